"""Gradient descent of the cell quality in 3D, for the last steps of a run (`surface_descent.cl`)."""

from __future__ import annotations

import pyopencl.array as cla

from ...opencl.engine import Engine
from ...tessellation.device_diagram import Tessellation
from ..tuning import LONGEST_DESCENT


class SurfaceDescent:
    """The kernels of `surface_descent.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/descent/surface_descent")

    def descend(
        self,
        t: Tessellation,
        h: cla.Array,
        quality: cla.Array,
        lloyd: cla.Array,
        *,
        bad_cell_weight: float = 0.0,
        rate: float = 0.1,
    ) -> None:
        """Write the displacement ``-rate h^2 dE/dx`` to `lloyd` (n, 3), in place of the displacement to the centroid.

        It is at most `LONGEST_DESCENT` h.

        - `t`: with vertices.
        - `h`, `quality`: (n,) real
        - `bad_cell_weight`: the weight of a cell is omega = 1 - bad_cell_weight log Q.
        - `rate`: step length.
        """
        engine, k, real = self.engine, self._kernels, self.engine.real.type
        with engine.workspace.frame():
            forces = engine.scratch((t.rows, 2))
            cells = t.starts, t.face_measures, t.volumes, quality
            engine.run_each(k.compute_surface_forces, t.n, *cells, real(bad_cell_weight), forces)
            t.forward(engine, forces)
            faces = *t.graph, t.face_measures, t.face_centroids, t.vertices[0]
            limits = real(rate), real(LONGEST_DESCENT)
            engine.run_each(k.descend_surface, t.n, *faces, t.points, h, forces, *limits, lloyd, *engine.period_args)
