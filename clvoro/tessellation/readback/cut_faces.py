"""Ends of the faces of cells that a boundary cuts: corners of convex cells, corners of the boundary, and crossings."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ...connectivity import rows_of, starts_of
from ..clipped.boundary_crossings import UNTOUCHED
from ..clipped.trim import Trimmed
from ..vertices import Vertices


class CutFaces:
    """The faces of a trimmed diagram of `n` cells with `m` faces, on the host; `scale` is that of the domain's frame.

    The arrays are small, because they cover only cells that the boundary crosses.

    - `touched` (t,) int32: the cells that the boundary crosses.
    - `shifted`: whether the boundary was shifted by round-off.
    - `edge_numbers` (k,) int: number in the caller's order of each edge on the device.
    """

    def __init__(self, made: Trimmed, n: int, m: int, scale: float) -> None:
        chords, self.m = made.chords, m
        self.edge_numbers = chords.rings.edge_numbers
        self._next = chords.rings.next_vertex
        self._vertices = chords.rings.vertices + chords.shift * scale
        self.shifted = bool(chords.shift.any())
        self._slots = chords.slots.get()[:n]
        self.touched = chords.touched.get()[: chords.touched_count]
        arrays = [a.get() for a in chords.arrays]
        self._device_vertices = arrays[0]
        self._firsts, self._chord_edges = arrays[3], arrays[5]
        self._chord_ends = arrays[6][: chords.count]
        starts, labels, begins, ends = (a.get() for a in made.segments[:4])
        count = made.segment_count
        self._segment_cells = np.repeat(self.touched, np.diff(starts[: len(self.touched) + 1]))
        self._segments = labels[:count], begins[:count], ends[:count]
        self._face_segments = made.face_segments.get()[:m]

    @cached_property
    def _numbered(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (k, 2) of corners and crossings, each once, and their numbers: of corners, then of ends of chords.

        Positions that are equal on the device count as one. The device has no segments between them.
        """
        found = []
        # The device measured with the shifted boundary.
        for vertices in (self._device_vertices, self._vertices):
            a, b = vertices[self._chord_edges], vertices[self._next[self._chord_edges]]
            t = self._chord_ends[:, None]
            ends = np.where(t >= 1, b, np.where(t <= 0, a, a + t * (b - a)))
            found.append(np.concatenate([vertices, ends]))
        _, first, numbers = np.unique(found[0], axis=0, return_index=True, return_inverse=True)
        return found[1][first], numbers.ravel()

    @property
    def positions(self) -> np.ndarray:
        """The vertices that the boundary adds, in physical units, (k, 2)."""
        return self._numbered[0]

    def ends(self, whole_starts: np.ndarray, shared: Vertices, starts: np.ndarray) -> np.ndarray:
        """Return the first and last vertex of each face on the device, (m, 2).

        The `shared` vertices of the convex diagram with rows at `whole_starts` come first, then `positions`. Rows of
        the trimmed diagram begin at `starts`.
        """
        corners = shared.cell_vertices.get()
        ends = np.empty((self.m, 2), np.int64)
        owner = rows_of(starts)
        whole = self._slots[owner] == UNTOUCHED
        i = owner[whole]
        k = np.flatnonzero(whole) - starts[i]
        sides = whole_starts[i + 1] - whole_starts[i]
        ends[whole, 0] = corners[whole_starts[i] + k]
        ends[whole, 1] = corners[whole_starts[i] + (k + 1) % sides]
        # Faces of trimmed cells are segments, which may lie in another convex cell.
        s = self._face_segments[~whole]
        labels, *sides_of = self._segments
        on_boundary = labels[s] < 0
        n_corners, number = len(self._vertices), self._numbered[1] + shared.count
        cell_first = whole_starts[self._segment_cells[s]]
        found = []
        for side in (sides_of[0][s], sides_of[1][s]):
            at_corner = cell_first + np.where(side < 0, -1 - side, 0)
            found.append(np.where(side >= 0, number[n_corners + np.maximum(side, 0)], corners[at_corner]))
        chord = sides_of[0][s][on_boundary]
        edge = self._chord_edges[chord]
        first, last = chord == self._firsts[edge], chord + 1 == self._firsts[edge + 1]
        found[0][on_boundary] = np.where(first, number[edge], number[n_corners + np.maximum(chord - 1, 0)])
        found[1][on_boundary] = np.where(last, number[self._next[edge]], number[n_corners + chord])
        ends[~whole] = np.stack(found, axis=1)
        return ends


def chain_faces(slots: np.ndarray, ends: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, dict[int, list[int]]]:
    """Order faces along the loops of each cell.

    - `slots` (m,) int: index of each face, row by row.
    - `ends` (m, 2) int: first and last vertex of each face, by index.
    - `starts` (n + 1,) int32: rows of `slots`.

    Results:
    - `order` (m,) int: `slots` in that order.
    - `lengths`: the lengths of the loops of those rows that have several.
    """
    ends, m = ends[slots], len(slots)
    row = rows_of(starts)
    following = np.arange(1, m + 1)
    filled = np.diff(starts) > 0  # cells of power diagrams may be empty
    following[starts[1:][filled] - 1] = starts[:-1][filled]
    broken = np.unique(row[ends[:, 1] != ends[following, 0]])
    order, lengths = slots.copy(), {}
    for i in broken.tolist():
        part = slice(starts[i], starts[i + 1])
        loops = _loops(ends[part])
        order[part] = slots[part][np.concatenate(loops)]
        lengths[i] = [len(loop) for loop in loops]
    return order, lengths


def join_loops(corners: np.ndarray, starts: np.ndarray, several: dict[int, list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return one closed chain of corners per cell: where it begins, (n + 1,) int32, and the corners, (c,) int32.

    A bridge, passed in both directions, connects the loops of a cell with `several`, given by their lengths.
    """
    if several:
        rows = np.split(corners, starts[1:-1])
        for i, lengths in several.items():
            loops = np.split(rows[i], np.cumsum(lengths)[:-1])
            chain = [loops[0]]
            for loop in loops[1:]:
                chain += [loops[0][:1], loop, loop[:1]]
            rows[i] = np.concatenate(chain)
        starts, corners = starts_of([len(r) for r in rows]), np.concatenate(rows)
    return starts.astype(np.int32), corners.astype(np.int32)


def _loops(ends: np.ndarray) -> list[list[int]]:
    """Chain faces from ends[:, 0] to ends[:, 1] into loops, the longest first."""
    left = dict.fromkeys(range(len(ends)))
    by_begin: dict[int, list[int]] = {}
    for k, begin in enumerate(ends[:, 0].tolist()):
        by_begin.setdefault(begin, []).append(k)
    loops = []
    while left:
        loop, k = [], next(iter(left))
        while True:
            loop.append(k)
            del left[k]
            onward = [j for j in by_begin.get(int(ends[k, 1]), []) if j in left]
            if not onward:
                break
            k = onward[0]
        loops.append(loop)
    return sorted(loops, key=len, reverse=True)
