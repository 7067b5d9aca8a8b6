"""The cost of domains: diagrams, runs and their meshes beside those of a box with walls.

    python bench/domains.py [--domains polygon,periodic] [--sizes 1e4,1e5] [--dims 2,3] [--edges 10000] [--repeat 3]
                            [--effort fast] [--skip diagram] [--device NAME] [--dtype float32] [--json]

The polygon, in 2D alone, is a coast of `--edges` edges with an island. In 3D alone, "cube" is the box as a solid, and
"body" the air in it around a wavy body of 82,000 triangles. "diagram" is that of uniform random generators, with its
arrays on the host; "run" has a constant size; "faces" makes its mesh with all faces, "for solvers" that for solvers.
Microseconds of processor time per cell, over the device's compute units: medians of `--repeat` by turns, after a first
call; `--skip` leaves parts out. In 3D there are a tenth of the cells. "memory" is the most so far of the whole process,
in GB, on the host. "quality" is the mean of the cells.
"""

from __future__ import annotations

import resource
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import Report, counts, heading, make_adapter, names, parser, random_points
from _sites import rough_lake

import clvoro


def figure(*parts: str, digits: int = 2) -> Callable[[dict[str, Any]], str]:
    """Return the text of a column: the sum of some parts in the box, in the domain, and the ratio."""

    def text(row: dict[str, Any]) -> str:
        if not row["box"].keys() >= set(parts):
            return "-"
        box, domain = (sum(row[name][part] for part in parts) for name in ("box", "domain"))
        return f"{box:.{digits}f}, {domain:.{digits}f}, {domain / box:.2f}"

    return text


COLUMNS = {
    "domain": lambda r: f"{r['kind']}, {r['dim']}D",
    "cells": lambda r: f"{r['cells']:,}",
    "diagram: box, domain, ratio": figure("diagram"),
    "run": figure("run"),
    "run, faces and for solvers": figure("run", "faces", "for solvers"),
    "memory": figure("memory"),
    "quality": figure("quality", digits=3),
}


def wavy_body() -> clvoro.Solid:
    """Return a ball with waves, of 82,000 triangles."""
    ball = clvoro.Solid.ball((0, 0, 0), 1, edge=0.0172).surface
    waves = 1 + 0.1 * np.sin(5 * ball.vertices).prod(axis=1)
    return clvoro.Solid(0.5 + 0.25 * waves[:, None] * ball.vertices, ball.triangles)


OTHERS: dict[str, tuple[tuple[int, ...], Callable[..., Any]]] = {
    "polygon": ((2,), lambda box, edges: rough_lake(edges)),
    "periodic": ((2, 3), lambda box, edges: clvoro.Box(box.lower, box.upper, periodic=True)),
    "cube": ((3,), lambda box, edges: clvoro.Solid.box(box.lower, box.upper)),
    "body": ((3,), lambda box, edges: clvoro.Solid.outside(wavy_body(), box)),
}
"""Domains that are compared with a box, and in how many dimensions."""


def compare(
    adapter: clvoro.Adapter, domains: dict[str, Any], n: int, repeat: int, effort: Any, skip: list[str]
) -> dict[str, dict[str, float]]:
    """Return microseconds per cell of each part of the work, and the memory, in each domain."""
    taken: dict[tuple[str, str], list[float]] = {}
    for _ in range(repeat + 1):
        for name, domain in domains.items():
            x, size, made = random_points(domain, n), (domain.measure / n) ** (1 / domain.dim), None
            parts: dict[str, Callable[[Any], Any]] = {
                "diagram": lambda made, domain=domain, x=x: adapter.diagram(domain, x).volumes,
                "run": lambda made, domain=domain, size=size: adapter.run(domain, size, effort),
                "faces": lambda result: (result, result.diagram.faces.area)[0],
                "for solvers": lambda result: result.diagram.solver_mesh().area,
            }
            for part, work in ((part, work) for part, work in parts.items() if part not in skip):
                began = time.process_time()
                made = work(made)
                if part == "run":
                    taken[name, "quality"] = [0.0, float(made.quality.mean())]
                taken.setdefault((name, part), []).append(time.process_time() - began)
            taken.setdefault((name, "memory"), [0.0, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20])
    found: dict[str, dict[str, float]] = {name: {} for name in domains}
    for (name, part), values in taken.items():
        scale = 1 if part in ("memory", "quality") else 1e6 / n / adapter.ctx.devices[0].max_compute_units
        found[name][part] = scale * statistics.median(values[1:])
    return found


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--domains", type=names, default=["polygon", "periodic"], help=", ".join(OTHERS))
    made.add_argument("--sizes", type=counts, default=[10_000, 100_000])
    made.add_argument("--dims", type=counts, default=[2, 3])
    made.add_argument("--edges", type=lambda text: counts(text)[0], default=10_000)
    made.add_argument("--repeat", type=int, default=3)
    made.add_argument("--effort", default="fast")
    made.add_argument("--skip", type=names, default=[], help="as the diagram, whose cures take long in large solids")
    options = made.parse_args()
    adapter, report = make_adapter(options), Report(options.json, COLUMNS)
    for kind in options.domains:
        for dim in (dim for dim in options.dims if dim in OTHERS[kind][0]):
            box = clvoro.Box((0,) * dim, (1,) * dim)
            other = OTHERS[kind][1](box, options.edges)
            for n in options.sizes if dim == 2 else [n // 10 for n in options.sizes]:
                found = compare(adapter, {"box": box, "domain": other}, n, options.repeat, options.effort, options.skip)
                report.add({"kind": kind, "dim": dim, "cells": n, **found}, f"{kind}, {dim}D, {n}")
    report.finish(heading(adapter, "Domains beside boxes, microseconds per cell"))


if __name__ == "__main__":
    main()
