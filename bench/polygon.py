"""The cost of polygonal domains, and the quality of their meshes.

    python bench/polygon.py [--cells 1e6] [--edges 10000] [--runs 5] [--seeds 7] [--only cost,meshes]
                            [--device NAME] [--dtype float32] [--json]

The first table compares the diagram of a polygon of `--edges` edges, a coast with an island, with that of a box with
as many generators: from nothing, and updated without motion, where only the boundary is clipped again. Times are
processor times over the number of cores, medians of several runs by turns.

The second table runs size fields of `bench/convergence.py` on such a polygon, medians of `--seeds` starts. F2 and F3
stand against one and a half times the error targets of the box, and its mean quality less .01. Fields with kinks, where
a run trades sizes for shape, stand against those of `bench/convergence.py`. Cells on the boundary stand against a mean
|e| of .006.
Quality is that of cells without a face on the boundary; the others have separate columns.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from typing import Any

import numpy as np
from _common import (
    BOX,
    Report,
    counts,
    device_name,
    figures,
    heading,
    make_adapter,
    names,
    off_walls,
    parser,
    test_field,
)

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.tessellation.tessellator import Tessellator

MOST_RATIO = 1.3
SMOOTH = {"mean_error": 0.006, "max_error": 0.06, "mean_quality": 0.980, "boundary_error": 0.006}
KINKED = {"mean_error": 0.015, "max_error": 0.25, "mean_quality": 0.985, "min_quality": 0.92, "boundary_error": 0.006}
MESHES = (
    ("fast", "F2", {"effort": "fast"}, {"mean_error": 0.009, "mean_quality": 0.965}),
    ("default", "F2", {}, SMOOTH),
    ("default", "F3", {}, SMOOTH),
    ("exact", "F2", {"method": "exact"}, {"mean_deviation": 1.5e-4, "max_deviation": 3e-3, "mean_quality": 0.976}),
    *(("default", field, {}, KINKED) for field in ("circles", "ridge", "steep circles", "steep ridge")),
)


def coast(k: int, seed: int, center: tuple[float, float], radii: tuple[float, float], rough: float) -> np.ndarray:
    """Return a closed curve of `k` corners, a rough ellipse: a random Fourier series of falling amplitude."""
    rng = np.random.Generator(np.random.PCG64(seed))
    t = 2 * np.pi * np.arange(k) / k
    waves = np.arange(2, min(400, k // 4))
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    bulge = np.cos(np.outer(t, waves) + phases) @ waves**-1.4
    r = np.exp(rough * bulge)[:, None]
    return np.array(center) + np.array(radii) * r * np.column_stack([np.cos(t), np.sin(t)])


def lake(edges: int, rough: float = 0.08) -> clvoro.Polygon:
    """Return a lake with an island, within `BOX` and around the circles of F2 and F3."""
    outer = coast(7 * edges // 10, 1, (1.2, 0.75), (1.0, 0.6), rough)
    island = coast(edges - len(outer), 2, (1.5, 0.75), (0.12, 0.12), rough)
    return clvoro.Polygon(outer, [island])


def random_points(domain: clvoro.Polygon | clvoro.Box, n: int) -> np.ndarray:
    """Return uniform random points in `domain`, (n, 2)."""
    rng = np.random.Generator(np.random.PCG64(3))
    found = np.empty((0, 2))
    while len(found) < n:
        more = rng.uniform(domain.lower, domain.upper, (n, 2))
        found = np.concatenate([found, more[domain.contains(more)]])
    return found[:n]


class Sets:
    """Generators of one domain, in the order of their bins, and their tessellator."""

    def __init__(self, adapter: clvoro.Adapter, domain: Any, n: int) -> None:
        engine = Engine(adapter.ctx, adapter.queue, 2, adapter.dtype, domain.traits(adapter.dtype))
        stages = Stages(engine)
        unsorted = engine.upload(domain.place(random_points(domain, n), adapter.dtype))
        items = stages.bins.build(domain, unsorted, n).items[:n].copy()
        self.n, self.points = n, stages.gather.rows(items, unsorted)
        self.queue = adapter.queue
        spacing = (domain.measure / n) ** 0.5
        self.tessellator = Tessellator(stages, domain, lambda x: np.full(len(x), spacing))
        self.latest = self.tessellator.tessellate(self.points, n)

    def seconds(self, repaired: bool) -> float:
        """Return the processor time of one diagram, divided by the cores."""
        self.queue.finish()
        begin = time.process_time()
        previous = self.latest if repaired else None
        self.latest = self.tessellator.tessellate(self.points, self.n, previous)
        self.queue.finish()
        return (time.process_time() - begin) / len(os.sched_getaffinity(0))


def cost(adapter: clvoro.Adapter, n: int, edges: int, runs: int, report: Report) -> bool:
    """Add the table of costs; False if the polygon costs too much."""
    sets = {"box": Sets(adapter, BOX, n), f"polygon, {edges} edges": Sets(adapter, lake(edges), n)}
    good = True
    for what, repaired in (("anew", False), ("repaired", True)):
        for one in sets.values():
            one.seconds(repaired)
        taken: dict[str, list[float]] = {name: [] for name in sets}
        for _ in range(runs):
            for name, one in sets.items():
                taken[name].append(one.seconds(repaired))
        medians = {name: statistics.median(values) for name, values in taken.items()}
        for name, seconds in medians.items():
            ratio = seconds / medians["box"]
            report.add({"diagram": what, "domain": name, "cells": n, "seconds": seconds, "ratio": ratio})
        good &= repaired or ratio <= MOST_RATIO
    return good


def measure(adapter: clvoro.Adapter, domain: clvoro.Polygon, field: str, **arguments: Any) -> dict[str, Any]:
    """Return the figures of one run."""
    begin = time.perf_counter()
    result = adapter.run(domain, test_field(field), **arguments)
    boundary = ~off_walls(result.diagram)
    return {
        **figures(result.diagram, result.target_size, result.quality),
        "seconds": time.perf_counter() - begin,
        "boundary_cells": int(boundary.sum()),
        "boundary_error": float(np.abs(result.size_error[boundary]).mean()),
        "boundary_quality": float(result.quality[boundary].mean()),
        "boundary_least": float(result.quality[boundary].min()),
        "sum": float(result.diagram.volumes.sum() / domain.measure - 1),
    }


def meshes(adapter: clvoro.Adapter, edges: int, seeds: int, report: Report) -> bool:
    """Add the table of meshes; False if one misses its targets."""
    domain, good = lake(edges), True
    for name, field, arguments, targets in MESHES:
        runs = [measure(adapter, domain, field, seed=seed, **arguments) for seed in range(seeds)]
        found = {key: type(runs[0][key])(statistics.median(run[key] for run in runs)) for key in runs[0]}
        record: dict[str, Any] = {"row": name, "field": field, **found}
        missed = [
            key for key, bound in targets.items() if (record[key] < bound if "quality" in key else record[key] > bound)
        ]
        record["missed"] = ", ".join(missed)
        good &= not missed
        report.add(record, f"{name} {field}: {found['cells']} cells")
    return good


def main() -> int:
    """Run the bench."""
    made = parser(__doc__)
    made.add_argument("--cells", type=lambda text: counts(text)[0], default=1_000_000)
    made.add_argument("--edges", type=lambda text: counts(text)[0], default=10_000)
    made.add_argument("--runs", type=int, default=5)
    made.add_argument("--seeds", type=int, default=7)
    made.add_argument("--only", type=names, default=["cost", "meshes"])
    options = made.parse_args()
    adapter, good = make_adapter(options), True
    if "cost" in options.only:
        table = Report(
            options.json,
            {
                "diagram": lambda r: r["diagram"],
                "domain": lambda r: r["domain"],
                "cells": lambda r: r["cells"],
                "s": lambda r: f"{r['seconds']:.3f}",
                "over the box": lambda r: f"{r['ratio']:.2f}",
            },
        )
        good &= cost(adapter, options.cells, options.edges, options.runs, table)
        table.finish(heading(adapter, "Diagrams of a box and of a polygon"))
    if "meshes" in options.only:
        table = Report(
            options.json,
            {
                "run": lambda r: f"{r['row']} {r['field']}",
                "cells": lambda r: r["cells"],
                "mean e": lambda r: f"{r['mean_error']:.4f}",
                "max e": lambda r: f"{r['max_error']:.3f}",
                "mean deviation": lambda r: f"{r['mean_deviation']:.1e}",
                "max deviation": lambda r: f"{r['max_deviation']:.1e}",
                "Q": lambda r: f"{r['mean_quality']:.4f}",
                "min Q": lambda r: f"{r['min_quality']:.3f}",
                "boundary": lambda r: r["boundary_cells"],
                "its mean e": lambda r: f"{r['boundary_error']:.4f}",
                "its Q": lambda r: f"{r['boundary_quality']:.4f}",
                "its min Q": lambda r: f"{r['boundary_least']:.3f}",
                "s": lambda r: f"{r['seconds']:.1f}",
                "missed": lambda r: r["missed"] or "-",
            },
        )
        good &= meshes(adapter, options.edges, options.seeds, table)
        table.finish(f"Meshes of a polygon of {options.edges} edges, {device_name(adapter)}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
