"""Merge vertices of a polyhedral mesh in 3D where the cells stay valid; many merges at once.

Each set of merges is tried on its own `Neighborhood`. It is made if the topology stays valid and `find_defects` finds
nothing beyond the `DefectLimits`. Sets that share no cell are tried together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..connectivity import distinct, independent, rows_of, starts_of, take_ranges, take_rows
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import lengths, loop_geometry, sum_columns
from .defects import DefectLimits, Defects, find_defects
from .neighborhood import Neighborhood
from .seams import unpack

_TRIES = 4
"""Vertices of a group, the nearest to its mean first, that are tried as the place where all meet."""
_CHUNK = 512
"""Sets of vertices that are tried at a time."""


@dataclass(frozen=True)
class Merges:
    """Groups of vertices, each to become one vertex, in sets that are merged together or not at all.

    - `starts`: (g + 1,) int
    - `vertices`: vertices of group i, ``vertices[starts[i]:starts[i + 1]]``.
    - `codes`: packed offsets of the images that coincide with the first vertex of the group.
    - `sets` (g,) int: set of each group, ascending from 0.
    - `priority` (k,) float: the least is tried first.
    - `reach` (k,) float: most distance of vertices from the first of their group; groups that are wider are left out.
    """

    starts: np.ndarray
    vertices: np.ndarray
    codes: np.ndarray
    sets: np.ndarray
    priority: np.ndarray
    reach: np.ndarray

    @cached_property
    def group(self) -> np.ndarray:
        """Group of each vertex."""
        return rows_of(self.starts)

    @property
    def heads(self) -> np.ndarray:
        """The first vertex of each group."""
        return self.vertices[self.starts[:-1]]

    def take(self, rows: np.ndarray) -> Merges:
        """Return some of the sets, in the same order."""
        rank = np.full(len(self.priority), -1)
        rank[rows] = np.arange(len(rows))
        groups = np.flatnonzero(rank[self.sets] >= 0)
        starts, places = take_rows(self.starts, np.arange(len(self.vertices)), groups)
        return Merges(
            starts,
            self.vertices[places],
            self.codes[places],
            rank[self.sets[groups]],
            self.priority[rows],
            self.reach[rows],
        )


class _Finder:
    """The rows of a ragged array that have an item. They are found for the items that are looked for, not for all.

    - `starts` (r + 1,) int or None: None if each item is a row.
    - `items` (k,) int: -1 for none.
    - `size`: number of different items.
    """

    def __init__(self, starts: np.ndarray | None, items: np.ndarray, size: int) -> None:
        self.starts, self.items = starts, items
        self.begin, self.count = np.full(size + 1, -1), np.zeros(size + 1, np.int64)
        self.rows = np.zeros(0, np.int64)

    def find(self, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return for each item in `wanted` its rows, ascending, as ragged rows."""
        new = distinct(wanted[self.begin[wanted] < 0])
        if len(new):
            is_new = np.zeros(len(self.begin), bool)  # the last one is that of item -1
            is_new[new] = True
            rows = np.flatnonzero(is_new[self.items])
            items = self.items[rows]
            if self.starts is not None:
                rows = np.searchsorted(self.starts, rows, "right") - 1
            counts = np.bincount(items, minlength=len(self.count))[new]
            self.begin[new], self.count[new] = len(self.rows) + np.cumsum(counts) - counts, counts
            self.rows = np.concatenate([self.rows, rows[np.argsort(items, kind="stable")]])
        return take_ranges(self.begin[wanted], self.count[wanted], self.rows)


class MergingCells:
    """Polyhedral cells in 3D whose vertices can be merged.

    In periodic directions images of a vertex are one vertex, and a corner of a face is a vertex with an offset.

    - `diagram`: see `collapse_short`.
    - `rows` (f,) int: the faces of `mesh`; their corners, cells and offsets are the other parameters.

    Its attributes:
    - `points`: (v, 3) float
    - `walls` (v,) int: the set of walls that the vertex lies on, a row of `wall_sets`.
    - `wall_sets`: walls, ascending; the first set is empty.
    - `begin`, `count` (f,) int: the corners of face i are ``corners[begin[i]:begin[i] + count[i]]``, counter-clockwise
      as seen from outside of the owner; none if the face is gone.
    - `corners`, `codes` (k,) int: vertices, and their packed offsets as the owner sees them.
    - `owner`, `neighbor` (f,) int: cells; -1 - k on wall k.
    - `face_codes` (f,) int: packed offset of the neighbor's image.
    - `touched` (n,) bool: cells that a merge has changed.
    - `unwanted` (f,) bool: faces that are collapsed whatever their size.
    - `centroids` (n, 3) float: where the cells had their centroids before all merges.
    - `changed`, `edited` (f,) bool: faces that a merge has changed, in this round and in any.
    """

    def __init__(
        self,
        mesh: Faces,
        diagram: Diagram | None,
        points: np.ndarray,
        starts: np.ndarray,
        corners: np.ndarray,
        codes: np.ndarray,
        owner: np.ndarray,
        neighbor: np.ndarray,
        face_codes: np.ndarray,
        rows: np.ndarray,
    ) -> None:
        self.domain, self.mesh, self.diagram, self.rows = mesh.domain, mesh, diagram, rows
        self.points, self.extent = np.array(points, float), np.asarray(mesh.domain.extent, float)
        self.begin, self.count = starts[:-1].copy(), np.diff(starts)
        self.corners, self.codes = corners.copy(), codes
        self.owner, self.neighbor = owner.astype(np.int64), neighbor.astype(np.int64)
        self.face_codes, self.n = face_codes, mesh.n_cells
        self.centroids = mesh.measures.geometry.centroids if diagram is None else diagram.centroids
        self.sizes = np.cbrt(mesh.volumes if diagram is None else diagram.volumes)
        self.limits = DefectLimits()
        v = len(points)
        self.walls, self.wall_sets = _sets_of_walls(starts, self.corners, self.neighbor, v)
        self._within: dict[tuple[int, int], bool] = {}
        self.at_vertex = _Finder(starts, corners, v)
        both = np.stack([self.owner, np.maximum(self.neighbor, -1)], axis=1).ravel()
        self.at_cell = _Finder(None, both, self.n)
        self.next = np.full(v, -1, np.int32)  # vertices that have been merged, as linked lists
        self.last = np.arange(v, dtype=np.int32)
        self.now = self.last.copy()  # the vertex that each vertex has become, and where its image is
        self.now_code = np.zeros(v, np.int64)
        self.touched = np.zeros(self.n, bool)
        self.changed, self.edited = np.zeros((2, len(self.owner)), bool)
        self.unwanted = np.zeros(len(self.owner), bool)
        self._places = [np.full(k, -1, np.int32) for k in (v, self.n, len(self.owner))]

    # Positions.

    def positions(self, vertices: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Return the positions of images of vertices, (3, k)."""
        return np.ascontiguousarray(self.points.take(vertices, axis=0).T) + self.offsets(codes)

    def offsets(self, codes: np.ndarray) -> np.ndarray:
        """Return packed offsets as vectors, (3, k), or (3, 1) if all are 0."""
        return (unpack(codes) * self.extent).T if codes.any() else np.zeros((3, 1))

    def geometry(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the centers and area vectors of `faces`, (3, k) each, on the owner's side of periodic seams.

        Those of faces that no merge has changed are the diagram's, up to round-off, or those of the mesh.
        """
        centers, normals = np.empty((2, 3, len(faces)))
        rows = np.flatnonzero(~self.edited[faces])
        centers[:, rows], normals[:, rows] = self._geometry_before(faces[rows])
        rows = np.flatnonzero(self.edited[faces])
        starts, places = self.face_corners(faces[rows])
        x = self.positions(self.corners[places], self.codes[places])
        centers[:, rows], normals[:, rows] = loop_geometry(x, starts)
        return centers, normals

    def _geometry_before(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if (d := self.diagram) is None:
            center, vector = self.mesh.vectors
            return center.take(self.rows[faces], axis=0).T, vector.take(self.rows[faces], axis=0).T
        half, i, j = self.mesh.half_face[self.rows[faces]], self.owner[faces], self.neighbor[faces]
        normals = d.points.take(np.maximum(j, 0), axis=0).T + self.offsets(self.face_codes[faces])
        normals -= d.points.take(i, axis=0).T
        wall = np.flatnonzero(j < 0)
        axis, upper = np.divmod(-1 - j[wall], 2)
        normals[:, wall] = 0
        normals[axis, wall] = 2 * upper - 1
        normals *= d.face_measures.take(half) / lengths(normals)
        return np.ascontiguousarray(d.face_centroids.take(half, axis=0).T), normals

    def face_corners(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts and places of the corners of `faces`."""
        counts = self.count[faces]
        starts = starts_of(counts)
        places = np.repeat(self.begin[faces] - starts[:-1], counts)
        places += np.arange(len(places))
        return starts, places

    def is_touched(self, faces: np.ndarray) -> np.ndarray:
        """Return which of some faces have a cell that a merge has changed."""
        neighbor = self.neighbor[faces]
        return self.touched[self.owner[faces]] | ((neighbor >= 0) & self.touched[np.maximum(neighbor, 0)])

    def find(self, kind: int, items: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the index in `items` of each of `values`, or -1. `kind` is VERTICES, CELLS or FACES."""
        places = self._places[kind]
        places[items] = np.arange(len(items))
        found = places.take(values)
        places[items] = -1
        return found

    # Merging.

    def prepare(self, vertices: np.ndarray) -> None:
        """Look up the faces at `vertices`, and all faces of the cells there, before merges ask for each."""
        around = self.at_vertex.find(vertices)[1]
        there = np.zeros(self.n + 1, bool)
        there[self.owner[around]] = there[np.maximum(self.neighbor[around], -1)] = True
        self.at_cell.find(np.flatnonzero(there[:-1]))

    def merge(self, merges: Merges) -> int:
        """Merge each set that leaves all cells valid; return how many do. Each merge removes a vertex."""
        done = 0
        while len((merges := self._current(merges)).sets):
            rows, faces = self._star(merges)
            cells = np.concatenate([self.owner[faces], self.neighbor[faces]])
            sets = np.concatenate([rows, rows])[cells >= 0]
            cells = cells[cells >= 0]
            chosen = independent(sets, cells, merges.priority, self.n)
            part = chosen[rows]
            rank = np.cumsum(chosen) - 1
            done += self._try(merges.take(np.flatnonzero(chosen)), rank[rows[part]], faces[part])
            merges = merges.take(np.flatnonzero(~chosen))
        return done

    def _current(self, merges: Merges) -> Merges:
        """Return `merges` of what their vertices have become, without groups of one vertex."""
        group, vertices = merges.group, merges.vertices
        codes = merges.codes + self.now_code[vertices]
        while True:
            vertices = self.now[vertices]
            if (self.now[vertices] == vertices).all():
                break
            codes = codes + self.now_code[vertices]
        v = len(self.points)
        first = np.zeros(len(vertices), bool)
        first[np.unique(group * v + vertices, return_index=True)[1]] = True
        counts = np.bincount(group[first], minlength=len(merges.sets))
        first &= counts[group] > 1
        group, vertices, codes = group[first], vertices[first], codes[first]
        kept = counts > 1
        starts = starts_of(counts[kept])
        codes = codes - np.repeat(codes[starts[:-1]], np.diff(starts))
        sets = merges.sets[kept]
        made = Merges(starts, vertices, codes, sets, merges.priority, merges.reach)
        x = self.positions(vertices, codes)
        away = lengths(x - x[:, starts[:-1]][:, made.group])
        of = sets[made.group]
        key = np.sort(of * v + vertices)  # a vertex in two groups of a set
        wrong = np.concatenate([of[away > merges.reach[of]], key[1:][np.diff(key) == 0] // v])
        good = np.bincount(sets, minlength=len(merges.priority)) > 0
        good[wrong] = False
        return made.take(np.flatnonzero(good))

    def _star(self, merges: Merges) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs (set, face with one of its vertices); pairs may repeat."""
        sets, vertices = merges.sets[merges.group], merges.vertices
        found: list[tuple[np.ndarray, np.ndarray]] = []
        while len(vertices):
            starts, faces = self.at_vertex.find(vertices)
            found.append((np.repeat(sets, np.diff(starts)), faces))
            vertices = self.next[vertices]
            sets, vertices = sets[vertices >= 0], vertices[vertices >= 0]
        if not found:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        rows, star = (np.concatenate(parts) for parts in zip(*found, strict=True))
        there = self.count[star] > 0
        return rows[there], star[there]

    def _try(self, merges: Merges, sets: np.ndarray, faces: np.ndarray) -> int:
        """Merge those of the sets that leave their cells valid; no two sets have a cell in common."""
        sets, faces = np.divmod(distinct(sets * len(self.owner) + faces), len(self.owner))
        k = len(merges.priority)
        done = 0
        for first in range(0, k, _CHUNK):
            begin, end = np.searchsorted(sets, [first, first + _CHUNK])
            part = merges.take(np.arange(first, min(first + _CHUNK, k)))
            done += self._try_some(part, sets[begin:end] - first, faces[begin:end])
        return done

    def _try_some(self, merges: Merges, sets: np.ndarray, faces: np.ndarray) -> int:
        """Merge those of the sets that leave their cells valid, given all pairs of a set and a face at its vertices."""
        targets = self._targets(merges)
        finite = np.ones(len(merges.priority), bool)
        finite[merges.sets[~np.isfinite(targets[:, 0, 0])]] = False
        around = Neighborhood(self, merges, sets, faces)
        good = around.is_manifold() & finite
        most = Defects.allowed(around.k, self.limits)
        fits = good & (find_defects(around, self.limits, targets[:, 0]) <= most)
        self._commit(merges, around, fits, targets[:, 0])
        done = int(np.count_nonzero(fits))
        rows = np.flatnonzero(good & ~fits)
        if not len(rows):
            return done
        # Few sets are left. Other targets may do, and cells that had defects before may keep them.
        targets = targets[np.isin(merges.sets, rows)]
        rank = np.full(around.k, -1)
        rank[rows] = np.arange(len(rows))
        merges, faces, sets = merges.take(rows), faces[rank[sets] >= 0], rank[sets]
        sets = sets[sets >= 0]
        before = find_defects(Neighborhood(self, merges, sets, faces, merged=False), self.limits)
        most = before.worsened(Defects.allowed(len(rows), self.limits))
        around, left = Neighborhood(self, merges, sets, faces), np.ones(len(rows), bool)
        for attempt in range(targets.shape[1]):
            tried = left.copy()
            tried[merges.sets[~np.isfinite(targets[:, attempt, 0])]] = False
            if tried.any():
                fits = tried & (find_defects(around, self.limits, targets[:, attempt]) <= most)
                self._commit(merges, around, fits, targets[:, attempt])
                done += int(np.count_nonzero(fits))
                left &= ~fits
        return done

    def _targets(self, merges: Merges) -> np.ndarray:
        """Return where the vertices of each group may meet, (g, tries, 3): their mean, or one of them; or nan.

        On walls vertices stay on the walls. A group is left out if no vertex of it is on all of its walls.
        """
        group, g = merges.group, len(merges.sets)
        x = self.positions(merges.vertices, merges.codes).T
        size = np.diff(merges.starts)
        mean = sum_columns(group, x.T, g).T / size[:, None]
        anchor = self._anchors(merges)
        targets = np.full((g, 1 + _TRIES, 3), np.nan)
        far = ((x - mean[group]) ** 2).sum(axis=1)
        order = np.lexsort((far, group))
        rank = np.arange(len(group)) - np.repeat(merges.starts[:-1], size)
        early = rank < _TRIES
        targets[group[order][early], 1 + rank[early]] = x[order][early]
        targets[:, 0] = mean
        walls = self.walls[merges.vertices[np.maximum(anchor, 0)]]
        fixed = np.flatnonzero((anchor >= 0) & (walls > 0))
        place = self.domain.onto_walls
        for attempt in range(1 + _TRIES):
            there = targets[fixed, attempt]
            targets[fixed, attempt] = place(there, x[anchor[fixed]], walls[fixed], self.wall_sets)
        targets[anchor < 0] = np.nan
        return targets

    def _anchors(self, merges: Merges) -> np.ndarray:
        """Return the first vertex of each group, as its place, that lies on all walls of the group; -1 without one."""
        ids = self.walls[merges.vertices]
        if not ids.any():
            return merges.starts[:-1].copy()
        size = np.array([len(walls) for walls in self.wall_sets])[ids]
        most = np.maximum.reduceat(size, merges.starts[:-1])
        rows = np.flatnonzero(size == most[merges.group])
        anchor = np.full(len(merges.sets), -1)
        anchor[merges.group[rows[::-1]]] = rows[::-1]
        theirs = ids[anchor[merges.group]]
        for one, other in set(zip(ids[ids != theirs].tolist(), theirs[ids != theirs].tolist(), strict=True)):
            if (one, other) not in self._within:
                self._within[one, other] = set(self.wall_sets[one]) <= set(self.wall_sets[other])
            if not self._within[one, other]:
                anchor[merges.group[(ids == one) & (theirs == other)]] = -1
        return anchor

    def _commit(self, merges: Merges, around: Neighborhood, done: np.ndarray, targets: np.ndarray) -> None:
        """Merge the sets `done` (k,) bool, whose vertices meet in `targets` (g, 3)."""
        yes, heads = done[merges.sets], merges.heads
        self.points[heads[yes]] = targets[yes]
        self.walls[heads[yes]] = self.walls[merges.vertices[self._anchors(merges)[yes]]]
        rank = np.arange(len(merges.vertices)) - merges.starts[merges.group]
        rows = np.flatnonzero(yes[merges.group] & (rank > 0))
        gone, into = merges.vertices[rows], heads[merges.group[rows]]
        self.now[gone] = into
        # The image of the old vertex at offset t is the image of the new one at t - code.
        self.now_code[gone] = -merges.codes[rows]
        for step in range(1, int(rank[rows].max(initial=0)) + 1):  # append one list to another
            one = rank[rows] == step
            self.next[self.last[into[one]]] = gone[one]
            self.last[into[one]] = self.last[gone[one]]
        mine = done[around.set_of_face]
        faces = around.faces[mine]
        starts, places = take_rows(around.starts, np.arange(len(around.corners)), np.flatnonzero(mine))
        self.count[faces] = np.diff(starts)
        there = self.face_corners(faces)[1]
        self.corners[there] = around.corners[places]
        if self.codes.flags.writeable:  # else there are no images
            self.codes[there] = around.codes[places]
        self.changed[faces] = self.edited[faces] = True
        self.touched[around.cells[done[around.set_of_cell]]] = True


def _sets_of_walls(
    starts: np.ndarray, corners: np.ndarray, neighbor: np.ndarray, count: int
) -> tuple[np.ndarray, list[tuple[int, ...]]]:
    """Return for each of `count` vertices its set of walls, and the sets, the first of which is empty."""
    outer = np.flatnonzero(neighbor < 0)
    at, vertices = take_rows(starts, corners, outer)
    wall = np.repeat(-1 - neighbor[outer], np.diff(at))
    size = int(wall.max(initial=0)) + 1
    vertex, wall = np.divmod(distinct(vertices.astype(np.int64) * size + wall), size)
    # Each round replaces the set of walls so far and the next wall by one number.
    found, sets = np.zeros(count, np.int64), [()]
    place = np.arange(len(vertex)) - np.searchsorted(vertex, vertex)
    for step in range(int(place.max(initial=-1)) + 1):
        rows = np.flatnonzero(place == step)
        key = found[vertex[rows]] * size + wall[rows]
        new = distinct(key)
        found[vertex[rows]] = len(sets) + np.searchsorted(new, key)
        sets += [(*sets[k // size], k % size) for k in new.tolist()]
    return found, sets
