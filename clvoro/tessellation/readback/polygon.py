"""Read the trimmed tessellation of a polygonal domain into a `Diagram`."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pyopencl.array as cla

from ...geometry.polygon import Polygon
from ...opencl.engine import Engine
from ..clipped.boundary_crossings import UNTOUCHED
from ..device_diagram import Tessellation
from ..vertices import VertexNumbering, Vertices
from .diagram import _DiagramReader, kept_faces, used_indices


class _PolygonReader(_DiagramReader):
    """Read a trimmed tessellation.

    Its vertices are corners of convex cells, corners of the polygon, and crossings of its edges with faces. Both ends
    of each face are stored, as several loops may bound a cell.
    """

    def __init__(self, engine: Engine, domain: Polygon, t: Tessellation, labels: cla.Array, copy: bool) -> None:
        super().__init__(engine, domain, t, labels, copy)
        made = t.trimmed
        assert made is not None
        self.domain: Polygon = domain
        self.m = len(self.t.neighbors)
        convex = made.convex
        self.convex = kept_faces(convex, int(convex.starts[convex.n].get()), copy)
        # These arrays are small: they cover only cells that the boundary crosses.
        self.slots_of_cells = made.chords.slots.get()[: t.n]
        self.touched = made.chords.touched.get()[: made.chords.touched_count]
        self.shift = made.chords.shift * domain.frame[1]
        arrays = [a.get() for a in made.chords.arrays]
        self.owners_of_vertices, self.firsts, self.chord_cells, self.chord_edges = arrays[2:6]
        self.chord_ends = arrays[6][: made.chords.count]
        self.device_vertices = arrays[0]
        starts, segment_labels, begins, ends = (a.get() for a in made.segments[:4])
        n_segments = made.segment_count
        self.segment_cells = np.repeat(self.touched, np.diff(starts[: len(self.touched) + 1]))
        self.segment_labels = segment_labels[:n_segments]
        self.segment_from, self.segment_to = begins[:n_segments], ends[:n_segments]
        self.face_segments = made.face_segments.get()[: self.m]

    def points(self) -> np.ndarray:
        positions = super().points()
        # Round-off must not move a generator on the boundary out of the domain.
        near = np.arange(len(positions)) if self.shift.any() else self.ranks[self.touched]
        positions[near] = self.domain.nearest(positions[near])
        return positions

    @cached_property
    def shared(self) -> Vertices:
        """Vertices of the convex diagram."""
        return VertexNumbering(self.engine).number(self.domain, self.convex)

    @cached_property
    def crossings(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (k, 2) of the polygon's corners and of crossings, each once, and the index of each chord's end.

        Positions that are equal on the device count as one. The device has no segments between them.
        """
        found = []
        # The device measured with the shifted boundary.
        for vertices in (self.device_vertices, self.domain.oriented.vertices + self.shift):
            a = vertices[self.chord_edges]
            b = vertices[self.domain.oriented.next_vertex[self.chord_edges]]
            t = self.chord_ends[:, None]
            ends = np.where(t >= 1, b, np.where(t <= 0, a, a + t * (b - a)))
            found.append(np.concatenate([vertices, ends]))
        _, first, numbers = np.unique(found[0], axis=0, return_index=True, return_inverse=True)
        return found[1][first], numbers.ravel()

    @cached_property
    def face_ends(self) -> np.ndarray:
        """First and last vertex of each face on the device, (m, 2). `crossings` follow the other vertices."""
        starts, corners = self.convex.starts.get(), self.shared.cell_vertices.get()
        count = self.shared.count
        ends = np.empty((self.m, 2), np.int64)
        owner = np.repeat(np.arange(self.n), np.diff(self.starts))
        whole = self.slots_of_cells[owner] == UNTOUCHED
        i = owner[whole]
        k = np.flatnonzero(whole) - self.starts[i]
        sides = starts[i + 1] - starts[i]
        ends[whole, 0] = corners[starts[i] + k]
        ends[whole, 1] = corners[starts[i] + (k + 1) % sides]
        # Faces of trimmed cells are segments, which may lie in another convex cell.
        s = self.face_segments[~whole]
        home, on_boundary = self.segment_cells[s], self.segment_labels[s] < 0
        n_corners, number = len(self.domain.oriented.vertices), self.crossings[1] + count
        cell_first = starts[home]
        found = []
        for side in (self.segment_from[s], self.segment_to[s]):
            at_corner = cell_first + np.where(side < 0, -1 - side, 0)
            ids = np.where(side >= 0, number[n_corners + np.maximum(side, 0)], corners[at_corner])
            found.append(ids)
        chord = self.segment_from[s][on_boundary]
        edge = self.chord_edges[chord]
        first, last = chord == self.firsts[edge], chord + 1 == self.firsts[edge + 1]
        begin = np.where(first, number[edge], number[n_corners + np.maximum(chord - 1, 0)])
        after = number[self.domain.oriented.next_vertex[edge]]
        found[0][on_boundary] = begin
        found[1][on_boundary] = np.where(last, after, number[n_corners + chord])
        ends[~whole] = np.stack(found, axis=1)
        return ends

    def neighbors(self) -> np.ndarray:
        found = super().neighbors()
        walls = found < 0  # on the device by their places in `oriented`
        found[walls] = -1 - self.domain.oriented.edge_numbers[-1 - found[walls]]
        return found

    @cached_property
    def slots(self) -> np.ndarray:
        """Index on the device of each face of the result, (m,), ordered along the loops of each cell."""
        order, _ = self._chained
        return order

    @cached_property
    def lists(self) -> None:
        """None: faces have another order than on the device."""
        return

    @cached_property
    def _chained(self) -> tuple[np.ndarray, dict[int, list[int]]]:
        """Indices of faces, and the lengths of the loops of those rows of the result that have several loops."""
        default = super().slots
        ends, starts = self.face_ends[default], self.neighbor_starts()
        row = np.repeat(np.arange(self.n), np.diff(starts))
        following = np.arange(1, self.m + 1)
        filled = np.diff(starts) > 0  # cells of power diagrams may be empty
        following[starts[1:][filled] - 1] = starts[:-1][filled]
        broken = np.unique(row[ends[:, 1] != ends[following, 0]])
        order, lengths = default.copy(), {}
        for i in broken.tolist():
            part = slice(starts[i], starts[i + 1])
            loops = _loops(ends[part])
            order[part] = default[part][np.concatenate(loops)]
            lengths[i] = [len(loop) for loop in loops]
        return order, lengths

    @cached_property
    def _numbered(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices that are ends of faces, and the index of each end, (m, 2)."""
        count = self.shared.count + len(self.crossings[0])
        return used_indices(self.face_ends[self.slots], count)

    def vertices(self) -> np.ndarray:
        used, count = self._numbered[0], self.shared.count
        corners = self.shared.positions.get().astype(np.float64) * self.scale + self.origin
        return np.concatenate([corners, self.crossings[0]])[used] if count else self.crossings[0]

    def face_vertex_starts(self) -> np.ndarray:
        return (2 * np.arange(self.m + 1)).astype(np.int32)

    def face_vertices(self) -> np.ndarray:
        return self._numbered[1].ravel()

    @cached_property
    def _outlines(self) -> tuple[np.ndarray, np.ndarray]:
        """One closed chain of corners per cell. A bridge, passed in both directions, connects several loops."""
        corners, starts = self._numbered[1][:, 0], self.neighbor_starts()
        several = self._chained[1]
        if not several:
            return starts, corners
        rows = np.split(corners, starts[1:-1])
        for i, lengths in several.items():
            loops = np.split(rows[i], np.cumsum(lengths)[:-1])
            chain = [loops[0]]
            for loop in loops[1:]:
                chain += [loops[0][:1], loop, loop[:1]]
            rows[i] = np.concatenate(chain)
        return np.concatenate([[0], np.cumsum([len(r) for r in rows])]), np.concatenate(rows)

    def cell_vertex_starts(self) -> np.ndarray:
        return self._outlines[0].astype(np.int32)

    def cell_vertices(self) -> np.ndarray:
        return self._outlines[1].astype(np.int32)


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
