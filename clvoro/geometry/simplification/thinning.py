"""The rings of what is left, with fewer vertices, and the names of their edges."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

import numpy as np
import shapely

from .narrow import Parts
from .triangles import Triangles

if TYPE_CHECKING:
    from ..polygon import Polygon

LEAST_PIECE = 4.0
"""Least area over h^2 of a piece of the domain that remains."""
_APART = 0.01
"""Distance over h by which the boundary is moved at a point where the water touches itself."""
_TRIES = 6

DEFAULT_NAME = re.compile(r"(outer|hole)(-\d+)?")
"""The names of rings that have none of their own, such as "outer" and "hole-1"."""


def pieces_of(domain: Polygon) -> list[tuple[list[np.ndarray], dict[str, list[int]]]]:
    """Return the rings of each piece, and the names of its edges but for those of rings without a name."""
    found, rings = [], domain.rings
    for piece in range(domain.n_pieces):
        rows = np.flatnonzero(domain.piece_of_ring == piece)
        edges = slice(domain.ring_starts[rows[0]], domain.ring_starts[rows[-1] + 1])
        index, names = domain.boundaries.index[edges], {}
        for part in np.unique(index).tolist():
            name = domain.boundaries.names[part]
            if DEFAULT_NAME.fullmatch(name) is None:
                names[name] = np.flatnonzero(index == part).tolist()
        found.append(([rings[row] for row in rows], names))
    return found


def large_pieces(triangles: Triangles) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Return the rings of all pieces of more than a few cells, the outer one first: vertices (k, 2) and sizes (k,)."""
    pieces = Parts(triangles, triangles.water)
    triangles.water = pieces.chosen(pieces.area > LEAST_PIECE * pieces.h**2)
    shore, near, corners = triangles.shores(), triangles.neighbors, triangles.corners
    t, k = np.nonzero(shore)
    number = np.full(shore.shape, -1)
    number[t, k] = np.arange(len(t))
    point, end = corners[t, (k + 1) % 3], corners[t, (k + 2) % 3]
    # The next side: turn about the end through water.
    after, turning, s, side = np.empty_like(t), np.arange(len(t)), t, (k + 1) % 3
    while len(turning):
        there = shore[s, side]
        after[turning[there]] = number[s[there], side[there]]
        turning, s = turning[~there], near[s, side][~there]
        side = ((corners[s] == end[turning, None]).argmax(axis=1) + 2) % 3
    x, h = _apart(triangles.x, point, after, triangles.h[point]), triangles.h[point]
    follow = x[after] - x
    before = np.empty_like(after)
    before[after] = np.arange(len(after))
    last = x - x[before]
    bend = np.abs(last[:, 0] * follow[:, 1] - last[:, 1] * follow[:, 0])
    straight = bend < 1e-9 * np.hypot(*last.T) * np.hypot(*follow.T)
    kept = ~straight | (point < triangles.n_vertices)
    piece_of = np.zeros(len(corners), np.int64)
    piece_of[pieces.row] = pieces.part
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    following, left = after.tolist(), np.ones(len(after), bool)
    for first in range(len(left)):
        if left[first]:
            ring, at = [first], following[first]
            while at != first:
                ring.append(at)
                at = following[at]
            left[ring] = False
            row = np.array(ring)[kept[ring]]
            found.setdefault(int(piece_of[t[first]]), []).append((x[row], h[row]))
    return [sorted(rings, key=lambda ring: -_area(ring[0])) for rings in found.values()]


def _area(ring: np.ndarray) -> float:
    """Return the area within a ring; negative if it runs clockwise."""
    x, y = (ring - ring[0]).T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _apart(x: np.ndarray, point: np.ndarray, after: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the positions of the points of rings: where the water touches itself, they move into it."""
    found = x[point]
    rows = np.flatnonzero(np.bincount(point)[point] > 1)
    before = np.empty_like(after)
    before[after] = np.arange(len(after))
    ahead, back = (x[point[way[rows]]] - found[rows] for way in (after, before))
    first, last = (np.arctan2(way[:, 1], way[:, 0]) for way in (ahead, back))
    angle = first + 0.5 * np.mod(last - first, 2 * math.pi)
    near = np.minimum(np.hypot(*ahead.T), np.hypot(*back.T))
    way = np.minimum(_APART * h[rows], near / 4)
    found[rows] += way[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return found


def thinned(
    domain: Polygon, water: list[list[tuple[np.ndarray, np.ndarray]]], tolerance: float
) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of pieces of `water` with fewer vertices, and the edges of each name."""
    pieces = [[_Ring(domain, *ring) for ring in piece] for piece in water]
    rows: list[list[np.ndarray]] = []
    for k in range(_TRIES):
        share = tolerance / 2**k if k < _TRIES - 1 else 0.0
        rows = [[ring.kept(share) for ring in piece] for piece in pieces]
        made = [
            shapely.Polygon(piece[0].x[own[0]], [r.x[o] for r, o in zip(piece[1:], own[1:], strict=True)])
            for piece, own in zip(pieces, rows, strict=True)
        ]  # fmt: skip
        if shapely.MultiPolygon(made).is_valid:
            break
    names: dict[str, list[int]] = {}
    named = set(domain.boundaries.names) - {
        n for n in domain.boundaries.names if DEFAULT_NAME.fullmatch(n)
    }
    named |= set(domain.names or ()) & set(domain.boundaries.names)
    edge = 0
    for ring, own in (
        (r, o) for p, q in zip(pieces, rows, strict=True) for r, o in zip(p, q, strict=True)
    ):
        for part in ring.part[own].tolist():
            name = domain.boundaries.names[part]
            if name in named:
                names.setdefault(name, []).append(edge)
            edge += 1
    return [
        [r.x[o] for r, o in zip(p, q, strict=True)] for p, q in zip(pieces, rows, strict=True)
    ], names


class _Ring:
    """One ring (k, 2) with the size at each vertex and the named part of each edge."""

    def __init__(self, domain: Polygon, x: np.ndarray, h: np.ndarray) -> None:
        self.x, self.h = x, h
        edges, _ = domain.nearest_edge((x + np.roll(x, -1, axis=0)) / 2)
        self.part = domain.boundaries.index[edges]

    def kept(self, share: float) -> np.ndarray:
        """Return the vertices, ascending, from whose polyline all others are at most `share` times the size away."""
        k = len(self.x)
        if share == 0:
            return np.arange(k)
        ends = np.flatnonzero(self.part != np.roll(self.part, 1))
        if len(ends) < 2:
            # A vertex of the convex hull, and the one that is farthest from it.
            center = self.x.mean(axis=0)
            first = int(ends[0]) if len(ends) else int(np.argmax(np.hypot(*(self.x - center).T)))
            far = int(np.argmax(np.hypot(*(self.x - self.x[first]).T)))
            ends = np.unique([first, far])
        rows = np.setdiff1d(np.arange(ends[0], ends[0] + k), ends)
        ends = np.append(ends, ends[0] + k)
        while len(rows):  # between kept vertices that are too far from each other
            part = np.searchsorted(ends, rows)
            begin = self.x[ends[part - 1] % k]
            along, way = self.x[ends[part] % k] - begin, self.x[rows % k] - begin
            square = np.maximum((along**2).sum(axis=1), 1e-300)
            t = np.clip((way * along).sum(axis=1) / square, 0, 1)
            off = np.hypot(*(way - t[:, None] * along).T) / self.h[rows % k]
            first = np.flatnonzero(np.diff(part, prepend=0))
            number = np.cumsum(np.diff(part, prepend=0) > 0) - 1
            worst = np.maximum.reduceat(off, first)[number]
            far = np.flatnonzero((off == worst) & (off > share))
            far = far[np.unique(number[far], return_index=True)[1]]
            again = worst > share
            again[far] = False
            ends, rows = np.sort(np.append(ends, rows[far])), rows[again]
        kept = np.zeros(k, bool)
        kept[ends % k] = True
        if kept.sum() < 3:
            return np.arange(k)
        return np.flatnonzero(kept)
