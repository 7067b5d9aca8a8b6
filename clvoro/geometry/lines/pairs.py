"""Pairs of generators that are mirror images in lines, so that faces between them lie on the lines.

Stations divide each line into chords about h long. Around each station is a ball without generators inside. The
generators beside a chord are where the circles around its two ends intersect: both ends belong to the cells of both
generators, and with them the whole chord, wherever all other generators are. Circles have the radii that make square
cells. Where lines meet, neighboring chords share the generator between them, unless there is room for two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy
import shapely

from ...connectivity import starts_of
from ..domain import Domain
from ..fixed_generators import FixedGenerators
from .lines import Network, wall_lines

_RADIUS = math.sqrt(0.5)  # of a circle, over the mean of its chords: square cells
_LEAST_RADIUS = 0.6  # of a circle, over the longer of its chords
_BEND = math.radians(50)  # a line that turns by less has room for the generators of both chords
_UPRIGHT = math.radians(70)  # a line that meets a wall at a larger angle needs no angle of its own
_SEPARATION = math.radians(60)  # least angle between two generators in one sector
_ANGLES = math.radians(3), math.radians(66)  # between a chord and its generators, as seen from a node
_BEHIND = 0.15  # of the radius of a corner: least length of its chords beyond the generators
_AT_WALL = 0.6  # the same, of the angle between the chord and a wall
_GROWTH = 0.35  # of the lengths of chords, per length
_LONG = 0.5  # of h: longer segments of a line have stations at both ends
_REACH = 0.4  # of h: turns are measured over this length
_STRAIGHT = 1e-9  # smaller turns, in radians, need no station
_JOINED = 0.45  # of h: a shorter rest of a line is not a chord of its own
_TIGHTER = 0.75  # sizes shrink by this factor where chords have no room
_SMALLEST = 0.05  # of h: a line with smaller chords is left out
_ROUNDS = 40
_OF_GAP = 0.6  # of the distance to another line: longest chords
_MOST = 10**6  # numbers of one array
_ROOM = 0.3  # of the height of both generators over their chords: their least distance
_DEPTH = 0.25  # of its height: least distance of a generator from a wall
_CLEAR = 1.06  # radius in which no other generators are, over that of the circle


@dataclass(frozen=True)
class LinePairs(FixedGenerators):
    """The generators beside lines. Balls are around the stations."""

    chords: np.ndarray
    sizes: np.ndarray
    """`chords`, `sizes`: (c, 2, 2) and (c,) float64. Where faces are to lie, and sizes of the cells beside them."""


class _Piece(NamedTuple):
    """A part of a line without a corner: its vertices, the lengths up to each of them, and the nodes at both ends."""

    path: np.ndarray
    along: np.ndarray
    ends: tuple[int, int]

    @property
    def length(self) -> float:
        return float(self.along[-1])

    def at(self, s: np.ndarray) -> np.ndarray:
        """Return the points (n, 2) at the lengths `s` (n,)."""
        return np.column_stack([np.interp(s, self.along, x) for x in self.path.T])


_Use = tuple[int, int]  # a piece, and which of its ends


class _Corner(NamedTuple):
    """A node whose chords need angles of their own: the radius of its circle, and angle and length of each chord."""

    radius: float
    angles: dict[_Use, float]
    lengths: dict[_Use, float]


@dataclass
class _Layout:
    """Balls and generators of one attempt."""

    points: list[np.ndarray] = field(default_factory=list)
    heights: list[float] = field(default_factory=list)
    pieces: list[int] = field(default_factory=list)
    """`points`, `heights`, `pieces`: of each generator: place, least distance from its lines, and piece."""
    centers: list[np.ndarray] = field(default_factory=list)
    radii: list[float] = field(default_factory=list)
    members: list[list[int]] = field(default_factory=list)
    """`centers`, `radii`, `members`: of each ball: center, radius, and its generators."""
    chords: list[np.ndarray] = field(default_factory=list)
    sizes: list[float] = field(default_factory=list)
    """`chords`, `sizes`: of each chord: ends (2, 2), and size of the cells beside it."""
    tight: list[tuple[float, float, float]] = field(default_factory=list)
    """list of (x, y, length). Chords that have to be shorter."""
    blamed: set[int] = field(default_factory=set)
    at_nodes: dict[tuple[int, float, float], int] = field(default_factory=dict)

    def blame(self, place: np.ndarray, length: float, piece: int) -> None:
        """Note that chords of `piece` at `place` have to be shorter than `length`."""
        self.tight.append((float(place[0]), float(place[1]), length))
        self.blamed.add(piece)

    def add_ball(self, center: np.ndarray, radius: float, node: int = -1) -> int:
        """Return the number of a ball; a node has one at each of its images."""
        key = node, *center.tolist()
        if node >= 0 and key in self.at_nodes:
            return self.at_nodes[key]
        self.at_nodes[key] = len(self.centers)
        self.centers.append(center)
        self.radii.append(radius)
        self.members.append([])
        return len(self.centers) - 1

    def add_generator(self, place: np.ndarray, height: float, piece: int, balls: tuple[int, ...]) -> None:
        """Add a generator of `balls`, at a distance `height` from the line, or use the one that is there."""
        known = {i for ball in balls for i in self.members[ball]}
        same = [i for i in known if math.dist(self.points[i], place) < 1e-6 * height]
        i = same[0] if same else len(self.points)
        if same:
            self.heights[i] = min(self.heights[i], height)
        else:
            self.points.append(place)
            self.heights.append(height)
            self.pieces.append(piece)
        for ball in balls:
            if i not in self.members[ball]:
                self.members[ball].append(i)


def place_pairs(domain: Domain, network: Network, size: Callable[[np.ndarray], np.ndarray]) -> LinePairs:
    """Return pairs of generators for the lines of `network` in `domain`, with chords of the `size` at points (n, 2)."""
    placing, rounds = _Placing(domain, network, size), 1
    layout = placing.lay_out()
    while placing.tighten(layout):
        if rounds == _ROUNDS:
            placing.leave_out(layout)
        layout, rounds = placing.lay_out(), rounds + 1
    members = sorted((i, b) for b, ones in enumerate(layout.members) for i in ones)
    counts = np.bincount([i for i, _ in members], minlength=len(layout.points))
    return LinePairs(
        domain.wrap(np.reshape(layout.points, (-1, 2))),
        np.reshape(layout.centers, (-1, 2)),
        _CLEAR * np.array(layout.radii),
        starts_of(counts, np.int32),
        np.array([b for _, b in members], np.int32),
        np.reshape(placing.dropped, (-1, 2)),
        np.reshape(layout.chords, (-1, 2, 2)),
        np.array(layout.sizes),
        n_sized=len(layout.points),
    )


class _Placing:
    """Places pairs; lengths of chords shrink where they have no room, until all have it."""

    def __init__(self, domain: Domain, network: Network, size: Callable[[np.ndarray], np.ndarray]) -> None:
        self.domain, self.size = domain, lambda x: size(domain.wrap(x))
        nodes, self.pieces = _divide(network, self.size)
        self.uses: list[list[_Use]] = [[] for _ in nodes]
        for k, piece in enumerate(self.pieces):
            for end in (0, 1):
                self.uses[piece.ends[end]].append((k, end))
        self.nodes, self.walls = nodes, _wall_directions(domain, nodes)
        self.limits = np.empty((0, 3))  # places and lengths that chords near them do not exceed
        self.dropped: list[np.ndarray] = []
        self.limit_in_gaps()

    def longest(self, points: np.ndarray) -> np.ndarray:
        """Return the largest length of chords at `points` (n, 2), (n,)."""
        h = np.asarray(self.size(points), float)
        for part in np.array_split(self.limits, 1 + self.limits.size * len(points) // _MOST):
            gaps = np.hypot(points[:, None, 0] - part[:, 0], points[:, None, 1] - part[:, 1])
            h = np.minimum(h, (part[:, 2] + _GROWTH * gaps).min(axis=1, initial=np.inf))
        return h

    def limit(self, places: np.ndarray) -> None:
        """Add limits (k, 3): places and lengths. Those that follow from others are left out."""
        places = places[places[:, 2] < 0.999 * self.longest(places[:, :2])] if len(places) else places
        places = places[np.argsort(places[:, 2], kind="stable")]
        kept: list[np.ndarray] = []
        while len(places):
            first, places = places[0], places[1:]
            kept.append(first)
            gaps = np.hypot(*(places[:, :2] - first[:2]).T)
            places = places[places[:, 2] < first[2] + _GROWTH * gaps]
        self.limits = np.concatenate([self.limits, *(place[None] for place in kept)])

    def limit_in_gaps(self) -> None:
        """Limit chords where other lines are near: each needs half a cell beside it."""
        if len(self.pieces) < 2:
            return
        tree = shapely.STRtree([shapely.LineString(piece.path) for piece in self.pieces])
        least = [np.min(h) for h in self.along_pieces(self.size, [9] * len(self.pieces))[1]]
        counts = [2 + math.ceil(2 * p.length / float(h)) for p, h in zip(self.pieces, least, strict=True)]
        x, h = (np.concatenate(of) for of in self.along_pieces(self.size, counts))
        rows, others = tree.query(shapely.points(x), predicate="dwithin", distance=h / _OF_GAP)
        ends = np.array([piece.ends for piece in self.pieces])
        own = np.repeat(ends, counts, axis=0)[rows]
        apart = (own[:, :, None] != ends[others][:, None]).all(axis=(1, 2))
        gaps = shapely.distance(shapely.points(x[rows]), tree.geometries[others])
        lengths = np.maximum(_OF_GAP * gaps, 2 * _SMALLEST * h[rows])
        near = apart & (lengths < h[rows])
        self.limit(np.column_stack([x[rows], lengths])[near])

    def along_pieces(
        self, size: Callable[[np.ndarray], np.ndarray], counts: list[int]
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Return `counts` equidistant points (n, 2) of each piece, and the `size` there, evaluated at once."""
        x = [piece.at(np.linspace(0, piece.length, n)) for piece, n in zip(self.pieces, counts, strict=True)]
        return x, np.split(np.asarray(size(np.concatenate(x)), float), np.cumsum(counts)[:-1])

    def lay_out(self) -> _Layout:
        """Place stations and generators within the present limits."""
        layout = _Layout()
        h = self.longest(self.nodes).tolist() if len(self.nodes) else []
        self.corners = [self.corner(node, h[node]) for node in range(len(self.nodes))]
        least = [h.min() for h in self.along_pieces(self.longest, [17] * len(self.pieces))[1]] if self.pieces else []
        counts = [max(17, 3 * math.ceil(p.length / float(h))) for p, h in zip(self.pieces, least, strict=True)]
        sizes = self.along_pieces(self.longest, counts)[1] if self.pieces else []
        left = {k for uses in self.uses for k, _ in uses}
        places = {k: self.stations(k, h, layout) for k, h in enumerate(sizes) if k in left}
        steps: list[list[float]] = [[] for _ in self.nodes]
        for k, s in places.items():
            chords = np.hypot(*np.diff(self.pieces[k].at(s), axis=0).T)
            for end, node in enumerate(self.pieces[k].ends):
                steps[node].append(float(chords[-end]))
        radii = [
            max(_RADIUS * sum(s) / len(s), _LEAST_RADIUS * max(s)) if c is None and s else (c.radius if c else 0.0)
            for c, s in zip(self.corners, steps, strict=True)
        ]
        for k, s in places.items():
            self.lay_piece(layout, k, s, radii)
        return layout

    def corner(self, node: int, h: float) -> _Corner | None:
        """Return how chords leave a node of size `h`; None if their generators have room in any case."""
        uses, walls = self.uses[node], self.walls.get(node, [])
        if not self.is_corner(node, h):
            return None
        for k, end in uses:
            piece = self.pieces[k]
            other = piece.ends[1 - end]
            h = min(h, piece.length * (0.5 if self.is_corner(other, h) else 1.0))
        lengths = [h] * len(uses)
        radius, angles, behind = h, np.empty(0), np.empty(0)
        for _ in range(3):  # on a curved line the direction of a chord follows from its length
            angles = choose_angles([self.direction(u, s) for u, s in zip(uses, lengths, strict=True)], walls)
            radius = min(h / math.sqrt(2 * max(float(np.sin(2 * angles).mean()), 0.2)), 1.2 * h)
            foot = radius * np.cos(angles)
            behind = np.minimum(foot, np.maximum(radius * np.sin(angles), _BEHIND * radius))
            reach = foot + behind
            lengths = [min(s, self.pieces[k].length) for s, (k, _) in zip(reach.tolist(), uses, strict=True)]
        ways = [self.direction(u, s) for u, s in zip(uses, lengths, strict=True)]
        for i, (k, end) in enumerate(uses):
            # The next chords fit to the circle between them and the first ones, those beyond fit between the lines.
            width = math.hypot(behind[i], radius * math.sin(angles[i])) / _RADIUS
            wedge = min((_between(ways[i], way) for j, way in enumerate(ways) if j != i), default=math.pi)
            opening = 2 * _OF_GAP * math.sin(wedge / 2)
            far = max(min(self.pieces[k].length, h / opening), lengths[i])
            r = np.geomspace(lengths[i], far, 2 + math.ceil(4 * math.log(far / lengths[i])))
            most = np.where(r < 1.4 * lengths[i], width, opening * r)
            places = self.pieces[k].at(np.abs(end * self.pieces[k].length - r))
            self.limit(np.column_stack([places, most]))
        return _Corner(radius, dict(zip(uses, angles.tolist(), strict=True)), dict(zip(uses, lengths, strict=True)))

    def is_corner(self, node: int, h: float) -> bool:
        """Return whether the chords at a node need angles of their own."""
        uses, walls = self.uses[node], self.walls.get(node, [])
        directions = [self.direction(use, h) for use in uses]
        if walls and len(uses) == 1:
            return min(_between(directions[0], wall) for wall in walls) < _UPRIGHT
        if len(uses) == 2 and not walls:
            return _between(*directions) < math.pi - _BEND
        return len(uses) > 1

    def direction(self, use: _Use, length: float) -> float:
        """Return the direction of the chord of this length from an end of a piece."""
        piece, end = self.pieces[use[0]], use[1]
        s = min(length, piece.length)
        way = piece.at(np.array([piece.length - s if end else s]))[0] - piece.path[-end]
        return math.atan2(way[1], way[0])

    def stations(self, k: int, h: np.ndarray, layout: _Layout) -> np.ndarray:
        """Return the lengths along piece `k` at which its chords end; `h` are the longest at equidistant points."""
        piece = self.pieces[k]
        length = piece.length
        first, last = (self.corners[node] for node in piece.ends)
        begin = 0.0 if first is None else first.lengths[k, 0]
        end = length - (0.0 if last is None else last.lengths[k, 1])
        fine = np.linspace(0, length, len(h))
        count = np.concatenate([[0], np.cumsum(np.diff(fine) * (1 / h[1:] + 1 / h[:-1]) / 2)])
        a, b = np.interp([begin, end], fine, count)
        free = first is None and last is None
        if free or (end > begin and b - a >= _JOINED):
            inner = np.interp(np.linspace(a, b, max(1, round(b - a)) + 1), count, fine)
            return np.unique(np.concatenate([[0.0], [begin], inner[1:-1], [end], [length]]))
        if first is None or last is None:
            return np.array([0.0, length])
        # The station between two corners is equally far from the generators of both chords.
        (ra, fa), (rb, fb) = (first.radius, first.angles[k, 0]), (last.radius, last.angles[k, 1])
        xa, ya, xb, yb = ra * math.cos(fa), ra * math.sin(fa), rb * math.cos(fb), rb * math.sin(fb)
        room = length - xa - xb
        t = ((length - xb) ** 2 + yb**2 - xa**2 - ya**2) / (2 * room) if room > 0 else -1.0
        if room < 0.2 * min(ra, rb) or not 0.15 * length < t < 0.85 * length:
            layout.blame(piece.at(np.array([length / 2]))[0], 0.4 * length, k)
            t = length / 2
        return np.array([0.0, t, length])

    def lay_piece(self, layout: _Layout, k: int, places: np.ndarray, at_nodes: list[float]) -> None:
        """Place balls and generators along piece `k`."""
        piece = self.pieces[k]
        x, m = piece.at(places), len(places) - 1
        x[0], x[-1] = piece.path[0], piece.path[-1]
        along = np.diff(x, axis=0)
        steps = np.hypot(*along.T)
        along /= steps[:, None]
        radii = np.empty(m + 1)
        pairs = np.maximum(_RADIUS * (steps[1:] + steps[:-1]) / 2, _LEAST_RADIUS * np.maximum(steps[1:], steps[:-1]))
        radii[0], radii[1:-1], radii[-1] = at_nodes[piece.ends[0]], pairs, at_nodes[piece.ends[1]]
        first, last = (self.corners[node] for node in piece.ends)
        given = np.full((m, 2), np.nan)  # foot and height where a corner gives them
        if last is not None:
            f = last.angles[k, 1]
            given[-1] = steps[-1] - last.radius * math.cos(f), last.radius * math.sin(f)
            radii[-2] = math.hypot(*given[-1])
        if first is not None:
            f = first.angles[k, 0]
            given[0] = first.radius * math.cos(f), first.radius * math.sin(f)
            radii[1] = math.hypot(steps[0] - given[0, 0], given[0, 1])
            radii[0] = first.radius
        foot = (steps**2 + radii[:-1] ** 2 - radii[1:] ** 2) / (2 * steps)
        height = np.sqrt(np.maximum(radii[:-1] ** 2 - foot**2, 0))
        own = np.isfinite(given[:, 0])
        foot[own], height[own] = given[own].T
        flat = (~own & (height < 0.2 * steps)) | (foot < -0.2 * steps) | (foot > 1.2 * steps)
        for c in np.flatnonzero(flat).tolist():
            middle = (x[c] + x[c + 1]) / 2
            layout.blame(middle, _TIGHTER * min(float(steps[c]), float(self.longest(middle[None])[0])), k)
        height = np.maximum(height, 1e-3 * steps)
        nodes = [piece.ends[0], *[-1] * (m - 1), piece.ends[1]]
        balls = [layout.add_ball(x[c], float(radii[c]), nodes[c]) for c in range(m + 1)]
        normals = np.column_stack([-along[:, 1], along[:, 0]])
        middles = x[:-1] + foot[:, None] * along
        for c in range(m):
            layout.chords.append(x[c : c + 2])
            layout.sizes.append(math.sqrt(2 * height[c] * steps[c]))
            for side in (height[c], -height[c]):
                place = middles[c] + side * normals[c]
                layout.add_generator(place, float(height[c]), k, (balls[c], balls[c + 1]))
        for end, way in ((0, -along[0]), (-1, along[-1])):
            node, radius = piece.ends[end], layout.radii[balls[end]]
            place = x[end] + radius * way
            if len(self.uses[node]) > 1 or node in self.walls or not self.has_room(place, radius):
                continue
            # A face ends where the line does: one more generator is as far from its end as those beside it.
            layout.add_generator(place, radius, k, (balls[end],))

    def has_room(self, place: np.ndarray, radius: float) -> bool:
        """Return whether a generator at `place` is inside the domain and not at its wall."""
        x = place[None]
        return bool(self.domain.contains(x)[0] and self.domain.boundary_distance(x)[0] > _DEPTH * radius)

    def tighten(self, layout: _Layout) -> bool:
        """Limit the lengths of chords where they have no room; return whether there are such places."""
        if layout.points:
            self.blame_crowded(layout)
        if not layout.tight:
            return False
        tight = np.array(layout.tight)
        h = _SMALLEST * np.asarray(self.size(tight[:, :2]), float)
        if (tight[:, 2] < h).any():
            self.leave_out(layout, tight[tight[:, 2] < h, :2])
        tight[:, 2] = np.maximum(tight[:, 2], h)
        self.limit(tight)
        return True

    def blame_crowded(self, layout: _Layout) -> None:
        """Blame generators outside of the domain or at its walls, in balls of others, and near each other."""
        domain, points, heights = self.domain, np.array(layout.points), np.array(layout.heights)
        inside = domain.contains(points)
        depth = domain.boundary_distance(points)
        for i in np.flatnonzero(~inside | (depth < _DEPTH * heights)).tolist():
            self.blame_at(layout, points[i], i)
        period = np.where(domain.periodic, domain.extent, 0.0)
        tree = scipy.spatial.KDTree(domain.wrap(points) - domain.lower, boxsize=period)
        centers = domain.wrap(np.array(layout.centers)) - domain.lower
        for b, inner in enumerate(tree.query_ball_point(centers, np.array(layout.radii) * (1 - 1e-7))):
            for i in set(inner).difference(layout.members[b]):
                self.blame_at(layout, points[i], i)
                self.blame_at(layout, layout.centers[b], i)
        near = tree.query_pairs(2 * _ROOM * float(heights.max()), output_type="ndarray")
        apart = points[near[:, 0]] - points[near[:, 1]]
        apart -= period * np.rint(apart / np.where(period > 0, period, np.inf))
        close = np.hypot(*apart.T) < _ROOM * heights[near].sum(axis=1)
        for i, j in near[close].tolist():
            if not any(i in ones and j in ones for ones in layout.members):
                self.blame_at(layout, points[i], i)
                self.blame_at(layout, points[j], j)

    def blame_at(self, layout: _Layout, place: np.ndarray, generator: int) -> None:
        layout.blame(place, _TIGHTER * float(self.longest(place[None])[0]), layout.pieces[generator])

    def leave_out(self, layout: _Layout, places: np.ndarray | None = None) -> None:
        """Leave out the pieces that have no room."""
        gone = layout.blamed
        self.dropped += [np.array(layout.tight)[:1, :2] if places is None else places[:1]]
        self.uses = [[use for use in uses if use[0] not in gone] for uses in self.uses]


def _between(a: float, b: float) -> float:
    """Return the angle between two directions, from 0 to pi."""
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


def _divide(network: Network, size: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, list[_Piece]]:
    """Divide chains at their corners; return the nodes (n, 2), at which pieces end, and the pieces."""
    nodes, pieces = list(network.nodes), []
    for chain, (begin, end) in zip(network.chains, network.ends.tolist(), strict=True):
        if begin == end and len(chain) == 2:  # straight from one periodic side to the other
            chain = np.insert(chain, 1, chain.mean(axis=0), axis=0)
        along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(chain, axis=0).T))])
        h = np.asarray(size(chain), float)
        cuts = [0, *_corners_of(chain, along, h).tolist(), len(chain) - 1]
        if begin == end and len(cuts) == 2:
            # A ring has two pieces at least, so that both ends of each differ.
            cuts.insert(1, int(np.clip(np.searchsorted(along, along[-1] / 2), 1, len(chain) - 2)))
        inner = range(len(nodes), len(nodes) + len(cuts) - 2)
        nodes += list(chain[cuts[1:-1]])
        numbers = [begin, *inner, end]
        for a, b, i, j in zip(cuts[:-1], cuts[1:], numbers[:-1], numbers[1:], strict=True):
            pieces.append(_Piece(chain[a : b + 1], along[a : b + 1] - along[a], (i, j)))
    return np.reshape(nodes, (-1, 2)), pieces


def _corners_of(chain: np.ndarray, along: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the inner vertices that divide a chain: between segments longer than h / 2, and at sharp bends."""
    if len(chain) < 3:
        return np.empty(0, int)
    s, reach = along[1:-1], _REACH * h[1:-1]

    def at(places: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(places, along, x) for x in chain.T])

    def turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        (ax, ay), (bx, by) = (chain[1:-1] - before).T, (after - chain[1:-1]).T
        return np.abs(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))

    steps = np.diff(along)
    long = (np.minimum(steps[:-1], steps[1:]) >= _LONG * h[1:-1]) & (turn(chain[:-2], chain[2:]) > _STRAIGHT)
    bend = turn(at(s - reach), at(s + reach))
    chosen = np.flatnonzero(long | (bend > _BEND))
    kept: list[int] = []
    for i in chosen[np.argsort(-bend[chosen] - 10.0 * long[chosen], kind="stable")].tolist():
        if all(abs(s[i] - s[j]) >= reach[i] for j in kept):
            kept.append(i)
    return np.sort(np.array(kept, int)) + 1


def _wall_directions(domain: Domain, nodes: np.ndarray) -> dict[int, list[float]]:
    """Return the directions of the walls that leave each node on a wall."""
    if not len(nodes) or all(domain.periodic):
        return {}
    near = 1e-6 * float(domain.extent.max())
    found: dict[int, list[float]] = {}
    for node in np.flatnonzero(domain.boundary_distance(nodes) < near).tolist():
        walls = shapely.Point(nodes[node]).buffer(10 * near).boundary.intersection(wall_lines(domain))
        ways = shapely.get_coordinates(walls) - nodes[node]
        found[node] = np.arctan2(ways[:, 1], ways[:, 0]).tolist()
    return found


def choose_angles(
    chords: list[float], walls: list[float], separation: float = _SEPARATION, least: float = _ANGLES[0]
) -> np.ndarray:
    """Return for chords in the given directions around a node the angle between each and its generators, (k,).

    They are as close to 45 degrees as may be. Two neighboring chords share a generator, whose angles to both are equal
    parts of those chords, or their generators are apart by at least `separation`. Beside walls there is room for one.
    Angles are at least `least`, if that is possible.
    """
    k = len(chords)
    order = np.argsort(chords, kind="stable")
    best, angles = math.inf, np.full(k, math.radians(45))
    sectors = []
    for a, b in zip(order.tolist(), np.roll(order, -1).tolist(), strict=True):
        width = (chords[b] - chords[a]) % (2 * math.pi) or 2 * math.pi
        if not any((wall - chords[a]) % (2 * math.pi) < width for wall in walls):
            sectors.append((a, b, width))
    most = np.full(k, _ANGLES[1])
    for wall in walls:
        for i, chord in enumerate(chords):
            most[i] = min(most[i], _AT_WALL * _between(chord, wall))
    for system in _systems(sectors, k, separation):
        rows, right = system
        # The nearest to 45 degrees: x = 45 + A^T (A A^T)^+ (b - A 45).
        start = np.minimum(np.full(k, math.radians(45)), most)
        x = start + (np.linalg.pinv(rows) @ (right - rows @ start) if len(rows) else 0)
        misfit = np.abs(rows @ x - right).sum() if len(rows) else 0.0
        for a, b, width in sectors:
            shared = any(row[a] and row[b] and abs(r - width) < 1e-12 for row, r in zip(rows, right, strict=True))
            if not shared:
                misfit += max(0.0, x[a] + x[b] - max(width - separation, 0) - 1e-9)
        misfit += np.maximum(least - x, 0).sum() + np.maximum(x - most - 1e-9, 0).sum()
        cost = float(((x - math.radians(45)) ** 2).sum()) + 1e3 * float(misfit)
        if cost < best:
            best, angles = cost, x
    return np.clip(angles, *_ANGLES)


def _systems(
    sectors: list[tuple[int, int, float]], k: int, separation: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield linear systems for the angles of `k` chords.

    In each sector is a shared generator, or two at the least angle between them, or two farther apart.
    """
    choices = []
    for a, b, width in sectors:
        row = np.zeros(k)
        row[a] += 1
        row[b] += 1
        options: list[tuple[np.ndarray, float] | None] = [None]
        if width < math.pi and a != b:
            options = [(row, width), *([(row, width - separation)] if width > separation else []), None]
        choices.append(options)
    if len(sectors) > 6:
        choices = [options[:1] for options in choices]
    for chosen in product(*choices):
        own = [c for c in chosen if c is not None]
        yield np.array([row for row, _ in own]).reshape(-1, k), np.array([right for _, right in own])
