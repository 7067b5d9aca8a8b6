"""Simplify polygons: fill bays and channels that are narrower than a cell, drop small islands, remove vertices.

What a disc of the diameter h cannot reach from inside is narrower than h. These places are the Delaunay triangles of
points on the boundary whose circumcircles are smaller than that disc (alpha shapes: Edelsbrunner, Kirkpatrick, Seidel
1983). Each triangle is water or land. To fill a bay is to turn its triangles into land.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import scipy
import shapely

from ..arguments import check_number, format_point
from ..connectivity import components
from ..errors import InputError, InputTypeError

if TYPE_CHECKING:
    from .polygon import Polygon

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


_LONGEST_EDGE = 0.5
"""Over h, where another edge is nearer than h. Shorter edges stay as they are."""
_LONGEST_FACING = 0.2
"""Over h, for parts of longer edges that face an edge nearly h away. In a channel that is w wide, circumcircles of
parts of length s have diameters of up to sqrt(w^2 + s^2): all less than h if w is 0.97 h."""
_NEARLY = math.sqrt(1 - _LONGEST_EDGE**2)
"""Over h. In a channel narrower than that, parts of h / 2 are short enough."""
_SHORTEST_EDGE = 1e-3
"""Over h. Shorter edges are not divided, even if they are no sides of triangles."""
_GABRIEL_ROUNDS = 4


def divided_boundary(
    domain: Polygon, sizes: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return points on the boundary (n, 2), their sizes, edges (k, 2), and how many points are vertices.

    The domain is on the left of each edge. Long edges are divided where another one is near.
    """
    oriented = domain.oriented
    x, row = np.unique(oriented.vertices, axis=0, return_inverse=True)
    row = row.reshape(-1)  # NumPy 2.0 keeps the axis
    edges = np.column_stack([row, row[oriented.next_vertex]])
    h, n = sizes(x), len(x)
    lines, way = np.asarray(shapely.linestrings(x[edges])), np.diff(x[edges], axis=1)[:, 0]
    way /= np.hypot(*way.T)[:, None]
    tree, own = shapely.STRtree(lines), np.arange(len(edges))
    again = shapely.length(lines) > _LONGEST_EDGE * h[edges].mean(axis=1)
    while again.any():
        begin, end = x[edges[again]].swapaxes(0, 1)
        size = h[edges[again]].mean(axis=1)
        length = np.hypot(*(end - begin).T)
        long = np.flatnonzero(length > _LONGEST_FACING * size)
        found = np.asarray(shapely.linestrings(np.stack([begin, end], axis=1)[long]))
        at, other = tree.query(found, predicate="dwithin", distance=size[long])
        row = long[at]
        facing = ((end - begin)[row] * way[other]).sum(axis=1) < -0.9 * length[row]
        facing &= shapely.distance(found[at], lines[other]) > _NEARLY * size[row]
        near = length[row] > np.where(facing, _LONGEST_FACING, _LONGEST_EDGE) * size[row]
        near &= other != own[again][row]
        split = np.zeros(len(edges), bool)
        split[np.flatnonzero(again)[row[near]]] = True
        made, x = _split(x, edges[split], n)
        h = np.concatenate([h, sizes(x[len(h) :])])
        edges = np.concatenate([edges[~split], made])
        own = np.concatenate([own[~split], np.tile(own[split], 2)])
        again = np.arange(len(edges)) >= len(edges) - len(made)
    # An edge is divided at the foot of the nearest point in the circle around it. Then the triangles between two walls
    # are not obtuse, however thin a slit is.
    for _ in range(_GABRIEL_ROUNDS):
        begin, end = x[edges].swapaxes(0, 1)
        nearest, point = scipy.spatial.KDTree(x).query((begin + end) / 2)
        split = nearest < (1 - 1e-9) * np.hypot(*(end - begin).T) / 2
        way = (end - begin)[split]
        share = ((x[point] - begin)[split] * way).sum(axis=1) / (way**2).sum(axis=1)
        made, x = _split(x, edges[split], n, share)
        edges = np.concatenate([edges[~split], made])
    return x, np.concatenate([h, sizes(x[len(h) :])]), edges, n


def _split(x: np.ndarray, edges: np.ndarray, n: int, share: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of edges, (2 k, 2), and all points. Edges are divided at shares of their lengths, (k,).

    Without shares these are halves, but beside one of the first `n` points an edge is divided at a distance that is a
    power of two. Then the parts of two edges that meet there are equally long, and a small angle does not take endless
    rounds (Ruppert 1995).
    """
    a, b = edges.T
    if share is None:
        length = np.hypot(*(x[b] - x[a]).T)
        power = np.exp2(np.floor(np.log2(length / 1.5))) / length
        share = np.where((a < n) == (b < n), 0.5, np.where(a < n, power, 1 - power))
    middle = len(x) + np.arange(len(edges))
    halves = np.concatenate([np.column_stack([a, middle]), np.column_stack([middle, b])])
    return halves, np.concatenate([x, x[a] + share[:, None] * (x[b] - x[a])])


class Triangles:
    """The Delaunay triangles of the ends of edges, of which each is a side of them.

    - `x`, `h`: points (n, 2), sizes (n,)
    - `edges` (k, 2) int: with water on the left. They are divided as far as is necessary.
    - `n_vertices`: the first points are vertices of the domain; others divide edges.
    - `corners`, `neighbors` (t, 3) int: the neighbor k, or -1, is beyond the side that does not have corner k.
    - `water`: (t,) bool
    """

    def __init__(
        self,
        x: np.ndarray,
        h: np.ndarray,
        edges: np.ndarray,
        n_vertices: int,
        is_water: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self.x, self.h, self.edges, self.n_vertices = x, h, edges, n_vertices
        while (missing := self._build()).any():
            a, b = self.edges.T
            missing &= np.hypot(*(self.x[b] - self.x[a]).T) > _SHORTEST_EDGE * self.h[a]
            if not missing.any():  # the boundary nearly touches itself
                self.water = is_water(self.x[self.corners].mean(axis=1))
                break
            self._divide(missing)

    def _divide(self, chosen: np.ndarray) -> None:
        ends = self.edges[chosen]
        halves, self.x = _split(self.x, ends, self.n_vertices)
        self.h = np.concatenate([self.h, self.h[ends].mean(axis=1)])
        self.edges = np.concatenate([self.edges[~chosen], halves])

    def _build(self) -> np.ndarray:
        """Find the triangles, and return the edges that are not sides of them."""
        used = np.flatnonzero(np.bincount(self.edges.ravel()))
        x = self.x[used]
        self._origin, self._extent = x.min(axis=0), np.ptp(x, axis=0).max()
        self._made = scipy.spatial.Delaunay((x - self._origin) / self._extent)
        self.corners, self.neighbors = used[self._made.simplices], self._made.neighbors
        keys = keys_of(np.sort(self.edges, axis=1))
        order = np.argsort(keys)
        sides = self.corners[:, [[1, 2], [2, 0], [0, 1]]]
        wanted = keys_of(np.sort(sides, axis=2))
        edge = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
        is_wall = keys[edge] == wanted
        is_left = is_wall & (self.edges[edge, 0] == sides[..., 0])
        _, component = joined_sets(~is_wall, self.neighbors)
        is_water = np.zeros(component.max() + 1, bool)
        is_water[component[is_left.any(axis=1)]] = True
        self.water = is_water[component]
        missing = np.ones(len(keys), bool)
        missing[edge[is_wall]] = False
        return missing

    def rebuilt(self) -> Triangles:
        """Return the triangles of what is the boundary now, after some of the water has become land, or land water."""
        t, k = np.nonzero(self.shores())
        edges = np.column_stack([self.corners[t, (k + 1) % 3], self.corners[t, (k + 2) % 3]])
        if not len(edges):
            return self
        return Triangles(self.x, self.h, edges, self.n_vertices, self._is_water)

    def _is_water(self, points: np.ndarray) -> np.ndarray:
        triangle = self._made.find_simplex((points - self._origin) / self._extent)
        return (triangle >= 0) & self.water[triangle]

    def shores(self) -> np.ndarray:
        """Return which sides of water have land behind them, (t, 3) bool."""
        land = (self.neighbors < 0) | ~self.water[self.neighbors]
        return self.water[:, None] & land

    @property
    def area(self) -> np.ndarray:
        """The area of each triangle."""
        a, b, c = self.x[self.corners].swapaxes(0, 1)
        u, v = b - a, c - a
        return 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def keys_of(pairs: np.ndarray) -> np.ndarray:
    """Return a number for each pair, (..., 2)."""
    pairs = pairs.astype(np.int64)
    return pairs[..., 0] << 32 | pairs[..., 1]


def joined_sets(joined: np.ndarray, neighbors: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of sets of triangles that are joined through sides, (t, 3) bool, and the set of each."""
    t, k = np.nonzero(joined & (neighbors >= 0))
    return components(len(joined), t, neighbors[t, k])


LEAST_PART = 0.12
"""Least area over h^2 of a narrow part that is filled or dropped. Corners of more than 70 degrees have less."""
SCALES = 1, 0.5, 0.25, 0.125
"""Narrow parts are found for these multiples of the size. A thin slit has a small area compared with h^2, but a large
one compared with the square of its width."""
LONGEST_PART = 1.25
"""Extent over the least scale of h beyond which a narrow part is filled, whatever its area."""


class Parts:
    """Sets of triangles that are joined: their areas and mean sizes.

    Attributes
    ----------
    row : (m,) int
        Triangles.
    part : (m,) int
        The set of each.
    rim : (m, 3) bool
        Which sides lead to other water, of a part of the water, or to other land.
    count : int
        Number of sets.
    area, h : (count,) float
    """

    def __init__(self, triangles: Triangles, chosen: np.ndarray) -> None:
        self.triangles, self.row = triangles, np.flatnonzero(chosen)
        near = triangles.neighbors
        inner = chosen[:, None] & (near >= 0) & chosen[near]
        water = triangles.water[:, None]
        same = np.where(near < 0, ~water, triangles.water[near] == water)
        component = joined_sets(inner, near)[1][self.row]
        names, self.part = np.unique(component, return_inverse=True)
        self.count, self.rim = len(names), (~inner & same)[self.row]
        self.area = self.sums(triangles.area[self.row])
        self.h = self.sums(triangles.h[triangles.corners[self.row]].mean(axis=1)) / self.sums()

    def sums(self, values: np.ndarray | None = None) -> np.ndarray:
        """Return the sum over each part of values, (m,), or the number of its triangles."""
        return np.bincount(self.part, values, self.count)

    def chosen(self, parts: np.ndarray) -> np.ndarray:
        """Return which triangles, (t,) bool, belong to the chosen `parts`, (count,) bool."""
        found = np.zeros(len(self.triangles.corners), bool)
        found[self.row[parts[self.part]]] = True
        return found

    def extents(self, wanted: np.ndarray) -> np.ndarray:
        """Return the longest side of the smallest rectangle around each wanted part, and 0 for others."""
        found = np.zeros(self.count)
        rows = np.flatnonzero(wanted[self.part])
        rows = rows[np.argsort(self.part[rows], kind="stable")]
        if rows.size:
            x = self.triangles.x[self.triangles.corners[self.row[rows]]].reshape(-1, 2)
            _, index = np.unique(self.part[rows], return_inverse=True)
            points = shapely.multipoints(x, indices=np.repeat(index, 3))
            around = np.asarray(shapely.oriented_envelope(points))
            corners, part = shapely.get_coordinates(around, return_index=True)
            sides, same = np.hypot(*np.diff(corners, axis=0).T), part[1:] == part[:-1]
            longest = np.zeros(len(around))
            np.maximum.at(longest, part[1:][same], sides[same])
            found[wanted] = longest
        return found


def narrow_parts(triangles: Triangles, water: bool, scale: float) -> Parts:
    """Return the parts of the water, or of the land, in which no disc of the diameter ``scale * h`` fits.

    Their areas are those beside the discs that touch their rims.
    """
    corners = triangles.x[triangles.corners]
    side = np.hypot(*np.moveaxis(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), -1, 0))
    disc = 0.5 * scale * triangles.h[triangles.corners].mean(axis=1)
    is_narrow = side.prod(axis=1) < 4 * triangles.area * disc
    parts = Parts(triangles, is_narrow & (triangles.water == water))
    t, k = np.nonzero(parts.rim)
    r = disc[parts.row][t]
    half = np.minimum(0.5 * side[parts.row][t, k], r)
    beyond = r**2 * np.arcsin(half / r) - half * np.sqrt(r**2 - half**2)
    parts.area -= np.bincount(parts.part[t], beyond, parts.count)
    return parts


def narrow_water(triangles: Triangles, scale: float) -> np.ndarray:
    """Return the triangles of narrow water to fill."""
    parts = narrow_parts(triangles, True, scale)
    h = scale * parts.h
    large = parts.area > LEAST_PART * h**2
    return parts.chosen(large | (parts.extents(~large) > LONGEST_PART * h))


def small_islands(triangles: Triangles) -> np.ndarray:
    """Return the triangles of islands that are smaller than h."""
    islands = Parts(triangles, ~triangles.water)
    inner = np.ones(islands.count, bool)
    inner[islands.part[(triangles.neighbors[islands.row] < 0).any(axis=1)]] = False
    return islands.chosen(inner & (islands.extents(inner) < islands.h))


def small_land(triangles: Triangles, scale: float) -> np.ndarray:
    """Return the triangles of islands and capes that are smaller than h. Land that joins two larger parts is kept."""
    parts = narrow_parts(triangles, False, scale)
    small = parts.area < LEAST_PART * (scale * parts.h) ** 2
    # A cape has one root: the sides to other land are one polyline.
    t, k = np.nonzero(parts.rim)
    part, corners = parts.part[t], triangles.corners[parts.row[t]]
    ends = [keys_of(np.column_stack([part, corners[np.arange(len(t)), (k + i) % 3]])) for i in (1, 2)]
    nodes, index = np.unique(ends, return_inverse=True)
    begin, end = index.reshape(2, -1)
    count, root = components(len(nodes), begin, end)
    part_of_root = np.zeros(count, np.int64)
    part_of_root[root] = nodes >> 32
    capes = ~small & (np.bincount(part_of_root, minlength=parts.count) == 1)
    capes &= parts.extents(capes) <= parts.h
    return small_islands(triangles) | parts.chosen(capes)
