"""Where the front of size against shape ends: errors beyond which cells get no better shape.

    python bench/front_ends.py [--fields F3,ridge] [--device NAME] [--dtype float32] [--json]

Each field has these rows. "target 0.2" with default and best: the largest error that a run makes of itself. "shape
alone": the default with 400 steps of descent of the quality on the finest level, without a bound on sizes. It ends
where the cells have their best shape, with the dislocations that this size field needs. "Lloyd": 400 steps to the
centroids of the density h^-4, whose cells have the size h. "smoothed": runs with the target 0.02 for log h that a
biharmonic filter has smoothed, so that fewer dislocations are needed; the filter is chosen so that it changes log h by
0.05 and by 0.1 in the mean over the cells. Errors are those against the field itself, for all cells, absolute; shapes
are those of cells off the walls.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from _common import BOX, FIRST_SEED, Report, figures, heading, make_adapter, names, parser, shown, test_field
from scipy.fft import dctn, idctn
from scipy.interpolate import RectBivariateSpline

import clvoro
from clvoro.adaptation.plan import efforts

FIELDS = ("F3", "circles", "ridge", "steep circles", "steep ridge")
TARGET, STEPS, SMOOTHED_TARGET = 0.2, 400, 0.02
CHANGES = (0.05, 0.1)
"""Mean changes of log h by smoothing."""
GRID = (1000, 600)


def smoothed(field: clvoro.sizing.Field, change: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return the field whose log h is smoothed so that it changes by `change` in the mean over the cells."""
    extent = np.array(BOX.upper) - BOX.lower
    x, y = ((np.arange(n) + 0.5) * length / n for n, length in zip(GRID, extent, strict=True))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    log_h = np.log(np.asarray(field(places.reshape(-1, 2)))).reshape(GRID)
    modes = dctn(log_h, norm="ortho")
    k2 = np.add.outer(*((np.pi * np.arange(n) / length) ** 2 for n, length in zip(GRID, extent, strict=True)))

    def apply(strength: float) -> tuple[float, np.ndarray]:
        made = idctn(modes / (1 + strength * k2**2), norm="ortho")
        return float(np.average(np.abs(made - log_h), weights=np.exp(-2 * made))), made

    low, high = -12.0, 0.0  # of log10 of the strength
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if apply(10**middle)[0] < change else (low, middle)
    spline = RectBivariateSpline(x, y, apply(10**low)[1])
    return lambda p: np.exp(spline.ev(p[:, 0], p[:, 1]))


def runs_on(adapter: clvoro.Adapter, field: clvoro.sizing.Field) -> dict[str, Callable[[], clvoro.Result]]:
    """Return the runs of a field by name."""

    def adapt(size: Any, target: float, free: efforts.Effort | None = None, **more: Any) -> clvoro.Result:
        kept = efforts.EFFORTS["default"]
        try:
            efforts.EFFORTS["default"] = free or kept
            options = clvoro.MultilevelOptions(error_target=target)
            return adapter.run(BOX, size, seed=FIRST_SEED, options=options, **more)
        finally:
            efforts.EFFORTS["default"] = kept

    unbound = replace(
        efforts.EFFORTS["default"], loose=efforts.LoosePolish(0.0, STEPS, 0.9), largest_log_ratio_scale=math.inf
    )
    lloyd = {"max_steps": STEPS, "options": clvoro.PaperOptions(tol=0)}
    return {
        f"default, target {TARGET:g}": lambda: adapt(field, TARGET),
        f"best, target {TARGET:g}": lambda: adapt(field, TARGET, effort="best"),
        "shape alone": lambda: adapt(field, 1.0, unbound),
        "Lloyd": lambda: adapter.run(BOX, field, seed=FIRST_SEED, method="weighted-lloyd", **lloyd),
        **{
            f"smoothed by {change:g}": lambda change=change: adapt(smoothed(field, change), SMOOTHED_TARGET)
            for change in CHANGES
        },
    }


COLUMNS = {
    "field": lambda r: r["field"],
    "run": lambda r: r["run"],
    "cells": shown("cells", ".0f"),
    "mean |e|": shown("mean_error", ".4f"),
    "max |e|": shown("max_error", ".3f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "CPU s": shown("seconds", ".1f"),
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--fields", type=names, default=FIELDS, help=", ".join(FIELDS))
    options = options_of.parse_args()
    if unknown := sorted(set(options.fields) - set(FIELDS)):
        options_of.error(f"no field {', '.join(unknown)}; there are {', '.join(FIELDS)}")
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for name in options.fields:
        field = test_field(name)
        for run, make in runs_on(adapter, field).items():
            begun = time.process_time()
            result = make()
            seconds = time.process_time() - begun
            size = np.asarray(field(result.diagram.points))
            found = figures(result.diagram, size, result.quality)
            report.add({"field": name, "run": run, **found, "seconds": seconds}, f"{name}, {run}")
    report.finish(heading(adapter, "Where the front of size and shape ends"))


if __name__ == "__main__":
    main()
