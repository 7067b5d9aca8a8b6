"""Meshes on the sphere: time, sizes, shapes and what C grids need, quasi-uniform and graded.

    python bench/sphere.py [--sizes 40962,163842,655362] [--efforts default] [--graded] [--plane]
                           [--openings] [--device NAME] [--dtype float32] [--json]

Quasi-uniform meshes of given numbers of cells, from random generators ("random") and, as a peer, the bisected
icosahedron after 100 steps of Lloyd's method ("icosahedral"; numbers of cells 10 * 4^k + 2 only). With `--graded`
meshes of the Earth with caps of fine cells in the North Atlantic: 27, 9 and 3 km times 9, and 1 : 64, with
a growth of a tenth and of a fifth per cell. With `--plane` the same numbers of cells in a square, for the cost
per cell. With `--openings` only small meshes are made, from `SEEDS` seeds each, with and without the opening of
obtuse triangles at the end of a run; errors are those with it.
The first run of each kind builds kernels; times are those of a second run. Processor seconds are those of all cores.

Columns: mean and largest |e|, mean and least Q; obtuse Delaunay triangles and the largest angle; the distance
between the middles of Voronoi edges and those of their Delaunay edges over the length of the former, mean and largest.
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, names, parser

import clvoro
from clvoro import earth, sizing
from clvoro.adaptation import preparation

EARTH = clvoro.Sphere()
ATLANTIC = (-45, 45)
LLOYD_STEPS = 100
SEEDS = 12


def nested(growth: float) -> sizing.Field:
    """Return 27, 9 and 3 km, times 9, in nested caps."""
    return earth.Caps([(ATLANTIC, 3e6, 81e3), (ATLANTIC, 1e6, 27e3)], h_max=243e3, growth=growth)


def steep(growth: float) -> sizing.Field:
    """Return sizes of 1 : 64."""
    return earth.Caps([(ATLANTIC, 5e5, 8e3)], h_max=512e3, growth=growth)


GRADED = {
    "1 : 9, growth 1.1": nested(1.1),
    "1 : 9, growth 1.2": nested(1.2),
    "1 : 64, growth 1.1": steep(1.1),
    "1 : 64, growth 1.2": steep(1.2),
}


def shape(result: clvoro.Result) -> dict[str, Any]:
    """Return sizes and shapes of a mesh, with those for C grids on a sphere."""
    error, quality = np.abs(result.size_error), result.quality
    found = {
        "cells": len(result.diagram),
        "mean_error": error.mean(),
        "max_error": error.max(),
        "mean_quality": quality.mean(),
        "min_quality": quality.min(),
    }
    if isinstance(result.diagram.domain, clvoro.Sphere):
        grid = result.measures.c_grid.summary()
        found |= {k: grid[k] for k in ("obtuse", "max_angle", "mean_edge_offset", "max_edge_offset")}
    return {k: float(v) for k, v in found.items()}


def timed(adapter: clvoro.Adapter, *args: Any, **given: Any) -> dict[str, Any]:
    """Run twice; return the figures of the second run."""
    few = {k: v for k, v in given.items() if k not in ("n_cells", "points")}
    adapter.run(args[0], *args[1:], **few, n_cells=5000)
    begin, work = time.perf_counter(), time.process_time()
    result = adapter.run(*args, **given)
    seconds, work = time.perf_counter() - begin, time.process_time() - work
    return {"seconds": seconds, "processor_seconds": work, **shape(result)}


def icosahedral(adapter: clvoro.Adapter, n: int) -> dict[str, Any] | None:
    """Return the figures of the bisected icosahedron after Lloyd's method; None if it has not `n` points."""
    level = round(math.log((n - 2) / 10, 4))
    if 10 * 4**level + 2 != n:
        return None
    points = EARTH.icosahedral_points(level)
    begin, work = time.perf_counter(), time.process_time()
    result = adapter.run(EARTH, (EARTH.measure / n) ** 0.5, points=points, method="lloyd", max_steps=LLOYD_STEPS)
    seconds, work = time.perf_counter() - begin, time.process_time() - work
    return {"seconds": seconds, "processor_seconds": work, **shape(result)}


def coarse(growth: float) -> sizing.Field:
    """Return two caps of fine cells, for about 4,000 cells."""
    fine = 6e4 if growth < 1.15 else 5e4
    caps = [(ATLANTIC, 1e6, fine), ((100, -20), 5e5, 1.7 * fine)]
    return earth.Caps(caps, h_max=12 * fine, growth=growth)


def compare_openings(options: Any) -> None:
    """Count the runs that end with obtuse triangles, with and without their opening."""
    adapter = make_adapter(options)
    kinds: list[tuple[str, Any, dict[str, Any]]] = [
        *((f"equal, {n}", 1e6, {"n_cells": n}) for n in (642, 2562, 10_242)),
        ("two caps, growth 1.1", coarse(1.1), {}),
        ("two caps, growth 1.2", coarse(1.2), {}),
    ]
    columns = {
        "mesh": lambda r: r["mesh"],
        "method, effort": lambda r: f"{r['method']}, {r['effort']}",
        "runs": lambda r: r["runs"],
        **{
            f"{way} opening": lambda r, way=way: "{} runs, {} triangles, {:.1f}".format(*r[way])
            for way in ("without", "with")
        },
        "mean, max abs(e)": lambda r: "{:.1e}, {:.1e}".format(*r["errors"]),
    }
    report, most = Report(options.json, columns), preparation.OPENINGS
    ways: list[tuple[Any, Any]] = [
        ("exact", "default"),
        ("adaptive", "fast"),
        ("exact", "fast"),
        ("adaptive", "default"),
        ("adaptive", "best"),
    ]
    for method, effort in ways:
        for name, size, given in kinds:
            row: dict[str, Any] = {"mesh": name, "method": method, "effort": effort, "runs": SEEDS}
            for way, openings in (("without", 0), ("with", most)):
                preparation.OPENINGS = openings
                results = [
                    adapter.run(EARTH, size, method=method, effort=effort, seed=seed, **given) for seed in range(SEEDS)
                ]
                grids = [result.measures.c_grid for result in results]
                error = np.concatenate([np.abs(result.size_error) for result in results])
                row["errors"] = float(error.mean()), float(error.max())
                found = [grid.obtuse for grid in grids]
                widest = max(float(grid.angles.max()) for grid in grids)
                row[way] = (sum(count > 0 for count in found), sum(found), widest)
            report.add(row, name)
    report.finish(heading(adapter, "Obtuse triangles, and the largest angle in degrees"))


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[40_962, 163_842], help="cells")
    options_of.add_argument("--efforts", type=names, default=["default"])
    options_of.add_argument("--graded", action="store_true", help="graded meshes, too")
    options_of.add_argument("--plane", action="store_true", help="a square, too")
    options_of.add_argument("--openings", action="store_true", help="only obtuse triangles")
    options = options_of.parse_args()
    if options.openings:
        compare_openings(options)
        return 0
    adapter = make_adapter(options)
    columns = {
        "mesh": lambda r: r["mesh"],
        "effort": lambda r: r["effort"],
        "cells": lambda r: f"{r['cells']:.0f}",
        "s": lambda r: f"{r['seconds']:.1f}",
        "processor s": lambda r: f"{r['processor_seconds']:.1f}",
        "us/cell": lambda r: f"{1e6 * r['seconds'] / r['cells']:.1f}",
        "mean, max abs(e)": lambda r: f"{r['mean_error']:.4f}, {r['max_error']:.3f}",
        "mean, min Q": lambda r: f"{r['mean_quality']:.4f}, {r['min_quality']:.3f}",
        "obtuse": lambda r: f"{r['obtuse']:.0f}" if "obtuse" in r else "",
        "max angle": lambda r: f"{r['max_angle']:.1f}" if "obtuse" in r else "",
        "edge offset": lambda r: f"{r['mean_edge_offset']:.4f}, {r['max_edge_offset']:.3f}" if "obtuse" in r else "",
    }
    report = Report(options.json, columns)
    for n in options.sizes:
        for effort in options.efforts:
            row = timed(adapter, EARTH, 1e6, n_cells=n, effort=effort, seed=FIRST_SEED)
            report.add({"mesh": "random", "effort": effort, **row}, f"random, {n}")
            if options.plane:
                square = clvoro.Box((0, 0), (1, 1))
                row = timed(adapter, square, 1.0, n_cells=n, effort=effort, seed=FIRST_SEED)
                report.add({"mesh": "square", "effort": effort, **row}, f"square, {n}")
        peer = icosahedral(adapter, n)
        if peer is not None:
            report.add({"mesh": "icosahedral", "effort": f"lloyd, {LLOYD_STEPS}", **peer}, f"icosahedral, {n}")
    for name, size in GRADED.items() if options.graded else ():
        for effort in options.efforts:
            row = timed(adapter, EARTH, size, effort=effort, seed=FIRST_SEED)
            report.add({"mesh": name, "effort": effort, **row}, name)
    report.finish(heading(adapter, "Meshes on the sphere"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
