"""A hierarchy of bounding boxes over segments or triangles, for nearest items and overlapping pairs."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..connectivity import rows_of

_LEAF = 4  # items per leaf at most
_BLOCK = 1 << 9  # points per batch: its pairs with boxes and items stay in the caches


def curve_order(x: np.ndarray) -> np.ndarray:
    """Return the order (n,) of points (n, d) along Morton's curve through their ranks by each coordinate.

    Ranks are even, so that clusters of any size are as well ordered as the rest.
    """
    n, d = x.shape
    place = np.zeros(n, np.int64)
    for axis in range(d):
        rank = np.empty(n, np.int64)
        rank[np.argsort(np.ascontiguousarray(x[:, axis]))] = np.arange(n)
        for bit in range(n.bit_length()):
            place |= (rank >> bit & 1) << d * bit + axis
    return np.argsort(place)


class Tree:
    """Complete binary tree of bounding boxes over n items.

    Node k has the children 2 k + 1 and 2 k + 2. Node j of a level with m nodes holds the items
    ``order[j n // m : (j + 1) n // m]``. Each node halves its items across the longest side of the
    box of their centers. The tree depends on the items only.

    - `low`, `high` (n, d) float: lower and upper corners of the items' bounding boxes.
    - `order` (n,) int: another order of the items, in which near ones follow each other, such as `curve_order`.
    - `leaf`: items of a leaf at most.

    Its attributes:
    - `levels`: number of levels below the root; there are 2^levels leaves.
    - `order` (n,) int: the items in the order of the leaves.
    - `boxes` (2^(levels + 1) - 1, 2 d) float: lower and upper corners of the nodes.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, order: np.ndarray | None = None, leaf: int = _LEAF):
        self.n, self.leaf = len(low), leaf
        self.levels = max(0, math.ceil(math.log2(self.n / leaf)))
        self.order = self._sort(0.5 * low.astype(float) + 0.5 * high) if order is None else order
        starts = self.starts(self.levels)[:-1]
        low, high = np.minimum.reduceat(low[self.order], starts), np.maximum.reduceat(high[self.order], starts)
        levels = [np.hstack([low, high])]
        for _ in range(self.levels):
            low, high = np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])
            levels.append(np.hstack([low, high]))
        self.boxes = np.concatenate(levels[::-1])

    def starts(self, level: int) -> np.ndarray:
        """Return the place in `order` where the items of each node of a level begin, and the end: (2^level + 1,)."""
        return (np.arange((1 << level) + 1, dtype=np.int64) * self.n) >> level

    def _sort(self, center: np.ndarray) -> np.ndarray:
        order = np.arange(self.n)
        for level in range(self.levels):
            starts = self.starts(level)
            inside = center[order]
            low = np.minimum.reduceat(inside, starts[:-1])
            extent = np.maximum.reduceat(inside, starts[:-1]) - low
            axis = extent.argmax(axis=1)
            node = rows_of(starts)
            longest = extent[np.arange(len(axis)), axis]
            # One key for the node and the place in it. Items at equal places may go to either child.
            place = inside[np.arange(self.n), axis[node]] - low[node, axis[node]]
            place /= np.where(longest > 0, longest, 1)[node]
            order = order[np.argsort(node + 0.5 * place, kind="stable")]
        return order

    def nearest2(
        self,
        points: np.ndarray,
        bound2: np.ndarray,
        distance2: Callable[[np.ndarray, np.ndarray], np.ndarray],
        in_boxes: bool = True,
    ) -> np.ndarray:
        """Return the smallest squared distance of each of `points` (n, d) to the items, but at most `bound2`, (n,).

        See `nearest`.
        """
        return self.nearest(points, bound2, distance2, in_boxes)[0]

    def nearest(
        self,
        points: np.ndarray,
        bound2: np.ndarray,
        distance2: Callable[[np.ndarray, np.ndarray], np.ndarray],
        in_boxes: bool = True,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the squared distance of each of `points` to the nearest item, at most `bound2`, and that item.

        - `points`: (n, d) float
        - `bound2` (n,) float: items beyond this squared distance are skipped; a tighter bound is faster.
        - `distance2`: returns the squared distances of points (m, d) to items (m,), given by index.
        - `in_boxes`: whether distances are those to places in the items' boxes. They may also be larger.

        The result is (n,) float, (n,) int: of items at the same distance the first one counts; -1 where no item is
        within the bound.
        """
        best2, best = bound2.copy(), np.full(len(points), -1)
        d = points.shape[1]
        for first in range(0, len(points), _BLOCK):
            who = np.arange(first, min(first + _BLOCK, len(points)))
            reach2 = best2.copy()
            node = np.zeros(len(who), np.int64)
            for level in range(self.levels + 1):
                box = self.boxes[node + (1 << level) - 1]
                low, high = box[:, :d] - points[who], points[who] - box[:, d:]
                away2 = (np.maximum(np.maximum(low, high), 0) ** 2).sum(axis=1)
                if in_boxes:  # each box holds an item, which is no farther than the farthest corner
                    farthest2 = (np.minimum(low, high) ** 2).sum(axis=1) * (1 + 1e-12)
                    np.minimum.at(reach2, who, farthest2)
                who, node = self._below(level, who, node, away2 <= reach2[who])
            who, item = self._items(who, node)
            found = distance2(points[who], item)
            order = np.lexsort((item, found, who))
            order = order[np.diff(who[order], prepend=-1) > 0]
            order = order[found[order] <= best2[who[order]]]
            best2[who[order]], best[who[order]] = found[order], item[order]
        return best2, best

    def _below(self, level: int, who: np.ndarray, node: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the `kept` pairs of a query and a node of a level, with the node's children unless it is a leaf."""
        who, node = who[kept], node[kept]
        if level < self.levels:
            who, node = np.repeat(who, 2), np.repeat(2 * node, 2)
            node[1::2] += 1
        return who, node

    def _items(self, who: np.ndarray, leaf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of a query and each item of its leaf."""
        starts = self.starts(self.levels)
        place = starts[leaf][:, None] + np.arange(self.leaf)
        inside = place < starts[leaf + 1][:, None]
        return np.repeat(who, inside.sum(axis=1)), self.order[place[inside]]

    def meeting(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all pairs of a box with the corners `low`, `high` (n, d) and an item whose leaf it meets.

        The pairs are sorted by box and item.
        """
        d = low.shape[1]
        who, node = np.arange(len(low)), np.zeros(len(low), np.int64)
        for level in range(self.levels + 1):
            box = self.boxes[node + (1 << level) - 1]
            meet = np.asarray(((box[:, :d] <= high[who]) & (low[who] <= box[:, d:])).all(axis=1))
            who, node = self._below(level, who, node, meet)
        who, item = self._items(who, node)
        order = np.lexsort((item, who))
        return who[order], item[order]

    def within(self, points: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of one of `points` (n, d) and an item whose leaf is not farther from it than `reach` (n,)."""
        d, block = points.shape[1], 32 * _BLOCK  # only boxes are compared here: larger batches are faster
        found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
        for first in range(0, len(points), block):
            who = np.arange(first, min(first + block, len(points)))
            node = np.zeros(len(who), np.int64)
            for level in range(self.levels + 1):
                box, x = self.boxes[node + (1 << level) - 1], points[who]
                away = np.maximum(np.maximum(box[:, :d] - x, x - box[:, d:]), 0)
                near = (away**2).sum(axis=1) <= reach[who] ** 2
                who, node = self._below(level, who, node, near)
            found.append(self._items(who, node))
        who, item = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return who, item

    def overlaps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all pairs of items i < j whose leaves are the same or have overlapping boxes, two arrays (m,) int.

        Boxes that touch overlap.
        """
        d = self.boxes.shape[1] // 2
        i = j = np.zeros(1, np.int64)
        for level in range(self.levels):
            (i, j), (more_i, more_j) = (2 * i, 2 * j), (2 * i, 2 * j + 1)
            distinct = i != j
            i, j = (
                np.concatenate([i, i + 1, more_i, (more_i + 1)[distinct]]),
                np.concatenate([j, j + 1, more_j, (more_j - 1)[distinct]]),
            )
            first = (1 << (level + 1)) - 1
            a, b = self.boxes[first + i], self.boxes[first + j]
            meet = ((a[:, :d] <= b[:, d:]) & (b[:, :d] <= a[:, d:])).all(axis=1)
            i, j = i[meet], j[meet]
        starts = self.starts(self.levels)
        found = []
        for slot in range(self.leaf):
            for other in range(self.leaf):
                p, q = starts[i] + slot, starts[j] + other
                inside = (p < starts[i + 1]) & (q < starts[j + 1]) & ((i != j) | (p < q))
                found.append(np.stack([self.order[p[inside]], self.order[q[inside]]]))
        pairs = np.sort(np.concatenate(found, axis=1), axis=0)
        return pairs[0], pairs[1]
