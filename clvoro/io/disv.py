"""Diagrams in 2D as the grid of MODFLOW 6's DISV package, with boundaries by name; FloPy writes the files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..connectivity import first_nodes, take_rows
from ..errors import InputError
from ..finite_volumes.criteria import Criterion, Rows, SolverReport
from ..finite_volumes.gate import LEAST_MEASURE, SOLVERS, around_islands, regions
from ..finite_volumes.prisms import cell_loops
from ..finite_volumes.solver_mesh import WallShape
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import smaller_size
from ..mesh.read_only import Sealed

_EMPTY = 1e-5
"""Length of faces that are left out, over the width of the smaller of their cells."""
_OBLIQUE = 1.0
"""Angle in degrees between a face's normal and the line between its centers, above which the check warns: fluxes then
need MODFLOW's option XT3D."""


@dataclass(frozen=True, eq=False)
class DisvBoundary(Sealed):
    """The faces of a DISV grid on one boundary of the domain.

    Attributes
    ----------
    cells : (k,) int32
        Cell of each face, from 0 as in FloPy; ascending. A cell with several faces is listed several times.
    lengths : (k,) float64
        Lengths of the faces.
    distances : (k,) float64
        Distances of the faces from the centers of their cells.
    feet : (k, 2) float64
        Points of the faces that are nearest to the centers of their cells, where the boundary's head belongs.
    """

    cells: np.ndarray
    lengths: np.ndarray
    distances: np.ndarray
    feet: np.ndarray

    def __len__(self) -> int:
        return len(self.cells)

    def conductance(self, transmissivity: float | np.ndarray) -> np.ndarray:
        """Return the conductance between boundary and cell center, (k,), as the packages GHB, RIV and DRN take it.

        Parameters
        ----------
        transmissivity : float or (k,) array
            Hydraulic conductivity times thickness of the layer, of all faces or of each.
        """
        return transmissivity * self.lengths / self.distances


class DisvBoundaries(dict[str, DisvBoundary]):
    """Faces on each boundary of the domain, by its name."""

    def __missing__(self, name: object) -> DisvBoundary:
        raise InputError(f"boundaries has no {name!r:.60}, expected the name of a boundary: {', '.join(self)}")


@dataclass(frozen=True, eq=False)
class Disv(Sealed):
    """A grid for MODFLOW 6's DISV package; see `Diagram.to_disv`.

    Attributes
    ----------
    vertices : (v, 2) float64
    cell_vertex_starts : (n + 1,) int64
    cell_vertices : (k,) int64
        Vertices of cell i, ``cell_vertices[cell_vertex_starts[i]:cell_vertex_starts[i + 1]]``, clockwise.
    centers : (n, 2) float64
        Centers of the cells: the generators.
    boundaries : dict of DisvBoundary
        Faces on each boundary of the domain, by its name. Another name raises InputError.
    lines : (k, 2) int64
        The two cells of each face on lines inside the domain, as the package HFB takes them.
    """

    vertices: np.ndarray
    cell_vertex_starts: np.ndarray
    cell_vertices: np.ndarray
    centers: np.ndarray
    boundaries: DisvBoundaries
    lines: np.ndarray

    @property
    def gridprops(self) -> dict[str, Any]:
        """Arguments of FloPy's ``ModflowGwfdisv``: ``nvert``, ``ncpl``, ``vertices`` and ``cell2d``, from 0."""
        corners = np.split(self.cell_vertices, self.cell_vertex_starts[1:-1])
        return {
            "nvert": len(self.vertices),
            "ncpl": len(self.centers),
            "vertices": [(k, *x) for k, x in enumerate(self.vertices.tolist())],
            "cell2d": [
                (i, *x, len(c), *c.tolist())
                for i, (x, c) in enumerate(zip(self.centers.tolist(), corners, strict=True))
            ],
        }

    def __repr__(self) -> str:
        return f"Disv({len(self.centers)} cells, {len(self.vertices)} vertices; {', '.join(self.boundaries)})"


def _without_empty_faces(mesh: Faces) -> Faces:
    """Return `mesh` without faces between cells of nearly no length, as round-off and curved walls leave them.

    MODFLOW divides by their length, and their normals may point anywhere.
    """
    ends = mesh.corners.reshape(-1, 2)
    a, b = mesh.points[ends].swapaxes(0, 1)
    short = np.hypot(*(b - a).T) <= _EMPTY * smaller_size(mesh.owner, mesh.neighbor, np.sqrt(np.abs(mesh.volumes)))
    short[mesh.n_inner :] = False
    if not short.any():
        return mesh
    # Several such faces may be in a row. All their ends become the first one.
    into = first_nodes(len(mesh.points), *ends[short].T)
    return replace(mesh, corners=into[mesh.corners]).take_faces(~short).compact()


def _disv_mesh(diagram: Diagram, walls: WallShape) -> Faces:
    """Return the mesh that a DISV grid consists of, or raise an error for one that DISV cannot hold."""
    domain = diagram.domain
    diagram.demand_voronoi("to_disv")
    domain.require_plane(
        "DISV grids are layers of cells in the plane",
        "project the region, mesh it as a clvoro.Polygon, and give MODFLOW the layers",
    )
    if any(domain.periodic):
        raise InputError("DISV grids have no periodic sides, and this box has; use a box without periodic directions")
    return _without_empty_faces(diagram.solver_mesh(walls, collapse=False))


def check_for_modflow(diagram: Diagram, walls: WallShape | None) -> SolverReport:
    """Check `diagram` by the demands of MODFLOW 6 on DISV grids, and of its control-volume differences on cells."""
    mesh = _disv_mesh(diagram, walls or "straight")
    around = around_islands(mesh)
    made = [around] if around is not None else _criteria(mesh)
    return SolverReport("modflow", tuple(made), mesh.n_cells, len(mesh), mesh.area_change, str(mesh.left_out))


SOLVERS["modflow"] = check_for_modflow


def _criteria(mesh: Faces) -> list[Criterion]:
    inner = np.arange(mesh.n_inner)
    own, other = mesh.owner[inner], mesh.neighbor[inner]
    line, normal = mesh.generators[other] - mesh.generators[own], mesh.normal[inner]
    across = np.abs(line[:, 0] * normal[:, 1] - line[:, 1] * normal[:, 0])
    angle = np.degrees(np.arctan2(across, np.einsum("ij,ij->i", line, normal)))
    cells, faces = Rows(mesh.generators, None, 2), Rows(mesh.center[inner], own, 2)
    return [
        cells("vertices of a cell", np.bincount(mesh.sides()[0], minlength=mesh.n_cells), 3, above=False),
        cells("cell area", mesh.volumes, LEAST_MEASURE, above=False),
        faces("center to face", np.minimum(mesh.near[inner], mesh.far[inner]), LEAST_MEASURE, above=False),
        faces("angle to the normal", angle, _OBLIQUE, demanded=False),
        regions(mesh),
    ]


def make_disv(diagram: Diagram, walls: WallShape) -> Disv:
    """Return the DISV grid of `diagram`; see `Diagram.to_disv`."""
    domain, mesh = diagram.domain, _disv_mesh(diagram, walls)
    starts, loops = cell_loops(mesh)
    cells = np.arange(mesh.n_cells)
    found = DisvBoundaries()
    for k, name in enumerate(domain.boundary_names):
        rows = np.flatnonzero(mesh.boundary == k)
        rows = rows[np.argsort(mesh.owner[rows], kind="stable")]
        found[name] = DisvBoundary(mesh.owner[rows], mesh.area[rows], mesh.near[rows], mesh.foot[rows])
    starts, corners = take_rows(starts, loops, cells, np.ones(len(cells), bool))
    inner, faces, rows = _pairs(mesh, np.arange(mesh.n_inner)), diagram.faces, diagram.border_faces
    n = len(diagram)
    on_lines = np.isin(inner @ [n, 1], _pairs(faces, rows) @ [n, 1])
    return Disv(mesh.points, starts, corners, diagram.points.astype(float), found, inner[on_lines])


def _pairs(mesh: Faces, rows: np.ndarray) -> np.ndarray:
    """Return the two cells of faces between cells, the first one first, (k, 2) int64."""
    return np.sort(np.column_stack([mesh.owner[rows], mesh.neighbor[rows]]), axis=1).astype(np.int64)
