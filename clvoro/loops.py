"""Vertices of a diagram in 3D, each once, and the loops of its faces, for output (`loops.cl`)."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ._device_array import buffer_of
from ._primitives import Scan
from ._program import Engine
from .corners import Corners, Views
from .domain import ClipBox
from .errors import ClvoroError
from .tessellation import Tessellation

MOST_ROUNDS = 200
"""Steps in which cells may come to agree; spheres of a hundred generators take some thirty."""
JOINED, PUT = 1, 2
MOST_DOUBLINGS, SURE_DOUBLINGS = 6, 3
"""How often the tolerance may double within which a face's views are brought together, and up to when vertices surely
are where they should be: in degenerate sets it doubles three times as a rule. Beyond that they are looked at."""
ROUNDINGS = 256
"""By how many roundings of positions a vertex may be farther from one of its generators than from another: as in
`check`."""


@dataclass(frozen=True)
class Loops:
    """Shared vertices and face loops on the device.

    Attributes
    ----------
    positions : (v, 3) real
    starts : (m + 1,) int32
        Loop k is ``vertices[starts[k]:starts[k + 1]]``, counter-clockwise seen from outside of its cell, the other way
        around in the neighbour's row. Both are empty where the face is no wider than its vertices round: the other
        faces close both cells without it.
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
        self._kernels = engine.kernels("loops", {"MOST_DOUBLINGS": MOST_DOUBLINGS})

    def walk(self, box: ClipBox, t: Tessellation) -> Loops:
        """Return the loops of `t`, vertices numbered in the order of the first cell they belong to.

        Raises
        ------
        MemoryLimitError
            If the loops are too long for 32-bit indices.
        """
        engine, n, k = self.engine, t.n, self._kernels
        m = int(t.starts[n].get())
        corners = Corners(engine)
        views = corners.list(box, t)
        twins = engine.empty(len(views.view_labels), np.int32)
        engine.run_each(k.find_twins, n, t.starts, views.starts, views.view_labels, twins)
        reduced, counts, chosen, widest = self._agree(k, corners, t, views, twins)
        c = len(views.owners)
        loop_starts, ids = engine.empty(m + 1, np.int32), engine.zeros(c + 1, np.int32)
        engine.run_each(
            k.measure_loops, n, t.starts, views.starts, views.turn_starts, reduced, counts, loop_starts, ids
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
            views.corners, views.labels, chosen, ids, positions,
        )  # fmt: skip
        result = Loops(positions, loop_starts, loops)
        if widest > SURE_DOUBLINGS and not self._are_right(t, result):
            raise self._apart()
        return result

    def _are_right(self, t: Tessellation, loops: Loops) -> bool:
        """Tell whether every vertex is as far from all generators whose cells meet there, but for rounding."""
        starts = t.starts.get()[: t.n + 1]
        cell = np.repeat(np.arange(t.n), np.diff(starts))
        own = np.repeat(cell, np.diff(loops.starts.get()))
        vertex = loops.vertices.get()
        at = loops.positions.get().astype(float)[vertex]
        far = np.linalg.norm(at - t.points.get().astype(float)[own], axis=1)
        nearest = np.full(len(loops.positions), np.inf)
        np.minimum.at(nearest, vertex, far)
        excess = far - nearest[vertex]
        return bool(excess.max(initial=0) <= ROUNDINGS * np.finfo(self.engine.real).eps)

    def _agree(
        self, k: SimpleNamespace, corners: Corners, t: Tessellation, views: Views, twins: cla.Array
    ) -> tuple[cla.Array, cla.Array, cla.Array, int]:
        """Change `views` until both cells of every face see the same loop.

        Returns the loops (in the places of the turns), their lengths, for each label the corner that lies where its
        vertex does, and how often tolerances have doubled at most.
        """
        engine, v, c = self.engine, len(twins), len(views.owners)
        counts, differs = engine.empty(v, np.int32), engine.empty(v, np.uint8)
        any_, done = engine.empty(1, np.int32), engine.empty(1, np.int32)
        reduced = engine.empty(len(views.turns), np.int32)
        chosen, snapping = self._chosen(k, views), None
        for _ in range(MOST_ROUNDS):
            engine.run_each(
                k.reduce_views, v, views.turn_starts, views.turns, views.labels, reduced, counts
            )
            any_.fill(0)
            engine.run_each(
                k.compare_views, v, twins, views.turn_starts, reduced, counts, differs, any_
            )
            if not int(any_[0].get()):
                widest = 0 if snapping is None else int(snapping[0].get().max())
                return reduced, counts, chosen, widest
            if snapping is None:
                snapping = self._begin_snapping(k, views, v, c)
            levels, joined, opposites, chains = snapping
            cl.enqueue_copy(engine.queue, buffer_of(joined), buffer_of(views.labels))
            done.fill(0)
            proposals = engine.empty(len(views.turns), np.int32).fill(-1)
            engine.run_each(
                k.snap_views, v, t.points, views.corners, views.owners, views.labels, chosen, twins,
                views.turn_starts, views.turns, chains, differs, levels, joined, proposals, done,
            )  # fmt: skip
            what = int(done[0].get())
            if not what:  # nothing is near enough, and no tolerance may grow
                break
            if what & JOINED:
                corners.name_vertices(views, joined)
                chosen = self._chosen(k, views)
            if what & PUT:
                del reduced
                snapping = levels, joined, *self._put(k, views, opposites, chains, proposals)
                reduced = engine.empty(len(views.turns), np.int32)
        raise self._apart()

    def _apart(self) -> ClvoroError:
        other = "" if self.engine.real == np.float64 else ", or use dtype='float64'"
        return ClvoroError(
            "the cells' views of their common faces do not come together; perturb generators that are cospherical, "
            f"or on a common circle{other}"
        )

    def _chosen(self, k: SimpleNamespace, views: Views) -> cla.Array:
        """Return the sharpest corner of each vertex, by label."""
        engine, c = self.engine, len(views.owners)
        best, chosen = engine.zeros(c, np.uint32), engine.empty(c, np.int32).fill(2**31 - 1)
        engine.run_each(k.rate_corners, c, views.labels, views.sharpness, best)
        engine.run_each(k.choose_corners, c, views.labels, views.sharpness, best, chosen)
        return chosen

    def _begin_snapping(
        self, k: SimpleNamespace, views: Views, v: int, c: int
    ) -> tuple[cla.Array, cla.Array, cla.Array, cla.Array]:
        """Return the levels of `v` views, the labels to be of `c` corners, the opposites and the chains of turns."""
        engine = self.engine
        levels, joined = engine.zeros(v, np.uint8), engine.empty(c, np.int32)
        opposites, chains = (engine.empty(len(views.turns), np.int32) for _ in range(2))
        engine.run_each(
            k.find_opposites, v, views.owners, views.corner_faces, views.starts, views.view_labels,
            views.turn_starts, views.turns, opposites, chains,
        )  # fmt: skip
        views.corner_faces = engine.empty(1, np.int32)  # the largest of what has served
        return levels, joined, opposites, chains

    def _put(
        self,
        k: SimpleNamespace,
        views: Views,
        opposites: cla.Array,
        chains: cla.Array,
        proposals: cla.Array,
    ) -> tuple[cla.Array, cla.Array]:
        """Put the vertices proposed into edges; return the new opposites and chains."""
        engine, v = self.engine, len(views.view_labels)
        starts, places = engine.empty(v + 1, np.int32), engine.empty(len(views.turns), np.int32)
        engine.run_each(k.measure_views, v, views.turn_starts, opposites, proposals, starts)
        self._scan.exclusive(starts, starts, v)
        engine.run_each(k.place_turns, v, views.turn_starts, opposites, proposals, starts, places)
        turns, new_opposites, new_chains = (
            engine.empty(int(starts[v].get()), np.int32) for _ in range(3)
        )
        engine.run_each(
            k.write_views, v, views.turn_starts, views.turns, opposites, chains, proposals, places,
            turns, new_opposites, new_chains,
        )  # fmt: skip
        views.turn_starts, views.turns = starts, turns
        return new_opposites, new_chains
