"""The cost of periodic boxes: diagrams, steps and runs beside those of the same box with walls.

    python bench/periodic.py [--sizes 1e4,1e5,1e6] [--sizes-3d 1e4,1e5] [--repeat 5] [--runs]
                             [--device NAME] [--dtype float32] [--json]

Generators are uniform random. "cold" is a diagram from nothing, "whole" one that has the cells of ghost images as well,
as vertices need them; "warm" is the next diagram after all generators have moved by up to a hundredth
of the spacing. Microseconds of processor time per cell, over the device's compute units: medians of
`--repeat`. "images" is their number over that of the generators. With `--runs` whole runs at
effort "fast" with a constant size follow.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from _common import Report, counts, heading, make_adapter, parser

import clvoro
from clvoro.tessellation.tessellator import Tessellator


def main(argv: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--sizes", type=counts, default=[10_000, 100_000, 1_000_000])
    made.add_argument("--sizes-3d", type=counts, default=[10_000, 100_000])
    made.add_argument("--repeat", type=int, default=5)
    made.add_argument("--runs", action="store_true", help="whole runs, too")
    options = made.parse_args(argv)
    adapter = make_adapter(options)
    units = adapter.ctx.devices[0].max_compute_units
    figures = ("cold", "warm", "whole", *(["run"] if options.runs else []))
    report = Report(
        options.json,
        {
            "dim": lambda r: r["dim"],
            "cells": lambda r: f"{r['cells']:,}",
            "images": lambda r: f"{r['images']:.2f}",
            **{
                f"{name}: walls, periodic, ratio": lambda r, name=name: (
                    f"{r['walls'][name]:.2f}, {r['periodic'][name]:.2f}, {r['periodic'][name] / r['walls'][name]:.2f}"
                )
                for name in figures
            },
        },
    )
    for dim, sizes in ((2, options.sizes), (3, options.sizes_3d)):
        for n in sizes:
            record: dict = {"dim": dim, "cells": n}
            for kind in ("walls", "periodic"):
                box = clvoro.Box((0,) * dim, (1,) * dim, periodic=kind == "periodic")
                times, images = measure(adapter, box, n, options.repeat, options.runs)
                record[kind] = {name: 1e6 * t / n / units for name, t in times.items()}
                record["images"] = images
            report.add(record)
    report.finish(heading(adapter, "Periodic boxes beside boxes, microseconds per cell"))
    return 0


def measure(
    adapter: clvoro.Adapter, box: clvoro.Box, n: int, repeat: int, runs: bool
) -> tuple[dict[str, float], float]:
    """Return processor seconds of each part of the work, and the ratio of images to generators."""
    stages = adapter._stages_for(box)
    engine, dim = stages.engine, box.dim
    rng = np.random.default_rng(7919)
    points = rng.random((n, dim))
    x = engine.upload(box.place(points, adapter.dtype))
    x = stages.bins.build(box, x, n).points[:n].copy()
    points = x.get().astype(float)
    moves = [
        engine.upload(box.place(moved, adapter.dtype))
        for moved in (
            np.clip(points + k * 0.005 * n ** (-1 / dim) * (2 * rng.random((n, dim)) - 1), 0, 1 - 1e-9) for k in (0, 1)
        )
    ]
    tessellator = Tessellator(stages, box)
    times = {
        "cold": clock(adapter, repeat, lambda: tessellator.tessellate(x, n)),
        "whole": clock(adapter, repeat, lambda: tessellator.tessellate(x, n, exact=True, complete=True)),
    }
    folded, images = tessellator.tessellate(x, n).folded, 0.0
    if folded is not None:
        images = folded.part.count / n - 1
    state = [tessellator.tessellate(moves[0], n), 0]

    def warm() -> None:
        state[1] = 1 - state[1]
        state[0] = tessellator.tessellate(moves[state[1]], n, state[0])

    times["warm"] = clock(adapter, repeat, warm)
    if runs:
        size = n ** (-1 / dim)
        times["run"] = clock(adapter, 1, lambda: adapter.run(box, size, effort="fast"))
    return times, images


def clock(adapter: clvoro.Adapter, repeat: int, function: Callable[[], object]) -> float:
    """Return the median of the processors' seconds for `function`, after a first call."""
    seconds = []
    for _ in range(repeat + 1):
        adapter.queue.finish()
        began = time.process_time()
        function()
        adapter.queue.finish()
        seconds.append(time.process_time() - began)
    return statistics.median(seconds[1:])


if __name__ == "__main__":
    sys.exit(main())
