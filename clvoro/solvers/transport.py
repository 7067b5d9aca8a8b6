"""Weights with which the cells of a power diagram have prescribed volumes: semi-discrete optimal transport.

With l the face between two cells and d the distance of their generators, dV_i / dw_j = -l_ij / (2 d_ij). So Newton's
equation is L dw = 2 (m - V) with the Laplacian L of `Poisson.assemble`. Steps are damped as Kitagawa, Merigot and
Thibert do (J. Eur. Math. Soc. 21, 2603, 2019, algorithm 1), which converges from any weights that leave no cell empty.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyopencl.array as cla

from ..errors import SolverError
from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..tessellation.device_diagram import Tessellation
from ..tessellation.power import PowerTessellator
from .poisson import Poisson

LEAST_SHARE = 2.0**-20
"""Smallest share of a Newton step."""
FORCING, ROUGHEST = 0.1, 1e-3
"""The linear residual is this share of the largest relative error, or `ROUGHEST` if that is less."""
FINEST = {"float64": 1e-9, "float32": 1e-5}
"""Smallest linear residual."""


@dataclass
class Newton:
    """The steps of a solve.

    Attributes
    ----------
    errors : list of float
        Largest |V - m| / m at the start and after each step.
    shares : list of float
        Share of each Newton step that was taken.
    converged : bool
    far : int
        Number of cells whose error is above the tolerance, at the end.
    """

    errors: list[float] = field(default_factory=list)
    shares: list[float] = field(default_factory=list)
    converged: bool = False
    far: int = 0


@dataclass
class _State:
    """Weights, their diagram, and its distance from the prescribed volumes."""

    weights: cla.Array
    t: Tessellation
    rhs: cla.Array
    relative: cla.Array
    norm: float
    error: float
    least: float


class Transport:
    """Damped Newton for prescribed volumes."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._poisson = Poisson(engine)
        self._kernels = engine.kernels("solvers/transport")
        self._summaries = Summaries(engine, ("volume", "square", "relative"))

    def solve(
        self,
        power: PowerTessellator,
        points: cla.Array,
        volumes: np.ndarray,
        weights: cla.Array,
        tolerance: float,
        max_steps: int,
        exact: bool = False,
    ) -> tuple[Tessellation, cla.Array, Newton]:
        """Return the power diagram of `points` (n, d) with the prescribed `volumes` (n,), its weights, and the steps.

        Parameters
        ----------
        volumes : (n,) float64
            In the device's unit. A common factor makes their sum that of the cells.
        weights : (n,) real
            Start. With 0 each cell contains its generator, and none is empty.
        tolerance : float
            Largest |V - m| / m.
        max_steps : int
        exact : bool
            As for `PowerTessellator.tessellate`.

        Raises
        ------
        SolverError
            If a cell is empty at the start.
        """
        engine, n, newton = self.engine, len(volumes), Newton()
        whole = np.prod(np.subtract(*power.domain.device_corners(engine.real)[::-1])[: engine.dim])
        prescribed = engine.upload(volumes * (float(whole) / volumes.sum()))
        least = float(prescribed.get().min())
        now = self._evaluate(power, points, prescribed, weights, exact)
        if not now.least > 0:
            empty = int((now.t.volumes.get() <= 0).sum())
            raise SolverError(
                f"{empty} of {n} cells are empty at the start of Newton's method, expected none; start from weights 0"
            )
        least = 0.5 * min(least, now.least)
        newton.errors.append(now.error)
        ordering = object()
        while now.error > tolerance and len(newton.shares) < max_steps:
            step = self._newton_step(now, points, ordering)
            share = 1.0
            while share >= LEAST_SHARE:
                stepped = engine.empty(n)
                engine.run_each(
                    self._kernels.step_weights,
                    n,
                    engine.real.type(share),
                    now.weights,
                    step,
                    stepped,
                )
                new = self._evaluate(power, points, prescribed, stepped, exact)
                if new.least >= least and new.norm <= (1 - share / 2) * now.norm:
                    break
                share /= 2
            else:
                # Round-off prevents any progress. The arrays of the diagram are overwritten.
                now = self._evaluate(power, points, prescribed, now.weights, exact)
                break
            now = new
            newton.errors.append(now.error)
            newton.shares.append(share)
        newton.converged = now.error <= tolerance
        if not newton.converged:
            newton.far = int((np.abs(now.relative.get()) > tolerance).sum())
        return now.t, now.weights, newton

    def _evaluate(
        self,
        power: PowerTessellator,
        points: cla.Array,
        prescribed: cla.Array,
        weights: cla.Array,
        exact: bool,
    ) -> _State:
        engine, n = self.engine, len(prescribed)
        t = power.tessellate(points, weights, n, exact)
        rhs, square, relative = (engine.empty(n) for _ in range(3))
        engine.run_each(
            self._kernels.compare_volumes, n, t.volumes, prescribed, rhs, square, relative
        )
        self._summaries.collect_all(
            {"volume": t.volumes, "square": square, "relative": relative}, n
        )
        s = self._summaries.read()
        return _State(
            weights, t, rhs, relative, s["square"].sum ** 0.5, s["relative"].peak, s["volume"].least
        )

    def _newton_step(self, now: _State, points: cla.Array, ordering: object) -> cla.Array:
        engine, t = self.engine, now.t
        tolerance = max(min(ROUGHEST, FORCING * now.error), FINEST[engine.real.name])
        step = engine.empty(len(points))
        with engine.workspace.frame():
            laplacian = self._poisson.assemble(
                t.starts, t.neighbors, t.face_measures, points, tolerance=tolerance
            )
            self._poisson.solve(
                laplacian, now.rhs, step, tolerance=tolerance, ordering=ordering, from_zero=True
            )
        return step
