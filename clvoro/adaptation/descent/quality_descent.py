"""Gradient descent in 2D: better cell shapes, no short edges, no generators close to each other (`quality_descent.cl`).

The last steps of a run use it. On a sphere obtuse Delaunay triangles are opened in the end, for models on C grids.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...opencl.device_array import read_number
from ...opencl.engine import Engine
from ...opencl.primitives import Scan
from ...tessellation.device_diagram import Tessellation
from ..tuning import FULL_RATE, LONGEST_DESCENT


@dataclass(frozen=True)
class Repulsion:
    """The energy ``stiffness / 2 max(0, length - l / h)^2`` of two points at the distance l."""

    length: float
    """Distance over h below which they are pushed apart."""
    stiffness: float


SHORT_EDGES = Repulsion(0.2, 2.0)
"""How both ends of an edge repel each other.

In a step the length of an edge between four cells on a square changes by up to 4 rate stiffness times the length that
is missing.
"""
CLOSE_PAIRS = Repulsion(0.5, 3.0)
"""How neighboring generators repel each other. In a hexagonal lattice they are 1.07 h apart."""


class QualityDescent:
    """The kernels of `quality_descent.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("adaptation/descent/quality_descent")

    def descend(
        self,
        t: Tessellation,
        h: cla.Array,
        quality: cla.Array,
        lloyd: cla.Array,
        *,
        quality_weight: float = 1.0,
        bad_cell_weight: float = 5.0,
        rate: float = 0.1,
    ) -> None:
        """Write the displacement ``-rate h^2 dE/dx`` to `lloyd` (n, 2), in place of the displacement to the centroid.

        It is at most `LONGEST_DESCENT` h. Beyond `FULL_RATE` the rate is smaller.

        - `h`, `quality`: (n,) real
        - `quality_weight`, `bad_cell_weight`: the weight of a cell is omega = quality_weight (1 - bad_cell_weight log
          Q).
        - `rate`: step length.
        """
        engine, k, real = self.engine, self._kernels, self.engine.real.type
        with engine.workspace.frame():
            forces, rows = engine.scratch((t.rows, 4)), t.whole or t
            assert rows.n == t.rows, "rows of neighbors are read"
            cells = t.starts, t.face_measures, t.volumes, quality, h
            weights = real(quality_weight), real(bad_cell_weight)
            engine.run(k.compute_cell_forces, -(-t.n // 4), np.int32(t.n), *cells, *weights, forces)
            t.forward(engine, forces)
            faces = *rows.graph, rows.face_measures, rows.face_centroids
            edges, pairs = SHORT_EDGES, CLOSE_PAIRS
            repulsions = edges.length, edges.stiffness, pairs.length, pairs.stiffness
            limits = map(real, (rate, LONGEST_DESCENT, *repulsions, FULL_RATE))
            moved = lloyd, *t.outlines, *engine.period_args
            engine.run_each(k.descend_quality, t.n, *faces, t.points, forces, *limits, *moved)

    def open_triangles(self, t: Tessellation, displacement: cla.Array) -> int:
        """Write the displacement (n, d) that opens obtuse Delaunay triangles; return their number.

        Without any the displacement is zero.
        """
        engine, n = self.engine, t.n
        with engine.workspace.frame():
            counts, sums = (engine.scratch(n + 1, np.int32) for _ in range(2))
            engine.run_each(
                self._kernels.open_obtuse_triangles, n, *t.graph, t.points, displacement, counts, *engine.period_args
            )
            self._scan.exclusive(counts, sums, n)
            return read_number(sums, n)
