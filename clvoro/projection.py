"""Exact projection: the least displacement that gives every cell its volume, to first order (`projection.cl`).

The paper's Poisson step approximates this, as an approximate projection does in incompressible flow.
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ._program import Engine
from .cells import Tessellation
from .krylov import ConjugateGradient, Solution


class Projection:
    """Solve for the correction u' in ``u = Ld + u'``, ``u' = -W J^T y``, ``(J W J^T + eps) y = r + J Ld``.

    J is the derivative of the excess r (see `Density`) by the generators, W = diag(h^2). With eps = 0 the excess would
    vanish to first order; eps > 0 is a penalty that trades it for a shorter displacement, and damps the modes which J
    hardly sees.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("projection")
        self._krylov = ConjugateGradient(engine)
        self._n = self._m = -1

    def _reserve(self, n: int, m: int) -> None:
        if n != self._n:
            self._n = n
            engine = self.engine
            self._own, self._u = engine.empty((n, engine.dim)), engine.empty((n, engine.dim))
            self._inverse, self._rhs, self._y, self._eps = (engine.empty(n) for _ in range(4))
        if m > self._m:
            self._m = m
            self._rows = self.engine.empty((m, self.engine.dim), np.float32)
            self._columns = self.engine.empty((m, self.engine.dim), np.float32)

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
    ) -> Solution:
        """Write the correction of `displacement` (n, d) to `correction` (n, d).

        Parameters
        ----------
        h, excess, quality : (n,) real
        gradient : (n, d) real
            grad log h.
        eps : float
        lenience : float
            -log Q at which the eps of a cell and its neighbours is twice as large; 0: quality does not matter.
        bound : float
            Excess at which a cell's eps is half; 0: the same eps for all.
        max_iterations : int
            Of Jacobi-preconditioned CG. Forty do: the high modes that are left weigh nothing.
        """
        engine, k, n = self.engine, self._kernels, t.n
        real = engine.real.type
        self._reserve(n, t.neighbours.shape[0])
        engine.run_each(
            k.set_penalty, n, t.starts, t.neighbours, quality, excess, real(eps), real(lenience),
            real(bound), self._eps,
        )  # fmt: skip
        engine.run_each(
            k.assemble_derivative, n, t.starts, t.neighbours, t.face_measures, t.face_centroids,
            t.volumes, t.points, gradient, h, self._eps, self._rows, self._columns, self._own,
            self._inverse,
        )  # fmt: skip

        def derivative(u: cla.Array, y: cla.Array, out: cla.Array) -> None:
            engine.run_each(
                k.apply_derivative, n, t.starts, t.neighbours, self._rows, self._own, u, self._eps,
                y, out,
            )  # fmt: skip

        def transpose(y: cla.Array, u: cla.Array) -> None:
            engine.run_each(
                k.apply_transpose, n, t.starts, t.neighbours, self._columns, self._own, h, y, u
            )

        def apply(y: cla.Array, out: cla.Array) -> None:
            transpose(y, self._u)
            derivative(self._u, y, out)

        self._y.fill(0)
        derivative(displacement, self._y, self._rhs)
        engine.run_each(k.add_excess, n, excess, self._rhs)
        solution = self._krylov.solve(
            apply, self._rhs, self._y, precondition=self._inverse, tolerance=tolerance,
            max_iterations=max_iterations,
        )  # fmt: skip
        transpose(self._y, correction)
        engine.run_each(k.negate, n, correction)
        return solution
