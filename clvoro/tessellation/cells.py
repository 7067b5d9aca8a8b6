"""Cells in 2D: each clipped by its neighbors and walls; faces and moments (`cells.cl`; `hulls.cl` on CPUs)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import ClvoroError, MemoryLimitError
from ..geometry.domain import ClipBox
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine
from ..opencl.workspace import framed
from .back_ends import LANES, LANES_FROM, has_lanes
from .bins import MAX_LEVELS, BinnedPoints
from .builder import CellBuilder
from .device_diagram import EXACT_SHARE, ROUGH_SHARE, CloseError, NeighborRows, OpenCellError, Tessellation
from .part import Part
from .periodic.halo import halo_defines
from .report import COINCIDE, DOUBT, FULL, KEPT, LOOPED, OPEN, SIZE, SLOTS, SPARE, WHOLE

SLOT = 20
"""Faces per slot. A longer row takes several slots."""
SPARE_SHARE, SPARE_LEAST = 32, 64
"""Number of cells per spare slot, and the least number of spare slots, at first."""
CROWDED = 1 << 16
"""A flag that only the host sets: there were too few spare slots."""


@dataclass
class FaceRows:
    """Rows of faces of a diagram under construction, in scratch memory; see `tessellation/face_rows.h`."""

    slots: cla.Array
    """(s * SLOT,) int32."""
    counts: cla.Array
    """(s,) int32. Number of faces of the row that begins in each slot; negative if the cell is doubtful due to
    round-off."""
    keep: cla.Array
    """(s,) uint32. Bits of the faces that both cells have."""
    places: cla.Array
    """(n,) int32. First slot of each row; -1 for a row of the previous graph."""
    starts: cla.Array
    """(n + 1,) int32. Beginning of each row in the new graph."""
    report: cla.Array
    """int32. See `tessellation/report.h`."""
    old: tuple[cla.Array, cla.Array]
    """tuple of (n + 1,) int32 and int32. Starts and neighbors of the previous graph; `places` twice if all rows are
    new."""
    points: cla.Array
    """Generators, with weights in a power diagram."""
    corners: tuple[object, ...]
    """Lower and upper corner of the box, as arguments of kernels."""
    share: np.floating
    """Share of a cell that round-off may make uncertain."""

    @property
    def output(self) -> tuple[object, ...]:
        """What kernels write that make rows, as their arguments."""
        return self.slots, self.counts, self.places

    @property
    def input(self) -> tuple[object, ...]:
        """What kernels read of rows, as their arguments."""
        return self.places, self.slots, self.counts, *self.old

    @property
    def sites(self) -> tuple[object, ...]:
        """Generators and box, as arguments of kernels."""
        return self.points, *self.corners

    @property
    def n(self) -> int:
        """Number of rows."""
        return len(self.places)

    @property
    def all_new(self) -> bool:
        """Whether no row is one of the previous graph."""
        return self.old[0] is self.places


def spare_slots(n: int) -> int:
    """Return the initial number of spare slots, for the long rows of `n` cells."""
    return n // SPARE_SHARE + SPARE_LEAST


CELL_CAPACITY = 24
"""Most faces of a cell while it is clipped."""
ROW_CAPACITY = SLOT
"""Most faces of a finished cell. Both capacities are doubled when a mesh needs more."""
MOST_ENTRIES = 2**31  # which 32-bit indices can tell apart
LARGEST_ROW, LARGEST_ELSEWHERE = 4096, 512
"""Largest row capacity: on CPUs in boxes, and elsewhere. On a GPU every work-item has private memory of that size; in a
polygon, clipping such a cell by as many edges takes minutes."""
EIGHTS = 16
"""Batches of `LANES` cells that one work-item of a CPU builds in `hulls.cl`."""
FIRST_REACH = 1.9
"""Largest first search radius of `hulls.cl`, in units of the local spacing of the bins."""


class Cells(CellBuilder):
    """Tessellate a box in 2D, or a sphere. A cell may have about `LARGEST_ROW` faces, or `LARGEST_ELSEWHERE`.

    - `folded`: for the folded diagrams of a periodic box, in which a neighbor is the nearest image of its generator:
      they are updated, or clipped by `clip_by_rings`. The periods are built into the kernels, which compute corners
      from differences of positions.

    Its attributes:
    - `lanes`: cells that one work-item measures or checks.
    """

    from_previous = False

    def __init__(self, engine: Engine, folded: bool = False) -> None:
        super().__init__(engine)
        self._folds = {f"FOLD_{a}": engine.traits.periods[a].hex() for a in range(2)} if folded else {}
        self._halo = engine.kernels("tessellation/periodic/ghost_images", halo_defines(engine))
        self._enlarged_for = 0
        self._first_reports: dict[tuple[int, int, bool], cla.Array] = {}
        self._build(CELL_CAPACITY, ROW_CAPACITY)

    def _build(self, cell_capacity: int, row_capacity: int) -> None:
        self.cell_capacity, self.row_capacity = cell_capacity, row_capacity
        engine, defines = self.engine, {**self.defines, "MAX_DEPTH": MAX_LEVELS}
        self.lanes = LANES if has_lanes(engine) else 1
        self._kernels = engine.kernels("tessellation/cells", {**defines, "IN_LANES": int(self.lanes > 1)})
        self._hulls = None
        if self.lanes > 1 and not self._folds:
            hulls = {"SLOT": SLOT, "MAX_DEPTH": MAX_LEVELS, "EIGHTS": EIGHTS}
            self._hulls = engine.kernels("simd/hulls", hulls)

    @property
    def defines(self) -> dict[str, object]:
        """The capacities and periods, for building kernels that work on the rows."""
        capacities: dict[str, object] = {
            "CELL_CAPACITY": self.cell_capacity,
            "ROW_CAPACITY": self.row_capacity,
            "SLOT": SLOT,
        }
        return capacities | self._folds

    def _tessellate(
        self, part: Part, binned: BinnedPoints, previous: Tessellation | NeighborRows | None, exact: bool, rows: int
    ) -> Tessellation:
        engine, n = self.engine, rows
        if self.row_capacity > ROW_CAPACITY and n > self._enlarged_for:
            # The capacities were enlarged for a smaller mesh: start again with the default ones.
            self._build(CELL_CAPACITY, ROW_CAPACITY)
        self.cells_of(n)
        spare, whole = spare_slots(n), False
        while True:
            with engine.workspace.frame():
                taken = self.take_rows(n, part.box, part.points, exact, spare=spare, whole=whole)
                flags, m = self._clip(taken, part, binned)
                if flags & CROWDED:
                    # Repeat with twice the slots that were requested so far.
                    spare = 2 * (int(taken.report.get()[SPARE]) - n)
                    continue
                t = None if flags & ~DOUBT else self.measure(taken, m, flags)
                if t is not None:
                    if part.halo_args:
                        self._request_depths(part, binned, t)
                    return t
                if flags & OPEN:
                    raise OpenCellError(part.points[: part.count].get()[:, : engine.dim])
                if whole or flags & COINCIDE:
                    raise CloseError(part.points, part.count)
                # Too many short faces may have been dropped: keep all.
                whole = True

    def _request_depths(self, part: Part, binned: BinnedPoints, t: Tessellation) -> None:
        """Request the depths of the halo that the cells of `t` require. In 3D the kernels that clip cells do this."""
        box = part.box.device_corners(self.engine.real)
        given = binned.items, binned.reach, part.points, *t.graph, *box, *part.halo_args
        self.engine.run_each(self._halo.measure_required_depths, part.count, *given)

    def _clip(self, rows: FaceRows, part: Part, binned: BinnedPoints) -> tuple[int, int]:
        """Build and match the faces of the first ``rows.n`` cells of `part`, and return what `_match` returns."""
        engine, n, total = self.engine, rows.n, part.count
        hulls = self._hulls if n >= LANES_FROM[2] else None
        some = hulls is not None
        bounds = () if self._bounds is None else self._bounds.build(part.box, part.points, total)
        if hulls is not None:
            items = -(-total // (LANES * EIGHTS))
            bins = binned.points, binned.items, binned.spacing, *binned.search
            reach = engine.real.type(FIRST_REACH)
            made = *rows.corners, reach, *rows.output
            engine.run_each(hulls.wrap_all_hulls, items, np.int32(total), np.int32(n), *bins, *made, group=1)
        while True:
            bins = binned.points, binned.items, *binned.search
            made = np.int32(some), *rows.output, rows.report
            engine.run_each(self._kernels.clip_polygons, total, np.int32(n), *bins, *rows.sites, *made, *bounds)
            found = self._match(rows)
            if not found[0] & FULL or found[0] & CROWDED:
                return found
            self._enlarge(n)
            # Clip only the cells that had too many faces: their rows are empty. Doubts about others stay.
            some = True
            self._report[:1].fill(found[0] & DOUBT)

    @framed
    def clip_by_rings(
        self, box: ClipBox, points: cla.Array, previous: NeighborRows, exact: bool
    ) -> Tessellation | None:
        """Tessellate by `points` with weights (n, 3), starting from the neighbors in `previous`.

        The result is right if the sum of its volumes is that of the domain. None if a cell has too many faces, or
        is open in a folded graph.
        """
        n = previous.n
        rows = self.take_rows(n, box, points, exact, spare=spare_slots(n))
        self.engine.run_each(self._kernels.clip_by_rings, n, *rows.sites, *previous.graph, *rows.output, rows.report)
        flags, m = self._match(rows)
        return None if flags & ~DOUBT else self.measure(rows, m, flags)

    def measure_faces(self, box: ClipBox, t: Tessellation) -> Tessellation:
        """Return `t`, a diagram of `box`, with face measures and centroids in full precision, in new arrays."""
        if t.face_measures.dtype == self.engine.real:
            return t
        engine, m = self.engine, len(t.neighbors)
        measures, centroids = engine.empty(m), engine.empty((m, engine.dim))
        engine.run_each(
            self._kernels.measure_faces, t.n, *t.graph, t.sites, *box.device_corners(engine.real), measures, centroids
        )
        return replace(t, face_measures=measures, face_centroids=centroids)

    def _read_report(self) -> tuple[int, int]:
        """Return the flags and the number of half-faces. `CROWDED`: there were too few spare slots."""
        return verdict(self._report.get().tolist())

    def _match(self, rows: FaceRows) -> tuple[int, int]:
        """Make the rows symmetric; return the flags and the number of half-faces."""
        self.enqueue_match(rows)
        return self._read_report()

    def enqueue_match(self, rows: FaceRows, marks: cla.Array | None = None, fits: cla.Array | None = None) -> None:
        """Make the rows symmetric, and count their faces.

        In an update nothing is done while cells are marked, by `marks` (n,). `fits` (n,) is 1 for a row if every
        neighbor lists the generator between the correct two neighbors; it becomes 0 where a face due to round-off is
        dropped.
        """
        updated = [rows.places if array is None else array for array in (marks, fits)]
        given = *rows.input, *rows.sites, int(fits is not None), rows.share, *updated
        self.engine.run_each(self._kernels.match_polygon_faces, rows.n, *given, rows.keep, rows.starts, rows.report)
        self._count(rows, rows.starts)

    def _count(self, rows: FaceRows, counts: cla.Array) -> None:
        """Set `rows.starts` and the number of half-faces from the lengths of rows."""
        self._scan.exclusive(counts, rows.starts, rows.n, total=(rows.report, KEPT))

    def measure(self, rows: FaceRows, m: int, flags: int, ahead: bool = False) -> Tessellation | None:
        """Write graph and measures of the rows; return None if doubtful cells are inconsistent.

        With `ahead` the report is not known. Nothing is written unless its flags are 0 and there are at most `m` faces.
        """
        engine, n = self.engine, rows.n
        new, faces = self.cells_of(n), self.faces_of(max(m, most_faces(n)))
        # The new graph may overwrite the previous one directly only if no row is read from there and no check follows.
        direct = rows.all_new and not flags & DOUBT
        neighbors = faces["neighbors"] if direct else engine.scratch(m, np.int32)
        unless = int(ahead), m, rows.report
        self._measure_rows(rows, unless, neighbors)
        if flags & DOUBT:
            wrong = self._check_doubtful(rows, neighbors)
            if wrong & LOOPED and rows.all_new:
                return self._measure_without_loops(rows, neighbors)
            if wrong:
                return None
        copy = int(not direct), *unless, rows.starts, neighbors, new["starts"], faces["neighbors"]
        engine.run_blocks(self._kernels.copy_graph, n, *copy)
        arrays: dict[str, Any] = {**new, **faces}
        return Tessellation(n, rows.points, **arrays)

    def _measure_rows(self, rows: FaceRows, unless: tuple[object, ...], neighbors: cla.Array) -> None:
        """Write the graph of the rows to `neighbors`, and their measures, `unless` as `measure` says."""
        new, faces = self.cells_of(rows.n), self._faces
        made = faces["face_measures"], faces["face_centroids"], new["volumes"], new["offsets"], new["covariances"]
        given = *rows.input, rows.keep, rows.starts, *rows.sites, *unless, neighbors
        self.engine.run(self._kernels.measure_cells, -(-rows.n // self.lanes), rows.n, *given, *made)

    def _check_doubtful(self, rows: FaceRows, neighbors: cla.Array) -> int:
        """Return the error bits of doubtful cells in the graph (`rows.starts`, `neighbors`)."""
        graph = rows.places, rows.counts, rows.starts, neighbors, self.cells_of(rows.n)["volumes"]
        given = *graph, *rows.sites, rows.share, rows.report
        self.engine.run_each(self._kernels.check_doubtful, rows.n, *given)
        return self._read_report()[0] & ~DOUBT

    def _measure_without_loops(self, rows: FaceRows, neighbors: cla.Array) -> Tessellation | None:
        """Measure again without the crossing faces of the graph (`rows.starts`, `neighbors`)."""
        n, drop_loops = rows.n, self._kernels.drop_loops
        counts = self.engine.scratch(n + 1, np.int32)
        self._report[:1].fill(DOUBT)
        graph = rows.starts, neighbors
        self.engine.run_each(drop_loops, n, rows.places, rows.counts, *graph, rows.keep, counts, rows.report)
        self._count(rows, counts)
        flags, m = self._read_report()
        return None if flags & ~DOUBT else self.measure(rows, m, flags)

    def take_rows(
        self,
        n: int,
        box: ClipBox,
        points: cla.Array,
        exact: bool,
        slots: int | None = None,
        spare: int = 0,
        whole: bool = False,
        reset: bool = True,
        previous: Tessellation | None = None,
    ) -> FaceRows:
        """Return `n` empty rows for the diagram of `points` in `box`, of which `slots` (by default all) may be new.

        Others are those of `previous`. `spare` slots follow, for rows longer than one slot. With `whole`, faces no
        longer than round-off stay. `reset` the report. For `exact` see `tessellate`.
        """
        engine, slots = self.engine, n if slots is None else slots
        first, slots = slots, slots + spare
        if slots * SLOT >= MOST_ENTRIES:
            raise MemoryLimitError(
                f"the faces of {n} cells need {slots * SLOT:.3g} entries, expected fewer than 2^31, which "
                "32-bit indices can tell apart; use fewer cells, or perturb generators that lie on a common circle"
            )
        if reset:
            self._reset_report(first, slots, whole)
        faces, counts = engine.scratch(slots * SLOT, np.int32), engine.scratch(slots, np.int32)
        keep, places = engine.scratch(slots, np.uint32), engine.scratch(n, np.int32)
        old = (places, places) if previous is None else previous.graph
        share = engine.real.type(EXACT_SHARE if exact else ROUGH_SHARE)
        starts, corners = engine.scratch(n + 1, np.int32), box.device_corners(engine.real)
        return FaceRows(faces, counts, keep, places, starts, self._report, old, points, corners, share)

    def _reset_report(self, first: int, slots: int, whole: bool) -> None:
        """Reset the report; `first` and `slots` are the range of the spare slots."""
        given = first, slots, whole
        if given not in self._first_reports:
            if len(self._first_reports) >= 4:
                self._first_reports.clear()
            # A copy on the device avoids a blocking transfer.
            report = np.zeros(SIZE, np.int32)
            report[[SPARE, SLOTS, WHOLE]] = given
            self._first_reports[given] = self.engine.upload(report, np.int32)
        cl.enqueue_copy(self.engine.queue, buffer_of(self._report), buffer_of(self._first_reports[given]))

    def _enlarge(self, n: int) -> None:
        """Double the capacities, for a mesh of `n` cells."""
        many = self.engine.group_size == 1 and not self.engine.traits.cut
        if self.row_capacity >= (LARGEST_ROW if many else LARGEST_ELSEWHERE):
            raise ClvoroError(
                f"a cell has more than {self.row_capacity} faces, expected fewer; remove or perturb cocircular "
                "generators, or give thin layers a spacing closer to the size of the cells beside them"
            )
        self._build(2 * self.cell_capacity, 2 * self.row_capacity)
        self._enlarged_for = n


def most_faces(n: int) -> int:
    """Return an upper bound of the number of half-faces of `n` cells.

    Cells and walls are the nodes of a planar graph with at most 3 (n + 4) - 6 edges. An edge has two half-faces, or one
    at a wall. Round-off may add more where many generators lie on a circle.
    """
    return 6 * n + 12


def verdict(report: Sequence[int]) -> tuple[int, int]:
    """Return the flags of a report, and the number of half-faces. `CROWDED`: there were too few spare slots."""
    return report[0] | (CROWDED if report[SPARE] > report[SLOTS] else 0), report[KEPT]
