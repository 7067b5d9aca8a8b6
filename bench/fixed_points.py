"""Cells of fixed generators, the cells beside them, and all others: sizes, shapes, distances of the centroids.

    python bench/fixed_points.py [--runs 3] [--kinds box,wells,...] [--efforts default] [--methods adaptive,exact]
                                 [--near] [--device NAME] [--dtype float32] [--json]

Random generators at least one cell from each other and half a cell from walls stay where they are; those of "wells"
are in the middle of the finest cells. Figures are over all runs: means, the largest |e| and the least Q. "off" is the
distance of the centroid from the generator over h, the largest one in brackets. With `--near` one generator is near a
wall of a box with equal sizes, or two are near each other, at distances of 0.01 to 1 h.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from _common import FIRST_SEED, SHAPE_COLUMNS, Report, heading, make_adapter, names, parser

import clvoro
from clvoro import sizing

COUNT = 40
BASIN = clvoro.Polygon(
    [(0, 0), (900, -150), (1800, 50), (2700, -100), (3500, 100), (3600, 1500), (2400, 2300), (600, 2100), (-200, 900)]
)
WELLS = np.array([(900, 500), (1400, 700), (1900, 500), (2400, 700)])
KINDS: dict[str, tuple[clvoro.Box | clvoro.Polygon, Any]] = {
    "box": (clvoro.Box((0, 0), (1, 1)), sizing.Expression("0.008 + 0.02 * x")),
    "periodic": (
        clvoro.Box((0, 0), (1, 1), (True, True)),
        sizing.Expression("0.012 + 0.006 * sin(2 * pi * x) * sin(2 * pi * y)"),
    ),
    "polygon": (BASIN, sizing.Expression("30 + 0.01 * fmax(x, 0.0)")),
    "wells": (
        BASIN,
        sizing.minimum(*(sizing.Distance(sizing.Circle(w, 1), h_min=6, growth=1.15, h_max=120) for w in WELLS)),
    ),
    "3D": (clvoro.Box((0, 0, 0), (1, 1, 1)), sizing.Expression("0.05 + 0.03 * x")),
}
DISTANCES = (0.01, 0.1, 0.2, 0.4, 0.7, 1.0)
COLUMNS = {
    "case": lambda r: r["case"],
    "cells": lambda r: f"{r['cells']:,}",
    "of them": lambda r: r["part"],
    **SHAPE_COLUMNS,
    "off": lambda r: f"{r['mean_off']:.3f} ({r['max_off']:.2f})",
}


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--runs", type=int, default=3)
    options_of.add_argument("--kinds", type=names, default=list(KINDS))
    options_of.add_argument("--efforts", type=names, default=["default"])
    options_of.add_argument("--methods", type=names, default=["adaptive", "exact"])
    options_of.add_argument("--near", action="store_true")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    seeds = range(FIRST_SEED, FIRST_SEED + options.runs)
    if options.near:
        warnings.simplefilter("ignore", clvoro.errors.MismatchWarning)
        for case, domain, fixed, h in near_cases():
            along = h * np.eye(domain.dim)[0]
            meshes = [adapter.run(domain, h, fixed=fixed + 0.4 * k * along, seed=s) for k, s in enumerate(seeds)]
            add(report, case, meshes, "fixed", "beside")
        report.finish(heading(adapter, "Generators near a wall or near each other"))
        return 0
    for kind in options.kinds:
        domain, size = KINDS[kind]
        fixed = WELLS if kind == "wells" else spread(domain, size)
        for method in options.methods:
            for effort in options.efforts:
                run = {"method": method, "effort": effort}
                case = f"{kind}, {method}, {effort}"
                free = [adapter.run(domain, size, seed=s, **run) for s in seeds]
                add(report, f"{case}, none fixed", free, "others")
                held = [adapter.run(domain, size, fixed=fixed, seed=s, **run) for s in seeds]
                add(report, case, held, "fixed", "beside", "others")
    report.finish(heading(adapter, "Fixed generators"))
    return 0


def spread(domain: clvoro.Box | clvoro.Polygon, size: Any) -> np.ndarray:
    """Return `COUNT` random positions that are a cell from each other and half a cell from walls."""
    rng, found = np.random.default_rng(7), np.empty((0, domain.dim))
    around = np.random.default_rng(8).normal(size=(100, domain.dim))
    around /= 2 * np.linalg.norm(around, axis=1, keepdims=True)
    while len(found) < COUNT:
        x = np.array(domain.lower) + domain.extent * rng.random((1, domain.dim))
        if domain.contains(x)[0]:
            h = float(size(x)[0])
            apart = (np.linalg.norm(found - x, axis=1) > h).all()
            if apart and domain.contains(x + h * around).all():
                found = np.concatenate([found, x])
    return found


def near_cases() -> Iterator[tuple[str, clvoro.Box, np.ndarray, float]]:
    """Yield name, domain, positions and size. The positions may be shifted along the first axis."""
    for dim, h in ((2, 0.03), (3, 0.09)):
        box, middle = clvoro.Box((0,) * dim, (1,) * dim), np.full((1, dim), 0.5)
        up = np.eye(dim)[1] * h
        for share in DISTANCES:
            at_wall = middle * (np.arange(dim) != 1) + share * up
            yield f"{dim}D, {share:g} h from a wall", box, at_wall, h
        for share in DISTANCES:
            pair = np.concatenate([middle, middle + share * up])
            yield f"{dim}D, {share:g} h from each other", box, pair, h


def add(report: Report, case: str, meshes: list[clvoro.Result], *parts: str) -> None:
    """Add the figures of `parts` of the cells of `meshes` to the report: one record for each."""
    for part in parts:
        found = []
        for mesh in meshes:
            d, k, index = mesh.diagram, mesh.settings["fixed"], np.arange(len(mesh))
            beside = np.isin(index, d.neighbors[: d.neighbor_starts[k]]) & (index >= k)
            of = {"fixed": index < k, "beside": beside, "others": ~beside & (index >= k)}[part]
            off = np.linalg.norm(d.centroids - d.points, axis=1) / mesh.target_size
            found.append(np.column_stack([np.abs(mesh.size_error), mesh.quality, off])[of])
        e, q, off = np.concatenate(found).T
        record = {"case": case, "part": part, "cells": len(meshes[0]), "min_quality": q.min()}
        record |= {f"mean_{name}": x.mean() for name, x in (("error", e), ("quality", q), ("off", off))}
        report.add({**record, "max_error": e.max(), "max_off": off.max()}, f"{case}: {part}")


if __name__ == "__main__":
    sys.exit(main())
