"""Whole runs, from nothing to a finished mesh: time per cell, its growth, and its parts.

    python bench/run.py [--sizes 1e4,1e5,1e6] [--efforts fast,default] [--methods adaptive]
                        [--no-profile] [--device NAME] [--dtype float32] [--json]

The field is F2, h = 0.002 + 0.08 d (d the distance to a circle), times the factor that makes the
count; sizes over 1 : 40 or so. A run counts the cells, samples the start, adapts it over all
levels and fetches the diagram. Kernels are built before, by a smaller run of each kind.

"work" is in steps of the finest level; "s per step" is the run's time over it. The shares are of
the device time of all kernels, by its events, in a second run ("s profiled"): "solve" all linear
systems, "diagram" binning, clipping and measuring with the scans. "outside" is the part of the
time in which no kernel runs: the host enqueues, reads scalars, allocates, waits.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from typing import Any

import numpy as np
from _common import (
    BOX,
    FIRST_SEED,
    Report,
    counts,
    figures,
    heading,
    make_adapter,
    markdown,
    names,
    parser,
    shown,
    test_field,
    work,
)

import clvoro
from clvoro.opencl.profile import Profile

SOLVERS = ("poisson", "multigrid", "aggregation", "conjugate_gradient", "volume_projection")
"""Programs that solve linear systems."""
TESSELLATION = ("bins", "cells", "incremental", "primitives")
"""Programs of the diagram; the scans and the reductions of the figures are in "primitives"."""

CELLS_OF_F2 = 22972
"""Integral of h^-2 of F2."""


BEFORE = 40_000
"""Cells of a first run, which builds kernels: enough for levels, multigrid and all parts of larger runs."""


def run_once(adapter: clvoro.Adapter, n: int, effort: str, method: str) -> tuple[clvoro.Result, float]:
    """Run from nothing to NumPy arrays of the finished mesh; return it and the seconds."""
    field = test_field("F2") * (CELLS_OF_F2 / n) ** 0.5
    start = time.perf_counter()
    result = adapter.run(BOX, field, effort=effort, method=method, seed=FIRST_SEED)
    result.diagram.neighbors  # noqa: B018  reads it from the device
    result.diagram.vertices  # noqa: B018
    result.diagram.cell_vertices  # noqa: B018
    return result, time.perf_counter() - start


def measure(adapter: clvoro.Adapter, profiled: bool, n: int, effort: str, method: str) -> dict[str, Any]:
    began = time.thread_time()
    result, seconds = run_once(adapter, n, effort, method)
    host = time.thread_time() - began
    history = result.history
    cost = work(history)
    finest = history["level"] == 0
    # Time between two rows of the finest level, reorganizing included.
    between = np.diff(history["seconds"])[finest[1:] & finest[:-1]]
    record: dict[str, Any] = {
        "method": method,
        "effort": effort,
        "seconds": seconds,
        "host_seconds": host,
        "per_cell": seconds / len(result.points),
        "per_step": seconds / max(cost["work"], 1e-300),
        "finest_step": statistics.median(between) if len(between) else float("nan"),
        **figures(result.diagram, result.target_size, result.quality),
        **cost,
        "iterations": int(history["iterations"].sum()),
    }
    if profiled:
        with Profile(adapter) as profile:
            _, again = run_once(adapter, n, effort, method)
        total = profile.device
        record |= {
            "seconds_profiled": again,
            "kernels": total,
            "launches": profile.launches,
            "outside_share": 1 - total / again,
            "solve_share": profile.of(*SOLVERS) / total,
            "diagram_share": profile.of(*TESSELLATION) / total,
            "programs": {name: cost.seconds / total for name, cost in sorted(profile.stages().items())},
        }
    return record


COLUMNS = {
    "method": lambda r: r["method"],
    "effort": lambda r: r["effort"],
    "cells": shown("cells", ",.0f"),
    "seconds": shown("seconds", ".2f"),
    "s of the host": shown("host_seconds", ".2f"),
    "us per cell": shown("per_cell", ".1f", 1e6),
    "work": shown("work", ".1f"),
    "s per step": shown("per_step", ".4f"),
    "s per finest step": shown("finest_step", ".4f"),
    "mean |e|": shown("mean_error", ".4f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "s profiled": shown("seconds_profiled", ".2f"),
    "solve": shown("solve_share", ".0%"),
    "diagram": shown("diagram_share", ".0%"),
    "launches": shown("launches", ",.0f"),
    "outside": shown("outside_share", ".0%"),
}


def programs(records: list[dict[str, Any]]) -> list[list[str]]:
    """Return the share of every program in the largest profiled run of each kind."""
    rows = []
    for kind in dict.fromkeys((r["method"], r["effort"]) for r in records):
        mine = [r for r in records if (r["method"], r["effort"]) == kind and "programs" in r]
        if mine:
            ranked = sorted(mine[-1]["programs"].items(), key=lambda item: -item[1])
            shares = ", ".join(f"{name} {share:.1%}" for name, share in ranked)
            rows.append([*kind, f"{mine[-1]['cells']:,}", shares])
    return rows


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**4, 10**5, 10**6])
    options_of.add_argument("--efforts", type=names, default=["fast", "default"])
    options_of.add_argument("--methods", type=names, default=["adaptive"])
    options_of.add_argument(
        "--profile", action=argparse.BooleanOptionalAction, default=True, help="run once more for the shares"
    )
    options = options_of.parse_args()

    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for method in options.methods:
        for effort in options.efforts:
            run_once(adapter, BEFORE, effort, method)
            for n in options.sizes:
                try:
                    record = measure(adapter, options.profile, n, effort, method)
                except clvoro.ClvoroError as error:
                    print(f"{method} {effort} {n:,}: {error}", file=sys.stderr)
                    continue
                report.add(record, f"{method} {effort} {n:,}: {record['seconds']:.1f} s")
    report.finish(heading(adapter, "Whole runs"))
    if options.profile and not options.json:
        print(markdown(["method", "effort", "cells", "share of device time"], programs(report.records)) + "\n")


if __name__ == "__main__":
    main()
