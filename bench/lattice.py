"""A constant size in 3D, from a random start and from a body-centered cubic lattice, coarse to fine.

    python bench/lattice.py [--cubes 10] [--levels 1] [--efforts default] [--device NAME]
                            [--dtype float32] [--json]

The cells of the lattice are truncated octahedra with the quotient 36 pi V^2 / S^3 = .7534 and 14 faces. No random
start reaches it. Refinement by midpoints keeps the lattice, except in the layers at walls and where generators are
deleted afterwards to meet the count. The coarsest lattice has `--cubes` cubes along each side of the unit cube and is
refined `--levels` times. The other starts have as many cells as the finest level. Quality and faces are those of cells
away from the walls; "all Q" is that of all cells.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from _common import CUBE, FIRST_SEED, Report, figures, heading, make_adapter, names, parser

import clvoro


def body_centered(m: int) -> np.ndarray:
    """Return the lattice of `m` cubes along each side of the unit cube, (2 m^3, 3)."""
    line = np.arange(m)
    corners = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([corners + 0.25, corners + 0.75]) / m


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--cubes", type=int, default=10)
    options_of.add_argument("--levels", type=int, default=1)
    options_of.add_argument("--efforts", type=names, default=["default"])
    options = options_of.parse_args()
    adapter = make_adapter(options)
    columns = {
        "start": lambda r: r["start"],
        "effort": lambda r: r["effort"],
        "cells": lambda r: r["cells"],
        "mean Q": lambda r: f"{r['mean_quality']:.4f}",
        "min Q": lambda r: f"{r['min_quality']:.3f}",
        "faces": lambda r: f"{r['faces']:.2f}",
        "all Q": lambda r: f"{r['mean_quality_all']:.4f} / {r['min_quality_all']:.3f}",
        "mean |e|": lambda r: f"{r['mean_error']:.5f}",
        "seconds": lambda r: f"{r['seconds']:.1f}",
    }
    report = Report(options.json, columns)
    fine = 2 * (options.cubes * 2**options.levels) ** 3
    for effort in options.efforts:
        starts = {
            "lattice": {
                "points": body_centered(options.cubes * 2**options.levels),
                "options": clvoro.MultilevelOptions(levels=0),
            },
            "coarse lattice": {
                "points": body_centered(options.cubes),
                "options": clvoro.MultilevelOptions(levels=options.levels),
            },
            "random": {"n_cells": fine, "seed": FIRST_SEED},
        }
        for start, given in starts.items():
            began = time.perf_counter()
            result = adapter.run(CUBE, fine ** (-1 / 3), effort=effort, **given)
            seconds = time.perf_counter() - began
            made = figures(result.diagram, result.target_size, result.quality)
            report.add({"start": start, "effort": effort, "seconds": seconds, **made}, start)
    report.finish(heading(adapter, "Constant size in 3D"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
