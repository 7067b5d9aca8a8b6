"""The diagram of a polygonal domain: convex cells of generators and sentinels, trimmed by the boundary."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ._device_array import buffer_of
from .bins import BinnedPoints
from .chords import Boundary
from .polygon import Polygon
from .sentinels import place_sentinels
from .stages import Stages, tessellate_box
from .tessellation import Tessellation

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
        stages: Stages,
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
            convex = tessellate_box(stages, domain, self._all, total, convex, exact, binned)
            # The vertices of the boundary are found from the cells that held them before, or from the least.
            chords = self._boundary.cut(convex, n)
            if not isinstance(chords, np.ndarray):
                return stages.trim.trim(domain, points, convex, chords, n)
            self._taken_away += 1
            keep = np.ones(len(self._sentinels), bool)
            keep[chords] = False
            self._sentinels = self._sentinels[keep & (self._taken_away < PATIENCE)]
            convex = None
