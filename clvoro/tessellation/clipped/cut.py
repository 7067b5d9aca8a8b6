"""The steps of a domain whose boundary cuts cells: ghost generators outside of it; convex cells, which are trimmed."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ...connectivity import rows_and_places
from ...geometry.polygon import BOUNDARY_SHIFTS, Polygon
from ...opencl.device_array import buffer_of
from ..device_diagram import Follow, Tessellation, read_report
from ..part import Part
from ..stages import TessellationStages
from ..steps import DomainSteps, Sort
from .boundary_crossings import Boundary, BoundaryError, Chords

PATIENCE = 3
"""Attempts that remove single ghost generators, before all are removed."""


CLEARANCE = 3.0
"""Least distance to the boundary, in spacings of the generators there."""
SAMPLED = 0.5
"""Distance of places along the boundary whose nearest generators all parts know, over the spacing of generators."""
GRADING = 1.5
"""Distance to the boundary over the spacing of ghost generators."""
MOST_BOXES = 1 << 20
_JITTER = 0.2  # of a spacing, so that no four lie on a circle


class Cut(DomainSteps):
    """The steps of one polygon.

    Ghost generators have cells, because the boundary is traced through them, but no values.

    - `spacing`: distance of generators near points (k, 2) of the boundary, (k,); see `graded_places`. None: no ghost
      generators. The diagram is the same, but slow to make where many generators surround a wide hole.
    - `straight`: measure cells with straight sides along the boundary, until `measure_exactly`; see `Trim.trim`.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Polygon,
        spacing: Callable[[np.ndarray], np.ndarray] | None,
        straight: bool = False,
    ) -> None:
        super().__init__(stages, domain)
        engine = stages.engine
        self._boundary, self._polygon, self._straight = Boundary(engine, domain), domain, straight
        origin, scale = domain.frame
        self._spacing = spacing
        found = np.empty((0, 2)) if spacing is None else graded_places(domain, spacing)
        self._ghosts = ((found - origin) / scale).astype(engine.real)
        self._removals = self.attempt = 0
        self._all: cla.Array | None = None

    @property
    def outside(self) -> np.ndarray:
        """The ghost generators in the device's coordinates, (g, 2)."""
        return self._ghosts

    @cached_property
    def landmarks(self) -> np.ndarray:
        """Places (k, 2) along the boundary and all over the domain, in the device's coordinates.

        All parts of a mesh know the generators nearest to them: so each can trace the whole boundary. Far from its own
        cells it traces cells that are nearly right, which is enough.
        """
        assert self._spacing is not None
        (origin, scale), edges = self._polygon.frame, self._polygon.oriented
        at, way = edges.vertices, edges.along
        for _ in range(2):
            h = np.asarray(self._spacing(at + way / 2), float)
            counts = np.ceil(np.hypot(*way.T) / (SAMPLED * h)).clip(1).astype(int)
            rows, place = rows_and_places(counts)
            way = way[rows] / counts[rows, None]
            at = at[rows] + place[:, None] * way
        inner = graded_places(self._polygon, self._spacing, inside=True)
        return (np.concatenate([at, inner]) - origin) / scale

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the first `n` of `sites` with the ghost generators."""
        if self._spacing is None:
            return super().extend(sites, n)
        engine, total = self.stages.engine, n + len(self._ghosts)
        if self._all is None or len(self._all) != total:
            self._all = engine.empty((total, self.domain.dim))
            if total > n:
                self._all[n:].set(self._ghosts)
        size = n * self.domain.dim * engine.real.itemsize
        cl.enqueue_copy(engine.queue, buffer_of(self._all), buffer_of(sites), byte_count=size)
        return Part(n, total, self._all, self.domain)

    def drop_ghosts(self) -> bool:
        """Remove all ghost generators: round-off at distant ones may make generators appear too close."""
        there = len(self._ghosts) > 0
        self._ghosts = self._ghosts[:0]
        return there

    def finish_updated(self, t: Tessellation, points: cla.Array, n: int, first: int = 0) -> Tessellation | None:
        """Clip the convex diagram `t` by the boundary; None if ghost generators had to be removed.

        `first` is the first attempt, and `attempt` the last one, which succeeds.

        Where many cells share a vertex that lies on a vertex of the boundary, their faces there are as short as
        round-off, and the tracing may fail. A boundary shifted by a few ulps crosses only one or two of these cells.
        """
        eps = float(np.finfo(self.stages.engine.real).eps)
        lost = BoundaryError()
        for self.attempt, far in list(enumerate((0, *BOUNDARY_SHIFTS)))[first:]:
            angle, length = 2 * self.attempt, far * eps
            shift = (length * math.cos(angle), length * math.sin(angle))
            try:
                # The search for the vertices starts from the cells of the previous call.
                chords = self._boundary.cut(t, n, shift)
                if isinstance(chords, Chords):
                    return self.stages.trim.trim(self._polygon, points, t, chords, n, self._straight)
            except BoundaryError as error:
                lost = error
                continue
            self._removals += 1
            keep = np.ones(len(self._ghosts), bool)
            keep[chords] = False
            self._ghosts = self._ghosts[keep & (self._removals < PATIENCE)]
            return None
        raise lost

    def measure_exactly(self, t: Tessellation) -> Tessellation:
        """Return `t` with the measures of cells up to the boundary."""
        if not self._straight:
            return t
        assert t.trimmed is not None
        return self.stages.trim.trim(self._polygon, t.points, t.trimmed.convex, t.trimmed.chords, t.n)

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update the convex diagram of `previous`, and clip it."""
        if previous.trimmed is None or previous.trimmed.convex.n != n + len(self._ghosts):
            return None
        part = self.extend(sites, n)
        t = super().update(part.points, part.count, previous.trimmed.convex, sort, read_report)
        t = None if t is None else self.finish_updated(t, sites, n)
        if t is not None:
            follow(t, None)
        return t


def graded_places(domain: Polygon, spacing: Callable[[np.ndarray], np.ndarray], inside: bool = False) -> np.ndarray:
    """Return ghost generators (s, 2) outside `domain`, inside the box that clips its cells; or such places `inside`.

    The convex cells of generators at the boundary reach far outside, up to the middle of a hole, and so does the search
    for their neighbors. Ghost generators bound these cells at little cost. They do not change the diagram inside the
    domain as long as none of their cells reaches into it; `boundary_crossings.py` checks this in each step.

    - `spacing`: distance of generators from their neighbors near points (k, 2) of the boundary, (k,).
    """
    lower, upper = domain.clip_box
    edge = float((upper - lower).max()) / 8
    counts = np.ceil((upper - lower) / edge).astype(int)
    centers = lower + edge * (np.indices(counts.tolist()).reshape(2, -1).T + 0.5)
    found: list[np.ndarray] = []
    children = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) / 4
    rng = np.random.Generator(np.random.PCG64(0))
    total = 0
    while len(centers) and total < MOST_BOXES:
        total += len(centers)
        nearest = domain.nearest_edge(centers)[1]
        distance = np.hypot(*(nearest - centers).T)
        outside = domain.contains(centers) == inside
        whole = distance > edge * np.sqrt(0.5)  # the boundary does not pass through the box
        clearance = CLEARANCE * np.asarray(spacing(nearest), float)
        small = edge <= distance / GRADING
        good = outside & whole & small
        taken = good & (distance >= clearance)
        shift = rng.uniform(-_JITTER, _JITTER, (np.count_nonzero(taken), 2)) * edge
        found.append(centers[taken] + shift)
        # Divide the others while a point at the least distance fits into them.
        reach = distance + edge * np.sqrt(0.5)
        divided = ~good & ~(~outside & whole) & (np.where(outside, reach, reach - distance) > clearance)
        edge /= 2
        centers = (centers[divided][:, None] + 2 * edge * children).reshape(-1, 2)
    points = np.concatenate(found)
    return points[np.all((points > lower) & (points < upper), axis=1)]
