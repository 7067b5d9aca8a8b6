"""Meshes of OpenFOAM: points, faces between cells, and the boundary as patches; a case around them.

In 2D the cells become one layer of prisms between two patches of type `empty`.

The seams of a periodic box become one pair of cyclic patches for each periodic direction. Cells are not cut at the
seams, so some faces lie between a cell and an image that is shifted in two or three directions. They are in the pair of
the first of these directions. The vector from a face to the one across then differs within a patch. OpenFOAM of
openfoam.com (tested: v1912) accepts that from a patch with the transform `noOrdering`, whose faces it takes in the
order of the file; `translational` demands one vector for all. OpenFOAM's decomposed cases are wrong at patches with
`noOrdering`, so in those each vector has its own pair of patches.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import orjson
from numpy.typing import ArrayLike

from ..arguments import check_flag
from ..connectivity import slices
from ..errors import InputError, InputTypeError, OutputError
from ..finite_volumes.gate import rejection
from ..finite_volumes.prisms import polyhedra
from ..finite_volumes.solver_mesh import WallShape, make_solver_mesh
from ..geometry.boundary_names import WORD, Walls
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from .atomic import atomic_file, atomic_folder, make_folder
from .contents import DOMAIN, Contents, describe
from .foam_parts import ADDRESSING, FoamPatch, FoamPiece, decompose, processors_of


def cyclic_patches(mesh: Faces, apart: bool = False) -> tuple[list[FoamPatch], np.ndarray]:
    """Return the patches of the faces at seams in pairs, the upper one first, and the order of the faces in them.

    There is one pair for each periodic direction. With `apart` there is one for each vector across the seams, such as
    ``xMaxyMin`` and ``xMinyMax``. The faces of one patch are the images of those of the other one, in the same order,
    and each begins with the image of the same corner.
    """
    made: list[FoamPatch] = []
    shifts = mesh.shift[mesh.n_outer :][: np.count_nonzero(mesh.twin >= 0)].astype(np.int64)
    axes = np.argmax(shifts != 0, axis=1)
    lower = mesh.twin[mesh.n_outer :][: len(shifts)] < mesh.n_outer + np.arange(len(shifts))
    steps = np.where(lower[:, None], -shifts, shifts)
    codes = axes * 27 + (apart * (steps + 1) @ np.array([9, 3, 1])[: mesh.dim] if len(steps) else 0)
    for code in np.unique(codes).tolist():
        one = steps[(codes == code) & ~lower]
        axis = axes[codes == code][0]
        named = [axis, *(b for b in range(axis + 1, mesh.dim) if apart and one[0, b])]
        upper, under = ("".join(f"{'xyz'[b]}{end[int(one[0, b] > 0)]}" for b in named) for end in _ENDS)
        period = np.pad(one[0] * np.array(mesh.domain.extent), (0, 3 - mesh.dim))
        for name, across, vector in ((upper, under, 0 - period), (under, upper, period)):
            transform = ["transform       noOrdering"]
            if (one == one[0]).all():
                numbers = " ".join(repr(x) for x in vector.tolist())
                transform = ["transform       translational", f"separationVector ({numbers})"]
            entries = (f"neighbourPatch  {across}", *transform, "matchTolerance  0.0001")
            made.append(FoamPatch(name, "cyclic", len(one), entries))
    return made, np.lexsort([lower, codes])


_ENDS = (("Min", "Max"), ("Max", "Min"))
"""Ends of an axis in the names of the upper and the lower patch at a seam, for a shift below 0 and above 0."""
PatchType = Literal["wall", "patch", "symmetry", "symmetryPlane"]
"""Types of patches for `poly_mesh`."""
_OPEN_PARTS = ("inlet", "outlet", "inflow", "outflow", "farfield", "freestream", "atmosphere")
_OPEN_WORDS = {"open", "opening", "openings", "in", "out"}
"""Parts of a name, and whole words in it, that say that a fluid crosses the boundary."""


def poly_mesh(
    diagram: Diagram,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
    walls: WallShape = "straight",
    check: bool = True,
    apart: bool = False,
) -> tuple[Faces, list[FoamPatch], float]:
    """Describe `diagram` for OpenFOAM; faces without measure and points without a face are left out.

    The patches are the boundaries of the domain by their names, then one pair of cyclic patches for each periodic
    direction (see `cyclic`), then in 2D `back` and `front`. Cells of a periodic box are not cut at its seams.

    - `patches`: names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls that
      are not mentioned keep the name that the domain gives them.
    - `types`: type of each patch by name: "wall", "patch", "symmetry" or "symmetryPlane". By default that of
      `default_type`.
    - `thickness`: in 2D: height of the prisms, whose bottoms are at z = 0. By default the mean width of a cell.
    - `walls` {"straight", "exact"}: see `Diagram.solver_mesh`.
    - `check`: whether OpenFOAM must accept the mesh.
    - `apart`: see `cyclic_patches`.

    Results:
    - Faces: the cells as polyhedra. The faces of the patches follow those between two cells, patch by patch.
    - list of Patch
    - float: `Faces.area_change` of the mesh, in 2D of its polygons.

    Raises `InputError` or `InputTypeError` if `patches` names walls that do not exist, or a wall twice; if `types`
    names a patch or type that does not exist; if `thickness` is not positive, or given in 3D; if a name is that of a
    cyclic or empty patch; or for a cell around an island, as a face of OpenFOAM has no hole. Raises `OutputError` if
    OpenFOAM rejects the mesh: says where.
    """
    domain = diagram.domain
    parts = domain.boundaries if patches is None else domain.boundaries.renamed("patches", patches)
    kinds = patch_types(parts.names, types)
    mesh = make_solver_mesh(diagram, walls, walls == "straight", parts.index)
    cells = polyhedra(mesh, thickness)
    if check and (why := rejection(mesh, walls)):
        raise OutputError(
            f"{why}. To write it all the same, call mesh.to_openfoam(path, check=False), or clvoro with --unchecked"
        )
    groups = parts.index[-1 - mesh.neighbor[mesh.n_inner : mesh.n_outer]]
    counts = np.bincount(groups, minlength=len(parts.names)).tolist()
    made = [FoamPatch(*patch) for patch in zip(parts.names, kinds, counts, strict=True)]
    seams, order_of_seams = cyclic_patches(mesh, apart)
    made += seams
    if len(cells) > len(mesh):
        made += [FoamPatch("back", "empty", mesh.n_cells), FoamPatch("front", "empty", mesh.n_cells)]
    own = {patch.name for patch in made[len(parts.names) :]}
    clash = [name for name in parts.names if name in own]
    if clash:
        raise InputError(
            f"the boundary {clash[0]!r} has the name of a patch that OpenFOAM needs here; choose another name"
        )
    order = np.arange(len(cells))
    order[mesh.n_inner : mesh.n_outer] = mesh.n_inner + np.argsort(groups, kind="stable")
    order[mesh.n_outer : len(mesh)] = mesh.n_outer + order_of_seams
    return cells.take_faces(order), made, mesh.area_change


def default_type(name: str) -> PatchType:
    """Return the type of a patch by its name: "patch" for inlets, outlets and open boundaries, else "wall".

    Examples
    --------
    >>> [default_type(name) for name in ("inlet", "left_outlet2", "farField", "out2", "inletWall", "xMin")]
    ['patch', 'patch', 'patch', 'patch', 'wall', 'wall']
    """
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)]
    if "wall" in words or "walls" in words:
        return "wall"
    joined = "".join(words)
    is_open = any(part in joined for part in _OPEN_PARTS) or _OPEN_WORDS.intersection(words)
    return "patch" if is_open else "wall"


def patch_types(names: tuple[str, ...], types: Mapping[str, PatchType] | None) -> list[PatchType]:
    """Return the type of each patch: that of `types`, else that of its name.

    Raises `InputError` or `InputTypeError` if `types` names a patch or a type that does not exist.
    """
    known = get_args(PatchType)
    given = {} if types is None else types
    if not isinstance(given, Mapping):
        raise InputTypeError(
            f"types is {types!r:.60} of type {type(types).__name__}, expected a mapping from names of patches to "
            "types, such as {'inlet': 'patch'}"
        )
    for name, kind in given.items():
        if name not in names:
            raise InputError(f"types has {name!r:.60}, expected names of patches: {', '.join(names)}")
        if kind not in known:
            raise InputError(f"types has {kind!r:.60} for {name}, expected one of {', '.join(known)}")
    return [given.get(name, default_type(name)) for name in names]


_FILES = {
    "points": "vectorField",
    "owner": "labelList",
    "neighbour": "labelList",  # as OpenFOAM spells it
    "boundary": "polyBoundaryMesh",
    "faces": "faceList",
}
GENERATORS = "generators"
"""A file of clvoro's own beside those of a processor: the generators of its cells, on the first one behind a comment
with the domain."""
_OTHERS = ("cellZones", "faceZones", *ADDRESSING, GENERATORS)
_BYTE_ORDER = {"little": "LSB", "big": "MSB"}[sys.byteorder]
_CHUNK = 1 << 14


def polymesh_folder(path: str | PathLike[str]) -> Path | None:
    """Return the folder ``polyMesh`` that `path` means: itself, its case, or a file ``.foam`` in it; else None."""
    path = Path(path)
    case = path.parent if path.suffix.lower() == ".foam" else path
    if path.name == "polyMesh":
        return path
    return case / "constant" / "polyMesh" if path.suffix.lower() == ".foam" or path.is_dir() else None


def write_foam(
    contents: Contents,
    path: Path,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
    binary: bool = False,
    walls: WallShape = "straight",
    zones: Mapping[str, ArrayLike] | None = None,
    check: bool = True,
    processors: int | ArrayLike | None = None,
) -> None:
    """Write a polyMesh. With `processors` write a decomposed case, too: a polyMesh for each processor.

    - `path`: the folder ``.../constant/polyMesh``, which is created if it does not exist; its five files are replaced,
      others are left. Or ``CASE/name.foam``, an empty file that ParaView opens, with the mesh in
      ``CASE/constant/polyMesh``.
    - `patches`, `types`, `thickness`, `walls`, `check`: see `poly_mesh`. The note in the file `points` says by how much
      straight walls change the area.
    - `binary`: write numbers as bytes: labels of 32 bits and scalars of 64.
    - `zones`: zones of cells by name, one bool per cell each; see `MeshOutput.to_openfoam`. Without zones the files of
      those of an earlier mesh are removed.
    - `processors` int or (n,) array of int: see `MeshOutput.to_openfoam`.
    """
    contents.diagram.domain.require_flat(
        f"cannot write {path}: OpenFOAM's cells are polyhedra", "save as .nc with convention='mpas', or as .vtu"
    )
    if contents.extra:
        raise InputError(
            f"cannot write cell_data to {path}: OpenFOAM's polyMesh holds none; save as .vtu, write cells that belong "
            "together as zones (mesh.to_openfoam(path, zones={name: mask})), or leave it out"
        )
    of_cells = _zones(contents.diagram, zones)
    check_flag("binary", binary)
    check_flag("check", check)
    mesh, made, change = poly_mesh(contents.diagram, patches, types, thickness, walls, check, processors is not None)
    folder = polymesh_folder(path) or path
    part, count = None, 0
    if processors is not None:
        part = processors_of(processors, mesh.generators)
        count = int(part.max()) + 1
        _refuse_other_processors(folder, count)
    if folder != path:
        make_folder(path.parent)
        with atomic_file(path):  # first, because it fails if the folder is not writable
            pass
    changed = f"straight walls change the area by {100 * change:+.3g} %" if change else ""
    of_faces = _face_zones(contents.diagram, mesh)
    _write_piece(FoamPiece.whole(mesh, made), folder, changed, binary, of_cells, of_faces)
    if part is None:
        return
    settings = folder.parent.parent / "system" / "decomposeParDict"
    if not settings.exists():  # parallel programs of OpenFOAM ask for it
        make_folder(settings.parent)
        with atomic_file(settings) as file:
            head = _header("decomposeParDict", "", False).replace("regIOobject", "dictionary")
            head = head.replace("constant/polyMesh", "system")
            coefficients = f"simpleCoeffs\n{{\n    n ({count} 1 1);\n    delta 0.001;\n}}\n"
            file.write(f"{head}numberOfSubdomains {count};\nmethod simple;\n{coefficients}".encode("ascii"))
    diagram, domain = contents.diagram, json.dumps(describe(contents.diagram.domain))
    points = np.pad(diagram.points, ((0, 0), (0, 3 - diagram.domain.dim)))
    for number, piece in enumerate(decompose(mesh, made, part)):
        own_cells = {name: piece.local_cells(rows) for name, rows in of_cells.items()}
        own_faces = {name: piece.local_faces(*rows) for name, rows in of_faces.items()}
        place = folder.parent.parent / f"processor{number}" / "constant" / "polyMesh"
        own = _text(len(piece.cells), _vectors(points[piece.cells])) if len(points) == mesh.n_cells else ()
        more = {name: _text(len(numbers), _labels(numbers)) for name, numbers in piece.addressing.items()}
        more |= {GENERATORS: chain([f"//{DOMAIN}{domain}\n".encode()] * (number == 0), own)} if own else {}
        _write_piece(piece, place, changed, binary, own_cells, own_faces, more)


def _refuse_other_processors(folder: Path, count: int) -> None:
    """Raise an error if the case of `folder` is decomposed for more than `count` processors: some meshes would stay."""
    case = folder.parent.parent
    if folder.parent.name != "constant":
        raise InputError(
            f"cannot write {folder} for {count} processors, whose meshes are beside the folder constant; write into "
            "CASE/constant/polyMesh, or CASE/name.foam"
        )
    if (case / f"processor{count}").exists():
        raise InputError(
            f"cannot write {case} for {count} processors: it has processor{count} of another decomposition; remove "
            "the folders processor*, or choose another case"
        )


def _write_piece(
    piece: FoamPiece,
    folder: Path,
    changed: str,
    binary: bool,
    of_cells: Mapping[str, np.ndarray],
    of_faces: Mapping[str, tuple[np.ndarray, np.ndarray]],
    more: Mapping[str, Iterable[bytes]] | None = None,
) -> None:
    """Write the files of one polyMesh, and `more` lists. Remove files that an earlier mesh has left."""
    inner = len(piece.neighbor)
    make_folder(folder)
    note = f"nPoints:{len(piece.points)} nCells:{len(piece.cells)} nFaces:{len(piece.owner)} nInternalFaces:{inner}"
    notes = {"owner": note, "neighbour": note, "points": changed}
    lists: dict[str, Iterable[bytes]]
    if binary:
        lists = {
            "points": _bytes(piece.points, np.float64),
            "faces": chain(_bytes(piece.starts, np.int32), _bytes(piece.corners, np.int32)),
            "owner": _bytes(piece.owner, np.int32),
            "neighbour": _bytes(piece.neighbor, np.int32),
        }
    else:
        lists = {
            "points": _text(len(piece.points), _vectors(piece.points)),
            "faces": _text(len(piece.owner), _faces(piece.starts, piece.corners)),
            "owner": _text(len(piece.owner), _labels(piece.owner)),
            "neighbour": _text(inner, _labels(piece.neighbor)),
        }
    lists["boundary"] = _text(len(piece.patches), [_boundary(piece.patches, inner).encode("ascii")])
    if of_cells:
        lists["cellZones"] = _text(len(of_cells), [_zone(name, rows, "cell") for name, rows in of_cells.items()])
    if of_faces:
        made = [_zone(name, rows, "face", against) for name, (rows, against) in of_faces.items()]
        lists["faceZones"] = _text(len(made), made)
    lists |= more or {}
    # `faces` is moved last: a case without it is recognized as incomplete.
    with atomic_folder(folder / "faces") as target:
        for name in [*(other for other in _OTHERS if other in lists), *_FILES]:
            head = _header(name, notes.get(name, ""), binary and name in _FILES and name != "boundary")
            with open(target.with_name(name), "wb") as file:
                file.write(head.encode("ascii"))
                file.writelines(lists[name])
    for name in _OTHERS:
        if name not in lists:
            (folder / name).unlink(missing_ok=True)


def _header(name: str, note: str, binary: bool) -> str:
    kind = "labelList" if name in ADDRESSING else (_FILES | {GENERATORS: "vectorField"}).get(name, "regIOobject")
    if binary and name == "faces":
        kind = "faceCompactList"
    noted = f'    note        "{note}";\n' if note else ""
    arch = f'    arch        "{_BYTE_ORDER};label=32;scalar=64";\n' if binary else ""
    return (
        f"FoamFile\n{{\n    version     2.0;\n    format      {'binary' if binary else 'ascii'};\n{arch}"
        f"    class       {kind};\n{noted}"
        f'    location    "constant/polyMesh";\n    object      {name};\n}}\n\n'
    )


def _zones(diagram: Diagram, given: Mapping[str, ArrayLike] | None) -> dict[str, np.ndarray]:
    """Return the cells of each zone by name: of the regions between borders inside, and of the caller's zones."""
    found = {}
    if diagram.domain.borders is not None:
        regions = diagram.cell_region
        found = {name: np.flatnonzero(regions == k) for k, name in enumerate(diagram.region_names)}
    if not isinstance(given, Mapping | None):
        raise InputTypeError(
            f"zones is a {type(given).__name__}, expected a mapping from names to one bool per cell, such as "
            "{'pipe': surface.contains(mesh.points)}"
        )
    for name, values in (given or {}).items():
        if not isinstance(name, str) or not WORD.fullmatch(name) or name in found:
            raise InputError(
                f"zones has the name {name!r:.60}, expected a word of ASCII letters, digits, _, . and -, and another "
                f"one than those of regions ({', '.join(diagram.region_names)}); choose another name"
            )
        mask = np.asarray(values)
        if mask.dtype != bool or mask.shape != (len(diagram),):
            raise InputError(
                f"zones[{name!r}] has dtype {mask.dtype} and shape {mask.shape}, expected {len(diagram)} bool, one per "
                "cell; write a comparison, such as mesh.points[:, 0] > 0"
            )
        found[name] = np.flatnonzero(mask)
    return found


def _face_zones(diagram: Diagram, mesh: Faces) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the inner faces of a mesh for OpenFOAM that lie on borders, by name; see `Borders.face_sets`."""
    if diagram.domain.borders is None:
        return {}
    n, found = len(diagram), {}
    inner = slice(mesh.n_inner)
    own, other = mesh.owner[inner].astype(np.int64), mesh.neighbor[inner].astype(np.int64)
    forth, back = own * n + other, other * n + own
    for name, (rows, against) in diagram.domain.borders.face_sets(diagram).items():
        pair = diagram.faces.owner[rows].astype(np.int64) * n + diagram.faces.neighbor[rows]
        some = np.flatnonzero(np.isin(forth, pair) | np.isin(back, pair))
        turned = np.isin(forth[some], pair[against]) | np.isin(back[some], pair[~against])
        found[name] = some, turned
    return found


def _zone(name: str, rows: np.ndarray, kind: Literal["cell", "face"], against: np.ndarray | None = None) -> bytes:
    """Return a zone of cells or faces as text; `against` (k,) says whether normals of faces point the other way."""
    labels = b"\n".join([b"%d" % len(rows), b"(", _numbers(rows).replace(b",", b"\n"), b")"])
    body = b"    type %bZone;\n    %bLabels List<label>\n%b;\n" % (kind.encode(), kind.encode(), labels)
    if against is not None:
        body += b"    flipMap List<bool> %d(%b);\n" % (len(rows), b" ".join([b"%d" % turned for turned in against]))
    return b"%b\n{\n%b}\n" % (name.encode(), body)


def _bytes(values: np.ndarray, dtype: type) -> Iterator[bytes]:
    """Yield a binary list of OpenFOAM: its length, and its bytes in parentheses. An empty list has no parentheses."""
    yield b"%d\n" % len(values)
    if len(values):
        yield b"("
        yield np.ascontiguousarray(values, dtype).tobytes()
        yield b")\n"


def _text(count: int, body: Iterable[bytes]) -> Iterator[bytes]:
    yield b"%d\n(\n" % count
    yield from body
    yield b")\n"


def _labels(values: np.ndarray) -> Iterator[bytes]:
    for part in slices(len(values), _CHUNK):
        yield _numbers(values[part]).replace(b",", b"\n") + b"\n"


def _vectors(values: np.ndarray) -> Iterator[bytes]:
    for part in slices(len(values), _CHUNK):
        rows = _numbers(values[part])[1:-1]
        yield b"(" + rows.replace(b"],[", b")\n(").replace(b",", b" ") + b")\n"


def _faces(starts: np.ndarray, corners: np.ndarray) -> Iterator[bytes]:
    """Yield for each face its number of corners, and the corners in parentheses."""
    for part in slices(len(starts) - 1, _CHUNK):
        own = starts[part.start : part.stop + 1]
        # No label is negative: -1 stands for the opening parenthesis, and -2 for the closing one.
        count = np.diff(own)
        begin = own[:-1] - own[0] + 3 * np.arange(len(count))
        numbers = np.full(own[-1] - own[0] + 3 * len(count), -1, np.int64)
        numbers[begin], numbers[begin + count + 2] = count, -2
        kept = np.ones(len(numbers), bool)
        kept[begin] = kept[begin + 1] = kept[begin + count + 2] = False
        numbers[kept] = corners[own[0] : own[-1]]
        text = _numbers(numbers) + b","
        yield text.replace(b",-1,", b"(").replace(b",-2,", b")\n").replace(b",", b" ")


def _numbers(values: np.ndarray) -> bytes:
    """Return the text of an array, with commas and the brackets of rows; numbers are read back as the same ones."""
    return orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]


def _boundary(patches: list[FoamPatch], start: int) -> str:
    body = ""
    for patch in patches:
        body += f"    {patch.name}\n    {{\n        type            {patch.kind};\n"
        body += "".join(f"        {entry};\n" for entry in patch.entries)
        body += f"        nFaces          {patch.size};\n        startFace       {start};\n    }}\n"
        start += patch.size
    return body
