"""Wall polygons: the loops in which cells end at the surface of a solid, divided by its creases and corners."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...errors import ClvoroError
from .wall_surface import WallSurface

_ALONG = 0.25
"""A chord is along a crease that is nearer to its middle than this share of its length."""


@dataclass
class WallPolygons:
    """Faces of cells on the surface."""

    cell: list[int] = field(default_factory=list)
    patch: list[int] = field(default_factory=list)
    """`cell`, `patch`: list of int."""
    loops: list[list[int]] = field(default_factory=list)
    """list of list of int. Corners, counter-clockwise as seen from outside of the cell."""

    def add(self, cell: int, patch: int, loop: list[int]) -> None:
        """Add a face, unless it has no area."""
        loop = [a for k, a in enumerate(loop) if a != loop[k - 1]]
        if len(loop) >= 3:
            self.cell.append(cell)
            self.patch.append(patch)
            self.loops.append(loop)


def open_sides(cell: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the sides of faces, given as seen from cells, that no other face of the cell has, turned around."""
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    forward = begin < end
    # Cells and vertices are numbered anew, so that a side is one number, which is sorted faster than three.
    (place, vertices), (row, cells) = _ranks(low, high), _ranks(cell)
    assert cells * vertices**2 < 2**63
    key = (row[cell] * vertices + place[low]) * vertices + place[high]
    order = np.argsort(key, kind="stable")
    new = np.diff(key[order], prepend=-1) != 0
    first = np.flatnonzero(new)
    if not len(first):
        return cell[:0], begin[:0], end[:0]
    balance = np.add.reduceat(np.where(forward[order], 1, -1), first)
    rows = order[first[balance != 0]]
    up = balance[balance != 0] < 0  # the missing side runs the other way
    return cell[rows], np.where(up, low[rows], high[rows]), np.where(up, high[rows], low[rows])


def _ranks(*numbers: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the rank of each number that occurs among all that do, as an array by number, and how many do."""
    used = np.zeros(max(int(given.max(initial=0)) for given in numbers) + 1, bool)
    for given in numbers:
        used[given] = True
    ranks = np.cumsum(used) - 1
    return ranks, int(ranks[-1]) + 1


def chain_loops(
    cell: np.ndarray, begin: np.ndarray, end: np.ndarray, label: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sides in the order of loops, and where each loop begins and the last one ends.

    At a vertex where a cell has several sides, those follow one another whose labels are equal.

    """
    size = int(max(begin.max(initial=0), end.max(initial=0))) + 1
    out, into = cell * size + begin, cell * size + end
    by_begin = np.lexsort((label, out))
    by_end = np.lexsort((label, into))
    # As many sides begin as end at each vertex of a cell: they are matched in this order.
    after = np.empty(len(cell), np.int64)
    if not np.array_equal(out[by_begin], into[by_end]):
        raise ClvoroError("the sides of cells at walls are not closed loops")  # those of whole faces are
    after[by_end] = by_begin
    # The least side of each loop is its head; the others are ranked by doubling.
    n = len(cell)
    head, jump = np.arange(n), after.copy()
    while True:
        lower = np.minimum(head, head[jump])
        if (lower == head).all():
            break
        head, jump = lower, jump[jump]
    is_head = head == np.arange(n)
    rank, jump = np.where(is_head, 0, 1), np.where(is_head, np.arange(n), 0)
    before = np.empty(n, np.int64)
    before[after] = np.arange(n)
    jump = np.where(is_head, np.arange(n), before)
    while (jump != head).any():
        rank = rank + rank[jump]
        jump = jump[jump]
    order = np.lexsort((rank, head))
    starts = np.append(np.flatnonzero(np.diff(head[order], prepend=-1) != 0), n)
    return order, starts


class Divider:
    """Divides loops between patches.

    - `corners_of`: corners (numbers) in the interior of each cell.
    - `vertex_of_corner`: returns the vertex of a corner.
    - `place_of`: returns the position of a vertex.
    """

    def __init__(self, surface: WallSurface, corners_of: dict[int, list[int]], vertex_of_corner, place_of) -> None:
        self.surface, self.corners_of = surface, corners_of
        self.vertex_of_corner, self.place_of = vertex_of_corner, place_of
        self.polygons = WallPolygons()

    def divide(self, cell: int, loop: list[int], labels: list[int]) -> None:
        """Divide one loop: `labels` are the patches of the sides that begin in the vertices of `loop`."""
        runs = _runs(loop, labels)
        corners = self.corners_of.get(cell, [])
        add = self.polygons.add
        while len(runs) > 2:
            done = self._cut_by_corner(cell, runs, corners) or self._cut_between(cell, runs)
            if not done:
                # No crease divides this loop: its shortest run becomes a polygon.
                k = min(range(len(runs)), key=lambda i: len(runs[i][1]))
                add(cell, runs[k][0], runs[k][1])
                _replace(runs, k, [runs[k][1][0], runs[k][1][-1]])
        if len(runs) == 1:
            add(cell, runs[0][0], runs[0][1][:-1])
            return
        (p, one), (q, other) = runs
        found = [self.vertex_of_corner(c) for c in self._corners_between(corners, {p, q})]
        between = [v for v in found if v not in one + other][:1]
        add(cell, p, one + between)
        add(cell, q, other + between[::-1])

    def _cut_by_corner(self, cell: int, runs: list[tuple[int, list[int]]], corners: list[int]) -> bool:
        """Cut off a run whose patch meets those of both neighbors in a corner, a new one near its ends if there is."""
        n, used = len(runs), {v for _, run in runs for v in run}
        for k in range(n):
            before, (q, run), after = runs[k - 1], runs[k], runs[(k + 1) % n]
            if before[0] != after[0] and (fits := self._corners_between(corners, {before[0], q, after[0]})):
                middle = (self.place_of(run[0]) + self.place_of(run[-1])) / 2
                far = [float(np.linalg.norm(self.surface.corners[c] - middle)) for c in fits]
                x = min((v in used, d, v) for v, d in zip(map(self.vertex_of_corner, fits), far, strict=True))[2]
                self.polygons.add(cell, q, [*run, x])
                runs[k - 1] = (before[0], [*before[1], x])
                runs[(k + 1) % n] = (after[0], [x, *after[1]])
                del runs[k]
                return True
        return False

    def _corners_between(self, corners: list[int], patches: set[int]) -> list[int]:
        """Return those of `corners` in which all of the patches meet."""
        return [c for c in corners if patches <= set(self.surface.patches_of(self.surface.first_corner + c))]

    def _cut_between(self, cell: int, runs: list[tuple[int, list[int]]]) -> bool:
        """Cut off a run between two runs of one patch, along a crease rather than across a strip between two."""
        n = len(runs)
        found = [k for k in range(n) if runs[k - 1][0] == runs[(k + 1) % n][0]]
        if not found or n < 4:
            return False
        ends = np.array([[self.place_of(runs[k][1][i]) for i in (0, -1)] for k in found])
        patches = np.array([[runs[k][0], runs[k - 1][0]] for k in found])
        long, middle = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), ends.mean(axis=1)
        across = self.surface.nearest_crease(middle, _ALONG * long, (patches[:, 0], patches[:, 1]))[0] < 0
        k = min(zip(across.tolist(), (len(runs[k][1]) for k in found), found, strict=True))[2]
        self.polygons.add(cell, runs[k][0], runs[k][1])
        _replace(runs, k, [runs[k][1][0], runs[k][1][-1]])
        return True


def _replace(runs: list[tuple[int, list[int]]], k: int, chord: list[int]) -> None:
    """Give a run with the patch of the run before it the place of run `k`, and join runs of one patch."""
    runs[k] = (runs[k - 1][0], chord)
    vertices: list[int] = []
    labels: list[int] = []
    for patch, run in runs:
        vertices += run[:-1]
        labels += [patch] * (len(run) - 1)
    runs[:] = _runs(vertices, labels)


def _runs(loop: list[int], labels: list[int]) -> list[tuple[int, list[int]]]:
    """Return the runs of sides with one label: label and vertices, ends included."""
    n = len(loop)
    cuts = [k for k in range(n) if labels[k] != labels[k - 1]]
    if not cuts:
        return [(labels[0], [*loop, loop[0]])]
    found = []
    for a, b in zip(cuts, [*cuts[1:], cuts[0] + n], strict=True):
        found.append((labels[a], [loop[k % n] for k in range(a, b + 1)]))
    return found
