"""Walls of solids: planes that cut the cell of one generator, found anew for each diagram (`own_planes.cl`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox, Domain
from ..geometry.wall_triangles import WallTriangles
from ..opencl.engine import Engine
from ..opencl.kernels import Kernels
from .bins import BinnedPoints

FIRST_REACH = 1.6
"""How far the surface is searched about a new generator, in units of the local spacing of bins."""
SIDES_OF_BOX = -(2**30)
"""Labels of the sides of the box around a solid are less."""
MOST_OWN = 8
"""Room for patches near a generator. It is doubled if there are more."""
PLANES_PER_CELL = 1.0
"""First guess of own planes per generator."""


class SolidBox(ClipBox):
    """The box around a solid, and the planes of walls that cut the cells of generators in it.

    - `domain`: one with `wall_triangles`.
    - `size`: target size near points (k, 3), (k,): normals are averaged over it, and planes are moved by the mean
      height of the surface over it. Without it planes touch the surface.

    Its attributes:
    - `plane_count`: number of planes when they were last counted.
    """

    def __init__(
        self,
        engine: Engine,
        domain: Domain,
        walls: WallTriangles,
        size: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.engine, self.domain = engine, domain
        self._walls = walls.arguments(engine, domain.frame)
        self._tree = walls.tree_arguments(engine, domain.frame)
        self._normals = engine.upload(walls.corner_normals(domain.frame[1], size))
        self._most, self._n = MOST_OWN, 0
        self._counters = engine.zeros(3, np.int32)
        self._rows, self._reach = engine.empty((0, 2), np.int32), engine.empty(0, np.float32)
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
        engine, self._n = self.engine, n
        if n > len(self._reach):
            room = n + n // 8
            self._rows = engine.empty((room, 2), np.int32)
            self._found, self._reach = engine.empty(room, np.float32), engine.empty(room, np.float32)
        kernel = self._kernels.guess_reach
        engine.run_each(kernel, n, binned.items, binned.spacing, np.float32(FIRST_REACH), self._reach)

    @property
    def _kernels(self) -> Kernels:
        return self.engine.kernels("tessellation/own_planes", {"MOST_OWN": self._most})

    def find(self, points: cla.Array) -> None:
        """Find the planes for the positions `points` (n, 3), as far as cells have reached, and have room for them."""
        if not len(self._labels):
            self._reserve(int(PLANES_PER_CELL * self._n) + 64)
        self.follow(points)
        while self._grow():
            self.follow(points)

    def follow(self, points: cla.Array) -> None:
        """Find the planes for the positions `points` (n, 3), if there is room; otherwise `look_farther` makes it.

        Nothing is read. Where there is no room, cells are flagged as those of which the surface is not known.
        """
        self._counters.fill(0)
        walls = *self._walls, *self._tree, self._normals, self._reach
        found = np.int32(len(self._labels)), self._rows, self._labels, self._planes, self._found, self._counters
        self.engine.run_each(self._kernels.find_own_planes, self._n, points, *walls, *found)

    def _grow(self) -> bool:
        """Make room for all planes that were found; return whether there was too little."""
        count, most, _ = self._counters.get().tolist()
        self.plane_count = count
        if most > self._most:
            self._most *= 2
        elif count > len(self._labels):
            self._reserve(count + count // 4)
        else:
            return False
        return True

    def _reserve(self, room: int) -> None:
        self._labels, self._planes = self.engine.empty(room, np.int32), self.engine.empty((room, 4))

    @property
    def outside(self) -> int:
        """Number of generators outside of the patch that is nearest to them, in the latest diagram."""
        return int(self._counters.get()[2])

    def look_farther(self, points: cla.Array) -> bool:
        """Find the planes again, since cells reach farther than the surface was known; return if there was no room."""
        lost = self._grow()
        self.find(points)
        return lost


class SurfaceSearch:
    """Finds the nearest triangles of the surface of a solid."""

    def __init__(self, engine: Engine, domain: Domain, walls: WallTriangles) -> None:
        self._engine, self._frame, self._walls = engine, domain.frame, walls

    def nearest(self, points: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
        """Return the triangle nearest to each of `points` (k, 3) within `reach`, (k,) or a number; else -1; (k,) int.

        Among triangles as near as one another to round-off of the device it may be any.
        """
        engine, (origin, scale) = self._engine, self._frame
        found = engine.empty(len(points), np.int32)
        if not len(points):
            return np.zeros(0, np.int64)
        engine.run_each(
            engine.kernels("tessellation/own_planes", {"MOST_OWN": MOST_OWN}).find_nearest_triangles,
            len(points),
            engine.upload((points - origin) / scale),
            engine.upload(np.broadcast_to(np.minimum(reach / scale, float(np.finfo(np.float32).max) / 4), len(points))),
            *self._walls.arguments(engine, self._frame),
            *self._walls.tree_arguments(engine, self._frame),
            found,
        )
        item = found.get().astype(np.int64)
        return np.where(item < 0, -1, self._walls.items[item])
