"""Order of the two-point scheme for Poisson's equation on graded meshes with walls.

    python bench/poisson_order.py [--only NAMES] [--levels 4] [--effort default] [--walls straight,exact]
                                  [--conditions Dirichlet,mixed] [--source mean,generator] [--place foot,center]
                                  [--device NAME] [--json]

-div grad u = f is solved with a smooth known u, on meshes of size h, h / 2, h / 4, ... The flux through a face is area
over distance of the generators times the difference of the unknowns, which stand for u at the generators. "Dirichlet":
u is given on all walls; "mixed": on the first boundary of the domain, and on the others its normal derivative.
Variants: f is taken at the centroid of the cell (its mean to second order) or at the generator; on walls u is given at
the foot of the generator on the plane of the face, or at the center of the face.

Errors at the generators: the largest, the largest of the cells on walls, the largest over the square of
the target size, and in L2. Orders are the slopes of the straight lines through all levels so far.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from _common import Report, heading, make_adapter, names, parser

import clvoro
from clvoro import sizing
from clvoro.mesh.faces import Faces

WAVE = np.array([2.0, 1.3, 1.7])
"""Frequencies w of u = prod_k sin(w_k x_k + k / 2) + exp(x_0 / 2)."""


class Problem(NamedTuple):
    """What to mesh: domain, and size field of the coarsest level."""

    domain: Any
    size: Any


def _ring(k: int, radius: float, center: tuple[float, float]) -> np.ndarray:
    angle = np.arange(k) * (2 * np.pi / k)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)]) + center


def box() -> Problem:
    """Return a box."""
    size = sizing.Distance(sizing.Circle((0.6, 0.4), 0.2), h_min=0.04, slope=0.25)
    return Problem(clvoro.Box((0, 0), (2, 1)), size)


def corner() -> Problem:
    """Return an L with a re-entrant corner of 264 degrees."""
    ring = [(0, 0), (2, 0), (2, 1), (1.1, 0.9), (1, 2), (0, 2)]
    size = sizing.Distance(sizing.Circle((1.1, 0.9), 0.05), h_min=0.04, slope=0.15, h_max=0.15)
    return Problem(clvoro.Polygon(ring, names={"given": [0, 1]}), size)


def island() -> Problem:
    """Return a lake with a triangular island."""
    domain = clvoro.Polygon([(0, 0), (2, 0.1), (2.2, 1.2), (1, 1.6), (-0.1, 1)], [[(0.7, 0.5), (1.4, 0.6), (0.9, 1.0)]])
    size = sizing.Distance(domain.boundary("hole-1"), h_min=0.04, slope=0.15, h_max=0.15)
    return Problem(domain, size)


def circle() -> Problem:
    """Return a channel with a circle of 720 edges."""
    hole = _ring(720, 0.25, (0.7, 0.5))
    domain = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)], [hole])
    size = sizing.Distance(domain.boundary("hole-1"), h_min=0.04, slope=0.15, h_max=0.15)
    return Problem(domain, size)


def cube() -> Problem:
    """Return a cube."""
    size = sizing.Distance(sizing.Ball((0.5, 0.5, 0.4), 0.25), h_min=0.12, slope=0.3)
    return Problem(clvoro.Box((0, 0, 0), (1, 1, 1)), size)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "box": box,
    "corner": corner,
    "island": island,
    "circle": circle,
    "cube": cube,
}


def exact(x: np.ndarray) -> np.ndarray:
    """Return u, (k,)."""
    d = x.shape[1]
    return np.sin(WAVE[:d] * x + np.arange(d) / 2).prod(axis=1) + np.exp(x[:, 0] / 2)


def gradient(x: np.ndarray) -> np.ndarray:
    """Return grad u, (k, d)."""
    d = x.shape[1]
    phase = WAVE[:d] * x + np.arange(d) / 2
    found = np.empty_like(x)
    for k in range(d):
        factors = np.sin(phase)
        factors[:, k] = WAVE[k] * np.cos(phase[:, k])
        found[:, k] = factors.prod(axis=1)
    found[:, 0] += np.exp(x[:, 0] / 2) / 2
    return found


def source(x: np.ndarray) -> np.ndarray:
    """Return f = -div grad u, (k,)."""
    d = x.shape[1]
    waves = np.sin(WAVE[:d] * x + np.arange(d) / 2).prod(axis=1)
    return (WAVE[:d] ** 2).sum() * waves - np.exp(x[:, 0] / 2) / 4


def solve(mesh: clvoro.Diagram, faces: Faces, f: np.ndarray, mixed: bool, place: str) -> np.ndarray:
    """Return the unknowns at the generators, (n,)."""
    n = len(mesh)
    inner = faces.neighbor >= 0
    i, j, a = faces.owner[inner], faces.neighbor[inner], faces.conductance[inner]
    given = np.flatnonzero(faces.boundary == 0 if mixed else ~inner)
    free = np.flatnonzero(faces.boundary > 0 if mixed else np.zeros(len(inner), bool))
    value = exact(faces.foot[given] if place == "foot" else faces.center[given])
    flux = (gradient(faces.center[free]) * faces.normal[free]).sum(axis=1) * faces.area[free]
    right = mesh.volumes * f
    right += np.bincount(faces.owner[given], faces.conductance[given] * value, n)
    right += np.bincount(faces.owner[free], flux, n)
    diagonal = np.bincount(i, a, n) + np.bincount(j, a, n)
    diagonal += np.bincount(faces.owner[given], faces.conductance[given], n)
    upper = scipy.sparse.coo_array((a, (i, j)), (n, n))
    matrix = (scipy.sparse.diags_array(diagonal) - upper - upper.T).tocsc()
    if mesh.domain.dim == 2:
        return scipy.sparse.linalg.spsolve(matrix, right)
    jacobi = scipy.sparse.diags_array(1 / diagonal)
    found, failed = scipy.sparse.linalg.cg(matrix, right, rtol=1e-11, maxiter=10_000, M=jacobi)
    if failed:
        raise SystemExit("the conjugate gradients have not converged")
    return found


def measure(result: clvoro.Result, walls: str, conditions: str, where: str, place: str) -> dict[str, Any]:
    """Solve on one mesh; return the errors."""
    mesh = result.diagram
    faces = mesh.solver_mesh(walls, collapse=False)
    f = source(mesh.centroids if where == "mean" else mesh.points)
    error = np.abs(solve(mesh, faces, f, conditions == "mixed", place) - exact(mesh.points))
    on_wall = np.unique(faces.owner[faces.neighbor < 0])
    return {
        "cells": len(mesh),
        "max": float(error.max()),
        "at_walls": float(error[on_wall].max()),
        "over_h2": float((error / result.target_size**2).max()),
        "l2": float(np.sqrt((mesh.volumes * error**2).sum() / mesh.volumes.sum())),
    }


def orders(rows: list[dict[str, Any]], dim: int) -> dict[str, float] | None:
    """Return the slopes of the errors over the mean size of a cell; None for a single row."""
    if len(rows) < 2:
        return None
    size = np.log([row["cells"] ** (-1 / dim) for row in rows])
    return {
        name: float(np.polyfit(size, np.log([row[name] for row in rows]), 1)[0]) for name in ("max", "at_walls", "l2")
    }


def _error(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda r: f"{r[name]:.2e}" + (f" ({r['orders'][name]:.2f})" if r["orders"] else "")


COLUMNS = {
    "domain": lambda r: r["domain"],
    "walls": lambda r: r["walls"],
    "conditions": lambda r: r["conditions"],
    "f, u on walls": lambda r: f"{r['source']}, {r['place']}",
    "cells": lambda r: f"{r['cells']:,}",
    "largest error (order)": _error("max"),
    "on walls": _error("at_walls"),
    "over h^2": lambda r: f"{r['over_h2']:.2f}",
    "L2": _error("l2"),
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--only", default=",".join(PROBLEMS), metavar="NAMES")
    options_of.add_argument("--levels", type=int, default=4, help="one less in 3D")
    options_of.add_argument("--effort", default="default")
    choices = {"walls": "straight", "conditions": "Dirichlet,mixed", "source": "mean", "place": "foot"}
    for name, value in choices.items():
        options_of.add_argument(f"--{name}", default=value, metavar="NAMES")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    variants = list(product(*(names(getattr(options, name)) for name in choices)))
    for name in names(options.only):
        domain, size = PROBLEMS[name]()
        levels = range(options.levels - (domain.dim == 3))
        meshes = [adapter.run(domain, size * 0.5**k, effort=options.effort) for k in levels]
        for variant in variants:
            rows: list[dict[str, Any]] = []
            for mesh in meshes:
                row = measure(mesh, *variant)
                rows.append(row)
                about = dict(zip(choices, variant, strict=True))
                row = {"domain": name, **about, **row, "orders": orders(rows, domain.dim)}
                report.add(row, f"{name}, {row['cells']} cells")
    report.finish(heading(adapter, "Order of the two-point scheme"))


if __name__ == "__main__":
    main()
