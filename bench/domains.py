"""The cost of polygonal and periodic domains: diagrams and runs beside those of a box with walls.

    python bench/domains.py [--domains polygon,periodic] [--sizes 1e4,1e5] [--dims 2,3] [--edges 10000] [--repeat 3]
                            [--device NAME] [--dtype float32] [--json]

The polygon, in 2D alone, is a coast of `--edges` edges with an island. "diagram" is that of uniform random generators,
with its arrays on the host; "run" has effort "fast" and a constant size. Microseconds of processor time per cell, over
the device's compute units: medians of `--repeat` by turns, after a first call. In 3D there are a tenth of the cells.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from _common import Report, counts, heading, make_adapter, names, parser, random_points
from _sites import rough_lake

import clvoro


def figure(name: str) -> Callable[[dict[str, Any]], str]:
    """Return the text of a column: microseconds in the box, in the domain, and the ratio."""
    return lambda r: f"{r['box'][name]:.2f}, {r['domain'][name]:.2f}, {r['domain'][name] / r['box'][name]:.2f}"


COLUMNS = {
    "domain": lambda r: f"{r['kind']}, {r['dim']}D",
    "cells": lambda r: f"{r['cells']:,}",
    "diagram: box, domain, ratio": figure("diagram"),
    "run: box, domain, ratio": figure("run"),
}


def compare(adapter: clvoro.Adapter, domains: dict[str, Any], n: int, repeat: int) -> dict[str, dict[str, float]]:
    """Return microseconds per cell of a diagram and of a run, in each domain."""
    works: dict[tuple[str, str], Callable[[], Any]] = {}
    for name, domain in domains.items():
        x, size = random_points(domain, n), (domain.measure / n) ** (1 / domain.dim)
        works[name, "diagram"] = lambda domain=domain, x=x: adapter.diagram(domain, x).volumes
        works[name, "run"] = lambda domain=domain, size=size: adapter.run(domain, size, "fast").diagram.volumes
    taken: dict[tuple[str, str], list[float]] = {key: [] for key in works}
    for _ in range(repeat + 1):
        for key, work in works.items():
            began = time.process_time()
            work()
            taken[key].append(time.process_time() - began)
    found: dict[str, dict[str, float]] = {name: {} for name in domains}
    for (name, part), seconds in taken.items():
        per_cell = 1e6 / n / adapter.ctx.devices[0].max_compute_units
        found[name][part] = per_cell * statistics.median(seconds[1:])
    return found


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--domains", type=names, default=["polygon", "periodic"])
    made.add_argument("--sizes", type=counts, default=[10_000, 100_000])
    made.add_argument("--dims", type=counts, default=[2, 3])
    made.add_argument("--edges", type=lambda text: counts(text)[0], default=10_000)
    made.add_argument("--repeat", type=int, default=3)
    options = made.parse_args()
    adapter, report = make_adapter(options), Report(options.json, COLUMNS)
    for kind in options.domains:
        for dim in options.dims if kind == "periodic" else [2]:
            box = clvoro.Box((0,) * dim, (1,) * dim)
            other = rough_lake(options.edges) if kind == "polygon" else clvoro.Box(box.lower, box.upper, periodic=True)
            for n in options.sizes if dim == 2 else [n // 10 for n in options.sizes]:
                found = compare(adapter, {"box": box, "domain": other}, n, options.repeat)
                report.add({"kind": kind, "dim": dim, "cells": n, **found}, f"{kind}, {dim}D, {n}")
    report.finish(heading(adapter, "Domains beside boxes, microseconds per cell"))


if __name__ == "__main__":
    main()
