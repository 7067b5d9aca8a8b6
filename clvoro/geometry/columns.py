"""Winding numbers of closed surfaces by rays along one axis, with the triangles in columns."""

from __future__ import annotations

import numpy as np

from ..connectivity import rows_and_places

_BLOCK = 1 << 15  # pairs of a point and a triangle per batch
_MOST = 1 << 20  # columns at most


class Columns:
    """The triangles of a closed surface in columns along one axis.

    A ray from a point along the axis counts the triangles that it crosses, +1 where it leaves the inside and -1 where
    it enters. Along an edge that two triangles share both decide by the same numbers, so that a ray crosses exactly one
    of them, whatever the round-off.

    - `corners`: (t, 3, 3) float
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
        low, high = flat.min(axis=1), flat.max(axis=1)
        self._bounds = low[:, 0], high[:, 0], low[:, 1], high[:, 1], corners[:, :, self.axis].max(axis=1)
        self._sides = [self._side(flat[:, k], flat[:, (k + 1) % 3]) for k in range(3)]
        each = np.where(seen, count.prod(axis=1), 0)
        item, place = rows_and_places(each)
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

    @staticmethod
    def _side(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return sides from p to q (t, 2) upwards, as both of their triangles take them.

        Two coordinates of the lower end, the vector (two arrays), the height of the upper end, and 1 or -1 for sides
        that are reversed.
        """
        upwards = (p[:, 1] < q[:, 1]) | ((p[:, 1] == q[:, 1]) & (p[:, 0] < q[:, 0]))
        begin, end = np.where(upwards[:, None], p, q), np.where(upwards[:, None], q, p)
        along = end - begin
        return *begin.T.copy(), *along.T.copy(), end[:, 1].copy(), np.where(upwards, 1.0, -1.0)

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
            local, place = rows_and_places(n)
            item = self.items[np.repeat(self.starts[column[begin:end]], n) + place]
            crossed = self._crossed(points[mine[local]], item)
            wound[mine] += np.bincount(local, crossed, end - begin).astype(np.int64)
        return self.turn * wound

    def _crossed(self, x: np.ndarray, item: np.ndarray) -> np.ndarray:
        """Return how a ray from each point x (m, 3) crosses its triangle: 1, -1 or 0."""
        u, v, w = (np.ascontiguousarray(x[:, a]) for a in (*self.across, self.axis))
        low_u, high_u, low_v, high_v, high_w = self._bounds
        near = (low_u[item] <= u) & (u <= high_u[item]) & (low_v[item] <= v) & (v <= high_v[item]) & (high_w[item] > w)
        rows = np.flatnonzero(near)
        u, v, w, item = u[rows], v[rows], w[rows], item[rows]
        areas = np.zeros((3, len(item)))  # twice the areas of the point and each side
        turn = np.zeros(len(item), np.int64)
        for k in range(3):
            begin_u, begin_v, along_u, along_v, end_v, up = (part[item] for part in self._sides[k])
            area = along_u * (v - begin_v) - along_v * (u - begin_u)
            areas[k] = up * area
            turn += np.where((begin_v <= v) & (v < end_v) & (area > 0), up, 0).astype(np.int64)
        weight = np.maximum(areas * np.where(turn < 0, -1, 1), 0)
        total = weight.sum(axis=0)
        weight = np.where(total > 0, weight / np.where(total > 0, total, 1), 1 / 3)
        heights = self.corners[item, :, self.axis]
        height = weight[0] * heights[:, 2] + weight[1] * heights[:, 0] + weight[2] * heights[:, 1]
        wound = np.zeros(len(x), np.int64)
        wound[rows] = np.where(height > w, turn, 0)
        return wound


def _batches(ends: np.ndarray):
    """Yield ranges of points whose counts, with the cumulated sums `ends`, fit into a batch."""
    begin = 0
    while begin < len(ends):
        done = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, done + _BLOCK, side="right")))
        yield begin, end
        begin = end
