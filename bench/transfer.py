"""Transfer of cell data between meshes: speed, errors of mass and bounds, order.

    python bench/transfer.py [--sizes 1e3,1e4,1e5] [--dims 2,3] [--on sphere|lake|ball] [--random] [--repeat 3]
                             [--device NAME] [--dtype float32] [--json]

Two uniform meshes of about as many cells ("fast" effort from two seeds; --random: random generators) in the unit box,
on the unit sphere, in a lake (see bench/solver_ready.py), or in a ball. The values of f = sin(3 x + 1) cos(2 y)
(1 + z^2) at the centroids of one mesh are transferred to the other and compared there.
"L1 error" is the mean of |error|, "order" its rate in the mesh width from one row to
the next. "1" is the first order, "2" the second with the limiter, "2 free" without it. "mass" is the error of the sum
of V f over the sum of V |f|, "beyond" the distance of new values from the bounds of the old ones. "new cells/s" is
the median of whole calls, with copies to and from the device; "per processor s" counts the least processor time.
"overlap" is the least share of a new cell that old cells overlap; in a ball two meshes have different planes at its
surface.
"""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, parser, shown
from _walled import lake

import clvoro

WAYS: dict[str, dict[str, Any]] = {"1": {"order": 1}, "2": {"order": 2}, "2 free": {"order": 2, "limited": False}}


def smooth(x: np.ndarray) -> np.ndarray:
    """Return the function that is carried."""
    last = 1 + x[:, 2] ** 2 if x.shape[1] == 3 else 1.0
    return np.sin(3 * x[:, 0] + 1) * np.cos(2 * x[:, 1]) * last


DOMAINS = {
    "sphere": lambda: clvoro.Sphere(1.0),
    "lake": lambda: lake().domain,
    "ball": lambda: clvoro.Solid.ball((0, 0, 0), 1.0),
}


def make_mesh(adapter: clvoro.Adapter, domain: Any, n: int, seed: int, random: bool) -> clvoro.Diagram:
    """Return a mesh of a domain, its arrays fetched."""
    rng = np.random.default_rng(seed)
    if random:
        points = domain.nearest(rng.uniform(domain.lower, domain.upper, (n, domain.dim)))
        made = adapter.diagram(domain, points)
    else:
        h = (domain.measure / n) ** (1 / domain.cell_dim)
        made = adapter.run(domain, h, effort="fast", seed=seed).diagram
    for name in ("volumes", "centroids", "neighbors"):
        getattr(made, name)
    return made


def measure(
    old: clvoro.Diagram, new: clvoro.Diagram, adapter: clvoro.Adapter, repeat: int, way: dict[str, Any]
) -> dict[str, float]:
    """Carry the function over `repeat` times."""
    values = smooth(old.centroids)
    seconds, processor = [], []
    for _ in range(repeat):
        start, used = time.perf_counter(), time.process_time()
        carried = old.transfer(values, new, adapter=adapter, **way)
        seconds.append(time.perf_counter() - start)
        processor.append(time.process_time() - used)
    # A part has a domain of its own, so that shares are those of the overlaps.
    part = new.subset(np.arange(len(new)) > 0)
    overlap = old.transfer(values, part, adapter=adapter, covered=True)[1]
    error = np.abs(carried - smooth(new.centroids))
    mass = float(new.volumes @ carried - old.volumes @ values)
    return {
        "cells": len(new),
        "per_second": len(new) / statistics.median(seconds),
        "per_processor": len(new) / min(processor),
        "error": float(new.volumes @ error / new.volumes.sum()),
        "max_error": float(error.max()),
        "mass": abs(mass) / float(old.volumes @ np.abs(values)),
        "overlap": float(overlap.min()),
        "beyond": max(carried.max() - values.max(), values.min() - carried.min(), 0.0),
    }


COLUMNS = {
    "dim": shown("dim", "d"),
    "order asked": lambda r: r["way"],
    "cells": shown("cells", ",d"),
    "new cells/s": shown("per_second", ",.0f"),
    "per processor s": shown("per_processor", ",.0f"),
    "L1 error": shown("error", ".2e"),
    "order": shown("rate", ".2f"),
    "largest error": shown("max_error", ".2e"),
    "mass": shown("mass", ".0e"),
    "beyond": shown("beyond", ".0e"),
    "overlap": shown("overlap", ".6f"),
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--sizes", type=counts, default=counts("1e3,1e4,1e5"), help="cells")
    made.add_argument("--dims", type=counts, default=[2, 3])
    made.add_argument("--on", choices=DOMAINS, help="another domain than the box")
    made.add_argument("--random", action="store_true", help="random generators")
    made.add_argument("--repeat", type=int, default=3)
    options = made.parse_args(arguments)
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for dim in [0] if options.on else options.dims:
        domain = DOMAINS[options.on]() if options.on else clvoro.Box((0,) * dim, (1,) * dim)
        dim = domain.cell_dim
        before: dict[str, tuple[int, float]] = {}
        for n in options.sizes:
            old, new = (make_mesh(adapter, domain, n, FIRST_SEED + k, options.random) for k in range(2))
            for name, way in WAYS.items():
                record: dict[str, Any] = {"dim": dim, "way": name, "rate": None}
                record |= measure(old, new, adapter, options.repeat, way)
                if name in before:
                    cells, error = before[name]
                    width = (len(new) / cells) ** (1 / dim)
                    record["rate"] = math.log(error / record["error"]) / math.log(width)
                before[name] = (len(new), record["error"])
                report.add(record, f"{dim}D, {n} cells, order {name}")
    kind = "random" if options.random else "uniform"
    where = f": {options.on}" if options.on else ""
    report.finish(heading(adapter, f"Transfer between {kind} meshes{where}"))
    worst = max(record["mass"] for record in report.records)
    return 0 if worst <= 1e-12 else 1


if __name__ == "__main__":
    raise SystemExit(main())
