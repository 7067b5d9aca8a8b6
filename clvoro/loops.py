"""Vertices of a diagram in 3D, each once, and the loops of its faces, for output (`loops.cl`)."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ._primitives import Scan
from ._program import Engine
from .cells import Tessellation
from .domain import Box
from .errors import MemoryLimitError

FACE_CAPACITY = 64
MOST_TURNS = 2**31 - 1
MOST_ROUNDS = 16
"""Vertices that may be put into one edge."""


@dataclass(frozen=True)
class Loops:
    """Shared vertices and face loops on the device.

    Attributes
    ----------
    positions : (v, 3) real
    starts : (m + 1,) int32
        Loop k is ``vertices[starts[k]:starts[k + 1]]``, counter-clockwise seen from outside of its cell.
    vertices : (l,) int32
    """

    positions: cla.Array
    starts: cla.Array
    vertices: cla.Array


class FaceLoops:
    """Number the vertices of a tessellation in 3D, and walk around its faces."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)

    def walk(self, box: Box, t: Tessellation) -> Loops:
        """Return the loops of `t`, vertices numbered in the order of the first cell they belong to.

        Raises
        ------
        MemoryLimitError
            If the loops are too long for 32-bit indices.
        """
        engine, n = self.engine, t.n
        m = int(t.starts[n].get())
        corner_starts, turn_starts = engine.empty(n + 1, np.int32), engine.empty(m + 1, np.int32)
        cell = (t.points, *box.device_corners(engine.real), t.starts, t.neighbours)
        capacity, flag = FACE_CAPACITY, engine.zeros(1, np.int32)
        while True:
            k = engine.kernels("loops", {"FACE_CAPACITY": capacity})
            # Private arrays of a whole group lie on the stack of a CPU's thread.
            group = None if capacity == FACE_CAPACITY else 1
            engine.run_each(
                k.count_corners, n, *cell, corner_starts, turn_starts, flag, group=group
            )
            if not int(flag[0].get()):
                break
            capacity *= 2
            flag.fill(0)
        self._scan.exclusive(corner_starts, corner_starts, n)
        self._scan.exclusive(turn_starts, turn_starts, m)
        c, turn_count = int(corner_starts[n].get()), int(turn_starts[m].get())
        if not (0 < turn_count <= MOST_TURNS and 0 < c <= MOST_TURNS // 3):
            raise MemoryLimitError(
                f"{n} cells have more vertices than 32-bit indices can tell apart; use fewer cells"
            )
        corners, same = engine.empty((c, 3)), engine.empty(c, np.int32)
        sharpness = engine.empty(c, np.float32)
        turns, partners = engine.empty(turn_count, np.int32), engine.empty(turn_count, np.int32)
        twins = engine.empty(m, np.int32)
        engine.run_each(
            k.list_corners, n, *cell, corner_starts, turn_starts, corners, sharpness, same, turns,
            group=group,
        )  # fmt: skip
        engine.run_each(
            k.match_corners, n, t.points, t.starts, t.neighbours, corners, turn_starts, turns,
            twins, partners,
        )  # fmt: skip
        labels, new = same.copy(), same.copy()
        spread = ((k.spread_over_faces, turn_count, turns, partners), (k.spread_in_cells, c, same))
        while True:
            flag.fill(0)
            for kernel, size, *links in spread:
                engine.run_each(kernel, size, *links, labels, new, flag)
                cl.enqueue_copy(engine.queue, labels.data, new.data)
            if not int(flag[0].get()):
                break
        best, chosen = engine.zeros(c, np.uint32), new
        chosen.fill(2**31 - 1)
        engine.run_each(k.rate_corners, c, labels, sharpness, best)
        engine.run_each(k.choose_corners, c, labels, sharpness, best, chosen)
        loop_starts, ids = engine.empty(m + 1, np.int32), engine.zeros(c + 1, np.int32)
        engine.run_each(k.measure_loops, m, twins, turn_starts, turns, labels, loop_starts, ids)
        self._scan.exclusive(loop_starts, loop_starts, m)
        self._scan.exclusive(ids, ids, c)
        loops = engine.empty(int(loop_starts[m].get()), np.int32)
        positions = engine.empty((int(ids[c].get()), 3))
        engine.run_each(
            k.write_loops, m, twins, turn_starts, turns, labels, ids, loop_starts, loops
        )
        engine.run_each(
            k.place_vertices, n, *cell[:3], corner_starts, corners, labels, chosen, ids, positions
        )
        starts, loops = self._mended(k, t, twins, loop_starts, loops)
        return Loops(positions, starts, loops)

    def _mended(
        self,
        k: SimpleNamespace,
        t: Tessellation,
        twins: cla.Array,
        starts: cla.Array,
        loops: cla.Array,
    ) -> tuple[cla.Array, cla.Array]:
        """Put vertices into edges that they lie on where a cell would not close without."""
        engine, m = self.engine, len(twins)
        changed = engine.empty(1, np.int32)
        for _ in range(MOST_ROUNDS):
            missing = engine.empty(max(len(loops), 1), np.int32)
            changed.fill(0)
            engine.run_each(k.find_missing, t.n, t.starts, starts, loops, missing, changed)
            if not int(changed[0].get()):
                break
            longer = engine.empty(m + 1, np.int32)
            engine.run_each(k.measure_mended, m, twins, starts, loops, missing, longer)
            self._scan.exclusive(longer, longer, m)
            mended = engine.empty(int(longer[m].get()), np.int32)
            engine.run_each(k.write_mended, m, twins, starts, loops, missing, longer, mended)
            starts, loops = longer, mended
        return starts, loops
