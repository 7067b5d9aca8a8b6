"""Interpolation error on a mesh from the Hessian of a function, against a uniform mesh.

    python bench/interpolation.py [--sizes 1e3,4e3,16e3,64e3] [--steepness 60] [--p 2] [--growth 1.3]
                                  [--h-max 0.2] [--effort fast] [--device NAME] [--dtype float32] [--json]

The function is u = tanh(k d) in the unit square, with the distance d to a circle of radius 0.6 about (0.2, 0.1): a
layer of width 1 / k between two plateaus. Both meshes have exactly N cells. The adapted mesh has the size field
Graded(hessian_size(u, n_cells=N, p, h_max), growth), with u on a raster of 1001 x 1001 values.
The error is that of piecewise linear interpolation on the dual Delaunay triangulation, with the values of u at the
generators, at the centroids of the faces on walls, and in the corners of the square. Triangles are divided into parts
of at most half the layer's width, and three points on each part integrate the error. "factor" is the error of the
uniform mesh over that of the adapted mesh; the target is 5 from 4000 cells on. "order" is the rate at which the error
decreases with N^(-1/2), from one row to the next; linear interpolation can have 2.

The best options (k = 60, N = 4000 and 16000, growth 1.1 to 2, p = 1, 2, 4 and infinity, h_max 0.05 to 0.2):

- always `Graded`: the Hessian is zero in the middle of the layer, and without grading the cells there are large.
  Growth of 1.2 to 1.4 is best (L2 factor 8.8 to 10.6). With 1.1 few cells are left for the layer, with 2 the cells
  are of poor shape;
- p = 2 for both norms. p = 1 gains at most 4 % in L1. p = infinity has the smallest largest error and costs 10 to
  20 % in L1;
- h_max of 0.1 or more. With 0.05, many cells are on the plateaus;
- h_min = 0, unless the raster has noise;
- any effort: the error depends on sizes, and barely on shape.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, names, parser, shown
from scipy.spatial import Delaunay

import clvoro
from clvoro import sizing

BOX = clvoro.Box((0, 0), (1, 1))
RASTER = 1001
WANTED, FROM_CELLS = 5.0, 4000
NODES = ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3))
"""Nodes of a quadrature of degree 2 in the unit triangle."""
BATCH = 2_000_000


def layer(steepness: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return u, of points (..., 2)."""
    return lambda x: np.tanh(steepness * (np.hypot(x[..., 0] - 0.2, x[..., 1] - 0.1) - 0.6))


def parts(count: int) -> np.ndarray:
    """Return barycentric coordinates (q, 3) of the nodes in a triangle's `count`^2 equal parts."""
    i, j = np.mgrid[:count, :count]
    upright, turned = i + j < count, i + j < count - 1
    found = []
    for a, b in NODES:
        found.append(np.column_stack([i[upright] + a, j[upright] + b]))
        found.append(np.column_stack([i[turned] + 1 - a, j[turned] + 1 - b]))
    at = np.concatenate(found) / count
    return np.column_stack([1 - at.sum(axis=1), at])


def interpolation_error(
    diagram: clvoro.Diagram, u: Callable[[np.ndarray], np.ndarray], width: float
) -> dict[str, float]:
    """Return the L1, L2 and largest error of linear interpolation; parts of triangles are at most `width` long."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    on_walls = diagram.face_centroids[diagram.neighbors < 0]
    nodes = np.vstack([diagram.points, on_walls, corners])
    triangles = Delaunay(nodes).simplices
    x, values = nodes[triangles], u(nodes)[triangles]
    longest = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(axis=1)
    count = np.clip(np.ceil(longest / width).astype(int), 3, 64)
    ab, ac = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    area = np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]) / 2
    first = second = largest = 0.0
    for c in np.unique(count):
        chosen, weights = np.flatnonzero(count == c), parts(c)
        for some in np.array_split(chosen, len(chosen) * len(weights) // BATCH + 1):
            there = np.einsum("qb,tbd->tqd", weights, x[some])
            error = np.abs(np.einsum("qb,tb->tq", weights, values[some]) - u(there))
            first += float(area[some] @ error.mean(axis=1))
            second += float(area[some] @ (error**2).mean(axis=1))
            largest = max(largest, float(error.max()))
    return {"l1": first, "l2": math.sqrt(second), "largest": largest}


def adapted_size(u: Callable[[np.ndarray], np.ndarray], n: int, p: float, growth: float, h_max: float) -> sizing.Field:
    """Return the size field by the Hessian of `u`."""
    along = np.linspace(0, 1, RASTER)
    values = u(np.stack(np.meshgrid(along, along), axis=-1))
    size = sizing.hessian_size(values, BOX.lower, BOX.upper, n_cells=n, p=p, h_max=h_max)
    return sizing.Graded(size, growth=growth)


COLUMNS = {
    "mesh": lambda r: r["mesh"],
    "cells": shown("cells", ",d"),
    "least h": shown("least", ".4f"),
    "largest h": shown("most", ".3f"),
    "mean Q": shown("quality", ".3f"),
    "L1 error": shown("l1", ".2e"),
    "order": shown("l1_order", ".2f"),
    "factor": shown("l1_factor", ".1f"),
    "L2 error": shown("l2", ".2e"),
    "order ": shown("l2_order", ".2f"),
    "factor ": shown("l2_factor", ".1f"),
    "largest error": shown("largest", ".1e"),
    "seconds": shown("seconds", ".1f"),
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--sizes", type=counts, default=counts("1e3,4e3,16e3,64e3"), help="cells")
    made.add_argument("--steepness", type=float, default=60.0, help="k")
    made.add_argument("--p", default="2", help="norms, comma-separated; inf too")
    made.add_argument("--growth", type=float, default=1.3)
    made.add_argument("--h-max", type=float, default=0.2)
    made.add_argument("--effort", default="fast", choices=("fast", "default", "best"))
    options = made.parse_args(arguments)
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    u = layer(options.steepness)
    norms = [float(p) for p in names(options.p)]
    before: dict[str, dict[str, Any]] = {}
    enough = True
    for n in options.sizes:
        fields: dict[str, object] = {"uniform": n**-0.5}
        for p in norms:
            fields[f"Hessian, p = {p:g}"] = adapted_size(u, n, p, options.growth, options.h_max)
        uniform: dict[str, Any] = {}
        for name, field in fields.items():
            start = time.perf_counter()
            result = adapter.run(BOX, field, n_cells=n, effort=options.effort, seed=FIRST_SEED)
            record: dict[str, Any] = {
                "mesh": name,
                "cells": len(result.points),
                "seconds": time.perf_counter() - start,
                "least": float(result.target_size.min()),
                "most": float(result.target_size.max()),
                "quality": float(result.quality.mean()),
                **interpolation_error(result.diagram, u, 0.5 / options.steepness),
            }
            uniform = uniform or record
            last = before.get(name)
            for norm in ("l1", "l2"):
                if record is not uniform:
                    record[f"{norm}_factor"] = uniform[norm] / record[norm]
                    enough &= n < FROM_CELLS or record[f"{norm}_factor"] >= WANTED
                if last is not None:
                    finer = math.log(record["cells"] / last["cells"]) / 2
                    record[f"{norm}_order"] = math.log(last[norm] / record[norm]) / finer
            before[name] = record
            report.add(record, f"{n} cells, {name}")
    report.finish(heading(adapter, f"Linear interpolation of tanh({options.steepness:g} d)"))
    return 0 if enough else 1


if __name__ == "__main__":
    raise SystemExit(main())
