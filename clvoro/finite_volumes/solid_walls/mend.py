"""Find cells at curved walls that checkMesh takes for concave, and the faces whose collapse mends them."""

from __future__ import annotations

import numpy as np

from ...connectivity import rows_with, take_rows
from ...mesh.faces import Faces
from ..defects import DefectLimits
from ..gate import rejected_cells

NARROW = 0.08
"""Faces between two cells are collapsed if they are smaller than this share of h^2 and a cell is concave there."""


def narrow_faces(faces: Faces, sizes: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return the small faces between two cells that make one of them concave, (f,) bool.

    Where a wall is curved, the common edge of two wall polygons may bulge out of the planes of both. So does the center
    of the face between their cells if that is small.

    - `sizes` (n,) float: h of the cells.
    - `among` (n,) bool: the cells that are examined.
    """
    chosen = np.zeros(len(faces), bool)
    chosen[faces.measures.concave_pairs(DefectLimits().concavity, among)[0]] = True
    chosen[faces.n_inner :] = False
    h = np.minimum(sizes[faces.owner], sizes[np.maximum(faces.neighbor, 0)])
    return chosen & (faces.area < NARROW * h**2)


def rejected_at_walls(faces: Faces, judged: np.ndarray) -> np.ndarray:
    """Return which of the cells `judged` (n,) bool at walls, or beside these, OpenFOAM rejects, (k,) int."""
    # Other faces have the vertices of the diagram, and their tetrahedra are right.
    return rejected_among(faces, judged & with_neighbors(faces, at_wall(faces)), touching_walls(faces))


def rejected_among(faces: Faces, judged: np.ndarray, doubtful: np.ndarray) -> np.ndarray:
    """Return the numbers (k,) of the cells that OpenFOAM rejects, of those `judged` (n,) bool.

    Only faces of `doubtful` cells (n,) bool are divided into tetrahedra, which takes the longest.
    """
    kept = with_neighbors(faces, judged)
    if 2 * np.count_nonzero(kept) > len(kept):
        kept[:] = True
    cells, part = np.flatnonzero(kept), faces if kept.all() else faces.part(kept)[0]
    doubtful = doubtful[cells]
    tested = np.flatnonzero(doubtful[part.owner] | (doubtful[np.maximum(part.neighbor, 0)] & (part.neighbor >= 0)))
    return cells[rejected_cells(part, tested, judged[cells])]


def spoiled_near_walls(before: Faces, made: Faces) -> np.ndarray:
    """Return which cells near walls `collapse_short` has changed so that OpenFOAM rejects them, (n,) bool.

    Cells there may have small defects before. A collapse may exchange these for others.
    """
    near = with_neighbors(before, touching_walls(before))
    judged = changed_cells(before, made, near) & near
    found = np.zeros(len(judged), bool)
    found[rejected_among(made, judged, judged)] = True
    return found


def changed_cells(before: Faces, made: Faces, among: np.ndarray | None = None) -> np.ndarray:
    """Return which cells `collapse_short` has changed, (n,) bool.

    It has turned the mesh `before` into `made`. Only faces of the cells `among` (n,) bool are compared, if given.
    """
    row = np.full(before.half_face.max() + 1, -1)
    row[before.half_face] = np.arange(len(before))
    rows = row[made.half_face]
    mine = np.ones(len(made), bool) if among is None else among[made.owner] | among[np.maximum(made.neighbor, 0)]
    changed = mine & (np.diff(made.starts) != np.diff(before.starts)[rows])
    kept = np.flatnonzero(mine & ~changed)
    starts, corners = take_rows(made.starts, made.corners, kept)
    there = take_rows(before.starts, before.corners, rows[kept])[1]
    moved = np.zeros(len(corners), bool)
    for x, y in zip(np.ascontiguousarray(made.points.T), np.ascontiguousarray(before.points.T), strict=True):
        moved |= x.take(corners) != y.take(there)
    changed[kept] = rows_with(starts, moved)
    return cells_of(made, changed)


def touching_walls(faces: Faces) -> np.ndarray:
    """Return which cells have a vertex on a wall, (n,) bool."""
    on = np.zeros(len(faces.points), bool)
    on[faces.corners[faces.starts[faces.n_inner] :]] = True
    return cells_of(faces, rows_with(faces.starts, on[faces.corners]))


def cells_of(faces: Faces, chosen: np.ndarray) -> np.ndarray:
    """Return which cells have one of the faces `chosen` (f,) bool, (n,) bool."""
    found = np.zeros(faces.n_cells, bool)
    found[faces.owner[chosen]] = True
    found[faces.neighbor[chosen & (faces.neighbor >= 0)]] = True
    return found


def with_neighbors(faces: Faces, cells: np.ndarray, rings: int = 1) -> np.ndarray:
    """Return the `cells` (n,) bool with their neighbors, the neighbors of these, and so on, (n,) bool."""
    a, b = faces.owner[: faces.n_inner], faces.neighbor[: faces.n_inner]
    for _ in range(rings):
        ring = cells.copy()
        ring[a[cells[b]]] = ring[b[cells[a]]] = True
        cells = ring
    return cells


def at_wall(faces: Faces) -> np.ndarray:
    """Return which cells have a wall, (n,) bool."""
    found = np.zeros(faces.n_cells, bool)
    found[faces.owner[faces.n_inner :]] = True
    return found
