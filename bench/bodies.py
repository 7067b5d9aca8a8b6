"""Drag of bodies with OpenFOAM against cells: on uniform meshes, graded by hand, and adapted to the solution.

    python bench/bodies.py [--flow airfoil|sphere] [--uniform LIST] [--graded LIST] [--adapted LIST] [--first N]
                           [--cycles 4] [--samples 1] [--pictures FOLDER] [--device NAME] [--json]

airfoil: a NACA 0012 section without incidence at Re 1000, in a square of 20 chords. sphere: Re 100, in a box of
16 x 12 x 12 diameters. The sides of the box slip. The flow is laminar and steady (`simpleFoam`).

"Graded" has sizes that grow from the body, by a share of the distance; the size at the body follows from the number of
cells. "Adapted" begins with a uniform mesh of --first cells, in which the body is as small as a cell or smaller;
`clvoro.foam.adapt_case` makes --cycles meshes for the forces on the body (`FieldSizes(forces="body")`). No place is
named, no size is given. Errors are those of the coefficient of drag in percent of a reference: for the airfoil that of
fine meshes in the same box, known to 0.5 %, for the sphere one without a box (Johnson and Patel 1999, from memory).
With --samples several meshes are made for each row, with counts that differ by one percent and with other seeds: shown
are the median and the range.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, parser, spread
from _openfoam import Case, forces_on, require

import clvoro
from clvoro import foam, sizing
from clvoro.foam.case import FoamCase
from clvoro.geometry.domain import Domain

STEPS = 1500
"""Most iterations on one mesh."""


@dataclass(frozen=True)
class Flow:
    """A body in a stream of speed 1.

    Attributes
    ----------
    domain : callable
        Its boundaries are inlet, outlet, sides and body.
    viscosity, area : float
        Area of the coefficient of drag.
    thickness : float or None
        Of the layer of cells, in 2D.
    slope : float
        Growth of the sizes that are graded by hand, per distance from the body.
    drag : float
        The reference.
    cells : dict of str to str
        Numbers of cells by kind of mesh.
    window : tuple
        Part of a picture.
    """

    domain: Callable[[], Domain]
    viscosity: float
    area: float
    thickness: float | None
    slope: float
    drag: float
    cells: dict[str, str]
    window: tuple[tuple[float, float], tuple[float, float]]


def around_airfoil() -> clvoro.Polygon:
    """Return a square of 20 chords around a section."""
    section = clvoro.curves.naca("0012", name="body")
    corners = [(-9.5, -10), (10.5, -10), (10.5, 10), (-9.5, 10)]
    return clvoro.Polygon(corners, [section], names={"sides": [0, 2], "outlet": 1, "inlet": 3})


def around_sphere() -> clvoro.Solid:
    """Return a box around a sphere of diameter 1."""
    ball = clvoro.Solid.ball((0, 0, 0), 0.5, edge=0.03, group_names=["body"])
    sides = {"inlet": 0, "outlet": 1, "sides": [2, 3, 4, 5]}
    return clvoro.Solid.outside(ball, clvoro.Box((-6, -6, -6), (10, 6, 6), names=sides))


FLOWS = {
    "airfoil": Flow(
        around_airfoil,
        1e-3,
        0.1,
        0.1,
        0.15,
        0.1217,
        {"uniform": "10000,40000", "graded": "1000,2000,4000,8000,16000", "adapted": "1000,2000,4000"},
        ((-0.3, -0.4), (1.7, 0.4)),
    ),
    "sphere": Flow(
        around_sphere,
        1e-2,
        math.pi / 4,
        None,
        0.2,
        1.09,
        {"uniform": "20000", "graded": "8000,20000", "adapted": "8000,20000"},
        ((-1.5, -1.5), (3.5, 1.5)),
    ),
}


def graded(flow: Flow, domain: Domain, n: int) -> sizing.Field:
    """Return sizes that grow from the body, for about `n` cells."""
    d = domain.cell_dim
    distance = np.geomspace(1e-5, float(domain.measure) ** (1 / d) / 2, 2000)
    # Shells around a plate of length 1, or a ball of diameter 1.
    shell = 2 + 2 * math.pi * distance if d == 2 else 4 * math.pi * (0.5 + distance) ** 2
    low, high = 1e-5, distance[-1]
    for _ in range(50):
        h = math.sqrt(low * high)
        most = np.trapezoid(shell / (h + flow.slope * distance) ** d, distance)
        low, high = (h, high) if most > n else (low, h)
    return sizing.Distance(domain.boundary("body"), h_min=low, slope=flow.slope)


def write_case(case: Case, flow: Flow) -> None:
    """Write fields and dictionaries."""
    flat = {} if flow.thickness is None else {name: {"type": "empty"} for name in ("back", "front")}
    closed, slip = {"type": "zeroGradient"}, {"type": "slip"}
    stream, zero = ({"type": "fixedValue", "value": f"uniform {value}"} for value in ("(1 0 0)", "0"))
    case.write_start(
        {"inlet": stream, "outlet": closed, "sides": slip, "body": {"type": "noSlip"}, **flat},
        {"inlet": closed, "outlet": zero, "sides": slip, "body": closed, **flat},
        ("uniform (1 0 0)", "uniform 0"),
    )
    solvers = {
        "p": {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-10, "relTol": 0.05},
        "U": {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": 1e-11, "relTol": 0.05},
    }
    functions = {"forces": forces_on("body", 1.0, 1.0, flow.area)}
    case.write_system(
        flow.viscosity,
        solution={"solvers": solvers, "SIMPLE": {"consistent": "yes", "residualControl": {"p": 1e-5, "U": 1e-6}}},
        control={"endTime": STEPS, "writePrecision": 10, "functions": functions},
    )


def solve(
    case: Case, flow: Flow, adapter: clvoro.Adapter, kind: str, n: int, first: int, cycles: int, seed: int
) -> float:
    """Solve on a mesh of `n` cells, or adapt one to the solution; return the coefficient of drag."""
    domain = flow.domain()
    count = first if kind == "adapted" else n
    size = graded(flow, domain, n) if kind == "graded" else (float(domain.measure) / count) ** (1 / domain.cell_dim)
    made = adapter.run(domain, size, n_cells=count, seed=seed)
    folder = case.folder / "constant" / "polyMesh"
    made.to_openfoam(folder, types=dict.fromkeys(("inlet", "outlet", "sides"), "patch"), thickness=flow.thickness)
    made.save(folder / "clvoro.npz")
    write_case(case, flow)
    if kind == "adapted":
        goal = foam.FieldSizes(forces="body")
        options: dict[str, Any] = {"sizes": goal, "interval": STEPS, "pictures": False, "adapter": adapter}
        foam.adapt_case(case.folder, n_cells=n, cycles=cycles, solver="simpleFoam", **options)
    else:
        case.run("simpleFoam")
    return float(case.table("forces", "coefficient.dat")["Cd"][-1])


def draw(records: list[dict[str, Any]], case: Case, flow: Flow, path: Path) -> None:
    """Draw errors against cells, and the last mesh of `case`, colored by speed."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), width_ratios=(2, 3), layout="constrained")
    for kind in flow.cells:
        rows = [row for row in records if row["mesh"] == kind]
        errors = [abs(statistics.median(row["error"])) for row in rows]
        left.loglog([statistics.median(row["cells"]) for row in rows], errors, "o-", label=kind)
    left.set(xlabel="cells", ylabel="error of the drag, %")
    left.legend(frameon=False)
    known = FoamCase(case.folder)
    mesh = clvoro.load(known.mesh_folder(known.latest()) / "clvoro.npz")
    speed = np.linalg.norm(case.field("U", len(mesh)), axis=1)
    options = {"view": "slice", "normal": "z"} if flow.thickness is None else {"view": "cells"}
    mesh.plot(speed, ax=right, window=flow.window, label="speed", title=f"adapted, {len(mesh):,} cells", **options)
    figure.savefig(path, dpi=130)
    plt.close(figure)


COLUMNS = {
    "mesh": lambda r: r["mesh"],
    "cells": lambda r: f"{statistics.median(r['cells']):,.0f}",
    "c_D": lambda r: spread(r["drag"], ".4f"),
    "error %": lambda r: spread(r["error"], "+.2f"),
    "s": lambda r: f"{statistics.median(r['seconds']):.0f}",
}


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--flow", choices=tuple(FLOWS), default="airfoil")
    for kind in ("uniform", "graded", "adapted"):
        options_of.add_argument(f"--{kind}", type=counts, metavar="LIST")
    options_of.add_argument("--first", type=int, metavar="N", help="cells of the first mesh; by default as many")
    options_of.add_argument("--cycles", type=int, default=4)
    options_of.add_argument("--samples", type=int, default=1)
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER")
    options = options_of.parse_args()
    require("simpleFoam")
    flow, adapter, report = FLOWS[options.flow], make_adapter(options), Report(options.json, COLUMNS)
    with tempfile.TemporaryDirectory() as folder:
        for kind, default in flow.cells.items():
            given = getattr(options, kind)
            for n in counts(default) if given is None else given:
                found: dict[str, Any] = {"cells": [], "drag": [], "error": [], "seconds": []}
                for sample in range(options.samples):
                    case, start = Case(Path(folder) / f"{kind}-{n}-{sample}"), time.perf_counter()
                    case.folder.mkdir()
                    many = round(n * (1 + 0.01 * sample))
                    drag = solve(
                        case, flow, adapter, kind, many, options.first or many, options.cycles, FIRST_SEED + sample
                    )
                    row = (len(case.latest_mesh()), drag, 100 * (drag / flow.drag - 1), time.perf_counter() - start)
                    for values, value in zip(found.values(), row, strict=True):
                        values.append(value)
                report.add({"mesh": kind, **found}, f"{kind}, {n}")
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw(report.records, case, flow, options.pictures / f"{options.flow}.png")
    report.finish(heading(adapter, f"Drag of the {options.flow}, reference {flow.drag}"))


if __name__ == "__main__":
    main()
