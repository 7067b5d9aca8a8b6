"""Columns of boundary layers: their feet on the wall and their directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..connectivity import rows_and_places
from .curves import angles
from .polygon import Polygon

_SHARP = math.radians(50)  # turn of the boundary at which one row ends and another one begins
_STEP = math.radians(36)  # largest angle between generators of a row around a corner
_MOST = 2.0**62  # columns, more than fit on any device: keeps their number finite
_LONG = 1.5  # widths: an edge of this length has columns that no other edge shares
_EQUAL = 1e-6  # of their length: tolerance for edges of regular polygons
_BULGE = 0.25
"""Largest distance between a curved wall and the chord of a cell, as a share of the first layer's height. The chord is
the wall face of solvers, so the cell is at most this share higher or lower there."""
_WINDOW = 0.2
"""Part of the wall, in widths, over which its curvature is a mean. The number of columns hardly depends on it."""
_FLAT = 8
"""Width of columns beside a corner with a fan, in heights of the first layer. With 16, checks for OpenFOAM refuse a
NACA 0012 section with a first layer of 2e-4 chord."""
_WIDENING = 0.3
"""Largest change of the width of columns per length along the wall: the relative difference of neighboring columns.
With 1.2, the same section is refused."""
_RATIO = 1.4  # of widths at neighboring places, between which the width is linear
_FINEST = 1e-6  # of the width: the narrowest columns


@dataclass(frozen=True)
class Chain:
    """Consecutive edges of the boundary without a sharp turn."""

    corners: np.ndarray
    """(k, 2) float. Vertices, with the domain on the left."""
    closed: bool
    """Whether the last vertex is the first one, without a sharp turn there."""
    fan: float
    """Angle at the end by which the boundary turns away from the domain, towards the next chain; 0 for other turns."""
    after_fan: bool
    """Whether the chain before ends in such a turn."""


def find_chains(polygon: Polygon, chosen: np.ndarray) -> list[Chain]:
    """Join the `chosen` edges of `polygon.oriented`, (k,) bool, to chains."""
    vertices, following = polygon.oriented.vertices, polygon.oriented.next_vertex
    along = vertices[following] - vertices
    turn = angles(along, along[following])
    # Whether edge e continues in the next one without a sharp turn.
    onward = chosen & chosen[following] & (np.abs(turn) < _SHARP)
    starts = chosen.copy()
    starts[following[onward]] = False
    fans = np.where(chosen & chosen[following] & ~onward & (turn < 0), -turn, 0.0)
    before = np.empty_like(following)
    before[following] = np.arange(len(following))
    chains, seen = [], np.zeros(len(chosen), bool)
    for e in [*np.flatnonzero(starts).tolist(), *np.flatnonzero(chosen).tolist()]:
        if seen[e]:
            continue
        edges = [e]
        while onward[edges[-1]] and following[edges[-1]] != e:
            edges.append(int(following[edges[-1]]))
        seen[edges] = True
        last = edges[-1]
        chains.append(
            Chain(
                np.vstack([vertices[edges], vertices[following[last]]]),
                bool(onward[last]),
                float(fans[last]),
                bool(fans[before[e]]),
            )
        )
    return chains


def count_columns(chain: Chain, width: float, height: float) -> int:
    """Return the number of columns along the chain, at most `width` wide; `height` is that of the first layer."""
    _, counts = _runs(_Wall.of(chain, width, height).stretched_lengths(), width, chain)
    return sum(map(int, counts.tolist()))


def count_fan(chain: Chain, width: float, distance: float) -> int:
    """Return the number of generators at a distance from the corner at the end of the chain.

    They are at most 36 degrees apart. Rows farther away have twice, four times, ... as many steps.
    """
    if not chain.fan:
        return 0
    least = math.ceil(chain.fan / _STEP)
    more = min(chain.fan * distance / width, _MOST) / least
    return 1 + least * 2 ** max(0, round(math.log2(max(more, 1.0))))


def place_fan(chain: Chain, width: float, distance: float) -> np.ndarray:
    """Return generators (m, 2) at a distance from the corner at the end of the chain.

    The first and the last one are above the corner on the normals of the two walls, so that their rows continue those
    of the walls. Faces between them end in the corner.
    """
    count = count_fan(chain, width, distance)
    along = chain.corners[-1] - chain.corners[-2]
    angles = math.atan2(along[0], -along[1]) - chain.fan * np.linspace(0, 1, count)
    return chain.corners[-1] + distance * np.column_stack([np.cos(angles), np.sin(angles)])


@dataclass(frozen=True)
class _Wall:
    """The edges of a chain, and lengths along it in which all columns are equally wide: stretched lengths.

    Columns are narrower where the wall is curved, so that the wall within a cell is flat beside the height of the first
    layer: a cell of width w bulges by w^2 / (8 r) on a wall of radius r. They are narrower beside corners with a fan,
    too, where the first cell of the fan is as small as the layer is high.
    """

    corners: np.ndarray
    """(k + 1, 2) float."""
    joined: bool
    """Whether the chain is closed and begins between two long edges."""
    along: np.ndarray
    """(k, 2) float. The edges as vectors."""
    lengths: np.ndarray
    """(k,) float. Lengths of the edges."""
    reached: np.ndarray
    """(k + 1,) float. Lengths along the chain up to each corner."""
    grading: tuple[np.ndarray, np.ndarray] | None
    """((m,) float, (m,) float) or None. Lengths along the chain and the stretched lengths there, linear between them.
    None if all columns have the largest width."""

    @classmethod
    def of(cls, chain: Chain, width: float, height: float) -> _Wall:
        """Return the wall of `chain`, for columns of at most `width` and a first layer of `height`."""
        corners, joined = _begun(chain, width)
        along = np.diff(corners, axis=0)
        lengths = np.hypot(*along.T)
        reached = np.concatenate([[0], np.cumsum(lengths)])
        bounds = _largest_widths(chain, along, lengths, reached, width, height)
        grading = None
        if (bounds < width).any():
            places, widths = _graded_widths(reached, bounds, width, chain.closed)
            grading = places, _stretch(places, widths, width)
        return cls(corners, joined, along, lengths, reached, grading)

    def stretched_lengths(self) -> np.ndarray:
        """Return the stretched lengths of the edges, (k,)."""
        return self.lengths if self.grading is None else np.diff(np.interp(self.reached, *self.grading))

    def unstretch(self, at: np.ndarray) -> np.ndarray:
        """Return the lengths along the chain, (n,), of places `at` (n,) in stretched lengths."""
        if self.grading is None:
            return at
        place, stretched = self.grading
        return np.interp(at, stretched, place)


def _largest_widths(
    chain: Chain, along: np.ndarray, lengths: np.ndarray, reached: np.ndarray, width: float, height: float
) -> np.ndarray:
    """Return the largest width of columns at each corner of the chain, (k + 1,), whatever it is at the others."""
    long = lengths >= _LONG * width
    turn = angles(along[:-1], along[1:])
    turn[long[:-1] & long[1:]] = 0  # such a corner is one of cells
    # The direction of the wall, linear between the middles of edges; its change over a part of a width.
    direction = np.concatenate([[0], np.cumsum(turn)])
    middles = (reached[1:] + reached[:-1]) / 2
    if chain.closed:
        closing = 2 * np.pi * round(direction[-1] / (2 * np.pi)) or direction[-1]
        direction = np.concatenate([direction + c for c in (-closing, 0, closing)])
        middles = np.concatenate([middles + c for c in (-reached[-1], 0, reached[-1])])
    window = np.array([[-_WINDOW], [_WINDOW]]) / 2 * width
    before, after = np.interp(reached + window, middles, direction)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        radius = _WINDOW * width / np.abs(after - before)
        bounds = np.fmin(width, np.sqrt(8 * _BULGE * height * radius))
    at_fans = min(width, _FLAT * height)
    if chain.after_fan:
        bounds[0] = min(bounds[0], at_fans)
    if chain.fan:
        bounds[-1] = min(bounds[-1], at_fans)
    return np.maximum(bounds, _FINEST * width)


def _graded_widths(
    reached: np.ndarray, bounds: np.ndarray, width: float, closed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return places along the chain and the widths of columns there, (m,) each, linear between them.

    They are the largest widths that exceed neither the `bounds` at the corners, nor `width`, nor change by more than
    `_WIDENING` per length.
    """
    narrow = bounds < width
    ratios = _RATIO ** np.arange(1, 1 + math.ceil(math.log(width / bounds.min(), _RATIO)))
    reach = (bounds[narrow] / _WIDENING)[:, None] * (ratios - 1)
    around = np.concatenate([reached[narrow, None] - reach, reached[narrow, None] + reach]).ravel()
    length = reached[-1]
    if closed:
        around %= length
    places = np.unique(np.concatenate([reached, around[(around > 0) & (around < length)]]))
    known, given = reached, bounds
    if closed:
        known = np.concatenate([reached + c for c in (-length, 0, length)])
        given = np.tile(bounds, 3)
    after = np.minimum.accumulate(given - _WIDENING * known)
    before = np.minimum.accumulate((given + _WIDENING * known)[::-1])[::-1]
    left = np.clip(np.searchsorted(known, places, side="right") - 1, 0, len(known) - 1)
    right = np.clip(np.searchsorted(known, places, side="left"), 0, len(known) - 1)
    widths = np.minimum(after[left] + _WIDENING * places, before[right] - _WIDENING * places)
    return places, np.minimum(widths, width)


def _stretch(places: np.ndarray, widths: np.ndarray, width: float) -> np.ndarray:
    """Return the integrals of ``width / w`` up to each place, (m,); w is linear between the `widths` (m,)."""
    ratio = np.log(widths[1:] / widths[:-1])
    # The logarithmic mean of both ends; where they are nearly equal, the arithmetic mean.
    mean = (widths[1:] + widths[:-1]) / 2
    np.divide(np.diff(widths), ratio, out=mean, where=np.abs(ratio) >= 1e-3)
    return np.concatenate([[0], np.cumsum(np.diff(places) * width / mean)])


def _begun(chain: Chain, width: float) -> tuple[np.ndarray, bool]:
    """Return the corners of a chain, and whether it is closed and begins between two long edges."""
    long = np.hypot(*np.diff(chain.corners, axis=0).T) >= _LONG * width
    begins = np.flatnonzero(long & np.roll(long, 1)) if chain.closed else np.empty(0, int)
    if not len(begins):
        return chain.corners, False
    first = int(begins[0])
    return np.vstack([chain.corners[first:-1], chain.corners[: first + 1]]), True


def _runs(lengths: np.ndarray, width: float, chain: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Cut a chain at the corners between long edges. These are corners of cells, too, so no face is a sliver.

    Beside a corner with a fan, half a width belongs to the fan.

    Results:
    - `runs`, `counts` (r,) float: lengths of the parts, and the number of columns on each.
    """
    long = lengths >= _LONG * width
    first = np.flatnonzero(np.concatenate([[True], long[1:] & long[:-1], [True]]))
    reached = np.concatenate([[0], np.cumsum(lengths)])
    runs = np.diff(reached[first])
    with np.errstate(over="ignore"):
        counts = np.minimum(runs / width, _MOST)
    counts[0] -= chain.after_fan / 2
    counts[-1] -= bool(chain.fan) / 2
    counts = np.maximum(np.rint(counts), 1)
    edges = len(lengths)
    if len(runs) == 1 and np.ptp(lengths) <= _EQUAL * lengths[0]:
        # On a regular polygon: equally many columns per edge, or equally many edges per column.
        share = counts[0] / edges
        whole = max(1, round(1 / share))
        if share >= 0.75:
            counts[0] = edges * round(min(share, _MOST))
        elif edges % whole == 0:
            counts[0] = edges // whole
    return runs, counts


def _places(lengths: np.ndarray, width: float, joined: bool, chain: Chain) -> np.ndarray:
    """Return the places of columns along the chain. They are symmetric about each corner between runs.

    `joined` says whether the first run begins at such a corner, too.
    """
    runs, counts = _runs(lengths, width, chain)
    starts = np.cumsum(runs) - runs
    fans = np.zeros((2, len(runs)))
    fans[0, 0], fans[1, -1] = chain.after_fan, bool(chain.fan)
    half = 0.5 * runs / (counts + fans.sum(axis=0) / 2)
    meet = 0.5 * (half[1:] + half[:-1])
    ends = 0.5 * (half[0] + half[-1]) if joined else None
    before = np.concatenate([[half[0] if ends is None else ends], meet]) * (1 + fans[0])
    after = np.concatenate([meet, [half[-1] if ends is None else ends]]) * (1 + fans[1])
    steps = (runs - before - after) / np.maximum(counts - 1, 1)
    n = counts.astype(np.int64)
    run, number = rows_and_places(n)
    return starts[run] + before[run] + number * steps[run]


def place_columns(chain: Chain, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Return feet (c, 2) on the wall, about `width` apart or less, and unit normals (c, 2) into the domain."""
    wall = _Wall.of(chain, width, height)
    along, lengths, reached = wall.along, wall.lengths, wall.reached
    at = wall.unstretch(_places(wall.stretched_lengths(), width, wall.joined, chain))
    edge = np.minimum(np.searchsorted(reached, at, side="right") - 1, len(lengths) - 1)
    share = ((at - reached[edge]) / lengths[edge])[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / lengths[:, None]
    # Normals turn gradually from corner to corner, so that columns neither cross nor leave gaps at bends.
    first, last = (normal[-1], normal[0]) if chain.closed else (normal[0], normal[-1])
    at_corners = np.vstack([first, normal]) + np.vstack([normal, last])
    at_corners /= np.hypot(*at_corners.T)[:, None]
    # A normal turns within half an edge of a corner, but at most within a width.
    bend = np.minimum(0.5, width / lengths[edge])[:, None]
    to_first, to_last = np.clip(1 - share / bend, 0, 1), np.clip(1 - (1 - share) / bend, 0, 1)
    mixed = (
        normal[edge] + to_first * (at_corners[edge] - normal[edge]) + to_last * (at_corners[edge + 1] - normal[edge])
    )
    return wall.corners[edge] + share * along[edge], mixed / np.hypot(*mixed.T)[:, None]
