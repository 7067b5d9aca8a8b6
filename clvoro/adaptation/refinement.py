"""Coarse to fine: a mesh for 2h becomes one for h by the middles of its Delaunay edges (`refinement.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla
from scipy.spatial import KDTree

from ..geometry.box import Domain
from ..geometry.polygon import Polygon
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from ..tessellation.device_diagram import Tessellation

SHORT_FACE = 0.02
"""Share of a cell's length (squared in 3D) under which a face is an accident that deserves no new generator."""
CLOSE, MOST_LOOKED_AT = 256, 5000
"""Roundings of positions within which new generators of polygons count as the same; how many may be looked at on the
host for that: cells of larger meshes are smaller than that could happen to."""


class Refinement:
    """The kernels of `refinement.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("adaptation/refinement", {"SHORT_FACE": SHORT_FACE})

    def refine(
        self,
        domain: Domain,
        t: Tessellation,
        h: cla.Array,
        labels: cla.Array | None = None,
        fixed: int = 0,
    ) -> cla.Array:
        """Return about 2^d times as many generators, (n', d): those of `t` first, then the new ones.

        Parameters
        ----------
        h : (n,) real
            Size on the new level, at the generators of `t`.
        labels : (n,) int32, optional
        fixed : int
            Generators of smaller labels, and edges that end in them, bring no new ones.
        """
        engine, k, n = self.engine, self._kernels, t.n
        still = t.starts if labels is None else labels, np.int32(fixed)
        firsts = self._children(t, *still)
        finer = engine.empty((n + int(firsts[n].get()), engine.dim))
        engine.run_each(
            k.place_children, n, t.starts, t.neighbors, t.face_measures, t.volumes, t.points, *still, h,
            np.int32(n), *domain.device_args(engine), firsts, finer,
            t.face_centroids, *t.outlines,
        )  # fmt: skip
        # Where cells are much larger than what their boundary is made of, several may bring one at the same corner.
        if isinstance(domain, Polygon) and len(finer) <= MOST_LOOKED_AT:
            return self._apart(finer, n)
        return finer

    def _apart(self, finer: cla.Array, n: int) -> cla.Array:
        """Return the generators without new ones, from row `n` on, that all but coincide with others."""
        host = finer.get()
        pairs = KDTree(host).query_pairs(CLOSE * np.finfo(host.dtype).eps, output_type="ndarray")
        close = np.unique(pairs.max(axis=1))
        close = close[close >= n]
        return self.engine.upload(np.delete(host, close, axis=0)) if len(close) else finer

    def count(self, t: Tessellation) -> int:
        """Return how many generators `refine` would make of `t`."""
        return t.n + int(self._children(t, t.starts, np.int32(0))[t.n].get())

    def _children(self, t: Tessellation, labels: cla.Array, fixed: np.int32) -> cla.Array:
        """Return the prefix sums (n + 1,) int32 of how many new generators each one brings."""
        firsts = self.engine.empty(t.n + 1, np.int32)
        self.engine.run_each(
            self._kernels.count_new_generators, t.n, t.starts, t.neighbors, t.face_measures, t.volumes,
            labels, fixed, firsts,
        )  # fmt: skip
        self._scan.exclusive(firsts, firsts, t.n)
        return firsts
