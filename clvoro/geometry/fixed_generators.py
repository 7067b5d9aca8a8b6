"""Generators that do not move, so that faces lie on lines or end in corners and creases.

Balls around lines and creases keep the others away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ..connectivity import rows_and_places
from .rings import WALL_CORNER, OrientedRings

if TYPE_CHECKING:
    from .domain import Domain
    from .polygon import Polygon

_LONG_SIDE, _MOST_BEND = 1.5, np.radians(20)
"""Length over h of both walls of a corner around which generators are fixed, and how much they may turn there."""
_DEPTH, _SPACING = 0.4, 0.8
"""Least distances over h of these generators from walls, and from those of another corner."""


@dataclass(frozen=True)
class FixedGenerators:
    """Fixed generators around places to which they are nearest, wherever all others are.

    Each place is the center of a ball; the generators that are to meet there are on its sphere or within. Others stay
    outside. So two neighboring places belong to the cells of the generators of both, with all that is between them.
    """

    points: np.ndarray
    """(n, d) float64."""
    centers: np.ndarray
    radii: np.ndarray
    """`centers`, `radii`: (b, d) and (b,) float64. Balls without other generators."""
    ball_starts: np.ndarray
    balls: np.ndarray
    """`ball_starts`, `balls`: (n + 1,) and (k,) int32. The balls of generator i are
    ``balls[ball_starts[i]:ball_starts[i + 1]]``."""
    left_out: np.ndarray
    """(k, d) float64. Places on lines or creases without room for generators."""
    n_sized: int = field(default=0, kw_only=True)
    """How many of the last generators have cells that keep their size, as their target size."""

    least_cells = 0
    """Least number of cells of a mesh for each of them."""

    def __len__(self) -> int:
        return len(self.points)

    def with_others(self, others: FixedGenerators | None, room: Callable[[np.ndarray], np.ndarray]) -> FixedGenerators:
        """Return these generators, and those of `others` that are farther than room(points) from all of these."""
        if others is None or not len(others):
            return self
        away = scipy.spatial.KDTree(self.points).query(others.points)[0]
        kept = np.flatnonzero(away > room(others.points))
        lists = [others.balls[others.ball_starts[k] : others.ball_starts[k + 1]] for k in kept.tolist()]
        ends = self.ball_starts[-1] + np.cumsum([len(balls) for balls in lists])
        return FixedGenerators(
            np.concatenate([self.points, others.points[kept]]),
            np.concatenate([self.centers, others.centers]),
            np.concatenate([self.radii, others.radii]),
            np.concatenate([self.ball_starts, ends]).astype(np.int32),
            np.concatenate([self.balls, *(balls + len(self.centers) for balls in lists)]).astype(np.int32),
            np.concatenate([self.left_out, others.left_out]),
            n_sized=int((kept >= len(others) - others.n_sized).sum()),
        )


@dataclass(frozen=True)
class CornerStations(FixedGenerators):
    """Fixed generators around re-entrant corners with long sides, at one distance, so that their faces end there.

    There are no balls around these corners.
    """

    least_cells = 3


def place_around_corners(
    domain: Polygon, size: Callable[[np.ndarray], np.ndarray], free: Domain, fixed: np.ndarray
) -> CornerStations:
    """Return generators around the re-entrant corners of `domain` that have room for cells of the sizes `size`.

    Around a corner of 270 degrees three stand in the middle of three equal sectors, around others as many as it has
    right angles. The outer ones see one wall each; all have the size h. Corners between walls that are straight over
    less than `_LONG_SIDE`, near layers, other stations, other walls or `fixed` generators (m, 2) have none.
    """
    rings = domain.oriented
    h, angle = np.asarray(size(rings.vertices), float), np.pi - rings.turns
    sharp = rings.turns < -WALL_CORNER
    sharp[sharp] = _have_straight_sides(rings, np.flatnonzero(sharp), _LONG_SIDE * h[sharp])
    corners = np.flatnonzero(sharp)
    count = np.maximum(np.rint(angle[corners] / (np.pi / 2)).astype(int), 2)
    sector = angle[corners] / count
    corner, place = rows_and_places(count)
    way = np.arctan2(*rings.along[corners].T[::-1])[corner] + sector[corner] * (place + 0.5)
    size_at = h[corners][corner]
    reach = size_at / (2 * np.sin(sector / 2))[corner]
    points = rings.vertices[corners][corner] + reach[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    good = domain.contains(points) & free.contains(points)
    good[good] = domain.boundary_distance(points[good]) >= _DEPTH * size_at[good]
    good[good] = free.boundary_distance(points[good]) >= _DEPTH * size_at[good]
    if len(fixed) and len(points):
        good &= scipy.spatial.KDTree(fixed).query(points)[0] >= size_at
    left = np.bincount(corner, ~good, len(corners)) == 0
    pairs = scipy.spatial.KDTree(points).query_pairs(float(size_at.max(initial=0)), output_type="ndarray")
    one, two = corner[pairs].T
    gap = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    near = (one != two) & (gap < _SPACING * size_at[pairs].max(axis=1))
    for a, b in zip(one[near].tolist(), two[near].tolist(), strict=True):
        if left[a] and left[b]:
            left[max(a, b)] = False
    points = points[left[corner]]
    no_balls = np.empty((0, 2)), np.empty(0), np.zeros(len(points) + 1, np.int32), np.empty(0, np.int32)
    return CornerStations(points, *no_balls, left_out=np.empty((0, 2)))


def _have_straight_sides(rings: OrientedRings, corners: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Return whether both walls of `corners` (c,) turn by at most `_MOST_BEND` up to `length` (c,), (c,) bool."""
    straight = np.ones(len(corners), bool)
    before = rings.before
    walls = (before, rings.lengths[before]), (rings.next_vertex, rings.lengths)
    for row, corner in enumerate(corners.tolist()):
        for step, lengths in walls:
            vertex, passed, bend = corner, float(lengths[corner]), 0.0
            while straight[row] and passed < length[row]:
                vertex = step[vertex]
                passed += lengths[vertex]
                bend += abs(rings.turns[vertex])
                straight[row] = bend <= _MOST_BEND
    return straight
