"""Walls of solids: planes that cut the cell of one generator, found anew for each diagram (`own_planes.cl`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..geometry.wall_triangles import WallTriangles
from ..opencl.engine import Engine
from .bins import BinnedPoints
from .cut_cells import CutCells
from .device_diagram import Follow, Tessellation
from .part import Part
from .polyhedra import Polyhedra
from .stages import TessellationStages
from .steps import DomainSteps, Sort

FIRST_REACH = 1.6
"""How far the surface is searched about a new generator, in units of the local spacing of bins."""
MOST_OWN = 8
"""Room for patches near a generator. It is doubled if there are more."""
PLANES_PER_CELL = 1.0
"""First guess of own planes per generator."""


class OwnPlanes:
    """The box around a solid, and the planes of walls that cut the cells of generators in it: a `ClipBox`.

    Parameters
    ----------
    domain : Domain
        One with `wall_triangles`.
    size : callable, optional
        Target size near points (k, 3), (k,): normals are averaged over it, and planes are moved by the mean height of
        the surface over it. Without it planes touch the surface.

    Attributes
    ----------
    outside : int
        Number of generators outside of the patch that is nearest to them, in the latest diagram.
    """

    def __init__(
        self,
        engine: Engine,
        domain: Domain,
        walls: WallTriangles,
        size: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.engine, self.domain, self.outside = engine, domain, 0
        origin, scale = domain.frame
        self._walls = walls.arguments(engine, (origin, scale))
        self._normals = engine.upload(walls.planes(scale, size))
        self._most, self._n = MOST_OWN, 0
        self._counters = engine.empty(3, np.int32)
        self._labels, self._planes = engine.empty(0, np.int32), engine.empty((0, 4))

    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box."""
        return self.domain.device_corners(real)

    def clip_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the CLIP_BOX_ARGS of kernels."""
        corners = self.domain.device_corners(engine.real)
        return *corners, self._rows, self._labels, self._planes, self._found, self._reach

    def guess(self, binned: BinnedPoints, n: int) -> None:
        """Guess how far the surface must be known about each of `n` new generators."""
        engine = self.engine
        if n != self._n:
            self._rows = engine.empty((n, 2), np.int32)
            self._found, self._reach = engine.empty(n, np.float32), engine.empty(n, np.float32)
            self._n = n
        kernel = self._kernels.guess_reach
        engine.run_each(kernel, n, binned.items, binned.spacing, np.float32(FIRST_REACH), self._reach)

    @property
    def _kernels(self):  # noqa: ANN202
        return self.engine.kernels("tessellation/own_planes", {"MOST_OWN": self._most})

    def find(self, points: cla.Array) -> None:
        """Find the planes for the positions `points` (n, 3), as far as cells have reached."""
        engine, n = self.engine, self._n
        if not len(self._labels):
            self._reserve(int(PLANES_PER_CELL * n) + 64)
        while True:
            self._counters.fill(0)
            engine.run_each(
                self._kernels.find_own_planes,
                n,
                points,
                *self._walls,
                self._normals,
                self._reach,
                np.int32(len(self._labels)),
                self._rows,
                self._labels,
                self._planes,
                self._found,
                self._counters,
            )
            count, most, self.outside = self._counters.get().tolist()
            if most > self._most:
                self._most *= 2
            elif count > len(self._labels):
                self._reserve(count + count // 4)
            else:
                self.count = count
                return

    def _reserve(self, room: int) -> None:
        self._labels, self._planes = self.engine.empty(room, np.int32), self.engine.empty((room, 4))

    def look_farther(self, points: cla.Array) -> None:
        """Find the planes again, since cells reach farther than the surface was known."""
        self.find(points)


class SolidWalls(DomainSteps):
    """The steps in a solid: cells are cut by planes of their own.

    Parameters
    ----------
    size : callable, optional
        See `OwnPlanes`.
    """

    box: OwnPlanes

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        walls: WallTriangles,
        size: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        super().__init__(stages, domain)
        self.box = OwnPlanes(stages.engine, domain, walls, size)

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the part of the first `n` of `sites`."""
        return Part(n, n, sites, self.box)

    def find_walls(self, part: Part, binned: BinnedPoints, previous: Tessellation | None) -> None:
        """Find the planes that cut the cells of `part`."""
        if previous is None:
            self.box.guess(binned, part.n_own)
        self.box.find(part.points)

    def finish_updated(self, t: Tessellation, points: cla.Array, n: int) -> Tessellation | None:
        """Return `t` with its walls."""
        return t

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update `previous` incrementally; cells at walls are clipped anew."""

        def clip(cells: Polyhedra, cut: CutCells, report: cla.Array, _: int) -> None:
            cells.clip_rest(cut, report, self.box, sites, sort(), previous)

        self.box.find(sites)
        return self.stages.update.update(self.stages.cells, self.box, sites, previous, follow=follow, clip=clip)
