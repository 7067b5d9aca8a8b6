"""OpenFOAM's polyMesh: points, faces between cells, and the walls as patches.

In 2D the cells become prisms, one layer of them, between two patches of type `empty`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..domain import Domain
from ..errors import InputError
from ..faces import Faces, faces_once, following, take_rows
from ..polygon import Polygon
from ..results import Diagram, Result
from ..walls import wall_groups
from .atomic import atomic_file, atomic_folder

_FILES = {
    "points": "vectorField",
    "owner": "labelList",
    "neighbour": "labelList",
    "boundary": "polyBoundaryMesh",
    "faces": "faceList",
}


_CHUNK = 1 << 16


@dataclass(frozen=True)
class PolyMesh:
    """A mesh as OpenFOAM describes it.

    Attributes
    ----------
    points : (v, 3) float
    starts : (f + 1,) int, corners : int
        Corners of each face, counter-clockwise as seen from its neighbour or from outside.
    owner : (f,) int
        Cell behind each face.
    neighbour : (inner,) int
        Cell in front of each inner face; owner < neighbour. Inner faces come first, in upper-triangular
        order: by owner, then by neighbour.
    patches : list of (name, type, number of faces)
        One after the other behind the inner faces.
    """

    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbour: np.ndarray
    patches: list[tuple[str, str, int]]


def poly_mesh(diagram: Diagram, patches: Mapping[str, Iterable[int]] | None = None) -> PolyMesh:
    """Describe `diagram` for OpenFOAM; faces without measure and points without a face are left out.

    The patches are `xMin`, `xMax`, `yMin`, ... of a box, `outer`, `hole-1`, ... of a polygon (see `wall_groups`); in 2D
    also `back` and `front`, at z = 0 and at z = the mean size of a cell.

    Parameters
    ----------
    patches : mapping, optional
        Of a polygon: names of patches, and the numbers of their edges (`Polygon.edge_numbers`). They come before those
        of the rings, which keep the edges that are in none.

    Raises
    ------
    InputError
        If there are no such edges; for a cell with an island in it, as no face of OpenFOAM's has a hole; or for a
        periodic box.
    """
    box = diagram.domain
    if any(box.periodic):
        raise InputError(
            f"the mesh is of {box}, whose seams OpenFOAM would need as cyclic patches, which are not written, expected "
            "a domain with walls; save it as .vtu or .npz"
        )
    names, groups = wall_groups(box) if patches is None else _named(box, patches)
    faces = _by_group(faces_once(diagram), groups)
    counts = np.bincount(groups[-1 - faces.neighbour[faces.inner :]], minlength=len(names))
    made = [(name, "patch", int(k)) for name, k in zip(names, counts, strict=True)]
    owner, neighbour = faces.owner, faces.neighbour[: faces.inner]
    if box.dim == 2:
        points, starts, corners = _extruded(diagram, faces.corners, box)
        owner = np.concatenate([owner, *2 * [np.arange(len(diagram))]])
        made += [("back", "empty", len(diagram)), ("front", "empty", len(diagram))]
    else:
        points, starts, corners = diagram.vertices, faces.starts, faces.corners
    used, corners = np.unique(corners, return_inverse=True)
    return PolyMesh(points[used], starts, corners.ravel(), owner, neighbour, made)


def _named(domain: Domain, patches: Mapping[str, Iterable[int]]) -> tuple[list[str], np.ndarray]:
    """Return names of the patches, and the one that each edge of the polygon belongs to."""
    if not isinstance(domain, Polygon):
        raise InputError(
            "patches are groups of a polygon's edges, and the domain is no polygon; leave them out"
        )
    rings, groups = wall_groups(domain)
    groups = groups + len(patches)
    for k, (name, numbers) in enumerate(patches.items()):
        wanted = np.unique(np.array(list(numbers), np.int64))
        unknown = np.setdiff1d(wanted, domain.edge_numbers)
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z_][\w.-]*", name):
            raise InputError(
                f"patches has the name {name!r:.60}, expected a word of letters, digits, _, . and -"
            )
        if unknown.size or not wanted.size:
            what = (
                f"the edges {unknown[:5].tolist()}, which the polygon lacks"
                if wanted.size
                else "no edges"
            )
            raise InputError(
                f"patches has for {name} {what}; expected numbers as in Polygon.edge_numbers"
            )
        mine = np.isin(domain.edge_numbers, wanted)
        taken = np.flatnonzero(mine & (groups < len(patches)))
        if taken.size:
            other = list(patches)[groups[taken[0]]]
            raise InputError(
                f"patches has edge {domain.edge_numbers[taken[0]]} both in {other} and in {name}, expected in one"
            )
        groups[mine] = k
    left = np.unique(groups[groups >= len(patches)])
    twice = [rings[g - len(patches)] for g in left if rings[g - len(patches)] in patches]
    if twice:
        raise InputError(
            f"patches has the name {twice[0]}, which is that of a ring with other edges; take another"
        )
    places = np.concatenate([np.arange(len(patches)), np.full(len(rings), -1)])
    places[left] = len(patches) + np.arange(len(left))
    return [*patches, *(rings[g - len(patches)] for g in left)], places[groups]


def _by_group(faces: Faces, groups: np.ndarray) -> Faces:
    """Return `faces` with those on the boundary in the order of their groups."""
    outer = np.argsort(groups[-1 - faces.neighbour[faces.inner :]], kind="stable") + faces.inner
    if (np.diff(outer) > 0).all():
        return faces
    order = np.concatenate([np.arange(faces.inner), outer])
    starts, corners = take_rows(faces.starts, faces.corners, order)
    return Faces(faces.owner[order], faces.neighbour[order], faces.rows[order], starts, corners)


def _extruded(
    diagram: Diagram, sides: np.ndarray, box: Domain
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, starts and corners of the prisms' sides, then their bottoms, then their tops."""
    flat, v = diagram.vertices, len(diagram.vertices)
    thickness = float(np.sqrt(box.measure / len(diagram)))
    points = np.concatenate([np.pad(flat, ((0, 0), (0, 1))), np.pad(flat, ((0, 0), (0, 1)))])
    points[v:, 2] = thickness
    a, b = sides.reshape(-1, 2).T
    walls = np.stack([a, b, b + v, a + v], axis=1)
    # Corners that are the same vertex twice are one.
    starts, corners = diagram.cell_vertex_starts, diagram.cell_vertices
    cell = np.repeat(np.arange(len(diagram)), np.diff(starts))
    kept = corners != corners[following(starts)]
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell[kept], minlength=len(diagram)))])
    corners, everyone = corners[kept], np.arange(len(diagram))
    key = np.sort(cell[kept].astype(np.int64) * v + corners)
    twice = key[1:][np.diff(key) == 0] // max(v, 1)
    if twice.size:
        raise InputError(
            f"cell {twice[0]} ({len(np.unique(twice))} in all) goes around a part of the boundary or touches itself, "
            "and faces of OpenFOAM's have no holes; use smaller cells there, leave out the hole, or save as .vtu"
        )
    _, bottoms = take_rows(starts, corners, everyone, np.ones(len(diagram), bool))
    lengths = np.concatenate([np.full(len(walls), 4), np.diff(starts), np.diff(starts)])
    return (
        points,
        np.concatenate([[0], np.cumsum(lengths)]),
        np.concatenate([walls.ravel(), bottoms, corners + v]),
    )


def write_foam(
    result: Result, path: Path, patches: Mapping[str, Iterable[int]] | None = None
) -> None:
    """Write a polyMesh.

    Parameters
    ----------
    path : Path
        The folder ``.../constant/polyMesh``, made if need be; its five files are replaced, others there are left.
        Or a case's marker ``CASE/name.foam``, an empty file which ParaView opens, with the mesh in
        ``CASE/constant/polyMesh``.
    patches : mapping, optional
        See `poly_mesh`.
    """
    mesh = poly_mesh(result.diagram, patches)
    marker = path if path.suffix.lower() == ".foam" else None
    folder = path if marker is None else path.parent / "constant" / "polyMesh"
    if marker is not None:
        with atomic_file(marker):  # first: it says whether the case's folder can be written
            pass
    _make(folder)
    note = (
        f"nPoints:{len(mesh.points)} nCells:{len(result.diagram)} nFaces:{len(mesh.owner)} "
        f"nInternalFaces:{len(mesh.neighbour)}"
    )
    bodies = {
        "points": (len(mesh.points), _vectors(mesh.points)),
        "faces": (len(mesh.owner), _faces(mesh.starts, mesh.corners)),
        "owner": (len(mesh.owner), _labels(mesh.owner)),
        "neighbour": (len(mesh.neighbour), _labels(mesh.neighbour)),
        "boundary": (len(mesh.patches), [_boundary(mesh)]),
    }
    # `faces` is put in place last: a case without it is plainly incomplete.
    with atomic_folder(folder / "faces") as target:
        for name, kind in _FILES.items():
            count, body = bodies[name]
            head = _header(name, kind, note if name in ("owner", "neighbour") else "")
            with open(target.with_name(name), "w", encoding="ascii", newline="\n") as file:
                file.write(f"{head}{count}\n(\n")
                file.writelines(body)
                file.write(")\n")


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot write {folder}: no folder can be made there ({error.strerror}); choose "
            "another place"
        ) from error


def _header(name: str, kind: str, note: str) -> str:
    noted = f'    note        "{note}";\n' if note else ""
    return (
        "FoamFile\n{\n    version     2.0;\n    format      ascii;\n"
        f"    class       {kind};\n{noted}"
        f'    location    "constant/polyMesh";\n    object      {name};\n}}\n\n'
    )


def _chunks(count: int) -> Iterator[slice]:
    """Cut `count` rows into parts, as text in Python takes ten times the room of the numbers."""
    return (slice(k, min(k + _CHUNK, count)) for k in range(0, count, _CHUNK))


def _labels(values: np.ndarray) -> Iterator[str]:
    for part in _chunks(len(values)):
        rows = values[part].tolist()
        yield "%d\n" * len(rows) % tuple(rows)


def _vectors(values: np.ndarray) -> Iterator[str]:
    for part in _chunks(len(values)):
        rows = values[part]
        # The shortest text that reads back as the same number.
        yield "(%r %r %r)\n" * len(rows) % tuple(rows.ravel().tolist())


def _faces(starts: np.ndarray, corners: np.ndarray) -> Iterator[str]:
    sides = np.diff(starts)
    forms = [f"{k}({' '.join(['%d'] * k)})\n" for k in range(int(sides.max(initial=0)) + 1)]
    for part in _chunks(len(sides)):
        form = "".join([forms[k] for k in sides[part].tolist()])
        yield form % tuple(corners[starts[part.start] : starts[part.stop]].tolist())


def _boundary(mesh: PolyMesh) -> str:
    body, start = "", len(mesh.neighbour)
    for name, kind, count in mesh.patches:
        body += (
            f"    {name}\n    {{\n        type            {kind};\n"
            f"        nFaces          {count};\n        startFace       {start};\n    }}\n"
        )
        start += count
    return body
