"""Shallow water on the sphere with the TRiSK scheme: Williamson's test cases 2 and 5 on meshes of clvoro.

    python bench/shallow_water.py [--cells 2562,10242,40962]
                                  [--meshes uniform,uniform+2,graded,graded+2,icosahedral+50] [--cases 2,5]
                                  [--reference 163842] [--effort default] [--days N] [--alpha 0]
                                  [--courant 0.8] [--upwinding 0] [--quick] [--truncation]
                                  [--device NAME] [--dtype float32] [--json]

The solver (`_trisk.py`) is NumPy and SciPy; it takes nothing but an MPAS file. Test 2 is a steady zonal flow, rotated
by --alpha degrees: 5 days, norms of the error of height. Test 5 is a flow over a mountain: 15 days, norms of the
difference of the final surface height from that on the last mesh of the run, or on an icosahedral mesh of --reference
cells (Williamson et al. 1992, J. Comput. Phys. 102, 211); "l2 near" counts the cells within 30 degrees of the top of
the mountain. Order is that from the row above, in the square root of the number of cells. "mass", "energy" and
"enstrophy" (potential) are relative changes over the run. "s" are seconds of the time steps.

Cells of "graded" meshes are four times as wide opposite the mountain as on it. "icosahedral" meshes, for comparison,
have the generators of a bisected icosahedron; they have 10 4^k + 2 cells. "+N": after N steps of Lloyd's method, which
move each generator to the centroid of its cell. "offset" is the mean distance of generators from centroids over the
square root of the area.

The last table has the discrete balances, each relative to the magnitudes of its terms: total dh/dt, work of the
Coriolis force, total dE/dt in space, curl of the tangential field against the mean divergence, and the curl of the
tangential field of a flow without divergence (geostrophic balance). All should be round-off.

`--truncation` takes no time step. It prints what the operators get wrong in the initial state of test 2, whose du/dt is
zero: root mean squares over the edges of cells that have five or seven sides, or have a neighbor that does ("odd"),
and over all others ("else"). "du/dt" and "grad K", the error of the gradient of the kinetic energy, are relative to
the Coriolis force, "tangential", the error of the tangential velocity, to that velocity.

`--quick` is 642 and 2,562 cells and one day. The script fails if a run is unstable, or a balance is not round-off.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, names, parser, shown
from _trisk import Mesh, ShallowWater, balances, mesh_of, unit
from scipy.spatial import cKDTree

import clvoro

RADIUS, ROTATION, GRAVITY = 6.37122e6, 7.292e-5, 9.80616
"""Of the Earth, in SI units, as in Williamson et al. 1992."""
DAY = 86400.0
MOUNTAIN = (-90.0, 30.0)
"""Longitude and latitude of its top in degrees."""
MESHES = "uniform,uniform+2,graded,graded+2,icosahedral+50"
DAYS = {2: 5.0, 5: 15.0}
"""Length of each test case."""
FASTEST = 250.0
"""A run with a faster normal velocity, in m/s, is unstable: the flow of both cases has at most 60 m/s."""
ROUND_OFF = 1e-12
"""Bound for the balances. The sums have up to 10^5 terms of magnitudes around 1e-16 of their total."""


@dataclass(frozen=True)
class Case:
    """A test case on a mesh: initial height (n,) and normal velocity (m,), bottom (n,), f (v,), steady or not."""

    h: np.ndarray
    u: np.ndarray
    bottom: np.ndarray
    coriolis: np.ndarray
    steady: bool


def set_up(number: int, mesh: Mesh, alpha: float) -> Case:
    """Return the initial state of test case 2 or 5.

    The flow is a solid-body rotation about an axis that leans by `alpha` degrees, case 2 only. Normal velocities are
    differences of the stream function along faces, so that the divergence is zero.
    """
    lean = math.radians(alpha) if number == 2 else 0.0
    axis = np.array([-math.sin(lean), 0.0, math.cos(lean)])
    speed, level = (2 * math.pi * RADIUS / (12 * DAY), 2.94e4 / GRAVITY) if number == 2 else (20.0, 5960.0)
    sine = mesh.points @ axis
    bottom = mountain(mesh) if number == 5 else np.zeros(len(sine))
    surface = level - (RADIUS * ROTATION * speed + speed**2 / 2) / GRAVITY * sine**2
    stream = -RADIUS * speed * (mesh.corners @ axis)
    u = -np.diff(stream[mesh.edge_vertices], axis=1)[:, 0] / mesh.dv
    return Case(surface - bottom, u, bottom, 2 * ROTATION * (mesh.corners @ axis), number == 2)


def mountain_top() -> np.ndarray:
    """Return the unit vector (3,) of the mountain's top."""
    return clvoro.Sphere(1).positions([MOUNTAIN])[0]


def mountain(mesh: Mesh) -> np.ndarray:
    """Return the height of the conical mountain of test case 5 in cells, (n,)."""
    lon, lat = np.radians(clvoro.Sphere(1).lonlat(mesh.points)).T
    top_lon, top_lat = np.radians(MOUNTAIN)
    wide = math.pi / 9
    away = np.hypot(np.remainder(lon - top_lon + math.pi, 2 * math.pi) - math.pi, lat - top_lat)
    return 2000 * (1 - np.minimum(away, wide) / wide)


def make_mesh(adapter: clvoro.Adapter, kind: str, n: int, effort: str) -> clvoro.Diagram:
    """Return a mesh of `n` cells: uniform, graded or icosahedral, after the Lloyd steps that follow a plus."""
    kind, _, lloyd = kind.partition("+")
    sphere = clvoro.Sphere(RADIUS)
    fine = mountain_top()

    def graded(x: np.ndarray) -> np.ndarray:
        return 1 + 1.5 * (1 - (x @ fine) / RADIUS)

    if kind == "icosahedral":
        bisections = round(math.log(max(n - 2, 10) / 10, 4))
        if n != 10 * 4**bisections + 2:
            raise ValueError(f"no icosahedral mesh has {n} cells; expected 10 4^k + 2, such as 2562")
        diagram = adapter.diagram(sphere, sphere.icosahedral_points(bisections))
    else:
        size = graded if kind == "graded" else 1.0
        diagram = adapter.run(sphere, size, n_cells=n, effort=effort, seed=FIRST_SEED).diagram
    for _ in range(int(lloyd or 0)):
        diagram = adapter.diagram(sphere, diagram.centroids)
    return diagram


def mesh_names(text: str) -> list[str]:
    """Split a comma-separated option of kinds of meshes."""
    found = names(text)
    for name in found:
        if not re.fullmatch(r"(uniform|graded|icosahedral)(\+\d+)?", name):
            raise argparse.ArgumentTypeError(
                f"{name!r} is no mesh; expected uniform, graded or icosahedral, then maybe + and Lloyd steps"
            )
    return found


def norms(area: np.ndarray, error: np.ndarray, scale: np.ndarray) -> dict[str, float]:
    """Return the norms l1, l2 and linf of an error in cells of these areas relative to those of `scale`."""
    return {
        "l1": float(area @ np.abs(error) / (area @ np.abs(scale))),
        "l2": float(np.sqrt(area @ error**2 / (area @ scale**2))),
        "linf": float(np.abs(error).max() / np.abs(scale).max()),
    }


def interpolate(mesh: Mesh, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return values in cells (n,) at unit vectors (k, 3), (k,): a least-squares parabola through the 12 nearest."""
    near = cKDTree(mesh.points).query(at, 12)[1]
    first, second = clvoro.Sphere(1).tangents(at)
    away = mesh.points[near] - at[:, None]
    wide = np.linalg.norm(away, axis=2).max(axis=1)[:, None]
    x, y = (np.einsum("kij,kj->ki", away, t) / wide for t in (first, second))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
    return np.einsum("ki,ki->k", np.linalg.pinv(basis)[:, 0], values[near])


def relative_change(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    return {name: (after[name] - before[name]) / before[name] for name in before}


def integrate(
    model: ShallowWater, case: Case, seconds: float, courant: float
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Return the final h and u, and the record: steps, dt, stable, changes of the invariants, seconds of work."""
    fastest = math.sqrt(GRAVITY * case.h.max()) + np.abs(case.u).max()
    steps = max(math.ceil(seconds / (courant * model.stable_step(fastest))), 1)
    dt, h, u = seconds / steps, case.h, case.u
    start, stable = time.perf_counter(), True
    for _ in range(steps):
        h, u = model.step(h, u, dt)
        stable = bool(h.min() > 0 and np.abs(u).max() < FASTEST)
        if not stable:
            break
    change = relative_change(model.invariants(case.h, case.u), model.invariants(h, u))
    spent = time.perf_counter() - start
    return h, u, {"steps": steps, "dt": dt, "stable": stable, **change, "seconds": spent}


def measure(
    kind: str, number: int, mesh: Mesh, options: argparse.Namespace
) -> tuple[dict[str, Any], np.ndarray, dict[str, Any]]:
    """Run a case on a mesh. Return its record, the final height of the surface, and the record of the balances."""
    case = set_up(number, mesh, options.alpha)
    model = ShallowWater(mesh, GRAVITY, case.coriolis, case.bottom, options.upwinding)
    days = options.days or DAYS[number]
    h, u, record = integrate(model, case, days * DAY, options.courant)
    about = {"case": number, "mesh": kind, "cells": len(h)}
    record = {**about, "days": days, "dx_min": float(mesh.dc.min()) / 1e3, "dx": float(mesh.dc.mean()) / 1e3, **record}
    if case.steady:
        record |= norms(mesh.cell_areas, h - case.h, case.h)
    return record, h + case.bottom, {**about, **balances(model, h, u)}


def measure_truncation(kind: str, diagram: clvoro.Diagram, alpha: float) -> dict[str, Any]:
    """Return errors of the operators in the initial state of test case 2, near odd cells and elsewhere."""
    mesh = mesh_of(diagram)
    case = set_up(2, mesh, alpha)
    model = ShallowWater(mesh, GRAVITY, case.coriolis, case.bottom)
    operators, areas = model.operators, mesh.edge_areas
    odd = np.diff(diagram.neighbor_starts) != 6
    near = odd | (diagram.adjacency @ odd.astype(float) > 0)
    at_odd = near[mesh.edge_cells].any(axis=1)
    lean = math.radians(alpha)
    spin = 2 * math.pi * RADIUS / (12 * DAY) * np.array([-math.sin(lean), 0.0, math.cos(lean)])
    kinetic = (np.cross(spin, mesh.points) ** 2).sum(axis=1) / 2
    along = unit(np.diff(mesh.corners[mesh.edge_vertices], axis=1)[:, 0])
    tangential = (np.cross(spin, mesh.crossings) * along).sum(axis=1)
    found = operators.tangential @ case.u
    sign = np.sign(found @ tangential)  # of the direction in which vertices are listed

    def rms(x: np.ndarray, where: np.ndarray) -> float:
        return float(np.sqrt(areas[where] @ x[where] ** 2 / areas[where].sum()))

    everywhere = np.ones(len(areas), bool)
    force = rms((operators.vertex_to_edge @ case.coriolis) * tangential, everywhere)
    errors = {
        "rate": model.tendency(case.h, case.u)[1] / force,
        "kinetic": operators.grad @ (operators.kinetic @ case.u**2 - kinetic) / force,
        "tangential": (found - sign * tangential) / rms(tangential, everywhere),
    }
    return {
        "case": 2,
        "mesh": kind,
        "cells": len(odd),
        "odd": int(odd.sum()),
        "share": float(areas[at_odd].sum() / areas.sum()),
        **{name: (rms(x, at_odd), rms(x, ~at_odd)) for name, x in errors.items()},
    }


def compare(runs: list[tuple[dict[str, Any], Mesh, np.ndarray]]) -> None:
    """Add to records of case 5 the difference of the surface from that of the last run."""
    for record, mesh, surface in runs[:-1]:
        reference = interpolate(runs[-1][1], runs[-1][2], mesh.points)
        error = surface - reference
        near = mesh.points @ mountain_top() > math.cos(math.radians(30))
        around = norms(mesh.cell_areas * near, error, reference)
        record |= {**norms(mesh.cell_areas, error, reference), "l2_near": around["l2"]}


def add_orders(records: list[dict[str, Any]]) -> None:
    """Add the orders of convergence of l2 and linf from one record to the next of the same case and kind of mesh."""
    last: dict[tuple[int, str], dict[str, Any]] = {}
    for record in records:
        coarse = last.get((record["case"], record["mesh"]))
        last[record["case"], record["mesh"]] = record
        if coarse is None or "l2" not in record or "l2" not in coarse:
            continue
        ratio = math.log(math.sqrt(record["cells"] / coarse["cells"]))
        for norm in ("l2", "linf"):
            record[f"{norm}_order"] = math.log(coarse[norm] / record[norm]) / ratio


def common_columns() -> dict[str, Any]:
    return {"case": shown("case", "d"), "mesh": lambda r: r["mesh"], "cells": shown("cells", ",d")}


COLUMNS = {
    **common_columns(),
    "days": shown("days", "g"),
    "offset": shown("offset", ".1%"),
    "dx, least [km]": shown("dx_min", ".0f"),
    "dx, mean [km]": shown("dx", ".0f"),
    "dt [s]": shown("dt", ".0f"),
    "l1": shown("l1", ".2e"),
    "l2": shown("l2", ".2e"),
    "order": shown("l2_order", ".2f"),
    "l2 near": shown("l2_near", ".2e"),
    "linf": shown("linf", ".2e"),
    "order of linf": shown("linf_order", ".2f"),
    "mass": shown("mass", ".0e"),
    "energy": shown("energy", ".1e"),
    "enstrophy": shown("enstrophy", ".1e"),
    "stable": lambda r: "yes" if r["stable"] else "no",
    "s": shown("seconds", ".1f"),
}
OF_TRUNCATION = {
    **common_columns(),
    "odd cells": shown("odd", ",d"),
    "share of edges near": shown("share", ".1%"),
    **{
        f"{title}: odd, else": lambda r, name=name: "{:.4f}, {:.4f}".format(*r[name])
        for title, name in (("du/dt", "rate"), ("grad K", "kinetic"), ("tangential", "tangential"))
    },
}
BALANCES = ("mass_rate", "coriolis_work", "energy_rate", "dual_divergence", "geostrophic")
OF_BALANCES = {**common_columns(), **{name.replace("_", " "): shown(name, ".0e") for name in BALANCES}}


def plan(options: argparse.Namespace) -> list[tuple[str, int, list[int]]]:
    """Return the kinds of the meshes, their numbers of cells, and the cases that run on them."""
    wanted = [(kind, n, options.cases) for kind in options.meshes for n in options.cells]
    if options.reference and 5 in options.cases:
        wanted.append(("icosahedral+50", options.reference, [5]))
    return wanted


def run_all(adapter: clvoro.Adapter, options: argparse.Namespace) -> tuple[list[Any], list[Any]]:
    """Return the records of the runs and of the balances."""
    records, checked, compared = [], [], []
    for kind, n, cases in plan(options):
        diagram = make_mesh(adapter, kind, n, options.effort)
        mesh = mesh_of(diagram)
        offset = np.linalg.norm(diagram.centroids - diagram.points, axis=1)
        offset = float((offset / np.sqrt(diagram.volumes)).mean())
        for number in cases:
            record, surface, balance = measure(kind, number, mesh, options)
            records.append(record | {"offset": offset})
            print(f"{kind}, {n} cells, case {number}: {record}", file=sys.stderr, flush=True)
            checked.append(balance)
            if number == 5 and record["stable"]:
                compared.append((records[-1], mesh, surface))
    compare(compared)
    records.sort(key=lambda r: r["case"])
    add_orders(records)
    return records, checked


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--cells", type=counts, default=counts("2562,10242,40962"))
    made.add_argument("--meshes", type=mesh_names, default=mesh_names(MESHES), metavar="LIST")
    made.add_argument("--cases", type=counts, default=[2, 5])
    made.add_argument("--reference", type=int, default=0, metavar="CELLS", help="of case 5")
    made.add_argument("--effort", choices=("fast", "default", "best"), default="default")
    made.add_argument("--days", type=float, help="instead of 5 and 15")
    made.add_argument("--alpha", type=float, default=0.0, help="degrees, case 2 only")
    made.add_argument("--courant", type=float, default=0.8, help="share of the longest stable step")
    made.add_argument("--upwinding", type=float, default=0.0, help="APVM; 0.5 is usual")
    made.add_argument("--truncation", action="store_true", help="only errors of the operators")
    made.add_argument("--quick", action="store_true", help="642 and 2,562 cells, one day")
    options = made.parse_args(arguments)
    if options.quick:
        options.cells, options.days = [642, 2562], 1.0
    if not set(options.cases) <= set(DAYS):
        made.error(f"--cases is {options.cases}, expected 2, 5 or both")
    adapter = make_adapter(options)
    if options.truncation:
        report = Report(options.json, OF_TRUNCATION)
        for kind, n, _ in plan(options):
            diagram = make_mesh(adapter, kind, n, options.effort)
            report.add(measure_truncation(kind, diagram, options.alpha), f"{kind}, {n} cells")
        report.finish(heading(adapter, "Errors of the operators of TRiSK"))
        return 0
    try:
        records, checked = run_all(adapter, options)
    except ValueError as error:
        raise SystemExit(f"{type(error).__name__}: {error}") from error
    for columns, rows, title in (
        (COLUMNS, records, "Shallow water on the sphere, TRiSK"),
        (OF_BALANCES, checked, "Discrete balances of the final states"),
    ):
        report = Report(options.json, columns)
        for row in rows:
            report.add(row)
        report.finish(heading(adapter, title))
    stable = all(r["stable"] for r in records)
    return 0 if stable and all(r[name] < ROUND_OFF for r in checked for name in BALANCES) else 1


if __name__ == "__main__":
    raise SystemExit(main())
