"""The Delaunay triangles of points on a boundary, each of them water or land."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import scipy
import shapely

if TYPE_CHECKING:
    from ..polygon import Polygon

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
        found = shapely.linestrings(np.stack([begin, end], axis=1)[long])
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
        share = np.exp2(np.floor(np.log2(length / 1.5))) / length
        share = np.where((a < n) == (b < n), 0.5, np.where(a < n, share, 1 - share))
    middle = len(x) + np.arange(len(edges))
    halves = np.concatenate([np.column_stack([a, middle]), np.column_stack([middle, b])])
    return halves, np.concatenate([x, x[a] + share[:, None] * (x[b] - x[a])])


class Triangles:
    """The Delaunay triangles of the ends of edges, of which each is a side of them.

    Attributes
    ----------
    x, h : points (n, 2), sizes (n,)
    edges : (k, 2) int
        With water on the left. They are divided as far as is necessary.
    n_vertices : int
        The first points are vertices of the domain; others divide edges.
    corners, neighbors : (t, 3) int
        The neighbor k, or -1, is beyond the side that does not have corner k.
    water : (t,) bool
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
        _, component = components(~is_wall, self.neighbors)
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


def components(joined: np.ndarray, neighbors: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of sets of triangles that are joined through sides, (t, 3) bool, and the set of each."""
    t, k = np.nonzero(joined & (neighbors >= 0))
    pairs = (t, neighbors[t, k])
    graph = scipy.sparse.coo_array((np.ones(len(t), bool), pairs), (len(joined), len(joined)))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)
