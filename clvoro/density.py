"""The size field as a density rho = h^-d: cell excess, grad log h and weighted centroids (`density.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ._primitives import Summaries
from ._program import Engine
from .cells import Tessellation


@dataclass(frozen=True)
class Weighting:
    """What the size field asks of each cell, on the device.

    Attributes
    ----------
    density : (n,) real
        rho = h^-d.
    weight : (n,) real
        V rho: how many generators the cell should hold.
    excess : (n,) real
        log(V rho) = d log(L / h): the cell is too large by this share of its volume.
    gradient : (n, d) real
        grad log h, fitted to the neighbours' h.
    lloyd : (n, d) real
        Displacement to the centroid weighted by h^-(d + 2).
    """

    density: cla.Array
    weight: cla.Array
    excess: cla.Array
    gradient: cla.Array
    lloyd: cla.Array


class Density:
    """The kernels of `density.cl`. Buffers are reused: a `Weighting` lives until the next call."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("density")
        self._sums = Summaries(engine, ("weighed", "weight"))
        self._n = -1

    def evaluate(self, t: Tessellation, h: cla.Array) -> Weighting:
        """Return the weighting of `t` for sizes `h` (n,)."""
        engine, k, n, d = self.engine, self._kernels, t.n, self.engine.dim
        if n != self._n:
            self._n = n
            self._log_h, self._weighed = engine.empty(n), engine.empty(n)
            self._weighting = Weighting(
                *(engine.empty(n) for _ in range(3)), *(engine.empty((n, d)) for _ in range(2))
            )
        w = self._weighting
        engine.run(
            k.evaluate_density, -(-n // 4), np.int32(n), t.volumes, h, w.density, w.weight,
            w.excess, self._log_h,
        )  # fmt: skip
        engine.run_each(
            k.fit_gradient, n, t.starts, t.neighbours, t.points, self._log_h, w.gradient
        )
        engine.run_each(k.weight_offsets, n, t.offsets, t.covariances, w.gradient, w.lloyd)
        return w

    def remove_mean(self, w: Weighting) -> None:
        """Take the mean of ``w.excess``, weighted by ``w.weight``, away from it."""
        n = self._n
        self.engine.run_each(self._kernels.weigh_excess, n, w.weight, w.excess, self._weighed)
        self._sums.collect_all({"weighed": self._weighed, "weight": w.weight}, n)
        self.engine.run_each(self._kernels.remove_mean, n, self._sums.values, w.excess)
