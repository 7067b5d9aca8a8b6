"""Whether a solver accepts a mesh: its criteria, each with value, limit and worst place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arguments import check_choice
from ..mesh.check.findings import Verdict
from ..mesh.diagram import Diagram
from .measures import SolverMeasures
from .prisms import simple_loops
from .solver_mesh import SolverMesh, WallShape, make_solver_mesh

Solver = Literal["openfoam"]
"""Solvers whose criteria are known."""
_LEAST = 1e-300
"""OpenFOAM's VSMALL: least area of a face and volume of a cell."""


@dataclass(frozen=True)
class Criterion:
    """One criterion of a solver.

    Attributes
    ----------
    name : str
    value : float
        The worst value in the mesh.
    limit : float
    above : bool
        Whether the solver complains of values above the limit; else of those below.
    demanded : bool
        Whether the solver rejects a mesh that fails. It only warns of the others.
    count : int
        Number of faces or cells that fail.
    cell : int or None
        The cell with the worst value, or one of the two cells of the face.
    place : tuple of float or None
        Centroid of that cell, or center of the face.
    """

    name: str
    value: float
    limit: float
    above: bool
    demanded: bool
    count: int
    cell: int | None = None
    place: tuple[float, ...] | None = None

    @property
    def ok(self) -> bool:
        """Whether no face or cell fails."""
        return self.count == 0

    def __str__(self) -> str:
        verdict = (
            "ok" if self.ok else f"{self.count} fail" if self.demanded else f"{self.count} warn"
        )
        limit = f"{'<=' if self.above else '>='} {self.limit:.4g}"
        where = ""
        if self.place is not None:
            where = f"cell {self.cell} at ({', '.join(f'{x:.6g}' for x in self.place)})"
        return f"{self.name:28}{self.value:>12.5g}  {limit:<12}{verdict:<12}{where}".rstrip()


@dataclass(frozen=True)
class SolverReport(Verdict):
    """The verdict on a mesh; it is true if the solver accepts it.

    Attributes
    ----------
    solver : str
    criteria : tuple of Criterion
    cells, faces : int
    area_change : float
        Volume (2D: area) of the mesh that the solver gets minus that of the domain, over that of the domain.
    """

    solver: str
    criteria: tuple[Criterion, ...]
    cells: int
    faces: int
    area_change: float

    @property
    def ok(self) -> bool:
        """Whether the solver accepts the mesh."""
        return all(c.ok for c in self.criteria if c.demanded)

    def __getitem__(self, name: str) -> Criterion:
        """Return a criterion by its name."""
        return next(c for c in self.criteria if c.name == name)

    def __str__(self) -> str:
        failed = [c.name for c in self.criteria if c.demanded and not c.ok]
        verdict = "accepted" if self.ok else f"rejected: {', '.join(failed)}"
        changed = ""
        if self.area_change:
            changed = f"; straight walls change the area by {self.area_change:+.2g} of the domain"
        head = f"{self.solver}: {verdict}; {self.cells} cells, {self.faces} faces{changed}"
        columns = f"{'criterion':28}{'worst':>12}  {'limit':<12}{'verdict':<12}where"
        return "\n  ".join([head, columns, *map(str, self.criteria)])


def check_for_solver(
    diagram: Diagram, solver: Solver = "openfoam", walls: WallShape = "straight"
) -> SolverReport:
    """Check `diagram`, as it is written for a solver, by that solver's criteria; see `Diagram.check`.

    Raises
    ------
    InputError
        If the solver is not known, or `walls` is neither "straight" nor "exact".
    """
    check_choice("solver", solver, ("openfoam",))
    mesh = make_solver_mesh(diagram, walls, walls == "straight")
    return SolverReport(
        solver, tuple(_openfoam(mesh)), len(mesh), len(mesh.owner), mesh.area_change
    )


def _openfoam(mesh: SolverMesh) -> list[Criterion]:
    """Return the criteria of `checkMesh -allGeometry -allTopology` of OpenFOAM v1912."""
    if mesh.dim == 2:
        broken = simple_loops(mesh)[2]
        if broken.size:
            cell = int(broken[0])
            place = (
                mesh.points[mesh.corners.reshape(-1, 2)[mesh.owner == cell]]
                .reshape(-1, 2)
                .mean(axis=0)
            )
            here = tuple(place.tolist())
            return [
                Criterion(
                    "cells around islands", len(broken), 0, True, True, len(broken), cell, here
                )
            ]
    m = mesh.measures
    g, owner = m.geometry, m.cells.owner
    coupled = m.coupled
    angle = m.non_orthogonality
    cells, faces = _Rows(g.centroids, None, mesh.dim), _Rows(g.centers, owner, mesh.dim)
    between = _Rows(g.centers[coupled], owner[coupled], mesh.dim)
    corners = m.cells.points[m.cells.corners]
    span = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    edges = m.edges
    ends = m.cells.points[edges].mean(axis=1)
    sides = np.bincount(m.face_cells[0], minlength=len(mesh))
    walls = np.concatenate([g.areas[mesh.inner : mesh.outer], g.areas[len(mesh.owner) :]])
    openness = np.abs(walls.sum(axis=0)).max() / (np.linalg.norm(walls, axis=1).sum() + _LEAST)
    concave = np.where(m.concave, np.maximum(m.concavity, 0), 0)
    made = [
        Criterion("boundary openness", float(openness), 1e-6, True, True, int(openness > 1e-6)),
        cells("faces of a cell", sides, 4, above=False),
        cells("cell openness", m.openness, 1e-6),
        cells("aspect ratio", m.aspect_ratio, 1000),
        faces("face area", np.linalg.norm(g.areas, axis=1), _LEAST, above=False),
        cells("cell volume", g.volumes, _LEAST, above=False),
        faces("non-orthogonality", angle, 90 - np.degrees(1e-15), strict=False),
        faces("non-orthogonality, severe", angle, 70, demanded=False),
        faces("face pyramids", m.pyramids, -1e-15, above=False),
        faces("skewness", m.skewness, 4),
        faces("face tetrahedra", m.bad_tetrahedra, 0),
        _Rows(ends, _cells_of_edges(m), mesh.dim)(
            "edge length over size", m.edge_spans / span, 1e-6, above=False, demanded=False
        ),
        faces("flatness", m.flatness, 0.8, above=False, demanded=False),
        cells("determinant", m.determinant, 1e-3, above=False),
        cells("concavity", concave, 0, failing=m.concave),
        between("interpolation weight", m.weight[coupled], 0.05, above=False),
        between("volume ratio", m.volume_ratio[coupled], 0.01, above=False),
    ]
    regions = _regions(mesh)
    return [*made, Criterion("regions", regions, 1, True, False, regions - 1)]


@dataclass(frozen=True)
class _Rows:
    """Places, (k, 3), with their cells, (k,) or None for the cells themselves."""

    places: np.ndarray
    cells: np.ndarray | None
    dim: int

    def __call__(
        self,
        name: str,
        values: np.ndarray,
        limit: float,
        *,
        above: bool = True,
        demanded: bool = True,
        strict: bool = True,
        failing: np.ndarray | None = None,
    ) -> Criterion:
        """Return a criterion: the worst of `values` (k,), the limit, and the cell with the worst one."""
        if not len(values):
            return Criterion(name, 0.0 if above else np.inf, limit, above, demanded, 0)
        bad = failing
        if bad is None:
            bad = values > limit if above else values < limit
            bad = bad if strict else values >= limit
        worst = int(np.argmax(values) if above else np.argmin(values))
        if bad.any() and not bad[worst]:
            worst = int(np.flatnonzero(bad)[0])
        cell = worst if self.cells is None else int(self.cells[worst])
        place = tuple(self.places[worst, : self.dim].tolist())
        return Criterion(
            name, float(values[worst]), limit, above, demanded, int(bad.sum()), cell, place
        )


def _cells_of_edges(m: SolverMeasures) -> np.ndarray:
    """Return for each edge of the polyhedra the index of one of its cells, (e,)."""
    found = np.zeros(len(m.edges), np.int64)
    found[m.edge_of_corner] = np.repeat(m.cells.owner, np.diff(m.cells.starts))
    return found


def _regions(mesh: SolverMesh) -> int:
    """Return the number of connected parts of the mesh."""
    import scipy.sparse

    joined = np.flatnonzero(mesh.neighbor >= 0)
    pair = (mesh.owner[joined], mesh.neighbor[joined])
    graph = scipy.sparse.coo_array((np.ones(len(joined)), pair), (len(mesh), len(mesh)))
    return int(scipy.sparse.csgraph.connected_components(graph, directed=False)[0])
