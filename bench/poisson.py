"""Poisson solve on Voronoi graphs: iterations, set-up and solve time, against pyamg and SciPy.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python bench/poisson.py [--sizes 1e3,1e4,1e5,1e6]
                        [--device NAME] [--dtype float32] [--json]

Right side: white noise of mean zero; relative residual 1e-8 (1e-5 in float32). Times are the best of `--repeat`
solves on a running process (kernels built), the peers' the best of one or two. Peers run where installed, up to
`--peers-up-to` cells; direct solves up to a tenth of that.

With `--processor-time`, seconds are the processor time of this process, clvoro's over the device's compute units: the
time of an idle machine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl as cl
import scipy.sparse as sp
import scipy.sparse.linalg as sla
from _common import Report, best, clock_of, counts, heading, make_adapter, parser

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.solvers.poisson import Poisson

try:
    import pyamg
except ImportError:
    pyamg = None

Outcome = tuple[int, float, float, float]
"""Iterations, relative residual, seconds of set-up and of the solve."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Order of points in [0, 1]^2 along a Morton curve."""
    key = np.zeros(len(points), np.int64)
    boxes = np.minimum((points * 2**15).astype(np.int64), 2**15 - 1)
    for bit in range(15):
        key |= ((boxes[:, 0] >> bit) & 1) << 2 * bit | ((boxes[:, 1] >> bit) & 1) << 2 * bit + 1
    return np.argsort(key, kind="stable")


def make_graph(adapter: clvoro.Adapter, n: int) -> clvoro.Diagram:
    """Diagram of `n` random generators in the unit box, in Morton order."""
    points = np.random.default_rng(n).random((n, 2))
    return adapter.diagram(clvoro.Box((0.0, 0.0), (1.0, 1.0)), points[morton_order(points)])


def ours(
    engine: Engine,
    diagram: clvoro.Diagram,
    b: np.ndarray,
    method: str,
    tolerance: float,
    repeat: int,
    clock: Callable[[], float],
) -> Outcome:
    poisson = Poisson(engine)
    arrays = (
        engine.upload(diagram.neighbor_starts, np.int32),
        engine.upload(diagram.neighbors, np.int32),
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
        return poisson.solve(laplacian, rhs, phi, preconditioner=method, tolerance=tolerance, max_iterations=20000)

    set_up()
    seconds_set_up, laplacian = best(repeat, set_up, clock)
    solve()
    seconds, solution = best(repeat, solve, clock)
    return solution.iterations, solution.residual, seconds_set_up, seconds


def matrix(diagram: clvoro.Diagram) -> sp.csr_matrix:
    """Return A = -Laplacian as a SciPy matrix."""
    n = len(diagram)
    rows = np.repeat(np.arange(n), np.diff(diagram.neighbor_starts))
    inner = diagram.neighbors >= 0
    i, j = rows[inner], diagram.neighbors[inner]
    d = np.linalg.norm(diagram.points[i] - diagram.points[j], axis=1)
    W = sp.csr_matrix((diagram.face_measures[inner] / d, (i, j)), (n, n))
    W = 0.5 * (W + W.T)
    return sp.csr_matrix(sp.diags(np.asarray(W.sum(axis=1)).ravel()) - W)


def with_pyamg(A: sp.csr_matrix, b: np.ndarray, tolerance: float, repeat: int, clock: Callable[[], float]) -> Outcome:
    # One addition to the diagonal makes the matrix definite, as pyamg needs it, and leaves x_0 = 0.
    A = A.copy()
    A[0, 0] *= 2
    set_up, ml = best(repeat, lambda: pyamg.smoothed_aggregation_solver(A), clock)
    residuals = []

    def solve():
        residuals.clear()
        return ml.solve(b, tol=tolerance, accel="cg", residuals=residuals, maxiter=300)

    seconds, x = best(repeat, solve, clock)
    residual = np.linalg.norm(b - A @ x) / np.linalg.norm(b)
    return len(residuals) - 1, residual, set_up, seconds


def with_scipy(A: sp.csr_matrix, b: np.ndarray, clock: Callable[[], float]) -> Outcome:
    set_up, lu = best(1, lambda: sla.splu(sp.csc_matrix(A[1:, 1:])), clock)
    x = np.zeros(len(b))
    seconds, x[1:] = best(1, lambda: lu.solve(b[1:]), clock)
    return 1, np.linalg.norm(b - A @ x) / np.linalg.norm(b), set_up, seconds


COLUMNS = {
    "cells": lambda r: f"{r['cells']:,}",
    "method": lambda r: r["method"],
    "iterations": lambda r: r["iterations"],
    "residual": lambda r: f"{r['residual']:.1e}",
    "set-up s": lambda r: f"{r['set_up']:.3f}",
    "solve s": lambda r: f"{r['solve']:.3f}",
    "sum s": lambda r: f"{r['set_up'] + r['solve']:.3f}",
    "over ours": lambda r: f"{r['ratio']:.1f}",
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=counts("1e3,1e4,1e5,1e6"))
    options_of.add_argument("--repeat", type=int, default=3)
    options_of.add_argument("--peers-up-to", type=float, default=1e6, metavar="N")
    options_of.add_argument("--jacobi-up-to", type=float, default=1e5, metavar="N")
    options_of.add_argument("--processor-time", action="store_true")
    options = options_of.parse_args()

    adapter = make_adapter(options)
    engine = Engine(adapter.ctx, cl.CommandQueue(adapter.ctx), 2, adapter.dtype)
    tolerance = 1e-8 if options.dtype == "float64" else 1e-5
    clock, clock_of_peers = clock_of(options, adapter), clock_of(options)
    report = Report(options.json, COLUMNS)
    for n in options.sizes:
        diagram = make_graph(adapter, n)
        b = np.random.default_rng(n + 1).standard_normal(len(diagram))
        b -= b.mean()
        rows = {}
        for method in ["multigrid"] + ["jacobi"] * (n <= options.jacobi_up_to):
            rows[method] = ours(engine, diagram, b, method, tolerance, options.repeat, clock)
        if n <= options.peers_up_to:
            A = matrix(diagram)
            if pyamg is not None:
                rows["pyamg"] = with_pyamg(A, b, tolerance, 1 if n > 2e5 else 2, clock_of_peers)
            if n <= options.peers_up_to / 10:
                rows["SciPy LU"] = with_scipy(A, b, clock_of_peers)
        total = sum(rows["multigrid"][2:])
        for method, (iterations, residual, set_up, solve) in rows.items():
            record = {
                "cells": len(diagram),
                "dtype": options.dtype,
                "method": method,
                "iterations": iterations,
                "residual": float(residual),
                "set_up": set_up,
                "solve": solve,
                "ratio": (set_up + solve) / total,
            }
            report.add(record, f"{n:,} {method}")
    report.finish(heading(adapter, "Poisson on random meshes"))


if __name__ == "__main__":
    main()
