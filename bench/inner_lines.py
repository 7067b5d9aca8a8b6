"""Lines inside a domain: how much of them faces of cells cover, and sizes and shapes of the cells.

    python bench/inner_lines.py [--cells 5e3] [--kinds faults,grid,...] [--effort default] [--device NAME]
                                [--dtype float32] [--json]

"covered" is the length of the faces on the lines over the length of the lines; a curve is longer than its chords. "left
out" says at how many places a line has no room. "h beside" is the size of the cells beside the lines over the size
field: the least, the median and the largest. Errors and qualities are with lines, in brackets without.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import SHAPE_COLUMNS, Report, heading, make_adapter, names, parser

import clvoro

BOX = clvoro.Box((0, 0), (2, 1))


def random_lines(seed: int, count: int, vertices: int) -> list[np.ndarray]:
    """Return random polylines in the box."""
    rng = np.random.default_rng(seed)
    starts, turns = rng.random((count, 2)) * (2, 1), rng.normal(0, 0.3, (count, vertices)).cumsum(axis=1)
    way = turns + rng.uniform(0, 2 * np.pi, (count, 1))
    steps = rng.uniform(0.1, 0.3, (count, vertices, 1)) * np.stack([np.cos(way), np.sin(way)], axis=2)
    return list(np.concatenate([starts[:, None], starts[:, None] + steps.cumsum(axis=1)], axis=1))


def meander(x: np.ndarray) -> np.ndarray:
    """Return a river as a fine polyline."""
    return np.column_stack([x, 0.5 + 0.2 * np.sin(5 * x)])


KINDS: dict[str, tuple[clvoro.Box | clvoro.Polygon, Any, Any]] = {
    "one": (BOX, [[(0.3, 0.2), (1.6, 0.8)]], 1.0),
    "faults": (BOX, random_lines(4, 6, 4), 1.0),
    "graded": (BOX, random_lines(4, 6, 4), lambda p: 0.3 + np.abs(p[:, 0] - 1)),
    "grid": (BOX, [[(x, 0), (x + 0.1, 1)] for x in (0.4, 0.9, 1.4)] + [[(0, y), (2, y)] for y in (0.3, 0.65)], 1.0),
    "river": (BOX, [meander(np.linspace(0, 2, 2000))], 1.0),
    "inclusions": (BOX, [clvoro.curves.circle(c, 0.12) for c in ((0.4, 0.5), (1, 0.3), (1.5, 0.6))], 1.0),
    "acute": (BOX, [[(0.1, 0.5), (1.9, 0.5)], [(0.8, 0.5), (1.8, 0.95)], [(0.8, 0.5), (1.8, 0.1)]], 1.0),
    "periodic": (clvoro.Box((0, 0), (2, 1), True), [[(0, 0.3), (2, 0.3)], [(1.7, 0.1), (2.3, 0.8)]], 1.0),
    "polygon": (
        clvoro.Polygon([(0, 0), (2, 0), (2, 0.5), (1, 0.5), (1, 1), (0, 1)], [clvoro.curves.circle((0.5, 0.5), 0.15)]),
        [[(0, 0.8), (1, 0.9)], [(0.2, 0.1), (1.8, 0.4)], [(0.5, 0.65), (0.5, 1)]],
        1.0,
    ),
}


def with_and_without(show: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], str]:
    """Return a column that shows a figure with lines and, in brackets, without."""
    return lambda r: f"{show(r)} ({show(r['without'])})"


COLUMNS = {
    "lines": lambda r: r["kind"],
    "cells": lambda r: f"{r['cells']:,}",
    "covered": lambda r: f"{r['covered']:.6f}",
    "left out": lambda r: r["left_out"],
    "h beside": lambda r: ", ".join(f"{x:.2f}" for x in r["beside"]),
    **{
        name: with_and_without(show)
        for name, show in {**SHAPE_COLUMNS, "time [s]": lambda r: f"{r['seconds']:.2f}"}.items()
    },
}


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--cells", type=float, default=5e3)
    options_of.add_argument("--kinds", type=names, default=list(KINDS))
    options_of.add_argument("--effort", default="default")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for kind in options.kinds:
        domain, lines, shape = KINDS[kind]
        size = clvoro.sizing.Function(shape) if callable(shape) else clvoro.sizing.Constant(shape)
        scale = (clvoro.adaptation.sampling.start.density_tree(size, domain).integral / options.cells) ** 0.5
        adapter.run(domain, scale * size, options.effort)  # kernels are built
        without, _ = figures(adapter, domain, scale * size, options.effort)
        found, mesh = figures(adapter, domain.with_lines(lines), scale * size, options.effort)
        d = mesh.diagram
        on = d.line_faces
        cells = np.unique([d.faces.owner[on], d.faces.neighbor[on]])
        ratio = np.sqrt(d.volumes[cells]) / (scale * size)(d.points[cells])
        report.add(
            {
                "kind": kind,
                **found,
                "covered": float(d.faces.area[on].sum() / d.domain.lines.inside(d.domain).length),
                "beside": [float(x) for x in (ratio.min(), np.median(ratio), ratio.max())],
                "without": without,
            }
        )
    report.finish(heading(adapter, "Lines inside"))
    return 0


def figures(adapter: clvoro.Adapter, domain: Any, size: Any, effort: Any) -> tuple[dict[str, Any], clvoro.Result]:
    """Return figures of a run, and its mesh."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        begin = time.perf_counter()
        mesh = adapter.run(domain, size, effort)
        seconds = time.perf_counter() - begin
    keys = ("cells", "mean_error", "max_error", "mean_quality", "min_quality")
    left_out = sum("no room" in str(w.message) for w in caught)
    return {**{key: mesh.summary()[key] for key in keys}, "seconds": seconds, "left_out": left_out}, mesh


if __name__ == "__main__":
    sys.exit(main())
