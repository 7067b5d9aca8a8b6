"""Move the vertices of curved surfaces so that each polygon on them cuts off as much of a cell as it adds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from ...connectivity import following, rows_of, rows_with, take_rows
from ...mesh.faces import Faces
from .mend import cells_of

Feet: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Returns the closest point of a surface to each of some points (k, 3)."""
_DEEPEST = 0.15
"""Largest depth of a polygon below the surface that is balanced, over the root of its area: where details are smaller
than polygons, depths do not follow from the curvature."""
_INNER = 0.01
"""A vertex stays in the planes of the faces between cells, and moves off its walls by their depths. Where it cannot do
both, the planes count this much, the depths 1. It never leaves flat patches."""
_LONGEST = 2.0
"""Farthest that a vertex moves, over the largest depth of the polygons around it."""


def balanced(faces: Faces, patch: np.ndarray, bent: np.ndarray, feet: Feet, turned: np.ndarray | None = None) -> Faces:
    """Return `faces` with vertices of curved surfaces moved by the mean depth of their polygons below the surface.

    Chords of a curved surface cut off a volume of second order. To keep it, the corners of a regular hexagon of area A
    on a sphere of curvature kappa get 7 / (36 sqrt(3)) A kappa, 0.11 A kappa, off the surface. Vertices stay in the
    planes of the faces between cells, along whose common edges they move, and in those of flat walls.

    - `patch` (f,) int: the smooth patch that a face lies on, -1 for those that are on none.
    - `bent` (p,) bool: which patches are curved and balanced.
    - `feet`: returns the closest points of the surface.
    - `turned` (f,) bool: faces whose normals point to the other side than those of others on the patch.
    """
    center, vector = faces.vectors
    curved = np.flatnonzero((patch >= 0) & bent[patch])
    if not len(curved):
        return faces
    if turned is not None:
        vector = np.where(turned[:, None], -vector, vector)
    normal = vector / np.maximum(np.linalg.norm(vector, axis=1), 1e-300)[:, None]
    depth = np.zeros(len(faces))
    depth[curved] = _depths(feet, faces, curved, center, normal)
    moved = np.zeros(len(faces.points), bool)
    moved[take_rows(faces.starts, faces.corners, curved)[1]] = True
    around = np.flatnonzero(rows_with(faces.starts, moved[faces.corners]))
    starts, corners = take_rows(faces.starts, faces.corners, around)
    face = np.repeat(around, np.diff(starts))[moved[corners]]
    vertex = (np.cumsum(moved) - 1)[corners[moved[corners]]]
    # One plane for each patch at a vertex, and one for each inner face; polygons count by their areas.
    key = vertex * (len(bent) + len(faces)) + np.where(patch[face] >= 0, patch[face], len(bent) + face)
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    total = np.maximum(np.bincount(place, faces.area[face]), 1e-300)
    planes = np.stack([np.bincount(place, vector[face, k]) for k in range(3)], axis=1)
    planes /= np.maximum(np.linalg.norm(planes, axis=1), 1e-300)[:, None]
    wanted = np.bincount(place, faces.area[face] * depth[face]) / total
    vertex, patch = vertex[first], patch[face[first]]
    n, held = np.count_nonzero(moved), (patch >= 0) & ~bent[patch]
    squares = planes[:, :, None] * planes[:, None, :]
    matrix, flat, right, most = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros(n)
    np.add.at(matrix, vertex, np.where(patch >= 0, 1.0, _INNER)[:, None, None] * squares)
    np.add.at(flat, vertex[held], squares[held])
    np.add.at(right, vertex, wanted[:, None] * planes)
    np.maximum.at(most, vertex, np.abs(wanted))
    along = np.eye(3) - np.linalg.pinv(flat, rcond=1e-4, hermitian=True) @ flat  # within the planes of flat patches
    inverse = np.linalg.pinv(along @ matrix @ along, rcond=1e-4, hermitian=True)
    way = np.einsum("vij,vj->vi", along @ inverse @ along, right)
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


def _depths(feet: Feet, faces: Faces, walls: np.ndarray, center: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the mean depth of the polygons `walls` (k,) below the surface, along their normals, (k,) float.

    Means are those of the middles of the sides of the triangles around the center: exact if the depth is a quadratic.
    """
    starts, corners = take_rows(faces.starts, faces.corners, walls)
    row = rows_of(starts)
    a, b, c = faces.points[corners], faces.points[corners[following(starts)]], center[walls][row]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    outer, inner = (((feet(x) - x) * normal[walls][row]).sum(axis=1) for x in ((a + b) / 2, (a + c) / 2))
    depth = (outer + inner + inner[following(starts)]) / 3
    total = np.maximum(np.bincount(row, area), 1e-300)
    most = _DEEPEST * np.sqrt(faces.area[walls])
    return np.clip(np.bincount(row, area * depth) / total, -most, most)
