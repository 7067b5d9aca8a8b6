"""Coarse to fine: a mesh for 2h becomes one for h by the middles of its Delaunay edges (`refinement.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ._primitives import Scan
from ._program import Engine
from .cells import Tessellation
from .domain import Box

SHORT_FACE = 0.02
"""Share of a cell's length (squared in 3D) under which a face is an accident that deserves no new generator."""


class Refinement:
    """The kernels of `refinement.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("refinement", {"SHORT_FACE": SHORT_FACE})

    def refine(self, box: Box, t: Tessellation, h: cla.Array) -> cla.Array:
        """Return about 2^d times as many generators, (n', d): those of `t` first, then the new ones.

        Parameters
        ----------
        h : (n,) real
            Size on the new level, at the generators of `t`.
        """
        engine, k, n = self.engine, self._kernels, t.n
        firsts = engine.empty(n + 1, np.int32)
        engine.run_each(
            k.count_children, n, t.starts, t.neighbours, t.face_measures, t.volumes, firsts
        )
        self._scan.exclusive(firsts, firsts, n)
        finer = engine.empty((n + int(firsts[n].get()), engine.dim))
        engine.run_each(
            k.place_children, n, t.starts, t.neighbours, t.face_measures, t.volumes, t.points, h,
            np.int32(n), *box.device_corners(engine.real), firsts, finer,
        )  # fmt: skip
        return finer
