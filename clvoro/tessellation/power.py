"""Power diagrams (Laguerre diagrams): Voronoi diagrams of generators with weights, the paper's (2.5).

V_i = { y : |y - x_i|^2 - w_i <= |y - x_j|^2 - w_j for all j } (Aurenhammer 1987, SIAM J. Comput. 16, 78). The kernels
are those of Voronoi diagrams, built with WEIGHTED (see geometry/weights.h).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..errors import InputError
from ..geometry.box import Box
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..opencl.primitives import Summaries
from .clipped.polygonal import PolygonTessellator
from .device_diagram import CloseError, NeighborRows, Tessellation
from .periodic.periodic_tessellator import ExtendedDiagram, PeriodicTessellator
from .polyhedra import Polyhedra
from .power_cells import PowerCells
from .stages import TessellationStages

CLOSED = 1e-12
"""Largest relative difference of the sum of volumes from that of the domain, where no part of a cell is missing."""
PROGRESS = 0.95
"""Ratio of the excess of two rounds above which the search begins anew."""


def require_power_domain(domain: Domain) -> None:
    """Raise InputError if there are no power diagrams in such a domain."""
    if not isinstance(domain, Polygon | Box):
        raise InputError(
            f"the domain is {domain}, expected a polygon or a box: there are no power diagrams in other domains"
        )


class PowerTessellator:
    """Tessellate one domain by generators with weights, repeatedly.

    Each call overwrites the `Tessellation` of the call before.

    Attributes
    ----------
    volume : float
        That of the domain, in normalized coordinates.

    Raises
    ------
    InputError
        If there are no power diagrams in such a domain.
    """

    def __init__(self, stages: TessellationStages, domain: Domain) -> None:
        require_power_domain(domain)
        self.stages, self.domain = stages.weighted, domain
        engine = self.stages.engine
        self._kernels = engine.kernels("tessellation/power")
        self._summaries = Summaries(engine, ("volume",))
        lower, upper = domain.device_corners(engine.real)
        self._volume = float(np.prod((upper - lower)[: engine.dim].astype(float)))
        self._most = engine.empty(1, np.int32)
        self._polygon = self._periodic = None
        if isinstance(domain, Box) and any(domain.periodic):
            self._periodic = PeriodicTessellator(self.stages, domain)
            self._most = self._periodic.halo.most
        self._complete: Tessellation | None = None
        self._by_rings = False
        if isinstance(domain, Polygon):
            # Weights would move the cells of ghost generators into the domain.
            self._polygon = PolygonTessellator(self.stages, domain, None)
            self.volume = domain.measure / domain.frame[1] ** 2
        else:
            self.volume = self._volume

    def tessellate(
        self,
        points: cla.Array,
        weights: cla.Array,
        n: int,
        exact: bool = False,
        previous: NeighborRows | None = None,
        least: float = 0.0,
        complete: bool = False,
    ) -> Tessellation | None:
        """Return the power diagram of `points` (n, d) with `weights` (n,), in normalized coordinates.

        Parameters
        ----------
        exact : bool
            As for `Cells.tessellate`.
        previous : NeighborRows, optional
            The graph of a diagram of similar weights, without empty cells: in 2D and float64 cells start from its
            neighbors. Far from its generator a cell is found much sooner than by a search around the generator.
        least : float
            With `previous`: None is returned as soon as a cell is known to be smaller.
        complete : bool
            In a periodic box, make the extended diagram as well, which `final` needs.

        Raises
        ------
        InputError
            If generators are too close to each other to be distinguished.
        """
        engine = self.stages.engine
        weighted = engine.empty((n, engine.site_size))
        self._most.fill(np.iinfo(np.int32).min)
        engine.run_each(self._kernels.attach_weights, n, points, weights, weighted, self._most)
        try:
            t, self._by_rings = None, True
            if previous is not None and engine.dim == 2 and engine.real == np.float64:
                t, too_small = self._from(weighted, previous, exact, least)
                if too_small:
                    return None
            if t is None:
                self._by_rings = False
                t = self._from_nothing(weighted, n, exact, complete)
        except CloseError:
            raise CloseError(points, n).within(self.domain) from None
        t = replace(t, points=points, weighted=weighted)
        self._complete = t if complete else None
        if self._polygon is None:
            return t
        clipped = self._polygon.clip(points, t, n)
        assert isinstance(clipped, Tessellation)
        return clipped

    def _from_nothing(self, weighted: cla.Array, n: int, exact: bool, complete: bool) -> Tessellation:
        stages = self.stages
        if self._periodic is not None:
            return self._periodic.tessellate(weighted, n, None, exact, nearest=False, keep_extended=complete)
        binned = stages.bins.build(self.domain, weighted, n)
        return stages.cells.tessellate(self.domain, weighted, n, binned, exact=exact)

    def _from(
        self, weighted: cla.Array, previous: NeighborRows, exact: bool, least: float
    ) -> tuple[Tessellation | None, bool]:
        """Return the diagram by way of the neighbors in `previous`, and whether a cell is smaller than `least`.

        The diagram is None if neighbors stay missing. Until all are found cells are too large, never too small.
        """
        box, cells, rows, before = self.domain, self.stages.cells, previous, np.inf
        if self._periodic is not None:
            # An image cuts off only what belongs to other cells. If one is missing, the volumes add up to
            # more than that of the box.
            box, cells = self._periodic.wide, self.stages.folded_cells
        assert isinstance(cells, PowerCells)
        while True:
            t = cells.clip_by_rings(box, weighted, rows, exact)
            if t is None:
                return None, False
            self._summaries.collect("volume", t.volumes, t.n)
            found = self._summaries.read_one("volume")
            if found.least < least:
                return None, True
            excess = abs(found.sum - self._volume)
            if excess <= CLOSED * self._volume:
                return t, False
            if not excess < PROGRESS * before:
                return None, False
            rows, before = NeighborRows(t.n, t.starts, t.neighbors), excess

    def laplacian_measures(self, t: Tessellation) -> cla.Array:
        """Return the face measures of the latest diagram `t` for a Poisson matrix (see `scale_far_measures`)."""
        if self._periodic is None or self._by_rings:
            return t.face_measures
        return self.stages.ghost_images.scale_far_measures(t, self._periodic.codes)

    @staticmethod
    def rows(t: Tessellation) -> NeighborRows:
        """Return a copy of the graph of `t`, for `previous`: in a polygon that of the cells before they are clipped."""
        whole = t if t.trimmed is None else t.trimmed.convex
        return NeighborRows(whole.n, whole.starts.copy(), whole.neighbors.copy())

    def final(self, t: Tessellation) -> tuple[Tessellation, ExtendedDiagram | None]:
        """Return the latest diagram `t` with faces in full precision, and, in a periodic box, its extended diagram."""
        cells = self.stages.cells
        if self._periodic is not None:
            return self._final_in_periodic_box(self._periodic, t)
        if self._polygon is not None or isinstance(cells, Polyhedra):
            return t, None
        return cells.measure_faces(self.domain, t), None

    def _final_in_periodic_box(
        self, periodic: PeriodicTessellator, t: Tessellation
    ) -> tuple[Tessellation, ExtendedDiagram]:
        if t is not self._complete:
            self.stages.clear_folded_cells()
            assert t.weighted is not None
            self._from_nothing(t.weighted, t.n, exact=True, complete=True)
        t = replace(periodic.measure_faces(), points=t.points, weighted=t.weighted)
        assert periodic.latest is not None
        whole = periodic.latest.tessellation
        positions = self.stages.engine.empty((whole.n, self.stages.engine.dim))
        self.stages.engine.run_each(self._kernels.detach_weights, whole.n, whole.points, positions)
        whole = replace(whole, points=positions, weighted=whole.points)
        return t, replace(periodic.latest, tessellation=whole)
