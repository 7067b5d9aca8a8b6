"""The diagram of a polygonal domain: convex cells of generators and sentinels, trimmed by the boundary."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ...geometry.polygon import BOUNDARY_SHIFTS, Polygon
from ...opencl.device_array import buffer_of
from ..bins import BinnedPoints
from ..device_diagram import CloseError, Tessellation
from ..stages import TessellationStages, tessellate_box
from .boundary_crossings import Boundary, BoundaryError, Chords
from .ghost_generators import place_sentinels

PATIENCE = 3
"""Times that sentinels are taken away one by one, before all are."""


class PolygonTessellator:
    """Tessellate one polygon again and again; see `Tessellator`, whose part for polygons it is.

    Parameters
    ----------
    spacing : callable or None
        Distance of generators near points (k, 2) of the boundary, (k,); see `place_sentinels`. Without it there are no
        sentinels: what is right in any case, and slow where many generators stand around a wide hole.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Polygon,
        spacing: Callable[[np.ndarray], np.ndarray] | None,
    ) -> None:
        self.stages, self.domain = stages, domain
        self.engine = stages.engine
        self._boundary = Boundary(self.engine, domain)
        origin, scale = domain.frame
        found = np.empty((0, 2)) if spacing is None else place_sentinels(domain, spacing)
        self._sentinels = ((found - origin) / scale).astype(self.engine.real)
        self._taken_away = 0
        self._all: cla.Array | None = None

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None,
        exact: bool,
        binned: BinnedPoints | None = None,
    ) -> Tessellation:
        """Tessellate; see `Tessellator.tessellate`."""
        stages, domain = self.stages, self.domain
        convex = previous.trimmed.convex if previous is not None and previous.trimmed else None
        while True:
            total = n + len(self._sentinels)
            if self._all is None or len(self._all) != total:
                self._all = self.engine.empty((total, 2))
                if total > n:
                    self._all[n:].set(self._sentinels)
                convex = None
            cl.enqueue_copy(
                self.engine.queue,
                buffer_of(self._all),
                buffer_of(points),
                byte_count=2 * n * self.engine.real.itemsize,
            )
            if total > n:
                binned = None  # sentinels are not among these
            try:
                convex = tessellate_box(stages, domain, self._all, total, convex, exact, binned)
            except CloseError:
                if total == n:
                    raise
                # From far away generators may look too close to each other, which without sentinels nobody sees.
                self._sentinels = self._sentinels[:0]
                continue
            found = self._cut_out(points, convex, n)
            if isinstance(found, Tessellation):
                return found
            self._taken_away += 1
            keep = np.ones(len(self._sentinels), bool)
            keep[found] = False
            self._sentinels = self._sentinels[keep & (self._taken_away < PATIENCE)]
            convex = None

    def _cut_out(
        self, points: cla.Array, convex: Tessellation, n: int
    ) -> Tessellation | np.ndarray:
        """Return the diagram of `points` (n, 2) that the boundary leaves of `convex`, or sentinels that are in its way.

        Where very many cells meet at one vertex of the boundary, their faces there are as rounding has it, and no edge
        may find its way through them. A little aside there are one or two of them.
        """
        eps = float(np.finfo(self.engine.real).eps)
        lost = BoundaryError()
        for attempt, far in enumerate((0, *BOUNDARY_SHIFTS)):
            angle, length = 2 * attempt, far * eps
            shift = (length * math.cos(angle), length * math.sin(angle))
            try:
                # The vertices of the boundary are found from the cells that held them before, or from the least.
                chords = self._boundary.cut(convex, n, shift)
                if not isinstance(chords, Chords):
                    return chords
                return self.stages.trim.trim(self.domain, points, convex, chords, n)
            except BoundaryError as error:
                lost = error
        raise lost
