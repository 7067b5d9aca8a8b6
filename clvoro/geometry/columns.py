"""Winding numbers of closed surfaces by rays along one axis, with the triangles in columns."""

from __future__ import annotations

import numpy as np

_BLOCK = 1 << 20  # pairs of a point and a triangle per batch
_MOST = 1 << 20  # columns at most


class Columns:
    """The triangles of a closed surface in columns along one axis.

    A ray from a point along the axis counts the triangles that it crosses, +1 where it leaves the inside and -1 where
    it enters. Along an edge that two triangles share both decide by the same numbers, so that a ray crosses exactly one
    of them, whatever the round-off.

    Parameters
    ----------
    corners : (t, 3, 3) float
    """

    def __init__(self, corners: np.ndarray):
        self.low, self.high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        # The axis along which the triangles reach into the fewest columns.
        grids = [self._bins(corners, axis) for axis in range(3)]
        self.axis = int(np.argmin([grid[3] for grid in grids]))
        self.across = np.delete(np.arange(3), self.axis)
        self.shape, self.step, (first, count), _ = grids[self.axis]
        # A triangle that is seen from the side as a segment is crossed by no ray.
        flat = corners[:, :, self.across]
        seen = (flat != np.roll(flat, -1, axis=1)).any(axis=2).all(axis=1)
        # Axes in the order (across, axis) are turned like (x, y, z), or not.
        self.turn = -1 if self.axis == 1 else 1
        self.corners = corners
        each = np.where(seen, count.prod(axis=1), 0)
        item = np.repeat(np.arange(len(corners)), each)
        place = np.arange(len(item)) - np.repeat(np.cumsum(each) - each, each)
        row, column = np.divmod(place, count[item, 1])
        key = (first[item, 0] + row) * self.shape[1] + first[item, 1] + column
        order = np.argsort(key, kind="stable")
        self.items = item[order]
        self.starts = np.searchsorted(key[order], np.arange(self.shape.prod() + 1))

    def _bins(self, corners: np.ndarray, axis: int):
        """Return a grid across `axis`: shape, steps, first columns and counts (t, 2) of the triangles, all entries."""
        across = np.delete(np.arange(3), axis)
        extent = np.maximum((self.high - self.low)[across], 1e-300)
        wanted = min(max(len(corners), 1), _MOST)
        shape = np.clip(np.sqrt(wanted * extent / extent[::-1]), 1, wanted).astype(int)
        step = extent / shape
        flat = corners[:, :, across]
        first = self._column(flat.min(axis=1), across, step, shape)
        count = self._column(flat.max(axis=1), across, step, shape) - first + 1
        return shape, step, (first, count), int(count.prod(axis=1).sum())

    def _column(self, flat: np.ndarray, across: np.ndarray, step: np.ndarray, shape: np.ndarray) -> np.ndarray:
        return np.clip(np.floor((flat - self.low[across]) / step), 0, shape - 1).astype(np.int64)

    def winding(self, points: np.ndarray) -> np.ndarray:
        """Return how often the surface winds around each of `points` (n, 3), (n,) int: 1 inside, 0 outside.

        Normals point outwards. On the surface either of its sides may count.
        """
        wound = np.zeros(len(points), np.int64)
        who = np.flatnonzero(((points >= self.low) & (points <= self.high)).all(axis=1))
        place = self._column(points[who][:, self.across], self.across, self.step, self.shape)
        column = place[:, 0] * self.shape[1] + place[:, 1]
        count = self.starts[column + 1] - self.starts[column]
        ends = np.cumsum(count)
        for begin, end in _batches(ends):
            mine, n = who[begin:end], count[begin:end]
            point = np.repeat(mine, n)
            place = np.arange(len(point)) - np.repeat(np.cumsum(n) - n, n)
            item = self.items[np.repeat(self.starts[column[begin:end]], n) + place]
            wound += np.bincount(point, self._crossed(points[point], item), len(points)).astype(np.int64)
        return self.turn * wound

    def _crossed(self, x: np.ndarray, item: np.ndarray) -> np.ndarray:
        """Return how a ray from each point x (m, 3) crosses its triangle: 1, -1 or 0."""
        u, v = self.across
        above = self.corners[item, :, self.axis].max(axis=1) > x[:, self.axis]
        wound = np.zeros(len(x), np.int64)
        rows = np.flatnonzero(above)
        x, item = x[rows], item[rows]
        corner = self.corners[item]
        sides = np.zeros((len(x), 3))  # twice the areas of the point and each side
        turn = np.zeros(len(x), np.int64)
        for k in range(3):
            p, q = corner[:, k], corner[:, (k + 1) % 3]
            up = p[:, v] < q[:, v]
            swap = up | ((p[:, v] == q[:, v]) & (p[:, u] < q[:, u]))
            lo, hi = np.where(swap[:, None], p, q), np.where(swap[:, None], q, p)
            side = (hi[:, u] - lo[:, u]) * (x[:, v] - lo[:, v]) - (hi[:, v] - lo[:, v]) * (x[:, u] - lo[:, u])
            sides[:, k] = np.where(swap, side, -side)
            meets = (p[:, v] > x[:, v]) != (q[:, v] > x[:, v])
            turn += np.where(meets & (side > 0), np.where(up, 1, -1), 0)
        weight = np.maximum(sides * np.where(turn < 0, -1, 1)[:, None], 0)
        total = weight.sum(axis=1)
        weight = np.where(total[:, None] > 0, weight / np.where(total > 0, total, 1)[:, None], 1 / 3)
        height = (weight * corner[:, [2, 0, 1], self.axis]).sum(axis=1)
        wound[rows] = np.where(height > x[:, self.axis], turn, 0)
        return wound


def _batches(ends: np.ndarray):
    """Yield ranges of points whose counts, with the cumulated sums `ends`, fit into a batch."""
    begin = 0
    while begin < len(ends):
        done = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, done + _BLOCK, side="right")))
        yield begin, end
        begin = end
