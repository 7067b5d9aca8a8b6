"""Exact projection: the least displacement that gives every cell its volume, to first order (`projection.cl`).

The paper's Poisson step approximates this, as an approximate projection does in incompressible flow.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyopencl.array as cla

from ..errors import SolverError
from ..opencl.launch import Launch, most_alone
from ..opencl.program import Engine
from ..opencl.workspace import framed
from ..tessellation.device_diagram import Tessellation
from .conjugate_gradient import Solution

SINGLE = 1e-4
"""Tolerance from which on the iteration's vectors are in single precision."""
_ROWS = 5
_NORM, _RUNNING, _CURVATURE = 0, 2, 3


class Projection:
    """Solve for the correction u' in ``u = Ld + u'``, ``u' = -W J^T y``, ``(J W J^T + eps) y = r + J Ld``.

    J is the derivative of the excess r (see `Density`) by the generators, W = diag(h^2). With eps = 0 the excess would
    vanish to first order; eps > 0 is a penalty that trades it for a shorter displacement, and damps the modes which J
    hardly sees.

    Conjugate gradients with the diagonal as a preconditioner, from y = 0 or along the last solution first, in two
    kernels an iteration. The host enqueues as many as the last solve took and then reads their record; the iterate is
    frozen on the device when the tolerance is met, so the result does not depend on when the host looks. Where cells
    are few, one kernel of one work-group does all of that alone.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._partial = engine.empty(_ROWS * engine.groups)
        self._record = engine.zeros(4 * 64)  # more rows than are written are read
        self._kernels: dict[np.dtype, SimpleNamespace] = {}
        self._ahead = 8
        self._most_alone = most_alone(engine)

    def _kernels_in(self, store: np.dtype) -> SimpleNamespace:
        if store not in self._kernels:
            self._kernels[store] = self.engine.kernels(
                "solvers/volume_projection", {"STORE": self.engine.name_of(store)}
            )
        return self._kernels[store]

    def _reserve(self, n: int, m: int, store: np.dtype, most: int) -> SimpleNamespace:
        """Return the iteration's arrays for `n` cells and `m` faces; make room for `most` iterations."""
        engine, d = self.engine, self.engine.dim
        if 4 * (most + 1) > len(self._record):
            self._record = engine.zeros(4 * (most + 1))
        return SimpleNamespace(
            **{name: engine.scratch((d, m), np.float32) for name in ("rows", "columns")},
            **{name: engine.scratch((n, d), store) for name in ("own", "s", "u")},
            **{name: engine.scratch(n, store) for name in ("eps", "inverse", "y", "r", "z", "p")},
        )

    @framed
    def project(
        self,
        t: Tessellation,
        h: cla.Array,
        gradient: cla.Array,
        excess: cla.Array,
        displacement: cla.Array,
        correction: cla.Array,
        quality: cla.Array,
        *,
        eps: float,
        lenience: float = 0.0,
        bound: float = 0.0,
        max_iterations: int,
        tolerance: float = 1e-6,
        labels: cla.Array | None = None,
        fixed: int = 0,
        start: cla.Array | None = None,
        warm: bool = False,
    ) -> Solution:
        """Write the correction of `displacement` (n, d) to `correction` (n, d).

        Parameters
        ----------
        h, excess, quality : (n,) real
        gradient : (n, d) real
            grad log h.
        eps : float
        lenience : float
            (1 - Q) / sqrt Q, which is next to -log Q, at which the eps of a cell and its neighbors is twice as large;
            0: quality does not matter.
        bound : float
            Excess at which a cell's eps is half; 0: the same eps for all.
        max_iterations : int
        tolerance : float
            Of the relative residual, by the recurrence. From `SINGLE` on the vectors are in single precision.
        labels : (n,) int32, optional
        fixed : int
            Generators with smaller labels do not move.
        start : (n,) float32, optional
            Where the solution y goes, if there is a need of one.
        warm : bool
            Begin from what `start` holds: a solution of a similar system.

        Returns
        -------
        Solution
            `residual` is the recurrence's, too.

        Raises
        ------
        SolverError
            If a number is not finite.
        """
        engine, n = self.engine, t.n
        real = engine.real.type
        store = np.dtype(np.float32) if tolerance >= SINGLE else engine.real
        v = self._reserve(n, t.neighbors.shape[0], store, max_iterations)
        k = self._kernels_in(store)
        sizes = np.int32(n), np.int32(max_iterations), np.int32(t.neighbors.shape[0])
        number, _, room = sizes
        faces, partial, record = (t.starts, t.neighbors), self._partial, self._record
        groups = 1 if n <= self._most_alone else engine.groups
        start = engine.scratch(n, np.float32) if start is None else start
        Launch(
            engine, k.assemble, number, room, *faces, t.face_measures, t.face_centroids, t.volumes,
            t.points, gradient, h, quality, excess, displacement, real(eps), real(lenience),
            real(bound), v.rows, v.columns, v.own, v.eps, v.inverse, v.r, v.z, partial,
            t.starts if labels is None else labels, np.int32(fixed), np.int32(warm), start,
            *engine.period_args, groups=groups,
        )()  # fmt: skip
        iteration = (
            *sizes, np.int32(warm), real(tolerance), *faces, v.rows, v.columns, v.own, v.eps, v.inverse,
            v.p, v.s, v.u, v.y, v.r, v.z, partial, record,
        )  # fmt: skip
        if groups == 1:
            Launch(engine, k.iterate, *iteration, groups=1)()
            rows = self._read(max_iterations)
        else:
            descend, update = (
                Launch(engine, kernel, np.int32(0), *iteration) for kernel in (k.descend, k.update)
            )
            rows = self._iterate(descend, update, max_iterations)
        solution = self._judge(rows, tolerance)
        if solution.iterations:
            engine.run_each(k.put_correction, n, v.u, v.y, h, correction, start)
        else:
            correction.fill(0)
        return solution

    def _iterate(self, descend: Launch, update: Launch, most: int) -> np.ndarray:
        """Iterate until the tolerance is met, or `most` times; return the record up to then, or later."""
        descend()
        done, ahead = 0, self._ahead
        while True:
            end = min(done + ahead, most)
            for k in range(done, end):
                for launch, number in ((update, k), (descend, k + 1)):
                    launch.set_first(number)
                    launch()
            rows = self._read(end)
            if not rows[:, _RUNNING].all():
                self._ahead = _stop(rows) + 2
                return rows
            done, ahead = end, 4

    def _read(self, end: int) -> np.ndarray:
        """Return the rows of the record up to iteration `end`."""
        return self._record[: 4 * (end + 1)].get().reshape(-1, 4).astype(np.float64)

    def _judge(self, rows: np.ndarray, tolerance: float) -> Solution:
        """Return how it went, by the record."""
        iterations = _stop(rows)
        flat = bool(iterations and not rows[iterations - 1, _CURVATURE] > 0)
        iterations -= flat
        norms, curvature = rows[: iterations + 1, _NORM], rows[iterations, _CURVATURE]
        # A curvature of zero: what is left is too small for the precision.
        if not np.isfinite(norms).all() or (flat and curvature != 0):
            raise SolverError(
                "the projection got an excess, displacement or diagram that is not finite: squared "
                f"residuals {norms}, curvature {curvature}; check the input"
            )
        if norms[0] == 0:
            return Solution(0, 0.0, np.zeros(1), True, "zero right side")
        residuals = np.sqrt(norms / norms[0])
        converged = bool(residuals[-1] <= tolerance)
        reason = "converged" if converged else "stagnated" if flat else "max_iterations"
        return Solution(iterations, float(residuals[-1]), residuals, converged, reason)


def _stop(rows: np.ndarray) -> int:
    """Return the first iteration that was not carried out; what the record holds behind it is of no meaning."""
    return int(np.flatnonzero(rows[:, _RUNNING] == 0)[0])
