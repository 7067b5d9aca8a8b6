"""Which vertices and edges of a Voronoi diagram lie inside of a solid, and where edges leave it.

The surface decides once for each vertex and edge, so that all cells that have it agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...connectivity import starts_of
from .wall_surface import WallSurface

ON = 0.03
"""Vertices this close to the surface, as a share of h, count as on it, and are moved there."""
_LEAVE = 4 * ON
"""Least length over h of the part of an edge that runs along a crease before the edge leaves the solid."""
_STRAIGHT = 0.05
"""Largest departure of the distance from a straight line, over the length, at which an edge is pierced once."""
_ROUNDS = 12
IN, WALL, OUT = -1, 0, 1
"""Sides of the surface; also the signs of distances."""


@dataclass(frozen=True)
class PiercedEdges:
    """The parts of edges in a solid."""

    starts_inside: np.ndarray
    ends_inside: np.ndarray
    """`starts_inside`, `ends_inside`: (e,) bool. Whether the edge is inside, or on the surface, beside its first and
    its second end."""
    first: np.ndarray
    """(e + 1,) int. Rows of the piercings of each edge; inside and outside alternate there."""
    edge: np.ndarray
    """(p,) int."""
    points: np.ndarray
    """(p, 3) float."""
    triangles: np.ndarray
    """(p,) int. Where the piercings lie on the surface."""


def sides(distance: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return IN, WALL or OUT for signed distances from the surface and sizes `h`, (k,) each."""
    return np.where(np.abs(distance) <= ON * h, WALL, np.sign(distance)).astype(np.int8)


def pierce_edges(
    surface: WallSurface, a: np.ndarray, b: np.ndarray, distances: np.ndarray, h: np.ndarray
) -> PiercedEdges:
    """Find where edges cross the surface.

    - `a`, `b` (e, 3) float: ends.
    - `distances` (e, 2) float: signed distances of the ends from the surface; 0 for ends on it.
    - `h`: (e,) float
    """
    length = np.linalg.norm(b - a, axis=1)
    samples = _sample(surface, a, b, distances, h, length)
    edge, t, d = samples
    sign = np.where((t == 0) | (t == 1), np.sign(d), sides(d, h[edge])).astype(np.int8)
    signed = np.flatnonzero(sign != 0)
    e, s = edge[signed], sign[signed]
    begin, end = np.full((2, len(a)), IN, np.int8)  # edges that stay on the surface count as inside
    begin[e[::-1]], end[e] = s[::-1], s
    change = np.flatnonzero((e[1:] == e[:-1]) & (s[1:] != s[:-1]))
    low, high = signed[change], signed[change + 1]
    row, place, tri, points = _roots(surface, a, b, edge[low], t[[low, high]], d[[low, high]], h)
    starts, ends = begin == IN, end == IN
    leaving = _leaves(surface, a, b, distances, (begin, end), h, length)
    row, place = np.concatenate([row, leaving[0]]), np.concatenate([place, leaving[1]])
    tri, points = np.concatenate([tri, leaving[2]]), np.concatenate([points, leaving[3]])
    starts[leaving[0][leaving[4] == 0]] = True
    ends[leaving[0][leaving[4] == 1]] = True
    order = np.lexsort((place, row))
    first = starts_of(np.bincount(row, minlength=len(a)))
    return PiercedEdges(starts, ends, first, row[order], points[order], tri[order])


def simplified(pierced: PiercedEdges, a: np.ndarray, b: np.ndarray, simple: np.ndarray) -> PiercedEdges:
    """Return the parts of edges with at most one piercing of each edge that is `simple` (e,).

    Of an edge between the sides IN and OUT, `a` and `b` (e,), the part beside its end inside is kept. What the surface
    cuts out of an edge with both ends inside is ignored, as is what is inside between two ends outside.
    """
    first, count = pierced.first[:-1], np.diff(pierced.first)
    leaves, enters = simple & (a == IN) & (b == OUT), simple & (a == OUT) & (b == IN)
    number = np.arange(len(pierced.edge)) - first[pierced.edge]
    kept = ~simple[pierced.edge] | leaves[pierced.edge] & (number == 0)
    kept |= enters[pierced.edge] & (number == count[pierced.edge] - 1)
    starts, ends = pierced.starts_inside.copy(), pierced.ends_inside.copy()
    starts[simple & (a != WALL)], ends[simple & (b != WALL)] = (
        (a == IN)[simple & (a != WALL)],
        (b == IN)[simple & (b != WALL)],
    )
    along = simple & ~leaves & ~enters
    one = along & (a == WALL) & (b != WALL)
    starts[one] = ends[one]
    one = along & (b == WALL) & (a != WALL)
    ends[one] = starts[one]
    both = along & (a == WALL) & (b == WALL)
    starts[both] = ends[both] = (starts & ends)[both]
    edge = pierced.edge[kept]
    return PiercedEdges(
        starts,
        ends,
        starts_of(np.bincount(edge, minlength=len(a))),
        edge,
        pierced.points[kept],
        pierced.triangles[kept],
    )


def _sample(
    surface: WallSurface, a: np.ndarray, b: np.ndarray, distances: np.ndarray, h: np.ndarray, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return edge, place and signed distance of samples of all edges, sorted: enough to find each crossing.

    A distance changes no faster than the place does. So nothing crosses between two samples of one sign whose distances
    together exceed their gap.
    """
    e = np.arange(len(a))
    t = np.stack([np.zeros(len(a)), np.ones(len(a))])
    d = distances.T.astype(float)
    kept = [(np.repeat(e, 2), np.tile([0.0, 1.0], len(e)), distances.ravel())]
    seen = np.zeros(len(e), np.int64)
    for _ in range(_ROUNDS):
        gap = (t[1] - t[0]) * length[e]
        together = np.abs(d).sum(axis=0)
        product = d[0] * d[1]
        # From an end on the surface the edge leaves at once, or runs along it for a while, or comes back.
        at_end = (product == 0) & ((together > 0.8 * gap) | (gap <= _LEAVE * h[e]))
        straight = at_end | (product < 0) & (seen > 0) | (gap <= ON * h[e])
        open_ = ~straight & ~((product > 0) & (together >= gap * (1 - 1e-9)))
        e, t, d, seen = e[open_], t[:, open_], d[:, open_], seen[open_]
        if not len(e):
            break
        tm = t.mean(axis=0)
        dm = surface.closest(a[e] + tm[:, None] * (b[e] - a[e]))[2]
        kept.append((e, tm, dm))
        linear = np.abs(dm - d.mean(axis=0)) < _STRAIGHT * (t[1] - t[0]) * length[e]
        linear |= np.abs(dm) <= ON * h[e]
        seen = np.where(linear | (d.prod(axis=0) >= 0), 1, 0)
        e, seen = np.concatenate([e, e]), np.concatenate([seen, seen])
        t = np.stack([np.concatenate([t[0], tm]), np.concatenate([tm, t[1]])])
        d = np.stack([np.concatenate([d[0], dm]), np.concatenate([dm, d[1]])])
    edge, place, distance = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    order = np.lexsort((place, edge))
    return edge[order], place[order], distance[order]


def _roots(
    surface: WallSurface, a: np.ndarray, b: np.ndarray, edge: np.ndarray, t: np.ndarray, d: np.ndarray, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return edge, place, triangle and point of the crossings between two samples each, by the Illinois method."""
    t, d = t.copy(), d.copy()
    place, left = t[0].copy(), np.arange(len(edge))
    last = np.zeros(len(edge), np.int8)
    triangle, point = np.zeros(len(edge), np.int64), np.zeros((len(edge), 3))
    for step in range(30):
        if not len(left):
            break
        u, v = t[:, left], d[:, left]
        place[left] = (u[0] * v[1] - u[1] * v[0]) / (v[1] - v[0]) if step % 5 < 4 else u.mean(axis=0)
        k = edge[left]
        triangle[left], point[left], found = surface.closest(a[k] + place[left, None] * (b[k] - a[k]))
        side = np.where(np.sign(found) == np.sign(d[0, left]), 0, 1).astype(np.int8)
        t[side, left], d[side, left] = place[left], found
        again = last[left] == side + 1
        d[1 - side[again], left[again]] *= 0.5
        last[left] = side + 1
        left = left[np.abs(found) > 1e-9 * h[k]]
    return edge, place, triangle, point


def _leaves(
    surface: WallSurface,
    a: np.ndarray,
    b: np.ndarray,
    distances: np.ndarray,
    sides_at: tuple[np.ndarray, np.ndarray],
    h: np.ndarray,
    length: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return edges that run along the surface from an end on it, and leave at a crease: place, triangle, point, end."""
    none = np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int64)
    found = [none]
    for end in (0, 1):
        k = np.flatnonzero((distances[:, end] == 0) & (sides_at[end] == OUT) & (length > _LEAVE * h))
        early = _LEAVE * h[k] / length[k]
        x = a[k] + (early if end == 0 else 1 - early)[:, None] * (b[k] - a[k])
        k = k[np.abs(surface.closest(x)[2]) <= ON * h[k]]
        if not len(k):
            continue
        low, high = np.zeros(len(k)), np.ones(len(k))
        for _ in range(7):
            middle = (low + high) / 2
            x = a[k] + (middle if end == 0 else 1 - middle)[:, None] * (b[k] - a[k])
            near = np.abs(surface.closest(x)[2]) <= ON * h[k]
            low, high = np.where(near, middle, low), np.where(near, high, middle)
        kept = low * length[k] > _LEAVE * h[k]
        k, low = k[kept], low[kept]
        place = low if end == 0 else 1 - low
        triangle, point, _ = surface.closest(a[k] + place[:, None] * (b[k] - a[k]))
        edge_of = surface.nearest_crease(point, 2 * ON * h[k])[0]
        kept = edge_of >= 0
        found.append((k[kept], place[kept], triangle[kept], point[kept], np.full(int(kept.sum()), end)))
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))
