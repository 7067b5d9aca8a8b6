"""Vertices of a diagram in 3D, each once, and the loops of its faces, for output (`loops.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...errors import ClvoroError
from ...geometry.box import ClipBox
from ...opencl.primitives import Scan
from ...opencl.program import Engine
from ..device_diagram import Tessellation
from .face_matching import Agreement


@dataclass(frozen=True)
class Loops:
    """Shared vertices and face loops on the device.

    Attributes
    ----------
    positions : (v, 3) real
    starts : (m + 1,) int32
        Loop k is ``vertices[starts[k]:starts[k + 1]]``, counter-clockwise seen from outside of its cell, the other way
        around in the neighbor's row. Both are empty where the face is no wider than its vertices round: the other
        faces close both cells without it.
    vertices : (l,) int32
    doubtful : bool
        Whether vertices had to be placed anew for views to come together: what comes of it is checked.
    """

    positions: cla.Array
    starts: cla.Array
    vertices: cla.Array
    doubtful: bool = False


def apart(real: np.dtype) -> ClvoroError:
    """Return what to tell the caller if cells do not come to see the same, or only what is wrong."""
    other = "" if real == np.float64 else ", or use dtype='float64'"
    return ClvoroError(
        "the cells' views of their common faces do not come together; perturb generators that are cospherical, "
        f"or on a common circle{other}"
    )


class FaceLoops:
    """Number the vertices of a tessellation in 3D, and walk around its faces."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("tessellation/topology3d/loops")

    def walk(self, box: ClipBox, t: Tessellation) -> Loops:
        """Return the loops of `t`, vertices numbered in the order of the first cell they belong to.

        Raises
        ------
        MemoryLimitError
            If the loops are too long for 32-bit indices.
        ClvoroError
            If cells do not come to see the same.
        """
        engine, n, k = self.engine, t.n, self._kernels
        m = int(t.starts[n].get())
        agreed = Agreement(engine, box, t).reach(sliding=False)
        agreed = agreed or Agreement(engine, box, t).reach(sliding=True)
        if agreed is None:
            raise apart(engine.real)
        views, reduced = agreed.views, agreed.reduced
        c = len(views.owners)
        loop_starts, ids = engine.empty(m + 1, np.int32), engine.zeros(c + 1, np.int32)
        engine.run_each(
            k.measure_loops, n, t.starts, views.starts, views.turn_starts, reduced, agreed.counts, loop_starts, ids
        )  # fmt: skip
        self._scan.exclusive(loop_starts, loop_starts, m)
        self._scan.exclusive(ids, ids, c)
        loops = engine.empty(int(loop_starts[m].get()), np.int32)
        positions = engine.empty((int(ids[c].get()), 3))
        engine.run_each(
            k.write_loops, n, t.starts, views.starts, views.turn_starts, reduced, ids, loop_starts, loops
        )  # fmt: skip
        engine.run_each(
            k.place_vertices, c, t.points, *box.device_corners(engine.real), views.owners,
            views.corners, views.labels, agreed.chosen, ids, positions,
        )  # fmt: skip
        return Loops(positions, loop_starts, loops, agreed.doubtful)
