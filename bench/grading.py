"""The cost of grading: diagrams of graded and uniform sets by turns, so that changes of the machine's speed cancel.

    python bench/grading.py [--sizes 1e6] [--sizes-3d 1e5,5e5] [--repeat 7] [--device NAME] [--dtype float32]
                            [--json]

The sets are those of `diagram.py`: in 2D "cubed" and "radial" (1 : 10 000), in 3D "radial" around an
empty ball and "core" around a filled one (1 : 1000). Microseconds per cell from generators in the
order of their bins to the graph, by the clock, medians and minima of `--repeat` rounds; "ratio" is
to the uniform set's.
"""

from __future__ import annotations

import statistics
import sys
import time
from typing import Any

import numpy as np
from _common import Report, counts, heading, make_adapter, parser
from diagram import SETS, SETS_3D

import clvoro
from clvoro.tessellation.tessellator import Tessellator

GRADED = {2: ("uniform", "cubed", "radial"), 3: ("uniform", "radial", "core")}
COLUMNS = {
    "dim": lambda r: str(r["dim"]),
    "set": lambda r: r["set"],
    "cells": lambda r: f"{r['cells']:,}",
    "median us": lambda r: f"{1e6 * r['median']:.2f}",
    "ratio": lambda r: f"{r['median_ratio']:.2f}",
    "least us": lambda r: f"{1e6 * r['least']:.2f}",
    "ratio of least": lambda r: f"{r['least_ratio']:.2f}",
}


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**6])
    options_of.add_argument("--sizes-3d", type=counts, default=[10**5, 5 * 10**5])
    options_of.add_argument("--repeat", type=int, default=7)
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for dim, sizes in ((2, options.sizes), (3, options.sizes_3d)):
        for n in sizes:
            for record in measure(adapter, dim, n, options.repeat):
                report.add(record, f"{dim}D {record['set']} {n:,}")
    report.finish(heading(adapter, "Graded sets beside uniform ones"))
    return 0


def measure(adapter: clvoro.Adapter, dim: int, n: int, repeat: int) -> list[dict[str, Any]]:
    """Return a record for each set of `n` cells."""
    box = clvoro.Box((0,) * dim, (1,) * dim)
    stages, sets = adapter._stages_for(box), SETS if dim == 2 else SETS_3D
    ordered = {}
    for name in GRADED[dim]:
        points = sets[name](n, np.random.default_rng(7))
        x = stages.engine.upload(box.place(points, adapter.dtype))
        ordered[name] = stages.bins.build(box, x, n).points[:n].copy()
    seconds: dict[str, list[float]] = {name: [] for name in ordered}
    for _ in range(repeat + 1):
        for name, x in ordered.items():
            adapter.queue.finish()
            began = time.perf_counter()
            Tessellator(stages, box).tessellate(x, n)
            adapter.queue.finish()
            seconds[name].append(time.perf_counter() - began)
    records = []
    for name, times in seconds.items():
        record = {"dim": dim, "set": name, "cells": n}
        for figure, of in (("median", statistics.median), ("least", min)):
            # The first of each builds kernels and allocates memory.
            record[figure] = of(times[1:]) / n
            record[f"{figure}_ratio"] = of(times[1:]) / of(seconds["uniform"][1:])
        records.append(record)
    return records


if __name__ == "__main__":
    sys.exit(main())
