"""Pairs of generators that are mirror images in surfaces, so that faces between them lie on the surfaces.

Each smooth patch gets a centroidal sample with a spacing of h. At each of its points a pair stands at h / 2 to both
sides, along the normal. Around the edges where patches end or meet, generators stand around chords, at one distance
from both ends, in the middle of sectors: so all their bisectors contain the chord, and those of two beside a patch
contain the patch there. The points of a patch at which three of its cells meet are centers of balls without other
generators: wherever these are, the pairs are nearest to all points of the surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy

from ...arguments import format_point
from ...connectivity import rows_and_places
from ...errors import InputError
from ..domain import Domain
from ..fixed_generators import FixedGenerators
from ..lines.pairs import choose_angles
from ..nearest_triangles import Feet, NearestTriangles
from ..solid.stations import AroundCreases, ChainOfChords, Line, share_corners
from .sheets import Sheets

_ON_WALL = 1e-7  # of the domain: points so near to its walls lie on them
_PARTS = 64  # parts of the domain's extent into which edges are divided to find where they leave it
_REACH = math.sqrt(0.5)  # distance of generators around a chord, over h
_APART, _CLOSER = math.radians(45), math.radians(35)  # least angle between two of them in one sector; without room
_HEIGHT, _LONGEST_REACH = 0.38, 1.3  # of h: their least distance from patches there, and their largest from the chord
_FROM_WALL = 0.25  # of h: distance from a wall at which the angle between it and an edge is measured
_DEPTH_AT_WALL, _LONGEST_AT_WALL = 0.4, 2.5  # least distance of generators there from the wall, longest chord, over h
_JOINED = 0.3  # of a radius: so near to its balls is the joint generator of two chains before it is fitted
_BESIDE = 0.64  # of h: generators this near to a patch, straight above it, are those of its cells
_UPRIGHT = 0.98  # cosine of the least angle there
_STRIP = 0.72  # of h: free points of the sample are farther from edges
_SAME = 0.35  # of h: feet of generators on both sides that are this near are one point of the sample
_CLOUD = 48  # points for each cell in which a sample is centroidal
_LONGEST = 1.5  # over h: longest sides of triangles in which these points are placed
_CANDIDATES = 16  # points among which each one of the first sample is chosen
_SPACINGS = 0.9, 0.84, 0.78  # over h: least distances in the first sample
_AROUND = 12  # neighbors among the points with which distances from generators are compared
_MEET = 0.2  # of h: points of the sample whose distances differ by less meet at a place
_STEPS_OF_PLACES, _MOST_STEP, _LEAST = 4, 0.15, 1e-9  # Newton's method for places: steps, longest step over h, damping
# A place moves back if its distance to generators shrinks below this share, or if it moves farther than this, over h.
_SURE, _FARTHEST = 0.98, 0.2
_MEETING = 4  # nearest points of the sample, of which those whose cells meet at a place are chosen
_STEPS = 60  # of Lloyd's method
_SETTLE, _SHARE = 40, 0.5  # in the first steps only this share of the points is taken
_OVER = 1.5  # how far it goes, over the way to the centroids
_CLEAR, _COARSE = 1.06, 0.03  # radius in which no other generators are, over that of a ball, and over h in addition
_ROOM = 0.4  # of h: least distance of generators that are no pair
# Heights of generators shrink, step by step, until a wall is this share of them away.
_AT_WALL, _SHRINKAGE, _SHRINKAGES = 0.7, 0.85, 8
_OF_GAP, _LEAST_HEIGHT = 3.0, 0.28  # gap to another patch over heights of generators, and their least height over h
_OPPOSITE = 0.8  # another patch is above or below if the way to it has a larger cosine to the normal
_DEPTH = 0.6  # of its height: least distance of a generator from walls
_STRAIGHT = 0.55  # of the height of a generator: least distance from surfaces
_ROUNDS = 40


def place_pairs(sheets: Sheets, domain: Domain, size: Callable[[np.ndarray], np.ndarray]) -> FixedGenerators:
    """Return the generators beside `sheets` in `domain`, where cells have the sizes h = size(points (n, 3)).

    Raises `InputError` if there is no room for them.
    """
    triangles = _off_walls(sheets, domain)
    around = _place_around_edges(sheets, triangles, domain, size)
    sample = _Sample(sheets, triangles, domain, size, around)
    return sample.pairs()


# Around edges.


class _Fold(ChainOfChords):
    """A chain at which patches end or meet: generators beside each of them, and in wide sectors between.

    - `edges` (m,) int: the edge of `sheets` on which each segment of `line` lies.
    """

    def __init__(
        self,
        sheets: Sheets,
        number: int,
        line: Line,
        vertices: np.ndarray,
        edges: np.ndarray,
        size: Callable[[np.ndarray], np.ndarray],
        domain: Domain,
    ) -> None:
        first, last = (_length_at_wall(line, k, size, domain) if vertices[k] < 0 else 1.0 for k in (0, -1))
        super().__init__(number, line, vertices, size, (first, last))
        row = np.clip(np.searchsorted(line.at, self.middle, side="right") - 1, 0, len(edges) - 1)
        self.turns, axes, reach = [], [], []
        corners, triangles = sheets.surface.corners, sheets.surface.triangles
        for edge, way in zip(edges[row].tolist(), self.ways, strict=True):
            items = sheets.triangles_at[sheets.triangle_starts[edge] : sheets.triangle_starts[edge + 1]]
            third = ~np.isin(triangles[items], sheets.edges[edge])
            out = corners[items][third] - sheets.surface.vertices[sheets.edges[edge, 0]]
            out -= (out @ way)[:, None] * way
            one = out[0] / np.linalg.norm(out[0])
            other = np.cross(way, one)
            axes.append((one, other))
            turns, far = _angles_of_generators(np.arctan2(out @ other, out @ one))
            self.turns.append(turns)
            reach.append(far)
        self.axes = np.array(axes).reshape(-1, 2, 3)
        self.set_radii(np.array(reach) * self.h)


def _length_at_wall(line: Line, end: int, size: Callable[[np.ndarray], np.ndarray], domain: Domain) -> float:
    """Return the length over h of the chord at an end of a line on a wall: the more the line leans, the longer."""
    h = float(np.asarray(size(line.points[[end]]))[0])
    away = min(_FROM_WALL * h, 0.5 * line.at[-1])
    x = line.along(line.points, np.array([away if end == 0 else line.at[-1] - away]))
    upright = min(float(domain.boundary_distance(x)[0]) / away, 1.0)
    sine = math.sqrt(1 - upright**2)
    return min(max(1.0, 2 * (_DEPTH_AT_WALL + sine) / max(upright, 1e-3)), _LONGEST_AT_WALL)


def _angles_of_generators(sheets: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the angles of the generators around a chord at which patches end, and their distance from it over h.

    `sheets` (m,) are the angles of the patches. The distance is larger where two of them are closer to each other.
    """
    sheets = np.sort(sheets % (2 * math.pi))
    least = math.asin(_HEIGHT / _LONGEST_REACH)
    beside = choose_angles(sheets.tolist(), [], _APART, least)
    if beside.min() < least - 1e-6:
        beside = choose_angles(sheets.tolist(), [], _CLOSER, least)
    reach = min(max(_REACH, _HEIGHT / math.sin(beside.min())), _LONGEST_REACH)
    apart = 2 * math.asin(0.5 / reach)
    found = []
    for k, (sheet, mine) in enumerate(zip(sheets, beside, strict=True)):
        after, other = sheets[(k + 1) % len(sheets)], beside[(k + 1) % len(sheets)]
        width = (after - sheet) % (2 * math.pi) or 2 * math.pi
        left = width - mine - other
        if left < 1e-6:  # both have the same generator
            found.append([sheet + width * mine / (mine + other)])
        else:
            n = max(round(left / apart), 1)
            found.append(sheet + mine + left * np.arange(n + 1) / n)
    return np.concatenate(found), reach


def _place_around_edges(
    sheets: Sheets, triangles: NearestTriangles, domain: Domain, size: Callable[[np.ndarray], np.ndarray]
) -> AroundCreases:
    """Return the generators around edges; `triangles` are those of `sheets` that do not lie on walls."""

    def depth(x: np.ndarray) -> np.ndarray:
        inside = domain.contains(x)
        return np.where(inside, np.minimum(triangles.feet(x, math.inf).distance, domain.boundary_distance(x)), -1.0)

    chains: list[ChainOfChords] = []
    for chain in np.unique(sheets.chain).tolist():
        for line, vertices, edges in _lines_inside(sheets, domain, np.flatnonzero(sheets.chain == chain)):
            fold = _Fold(sheets, len(chains), line, vertices, edges, size, domain)
            if not len(fold.h):
                place = line.points[0]
                raise InputError(
                    f"an edge of a surface inside at {format_point(place)} is {line.at[-1]:.3g} long, shorter than "
                    f"half of the size there, {float(np.asarray(size(place[None]))[0]):.3g}; use smaller sizes there, "
                    "or a larger `angle`, so that it is no edge"
                )
            chains.append(fold)
    share_corners(chains)
    placing = AroundCreases(depth)
    placing.add(chains)
    placing.join(_JOINED)
    placing.fit()
    placing.leave_out()
    if len(placing.lost):
        raise _no_room(placing.lost[0], size, "edges are too near to each other, or the angle between two is too small")
    return placing


def _inside(domain: Domain, points: np.ndarray) -> np.ndarray:
    """Return whether `points` (n, 3) are in the domain and not on its walls, (n,) bool."""
    return domain.contains(points) & (domain.boundary_distance(points) > _ON_WALL * float(domain.extent.max()))


def _off_walls(sheets: Sheets, domain: Domain) -> NearestTriangles:
    """Return the triangles that do not lie on walls."""
    surface, most = sheets.surface, _ON_WALL * float(domain.extent.max())
    on = (domain.boundary_distance(surface.vertices) <= most)[surface.triangles].all(axis=1)
    on[on] = domain.boundary_distance(surface.corners[on].mean(axis=1)) <= most
    if on.all():
        raise InputError("surfaces are on the walls of the domain, expected a part of one inside; leave them out")
    return NearestTriangles(surface, np.flatnonzero(~on))


def _no_room(place: np.ndarray, size: Callable[[np.ndarray], np.ndarray], why: str) -> InputError:
    return InputError(
        f"surfaces inside have no room at {format_point(place)} for the size there, "
        f"{float(np.asarray(size(place[None]))[0]):.3g}: {why}; use smaller sizes around it"
    )


def _lines_inside(sheets: Sheets, domain: Domain, edges: np.ndarray) -> list[tuple[Line, np.ndarray, np.ndarray]]:
    """Return the parts of a chain that are in the domain and not on its walls.

    Each is a line, its ends as vertices, negative where it ends on a wall, and the edge of each of its segments.
    """
    x = sheets.surface.vertices
    longest, inside = float(domain.extent.max()) / _PARTS, partial(_inside, domain)
    begin, end = x[sheets.edges[edges, 0]], x[sheets.edges[edges, 1]]
    counts = np.maximum(np.ceil(np.linalg.norm(end - begin, axis=1) / longest), 1).astype(int)
    row, share = rows_and_places(counts)
    share = share / counts[row]
    points = np.vstack([begin[row] + share[:, None] * (end - begin)[row], end[-1:]])
    vertex = np.append(np.where(share == 0, sheets.edges[edges[row], 0], -1), sheets.edges[edges[-1], 1])
    kept = inside(0.5 * (points[1:] + points[:-1]))
    closed = bool(vertex[0] == vertex[-1])
    if closed and not kept.all() and kept.any():  # begin where it comes in
        first = int(np.flatnonzero(kept & ~np.roll(kept, 1))[0])
        points, vertex = (np.concatenate([a[first:-1], a[:first], a[first : first + 1]]) for a in (points, vertex))
        row, kept, closed = np.roll(row, -first), np.roll(kept, -first), False
    found = []
    for run in np.split(np.arange(len(kept)), np.flatnonzero(np.diff(kept)) + 1):
        if not kept[run[0]]:
            continue
        some = points[run[0] : run[-1] + 2].copy()
        ends = vertex[[run[0], run[-1] + 1]]
        for k, inner in ((0, 1), (-1, -2)):
            there = some[[k]]
            if not inside(there)[0]:
                ends[k] = -1 - 2 * len(found) + k
                some[k] = _cut(some[inner], some[k], inside)
            elif len(run) < len(kept) and run[k] not in (0, len(kept) - 1):
                ends[k] = -1 - 2 * len(found) + k
                outer = points[run[0] - 1] if k == 0 else points[run[-1] + 2]
                cut = _cut(some[k], outer, inside)
                some = np.vstack([cut, some]) if k == 0 else np.vstack([some, cut])
        segments = edges[row[run]]
        extra = len(some) - 1 - len(segments)
        if extra:
            head = 1 if extra == 2 or np.any(some[0] != points[run[0]]) else 0
            segments = np.concatenate([segments[:1].repeat(head), segments, segments[-1:].repeat(extra - head)])
        lengths = np.linalg.norm(np.diff(some, axis=0), axis=1)
        at = np.append(0, np.cumsum(lengths))
        found.append((Line(some, some, some, some, at, closed), ends, segments))
    return found


def _cut(inner: np.ndarray, outer: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return where the way from a point inside to one outside meets the wall."""
    for _ in range(_ROUNDS):
        middle = 0.5 * (inner + outer)
        inner, outer = (middle, outer) if inside(middle[None])[0] else (inner, middle)
    return outer


# On patches.


class _Places(NamedTuple):
    """Points of patches at which cells meet.

    - `x`, `h`, `patch`: (m, 3), (m,) float and (m,) int
    - `radius` (m,) float: distance from the nearest generators at first.
    - `members`: the points of the sample whose cells meet there.
    """

    x: np.ndarray
    h: np.ndarray
    patch: np.ndarray
    radius: np.ndarray
    members: list[list[int]]


class _Sample:
    """Points on patches, and the generators above and below.

    - `q`, `h`, `patch`: (s, 3), (s,) float and (s,) int
    - `generators`: list of list of int
    """

    def __init__(
        self,
        sheets: Sheets,
        triangles: NearestTriangles,
        domain: Domain,
        size: Callable[[np.ndarray], np.ndarray],
        around: AroundCreases,
    ) -> None:
        self.sheets, self.triangles, self.domain, self.size = sheets, triangles, domain, size
        self.points, self.heights = [*around.points], [*around.sizes / 2]
        self.balls = [list(balls) for balls in around.balls]
        self.centers, self.radii = [*around.centers], [_CLEAR * r for r in around.radii]
        q, patch, self.generators = self._feet_of(around)
        self.cloud, cloud_patch = _cloud(sheets, domain, size)
        n_fixed, self.fold = len(q), len(around.points)
        if not len(self.cloud):
            raise InputError("surfaces are outside of the domain, expected a part of one inside; do units agree?")
        h = np.asarray(size(self.cloud), float)
        apart = 10 * float(domain.extent.max())  # between patches
        self.lifted = np.column_stack([self.cloud, apart * cloud_patch])
        count = sum(
            max(round(int((cloud_patch == p).sum()) / _CLOUD) - int((patch == p).sum()), 0)
            for p in range(sheets.n_patches)
        )
        # Beside edges are the cells of the generators around them only.
        foot = sheets.nearest_on_edges(self.cloud, _STRIP * h)
        there = np.flatnonzero(np.isfinite(foot[:, 0]))
        on_wall = ~_inside(domain, foot[there])
        clear = np.ones(len(self.cloud), bool)
        clear[there[~on_wall]] = False
        clear &= ~_in_balls(around, self.cloud, h)
        self.raised = _relaxed(self.lifted, h**-2, h, np.column_stack([q, apart * patch]), count, clear)
        if not len(self.raised):
            raise InputError(
                f"surfaces are smaller than the size at {format_point(self.cloud[0])}, {float(h[0]):.3g}, and no cell "
                "has room beside them, expected smaller sizes there; do h and the domain have the same unit of length?"
            )
        self.q, self.patch = self.raised[:, :3].copy(), np.rint(self.raised[:, 3] / apart).astype(int)
        feet = self._feet(self.q[n_fixed:], self.patch[n_fixed:])
        h = np.asarray(size(feet.point), float)
        self.q[n_fixed:], normals = feet.point, sheets.normals_at(feet)
        height = self._heights(feet.point, normals, h, self.patch[n_fixed:])
        for sign in (1, -1):
            self.points += [*(feet.point + sign * height[:, None] * normals)]
            self.heights += [*height]
        first = self.fold + np.arange(len(feet.point))
        self.generators += [[int(k), int(k) + len(feet.point)] for k in first]
        self.balls += [[] for _ in range(2 * len(feet.point))]
        self._check_room()
        places = self._places()
        self._center(places)
        self._add_balls(places)

    def _heights(self, q: np.ndarray, normals: np.ndarray, h: np.ndarray, patch: np.ndarray) -> np.ndarray:
        """Return h / 2, or less where a wall or another patch leaves less room, (n,)."""
        height = np.minimum(0.5 * h, np.maximum(self._gaps(q, normals, h, patch) / _OF_GAP, _LEAST_HEIGHT * h))
        for _ in range(_SHRINKAGES):
            narrow = np.zeros(len(q), bool)
            for sign in (1, -1):
                x = q + sign * height[:, None] * normals
                narrow |= ~self.domain.contains(x) | (self.domain.boundary_distance(x) < _AT_WALL * height)
            if not narrow.any():
                break
            height[narrow] *= _SHRINKAGE
        return height

    def _gaps(self, q: np.ndarray, normals: np.ndarray, h: np.ndarray, patch: np.ndarray) -> np.ndarray:
        """Return how far from points `q` (n, 3) of patches another patch above or below is, (n,), inf without one."""
        gap = np.full(len(q), math.inf)
        for other, triangles in enumerate(self.sheets.patches):
            rows = np.flatnonzero(patch != other)
            for sign in (1, -1):
                x = q[rows] + 0.5 * sign * h[rows, None] * normals[rows]
                feet = triangles.feet(x, 2 * float(h.max(initial=0)))
                way = feet.point - q[rows]
                up = sign * np.einsum("ij,ij->i", way, normals[rows])
                opposite = (feet.triangle >= 0) & (up > _OPPOSITE * np.linalg.norm(way, axis=1))
                gap[rows[opposite]] = np.minimum(gap[rows[opposite]], up[opposite])
        return gap

    def _feet(self, x: np.ndarray, patch: np.ndarray) -> Feet:
        """Return the nearest points of patches."""
        triangle, weights, point = np.zeros(len(x), int), np.zeros((len(x), 3)), np.zeros((len(x), 3))
        for p in np.unique(patch).tolist():
            rows = np.flatnonzero(patch == p)
            feet = self.sheets.patches[p].feet(x[rows], math.inf)
            triangle[rows], weights[rows], point[rows] = feet.triangle, feet.weights, feet.point
        return Feet(triangle, weights, point, np.linalg.norm(x - point, axis=1))

    def _feet_of(self, around: AroundCreases) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
        """Return the points of patches below the generators around edges, their patches, and the generators."""
        x, h = around.points, around.sizes
        q, patch, generators = [np.zeros((0, 3))], [], []
        if not len(x):
            return q[0], np.zeros(0, int), []
        for p, triangles in enumerate(self.sheets.patches):
            feet = triangles.feet(x, _BESIDE * float(h.max()))
            rows = np.flatnonzero((feet.triangle >= 0) & (feet.distance < _BESIDE * h))
            if not len(rows):
                continue
            normal = self.sheets.normals[feet.triangle[rows]]
            side = np.einsum("ij,ij->i", x[rows] - feet.point[rows], normal)
            upright = np.abs(side) > _UPRIGHT * feet.distance[rows]
            rows, side, foot = rows[upright], side[upright], feet.point[rows[upright]]
            left = np.ones(len(rows), bool)
            pairs = scipy.spatial.KDTree(foot).query_pairs(_SAME * float(h.max()), output_type="ndarray")
            gap = np.linalg.norm(foot[pairs[:, 0]] - foot[pairs[:, 1]], axis=1)
            good = (side[pairs[:, 0]] * side[pairs[:, 1]] < 0) & (gap < _SAME * h[rows[pairs[:, 0]]])
            for k in np.argsort(gap, kind="stable").tolist():
                a, b = pairs[k].tolist()
                if good[k] and left[a] and left[b]:
                    left[[a, b]] = False
                    q.append(0.5 * (foot[[a]] + foot[[b]]))
                    generators.append([int(rows[a]), int(rows[b])])
                    patch.append(p)
            for a in np.flatnonzero(left).tolist():
                q.append(foot[[a]])
                generators.append([int(rows[a])])
                patch.append(p)
        return np.concatenate(q), np.array(patch, int), generators

    def _check_room(self) -> None:
        """Raise an `InputError` if a generator is near others, other surfaces, or walls."""
        x, height = np.array(self.points), np.array(self.heights)
        wide = self.domain.contains(x)
        wide &= self.domain.boundary_distance(x) > _DEPTH * height
        if not wide.all():
            place = x[~wide][0]
            raise _no_room(place, self.size, "a wall is too near")
        close = np.flatnonzero(self.triangles.feet(x, math.inf).distance < _STRAIGHT * height)
        close = close[close >= self.fold]
        if len(close):
            raise _no_room(x[close[0]], self.size, "surfaces are too near to each other, or too curved")
        near = scipy.spatial.KDTree(x).query_pairs(2 * _ROOM * float(height.max()), output_type="ndarray")
        gap = np.linalg.norm(x[near[:, 0]] - x[near[:, 1]], axis=1)
        near = near[gap < 2 * _ROOM * height[near].min(axis=1)]
        mates = {tuple(sorted(pair)) for pair in self.generators if len(pair) == 2}
        for a, b in near.tolist():
            if (a, b) not in mates and a >= self.fold:
                raise _no_room(x[a], self.size, "surfaces are too near to each other, or too curved")

    def _places(self) -> _Places:
        """Return the points of patches where cells of a patch meet, and those that are farthest from all generators."""
        gens, count = np.array(self.points), len(self.cloud)
        radius = np.asarray(scipy.spatial.KDTree(gens).query(self.cloud)[0])
        others = scipy.spatial.KDTree(self.lifted).query(self.lifted, k=min(_AROUND, count))[1]
        farthest = radius >= radius[others.reshape(count, -1)].max(axis=1)
        h = np.asarray(self.size(self.cloud), float)
        near = scipy.spatial.KDTree(self.raised).query(self.lifted, k=min(_MEETING, len(self.q)))[1].reshape(count, -1)
        one = np.array([g[0] for g in self.generators])
        away = np.linalg.norm(gens[one[near]] - self.cloud[:, None], axis=2)
        order = np.argsort(away, axis=1, kind="stable")[:, :3]
        near, away = np.take_along_axis(near, order, axis=1), np.take_along_axis(away, order, axis=1)
        meet = away - away[:, :1] < _MEET * h[:, None]
        # Of those points where the same three cells are near, the one where they are most equally far.
        key = np.sort(near, axis=1)
        order = np.lexsort((away[:, -1] - away[:, 0], *key.T))
        new = np.ones(count, bool)
        new[1:] = (np.diff(key[order], axis=0) != 0).any(axis=1)
        rows = np.union1d(order[new][meet[order[new]].all(axis=1)], np.flatnonzero(farthest))
        x, h, near, meet = self.cloud[rows], h[rows], near[rows], meet[rows]
        members = [some[together].tolist() for some, together in zip(near, meet, strict=True)]
        return _Places(x, h, self.patch[near[:, 0]], radius[rows], members)

    def _center(self, places: _Places) -> None:
        """Move places along their patches until all generators of the cells that meet there are equally far."""
        gens, x = np.array(self.points), places.x
        rows = [
            (v, g) for v, some in enumerate(places.members) if len(some) > 2 for s in some for g in self.generators[s]
        ]
        if not rows:
            return
        v, g = np.array(rows).T
        free, start = np.unique(v), x.copy()
        for _ in range(_STEPS_OF_PLACES):
            feet = self._feet(x, places.patch)
            normals = self.sheets.normals_at(feet)
            one = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
            one /= np.linalg.norm(one, axis=1)[:, None]
            other = np.cross(normals, one)
            # |g - x|^2 = c, linearized in x and c, by least squares.
            way = (gens[g] - x[v]) / places.h[v, None]
            row = np.stack([2 * (way * one[v]).sum(axis=1), 2 * (way * other[v]).sum(axis=1), np.ones(len(v))], axis=1)
            matrix, right = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
            np.add.at(matrix, v, row[:, :, None] * row[:, None])
            np.add.at(right, v, row * (way**2).sum(axis=1)[:, None])
            step = np.linalg.solve(matrix[free] + _LEAST * np.eye(3), right[free, :, None])[:, :2, 0]
            size = np.linalg.norm(step, axis=1)
            step *= (np.minimum(size, _MOST_STEP) / np.maximum(size, 1e-300) * places.h[free])[:, None]
            moved = x[free] + step[:, :1] * one[free] + step[:, 1:] * other[free]
            x[free] = self._feet(moved, places.patch[free]).point
        lost = scipy.spatial.KDTree(gens).query(x)[0] < _SURE * places.radius
        lost |= np.linalg.norm(x - start, axis=1) > _FARTHEST * places.h
        x[lost] = start[lost]

    def _add_balls(self, places: _Places) -> None:
        """Add balls around `places`."""
        radius = np.asarray(scipy.spatial.KDTree(np.array(self.points)).query(places.x)[0])
        radii = _CLEAR * radius + np.where([len(some) > 2 for some in places.members], 0, _COARSE) * places.h
        for x, r, some in zip(places.x, radii.tolist(), places.members, strict=True):
            ball = len(self.centers)
            self.centers.append(x)
            self.radii.append(r)
            for s in some:
                for g in self.generators[s]:
                    self.balls[g].append(ball)

    def pairs(self) -> FixedGenerators:
        return FixedGenerators(
            np.array(self.points),
            np.array(self.centers).reshape(-1, 3),
            np.array(self.radii),
            np.cumsum([0, *map(len, self.balls)]).astype(np.int32),
            np.array([ball for balls in self.balls for ball in balls], np.int32),
            np.empty((0, 3)),
        )


def _in_balls(around: AroundCreases, points: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return above which `points` (n, 3) of patches the height h / 2 is in a ball around an edge, (n,) bool."""
    found = np.zeros(len(points), bool)
    if len(around.centers):
        tree, radii = scipy.spatial.KDTree(points), np.array(around.radii)
        for x, r, near in zip(around.centers, radii, tree.query_ball_point(around.centers, radii), strict=True):
            near = np.array(near, int)
            away2 = ((points[near] - x) ** 2).sum(axis=1) + 0.25 * h[near] ** 2
            found[near[away2 < r * r]] = True
    return found


def _cloud(sheets: Sheets, domain: Domain, size: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) on the patches, `_CLOUD` for each area of h^2, and their patches (n,)."""
    corners, patch = sheets.surface.corners, sheets.patch
    while True:
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        h = np.asarray(size(domain.nearest(corners.mean(axis=1))), float)
        long = np.flatnonzero(sides.max(axis=1) > _LONGEST * h)
        if not len(long):
            break
        # Triangles are halved across their longest sides.
        k = sides[long].argmax(axis=1)
        a, b, c = (corners[long, (k + j) % 3] for j in range(3))
        middle = 0.5 * (a + b)
        keep = np.ones(len(corners), bool)
        keep[long] = False
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[keep], *halves])
        patch = np.concatenate([patch[keep], patch[long], patch[long]])
        met = (corners.max(axis=1) >= domain.lower).all(axis=1) & (corners.min(axis=1) <= domain.upper).all(axis=1)
        corners, patch = corners[met], patch[met]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.cumsum(_CLOUD * area / h**2)
    k = np.arange(round(float(total[-1]))) if len(total) else np.arange(0)
    item = np.minimum(np.searchsorted(total, k + 0.5), len(total) - 1)
    s, t = np.sqrt((0.5 + 0.7548776662466927 * k) % 1), (0.5 + 0.5698402909980532 * k) % 1
    points = np.einsum("nk,nkd->nd", np.column_stack([1 - s, s * (1 - t), s * t]), corners[item])
    inside = _inside(domain, points)
    return points[inside], patch[item[inside]]


def _relaxed(
    cloud: np.ndarray, weight: np.ndarray, h: np.ndarray, fixed: np.ndarray, count: int, clear: np.ndarray
) -> np.ndarray:
    """Return a centroidal sample of a cloud of points (n, 4): `fixed` (k, 4) and after them about `count` others.

    Coordinates are those in space and one that keeps patches apart. `weight` and `h` (n,) are density and spacing.
    The others are not where the cloud is not `clear` (n,).
    """
    random = np.random.default_rng(0)
    x, k = _spread(cloud[clear], h[clear], fixed, count, random), len(fixed)
    for step in range(_STEPS if len(x) > k else 0):
        # Different points in each step: of the same ones a few would hold each other in place.
        some = random.random(len(cloud)) < (_SHARE if step < _SETTLE else 1.0)
        nearest = scipy.spatial.KDTree(x).query(cloud[some])[1]
        mass = np.bincount(nearest, weight[some], len(x))
        means = np.column_stack([np.bincount(nearest, weight[some] * c, len(x)) for c in cloud[some, :3].T])
        moves = np.flatnonzero((np.arange(len(x)) >= k) & (mass > 0))
        x[moves, :3] += _OVER * (means[moves] / mass[moves, None] - x[moves, :3])
        if step in (_SETTLE, _STEPS - 1):
            kept = clear[scipy.spatial.KDTree(cloud).query(x)[1]]
            kept[:k] = True
            x = x[kept]
    if not len(x):
        return x
    used = np.bincount(scipy.spatial.KDTree(x).query(cloud)[1], minlength=len(x)) > 0
    used[:k] = True
    return x[used]


def _spread(cloud: np.ndarray, h: np.ndarray, fixed: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return `fixed` points (k, 4) and at most `count` of a cloud, as far apart as may be in units of `h` (n,)."""
    chosen = [fixed]
    left = np.sort(random.permutation(len(cloud))[: _CANDIDATES * (count + len(fixed))])
    room = np.full(len(left), math.inf)
    if len(fixed):
        room = scipy.spatial.KDTree(fixed).query(cloud[left])[0] / h[left]
    for spacing in _SPACINGS:
        while count > 0:
            free = left[room > spacing]
            if not len(free):
                break
            # Those that come before all others within reach.
            rank = random.permutation(len(free))
            pairs = scipy.spatial.KDTree(cloud[free]).query_pairs(spacing * float(h[free].max()), output_type="ndarray")
            gap = np.linalg.norm(cloud[free[pairs[:, 0]]] - cloud[free[pairs[:, 1]]], axis=1)
            pairs = pairs[gap < spacing * np.minimum(h[free[pairs[:, 0]]], h[free[pairs[:, 1]]])]
            first = np.ones(len(free), bool)
            first[np.where(rank[pairs[:, 0]] < rank[pairs[:, 1]], pairs[:, 1], pairs[:, 0])] = False
            new = cloud[free[first][:count]]
            chosen.append(new)
            count -= len(new)
            room = np.minimum(room, scipy.spatial.KDTree(new).query(cloud[left])[0] / h[left])
    return np.concatenate(chosen)
