"""Adapt a case of OpenFOAM to its solution: once, or in a loop with its solver."""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from dataclasses import fields as fields_of
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np

from ..adaptation.options import EffortName, MultilevelOptions
from ..adapter import Adapter
from ..arguments import check_integer, check_number, warn
from ..errors import InputError, InputTypeError, LostFieldsWarning, MismatchWarning
from ..finite_volumes.gate import rejection
from ..geometry.boundary_layers import Layers
from ..io import load
from ..io.arrays import explained
from ..io.atomic import atomic_file, check_writable, make_folder
from ..io.foam import PatchType
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..shared import shared_adapter
from ..sizing import Estimate, combine, force_weight, hessian_size, normalize, steepness
from .case import FoamCase, Time, check_solver
from .fields import FoamField, Values
from .mesh import FoamMesh
from .transfer import MeshOfCase, check_fluxes, entries_at, fields_that_move, transfer_fields

_MESH, _NOTE = "clvoro.npz", "clvoro.json"
"""Files beside those of a polyMesh: the generators, and what is known of the cycle."""
_CELLS_PER_PATCH = 4
_STEPS: dict[EffortName, int] = {"fast": 60, "default": 60, "best": 150}
"""Steps of a cycle without a window."""
Estimator = Callable[[Mapping[str, np.ndarray], Diagram, int], Estimate]


@dataclass(frozen=True)
class FoamCycle:
    """One row of the report: a solution, and the mesh that was made from it.

    Attributes
    ----------
    cycle : int
        0 for the first mesh.
    time : float
        Time, or iteration, at which the solution was read.
    cells : int
        Number of cells on which it was computed.
    monitors : dict of str to float
        Last values of the tables of the case's function objects, such as forces, as ``forces.Cd``.
    solver_seconds : float
        0 if the solver was run by hand.
    predicted_error : float or None
        The norm of the error that the next mesh has by the estimate; None if no mesh was made, after the last cycle.
    next_cells : int or None
    mesh_seconds, transfer_seconds : float or None
    """

    cycle: int
    time: float
    cells: int
    monitors: dict[str, float] = field(default_factory=dict)
    solver_seconds: float = 0.0
    predicted_error: float | None = None
    next_cells: int | None = None
    mesh_seconds: float | None = None
    transfer_seconds: float | None = None


@dataclass(frozen=True)
class FieldSizes:
    """Sizes for the next mesh of a case, from its fields: by `hessian_size`, for the solution or for a goal.

    Parameters
    ----------
    fields : sequence of str
        Fields that the mesh follows; each has the same weight.
    forces : str or sequence of str
        Patches whose forces are the goal: cells near them count more (`force_weight`).
    adjoints : sequence of str
        Adjoint velocities among the case's fields, such as "Ua" of ``adjointOptimisationFoam``, one for each goal:
        cells count by the largest gradient of these (`steepness`), times what an error e of the velocity, the first of
        `fields`, changes in the flux of momentum, ``(speed + viscosity / h) e``. They are compared as they are: equal
        errors of the goals count alike, such as .001 of two coefficients. A larger weight of its objective makes a goal
        count more.
    viscosity : float, optional
        Kinematic viscosity, with `adjoints`; by default `adapt_case` takes that of the case.
    p : float, optional
        As for `hessian_size`. By default 2, and 1 for a goal.
    h_min, h_max, growth : float
        As for `hessian_size`.
    """

    fields: Sequence[str] = ("U",)
    forces: str | Sequence[str] = ()
    adjoints: Sequence[str] = ()
    p: float | None = None
    h_min: float = 0.0
    h_max: float = math.inf
    growth: float = 1.2
    viscosity: float | None = None

    def __post_init__(self) -> None:
        for what, names in (("fields", self.fields), ("adjoints", self.adjoints)):
            if isinstance(names, str) or not all(isinstance(name, str) for name in names):
                raise InputTypeError(f"{what} is {names!r:.60}, expected names, such as ('U', 'p')")
        if not self.fields:
            raise InputError("fields is empty, expected names, such as ('U', 'p')")
        if self.forces and self.adjoints:
            raise InputError(f"got forces={self.forces!r} and adjoints={self.adjoints!r}, expected one of them")
        if self.viscosity is not None:
            check_number("viscosity", self.viscosity, least=0)
            if not self.adjoints:
                raise InputError(f"viscosity is {self.viscosity!r} without adjoints, expected both; name adjoints=")

    def of_case(self, case: FoamCase) -> FieldSizes:
        """Return these with what a case knows: its viscosity, if adjoints need one."""
        return replace(self, viscosity=case.viscosity()) if self.adjoints and self.viscosity is None else self

    def __call__(self, found: Mapping[str, np.ndarray], on: Diagram, n_cells: int) -> Estimate:
        """Return the estimate from values in cells, (n,) or (n, d), by the names of the fields."""
        missing = [name for name in (*self.fields, *self.adjoints) if name not in found]
        if missing:
            there = f"one of {', '.join(found)}" if found else "fields in cells, and it has none"
            raise InputError(f"the latest time has no field {missing[0]}, expected {there}")
        if not any(np.ptp(found[name], axis=0).any() for name in self.fields):
            raise InputError(
                f"{', '.join(self.fields)} has one value in all cells of the latest time, expected a solution; run the "
                "solver first"
            )
        weight = None
        if self.forces:
            weight = force_weight(self.forces, on)
        elif self.adjoints:
            weight = np.maximum.reduce([steepness(found[name], on) for name in self.adjoints])
            speed = np.linalg.norm(np.atleast_2d(found[self.fields[0]].T), axis=0)
            weight = weight * (speed + (self.viscosity or 0.0) * on.volumes ** (-1 / on.domain.cell_dim))
        p = self.p or (2.0 if weight is None else 1.0)
        bounds: dict[str, Any] = {"p": p, "h_min": self.h_min, "h_max": self.h_max, "growth": self.growth}
        return hessian_size([found[f] for f in self.fields], on=on, n_cells=n_cells, weight=weight, **bounds)


def adapt_case(
    case: str | PathLike[str],
    *,
    n_cells: int,
    cycles: int = 1,
    solver: str | Callable[[Path], object] | None = None,
    interval: float | None = None,
    sizes: Estimator | None = None,
    window: float = 0.0,
    layers: Layers | Sequence[Layers] | None = None,
    mesh: Result | Diagram | str | PathLike[str] | None = None,
    effort: EffortName = "default",
    pictures: bool = True,
    adapter: Adapter | None = None,
    on_cycle: Callable[[FoamCycle], object] | None = None,
) -> list[FoamCycle]:
    """Adapt the mesh of a case of OpenFOAM to its latest solution, `cycles` times.

    A cycle reads the latest time, estimates sizes from its fields, makes a mesh with them, and transfers all fields in
    cells. It begins from the present generators. The new mesh and its fields become the latest time, in place of the
    old one, in one step: at any moment the case has a mesh that fits its fields.
    Fluxes `phi` are projected so that they are free of divergence. Names and types of patches and boundary conditions
    stay; their lists of values are interpolated.

    With `solver` the case is solved first, between the cycles, and at the end. A call that was killed goes on where it
    was, if it is repeated.

    Parameters
    ----------
    case : path
        The folder, not decomposed. In 2D one layer of cells normal to z between empty patches.
    n_cells : int
        Number of cells of the new mesh, at least four for each patch.
    cycles : int
        Number of meshes that are made, those of earlier calls included if there is a `solver`.
    solver : str or callable, optional
        A program of OpenFOAM, such as "simpleFoam", or a function of the folder that writes a later time. Without it
        there is one cycle.
    interval : float, optional
        Time, or number of iterations, that the solver advances in each cycle. By default the time from the start to the
        end of ``system/controlDict``. Its entries `startFrom` and `endTime` change.
    sizes : FieldSizes or callable, optional
        Where sizes come from; by default ``FieldSizes()``, the Hessian of U. A function of your own takes the fields by
        name, (n,) or (n, d), the diagram, and `n_cells`, and returns an estimate.
    window : float
        Times that were written on the present mesh count, too, as far as this before the latest one: the finest size of
        all holds, scaled to `n_cells`. With the period of a flow vortices stay inside of fine cells.
    layers : Layers or sequence of Layers, optional
        Boundary layers of the new meshes; by default those of the last call.
    mesh : Result, Diagram or path, optional
        The present mesh as clvoro made it; by default ``polyMesh/clvoro.npz``, else the boundary of the case becomes a
        polygon or a solid, and the centroids of its cells the generators.
    effort : "fast", "default" or "best"
        As for `Adapter.run`.
    pictures : bool
        Draw the mesh of each cycle, colored by the size of the first field that it follows, into
        ``clvoro/cycle-K.png``, and all side by side into ``clvoro/cycles.png``. In space they are sections.
    adapter : Adapter, optional
        By default the shared one, on the best device.
    on_cycle : callable, optional
        Called with each row of the report.

    Returns
    -------
    list of FoamCycle
        Also as ``clvoro/report.csv`` in the case.

    Raises
    ------
    InputError, InputTypeError
        Before anything is written: if there is no time or mesh; a field is missing, has another length or is not
        finite; U enters the domain and cannot leave it; the estimate is zero everywhere; the patches are not those of
        `mesh`; another call, or its solver, uses the case; or an argument is wrong.
    ClvoroError
        If the solver fails.

    Examples
    --------
    Three cycles, unattended::

        rows = clvoro.foam.adapt_case("cylinder", n_cells=6000, cycles=3, solver="simpleFoam")
        print(rows[-1].monitors["forces.Cd"])

    For the forces on a patch::

        sizes = clvoro.foam.FieldSizes(forces="cylinder")
        clvoro.foam.adapt_case("cylinder", n_cells=6000, cycles=3, solver="simpleFoam", sizes=sizes)
    """
    check_integer("n_cells", n_cells, 1)
    check_integer("cycles", cycles, 1)
    if solver is None and cycles > 1:
        raise InputError(f"cycles is {cycles} without a solver, expected 1; give solver=, such as 'simpleFoam'")
    known, sizes = FoamCase(case), sizes or FieldSizes()
    complete = getattr(sizes, "of_case", None)
    loop = _Loop(
        known,
        n_cells,
        complete(known) if complete else sizes,
        check_number("window", window, least=0),
        None if layers is None else (layers,) if isinstance(layers, Layers) else tuple(layers),
        effort,
        pictures,
        adapter or shared_adapter(),
    )
    with loop.case.held():
        return loop.run(mesh, cycles, solver, interval, on_cycle or (lambda row: None))


@dataclass
class _Loop:
    case: FoamCase
    n_cells: int
    sizes: Estimator
    window: float
    layers: tuple[Layers, ...] | None
    effort: EffortName
    pictures: bool
    adapter: Adapter
    rows: list[FoamCycle] = field(default_factory=list)
    read: dict[Path, FoamMesh] = field(default_factory=dict)

    def run(
        self,
        mesh: object,
        cycles: int,
        solver: str | Callable[[Path], object] | None,
        interval: float | None,
        on_cycle: Callable[[FoamCycle], object],
    ) -> list[FoamCycle]:
        case = self.case
        case.check_kind()
        case.mend()
        note = self._note(case.latest())
        self.rows = _read_report(case.own / "report.csv")[: note["cycle"] + 1]
        if note["cycle"]:
            # The report is written after the mesh: a call may have been killed in between.
            self.rows[note["cycle"] - 1 : note["cycle"]] = [FoamCycle(**note["row"])]
        if solver is None:
            # Before anything is written.
            on_cycle(self._adapt(self._known(note) or self._solved(note, 0.0), note, mesh))
            return self.rows
        if not callable(solver):
            check_solver(solver)
        self._check_mesh(mesh)
        length = self._interval(interval)
        check_writable(case.folder)
        make_folder(case.own)
        while True:
            note = self._note(case.latest())
            known = self._known(note) or self._solve(solver, note, length)
            if note["cycle"] >= cycles:
                if self.pictures:
                    latest = case.latest()
                    old = self._present(latest, note, mesh)
                    self._draw(old, case.fields(latest), known)
                on_cycle(known)
                return self.rows
            on_cycle(self._adapt(known, note, mesh))

    def _mesh_in(self, folder: Path) -> FoamMesh:
        """Return the mesh in a folder; it is read once."""
        if folder not in self.read:
            self.read = {folder: FoamMesh.read(folder)}
        return self.read[folder]

    def _check_mesh(self, given: object) -> None:
        """Raise InputError, before the solver runs, if `n_cells` is too small, or the domain is not found."""
        folder = self.case.mesh_folder(self.case.latest())
        foam = self._mesh_in(folder)
        self._check_count(foam)
        if given is None and not (folder / _MESH).exists():
            foam.domain()

    def _check_count(self, foam: FoamMesh) -> None:
        least = _CELLS_PER_PATCH * len(foam.types)
        if self.n_cells < least:
            raise InputError(
                f"n_cells is {self.n_cells}, expected at least {least}: {_CELLS_PER_PATCH} for each of the "
                f"{len(foam.types)} patches"
            )

    def _known(self, note: dict[str, Any]) -> FoamCycle | None:
        """Return the row of the latest solution; None if it is not in the report."""
        row = self.rows[note["cycle"]] if len(self.rows) > note["cycle"] else None
        return row if row is not None and row.time == self.case.latest().value else None

    def _note(self, time: Time) -> dict[str, Any]:
        """Return what is known of the mesh at a time: cycle, time of the transfer, layers."""
        path = self.case.mesh_folder(time) / _NOTE
        if not path.exists():
            return {"cycle": 0, "time": None, "layers": []}
        with explained(path, "the note of a cycle"):
            note = json.loads(path.read_text())
            return {key: note[key] for key in ("cycle", "time", "layers", "row")}

    def _interval(self, given: float | None) -> float:
        if given is None:
            case = self.case
            end, begin = case.control_number("endTime"), case.control_number("startTime")
            kept = case.own / "interval"
            if kept.exists():
                with explained(kept, "the interval of the first call"):
                    return float(kept.read_text())
            if end is None or end <= (begin or 0.0):
                raise InputError(
                    f"{case.control} has no endTime after its startTime, expected both; write them, or pass interval="
                )
            make_folder(case.own)
            given = end - (begin or 0.0)
            with atomic_file(kept) as file:
                file.write(repr(given).encode())
        if not (math.isfinite(given) and given > 0):
            raise InputError(f"interval is {given!r}, expected a positive number")
        return given

    def _solve(self, solver: str | Callable[[Path], object], note: dict[str, Any], length: float) -> FoamCycle:
        """Run the solver on the present mesh; return the row of its solution."""
        case = self.case
        before = case.latest()
        begin = before.value if note["time"] is None else note["time"]
        end = case.control_number("endTime")
        if note["time"] is None and case.control_before.exists() and end is not None:
            begin = min(begin, end - length)  # a call was killed while the first solution was computed
        case.set_control(startFrom="latestTime", endTime=f"{begin + length:.12g}")
        start = time.perf_counter()
        if callable(solver):
            solver(case.folder)
        else:
            case.run(solver, case.own / f"log.cycle-{note['cycle']}")
        after = case.latest()
        if after.value <= begin:
            raise InputError(
                f"solver {solver!r:.60} has written no time after {before.name}; let writeInterval in {case.control} "
                f"divide the interval of {length:g}"
            )
        return self._solved(note, time.perf_counter() - start)

    def _solved(self, note: dict[str, Any], seconds: float) -> FoamCycle:
        """Return the row of the latest solution, and add it to the report."""
        case = self.case
        latest = case.latest()
        cells = self._mesh_in(case.mesh_folder(latest)).n_cells
        row = FoamCycle(note["cycle"], latest.value, cells, case.monitors(), seconds)
        if seconds:
            self._keep(row)
        return row

    def _keep(self, row: FoamCycle) -> None:
        self.rows[row.cycle :] = [row]
        _write_report(self.case.own / "report.csv", self.rows)

    def _adapt(self, row: FoamCycle, note: dict[str, Any], mesh: object) -> FoamCycle:
        """Make the next mesh, transfer the fields, and put them in place; return the row with figures of the mesh."""
        case, latest = self.case, self.case.latest()
        start = time.perf_counter()
        old = self._present(latest, note, mesh)
        foam, fields = old.foam, case.fields(latest)
        _check_values(fields, foam)
        check_fluxes(fields, foam)
        self._check_count(foam)
        self._warn_of_lost_fields(fields, foam, latest)
        size = self._sizes_in_window(fields, old, latest)
        layers = tuple(_layers_of(note["layers"])) if self.layers is None else self.layers
        domain = old.diagram.domain
        # Centroids of cells that clvoro has not made may be outside of a curved wall.
        points = old.diagram.points
        points = points[domain.contains(points)]
        # Fields of an unsteady flow lose less in a transfer between similar meshes, so that these are only corrected.
        # Corrections add up to cells of a poorer shape: a steady flow takes more steps.
        made = self.adapter.run(
            domain,
            size,
            self.effort,
            points=points,
            n_cells=self.n_cells,
            layers=layers,
            max_steps=None if self.window else _STEPS[self.effort],
            options=MultilevelOptions(correct=bool(self.window)),
        )
        mesh_seconds = time.perf_counter() - start
        target, new = self._write_mesh(made, old, latest)
        start = time.perf_counter()
        for moved in transfer_fields(fields, old, new, self.adapter):
            moved.write(target / moved.name, latest.name)
        transfer_seconds = time.perf_counter() - start
        if self.pictures:
            self._draw(old, fields, row)
        done = replace(
            row,
            predicted_error=size.norm,
            next_cells=new.foam.n_cells,
            mesh_seconds=mesh_seconds,
            transfer_seconds=transfer_seconds,
        )
        described = [asdict(layer) for layer in layers]
        known = {"cycle": row.cycle + 1, "time": latest.value, "layers": described, "row": asdict(done)}
        (target / "polyMesh" / _NOTE).write_text(json.dumps(known))
        case.put_time(latest.name, target)
        self.read = {case.folder / latest.name / "polyMesh": new.foam}
        self._keep(done)
        return done

    def _write_mesh(self, made: Result, old: MeshOfCase, latest: Time) -> tuple[Path, MeshOfCase]:
        """Write the next mesh into a folder of its own, which is to take the place of the latest time."""
        case, foam, zones = self.case, old.foam, old.zones_on(made.diagram)
        make_folder(case.own)
        target = case.own / f"next-{latest.name}"
        shutil.rmtree(target, ignore_errors=True)
        names = old.diagram.domain.boundary_names
        types = cast(dict[str, PatchType], {name: foam.types[name] for name in names})
        target.mkdir()
        if (case.folder / latest.name / "uniform").is_dir():
            shutil.copytree(case.folder / latest.name / "uniform", target / "uniform")
        if why := rejection(made.solver_mesh()):
            warn(why, MismatchWarning)
        made.to_openfoam(target / "polyMesh", types=types, thickness=foam.thickness, zones=zones, check=False)
        foam.keep_groups(target / "polyMesh" / "boundary")
        made.save(target / "polyMesh" / _MESH)
        return target, MeshOfCase.of(FoamMesh.read(target / "polyMesh"), made.diagram)

    def _warn_of_lost_fields(self, fields: Sequence[FoamField], foam: FoamMesh, time: Time) -> None:
        """Warn of the fields and folders of the latest time that are not transferred to the next mesh."""
        moving = {one.name for one in fields_that_move(fields, foam.patches)}
        dropped = [f"{one.name} ({one.kind})" for one in fields if one.name not in moving]
        dropped += [f"{name}/" for name in self.case.folders(time)]
        dropped += [f"{name} (a zone of faces or points)" for name in foam.lost_zones]
        if dropped:
            warn(
                f"the latest time of {self.case.folder} has {', '.join(dropped)}: not transferred, since only fields "
                "in cells are, and the flux phi of U unless patches are cyclic; copy the folder first if you need them",
                LostFieldsWarning,
            )

    def _present(self, latest: Time, note: dict[str, Any], mesh: object) -> MeshOfCase:
        """Return the mesh of the latest time; `mesh` is that of the caller for the first cycle."""
        folder = self.case.mesh_folder(latest)
        foam = self._mesh_in(folder)
        return MeshOfCase.of(foam, self._diagram(folder, foam, mesh if note["cycle"] == 0 else None))

    def _diagram(self, folder: Path, foam: FoamMesh, given: object) -> Diagram:
        """Return the diagram of the present mesh: given, kept beside it, or of the boundary and the centroids."""
        if given is None and (folder / _MESH).exists():
            given = folder / _MESH
        if isinstance(given, str | PathLike):
            given = load(given)
        if isinstance(given, Result):
            given = given.diagram
        if given is None:
            domain = foam.domain()
            if not foam.is_plane:
                return foam.diagram(domain)
            with warnings.catch_warnings():
                # The solver uses the mesh of the case, and not this diagram.
                warnings.simplefilter("ignore", MismatchWarning)
                return self.adapter.diagram(domain, foam.centroids[:, : domain.dim])
        if not isinstance(given, Diagram):
            raise InputTypeError(f"mesh is a {type(given).__name__}, expected a clvoro.Result, a Diagram or a path")
        own, there = set(given.domain.boundary_names), set(foam.types)
        if own != there:
            raise InputError(
                f"mesh has the boundaries {', '.join(sorted(own))}, the case the patches {', '.join(sorted(there))}; "
                "expected the same names: give them to the domain, and write the case from it"
            )
        # At the walls of a solid some cells are merged or divided.
        if abs(foam.n_cells - len(given)) > (0 if foam.is_plane else 0.1 * len(given)):
            raise InputError(f"mesh has {len(given)} cells, the case {foam.n_cells}; expected the mesh of the case")
        return given

    def _sizes_in_window(self, fields: Sequence[FoamField], old: MeshOfCase, latest: Time) -> Estimate:
        """Return the estimate from the latest time, and from those of the window on the same mesh."""
        case, made = self.case, self._sizes(fields, old)
        folder = case.mesh_folder(latest)
        found = []
        for one in case.times():
            inside = latest.value - self.window <= one.value < latest.value
            if inside and case.mesh_folder(one) == folder:
                earlier = case.fields(one)
                _check_values(earlier, old.foam)
                found.append(self._sizes(earlier, old))
        if not found:
            return made
        top = max(float(e.values.max()) for e in (*found, made))
        return normalize(combine(*found, made), n_cells=self.n_cells, h_max=top)

    def _sizes(self, fields: Sequence[FoamField], old: MeshOfCase) -> Estimate:
        found: dict[str, np.ndarray] = {}
        for one in fields:
            if one.in_cells:
                columns = old.to_diagram(one.internal.rows(old.foam.n_cells))
                if one.type == "vector":
                    columns = columns[:, : old.diagram.domain.dim]
                found[one.name] = columns[:, 0] if one.type == "scalar" else columns
        made = self.sizes(found, old.diagram, self.n_cells)
        if not isinstance(made, Estimate):
            raise InputTypeError(f"sizes returned a {type(made).__name__}, expected a clvoro.sizing.Estimate")
        return made

    def _draw(self, old: MeshOfCase, fields: Sequence[FoamField], row: FoamCycle) -> None:
        """Draw the mesh and the solution of a cycle, in space a section, and all cycles up to it side by side."""
        import importlib.util

        if importlib.util.find_spec("matplotlib") is None:
            return
        from matplotlib import image, pyplot

        first = getattr(self.sizes, "fields", ["U"])[0]
        shown = min((one for one in fields if one.in_cells), key=lambda one: one.name != first)
        values = old.to_diagram(shown.internal.rows(old.foam.n_cells))
        view = None if old.foam.is_plane else "slice"
        figure = old.diagram.plot(np.linalg.norm(values, axis=1), view, label=shown.name)
        axes = figure.axes[0]
        place = axes.get_title()  # of a section, in space
        axes.set_title("")
        axes.set_title(f"cycle {row.cycle}: {old.foam.n_cells:,} cells{place and ', '}{place}", loc="left")
        own = self.case.own
        figure.savefig(own / f"cycle-{row.cycle}.png", dpi=150, bbox_inches="tight")
        pyplot.close(figure)
        paths = [own / f"cycle-{k}.png" for k in range(row.cycle + 1)]
        parts = [image.imread(path) for path in paths if path.exists()]
        high, wide = (max(part.shape[axis] for part in parts) for axis in (0, 1))
        columns = min(len(parts), max(1, round(math.sqrt(len(parts) * high / wide))))
        page = np.ones((-(-len(parts) // columns) * high, columns * wide, parts[0].shape[2]), parts[0].dtype)
        for k, part in enumerate(parts):
            top, left = k // columns * high, k % columns * wide
            page[top : top + part.shape[0], left : left + part.shape[1]] = part
        image.imsave(own / "cycles.png", page)


def _check_values(fields: Sequence[FoamField], foam: FoamMesh) -> None:
    """Raise InputError if a field has not a finite value for each cell, or others at a patch."""
    for one in fields:
        if not one.in_cells:
            continue
        values = one.internal
        if not values.uniform and len(values.numbers) != foam.n_cells:
            raise InputError(
                f"the field {one.name} has {len(values.numbers)} values, the mesh {foam.n_cells} cells; expected a "
                "time and its own mesh"
            )
        bad = ~np.isfinite(values.numbers).all(axis=1)
        if bad.any():
            raise InputError(
                f"{one.name} is not finite in {int(bad.sum())} cells, the first is {int(bad.argmax())}; the solver has "
                "diverged: go back to an earlier time"
            )
        for patch in foam.patches:
            if patch.kind != "empty" and len(patch.faces):
                entries_at(one, patch)
        for name, entries in one.patches.items():
            for key, given in entries.items():
                if isinstance(given, Values) and not np.isfinite(given.numbers).all():
                    raise InputError(
                        f"{one.name} has a {key} at {name} that is not finite, expected numbers; go back to an earlier "
                        "time, or correct the condition"
                    )


def _layers_of(described: Sequence[Mapping[str, Any]]) -> list[Layers]:
    return [Layers(**{**one, "edges": None if one["edges"] is None else tuple(one["edges"])}) for one in described]


_COLUMNS = tuple(one.name for one in fields_of(FoamCycle) if one.name != "monitors")


def _write_report(path: Path, rows: Sequence[FoamCycle]) -> None:
    monitors = list(dict.fromkeys(name for row in rows for name in row.monitors))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([*_COLUMNS, *monitors])
    for row in rows:
        own = [getattr(row, name) for name in _COLUMNS]
        table.writerow(["" if v is None else v for v in (*own, *(row.monitors.get(m) for m in monitors))])
    with atomic_file(path) as file:
        file.write(text.getvalue().encode())


def _read_report(path: Path) -> list[FoamCycle]:
    if not path.exists():
        return []
    found = []
    with open(path, newline="") as file:
        for given in csv.DictReader(file):
            numbers = {key: float(value) for key, value in given.items() if value}
            own: dict[str, Any] = {key: numbers.pop(key, None) for key in _COLUMNS}
            for key in ("cycle", "cells", "next_cells"):
                own[key] = None if own[key] is None else int(own[key])
            found.append(FoamCycle(**own, monitors=numbers))
    return found
