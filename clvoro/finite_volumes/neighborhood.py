"""The 3D cells around vertices that merge, and the check that the merge keeps their topology."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..mesh.connectivity import following, take_rows

if TYPE_CHECKING:
    from .merging import Cells, Merges


class Neighborhood:
    """The cells around some sets of vertices, with their faces as they are after the merge.

    Attributes
    ----------
    cells, set_of_cell : (c,) int
        The cells, and for each one the set of vertices whose merge changes it.
    faces, set_of_face : (f,) int
        All faces of the cells, and the set with one of their vertices, or -1.
    alive : (f,) bool
        Faces that keep at least three corners.
    starts : (f + 1,) int
    corners, codes, face : (k,) int
        Vertices at the corners of each face, their packed offsets, and the face as an index into `faces`.
    new : (k,) int
        Group of each corner that is a merged vertex; -1 for others.
    after, before : (k,) int
        Place of the next and of the previous corner of the same face.
    side_face, side_cell : (s,) int
        Each face with each cell of the neighborhood that has it, as indices into `faces` and `cells`.
    side_sign : (s,) float
        1 for the owner, -1 for the neighbor.
    side_code : (s,) int
        Packed offset of the face as seen from that cell.
    """

    def __init__(
        self,
        whole: Cells,
        merges: Merges,
        cells: np.ndarray,
        set_of_cell: np.ndarray,
        merged: bool = True,
    ) -> None:
        self.whole, self.cells, self.set_of_cell = whole, cells, set_of_cell
        self.k, self.set_of_group = len(merges.priority), merges.sets
        self.faces = whole.faces_of(cells)
        old_starts, places = whole.face_corners(self.faces)
        corners, codes = whole.corners[places], whole.codes[places]
        face = np.repeat(np.arange(len(self.faces)), np.diff(old_starts))
        member = _Lookup(merges.vertices)
        at = member(corners)
        moved = at >= 0
        group = merges.group[at]
        self.set_of_face = np.full(len(self.faces), -1)
        self.set_of_face[face[moved]] = merges.sets[group[moved]]
        if merged:
            corners[moved] = merges.heads[group[moved]]
            codes[moved] -= merges.codes[at[moved]]
        new = np.where(moved, group, -1)
        # A repeated corner is given once. Faces with fewer than three corners vanish.
        follow = following(old_starts)
        kept = (corners != corners[follow]) | (codes != codes[follow])
        counts = np.bincount(face[kept], minlength=len(self.faces))
        self.alive = counts >= 3
        kept &= self.alive[face]
        self.starts = np.concatenate([[0], np.cumsum(np.where(self.alive, counts, 0))])
        self.corners, self.codes, self.face = corners[kept], codes[kept], face[kept]
        self.new = new[kept]
        self.after = following(self.starts)
        self.before = np.empty_like(self.after)
        self.before[self.after] = np.arange(len(self.after))
        # Each face as a cell of the neighborhood sees it.
        local = self.local = _Lookup(cells)
        owner, neighbor = whole.owner[self.faces], whole.neighbor[self.faces]
        rows = np.flatnonzero(self.alive)
        here = local(owner[rows])
        there = np.where(neighbor[rows] >= 0, local(np.maximum(neighbor[rows], 0)), -1)
        self.side_face = np.concatenate([rows[here >= 0], rows[there >= 0]])
        self.side_cell = np.concatenate([here[here >= 0], there[there >= 0]])
        self.side_sign = np.repeat([1.0, -1.0], [np.sum(here >= 0), np.sum(there >= 0)])
        self.side_code = np.where(
            self.side_sign > 0, 0, whole.face_codes[self.faces[self.side_face]]
        )

    def _bad(self, sets: np.ndarray) -> np.ndarray:
        """Return which sets occur in `sets`, (k,) bool."""
        return np.bincount(sets[sets >= 0], minlength=self.k) > 0

    def is_manifold(self) -> np.ndarray:
        """Return which merges leave the cells topological balls that meet in faces, edges and vertices, (k,) bool."""
        bad = self._bad(self.set_of_group[self._repeated()])
        # Euler's formula for each cell, and two faces at each edge of it.
        starts, place = take_rows(self.starts, np.arange(len(self.corners)), self.side_face)
        side = np.repeat(np.arange(len(self.side_face)), np.diff(starts))
        cell = self.side_cell[side]
        m = len(self.cells)
        vertex = _number(cell, self.corners[place], self.codes[place] - self.side_code[side])
        after = following(starts)
        low, high = np.minimum(vertex, vertex[after]), np.maximum(vertex, vertex[after])
        edges, times = np.unique(low * (vertex.max(initial=0) + 1) + high, return_counts=True)
        cell_of_vertex = np.zeros(vertex.max(initial=-1) + 1, np.int64)
        cell_of_vertex[vertex] = cell
        cell_of_edge = cell_of_vertex[edges // (vertex.max(initial=0) + 1)]
        faces = np.bincount(self.side_cell, minlength=m)
        euler = (
            np.bincount(cell_of_vertex, minlength=m)
            - np.bincount(cell_of_edge, minlength=m)
            + faces
        )
        wrong = (euler != 2) | (faces < 4)
        wrong[cell_of_edge[times != 2]] = True
        bad |= self._bad(self.set_of_cell[wrong])
        return ~(bad | self._bad(self.set_of_group[self._pinched()]))

    def _repeated(self) -> np.ndarray:
        """Return the groups whose vertex occurs twice in a face."""
        rows = np.flatnonzero(self.new >= 0)
        number = _number(self.face[rows], self.new[rows], self.codes[rows])
        twice = np.bincount(number)[number] > 1
        return self.new[rows[twice]]

    def _pinched(self) -> np.ndarray:
        """Return the groups of which two faces share several paths, or whose vertex is not inside a ball of cells."""
        rows = np.flatnonzero(self.new >= 0)
        groups, faces = self.new[rows], self.face[rows]
        # Corners of these faces, relative to the vertex, and the sides that begin there.
        starts, place = take_rows(self.starts, np.arange(len(self.corners)), faces)
        counts = np.diff(starts)
        row = np.repeat(np.arange(len(rows)), counts)
        number = _number(
            groups[row], self.corners[place], self.codes[place] - self.codes[rows[row]]
        )
        side = np.sort(np.stack([number, number[following(starts)]]), axis=0)
        f, g = len(rows), len(self.set_of_group)
        pairs = _pairs(number, row)
        key, points = np.unique(pairs[0] * f + pairs[1], return_counts=True)
        pairs = _pairs(_number(*side), row)
        sides = np.bincount(np.searchsorted(key, pairs[0] * f + pairs[1]), minlength=len(key))
        one, other = key // max(f, 1), key % max(f, 1)
        split = (points - sides != 1) | (points >= np.minimum(counts[one], counts[other]))
        wrong = [groups[one[split]]]
        beside = (place == self.after[rows[row]]) | (place == self.before[rows[row]])
        # Around the vertex: edges - faces + cells = 2, the outside of the domain included.
        edges = _count_unique(groups[row[beside]], number[beside], g)
        w, f = self.whole, self.faces[faces]
        inner = w.neighbor[f] >= 0
        cell_groups = np.concatenate([groups, groups[inner]])
        cells = np.concatenate([w.owner[f], w.neighbor[f][inner]])
        frames = np.concatenate([-self.codes[rows], (w.face_codes[f] - self.codes[rows])[inner]])
        around = _count_unique(cell_groups, _number(cells, frames), g)
        outside = np.bincount(groups[~inner], minlength=g) > 0
        euler = edges - np.bincount(groups, minlength=g) + around + outside
        wrong.append(np.flatnonzero(euler != 2))
        return np.concatenate(wrong)


class _Lookup:
    """The place of a value in an array without duplicates."""

    def __init__(self, entries: np.ndarray) -> None:
        self.order = np.argsort(entries, kind="stable")
        self.sorted = entries[self.order]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Return the place of each of `values` (k,), -1 for those that the array does not have."""
        if not len(self.sorted):
            return np.full(len(values), -1)
        at = np.minimum(np.searchsorted(self.sorted, values), len(self.sorted) - 1)
        return np.where(self.sorted[at] == values, self.order[at], -1)


def _number(*keys: np.ndarray) -> np.ndarray:
    """Return equal numbers for equal keys, ascending."""
    order = np.lexsort(keys[::-1])
    new = np.zeros(len(order), bool)
    new[:1] = True
    for key in keys:
        new[1:] |= key[order[1:]] != key[order[:-1]]
    numbers = np.empty(len(order), np.int64)
    numbers[order] = np.cumsum(new) - 1
    return numbers


def _count_unique(sets: np.ndarray, numbers: np.ndarray, k: int) -> np.ndarray:
    """Return how many different numbers each set has, (k,) int."""
    pairs = np.unique(sets * (numbers.max(initial=0) + 1) + numbers)
    return np.bincount(pairs // (numbers.max(initial=0) + 1), minlength=k)


def _pairs(groups: np.ndarray, items: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of items in the same group, the lesser item first."""
    order = np.lexsort((items, groups))
    groups, items = groups[order], items[order]
    counts = np.bincount(groups)
    later = np.cumsum(counts)[groups] - np.arange(len(groups)) - 1
    first = np.repeat(np.arange(len(groups)), later)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(later) - later, later)
    return items[first], items[second]
