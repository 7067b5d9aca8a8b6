"""Faces that end in the re-entrant corners of polygonal domains (`corners.cl`).

A cell that contains a re-entrant corner of the boundary in the middle of its side is concave. The face between two
generators ends in the corner if both have the same distance from it and no other generator is nearer. After each step
the generators that share a corner move to their mean distance from it, and nearer ones move away.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy

from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..geometry.rings import OrientedRings
from ..geometry.tips import WIDEST, find_tips
from ..mesh.straightening import cross
from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation
from .motion import Moving
from .tuning import (
    BEND_REACH,
    CANDIDATE_REACH,
    FAN,
    FARTHEST_REACH,
    GROUP_REACH,
    JOINED,
    LEAST_SPACING,
    LEAST_TURN,
    POCKET_SPACING,
    POCKETS,
    SHARP_REACH,
    SHARP_TURN,
    SPACING,
    WALL_REACH,
)

GROUP = 4
"""Work-items per work-group. There are few work-items, and each does much."""
MOST_IN_GROUP, MOST_MOVED = 8, 48
"""Corners of a group, and generators that it moves at once."""


@dataclass(frozen=True)
class CornerGroups:
    """The re-entrant corners of a polygon that matter for cells of size h, in groups that may share generators.

    Attributes
    ----------
    vertices : (c,) int
        Vertices in `Polygon.oriented`, group by group.
    starts : (g + 1,) int32
        Group i has the corners ``starts[i]`` to ``starts[i + 1]``.
    directions : (c,) float
        Angle from the x axis to the wall that begins in the corner.
    angles : (c,) float
        Interior angle, in radians.
    slack : (c,) float
        Extent of the vertices around the corner that count as a part of it.
    sizes : (c,) float
        h at the corner.
    other_starts, others : (g + 1,), (k,) int32
        Corners of other groups near each group.
    wall_corners : (edges, 2) int32
        The nearest corner behind the begin and beyond the end of each edge, along the boundary; -1 for none.
    """

    vertices: np.ndarray
    starts: np.ndarray
    directions: np.ndarray
    angles: np.ndarray
    slack: np.ndarray
    sizes: np.ndarray
    other_starts: np.ndarray
    others: np.ndarray
    wall_corners: np.ndarray

    def __len__(self) -> int:
        return len(self.starts) - 1


def find_corners(
    domain: Polygon, h: np.ndarray, free: Polygon | None = None, without: np.ndarray | None = None
) -> CornerGroups:
    """Return the re-entrant corners of `domain` that matter for cells of size `h` (k,) at its vertices.

    Corners that are not on the boundary of `free`, the part of the domain without layers, are left out, and those
    `without`, around which fixed generators stand. Of corners that are too near to each other (`SPACING`,
    `POCKET_SPACING`) the sharper one is kept.
    """
    oriented = domain.oriented
    x, turns = oriented.vertices, oriented.turns
    turned, bend = np.empty(len(x)), np.empty(len(x))
    for a, b in pairwise(oriented.ring_starts.tolist()):
        turned[a:b] = _turned(x[a:b], turns[a:b], SHARP_REACH * h[a:b])
        bend[a:b] = _bend(x[a:b], turned[a:b], BEND_REACH * h[a:b])
    sharp = np.flatnonzero((turned < -SHARP_TURN) & (turns < 0) & (bend > LEAST_TURN))
    sharp = sharp[_is_free(domain, free, x[sharp])]
    # The sharpest first: `_spaced` leaves out vertices that are too close to an earlier one.
    order = sharp[np.lexsort((sharp, turns[sharp].round(9), -bend[sharp].round(9)))]
    kept = np.sort(_spaced(oriented, bend, h, order))
    kept = kept if without is None else np.setdiff1d(kept, without)
    directions, angles, slack = _walls(domain, kept, h)
    tips, *shape = find_tips(domain, h, kept)
    bare = _is_free(domain, free, x[tips])
    tips, shape = tips[bare], [values[bare] for values in shape]
    kept = np.concatenate([tips, kept])  # in each group the tips come first
    directions, angles = (np.concatenate(pair) for pair in zip(shape[:2], (directions, angles), strict=True))
    slack = np.concatenate([np.zeros(len(tips)), slack])
    size = np.concatenate([shape[2], h[kept[len(tips) :]]])
    groups = _grouped(x[kept], size)
    sizes = [len(g) for g in groups]
    order = np.concatenate([np.empty(0, int), *groups]).astype(int)
    starts = np.cumsum([0, *sizes]).astype(np.int32)
    vertices = kept[order]
    other_starts, others = _others(x[vertices], size[order], starts)
    return CornerGroups(
        vertices,
        starts,
        directions[order],
        angles[order],
        slack[order],
        size[order],
        other_starts,
        others,
        _wall_corners(domain, vertices, WALL_REACH * h),
    )


def _is_free(domain: Polygon, free: Polygon | None, points: np.ndarray) -> np.ndarray:
    """Return whether `points` (n, 2) on the boundary of the domain are on that of its part without layers, too."""
    if free is None or free is domain or not len(points):
        return np.ones(len(points), bool)
    edge = free.nearest_edge(points)[1]
    return np.hypot(*(edge - points).T) < 1e-6 * float(domain.extent.max())


def _lengths(ring: np.ndarray) -> np.ndarray:
    """Return the positions along a ring (k, 2) of its vertices, and its length, (k + 1,)."""
    return np.concatenate([[0], np.cumsum(np.hypot(*(np.roll(ring, -1, axis=0) - ring).T))])


def _turned(ring: np.ndarray, turns: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the sums of `turns` over the vertices within `reach` along the ring, (k,)."""
    s = _lengths(ring)
    length, k = s[-1], len(ring)
    reach = np.minimum(reach, 0.1 * length)
    three = np.concatenate([s[:-1] - length, s[:-1], s[:-1] + length])
    total = np.concatenate([[0], np.cumsum(np.tile(turns, 3))])
    middle = three[k : 2 * k]
    return (
        total[np.searchsorted(three, middle + reach, side="right")]
        - total[np.searchsorted(three, middle - reach, side="left")]
    )


def _bend(ring: np.ndarray, turned: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the interior angle minus pi between the points at `reach` along the ring on both sides, (k,)."""
    s = _lengths(ring)
    reach = np.minimum(reach, 0.3 * s[-1])
    closed = np.concatenate([ring, ring[:1]])
    ways = []
    for way in (1, -1):
        place = (s[:-1] + way * reach) % s[-1]
        ends = np.column_stack([np.interp(place, s, closed[:, axis]) for axis in (0, 1)])
        ways.append(np.arctan2(*(ends - ring).T[::-1]))
    angle = (ways[1] - ways[0]) % (2 * np.pi)
    # Both walls of a thin hole may cross by round-off, or by the extent of its tip.
    return np.where((angle < np.pi / 2) & (turned < -np.pi / 3), 2 * np.pi, angle) - np.pi


def _spaced(rings: OrientedRings, bend: np.ndarray, h: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return those of the vertices `order` that are far enough from all earlier ones that are kept.

    Only around those that are kept others are searched: on a fine coast most are not.
    """
    if not len(order):
        return order
    x, bend, h = rings.vertices[order], bend[order], h[order]
    pockets = _Pockets(rings)
    tree, kept = scipy.spatial.KDTree(x), np.ones(len(order), bool)
    for k in range(len(order)):
        if not kept[k]:
            continue
        near = np.array(tree.query_ball_point(x[k], SPACING * h[k]))
        near = near[near > k]
        size = np.minimum(h[near], h[k])
        gap = np.hypot(*(x[near] - x[k]).T) / size
        near, size, gap = near[gap < SPACING], size[gap < SPACING], gap[gap < SPACING]
        fan = SPACING - FAN * (bend[near] + bend[k]) / 2
        area = pockets.areas(order[k], order[near]) / size**2
        pocket = (area > POCKETS[0]) & (area < POCKETS[1])
        least = np.maximum(fan, np.where(pocket, POCKET_SPACING, LEAST_SPACING))
        kept[near[gap < least]] = False
    return order[kept]


class _Pockets:
    """Areas between the boundary and the segment from one of its vertices to another."""

    def __init__(self, rings: OrientedRings) -> None:
        first = rings.ring_starts[:-1]
        self._ring = np.repeat(np.arange(len(first)), np.diff(rings.ring_starts))
        self._x = rings.vertices - rings.vertices[first[self._ring]]
        # Twice the areas of the triangles of all edges with the first vertex of their ring.
        sums = np.concatenate([[0], np.cumsum(cross(self._x, self._x[rings.next_vertex]))])
        self._sums = sums[:-1] - sums[first[self._ring]]
        self._whole = np.diff(sums[rings.ring_starts])

    def areas(self, v: int, others: np.ndarray) -> np.ndarray:
        """Return the areas for vertex `v` and each of `others` (k,), (k,); positive where the domain is between.

        The smaller one on both ways along the ring counts. It is infinite for vertices of other rings.
        """
        ring, x, sums = self._ring[v], self._x, self._sums
        ahead = sums[others] - sums[v] + np.where(others < v, self._whole[ring], 0)
        ahead += cross(x[others], x[None, v])
        behind = self._whole[ring] - ahead
        area = np.where(np.abs(ahead) < np.abs(behind), ahead, behind) / 2
        return np.where(self._ring[others] == ring, area, np.inf)


def _walls(domain: Polygon, corners: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return direction, interior angle and slack of each corner."""
    oriented = domain.oriented
    ring_of = np.searchsorted(oriented.ring_starts, corners, side="right") - 1
    found = np.zeros((3, len(corners)))
    chosen = set(corners.tolist())
    for row, (v, r) in enumerate(zip(corners.tolist(), ring_of.tolist(), strict=True)):
        a, b = oriented.ring_starts[r : r + 2].tolist()
        ends, slack = [], 0.0
        for way in (1, -1):
            here, left, at = oriented.vertices[v], BEND_REACH * h[v], v
            for _ in range(b - a):
                after = a + (at - a + way) % (b - a)
                step = oriented.vertices[after] - here
                length = float(np.hypot(*step))
                if length >= left or after in chosen:
                    ends.append(here + step * min(1.0, left / length))
                    break
                left -= length
                here, at = oriented.vertices[after], after
                slack = max(slack, float(np.hypot(*(here - oriented.vertices[v]))))
            else:
                ends.append(here)
        d = [np.arctan2(*(end - oriented.vertices[v])[::-1]) for end in ends]
        angle = (d[1] - d[0]) % (2 * np.pi)
        if angle < np.pi / 2:  # both walls of a thin hole
            angle = 2 * np.pi
        found[:, row] = d[0], max(angle, np.pi + 0.1), slack
    return found[0], found[1], found[2]


def _grouped(x: np.ndarray, h: np.ndarray) -> list[list[int]]:
    """Divide points into groups of at most `MOST_IN_GROUP`: join those nearer than `JOINED` h, the nearest first."""
    group: list[list[int]] = [[k] for k in range(len(x))]
    if len(x) < 2:
        return group
    pairs = scipy.spatial.KDTree(x).query_pairs(JOINED * float(h.max()), output_type="ndarray")
    gaps = np.hypot(*(x[pairs[:, 0]] - x[pairs[:, 1]]).T)
    close = gaps < JOINED * h[pairs].max(axis=1)
    pairs, gaps = pairs[close], gaps[close]
    for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0], gaps.round(12)))].tolist():
        a, b = group[i], group[j]
        if a is not b and len(a) + len(b) <= MOST_IN_GROUP:
            a += b
            for k in b:
                group[k] = a
    unique = {id(g): sorted(g) for g in group}
    return sorted(unique.values())


def _others(x: np.ndarray, h: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of other groups near each group."""
    found: list[np.ndarray] = []
    if len(x):
        near = scipy.spatial.KDTree(x).query_ball_point(x, GROUP_REACH * h)
        row = np.repeat(np.arange(len(x)), [len(rows) for rows in near])
        pair = np.concatenate([np.array(rows, int) for rows in near])
        # Each of two corners knows the other one if one of them is large enough.
        row, pair = np.concatenate([row, pair]), np.concatenate([pair, row])
        group = np.searchsorted(starts, row, side="right") - 1
        key = np.unique(group * len(x) + pair)
        group, pair = np.divmod(key, len(x))
        away = (pair < starts[group]) | (pair >= starts[group + 1])
        found = np.split(pair[away], np.searchsorted(group[away], np.arange(1, len(starts) - 1)))
    counts = [len(f) for f in found]
    return (np.cumsum([0, *counts]).astype(np.int32), np.concatenate([np.empty(0, int), *found]).astype(np.int32))


def _wall_corners(domain: Polygon, corners: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return for each edge the nearest of `corners` behind its begin and beyond its end, (k, 2) int32; -1 for none."""
    oriented = domain.oriented
    found = np.full((len(oriented.vertices), 2), -1, np.int32)
    number = np.full(len(oriented.vertices), -1)
    number[corners] = np.arange(len(corners))
    for a, b in pairwise(oriented.ring_starts.tolist()):
        own = np.flatnonzero(number[a:b] >= 0)
        if not len(own):
            continue
        s, k = _lengths(oriented.vertices[a:b]), b - a
        edges = np.arange(k)
        before = own[np.searchsorted(own, edges, side="right") - 1]
        place = np.searchsorted(own, (edges + 1) % k, side="left")
        after = own[place % len(own)]
        behind = (s[edges] - s[before]) % s[-1]
        ahead = (s[after] - s[(edges + 1) % k]) % s[-1]
        for side, (corner, gap) in enumerate(((before, behind), (after, ahead))):
            near = gap <= reach[a + corner]
            found[a:b, side][near] = number[a + corner[near]]
    return found


class PlacedCorners:
    """Corner groups on the device, in the frame of a domain."""

    def __init__(self, engine: Engine, domain: Polygon, groups: CornerGroups) -> None:
        origin, scale = domain.frame
        at = (domain.oriented.vertices[groups.vertices] - origin) / scale
        measures = (groups.directions, groups.angles, groups.sizes / scale, groups.slack / scale)
        self.count, self.groups = len(groups.vertices), len(groups)
        self.corners = engine.upload(at.ravel())
        self.shapes = engine.upload(np.column_stack(measures).ravel())
        self.starts = engine.upload(groups.starts, np.int32)
        self.other_starts = engine.upload(groups.other_starts, np.int32)
        self.others = engine.upload(np.append(groups.others, 0), np.int32)
        self.wall_corners = engine.upload(groups.wall_corners.ravel(), np.int32)
        self.nearest = engine.empty(self.count, np.int32)
        self.seeds = engine.empty(self.count, np.int32)
        self.moved = engine.empty(self.groups * MOST_MOVED, np.int32)
        self.targets = engine.empty(2 * self.groups * MOST_MOVED)


class Corners:
    """The kernels of `corners.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels(
            "adaptation/corners",
            {
                "MOST_IN_GROUP": MOST_IN_GROUP,
                "MOST_MOVED": MOST_MOVED,
                "CANDIDATE_REACH": CANDIDATE_REACH,
                "FARTHEST_REACH": FARTHEST_REACH,
                "WIDEST_TIP": float(WIDEST),
            },
        )

    def share(self, placed: PlacedCorners, free: Domain, t: Tessellation, moving: Moving) -> None:
        """Move generators so that a face ends in every corner.

        Parameters
        ----------
        free : Domain
            The part of the polygon without layers, in its frame. Generators outside it do not see the corners.
        t : Tessellation
            Diagram of the same generators before their last displacement.
        """
        engine, k, p = self.engine, self._kernels, placed
        assert t.trimmed is not None
        chords = t.trimmed.chords
        p.nearest.fill(0x7FFFFFFF)
        p.seeds.fill(0x7FFFFFFF)
        for find_cells in (False, True):
            engine.run_each(
                k.find_seeds,
                chords.touched_count,
                np.int32(find_cells),
                chords.touched,
                np.int32(t.n),
                t.starts,
                t.neighbors,
                t.points,
                p.wall_corners,
                p.corners,
                p.nearest,
                p.seeds,
            )
        engine.run_each(
            k.share_corners,
            p.groups,
            t.starts,
            t.neighbors,
            np.int32(t.n),
            moving.points,
            moving.labels,
            np.int32(moving.fixed),
            p.starts,
            p.corners,
            p.shapes,
            p.other_starts,
            p.others,
            p.seeds,
            *free.device_args(engine),
            p.moved,
            p.targets,
            group=GROUP,
        )
        engine.run_each(k.move_to_corners, p.groups * MOST_MOVED, p.moved, p.targets, moving.points, moving.velocity)
