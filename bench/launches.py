"""Launches and reads of one step: how many commands a device gets, and how often the host waits for it.

    python bench/launches.py [--sizes 1e4,1e6] [--dims 2,3] [--device NAME] [--dtype float32] [--json]

A fast run makes a mesh of F2 (2D) or S1 (3D), scaled to the count (see `convergence.py`). Some steps of each kind of a
default run follow. Figures are means per step. "launches" are kernels, copies and fills; "solve" are those of the
linear solver among them, "set-up" those of a new multigrid. The host waits at each of "reads" and "writes".
Work-groups, merged kernels and preconditioners are those of a GPU on any device, so that the counts hold there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
from _common import Report, counts, domain_of, heading, make_adapter, parser, test_field

import clvoro
from clvoro.adaptation.methods import ProjectedMethod, WeightedMethod
from clvoro.adaptation.motion import Method
from clvoro.adaptation.plan.actions import Step
from clvoro.adaptation.plan.schedule import adaptive_schedule
from clvoro.adaptation.sampling.start import count_cells
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.state import MeshState
from clvoro.opencl.engine import Engine
from clvoro.opencl.hooks import Tally, watching
from clvoro.sizing import Sizing
from tests.robustness.gpu_like import groups

FIELDS = {2: "F2", 3: "S1"}
WARM_UP, STEPS = 3, 5
GPU_GROUPS, GPU_GROUP_SIZE = 512, 128
SOLVERS = ("multigrid", "conjugate_gradient", "volume_projection")
SET_UP = ("aggregation",)


def kinds(dim: int) -> dict[str, Method]:
    """Return a method of each kind of step that a run takes on its finest level: default ones, and exact ones."""
    found: dict[str, Method] = {}
    for exact in (False, True):
        for action in adaptive_schedule(dim, "default", 1, exact=exact):
            if isinstance(action, Step):
                found[name_of(action.method)] = action.method
    return found


def name_of(method: Method) -> str:
    """Return the name of a kind of step."""
    if isinstance(method, WeightedMethod):
        return "weighted" if method.lloyd else "correct"
    assert isinstance(method, ProjectedMethod)
    if method.gradient_from_field:
        return "exact"
    return {"lloyd": "glide", "quality": "polish", "edges": "separate", "surface": "polish"}[method.descent]


@contextmanager
def counted(
    adapter: clvoro.Adapter, domain: clvoro.Box, field: Any, points: np.ndarray
) -> Iterator[tuple[MeshState, Tally]]:
    """Count the commands on a mesh of `points` while the context is open."""
    origin, scale = domain.frame
    with groups(GPU_GROUP_SIZE, GPU_GROUPS):
        engine = Engine(adapter.ctx, cl.CommandQueue(adapter.ctx), domain.dim, adapter.dtype)
        start, tally = engine.upload((points - origin) / scale), Tally()
        with watching(engine.queue, tally):
            mesh = MeshState.create(Stages(engine), domain, Sizing(engine, domain, field), start)
            yield mesh, tally


def take_step(mesh: MeshState, method: Method) -> int:
    """Take a step as a run does; return the iterations of its solve."""
    with mesh.engine.workspace.frame():
        displacement = method.step(mesh)
        mesh.move(displacement)
    mesh.update()
    return displacement.solution.iterations


def measure(
    adapter: clvoro.Adapter, domain: clvoro.Box, field: Any, points: np.ndarray, method: Method
) -> dict[str, Any]:
    """Return counts per step of `method`."""
    method = replace(method)  # type: ignore[type-var]
    with counted(adapter, domain, field, points) as (mesh, tally):
        for _ in range(WARM_UP):
            take_step(mesh, method)
        tally.calls.clear()
        tally.bytes.clear()
        iterations = sum(take_step(mesh, method) for _ in range(STEPS))
    kernels = {f"{stage.split('/')[-1]}.{name}": k / STEPS for (stage, name), k in tally.calls.items()}
    return {
        "dim": domain.dim,
        "cells": mesh.n,
        "iterations": iterations / STEPS,
        "launches": tally.launches / STEPS,
        "reads": tally.reads / STEPS,
        "writes": tally.writes / STEPS,
        "bytes": tally.bytes_read / STEPS,
        "solve": sum(k for name, k in kernels.items() if name.startswith(SOLVERS)),
        "set_up": sum(k for name, k in kernels.items() if name.startswith(SET_UP)),
    }


COLUMNS = {
    "step": lambda r: f"{r['kind']}, {r['dim']}D",
    "cells": lambda r: f"{r['cells']:,}",
    "iterations": lambda r: f"{r['iterations']:.1f}",
    "launches": lambda r: f"{r['launches']:.1f}",
    "solve": lambda r: f"{r['solve']:.1f}",
    "set-up": lambda r: f"{r['set_up']:.1f}",
    "reads": lambda r: f"{r['reads']:.1f}",
    "writes": lambda r: f"{r['writes']:.1f}",
    "bytes read": lambda r: f"{r['bytes']:.0f}",
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**4, 10**6])
    options_of.add_argument("--dims", type=counts, default=[2, 3])
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for dim in options.dims:
        domain = domain_of(FIELDS[dim])
        for n in options.sizes:
            field = test_field(FIELDS[dim])
            field = field * (count_cells(field, domain) / n) ** (1 / dim)
            points = adapter.run(domain, field, effort="fast").points
            for kind, method in kinds(dim).items():
                record = measure(adapter, domain, field, points, method)
                report.add({"kind": kind, **record}, f"{kind} {dim}D {n:,}")
    report.finish(heading(adapter, f"Commands per step, means of {STEPS}, GPU's work-groups"))


if __name__ == "__main__":
    main()
