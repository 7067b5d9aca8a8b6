"""Restarts: adaptations of one mesh, each from the mesh before, while the size field moves.

    python bench/restart.py [--moves 10] [--by 2] [--factors 1] [--effort default] [--cold]
                            [--device NAME] [--dtype float32] [--json]

The field is F2 times a factor, h = 0.002 + 0.08 d with d the distance to a circle, which moves along x by
two of its smallest cells at a time. Each run begins with the points of the one before. "to tolerance" is
the number of steps after which mean |e| <= 0.004, max |e| <= 0.04 and mean Q >= 0.985 (0.975 with --effort
fast). A mesh of ten thousand cells or more can meet these; the target is five steps. "carried" is the height
after all transfers of second order of a peak of height 1 and width 0.05 beside the circle, "mass" the relative error
of its mass.

A mesh is corrected in a few steps if its mean |e| is at most 0.15 and its count within 2 % of that of the size field.
Otherwise the run starts as from any points. A field that moves far is therefore better followed in steps of one or two
of its smallest cells.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from _common import BOX, FIRST_SEED, Report, heading, make_adapter, names, parser

from clvoro import sizing

WANTED = 5


def moved_field(by: float, factor: float) -> sizing.Field:
    """Return F2 times `factor`, its circle moved by `by`."""
    circle = sizing.Circle((0.9 + by, 0.75), 0.3)
    return sizing.Distance(circle, h_min=0.002 * factor, slope=0.08 * factor)


def to_tolerance(history: np.ndarray, quality: float) -> int | None:
    """Return the steps after which a run is within the default's tolerance, or None."""
    within = (history["mean_error"] <= 0.004) & (history["max_error"] <= 0.04)
    within &= history["mean_quality"] >= quality
    return int(history["step"][np.argmax(within)]) if within.any() else None


def peak(x: np.ndarray) -> np.ndarray:
    """Return a bump between the circle and the right wall."""
    return np.exp(-(((x - [1.4, 0.75]) / 0.05) ** 2).sum(axis=1))


def figures_of(result: Any, quality: float, seconds: float) -> dict[str, Any]:
    history, error = result.history, np.abs(result.size_error)
    return {
        "cells": len(result.points),
        "seconds": seconds,
        "steps": int(history["step"][-1]),
        "start_error": float(history["mean_error"][0]),
        "start_max": float(history["max_error"][0]),
        "to_tolerance": to_tolerance(history, quality),
        "mean_error": float(error.mean()),
        "max_error": float(error.max()),
        "mean_quality": float(result.quality.mean()),
        "min_quality": float(result.quality.min()),
    }


COLUMNS = {
    "factor": lambda r: f"{r['factor']:g}",
    "run": lambda r: r["run"],
    "cells": lambda r: f"{r['cells']:,}",
    "start: mean |e|": lambda r: f"{r['start_error']:.4f}",
    "max |e|": lambda r: f"{r['start_max']:.3f}",
    "to tolerance": lambda r: "never" if r["to_tolerance"] is None else r["to_tolerance"],
    "steps": lambda r: r["steps"],
    "end: mean |e|": lambda r: f"{r['mean_error']:.4f}",
    "max |e| ": lambda r: f"{r['max_error']:.3f}",
    "mean Q": lambda r: f"{r['mean_quality']:.4f}",
    "min Q": lambda r: f"{r['min_quality']:.3f}",
    "seconds": lambda r: f"{r['seconds']:.2f}",
    "carried": lambda r: f"{r['carried']:.3f}",
    "mass": lambda r: f"{r['mass']:.0e}",
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--moves", type=int, default=10, help="adaptations in a row")
    made.add_argument("--by", type=float, default=2.0, help="smallest cells that the circle moves")
    made.add_argument("--factors", default="1", help="on the size field, comma-separated")
    made.add_argument("--effort", default="default", choices=("fast", "default", "best"))
    made.add_argument("--cold", action="store_true", help="also a run from nothing at the end")
    options = made.parse_args(arguments)
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    quality = 0.975 if options.effort == "fast" else 0.985
    slowest = 0
    adapter.run(BOX, moved_field(0.0, 8), effort=options.effort, seed=FIRST_SEED)  # kernels
    for factor in [float(f) for f in names(options.factors)]:
        result, values, mass = None, np.zeros(0), 0.0
        for k in range(options.moves + 1 + options.cold):
            warm = 0 < k <= options.moves
            by = min(k, options.moves) * options.by * 0.002 * factor
            start = time.perf_counter()
            new = adapter.run(
                BOX,
                moved_field(by, factor),
                points=result.points if warm else None,
                effort=options.effort,
                seed=FIRST_SEED,
            )
            seconds = time.perf_counter() - start
            if warm:
                values = result.transfer(values, new, order=2, adapter=adapter)
            else:
                values = peak(new.diagram.centroids)
                mass = new.diagram.volumes @ values
            result = new
            record = {
                "factor": factor,
                "run": f"moved {k}" if warm else "cold",
                **figures_of(result, quality, seconds),
                "carried": float(values.max()),
                "mass": abs(float(result.diagram.volumes @ values / mass - 1)),
            }
            if warm:
                taken = record["to_tolerance"]
                slowest = max(slowest, sys.maxsize if taken is None else taken)
            report.add(record, f"F2 x {factor:g}, {record['run']}")
    report.finish(heading(adapter, f"Restarts, the circle moved by {options.by:g} cells at a time"))
    return 0 if slowest <= WANTED else 1


if __name__ == "__main__":
    raise SystemExit(main())
