"""Write the files of OpenFOAM's polyMesh; `polymesh` makes the mesh."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

import numpy as np
import orjson

from ..errors import InputError, InputTypeError
from ..finite_volumes.solver_mesh import WallShape, check_not_sphere
from ..geometry.boundary_names import Walls
from ..mesh.connectivity import slices
from .atomic import atomic_file, atomic_folder, make_folder
from .contents import Contents
from .cyclic import FoamPatch
from .polymesh import PatchType, poly_mesh

_FILES = {
    "points": "vectorField",
    "owner": "labelList",
    "neighbour": "labelList",  # as OpenFOAM spells it
    "boundary": "polyBoundaryMesh",
    "faces": "faceList",
}
_BYTE_ORDER = {"little": "LSB", "big": "MSB"}[sys.byteorder]
_CHUNK = 1 << 14


def write_foam(
    contents: Contents,
    path: Path,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
    binary: bool = False,
    walls: WallShape = "straight",
) -> None:
    """Write a polyMesh.

    Parameters
    ----------
    path : Path
        The folder ``.../constant/polyMesh``, which is created if it does not exist; its five files are replaced, others
        are left. Or ``CASE/name.foam``, an empty file that ParaView opens, with the mesh in ``CASE/constant/polyMesh``.
    patches, types, thickness, walls : optional
        See `poly_mesh`. The note in the file `points` says by how much straight walls change the area.
    binary : bool, optional
        Write numbers as bytes: labels of 32 bits and scalars of 64.
    """
    check_not_sphere(
        contents.diagram,
        f"cannot write {path}: OpenFOAM's cells are polyhedra",
        "save as .nc with convention='mpas', or as .vtu",
    )
    if contents.extra:
        raise InputError(
            f"cannot write cell_data to {path}: OpenFOAM's polyMesh holds none; save as .vtu or leave it out"
        )
    if not isinstance(binary, bool | np.bool_):
        raise InputTypeError(f"binary is {binary!r:.60} of type {type(binary).__name__}, expected True or False")
    mesh, made, change = poly_mesh(contents.diagram, patches, types, thickness, walls)
    inner = mesh.n_inner
    marker = path if path.suffix.lower() == ".foam" else None
    folder = path if marker is None else path.parent / "constant" / "polyMesh"
    if marker is not None:
        make_folder(marker.parent)
        with atomic_file(marker):  # first, because it fails if the folder is not writable
            pass
    make_folder(folder)
    note = f"nPoints:{len(mesh.points)} nCells:{mesh.n_cells} nFaces:{len(mesh)} nInternalFaces:{inner}"
    changed = f"straight walls change the area by {100 * change:+.3g} %" if change else ""
    notes = {"owner": note, "neighbour": note, "points": changed}
    if binary:
        lists = {
            "points": _bytes(mesh.points, np.float64),
            "faces": chain(_bytes(mesh.starts, np.int32), _bytes(mesh.corners, np.int32)),
            "owner": _bytes(mesh.owner, np.int32),
            "neighbour": _bytes(mesh.neighbor[:inner], np.int32),
        }
    else:
        lists = {
            "points": _text(len(mesh.points), _vectors(mesh.points)),
            "faces": _text(len(mesh.owner), _faces(mesh.starts, mesh.corners)),
            "owner": _text(len(mesh.owner), _labels(mesh.owner)),
            "neighbour": _text(inner, _labels(mesh.neighbor[:inner])),
        }
    lists["boundary"] = _text(len(made), [_boundary(made, inner).encode("ascii")])
    # `faces` is moved last: a case without it is recognized as incomplete.
    with atomic_folder(folder / "faces") as target:
        for name in _FILES:
            head = _header(name, notes.get(name, ""), binary and name != "boundary")
            with open(target.with_name(name), "wb") as file:
                file.write(head.encode("ascii"))
                file.writelines(lists[name])


def _header(name: str, note: str, binary: bool) -> str:
    kind = "faceCompactList" if binary and name == "faces" else _FILES[name]
    noted = f'    note        "{note}";\n' if note else ""
    arch = f'    arch        "{_BYTE_ORDER};label=32;scalar=64";\n' if binary else ""
    return (
        f"FoamFile\n{{\n    version     2.0;\n    format      {'binary' if binary else 'ascii'};\n{arch}"
        f"    class       {kind};\n{noted}"
        f'    location    "constant/polyMesh";\n    object      {name};\n}}\n\n'
    )


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
        if patch.across:
            body += f"        neighbourPatch  {patch.across};\n"
            vector = " ".join(repr(x) for x in patch.separation)
            body += (
                f"        transform       translational;\n        separationVector ({vector});\n"
                if patch.separation
                else "        transform       noOrdering;\n"
            )
            body += "        matchTolerance  0.0001;\n"
        body += f"        nFaces          {patch.size};\n        startFace       {start};\n    }}\n"
        start += patch.size
    return body
