"""The boundary of a domain as faces on it see it, on the host: walls of boxes, edges of polygons.

A face on wall b of its domain has the neighbor -1 - b: wall 2 a of a box is the lower one of axis a, wall 2 a + 1 the
upper one, and wall e of a polygon its edge e.
"""

from __future__ import annotations

import numpy as np

from .box import Domain
from .polygon import Polygon


def wall_count(domain: Domain) -> int:
    """Return how many walls `domain` has."""
    return len(domain.vertices) if isinstance(domain, Polygon) else 2 * domain.dim


def wall_planes(domain: Domain, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outward unit normals of `walls` (k,) and a point on each, (k, d) each."""
    if isinstance(domain, Polygon):
        begin, end = _edges(domain, walls)
        along = (end - begin) / np.hypot(*(end - begin).T)[:, None]
        return np.stack([along[:, 1], -along[:, 0]], axis=1), begin
    axis, upper = walls // 2, walls % 2
    normals = np.zeros((len(walls), domain.dim))
    normals[np.arange(len(walls)), axis] = 2.0 * upper - 1
    return normals, np.array([domain.lower, domain.upper])[upper]


def wall_distance(domain: Domain, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how far each of `points` (k, d) is off its wall; off a box' the plane, off a polygon's edge the edge."""
    if isinstance(domain, Polygon):
        begin, end = _edges(domain, walls)
        along, off = end - begin, points - begin
        t = np.clip((off * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        return np.hypot(*(t[:, None] * along - off).T)
    normals, anchors = wall_planes(domain, walls)
    return np.abs(((points - anchors) * normals).sum(axis=1))


def surface(domain: Domain) -> float:
    """Return the measure of the boundary: length in 2D, area in 3D."""
    if isinstance(domain, Polygon):
        begin, end = _edges(domain, np.arange(len(domain.vertices)))
        return float(np.hypot(*(end - begin).T).sum())
    extent = domain.extent
    return float(2 * sum(np.prod(np.delete(extent, a)) for a in range(domain.dim)))


def wall_groups(domain: Domain) -> tuple[list[str], np.ndarray]:
    """Return names of parts of the boundary, and the part that each wall belongs to.

    In a box a wall is a part of its own, `xMin`, `xMax`, `yMin`, ...; in a polygon a ring: `outer` and `hole-1`,
    `hole-2`, ..., in the order in which the rings are kept, or `outer-1`, `outer-2`, ... where there are several
    pieces.
    """
    if not isinstance(domain, Polygon):
        names = [f"{axis}{end}" for axis in "xyz"[: domain.dim] for end in ("Min", "Max")]
        return names, np.arange(len(names))
    first = np.diff(domain.piece_of_ring, prepend=-1) > 0
    outers, holes = np.cumsum(first), np.cumsum(~first)
    names = [
        (f"outer-{o}" if domain.n_pieces > 1 else "outer") if is_outer else f"hole-{h}"
        for is_outer, o, h in zip(first, outers, holes, strict=True)
    ]
    return names, np.repeat(np.arange(len(names)), np.diff(domain.ring_starts))


def _edges(domain: Polygon, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return domain.vertices[walls], domain.vertices[domain.next_vertex[walls]]
