"""Faces and cells around vertices that are to be merged in 3D, and whether the cells remain topological balls."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..connectivity import distinct, following, rows_and_places, rows_of, starts_of, take_rows

if TYPE_CHECKING:
    from .merging import Merges, MergingCells

VERTICES, CELLS, FACES = range(3)
"""Kinds of items of a mesh; see `MergingCells.find`."""


class Neighborhood:
    """The faces with a vertex of some sets, as they are after the merge, and all cells of these faces.

    - `faces`, `set_of_face` (f,) int: the faces, and for each one the set that has one of its vertices.
    - `alive` (f,) bool: faces that keep at least three corners.
    - `starts`: (f + 1,) int
    - `corners`, `codes`, `face` (k,) int: vertices at the corners of each face, their packed offsets, and the face as
      an index into `faces`.
    - `new` (k,) int: group of each corner that is a merged vertex; -1 for others.
    - `after`, `before` (k,) int: place of the next and of the previous corner of the same face.
    - `cells`, `set_of_cell` (c,) int: the cells, and for each one the set of vertices whose merge changes it.
    - `cells_of_face` (f, 2) int: owner and neighbor of each face as indices into `cells`; -1 on walls.
    - `side_starts`: (c + 1,) int
    - `side_face`, `side_cell` (s,) int: the faces of each cell, those that no merge changes included, as indices into
      those of `whole`; the cell.
    - `side_star` (s,) int: those of `faces` as indices into them; -1 for others.
    - `side_sign` (s,) float: 1 for the owner, -1 for the neighbor.
    - `side_code` (s,) int: packed offset of the face as seen from that cell.
    """

    def __init__(
        self, whole: MergingCells, merges: Merges, sets: np.ndarray, faces: np.ndarray, merged: bool = True
    ) -> None:
        self.whole, self.faces, self.set_of_face = whole, faces, sets
        self.k, self.set_of_group = len(merges.priority), merges.sets
        old_starts, places = whole.face_corners(faces)
        corners, codes = whole.corners[places], whole.codes[places]
        face = rows_of(old_starts)
        at = whole.find(VERTICES, merges.vertices, corners)
        moved = np.flatnonzero(at >= 0)
        at, new = at[moved], np.full(len(corners), -1)
        new[moved] = merges.group[at]
        self._were = face[moved], corners[moved], codes[moved]
        if merged:
            corners[moved] = merges.heads[new[moved]]
            codes[moved] -= merges.codes[at]
        # A repeated corner is given once. Faces with fewer than three corners vanish.
        follow = following(old_starts)
        kept = (corners != corners[follow]) | (codes != codes[follow])
        counts = np.bincount(face[kept], minlength=len(faces))
        self.alive = counts >= 3
        kept &= self.alive[face]
        counts[~self.alive] = 0
        self._lost = np.diff(old_starts) - counts
        self.starts = starts_of(counts)
        self.corners, self.codes, self.face = corners[kept], codes[kept], face[kept]
        self.new = new[kept]
        self.after = following(self.starts)
        self.before = np.empty_like(self.after)
        self.before[self.after] = np.arange(len(self.after))
        both = np.stack([whole.owner[faces], whole.neighbor[faces]], axis=1)
        inner = both >= 0
        self.cells = distinct(both[inner])
        self.cells_of_face = np.where(inner, whole.find(CELLS, self.cells, np.maximum(both, 0)), -1)
        self.set_of_cell = np.empty_like(self.cells)
        for column in self.cells_of_face.T:
            self.set_of_cell[column[column >= 0]] = sets[column >= 0]
        # All faces as each cell sees them.
        starts, sides = whole.at_cell.find(self.cells)
        side_face = sides // 2
        star = whole.find(FACES, faces, side_face)
        rows = np.flatnonzero(np.where(star < 0, whole.count[side_face] > 0, self.alive[star]))
        self.side_face, self.side_star = side_face[rows], star[rows]
        self.side_cell = rows_of(starts)[rows]
        counts = np.bincount(self.side_cell, minlength=len(self.cells))
        self.side_starts = starts_of(counts)
        back = sides[rows] % 2
        self.side_sign = 1.0 - 2 * back
        self.side_code = back * whole.face_codes[self.side_face]

    @cached_property
    def star(self) -> np.ndarray:
        """Sides of the faces that have a vertex of a set."""
        return np.flatnonzero(self.side_star >= 0)

    @cached_property
    def kept_geometry(self) -> tuple[np.ndarray, np.ndarray]:
        """Centers and outward areas of the sides that no merge changes, (3, s) each; nan for others."""
        kept = self.side_star < 0
        seen, outward = np.full((2, 3, len(kept)), np.nan)
        centers, areas = self.whole.geometry(self.side_face[kept])
        seen[:, kept] = centers - self.whole.offsets(self.side_code[kept])
        outward[:, kept] = areas * self.side_sign[kept]
        return seen, outward

    def _bad(self, sets: np.ndarray) -> np.ndarray:
        """Return which sets occur in `sets`, (k,) bool."""
        return np.bincount(sets, minlength=self.k) > 0

    def is_manifold(self) -> np.ndarray:
        """Return which merges leave the cells topological balls that meet in faces, edges and vertices, (k,) bool."""
        bad = self._bad(self.set_of_group[self._repeated()])
        bad |= self._bad(self.set_of_cell[self._not_balls()])
        return ~(bad | self._bad(self.set_of_group[self._pinched()]))

    def _not_balls(self) -> np.ndarray:
        """Return which cells are no topological balls, (c,) bool, by Euler's formula and the two faces at each edge."""
        m = len(self.cells)
        # Corners with a merged vertex, of each side.
        corner = np.flatnonzero(self.new >= 0)
        starts = np.searchsorted(self.face[corner], np.arange(len(self.faces) + 1))
        starts, corner = take_rows(starts, corner, self.side_star[self.star])
        side = self.star[rows_of(starts)]
        cell = self.side_cell[side]
        hub = _pack_keys(cell, self.new[corner], self.codes[corner] - self.side_code[side])
        ends = np.concatenate([self.after[corner], self.before[corner]])
        codes = self.codes[ends] - np.tile(self.codes[corner], 2)
        spokes = _pack_keys(np.tile(hub, 2), self.corners[ends], codes)
        order = np.argsort(spokes, kind="stable")
        numbers = _runs(spokes[order])
        times = np.bincount(numbers)[numbers]
        wrong = np.zeros(m, bool)
        wrong[np.tile(cell, 2)[order[times != 2]]] = True
        # Euler's formula holds before: vertices - edges + faces does not change.
        vertices = _count_unique(cell, hub, m)
        twice = np.zeros(m, np.int64)
        lost = self._lost - 2 * ~self.alive
        for column in self.cells_of_face.T:
            twice += np.bincount(column[column >= 0], lost[column >= 0], m).astype(np.int64)
        face, corner, code = self._were
        own, other = self.cells_of_face[face].T
        inner = other >= 0
        cell = np.concatenate([own, other[inner]])
        codes = np.concatenate([code, (code - self.whole.face_codes[self.faces[face]])[inner]])
        were = _pack_keys(cell, np.concatenate([corner, corner[inner]]), codes)
        vertices -= _count_unique(cell, were, m)
        return wrong | (2 * vertices + twice != 0) | (np.diff(self.side_starts) < 4)

    def _repeated(self) -> np.ndarray:
        """Return the groups whose vertex occurs twice in a face."""
        rows = np.flatnonzero(self.new >= 0)
        key = _pack_keys(self.face[rows], self.new[rows], self.codes[rows])
        order = np.argsort(key, kind="stable")
        return self.new[rows[order[1:][np.diff(key[order]) == 0]]]

    def _pinched(self) -> np.ndarray:
        """Return the groups of which two faces share several paths, or whose vertex is not inside a ball of cells."""
        rows = np.flatnonzero(self.new >= 0)
        groups, faces = self.new[rows], self.face[rows]
        # Corners of these faces, relative to the vertex, and the sides that begin there.
        starts, place = take_rows(self.starts, np.arange(len(self.corners)), faces)
        counts = np.diff(starts)
        row = np.repeat(np.arange(len(rows)), counts)
        key = _pack_keys(groups[row], self.corners[place], self.codes[place] - self.codes[rows[row]])
        order = np.argsort(key, kind="stable")
        number = np.empty_like(order)
        number[order] = _runs(key[order])
        side = np.sort(np.stack([number, number[following(starts)]]), axis=0)
        f, g = len(rows), len(self.set_of_group)
        away = np.flatnonzero(place != rows[row])  # all faces share the vertex itself
        pairs = _pairs(number[away], row[away])
        key, points = np.unique(pairs[0] * f + pairs[1], return_counts=True)
        pairs = _pairs(_pack_keys(*side), row)
        sides = np.bincount(np.searchsorted(key, pairs[0] * f + pairs[1]), minlength=len(key))
        one, other = key // max(f, 1), key % max(f, 1)
        split = (points != sides) | (points + 1 >= np.minimum(counts[one], counts[other]))
        wrong = [groups[one[split]]]
        beside = (place == self.after[rows[row]]) | (place == self.before[rows[row]])
        # Around the vertex: edges - faces + cells = 2, the outside of the domain included.
        edges = _count_unique(groups[row[beside]], number[beside], g)
        w, f = self.whole, self.faces[faces]
        inner = w.neighbor[f] >= 0
        cell_groups = np.concatenate([groups, groups[inner]])
        cells = np.concatenate([w.owner[f], w.neighbor[f][inner]])
        frames = np.concatenate([-self.codes[rows], (w.face_codes[f] - self.codes[rows])[inner]])
        around = _count_unique(cell_groups, _pack_keys(cell_groups, cells, frames), g)
        outside = np.bincount(groups[~inner], minlength=g) > 0
        euler = edges - np.bincount(groups, minlength=g) + around + outside
        wrong.append(np.flatnonzero(euler != 2))
        return np.concatenate(wrong)


def _runs(values: np.ndarray) -> np.ndarray:
    """Return the number of each run of equal `values`, (k,) int, ascending from 0."""
    new = np.zeros(len(values), np.int64)
    new[1:] = values[1:] != values[:-1]
    return np.cumsum(new)


def _pack_keys(*keys: np.ndarray) -> np.ndarray:
    """Return one integer for each tuple of entries of `keys`, (k,): equal for equal tuples, and in their order."""
    packed, span = np.zeros(len(keys[0]), np.int64), 1
    for key in keys:
        low, high = int(key.min(initial=0)), int(key.max(initial=0))
        if span * (high - low + 1) > 1 << 62:
            packed = np.unique(packed, return_inverse=True)[1]
            span = len(packed)
        packed = packed * (high - low + 1) + (key - low)
        span *= high - low + 1
    return packed


def _count_unique(sets: np.ndarray, keys: np.ndarray, k: int) -> np.ndarray:
    """Return how many different `keys` each set has, (k,) int; sets have no key in common."""
    first = np.unique(keys, return_index=True)[1]
    return np.bincount(sets[first], minlength=k)


def _pairs(groups: np.ndarray, items: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of different items in the same group, the lesser item first; `items` ascend."""
    order = np.argsort(groups, kind="stable")
    groups, items = _runs(groups[order]), items[order]
    counts = np.bincount(groups)
    later = np.cumsum(counts)[groups] - np.arange(len(groups)) - 1
    first, place = rows_and_places(later)
    second = first + 1 + place
    one, other = items[first], items[second]
    return one[one != other], other[one != other]
