"""Chords of a part of a boundary in 2D: which points they keep, and what they cost.

The cost is the area between the boundary and the chords, and prices for their distance from it, for sharp corners that
they cut off, and for slivers. All prices are in squares of the size of the cell.
"""

from __future__ import annotations

from itertools import pairwise
from math import atan2, hypot, inf

import numpy as np

from ..mesh.straightening import SIDE_TURN

_FILLED = 0.25
"""A kink into the cell is cut off if it is nearer than this to the chord, over the size of the cell."""
_CUT = 0.03
"""The same for a kink out of the cell."""
_SLIVER = 0.1
"""Wall faces shorter than this over the size of the cell are slivers."""
_SHARP, _CONVEX = np.pi / 3, 1e-4
"""Turn into the cell beyond which a chord cuts off a sharp corner; least turn in a corner of a convex cell."""
_CONCAVE_PRICE, _SHARP_PRICE, _OFF_PRICE, _SLIVER_PRICE = 0.5, 0.1, 0.2, 0.02
"""Concave corners cost by their angle in radians, chords by their distance from the boundary over the size."""

Point = tuple[float, float]


def _turn(a: Point, b: Point, c: Point) -> float:
    """Return the angle by which the way from a over b to c turns to the left."""
    x, y, u, v = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    return atan2(x * v - y * u, x * u + y * v)


def _offset(a: Point, b: Point, c: Point) -> float:
    """Return the distance of b from the straight line between a and c."""
    x, y, u, v = c[0] - a[0], c[1] - a[1], b[0] - a[0], b[1] - a[1]
    square = x * x + y * y
    t = min(max((x * u + y * v) / square, 0.0), 1.0) if square > 0 else 0.0
    return hypot(u - t * x, v - t * y)


def chord_points(line: list[Point], fixed: list[bool], size: float) -> list[int]:
    """Return the indices of the points of a line between which chords run, the first and the last included.

    A stretch that turns by at most 30 degrees in sum becomes straight. Then kinks near the chord are dropped.
    `fixed` says of each inner point whether it remains in any case.
    """
    last = len(line) - 1
    kept, turned = [0], 0.0
    for i in range(1, last):
        turned += _turn(line[i - 1], line[i], line[i + 1])
        if fixed[i - 1] or abs(turned) > SIDE_TURN:
            kept.append(i)
            turned = 0.0
    kept.append(last)
    if len(kept) == 2:
        return kept

    def offset(k: int) -> float:
        """Return the distance of a kink from the chord, or infinity if it stays."""
        a, b, c = line[kept[k - 1]], line[kept[k]], line[kept[k + 1]]
        far = _offset(a, b, c)
        limit = _FILLED if _turn(a, b, c) < 0 else _CUT
        return inf if fixed[kept[k] - 1] or far >= limit * size else far

    offsets = [inf, *map(offset, range(1, len(kept) - 1)), inf]
    while (least := min(offsets)) < inf:
        k = offsets.index(least)
        del kept[k], offsets[k]
        for j in (k - 1, k):
            if 0 < j < len(kept) - 1:
                offsets[j] = offset(j)
    _drop_for_area(line, fixed, kept, _FILLED * size)
    return kept


def _drop_for_area(line: list[Point], fixed: list[bool], kept: list[int], limit: float) -> None:
    """Drop kinks nearer than `limit` without which the area is nearer to the exact one, as on rough walls."""
    if len(kept) == 2:
        return
    lost = _area(line) - _area([line[i] for i in kept])
    while True:
        best, where, saved = abs(lost), -1, 0.0
        for k in range(1, len(kept) - 1):
            three = [line[i] for i in kept[k - 1 : k + 2]]
            area = _area(three)
            if fixed[kept[k] - 1] or _offset(*three) > limit:
                continue
            if abs(lost + area) < best:
                best, where, saved = abs(lost + area), k, area
        if where < 0:
            return
        lost += saved
        del kept[where]


def _area(line: list[Point]) -> float:
    """Return the area to the left of a line and to the right of its chord."""
    (x, y), area = line[0], 0.0
    for (u, v), (s, t) in pairwise(line[1:]):
        area += (u - x) * (t - y) - (v - y) * (s - x)
    return area / 2


def chord_cost(line: list[Point], kept: list[int], size: float) -> float:
    """Return the cost of a run with the points `kept`, apart from corners that are not convex."""
    total = 0.0
    for first, last in pairwise(kept):
        total += abs(_area(line[first : last + 1]))
        off, farthest = 0.0, first
        for i in range(first + 1, last):
            here = _offset(line[first], line[i], line[last])
            if here > off:
                off, farthest = here, i
        total += _OFF_PRICE * off * size
        if farthest > first and _turn(line[first], line[farthest], line[last]) < -_SHARP:
            total += _SHARP_PRICE * size * size
        (x, y), (u, v) = line[first], line[last]
        if hypot(u - x, v - y) < _SLIVER * size:
            total += _SLIVER_PRICE * size * size
    return total


def skewness(a: Point, b: Point, centroid: Point) -> float:
    """Return OpenFOAM's skewness of a wall face from a to b."""
    x, y = b[0] - a[0], b[1] - a[1]
    length = hypot(x, y)
    u, v = (a[0] + b[0]) / 2 - centroid[0], (a[1] + b[1]) / 2 - centroid[1]
    if length == 0:
        return 0.0
    off, height = abs(x * u + y * v) / length, abs(x * v - y * u) / length
    return off / max(length / 2, 0.4 * height)


def concave_price(line: list[Point]) -> float:
    """Return the price for corners on a line, without its ends, that are not convex."""
    price = 0.0
    for k in range(1, len(line) - 1):
        turn = _turn(*line[k - 1 : k + 2])
        if turn < _CONVEX:
            price += _CONCAVE_PRICE * (0.1 + min(-turn, 1.0))
    return price
