"""Geometry of meshes for the MPAS mesh specification: `measure` in the plane and on a sphere, and coordinates.

The place of an edge is where the line, or the great circle, between its generators crosses it. The kites of a cell are
the quadrilaterals of generator, edge, vertex and next edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.domain import Domain
from ..geometry.sphere import Sphere, triangle_areas
from ..io.half_edges import HalfEdges
from ..mesh.connectivity import neighbor_points
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class Shape:
    """Places and measures of cells and edges, as the file has them.

    Attributes
    ----------
    edges : (e, d) float
        Places of the edges.
    kites : (h,) float
        Signed area of the kite of generator, edge, begin of the half-edge, and previous edge.
    areas : (n,) float
        Areas of cells as sums of their kites, so that both add up to the same total.
    lengths, distances, angles : (e,) float
        Length of each edge, distance of its generators, and angle of its normal from the x axis, on a sphere from the
        direction to the east.
    reach : (d,) float
        Largest distance of a corner or of a neighbor from the generator of a cell, along each axis.
    """

    edges: np.ndarray
    kites: np.ndarray
    areas: np.ndarray
    lengths: np.ndarray
    distances: np.ndarray
    angles: np.ndarray
    reach: np.ndarray


def measure(diagram: Diagram, halves: HalfEdges) -> Shape:
    """Return the geometry of `diagram` in the plane or on a sphere."""
    if globe := diagram.domain.globe:
        return _on_sphere(diagram, globe, halves)
    return _in_plane(diagram, halves)


def describe(domain: Domain) -> dict[str, str | np.generic]:
    """Return the attributes of the file that describe the domain."""
    if globe := domain.globe:
        return {
            "on_a_sphere": "YES",
            "sphere_radius": np.float64(globe.radius),
            "is_periodic": "NO",
            "x_period": np.float64(0),
            "y_period": np.float64(0),
        }
    periods = np.where(domain.periodic, domain.extent, 0.0)
    return {
        "on_a_sphere": "NO",
        "sphere_radius": np.float64(0),
        "is_periodic": "YES" if periods.any() else "NO",
        "x_period": periods[0],
        "y_period": periods[1],
    }


def coordinates(domain: Domain, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return x, y, z, and latitude and longitude in radians, of `points` (n, d); what the plane lacks is 0.

    Longitudes are in [0, 2 pi), as in the meshes of MPAS.
    """
    globe = domain.globe
    if globe is None:
        nothing = np.zeros(len(points))
        x, y = points.T
        return {"x": x, "y": y, "z": nothing, "lat": nothing, "lon": nothing}
    x, y, z = points.T
    lon, lat = np.radians(globe.lonlat(points)).T
    lon = np.where(lon < 0, lon + 2 * np.pi, lon)
    return {"x": x, "y": y, "z": z, "lat": lat, "lon": np.where(lon < 2 * np.pi, lon, 0.0)}


def _on_sphere(diagram: Diagram, sphere: Sphere, halves: HalfEdges) -> Shape:
    """Return arcs of great circles and spherical areas; all follow from generators and vertices moved onto the sphere.

    The edge is at the middle of the arc between its generators, whose direction is that of their sum. At the boundary
    of a region the other generator is that of the removed cell.
    """
    r, first, edge = sphere.radius, halves.first, halves.edge
    points, vertices = (sphere.wrap(x) / r for x in (diagram.points, diagram.vertices))
    one = points[halves.cell[first]]
    other = sphere.wrap(neighbor_points(diagram, halves.rows[first])) / r
    line = other - one
    middles = one + other
    middles /= np.linalg.norm(middles, axis=1)[:, None]
    begin, end, own = vertices[halves.begin], vertices[halves.end], points[halves.cell]
    kites = triangle_areas(own, middles[edge[halves.previous]], begin)
    kites += triangle_areas(own, begin, middles[edge])
    kites *= r**2
    lengths = np.linalg.norm(end[first] - begin[first], axis=1)
    east, north = _east_and_north(sphere, middles)
    return Shape(
        r * middles,
        kites,
        np.bincount(halves.cell, kites, len(diagram)),
        sphere.lengths(r * lengths),
        sphere.lengths(r * np.linalg.norm(line, axis=1)),
        np.arctan2((line * north).sum(axis=1), (line * east).sum(axis=1)),
        r * np.maximum(np.abs(line).max(axis=0), np.abs(begin - own).max(axis=0)),
    )


def _east_and_north(sphere: Sphere, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors to the east and to the north at `points` (n, 3), those of longitude 0 at the poles."""
    lon, lat = np.radians(sphere.lonlat(points)).T
    nothing = np.zeros(len(points))
    east = np.column_stack([-np.sin(lon), np.cos(lon), nothing])
    return east, np.column_stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])


def _in_plane(diagram: Diagram, halves: HalfEdges) -> Shape:
    """Return lengths and areas in the plane.

    An edge on a wall is at its middle, and its distance of generators is sqrt(3) times its length, as in the tools of
    MPAS. Behind an edge towards a removed cell is the generator of that one.
    """
    own, first = diagram.points[halves.cell], halves.first
    # Relative to the generators of the cells.
    begin, end = (diagram.vertices[v] - own for v in (halves.begin, halves.end))
    behind = diagram.neighbors[halves.rows]
    inner = (behind >= 0) | diagram.domain.removed_behind(-1 - behind)
    line, middle = np.zeros_like(own), (begin + end) / 2
    line[inner] = neighbor_points(diagram, halves.rows[inner]) - own[inner]
    lengths = diagram.face_measures[halves.rows[first]]
    distances = np.where(inner[first], np.hypot(*line[first].T), np.sqrt(3) * lengths)
    foot = np.where(inner[:, None], line / 2, middle)
    kites = (_cross(begin, foot) + _cross(foot[halves.previous], begin)) / 2
    along = (end - begin)[first]
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normals = np.where(inner[first][:, None], line[first], outward)
    return Shape(
        diagram.domain.wrap(own[first] + foot[first]),
        kites,
        np.bincount(halves.cell, kites, len(diagram)),
        lengths,
        distances,
        np.arctan2(normals[:, 1], normals[:, 0]),
        np.abs([begin, line]).max(axis=(0, 1)),
    )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
