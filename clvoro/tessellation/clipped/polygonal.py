"""The diagram of a polygonal domain: convex cells of generators and ghost generators, clipped by the boundary."""

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
from .ghost_generators import place_ghost_generators

PATIENCE = 3
"""Attempts that remove single ghost generators, before all are removed."""


class PolygonTessellator:
    """Tessellate one polygon repeatedly: the part of `Tessellator` for polygons.

    Parameters
    ----------
    spacing : callable or None
        Distance of generators near points (k, 2) of the boundary, (k,); see `place_ghost_generators`. None: no ghost
        generators. The diagram is the same, but slow to make where many generators surround a wide hole.
    """

    def __init__(
        self, stages: TessellationStages, domain: Polygon, spacing: Callable[[np.ndarray], np.ndarray] | None
    ) -> None:
        self.stages, self.domain = stages, domain
        self.engine = stages.engine
        self._boundary = Boundary(self.engine, domain)
        origin, scale = domain.frame
        found = np.empty((0, 2)) if spacing is None else place_ghost_generators(domain, spacing)
        self._ghosts = ((found - origin) / scale).astype(self.engine.real)
        self._removals = 0
        self._all: cla.Array | None = None

    def tessellate(
        self, points: cla.Array, n: int, previous: Tessellation | None, exact: bool, binned: BinnedPoints | None = None
    ) -> Tessellation:
        """Tessellate; see `Tessellator.tessellate`."""
        stages, domain = self.stages, self.domain
        convex = previous.trimmed.convex if previous is not None and previous.trimmed else None
        while True:
            total = n + len(self._ghosts)
            if self._all is None or len(self._all) != total:
                self._all = self.engine.empty((total, 2))
                if total > n:
                    self._all[n:].set(self._ghosts)
                convex = None
            cl.enqueue_copy(
                self.engine.queue, buffer_of(self._all), buffer_of(points), byte_count=2 * n * self.engine.real.itemsize
            )
            if total > n:
                binned = None  # without the ghost generators
            try:
                convex = tessellate_box(stages, domain, self._all, total, convex, exact, binned)
            except CloseError:
                if total == n:
                    raise
                # Round-off at distant ghost generators may make generators appear too close. Try without ghosts.
                self._ghosts = self._ghosts[:0]
                continue
            found = self.clip(points, convex, n)
            if isinstance(found, Tessellation):
                return found
            self._removals += 1
            keep = np.ones(len(self._ghosts), bool)
            keep[found] = False
            self._ghosts = self._ghosts[keep & (self._removals < PATIENCE)]
            convex = None

    def clip(self, points: cla.Array, convex: Tessellation, n: int) -> Tessellation | np.ndarray:
        """Clip `convex` by the boundary; return the diagram of `points` (n, 2), or the ghost generators to remove.

        Where many cells share a vertex that lies on a vertex of the boundary, their faces there are as short as
        round-off, and the tracing may fail. A boundary shifted by a few ulps crosses only one or two of these cells.
        """
        eps = float(np.finfo(self.engine.real).eps)
        lost = BoundaryError()
        for attempt, far in enumerate((0, *BOUNDARY_SHIFTS)):
            angle, length = 2 * attempt, far * eps
            shift = (length * math.cos(angle), length * math.sin(angle))
            try:
                # The search for the vertices starts from the cells of the previous call.
                chords = self._boundary.cut(convex, n, shift)
                if not isinstance(chords, Chords):
                    return chords
                return self.stages.trim.trim(self.domain, points, convex, chords, n)
            except BoundaryError as error:
                lost = error
        raise lost
