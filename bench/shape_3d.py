"""What bounds the quality of cells in 3D: lattices, the start, the growth of h, and walls.

    python bench/shape_3d.py [--parts lattices,growth] [--cells 16000]
                             [--efforts default,best] [--device NAME] [--dtype float32] [--json]

*lattices*  cells of perfect lattices: mean Q, and the spread of their sizes about their mean
*growth*    h = h0 + slope (x - 1/2): from the lattice, mapped along x to the density h^-3, and at random

The quality is 36 pi V^2 / S^3.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from _common import CUBE, FIRST_SEED, SHAPE_COLUMNS, Report, figures, heading, make_adapter, names, parser
from scipy.spatial import ConvexHull, Voronoi

import clvoro
from clvoro import sizing

PARTS = ("lattices", "growth")
BCC = np.array([[0, 0, 0], [2, 2, 2]]) / 4
FCC = np.array([[0, 0, 0], [2, 2, 0], [2, 0, 2], [0, 2, 2]]) / 4
A15 = np.array([[0, 0, 0], [2, 2, 2], [1, 2, 0], [3, 2, 0], [0, 1, 2], [0, 3, 2], [2, 0, 1], [2, 0, 3]]) / 4
SLOPES = (0.0, 0.02, 0.05)
LEVELS = clvoro.MultilevelOptions(levels=0)


def of_lattice(sites: np.ndarray) -> dict[str, float]:
    """Return the figures of the cells of `sites` (k, 3) of a cubic lattice."""
    line = np.arange(-2, 3)
    cubes = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    points = (cubes[None] + sites[:, None]).reshape(-1, 3)
    diagram = Voronoi(points)
    rows = []
    for k in range(len(sites)):
        place = k * len(cubes) + len(cubes) // 2
        hull = ConvexHull(diagram.vertices[diagram.regions[diagram.point_region[place]]])
        rows.append((36 * np.pi * hull.volume**2 / hull.area**3, hull.volume))
    quality, volume = np.array(rows).T
    error = np.abs(np.cbrt(volume / volume.mean()) - 1)
    return {
        "mean_error": error.mean(),
        "max_error": error.max(),
        "mean_quality": quality.mean(),
        "min_quality": quality.min(),
    }


def body_centered(m: int) -> np.ndarray:
    """Return the lattice of `m` cubes along each side of the unit cube, (2 m^3, 3)."""
    line = np.arange(m)
    corners = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([corners + 0.25, corners + 0.75]) / m


def mapped_along_x(points: np.ndarray, size: float, slope: float) -> np.ndarray:
    """Return `points` with x mapped so that their density is proportional to (size + slope (x - 1/2))^-3."""
    x = np.linspace(0, 1, 2001)
    density = (size + slope * (x - 0.5)) ** -3
    share = np.concatenate([[0], np.cumsum(density[1:] + density[:-1])])
    return np.column_stack([np.interp(points[:, 0], share / share[-1], x), points[:, 1:]])


def starts(n: int) -> list[tuple[str, str, Any, dict[str, Any]]]:
    """Return runs with growing sizes: name, start, size field, arguments."""
    side = round((n / 2) ** (1 / 3))
    lattice, size = body_centered(side), (2 * side**3) ** (-1 / 3)
    runs = []
    for slope in SLOPES:
        field, name = sizing.Expression(f"{size} + {slope} * (x - 0.5)"), f"slope {slope}"
        points = mapped_along_x(lattice, size, slope)
        runs.append((name, "lattice", field, {"points": points, "options": LEVELS}))
        runs.append((name, "random", field, {"seed": FIRST_SEED, "options": LEVELS}))
    return runs


COLUMNS = {
    "part": lambda r: r["part"],
    "case": lambda r: r["case"],
    "start": lambda r: r["start"],
    "effort": lambda r: r["effort"],
    "cells": lambda r: r.get("cells", ""),
    **SHAPE_COLUMNS,
    "all Q": lambda r: f"{r['mean_quality_all']:.4f} / {r['min_quality_all']:.3f}" if "mean_quality_all" in r else "",
    "seconds": lambda r: f"{r['seconds']:.1f}" if "seconds" in r else "",
}


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--parts", type=names, default=list(PARTS), help=", ".join(PARTS))
    options_of.add_argument("--cells", type=int, default=16000, help="of grains and growth")
    options_of.add_argument("--efforts", type=names, default=["default", "best"])
    options = options_of.parse_args()
    if unknown := sorted(set(options.parts) - set(PARTS)):
        options_of.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    report = Report(options.json, COLUMNS)
    none = {"start": "", "effort": ""}
    if "lattices" in options.parts:
        for name, sites in (("body-centered", BCC), ("face-centered", FCC), ("A15", A15)):
            report.add({"part": "lattices", "case": name, **none, **of_lattice(sites)})
    adapter = make_adapter(options)
    for case, start, field, given in starts(options.cells) if "growth" in options.parts else ():
        for effort in options.efforts:
            began = time.process_time()
            result = adapter.run(CUBE, field, effort=effort, **given)
            made = figures(result.diagram, result.target_size, result.quality)
            made["seconds"] = time.process_time() - began
            record = {"part": "growth", "case": case, "start": start, "effort": effort, **made}
            report.add(record, f"{case} {start} {effort}")
    report.finish(heading(adapter, "Bounds of the quality in 3D (seconds of processor time)"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
