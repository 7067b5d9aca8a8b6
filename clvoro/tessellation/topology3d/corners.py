"""Corners of a diagram's cells in 3D, and which of them are one vertex (`corners.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ...errors import MemoryLimitError
from ...geometry.box import ClipBox
from ...opencl.device_array import buffer_of
from ...opencl.primitives import Scan
from ...opencl.program import Engine
from ..device_diagram import Tessellation

FACE_CAPACITY = 64
MOST_TURNS = 2**31 - 1


@dataclass
class Views:
    """Every cell as it sees itself, on the device: its corners, and loops of corners around its faces.

    Attributes
    ----------
    corners : (c, 3) real
        Relative to the generator `owners` (c,) int32.
    sharpness : (c,) float32
        How well its faces determine a corner.
    corner_faces : (c, 3) int32
        Labels of the faces that meet there: a generator, or ``-1 - wall``.
    same, twins : (c,) int32
        Corners that are one vertex with it: in the same cell, in another.
    labels : (c,) int32
        The least corner of its vertex.
    starts : (n + 1,) int32
        Rows of views, a cell's own faces: those of the graph in its order, then walls that the graph leaves out.
    view_labels : (v,) int32
    turn_starts : (v + 1,) int32
    turns : (3 c,) int32
        The loop of each view: corners, counter-clockwise from outside.
    """

    corners: cla.Array
    owners: cla.Array
    sharpness: cla.Array
    corner_faces: cla.Array
    same: cla.Array
    twins: cla.Array
    labels: cla.Array
    starts: cla.Array
    view_labels: cla.Array
    turn_starts: cla.Array
    turns: cla.Array


class Corners:
    """List the corners of a tessellation's cells, and name their vertices."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)

    def list(self, box: ClipBox, t: Tessellation) -> Views:
        """Return what each cell of `t` sees.

        Raises
        ------
        MemoryLimitError
            If the corners are too many for 32-bit indices.
        """
        engine, n = self.engine, t.n
        corner_starts, starts = engine.empty(n + 1, np.int32), engine.empty(n + 1, np.int32)
        cell = (t.points, *box.device_corners(engine.real), t.starts, t.neighbors)
        capacity, full = FACE_CAPACITY, engine.zeros(1, np.int32)
        while True:
            k = engine.kernels("tessellation/topology3d/corners", {"FACE_CAPACITY": capacity})
            # Private arrays of a whole group lie on the stack of a CPU's thread.
            group = None if capacity == FACE_CAPACITY else 1
            engine.run_each(k.count_corners, n, *cell, corner_starts, starts, full, group=group)
            if not int(full[0].get()):
                break
            capacity *= 2
            full.fill(0)
        self._scan.exclusive(corner_starts, corner_starts, n)
        self._scan.exclusive(starts, starts, n)
        c, views = int(corner_starts[n].get()), int(starts[n].get())
        if not 0 < c <= MOST_TURNS // 3:
            raise MemoryLimitError(
                f"{n} cells have more vertices than 32-bit indices can tell apart; use fewer cells"
            )
        owners, same, twins = (engine.empty(c, np.int32) for _ in range(3))
        corners, sharpness = engine.empty((c, 3)), engine.empty(c, np.float32)
        corner_faces, turns = engine.empty((c, 3), np.int32), engine.empty(3 * c, np.int32)
        view_labels, turn_starts = engine.empty(views, np.int32), engine.empty(views + 1, np.int32)
        engine.run_each(
            k.list_corners, n, *cell, corner_starts, starts, corners, sharpness, corner_faces, owners,
            same, view_labels, turn_starts, turns, group=group,
        )  # fmt: skip
        engine.run_each(k.match_corners, c, owners, corner_starts, corner_faces, twins)
        self._spread = k.spread_labels
        result = Views(
            corners, owners, sharpness, corner_faces, same, twins, same.copy(), starts, view_labels,
            turn_starts, turns,
        )  # fmt: skip
        self.name_vertices(result, same.copy())
        return result

    def name_vertices(self, views: Views, joined: cla.Array) -> None:
        """Find the labels anew, where `joined` (c,) holds lesser ones of some corners."""
        engine, changed = self.engine, self.engine.empty(1, np.int32)
        while True:
            changed.fill(0)
            cl.enqueue_copy(engine.queue, buffer_of(views.labels), buffer_of(joined))
            engine.run_each(
                self._spread, len(joined), views.same, views.twins, views.labels, joined, changed
            )
            if not int(changed[0].get()):
                break
