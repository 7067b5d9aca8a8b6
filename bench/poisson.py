"""Poisson solve on Voronoi graphs: iterations, set-up and solve time, against pyamg and SciPy.

    python bench/poisson.py [N ...] [--mesh random|adapted] [--device NAME] [--dtype float32] [--json]

Right side: white noise of mean zero; relative residual 1e-8 (1e-5 in float32). Times are the best of `--repeat`
solves on a running process (kernels built), the peers' the best of one or two. Peers run where installed, up to
`--peers-up-to` cells; direct solves up to a tenth of that.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np
import pyopencl as cl
import scipy.sparse as sp
import scipy.sparse.linalg as sla

import clvoro
from clvoro._program import Engine
from clvoro.poisson import Poisson

try:
    import pyamg
except ImportError:
    pyamg = None


def context(name):
    """Return the context of the first device whose (or whose platform's) name contains `name`."""
    if name is None:
        return clvoro.create_context()
    for platform in cl.get_platforms():
        for device in platform.get_devices():
            if name.lower() in f"{platform.name} {device.name}".lower():
                return cl.Context([device])
    raise SystemExit(f"no OpenCL device whose name contains {name!r}; see `clvoro devices`")


def morton_order(points):
    """Order of points in [0, 1]^2 along a Morton curve."""
    key = np.zeros(len(points), np.int64)
    boxes = np.minimum((points * 2**15).astype(np.int64), 2**15 - 1)
    for bit in range(15):
        key |= ((boxes[:, 0] >> bit) & 1) << 2 * bit | ((boxes[:, 1] >> bit) & 1) << 2 * bit + 1
    return np.argsort(key, kind="stable")


def make_graph(adapter, n, mesh):
    """Diagram of `n` cells in the unit box, generators in Morton order."""
    box = clvoro.Box((0.0, 0.0), (1.0, 1.0))
    rng = np.random.default_rng(n)
    if mesh == "random":
        points = rng.random((n, 2))
    else:
        # Sizes over 1 : 20, growing away from a corner.
        def size(x):
            return (0.05 + np.hypot(x[:, 0], x[:, 1])) / np.sqrt(n)

        points = adapter.run(box, size, n_cells=n, max_steps=10, tol=0, seed=n).points
    return adapter.diagram(box, points[morton_order(points)])


def best(repeat, function):
    """Least of `repeat` times of `function`, and its last result."""
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - start)
    return min(times), result


def ours(engine, diagram, b, method, tolerance, repeat):
    poisson = Poisson(engine)
    arrays = (
        engine.upload(diagram.neighbour_starts, np.int32),
        engine.upload(diagram.neighbours, np.int32),
        engine.upload(diagram.face_measures),
        engine.upload(diagram.points),
    )
    rhs, phi = engine.upload(b), engine.zeros(len(b))

    def set_up():
        laplacian = poisson.assemble(*arrays)
        if method == "multigrid":
            poisson.set_up_multigrid(laplacian)
        engine.queue.finish()
        return laplacian

    def solve():
        phi.fill(0)
        return poisson.solve(
            laplacian, rhs, phi, preconditioner=method, tolerance=tolerance, max_iterations=20000
        )

    set_up()
    seconds_set_up, laplacian = best(repeat, set_up)
    solve()
    seconds, solution = best(repeat, solve)
    return solution.iterations, solution.residual, seconds_set_up, seconds


def matrix(diagram):
    """Return A = -Laplacian as a SciPy matrix."""
    n = len(diagram)
    rows = np.repeat(np.arange(n), np.diff(diagram.neighbour_starts))
    inner = diagram.neighbours >= 0
    i, j = rows[inner], diagram.neighbours[inner]
    d = np.linalg.norm(diagram.points[i] - diagram.points[j], axis=1)
    W = sp.csr_matrix((diagram.face_measures[inner] / d, (i, j)), (n, n))
    W = 0.5 * (W + W.T)
    return sp.csr_matrix(sp.diags(np.asarray(W.sum(axis=1)).ravel()) - W)


def with_pyamg(A, b, tolerance, repeat):
    # One addition to the diagonal makes the matrix definite, as pyamg needs it, and leaves x_0 = 0.
    A = A.copy()
    A[0, 0] *= 2
    set_up, ml = best(repeat, lambda: pyamg.smoothed_aggregation_solver(A))
    residuals = []

    def solve():
        residuals.clear()
        return ml.solve(b, tol=tolerance, accel="cg", residuals=residuals, maxiter=300)

    seconds, x = best(repeat, solve)
    residual = np.linalg.norm(b - A @ x) / np.linalg.norm(b)
    return len(residuals) - 1, residual, set_up, seconds


def with_scipy(A, b):
    set_up, lu = best(1, lambda: sla.splu(sp.csc_matrix(A[1:, 1:])))
    x = np.zeros(len(b))
    seconds, x[1:] = best(1, lambda: lu.solve(b[1:]))
    return 1, np.linalg.norm(b - A @ x) / np.linalg.norm(b), set_up, seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", nargs="*", type=float, default=[1e3, 1e4, 1e5, 1e6])
    parser.add_argument("--mesh", choices=["random", "adapted"], default="random")
    parser.add_argument("--device", help="part of the device's or platform's name")
    parser.add_argument("--dtype", choices=["float64", "float32"], default="float64")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--peers-up-to", type=float, default=1e6, metavar="N")
    parser.add_argument("--jacobi-up-to", type=float, default=1e5, metavar="N")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    options = parser.parse_args()

    ctx = context(options.device)
    adapter = clvoro.Adapter(ctx)
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(options.dtype))
    tolerance = 1e-8 if options.dtype == "float64" else 1e-5
    if not options.json:
        print(f"{ctx.devices[0].name.strip()}, {options.dtype}, {options.mesh} mesh")
        print(f"{'N':>9} {'method':<10} {'its':>6} {'residual':>9} {'set-up s':>9} {'solve s':>9} "
              f"{'sum s':>9} {'times ours':>10}")  # fmt: skip
    for n in map(int, options.cells):
        diagram = make_graph(adapter, n, options.mesh)
        b = np.random.default_rng(n + 1).standard_normal(len(diagram))
        b -= b.mean()
        rows = {}
        for method in ["multigrid"] + ["jacobi"] * (n <= options.jacobi_up_to):
            rows[method] = ours(engine, diagram, b, method, tolerance, options.repeat)
        if n <= options.peers_up_to:
            A = matrix(diagram)
            if pyamg is not None:
                rows["pyamg"] = with_pyamg(A, b, tolerance, 1 if n > 2e5 else 2)
            if n <= options.peers_up_to / 10:
                rows["SciPy LU"] = with_scipy(A, b)
        total = sum(rows["multigrid"][2:])
        for method, (iterations, residual, set_up, solve) in rows.items():
            ratio = (set_up + solve) / total
            if options.json:
                print(json.dumps({
                    "cells": len(diagram), "mesh": options.mesh, "dtype": options.dtype,
                    "method": method, "iterations": iterations, "residual": residual,
                    "set_up": set_up, "solve": solve, "ratio": ratio,
                }))  # fmt: skip
            else:
                print(f"{len(diagram):>9} {method:<10} {iterations:>6} {residual:>9.1e} "
                      f"{set_up:>9.4f} {solve:>9.4f} {set_up + solve:>9.4f} {ratio:>10.2f}",
                      flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
