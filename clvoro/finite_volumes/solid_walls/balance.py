"""Move the vertices of curved walls so that each wall polygon cuts off as much of the solid as it adds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...mesh.connectivity import following, rows_with, take_rows
from ...mesh.faces import Faces
from .mend import cells_of
from .wall_surface import WallSurface

_DEEPEST = 0.15
"""Largest depth of a polygon below the surface that is balanced, over the root of its area: where details are smaller
than polygons, depths do not follow from the curvature."""
_INNER = 0.01
"""A vertex stays in the planes of the faces between cells, and moves off its walls by their depths. Where it cannot do
both, the planes count this much, the depths 1."""
_LONGEST = 2.0
"""Longest way of a vertex, over the largest depth of the wall polygons around it."""


def balanced(surface: WallSurface, faces: Faces) -> Faces:
    """Return `faces` with vertices of curved walls moved by the mean depth of the wall polygons below the surface.

    Chords of a curved surface cut off a volume of second order. Vertices stay in the planes of the faces between cells,
    along whose common edges they move, and in those of flat walls.
    """
    center, vector = faces.vectors
    normal = vector / np.maximum(np.linalg.norm(vector, axis=1), 1e-300)[:, None]
    patch = np.where(faces.neighbor < 0, -1 - faces.neighbor, 0)
    curved = np.flatnonzero((faces.neighbor < 0) & surface.bent[patch])
    if not len(curved):
        return faces
    depth = np.zeros(len(faces))
    depth[curved] = _depths(surface, faces, curved, center, normal)
    moved = np.zeros(len(faces.points), bool)
    moved[take_rows(faces.starts, faces.corners, curved)[1]] = True
    around = np.flatnonzero(rows_with(faces.starts, moved[faces.corners]))
    starts, corners = take_rows(faces.starts, faces.corners, around)
    face = np.repeat(around, np.diff(starts))[moved[corners]]
    vertex = (np.cumsum(moved) - 1)[corners[moved[corners]]]
    # One plane for each patch at a vertex, and one for each inner face; polygons count by their areas.
    key = vertex * (len(surface.bent) + len(faces)) + np.where(
        faces.neighbor[face] < 0, patch[face], len(surface.bent) + face
    )
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    total = np.maximum(np.bincount(place, faces.area[face]), 1e-300)
    planes = np.stack([np.bincount(place, vector[face, k]) for k in range(3)], axis=1)
    planes /= np.maximum(np.linalg.norm(planes, axis=1), 1e-300)[:, None]
    wanted = np.bincount(place, faces.area[face] * depth[face]) / total
    vertex, weight = vertex[first], np.where(faces.neighbor[face[first]] < 0, 1.0, _INNER)
    n = np.count_nonzero(moved)
    matrix, right, most = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n)
    np.add.at(matrix, vertex, (weight[:, None] * planes)[:, :, None] * planes[:, None, :])
    np.add.at(right, vertex, wanted[:, None] * planes)
    np.maximum.at(most, vertex, np.abs(wanted))
    way = np.einsum("vij,vj->vi", np.linalg.pinv(matrix, rcond=1e-4, hermitian=True), right)
    way *= np.minimum(1, _LONGEST * most / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
    points = faces.points.copy()
    points[moved] += way
    return replace(faces, points=points)


def unbalanced(faces: Faces, chords: np.ndarray, cells: np.ndarray) -> tuple[Faces, np.ndarray]:
    """Return `faces` with the vertices of `cells` (k,) int where they were before `balanced`, at `chords` (v, 3).

    Return also which cells have such a vertex, (n,) bool.
    """
    back = np.zeros(len(faces.points), bool)
    rows = np.flatnonzero(np.isin(faces.owner, cells) | np.isin(faces.neighbor, cells))
    back[take_rows(faces.starts, faces.corners, rows)[1]] = True
    points = np.where(back[:, None], chords, faces.points)
    return replace(faces, points=points), cells_of(faces, rows_with(faces.starts, back[faces.corners]))


def _depths(
    surface: WallSurface, faces: Faces, walls: np.ndarray, center: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Return the mean depth of the polygons `walls` (k,) below the surface, along their normals, (k,) float.

    Means are those of the middles of the sides of the triangles around the center: exact if the depth is a quadratic.
    """
    starts, corners = take_rows(faces.starts, faces.corners, walls)
    row = np.repeat(np.arange(len(walls)), np.diff(starts))
    a, b, c = faces.points[corners], faces.points[corners[following(starts)]], center[walls][row]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    outer, inner = (((surface.feet(x) - x) * normal[walls][row]).sum(axis=1) for x in ((a + b) / 2, (a + c) / 2))
    depth = (outer + inner + inner[following(starts)]) / 3
    total = np.maximum(np.bincount(row, area), 1e-300)
    most = _DEEPEST * np.sqrt(faces.area[walls])
    return np.clip(np.bincount(row, area * depth) / total, -most, most)
