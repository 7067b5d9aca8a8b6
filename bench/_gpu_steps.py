"""Steps and diagrams for `gpu_model.py`: what is launched, by the hooks, and what is executed, by Oclgrind."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pyopencl as cl
from launches import kinds, take_step
from update_3d import Shares

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.state import MeshState
from clvoro.opencl import hooks, primitives
from clvoro.opencl.engine import Engine
from clvoro.opencl.hooks import Tally
from clvoro.sizing import Sizing
from clvoro.solvers import poisson
from clvoro.tessellation.teams import TEAM
from tests.robustness.gpu_like import by_teams, groups
from tests.robustness.oclgrind_runs import as_for_many

COUNTS = Path(__file__).with_name("gpu_counts.json")
COUNTED = (2, "weighted"), (2, "glide"), (2, "polish"), (3, "weighted"), (3, "glide"), (3, "polish")
WARM_UP = {(3, "weighted"): 1, (3, "glide"): 1, (3, "polish"): 2}
"""Steps before those that count, if not 3. In 3D the shares of cells that keep their vertices, and that are updated
again, are then near those of a run of a million cells (see `update_3d.py --shares`)."""
COUNTED_AT = {2: (300, 1200), 3: (128, 432)}
"""Numbers of cells at which Oclgrind counts. The work of a kernel over cells is that of a cell at the larger number,
times the cells. Kernels with as many work-items for any number of cells have a fixed part, from both numbers."""
COUNTED_GROUP, COUNTED_ITEMS = 128, 16 * 128
"""Work-items of a group, and of all groups of a block-wise kernel, where Oclgrind counts."""
FREE = re.compile(r"phi|alloca|bitcast|ret|br|fence|unreachable|call (llvm\.(lifetime|dbg|assume)|(?!_Z|llvm))")
"""Instructions of LLVM that cost a GPU little or nothing after its compiler has inlined all calls."""
SLOW = {
    "fdiv": 10,
    "sqrt": 10,
    "rsqrt": 10,
    "exp": 30,
    "log": 30,
    "sin": 40,
    "cos": 40,
    "cbrt": 40,
    "atan2": 60,
    "pow": 60,
}
"""Instructions that a GPU takes for one division or function, in float64."""


def lattice(dim: int, n: int) -> np.ndarray:
    """Return about `n` points of a hexagonal or body-centered lattice in the unit box, displaced at random."""
    if dim == 2:
        columns = max(round((n * 3**0.5 / 2) ** 0.5), 2)
        rows = max(round(n / columns / 2), 1) * 2
        i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
        x = np.stack([(i + 0.25 + 0.5 * (j % 2)) / columns, (j + 0.5) / rows], -1).reshape(-1, 2)
    else:
        side = max(round((n / 2) ** (1 / 3)), 2)
        corner = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
        x = np.concatenate([corner + 0.25, corner + 0.75]) / side
    noise = np.random.default_rng(0).uniform(-0.2, 0.2, x.shape) * len(x) ** (-1 / dim)
    return np.clip(x + noise, 1e-6, 1 - 1e-6)


class Run:
    """A mesh of a constant size, and the commands that make it take steps and diagrams."""

    def __init__(
        self,
        adapter: clvoro.Adapter,
        dim: int,
        kind: str,
        n: int,
        points: np.ndarray | None = None,
        warm_up: int | None = None,
    ) -> None:
        engine = Engine(adapter.ctx, adapter.queue, dim, adapter.dtype)
        box, points = (clvoro.Box((0,) * dim, (1,) * dim), lattice(dim, n) if points is None else points)
        size = Sizing(engine, box, len(points) ** (-1 / dim))
        # The hooks also note the sizes of buffers that are bound before the commands count.
        with hooks.watching(engine.queue, Tally()):
            self.mesh = MeshState.create(Stages(engine), box, size, engine.upload(points))
            self.method = replace(kinds(dim)[kind])  # type: ignore[type-var]
            self.n = len(points)
            rng = np.random.default_rng(1)
            self.random = engine.upload(rng.uniform(size=points.shape))
            for _ in range(WARM_UP.get((dim, kind), 3) if warm_up is None else warm_up):
                self.step()

    def step(self) -> None:
        """Take one step of the method."""
        take_step(self.mesh, self.method)

    def diagram(self) -> None:
        """Make the diagram of random points from nothing, as `diagram.py`."""
        self.mesh.tessellation = self.mesh.tessellator.tessellate(self.random, self.mesh.n)

    @property
    def parts(self) -> dict[str, Callable[[], None]]:
        """What is counted: a step, and the diagram from nothing."""
        return {"step": self.step, "diagram": self.diagram}


@dataclass
class Launches:
    """The launches of one kernel in a step: their number, work-items, items of a group, and bytes of all buffers."""

    calls: float = 0
    items: float = 0
    group: int = 1
    bytes: float = 0


@dataclass
class Commands:
    """The commands of a step: launches by kernel; copies and fills; blocking reads, and their bytes."""

    cells: int
    launches: dict[str, Launches]
    copies: float = 0
    reads: float = 0
    read_bytes: float = 0

    @property
    def count(self) -> float:
        """Number of launches, copies and fills."""
        return sum(k.calls for k in self.launches.values()) + self.copies


def commands(run: Run, part: str, repeat: int = 2, part_of: Callable[[], None] | None = None) -> Commands:
    """Return what a step or a diagram enqueues, the mean of `repeat`."""
    found = Commands(run.n, collections.defaultdict(Launches))
    enqueue, share = cl.enqueue_nd_range_kernel, 1 / repeat

    def noted(queue: cl.CommandQueue, kernel: cl.Kernel, size: Any, group: Any, *rest: Any, **more: Any) -> Any:
        row = found.launches[kernel.function_name]
        row.items += share * size[0]
        row.group = group[0]
        return enqueue(queue, kernel, size, group, *rest, **more)

    def watch(event: cl.Event, stage: str, name: str, moved: int | None, done: bool = False) -> None:
        if stage != hooks.MEMORY:
            row = found.launches[name]
            row.calls += share
            row.bytes += share * (moved or 0)
        elif name == "read":
            found.reads += share * done
            found.read_bytes += share * (moved or 0)
        else:
            found.copies += share

    cl.enqueue_nd_range_kernel = noted
    try:
        with hooks.watching(run.mesh.engine.queue, watch):
            for _ in range(repeat):
                (part_of or run.parts[part])()
            run.mesh.engine.queue.finish()
    finally:
        cl.enqueue_nd_range_kernel = enqueue
    return found


def with_teams(found: Commands) -> Commands:
    """Return the commands on an NVIDIA GPU: teams build and update cells in 3D.

    PoCL takes minutes to hours to compile their kernels.
    """
    for alone in ("clip_polyhedra", "update_cells"):
        if alone in found.launches:
            row, team = found.launches[alone], f"{alone}_by_teams"
            found.launches[team] = Launches(row.calls, TEAM * row.items, TEAM, row.bytes)
            del found.launches[alone]
    return found


# Counting by Oclgrind.


@dataclass
class Work:
    """What all work-items of a launch execute: instructions, those in REAL, accesses of memory, and their bytes."""

    launches: int = 0
    items: float = 0
    instructions: float = 0
    real: float = 0
    accesses: float = 0
    global_bytes: float = 0
    private_bytes: float = 0
    stored_private_bytes: float = 0

    def take(self, count: float, name: str, size: float) -> None:
        """Add `count` instructions `name` that move `size` bytes."""
        if (at := re.match(r"(load|store) (\w+)", name)) is not None:
            self.accesses += count
            self.instructions += count
            if at[2] == "global":
                self.global_bytes += size
            elif at[2] == "private":
                self.private_bytes += size
                self.stored_private_bytes += size * (at[1] == "store")
        elif not FREE.match(name):
            called = re.match(r"call _Z\d+(\D+?)(?:Dv(\d+)_)?[a-z]", name)
            function = re.match(r"call _Z\d+(sqrt|rsqrt|exp|log|sin|cos|cbrt|atan2|pow)", name)
            cost = SLOW.get(function[1] if function else name, 1)
            lanes = re.search(r"Dv(\d+)_", name)
            cost *= int(lanes[1]) if called and lanes else 1
            self.instructions += count * cost
            if name.startswith("f") or called:
                self.real += count * cost


def parse_counts(text: str) -> dict[str, dict[str, Work]]:
    """Return the work of each kernel in each part that Oclgrind's plugin for counting has printed."""
    found: dict[str, dict[str, Work]] = {}
    part: dict[str, Work] = {}
    work = Work()
    for line in text.splitlines():
        if line.startswith("=== "):
            part = found.setdefault(line[4:], {})
        elif (kernel := re.match(r"Instructions executed for kernel '(\w+)'", line)) is not None:
            work = part.setdefault(kernel[1], Work())
            work.launches += 1
        elif (row := re.match(r"\s*(\d+) - (.+?)(?: \((\d+) bytes\))?$", line)) is not None:
            work.take(float(row[1]), row[2], float(row[3] or 0))
    return found


def count_in_this_process(dim: int, kind: str, n: int) -> None:
    """Take a step and make a diagram on Oclgrind, whose plugin prints what is executed.

    Steps before them are taken on PoCL, which is hundreds of times as fast. Teams build and update cells in 3D.
    """
    with (
        groups(COUNTED_GROUP, COUNTED_ITEMS // COUNTED_GROUP),
        as_for_many(),
        mock.patch.object(poisson, "expected_costs", return_value=(1.0, 0.0)),
        mock.patch.object(primitives, "FEW", 0),
    ):
        near = Run(clvoro.Adapter(clvoro.create_context("portable"), "float64"), dim, kind, n)
        with by_teams(dim == 3):
            # The second step of a method keeps its aggregates or multipliers, as later ones do.
            simulator = clvoro.Adapter(clvoro.create_context("oclgrind"), "float64")
            run = Run(simulator, dim, kind, n, near.mesh.points.get(), warm_up=1)
            for name, part in run.parts.items():
                if name == "diagram" and kind != "weighted":
                    continue
                run.mesh.engine.queue.finish()
                shares = Shares()
                shares.kind = kind if dim == 3 and name == "step" else ""
                print(f"=== {name}", flush=True)
                with shares.counting():
                    items = commands(run, name, 1, part).launches
                print("=== end", flush=True)
                sized = {k: {"items": v.items, "calls": v.calls} for k, v in items.items()}
                counted = {k: float(v) for step in shares.steps for k, v in step.items() if k != "kind"}
                record = {"part": name, "cells": run.n, "kernels": sized, "shares": counted}
                print("@@@" + json.dumps(record), flush=True)


def counted(dim: int, kind: str) -> dict[str, Any]:
    """Return the work of each kernel of a step and a diagram, at two numbers of cells."""
    found: dict[str, Any] = {}

    def simulate(n: int) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, __file__.replace("_gpu_steps", "gpu_model"), "--count-one", f"{dim},{kind},{n}"],
            capture_output=True,
            text=True,
            env={**os.environ, "OCLGRIND_INST_COUNTS": "1"},
        )

    with ThreadPoolExecutor() as pool:
        all_done = list(pool.map(simulate, COUNTED_AT[dim]))
    for done in all_done:
        if done.returncode:
            raise SystemExit(f"counting on Oclgrind failed: {done.stderr[-1000:]}")
        work = parse_counts(done.stdout)
        for line in re.findall("^@@@(.*)$", done.stdout, re.M):
            sized = json.loads(line)
            part = work[sized["part"]]
            for kernel, each in sized["kernels"].items():
                if kernel in part:
                    part[kernel].items = each["items"]
            rows = {k: [round(v) for v in vars(w).values()] for k, w in part.items()}
            found.setdefault(sized["part"], []).append(
                {"cells": sized["cells"], "shares": sized["shares"], "kernels": rows}
            )
    return found


def save_counts(dims: list[int]) -> None:
    """Count all kinds of steps in `dims` dimensions, and write them to `COUNTS`."""
    found = json.loads(COUNTS.read_text()) if COUNTS.exists() else {}
    for dim, kind in COUNTED:
        if dim not in dims:
            continue
        print(f"{kind} step in {dim}D", file=sys.stderr, flush=True)
        found[f"{dim}D {kind}"] = counted(dim, kind)
    COUNTS.write_text(json.dumps(found).replace("], ", "],\n ") + "\n")


def load_counts() -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return the work of each kernel, by kind of step, part and number of cells, as `COUNTS` holds it."""
    if not COUNTS.exists():
        raise SystemExit(f"{COUNTS} is missing: run gpu_model.py --count where Oclgrind is installed")
    found = json.loads(COUNTS.read_text())
    for parts in found.values():
        for pair in parts.values():
            rows = [{k: vars(Work(*row)) for k, row in each["kernels"].items()} for each in pair]
            for each, own, other in zip(pair, rows, rows[::-1], strict=True):
                each["kernels"] = other | own  # some repair nothing where cells are few
    return found


@contextlib.contextmanager
def gpu_groups() -> Iterator[None]:
    """Work in the groups of an H200, and precondition by multigrid as for millions of cells."""
    with groups(128, 512), mock.patch.object(poisson, "expected_costs", return_value=(1.0, 0.0)):
        yield
