"""Time against cells of diagrams, solves and runs, and of other tools, in one picture with slopes.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python bench/scaling.py [--sizes 1e4,1e5,1e6,4e6]
                        [--solid-sizes 1e4,1e5,1e6] [--run-sizes 1e4,1e5,1e6] [--processor-time]
                        [--from FILE] [--out DIR] [--device NAME] [--dtype float32] [--json]

Writes `scaling.png` into `bench/pictures` or `--out`, and prints the slopes. Seconds come from the scripts that measure
each part (`diagram.py`, `poisson.py`, `run.py`), which it calls; `scaling.jsonl` beside the picture holds them, and
`--from` draws them again. A slope is that of the line through the logarithms from 1e5 cells on; below, the
fixed cost of a call is visible. With 1, time is proportional to the number of cells.

The machine should be idle. `--processor-time` helps otherwise, except for runs, which use the clock.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from _common import PICTURES, Report, heading, make_adapter, parser

HERE = Path(__file__).resolve().parent
LARGE = 1e5
"""Least number of cells of the points that determine the slopes."""
OURS = ("diagram", "next diagram", "3D diagram", "Poisson", "fast run", "default run")
PEERS = ("SciPy's Voronoi", "pyamg")


Points = list[tuple[str, float]]
"""Points of a record: the curve of each, and its seconds."""


def of_diagram(record: dict[str, Any]) -> Points:
    """Return the times of a diagram of random generators, or of the next diagram of a finished mesh."""
    if record["start"] == "warm":
        return [("next diagram", record["diagram"])] if record["set"] == "hexagonal" else []
    if record["set"] != "uniform":
        return []
    peer = [("SciPy's Voronoi", record["scipy"])] if "scipy" in record else []
    return [("diagram", record["bins"] + record["diagram"]), *peer]


def of_solid_diagram(record: dict[str, Any]) -> Points:
    cold = record["start"] == "cold"
    return [("3D diagram", record["bins"] + record["diagram"])] if cold else []


def of_solve(record: dict[str, Any]) -> Points:
    name = {"multigrid": "Poisson", "pyamg": "pyamg"}.get(record["method"])
    return [] if name is None else [(name, record["set_up"] + record["solve"])]


def of_run(record: dict[str, Any]) -> Points:
    return [(f"{record['effort']} run", record["seconds"])]


def measure(options: Any) -> list[dict[str, Any]]:
    """Call the scripts; return points of the curves."""
    common = ["--dtype", options.dtype, "--json"]
    if options.device:
        common += ["--device", options.device]
    clock = ["--processor-time"] if options.processor_time else []
    sizes = ["--sizes", options.sizes, *clock]
    solid_sizes = ["--sizes", options.solid_sizes, *clock]
    jobs: tuple[tuple[str, list[str], Callable[[dict[str, Any]], Points]], ...] = (
        ("diagram.py", [*sizes, "--sets", "uniform,hexagonal", "--scipy"], of_diagram),
        ("diagram.py", [*solid_sizes, "--sets", "uniform", "--dim", "3"], of_solid_diagram),
        ("poisson.py", [*sizes, "--jacobi-up-to", "0"], of_solve),
        ("run.py", ["--sizes", options.run_sizes, "--no-profile"], of_run),
    )
    found = []
    for script, arguments, points_of in jobs:
        print(f"{script} {' '.join(arguments)}", file=sys.stderr, flush=True)
        command = [sys.executable, str(HERE / script), *arguments, *common]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        for record in map(json.loads, done.stdout.splitlines()):
            found += [
                {"curve": name, "cells": record["cells"], "seconds": seconds} for name, seconds in points_of(record)
            ]
    return found


def slope_of(points: list[tuple[int, float]]) -> float | None:
    """Return the slope of log time against log cells, of the large ones."""
    large = [(np.log(n), np.log(s)) for n, s in points if n >= 0.9 * LARGE]
    if len(large) < 2:
        return None
    x, y = np.array(large).T
    return float(np.polyfit(x, y, 1)[0])


def draw(curves: dict[str, list[tuple[int, float]]], title: str, path: Path) -> None:
    """Write the picture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(8.4, 5.6), layout="constrained")
    for k, name in enumerate(n for n in (*OURS, *PEERS) if n in curves):
        cells, seconds = np.array(curves[name]).T
        slope = slope_of(curves[name])
        label = name if slope is None else f"{name}, slope {slope:.2f}"
        style = {"ls": "--", "color": f"{0.35 + 0.25 * (name == 'pyamg')}", "marker": "s"}
        ours = {"color": f"C{k}", "marker": "o"}
        ax.loglog(cells, seconds, ms=4, lw=1.6, label=label, **(style if name in PEERS else ours))
    low, high = ax.get_xlim()
    # Below all curves, where nothing crosses its name.
    rate = 0.5 * min(s / n for points in curves.values() for n, s in points)
    x = np.array([low, high])
    ax.loglog(x, rate * x, color="0.85", lw=1, zorder=0)
    ax.annotate(
        "slope 1", (x[1], rate * x[1]), (-4, -26), textcoords="offset points", color="0.6", ha="right", va="top"
    )
    ax.set_xlim(low, high)
    ax.set_xlabel("cells")
    ax.set_ylabel("seconds")
    ax.set_title(fill(title, 90), fontsize=9, loc="left")
    ax.grid(True, which="major", color="0.92")
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    fig.savefig(path, dpi=150)
    plt.close(fig)


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", default="1e4,1e5,1e6,4e6")
    options_of.add_argument("--solid-sizes", default="1e4,1e5,1e6")
    options_of.add_argument("--run-sizes", default="1e4,1e5,1e6")
    options_of.add_argument("--processor-time", action="store_true")
    options_of.add_argument("--from", dest="source", type=Path, metavar="FILE")
    options_of.add_argument("--out", type=Path, default=PICTURES)
    options = options_of.parse_args()

    title = heading(make_adapter(options), "Time against cells")
    options.out.mkdir(parents=True, exist_ok=True)
    if options.source is None:
        found = measure(options)
        lines = [json.dumps(point) for point in found]
        (options.out / "scaling.jsonl").write_text("\n".join(lines) + "\n")
    else:
        found = [json.loads(line) for line in options.source.read_text().splitlines()]
    curves: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for point in found:
        curves[point["curve"]].append((point["cells"], point["seconds"]))

    report = Report(
        options.json,
        {
            "curve": lambda r: r["curve"],
            "from": lambda r: f"{r['cells'][0]:,}",
            "to": lambda r: f"{r['cells'][-1]:,}",
            "seconds at the largest": lambda r: f"{r['seconds'][-1]:.3g}",
            "us per cell there": lambda r: f"{1e6 * r['seconds'][-1] / r['cells'][-1]:.3g}",
            "slope": lambda r: "" if r["slope"] is None else f"{r['slope']:.2f}",
        },
    )
    for name in (*OURS, *PEERS):
        if name in curves:
            cells, seconds = zip(*sorted(curves[name]), strict=True)
            report.add({"curve": name, "cells": cells, "seconds": seconds, "slope": slope_of(curves[name])})
    draw(curves, title, options.out / "scaling.png")
    report.finish(title)


if __name__ == "__main__":
    main()
