"""Where creases of a solid pass from one Voronoi cell into another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ...connectivity import rows_and_places
from .wall_surface import WallSurface, nearest

_ROUNDS = 60


@dataclass(frozen=True)
class Crossings:
    """Points in which creases cross faces between two cells, sorted by the cells."""

    cells: np.ndarray
    """(x, 2) int. The two cells, the lower one first."""
    points: np.ndarray
    """(x, 3) float."""
    edge: np.ndarray
    """(x,) int. Edge of the crease."""

    def take(self, rows: np.ndarray) -> Crossings:
        """Return some of the crossings."""
        return Crossings(self.cells[rows], self.points[rows], self.edge[rows])


def cross_cells(
    surface: WallSurface, generators: np.ndarray, tree: scipy.spatial.KDTree, sizes: np.ndarray
) -> Crossings:
    """Return where the creases cross the faces of the Voronoi diagram of `generators` (n, 3)."""
    ends = surface.ends
    if not len(ends):
        return Crossings(np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros(0, np.int64))
    # Pieces no longer than half of the nearest cell.
    h = sizes[nearest(tree, ends.mean(axis=1))[1]]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    pieces = np.maximum(1, np.ceil(2 * length / np.minimum(h, sizes.min() * 4))).astype(np.int64)
    edge, number = rows_and_places(pieces)
    low, high = number / pieces[edge], (number + 1) / pieces[edge]

    def at(e: np.ndarray, t: np.ndarray) -> np.ndarray:
        return ends[e, 0] + t[:, None] * (ends[e, 1] - ends[e, 0])

    i, j = nearest(tree, at(edge, low))[1], nearest(tree, at(edge, high))[1]
    found = [(np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros(0, np.int64))]
    for _ in range(_ROUNDS):
        apart = i != j
        edge, low, high, i, j = edge[apart], low[apart], high[apart], i[apart], j[apart]
        if not len(edge):
            break
        p, q = at(edge, low), at(edge, high)
        across = generators[j] - generators[i]
        height = ((p - (generators[i] + generators[j]) / 2) * across).sum(axis=1)
        slope = ((q - p) * across).sum(axis=1)
        share = np.clip(-height / np.where(slope == 0, 1, slope), 0, 1)
        t = low + share * (high - low)
        x = at(edge, t)
        far, k = nearest(tree, x)
        own = np.linalg.norm(x - generators[i], axis=1)
        done = (k == i) | (k == j) | (far >= own * (1 - 1e-12))
        found.append((np.stack([i[done], j[done]], axis=1), x[done], edge[done]))
        edge, low, high, i, j, t, k = (values[~done] for values in (edge, low, high, i, j, t, k))
        edge, low, high = np.concatenate([edge, edge]), np.concatenate([low, t]), np.concatenate([t, high])
        i, j = np.concatenate([i, k]), np.concatenate([k, j])
    cells, x, edge = (np.concatenate(values) for values in zip(*found, strict=True))
    cells = np.sort(cells, axis=1)
    order = np.lexsort((edge, cells[:, 1], cells[:, 0]))
    return Crossings(cells[order], x[order], edge[order])
