"""Locate points in a polygonal region: inside or outside, piece, nearest edge."""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely

from ..arguments import check_rows
from .domain import Domain
from .rings import OrientedRings, project

_ROUNDINGS = 8  # tolerance for points on the boundary, in units of round-off of the largest coordinate


class Region(Domain):
    """Queries of a `Polygon` about points. `Polygon` describes the attributes."""

    vertices: np.ndarray
    ring_starts: np.ndarray
    piece_of_ring: np.ndarray
    oriented: OrientedRings

    @property
    def n_pieces(self) -> int:
        """Number of pieces, each with one outer ring."""
        return int(self.piece_of_ring[-1]) + 1

    @property
    def rings(self) -> list[np.ndarray]:
        """Vertices (k, 2) of each ring, as the caller gave them."""
        return [self.vertices[a:b] for a, b in pairwise(self.ring_starts)]

    @cached_property
    def pieces(self) -> list[Any]:
        """Each piece as a shapely Polygon."""
        found = []
        for p in range(self.n_pieces):
            mine = [r for r, piece in zip(self.oriented.rings, self.piece_of_ring, strict=True) if piece == p]
            found.append(shapely.Polygon(mine[0], mine[1:]))
        return found

    @cached_property
    def geometry(self) -> Any:
        """The domain as a shapely Polygon or MultiPolygon, prepared."""
        whole = self.pieces[0] if self.n_pieces == 1 else shapely.MultiPolygon(self.pieces)
        shapely.prepare(whole)
        return whole

    @cached_property
    def _edges(self) -> Any:
        """Tree of the oriented edges."""
        vertices = self.oriented.vertices
        ends = np.stack([vertices, vertices[self.oriented.next_vertex]], axis=1)
        return shapely.STRtree(np.asarray(shapely.linestrings(ends)))

    @property
    def _rounding(self) -> float:
        far = max(map(abs, (*self.lower, *self.upper)))
        return _ROUNDINGS * float(np.finfo(float).eps) * far

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it lies in the domain; (n,) bool.

        The boundary is included, with a tolerance of eight units of round-off of the largest coordinate: points on
        slanted edges cannot be represented exactly.
        """
        points = check_rows("points", points, 2)
        inside = self.covers(points)
        near = self.lower - np.full(2, self._rounding), self.upper + np.full(2, self._rounding)
        rest = np.flatnonzero(~inside & ((points >= near[0]) & (points <= near[1])).all(axis=1))
        if rest.size:
            rows, _ = self._edges.query(shapely.points(points[rest]), predicate="dwithin", distance=self._rounding)
            inside[rest[rows]] = True
        return inside

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it lies in the domain, without tolerance; (n,) bool."""
        return np.array(shapely.intersects_xy(self.geometry, points[:, 0], points[:, 1]))

    def contains_well(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it is inside and over `margin` from the boundary; (n,) bool."""
        inside = self.covers(points)
        rows = np.flatnonzero(inside)
        near, _ = self._edges.query(shapely.points(points[rows]), predicate="dwithin", distance=margin)
        inside[rows[near]] = False
        return inside

    def piece_of(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) in the domain the piece that holds it, (n,) int; -1 elsewhere."""
        found = np.full(len(points), -1)
        rows, pieces = shapely.STRtree(self.pieces).query(shapely.points(points), predicate="intersects")
        found[rows] = pieces
        return found

    def nearest_piece(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) the piece that holds it or is nearest, (n,) int."""
        found = self.piece_of(points)
        rest = np.flatnonzero(found < 0)
        if rest.size:  # outside by round-off
            edge, _ = self.nearest_edge(points[rest])  # by the caller's number, as are the starts of rings
            ring = np.searchsorted(self.ring_starts, edge, side="right") - 1
            found[rest] = self.piece_of_ring[ring]
        return found

    def inner_points(self) -> np.ndarray:
        """Return a point inside of each piece, (n_pieces, 2), not on its boundary."""
        return np.array(shapely.get_coordinates(shapely.point_on_surface(self.pieces)))

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) the number of the closest edge, (n,) int."""
        return self.nearest_edge(points)[0]

    def nearest_edge(self, points: np.ndarray, within: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the nearest edge to each of `points` (n, 2), and the nearest point on it.

        A search radius `within` makes it faster; the number is -1 for points without an edge in that radius.

        Returns
        -------
        edges : (n,) int
        nearest : (n, 2) float64
        """
        oriented = self.oriented
        points = np.asarray(points, dtype=float)
        edge = np.full(len(points), -1)
        rows, edges = self._edges.query_nearest(shapely.points(points), max_distance=within, all_matches=False)
        edge[rows] = edges
        begin, end = oriented.vertices[edge], oriented.vertices[oriented.next_vertex[edge]]
        return np.where(edge >= 0, oriented.edge_numbers[edge], -1), project(points, begin, end)

    def edges_within(self, points: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of rows of `points` (n, 2) and of oriented edges that are nearer than `distance` (n,)."""
        found = self._edges.query(shapely.points(points), predicate="dwithin", distance=distance)
        return found[0], found[1]

    def is_slit(self, points: np.ndarray, within: float) -> np.ndarray:
        """Return for each of `points` (n, 2) whether separate parts of the boundary are within `within`; (n,) bool."""
        rows, edges = self._edges.query(shapely.points(points), predicate="dwithin", distance=within)
        following = self.oriented.next_vertex
        after, count = following[edges], len(following)
        on = np.hypot(*(self.oriented.vertices[after] - points[rows]).T) <= within
        on &= np.isin(rows * count + after, rows * count + edges)
        return np.bincount(rows, minlength=len(points)) > 1 + np.bincount(rows[on], minlength=len(points))

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the domain to each of `points` (n, 2): the point itself if it is inside."""
        found = np.array(points, dtype=float)
        outside = np.flatnonzero(~self.contains(found))
        if outside.size:
            found[outside] = self.nearest_edge(found[outside])[1]
        return found

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (n, 2) to the boundary, inside and outside; (n,)."""
        return np.hypot(*(self.nearest_edge(points)[1] - points).T)
