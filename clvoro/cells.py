"""The tessellation: each cell cut by neighbours and walls, its faces and moments (`cells.cl`; `hulls.cl` on CPUs)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ._primitives import Scan
from ._program import Engine
from .bins import MAX_LEVELS, BinnedPoints
from .domain import Box
from .errors import ClvoroError, InputError, MemoryLimitError

if TYPE_CHECKING:
    from .trim import Trimmed

CELL_CAPACITY = 24
"""Faces that a cell may have while it is clipped."""
ROW_CAPACITY = 20
"""Faces that a cell may have in the end. Both are doubled where a mesh needs more."""
LARGEST_ROW = 512
LANES, WRAP_GROUP = 8, 16
"""Cells that a CPU's work-item makes at a time (`hulls.cl`), and its work-items per group."""
FIRST_REACH = 2.0
"""How far it looks for neighbours at first, in edges of a bin."""
EXACT_SHARE, ROUGH_SHARE = 0.01, 0.5
"""Share of a cell that rounding may make uncertain: in a diagram, and on a run's way, where all will move again."""
# FULL and COINCIDE are bits of common/face_rows.h, whose other one means cells that collapsed.
FULL, COINCIDE, DOUBT, NARROW = 1, 2, 8, 16


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
    outlines : tuple of arrays
        Of a diagram trimmed by a boundary what kernels take as OUTLINE_ARGS (common/outline.h); else empty.
    trimmed : Trimmed, optional
        How such a diagram came to be.
    narrow : bool
        Whether faces (in 3D) may be as narrow as their vertices round: of those, what has no loop in `Loops` is none.
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
    outlines: tuple[cla.Array, ...] = ()
    trimmed: Trimmed | None = None
    narrow: bool = False


@dataclass
class FaceRows:
    """Lists of faces while a diagram is made, on the device; see `common/face_rows.h`.

    Attributes
    ----------
    slots : (>= s * row_capacity,) int32
    counts : (n,) int32
        Faces in each slot; negative where rounding leaves a doubt.
    keep : uint32
        Bits of the faces that both cells see.
    places : (n,) int32
        Slot of each row, or -1 if it is as before.
    flags : (3,) int32
        What went wrong, the first generator concerned, and whether any cell is doubtful.
    """

    slots: cla.Array
    counts: cla.Array
    keep: cla.Array
    places: cla.Array
    flags: cla.Array


class Cells:
    """Tessellate a box.

    Buffers are reused: of a `Tessellation` the next call leaves only the graph as it is, the one after that nothing.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._capacity = 0
        self._turn = 0
        self._n = 0
        self.rows = self._no_rows(engine.empty(3, np.int32))
        self._build(CELL_CAPACITY, ROW_CAPACITY)

    def _build(self, cell_capacity: int, row_capacity: int) -> None:
        self.cell_capacity, self.row_capacity = cell_capacity, row_capacity
        engine, defines = self.engine, {**self.defines, "MAX_DEPTH": MAX_LEVELS}
        self._kernels = engine.kernels("cells", defines)
        self._wrap = None
        if engine.group_size == 1 and engine.real == np.float64:
            self._wrap = engine.kernels("hulls", defines).wrap_cells

    @property
    def defines(self) -> dict[str, object]:
        """The capacities, as kernels that work on the rows must be built with."""
        return {"CELL_CAPACITY": self.cell_capacity, "ROW_CAPACITY": self.row_capacity}

    def _reserve(self, n: int) -> None:
        if n > self._capacity:
            engine, d = self.engine, self.engine.dim
            # A planar graph has at most 3 n - 6 edges, and every cell at most one face on each wall it touches.
            m = 7 * n + 8
            # Two graphs in turn: the previous one stays valid, to be repaired. Measures are those of the present.
            self._graphs = [
                {"starts": engine.empty(n + 1, np.int32), "neighbours": engine.empty(m, np.int32)}
                for _ in range(2)
            ]
            self._measures = {
                "face_measures": engine.empty(m),
                "face_centroids": engine.empty((m, d)),
                "volumes": engine.empty(n),
                "offsets": engine.empty((n, d)),
                "covariances": engine.empty((n, d * (d + 1) // 2)),
            }
            self._capacity = n
            self._n = -1
        if n != self._n:
            # Cut the buffers to n cells (the faces' keep their spare room: their number is only known on the device).
            lengths = {"starts": n + 1, "volumes": n, "offsets": n, "covariances": n}
            self._views = [
                {
                    name: a[: lengths[name]] if name in lengths else a
                    for name, a in {**graph, **self._measures}.items()
                }
                for graph in self._graphs
            ]
            self._n = n

    def tessellate(
        self,
        box: Box,
        points: cla.Array,
        n: int,
        binned: BinnedPoints,
        exact: bool = True,
        wanted: int | None = None,
    ) -> Tessellation:
        """Tessellate `box` by the first `n` of `points` (n, d), which lie in `binned`.

        Parameters
        ----------
        exact : bool
            Refuse generators so close together that rounding makes more than `EXACT_SHARE` of a cell uncertain. Without
            it only more than `ROUGH_SHARE`.
        wanted : int, optional
            Generators whose cells are wanted, the first ones; the faces of these towards others are not compared.

        Raises
        ------
        InputError
            If two generators coincide or are too close for the precision; names the first.
        MemoryLimitError
            If the rows of faces are too many for 32-bit indices.
        ClvoroError
            If a cell has more than `LARGEST_ROW` faces, or a little more.
        """
        engine, rows = self.engine, self.rows
        total, n = n, n if wanted is None else wanted
        if self.row_capacity > ROW_CAPACITY and n * self.row_capacity > rows.slots.size:
            # One mesh had a cell of very many faces; a larger one need not pay for that.
            self._build(CELL_CAPACITY, ROW_CAPACITY)
        self.reserve_rows(n)
        self._reserve(n)
        while True:
            self.clear_flags()
            corners = box.device_corners(engine.real)
            search = binned.reach, binned.bins, binned.grid_frames, binned.grid_shapes
            if self._wrap is not None:
                engine.run_each(
                    self._wrap, -(-total // LANES), np.int32(total), np.int32(n), binned.points,
                    binned.items, *search, *corners, engine.real.type(FIRST_REACH), rows.slots,
                    rows.counts, rows.places, group=WRAP_GROUP,
                )  # fmt: skip
            engine.run_each(
                self._kernels.clip_cells, total, np.int32(n), binned.points, binned.items, *search,
                points, *corners, np.int32(self._wrap is not None), rows.slots, rows.counts,
                rows.places, rows.flags,
            )  # fmt: skip
            # Every row is new: there are none from before.
            flags, generator = self._match(box, points, n, rows.places, rows.places, exact)
            if not flags & FULL:
                break
            self._enlarge(n)
        if not flags & ~DOUBT:
            t = self._measure(box, points, n, rows.places, rows.places)
            if flags & DOUBT:
                flags, generator = self._check(box, t, exact)
        if flags & ~DOUBT:
            self._refuse(flags, generator)
        return t

    def complete(self, box: Box, points: cla.Array, previous: Tessellation) -> Tessellation | None:
        """Return the diagram of `points` whose `rows` are those of `previous` or, where that has a place, new ones.

        None if they do not make a diagram.
        """
        n, starts, neighbours = previous.n, previous.starts, previous.neighbours
        flags = self._match(box, points, n, starts, neighbours, exact=False)[0]
        if flags & ~DOUBT:
            return None
        t = self._measure(box, points, n, starts, neighbours)
        return None if flags & DOUBT and self._check(box, t, exact=False)[0] & ~DOUBT else t

    def clear_flags(self) -> None:
        """Nothing has gone wrong yet."""
        self.rows.flags.set(np.array([0, 2**31 - 1, 0], np.int32))

    def _flags(self) -> tuple[int, int]:
        """Read what has gone wrong, with `DOUBT` where any cell is doubtful, and the first generator concerned."""
        wrong, generator, doubtful = (int(v) for v in self.rows.flags.get())
        return wrong | (DOUBT if doubtful else 0), generator

    def _match(
        self,
        box: Box,
        points: cla.Array,
        n: int,
        starts: cla.Array,
        neighbours: cla.Array,
        exact: bool,
    ) -> tuple[int, int]:
        """Make the rows symmetric, count their faces; return the flags, and the first generator concerned."""
        rows, counts = self.rows, self._views[self._turn]["starts"]
        self.engine.run_each(
            self._kernels.match_faces, n, rows.places, rows.slots, rows.counts, starts, neighbours,
            points, *box.device_corners(self.engine.real), np.int32(starts is not rows.places),
            self._share(exact), rows.keep, counts, rows.flags,
        )  # fmt: skip
        return self._flags()

    def _measure(
        self, box: Box, points: cla.Array, n: int, starts: cla.Array, neighbours: cla.Array
    ) -> Tessellation:
        """Write graph and measures of the rows."""
        rows, new = self.rows, self._views[self._turn]
        self._scan.exclusive(new["starts"], new["starts"], n)
        self.engine.run_each(
            self._kernels.measure_cells, n, rows.places, rows.slots, rows.counts, starts, neighbours,
            rows.keep, new["starts"], points, *box.device_corners(self.engine.real),
            new["neighbours"], new["face_measures"], new["face_centroids"], new["volumes"],
            new["offsets"], new["covariances"],
        )  # fmt: skip
        # Only now: a call that was broken off leaves the previous diagram as it is.
        self._turn = 1 - self._turn
        return Tessellation(n=n, points=points, **new)

    def _check(self, box: Box, t: Tessellation, exact: bool) -> tuple[int, int]:
        """Check the doubtful cells of `t`; return the flags, and the first generator concerned."""
        rows = self.rows
        self.engine.run_each(
            self._kernels.check_doubtful, t.n, rows.places, rows.counts, t.starts, t.neighbours,
            t.volumes, t.points, *box.device_corners(self.engine.real),
            self._share(exact), rows.flags,
        )  # fmt: skip
        return self._flags()

    def _share(self, exact: bool) -> np.floating:
        return self.engine.real.type(EXACT_SHARE if exact else ROUGH_SHARE)

    def clear(self) -> None:
        """Let go of the lists of faces, which hold nothing between two diagrams."""
        self.rows = self._no_rows(self.rows.flags)

    def _no_rows(self, flags: cla.Array) -> FaceRows:
        """Return lists for one cell."""
        slots, counts, places = (self.engine.empty(1, np.int32) for _ in range(3))
        return FaceRows(slots, counts, self.engine.empty(1, np.uint32), places, flags)

    def reserve_rows(self, n: int) -> None:
        """Make room for `n` rows of faces of the present capacity."""
        if n > self.rows.counts.size:
            self.rows.counts, self.rows.places = (
                self.engine.empty(n, np.int32), self.engine.empty(n, np.int32)
            )  # fmt: skip
        entries = n * self.row_capacity
        if entries >= 2**31:
            raise MemoryLimitError(
                f"{n} cells of up to {self.row_capacity} faces need {entries:.3g} entries, expected "
                "fewer than 2^31, which 32-bit indices can tell apart; use fewer cells, or perturb "
                "generators that lie on a common circle"
            )
        if entries > self.rows.slots.size:
            self.rows.slots = self.engine.empty(entries, np.int32)
        words = n * ((self.row_capacity + 31) // 32)
        if words > self.rows.keep.size:
            self.rows.keep = self.engine.empty(words, np.uint32)

    def _enlarge(self, n: int) -> None:
        """Double the capacities, for `n` cells."""
        if self.row_capacity >= LARGEST_ROW:
            raise ClvoroError(
                f"a cell has more than {self.row_capacity} faces; so many cocircular generators "
                "are not supported: remove or perturb some"
            )
        self._build(2 * self.cell_capacity, 2 * self.row_capacity)
        self.reserve_rows(n)

    def _refuse(self, flags: int, generator: int) -> None:
        what = "coincides with another" if flags & COINCIDE else "is too close to others"
        raise InputError(
            f"generator {generator} {what} in {self.engine.real}; expected distinct generators: "
            "remove duplicates (numpy.unique(points, axis=0)) or use dtype='float64'"
        )
