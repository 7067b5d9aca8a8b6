"""Weights with which the cells of a power diagram have prescribed volumes: semi-discrete optimal transport.

With l the face between two cells and d the distance of their generators, dV_i / dw_j = -l_ij / (2 d_ij). So Newton's
equation is L dw = 2 (m - V) with the Laplacian L of `Poisson.assemble`. Steps are damped as Kitagawa, Merigot and
Thibert do (J. Eur. Math. Soc. 21, 2603, 2019, algorithm 1), which converges from any weights that leave no cell empty.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..tessellation.device_diagram import NeighborRows, OpenCellError, Tessellation
from ..tessellation.tessellator import Tessellator
from .components import balance_components, fit_components
from .linear_system import Solution
from .poisson import Poisson

TOLERANCE = {"float64": 1e-10, "float32": 1e-3}
"""Default of the largest relative error of volumes."""
MAX_STEPS = 100
"""Default of the largest number of Newton steps."""
LEAST_SHARE = 2.0**-20
"""Smallest share of a Newton step."""
FORCING, ROUGHEST = 0.1, 1e-3
"""The linear residual is this share of the largest relative error, or `ROUGHEST` if that is less."""
FINEST = {"float64": 1e-9, "float32": 1e-5}
"""Smallest linear residual."""
FEW = 20_000
"""Largest number of cells for which all linear solves have the precision of the last, to save the build of kernels."""


@dataclass
class Newton:
    """The steps of a solve."""

    errors: list[float] = field(default_factory=list)
    """list of float. Largest |V - m| / m at the start and after each step."""
    shares: list[float] = field(default_factory=list)
    """list of float. Share of each Newton step that was taken."""
    factor: float = 1.0
    """Factor on the prescribed volumes that makes their sum that of the domain."""
    converged: bool = False
    far: int = 0
    """Number of cells whose error is above the tolerance, at the end."""
    solution: Solution = field(default_factory=Solution.zero)
    """Of the last linear solve."""


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
        self._rows: NeighborRows | None = None

    def prescribe_sizes(self, h: cla.Array) -> cla.Array:
        """Return the volumes h^d (n,) of the target sizes `h` (n,)."""
        prescribed = self.engine.empty(len(h))
        self.engine.run_each(self._kernels.prescribe_sizes, len(h), h, prescribed)
        return prescribed

    def solve(
        self,
        power: Tessellator,
        points: cla.Array,
        prescribed: cla.Array,
        start: cla.Array | None = None,
        tolerance: float | None = None,
        max_steps: int = MAX_STEPS,
        exact: bool = False,
    ) -> tuple[Tessellation, cla.Array, Newton]:
        """Return the power diagram of `points` (n, d) with the `prescribed` volumes (n,), its weights, and the steps.

        - `prescribed` (n,) real: changed by a common factor, so that their sum is the volume of the domain; then by one
          for each component of the diagram, where the domain has several pieces.
        - `start` (n,) real: weights to start from, unless they leave a cell empty. By default 0: no cell is empty then.
        - `tolerance`: largest |V - m| / m; by default that of `TOLERANCE`.
        - `exact`: as for `Tessellator.tessellate`.
        """
        engine, n = self.engine, len(prescribed)
        tolerance = TOLERANCE[engine.real.name] if tolerance is None else tolerance
        newton = Newton(factor=self._fit(power, prescribed))
        least = self._summaries.read_one("volume").least * newton.factor

        def evaluate(weights: cla.Array, least: float = 0.0) -> _State | None:
            return self._evaluate(power, points, prescribed, weights, exact, least)

        self._rows = None
        now = None if start is None else evaluate(start)
        if now is None or not now.least > 0:
            now = evaluate(engine.zeros(n))
        assert now is not None
        if fit_components(engine, power.domain, now.t, prescribed):
            now = evaluate(now.weights)
            assert now is not None
        least = 0.5 * min(least, now.least)
        newton.errors.append(now.error)
        ordering = object()
        while now.error > tolerance and len(newton.shares) < max_steps:
            # Trial steps overwrite the diagram.
            self._rows = NeighborRows.copy_of(now.t)
            balance_components(engine, power.domain, now.t, now.rhs, prescribed)
            step, newton.solution = self._newton_step(power, now, points, ordering)
            new, share = None, 2.0
            while new is None and share > LEAST_SHARE:
                share /= 2
                stepped = engine.empty(n)
                engine.run_each(self._kernels.step_weights, n, engine.real.type(share), now.weights, step, stepped)
                new = evaluate(stepped, least)
                if new is not None and (new.least < least or new.norm > (1 - share / 2) * now.norm):
                    new = None
            if new is None:
                # Round-off prevents any progress.
                now = evaluate(now.weights)
                assert now is not None
                break
            now = new
            newton.errors.append(now.error)
            newton.shares.append(share)
        newton.converged = now.error <= tolerance
        if not newton.converged:
            newton.far = int((np.abs(now.relative.get()) > tolerance).sum())
        return now.t, now.weights, newton

    def _fit(self, power: Tessellator, prescribed: cla.Array) -> float:
        """Scale volumes so that their sum is that of the domain; return the factor."""
        engine = self.engine
        self._summaries.collect("volume", prescribed, len(prescribed))
        assert power.rings is not None
        factor = power.rings.volume / self._summaries.read_one("volume").sum
        engine.run_each(self._kernels.scale_volumes, len(prescribed), engine.real.type(factor), prescribed)
        return factor

    def _evaluate(
        self,
        power: Tessellator,
        points: cla.Array,
        prescribed: cla.Array,
        weights: cla.Array,
        exact: bool,
        least: float,
    ) -> _State | None:
        """Return the state with these weights; None if a cell is known to be smaller than `least`."""
        engine, n = self.engine, len(prescribed)
        try:
            t = power.tessellate_weighted(points, weights, n, exact, self._rows, least)
        except OpenCellError:
            if least <= 0:  # the generators alone leave a half of the sphere free
                raise
            return None
        if t is None:
            return None
        rhs, square, relative = (engine.empty(n) for _ in range(3))
        engine.run_each(self._kernels.compare_volumes, n, t.volumes, prescribed, rhs, square, relative)
        self._summaries.collect_all({"volume": t.volumes, "square": square, "relative": relative}, n)
        s = self._summaries.read()
        return _State(weights, t, rhs, relative, s["square"].sum ** 0.5, s["relative"].peak, s["volume"].least)

    def _newton_step(
        self, power: Tessellator, now: _State, points: cla.Array, ordering: object
    ) -> tuple[cla.Array, Solution]:
        engine, t = self.engine, now.t
        tolerance = max(min(ROUGHEST, FORCING * now.error), FINEST[engine.real.name])
        step = engine.empty(len(points))
        with engine.workspace.frame():
            measures = power.laplacian_measures(t)
            finest = FINEST[engine.real.name] if t.n <= FEW else tolerance
            laplacian = self._poisson.assemble(*t.graph, measures, points, tolerance=finest)
            solution = self._poisson.solve(
                laplacian, now.rhs, step, tolerance=tolerance, ordering=ordering, from_zero=True
            )
        return step, solution
