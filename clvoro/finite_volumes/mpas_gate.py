"""Whether a mesh suits models on C grids such as MPAS: the criteria of `check(solver="mpas")`.

The schemes need positive lengths and areas, and vertices inside of their Delaunay triangles (see `mesh.c_grid`). The
limits of criteria that only warn are rules of thumb.
"""

from __future__ import annotations

import numpy as np

from ..mesh.c_grid import RIGHT_ANGLE, measure_c_grid
from ..mesh.connectivity import face_ends, face_keys, face_owners
from ..mesh.diagram import Diagram
from .criteria import Criterion, Rows

LEAST_AREA = 1e-300
"""Areas must be positive."""
SHORTEST_EDGE = 1e-6
"""Least length of an edge over the distance of its generators: the schemes divide by lengths of edges."""
LEAST_ANGLE = 30.0
"""Angle of a triangle, in degrees, below which the mesh is warned of."""
LEAST_EDGE_RATIO = 0.1
"""Ratio of the shortest to the longest edge of a cell below which the mesh is warned of."""
MOST_CENTROID_OFFSET = 0.1
"""Distance from generator to centroid over the size of the cell above which the mesh is warned of.

C grids take the value at the generator for the mean over the cell, which is of second order at the centroid only."""


def mpas_criteria(diagram: Diagram) -> list[Criterion]:
    """Return the criteria for meshes of MPAS.

    Raises
    ------
    InputError
        In 3D and in polygonal domains.
    """
    d, m = diagram, measure_c_grid(diagram)
    dim, owner = d.domain.dim, face_owners(diagram)
    inner = np.flatnonzero(m.inner)
    inner = inner[np.less(*face_keys(d, inner))]  # each edge once
    cells = Rows(d.points, None, dim)
    edges = Rows(d.face_centroids[inner], owner[inner], dim)
    places, cell = d.vertices[face_ends(d)[m.corners, 0]], owner[m.corners]
    corners, vertices = Rows(places, cell, dim), Rows(places[m.first], cell[m.first], dim)
    return [
        cells("edges of a cell", np.diff(d.neighbor_starts), 3, above=False),
        cells("cell area", d.volumes, LEAST_AREA, above=False),
        edges("edge length over distance", m.length_ratio[inner], SHORTEST_EDGE, above=False),
        corners("largest angle of triangle", m.angles, RIGHT_ANGLE),
        corners("smallest angle of triangle", m.angles, LEAST_ANGLE, above=False, demanded=False),
        corners("kite area over cell area", m.kites, 0, above=False),
        vertices("cells at a vertex", m.vertex_cells[m.first], 3, demanded=False),
        edges("edge offset", m.edge_offset[inner], 0.5, demanded=False),
        cells("centroid offset", m.centroid_offset, MOST_CENTROID_OFFSET, demanded=False),
        cells("edge ratio", m.edge_ratio, LEAST_EDGE_RATIO, above=False, demanded=False),
    ]
