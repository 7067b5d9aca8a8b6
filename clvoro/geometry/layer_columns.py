"""Columns of boundary layers: their feet on the wall and their directions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .polygon import Polygon

_SHARP = math.radians(50)  # turn of the boundary at which one row ends and another one begins
_EDGE = math.radians(120)  # turn at a sharp edge, as the trailing edge of a wing
_MOST = 2.0**62  # columns, more than fit on any device: keeps their number finite
_LONG = 1.5  # widths: an edge of this length has columns that no other edge shares
_EQUAL = 1e-6  # of their length: tolerance for edges of regular polygons


@dataclass(frozen=True)
class Chain:
    """Consecutive edges of the boundary without a sharp turn.

    Attributes
    ----------
    corners : (k, 2) float
        Vertices, with the domain on the left.
    closed : bool
        Whether the last vertex is the first one, without a sharp turn there.
    fan : float
        Angle at the end by which the boundary turns away from the domain, towards the next chain; 0 for other turns.
    """

    corners: np.ndarray
    closed: bool
    fan: float


def find_chains(polygon: Polygon, chosen: np.ndarray) -> list[Chain]:
    """Join the `chosen` edges of `polygon.oriented`, (k,) bool, to chains."""
    vertices, following = polygon.oriented.vertices, polygon.oriented.next_vertex
    along = vertices[following] - vertices
    after = along[following]
    turn = np.arctan2(
        along[:, 0] * after[:, 1] - along[:, 1] * after[:, 0], (along * after).sum(axis=1)
    )
    # Whether edge e continues in the next one without a sharp turn.
    onward = chosen & chosen[following] & (np.abs(turn) < _SHARP)
    starts = chosen.copy()
    starts[following[onward]] = False
    chains, seen = [], np.zeros(len(chosen), bool)
    for e in [*np.flatnonzero(starts).tolist(), *np.flatnonzero(chosen).tolist()]:
        if seen[e]:
            continue
        edges = [e]
        while onward[edges[-1]] and following[edges[-1]] != e:
            edges.append(int(following[edges[-1]]))
        seen[edges] = True
        last = edges[-1]
        fan = (
            -turn[last] if chosen[following[last]] and not onward[last] and turn[last] < 0 else 0.0
        )
        chains.append(
            Chain(
                np.vstack([vertices[edges], vertices[following[last]]]),
                bool(onward[last]),
                float(fan),
            )
        )
    return chains


def count_columns(chain: Chain, width: float) -> int:
    """Return the number of columns along the chain."""
    corners, _ = _begun(chain, width)
    _, counts = _runs(np.hypot(*np.diff(corners, axis=0).T), width)
    return sum(map(int, counts.tolist()))


def count_fan(chain: Chain, width: float, height: float) -> int:
    """Return the number of generators at the distance `height` around the corner at the end of the chain.

    There are at least two. Faces between them end in the corner; the cell of a single one would go around it. At a
    sharp edge there are at least three: a face between only two long cells is much shorter than they are, and skew.
    """
    least = 3 if chain.fan > _EDGE else 2
    return max(least, round(min(chain.fan * height / width, _MOST))) if chain.fan else 0


def place_fan(chain: Chain, width: float, height: float) -> np.ndarray:
    """Return generators (m, 2) at the distance `height` around the corner at the end of the chain."""
    count = count_fan(chain, width, height)
    along = chain.corners[-1] - chain.corners[-2]
    normal = math.atan2(along[0], -along[1])
    angles = normal - chain.fan * (np.arange(count) + 0.5) / max(count, 1)
    return chain.corners[-1] + height * np.column_stack([np.cos(angles), np.sin(angles)])


def _begun(chain: Chain, width: float) -> tuple[np.ndarray, bool]:
    """Return the corners of a chain, and whether it is closed and begins between two long edges."""
    long = np.hypot(*np.diff(chain.corners, axis=0).T) >= _LONG * width
    begins = np.flatnonzero(long & np.roll(long, 1)) if chain.closed else np.empty(0, int)
    if not len(begins):
        return chain.corners, False
    first = int(begins[0])
    return np.vstack([chain.corners[first:-1], chain.corners[: first + 1]]), True


def _runs(lengths: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut a chain at the corners between long edges. These are corners of cells, too, so no face is a sliver.

    Returns
    -------
    runs, counts : (r,) float
        Lengths of the parts, and the number of columns on each.
    """
    long = lengths >= _LONG * width
    first = np.flatnonzero(np.concatenate([[True], long[1:] & long[:-1], [True]]))
    reached = np.concatenate([[0], np.cumsum(lengths)])
    runs = np.diff(reached[first])
    with np.errstate(over="ignore"):
        counts = np.maximum(np.rint(np.minimum(runs / width, _MOST)), 1)
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


def _places(lengths: np.ndarray, width: float, joined: bool) -> np.ndarray:
    """Return the places of columns along the chain. They are symmetric about each corner between runs.

    `joined` says whether the first run begins at such a corner, too.
    """
    runs, counts = _runs(lengths, width)
    starts = np.cumsum(runs) - runs
    half = 0.5 * runs / counts
    meet = 0.5 * (half[1:] + half[:-1])
    ends = 0.5 * (half[0] + half[-1]) if joined else None
    before = np.concatenate([[half[0] if ends is None else ends], meet])
    after = np.concatenate([meet, [half[-1] if ends is None else ends]])
    steps = (runs - before - after) / np.maximum(counts - 1, 1)
    n = counts.astype(np.int64)
    run = np.repeat(np.arange(len(runs)), n)
    number = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
    return starts[run] + before[run] + number * steps[run]


def place_columns(chain: Chain, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return feet (c, 2) on the wall, about `width` apart, and unit normals (c, 2) into the domain of the columns."""
    corners, joined = _begun(chain, width)
    along = np.diff(corners, axis=0)
    lengths = np.hypot(*along.T)
    reached = np.concatenate([[0], np.cumsum(lengths)])
    at = _places(lengths, width, joined)
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
        normal[edge]
        + to_first * (at_corners[edge] - normal[edge])
        + to_last * (at_corners[edge + 1] - normal[edge])
    )
    return corners[edge] + share * along[edge], mixed / np.hypot(*mixed.T)[:, None]
