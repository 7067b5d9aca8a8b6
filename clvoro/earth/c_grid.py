"""Measures of a mesh for C grids, on which unknowns are at the cells, the edges and the vertices.

Such schemes interpolate between a Voronoi diagram and its Delaunay triangles, as TRiSK does (Thuburn et al. 2009, J.
Comput. Phys. 228, 8321; Ringler et al. 2010, J. Comput. Phys. 229, 3065). They need vertices inside of their triangles,
and edges that cross in their middles (Heikes and Randall 1995, Mon. Weather Rev. 123, 1881; Engwirda 2018, J. Comput.
Phys. 375, 155).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..mesh.diagram import Diagram

RIGHT_ANGLE = 90 + 1e-4
"""Angle in degrees above which a triangle counts as obtuse. Those of a square lattice have 90 up to round-off."""


@dataclass(frozen=True, repr=False)
class CGridMeasures:
    """Measures for C grids per cell (n,), per half-face (m,), or per corner of a cell that is not on a wall (k,)."""

    angles: np.ndarray
    """(k,) float. Angles of the Delaunay triangles in degrees, each once: the one opposite to the side that belongs to
    half-face ``corners[k]``, in the triangle around the vertex where that half-face begins. On a sphere these are
    angles of flat triangles: the vertex is outside of its triangle exactly if one of them is obtuse. Where more than
    three cells meet, the third corner is any other generator there, and only sides of cells count."""
    corners: np.ndarray
    """(k,) int. The half-faces that begin in these corners."""
    kites: np.ndarray
    """(k,) float. Signed area of the quadrilateral of generator, middle of one side, vertex and middle of the next
    side, as a share of the area of its cell. The middles are those of the lines between generators (MPAS:
    `kiteAreasOnVertex` over `areaCell`). Negative where the vertex is far outside of its triangle."""
    edge_offset: np.ndarray
    """(m,) float. Distance between the middle of the Voronoi edge and the middle of its Delaunay edge, over the length
    of the Voronoi edge (MPAS: `dvEdge`). 0 is ideal. Beyond 1/2 the two edges do not cross: a vertex is outside of its
    triangle. Infinite for edges without length; 0 on walls. Over the distance of the generators (`dcEdge`) this
    distance is `Measures.skewness`."""
    length_ratio: np.ndarray
    """(m,) float. Length of the Voronoi edge over the distance of its generators (`dvEdge` over `dcEdge`); 0.58 in a
    lattice of regular hexagons, 0 on walls."""
    centroid_offset: np.ndarray
    """(n,) float. Distance from the generator to the centroid over the square root of the cell's area; 0 in a
    centroidal diagram."""
    edge_ratio: np.ndarray
    """(n,) float. Shortest over longest edge of the cell."""
    off_bisector: np.ndarray
    """(m,) float. Distance of the ends of the edge from the bisector of its generators, over the distance of these. It
    is not 0 where a part of a cell that the boundary of a polygon cuts off belongs to another cell. 0 on walls."""
    inner: np.ndarray
    """(m,) bool. Whether the half-face is between two cells."""
    vertex_cells: np.ndarray
    """(k,) int. Number of cells that meet in the vertex; 3 in general."""
    first: np.ndarray
    """(k,) bool. True at one corner of each vertex."""

    @property
    def obtuse(self) -> int:
        """Number of obtuse triangles: of vertices outside of their triangles."""
        return int(np.count_nonzero(self.angles > RIGHT_ANGLE))

    @property
    def negative_kites(self) -> int:
        """Number of kites with a negative area."""
        return int(np.count_nonzero(self.kites < 0))

    def __repr__(self) -> str:
        s = self.summary()
        return (
            f"CGridMeasures(angles {s['min_angle']:.1f}° to {s['max_angle']:.1f}°, {s['obtuse']} obtuse triangles, "
            f"edge offset mean {s['mean_edge_offset']:.3f}, max {s['max_edge_offset']:.3f})"
        )

    def summary(self) -> dict[str, Any]:
        """Return counts, means and worst values by name; those of edges are over the edges between two cells."""
        offset = self.edge_offset[self.inner]
        some, nothing = len(self.angles) > 0, float("nan")
        return {
            "min_angle": float(self.angles.min()) if some else nothing,
            "max_angle": float(self.angles.max()) if some else nothing,
            "obtuse": self.obtuse,
            "min_kite": float(self.kites.min()) if some else nothing,
            "negative_kites": self.negative_kites,
            "mean_edge_offset": float(offset.mean()) if len(offset) else 0.0,
            "max_edge_offset": float(offset.max(initial=0)),
            "mean_centroid_offset": float(self.centroid_offset.mean()),
            "max_centroid_offset": float(self.centroid_offset.max()),
            "mean_edge_ratio": float(self.edge_ratio.mean()),
            "min_edge_ratio": float(self.edge_ratio.min()),
        }


def measure_c_grid(diagram: Diagram) -> CGridMeasures:
    """Measure a diagram on a sphere or in the plane as a C grid.

    Raises `InputError` in 3D.
    """
    d, domain = diagram, diagram.domain
    diagram.demand_voronoi("c_grid")
    if domain.cell_dim != 2:
        raise InputError(
            f"measures for C grids are for meshes on a Sphere and in the plane, not for {domain}; use the other "
            "entries of measures"
        )
    owner, inner = d.half_faces.owner, d.neighbors >= 0
    after = d.half_faces.next
    before = np.argsort(after)
    corners = np.flatnonzero(inner & inner[before])
    begin, end = d.vertices[d.half_faces.ends.T]
    own, line = d.points[owner], np.zeros_like(begin)
    line[inner] = d.half_faces.behind(np.flatnonzero(inner)) - own[inner]
    distance = np.maximum(np.linalg.norm(line, axis=1), 1e-300)
    normal, middle = line / distance[:, None], own + line / 2
    angles = _angles(begin[corners], middle[corners], normal[corners], distance[corners])
    middle = domain.onto(middle)
    offset = domain.lengths(np.linalg.norm(d.face_centroids - middle, axis=1))
    distance = domain.lengths(distance)
    away = domain.lengths(np.linalg.norm(d.centroids - d.points, axis=1))
    relative = np.full(len(offset), np.inf)
    np.divide(offset, d.face_measures, out=relative, where=d.face_measures > 0)
    sides = [middle[before[corners]], begin[corners], middle[corners]]
    kites = _kites(d, own[corners], *sides) / d.volumes[owner[corners]]
    ratio = d.measures.face_ratio
    return CGridMeasures(
        angles,
        corners,
        kites,
        np.where(inner, relative, 0.0),
        np.where(inner, d.face_measures / distance, 0.0),
        away / np.sqrt(d.volumes),
        ratio,
        off_bisector(begin - own, end - own, line) if domain.cuts_cells else np.zeros(len(line)),
        inner,
        *_cells_around(d, corners, after),
    )


def off_bisector(begin: np.ndarray, end: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Return how far edges are from the bisectors of their generators (k,); see `CGridMeasures`.

    `begin`, `end` and the other generator, `line`, are relative to one generator; `line` is 0 on walls.
    """
    square = np.maximum((line**2).sum(axis=1), 1e-300)
    shares = [(x * line).sum(axis=1) / square for x in (begin, end)]
    return np.where(line.any(axis=1), np.abs(np.subtract(shares, 0.5)).max(axis=0), 0.0)


def _angles(vertex: np.ndarray, middle: np.ndarray, normal: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Return the angles in degrees under which Delaunay edges appear from the circles around their vertices, (k,).

    By the inscribed angle theorem this is the angle opposite to the edge in any triangle of generators on the circle.
    With R the radius of the circle, half the edge is R sin(angle), and its signed distance from the center R
    cos(angle). The edge is given by its middle, its direction and its length. The vertex begins the Voronoi edge.
    """
    if vertex.shape[1] == 3:
        up = vertex / np.linalg.norm(vertex, axis=1)[:, None]
        along = np.cross(up, normal)
    else:
        along = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    height = ((middle - vertex) * along).sum(axis=1)
    return np.degrees(np.arctan2(distance / 2, height))


def _cells_around(d: Diagram, corners: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how many cells meet where half-faces begin, and which corner of a vertex is its first one, (k,) each.

    A walk around the vertex needs no numbers of vertices, which differ between images across seams.
    """
    opposite = d.half_faces.opposite
    turn = np.where(opposite >= 0, after[opposite], -1)
    counts, at, walking = np.zeros(len(corners), np.int64), corners, np.arange(len(corners))
    first = np.ones(len(corners), bool)
    while len(walking):
        at = turn[at]
        counts[walking] += 1
        first[walking] &= (at >= corners[walking]) | (at < 0)
        onward = (at != corners[walking]) & (at >= 0)  # a wall ends the walk
        at, walking = at[onward], walking[onward]
    return counts, first


def _kites(d: Diagram, own: np.ndarray, before: np.ndarray, vertex: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the signed areas of quadrilaterals own, before, vertex, after, counter-clockwise, (k,)."""
    areas = d.domain.triangle_areas
    return areas(own, before, vertex) + areas(own, vertex, after)
