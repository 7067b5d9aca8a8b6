"""Merge vertices of a polyhedral mesh in 3D where the cells stay valid; many merges at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from ..mesh.connectivity import following, take_rows
from .geometry import cell_geometry, face_geometry, sum_rows

_BASE = 64
"""Offsets of images, three numbers between -32 and 31, are digits of one integer: offsets add as integers."""
_TRIES = 4
"""Vertices of a group, the nearest to its mean first, that are tried as the place where all meet."""
_WORSE = 0.02
"""Change of non-orthogonality, in degrees, and relative change of skewness that is accepted anywhere."""
_CHUNK = 2048
"""Sets of vertices that are tried at a time."""
_THIN = 1e-6
"""Least volume of a tetrahedron over that of the pyramid of its face."""


def pack(offsets: np.ndarray) -> np.ndarray:
    """Return offsets (k, 3) as integers (k,) int64."""
    return offsets.astype(np.int64) @ _BASE ** np.arange(3)


def unpack(codes: np.ndarray) -> np.ndarray:
    """Return integers of `pack` (k,) as offsets (k, 3)."""
    half = _BASE // 2
    digits = codes + half * (1 + _BASE + _BASE**2)
    return np.stack([digits // _BASE**a % _BASE - half for a in range(3)], axis=1)


def ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return ``starts[0], starts[0] + 1, ...``, `counts[0]` numbers, then those of the next row."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - (ends - counts), counts)


def smaller_size(owner: np.ndarray, neighbor: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the smaller of the `sizes` (n,) of both cells of each face, (f,)."""
    return np.minimum(sizes[owner], sizes[np.where(neighbor >= 0, neighbor, owner)])


@dataclass(frozen=True)
class Limits:
    """What cells must satisfy after a merge.

    Attributes
    ----------
    flatness : float
        Least area of a face over the sum of the areas of its triangles about its center.
    concavity : float
        In a cell the direction from the center of a face to that of another one has at most this cosine with the
        outward normal of the first.
    non_orthogonality, skewness : float
        Largest values of the faces that change; a face that exceeds one of them must not get worse.
    """

    flatness: float = 0.95
    concavity: float = -1e-5
    non_orthogonality: float = 10.0
    skewness: float = 2.0


@dataclass(frozen=True)
class Merges:
    """Groups of vertices, each to become one vertex, in sets that are merged together or not at all.

    Attributes
    ----------
    starts : (g + 1,) int
    vertices : int
        Vertices of group i, ``vertices[starts[i]:starts[i + 1]]``.
    codes : int
        Packed offsets of the images that coincide with the first vertex of the group.
    sets : (g,) int
        Set of each group, ascending from 0.
    priority : (k,) float
        The least is tried first.
    reach : (k,) float
        Most distance of vertices from the first of their group; groups that are wider are left out.
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
        return np.repeat(np.arange(len(self.sets)), np.diff(self.starts))

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
            starts, self.vertices[places], self.codes[places], rank[self.sets[groups]],
            self.priority[rows], self.reach[rows],
        )  # fmt: skip


class Cells:
    """Polyhedral cells in 3D whose vertices can be merged.

    In periodic directions images of a vertex are one vertex, and a corner of a face is a vertex with an offset.

    Attributes
    ----------
    points : (v, 3) float
    walls : (v,) int
        Bit k is set if the vertex lies on wall k.
    begin, count : (f,) int
        The corners of face i are ``corners[begin[i]:begin[i] + count[i]]``, counter-clockwise as seen from outside of
        the owner; none if the face is gone.
    corners, codes : (k,) int
        Vertices, and their packed offsets as the owner sees them.
    owner, neighbor : (f,) int
        Cells; -1 - k on wall k.
    face_codes : (f,) int
        Packed offset of the neighbor's image.
    touched : (n,) bool
        Cells that a merge has changed.
    centroids : (n, 3) float, or None
        Where the cells had their centroids before all merges.
    """

    def __init__(
        self,
        points: np.ndarray,
        starts: np.ndarray,
        corners: np.ndarray,
        codes: np.ndarray,
        owner: np.ndarray,
        neighbor: np.ndarray,
        face_codes: np.ndarray,
        extent: np.ndarray,
        sizes: np.ndarray,
        small: float,
    ) -> None:
        self.points, self.extent = np.array(points, float), np.asarray(extent, float)
        self.begin, self.count = starts[:-1].copy(), np.diff(starts)
        self.corners, self.codes = corners.astype(np.int64), codes.astype(np.int64)
        self.owner, self.neighbor = owner.astype(np.int64), neighbor.astype(np.int64)
        self.face_codes, self.n = face_codes, len(sizes)
        self.sizes, self.small = sizes, small
        self.limits = Limits()
        self.centroids: np.ndarray | None = None
        v, f = len(points), len(owner)
        rows = np.repeat(np.arange(f), self.count)
        self.walls = np.zeros(v, np.int64)
        outer = self.neighbor[rows] < 0
        np.bitwise_or.at(self.walls, self.corners[outer], 1 << (-1 - self.neighbor[rows[outer]]))
        self.at_vertex = _inverse(self.corners, rows, v)
        inner = np.flatnonzero(self.neighbor >= 0)
        self.at_cell = _inverse(
            np.concatenate([self.owner, self.neighbor[inner]]),
            np.concatenate([np.arange(f), inner]),
            self.n,
        )
        self.next = np.full(v, -1)  # vertices that have been merged, as linked lists
        self.last = np.arange(v)
        self.now = np.arange(v)  # the vertex that each vertex has become, and where its image is
        self.now_code = np.zeros(v, np.int64)
        self.touched = np.zeros(self.n, bool)

    # Positions.

    def positions(self, vertices: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Return the positions of images of vertices, (k, 3)."""
        if not codes.any():
            return self.points[vertices]
        return self.points[vertices] + unpack(codes) * self.extent

    def face_corners(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts and places of the corners of `faces`."""
        counts = self.count[faces]
        starts = np.concatenate([[0], np.cumsum(counts)])
        return starts, ranges(self.begin[faces], counts)

    def faces_of(self, cells: np.ndarray) -> np.ndarray:
        """Return the faces of some cells, ascending."""
        starts, faces = self.at_cell
        faces = np.unique(faces[ranges(starts[cells], starts[cells + 1] - starts[cells])])
        return faces[self.count[faces] > 0]

    # Merging.

    def merge(self, merges: Merges) -> int:
        """Merge each set that leaves all cells valid; return how many do. Each merge removes a vertex."""
        done = 0
        while len((merges := self._current(merges)).sets):
            sets, faces = self._star(merges)
            cells = np.concatenate([self.owner[faces], self.neighbor[faces]])
            sets = np.concatenate([sets, sets])[cells >= 0]
            cells = cells[cells >= 0]
            chosen = independent(sets, cells, merges.priority, self.n)
            part = chosen[sets]
            rank = np.cumsum(chosen) - 1
            done += self._try(merges.take(np.flatnonzero(chosen)), rank[sets[part]], cells[part])
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
        starts = np.concatenate([[0], np.cumsum(counts[kept])])
        codes = codes - np.repeat(codes[starts[:-1]], np.diff(starts))
        sets = merges.sets[kept]
        made = Merges(starts, vertices, codes, sets, merges.priority, merges.reach)
        x = self.positions(vertices, codes)
        away = np.linalg.norm(x - x[starts[:-1]][made.group], axis=1)
        of = sets[made.group]
        key = np.sort(of * v + vertices)  # a vertex in two groups of a set
        wrong = np.concatenate([of[away > merges.reach[of]], key[1:][np.diff(key) == 0] // v])
        good = np.bincount(sets, minlength=len(merges.priority)) > 0
        good[wrong] = False
        return made.take(np.flatnonzero(good))

    def _star(self, merges: Merges) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs (set, face with one of its vertices); pairs may repeat."""
        sets, vertices = merges.sets[merges.group], merges.vertices
        starts, faces = self.at_vertex
        found: list[tuple[np.ndarray, np.ndarray]] = []
        while len(vertices):
            counts = starts[vertices + 1] - starts[vertices]
            found.append((np.repeat(sets, counts), faces[ranges(starts[vertices], counts)]))
            vertices = self.next[vertices]
            sets, vertices = sets[vertices >= 0], vertices[vertices >= 0]
        if not found:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        rows, star = (np.concatenate(parts) for parts in zip(*found, strict=True))
        there = self.count[star] > 0
        return rows[there], star[there]

    def _try(self, merges: Merges, sets: np.ndarray, cells: np.ndarray) -> int:
        """Merge those of the sets that leave their cells valid; no two sets have a cell in common."""
        pairs = np.unique(sets * self.n + cells)
        sets, cells = np.divmod(pairs, self.n)
        k = len(merges.priority)
        done = 0
        for first in range(0, k, _CHUNK):
            begin, end = np.searchsorted(sets, [first, first + _CHUNK])
            part = merges.take(np.arange(first, min(first + _CHUNK, k)))
            done += self._try_some(part, sets[begin:end] - first, cells[begin:end])
        return done

    def _try_some(self, merges: Merges, sets: np.ndarray, cells: np.ndarray) -> int:
        """Merge those of the sets that leave their cells valid, given pairs of set and cell."""
        targets = self._targets(merges)
        finite = np.ones(len(merges.priority), bool)
        finite[merges.sets[~np.isfinite(targets[:, 0, 0])]] = False
        region = Region(self, merges, cells, sets)
        good = region.is_manifold() & finite
        most = _Defects.allowed(region.k, self.limits)
        fits = good & (region.assess(targets[:, 0]) <= most)
        self._commit(merges, region, fits, targets[:, 0])
        done = int(np.count_nonzero(fits))
        rows = np.flatnonzero(good & ~fits)
        if not len(rows):
            return done
        # Few sets are left. Other targets may do, and cells that had defects before may keep them.
        targets = targets[np.isin(merges.sets, rows)]
        rank = np.full(region.k, -1)
        rank[rows] = np.arange(len(rows))
        merges, cells, sets = merges.take(rows), cells[rank[sets] >= 0], rank[sets]
        sets = sets[sets >= 0]
        before = Region(self, merges, cells, sets, merged=False).assess()
        most = before.worsened(_Defects.allowed(len(rows), self.limits))
        region, left = Region(self, merges, cells, sets), np.ones(len(rows), bool)
        for attempt in range(targets.shape[1]):
            tried = left.copy()
            tried[merges.sets[~np.isfinite(targets[:, attempt, 0])]] = False
            if tried.any():
                fits = tried & (region.assess(targets[:, attempt]) <= most)
                self._commit(merges, region, fits, targets[:, attempt])
                done += int(np.count_nonzero(fits))
                left &= ~fits
        return done

    def _targets(self, merges: Merges) -> np.ndarray:
        """Return where the vertices of each group may meet, (g, tries, 3): their mean, or one of them; or nan.

        On walls vertices stay on the walls. A group is left out if no vertex of it is on all of its walls.
        """
        group, g = merges.group, len(merges.sets)
        x = self.positions(merges.vertices, merges.codes)
        size = np.diff(merges.starts)
        mean = sum_rows(group, x, g) / size[:, None]
        walls = np.bitwise_or.reduceat(self.walls[merges.vertices], merges.starts[:-1])
        complete = self.walls[merges.vertices] == walls[group]
        targets = np.full((g, 1 + _TRIES, 3), np.nan)
        far = ((x - mean[group]) ** 2).sum(axis=1)
        order = np.lexsort((far, group))
        rank = np.arange(len(group)) - np.repeat(merges.starts[:-1], size)
        early = rank < _TRIES
        targets[group[order][early], 1 + rank[early]] = x[order][early]
        targets[:, 0] = mean
        # The coordinates of walls are those of a vertex on all of them.
        rows = np.flatnonzero(complete)
        anchor = np.full(g, -1)
        anchor[group[rows[::-1]]] = rows[::-1]
        for axis in range(3):
            fixed = walls & (3 << (2 * axis)) > 0
            targets[fixed, :, axis] = np.where(
                np.isnan(targets[fixed, :, axis]), np.nan, x[anchor[fixed], axis][:, None]
            )
        targets[anchor < 0] = np.nan
        return targets

    def _commit(
        self, merges: Merges, region: Region, done: np.ndarray, targets: np.ndarray
    ) -> None:
        """Merge the sets `done` (k,) bool, whose vertices meet in `targets` (g, 3)."""
        yes, heads = done[merges.sets], merges.heads
        walls = np.bitwise_or.reduceat(self.walls[merges.vertices], merges.starts[:-1])
        self.points[heads[yes]], self.walls[heads[yes]] = targets[yes], walls[yes]
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
        mine = done[region.set_of_face] & (region.set_of_face >= 0)
        faces = region.faces[mine]
        starts, places = take_rows(
            region.starts, np.arange(len(region.corners)), np.flatnonzero(mine)
        )
        counts = np.diff(starts)
        self.count[faces] = counts
        there = ranges(self.begin[faces], counts)
        self.corners[there] = region.corners[places]
        self.codes[there] = region.codes[places]
        self.touched[region.cells[done[region.set_of_cell]]] = True


@dataclass(frozen=True)
class _Defects:
    """What is wrong with the cells at each set of vertices, (k,) each.

    Attributes
    ----------
    count, serious : int
        Warped faces, inverted tetrahedra, concave pairs of faces: all, and those without small faces.
    angle, skewness : float
        Largest non-orthogonality in degrees, and skewness of the faces.
    """

    count: np.ndarray
    serious: np.ndarray
    angle: np.ndarray
    skewness: np.ndarray

    @classmethod
    def allowed(cls, k: int, limits: Limits) -> _Defects:
        """Return what is allowed anywhere."""
        none = np.zeros(k, np.int64)
        return cls(none, none, np.full(k, limits.non_orthogonality), np.full(k, limits.skewness))

    def worsened(self, allowed: _Defects) -> _Defects:
        """Return the defects that are there already, a little increased, or those that are allowed anywhere."""
        angle = np.maximum(self.angle + _WORSE, allowed.angle)
        skewness = np.maximum(self.skewness * (1 + _WORSE), allowed.skewness)
        return _Defects(self.count, self.serious, angle, skewness)

    def __le__(self, other: _Defects) -> np.ndarray:
        return (
            (self.count <= other.count)
            & (self.serious <= other.serious)
            & (self.angle <= other.angle)
            & (self.skewness <= other.skewness)
        )


@dataclass(frozen=True)
class _Shapes:
    """Faces and cells of a region: `seen` and `outward` are centers and areas of faces as each cell sees them."""

    centers: np.ndarray
    areas: np.ndarray
    flatness: np.ndarray
    seen: np.ndarray
    outward: np.ndarray
    middles: np.ndarray
    volumes: np.ndarray


class _Lookup:
    """Places of the entries of an array without duplicates; -1 for others."""

    def __init__(self, entries: np.ndarray) -> None:
        self.order = np.argsort(entries, kind="stable")
        self.sorted = entries[self.order]

    def __call__(self, values: np.ndarray) -> np.ndarray:
        if not len(self.sorted):
            return np.full(len(values), -1)
        at = np.minimum(np.searchsorted(self.sorted, values), len(self.sorted) - 1)
        return np.where(self.sorted[at] == values, self.order[at], -1)


def _inverse(items: np.ndarray, rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and rows of each item."""
    pairs = scipy.sparse.coo_array(
        (np.ones(len(items), np.int8), (items, rows)), (size, int(rows.max(initial=-1)) + 1)
    ).tocsr()
    return pairs.indptr.astype(np.int64), pairs.indices.astype(np.int64)


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
    return items[first], items[ranges(np.arange(len(groups)) + 1, later)]


def independent(sets: np.ndarray, cells: np.ndarray, priority: np.ndarray, n: int) -> np.ndarray:
    """Return a maximal choice of sets without a cell in common, those of least priority first, (k,) bool."""
    k = len(priority)
    rank = np.empty(k, np.int64)
    rank[np.argsort(priority, kind="stable")] = np.arange(k)
    chosen, left = np.zeros(k, bool), np.ones(k, bool)
    taken = np.zeros(n, bool)
    while len(sets):
        best = np.full(n, k)
        np.minimum.at(best, cells, rank[sets])
        loses = np.zeros(k, bool)
        loses[sets[best[cells] != rank[sets]]] = True
        wins = left & ~loses
        wins &= np.bincount(sets, minlength=k) > 0
        chosen |= wins
        taken[cells[wins[sets]]] = True
        left &= ~wins
        left[sets[taken[cells]]] = False
        going = left[sets]
        sets, cells = sets[going], cells[going]
    return chosen


class Region:
    """The cells around some sets of vertices, with their faces as they are after the merge."""

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
        """Group of each corner that is a merged vertex; -1 for others."""
        self.after = following(self.starts)
        self.before = np.empty_like(self.after)
        self.before[self.after] = np.arange(len(self.after))
        # Each face as a cell of the region sees it.
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
        counts = np.diff(self.starts)[self.side_face]
        side = np.repeat(np.arange(len(counts)), counts)
        place = ranges(self.starts[self.side_face], counts)
        cell = self.side_cell[side]
        m = len(self.cells)
        vertex = self._numbers(cell, self.corners[place], self.codes[place] - self.side_code[side])
        after = np.arange(len(place)) + 1
        ends = np.cumsum(counts)
        after[ends - 1] = ends - counts
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

    def _numbers(self, *keys: np.ndarray) -> np.ndarray:
        """Return equal numbers for equal keys, ascending."""
        order = np.lexsort(keys[::-1])
        new = np.zeros(len(order), bool)
        new[:1] = True
        for key in keys:
            new[1:] |= key[order[1:]] != key[order[:-1]]
        numbers = np.empty(len(order), np.int64)
        numbers[order] = np.cumsum(new) - 1
        return numbers

    def _repeated(self) -> np.ndarray:
        """Return the groups whose vertex occurs twice in a face."""
        rows = np.flatnonzero(self.new >= 0)
        number = self._numbers(self.face[rows], self.new[rows], self.codes[rows])
        twice = np.bincount(number)[number] > 1
        return self.new[rows[twice]]

    def _pinched(self) -> np.ndarray:
        """Return the groups about whose vertex faces meet elsewhere than on one path, or do not surround it once."""
        rows = np.flatnonzero(self.new >= 0)
        groups, faces = self.new[rows], self.face[rows]
        # Corners of these faces, relative to the vertex, and the sides that begin there.
        counts = np.diff(self.starts)[faces]
        row = np.repeat(np.arange(len(rows)), counts)
        place = ranges(self.starts[faces], counts)
        number = self._numbers(
            groups[row], self.corners[place], self.codes[place] - self.codes[rows[row]]
        )
        ends = np.cumsum(counts)
        after = np.arange(len(place)) + 1
        after[ends - 1] = ends - counts
        side = np.sort(np.stack([number, number[after]]), axis=0)
        f, g = len(rows), len(self.set_of_group)
        pairs = _pairs(number, row)
        key, points = np.unique(pairs[0] * f + pairs[1], return_counts=True)
        pairs = _pairs(self._numbers(*side), row)
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
        around = _count_unique(cell_groups, self._numbers(cells, frames), g)
        outside = np.bincount(groups[~inner], minlength=g) > 0
        euler = edges - np.bincount(groups, minlength=g) + around + outside
        wrong.append(np.flatnonzero(euler != 2))
        return np.concatenate(wrong)

    def assess(self, targets: np.ndarray | None = None) -> _Defects:
        """Return what is wrong with the cells if the vertices of each group meet in `targets` (g, 3)."""
        limits, w = self.whole.limits, self.whole
        x = w.positions(self.corners, self.codes)
        if targets is not None:
            moved = np.flatnonzero(self.new >= 0)
            x[moved] = targets[self.new[moved]] + unpack(self.codes[moved]) * w.extent
        with np.errstate(invalid="ignore", divide="ignore"):
            shapes = self._shapes(x)
            h = smaller_size(w.owner[self.faces], w.neighbor[self.faces], w.sizes)
            large = np.linalg.norm(shapes.areas, axis=1) >= w.small * h**2
            changed = self.alive & (self.set_of_face >= 0)
            wrong = changed & ~(shapes.flatness >= limits.flatness)
            wrong |= changed & self._bad_tetrahedra(x, shapes)
            arms = shapes.seen - shapes.middles[self.side_cell]
            low = ~(np.einsum("ij,ij->i", shapes.outward, arms) > 0)
            wrong[self.side_face[low]] |= changed[self.side_face[low]]
            sets = self.set_of_face
            count = np.bincount(sets[wrong], minlength=self.k)
            serious = np.bincount(sets[wrong & large], minlength=self.k)
            part = self.set_of_cell
            count += np.bincount(part[~(shapes.volumes > 0)], minlength=self.k)
            pairs = concave_pairs(
                shapes.seen, shapes.outward, self.side_cell, len(self.cells), limits.concavity,
                changed[self.side_face], large[self.side_face],
            )  # fmt: skip
            count += np.bincount(part, pairs[0], self.k).astype(np.int64)
            serious += np.bincount(part, pairs[1], self.k).astype(np.int64)
            angle, skewness = self._quality(x, shapes)
        return _Defects(count, serious, angle, skewness)

    def _shapes(self, x: np.ndarray) -> _Shapes:
        """Return centers and areas of the faces with corners at `x` (k, 3), and of the cells."""
        f, rows = len(self.faces), np.flatnonzero(self.alive)
        starts = np.append(self.starts[rows], len(x))
        centers, areas = np.full((f, 3), np.nan), np.full((f, 3), np.nan)
        centers[rows], areas[rows] = face_geometry(x, starts, np.arange(len(x)))
        about = np.cross(x[self.after] - x, centers[self.face] - x)
        spread = 0.5 * np.bincount(self.face, np.linalg.norm(about, axis=1), f)
        side = self.side_face
        seen = centers[side] - unpack(self.side_code) * self.whole.extent
        outward = areas[side] * self.side_sign[:, None]
        none = np.zeros(0, np.int64)
        middles, volumes = cell_geometry(seen, outward, self.side_cell, none, len(self.cells))
        flatness = np.linalg.norm(areas, axis=1) / spread
        return _Shapes(centers, areas, flatness, seen, outward, middles, volumes)

    def _bad_tetrahedra(self, x: np.ndarray, shapes: _Shapes) -> np.ndarray:
        """Return whether the tetrahedra of a face with the centers of its cells are not all positive, (f,) bool.

        Its triangles are those about its center, and the fan about one of its corners, whichever will do.
        """
        rows = np.flatnonzero(self.set_of_face[self.side_face] >= 0)
        face = self.side_face[rows]
        origins = shapes.middles[self.side_cell[rows]]
        origins = origins + unpack(self.side_code[rows]) * self.whole.extent
        counts = np.diff(self.starts)
        fans = np.zeros(len(self.corners))
        bad = np.zeros(len(self.faces), bool)
        for n in np.unique(counts[face]).tolist():
            these = counts[face] == n
            f, sign = face[these], self.side_sign[rows[these], None]
            places = self.starts[f][:, None] + np.arange(n)
            y = x[places] - origins[these][:, None]
            normal = np.cross(y, np.roll(y, -1, axis=1))
            about = np.einsum("mnk,mk->mn", normal, shapes.centers[f] - origins[these]) * sign
            bad[f[~(about > 0).all(axis=1)]] = True
            volume = np.einsum("mbk,mik->mbi", y, normal) * sign[:, :, None]
            volume[:, np.arange(n), np.arange(n)] = np.inf
            volume[:, np.arange(n), np.arange(n) - 1] = np.inf
            least = volume.min(axis=2) > _THIN * about.sum(axis=1)[:, None]
            np.add.at(fans, places[~least], 1)
        some = np.bincount(self.face[fans == 0], minlength=len(self.faces)) > 0
        return bad | ~(some | ~self.alive)

    def _quality(self, x: np.ndarray, shapes: _Shapes) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest non-orthogonality, in degrees, and skewness of the faces of each set, (k,) float each."""
        w, middles = self.whole, shapes.middles
        rows = np.flatnonzero(self.alive & (self.set_of_face >= 0))
        faces = self.faces[rows]
        center, area = shapes.centers[rows], shapes.areas[rows]
        area = area / np.linalg.norm(area, axis=1, keepdims=True)
        own = middles[self.local(w.owner[faces])]
        inner = w.neighbor[faces] >= 0
        other = middles[self.local(np.maximum(w.neighbor[faces], 0))]
        other += unpack(w.face_codes[faces]) * w.extent
        to_face = center - own
        height = np.einsum("ij,ij->i", area, to_face)
        d = np.where(inner[:, None], other - own, height[:, None] * area)
        across = np.einsum("ij,ij->i", area, d)
        length = np.linalg.norm(d, axis=1)
        angle = np.degrees(np.arccos(np.clip(across / length, -1, 1)))
        off = to_face - (height / across)[:, None] * d
        size = np.linalg.norm(off, axis=1)
        along = off / np.maximum(size, 1e-300)[:, None]
        counts = np.diff(self.starts)[rows]
        row = np.repeat(np.arange(len(rows)), counts)
        place = ranges(self.starts[rows], counts)
        reach = np.where(inner, 0.2, 0.4) * length
        np.maximum.at(reach, row, np.abs(np.einsum("ij,ij->i", along[row], x[place] - center[row])))
        worst = np.zeros((2, self.k))
        np.maximum.at(worst[0], self.set_of_face[rows], angle)
        np.maximum.at(worst[1], self.set_of_face[rows], size / reach)
        return worst[0], worst[1]


def concave_pairs(
    centers: np.ndarray,
    areas: np.ndarray,
    cell: np.ndarray,
    cells: int,
    limit: float,
    changed: np.ndarray,
    large: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each cell the number of pairs of faces that checkMesh takes for concave, and of large ones, (n,) int.

    Checked is the cosine of the outward normal of a face and the direction from its center to that of another face.

    Parameters
    ----------
    centers, areas : (k, 3) float
        Of each face as seen from a cell; areas point outward.
    cell : (k,) int
    limit : float
        The largest cosine.
    changed, large : (k,) bool
        One face of a pair is changed; both are large.
    """
    pairs, large_pairs = np.zeros(cells, np.int64), np.zeros(cells, np.int64)
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=cells)
    starts = np.concatenate([[0], np.cumsum(counts)])
    for k in np.unique(counts).tolist():
        rows = np.flatnonzero(counts == k)
        places = order[starts[rows][:, None] + np.arange(k)]
        c, s, new = centers[places], areas[places], changed[places]
        c = c - c.mean(axis=1, keepdims=True)
        s = s / np.linalg.norm(s, axis=2, keepdims=True)
        height = s @ c.transpose(0, 2, 1) - np.einsum("mij,mij->mi", s, c)[:, :, None]
        squares = np.einsum("mij,mij->mi", c, c)
        far = squares[:, :, None] + squares[:, None, :] - 2 * c @ c.transpose(0, 2, 1)
        steep = height > limit * np.sqrt(np.maximum(far, 0))
        steep &= new[:, :, None] | new[:, None, :]
        steep[:, np.arange(k), np.arange(k)] = False
        m, i, j = np.nonzero(steep)
        pairs += np.bincount(rows[m], minlength=cells)
        both = large[places[m, i]] & large[places[m, j]]
        large_pairs += np.bincount(rows[m[both]], minlength=cells)
    return pairs, large_pairs
