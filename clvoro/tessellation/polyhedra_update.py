"""Incremental update in 3D: cells from their previous vertices and neighbors, compared with each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.kernels import Kernels
from ..opencl.workspace import framed
from .cut_cells import CutCells
from .device_diagram import ROUGH_SHARE, Follow, Tessellation, read_report
from .polyhedra import Polyhedra
from .report import HARMLESS, LISTED, SIZE, UNKNOWN, with_room

MORE = 8
"""Room for further neighbors of a cell, as in `tessellation/polyhedra_update.cl`."""
MAX_ROUNDS = 8
"""Most rounds of making cells again, before cells are clipped and after; then the diagram is built from scratch."""
MAX_SHARE = 0.5
"""Largest share of cells to make again in one round. Beyond it a new diagram costs less."""
ALL_CELLS, MARKED_CELLS = 0, 1
"""Which cells `update_cells` updates: all, or those marked by a check."""
FACES_AT_WALL = 17
"""Faces of a cell at a wall, rather too many."""
SPARE = 0.25
"""Room for cells that gain faces, over the half-faces of the previous diagram."""


class PolyhedraUpdate:
    """Update a diagram in 3D for moved generators: keep the vertices as triples of faces, check and repair them.

    The result is the exact Voronoi diagram; `polyhedra_update.cl` has the proof.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("tessellation/polyhedra_update")
        self._report = engine.empty(SIZE, np.int32)
        self._share = engine.real.type(ROUGH_SHARE)
        self._n, self._expected, self._clips = 0, [0], 0

    @framed
    def update(
        self,
        cells: Polyhedra,
        box: ClipBox,
        points: cla.Array,
        previous: Tessellation,
        clip: Callable[[Polyhedra, CutCells, cla.Array, int], None],
        follow: Follow = read_report,
    ) -> Tessellation | None:
        """Tessellate `box` by `points` (n, 3), the new positions of the generators of `previous`.

        In a periodic box that is the folded diagram. `box` then extends a period beyond the generators.

        The host enqueues as many rounds as the last update took before cells were clipped, for somewhat more cells, and
        then reads the report. It matches faces once it has clipped cells as often as the last update did.

        Returns None if too much has changed, or if generators coincide. The diagram must then be built from scratch.
        `clip` clips unfinished cells; it gets `cells`, the unfinished ones, the report and the number of faces so far.
        See `Follow` for what is called with the diagram.
        """
        n, before = previous.n, len(previous.neighbors)
        most = int(MAX_SHARE * n)
        if n != self._n:
            self._n, self._expected, self._clips = n, [most], 0
        rounds = _Rounds(self.engine, self._kernels, self._report, cells, box, points, previous)
        rounds.update(n, ALL_CELLS)
        done, sizes = 0, self._expected
        rounds_before, clips, final = 0, 0, not self._clips
        while True:
            for size in sizes[: MAX_ROUNDS + rounds_before - done]:
                rounds.list_marked(done, size)
                rounds.update(size, MARKED_CELLS)
                done += 1
            matching = None
            if final:
                matching = cells.match(rounds.cut, self._report, points, self._share, before, folded=True)
                found = follow(matching.tessellation(), self._report)
            else:
                found = self._report.get().tolist()
            flags, used, left, marked, kept = found[:LISTED]
            if flags & UNKNOWN:
                if box.look_farther(points):
                    return None
                flags &= ~UNKNOWN
                self._report[0].set(np.array(flags, np.int32))
            if flags & ~HARMLESS or max(left, marked) > most:
                return None
            if marked or left:
                if done == MAX_ROUNDS + rounds_before:
                    return None
                sizes = [marked] if marked else []
                if not marked:
                    rounds.list_marked(done, 0)
                    rounds_before = rounds_before or done
                    done, clips = done + 1, clips + 1
                    final = clips >= self._clips
                    clip(cells, rounds.cut, self._report, used)
                    rounds.check()
                continue
            self._clips = clips
            counts = found[LISTED : LISTED + (rounds_before or done)]
            self._expected = with_room((count for count in counts if count > 0), most)
            if matching is None:
                sizes, final = [], True
                continue
            if kept > len(matching.arrays["neighbors"]):
                cells.place(matching, kept)
                follow(matching.tessellation(), None)
            return matching.tessellation(flags)


class _Rounds:
    """The launches of the rounds of one update.

    - `cut`: CutCells
    - `room`: number of faces that it has room for.
    """

    def __init__(
        self,
        engine: Engine,
        kernels: Kernels,
        report: cla.Array,
        cells: Polyhedra,
        box: ClipBox,
        points: cla.Array,
        previous: Tessellation,
    ) -> None:
        self._engine, self._kernels, self._report = engine, kernels, report
        self._n, before = previous.n, len(previous.neighbors)
        n, most = previous.n, max(int(MAX_SHARE * previous.n), 1)
        # Cells at walls of a solid, and beside ghosts, are clipped anew, to other places.
        anew = min(box.plane_count + (previous.rows - n) // 2, n)
        self.room = int((1 + SPARE) * before + anew * FACES_AT_WALL) + 64
        self.cut = cells.take_cells(n, self.room)
        self._changed, self._marks, self._listed = (engine.scratch(n, np.int32) for _ in range(3))
        self._more = engine.scratch(n * MORE, np.int32)
        self._further = engine.scratch(most * MORE, np.int32)
        old = previous.vertices or (self._listed, self._listed)
        self._box = box
        self._before = (*previous.graph, np.int32(bool(previous.vertices)), *old, points)
        reach = self.cut.cells.get("reach", self.cut.cells["volumes"])
        with_reach = np.int32("reach" in self.cut.cells)
        self._output = (np.int32(self.room), *self.cut.output(report), self.cut.keys, self._changed, with_reach, reach)
        engine.run_each(
            kernels.begin_cell_updates, n, np.int32(before), np.int32(SIZE), report, self._marks, self._more
        )

    def update(self, size: int, which: int) -> None:
        """Update and check all cells, or the listed ones, at most `size`."""
        engine = self._engine
        given = np.int32(which), np.int32(self._n), self._listed, self._further, *self._before
        written = *self._output, self._more, self._marks
        args = *given, *self._box.clip_args(engine), *written, *engine.period_args
        engine.run_each(self._kernels.update_cells, size, *args)
        self.check()

    def check(self) -> None:
        """Check changed cells, and count those that must be updated again, and the unfinished ones."""
        engine, k, cut = self._engine, self._kernels, self.cut
        room = np.int32(self.room)
        faces = cut.places, cut.counts, cut.labels, cut.measures, cut.corners, cut.keys
        engine.run_each(k.check_cells, self._n, room, self._report, *faces, self._changed, self._marks)

    def list_marked(self, number: int, most: int) -> None:
        """List the marked cells, if they are not more than `most`. The report has room for the first rounds."""
        marks = self._more, self.cut.counts, self._marks, self._changed, self._listed, self._further
        limits = np.int32(most), np.int32(min(number, MAX_ROUNDS - 1))
        self._engine.run_each(self._kernels.list_marked_cells, self._n, *limits, *marks, self._report)
