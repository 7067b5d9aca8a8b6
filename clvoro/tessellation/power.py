"""Power diagrams (Laguerre diagrams): Voronoi diagrams of generators with weights, the paper's (2.5).

V_i = { y : |y - x_i|^2 - w_i <= |y - x_j|^2 - w_j for all j } (Aurenhammer 1987, SIAM J. Comput. 16, 78). On the unit
sphere V_i = { y : exp(w_i / 2) x_i.y >= exp(w_j / 2) x_j.y for all j }, which is the same for small cells; faces are
arcs of great circles (Sugihara 2002, J. Geom. Graph. 6, 69). The kernels are those of Voronoi diagrams, built with
WEIGHTED (see geometry/weights.h, geometry/site.h).
"""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox, Domain
from ..opencl.primitives import Summaries
from .device_diagram import NeighborRows, Tessellation
from .stages import TessellationStages

CLOSED = 1e-12
"""Largest relative difference of the sum of volumes from that of the domain, where no part of a cell is missing."""
RINGS_FROM = 2000
"""Number of generators from which cells are searched in rings. For fewer, the build of its kernel takes longer."""
PROGRESS = 0.95
"""Ratio of the excess of two rounds above which the search begins anew."""


class Rings:
    """Generators with weights, and the search for the neighbors of a cell in rings around its neighbors so far.

    - `volume`: that of the domain, in normalized coordinates.
    """

    def __init__(self, stages: TessellationStages, domain: Domain) -> None:
        self.stages = stages
        engine = stages.engine
        self._kernels = engine.kernels("tessellation/power")
        self._arcs: cla.Array | None = None
        self._summaries = Summaries(engine, ("volume",))
        lower, upper = domain.device_corners(engine.real)
        given = domain.measure / domain.frame[1] ** engine.cell_dim
        of_box = float(np.prod((upper - lower)[: engine.dim].astype(float)))
        self._curved = domain.curved
        self._volume = given if self._curved else of_box
        self.volume = given if domain.cuts_cells else self._volume

    def attach(self, points: cla.Array, weights: cla.Array, n: int, most: cla.Array) -> cla.Array:
        """Return `points` (n, d) with `weights` (n,) in rows (n, d + 1); `most` becomes the key of the largest."""
        engine = self.stages.engine
        sites = engine.empty((n, engine.site_size))
        most.fill(np.iinfo(np.int32).min)
        engine.run_each(self._kernels.attach_weights, n, points, weights, sites, most)
        return sites

    def slopes(self, t: Tessellation) -> cla.Array:
        """Return what the matrix of -2 dV/dw takes for the measures of faces: on a sphere with `weigh_arcs`."""
        engine = self.stages.engine
        if not self._curved:
            return t.face_measures
        if self._arcs is None or len(self._arcs) < len(t.face_measures):
            self._arcs = engine.empty(len(t.face_measures), engine.face)
        faces = *t.graph, t.sites, t.face_measures, t.face_centroids
        engine.run_each(self._kernels.weigh_arcs, t.n, *faces, self._arcs)
        return self._arcs

    def search(
        self, box: ClipBox, sites: cla.Array, previous: NeighborRows, exact: bool, least: float
    ) -> tuple[Tessellation | None, bool]:
        """Return the diagram by way of the neighbors in `previous`, and whether a cell is smaller than `least`.

        The diagram is None if neighbors stay missing, and where there is no such search. Until all are found cells are
        too large, never too small. In a periodic box an image cuts off only what belongs to other cells. If one is
        missing, the volumes add up to more than that of the box.
        """
        cells = self.stages.ring_cells if previous.n >= RINGS_FROM else None
        rows, before = previous, np.inf
        while cells is not None:
            t = cells.clip_by_rings(box, sites, rows, exact)
            if t is None:
                break
            self._summaries.collect("volume", t.volumes, t.n)
            found = self._summaries.read_one("volume")
            if found.least < least:
                return None, True
            excess = abs(found.sum - self._volume)
            if excess <= CLOSED * self._volume:
                return t, False
            if not excess < PROGRESS * before:
                break
            rows, before = NeighborRows(t.n, *t.graph), excess
        return None, False
