"""Runs along walls in 2D. A run is the part of the boundary from the end of one inner face to the end of the next.

It belongs to one cell. Its cost is that of its chords, and of corners at which the cell is not convex: see `chords`.
"""

from __future__ import annotations

import numpy as np

from ..mesh.faces import Faces
from ..mesh.geometry import polygon_centroids
from .chords import Lines, chord_costs, complex_of, concave_prices, kept_points
from .prisms import simple_loops

_WAY_PRICE, _TILT_PRICE = 0.02, 0.6
"""Prices of moving the end of a face, in squares of the size of the cell: for the distance over the size, and for the
square of the angle in radians by which the face turns."""


class WallRuns:
    """The runs of one mesh.

    Attributes
    ----------
    order : (w,) int
        Wall faces, chain by chain as they follow each other on their rings. Whole rings within one cell are left out.
    begin, end : (r,) int
        Places in `order` of the first face of each run, and behind the last one. On a closed chain places go on behind
        its end, and before its beginning.
    cell : (r,) int
    one, two : (e,) int
        Runs on both sides of the face ends that can move.
    face, side : (e,) int
        The faces, and which of their ends.
    first, last : (w,) int
        Points of the wall faces, counted from the first wall face as in all arrays here.
    lengths : (w,) float
    part : (w,) int
        Named part of the boundary.
    sizes : (n,) float
        Sizes of cells.
    """

    def __init__(self, mesh: Faces, onward: np.ndarray, parts: np.ndarray) -> None:
        self.mesh, self.walls = mesh, np.arange(mesh.n_inner, mesh.n_outer)
        self.first, self.last = mesh.corners.reshape(-1, 2)[self.walls].T
        areas, centroids = polygon_centroids(mesh)
        self.points, self.centroids = complex_of(mesh.points), complex_of(centroids)
        self.lengths = np.abs(self.points[self.last] - self.points[self.first])
        self.sizes = np.sqrt(np.maximum(areas, 0))
        self.part = parts[-1 - mesh.neighbor[self.walls]]
        self._set_runs(self._following(onward))
        self.behind, self.ahead, self.known = self._beside()
        self.one, self.two, self.face, self.side = self._links()
        # Costs that are known, by a key for run, begin and end; the keys ascend.
        self.keys, self.costs = np.zeros(0, np.int64), np.zeros(0)

    def _following(self, onward: np.ndarray) -> np.ndarray:
        """Return the next wall face on the ring for each one, counted from the first, (w,); -1 at an end.

        `onward` (m,) is the next half-face of the diagram on its ring; see `along_rings`.
        """
        place = np.full(len(onward) + 1, -1)
        rows = self.mesh.half_face[self.walls]
        place[rows] = np.arange(len(rows))
        after = onward[rows]
        for _ in range(64):  # half-faces without length have no face
            skipped = (after >= 0) & (place[after] < 0)
            if not skipped.any():
                break
            after[skipped] = onward[after[skipped]]
        after = np.where((after >= 0) & (place[after] >= 0), place[after], -1)
        joined = (after >= 0) & (self.first[after] == self.last)
        return np.where(joined, after, -1)

    def _set_runs(self, following: np.ndarray) -> None:
        """Set `order`, which lists the runs, and `after`, for each run the next one on the boundary or -1."""
        owner = self.mesh.owner[self.walls]
        before = np.full(len(owner), -1)
        goes_on = np.flatnonzero(following >= 0)
        before[following[goes_on]] = goes_on
        begins = (before < 0) | (owner[before] != owner)
        # Open chains first, then closed ones, which begin where a run begins.
        heads = np.concatenate([np.flatnonzero(before < 0), np.flatnonzero(begins)])
        order: list[int] = []
        chains: list[int] = []
        onward, done = following.tolist(), [False] * len(owner)
        for head in heads.tolist():
            if done[head]:
                continue
            chains.append(len(order))
            face = head
            while face >= 0 and not done[face]:
                done[face] = True
                order.append(face)
                face = onward[face]
        self.order = np.array(order, np.int64)
        starts = np.array([*chains, len(order)], np.int64)
        self.begin = np.flatnonzero(begins[self.order])
        self.end = np.append(self.begin, len(order))[1:]
        self.cell = owner[self.order[self.begin]].astype(np.int64)
        chain = np.searchsorted(starts, self.begin, side="right") - 1
        self.chain_begin, self.chain_length = starts[chain], np.diff(starts)[chain]
        # The run that begins with the face after the last one.
        run = np.full(len(owner) + 1, -1)
        run[self.order[self.begin]] = np.arange(len(self.begin))
        self.after = run[following[self.order[self.end - 1]]]

    def at(self, run: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return the wall faces at places on the chains of runs."""
        begin = self.chain_begin[run]
        return self.order[begin + (place - begin) % self.chain_length[run]]

    def _beside(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the two points before and after each run in the loop around its cell, and whether they are known."""
        starts, loops, broken = simple_loops(self.mesh)
        v, row = len(self.mesh.points), np.repeat(np.arange(self.mesh.n_cells), np.diff(starts))
        keys = row * v + loops
        order = np.argsort(keys, kind="stable")
        keys = keys[order]

        def places(points: np.ndarray) -> np.ndarray:
            """Return the places of `points`, one per run, in the loops of points around the cells of the runs."""
            at = np.searchsorted(keys, self.cell * v + points)
            return order[np.minimum(at, len(keys) - 1)] - starts[self.cell]

        counts = np.diff(starts)[self.cell]
        begin = places(self.first[self.order[self.begin]])
        end = places(self.last[self.order[self.end - 1]])

        def taken(place: np.ndarray) -> np.ndarray:
            at = starts[self.cell] + place % np.maximum(counts, 1)
            return self.points[loops[np.minimum(at, len(loops) - 1)]]

        behind = np.stack([taken(begin - 2), taken(begin - 1)], axis=1)
        ahead = np.stack([taken(end + 1), taken(end + 2)], axis=1)
        known = (counts >= self.end - self.begin + 3) & ~np.isin(self.cell, broken)
        return behind, ahead, known

    def _links(self) -> tuple[np.ndarray, ...]:
        """Return the runs on both sides of face ends that can move, the inner faces, and which of their ends."""
        k, v = self.mesh.n_inner, len(self.mesh.points)
        inner = self.mesh.corners[: 2 * k]
        wall_ends = np.concatenate([self.first, self.last])
        single = np.bincount(inner, minlength=v) == 1
        single &= np.bincount(wall_ends, minlength=v) == 2
        at = np.full(v, -1)
        at[inner] = np.arange(len(inner))
        one = np.flatnonzero((self.after >= 0) & self.known)
        two = self.after[one]
        point = self.first[self.order[self.begin[two]]]
        place = np.where(single[point], at[point], -1)
        face, side = np.divmod(np.maximum(place, 0), 2)
        sides = np.sort([self.mesh.owner[face], self.mesh.neighbor[face]], axis=0)
        joined = (sides == np.sort([self.cell[one], self.cell[two]], axis=0)).all(axis=0)
        rows = np.flatnonzero((place >= 0) & joined & self.known[two] & (one != two))
        return one[rows], two[rows], face[rows], side[rows]

    def lines(self, run: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[Lines, np.ndarray, np.ndarray]:
        """Return the lines of runs between two places, their points, and the wall face that begins in each point.

        For the last point of a line it is the face that ends there. A line with `begin` = `end` is one point.
        """
        counts = end - begin + 1
        starts = np.concatenate([[0], np.cumsum(counts)])
        row = np.repeat(np.arange(len(run)), counts)
        k = np.arange(starts[-1]) - starts[row]
        last = (k == counts[row] - 1) & (k > 0)
        face = self.at(run[row], begin[row] + k - last)
        points = np.where(last, self.last[face], self.first[face])
        fixed = np.zeros(len(face), bool)
        fixed[1:] = ~last[1:] & (k[1:] > 0) & (self.part[face[1:]] != self.part[face[:-1]])
        sizes = self.sizes[self.cell[run]]
        return Lines(starts, self.points[points], fixed, sizes), points, face

    def cost(self, run: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return what each run would cost if it began at place `begin` and ended at place `end`.

        If both are equal, the run is one point.
        """
        m = len(self.order) + 1
        begin = begin - self.chain_begin[run]
        keys = (run * m + begin % self.chain_length[run]) * m + end - begin - self.chain_begin[run]
        wanted, first = np.unique(keys, return_index=True)
        fresh = first[~np.isin(wanted, self.keys, assume_unique=True)]
        if fresh.size:
            begin = begin + self.chain_begin[run]
            some = run[fresh]
            lines, _, _ = self.lines(some, begin[fresh], end[fresh])
            kept = kept_points(lines)
            costs = chord_costs(lines, kept, self.centroids[self.cell[some]])
            costs += concave_prices(lines, kept, self.behind[some], self.ahead[some])
            every = np.concatenate([self.keys, keys[fresh]])
            order = np.argsort(every, kind="stable")
            self.keys, self.costs = every[order], np.concatenate([self.costs, costs])[order]
        return self.costs[np.searchsorted(self.keys, keys)]

    def way_price(self, run: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
        """Return the prices of moving the ends of runs from points `old` to `new`."""
        size, foot = self.sizes[self.cell[run]], self.ahead[run, 0]
        u, v = self.points[old] - foot, self.points[new] - foot
        tilt = np.angle(np.conj(u) * v)
        return _WAY_PRICE * np.abs(v - u) * size + _TILT_PRICE * (tilt * size) ** 2
