"""The nearest points of a triangulated surface."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from .bvh import Tree
from .surface import Surface
from .triangles import areas_of, packed_weights

_ON = 1e-12  # of the extent: triangles this much farther count as equally near
_SAMPLES = 2048  # places on the surface from which the search for nearest points begins, besides vertices
_MOST_STEPS = 64  # along a side of a triangle


@dataclass(frozen=True)
class Feet:
    """The nearest points of a surface."""

    triangle: np.ndarray
    """(n,) int. -1 where nothing is near."""
    weights: np.ndarray
    """(n, 3) float. Weights of the triangle's corners in the foot; 0 to round-off for the corner opposite to a side
    that it lies on."""
    point: np.ndarray
    """(n, 3) float."""
    distance: np.ndarray
    """(n,) float. inf where nothing is near."""


class NearestTriangles:
    """Some triangles of a surface, to find the nearest points on them.

    - `items` (m,) int: the triangles.
    """

    def __init__(self, surface: Surface, items: np.ndarray):
        self.items = items
        self.corners, self._rows = surface.corners[items], surface.rows[items]
        self._tree = Tree(self.corners.min(axis=1), self.corners.max(axis=1))
        points, self._sampled = _samples(surface.triangles[items], self.corners)
        self._samples = scipy.spatial.KDTree(points)
        self._tie = _ON * float(np.ptp(surface.vertices, axis=0).max())

    def feet(self, x: np.ndarray, reach: float) -> Feet:
        """Return the nearest point of the triangles to each of the points x (n, 3), within `reach`."""
        bound2 = np.full(len(x), reach * reach)
        close = np.flatnonzero(np.isfinite(x).all(axis=1))
        if reach > self._tie:
            away, sample = self._samples.query(x[close], distance_upper_bound=reach)
            close, sample = close[np.isfinite(away)], sample[np.isfinite(away)]
            there2 = packed_weights(x[close], self._rows[self._sampled[sample]])[2]
            bound2[close] = np.minimum(bound2[close], (np.sqrt(there2) + self._tie) ** 2)
        _, item = self._tree.nearest(x, bound2, lambda y, k: packed_weights(y, self._rows[k])[2])
        return self.feet_on(x, item)

    def feet_on(self, x: np.ndarray, item: np.ndarray) -> Feet:
        """Return the points of triangles `item` (n,) nearest to the points x (n, 3); nothing for the item -1."""
        found = item >= 0
        weights, away2 = np.zeros((len(x), 3)), np.full(len(x), math.inf)
        s, t, away2[found] = packed_weights(x[found], self._rows[item[found]])
        weights[found] = np.column_stack([1 - s - t, s, t])
        point = np.einsum("nk,nkd->nd", weights, self.corners[item])
        return Feet(np.where(found, self.items[item], -1), weights, point, np.sqrt(away2))


def _samples(triangles: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (k, 3) on a surface, and their triangles (k,): the vertices, and a grid in each large triangle.

    - `triangles`: (t, 3) int
    - `corners`: (t, 3, 3) float
    """
    _, first = np.unique(triangles, return_index=True)
    points, item = [corners.reshape(-1, 3)[first]], [first // 3]
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    spacing = math.sqrt(float(areas_of(corners).sum()) / _SAMPLES)
    steps = np.minimum(np.ceil(longest / spacing), _MOST_STEPS).astype(int) if spacing > 0 else np.ones(len(corners))
    for k in np.unique(steps[steps > 1]).tolist():
        rows = np.flatnonzero(steps == k)
        i, j = np.nonzero(np.add.outer(np.arange(k + 1), np.arange(k + 1)) <= k)
        weights = np.column_stack([k - i - j, i, j]) / k
        points.append(np.einsum("sk,tkd->tsd", weights, corners[rows]).reshape(-1, 3))
        item.append(np.repeat(rows, len(weights)))
    return np.concatenate(points), np.concatenate(item)


def heights_over(
    feet: Callable[[np.ndarray], Feet], normals: np.ndarray, corners: np.ndarray, starts: np.ndarray
) -> np.ndarray:
    """Return how high a surface is curved over polygons, (f,) float.

    - `feet`: returns the nearest points of the surface.
    - `normals` (t, 3) float: of its triangles.
    - `corners` (c, 3) float, `starts` (f + 1,) int: those of each polygon.
    """
    foot, counts = feet(corners).point, np.diff(starts)
    middle = feet(np.add.reduceat(foot, starts[:-1]) / counts[:, None])
    away = foot - np.repeat(middle.point, counts, axis=0)
    height = np.abs((away * np.repeat(normals[middle.triangle], counts, axis=0)).sum(axis=1))
    return np.maximum.reduceat(height, starts[:-1])
