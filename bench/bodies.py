"""Drag of bodies with OpenFOAM against cells: on uniform meshes, graded by hand, and adapted to the solution.

    python bench/bodies.py [--flow airfoil|sphere] [--uniform LIST] [--graded LIST] [--wake LIST] [--adapted LIST]
                           [--first N] [--goal forces|velocity] [--cycles 4] [--samples 1] [--reference LIST]
                           [--velocity N] [--pictures FOLDER] [--device NAME] [--json]

airfoil: a NACA 0012 section without incidence at Re 1000, in a square of 20 chords. sphere: Re 100, in a box of
16 x 12 x 12 diameters. The sides of the box slip. The flow is laminar and steady (`simpleFoam`).

"Graded" has sizes that grow from the body, by a share of the distance; the size at the body follows from the number of
cells. "Adapted" begins with a uniform mesh of --first cells, in which the body is as small as a cell or smaller;
`clvoro.foam.adapt_case` makes --cycles meshes for the forces on the body (`FieldSizes(forces="body")`), or with
`--goal velocity` for the L2 error of the velocity (`FieldSizes()`). No place is named, no size is given. Errors are
those of the coefficient of drag in percent of a reference. With --samples several meshes are made for each row, with
counts that differ by one percent and with other seeds: shown are the median and the range.

With --velocity "u %" is the L2 error of the velocity, linear between the cells, in percent of the norm of what the body
changes of the stream. It has no sign, so that two errors do not cancel. The reference is the flow on a mesh of N cells,
"wake" around the airfoil and structured around the sphere, where errors count within three diameters of the axis.

--reference, such as 3000,12000,48000, finds the reference: on structured meshes of quadrilaterals between the body and
the box, whose angles and ratios of radii are uniform; around the airfoil in the plane in which its chord is a circle.
Richardson's method extrapolates their drag to cells of size zero. The flow around the sphere is that of a wedge, in
a round box with the cross-section of the square one.
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
from _openfoam import Case, forces_on, require, write_prisms
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

import clvoro
from clvoro import foam, sizing
from clvoro.geometry.domain import Domain

GOALS = {"forces": foam.FieldSizes(forces="body"), "velocity": foam.FieldSizes()}
STEPS = 1500
"""Most iterations on one mesh."""
WEDGE = 0.1
"""Thickness of a wedge at the distance 1 from its axis."""


@dataclass(frozen=True)
class Flow:
    """A body in a stream of speed 1."""

    domain: Callable[[], Domain]  # with the boundaries inlet, outlet, sides and body
    viscosity: float
    area: float  # of the coefficient of drag
    thickness: float | None  # of the layer of cells, in 2D
    slope: float  # growth of the sizes that are graded by hand, per distance from the body
    drag: float  # the reference, by --reference
    lines: Callable[[], tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]]
    """Returns the body and the box as complex lines, and the map between the plane of the flow and theirs."""
    cells: dict[str, str]  # by kind of mesh
    window: tuple[tuple[float, float], tuple[float, float]]  # of a picture
    reach: float  # distance from the axis up to which errors of the velocity count


def around_airfoil() -> clvoro.Polygon:
    """Return a square of 20 chords around a section."""
    section = clvoro.curves.naca("0012", name="body")
    corners = [(-9.5, -10), (10.5, -10), (10.5, 10), (-9.5, 10)]
    return clvoro.Polygon(corners, [section], names={"sides": [0, 2], "outlet": 1, "inlet": 3})


def around_sphere() -> clvoro.Solid:
    """Return a box around a sphere of diameter 1."""
    ball = clvoro.Solid.ball((0, 0, 0), 0.5, edge=0.03, name="body")
    sides = {"inlet": 0, "outlet": 1, "sides": [2, 3, 4, 5]}
    return clvoro.Solid.outside(ball, clvoro.Box((-6, -6, -6), (10, 6, 6), names=sides))


def lines_of_airfoil() -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return section and square after a Joukowski map, and the inverse map.

    The map makes a circle of a chord that begins at the focus of the nose. At the sharp tail, where stresses have a
    singularity, sizes of cells are proportional to the square of the angle.
    """
    nose = 1.1019 * 0.12**2 / 2

    def to_circle(z: np.ndarray) -> np.ndarray:
        w = 4 * (z - nose) / (1 - nose) - 2
        return (w + np.sqrt(w - 2) * np.sqrt(w + 2)) / 2

    x, y = clvoro.curves.naca("0012", tolerance=1e-8).vertices.T
    corners = np.array([10.5 - 10j, 10.5 + 10j, -9.5 + 10j, -9.5 - 10j])
    return (
        to_circle(x + 1j * y),
        to_circle(along(np.append(corners, corners[0]))),
        lambda z: nose + (z + 1 / z + 2) * (1 - nose) / 4,
    )


def lines_of_sphere() -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return half of a section of the sphere and of a round box with the length and area of the square one."""
    wide = 12 / math.sqrt(math.pi)
    corners = np.array([10, 10 + 1j * wide, -6 + 1j * wide, -6])
    return 0.5 * np.exp(1j * np.linspace(0, math.pi, 1001)), along(corners), lambda z: z


def along(corners: np.ndarray) -> np.ndarray:
    """Return points on the straight lines between corners, these included."""
    k = np.linspace(0, len(corners) - 1, 2000 * (len(corners) - 1) + 1)
    return np.interp(k, np.arange(len(corners)), corners)


FLOWS = {
    "airfoil": Flow(
        around_airfoil,
        1e-3,
        0.1,
        0.1,
        0.15,
        0.1199,
        lines_of_airfoil,
        {"uniform": "10000,40000", "graded": "1000,2000,4000,8000,16000", "wake": "", "adapted": "1000,2000,4000"},
        ((-0.3, -0.4), (1.7, 0.4)),
        math.inf,
    ),
    "sphere": Flow(
        around_sphere,
        1e-2,
        math.pi / 4,
        None,
        0.2,
        1.0963,
        lines_of_sphere,
        {"uniform": "20000", "graded": "8000,20000", "adapted": "8000,20000"},
        ((-1.5, -1.5), (3.5, 1.5)),
        3.0,
    ),
}


def graded(flow: Flow, domain: Domain, n: int, wake: bool = False) -> sizing.Field:
    """Return sizes that grow from the body, or in the plane from its wake, too, for about `n` cells."""
    if wake:
        x = float(domain.upper[0])
        # A strip of the length x with cells of the size h in its middle has 2 x / (slope h) of them.
        strip = f"{4 * x / (flow.slope * n)} + {flow.slope} * hypot(y, fmax(1.0 - x, 0.0))"
        return sizing.minimum(graded(flow, domain, n // 2), sizing.Expression(strip))
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


def mesh_structured(case: Case, flow: Flow, n: int) -> None:
    """Write a mesh of about `n` quadrilaterals between the body and the box, in the plane or as a wedge."""
    body, box, back = flow.lines()
    whole = flow.thickness is not None
    turn = 2 * math.pi if whole else math.pi
    ratio = float(np.log(np.abs(box)).mean() - np.log(np.abs(body)).mean()) / turn
    many = round(math.sqrt(n / ratio))
    angle = turn * np.arange(many + (not whole)) / many
    if not whole:
        # The axis is a narrow tube.
        angle[[0, -1]] += 1e-3 * turn / many * np.array([1, -1])
    inner, outer = (
        np.interp(angle, np.angle(line) % (2 * math.pi), np.log(np.abs(line)), period=2 * math.pi) + 1j * angle
        for line in (body, box)
    )
    corners = box[2000:-1:2000] if not whole else box[:-1:2000]
    for corner in corners:
        at = np.angle(corner) % (2 * math.pi)
        outer[np.abs(angle - at).argmin()] = math.log(abs(corner)) + 1j * at
    share = np.linspace(0, 1, round(ratio * many) + 1)[:, None]
    share = (share + share**2) / 2
    points = back(np.exp((1 - share) * inner + share * outer)).ravel()
    row, k = np.meshgrid(np.arange(len(share) - 1), np.arange(many), indexing="ij")
    a, b = (row * len(angle) + (k + step) % len(angle) for step in (0, 1))
    cells = np.stack([a, a + len(angle), b + len(angle), b], axis=-1).reshape(-1, 4)
    flat = np.column_stack([points.real, points.imag])
    front, end, side = back(box).real.min() + 1e-3, back(box).real.max() - 1e-3, back(box).imag.max() - 1e-3

    def patch_of(middles: np.ndarray) -> np.ndarray:
        u, v = middles.T
        is_axis = (v < 0.05 * turn / many) & (not whole)
        return np.select([u < front, u > end, np.abs(v) > side, is_axis], [0, 1, 2, 4], 3)

    kinds = {**dict.fromkeys(("inlet", "outlet", "sides"), "patch"), "body": "wall"} | (
        {} if whole else {"axis": "patch"}
    )
    write_prisms(case.folder, flat, list(cells), patch_of, kinds, flow.thickness or WEDGE, wedge=not whole)


def write_case(case: Case, flow: Flow, wedge: bool = False) -> None:
    """Write fields and dictionaries."""
    sides = "wedge" if wedge else "empty"
    flat = {} if flow.thickness is None and not wedge else {name: {"type": sides} for name in ("back", "front")}
    if wedge:
        flat["axis"] = {"type": "slip"}
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
    # Across a wedge the velocity is round-off.
    limits = {"p": 1e-7} if wedge else {"p": 1e-5, "U": 1e-6}
    functions = {"forces": forces_on("body", 1.0, 1.0, WEDGE / 8 if wedge else flow.area)}
    case.write_system(
        flow.viscosity,
        solution={"solvers": solvers, "SIMPLE": {"consistent": "yes", "residualControl": limits}},
        control={"endTime": STEPS, "writePrecision": 10, "functions": functions},
    )


def solve(
    case: Case,
    flow: Flow,
    adapter: clvoro.Adapter,
    kind: str,
    n: int,
    first: int | None = None,
    cycles: int = 1,
    seed: int = FIRST_SEED,
    goal: foam.FieldSizes | None = None,
) -> float:
    """Solve on a mesh of `n` cells, or adapt one to the solution; return the coefficient of drag."""
    if kind == "structured":
        mesh_structured(case, flow, n)
        write_case(case, flow, wedge=flow.thickness is None)
        case.run("simpleFoam")
        return float(case.table("forces", "coefficient.dat")["Cd"][-1])
    domain = flow.domain()
    count = first or n if kind == "adapted" else n
    size: object = (float(domain.measure) / count) ** (1 / domain.cell_dim)
    if kind in ("graded", "wake"):
        size = graded(flow, domain, n, kind == "wake")
    made = adapter.run(domain, size, n_cells=count, seed=seed)
    case.write_mesh(made, ("inlet", "outlet", "sides"), flow.thickness)
    write_case(case, flow)
    if kind == "adapted":
        options: dict[str, Any] = {"sizes": goal, "interval": STEPS, "pictures": False, "adapter": adapter}
        foam.adapt_case(case.folder, n_cells=n, cycles=cycles, solver="simpleFoam", **options)
    else:
        case.run("simpleFoam")
    return float(case.table("forces", "coefficient.dat")["Cd"][-1])


class Reference:
    """The velocity on a fine mesh, against which others are measured.

    `velocity` (n, d) is that `at` the centroids of its cells, with their volumes as `weight`; around the sphere each is
    turned about the axis by several angles.
    """

    def __init__(self, case: Case, flow: Flow) -> None:
        mesh = case.latest_mesh()
        inside = mesh.centroids[:, 1] < flow.reach
        self.at, self.weight = mesh.centroids[inside, :2], mesh.volumes[inside]
        self.velocity = case.field("U", len(mesh))[inside, :2]
        if flow.thickness is None:
            angle = 2.4 * np.add.outer(np.arange(4), 4 * np.arange(len(self.at))).ravel()
            turn = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
            self.at, self.velocity = (np.tile(v, (4, 1))[:, [0, 1, 1]] * turn for v in (self.at, self.velocity))
            self.weight = np.tile(self.weight, 4)

    def error(self, case: Case) -> float:
        """Return the L2 error of the velocity of a case, in percent of what the body changes of the stream."""
        d, mesh = self.at.shape[1], case.latest_mesh()
        at = np.concatenate([mesh.centroids, mesh.faces[0][mesh.patch("body")]])[:, :d]
        known = np.zeros((len(at), d))
        known[: len(mesh)] = case.field("U", len(mesh))[:, :d]
        found = LinearNDInterpolator(at, known)(self.at)
        beyond = np.isnan(found[:, 0])
        found[beyond] = NearestNDInterpolator(at, known)(self.at[beyond])
        stream = np.eye(d)[0]
        off, all_ = (self.weight @ ((v - self.velocity) ** 2).sum(axis=1) for v in (found, stream))
        return 100 * math.sqrt(off / all_)


def extrapolated(cells: list[float], drags: list[float]) -> tuple[float, float, float]:
    """Return the drag extrapolated to cells of size zero, its uncertainty, and the order of its error on three meshes.

    The error is proportional to h^2, which is 1 / cells in the plane. The uncertainty is the difference to the value
    without the finest mesh.
    """
    fine, coarse = (
        float(np.polyfit(1 / np.array(cells[rows]), drags[rows], 1)[1]) for rows in (slice(-2, None), slice(-3, -1))
    )
    order = math.log(abs((drags[-3] - drags[-2]) / (drags[-2] - drags[-1])), math.sqrt(cells[-1] / cells[-2]))
    return fine, abs(fine - coarse), order


def draw(records: list[dict[str, Any]], case: Case, flow: Flow, path: Path) -> None:
    """Draw errors against cells, and the last mesh of `case`, colored by speed."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    shown = "velocity" if "velocity" in records[-1] else "error"
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), width_ratios=(2, 3), layout="constrained")
    for kind in flow.cells:
        rows = [row for row in records if row["mesh"] == kind]
        errors = [abs(statistics.median(row[shown])) for row in rows]
        left.loglog([statistics.median(row["cells"]) for row in rows], errors, "o-", label=kind)
    left.set(xlabel="cells", ylabel=f"error of the {'drag' if shown == 'error' else 'velocity'}, %")
    left.legend(frameon=False)
    options = {"view": "slice", "normal": "z"} if flow.thickness is None else {"view": "cells"}
    case.plot_speed(ax=right, window=flow.window, title=f"adapted, {len(case.latest_mesh()):,} cells", **options)
    figure.savefig(path, dpi=130)
    plt.close(figure)


COLUMNS = {
    "mesh": lambda r: r["mesh"],
    "cells": lambda r: f"{statistics.median(r['cells']):,.0f}",
    "c_D": lambda r: spread(r["drag"], ".4f"),
    "error %": lambda r: spread(r["error"], "+.2f"),
    "u %": lambda r: spread(r["velocity"], ".2f") if "velocity" in r else "",
    "s": lambda r: f"{statistics.median(r['seconds']):.0f}",
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--flow", choices=tuple(FLOWS), default="airfoil")
    for kind in ("uniform", "graded", "wake", "adapted"):
        options_of.add_argument(f"--{kind}", type=counts, metavar="LIST")
    options_of.add_argument("--first", type=int, metavar="N", help="cells of the first mesh; by default as many")
    options_of.add_argument("--reference", type=counts, metavar="LIST", help="cells of three or more structured meshes")
    options_of.add_argument("--velocity", type=int, metavar="N", help="cells of the reference of the velocity")
    options_of.add_argument("--goal", choices=tuple(GOALS), default="forces")
    options_of.add_argument("--cycles", type=int, default=4)
    options_of.add_argument("--samples", type=int, default=1)
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER")
    options = options_of.parse_args()
    require("simpleFoam")
    flow, adapter, report = FLOWS[options.flow], make_adapter(options), Report(options.json, COLUMNS)
    with tempfile.TemporaryDirectory() as folder:
        asked = {kind: getattr(options, kind) for kind in flow.cells}
        lists = {kind: counts(flow.cells[kind]) if given is None else given for kind, given in asked.items()}
        finest = None
        if options.velocity:
            case = Case(Path(folder) / "finest")
            case.folder.mkdir()
            solve(case, flow, adapter, "wake" if flow.thickness else "structured", options.velocity)
            finest = Reference(case, flow)
        for kind, many_cells in {"structured": options.reference or [], **lists}.items():
            for n in many_cells:
                found: dict[str, list[float]] = {}
                for sample in range(1 if kind == "structured" else options.samples):
                    case, start = Case(Path(folder) / f"{kind}-{n}-{sample}"), time.perf_counter()
                    case.folder.mkdir()
                    many, seed = round(n * (1 + 0.01 * sample)), FIRST_SEED + sample
                    drag = solve(
                        case, flow, adapter, kind, many, options.first, options.cycles, seed, GOALS[options.goal]
                    )
                    row = {"cells": len(case.latest_mesh()), "drag": drag, "error": 100 * (drag / flow.drag - 1)}
                    row["seconds"] = time.perf_counter() - start
                    if finest is not None and (kind != "structured" or flow.thickness is not None):
                        row["velocity"] = finest.error(case)
                    for key, value in row.items():
                        found.setdefault(key, []).append(value)
                report.add({"mesh": kind, **found}, f"{kind}, {n}")
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw(report.records, case, flow, options.pictures / f"{options.flow}.png")
    report.finish(heading(adapter, f"Drag of the {options.flow}, reference {flow.drag}"))
    if options.reference and len(options.reference) > 2:
        found = [row for row in report.records if row["mesh"] == "structured"]
        drag, off, order = extrapolated(*([statistics.median(row[key]) for row in found] for key in ("cells", "drag")))
        print(f"Reference by Richardson: {drag:.5f} +- {off:.5f}, observed order {order:.2f}")


if __name__ == "__main__":
    main()
