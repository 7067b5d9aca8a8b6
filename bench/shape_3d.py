"""What bounds the quality of cells in 3D: lattices, their strain, grains, the growth of h, and walls.

    python bench/shape_3d.py [--parts lattices,strain,grains,growth] [--cells 16000]
                             [--efforts default,best] [--device NAME] [--dtype float32] [--json]

*lattices*  cells of perfect lattices: mean Q, and the spread of their sizes about their mean
*strain*    cells of the body-centered lattice stretched along one axis, at constant volume
*grains*    a constant size: from the lattice, from grains of the lattice with random orientations, and at random
*growth*    h = h0 + slope (x - 1/2): from the lattice, mapped along x to the density h^-3, and at random

The quality is 36 pi V^2 / S^3.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from _common import CUBE, FIRST_SEED, SHAPE_COLUMNS, Report, figures, heading, make_adapter, names, parser
from scipy.spatial import ConvexHull, KDTree, Voronoi
from scipy.spatial.transform import Rotation

import clvoro
from clvoro import sizing

PARTS = ("lattices", "strain", "grains", "growth")
BCC = np.array([[0, 0, 0], [2, 2, 2]]) / 4
FCC = np.array([[0, 0, 0], [2, 2, 0], [2, 0, 2], [0, 2, 2]]) / 4
A15 = np.array([[0, 0, 0], [2, 2, 2], [1, 2, 0], [3, 2, 0], [0, 1, 2], [0, 3, 2], [2, 0, 1], [2, 0, 3]]) / 4
STRAINS = (0.02, 0.05, 0.1, 0.2)
GRAINS = (8, 32, 128)
SLOPES = (0.01, 0.02, 0.05)
MARGIN, NEAREST = 0.3, 0.65
"""Least distances over h of generators of grains from walls, and from those of another grain."""
LEVELS = clvoro.MultilevelOptions(levels=0)


def lattice_cells(sites: np.ndarray, stretch: np.ndarray) -> np.ndarray:
    """Return quality and volume (k, 2) of the cells of `sites` (k, 3) of a cubic lattice, stretched by a matrix."""
    line = np.arange(-2, 3)
    cubes = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    points = (cubes[None] + sites[:, None]).reshape(-1, 3) @ stretch.T
    diagram = Voronoi(points)
    rows = []
    for k in range(len(sites)):
        place = k * len(cubes) + len(cubes) // 2
        hull = ConvexHull(diagram.vertices[diagram.regions[diagram.point_region[place]]])
        rows.append((36 * np.pi * hull.volume**2 / hull.area**3, hull.volume))
    return np.array(rows)


def of_lattice(sites: np.ndarray, stretch: np.ndarray) -> dict[str, float]:
    quality, volume = lattice_cells(sites, stretch).T
    error = np.abs(np.cbrt(volume / volume.mean()) - 1)
    return {
        "mean_error": error.mean(),
        "max_error": error.max(),
        "mean_quality": quality.mean(),
        "min_quality": quality.min(),
    }


def relaxed_seeds(count: int, seed: int) -> np.ndarray:
    """Return `count` points in the unit cube after Lloyd's steps with samples, and the samples' generator."""
    random = np.random.default_rng(seed)
    seeds = random.random((count, 3))
    for _ in range(20):
        samples = random.random((20000, 3))
        owners = KDTree(seeds).query(samples)[1]
        seeds = np.array([samples[owners == k].mean(axis=0) for k in range(count)])
    return seeds


def fill(seeds: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Return the generators of grains around `seeds`: the lattice with cells of volume size^3, turned at random."""
    random, tree, most = np.random.default_rng(seed), KDTree(seeds), int(1.8 / size / 1.25) + 1
    line = np.arange(-most, most + 1)
    cubes = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    lattice = size * np.concatenate([cubes, cubes + 0.5]) * 2 ** (1 / 3)
    parts = []
    for k, center in enumerate(seeds):
        x = center + lattice @ Rotation.from_quat(random.normal(size=4)).as_matrix()
        x = x[((x > MARGIN * size) & (x < 1 - MARGIN * size)).all(axis=1)]
        parts.append(x[tree.query(x)[1] == k])
    points, grain = np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(p) for p in parts])
    kept = np.ones(len(points), bool)
    for i, j in KDTree(points).query_pairs(NEAREST * size):
        if grain[i] != grain[j] and kept[i] and kept[j]:
            kept[j] = False
    return points[kept]


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


def starts(part: str, n: int) -> list[tuple[str, str, Any, dict[str, Any]]]:
    """Return the runs of a part: name, start, size field, arguments."""
    side = round((n / 2) ** (1 / 3))
    lattice, size = body_centered(side), (2 * side**3) ** (-1 / 3)
    at_random = {"seed": FIRST_SEED}
    if part == "grains":
        field = sizing.Constant(size)
        runs = [("constant", "lattice", field, {"points": lattice, "options": LEVELS})]
        for count in GRAINS:
            points = fill(relaxed_seeds(count, FIRST_SEED), size, FIRST_SEED)
            runs.append(("constant", f"{count} grains", field, {"points": points, "options": LEVELS}))
        return [*runs, ("constant", "random", field, {**at_random, "options": LEVELS})]
    runs = []
    for slope in SLOPES:
        field, name = sizing.Expression(f"{size} + {slope} * (x - 0.5)"), f"slope {slope}"
        points = mapped_along_x(lattice, size, slope)
        runs.append((name, "lattice", field, {"points": points, "options": LEVELS}))
        runs.append((name, "random", field, {**at_random, "options": LEVELS}))
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
            report.add({"part": "lattices", "case": name, **none, **of_lattice(sites, np.eye(3))})
    if "strain" in options.parts:
        for strain in STRAINS:
            stretch = np.diag(np.exp(strain * np.array([2, -1, -1]) / 3))
            made = of_lattice(BCC, stretch)
            report.add({"part": "strain", "case": f"{strain:g}", **none, **made})
    adapter = make_adapter(options)
    for part in PARTS[2:]:
        if part not in options.parts:
            continue
        for case, start, field, given in starts(part, options.cells):
            for effort in options.efforts:
                began = time.process_time()
                result = adapter.run(CUBE, field, effort=effort, **given)
                made = figures(result.diagram, result.target_size, result.quality)
                made["seconds"] = time.process_time() - began
                report.add(
                    {"part": part, "case": case, "start": start, "effort": effort, **made},
                    f"{part} {case} {start} {effort}",
                )
    report.finish(heading(adapter, "Bounds of the quality in 3D (seconds of processor time)"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
