"""A front that moves with the flow, on a mesh that follows it: error, conservation, extrema, and the number of cells.

    python bench/following.py [--cells 1000,2000] [--cycles 50] [--uniform 1000,4000,16000] [--steps 21]
                              [--picture FILE] [--device NAME] [--json]

A disk with a smooth rim turns once around the middle of a square, in `--cycles` parts. After each
the sizes are those of `hessian_size` of the present solution and of the solution at the end of the next part, as if
it only turned (`combine`); a run follows them (`Run.follow`) by at most `--steps` steps, and the solution is
transferred by `Diagram.transfer`. The solver is of second order: linear functions in the cells, limited by Barth and
Jespersen, upwind fluxes, and Heun's method. "L1" is the error over the integral of the disk. "mass" is the largest
relative change of the integral in a transfer, "extrema" the largest excess over the values before one. "drift" is the
largest deviation of the number of cells from that of the first mesh, without `n_cells`, "|e|" the largest mean error
of the sizes, "Q" the least mean quality. "s" are seconds of the loop by the clock, from the first solution on,
"cpu s" seconds of processor time, and "solver", "mesh" and "transfer" the parts of these. Compare times within one
call, and after a first call that has built the kernels.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, parser, shown
from scipy.sparse import csr_array

import clvoro
from clvoro import sizing

BOX = clvoro.Box((-1, -1), (1, 1))
CENTER, RADIUS, WIDTH = np.array([0.5, 0.0]), 0.2, 0.02
COURANT = 0.4


def disk(x: np.ndarray, angle: float) -> np.ndarray:
    """Return the disk that has turned by `angle`, at points (n, 2)."""
    c, s = math.cos(angle), math.sin(angle)
    center = np.array([[c, -s], [s, c]]) @ CENTER
    return 0.5 - 0.5 * np.tanh((np.hypot(*(x - center).T) - RADIUS) / WIDTH)


class Advection:
    """Moves data of cells with the velocity (-y, x)."""

    def __init__(self, mesh: clvoro.Diagram) -> None:
        f, n = mesh.faces, len(mesh)
        k = f.n_inner
        self.volumes, self.own, self.other = mesh.volumes, f.owner[:k], f.neighbor[:k]
        center = f.center[:k]
        self.flux = (np.column_stack([-center[:, 1], center[:, 0]]) * f.normal[:k]).sum(axis=1) * f.area[:k]
        x = mesh.centroids
        self.to_own, self.to_other = center - x[self.own], center - x[self.other]
        # Gradients by Green's theorem would be wrong at walls: least squares over neighbors.
        rows, columns = np.concatenate([self.own, self.other]), np.concatenate([self.other, self.own])
        apart = x[columns] - x[rows]
        weight = 1 / (apart**2).sum(axis=1)
        moments = np.zeros((n, 2, 2))
        np.add.at(moments, rows, weight[:, None, None] * apart[:, :, None] * apart[:, None, :])
        parts = np.einsum("nab,nb->na", np.linalg.inv(moments)[rows], apart * weight[:, None])
        self.slopes = []
        for a in range(2):
            matrix = csr_array((parts[:, a], (rows, columns)), shape=(n, n))
            self.slopes.append(matrix - csr_array((np.bincount(rows, parts[:, a], n), (range(n), range(n))), (n, n)))
        order = np.argsort(rows, kind="stable")
        self.sorted, self.starts = columns[order], np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])[:-1]
        out = np.bincount(rows, np.concatenate([np.maximum(self.flux, 0), np.maximum(-self.flux, 0)]), n)
        self.step = COURANT * float((self.volumes / np.maximum(out, 1e-300)).min())

    def rate(self, u: np.ndarray) -> np.ndarray:
        """Return du/dt. No flux crosses the walls, where u is 0."""
        gradient = np.stack([slope @ u for slope in self.slopes], axis=1)
        around = u[self.sorted]
        low = np.minimum(np.minimum.reduceat(around, self.starts), u)
        high = np.maximum(np.maximum.reduceat(around, self.starts), u)
        limit = np.ones(len(u))
        for cells, to in ((self.own, self.to_own), (self.other, self.to_other)):
            rise = (gradient[cells] * to).sum(axis=1)
            room = np.where(rise > 0, high[cells] - u[cells], low[cells] - u[cells])
            share = np.divide(room, rise, out=np.ones(len(rise)), where=np.abs(rise) > 1e-300)
            np.minimum.at(limit, cells, np.minimum(share, 1))
        gradient *= limit[:, None]
        here = u[self.own] + (gradient[self.own] * self.to_own).sum(axis=1)
        there = u[self.other] + (gradient[self.other] * self.to_other).sum(axis=1)
        flux = self.flux * np.where(self.flux > 0, here, there)
        n = len(u)
        return (np.bincount(self.other, flux, n) - np.bincount(self.own, flux, n)) / self.volumes

    def advance(self, u: np.ndarray, length: float) -> np.ndarray:
        """Return u after a time, by Heun's method."""
        steps = math.ceil(length / self.step)
        for _ in range(steps):
            first = u + length / steps * self.rate(u)
            u = (u + first + length / steps * self.rate(first)) / 2
        return u


def means(mesh: clvoro.Diagram, angle: float) -> np.ndarray:
    """Return the disk at the centroids, which is its mean over a cell to second order."""
    return disk(mesh.centroids, angle)


def sizes(u: np.ndarray, mesh: clvoro.Diagram, n: float, turn: float) -> sizing.Estimate:
    """Return the sizes for a solution now, and for the time until it has turned by `turn`."""
    now = sizing.hessian_size(u, on=mesh, n_cells=n, growth=1.25, h_max=0.2)
    parts = [now]
    for share in (0.5, 1.0):
        c, s = math.cos(share * turn), math.sin(share * turn)
        back = mesh.centroids @ np.array([[c, -s], [s, c]])
        ahead = now(np.clip(back, -1, 1))
        parts.append(sizing.Estimate(mesh, ahead, now.error))
    return sizing.normalize(sizing.combine(*parts), n_cells=n, growth=1.25, h_max=0.2)


class Clock:
    """Seconds by the clock and of processor time, in all and in each part of a loop."""

    def __init__(self) -> None:
        self.parts: dict[str, float] = {}
        self._start = self._last = time.perf_counter(), time.process_time()

    def spent(self, name: str) -> None:
        """Count the time since the last call for a part."""
        now = time.perf_counter(), time.process_time()
        self.parts[name] = self.parts.get(name, 0.0) + now[1] - self._last[1]
        self._last = now

    def record(self) -> dict[str, float]:
        """Return the seconds of all parts."""
        wall, cpu = (last - start for last, start in zip(self._last, self._start, strict=True))
        return {**self.parts, "seconds": wall, "cpu_seconds": cpu}


def followed(adapter: clvoro.Adapter, n: int, cycles: int, steps: int) -> tuple[dict[str, Any], Any]:
    """Return the record of a mesh that follows, and the last mesh with its data."""
    turn = 2 * math.pi / cycles
    run = adapter.start(BOX, 2 / math.sqrt(n), "fast", seed=FIRST_SEED)
    mesh = run.finish().diagram
    for _ in range(3):
        run.follow(sizes(means(mesh, 0), mesh, n, turn))
        mesh = run.finish().diagram
    u = means(mesh, 0)
    first, drift, mass, excess = len(mesh), 0.0, 0.0, 0.0
    taken, errors, qualities = [], [], []
    run = adapter.start(BOX, sizes(u, mesh, n, turn), "fast", points=mesh.points, seed=FIRST_SEED, max_steps=steps)
    clock = Clock()
    for cycle in range(cycles):
        u = Advection(mesh).advance(u, turn)
        clock.spent("solver")
        if cycle + 1 == cycles:
            break
        run.follow(sizes(u, mesh, n, turn))
        after = run.finish()
        clock.spent("mesh")
        v = mesh.transfer(u, onto=after, order=2, adapter=adapter)
        clock.spent("transfer")
        taken.append(int(after.history["step"][-1]))
        errors.append(float(np.abs(after.size_error).mean()))
        qualities.append(float(after.quality.mean()))
        mass = max(mass, abs(float(after.diagram.volumes @ v) / float(mesh.volumes @ u) - 1))
        excess = max(excess, v.max() - u.max(), u.min() - v.min())
        mesh, u = after.diagram, v
        drift = max(drift, abs(len(mesh) / first - 1))
    record = {"kind": "followed", "cells": len(mesh), **_error(mesh, u), "mass": mass, "extrema": excess}
    record |= {"drift": drift, "steps": float(np.median(taken)), "e": max(errors), "quality": min(qualities)}
    return record | clock.record(), (mesh, u)


def uniform(adapter: clvoro.Adapter, n: int) -> dict[str, Any]:
    """Return the record of a uniform mesh."""
    mesh = adapter.run(BOX, 2 / math.sqrt(n), "fast", n_cells=n, seed=FIRST_SEED).diagram
    clock = Clock()
    u = Advection(mesh).advance(means(mesh, 0), 2 * math.pi)
    clock.spent("solver")
    return {"kind": "uniform", "cells": n, **_error(mesh, u), **clock.record()}


def _error(mesh: clvoro.Diagram, u: np.ndarray) -> dict[str, float]:
    exact = means(mesh, 0)
    return {"l1": float(mesh.volumes @ np.abs(u - exact) / (math.pi * RADIUS**2))}


COLUMNS = {
    "mesh": lambda r: r["kind"],
    "cells": shown("cells", ",d"),
    "L1": shown("l1", ".4f"),
    "mass": shown("mass", ".0e"),
    "extrema": shown("extrema", ".0e"),
    "drift": shown("drift", ".2%"),
    "steps": shown("steps", ".0f"),
    "|e|": shown("e", ".3f"),
    "Q": shown("quality", ".3f"),
    "s": shown("seconds", ".1f"),
    "cpu s": shown("cpu_seconds", ".1f"),
    "solver": shown("solver", ".1f"),
    "mesh ": shown("mesh", ".1f"),
    "transfer": shown("transfer", ".1f"),
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--cells", type=counts, default=counts("1000,2000"))
    made.add_argument("--cycles", type=int, default=50)
    made.add_argument("--uniform", type=counts, default=counts("1000,4000,16000"))
    made.add_argument("--steps", type=int, default=21)
    made.add_argument("--picture", type=Path, metavar="FILE")
    options = made.parse_args(arguments)
    adapter, report = make_adapter(options), Report(options.json, COLUMNS)
    for n in options.cells:
        record, (mesh, u) = followed(adapter, n, options.cycles, options.steps)
        report.add(record, f"followed, {n}")
        if options.picture:
            mesh.plot(u, label="u").savefig(options.picture, dpi=90)
    for n in options.uniform:
        report.add(uniform(adapter, n), f"uniform, {n}")
    report.finish(heading(adapter, f"A disk that turns once, {options.cycles} meshes"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
