"""Meshes whose faces lie on surfaces inside: small faces there are collapsed, vertices are moved onto the surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..connectivity import distinct, following, rows_of, rows_with, starts_of, take_rows
from ..errors import InputError
from ..geometry.solid.creases import connect
from ..geometry.surfaces.sheets import Sheets
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import sum_rows
from .collapse import collapse_short
from .moves import FEW, MOVES, at_generators, least_bad, moved
from .solid_walls.balance import balanced, unbalanced
from .solid_walls.mend import NARROW, cells_of, narrow_faces, rejected_among, with_neighbors
from .solid_walls.mesh import diagram_of

_SMALL = 0.15
"""Smaller faces on a surface, over h^2, are between cells of different pairs."""
_ON_EDGE, _ON_CORNER = 0.12, 0.2
"""Vertices this near to an edge or a corner of a surface, over h, lie on it."""
_FLAT = 1e-6
"""Vertices this near to a surface, over h, are on it."""
_TINY = 1e-3
"""Smaller faces between cells near surfaces, over h^2, are collapsed."""
_COLLAPSES, _TRIALS = 3, 20
_ROUNDS = 4
"""How often vertices at walls are moved to the surface, and back to the walls."""


@dataclass(frozen=True)
class _OnSurfaces:
    """A mesh whose faces lie on surfaces.

    - `diagram`: Diagram
    - `rejected` (k,) int: the cells near surfaces that OpenFOAM rejects.
    """

    diagram: Diagram
    rejected: np.ndarray

    @property
    def home(self) -> np.ndarray:
        """Return the generator of each cell, (n,) int."""
        home = self.diagram.home
        return np.arange(len(self.diagram)) if home is None else np.where(home < 0, -1 - home, home)


def on_surfaces(
    diagram: Diagram,
    sheets: Sheets,
    points: np.ndarray,
    sizes: np.ndarray,
    remake: Callable[[np.ndarray], Diagram],
    held: int = 0,
) -> Diagram:
    """Return a mesh whose faces between cells on both sides of `sheets` lie on them.

    Pairs of generators are mirror images in tangent planes. The face between such a pair lies on the surface where that
    is flat. Elsewhere it is near the surface, with narrow faces between cells of different pairs around it. Where
    OpenFOAM would reject cells, generators there are moved a little, and the mesh is made again.

    - `points` (n, 3) float: the generators of `diagram`.
    - `sizes` (n,) float: h at the generators.
    - `remake`: returns the diagram of other generators (n, 3).
    - `held`: how many of the first generators are not moved.
    """
    domain, first = diagram.domain, _made(diagram, sheets)

    def depth(x: np.ndarray) -> np.ndarray:
        return np.where(domain.contains(x), domain.boundary_distance(x), -1.0)

    def again(points: np.ndarray, last: _OnSurfaces) -> _OnSurfaces | None:
        del last
        try:
            return _made(remake(points), sheets)
        except InputError:
            return None

    points, own = points.copy(), slice(None) if diagram.home is None else diagram.home >= 0
    points[first.home[own]] = diagram.points[own]

    def change(points: np.ndarray, rows: np.ndarray, move: int) -> np.ndarray:
        return moved(domain, depth, sizes, points, rows, move, held) if len(rows) <= FEW * len(points) else points

    def badness(made: _OnSurfaces) -> np.ndarray:
        return at_generators(made.home[made.rejected], len(points))

    return least_bad(first, points, sizes, badness, change, again, [False] * MOVES).diagram


def _made(diagram: Diagram, sheets: Sheets) -> _OnSurfaces:
    """Move the faces of a diagram between cells on both sides of surfaces onto them."""
    none = np.zeros(0, np.int64)
    rows = diagram.border_faces
    if not len(rows):
        return _OnSurfaces(diagram, none)
    faces = diagram.faces
    h = np.cbrt(diagram.volumes)
    of_face = np.minimum(h[faces.owner[rows]], h[faces.neighbor[rows]])
    vertices, size = _vertices(faces, rows, of_face)
    small = faces.area[rows] < _SMALL * of_face**2
    if not small.any() and (sheets.distance(faces.points[vertices]) < _FLAT * size).all():
        return _OnSurfaces(diagram, none)
    mesh = replace(faces, diagram=None, points=faces.points.astype(np.float64), corners=faces.corners.astype(np.int32))
    if small.any():
        mesh = _with_pairs_only(mesh, rows, small, vertices)
    made = _moved(mesh, sheets, h)
    for _ in range(_COLLAPSES):
        narrow = _faces_to_collapse(made, h)
        if not narrow.any():
            break
        made = _moved(collapse_short(made.faces, None, narrow, narrow), sheets, h)
    # Then single faces are collapsed where fewer cells are rejected afterwards.
    rejected, tried = _rejected(made, np.ones(len(made), bool)), 0
    while len(rejected) and tried < _TRIALS:
        mesh = made.faces
        of_rejected = np.isin(mesh.owner, rejected) | np.isin(mesh.neighbor, rejected)
        size = np.minimum(h[mesh.owner], h[np.maximum(mesh.neighbor, 0)]) ** 2
        narrow = np.flatnonzero((of_rejected & (mesh.area < NARROW * size))[: mesh.n_inner])
        narrow = narrow[np.argsort((mesh.area / size)[narrow], kind="stable")][tried:]
        if not len(narrow):
            break
        trial, near = _moved(_without_face(mesh, narrow[0]), sheets, h), _around(mesh, narrow[0])
        left = np.union1d(rejected[~near[rejected]], _rejected(trial, near))
        if len(left) < len(rejected):
            made, rejected, tried = trial, left, 0
        else:
            tried += 1
    made, rejected = _balanced(made, sheets, rejected)
    made.home = np.arange(len(made)) if diagram.home is None else diagram.home
    return _OnSurfaces(made, rejected)


def _balanced(diagram: Diagram, sheets: Sheets, rejected: np.ndarray) -> tuple[Diagram, np.ndarray]:
    """Return the mesh with balanced faces on curved surfaces, and the cells that OpenFOAM rejects, (k,) int.

    Vertices stay where it would reject other cells than those that it has `rejected` (k,) before.
    """
    mesh, rows = diagram.faces, diagram.border_faces
    feet = sheets.feet(mesh.center[rows])
    patch, turned = np.where(mesh.neighbor < 0, sheets.n_patches - 1 - mesh.neighbor, -1), np.zeros(len(mesh), bool)
    patch[rows] = sheets.patch[feet.triangle]
    turned[rows] = (mesh.vectors[1][rows] * sheets.normals[feet.triangle]).sum(axis=1) < 0
    bent = np.zeros(patch.max(initial=0) + 1, bool)
    bent[: sheets.n_patches] = sheets.bent
    faces, every = balanced(mesh, patch, bent, sheets.nearest, turned), np.ones(len(diagram), bool)
    if faces is mesh:
        return diagram, rejected
    made = _with_borders(faces, rows)
    found = _rejected(made, every)
    if len(worse := np.setdiff1d(found, rejected)):
        made = _with_borders(unbalanced(faces, mesh.points, worse)[0], rows)
        found = _rejected(made, every)
    return made, found


def _with_borders(mesh: Faces, rows: np.ndarray) -> Diagram:
    """Return the diagram of a mesh whose faces `rows` (k,) lie on surfaces."""
    made = diagram_of(mesh)
    made.border_faces = rows
    return made


def _rejected(diagram: Diagram, among: np.ndarray) -> np.ndarray:
    """Return the numbers (k,) of the cells `among` (n,) bool that OpenFOAM rejects, near surfaces only.

    These cells have a face on a surface, or a neighbor with one.
    """
    beside = _beside(diagram)
    return rejected_among(diagram.faces, beside & among, beside)


def _around(mesh: Faces, row: int) -> np.ndarray:
    """Return which cells have a vertex of the face `row`, or a neighbor that has one, (n,) bool."""
    corners = mesh.corners[mesh.starts[row] : mesh.starts[row + 1]]
    return with_neighbors(mesh, cells_of(mesh, rows_with(mesh.starts, np.isin(mesh.corners, corners))))


def _without_face(mesh: Faces, row: int) -> Faces:
    """Return a mesh in which all corners of a face are one vertex, in the middle."""
    corners = mesh.corners[mesh.starts[row] : mesh.starts[row + 1]]
    points, to = mesh.points.copy(), np.arange(len(mesh.points))
    points[corners[0]], to[corners] = points[corners].mean(axis=0), corners[0]
    return _relabeled(replace(mesh, points=points), to)


def _moved(mesh: Faces, sheets: Sheets, h: np.ndarray) -> Diagram:
    """Return a mesh whose faces on surfaces have their vertices there; `h` (n,) are the sizes of cells."""
    rows = diagram_of(mesh).border_faces
    vertices, size = _vertices(mesh, rows, np.minimum(h[mesh.owner[rows]], h[mesh.neighbor[rows]]))
    points = mesh.points.copy()
    points[vertices] = _onto(mesh, sheets, vertices, size)
    return _with_borders(replace(mesh, points=points, diagram=None), rows)


def _beside(diagram: Diagram) -> np.ndarray:
    """Return which cells have a face on a surface, or a neighbor with such a face, (n,) bool."""
    on_surface = np.zeros(len(diagram.faces), bool)
    on_surface[diagram.border_faces] = True
    return with_neighbors(diagram.faces, cells_of(diagram.faces, on_surface))


def _faces_to_collapse(diagram: Diagram, h: np.ndarray) -> np.ndarray:
    """Return the faces of cells near surfaces that are tiny, or small where a cell is concave, (f,) bool."""
    mesh, beside = diagram.faces, _beside(diagram)
    tiny = mesh.area < _TINY * np.minimum(h[mesh.owner], h[np.maximum(mesh.neighbor, 0)]) ** 2
    tiny &= beside[mesh.owner] | beside[np.maximum(mesh.neighbor, 0)]
    tiny[mesh.n_inner :] = False
    return tiny | narrow_faces(mesh, h, beside)


def _with_pairs_only(mesh: Faces, rows: np.ndarray, small: np.ndarray, vertices: np.ndarray) -> Faces:
    """Return a mesh without the small faces on surfaces, which are between cells of different pairs.

    Two cells that share a large face on a surface are a pair and have one number. A vertex has the numbers of the cells
    at surfaces that meet there, and of its walls. Two ends of an edge of a small face become one vertex if they have
    the same numbers, or if one has all the numbers of the other and four or more. Small faces then have no area.

    - `rows` (k,) int: the faces on surfaces.
    - `small` (k,) bool: which of these are small.
    - `vertices` (v,) int: the corners of these faces.
    """
    n = mesh.n_cells
    pairs = np.stack([mesh.owner[rows[~small]], mesh.neighbor[rows[~small]]], axis=1)
    number = connect(n, pairs)[1]
    on_border = np.zeros(n, bool)
    on_border[mesh.owner[rows]] = on_border[mesh.neighbor[rows]] = True
    place = np.full(len(mesh.points), -1)
    place[vertices] = np.arange(len(vertices))
    at = place[mesh.corners]
    face = rows_of(mesh.starts)
    at, face = at[at >= 0], face[at >= 0]
    other = mesh.neighbor[face]
    both = [np.stack([at, number[mesh.owner[face]]], axis=1)[on_border[mesh.owner[face]]]]
    inner = (other >= 0) & on_border[np.maximum(other, 0)]
    both += [np.stack([at, number[np.maximum(other, 0)]], axis=1)[inner], np.stack([at, other], axis=1)[other < 0]]
    found = np.unique(np.concatenate(both), axis=0)
    starts = np.searchsorted(found[:, 0], np.arange(len(vertices) + 1))
    numbers = [tuple(found[starts[k] : starts[k + 1], 1].tolist()) for k in range(len(vertices))]
    starts, corners = take_rows(mesh.starts, mesh.corners, rows[small])
    begin, end = place[corners], place[corners[following(starts)]]
    joined = []
    for i, j in zip(begin.tolist(), end.tolist(), strict=True):
        one, two = numbers[i], numbers[j]
        if one == two or (max(len(one), len(two)) > 3 and (set(one) <= set(two) or set(two) <= set(one))):
            joined.append((i, j))
    group = connect(len(vertices), np.array(joined, int).reshape(-1, 2))[1]
    count = np.bincount(group)
    x = sum_rows(group, mesh.points[vertices], len(count)) / count[:, None]
    first = vertices[np.unique(group, return_index=True)[1]]
    points, to = mesh.points.copy(), np.arange(len(mesh.points))
    points[first], to[vertices] = x, first[group]
    return _relabeled(replace(mesh, points=points), to)


def _relabeled(mesh: Faces, to: np.ndarray) -> Faces:
    """Return a mesh with vertices replaced by the vertices `to` (v,); faces with less than three are left out."""
    touched = np.unique(rows_of(mesh.starts)[to[mesh.corners] != mesh.corners])
    corners, stays = to[mesh.corners].astype(np.int32), np.ones(len(mesh.corners), bool)
    for begin, end in zip(mesh.starts[touched].tolist(), mesh.starts[touched + 1].tolist(), strict=True):
        left = _without_spikes(list(zip(corners[begin:end].tolist(), range(begin, end), strict=True)))
        stays[begin:end] = False
        stays[[place for _, place in left]] = len(left) > 2
    counts = np.add.reduceat(stays, mesh.starts[:-1], dtype=np.int64)
    rows = np.flatnonzero(counts)
    starts = starts_of(counts[rows])
    return mesh.take_faces(rows, starts=starts, corners=corners[stays]).compact()


def _without_spikes(loop: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return a loop of (vertex, place) without repeated vertices and edges that run there and back."""
    k = 0
    while k < len(loop) and len(loop) > 2:
        if loop[k][0] == loop[k - 1][0]:
            del loop[k]
        elif loop[k - 2][0] == loop[k][0]:
            for m in sorted(((k - 1) % len(loop), k), reverse=True):
                del loop[m]
        else:
            k += 1
            continue
        k = 0
    return loop


def _vertices(faces: Faces, rows: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of some faces, each once, and the least of the sizes of their faces."""
    starts, corners = take_rows(faces.starts, faces.corners, rows)
    vertices, place = np.unique(corners, return_inverse=True)
    least = np.full(len(vertices), math.inf)
    np.minimum.at(least, place.reshape(-1), np.repeat(size, np.diff(starts)))
    return vertices, least


def _onto(mesh: Faces, sheets: Sheets, vertices: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the points on the surface to which vertices move; vertices on walls stay there."""
    x = mesh.points[vertices]
    starts, corners = take_rows(mesh.starts, mesh.corners, np.arange(mesh.n_inner, len(mesh)))
    wall = np.repeat(-1 - mesh.neighbor[mesh.n_inner :], np.diff(starts))
    pairs = np.unique(np.stack([corners, wall], axis=1), axis=0)
    place = np.searchsorted(vertices, pairs[:, 0])
    there = (place < len(vertices)) & (vertices[np.minimum(place, len(vertices) - 1)] == pairs[:, 0])
    place, wall = place[there], pairs[there, 1]
    at_wall = np.zeros(len(vertices), bool)
    at_wall[place] = True
    corner, edge = sheets.nearest_corner(x, _ON_CORNER * size), sheets.nearest_on_edges(x, _ON_EDGE * size)
    moved = np.where(np.isfinite(edge), edge, sheets.nearest(x))
    moved = np.where(np.isfinite(corner) & ~at_wall[:, None], corner, moved)
    for k in range(_ROUNDS + 1 if len(place) else 0):
        if k:
            moved[at_wall] = sheets.nearest(moved[at_wall])
        for w in distinct(wall).tolist():
            some = place[wall == w]
            normals, gaps = mesh.domain.toward_walls(np.full(len(some), w), moved[some])
            moved[some] += gaps[:, None] * normals
    return moved
