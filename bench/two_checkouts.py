"""What a change costs: runs of two checkouts in alternation.

    python bench/two_checkouts.py OTHER [--repeat N] [--only NAMES] [--json]

OTHER is the folder of another checkout of the project, for instance a git worktree of an earlier commit. Each
repetition starts one process per checkout. It adapts a mesh once to build the kernels, then three times, and reports
the median of the seconds. The table has the median of these over the repetitions for each checkout, and the median of
the ratios of the pairs, with their range.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from _common import Report, spread

HERE = Path(__file__).resolve().parent.parent
RUNS = {
    "2D box": "clvoro.Box((0, 0), (1, 1)), 0.005, {}",
    "2D box, fast": "clvoro.Box((0, 0), (1, 1)), 0.005, {'effort': 'fast'}",
    "2D box, best": "clvoro.Box((0, 0), (1, 1)), 0.01, {'effort': 'best'}",
    "2D box, 600 cells": "clvoro.Box((0, 0), (1, 1)), 0.04, {}",
    "3D box": "clvoro.Box((0, 0, 0), (1, 1, 1)), 0.033, {}",
    "lake with an island": "clvoro.Polygon(SHORE, [ISLAND]), 0.005, {}",
    "comb of eight teeth": "clvoro.Polygon(COMB), 0.006, {}",
    "nine houses": "clvoro.Polygon(SQUARE, HOUSES), 0.009, {}",
}
CHILD = """
import sys, time, warnings
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
domain, size, options = {run}
adapter = clvoro.Adapter()
adapter.run(domain, size, **options)
seconds = []
for seed in range(3):
    begin = time.perf_counter()
    adapter.run(domain, size, seed=seed, **options)
    seconds.append(time.perf_counter() - begin)
print(sorted(seconds)[1])
"""


def seconds_of(checkout: Path, run: str) -> float:
    """Return the median of the seconds of three runs in a new process that imports `checkout`."""
    code = CHILD.format(checkout=str(checkout), run=run)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    if done.returncode:
        raise SystemExit(f"{checkout}: {done.stderr.strip().splitlines()[-1]}")
    return float(done.stdout)


COLUMNS = {
    "run": lambda r: r["run"],
    "other, s": lambda r: f"{statistics.median(r['other']):.3f}",
    "this, s": lambda r: f"{statistics.median(r['this']):.3f}",
    "ratio": lambda r: spread(r["ratios"], ".2f"),
}


def main() -> None:
    """Run the bench."""
    title, _, rest = (__doc__ or "").partition("\n")
    options_of = argparse.ArgumentParser(
        description=title, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options_of.add_argument("other", type=Path)
    options_of.add_argument("--repeat", type=int, default=5, metavar="N")
    options_of.add_argument("--only", default="", metavar="NAMES", help="; ".join(RUNS))
    options_of.add_argument("--json", action="store_true", help="print one JSON object per line")
    options = options_of.parse_args()
    other = options.other.resolve()
    if not (other / "clvoro" / "__init__.py").is_file():
        raise SystemExit(f"{options.other} is not a checkout of clvoro")
    report = Report(options.json, COLUMNS)
    chosen = [n.strip() for n in options.only.split(";")] if options.only else RUNS
    for name in chosen:
        pairs = [
            (seconds_of(other, RUNS[name]), seconds_of(HERE, RUNS[name]))
            for _ in range(options.repeat)
        ]
        theirs, ours = zip(*pairs, strict=True)
        ratios = [b / a for a, b in pairs]
        report.add({"run": name, "other": theirs, "this": ours, "ratios": ratios}, name)
    report.finish(f"Runs of this checkout against {json.dumps(options.other.name)}.")


if __name__ == "__main__":
    main()
