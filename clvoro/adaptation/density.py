"""The density rho = h^-d of the size field: cell weights, grad log h and weighted centroids (`density.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


@dataclass(frozen=True)
class CellWeights:
    """Cells against the size field, on the device."""

    density: cla.Array
    """(n,) real. rho = h^-d."""
    weight: cla.Array
    """(n,) real. V rho, the number of generators that the cell should have."""
    log_ratio: cla.Array
    """(n,) real. r = log(V rho) = log(V / h^d) = d log(L / h)."""


@dataclass(frozen=True)
class LloydWeights(CellWeights):
    """Weights of the cells, and weighted centroids, on the device."""

    gradient: cla.Array
    """(n, d) real. grad log h, fitted to the neighbors' h."""
    lloyd: cla.Array
    """(n, d) real. Displacement to the centroid weighted by h^-(d + 2)."""


class Density:
    """The kernels of `density.cl`. Results are in the workspace."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/density")
        self._partial = engine.empty(2 * engine.groups)

    def cell_weights(self, t: Tessellation, h: cla.Array, log_ratio: cla.Array | None = None) -> CellWeights:
        """Return density, weight and log ratio, in the given array, of the cells of `t` for sizes `h` (n,)."""
        log_ratio = self.engine.scratch(t.n) if log_ratio is None else log_ratio
        w = CellWeights(self.engine.scratch(t.n), self.engine.scratch(t.n), log_ratio)
        with self.engine.workspace.frame():
            self._evaluate(t, h, w)
        return w

    def _evaluate(self, t: Tessellation, h: cla.Array, w: CellWeights) -> cla.Array:
        """Write the weights; return log h, that of ghosts as well."""
        log_h = self.engine.scratch(t.rows)
        self.engine.run(
            self._kernels.evaluate_density, -(-t.n // 4), t.n, t.volumes, h, w.density, w.weight, w.log_ratio, log_h
        )
        t.forward(self.engine, log_h)
        return log_h

    def lloyd_weights(
        self,
        t: Tessellation,
        h: cla.Array,
        lloyd: cla.Array | None = None,
        gradient: cla.Array | None = None,
        log_ratio: cla.Array | None = None,
    ) -> LloydWeights:
        """Return the weights and weighted centroids of `t` for sizes `h` (n,), in the given arrays."""
        engine, k, shape = self.engine, self._kernels, (t.n, self.engine.dim)
        lloyd = engine.scratch(shape) if lloyd is None else lloyd
        gradient = engine.scratch(shape) if gradient is None else gradient
        log_ratio = engine.scratch(t.n) if log_ratio is None else log_ratio
        w = LloydWeights(engine.scratch(t.n), engine.scratch(t.n), log_ratio, gradient, lloyd)
        with engine.workspace.frame():
            log_h = self._evaluate(t, h, w)
            cells = t.points, log_h, t.offsets, t.covariances
            engine.run_each(k.fit_gradient, t.n, *t.graph, *cells, gradient, lloyd, *engine.period_args)
        return w

    def sum_log_ratio(self, w: CellWeights) -> cla.Array:
        """Return sums of ``w.weight * w.log_ratio`` over parts of the cells, and behind them those of ``w.weight``.

        The ratio of both is the weighted mean of the log ratios. The next call overwrites the sums.
        """
        size = len(w.log_ratio)
        self.engine.run_blocks(self._kernels.sum_log_ratio, size, w.weight, w.log_ratio, self._partial)
        return self._partial
