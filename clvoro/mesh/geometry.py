"""Centers, areas and volumes of polyhedra by the formulas of OpenFOAM.

A face is divided into triangles about the mean of its corners, a cell into pyramids about the mean of the centers of
its faces. Flat faces of convex cells get their exact centroids.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..connectivity import following
from .read_only import Sealed
from .straightening import cross

if TYPE_CHECKING:
    from .faces import Faces

_TINY = 1e-150
"""OpenFOAM's ROOTVSMALL, which keeps quotients finite."""
_CHUNK = 1 << 11
"""Faces that are evaluated at a time: their arrays fit the caches."""


@dataclass(frozen=True, eq=False)
class Geometry(Sealed):
    """What follows from the points of polyhedra."""

    centers: np.ndarray
    """(f, 3) float64. Centers of the faces."""
    areas: np.ndarray
    """(f, 3) float64. Area vectors: normal to the face, out of its owner, as long as its area."""
    centroids: np.ndarray
    """(n, 3) float64."""
    volumes: np.ndarray
    """(n,) float64."""


def face_vectors(points: np.ndarray, starts: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centers and area vectors of faces, (f, d) each; in 2D of edges, to the right of the way along them."""
    if points.shape[1] == 3:
        return face_geometry(points, starts, corners)
    a, b = points[corners.reshape(-1, 2)].swapaxes(0, 1)
    return (a + b) / 2, np.stack([(b - a)[:, 1], -(b - a)[:, 0]], axis=1)


def face_geometry(points: np.ndarray, starts: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centers and area vectors of faces, (f, 3) each.

    - `points`: (v, 3) float
    - `starts` (f + 1,) int, corners : int: corners of each face, at least three.
    """
    f = len(starts) - 1
    centers, areas = np.empty((2, f, 3))
    for first in range(0, f, _CHUNK):
        end = min(first + _CHUNK, f)
        here = points.take(corners[starts[first] : starts[end]], axis=0).T
        made = loop_geometry(np.ascontiguousarray(here), starts[first : end + 1] - starts[first])
        centers[first:end], areas[first:end] = made[0].T, made[1].T
    return centers, areas


def loop_geometry(here: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centers and area vectors of faces whose corners are the columns of `here` (3, k): (3, f) each.

    Column by column NumPy takes a third of the time that it takes row by row.
    """
    counts, first, after = np.diff(starts), starts[:-1], following(starts)
    there = here.take(after, axis=1)
    means = np.add.reduceat(here, first, axis=1) / counts
    middle = np.repeat(means, counts, axis=1)
    normals = cross_columns(there - here, middle - here)
    weights = lengths(normals)
    total = np.add.reduceat(weights, first)
    # Relative to the mean, so that little is lost in cancellation.
    moments = np.add.reduceat(weights * (here + there - 2 * middle), first, axis=1)
    centers = means + moments / np.maximum(3 * total, _TINY)
    return centers, np.add.reduceat(normals, first, axis=1) / 2


def cell_geometry(
    centers: np.ndarray, areas: np.ndarray, owner: np.ndarray, neighbor: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids (n, 3) and volumes (n,) of cells.

    - `centers`, `areas`: (f, 3) float
    - `owner`: (f,) int
    - `neighbor` (k,) int: cells behind the first k faces; no other face has a cell behind it.
    """
    cell, k = np.concatenate([owner, neighbor]), len(neighbor)

    def sides(axis: int) -> tuple[np.ndarray, np.ndarray]:
        center, area = centers[:, axis], areas[:, axis]
        return np.concatenate([center, center[:k]]), np.concatenate([area, -area[:k]])

    found, volumes = pyramid_sums(sides, cell, cells)
    return np.ascontiguousarray(found.T), volumes


def pyramid_sums(
    sides: Callable[[int], tuple[np.ndarray, np.ndarray]], cell: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids (3, n) and volumes (n,) of cells from their faces.

    - `sides`: called with an axis. Returns that component of the centers of the faces, and of their outward areas, (k,)
      each. One axis at a time takes less memory.
    - `cell` (k,) int: the cell of each face.
    """
    counts = np.maximum(np.bincount(cell, minlength=cells), 1)
    means, moments = np.empty((2, 3, cells))
    thrice = np.zeros(len(cell))
    for a in range(3):
        center, area = sides(a)
        means[a] = np.bincount(cell, center, cells) / counts
        thrice += area * (center - means[a].take(cell))
    volumes = np.bincount(cell, thrice, cells)
    for a in range(3):
        moments[a] = np.bincount(cell, thrice * (sides(a)[0] - means[a].take(cell)), cells)
    safe = np.where(np.abs(volumes) > _TINY**2, volumes, np.inf)
    return means + 0.75 * moments / safe, volumes / 3


def polygon_sides(mesh: Faces) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the sides of all cells in 2D: their cells (s,), two ends relative to a corner of the cell, (s, 2) each.

    The last array is that corner for each cell, (n, 2). A cell lies on the left of the way from the first end to the
    second.
    """
    cell, (begin, end) = mesh.sides()[0], mesh.side_ends()
    base = np.zeros(mesh.n_cells, np.int64)
    base[cell] = begin
    origins = mesh.points.take(base, axis=0)
    near = origins.take(cell, axis=0)
    return (cell, mesh.points.take(begin, axis=0) - near, mesh.points.take(end, axis=0) - near, origins)


def polygon_areas(mesh: Faces) -> np.ndarray:
    """Return the area of each cell in 2D, (n,)."""
    cell, p, q, _ = polygon_sides(mesh)
    return np.bincount(cell, cross(p, q), mesh.n_cells) / 2


def turns(corners: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the angle by which polygons turn to the left in each corner, (k,), -pi to pi.

    - `corners`: (k, 2) float
    - `after` (k,) int: place of the next corner of the same polygon.
    """
    ahead = corners[after] - corners
    behind = np.empty_like(ahead)
    behind[after] = ahead
    return np.arctan2(cross(behind, ahead), (behind * ahead).sum(axis=1))


def cross_columns(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of the columns of `a` and `b`, (3, k) each."""
    found = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for row, (i, j) in zip(found, ((1, 2), (2, 0), (0, 1)), strict=True):
        np.multiply(a[i], b[j], out=row)
        row -= a[j] * b[i]
    return found


def dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of the columns of `a` and `b`, (d, k) each: (k,)."""
    return np.einsum("ij,ij->j", a, b)


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the length of each column of `vectors` (d, k), (k,)."""
    return np.sqrt(dots(vectors, vectors))


def sum_columns(places: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return for each place the sum of its `values` (d, k): (d, count)."""
    return np.stack([np.bincount(places, row, count) for row in values])


def sum_rows(places: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Return for each place the sum of its `values` (k, d): (count, d)."""
    return np.ascontiguousarray(sum_columns(places, values.T, count).T)


def smaller_size(owner: np.ndarray, neighbor: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the smaller of the `sizes` (n,) of both cells of each face, (f,)."""
    return np.minimum(sizes[owner], sizes[np.where(neighbor >= 0, neighbor, owner)])
