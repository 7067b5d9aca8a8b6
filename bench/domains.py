"""The cost of polygonal and periodic domains: diagrams and runs beside those of a box with walls.

    python bench/domains.py [--kinds polygon,periodic] [--sizes 1e4,1e5,1e6] [--dims 2,3] [--edges 10000]
                            [--repeat 5] [--runs] [--device NAME] [--dtype float32] [--json]

Generators are uniform random. The polygon, in 2D alone, is a coast of `--edges` edges with an island. "cold" is a
diagram from nothing, "whole" one that has the cells of ghost images as well, as vertices need them; "warm" is the next
diagram after all generators have moved by up to a hundredth of the spacing. Microseconds of processor time per cell,
over the device's compute units: medians of `--repeat`, by turns. "images" is their number over that of the generators.
With `--runs` whole runs at effort "fast" with a constant size follow. In 3D there are a tenth of the cells.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import Report, counts, heading, make_adapter, names, parser
from _sites import rough_lake

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.tessellation.tessellator import Tessellator


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--kinds", type=names, default=["polygon", "periodic"])
    made.add_argument("--sizes", type=counts, default=[10_000, 100_000, 1_000_000])
    made.add_argument("--dims", type=counts, default=[2, 3])
    made.add_argument("--edges", type=lambda text: counts(text)[0], default=10_000)
    made.add_argument("--repeat", type=int, default=5)
    made.add_argument("--runs", action="store_true", help="whole runs, too")
    options = made.parse_args()
    adapter = make_adapter(options)
    columns = {
        "domain": lambda r: f"{r['kind']}, {r['dim']}D",
        "cells": lambda r: f"{r['cells']:,}",
        "images": lambda r: f"{r['images']:.2f}",
    }
    parts = ["cold", "warm", "whole", *(["run"] if options.runs else [])]
    for name in parts:
        columns[f"{name}: box, domain, ratio"] = lambda r, name=name: (
            f"{r['box'][name]:.2f}, {r['domain'][name]:.2f}, {r['domain'][name] / r['box'][name]:.2f}"
        )
    report = Report(options.json, columns)
    for kind in options.kinds:
        for dim in options.dims:
            if kind == "polygon" and dim == 3:
                continue
            box = clvoro.Box((0,) * dim, (1,) * dim)
            domain = rough_lake(options.edges) if kind == "polygon" else clvoro.Box(box.lower, box.upper, (True,) * dim)
            for n in options.sizes if dim == 2 else [n // 10 for n in options.sizes]:
                report.add(
                    {"kind": kind, "dim": dim, "cells": n, **compare(adapter, box, domain, n, parts, options.repeat)}
                )
    report.finish(heading(adapter, "Domains beside boxes, microseconds per cell"))


def compare(adapter: clvoro.Adapter, box: Any, domain: Any, n: int, parts: list[str], repeat: int) -> dict[str, Any]:
    """Return microseconds per cell of each part of the work on both domains, and the ratio of images to generators."""
    works = {"box": work_on(adapter, box, n), "domain": work_on(adapter, domain, n)}
    seconds: dict[str, dict[str, float]] = {name: {} for name in works}
    folded = works["domain"]["cold"]().folded
    for part in parts:
        taken: dict[str, list[float]] = {name: [] for name in works}
        for _ in range(2 if part == "run" else repeat + 1):
            for name, work in works.items():
                adapter.queue.finish()
                began = time.process_time()
                work[part]()
                adapter.queue.finish()
                taken[name].append(time.process_time() - began)
        for name, all_seconds in taken.items():
            per_cell = 1e6 / n / adapter.ctx.devices[0].max_compute_units
            seconds[name][part] = per_cell * statistics.median(all_seconds[1:])
    return {**seconds, "images": 0.0 if folded is None else folded.part.count / n - 1}


def work_on(adapter: clvoro.Adapter, domain: Any, n: int) -> dict[str, Callable[[], Any]]:
    """Return the parts of the work on `n` random generators in `domain`, in the order of their bins."""
    stages = Stages(adapter._engine_for(domain))
    dim, spacing = domain.dim, (domain.measure / n) ** (1 / domain.dim)
    rng, points = np.random.default_rng(7919), np.empty((0, dim))
    while len(points) < n:
        more = rng.uniform(domain.lower, domain.upper, (n, dim))
        points = np.concatenate([points, more[domain.contains(more)]])
    upload = stages.engine.upload
    x = stages.bins.build(domain, upload(domain.place(points[:n], adapter.dtype)), n).points[:n].copy()
    origin, scale = domain.frame
    places = x.get().astype(float) * scale + origin
    moves = []
    for k in (0, 1):
        moved = places + 0.01 * k * spacing * (rng.random((n, dim)) - 0.5)
        moved = np.where(domain.contains(moved)[:, None], moved, places)
        moves.append(upload(domain.place(moved, adapter.dtype)))
    tessellator = Tessellator(stages, domain, lambda at: np.full(len(at), spacing))
    state = [tessellator.tessellate(moves[0], n), 0]

    def warm() -> None:
        state[1] = 1 - state[1]
        state[0] = tessellator.tessellate(moves[state[1]], n, state[0])

    return {
        "cold": lambda: tessellator.tessellate(x, n),
        "warm": warm,
        "whole": lambda: tessellator.tessellate(x, n, exact=True, complete=True),
        "run": lambda: adapter.run(domain, spacing, effort="fast"),
    }


if __name__ == "__main__":
    main()
