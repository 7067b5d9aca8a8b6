"""Gradient descent of the cell quality in 2D, for the last steps of a run (`quality_descent.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class QualityDescent:
    """The kernels of `quality_descent.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/quality_descent")

    def descend(
        self,
        t: Tessellation,
        h: cla.Array,
        quality: cla.Array,
        lloyd: cla.Array,
        *,
        bad_cell_weight: float = 5.0,
        rate: float = 0.1,
        max_displacement: float = 0.2,
    ) -> None:
        """Write the displacement ``-rate h^2 dE/dx`` to `lloyd` (n, 2), in place of the displacement to the centroid.

        Parameters
        ----------
        h, quality : (n,) real
        bad_cell_weight : float
            Factor in the weight omega = 1 - bad_cell_weight log Q of a cell.
        rate : float
            Step length.
        max_displacement : float
            Largest displacement over h.
        """
        engine, k, real = self.engine, self._kernels, self.engine.real.type
        with engine.workspace.frame():
            tension, pressure = engine.scratch(t.n), engine.scratch(t.n)
            engine.run(
                k.compute_tension_pressure, -(-t.n // 4), np.int32(t.n), t.starts, t.face_measures, t.volumes,
                quality, real(bad_cell_weight), tension, pressure,
            )  # fmt: skip
            engine.run_each(
                k.descend_quality, t.n, t.starts, t.neighbors, t.face_measures, t.face_centroids,
                t.points, tension, pressure, h, real(rate), real(max_displacement), lloyd, *t.outlines,
                *engine.period_args,
            )  # fmt: skip
