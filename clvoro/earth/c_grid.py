"""Measures, weights and criteria of a mesh for C grids, on which unknowns are at the cells, the edges and the vertices.

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
from ..finite_volumes.criteria import Criterion, Rows, SolverReport
from ..finite_volumes.gate import LEAST_MEASURE
from ..finite_volumes.solver_mesh import WallShape
from ..mesh.diagram import Diagram
from ..mesh.faces import OFF_BISECTOR
from ..mesh.half_faces import HalfEdges

_SHORTEST_EDGE = 1e-6
"""Least ratio of the length of an edge to the distance of its generators: C-grid schemes divide by the length."""
_LEAST_ANGLE = 30.0
"""Angle of a triangle, in degrees, below which the mesh is warned of."""
_LEAST_EDGE_RATIO = 0.1
"""Ratio of the shortest to the longest edge of a cell below which the mesh is warned of."""
_MOST_CENTROID_OFFSET = 0.1
"""Distance from generator to centroid over the size of the cell above which the mesh is warned of.

C grids take the value at the generator for the mean over the cell, which is of second order at the centroid only."""


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


def check_for_mpas(diagram: Diagram, walls: WallShape | None) -> SolverReport:
    """Check `diagram` by the criteria of models on C grids.

    Raises `InputError` in 3D, or if `walls` is given.
    """
    if walls is not None:
        raise InputError(f"walls is {walls!r:.60}, and solver 'mpas'; walls are for 'openfoam', leave it out")
    faces, domain, made = int(diagram.faces.owner.size), diagram.domain, _criteria(diagram)
    if domain.globe:
        made = [criterion.on_sphere(domain.globe) for criterion in made]
    return SolverReport("mpas", tuple(made), len(diagram), faces, 0.0)


def _edges_once(diagram: Diagram, m: CGridMeasures) -> tuple[np.ndarray, Rows]:
    """Return a half-face for each edge between two cells, (k,) int, and these edges as `Rows`, which make criteria."""
    inner = np.flatnonzero(m.inner)
    inner = inner[inner < diagram.half_faces.opposite[inner]]
    return inner, Rows(diagram.face_centroids[inner], diagram.half_faces.owner[inner], diagram.domain.dim)


def _at_walls(diagram: Diagram, edges: Rows, off_bisector: np.ndarray) -> list[Criterion]:
    """Return the criteria that cut cells at walls may break: edges lie on bisectors, and three meet at a vertex."""
    if not diagram.domain.cuts_cells:
        return []
    f = diagram.faces
    ends = f.corners.reshape(-1, 2)
    count = np.bincount(ends.ravel(), minlength=len(f.points))
    at_wall, row = np.unique(ends[f.n_inner :], return_index=True)
    vertices = Rows(f.points[at_wall], f.owner[f.n_inner :][row // 2], f.dim)
    return [
        edges("edge off its bisector", off_bisector, OFF_BISECTOR),
        vertices("edges at a vertex", count[at_wall], 3),
    ]


def coast_faults(diagram: Diagram) -> list[Criterion]:
    """Return the criteria that the walls of a polygon break, so that no model on a C grid can use the mesh."""
    if not diagram.domain.cuts_cells:
        return []
    m = measure_c_grid(diagram)
    inner, edges = _edges_once(diagram, m)
    return [c for c in _at_walls(diagram, edges, m.off_bisector[inner]) if not c.ok]


def _criteria(diagram: Diagram) -> list[Criterion]:
    """Return the criteria for meshes of MPAS."""
    d, m = diagram, measure_c_grid(diagram)
    dim, owner = d.domain.dim, diagram.half_faces.owner
    inner, edges = _edges_once(d, m)
    cells = Rows(d.points, None, dim)
    places, cell = d.vertices[d.half_faces.ends[m.corners, 0]], owner[m.corners]
    corners, vertices = Rows(places, cell, dim), Rows(places[m.first], cell[m.first], dim)
    return [
        *_at_walls(diagram, edges, m.off_bisector[inner]),
        cells("edges of a cell", np.diff(d.neighbor_starts), 3, above=False),
        cells("cell area", d.volumes, LEAST_MEASURE, above=False),
        edges("edge length over distance", m.length_ratio[inner], _SHORTEST_EDGE, above=False),
        corners("largest angle of triangle", m.angles, RIGHT_ANGLE),
        corners("smallest angle of triangle", m.angles, _LEAST_ANGLE, above=False, demanded=False),
        corners("kite area over cell area", m.kites, 0, above=False),
        vertices("cells at a vertex", m.vertex_cells[m.first], 3, demanded=False),
        edges("edge offset", m.edge_offset[inner], 0.5, demanded=False),
        cells("centroid offset", m.centroid_offset, _MOST_CENTROID_OFFSET, demanded=False),
        cells("edge ratio", m.edge_ratio, _LEAST_EDGE_RATIO, above=False, demanded=False),
    ]


@dataclass(frozen=True)
class Weights:
    """Weights for tangential velocities (Thuburn et al. 2009), as ragged rows, one per edge.

    The tangential velocity at edge e is the sum of w(e, e') u(e') over all other edges e' of its two cells i, with the
    normal velocities u and

        w(e, e') = n(e, i) n(e', i) (1/2 - sum R) l(e') / d(e)

    Here l is the length of an edge, d the distance of its generators, and n is 1 if the normal of the edge points out
    of the cell, -1 if it points inwards. R is the share of a vertex' kite in the area of the cell. The sum of R is over
    the vertices between e and e', counter-clockwise around the cell.
    """

    counts: np.ndarray
    """(e,) int. Number of other edges in each row."""
    edges: np.ndarray
    """(w,) int. The other edges, counter-clockwise from the edge on: those of the lower cell, then those of the other
    cell."""
    values: np.ndarray
    """(w,) float. The weight of each of these edges."""


def find_weights(halves: HalfEdges, shares: np.ndarray, lengths: np.ndarray, distances: np.ndarray) -> Weights:
    """Return the weights. The normal of an edge points out of its lower cell.

    - `shares` (h,) float: share of the kite at the begin of each half-edge in the area of its cell.
    - `lengths`, `distances` (e,) float: lengths of edges, and distances between their generators.
    """
    sides = halves.counts[halves.cell]
    first, twin = halves.first, halves.twin[halves.first]
    counts = sides[first] - 1
    pairs = twin >= 0
    place = np.empty(len(sides), np.int64)
    place[twin[pairs]] = counts[pairs]
    counts[pairs] += sides[twin[pairs]] - 1
    place[first] = 0
    place += (np.cumsum(counts) - counts)[halves.edge]
    normal = np.full(len(sides), -1.0)
    normal[first] = 1
    edges, values = np.empty(counts.sum(), np.int64), np.empty(counts.sum())
    here = there = np.arange(len(sides))
    passed = np.zeros(len(sides))
    for step in range(1, int(sides.max())):
        going = sides[here] > step
        here, there = here[going], halves.next[there[going]]
        passed = passed[going] + shares[there]
        at, edge = place[here] + step - 1, halves.edge[there]
        edges[at] = edge
        # Files of others may have distances of 0. They are refused later.
        with np.errstate(divide="ignore"):
            ratio = lengths[edge] / distances[halves.edge[here]]
        values[at] = normal[here] * normal[there] * (0.5 - passed) * ratio
    return Weights(counts, edges, values)
