"""Both cells of every face come to see the same of it, in 3D (`agreement.cl`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ...geometry.box import ClipBox
from ...opencl.device_array import buffer_of
from ...opencl.primitives import Scan
from ...opencl.program import Engine
from ..device_diagram import Tessellation
from .corners import Corners, Views
from .meetings import Meetings

MOST_ROUNDS, ROUNDS_IN_PLACE = 200, 60
"""Steps in which cells may come to agree, if vertices may slide and if not: spheres of a hundred generators take some
thirty."""
MOST_GROWTH = 2
"""By how much that may lengthen all loops, if vertices may not slide: of spheres a third, of circles tenfold."""
MOST_DOUBLINGS, SURE_DOUBLINGS = 12, 3
"""How often the tolerance may double within which a face's views are brought together, and up to when vertices surely
are where they should be: in degenerate sets it doubles three times as a rule. Beyond that they are placed anew."""
ROUNDINGS = 256
"""By how many roundings of positions a vertex may be farther from one of its generators than from another: as in
`check`."""
NEAR = 1e-3
"""Vertices this much of the distance to their generators apart, and no more, may be told to be one."""
# Bits of agreement.cl.
JOINED, PUT, SLID = 1, 2, 8
HAS_DIFFERED, IN_DOUBT = 2, 4


class Agreed(NamedTuple):
    """What all cells agree about.

    Attributes
    ----------
    views : Views
        With what was put into their edges.
    reduced : (t,) int32
        Vertices of each view's loop, in the places of its turns, by their labels.
    counts : (v,) int32
        How many.
    chosen : (c,) int32
        Of each label, the corner that lies where its vertex does.
    doubtful : bool
        Whether vertices had to be placed anew: what comes of it is to be checked.
    """

    views: Views
    reduced: cla.Array
    counts: cla.Array
    chosen: cla.Array
    doubtful: bool


class Agreement:
    """One attempt to bring the views together that cells have of their faces."""

    def __init__(self, engine: Engine, box: ClipBox, t: Tessellation) -> None:
        self.engine, self.t = engine, t
        self._scan, self._corners = Scan(engine), Corners(engine)
        self._kernels = k = engine.kernels(
            "tessellation/topology3d/face_matching", {"MOST_DOUBLINGS": MOST_DOUBLINGS}
        )
        self.views = views = self._corners.list(box, t)
        self.v, self.c = len(views.view_labels), len(views.owners)
        self.twins, self.counts = (engine.empty(self.v, np.int32) for _ in range(2))
        engine.run_each(k.find_twins, t.n, t.starts, views.starts, views.view_labels, self.twins)
        self.differs = engine.zeros(self.v, np.uint8)
        self.reduced = engine.empty(len(views.turns), np.int32)
        self.chosen = self._choose()
        self._most = ROUNDINGS * float(np.finfo(engine.real).eps)

    def reach(self, sliding: bool) -> Agreed | None:
        """Change the views until both cells of every face see the same loop; return None if they do not come to.

        If `sliding`, vertices may be joined that are far from each other, where all their planes meet in one line, and
        placed anew; else it is None as well where vertices come to lie where they should not.
        """
        levels, widened, placed = None, False, False
        most_turns = np.inf if sliding else MOST_GROWTH * len(self.views.turns)
        for _ in range(MOST_ROUNDS if sliding else ROUNDS_IN_PLACE):
            if not self._differ():
                widened = widened or (
                    levels is not None and int(levels.get().max()) > SURE_DOUBLINGS
                )
                if levels is None or not widened:
                    return self._agreed(doubtful=False)
                if not sliding:
                    return self._agreed(doubtful=False) if self._are_right() else None
                labels = self._place_anew()
                if labels is not None:
                    self._rename(self.engine.upload(labels, np.int32))
                    continue
                if not placed:
                    levels.fill(SURE_DOUBLINGS)
                placed = True
                if not self._are_slits(levels):
                    return self._agreed(doubtful=True)
            if levels is None:
                levels = self._begin_snapping(sliding)
            what, joined, proposals = self._snap(levels, sliding)
            if not what or len(self.views.turns) > most_turns:
                break  # nothing is near enough, and no tolerance may grow, or it would not end
            widened = widened or bool(what & SLID)
            if what & JOINED:
                self._rename(joined)
            if what & PUT:
                self._put(proposals)
        return None

    def _agreed(self, doubtful: bool) -> Agreed:
        return Agreed(self.views, self.reduced, self.counts, self.chosen, doubtful)

    def _differ(self) -> bool:
        """Tell whether any views do."""
        views, k, any_ = self.views, self._kernels, self.engine.zeros(1, np.int32)
        self.engine.run_each(
            k.reduce_views, self.v, views.turn_starts, views.turns, views.labels, self.reduced, self.counts
        )  # fmt: skip
        self.engine.run_each(
            k.compare_views, self.v, self.twins, views.turn_starts, self.reduced, self.counts, self.differs, any_
        )  # fmt: skip
        return bool(any_[0].get())

    def _are_right(self) -> bool:
        """Tell whether vertices are as far from all generators whose cells have them, but for rounding."""
        views, n, points = self.views, self.t.n, self.t.points.get().astype(float)
        lengths = self.counts.get().astype(np.int64)
        vertices = self.reduced.get()[_places(views.turn_starts.get()[:-1], lengths)]
        cells = np.repeat(np.repeat(np.arange(n), np.diff(views.starts.get()[: n + 1])), lengths)
        at = self.chosen.get()[vertices]
        places = points[views.owners.get()[at]] + views.corners.get()[at]
        far = np.linalg.norm(places - points[cells], axis=1)
        nearest = np.full(self.c, np.inf)
        np.minimum.at(nearest, vertices, far)
        return bool((far - nearest[vertices]).max(initial=0) <= self._most)

    def _are_slits(self, levels: cla.Array) -> bool:
        """Tell whether any faces are, which differ from now on."""
        views, t, any_ = self.views, self.t, self.engine.zeros(1, np.int32)
        self.engine.run_each(
            self._kernels.find_slits, self.v, t.points, views.corners, views.owners, views.labels, self.chosen,
            self.twins, views.turn_starts, views.turns, self.reduced, self.counts, levels, self.differs, any_,
        )  # fmt: skip
        return bool(any_[0].get())

    def _snap(self, levels: cla.Array, sliding: bool) -> tuple[int, cla.Array, cla.Array]:
        """Bring views that differ nearer together; return what was done, labels to be, and what to put into edges."""
        views, engine = self.views, self.engine
        joined, done = engine.empty(self.c, np.int32), engine.zeros(1, np.int32)
        cl.enqueue_copy(engine.queue, buffer_of(joined), buffer_of(views.labels))
        proposals = engine.empty(len(views.turns), np.int32).fill(-1)
        engine.run_each(
            self._kernels.snap_views, self.v, np.int32(sliding), self.t.points, views.corners, views.owners,
            views.labels, self.chosen, self.twins, views.turn_starts, views.turns, self._chains, views.corner_faces,
            self.differs, levels, joined, proposals, done,
        )  # fmt: skip
        return int(done[0].get()), joined, proposals

    def _rename(self, joined: cla.Array) -> None:
        self._corners.name_vertices(self.views, joined)
        self.chosen = self._choose()

    def _choose(self) -> cla.Array:
        """Return the sharpest corner of each vertex, by label."""
        engine, views, k = self.engine, self.views, self._kernels
        best = engine.zeros(self.c, np.uint32)
        chosen = engine.empty(self.c, np.int32).fill(2**31 - 1)
        engine.run_each(k.rate_corners, self.c, views.labels, views.sharpness, best)
        engine.run_each(k.choose_corners, self.c, views.labels, views.sharpness, best, chosen)
        return chosen

    def _begin_snapping(self, sliding: bool = False) -> cla.Array:
        """Find the opposites and the chains of turns; return the levels of views."""
        engine, views = self.engine, self.views
        self._opposites, self._chains = (engine.empty(len(views.turns), np.int32) for _ in range(2))
        engine.run_each(
            self._kernels.find_opposites, self.v, views.owners, views.corner_faces, views.starts, views.view_labels,
            views.turn_starts, views.turns, self._opposites, self._chains,
        )  # fmt: skip
        if not sliding:  # the largest of what has served
            views.corner_faces = engine.empty(1, np.int32)
        return engine.zeros(self.v, np.uint8)

    def _put(self, proposals: cla.Array) -> None:
        """Put the vertices proposed into edges."""
        engine, views, v, k = self.engine, self.views, self.v, self._kernels
        del self.reduced
        starts, places = engine.empty(v + 1, np.int32), engine.empty(len(views.turns), np.int32)
        given = views.turn_starts, self._opposites, proposals
        engine.run_each(k.measure_views, v, *given, starts)
        self._scan.exclusive(starts, starts, v)
        engine.run_each(k.place_turns, v, *given, starts, places)
        turns, opposites, chains = (engine.empty(int(starts[v].get()), np.int32) for _ in range(3))
        engine.run_each(
            k.write_views, v, views.turn_starts, views.turns, self._opposites, self._chains, proposals, places,
            turns, opposites, chains,
        )  # fmt: skip
        views.turn_starts, views.turns = starts, turns
        self._opposites, self._chains = opposites, chains
        self.reduced = engine.empty(len(turns), np.int32)

    def _place_anew(self) -> np.ndarray | None:
        """Move vertices of views that have differed to where they are as far from all their generators.

        Returns labels to be, if some cannot be told from each other.
        """
        views = self.views
        names, ends = self._edges_in_doubt()
        labels, at = views.labels.get(), self.chosen.get()[names]
        here = np.flatnonzero(np.isin(labels, names))
        vertices = np.searchsorted(names, labels[here])
        cells = np.column_stack([views.owners.get()[here], views.corner_faces.get()[here]])
        fixed = np.zeros((len(names), 3), bool)
        row, column = np.nonzero(cells < 0)
        fixed[vertices[row], (-1 - cells[row, column]) // 2] = True
        row, column = np.nonzero(cells >= 0)
        points, corners = self.t.points.get().astype(float), views.corners.get()
        meetings = Meetings(points, fixed, vertices[row], cells[row, column])
        own = points[views.owners.get()[at]]
        places = meetings.place(own + corners[at])
        corners[at] = places - own
        views.corners.set(corners)
        a, b = ends
        way = places[b] - places[a]
        near = np.linalg.norm(way, axis=1) < NEAR * np.linalg.norm(corners[at][a], axis=1)
        near &= ~(fixed[a] & (np.abs(way) > self._most)).any(axis=1)
        a, b = a[near], b[near]
        alike = meetings.excess(a, places[b]) < self._most
        if not alike.any():
            return None
        pairs = np.sort(np.stack([names[a], names[b]])[:, alike], axis=0)
        np.minimum.at(labels, pairs[1], pairs[0])
        return labels

    def _edges_in_doubt(self) -> tuple[np.ndarray, np.ndarray]:
        """Mark the views that have a vertex of one that has differed.

        Returns the labels of their vertices, and which of those are ends of edges, (2, e).
        """
        loops, state = self.reduced.get(), self.differs.get() & HAS_DIFFERED
        begins, lengths = self.views.turn_starts.get()[:-1], self.counts.get().astype(np.int64)
        touched = np.zeros(self.c, bool)
        touched[loops[_places(begins, np.where(state > 0, lengths, 0))]] = True
        of_turns = np.repeat(np.arange(self.v), lengths)
        state[of_turns[touched[loops[_places(begins, lengths)]]]] |= IN_DOUBT
        self.differs.set(state)
        some = np.flatnonzero((state & IN_DOUBT > 0) & (lengths > 0))
        begins, lengths = begins[some], lengths[some]
        turns = _places(begins, lengths)
        nexts = turns + 1
        nexts[np.cumsum(lengths) - 1] = begins
        names, ends = np.unique(np.stack([loops[turns], loops[nexts]]), return_inverse=True)
        return names, np.unique(ends.reshape(2, -1), axis=1)


def _places(begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the places of rows that begin at `begins` and are `lengths` long, (sum of lengths,)."""
    return np.repeat(begins - np.cumsum(lengths) + lengths, lengths) + np.arange(lengths.sum())
