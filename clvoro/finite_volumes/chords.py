"""Chords of a part of a boundary in 2D: which points they keep, and what they cost.

The cost is the area between the boundary and the chords, and prices for their distance from it, for sharp corners that
they cut off, and for slivers. All prices are in squares of the size of the cell.
"""

from __future__ import annotations

from itertools import pairwise
from math import atan2, hypot, inf, sqrt

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


def _offset(a: Point, b: Point, c: Point) -> tuple[float, float]:
    """Return the distance of b from the straight line between a and c, and twice the area of the triangle.

    The area is negative where the way from a over b to c turns to the right.
    """
    (p, q), (u, v), (x, y) = a, b, c
    x, y, u, v = x - p, y - q, u - p, v - q
    square, along, left = x * x + y * y, x * u + y * v, u * y - v * x
    if 0 < along < square:
        return abs(left) / sqrt(square), left
    return (hypot(u, v) if along <= 0 else hypot(u - x, v - y)), left


def chord_points(line: list[Point], fixed: list[bool], size: float) -> list[int]:
    """Return the indices of the points of a line between which chords run, the first and the last included.

    A stretch that turns by at most 30 degrees in sum becomes straight. Then kinks near the chord are dropped.
    `fixed` says of each inner point whether it remains in any case.
    """
    last = len(line) - 1
    kept, turned = [0], 0.0
    (p, q), (s, t) = line[:2]
    x, y = s - p, t - q
    for i in range(1, last):
        p, q = line[i + 1]
        u, v = p - s, q - t
        turned += atan2(x * v - y * u, x * u + y * v)
        if fixed[i - 1] or turned > SIDE_TURN or turned < -SIDE_TURN:
            kept.append(i)
            turned = 0.0
        x, y, s, t = u, v, p, q
    kept.append(last)
    if len(kept) == 2:
        return kept
    filled, cut = _FILLED * size, _CUT * size

    def offset(k: int) -> float:
        """Return the distance of a kink from the chord, or infinity if it stays."""
        at = kept[k]
        if fixed[at - 1]:
            return inf
        far, left = _offset(line[kept[k - 1]], line[at], line[kept[k + 1]])
        return inf if far >= (filled if left < 0 else cut) else far

    offsets = [inf, *map(offset, range(1, len(kept) - 1)), inf]
    while (least := min(offsets)) < inf:
        k = offsets.index(least)
        del kept[k], offsets[k]
        if k > 1:
            offsets[k - 1] = offset(k - 1)
        if k < len(kept) - 1:
            offsets[k] = offset(k)
    if len(kept) > 2:
        _drop_for_area(line, fixed, kept, filled)
    return kept


def _drop_for_area(line: list[Point], fixed: list[bool], kept: list[int], limit: float) -> None:
    """Drop kinks nearer than `limit` without which the area is nearer to the exact one, as on rough walls."""
    lost = _area(line) - _area([line[i] for i in kept])
    while True:
        best, where, saved = abs(lost), -1, 0.0
        for k in range(1, len(kept) - 1):
            far, left = _offset(line[kept[k - 1]], line[kept[k]], line[kept[k + 1]])
            area = left / 2
            if abs(lost + area) < best and far <= limit and not fixed[kept[k] - 1]:
                best, where, saved = abs(lost + area), k, area
        if where < 0:
            return
        lost += saved
        del kept[where]


def _area(line: list[Point]) -> float:
    """Return the area to the left of a line and to the right of its chord."""
    (x, y), area = line[0], 0.0
    p = q = 0.0
    for s, t in line[1:]:
        s, t = s - x, t - y
        area += p * t - q * s
        p, q = s, t
    return area / 2


def chord_cost(line: list[Point], kept: list[int], size: float) -> float:
    """Return the cost of a run with the points `kept`, apart from corners that are not convex."""
    total = 0.0
    for first, last in pairwise(kept):
        total += abs(_area(line[first : last + 1]))
        a, c = line[first], line[last]
        off, farthest = 0.0, a
        for b in line[first + 1 : last]:
            far, _ = _offset(a, b, c)
            if far > off:
                off, farthest = far, b
        total += _OFF_PRICE * off * size
        if off > 0 and _turn(a, farthest, c) < -_SHARP:
            total += _SHARP_PRICE * size * size
        if hypot(c[0] - a[0], c[1] - a[1]) < _SLIVER * size:
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
