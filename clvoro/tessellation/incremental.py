"""Incremental update: the diagram of generators that moved a little, from the previous one (`incremental.cl`)."""

from __future__ import annotations

from types import SimpleNamespace
from weakref import ReferenceType, ref

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..geometry.box import ClipBox
from ..opencl.device_array import read_number
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from .cells import Cells
from .device_diagram import Tessellation
from .face_rows import spare_slots

MAX_ROUNDS = 6
"""Most rounds of clipping and checking; after that the diagram is built from scratch."""
MAX_SHARE = 0.4
"""Largest share of cells to clip in the first round. Beyond it a new diagram costs less."""
AGAIN_SHARE = 0.1
"""Largest share of cells to clip in all later rounds together."""
SAMPLE, SAMPLED_FROM = 8, 200_000
"""With at least `SAMPLED_FROM` cells, one work-item in `SAMPLE` runs first, to estimate how many cells changed."""
WRONG_SHARE = 0.23
"""Largest share of wrong cells in this sample. With their neighbors they amount to `MAX_SHARE`."""
FEW = 256
"""From this many cells on, CPUs first build cells eight at a time in vector lanes."""


class IncrementalUpdate:
    """Update a diagram for moved generators: keep the neighbors, check all cells, clip those that do not fit.

    The result is the exact Voronoi diagram; `incremental.cl` has the proof.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels: dict[tuple[object, ...], SimpleNamespace] = {}
        self._n = -1
        # A weak reference, so that this stage does not keep the diagram of another mesh in memory.
        self._last: ReferenceType[Tessellation] | None = None

    def update(
        self, cells: Cells, box: ClipBox, points: cla.Array, previous: Tessellation
    ) -> Tessellation | None:
        """Tessellate `box` by `points` (n, d), the new positions of the generators of `previous`.

        Returns None if too much has changed, or if generators coincide. The diagram must then be built from scratch.
        """
        with self.engine.workspace.frame():
            t = self._update(cells, box, points, previous)
        self._last = None if t is None else ref(t)
        return t

    def _update(
        self, cells: Cells, box: ClipBox, points: cla.Array, previous: Tessellation
    ) -> Tessellation | None:
        engine, n = self.engine, previous.n
        key = tuple(cells.defines.values())
        if key not in self._kernels:
            in_lanes = int(cells.lanes > 1)
            self._kernels[key] = engine.kernels(
                "tessellation/incremental", {**cells.defines, "IN_LANES": in_lanes}
            )
        k = self._kernels[key]
        if n != self._n:
            self._n, self._fits = n, engine.empty(n, np.int32)
            self._last = None
        if self._last is None or self._last() is not previous:
            self._fits.fill(0)
        first_most, most = int(MAX_SHARE * n), int((MAX_SHARE + AGAIN_SHARE) * n)
        rows = cells.take_rows(n, most, spare_slots(n))
        marks, listed = engine.scratch(n, np.int32), engine.scratch(most, np.int32)
        sums = engine.scratch(n + 1, np.int32)
        corners = box.device_corners(engine.real)
        old = (previous.starts, previous.neighbors)
        marks.fill(0)
        rows.places.fill(-1)
        check = *old, points, *corners, self._fits, marks, rows.flags
        if not self._check(k.check_rows, -(-n // cells.lanes), n, check, rows.flags):
            return None
        base = 0
        for _ in range(MAX_ROUNDS):
            self._scan.exclusive(marks, sums, n)
            count = read_number(sums, n)
            if count == 0:
                return cells.complete(rows, box, points, previous, self._fits)
            if base + count > (most if base else first_most):
                return None
            engine.run_each(k.list_marked, n, marks, sums, listed)
            wrapped = cells.lanes > 1 and base == 0 and count >= FEW
            if wrapped:
                engine.run_each(
                    k.wrap_marked, -(-count // cells.lanes), np.int32(count), listed, rows.places, rows.slots,
                    rows.counts, *old, points, *corners, group=1,
                )  # fmt: skip
            engine.run_each(
                k.clip_marked, count, listed, np.int32(base), np.int32(wrapped), rows.places, rows.slots,
                rows.counts, *old, points, *corners, self._fits, rows.flags,
            )  # fmt: skip
            engine.run_each(
                k.place_clipped, count, listed, np.int32(base), rows.slots, rows.counts, rows.places,
                marks, self._fits,
            )  # fmt: skip
            engine.run_each(
                k.check_clipped, count, listed, rows.places, rows.slots, rows.counts, *old,
                points, *corners, marks, self._fits,
            )  # fmt: skip
            base += count
        return None

    def _check(
        self, kernel: cl.Kernel, items: int, n: int, args: tuple[object, ...], flags: cla.Array
    ) -> bool:
        """Check all rows with `items` work-items. Return False early if a sample shows that too many have changed."""
        one, part = np.int32(1), -(-items // SAMPLE)
        if n < SAMPLED_FROM:
            self.engine.run(kernel, items, np.int32(n), one, np.int32(0), *args)
            return True
        stride = np.int32(SAMPLE)
        self.engine.run(kernel, part, np.int32(n), stride, np.int32(0), *args)
        if int(flags.get()[2]) > WRONG_SHARE * n / SAMPLE:
            return False
        self.engine.run(kernel, items - part, np.int32(n), stride, one, *args)
        return True
