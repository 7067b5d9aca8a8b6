"""One step of a run by its parts: displacement, motion, update of the diagram, evaluation.

    python bench/step.py [--sizes 1e5,1e6] [--kinds weighted,glide,polish] [--repeat 7]
                         [--processor-time] [--device NAME] [--dtype float32] [--json]

A fast run makes a mesh of F2 scaled to the count (see `convergence.py`). A few steps of each kind of a default run
follow: "weighted" couples weighted centroids and the Poisson correction, "glide" and "polish" project onto the cells'
sizes. Times are medians over `--repeat` further steps, from an
idle queue to an idle queue, in milliseconds: "displace" finds the displacement ("solve" is the
device's time of its linear solver), "diagram" updates the tessellation, "rest" moves, evaluates h,
error, quality and their sums. "diagram M/s" is cells per second of the updated diagram with all its measures,
"to host" the bytes that the host reads. "cold" makes the same diagram from nothing, from binning on.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl
from _common import BOX, Report, clock_of, counts, heading, make_adapter, names, parser, test_field

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
        take_steps(mesh, method, repeat, clock)
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


if __name__ == "__main__":
    main()
