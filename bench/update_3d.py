"""The update of a diagram in 3D against a new one: small moves of relaxed generators, and whole runs.

    python bench/update_3d.py [--sizes 1e5,1e6] [--moves 0,0.003,0.01,0.03] [--relax 6] [--repeat 4] [--runs 0.25]
                              [--processor-time] [--device NAME] [--dtype float32] [--json]

Random generators in the unit cube move to their centroids `--relax` times. Then all move at random by `--moves`
spacings, `--repeat` times. Each time the diagram is updated and, with other buffers, made anew, from binning on.
Seconds are means over the moves. "cells changed" have other neighbors than before.

`--runs` makes meshes of S1 (see `convergence.py`) with these multiples of its sizes, effort "default", with and without
updates: seconds of the run and of all its diagrams, mean |log(L / h)| and Q.

With `--processor-time`, seconds are the processor time of this process over the device's compute units.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import CUBE, Report, clock_of, counts, heading, make_adapter, names, parser, shown, test_field

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.device_diagram import Tessellation
from clvoro.tessellation.polyhedra_update import PolyhedraUpdate
from clvoro.tessellation.stages import TessellationStages
from clvoro.tessellation.tessellator import Tessellator

SEED = 7919


class Diagrams:
    """Diagrams of one set of generators in the unit cube, with buffers of their own."""

    def __init__(self, adapter: clvoro.Adapter) -> None:
        self.stages = TessellationStages(Engine(adapter.ctx, adapter.queue, 3, adapter.dtype))

    def make(self, points: np.ndarray, previous: Tessellation | None = None) -> Tessellation:
        """Return the diagram of the points, and wait for it."""
        x = self.stages.engine.upload(points)
        t = Tessellator(self.stages, CUBE).tessellate(x, len(points), previous)
        self.stages.engine.queue.finish()
        return t


def along_curve(points: np.ndarray) -> np.ndarray:
    """Return the points in the order of Morton's curve, so that neighbors are close in memory."""
    code = np.zeros(len(points), np.int64)
    place = (points * 1023).astype(np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((place[:, axis] >> bit) & 1) << (3 * bit + axis)
    return points[np.argsort(code, kind="stable")]


def rows_of(t: Tessellation) -> np.ndarray:
    """Return cell and neighbor of each half-face in one number, sorted."""
    starts = t.starts.get()[: t.n + 1].astype(np.int64)
    cell = np.repeat(np.arange(t.n), np.diff(starts))
    return np.sort(cell * (t.n + 8) + t.neighbors.get()[: starts[-1]] + 6)


def moves(adapter: clvoro.Adapter, n: int, options: Any, clock: Callable[[], float]) -> list[dict[str, Any]]:
    rng = np.random.default_rng(SEED)
    ours, anew = Diagrams(adapter), Diagrams(adapter)
    x = along_curve(rng.random((n, 3)))
    t = ours.make(x)
    for _ in range(options.relax):
        x = np.clip(x + t.offsets.get()[:n], 0, 1)
        t = ours.make(x, t)
    found = []
    for share in map(float, options.moves):
        spent, changed = np.zeros(2), 0.0
        for k in range(options.repeat + 1):
            way = rng.standard_normal((n, 3))
            way *= share * n ** (-1 / 3) / np.linalg.norm(way, axis=1)[:, None]
            x = np.clip(x + way, 0, 1)
            before, start = rows_of(t), clock()
            t = ours.make(x, t)
            updated = clock()
            anew.make(x)
            if k:  # the first one also compiles kernels
                spent += updated - start, clock() - updated
                other = np.setxor1d(before, rows_of(t), assume_unique=True)
                changed += len(np.unique(other // (n + 8))) / n / options.repeat
        update, new = spent / options.repeat
        found.append(
            {"cells": n, "move": share, "changed": changed, "update": update, "new": new, "factor": new / update}
        )
    return found


def run(adapter: clvoro.Adapter, factor: float, updated: bool, clock: Callable[[], float]) -> dict[str, Any]:
    """One whole run, and the seconds of its diagrams."""
    update, tessellate, spent = PolyhedraUpdate.update, Tessellator.tessellate, 0.0

    def timed(self: Tessellator, *args: Any, **named: Any) -> Tessellation:
        nonlocal spent
        queue = self.stages.engine.queue
        queue.finish()
        start = clock()
        t = tessellate(self, *args, **named)
        queue.finish()
        spent += clock() - start
        return t

    Tessellator.tessellate = timed  # type: ignore[method-assign]
    if not updated:
        PolyhedraUpdate.update = lambda *_: None  # type: ignore[method-assign]
    try:
        start = clock()
        result = adapter.run(CUBE, test_field("S1") * factor, seed=1)
        seconds = clock() - start
    finally:
        Tessellator.tessellate, PolyhedraUpdate.update = tessellate, update  # type: ignore[method-assign]
    return {
        "cells": len(result.points),
        "move": "run, updated" if updated else "run, anew",
        "run": seconds,
        "diagrams": spent,
        "error": float(np.abs(result.size_error).mean()),
        "quality": float(result.quality.mean()),
    }


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**5, 10**6])
    options_of.add_argument("--moves", type=names, default=["0", "0.003", "0.01", "0.03"])
    options_of.add_argument("--relax", type=int, default=6)
    options_of.add_argument("--repeat", type=int, default=4)
    options_of.add_argument("--runs", type=names, default=["0.25"])
    options_of.add_argument("--processor-time", action="store_true")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    clock = clock_of(options, adapter)
    report = Report(
        options.json,
        {
            "cells": shown("cells", ","),
            "move, spacings": lambda r: r["move"],
            "cells changed": shown("changed", ".0%"),
            "update s": shown("update", ".3f"),
            "new s": shown("new", ".3f"),
            "new / update": shown("factor", ".2f"),
            "run s": shown("run", ".2f"),
            "its diagrams s": shown("diagrams", ".2f"),
            "mean e": shown("error", ".5f"),
            "mean Q": shown("quality", ".4f"),
        },
    )
    for n in options.sizes:
        began = time.perf_counter()
        for record in moves(adapter, n, options, clock):
            report.add(record, f"{n:,}: {time.perf_counter() - began:.0f} s")
    for factor in map(float, options.runs):
        for updated in (False, True):
            run(adapter, 2.0, updated, clock)
            report.add(run(adapter, factor, updated, clock), f"run x {factor}")
    report.finish(heading(adapter, "Updates in 3D"))


if __name__ == "__main__":
    main()
