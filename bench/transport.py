"""Prescribed volumes in power diagrams: steps of Newton's method, and time.

    python bench/transport.py [--sizes 1e3,1e4] [--domains square,cube,lake,torus,torus in 3D,sphere]
                              [--repeat N] [--processor-time]
                              [--picture] [--out DIR] [--device NAME] [--dtype float32] [--json]

Uniform random generators in a unit box with walls, in periodic ones ("torus", in 3D with a tenth of the cells), in a
lake of 400 edges with an island (see bench/solver_ready.py), and random ones on a sphere of radius 0.5 around 0, get
cells of equal volume, and of volumes in proportion to 0.02 + |x - c|^2, c = (0.5, 0.5) (in the box in 2D 1 : 26).
"outside" is the share of the cells that do not contain their generator, "shares" the shares of the damped Newton
steps. Seconds are the least of the repeated solves, with generators
sorted and arrays read back. `--processor-time` measures the processor time of all threads over the number of compute
units, for a machine with other work. `--picture` writes `transport.png` instead, into `bench/pictures` or `--out`:
Voronoi cells and power cells of equal area of the same generators.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from _common import PICTURES, Report, best, clock_of, counts, heading, make_adapter, names, parser, random_points, shown
from _walled import lake

import clvoro

SEED = 7411
LINE = "#D55E00"


def graded(points: np.ndarray) -> np.ndarray:
    """Return volumes that grow from the middle of the box."""
    return 0.02 + ((points - 0.5) ** 2).sum(axis=1)


def equal(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points))


VOLUMES = {"equal": equal, "graded": graded}
DOMAINS = {
    "square": lambda: clvoro.Box((0, 0), (1, 1)),
    "cube": lambda: clvoro.Box((0, 0, 0), (1, 1, 1)),
    "lake": lambda: lake().domain,
    "torus": lambda: clvoro.Box((0, 0), (1, 1), periodic=True),
    "torus in 3D": lambda: clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True),
    "sphere": lambda: clvoro.Sphere(0.5),
}
COLUMNS = {
    "domain": shown("domain", ""),
    "cells": shown("cells", ",d"),
    "volumes": shown("volumes", ""),
    "steps": shown("steps", "d"),
    "shares below 1": shown("damped", ""),
    "relative error": shown("error", ".1e"),
    "outside": shown("outside", ".3f"),
    "s": shown("seconds", ".2f"),
}


def draw(adapter: clvoro.Adapter, folder: Path) -> None:
    """Draw the Voronoi cells of random generators beside their power cells of equal area."""
    import matplotlib.pyplot as plt

    box, n = clvoro.Box((0, 0), (1, 1)), 400
    points = np.random.default_rng(SEED).random((n, 2))
    equal_cells = adapter.transport(box, points, np.full(n, 1 / n)).diagram
    panels = {"Voronoi cells": adapter.diagram(box, points), "power cells of equal area": equal_cells}
    figure, axes = plt.subplots(1, 2, figsize=(10, 5), layout="constrained")
    for ax, (title, diagram) in zip(axes, panels.items(), strict=True):
        diagram.plot(diagram.volumes * n, ax=ax, limits=(-0.5, 2.2), key=False, title=title, label="area over mean")
        ways = np.stack([points, diagram.centroids])
        ax.plot(ways[..., 0], ways[..., 1], "-", color=LINE, linewidth=1)
        ax.plot(*points.T, ".", color=LINE, markersize=4)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "transport.png", dpi=110)
    print(f"wrote {folder / 'transport.png'}")


def main(arguments: list[str] | None = None) -> None:
    made = parser(__doc__)
    made.add_argument("--sizes", type=counts, default=counts("1e3,1e4"), metavar="N,...")
    made.add_argument("--domains", type=names, default=list(DOMAINS), metavar="NAMES")
    made.add_argument("--repeat", type=int, default=3, metavar="N")
    made.add_argument("--picture", action="store_true", help="draw a picture instead")
    made.add_argument("--out", type=Path, default=PICTURES, metavar="DIR")
    made.add_argument("--processor-time", action="store_true", help="not the wall clock")
    options = made.parse_args(arguments)
    adapter = make_adapter(options)
    if options.picture:
        draw(adapter, options.out)
        return
    report, clock = Report(options.json, COLUMNS), clock_of(options, adapter)
    for name in options.domains:
        domain = DOMAINS[name]()
        for n in options.sizes if name != "torus in 3D" else [n // 10 for n in options.sizes]:
            points = random_points(domain, n)
            for kind, volumes_at in VOLUMES.items():
                volumes = volumes_at(points)
                volumes *= domain.measure / volumes.sum()
                adapter.transport(domain, points, volumes, max_steps=1)  # builds the kernels
                seconds, found = best(
                    options.repeat, lambda d=domain, p=points, v=volumes: adapter.transport(d, p, v), clock
                )
                inside = found.diagram.locate(points) == np.arange(n)
                damped = ", ".join(f"{s:g}" for s in found.shares[found.shares < 1])
                record = {
                    "domain": name,
                    "cells": n,
                    "volumes": kind,
                    "steps": len(found.shares),
                    "damped": damped or "-",
                    "error": float(found.errors[-1]),
                    "outside": float(1 - inside.mean()),
                    "seconds": seconds,
                }
                report.add(record, f"{name}, {n} cells, {kind}")
    report.finish(heading(adapter, "Prescribed volumes"))


if __name__ == "__main__":
    main()
