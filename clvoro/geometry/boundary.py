"""The walls of a domain by their numbers, on the host: planes, distances, measure of the boundary.

A wall is one side of a box or one edge of a polygon. A face on wall k has the neighbor -1 - k.
"""

from __future__ import annotations

import numpy as np

from .domain import Domain
from .polygon import Polygon


def wall_planes(domain: Domain, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outward unit normals of `walls` (k,) and a point on each, (k, d) each."""
    if isinstance(domain, Polygon):
        begin, end = domain.edge_ends(walls)
        along = (end - begin) / np.hypot(*(end - begin).T)[:, None]
        return np.stack([along[:, 1], -along[:, 0]], axis=1), begin
    axis, upper = walls // 2, walls % 2
    normals = np.zeros((len(walls), domain.dim))
    normals[np.arange(len(walls)), axis] = 2.0 * upper - 1
    return normals, np.array([domain.lower, domain.upper])[upper]


def wall_distance(domain: Domain, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distance of each of `points` (k, d) to its wall: to the plane of a side, to the segment of an edge."""
    if isinstance(domain, Polygon):
        begin, end = domain.edge_ends(walls)
        along, off = end - begin, points - begin
        t = np.clip((off * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        return np.hypot(*(t[:, None] * along - off).T)
    normals, anchors = wall_planes(domain, walls)
    return np.abs(((points - anchors) * normals).sum(axis=1))


def boundary_measure(domain: Domain) -> float:
    """Return the measure of the boundary: length in 2D, area in 3D."""
    if isinstance(domain, Polygon):
        oriented = domain.oriented
        along = oriented.vertices[oriented.next_vertex] - oriented.vertices
        return float(np.hypot(*along.T).sum())
    extent = domain.extent
    return float(2 * sum(np.prod(np.delete(extent, a)) for a in range(domain.dim)))
