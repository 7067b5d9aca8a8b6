"""The tessellation: every cell clipped by its neighbours and walls, its faces, volume and centroid (`cells.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ._primitives import Scan
from ._program import Engine
from .bins import MAX_LEVELS, BinnedPoints
from .domain import Box
from .errors import ClvoroError, InputError, MemoryLimitError

CELL_CAPACITY = 24
"""Faces that a cell may have while it is clipped."""
ROW_CAPACITY = 20
"""Faces that a cell may have in the end. Both are doubled where a mesh needs more."""
LARGEST_ROW = 512
FULL, COINCIDE = 1, 2  # of the bits in cells.cl; any other means cells that collapsed


@dataclass(frozen=True)
class Tessellation:
    """A Voronoi diagram on the device: normalised coordinates, vectors relative to the generator of the row.

    Attributes
    ----------
    n : int
    points : (n, d) real
    starts : (n + 1,) int32
    neighbours : (m,) int32
        A generator, or ``-1 - wall``; counter-clockwise in 2D.
    face_measures : (m,) real
    face_centroids : (m, d) real
        Relative to the generator.
    volumes : (n,) real
    offsets : (n, d) real
        Centroid minus generator: the Lloyd displacement.
    covariances : (n, d (d + 1) / 2) real
        Second moments about the centroid per unit volume: xx, xy, yy in 2D.
    """

    n: int
    points: cla.Array
    starts: cla.Array
    neighbours: cla.Array
    face_measures: cla.Array
    face_centroids: cla.Array
    volumes: cla.Array
    offsets: cla.Array
    covariances: cla.Array


class Cells:
    """Tessellate a box. Buffers are reused: a `Tessellation` lives until the second call after it."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._capacity = 0
        self._turn = 0
        self._n = 0
        self._rows, self._keep = engine.empty(1, np.int32), engine.empty(1, np.uint32)
        self._flags = engine.empty(2, np.int32)
        self._build(CELL_CAPACITY, ROW_CAPACITY)

    def _build(self, cell_capacity: int, row_capacity: int) -> None:
        self.cell_capacity, self.row_capacity = cell_capacity, row_capacity
        self._kernels = self.engine.kernels(
            "cells",
            {
                "CELL_CAPACITY": cell_capacity,
                "ROW_CAPACITY": row_capacity,
                "MAX_DEPTH": MAX_LEVELS,
            },
        )

    def _reserve(self, n: int) -> None:
        if n <= self._capacity:
            return
        engine, d = self.engine, self.engine.dim
        # A planar graph has at most 3 n - 6 edges, and every cell at most one face on each wall it touches.
        m = 7 * n + 8
        self._row_counts = engine.empty(n, np.int32)
        # Two sets in turn: the previous diagram stays valid, for a warm start and to compare neighbours.
        self._sets = [
            {
                "starts": engine.empty(n + 1, np.int32),
                "neighbours": engine.empty(m, np.int32),
                "face_measures": engine.empty(m),
                "face_centroids": engine.empty((m, d)),
                "volumes": engine.empty(n),
                "offsets": engine.empty((n, d)),
                "covariances": engine.empty((n, d * (d + 1) // 2)),
            }
            for _ in range(2)
        ]
        self._capacity = n
        self._views_for(n)

    def _views_for(self, n: int) -> None:
        """Cut the buffers to `n` cells (the faces' keep their spare room: their number is only known on the device)."""
        lengths = {"starts": n + 1, "volumes": n, "offsets": n, "covariances": n}
        self._views = [
            {name: a[: lengths[name]] if name in lengths else a for name, a in arrays.items()}
            for arrays in self._sets
        ]
        self._n = n

    def tessellate(
        self,
        box: Box,
        points: cla.Array,
        n: int,
        binned: BinnedPoints,
        previous: Tessellation | None = None,
    ) -> Tessellation:
        """Tessellate `box` by the first `n` of `points` (n, d), which lie in `binned`.

        Parameters
        ----------
        previous : Tessellation, optional
            A diagram of the same generators at earlier positions: clipping starts from its neighbours.

        Raises
        ------
        InputError
            If two generators coincide or are too close for the precision; names the first.
        MemoryLimitError
            If the rows of faces are too many for 32-bit indices.
        ClvoroError
            If a cell has more than `LARGEST_ROW` faces, or a little more.
        """
        engine = self.engine
        if self.row_capacity > ROW_CAPACITY and n * self.row_capacity > self._rows.size:
            # One mesh had a cell of very many faces; a larger one need not pay for that.
            self._build(CELL_CAPACITY, ROW_CAPACITY)
        self._reserve_rows(n)
        self._reserve(n)
        k = self._kernels
        lower, upper = box.device_corners(engine.real)
        if n != self._n:
            self._views_for(n)
        arrays = self._views[self._turn]
        warm = previous is not None and previous.n == n
        old = (
            (previous.starts, previous.neighbours)
            if previous is not None and warm
            else (self._row_counts, self._row_counts)
        )
        while True:
            self._flags.set(np.array([0, 2**31 - 1], np.int32))
            engine.run_each(
                k.clip_cells, n, binned.points, binned.items, binned.reach, binned.bins,
                binned.grid_frames, binned.grid_shapes, points, lower, upper, np.int32(warm),
                *old, self._rows, self._row_counts, self._flags,
            )  # fmt: skip
            engine.run_each(
                k.match_faces, n, self._rows, self._row_counts, points, lower, upper, self._keep,
                arrays["starts"], self._flags,
            )  # fmt: skip
            flags, generator = (int(v) for v in self._flags.get())
            if not flags & FULL:
                break
            self._enlarge(n)
            k = self._kernels
        if flags:
            self._refuse(flags, generator)
        self._scan.exclusive(arrays["starts"], arrays["starts"], n)
        engine.run_each(
            k.measure_cells, n, self._rows, self._row_counts, self._keep, arrays["starts"], points,
            lower, upper, arrays["neighbours"], arrays["face_measures"], arrays["face_centroids"],
            arrays["volumes"], arrays["offsets"], arrays["covariances"],
        )  # fmt: skip
        # Only now: a call that was broken off leaves the previous diagram as it is.
        self._turn = 1 - self._turn
        return Tessellation(n=n, points=points, **arrays)

    def _reserve_rows(self, n: int) -> None:
        """Make room for `n` rows of faces of the present capacity."""
        entries = n * self.row_capacity
        if entries >= 2**31:
            raise MemoryLimitError(
                f"{n} cells of up to {self.row_capacity} faces need {entries:.3g} entries, expected "
                "fewer than 2^31, which 32-bit indices can tell apart; use fewer cells, or perturb "
                "generators that lie on a common circle"
            )
        if entries > self._rows.size:
            self._rows = self.engine.empty(entries, np.int32)
        words = n * ((self.row_capacity + 31) // 32)
        if words > self._keep.size:
            self._keep = self.engine.empty(words, np.uint32)

    def _enlarge(self, n: int) -> None:
        """Double the capacities, for `n` cells."""
        if self.row_capacity >= LARGEST_ROW:
            raise ClvoroError(
                f"a cell has more than {self.row_capacity} faces; so many cocircular generators "
                "are not supported: remove or perturb some"
            )
        self._build(2 * self.cell_capacity, 2 * self.row_capacity)
        self._reserve_rows(n)

    def _refuse(self, flags: int, generator: int) -> None:
        what = "coincides with another" if flags & COINCIDE else "is too close to others"
        raise InputError(
            f"generator {generator} {what} in {self.engine.real}; expected distinct generators: "
            "remove duplicates (numpy.unique(points, axis=0)) or use dtype='float64'"
        )
