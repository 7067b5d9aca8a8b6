"""One step of a run by its parts: displacement, motion, update of the diagram, evaluation; and the machine's limits.

    python bench/step.py [--sizes 1e5,1e6] [--kinds weighted,glide,polish] [--repeat 7]
                         [--processor-time] [--device NAME] [--dtype float32] [--json]

A fast run makes a mesh of F2 scaled to the count (see `convergence.py`). A few steps of each kind of a default run
follow: "weighted" couples weighted centroids and the Poisson correction, "glide" and "polish" project onto the cells'
sizes. Times are medians over `--repeat` further steps, from an
idle queue to an idle queue, in milliseconds: "displace" finds the displacement ("solve" is the
device's time of its linear solver), "diagram" updates the tessellation, "rest" moves, evaluates h,
error, quality and their sums. "diagram M/s" is cells per second of the updated diagram with all its measures,
"to host" the bytes that the host reads. "cold" makes the same diagram from nothing, from binning on.

The second table holds kernels against the machine: bytes that must move per cell (each array that
the kernel needs, once) over what copying moves per second, and operations that must be done per
cell over what independent multiply-adds reach, each as a share of the time measured; the larger
says how near the kernel is to its limit. Operations are counted from the source for a cell of six
faces, a division as four.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
from _common import BOX, Report, clock_of, counts, heading, make_adapter, markdown, names, parser, test_field

import clvoro
from clvoro.adaptation.methods import ProjectedMethod, WeightedMethod
from clvoro.adaptation.motion import Displacement, Method
from clvoro.adaptation.plan.actions import Step
from clvoro.adaptation.plan.schedule import adaptive_schedule
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.state import MeshState
from clvoro.opencl.engine import Engine
from clvoro.opencl.profile import Profile, profiled_queue
from clvoro.sizing import Sizing
from clvoro.tessellation.device_diagram import Follow, Tessellation

CELLS_OF_F2 = 22972
SOLVERS = ("poisson", "multigrid", "aggregation", "conjugate_gradient", "volume_projection")
WARM_UP = 4


def kinds() -> dict[str, Callable[[], Method]]:
    """Return functions that create the methods of the steps of a default run on its finest level."""
    steps = [a.method for a in adaptive_schedule(2, "default", 1, exact=False) if isinstance(a, Step)]
    projected = {m.descent: m for m in steps if isinstance(m, ProjectedMethod)}
    coupled = [m for m in steps if isinstance(m, WeightedMethod)]
    last = {"weighted": coupled[-1], "glide": projected["lloyd"], "polish": projected["quality"]}
    return {name: partial(replace, method) for name, method in last.items()}


KINDS = kinds()

NEEDS = {
    # kernel: (reals, integers, operations) per cell of six faces
    "incremental.check_rows": (2, 6 + 3, 6 * 40),
    "cells.match_polygon_faces": (0, 4, 0),
    "cells.measure_cells": (2 + 1 + 2 + 3, 6 + 6 + 4 + 6 + 12, 6 * 75 + 40),
    "metric.evaluate_metric": (1 + 2 + 3 + 1 + 4 + 2 + 2 + 2, 1 + 6 + 6 + 1 + 1, 60 + 6 * 12),
    "density.fit_gradient": (2 + 1 + 2 + 3 + 2 + 2, 6 + 1, 6 * 20 + 50),
    "quality_descent.descend_quality": (2 + 4 + 2, 6 + 1 + 6 + 12, 6 * 60),
    "motion.move_generators": (2 + 2 + 1 + 2 + 2 + 2, 0, 20),
    "poisson.assemble_laplacian": (2 + 1, 6 + 1 + 6 + 12, 3 * 20),
    "volume_projection.assemble_projection": (2 + 1 + 2 + 1 + 2, 6 + 1 + 6 + 12 + 12 + 12, 6 * 40),
    "volume_projection.update_projection_direction": (0, 6 + 1 + 12 + 2 + 1 + 2 + 2, 6 * 4),
    "volume_projection.update_projection": (0, 6 + 1 + 12 + 2 + 1 + 2 + 2, 6 * 4),
}
"""What each kernel must at least transfer and compute. Numbers in single precision count as integers."""

ITERATED = ("update_projection_direction", "update_projection")
"""Kernels that are enqueued for more iterations than are needed. Only calls of the needed ones count."""

PEAK = """
kernel void multiply_add(const int size, const REAL a, const REAL b, global REAL *out)
{
    const int i = get_global_id(0);
    VEC x[8];
    for (int k = 0; k < 8; ++k)
        x[k] = (VEC)(i + k);
    for (int n = 0; n < 4096; ++n)
        for (int k = 0; k < 8; ++k)
            x[k] = fma(x[k], (VEC)(a), (VEC)(b));
    VEC sum = 0;
    for (int k = 0; k < 8; ++k)
        sum += x[k];
    if (i < size)
        out[i] = sum.s0 + sum.s1 + sum.s2 + sum.s3 + sum.s4 + sum.s5 + sum.s6 + sum.s7;
}
"""


def peak_operations(adapter: clvoro.Adapter) -> float:
    """Operations per second of independent multiply-adds, in vectors of eight; a multiply-add is two."""
    real = "double" if adapter.dtype == np.float64 else "float"
    queue = profiled_queue(adapter.ctx)
    options = [f"-DREAL={real}", f"-DVEC={real}8"]
    kernel = cl.Program(adapter.ctx, PEAK).build(options=options).multiply_add
    items = 64 * 64 * adapter.ctx.devices[0].max_compute_units
    out = cl.Buffer(adapter.ctx, cl.mem_flags.READ_WRITE, 8 * items)
    scalar = adapter.dtype.type
    best = float("inf")
    for _ in range(5):
        event = kernel(queue, (items,), (64,), np.int32(items), scalar(0.5), scalar(1), out)
        event.wait()
        best = min(best, 1e-9 * (event.profile.end - event.profile.start))
    return items * 4096 * 8 * 8 * 2 / best


def fresh_mesh(adapter: clvoro.Adapter, queue: cl.CommandQueue, points: np.ndarray, n: int) -> MeshState:
    engine = Engine(adapter.ctx, queue, 2, adapter.dtype)
    field = test_field("F2") * (CELLS_OF_F2 / n) ** 0.5
    origin, scale = BOX.frame
    unsorted = engine.upload((points - origin) / scale)
    return MeshState.create(Stages(engine), BOX, Sizing(engine, BOX, field), unsorted)


def take_steps(
    mesh: MeshState, method: Method, repeat: int, clock: Callable[[], float]
) -> tuple[dict[str, list[float]], int]:
    """Seconds of the parts of `repeat` steps, by `clock`, and the iterations of their solves."""
    queue = mesh.engine.queue
    parts: dict[str, list[float]] = {"displace": [], "diagram": [], "rest": []}

    def timed(function: Callable[[], object]) -> float:
        queue.finish()
        start = clock()
        function()
        queue.finish()
        return clock() - start

    tessellator = mesh.tessellator
    original = tessellator.tessellate
    spent = 0.0
    made: list[Displacement] = []

    def tessellate(*args: Any, follow: Follow, **named: Any) -> Any:
        nonlocal spent
        kept: list[Any] = []
        after = 0.0

        def timed_follow(t: Tessellation, report: Any) -> list[int]:
            nonlocal after
            found: list[list[int]] = []
            after += timed(lambda: found.append(follow(t, report)))
            return found[0]

        spent = timed(lambda: kept.append(original(*args, follow=timed_follow, **named))) - after
        return kept[0]

    tessellator.tessellate = tessellate  # type: ignore[method-assign]
    try:
        for _ in range(repeat):
            with mesh.engine.workspace.frame():
                parts["displace"].append(timed(lambda: made.append(method.step(mesh))))
                moving = timed(lambda: mesh.move(made[-1]))
            rest = moving + timed(mesh.update)
            parts["diagram"].append(spent)
            parts["rest"].append(rest - spent)
    finally:
        tessellator.tessellate = original  # type: ignore[method-assign]
    return parts, sum(displacement.solution.iterations for displacement in made)


def measure(
    adapter: clvoro.Adapter, kind: str, points: np.ndarray, n: int, repeat: int, clock: Callable[[], float]
) -> dict[str, Any]:
    mesh, method = fresh_mesh(adapter, adapter.queue, points, n), KINDS[kind]()
    take_steps(mesh, method, WARM_UP, clock)
    taken, _ = take_steps(mesh, method, repeat, clock)
    parts = {k: statistics.median(v) for k, v in taken.items()}
    cold = []
    for _ in range(3):
        mesh.engine.queue.finish()
        start = clock()
        mesh.tessellation = mesh.tessellator.tessellate(mesh.points, mesh.n)
        mesh.engine.queue.finish()
        cold.append(clock() - start)
    del mesh

    queue = profiled_queue(adapter.ctx)
    mesh, method = fresh_mesh(adapter, queue, points, n), KINDS[kind]()
    take_steps(mesh, method, WARM_UP, clock)
    with Profile(queue) as profile:
        _, iterations = take_steps(mesh, method, repeat, clock)
    counted = [
        (f"{stage}.{kernel}", cost, iterations if kernel in ITERATED else cost.calls)
        for (stage, kernel), cost in profile.costs.items()
    ]
    read = sum(span.read for span in profile.spans) / repeat
    return {
        "kind": kind,
        "cells": mesh.n,
        **parts,
        "step": sum(parts.values()),
        "solve": profile.of(*SOLVERS) / repeat,
        "cold": statistics.median(cold),
        "read": read,
        "rate": mesh.n / parts["diagram"],
        "kernels": {name: (cost.seconds / calls, calls / repeat) for name, cost, calls in counted},
        "bandwidth": profile.bandwidth,
    }


def ms(figure: str) -> Callable[[dict[str, Any]], str]:
    return lambda r: f"{1e3 * r[figure]:.1f}"


COLUMNS = {
    "step": lambda r: r["kind"],
    "cells": lambda r: f"{r['cells']:,}",
    "displace": ms("displace"),
    "solve": ms("solve"),
    "diagram": ms("diagram"),
    "rest": ms("rest"),
    "whole step": ms("step"),
    "diagram M/s": lambda r: f"{1e-6 * r['rate']:.2f}",
    "cold": ms("cold"),
    "to host": lambda r: f"{r['read']:.0f} B",
}


def limits(records: list[dict[str, Any]], peak: float, real: int) -> list[list[str]]:
    """Time of each kernel per cell, and the times of its least memory traffic and arithmetic."""
    rows = []
    last = {r["kind"]: r for r in records}
    for name, (reals, integers, operations) in NEEDS.items():
        seen = [r for r in last.values() if name in r["kernels"]]
        if not seen:
            continue
        record = max(seen, key=lambda r: r["cells"])
        seconds, calls = record["kernels"][name]
        per_cell = seconds / record["cells"]
        size = reals * real + integers * 4
        memory = size / record["bandwidth"] / per_cell
        arithmetic = operations / peak / per_cell
        rows.append(
            [
                name,
                record["kind"],
                f"{calls:.1f}",
                f"{1e9 * per_cell:.1f}",
                str(size),
                str(operations),
                f"{memory:.0%}",
                f"{arithmetic:.0%}",
            ]
        )
    return rows


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**5, 10**6])
    options_of.add_argument("--kinds", type=names, default=list(KINDS), help=", ".join(KINDS))
    options_of.add_argument("--repeat", type=int, default=7)
    options_of.add_argument(
        "--processor-time",
        action="store_true",
        help="the process's processor time over the device's units in the place of the clock's, where others use them",
    )
    options = options_of.parse_args()
    if unknown := set(options.kinds) - set(KINDS):
        options_of.error(f"no step {', '.join(unknown)}; there are {', '.join(KINDS)}")

    adapter = make_adapter(options)
    clock = clock_of(options, adapter)
    report = Report(options.json, COLUMNS)
    for n in options.sizes:
        field = test_field("F2") * (CELLS_OF_F2 / n) ** 0.5
        points = adapter.run(BOX, field, effort="fast").points
        for kind in options.kinds:
            record = measure(adapter, kind, points, n, options.repeat, clock)
            report.add(record, f"{kind} {n:,}")
    report.finish(heading(adapter, f"One step, medians of {options.repeat}"))
    if not options.json:
        peak = peak_operations(adapter)
        bandwidth = report.records[-1]["bandwidth"]
        print(f"Copying moves {1e-9 * bandwidth:.1f} GB/s, multiply-adds reach {1e-9 * peak:.0f} Gflop/s.\n")
        header = [
            "kernel",
            "step",
            "calls a step",
            "ns per cell",
            "bytes needed",
            "operations",
            "memory: share of the time",
            "arithmetic",
        ]
        print(markdown(header, limits(report.records, peak, adapter.dtype.itemsize)))


if __name__ == "__main__":
    main()
