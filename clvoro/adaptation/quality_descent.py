"""Descent of cell quality itself (`shape.cl`), for the last steps, where Lloyd's centroids no longer help."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class Shape:
    """The kernels of `shape.cl`."""

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
        emphasis: float = 5.0,
        rate: float = 0.1,
        longest: float = 0.2,
    ) -> None:
        """Write the displacement ``-rate h^2 dE/dx`` to `lloyd` (n, 2), in the place of Lloyd's.

        Parameters
        ----------
        h, quality : (n,) real
        emphasis : float
            Weight of bad cells: omega = 1 + emphasis (-log Q).
        longest : float
            Bound of the displacement over h.
        """
        engine, k, real = self.engine, self._kernels, self.engine.real.type
        with engine.workspace.frame():
            tension, pressure = engine.scratch(t.n), engine.scratch(t.n)
            engine.run(
                k.load_cells, -(-t.n // 4), np.int32(t.n), t.starts, t.face_measures, t.volumes,
                quality, real(emphasis), tension, pressure,
            )  # fmt: skip
            engine.run_each(
                k.descend_shape, t.n, t.starts, t.neighbors, t.face_measures, t.face_centroids,
                t.points, tension, pressure, h, real(rate), real(longest), lloyd, *t.outlines,
                *engine.period_args,
            )  # fmt: skip
