"""Polygons without what is smaller than a cell: narrow bays and channels filled, small islands dropped, edges thinned.

What a disc of the diameter h cannot reach from inside is narrower than h: the domain without its opening. Sizes that
vary are rounded to levels, and each level has zones of the plane.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import shapely

from ..arguments import check_number, format_point
from ..errors import InputError, InputTypeError

if TYPE_CHECKING:
    from .polygon import Polygon

LEAST_PART = 0.12
"""Least area over h^2 of a narrow part that is filled or dropped. Corners of more than 70 degrees have less."""
SCALES = 1, 0.5, 0.25, 0.125
"""Multiples of the size for which narrow parts are searched, one after the other: a slit has little area, but not for
its width."""
LONGEST_PART = 1.25
"""Extent over h beyond which a narrow part is filled, whatever its area."""
LEAST_PIECE = 4.0
"""Least area over h^2 of a piece of the domain that remains."""
_OVER = 1.03
"""Dilation over erosion, so that what a circle of few edges leaves out does not count."""
_LEVEL = 1.25
"""Ratio of the sizes of two levels."""
_SLIT = 1e-3
"""Slits narrower than this, over the least size, are closed."""
_MOST_SQUARES = 1 << 20
_MOST_CORNERS = 2000
"""Larger shapes are dilated in parts."""
_TRIES = 6

DEFAULT_NAME = re.compile(r"(outer|hole)(-\d+)?")
"""The names of rings that have none of their own, such as "outer" and "hole-1"."""

Sizes = Callable[[np.ndarray], np.ndarray]


def simplify(
    domain: Polygon, size: object, tolerance: float
) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of the simplified domain, piece by piece, and the names of edges; see `Polygon.simplified`."""
    tolerance = check_number("tolerance", tolerance, least=0)
    if tolerance > 0.5:
        raise InputError(f"tolerance is {tolerance:g}, expected a share of the size from 0 to 0.5")
    sizes = _as_sizes(domain, size)
    zones = _zones(domain, sizes, constant=not callable(size))
    water = domain.geometry
    for scale in SCALES:
        filled = _narrow_water(water, zones, sizes, scale)
        water = _area(water.difference(shapely.union_all(filled))) if filled else water
        dropped = _small_land(water, zones, sizes, scale)
        water = _area(water.union(shapely.union_all(dropped))) if dropped else water
    water = _large_pieces(_without_slits(water, _SLIT * min(h for h, _ in zones)), sizes)
    if water.is_empty:
        raise InputError(
            "the domain is narrower than the size everywhere, and nothing is left of it; choose a smaller size"
        )
    return _thinned(domain, water, sizes, tolerance)


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


def _as_sizes(domain: Polygon, size: object) -> Sizes:
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
            raise InputError(
                f"size is {found[row]:g} at {format_point(points[row])}, expected a positive length"
            )
        return found

    return sizes


def _zones(domain: Polygon, sizes: Sizes, constant: bool) -> list[tuple[float, Any]]:
    """Return sizes h, and for each the part of the plane near the boundary where it holds; None for the whole plane."""
    if constant:
        return [(float(sizes(domain.vertices[:1])[0]), None)]
    side = float(domain.extent.max()) / 8
    counts = np.maximum(np.ceil(domain.extent / side), 1).astype(int)
    center = domain.lower + (np.indices(tuple(counts)).reshape(2, -1).T + 0.5) * side
    found: list[tuple[np.ndarray, float, np.ndarray]] = []
    corners = np.array([(0, 0), (-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    total = 0
    while len(center):
        h = sizes((center[:, None] + side * corners).reshape(-1, 2)).reshape(-1, 5)
        near = domain.boundary_distance(center) < 0.75 * side + h.max(axis=1)
        center, h = center[near], h[near]
        level = np.rint(np.log(h) / math.log(_LEVEL))
        split = (np.ptp(level, axis=1) > 0) & (side > h.min(axis=1))
        total += len(center)
        if total > _MOST_SQUARES:
            raise InputError(
                "size varies too much within the domain for `simplified`; bound it from below"
            )
        found.append((center[~split], side, level[~split, 0]))
        side /= 2
        center = (center[split][:, None] + side * corners[1:]).reshape(-1, 2)
    square = [np.concatenate([c - s / 2, c + s / 2], axis=1) for c, s, _ in found]
    boxes = shapely.box(*np.concatenate(square).T)
    level = np.concatenate([at for *_, at in found])
    return [(_LEVEL**k, shapely.union_all(boxes[level == k])) for k in np.unique(level).tolist()]


def _narrow_parts(
    water: Any, zones: list[tuple[float, Any]], scale: float, land: bool
) -> list[Any]:
    """Return the parts of the water, or of the land, in which no disc of the diameter ``scale * h`` fits."""
    found = []
    for h, zone in zones:
        within = water if zone is None else water.intersection(zone.buffer(2 * h))
        radius = (1 if land else -1) * scale * h / 2
        for tile, near in _tiles(within, (1 + _OVER) * scale * h / 2):
            open_parts = near.buffer(radius, quad_segs=16).buffer(-_OVER * radius, quad_segs=16)
            parts = open_parts.difference(near) if land else near.difference(open_parts)
            for cut in (tile, zone):
                parts = parts if cut is None else parts.intersection(cut)
            found.append(parts)
    return _joined([part for parts in found for part in _polygons(parts)])


def _tiles(shape: Any, margin: float) -> Iterator[tuple[Any, Any]]:
    """Yield rectangles that cover `shape`, and of each the part of it that is nearer than `margin`.

    The time for the dilation of one shape grows with the square of the number of its rings. A small shape is yielded as
    it is, with None for the rectangle.
    """
    if shapely.get_num_coordinates(shape) <= _MOST_CORNERS:
        yield None, shape
        return
    left = [(shape.bounds, shape)]
    while left:
        (x, y, u, v), near = left.pop()
        long, wide = max(u - x, v - y), u - x > v - y
        if shapely.get_num_coordinates(near) <= _MOST_CORNERS or long < 4 * margin:
            yield shapely.box(x, y, u, v), near
            continue
        s, t = (x + u) / 2, (y + v) / 2
        for half in ((x, y, s, v), (s, y, u, v)) if wide else ((x, y, u, t), (x, t, u, v)):
            around = shapely.box(*half).buffer(margin, join_style="mitre")
            left.append((half, near.intersection(around)))


def _joined(parts: list[Any]) -> list[Any]:
    """Return polygons in which those of `parts` that touch are one."""
    if len(parts) < 2:
        return parts
    pairs = shapely.STRtree(parts).query(parts, predicate="intersects")
    graph = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs), (len(parts), len(parts)))
    component = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    order = np.argsort(component, kind="stable")
    groups = np.split(np.array(parts)[order], np.flatnonzero(np.diff(component[order])) + 1)
    found: list[Any] = []
    for group in groups:
        found += list(group) if len(group) == 1 else _polygons(shapely.union_all(group))
    return found


def _narrow_water(
    water: Any, zones: list[tuple[float, Any]], sizes: Sizes, scale: float
) -> list[Any]:
    parts = _narrow_parts(water, zones, scale, land=False)
    h = scale * _sizes_at(parts, sizes)
    large = (shapely.area(parts) > LEAST_PART * h**2) | (_extents(parts) > LONGEST_PART * h)
    return [parts[k] for k in np.flatnonzero(large)]


def _small_land(
    water: Any, zones: list[tuple[float, Any]], sizes: Sizes, scale: float
) -> list[Any]:
    """Return islands and capes that are smaller than h. Land that joins two larger parts is kept."""
    islands = [shapely.Polygon(ring) for piece in _polygons(water) for ring in piece.interiors]
    found = [islands[k] for k in np.flatnonzero(_extents(islands) < _sizes_at(islands, sizes))]
    dropped, boundary = shapely.MultiPolygon(found), water.boundary
    shapely.prepare(dropped)
    capes = _narrow_parts(water, zones, scale, land=True)
    lengths = _sizes_at(capes, sizes)
    small = shapely.area(capes) < LEAST_PART * (scale * lengths) ** 2
    left = np.flatnonzero(~small & (_extents(capes) <= lengths))
    for part, h in ((capes[k], lengths[k]) for k in left):
        if dropped.intersects(part):
            continue
        coast = shapely.intersection(boundary, part.envelope.buffer(h))
        roots = part.boundary.difference(coast.buffer(1e-6 * h))
        roots = shapely.line_merge(roots) if roots.geom_type == "MultiLineString" else roots
        if len(getattr(roots, "geoms", [roots])) == 1:
            found.append(part)
    return found


def _sizes_at(parts: list[Any], sizes: Sizes) -> np.ndarray:
    """Return the size at a point of each part."""
    return sizes(shapely.get_coordinates(shapely.point_on_surface(parts))) if parts else np.empty(0)


def _extents(parts: list[Any]) -> np.ndarray:
    """Return the longest side of the smallest rectangle around each part."""
    corners, row = shapely.get_coordinates(shapely.oriented_envelope(parts), return_index=True)
    sides, found = np.hypot(*np.diff(corners, axis=0).T), np.zeros(len(parts))
    same = row[1:] == row[:-1]
    np.maximum.at(found, row[1:][same], sides[same])
    return found


def _polygons(shape: Any) -> Iterator[Any]:
    parts = shapely.get_parts(shape)
    return (part for part in parts if part.geom_type == "Polygon" and not part.is_empty)


def _area(shape: Any) -> Any:
    """Return `shape` without lines and points that an overlay has left."""
    return shapely.MultiPolygon(list(_polygons(shape)))


def _without_slits(shape: Any, width: float) -> Any:
    """Return `shape` without the slits and spikes that an overlay has left; other corners stay."""
    for way in (-width, 2 * width, -width):
        shape = shape.buffer(way, join_style="mitre", mitre_limit=20)
    return shape


def _large_pieces(water: Any, sizes: Sizes) -> Any:
    """Return `water` without pieces of a few cells."""
    pieces = list(_polygons(water))
    least = LEAST_PIECE * _sizes_at(pieces, sizes) ** 2
    return shapely.union_all([p for p, area in zip(pieces, least, strict=True) if p.area > area])


def _thinned(
    domain: Polygon, water: Any, sizes: Sizes, tolerance: float
) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of `water` with fewer vertices, and the edges of each name."""
    least = 1e-9 * float(domain.extent.max())
    pieces = []
    for piece in _polygons(shapely.remove_repeated_points(water, least)):
        rings = [np.asarray(ring.coords)[:-1] for ring in (piece.exterior, *piece.interiors)]
        pieces.append([_Ring(domain, x, sizes(x)) for x in rings])
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
            first = int(ends[0]) if len(ends) else 0
            far = int(np.argmax(np.hypot(*(self.x - self.x[first]).T)))
            ends = np.unique([first, far])
        kept = np.zeros(k, bool)
        kept[ends] = True
        stack = [
            (a, b) for a, b in zip(ends.tolist(), [*ends[1:].tolist(), ends[0] + k], strict=True)
        ]
        while stack:
            a, b = stack.pop()
            rows = np.arange(a + 1, b) % k
            if not len(rows):
                continue
            begin, along = self.x[a % k], self.x[b % k] - self.x[a % k]
            square = max(float(along @ along), 1e-300)
            t = np.clip((self.x[rows] - begin) @ along / square, 0, 1)
            off = np.hypot(*(self.x[rows] - begin - t[:, None] * along).T) / self.h[rows]
            worst = int(np.argmax(off))
            if off[worst] > share:
                middle = a + 1 + worst
                kept[middle % k] = True
                stack += [(a, middle), (middle, b)]
        if kept.sum() < 3:
            return np.arange(k)
        return np.flatnonzero(kept)
