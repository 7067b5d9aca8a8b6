"""Fields from the mesh of a case to the next one: cells conservatively, patches, and fluxes free of divergence."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from ..adapter import Adapter
from ..errors import InputError
from ..geometry.box import Box
from ..io.foam_read import FoamPatchFaces
from ..mesh.diagram import Diagram
from ..mesh.geometry import sum_rows
from ..remapping.cell_data import conserved
from ..sizing.graded import default_engine
from ..solvers.poisson import Laplacian, Poisson
from .fields import WIDTHS, Entries, FoamField, Values
from .mesh import FoamMesh

MOST_DIVERGENCE = 1e-10
"""Largest sum of the fluxes out of a cell, over the mean flux through a face."""
_DIRECT = 20_000  # cells up to which a factorization costs less than iterations
_TOLERANCE = 1e-12
_UNBALANCED = 0.1
"""Difference of what enters and leaves, over the larger one, that is no matter of how a mesh resolves the boundary."""
_NOTHING = 1e-6  # share of the largest velocity times the boundary


def project_fluxes(mesh: FoamMesh, velocity: np.ndarray, at_boundary: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """Return fluxes near those of a velocity whose sum out of each cell is zero.

    The velocity is interpolated to the faces, and the gradient of a potential q is subtracted from it, which solves
    ``sum over faces of (A / d) (q_j - q_i) = sum of the fluxes out of cell i``, with q = 0 beyond open faces.

    - `velocity` (n, 3) float64: in the cells.
    - `at_boundary` (b,) float64: fluxes through the faces of the boundary, out of the domain. If none of them is open,
      those that leave the domain are scaled to the sum of those that enter.
    - `is_open` (b,) bool: faces whose flux is free.

    The result is (f,) float64.

    Raises `InputError` if none of them is open, and what enters does not leave.
    """
    check_balance(mesh, velocity, at_boundary, is_open)
    centers, areas = mesh.faces
    n, inner = mesh.n_cells, len(mesh.neighbor)
    owner, neighbor = mesh.owner[:inner], mesh.neighbor
    behind, ahead = (np.linalg.norm(centers[:inner] - mesh.centroids[cells], axis=1) for cells in (owner, neighbor))
    share = (ahead / (behind + ahead))[:, None]
    between = share * velocity[owner] + (1 - share) * velocity[neighbor]
    flux = np.concatenate([(between * areas[:inner]).sum(axis=1), at_boundary])
    outer = mesh.owner[inner:]
    flux[inner:][is_open] = (velocity[outer] * areas[inner:]).sum(axis=1)[is_open]
    if not is_open.any():
        leaving = np.maximum(flux[inner:], 0).sum()
        entering = -np.minimum(flux[inner:], 0).sum()
        if leaving > 0:
            flux[inner:] = np.where(flux[inner:] > 0, flux[inner:] * entering / leaving, flux[inner:])
    size = np.linalg.norm(areas, axis=1)
    to = np.linalg.norm(mesh.centroids[neighbor] - mesh.centroids[owner], axis=1)
    conductance = size[:inner] / to
    to_wall = np.linalg.norm(centers[inner:] - mesh.centroids[outer], axis=1)
    beyond = np.where(is_open, size[inner:] / to_wall, 0.0)
    solve = _solver(owner, neighbor, outer, conductance, beyond, n)
    for _ in range(3):  # the second time corrects the round-off of the first
        q = solve(_sum_out(mesh, flux))
        flux[:inner] -= conductance * (q[owner] - q[neighbor])
        flux[inner:] -= beyond * q[outer]
        if divergence(mesh, flux) < 0.01 * MOST_DIVERGENCE:
            break
    return flux


def check_balance(mesh: FoamMesh, velocity: np.ndarray, at_boundary: np.ndarray, is_open: np.ndarray) -> None:
    """Raise InputError if no face of the boundary is open, and what enters does not leave; see `project_fluxes`."""
    entering, leaving = -np.minimum(at_boundary, 0).sum(), np.maximum(at_boundary, 0).sum()
    most = max(entering, leaving)
    scale = np.abs(velocity).max() * np.linalg.norm(mesh.faces[1][len(mesh.neighbor) :], axis=1).sum()
    if not is_open.any() and most > _NOTHING * scale and abs(entering - leaving) > _UNBALANCED * most:
        raise InputError(
            f"U enters the domain with {entering:.4g} and leaves it with {leaving:.4g}, expected as much, since its "
            "values are given at all patches; give one of them a type such as zeroGradient or inletOutlet"
        )


def divergence(mesh: FoamMesh, flux: np.ndarray) -> float:
    """Return the largest sum of fluxes out of a cell, over the mean flux through a face."""
    mean = float(np.abs(flux).mean())
    return float(np.abs(_sum_out(mesh, flux)).max()) / mean if mean else 0.0


def _sum_out(mesh: FoamMesh, flux: np.ndarray) -> np.ndarray:
    inner = flux[: len(mesh.neighbor)]
    return np.bincount(mesh.owner[: len(flux)], flux, mesh.n_cells) - np.bincount(mesh.neighbor, inner, mesh.n_cells)


def _solver(
    owner: np.ndarray, neighbor: np.ndarray, outer: np.ndarray, conductance: np.ndarray, beyond: np.ndarray, n: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that solves for the potential, by multigrid if there are many cells.

    All open faces lead to one more node n, where the potential is 0. Without open faces it is that of cell 0.
    """
    is_open = beyond > 0
    a = np.concatenate([owner, outer[is_open]])
    b = np.concatenate([neighbor, np.full(is_open.sum(), n)])
    weights = np.concatenate([conductance, beyond[is_open]])
    ground = n if is_open.any() else 0
    m = n + is_open.any()
    graph = scipy.sparse.coo_array(
        (np.tile(weights, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(m, m)
    ).tocsr()
    if m > _DIRECT and (engine := default_engine(3)).real == np.float64:
        return _multigrid_solver(Poisson(engine), graph, ground, n)
    kept = np.flatnonzero(np.arange(m) != ground)
    matrix = scipy.sparse.diags_array(graph.sum(axis=1) + 1e-300) - graph
    factors = scipy.sparse.linalg.splu(
        matrix[kept][:, kept].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )

    def solve(sources: np.ndarray) -> np.ndarray:
        q = np.zeros(m)
        q[kept] = factors.solve(np.append(sources, 0)[:m][kept])
        return q[:n]

    return solve


def _multigrid_solver(
    poisson: Poisson, graph: scipy.sparse.csr_array, ground: int, n: int
) -> Callable[[np.ndarray], np.ndarray]:
    engine = poisson.engine
    laplacian = Laplacian(
        engine.upload(graph.indptr, np.int32), engine.upload(graph.indices, np.int32), engine.upload(graph.data)
    )

    def solve(sources: np.ndarray) -> np.ndarray:
        every = np.append(sources, -sources.sum())[: graph.shape[0]]
        potential = engine.zeros(len(every))
        poisson.solve(laplacian, engine.upload(every), potential, tolerance=_TOLERANCE, preconditioner="multigrid")
        q = potential.get()
        return q[:n] - q[ground]

    return solve


_OPEN = ("zeroGradient", "inletOutlet", "outletInlet", "pressureInlet", "freestream", "advective", "waveTransmissive")
"""Beginnings of the types of a velocity at patches through which the flux is free."""
_CLOSED = ("noSlip", "slip", "symmetry", "symmetryPlane", "empty")
_VOLUME_FLUX = (0.0, 3.0, -1.0)


@dataclass(frozen=True)
class MeshOfCase:
    """The mesh of a case, as OpenFOAM's and as a diagram.

    - `foam`: FoamMesh
    - `diagram`: Diagram
    - `row` (c,) int: the cell of the diagram to which each cell of OpenFOAM belongs: where cells are merged or divided
      at walls, not all have one of their own.
    """

    foam: FoamMesh
    diagram: Diagram
    row: np.ndarray

    @classmethod
    def of(cls, foam: FoamMesh, diagram: Diagram) -> MeshOfCase:
        """Join both meshes."""
        if foam.n_cells == len(diagram):
            return cls(foam, diagram, np.arange(len(diagram)))
        centroids = foam.centroids[:, : diagram.domain.dim]
        return cls(foam, diagram, scipy.spatial.KDTree(diagram.points).query(centroids)[1])

    def to_diagram(self, values: np.ndarray) -> np.ndarray:
        """Return the means of values (c, k) over the cells of the diagram, (n, k); of the nearest one if there is none.

        They are numbers that a solver has for its cells.
        """
        n = len(self.diagram)
        if len(self.row) == n:
            return values
        volume = np.bincount(self.row, self.foam.volumes, n)
        sums = sum_rows(self.row, self.foam.volumes[:, None] * values, n)
        empty = volume == 0
        means = sums / np.where(empty, 1, volume)[:, None]
        if empty.any():
            means[empty] = values[self._nearest(self.diagram.points[empty])]
        return means

    def _nearest(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) the cell of OpenFOAM with the nearest centroid, (n,) int."""
        return scipy.spatial.KDTree(self.foam.centroids[:, : self.diagram.domain.dim]).query(points)[1]

    def zones_on(self, new: Diagram) -> dict[str, np.ndarray]:
        """Return by name which cells of a new diagram are in each zone, (n,) bool: those whose nearest old cell is.

        Regions of the domain are left out, since the new mesh has them by itself.

        Raises `InputError` if a zone has none of the new cells.
        """
        known = () if new.domain.borders is None else new.region_names
        zones = {name: rows for name, rows in self.foam.zones.items() if name not in known}
        if not zones:
            return {}
        nearest = self._nearest(new.points)
        made = {name: np.isin(nearest, rows) for name, rows in zones.items()}
        for name, inside in made.items():
            if not inside.any():
                raise InputError(
                    f"the zone {name} has none of the new cells, expected some; give more cells, or a smaller h_max"
                )
        return made


def entries_at(field: FoamField, patch: FoamPatchFaces) -> Entries:
    """Return the entries of a field for a patch: by its name, else by a group, else by the last pattern that fits.

    Raises `InputError` if there are none.
    """
    # A patch is also in the group of its type, such as "wall".
    for name in (patch.name, *patch.groups, patch.kind):
        if name in field.patches:
            return field.patches[name]
    for key in reversed(field.patches):
        if key.startswith('"') and re.fullmatch(key.strip('"'), patch.name):
            return field.patches[key]
    raise InputError(
        f"the field {field.name} has no entry for the patch {patch.name} in its boundaryField, expected one; run the "
        "solver first, which writes one for each patch"
    )


def fields_that_move(fields: Sequence[FoamField], patches: Sequence[FoamPatchFaces]) -> list[FoamField]:
    """Return the fields that `transfer_fields` can transfer: all with a value in each cell, and the flux `phi`.

    The flux is that of the velocity `U`. If the mesh has cyclic patches it is left out: solvers then compute it from U.
    """
    moving = [field for field in fields if field.in_cells]
    if any(field.name == "U" for field in moving) and not any(patch.kind == "cyclic" for patch in patches):
        moving += [field for field in fields if field.name == "phi" and field.dimensions[:3] == _VOLUME_FLUX]
    return moving


def transfer_fields(fields: Sequence[FoamField], old: MeshOfCase, new: MeshOfCase, adapter: Adapter) -> list[FoamField]:
    """Return those of the fields that can be transferred (`fields_that_move`), on the new mesh.

    In cells the sum of volume times value is that on the old mesh, with the volumes of the solver, and there are no new
    extrema.
    """
    every = fields_that_move(fields, new.foam.patches)
    in_cells = [field for field in every if field.in_cells]
    widths = [WIDTHS[field.type] for field in in_cells]
    columns = np.concatenate([f.internal.rows(old.foam.n_cells) for f in in_cells], axis=1)
    # Columns without differences are not transferred: the third component in the plane, for one.
    moving = np.ptp(columns, axis=0) > 0
    values = np.repeat(columns[:1], new.foam.n_cells, axis=0)
    if moving.any():
        given = old.to_diagram(columns[:, moving])
        carried = _carry(given, old.diagram, new.diagram, adapter)[new.row]
        given = columns[:, moving]
        # Volumes of two meshes of one domain differ where walls are curved: means are kept then.
        volumes = old.foam.volumes * (new.foam.volumes.sum() / old.foam.volumes.sum())
        bounds = given.min(axis=0), given.max(axis=0)
        values[:, moving] = conserved(given, volumes, carried, new.foam.volumes, *bounds)
    made = []
    for field, part in zip(in_cells, np.split(values, np.cumsum(widths)[:-1], axis=1), strict=True):
        given = field.internal
        internal = given if given.uniform else Values(given.kind, part, False)
        made.append(replace(field, entries=_with_boundary(field, internal, old.foam, new.foam)))
    velocity = next((field for field in made if field.name == "U"), None)
    if velocity is not None:
        made += [_flux(field, velocity, new.foam) for field in every if not field.in_cells]
    return made


def _carry(values: np.ndarray, old: Diagram, new: Diagram, adapter: Adapter) -> np.ndarray:
    """Return cell data on the new diagram. In a solid those of the cells of a box around it."""
    extent = np.array(old.domain.extent)
    if len(extent) > 2 and old.domain.measure < (1 - 1e-9) * extent.prod():
        every = np.concatenate([old.points, new.points])
        margin = 0.01 * np.ptp(every, axis=0).max()
        box = Box(tuple((every.min(axis=0) - margin).tolist()), tuple((every.max(axis=0) + margin).tolist()))
        old, new = adapter.diagram(box, old.points), adapter.diagram(box, new.points)
    return old.transfer(values, onto=new, order=2, adapter=adapter)


def _with_boundary(field: FoamField, internal: Values, old: FoamMesh, new: FoamMesh) -> Entries:
    """Return the entries of a field on the new mesh: lists of values at patches are interpolated."""
    boundary: Entries = {}
    before = {patch.name: patch.faces for patch in old.patches}
    for patch in new.patches:
        if patch.kind == "empty":
            boundary[patch.name] = {"type": b"empty"}
            continue
        faces = before.get(patch.name, np.zeros(0, int))
        boundary[patch.name] = _on_patch(entries_at(field, patch), faces, patch.faces, old, new)
    return {**field.entries, "internalField": internal, "boundaryField": boundary}


def _on_patch(entries: Entries, before: np.ndarray, faces: np.ndarray, old: FoamMesh, new: FoamMesh) -> Entries:
    made: Entries = {}
    for name, value in entries.items():
        if isinstance(value, dict):
            made[name] = _on_patch(value, before, faces, old, new)
        elif isinstance(value, Values) and not value.uniform and len(value.numbers) == len(before) > 0:
            made[name] = replace(value, numbers=_interpolate(value.numbers, before, faces, old, new))
        elif isinstance(value, Values) and not value.uniform and len(value.numbers) != len(faces):
            continue  # of faces that are not there: the solver evaluates the condition
        else:
            made[name] = value
    return made


def _interpolate(values: np.ndarray, before: np.ndarray, faces: np.ndarray, old: FoamMesh, new: FoamMesh) -> np.ndarray:
    """Return the values at the new faces of a patch from those at its old faces, (k, w), with the same mean.

    On a straight patch of a layer of cells they are exact for means of quadratic functions, else linear between the two
    nearest old ones.
    """
    centers, areas = old.faces[0][before], np.linalg.norm(old.faces[1][before], axis=1)
    at, sizes = new.faces[0][faces], np.linalg.norm(new.faces[1][faces], axis=1)
    if len(centers) == 1 or len(at) == 0:
        return np.repeat(values[:1], len(at), axis=0)
    made = _along_line(values, centers, areas, at, sizes, old.thickness) if old.thickness else None
    if made is None and old.is_plane:
        _, near = scipy.spatial.KDTree(centers[:, :2]).query(at[:, :2], 2)
        a, b = centers[near[:, 0]], centers[near[:, 1]]
        along = ((at - a) * (b - a))[:, :2].sum(axis=1) / np.maximum(((b - a)[:, :2] ** 2).sum(axis=1), 1e-300)
        # Beyond the last face the line goes on.
        share = np.clip(along, -1, 1)[:, None]
        made = (1 - share) * values[near[:, 0]] + share * values[near[:, 1]]
    elif made is None:
        apart, near = (a.reshape(len(at), -1) for a in scipy.spatial.KDTree(centers).query(at, min(4, len(centers))))
        weight = 1 / np.maximum(apart, 1e-9 * apart.max()) ** 2
        made = (weight[..., None] * values[near]).sum(axis=1) / weight.sum(axis=1)[:, None]
    return made + (areas @ values / areas.sum() - sizes @ made / sizes.sum())


def _along_line(
    values: np.ndarray, centers: np.ndarray, areas: np.ndarray, at: np.ndarray, sizes: np.ndarray, thickness: float
) -> np.ndarray | None:
    """Return means over new faces of a straight patch, by a cubic spline of the integral; None if it is not straight.

    They stay between the values of the old faces there and of their neighbors; at the two ends the line goes on.
    """
    x, y = centers[:, :2], at[:, :2]
    along = x[np.argmax(((x - x[0]) ** 2).sum(axis=1))] - x[0]
    along = along / np.linalg.norm(along)
    middle, half = (x - x[0]) @ along, areas / (2 * thickness)
    order = np.argsort(middle)
    low, high = (middle - half)[order], (middle + half)[order]
    length = high[-1] - low[0]
    off = max(np.abs((points - x[0]) @ [-along[1], along[0]]).max() for points in (x, y))
    if off > 1e-6 * length or np.abs(high[:-1] - low[1:]).max() > 1e-6 * length:
        return None
    v = values[order]
    knots = np.append(low, high[-1])
    integral = np.concatenate([np.zeros((1, v.shape[1])), np.cumsum(v * np.diff(knots)[:, None], axis=0)])
    spline = scipy.interpolate.CubicSpline(knots, integral)
    new = (y - x[0]) @ along
    begin, end = (np.clip(new + side * sizes / (2 * thickness), low[0], high[-1]) for side in (-1, 1))
    made = (spline(end) - spline(begin)) / np.maximum(end - begin, 1e-300)[:, None]
    around = np.concatenate([2 * v[:1] - v[1:2], v, 2 * v[-1:] - v[-2:-1]])
    first = np.clip(np.searchsorted(knots, begin, "right") - 1, 0, len(v) - 1)
    last = np.clip(np.searchsorted(knots, end) - 1, first, len(v) - 1) + 3
    ranges = [around[i:j] for i, j in zip(first.tolist(), last.tolist(), strict=True)]
    return np.clip(made, [r.min(axis=0) for r in ranges], [r.max(axis=0) for r in ranges])


def check_fluxes(fields: Sequence[FoamField], mesh: FoamMesh) -> None:
    """Raise InputError if there is a flux `phi` that `transfer_fields` cannot make free of divergence."""
    moving = fields_that_move(fields, mesh.patches)
    velocity = next((field for field in moving if field.name == "U"), None)
    if velocity is not None and not all(field.in_cells for field in moving):
        check_balance(mesh, velocity.internal.rows(mesh.n_cells), *_at_boundary(velocity, mesh))


def _at_boundary(velocity: FoamField, mesh: FoamMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the fluxes of a velocity out of the faces of the boundary (b,), and whether they are free there."""
    inner = len(mesh.neighbor)
    at_boundary, is_open = np.zeros(len(mesh.owner) - inner), np.zeros(len(mesh.owner) - inner, bool)
    areas = mesh.faces[1]
    for patch in mesh.patches:
        rows = patch.faces - inner
        entries = entries_at(velocity, patch)
        kind = entries.get("type", b"")
        name = kind.decode() if isinstance(kind, bytes) else ""
        value = entries.get("value")
        if name.startswith(_CLOSED) or patch.kind == "empty":
            continue
        if name.startswith(_OPEN) or not isinstance(value, Values):
            is_open[rows] = True
        else:
            at_boundary[rows] = (value.rows(len(rows)) * areas[patch.faces]).sum(axis=1)
    return at_boundary, is_open


def _flux(field: FoamField, velocity: FoamField, mesh: FoamMesh) -> FoamField:
    """Return the field `phi` of a velocity, free of divergence."""
    inner = len(mesh.neighbor)
    flux = project_fluxes(mesh, velocity.internal.rows(mesh.n_cells), *_at_boundary(velocity, mesh))
    boundary: Entries = {}
    for patch in mesh.patches:
        kind = patch.kind if patch.kind.startswith(("empty", "symmetry")) else "calculated"
        through = flux[patch.faces[: 0 if kind == "empty" else None], None]
        boundary[patch.name] = {"type": kind.encode(), "value": Values("scalar", through, False)}
    internal = Values("scalar", flux[:inner, None], False)
    return replace(field, entries={**field.entries, "internalField": internal, "boundaryField": boundary})
