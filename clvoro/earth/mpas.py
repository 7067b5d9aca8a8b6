"""Write meshes by the MPAS mesh specification 1.0, for models on C grids of Voronoi cells and their dual.

Cells, edges and vertices are numbered from 1; 0 stands for a missing item. `vertexDegree` is 3 unless more edges meet
at a vertex, as between cocircular generators. The place of an edge is where the line, or the great circle, between its
generators crosses it. The kites of a cell are the quadrilaterals of generator, edge, vertex and next edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..arguments import format_point
from ..connectivity import components
from ..errors import InputError
from ..geometry.domain import Domain
from ..geometry.sphere import Sphere, triangle_areas
from ..io.contents import Contents
from ..io.netcdf import NetCDF, squared
from ..mesh.diagram import Diagram
from ..mesh.faces import OFF_BISECTOR
from ..mesh.half_faces import HalfEdges
from ..mesh.straightening import cross
from .c_grid import coast_faults, find_weights, off_bisector


@dataclass(frozen=True)
class Shape:
    """Places and measures of cells and edges, as the file has them."""

    edges: np.ndarray
    """(e, d) float. Places of the edges."""
    kites: np.ndarray
    """(h,) float. Signed area of the kite of generator, edge, begin of the half-edge, and previous edge."""
    areas: np.ndarray
    """(n,) float. Areas of cells as sums of their kites, so that both add up to the same total."""
    lengths: np.ndarray
    distances: np.ndarray
    angles: np.ndarray
    """`lengths`, `distances`, `angles`: (e,) float. Length of each edge, distance of its generators, and angle of its
    normal from the x axis, on a sphere from the direction to the east."""
    reach: np.ndarray
    """(d,) float. Largest distance of a corner or of a neighbor from the generator of a cell, along each axis."""


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
    other = sphere.wrap(diagram.half_faces.behind(halves.rows[first])) / r
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
    MPAS. Behind an edge towards a removed cell is the generator of that one, unless the edge is off their bisector,
    because a wall has cut the removed cell: then it is as on a wall.
    """
    own, first = diagram.points[halves.cell], halves.first
    # Relative to the generators of the cells.
    begin, end = (diagram.vertices[v] - own for v in (halves.begin, halves.end))
    behind = diagram.neighbors[halves.rows]
    inner = (behind >= 0) | diagram.domain.removed_behind(-1 - behind)
    line, middle = np.zeros_like(own), (begin + end) / 2
    line[inner] = diagram.half_faces.behind(halves.rows[inner]) - own[inner]
    inner &= off_bisector(begin, end, line) <= OFF_BISECTOR
    lengths = diagram.face_measures[halves.rows[first]]
    distances = np.where(inner[first], np.hypot(*line[first].T), np.sqrt(3) * lengths)
    foot = np.where(inner[:, None], line / 2, middle)
    kites = (cross(begin, foot) + cross(foot[halves.previous], begin)) / 2
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


ZONES = "bdyMaskCell"
"""Cell data from which those of edges and vertices follow; see `clvoro.earth.rings`."""


def write_mpas(contents: Contents, path: Path, unit: str = "m") -> None:
    """Write the mesh with coordinates in `unit`. In a periodic box each edge and vertex at a seam exists once."""
    _describe(contents, path, unit).write()


def _describe(contents: Contents, path: Path, unit: str) -> NetCDF:
    diagram, domain = contents.diagram, contents.diagram.domain
    diagram.demand_voronoi("an MPAS file")
    halves = diagram.half_faces.edges(glued=True)
    _check_loops(halves, path)
    _check_coasts(diagram, path)
    shape = measure(diagram, halves)
    periods = np.where(domain.periodic, domain.extent, 0.0)
    _check_reach(shape.reach, periods, path)
    around = _walk_around(halves)
    n, e, v = len(diagram), len(halves.first), len(around.corners)
    width, degree = int(halves.counts.max()), around.edges.shape[1]
    file = NetCDF(
        path,
        contents,
        {
            "nCells": n,
            "nEdges": e,
            "nVertices": v,
            "maxEdges": width,
            "maxEdges2": 2 * width,
            "TWO": 2,
            "vertexDegree": degree,
        },
        {**describe(domain), "mesh_spec": "1.0", "Conventions": "MPAS"},
    )
    places = {
        "Cell": domain.wrap(diagram.points),
        "Edge": shape.edges,
        "Vertex": domain.wrap(diagram.vertices[halves.begin[around.corners[:, 0]]]),
    }
    for name, points in places.items():
        plural = ("nVertices" if name == "Vertex" else f"n{name}s",)
        for axis, values in coordinates(domain, points).items():
            file.add(f"{axis}{name}", plural, values, units="rad" if len(axis) > 1 else unit)
        file.add(f"indexTo{name}ID", plural, np.arange(1, len(points) + 1))
    _add_graph(file, halves, around)
    _add_measures(file, around, shape, unit)
    weights = find_weights(halves, shape.kites / shape.areas[halves.cell], shape.lengths, shape.distances)
    wide = ("nEdges", "maxEdges2")
    file.add("nEdgesOnEdge", ("nEdges",), weights.counts)
    for name, items in (("edges", weights.edges + 1), ("weights", weights.values)):
        file.add_rows(f"{name}OnEdge", wide, weights.counts, items, 0)
    run = contents.result
    size = np.sqrt(diagram.volumes) if run is None else run.target_size
    file.add("meshDensity", ("nCells",), (size.min() / size) ** 4)
    file.add_extra("nCells")
    _add_zones(file, contents.extra.get(ZONES), halves, around)
    return file


def _add_zones(file: NetCDF, zones: np.ndarray | None, halves: HalfEdges, around: _Around) -> None:
    """Add the zones at the boundary of a limited area for edges and vertices: the lowest one of their cells.

    MPAS-Atmosphere reads all three. It computes 0, relaxes 1 to 5, and is given 6 and 7.
    """
    if zones is None or zones.ndim != 1:
        return
    here = zones[halves.cell]
    beside = np.where(halves.twin >= 0, here[halves.twin], here)
    file.add("bdyMaskEdge", ("nEdges",), np.minimum(here, beside)[halves.first])
    most = zones.max()
    at_vertex = np.where(around.corners >= 0, here[around.corners], most).min(axis=1)
    file.add("bdyMaskVertex", ("nVertices",), at_vertex)


def _add_graph(file: NetCDF, halves: HalfEdges, around: _Around) -> None:
    first, corners = halves.first, around.corners
    across = np.where(halves.twin >= 0, halves.cell[halves.twin] + 1, 0)
    ends = around.vertex[halves.next]
    # Around a cell, vertex k lies between edges k and k + 1. Around a vertex, so does cell k.
    on_cell = {"cells": across, "edges": halves.edge + 1, "vertices": ends + 1}
    for name, items in on_cell.items():
        file.add_rows(f"{name}OnCell", ("nCells", "maxEdges"), halves.counts, items, 0)
    file.add("nEdgesOnCell", ("nCells",), halves.counts)
    pairs = {"cells": (halves.cell + 1, across), "vertices": (around.vertex + 1, ends + 1)}
    for name, (one, other) in pairs.items():
        file.add(f"{name}OnEdge", ("nEdges", "TWO"), np.stack([one[first], other[first]], axis=1))
    at_vertex = {"cells": np.where(corners >= 0, halves.cell[corners] + 1, 0), "edges": around.edges + 1}
    for name, table in at_vertex.items():
        file.add(f"{name}OnVertex", ("nVertices", "vertexDegree"), table)


def _add_measures(file: NetCDF, around: _Around, shape: Shape, unit: str) -> None:
    area = squared(unit)
    kites = np.where(around.corners >= 0, shape.kites[around.corners], 0.0)
    file.add("kiteAreasOnVertex", ("nVertices", "vertexDegree"), kites, units=area)
    file.add("areaTriangle", ("nVertices",), kites.sum(axis=1), units=area)
    file.add("areaCell", ("nCells",), shape.areas, units=area)
    file.add("dvEdge", ("nEdges",), shape.lengths, units=unit)
    file.add("dcEdge", ("nEdges",), shape.distances, units=unit)
    file.add("angleEdge", ("nEdges",), shape.angles, units="rad")


@dataclass(frozen=True)
class _Around:
    """Cells and edges around each vertex, counter-clockwise; at the boundary they begin at the boundary."""

    vertex: np.ndarray
    """(h,) int. Number of the vertex where each half-edge begins."""
    corners: np.ndarray
    """(v, k) int. The half-edges that begin at each vertex, then -1. Each stands for the corner of its cell."""
    edges: np.ndarray
    """(v, k) int. The edges at each vertex, then -1; on the boundary one more than corners."""


def _walk_around(halves: HalfEdges) -> _Around:
    """Find the vertices from the connectivity of half-edges: once at a seam, but once for each side of a slit."""
    h = len(halves.cell)
    onward = halves.twin[halves.previous]
    joined = np.flatnonzero(onward >= 0)
    label = components(h, joined, onward[joined])[1]
    # Vertices are numbered by their lowest half-edge. At the boundary the first edge is the one on it.
    rank = np.lexsort((np.arange(h), halves.twin >= 0, label))
    begins = rank[np.flatnonzero(np.diff(label[rank], prepend=-1))]
    least = np.full(len(begins), h)
    np.minimum.at(least, label, np.arange(h))
    by_least = np.argsort(least)
    number = np.empty(len(begins), np.int64)
    number[by_least] = np.arange(len(begins))
    corners, current = [], begins[by_least]
    start = current
    while (current >= 0).any():
        corners.append(current)
        following = np.where(current >= 0, onward[current], -1)
        current = np.where(following == start, -1, following)
    corners = np.stack(corners, axis=1)
    cells = (corners >= 0).sum(axis=1)
    is_open = halves.twin[start] < 0
    degree = max(3, int((cells + is_open).max()))
    corners = np.pad(corners, ((0, 0), (0, degree - corners.shape[1])), constant_values=-1)
    edges = np.where(corners >= 0, halves.edge[corners], -1)
    last = np.flatnonzero(is_open)
    final = corners[last, cells[last] - 1]
    edges[last, cells[last]] = halves.edge[halves.previous[final]]
    return _Around(number[label], corners, edges)


def _check_loops(halves: HalfEdges, path: Path) -> None:
    loops = np.bincount(halves.cell[halves.next <= np.arange(len(halves.cell))])
    several = np.flatnonzero(loops > 1)
    if several.size:
        raise InputError(
            f"cannot write {path}: cell {several[0]} ({several.size} in all) goes around a part of the boundary, and "
            "cells in MPAS have no holes; use smaller cells there, leave out the hole, or leave out convention='mpas'"
        )


def _check_coasts(diagram: Diagram, path: Path) -> None:
    """Refuse cells that a wall has cut so that edges are off bisectors, or four meet."""
    faults = coast_faults(diagram)
    if faults:
        said = [
            f"{_FAULTS[c.name]}: {c.count}, the worst {c.value:.3g} at {format_point(c.place or ())}" for c in faults
        ]
        raise InputError(
            f"cannot write {path}: models on C grids have three edges at each vertex, on the bisectors of cells, and "
            f"the walls of {diagram.domain} break that ({'; '.join(said)}). Mesh a box or a larger polygon, "
            "and remove cells: mesh.subset(polygon) keeps those with their generators in polygon; "
            "mesh.boundary_cells() lists the cells at walls"
        )


_FAULTS = {
    "edge off its bisector": "edges off the bisector of their cells",
    "edges at a vertex": "vertices with more edges",
}


def _check_reach(reach: np.ndarray, periods: np.ndarray, path: Path) -> None:
    """Refuse cells that reach half a period, because readers of the file assume nearest images."""
    far = np.flatnonzero((periods > 0) & (reach > 0.499 * periods))
    if far.size:
        raise InputError(
            f"cannot write {path}: cells reach {reach[far[0]]:.3g} across a period of {periods[far[0]]:.3g}, and MPAS "
            "uses nearest images, which half a period away are ambiguous; use more cells, or leave out "
            "convention='mpas'"
        )
