"""The size field as a density rho = h^-d: cell excess, grad log h and weighted centroids (`density.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


@dataclass(frozen=True)
class Excess:
    """How much each cell is too large or too small for the size field, on the device.

    Attributes
    ----------
    density : (n,) real
        rho = h^-d.
    weight : (n,) real
        V rho: how many generators the cell should hold.
    excess : (n,) real
        log(V rho) = d log(L / h): the cell is too large by this share of its volume.
    """

    density: cla.Array
    weight: cla.Array
    excess: cla.Array


@dataclass(frozen=True)
class Weighting(Excess):
    """That, and what the size field asks of each generator, on the device.

    Attributes
    ----------
    gradient : (n, d) real
        grad log h, fitted to the neighbors' h.
    lloyd : (n, d) real
        Displacement to the centroid weighted by h^-(d + 2).
    """

    gradient: cla.Array
    lloyd: cla.Array


class Density:
    """The kernels of `density.cl`. What they return is of the workspace."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/density")
        self._partial = engine.empty(2 * engine.groups)

    def weigh(self, t: Tessellation, h: cla.Array) -> Excess:
        """Return the excess of the cells of `t` over sizes `h` (n,)."""
        w = Excess(*(self.engine.scratch(t.n) for _ in range(3)))
        with self.engine.workspace.frame():
            self._weigh(t, h, w)
        return w

    def _weigh(self, t: Tessellation, h: cla.Array, w: Excess) -> cla.Array:
        """Write the excess; return log h (n,)."""
        log_h = self.engine.scratch(t.n)
        self.engine.run(
            self._kernels.evaluate_density, -(-t.n // 4), np.int32(t.n), t.volumes, h, w.density,
            w.weight, w.excess, log_h,
        )  # fmt: skip
        return log_h

    def evaluate(
        self,
        t: Tessellation,
        h: cla.Array,
        lloyd: cla.Array | None = None,
        gradient: cla.Array | None = None,
        excess: cla.Array | None = None,
    ) -> Weighting:
        """Return the weighting of `t` for sizes `h` (n,), in the arrays that are given."""
        engine, k, shape = self.engine, self._kernels, (t.n, self.engine.dim)
        lloyd = engine.scratch(shape) if lloyd is None else lloyd
        gradient = engine.scratch(shape) if gradient is None else gradient
        excess = engine.scratch(t.n) if excess is None else excess
        w = Weighting(engine.scratch(t.n), engine.scratch(t.n), excess, gradient, lloyd)
        with engine.workspace.frame():
            log_h = self._weigh(t, h, w)
            engine.run_each(
                k.fit_gradient, t.n, t.starts, t.neighbors, t.points, log_h, t.offsets, t.covariances,
                gradient, lloyd, *engine.period_args,
            )  # fmt: skip
        return w

    def remove_mean(self, w: Excess) -> None:
        """Take the mean of ``w.excess``, weighted by ``w.weight``, away from it."""
        run, k, size = self.engine.run_blocks, self._kernels, np.int32(len(w.excess))
        run(k.sum_excess, size, w.weight, w.excess, self._partial)
        run(k.remove_mean, size, self._partial, w.excess)
