"""Incremental update in 3D: cells from their previous vertices and neighbors, compared with each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..geometry.box import ClipBox
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from ..opencl.workspace import framed
from .bins import BinnedPoints
from .device_diagram import DOUBT, ROUGH_SHARE, Tessellation
from .polyhedra import Polyhedra

MORE = 8
"""Room for further neighbors of a cell, as in `tessellation/polyhedra_update.cl`."""
NO_CORNERS = 0
"""The fourth number of the first triple of a cell without triples."""
NO_NEIGHBOR = np.iinfo(np.int32).min
MAX_ROUNDS = 8
"""Most rounds of making cells again; after that the diagram is built from scratch."""
MAX_SHARE = 0.5
"""Largest share of cells to make again in one round. Beyond it a new diagram costs less."""
SPARE = 0.25
"""Room for cells that gain faces, over the half-faces of the previous diagram."""


def are_triples(starts: np.ndarray, saved: np.ndarray) -> bool:
    """Return whether `saved` triples (2 m,) uint32 name only faces of their rows, given by `starts` (n + 1,)."""
    triples = saved.view(np.uint8).reshape(-1, 4)
    counts = np.diff(starts)
    known = triples[2 * starts[:-1], 3] != NO_CORNERS
    used = np.arange(len(triples)) - np.repeat(2 * starts[:-1], 2 * counts) < np.repeat(
        2 * counts - 4, 2 * counts
    )
    limits = np.repeat(np.where(known, counts, 256), 2 * counts)
    return bool((~used | (triples[:, :3].max(axis=1) < limits)).all())


class PolyhedraUpdate:
    """Update a diagram in 3D for moved generators: keep the vertices as triples of faces, check and repair them.

    The result is the exact Voronoi diagram; `polyhedra_update.cl` has the proof.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("tessellation/polyhedra_update")
        self._report = engine.empty(4, np.int32)
        self._share = engine.real.type(ROUGH_SHARE)

    @framed
    def update(
        self,
        cells: Polyhedra,
        box: ClipBox,
        points: cla.Array,
        previous: Tessellation,
        bins: Callable[[], BinnedPoints],
    ) -> Tessellation | None:
        """Tessellate `box` by `points` (n, 3), the new positions of the generators of `previous`.

        Returns None if too much has changed, or if generators coincide. The diagram must then be built from scratch.
        `bins` sorts the generators into bins; it is called if cells must be clipped.
        """
        engine, k, n = self.engine, self._kernels, previous.n
        before = len(previous.neighbors)
        room = int((1 + SPARE) * before) + 64
        cut = cells.take_cells(n, room)
        changed, marks, listed = (engine.scratch(n, np.int32) for _ in range(3))
        sums = engine.scratch(n + 1, np.int32)
        more, most = engine.scratch(n * MORE, np.int32), int(MAX_SHARE * n)
        further = engine.scratch(max(most, 1) * MORE, np.int32)
        more.fill(NO_NEIGHBOR)
        marks.fill(0)
        old = previous.vertices or (listed, sums)
        fixed = (
            previous.starts, previous.neighbors, np.int32(bool(previous.vertices)), *old, points,
            *box.device_corners(engine.real), np.int32(room),
        )  # fmt: skip
        binned: BinnedPoints | None = None
        count, some, flags, used = n, False, 0, before
        for _ in range(MAX_ROUNDS):
            self._report.set(np.array([flags, used, 0, 0], np.int32))
            engine.run_each(
                k.update_cells, count, np.int32(some), listed, further, *fixed, *cut.output(self._report),
                cut.keys, changed, more, marks,
            )  # fmt: skip
            flags, used, left, _ = (int(v) for v in self._report.get())
            if used > room or left > most:
                return None
            if left:
                binned = bins() if binned is None else binned
                if not cells.clip_rest(cut, self._report, box, points, binned, previous):
                    return None
            engine.run_each(
                k.check_cells,
                n,
                cut.places,
                cut.counts,
                cut.labels,
                cut.measures,
                cut.keys,
                changed,
                marks,
            )
            engine.run_each(k.flag_marked_cells, n, marks, sums, self._report)
            flags, used, _, count = (int(v) for v in self._report.get())
            if count > most:
                return None
            if count == 0:
                cut = replace(cut, doubtful=bool(flags & DOUBT))
                return cells.match(cut, self._report, points, self._share, sparse=True)
            some = True
            self._scan.exclusive(sums, sums, n)
            engine.run_each(k.list_marked_cells, n, sums, more, marks, changed, listed, further)
        return None
