"""Chords of parts of a boundary in 2D: which points they keep, and what they cost.

The cost is the area between the boundary and the chords, and prices for their distance from it, for sharp corners that
they cut off, and for slivers. All prices are in squares of the size of the cell. Many lines are treated at once, step
by step. Points are complex numbers: the real part of ``conj(u) * v`` is the scalar product of two vectors, the
imaginary part their cross product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.straightening import SIDE_TURN

FILLED = 0.25
"""A kink into the cell is cut off if it is nearer than this to the chord, over the size of the cell."""
_CUT = 0.03
"""The same for a kink out of the cell."""
_SLIVER = 0.1
"""Wall faces shorter than this over the size of the cell are slivers."""
_SHARP, _CONVEX = np.pi / 3, 1e-4
"""Turn into the cell beyond which a chord cuts off a sharp corner; least turn in a corner of a convex cell."""
_CONCAVE_PRICE, _SHARP_PRICE, _OFF_PRICE, _SLIVER_PRICE = 0.5, 0.1, 0.2, 0.02
"""Concave corners cost by their angle in radians, chords by their distance from the boundary over the size."""
_SKEW_PRICE = 0.1
"""Price of a wall face for the square of its skewness above 1."""


@dataclass(eq=False)
class Lines:
    """Lines along the boundary as ragged rows; each has at least one point.

    Attributes
    ----------
    starts : (l + 1,) int
    points : (k,) complex
    fixed : (k,) bool
        Points that remain in any case. The first and the last point of a line always do.
    sizes : (l,) float
        Sizes of their cells.
    row : (k,) int
        The line of each point.
    """

    starts: np.ndarray
    points: np.ndarray
    fixed: np.ndarray
    sizes: np.ndarray

    def __post_init__(self) -> None:
        self.row = np.repeat(np.arange(len(self.sizes)), np.diff(self.starts))


def complex_of(points: np.ndarray) -> np.ndarray:
    """Return points (k, 2) as complex numbers."""
    return points[:, 0] + 1j * points[:, 1]


def turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the angles by which the paths a, b, c turn to the left in b, in radians."""
    return np.angle(np.conj(b - a) * (c - b))


def _offset(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of b from the segments between a and c, and the areas of the triangles a, b, c.

    An area is negative where the path a, b, c turns to the right.
    """
    along, aside = c - a, b - a
    both, length = np.conj(aside) * along, np.abs(along)
    part = both.real
    far = np.abs(both.imag) / np.maximum(length, 1e-300)
    outside = (part <= 0) | (part >= length * length)
    at = np.flatnonzero(outside)
    far[at] = np.abs(np.where(part[at] <= 0, aside[at], b[at] - c[at]))
    return far, both.imag / 2


def kept_points(lines: Lines) -> np.ndarray:
    """Return which points of the lines are ends of chords, (k,) bool; the first and the last one of a line are.

    First, a stretch becomes straight if its turns add up to at most 30 degrees. Then kinks near their chord are
    dropped. At last, kinks are dropped if the area without them is nearer to the exact one, as on rough walls.
    """
    if not len(lines.row):
        return np.zeros(0, bool)
    kinks = _Kinks(lines, _stretch_ends(lines))
    kinks.drop_nearest()
    kinks.drop_for_area()
    found = np.zeros(len(lines.row), bool)
    found[kinks.items[kinks.left]] = True
    return found


def _stretch_ends(lines: Lines) -> np.ndarray:
    """Return where stretches end whose turns add up to at most 30 degrees, (k,) bool; lines end there, too."""
    starts, x = lines.starts, lines.points
    turns = np.zeros(len(x))
    turns[1:-1] = turn(x[:-2], x[1:-1], x[2:])
    found = np.zeros(len(x), bool)
    found[starts[:-1]] = found[starts[1:] - 1] = True
    counts = np.diff(starts)
    longest_first = np.argsort(-counts, kind="stable")
    counts, at = counts[longest_first], starts[:-1][longest_first]
    # The k-th inner point of all lines at once: `number` lines have one, those with the most points first.
    number = np.searchsorted(-counts, -np.arange(2, counts.max(initial=0)), side="left")
    turned = np.zeros(len(at))
    for k, going in enumerate(number.tolist(), 1):
        here, sums = at[:going] + k, turned[:going]
        sums += turns[here]
        ends = lines.fixed[here] | (np.abs(sums) > SIDE_TURN)
        found[here[ends]] = True
        sums[ends] = 0
    return found


class _Kinks:
    """The ends of chords, and which of them have been dropped.

    Attributes
    ----------
    items : (m,) int
        Points of the lines.
    left : (m,) bool
        Not dropped yet.
    before, after : (m,) int
        The nearest items before and after each one that are left.
    """

    def __init__(self, lines: Lines, chosen: np.ndarray) -> None:
        self.lines, self.items = lines, np.flatnonzero(chosen)
        self.row, self.x = lines.row[self.items], lines.points[self.items]
        self.left = np.ones(len(self.items), bool)
        self.before, self.after = np.arange(len(self.items)) - 1, np.arange(len(self.items)) + 1
        self.can_go = ~lines.fixed[self.items]
        self.can_go[np.diff(self.row, prepend=-1) > 0] = False
        self.can_go[np.diff(self.row, append=len(lines.sizes)) > 0] = False
        self.limit = (FILLED * lines.sizes)[self.row]

    def _triangles(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of `some` items from the chords without them, and the areas of the triangles."""
        return _offset(self.x[self.before[some]], self.x[some], self.x[self.after[some]])

    def _drop(self, some: np.ndarray) -> np.ndarray:
        """Drop items, no two of which are adjacent; return the others whose chord changes."""
        before, after = self.before[some], self.after[some]
        self.left[some] = False
        self.after[before], self.before[after] = after, before
        near = np.concatenate([before, after])
        return near[self.can_go[near]]

    def drop_nearest(self) -> None:
        """Drop kinks near their chords. Each round drops those that are nearer than the kinks before and after them."""
        cut = (_CUT * self.lines.sizes)[self.row]

        def offsets(some: np.ndarray) -> np.ndarray:
            """Return the distances from the chords, or infinity for kinks that stay."""
            far, area = self._triangles(some)
            return np.where(far >= np.where(area < 0, self.limit[some], cut[some]), np.inf, far)

        far = np.full(len(self.items), np.inf)
        going = np.flatnonzero(self.can_go)
        far[going] = offsets(going)
        while going.size:
            here, before, after = far[going], far[self.before[going]], far[self.after[going]]
            changed = self._drop(np.unique(going[(here < before) & (here <= after)]))
            far[changed] = offsets(changed)
            near = np.concatenate([changed, self.before[changed], self.after[changed]])
            going = near[np.isfinite(far[near])]

    def drop_for_area(self) -> None:
        """Drop each kink near its chord without which the area of the cell is nearer to the exact one."""
        lines = self.lines
        lost = _areas(lines.points, lines.starts)
        rest = np.flatnonzero(self.left)
        lost -= _areas(self.x[rest], np.searchsorted(self.row[rest], np.arange(len(lost) + 1)))
        far, area = np.zeros((2, len(self.items)))
        going = np.flatnonzero(self.left & self.can_go)
        far[going], area[going] = self._triangles(going)
        while going.size:
            row = self.row[going]
            miss = np.where(far[going] <= self.limit[going], np.abs(lost[row] + area[going]), np.inf)
            best = least_of_rows(row, miss)
            best = best[miss[best] < np.abs(lost[row[best]])]
            best, going = going[best], _of_lines(going, row, row[best])
            lost[self.row[best]] += area[best]
            changed = self._drop(best)
            far[changed], area[changed] = self._triangles(changed)
            going = going[self.left[going]]


def least_of_rows(row: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the place of the smallest value of each row, the first one of equals; entries of a row are adjacent."""
    if not len(row):
        return np.zeros(0, np.int64)
    begins = np.flatnonzero(np.diff(row, prepend=-1) > 0)
    counts = np.diff(np.append(begins, len(row)))
    least = np.flatnonzero(values == np.repeat(np.minimum.reduceat(values, begins), counts))
    return least[np.diff(row[least], prepend=-1) > 0]


def _of_lines(items: np.ndarray, row: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Return those of `items` (k,) whose `row` is among `lines`; both are ascending."""
    counts = np.searchsorted(lines, row, side="right") - np.searchsorted(lines, row, side="left")
    return items[counts > 0]


def _areas(points: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the area between each line and the segment from its first to its last point, (l,).

    It is positive where the line is to the right of the segment.
    """
    p = points - np.repeat(points[starts[:-1]], np.diff(starts))
    twice = np.zeros(len(p))
    twice[:-1] = (np.conj(p[:-1]) * p[1:]).imag
    twice[starts[1:] - 1] = 0
    return np.add.reduceat(twice, starts[:-1]) / 2


def chords(lines: Lines, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return all points of `lines` but the last of each, (s,); where each chord begins among them, and its number."""
    step = np.ones(len(lines.row), bool)
    step[lines.starts[1:] - 1] = False
    steps = np.flatnonzero(step)
    firsts = np.flatnonzero(kept[steps])
    return steps, firsts, np.diff(np.append(firsts, len(steps)))


def chord_costs(lines: Lines, kept: np.ndarray, centroids: np.ndarray) -> np.ndarray:
    """Return the cost of each line, (l,), with chords between the points `kept` (k,) bool.

    Corners that are not convex have a price of their own, see `concave_prices`.

    `centroids` (l,) complex are those of the cells.
    """
    x, count = lines.points, len(lines.sizes)
    steps, firsts, counts = chords(lines, kept)
    if not steps.size:
        return np.zeros(count)
    begin, end = steps[firsts], steps[firsts + counts - 1] + 1
    a, c = np.repeat(x[begin], counts), np.repeat(x[end], counts)
    p, q = x[steps] - a, x[steps + 1] - a
    area = np.add.reduceat((np.conj(p) * q).imag, firsts) / 2
    far, _ = _offset(a, x[steps], c)
    far[firsts] = 0
    chord = np.repeat(np.arange(len(firsts)), counts)
    off = np.maximum.reduceat(far, firsts)
    farthest = steps[least_of_rows(chord, -far)]
    row = lines.row[begin]
    size = lines.sizes[row]
    sharp = (off > 0) & (turn(x[begin], x[farthest], x[end]) < -_SHARP)
    sliver = np.abs(x[end] - x[begin]) < _SLIVER * size
    beyond = np.maximum(skewness(x[begin], x[end], centroids[row]) - 1, 0)
    price = np.abs(area) + _OFF_PRICE * off * size
    price += (_SHARP_PRICE * sharp + _SLIVER_PRICE * sliver + _SKEW_PRICE * beyond**2) * size**2
    return np.bincount(row, price, count)


def skewness(a: np.ndarray, b: np.ndarray, centroids: np.ndarray) -> np.ndarray:
    """Return OpenFOAM's skewness of wall faces from a to b."""
    length = np.maximum(np.abs(b - a), 1e-300)
    middle = np.conj((b - a) / length) * ((a + b) / 2 - centroids)
    off, height = np.abs(middle.real), np.abs(middle.imag)
    return off / np.maximum(np.maximum(length / 2, 0.4 * height), 1e-300)


def concave_prices(lines: Lines, kept: np.ndarray, behind: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the price of each line, (l,), for the corners at which its cell is not convex.

    Parameters
    ----------
    kept : (k,) bool
    behind, ahead : (l, 2) complex
        Two points before and two after each line in the loop around the cell.
    """
    row = lines.row[kept]
    counts = np.bincount(row, minlength=len(lines.sizes))
    ends = np.cumsum(counts + 4)
    begins = ends - counts - 4
    way = np.empty(int(ends[-1]), complex)
    way[begins], way[begins + 1] = behind[:, 0], behind[:, 1]
    way[ends - 2], way[ends - 1] = ahead[:, 0], ahead[:, 1]
    way[np.arange(len(row)) + 4 * row + 2] = lines.points[kept]
    angle = np.zeros(len(way))
    angle[1:-1] = turn(way[:-2], way[1:-1], way[2:])
    price = np.where(angle < _CONVEX, _CONCAVE_PRICE * (0.1 + np.minimum(-angle, 1.0)), 0.0)
    price[begins] = price[ends - 1] = 0
    return np.add.reduceat(price, begins) * lines.sizes**2
