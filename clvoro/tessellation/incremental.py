"""Incremental update: the diagram of generators that moved a little, from the previous one (`incremental.cl`)."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace
from weakref import ReferenceType, ref

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from .cells import Cells, FaceRows, most_faces, spare_slots, verdict
from .device_diagram import Follow, Tessellation, read_report
from .report import DOUBT, LISTED, SIZE, UNFINISHED, WRONG, with_room

MAX_ROUNDS = 8
"""Most rounds of clipping and checking, as many as a report has room for; after that the diagram is built from scratch.
"""
MAX_SHARE = 0.4
"""Largest share of cells to clip in the first round. Beyond it a new diagram costs less."""
AGAIN_SHARE = 0.1
"""Largest share of cells to clip in all later rounds together."""
SAMPLE, SAMPLED_FROM = 8, 200_000
"""With at least `SAMPLED_FROM` cells, one work-item in `SAMPLE` runs first, to estimate how many cells changed."""
WRONG_SHARE = 0.23
"""Largest share of wrong cells in this sample. With their neighbors they amount to `MAX_SHARE`."""
FEW = 256
"""From this many cells on, of four times as many or more, CPUs first build cells eight at a time in vector lanes."""


class IncrementalUpdate:
    """Update a diagram for moved generators: keep the neighbors, check all cells, clip those that do not fit.

    The result is the exact Voronoi diagram; `incremental.cl` has the proof.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels: dict[tuple[object, ...], SimpleNamespace] = {}
        self._n = -1
        self._expected: list[int] | None = None
        # A weak reference, so that this stage does not keep the diagram of another mesh in memory.
        self._last: ReferenceType[Tessellation] | None = None

    def update(
        self,
        cells: Cells,
        box: ClipBox,
        points: cla.Array,
        previous: Tessellation,
        clip: object = None,
        follow: Follow = read_report,
    ) -> Tessellation | None:
        """Tessellate `box` by `points` (n, d), the new positions of the generators of `previous`.

        The host enqueues as many rounds as the last update took, for somewhat more cells, and then reads the report.
        See `Follow` for what is called with the diagram. `clip` is not used: in 2D the update finishes all cells.

        Returns None if too much has changed, or if generators coincide. The diagram must then be built from scratch.
        """
        with self.engine.workspace.frame():
            t = self._update(cells, box, points, previous, follow)
        if t is None:
            # Free the work arrays of the steps, because the bins need memory.
            self.engine.workspace.shrink()
        self._last = None if t is None else ref(t)
        return t

    def _update(
        self, cells: Cells, box: ClipBox, points: cla.Array, previous: Tessellation, follow: Follow
    ) -> Tessellation | None:
        engine, n = self.engine, previous.n
        key = tuple(cells.defines.values())
        if key not in self._kernels:
            in_lanes = int(cells.lanes > 1)
            self._kernels[key] = engine.kernels("tessellation/incremental", {**cells.defines, "IN_LANES": in_lanes})
        k = self._kernels[key]
        if n != self._n:
            self._n, self._fits = n, engine.empty(n, np.int32)
            self._last = self._expected = None
        if self._last is None or self._last() is not previous:
            self._fits.fill(0)
        first_most, most = int(MAX_SHARE * n), int((MAX_SHARE + AGAIN_SHARE) * n)
        spare = spare_slots(n)
        rows = cells.take_rows(n, box, points, False, most, spare, reset=False, previous=previous)
        marks, listed = engine.scratch(n, np.int32), engine.scratch(most, np.int32)
        sums = engine.scratch(n + 1, np.int32)
        most_wrong = int(WRONG_SHARE * n / SAMPLE) if n >= SAMPLED_FROM else n
        engine.run_each(k.begin_update, n, marks, rows.places, rows.report, SIZE, most, most + spare)
        given = *rows.old, points, *rows.corners
        check = most_wrong, *given, self._fits, marks, rows.report
        self._check(k.check_rows, -(-n // cells.lanes), n, check)
        done, expected = 0, [first_most] if self._expected is None else self._expected
        while True:
            for number, size in enumerate(expected, done):
                in_all = most if number else first_most
                limits = size, in_all, most_wrong
                self._scan.exclusive(marks, sums, n)
                engine.run_each(k.list_marked, n, number, *limits, marks, sums, listed, rows.report)
                self._clip_listed(k, cells, number, size, listed, rows, marks, given)
            cells.enqueue_match(rows, marks, self._fits)
            t = cells.measure(rows, most_faces(n), 0, ahead=True)
            assert t is not None
            found = follow(t, rows.report)
            sums_of_rounds = found[LISTED : LISTED + done + len(expected) + 1]
            clipped = [after - before for before, after in pairwise(sums_of_rounds)]
            done, left = sum(count > 0 for count in clipped), found[UNFINISHED]
            if left == 0:
                self._expected = with_room(clipped[:done], first_most)
                flags, m = verdict(found)
                if flags & ~DOUBT:
                    return None
                if flags or m > most_faces(n):
                    t = cells.measure(rows, m, flags)
                    if t is not None:
                        follow(t, None)
                return t
            in_all = most if done else first_most
            if found[WRONG] > most_wrong or sum(clipped) + left > in_all or done >= MAX_ROUNDS - 1:
                return None
            expected = [left]

    def _clip_listed(
        self,
        k: SimpleNamespace,
        cells: Cells,
        number: int,
        size: int,
        listed: cla.Array,
        rows: FaceRows,
        marks: cla.Array,
        given: tuple[object, ...],
    ) -> None:
        """Round `number`: clip the `listed` cells, at most `size`, and check them and their neighbors.

        `given` are the graph before, the generators and the corners of the box.
        """
        engine, this = self.engine, (listed, number)
        few = FEW if cells.lanes > 1 and number == 0 and self._n >= 4 * FEW else self._n + 1
        new = rows.slots, rows.counts
        if few <= size:
            engine.run_each(
                k.wrap_marked, -(-size // cells.lanes), few, rows.report, listed, rows.places, *new, *given, group=1
            )
        engine.run_each(k.clip_marked, size, *this, few, rows.places, *new, *given, self._fits, rows.report)
        engine.run_each(k.place_clipped, size, *this, rows.report, *new, rows.places, marks, self._fits)
        engine.run_each(k.check_clipped, size, *this, rows.report, rows.places, *new, *given, marks, self._fits)

    def _check(self, kernel: cl.Kernel, items: int, n: int, args: tuple[object, ...]) -> None:
        """Check all rows with `items` work-items, or only a sample if it shows that too many have changed."""
        if n < SAMPLED_FROM:
            self.engine.run(kernel, items, n, 1, 0, *args)
            return
        part = -(-items // SAMPLE)
        self.engine.run(kernel, part, n, SAMPLE, 0, *args)
        self.engine.run(kernel, items - part, n, SAMPLE, 1, *args)
