"""What a change costs: runs of two checkouts in alternation.

    python bench/two_checkouts.py OTHER [--repeat N] [--runs N] [--only NAMES] [--json]

OTHER is the folder of another checkout of the project, for instance a git worktree of an earlier commit. Each
repetition starts one process per checkout. It adapts a mesh once to build the kernels, then `--runs` times, and reports
the median of the seconds: processor time of all threads, without that of the system. The load of the machine hardly
changes it. "host" is the processor time of the thread that calls clvoro: on PoCL, kernels run in other threads. The
table has the median of these over the repetitions for each checkout, and the median of the ratios of
the pairs, with their range. S2 and S3 are fields of `convergence.py`. S3 takes minutes: name it to run it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from _common import Report, spread

HERE = Path(__file__).resolve().parent.parent
GRADED = {
    "{}": "{}",
    "{}, fast": "{'effort': 'fast'}",
    "{}, best": "{'effort': 'best'}",
    "{}, exact": "{'method': 'exact'}",
}
RUNS = {
    "2D box": "clvoro.Box((0, 0), (1, 1)), 0.005, {}",
    "2D box, fast": "clvoro.Box((0, 0), (1, 1)), 0.005, {'effort': 'fast'}",
    "2D box, best": "clvoro.Box((0, 0), (1, 1)), 0.01, {'effort': 'best'}",
    "2D box, 600 cells": "clvoro.Box((0, 0), (1, 1)), 0.04, {}",
    "3D box": "clvoro.Box((0, 0, 0), (1, 1, 1)), 0.033, {}",
    "3D periodic": "clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), 0.033, {}",
    **{name.format("S2"): f"CUBE, graded(2), {options}" for name, options in GRADED.items()},
    "lake with an island": "clvoro.Polygon(SHORE, [ISLAND]), 0.005, {}",
    "comb of eight teeth": "clvoro.Polygon(COMB), 0.006, {}",
    "nine houses": "clvoro.Polygon(SQUARE, HOUSES), 0.009, {}",
}
LARGE = {name.format("S3"): f"CUBE, graded(4), {options}" for name, options in GRADED.items()}
"""Runs that are not measured unless they are named."""
CHILD = """
import resource, sys, time, warnings
sys.path.insert(0, {checkout!r})
warnings.simplefilter("ignore")
import numpy as np
import clvoro
assert clvoro.__file__.startswith({checkout!r}), clvoro.__file__
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
t = np.arange(400) * np.pi / 200
r = 0.4 + 0.08 * np.sin(5 * t)
SHORE, ISLAND = np.column_stack([r * np.cos(t), r * np.sin(t)]), [(-0.08, -0.05), (0.1, -0.08), (0.02, 0.1)]
cuts = [((k + 0.5 + s / 4) / 8, y) for k in range(7, -1, -1) for s, y in ((1, 1), (1, 0.3), (-1, 0.3), (-1, 1))]
COMB = [(0, 0), (1, 0), (1, 1), *cuts, (0, 1)]
house = np.array([(-0.1, -0.1), (0.1, -0.1), (0.1, 0), (0, 0), (0, 0.1), (-0.1, 0.1)])
HOUSES = [house + (0.2 + 0.3 * i, 0.2 + 0.3 * j) for i in range(3) for j in range(3)]
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
def graded(factor):
    ball = getattr(clvoro.sizing, "Ball", None) or clvoro.sizing.Sphere  # its name before
    return clvoro.sizing.Distance(ball((0.5, 0.5, 0.4), 0.25), h_min=0.04, slope=0.3) * (1 / factor)
def clock():
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime
domain, size, options = {run}
adapter = clvoro.Adapter()
adapter.run(domain, size * {coarser}, **options)
seconds, host = [], []
for seed in range({runs}):
    begin, there = clock(), time.thread_time()
    adapter.run(domain, size, seed=seed, **options)
    seconds.append(clock() - begin)
    host.append(time.thread_time() - there)
print(*seconds)
print(*host)
"""


def seconds_of(checkout: Path, name: str, runs: int) -> tuple[float, ...]:
    """Return medians of the processor seconds of `runs` runs in a new process that imports `checkout`.

    They are those of all threads, and of the host.
    """
    coarser = 2 if name in LARGE else 1
    code = CHILD.format(checkout=str(checkout), run={**RUNS, **LARGE}[name], runs=runs, coarser=coarser)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"{checkout}: {done.stderr.strip().splitlines()[-1]}")
    return tuple(statistics.median(map(float, line.split())) for line in done.stdout.strip().splitlines())


COLUMNS = {
    "run": lambda r: r["run"],
    "other, s": lambda r: f"{statistics.median(r['other']):.3f}",
    "this, s": lambda r: f"{statistics.median(r['this']):.3f}",
    "ratio": lambda r: spread(r["ratios"], ".2f"),
    "host, other, s": lambda r: f"{statistics.median(r['host_other']):.3f}",
    "host, this, s": lambda r: f"{statistics.median(r['host_this']):.3f}",
    "host, ratio": lambda r: spread(r["host_ratios"], ".2f"),
}


def main() -> None:
    title, _, rest = (__doc__ or "").partition("\n")
    options_of = argparse.ArgumentParser(
        description=title, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options_of.add_argument("other", type=Path)
    options_of.add_argument("--repeat", type=int, default=5, metavar="N")
    options_of.add_argument("--runs", type=int, default=3, metavar="N")
    options_of.add_argument("--only", default="", metavar="NAMES", help="; ".join([*RUNS, *LARGE]))
    options_of.add_argument("--json", action="store_true", help="print one JSON object per line")
    options = options_of.parse_args()
    other = options.other.resolve()
    if not (other / "clvoro" / "__init__.py").is_file():
        raise SystemExit(f"{options.other} is not a checkout of clvoro")
    report = Report(options.json, COLUMNS)
    chosen = [n.strip() for n in options.only.split(";")] if options.only else list(RUNS)
    if unknown := sorted(set(chosen) - {*RUNS, *LARGE}):
        options_of.error(f"no run {', '.join(unknown)}; there are {'; '.join([*RUNS, *LARGE])}")
    for name in chosen:
        pairs = [
            (seconds_of(other, name, options.runs), seconds_of(HERE, name, options.runs)) for _ in range(options.repeat)
        ]
        record: dict[str, Any] = {"run": name}
        for k, prefix in enumerate(("", "host_")):
            theirs, ours = [a[k] for a, _ in pairs], [b[k] for _, b in pairs]
            ratios = [b / a for a, b in zip(theirs, ours, strict=True)]
            record |= {f"{prefix}other": theirs, f"{prefix}this": ours, f"{prefix}ratios": ratios}
        report.add(record, name)
    report.finish(f"Runs of this checkout against {json.dumps(options.other.name)}, in processor seconds.")


if __name__ == "__main__":
    main()
