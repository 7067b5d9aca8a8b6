"""Pairs of generators on both sides of walls that are thinner than a cell (`thin_walls.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..geometry.polygon import Polygon
from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class ThinWalls:
    """The kernels of `thin_walls.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/thin_walls")

    def pair(
        self,
        domain: Polygon,
        t: Tessellation,
        h: cla.Array,
        points: cla.Array,
        velocity: cla.Array,
        labels: cla.Array,
        fixed: int,
    ) -> None:
        """Move generators on both sides of thin walls to be mirror images of each other.

        Parameters
        ----------
        t : Tessellation
            Diagram of the same generators before their last displacement.
        h : (n,) real
        points, velocity : (n, 2) real
            Both change by the same displacement.
        labels, fixed : (n,) int32, int
            Generators with labels below `fixed` do not move.
        """
        engine, k = self.engine, self._kernels
        assert t.trimmed is not None
        chords, convex = t.trimmed.chords, t.trimmed.convex
        u, n, args = chords.touched_count, np.int32(t.n), domain.device_args(engine)
        with engine.workspace.frame():
            partners, targets = engine.scratch(u, np.int32), engine.scratch((u, 2))
            engine.run_each(
                k.find_partners, u, chords.touched, n, convex.starts, convex.neighbors, t.starts, t.neighbors, points,
                h, labels, np.int32(fixed), *args, partners,
            )  # fmt: skip
            engine.run_each(
                k.place_pairs,
                u,
                chords.touched,
                n,
                chords.slots,
                partners,
                points,
                h,
                *args,
                targets,
            )
            engine.run_each(k.move_pairs, u, chords.touched, n, targets, points, velocity)
