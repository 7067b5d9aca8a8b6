"""Domains without what is finer than the cells."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import scipy
import shapely

from ...arguments import check_number, format_point
from ...errors import InputError, InputTypeError
from .triangles import SCALES, Parts, Triangles, divided_boundary, narrow_water, small_islands, small_land

if TYPE_CHECKING:
    from ..polygon import Polygon

LEAST_PIECE = 4.0
"""Least area over h^2 of a piece of the domain that remains."""
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
    water = pieces.chosen(pieces.area > LEAST_PIECE * pieces.h**2)
    whole = shapely.coverage_union_all(shapely.polygons(triangles.x[triangles.corners[water]]))
    places = scipy.spatial.KDTree(triangles.x)

    def ring(line: shapely.LinearRing) -> tuple[np.ndarray, np.ndarray]:
        x = shapely.get_coordinates(line)[:-1]
        point, before, after = places.query(x)[1], x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
        bend = np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0])
        straight = bend < 1e-9 * np.hypot(*before.T) * np.hypot(*after.T)
        kept = ~straight | (point < triangles.n_vertices)
        return x[kept], triangles.h[point[kept]]

    return [[ring(piece.exterior), *map(ring, piece.interiors)] for piece in shapely.get_parts(whole)]


def thinned(
    domain: Polygon, water: list[list[tuple[np.ndarray, np.ndarray]]], tolerance: float
) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of pieces of `water` with fewer vertices, and the edges of each name."""
    rings = [_Ring(domain, *ring, tolerance) for piece in water for ring in piece]
    first = np.cumsum([0] + [len(piece) for piece in water])
    rows: list[np.ndarray] = []
    pieces: list[list[np.ndarray]] = []
    for k in range(_TRIES):
        rows = [ring.kept() for ring in rings]
        thin = [ring.x[row] for ring, row in zip(rings, rows, strict=True)]
        pieces = [thin[i:j] for i, j in itertools.pairwise(first)]
        if shapely.MultiPolygon([(p[0], p[1:]) for p in pieces]).is_valid:
            break
        crossing = _crossing(thin)
        if k == _TRIES - 2 or not crossing.any():
            crossing[:] = True
        ends = np.cumsum([len(row) for row in rows])[:-1]
        for ring, row, again in zip(rings, rows, np.split(crossing, ends), strict=True):
            ring.share[again[np.searchsorted(row, np.arange(len(ring.x)), "right") - 1]] = -1
    names: dict[str, list[int]] = {}
    given = domain.boundaries.names
    named = {n for n in given if not DEFAULT_NAME.fullmatch(n) or n in (domain.names or ())}
    parts = np.concatenate([ring.part[row] for ring, row in zip(rings, rows, strict=True)])
    for edge, part in enumerate(parts.tolist()):
        if given[part] in named:
            names.setdefault(given[part], []).append(edge)
    return pieces, names


def _crossing(rings: list[np.ndarray]) -> np.ndarray:
    """Return which edges of all rings, (k,) bool, touch an edge that does not follow or precede them."""
    ends = np.concatenate([np.stack([x, np.roll(x, -1, axis=0)], axis=1) for x in rings])
    ring = np.repeat(np.arange(len(rings)), [len(x) for x in rings])
    after = np.arange(1, len(ends) + 1)
    last = np.flatnonzero(np.diff(ring, append=-1))
    after[last] = np.append(0, last[:-1] + 1)
    lines = np.asarray(shapely.linestrings(ends))
    a, b = shapely.STRtree(lines).query(lines, predicate="intersects")
    found = np.zeros(len(ends), bool)
    found[a[(a != b) & (after[a] != b) & (after[b] != a)]] = True
    return found


class _Ring:
    """One ring (k, 2). Vertices have a size, and a tolerance as a share of it; edges have a named part."""

    def __init__(self, domain: Polygon, x: np.ndarray, h: np.ndarray, tolerance: float) -> None:
        self.x, self.h, self.share = x, h, np.full(len(x), tolerance or -1.0)
        edges, _ = domain.nearest_edge((x + np.roll(x, -1, axis=0)) / 2)
        self.part = domain.boundaries.index[edges]

    def kept(self) -> np.ndarray:
        """Return the vertices, ascending, from whose polyline all others are at most `share` times the size away."""
        k = len(self.x)
        ends = np.flatnonzero(self.part != np.roll(self.part, 1))
        if len(ends) < 2:
            # A vertex of the convex hull, and the one that is farthest from it.
            center = self.x.mean(axis=0)
            first = int(ends[0]) if len(ends) else int(np.argmax(np.hypot(*(self.x - center).T)))
            far = int(np.argmax(np.hypot(*(self.x - self.x[first]).T)))
            ends = np.unique([first, far])
        ends = np.union1d(ends, np.flatnonzero(self.share < 0))
        rows = np.setdiff1d(np.arange(ends[0], ends[0] + k), ends)
        ends = np.append(ends, ends[0] + k)
        while len(rows):  # between kept vertices that are too far from each other
            part = np.searchsorted(ends, rows)
            begin = self.x[ends[part - 1] % k]
            along, way = self.x[ends[part] % k] - begin, self.x[rows % k] - begin
            square = np.maximum((along**2).sum(axis=1), 1e-300)
            t = np.clip((way * along).sum(axis=1) / square, 0, 1)
            off = np.hypot(*(way - t[:, None] * along).T) / self.h[rows % k] - self.share[rows % k]
            first = np.flatnonzero(np.diff(part, prepend=0))
            number = np.cumsum(np.diff(part, prepend=0) > 0) - 1
            worst = np.maximum.reduceat(off, first)[number]
            far = np.flatnonzero((off == worst) & (off > 0))
            far = far[np.unique(number[far], return_index=True)[1]]
            again = worst > 0
            again[far] = False
            ends, rows = np.sort(np.append(ends, rows[far])), rows[again]
        kept = np.zeros(k, bool)
        kept[ends % k] = True
        if kept.sum() < 3:
            return np.arange(k)
        return np.flatnonzero(kept)


Sizes = Callable[[np.ndarray], np.ndarray]


def simplify(domain: Polygon, size: object, tolerance: float) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of the simplified domain, piece by piece, and the names of edges; see `Polygon.simplified`."""
    tolerance = check_number("tolerance", tolerance, least=0)
    if tolerance > 0.5:
        raise InputError(f"tolerance is {tolerance:g}, expected a share of the size from 0 to 0.5")
    boundary = divided_boundary(domain, as_sizes(domain, size))
    triangles = Triangles(*boundary, lambda x: shapely.contains_xy(domain.geometry, *x.T))
    turned = np.zeros(0, bool)
    for find, scales in (
        (narrow_water, SCALES[:1]),
        (small_land, SCALES[:1]),
        (narrow_water, SCALES[1:]),
        (small_land, SCALES[1:]),
    ):
        triangles = triangles.rebuilt() if turned.any() else triangles
        turned = np.any([find(triangles, scale) for scale in scales], axis=0)
        triangles.water ^= turned
    triangles.water |= small_islands(triangles)
    pieces = large_pieces(triangles)
    if not pieces:
        raise InputError(
            "the domain is narrower than the size everywhere, and nothing is left of it; choose a smaller size"
        )
    return thinned(domain, pieces, tolerance)


def as_sizes(domain: Polygon, size: object) -> Sizes:
    """Return a function of points (n, 2), of which the nearest ones in the domain count."""
    if not callable(size):
        value = check_number("size", size, above=0)
        return lambda points: np.full(len(points), value)

    def sizes(points: np.ndarray) -> np.ndarray:
        found = np.asarray(size(domain.nearest(points)), float)
        if found.shape != (len(points),):
            raise InputTypeError(
                f"size returned an array of shape {found.shape} for {len(points)} points, expected ({len(points)},)"
            )
        if not ((found > 0) & (found < math.inf)).all():
            row = int(np.argmin((found > 0) & (found < math.inf)))
            raise InputError(f"size is {found[row]:g} at {format_point(points[row])}, expected a positive length")
        return found

    return sizes
