"""Whether a solver accepts a mesh: its criteria, each with value, limit and worst place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..arguments import check_choice, format_point
from ..connectivity import components, following, rows_of
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import turns
from .criteria import Criterion, Rows, SolverReport
from .measures import PlaneMeasures, SolverMeasures
from .prisms import simple_loops
from .solver_mesh import WallShape, make_solver_mesh

Solver = Literal["openfoam", "mpas", "modflow"]
"""Solvers whose criteria are known."""
LEAST_MEASURE = 1e-300
"""OpenFOAM's VSMALL: least area of a face and volume of a cell."""
LEAST_DETERMINANT = 1e-3
"""Least determinant of a cell; that of a cell with neighbors on one side only is smaller."""


@dataclass(frozen=True)
class Limit:
    """What `checkMesh` asks of a measure of cells or faces: values above it, or below, are rejected or warned of.

    What it asks with the option ``-allGeometry`` only is `thorough`.
    """

    name: str
    value: float
    above: bool = True
    of_cells: bool = False
    demanded: bool = True
    strict: bool = True
    thorough: bool = False

    def broken(self, values: np.ndarray) -> np.ndarray:
        """Return which of `values` (k,) break it, (k,) bool."""
        if not self.strict:
            return values >= self.value
        return values > self.value if self.above else values < self.value


LIMITS = {
    "openness": Limit("cell openness", 1e-6, of_cells=True),
    "aspect_ratio": Limit("aspect ratio", 1000, of_cells=True),
    "face_areas": Limit("face area", LEAST_MEASURE, above=False),
    "volumes": Limit("cell volume", LEAST_MEASURE, above=False, of_cells=True),
    "non_orthogonality": Limit("non-orthogonality", 90 - np.degrees(1e-15), strict=False),
    "pyramids": Limit("face pyramids", -1e-15, above=False),
    "skewness": Limit("skewness", 4),
    "bad_tetrahedra": Limit("face tetrahedra", 0, thorough=True),
    "flatness": Limit("flatness", 0.8, above=False, demanded=False),
    "determinant": Limit("determinant", LEAST_DETERMINANT, above=False, of_cells=True, thorough=True),
    "weight": Limit("interpolation weight", 0.05, above=False, thorough=True),
    "volume_ratio": Limit("volume ratio", 0.01, above=False, thorough=True),
}
"""Limits of OpenFOAM by the names of `SolverMeasures`."""
_MEASURES = {2: PlaneMeasures, 3: SolverMeasures}
OF_CONVEX = ("aspect_ratio", "non_orthogonality", "skewness", "determinant", "weight", "volume_ratio")
"""Those that convex cells, too, may break."""


def check_for_solver(diagram: Diagram, solver: Solver = "openfoam", walls: WallShape | None = None) -> SolverReport:
    """Check `diagram`, as it is written for a solver, by that solver's criteria; see `Diagram.check`."""
    check_choice("solver", solver, tuple(SOLVERS))
    return SOLVERS[solver](diagram, walls)


def _check_for_openfoam(diagram: Diagram, walls: WallShape | None) -> SolverReport:
    remedy = "use solver='mpas' for meshes on a sphere"
    diagram.domain.require_flat("solver is 'openfoam', whose meshes are polyhedra", remedy)
    walls = "straight" if walls is None else walls
    mesh = make_solver_mesh(diagram, walls, walls == "straight")
    return openfoam_report(mesh, mesh.area_change, str(mesh.left_out))


def openfoam_report(mesh: Faces, area_change: float = 0.0, left_out: str = "") -> SolverReport:
    """Check the solver mesh `mesh` by the criteria of OpenFOAM."""
    return SolverReport("openfoam", tuple(_openfoam(mesh)), mesh.n_cells, len(mesh), area_change, left_out)


SOLVERS: dict[str, Callable[[Diagram, WallShape | None], SolverReport]] = {"openfoam": _check_for_openfoam}
"""The check of a diagram for each solver; `io` adds MODFLOW, `earth` models on C grids."""


_PLANE = 1e-6
"""Least turn in a corner of a polygon, in radians, that OpenFOAM counts as convex."""


def rejection(mesh: Faces, walls: WallShape = "straight") -> str:
    """Return why OpenFOAM rejects a mesh that was made with `walls`, where, and the remedy; "" if it does not.

    All criteria are computed for the cells that walls cut in 3D, and for those that seem bad. Others are convex.
    """
    at_walls = mesh.domain.shapes_cells
    if mesh.domain.outline is not None:
        judged = rejected_polygons(mesh)
    else:
        judged = cells_beyond(_MEASURES[mesh.dim](mesh))
        judged[mesh.owner[at_walls & (mesh.neighbor < 0)]] = True
        if mesh.domain.sheets is not None:
            at_walls, size = True, np.cbrt(mesh.volumes)
            judged |= mesh.domain.sheets.distance(mesh.generators) < size
    if not judged.any():
        return ""
    kept, k = judged.copy(), np.flatnonzero(mesh.neighbor >= 0)
    a, b = mesh.owner[k], mesh.neighbor[k]
    kept[a[judged[b]]] = kept[b[judged[a]]] = True
    part, _ = mesh.part(kept)
    failed = [c for c in _openfoam(part, judged[kept]) if c.demanded and not c.ok]
    if not failed:
        return ""
    first = failed[0]
    at = "" if first.place is None else f" at {format_point(first.place)}"
    also = f", and {', '.join(c.name for c in failed[1:])}" if failed[1:] else ""
    remedy = "Use smaller cells there" if at_walls else "Let a run move the generators, as clvoro.adapt does"
    if mesh.domain.uncut is not mesh.domain:
        remedy = "Use smaller cells there, or let subset keep more or fewer of the cells there"
    if mesh.layer is not None:
        remedy = "Use smaller cells there, or layers on fewer boundaries"
    if walls == "exact":
        remedy = "Write it with walls='straight'"
    elif mesh.domain.outline is not None:
        remedy += ", or drop what is smaller than a cell first, as domain.simplified(size) does"
    return (
        f"OpenFOAM's checkMesh rejects this mesh: {first.name} is {first.value:.3g}, expected "
        f"{'at most' if first.above else 'at least'} {first.limit:.3g}{at}{also}; check(solver='openfoam') lists all. "
        f"{remedy}"
    )


def cells_beyond(
    m: SolverMeasures | PlaneMeasures, names: tuple[str, ...] = OF_CONVEX, faces: np.ndarray | None = None
) -> np.ndarray:
    """Return the cells beyond a limit of `names`, or with a face beyond one or of `faces` (f,), (n,) bool."""
    mesh = m.mesh
    found = np.zeros(mesh.n_cells, bool)
    faces = np.zeros(len(mesh), bool) if faces is None else faces
    for name in names:
        broken = LIMITS[name].broken(getattr(m, name))
        if mesh.layer is not None and LIMITS[name].thorough:
            broken &= judged_thoroughly(mesh)[0 if LIMITS[name].of_cells else 1]
        if LIMITS[name].of_cells:
            found |= broken
        else:
            faces = faces | broken
    found[mesh.owner[faces]] = True
    found[mesh.neighbor[faces & (mesh.neighbor >= 0)]] = True
    return found


def _openfoam(mesh: Faces, judged: np.ndarray | None = None) -> list[Criterion]:
    """Return the criteria of `checkMesh -allGeometry -allTopology` of OpenFOAM v1912, for the cells `judged`."""
    if mesh.dim == 2 and (around := around_islands(mesh)) is not None:
        return [around]
    m = mesh.measures
    g, owner = m.geometry, m.cells.owner
    judged = np.ones(mesh.n_cells, bool) if judged is None else judged
    of_faces = judged[owner]
    of_faces[: mesh.n_inner] |= judged[mesh.neighbor[: mesh.n_inner]]
    cells, faces = Rows(g.centroids, None, mesh.dim, judged), Rows(g.centers, owner, mesh.dim, of_faces)
    thorough = (faces, cells)
    if mesh.layer is not None:
        of_cells, between = judged_thoroughly(mesh)
        thorough = (replace(faces, judged=of_faces & between), replace(cells, judged=judged & of_cells))

    def judge(*names: str) -> list[Criterion]:
        of = [(LIMITS[name], getattr(m, name)) for name in names]
        return [
            (thorough if a.thorough else (faces, cells))[a.of_cells](
                a.name, v, a.value, above=a.above, demanded=a.demanded, strict=a.strict
            )
            for a, v in of
        ]

    corners = m.cells.points[m.cells.corners]
    span = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))
    ends = Rows(m.cells.points[m.edges].mean(axis=1), _cells_of_edges(m), mesh.dim)
    sides = np.bincount(m.face_cells[0], minlength=mesh.n_cells)
    walls = np.concatenate([g.areas[mesh.n_inner : mesh.n_outer], g.areas[len(mesh.owner) :]])
    openness = np.abs(walls.sum(axis=0)).max() / (np.linalg.norm(walls, axis=1).sum() + LEAST_MEASURE)
    concave = np.where(m.concave, np.maximum(m.concavity, 0), 0)
    return [
        Criterion("boundary openness", float(openness), 1e-6, True, True, int(openness > 1e-6)),
        cells("faces of a cell", sides, 4, above=False),
        *judge("openness", "aspect_ratio", "face_areas", "volumes", "non_orthogonality"),
        faces("non-orthogonality, severe", m.non_orthogonality, 70, demanded=False),
        *judge("pyramids", "skewness", "bad_tetrahedra"),
        ends("edge length over size", m.edge_spans / span, 1e-6, above=False, demanded=False),
        *judge("flatness", "determinant"),
        thorough[1]("concavity", concave, 0, failing=m.concave),
        *judge("weight", "volume_ratio"),
        regions(mesh),
    ]


def judged_thoroughly(mesh: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return which cells are in no layer of a solid, (n,) bool, and which faces have no cell in one, (f,) bool.

    They are judged as `checkMesh` does with its option ``-allGeometry``, others as it does without it: cells in layers
    are flat by intent.
    """
    cells = np.ones(mesh.n_cells, bool) if mesh.layer is None else mesh.layer == 0
    return cells, cells[mesh.owner] & (cells[np.maximum(mesh.neighbor, 0)] | (mesh.neighbor < 0))


def rejected_cells(mesh: Faces, divided: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return which of the cells `judged` (n,) OpenFOAM rejects in 3D, (n,) bool: also those with a face it rejects.

    Only the faces `divided` (k,) are divided into tetrahedra, which takes the longest.
    """
    m, faces, found = mesh.measures, np.zeros(len(mesh), bool), np.zeros(mesh.n_cells, bool)
    cells, between = judged_thoroughly(mesh)
    divided = divided[between[divided]]
    faces[divided] = m.bad_tetrahedra_of(divided) > 0
    found[m.concave_pairs(judged=judged & cells)[1]] = True
    return (found | cells_beyond(m, (*OF_CONVEX, "volumes", "face_areas", "pyramids"), faces)) & judged


def rejected_polygons(mesh: Faces) -> np.ndarray:
    """Return which cells OpenFOAM rejects in 2D, (n,) bool: also those with a face that it rejects."""
    bad = np.bincount(mesh.sides()[0], minlength=mesh.n_cells) < 3
    return bad | not_convex(mesh, _PLANE) | cells_beyond(PlaneMeasures(mesh))


def not_convex(mesh: Faces, least: float) -> np.ndarray:
    """Return which cells in 2D are no simple polygons, or turn left by less than `least` in a corner, (n,) bool."""
    starts, loop, broken = simple_loops(mesh)
    cell = rows_of(starts)
    turn = turns(mesh.points[loop], following(starts))
    found = np.bincount(cell, turn, mesh.n_cells) > 3 * np.pi  # 4 pi if sides cross
    found[broken] = found[cell[turn < least]] = True
    return found


def around_islands(mesh: Faces) -> Criterion | None:
    """Return the cells in 2D around islands as a criterion that fails, or None if there are none."""
    broken = simple_loops(mesh)[2]
    if not broken.size:
        return None
    cell = int(broken[0])
    place = mesh.points[mesh.corners.reshape(-1, 2)[mesh.owner == cell]].reshape(-1, 2).mean(axis=0)
    return Criterion("cells around islands", len(broken), 0, True, True, len(broken), cell, tuple(place.tolist()))


def _cells_of_edges(m: SolverMeasures) -> np.ndarray:
    """Return for each edge of the polyhedra the index of one of its cells, (e,)."""
    found = np.zeros(len(m.edges), np.int64)
    found[m.edge_of_corner] = np.repeat(m.cells.owner, np.diff(m.cells.starts))
    return found


def regions(mesh: Faces) -> Criterion:
    """Return the number of connected parts of the mesh as a criterion."""
    joined = np.flatnonzero(mesh.neighbor >= 0)
    found = int(components(mesh.n_cells, mesh.owner[joined], mesh.neighbor[joined])[0])
    return Criterion("regions", found, 1, True, False, found - 1)
