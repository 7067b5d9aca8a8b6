"""Whether models on C grids accept a mesh: the criteria of the solver "mpas"."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..finite_volumes.criteria import Criterion, Rows, SolverReport
from ..finite_volumes.gate import LEAST_MEASURE
from ..finite_volumes.solver_mesh import WallShape
from ..mesh.diagram import Diagram
from ..mesh.faces import OFF_BISECTOR
from .c_grid import RIGHT_ANGLE, CGridMeasures, measure_c_grid

_SHORTEST_EDGE = 1e-6
"""Least ratio of the length of an edge to the distance of its generators: C-grid schemes divide by the length."""
_LEAST_ANGLE = 30.0
"""Angle of a triangle, in degrees, below which the mesh is warned of."""
_LEAST_EDGE_RATIO = 0.1
"""Ratio of the shortest to the longest edge of a cell below which the mesh is warned of."""
_MOST_CENTROID_OFFSET = 0.1
"""Distance from generator to centroid over the size of the cell above which the mesh is warned of.

C grids take the value at the generator for the mean over the cell, which is of second order at the centroid only."""


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
