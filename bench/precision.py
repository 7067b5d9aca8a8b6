"""Single against double precision: how much float32 adds to the size error.

    python bench/precision.py [--fields circle,point,sphere] [--sizes 1e4,1e6] [--grading 1000]
                              [--efforts fast] [--seeds 3] [--device NAME] [--json]

The size grows linearly from its smallest to its largest value, whose ratio is the grading: away from the circle of
radius 0.3 about (0.9, 0.75) in the box 2.5 x 1.5, from that circle's center alone ("point"), or from the sphere
of radius 0.25 about (0.5, 0.5, 0.4) in the unit cube; it is scaled to the count. h and e are evaluated on the host, in
float64, at the generators as they are; medians over the starts. "spacing" is that of positions in
float32 over h, at the smallest size and as a mean over the cells. "more" is what float32 adds to the mean
error, "scatter" the range of the error in float64 over the starts. The script returns 1 if "more" exceeds 1e-3 and the
scatter without a warning before the run.
"""

from __future__ import annotations

import statistics
import sys
import warnings
from argparse import Namespace
from typing import Any

from _common import BOX, CUBE, FIRST_SEED, Report, counts, figures, heading, make_adapter, names, parser

import clvoro
from clvoro import sizing
from clvoro.adaptation.diagnostics import MAX_ROUND_OFF_ERROR
from clvoro.adaptation.sampling.start import count_cells
from clvoro.errors import PrecisionWarning

SHAPES = {
    "circle": (BOX, sizing.Circle((0.9, 0.75), 0.3), 1.4671),
    "point": (BOX, sizing.Circle((0.9, 0.75), 0.0), 1.7671),
    "sphere": (CUBE, sizing.Ball((0.5, 0.5, 0.4), 0.25), 0.6772),
}
"""Domain, shape, and the largest distance from it."""


def graded(name: str, grading: float, n: int) -> tuple[clvoro.Box, sizing.Field]:
    """Return the domain, and the field of about `n` cells whose largest size is `grading` times its least."""
    box, shape, far = SHAPES[name]
    field = sizing.Distance(shape, h_min=1.0, slope=(grading - 1) / far)
    return box, field * (count_cells(field, box) / n) ** (1 / box.dim)


def measure(options: Namespace, name: str, n: int, effort: str) -> dict[str, Any]:
    """Run in both precisions, from some starts."""
    box, field = graded(name, options.grading, n)
    record: dict[str, Any] = {"field": name, "dim": box.dim, "effort": effort, "warned": False}
    spacing = 2.0**-24 * box.frame[1]
    for real in ("float64", "float32"):
        adapter = make_adapter(Namespace(device=options.device, dtype=real))
        found = []
        for seed in range(FIRST_SEED, FIRST_SEED + options.seeds):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                result = adapter.run(box, field, effort=effort, seed=seed)
            record["warned"] |= any(issubclass(w.category, PrecisionWarning) for w in caught)
            h = field(result.points)
            found.append(figures(result.diagram, h, result.quality))
        for figure in found[0]:
            values = [each[figure] for each in found]
            record[f"{real}_{figure}"] = statistics.median(values)
            record[f"{real}_{figure}_range"] = max(values) - min(values)
        record["least"], record["mean"] = spacing / float(h.min()), float((spacing / h).mean())
    record["more"] = record["float32_mean_error"] - record["float64_mean_error"]
    record["scatter"] = record["float64_mean_error_range"]
    record["fits"] = record["more"] <= max(MAX_ROUND_OFF_ERROR, record["scatter"])
    return record


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--fields", type=names, default=["circle", "point"])
    options_of.add_argument("--sizes", type=counts, default=[10_000, 100_000], help="cells (1e4,1e5)")
    options_of.add_argument("--efforts", type=names, default=["fast"])
    options_of.add_argument("--grading", type=float, default=1000.0, help="largest over least size")
    options_of.add_argument("--seeds", type=int, default=1, help="random starts of each run (1)")
    options = options_of.parse_args()

    def pair(figure: str, digits: int) -> Any:
        return lambda r: " / ".join(f"{r[f'{real}_{figure}']:.{digits}f}" for real in ("float64", "float32"))

    columns = {
        "field": lambda r: r["field"],
        "cells": lambda r: f"{r['float32_cells']:,}",
        "effort": lambda r: r["effort"],
        "spacing, least": lambda r: f"{r['least']:.1e}",
        "mean": lambda r: f"{r['mean']:.1e}",
        "mean abs e, float64 / float32": pair("mean_error", 5),
        "more": lambda r: f"{r['more']:.1e}",
        "scatter": lambda r: f"{r['scatter']:.1e}",
        "max abs e": pair("max_error", 3),
        "mean Q": pair("mean_quality_all", 4),
        "min Q": pair("min_quality_all", 3),
        "warned": lambda r: "yes" if r["warned"] else "no",
    }
    report = Report(options.json, columns)
    good = True
    for name in options.fields:
        for n in options.sizes:
            for effort in options.efforts:
                record = measure(options, name, n, effort)
                report.add(record)
                good &= record["fits"] or record["warned"]
    report.finish(heading(make_adapter(Namespace(device=options.device, dtype="float32")), "Precision"))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
