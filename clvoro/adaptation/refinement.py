"""Refinement from a mesh for 2h to one for h: new generators at the midpoints of Delaunay edges (`refinement.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla
import scipy

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from ..tessellation.device_diagram import Tessellation
from .tuning import CHECKED, CHECKED_PER_EDGE, COINCIDENT, SHORT_FACE


def most_checked(domain: Domain) -> int:
    """Return the number of new and old generators up to which coincident ones are looked for."""
    edges = domain.cutting_edges
    return max(CHECKED, CHECKED_PER_EDGE * edges) if edges else 0


class Refinement:
    """The kernels of `refinement.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("adaptation/refinement", {"SHORT_FACE": SHORT_FACE})

    def refine(
        self, domain: Domain, t: Tessellation, h: cla.Array, labels: cla.Array | None = None, fixed: int = 0
    ) -> cla.Array:
        """Return about 2^d times as many generators, (n', d): those of `t`, then the new ones.

        - `h` (n,) real: size on the new level, at the generators of `t`.
        - `labels`: (n,) int32
        - `fixed`: generators with labels below `fixed`, and edges that end in them, get no new generators.
        """
        engine, k, n = self.engine, self._kernels, t.n
        fixed_args = *t.fixed_args(engine, labels, fixed), *t.name_args
        starts = self._child_starts(t, *fixed_args)
        finer = engine.empty((n + int(starts[n].get()), engine.dim))
        cells = *t.graph, t.face_measures, t.volumes, t.points
        made = starts, finer, t.face_centroids, *t.outlines
        engine.run_each(
            k.place_new_generators, n, *cells, *fixed_args, h, np.int32(n), *domain.device_args(engine), *made
        )
        # Several cells that are much larger than the edges of the boundary can bring one at the same corner.
        if len(finer) <= most_checked(domain):
            return self._without_coincident(finer, n)
        return finer

    def _without_coincident(self, finer: cla.Array, n: int) -> cla.Array:
        """Return the generators without new ones (from row `n` on) that coincide with others."""
        host = finer.get()
        pairs = scipy.spatial.KDTree(host).query_pairs(COINCIDENT * np.finfo(host.dtype).eps, output_type="ndarray")
        close = np.unique(pairs.max(axis=1))
        close = close[close >= n]
        return self.engine.upload(np.delete(host, close, axis=0)) if len(close) else finer

    def count(self, t: Tessellation) -> int:
        """Return the number of generators after `refine`."""
        return t.n + int(self._child_starts(t, *t.fixed_args(self.engine, None, 0), *t.name_args)[t.n].get())

    def _child_starts(self, t: Tessellation, *fixed_args: object) -> cla.Array:
        """Return the prefix sums (n + 1,) int32 of the numbers of new generators."""
        starts = self.engine.empty(t.n + 1, np.int32)
        self.engine.run_each(
            self._kernels.count_new_generators, t.n, *t.graph, t.face_measures, t.volumes, *fixed_args, starts
        )
        self._scan.exclusive(starts, starts, t.n)
        return starts
