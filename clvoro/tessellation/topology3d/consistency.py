"""Make both half-faces of every face identical in 3D, and give the vertices their numbers (`consistency.cl`).

This is the one place for round-off in 3D. Cells are clipped one by one. Where more than four cells meet in a point, or
where generators lie on a circle or a sphere, round-off decides which faces each of them has. `share_faces` makes both
cells of every face agree, or raises.

The least distance of generators is `LEAST_SEPARATION`, a share of the longest edge of the domain. Nearer ones may raise
an error. A diagram that is returned is correct in any case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ...geometry.domain import ClipBox
from ...opencl.device_array import buffer_of
from ...opencl.engine import Engine
from ...opencl.primitives import Scan
from ..device_diagram import CloseError, Tessellation
from .half_faces import HalfFaces, list_half_faces

MOST_DOUBLINGS, SAFE_DOUBLINGS = 14, 3
"""How often the tolerance may double, and how often without a check of the result. Lattices take none."""
_LARGEST = 2**31 - 1


@dataclass(frozen=True)
class SharedFaces:
    """Vertices and the loops of faces, on the device."""

    positions: cla.Array
    """(v, 3) real. In the order of the first cell that has the vertex."""
    starts: cla.Array
    """(m + 1,) int32. The loop of face k is ``vertices[starts[k]:starts[k + 1]]``, counter-clockwise as seen from
    outside of its cell, reversed in the row of the neighbor. Both are empty where the face is no wider than round-off:
    the other faces close both cells without it."""
    vertices: cla.Array
    """(l,) int32."""
    merged: bool
    """Whether vertices have been merged: some faces may then have no area."""
    needs_check: bool
    """Whether the tolerance was so large that the diagram has to be checked."""


def share_faces(engine: Engine, box: ClipBox, t: Tessellation) -> SharedFaces:
    """Return the vertices and faces of `t`, the same from both cells of every face.

    Raises `MemoryLimitError` if the loops are too long for 32-bit indices. Raises `CloseError` if round-off leaves too
    much of a cell uncertain.
    """
    return FaceSharing(engine, box, t).run()


class FaceSharing:
    """Vertices are merged until the two half-faces of every face are identical.

    - `half_faces`: HalfFaces
    - `labels` (c,) int32: of each corner: its vertex, named by its first corner.
    - `best_corners` (c,) int32: of each vertex: the corner that its faces determine best.
    - `reduced`, `counts` (3 c,), (h,) int32: the loops of half-faces as vertices, without repetitions and spurs, and
      their lengths.
    - `differs`: (h,) uint8
    - `merged`: whether any vertices have been merged.
    """

    def __init__(self, engine: Engine, box: ClipBox, t: Tessellation) -> None:
        self.engine, self.t = engine, t
        self._kernels = engine.kernels("tessellation/topology3d/consistency")
        self._corners = box.device_corners(engine.real)
        self.half_faces: HalfFaces = list_half_faces(engine, box, t)
        f = self.half_faces
        self.c, self.h = len(f.owners), len(f.labels)
        self.merged = False
        self.labels = f.same.copy()
        self.name_vertices(f.same.copy())
        self.twins = engine.empty(self.h, np.int32)
        engine.run_each(self._kernels.find_twins, t.n, t.starts, f.starts, f.labels, self.twins)
        self.differs = engine.empty(self.h, np.uint8)

    def run(self) -> SharedFaces:
        """Return the faces once their half-faces are identical."""
        doublings = 0
        while self.compare():
            if not self.merge(doublings):
                doublings += 1
            if doublings > MOST_DOUBLINGS:
                raise CloseError(self.t.points, self.t.n)
        return self._write(doublings)

    def name_vertices(self, labels: cla.Array) -> None:
        """Find the labels and best corners of vertices, where `labels` (c,) holds lesser ones of some corners."""
        engine, f, k = self.engine, self.half_faces, self._kernels
        changed = engine.empty(1, np.int32)
        while True:
            changed.fill(0)
            cl.enqueue_copy(engine.queue, buffer_of(self.labels), buffer_of(labels))
            engine.run_each(k.spread_labels, self.c, f.same, f.twin_corners, self.labels, labels, changed)
            if not int(changed[0].get()):
                break
        best = engine.zeros(self.c, np.uint32)
        self.best_corners = engine.empty(self.c, np.int32).fill(_LARGEST)
        engine.run_each(k.rate_corners, self.c, self.labels, f.sharpness, best)
        engine.run_each(k.choose_corners, self.c, self.labels, f.sharpness, best, self.best_corners)

    def compare(self) -> bool:
        """Reduce all loops; return whether any half-face differs from its twin."""
        f, k, any_ = self.half_faces, self._kernels, self.engine.zeros(1, np.int32)
        self.reduced, self.counts = (self.engine.empty(size, np.int32) for size in (len(f.loops), self.h))
        self.engine.run_each(k.reduce_loops, self.h, f.loop_starts, f.loops, self.labels, self.reduced, self.counts)
        self.engine.run_each(
            k.compare_half_faces, self.h, self.twins, f.loop_starts, self.reduced, self.counts, self.differs, any_
        )
        return bool(any_[0].get())

    @property
    def _vertices(self) -> tuple[object, ...]:
        """What kernels take as VERTEX_ARGS."""
        f = self.half_faces
        return (self.t.sites, f.corners, f.owners, f.corner_faces, self.labels, self.best_corners, *self._corners)

    def merge(self, doublings: int) -> bool:
        """Merge vertices of half-faces that differ, within a tolerance; return whether there were any to merge."""
        engine, f, k, c = self.engine, self.half_faces, self._kernels, self.c
        del self.reduced, self.counts  # they are made again
        distances = engine.empty(c, np.uint32).fill(2**32 - 1)
        targets = engine.empty(c, np.int32).fill(_LARGEST)
        for second_pass in (0, 1):
            loops = f.sharpness, f.loop_starts, f.loops, self.twins, self.differs
            engine.run_each(
                k.find_targets,
                self.h,
                *self._vertices,
                *loops,
                np.int32(doublings),
                np.int32(second_pass),
                distances,
                targets,
            )
        del distances
        rejected, any_ = engine.zeros(c, np.int32), engine.zeros(1, np.int32)
        engine.run_each(k.reject_targets, c, *self._vertices, targets, np.int32(doublings), rejected)
        labels = self.labels.copy()
        engine.run_each(k.merge_vertices, c, self.labels, targets, rejected, labels, any_)
        if not int(any_[0].get()):
            return False
        self.merged = True
        del targets, rejected
        self.name_vertices(labels)
        return True

    def _write(self, doublings: int) -> SharedFaces:
        engine, t, f, k, c = self.engine, self.t, self.half_faces, self._kernels, self.c
        n, m, scan = t.n, int(t.starts[t.n].get()), Scan(engine)
        del f.same, f.twin_corners, f.sharpness, f.loops, self.twins, self.differs  # memory for the result
        starts, ids = engine.empty(m + 1, np.int32), engine.zeros(c + 1, np.int32)
        engine.run_each(k.measure_loops, n, t.starts, f.starts, f.loop_starts, self.reduced, self.counts, starts, ids)
        scan.exclusive(starts, starts, m)
        scan.exclusive(ids, ids, c)
        vertices = engine.empty(int(starts[m].get()), np.int32)
        engine.run_each(k.write_loops, n, t.starts, f.starts, f.loop_starts, self.reduced, ids, starts, vertices)
        del self.reduced, self.counts
        positions = engine.empty((int(ids[c].get()), 3))
        engine.run_each(k.write_positions, c, *self._vertices, ids, positions)
        return SharedFaces(positions, starts, vertices, self.merged, doublings > SAFE_DOUBLINGS)
