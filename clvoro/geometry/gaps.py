"""Gaps between the walls of a polygon, and its narrow parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ..connectivity import rows_and_places

if TYPE_CHECKING:
    from .polygon import Polygon

FACING = math.radians(135)
"""Least angle between the directions from the center of a gap to its walls: the walls of a corner of more than 45
degrees do not face each other."""
NARROW = 0.5
"""A gap is too narrow if its width is less than this times the target size. A cell from wall to wall is then more than
four times as long as wide."""
NARROW_GAP = 3.0
"""A gap beside a body thinner than a cell is too narrow if its width is less than this times the target size."""
_FAN = math.radians(7.5)  # between the directions from a corner
_PER_RADIUS = 4  # samples of an edge per radius of the balls at it
_MAX_SAMPLES = 2048  # of one edge
_TIP = 6.0  # sizes of boundary between the walls of a tip or a bay, at most
_DEAD_END, _LONGEST = (4.0, 12.0)  # sizes of boundary between the walls of a dead end: at least, and at most
_PARTS = 256  # of the domain, in which the size hardly changes
_MOST_WALL_SAMPLES = 20_000
_CLOSE = 1e-9


def find_gaps(domain: Polygon, least: float, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return chords across the gaps of a domain, from wall to wall.

    A ball of the medial axis touches the boundary at two points. For a point on the boundary it is found by shrinking a
    large ball repeatedly until it contains no other boundary point (Ma, Bae, Choi 2012). If both walls face each other,
    their distance is the width of a gap. At reentrant corners balls start in all directions between the normals of the
    two edges.

    - `least`: smallest width to resolve; it bounds the work.
    - `most`: largest width of a gap.

    Results:
    - `begin`, `end` (m, 2) float64: the points where the balls touch the boundary.
    """
    start, edge, length = domain.oriented.vertices, domain.oriented.along, domain.oriented.lengths
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / length[:, None]
    found = [_from_corners(domain, normal, most)]
    # Edges are sampled more finely at narrower gaps.
    counts = np.clip(np.ceil(length / (most / 2)), 1, _MAX_SAMPLES).astype(np.int64)
    rows = np.arange(len(counts))
    while rows.size:
        row, t = rows_and_places(counts[rows])
        row = rows[row]
        points = start[row] + ((t + 0.5) / counts[row])[:, None] * edge[row]
        begin, end, radius = _balls(domain, points, normal[row], most)
        narrowest = np.full(len(counts), math.inf)
        np.minimum.at(narrowest, row[np.isfinite(radius)], radius[np.isfinite(radius)])
        finer = np.ceil(_PER_RADIUS * length[rows] / np.maximum(narrowest[rows], least / 2))
        finer = np.minimum(finer, _MAX_SAMPLES).astype(np.int64)
        again = finer > 1.5 * counts[rows]
        done = np.isin(row, rows[~again]) & np.isfinite(radius)
        found.append((begin[done], end[done]))
        # One pass takes at most four times the samples of the pass before.
        counts[rows[again]] = np.minimum(finer[again], 4 * counts[rows[again]])
        rows = rows[again]
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]


@dataclass(frozen=True)
class NarrowPart:
    """A part of a domain that is narrow for its cells: a place (d,), the width and the target size there.

    - `share`: that of all walls which are nearer to each other than a cell, where this is known.
    - `behind`: how thick the body behind a wall of a gap is, where it is thinner than a cell.
    """

    place: np.ndarray
    width: float
    size: float
    share: float = 0.0
    behind: float = 0.0


def find_narrow_parts(
    domain: Polygon, size: Callable[[np.ndarray], np.ndarray]
) -> tuple[NarrowPart | None, NarrowPart | None]:
    """Return where the domain is narrower than half a cell, and a dead end that is narrower than a cell.

    Each is the narrowest in units of the size, or None. The tips of corners and short bays do not count for the first:
    places whose walls are connected by less than `_TIP` sizes of boundary. For the second, these are
    `_DEAD_END` sizes at least, which is a bay of depth 2, or a corner of 28 degrees.

    - `size`: takes points (n, 2) and returns target sizes (n,).
    """
    points, normals, along, h = _wall_samples(domain, size)
    begin, end, radius = _balls(domain, points, normals, 2 * h)
    rows = np.flatnonzero(np.isfinite(radius))
    if not rows.size:
        return None, None
    middle = 0.5 * (begin[rows] + end[rows])
    width, wanted = np.hypot(*(end[rows] - begin[rows]).T), size(middle)
    thin = width < wanted
    rows, middle, width, wanted = rows[thin], middle[thin], width[thin], wanted[thin]
    if not rows.size:
        return None, None
    starts = domain.oriented.ring_starts
    lengths, reached = _ring_lengths(domain)
    edge, _ = domain.nearest_edge(end[rows])
    place = domain.oriented.places[edge]
    there = reached[place] + np.hypot(*(end[rows] - domain.oriented.vertices[place]).T)
    ring = np.searchsorted(starts, place, side="right") - 1
    own = np.searchsorted(reached[starts[:-1]], along[rows], side="right") - 1
    way = np.abs(there - along[rows])
    way = np.where(ring == own, np.minimum(way, lengths[ring] - way), math.inf)

    def narrowest(chosen: np.ndarray) -> NarrowPart | None:
        if not chosen.any():
            return None
        k = np.flatnonzero(chosen)[np.argmin((width / wanted)[chosen])]
        return NarrowPart(middle[k], float(width[k]), float(wanted[k]))

    turned_back = (way > _DEAD_END * wanted) & (way < _LONGEST * wanted)
    return narrowest((width < NARROW * wanted) & (way > _TIP * wanted)), narrowest(turned_back)


def _ring_lengths(domain: Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return the length of each ring, (r,), and of the boundary before each oriented edge, all rings in turn, (k,)."""
    oriented = domain.oriented
    total = np.concatenate([[0.0], np.cumsum(oriented.lengths)])
    return np.diff(total[oriented.ring_starts]), total[:-1]


def _wall_samples(
    domain: Polygon, size: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points on the boundary (n, 2), about half a size apart, their normals, places along it, and sizes (n,)."""
    start, edge, length = domain.oriented.vertices, domain.oriented.along, domain.oriented.lengths
    # Long edges in parts, along which the size changes.
    parts = np.ceil(length / (domain.extent.max() / _PARTS)).astype(np.int64)
    row, first = rows_and_places(parts)
    first = first / parts[row]
    share = first + 0.5 / parts[row]
    counts = 2 * length[row] / parts[row] / size(start[row] + share[:, None] * edge[row])
    reached = np.concatenate([[0.0], np.cumsum(counts)])
    n = int(np.clip(np.ceil(reached[-1]), 1, _MOST_WALL_SAMPLES))
    at = (np.arange(n) + 0.5) / n * reached[-1]
    part = np.minimum(np.searchsorted(reached, at, side="right") - 1, len(row) - 1)
    t = first[part] + (at - reached[part]) / np.maximum(counts[part], 1e-300) / parts[row[part]]
    row = row[part]
    points = start[row] + t[:, None] * edge[row]
    normals = np.column_stack([-edge[row, 1], edge[row, 0]]) / length[row, None]
    return points, normals, _ring_lengths(domain)[1][row] + t * length[row], size(points)


def _from_corners(domain: Polygon, normal: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return chords from reentrant corners (more than 180 degrees inside the domain)."""
    first = normal[domain.oriented.before]
    turn = np.arctan2(first[:, 0] * normal[:, 1] - first[:, 1] * normal[:, 0], (first * normal).sum(axis=1))
    rows = np.flatnonzero(turn < -_FAN)
    counts = np.ceil(-turn[rows] / _FAN).astype(np.int64) - 1
    fan, step = rows_and_places(counts)
    row = rows[fan]
    angle = np.arctan2(first[row, 1], first[row, 0]) + turn[row] * (step + 1) / (counts + 1)[fan]
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    begin, end, radius = _balls(domain, domain.oriented.vertices[row], direction, most)
    return begin[np.isfinite(radius)], end[np.isfinite(radius)]


def _balls(
    domain: Polygon, points: np.ndarray, normal: np.ndarray, most: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the two points where balls touch the boundary, `points` and another one, and their radii.

    The radius is infinite where the walls do not face each other, or are farther apart than `most`, one number or (n,).
    """
    n = len(points)
    # The width of a gap is at least the radius of its ball times 2 sin(FACING / 2).
    radius = np.full(n, most / (2 * math.sin(FACING / 2)))
    touched = points.copy()
    met = np.zeros(n, bool)
    # First until no vertex is inside: the search for a vertex is much faster than that for an edge.
    vertices = domain.oriented.vertices
    tree, active = scipy.spatial.KDTree(vertices), np.arange(n)
    while active.size:
        center = points[active] + radius[active, None] * normal[active]
        distance, nearest = tree.query(center)
        across = vertices[nearest] - points[active]
        along = (across * normal[active]).sum(axis=1)
        inside = (distance < radius[active] * (1 - _CLOSE)) & (along > 0)
        active, across, along = active[inside], across[inside], along[inside]
        radius[active] = (across**2).sum(axis=1) / (2 * along)
        touched[active], met[active] = points[active] + across, True
    center = points + radius[:, None] * normal
    ball, edge = domain.edges_within(center, radius * (1 - _CLOSE))
    place, shrunk = _touched(domain, points[ball], normal[ball], edge)
    order = np.lexsort((shrunk, ball))
    first = order[np.unique(ball[order], return_index=True)[1]]
    first = first[np.isfinite(shrunk[first])]
    radius[ball[first]], touched[ball[first]], met[ball[first]] = shrunk[first], place[first], True
    center = points + radius[:, None] * normal
    away = touched - center
    facing = -(away * normal).sum(axis=1) <= math.cos(FACING) * np.hypot(*away.T)
    wide = np.hypot(*(touched - points).T) > most
    radius[~met | ~facing | wide] = math.inf
    return points, touched, radius


def _touched(
    domain: Polygon, points: np.ndarray, normal: np.ndarray, edge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where balls that grow from `points` along `normal` first touch oriented edges, and their radii.

    A ball of radius r touches a line at the distance d, with the unit normal m towards the point, if d + r m.n = r.
    """
    begin = domain.oriented.vertices[edge]
    way = domain.oriented.along[edge]
    length = np.hypot(*way.T)
    facing = np.column_stack([-way[:, 1], way[:, 0]]) / length[:, None]
    off = points - begin
    distance, slant = (off * facing).sum(axis=1), (normal * facing).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.abs(distance) / (1 - np.copysign(slant, distance * slant))
        center = off + radius[:, None] * normal
        share = np.clip((center * way).sum(axis=1) / length**2, 0, 1)
        across = share[:, None] * way - off
        along = (across * normal).sum(axis=1)
        radius = np.where(along > 0, (across**2).sum(axis=1) / (2 * along), math.inf)
    return points + across, radius
