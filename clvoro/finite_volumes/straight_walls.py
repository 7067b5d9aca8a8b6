"""Straight walls in 2D: along the boundary each cell gets one face where the boundary turns by little.

A run is the part of a ring of the domain that belongs to one cell, from one face end to the next. Its faces become
chords; see `kept_points`. Before that, a face end may move along the wall into a vertex of the domain: into a
re-entrant corner, so that both cells are convex, or into another kink that a chord would cut off. Each move must lower
a cost: that of the chords, for corners that are not convex, for skew faces, and for the way of the face end. A cell
with a short run may leave the wall: both ends of the run move into one point. The moves that gain most are made first.

Where the boundary is a curve, all points on walls lie on the curve itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arguments import format_point, warn
from ..errors import MismatchWarning
from ..geometry.polygon import Polygon
from ..geometry.simplification import DEFAULT_NAME
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import polygon_centroids, polygon_sides
from ..mesh.straightening import along_rings, cross
from .chords import chords, kept_points, least_of_rows
from .independent import independent
from .wall_runs import WallRuns

REACH = 0.4
"""Farthest way of a face end into a vertex of the domain, over the smaller size of its two cells."""
_SHORT = 0.03
"""Faces shorter than this over the size of the cell may be bad."""
_CHEAP = 1e-4
"""Runs that cost less than this remain as they are, in squares of the size of the cell."""


def straight_walls(mesh: Faces, diagram: Diagram, parts: np.ndarray) -> Faces:
    """Return `mesh`, which has exact walls, with straight walls.

    Parameters
    ----------
    mesh : Faces
        Of `diagram`, in 2D.
    diagram : Diagram
    parts : (k,) int
        Index of the named part of the boundary for each wall. A straight face has walls of one part.
    """
    domain = diagram.domain.outline
    assert domain is not None
    mesh = _on_curves(_without_islands(mesh, domain, parts), domain)
    runs = WallRuns(mesh, along_rings(diagram, domain), parts)
    # 1: the ends of the cell do not move; 2: its walls remain as they are.
    spared, most = np.zeros(mesh.n_cells, int), np.where(_starlike(mesh), 2, 1)
    while True:
        made = _straightened(runs, spared)
        worse = ~_starlike(made) & (spared < most)
        if not worse.any():
            return made
        spared[worse] += 1


def _without_islands(mesh: Faces, domain: Polygon, parts: np.ndarray) -> Faces:
    """Return `mesh` without the holes of the domain that lie within one cell each.

    Those stay with which a named part of the boundary would vanish, but for rings that nobody gave a name.

    Warns
    -----
    MismatchWarning
        If there are such holes.
    """
    walls = np.arange(mesh.n_inner, mesh.n_outer)
    edge, owner = -1 - mesh.neighbor[walls], mesh.owner[walls].astype(np.int64)
    ring, rings = (np.searchsorted(domain.ring_starts, edge, "right") - 1, len(domain.ring_starts) - 1)
    least, most = np.full(rings, mesh.n_cells), np.full(rings, -1)
    np.minimum.at(least, ring, owner)
    np.maximum.at(most, ring, owner)
    within = (least == most) & (np.diff(domain.piece_of_ring, prepend=-1) == 0)
    left = np.bincount(parts[edge[~within[ring]]], minlength=parts.max() + 1) > 0
    names = domain.boundaries.names
    named = np.array([DEFAULT_NAME.fullmatch(name) is None for name in names])
    named = named[domain.boundaries.index[edge]]
    within[ring[named & ~left[parts[edge]]]] = False
    if not within.any():
        return mesh
    dropped = [x for x, here in zip(domain.rings, within, strict=True) if here]
    extents = [np.ptp(x, axis=0).max() for x in dropped]
    count, place = len(dropped), format_point(dropped[int(np.argmax(extents))].mean(axis=0))
    what = "1 island lies within one cell and is"
    if count > 1:
        what = f"{count} islands lie within one cell each and are"
    warn(
        f"{what} left out of the mesh for solvers, as the one at {place}, {max(extents):.3g} long. Use smaller cells "
        "there, or drop what is smaller than a cell first, as domain.simplified(size) does",
        MismatchWarning,
    )
    kept = np.ones(len(mesh.owner), bool)
    kept[walls[within[ring]]] = False
    return mesh.take_faces(kept).compact()


def _on_curves(mesh: Faces, domain: Polygon) -> Faces:
    """Return `mesh` with the points on walls moved from the domain's edges to its curves."""
    if not domain.curves:
        return mesh
    walls = slice(mesh.n_inner, mesh.n_outer)
    ends, edges = mesh.corners.reshape(-1, 2)[walls], -1 - mesh.neighbor[walls]
    rows, first = np.unique(ends, return_index=True)
    points = mesh.points.copy()
    # A point between two edges is a vertex of the domain, which is on the curves of both.
    points[rows] = domain.on_curve(points[rows], np.repeat(edges, 2)[first])
    return replace(mesh, points=points)


def _straightened(runs: WallRuns, spared: np.ndarray) -> Faces:
    """Return the mesh with straight walls, where `spared` (n,) is not 2; face ends move where it is 0."""
    mesh, ends = runs.mesh, _Ends(runs, spared == 0)
    while ends.move():
        pass
    corners, moved = mesh.corners.reshape(-1, 2).copy(), np.flatnonzero(ends.target >= 0)
    corners[runs.face[moved], runs.side[moved]] = ends.target[moved]
    left = np.flatnonzero(ends.end > ends.begin)
    lines, points, face = runs.lines(left, ends.begin[left], ends.end[left])
    kept = kept_points(lines) | (spared[runs.cell[left]] == 2)[lines.row]
    steps, firsts, counts = chords(lines, kept)
    chord = np.repeat(np.arange(len(firsts)), counts)
    longest = steps[least_of_rows(chord, -runs.lengths[face[steps]])]
    rest = np.ones(len(runs.walls), bool)  # whole rings within one cell
    rest[runs.order] = False
    a = np.concatenate([points[steps[firsts]], runs.first[rest]])
    b = np.concatenate([points[steps[firsts + counts - 1] + 1], runs.last[rest]])
    source = runs.walls[np.concatenate([face[longest], np.flatnonzero(rest)])]
    owner = mesh.owner[source].copy()
    owner[: len(firsts)] = runs.cell[left[lines.row[steps[firsts]]]]
    order = np.lexsort((owner, -mesh.neighbor[source]))
    k = mesh.n_inner
    taken = np.concatenate([np.arange(k), source[order]])
    pairs = np.concatenate([corners[:k], np.stack([a, b], axis=1)[order]])
    return replace(
        mesh,
        starts=2 * np.arange(len(pairs) + 1),
        corners=pairs.ravel(),
        owner=np.concatenate([mesh.owner[:k], owner[order]]),
        neighbor=mesh.neighbor[taken],
        twin=mesh.twin[taken],
        shift=mesh.shift[taken],
        half_face=mesh.half_face[taken],
    )


class _Ends:
    """The ends of runs while they move. Each moves at most once, and those that gain most move first.

    Attributes
    ----------
    begin, end : (r,) int
        Places between which the runs are.
    cost : (r,) float
    free : (e,) bool
        Face ends that can move.
    target : (e,) int
    stale : (r,) bool
        Runs that the last moves changed.
    gain, way : (e + r,) float, int
        The best move of each face end, and of each run that leaves the wall: what it gains, and by how many faces. The
        end of a run before the one that leaves moves over so many faces.
    """

    def __init__(self, runs: WallRuns, can_move: np.ndarray) -> None:
        """`can_move` (n,) bool are cells whose face ends can move."""
        w = self.walls = runs
        self.begin, self.end, count = w.begin.copy(), w.end.copy(), len(w.begin)
        self.free = can_move[w.cell[w.one]] & can_move[w.cell[w.two]]
        self.target = np.full(len(w.one), -1)
        # The face ends at the beginning and at the end of each run, behind them one that never moves.
        self.ends_of = np.full((2, count), len(w.one))
        self.ends_of[0, w.two] = self.ends_of[1, w.one] = np.arange(len(w.one))
        self.gain = np.zeros(len(w.one) + count)
        self.way = np.zeros(len(self.gain), np.int64)
        self.cost, self.stale = np.zeros(count), np.zeros(count, bool)
        self.stale[w.one[self.free]] = self.stale[w.two[self.free]] = True
        self._renew()

    def _renew(self) -> None:
        """Renew the costs of runs that have changed, and the best moves there."""
        w, count = self.walls, len(self.walls.one)
        some = np.flatnonzero(self.stale)
        self.cost[some] = w.cost(some, self.begin[some], self.end[some])
        dear = self.cost > _CHEAP * w.sizes[w.cell] ** 2
        near = self.stale[w.one] | self.stale[w.two]
        self.gain[:count][near | ~self.free] = 0
        self._set_shifts(np.flatnonzero(self.free & near & (dear[w.one] | dear[w.two])))
        free = np.append(self.free, False)[self.ends_of].all(axis=0)
        self.gain[count:][~free] = 0
        runs = np.flatnonzero(free)
        one, two = self._beside(runs)
        near = self.stale[runs] | self.stale[one] | self.stale[two]
        self.gain[count + runs[near]] = 0
        self._set_exits(runs[near & dear[runs] & (one != two)])

    def _beside(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the runs before and after `runs`, both of whose ends can move."""
        return self.walls.one[self.ends_of[0, runs]], self.walls.two[self.ends_of[1, runs]]

    def _ways(self, run: np.ndarray, begin: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return for `counts` faces from each place on: the row, the number from 0, and the length up to their end."""
        starts = np.cumsum(counts) - counts
        row = np.repeat(np.arange(len(run)), counts)
        k = np.arange(len(row)) - starts[row]
        length = self.walls.lengths[self.walls.at(run[row], begin[row] + k)]
        sums = np.concatenate([[0.0], np.cumsum(length)])
        return row, k, sums[1:] - sums[starts[row]]

    def _set_shifts(self, some: np.ndarray) -> None:
        """Find the best place for `some` face ends along the wall."""
        w = self.walls
        one, two = w.one[some], w.two[some]
        reach = REACH * np.minimum(w.sizes[w.cell[one]], w.sizes[w.cell[two]])
        first, place, old = self.begin[one], self.end[one], w.first[w.at(one, self.end[one])]
        row, k, way = self._ways(one, first, place - first)
        total = np.zeros(len(some))
        np.maximum.at(total, row, way)
        before = np.stack([row, k + 1 - (place - first)[row]]), total[row] - way
        row, k, way = self._ways(two, self.begin[two], self.end[two] - self.begin[two])
        (row, by), way = (np.concatenate(z, axis=-1) for z in zip(before, (np.stack([row, k + 1]), way), strict=True))
        # Each run keeps a face.
        room = by != (self.end[two] - self.begin[two])[row]
        near = np.flatnonzero((way <= reach[row]) & (by != 0) & room)
        row, by = row[near], by[near]
        new = w.first[w.at(one[row], place[row] + by)]
        gain = (self.cost[one] + self.cost[two])[row] - w.way_price(one[row], old[row], new)
        lines = ((one, first, place, 0, 1), (two, self.begin[two], self.end[two], 1, 0))
        self._keep_best(some, row, by, gain, lines)

    def _set_exits(self, runs: np.ndarray) -> None:
        """Find the best points into which the ends of `runs` can move."""
        w = self.walls
        one, two = self._beside(runs)
        size = w.sizes[w.cell]
        reach = REACH * np.minimum(np.minimum(size[one], size[two]), size[runs])
        counts = self.end[runs] - self.begin[runs]
        row, k, way = self._ways(runs, self.begin[runs], counts + 1)
        # `_ways` measures up to the end of each face; here lengths up to its beginning are needed.
        way -= w.lengths[w.at(runs[row], self.begin[runs[row]] + k)]
        total = np.zeros(len(runs))
        np.maximum.at(total, row, way)
        part = w.part[w.at(runs[row], self.begin[runs[row]] + k)]
        named = (k > 0) & (k < counts[row])
        named[1:] &= part[1:] != part[:-1]
        names = np.bincount(row, named, len(runs))[row]
        far = np.maximum(way, total[row] - way) > reach[row]
        near = np.flatnonzero(~far & ((names == 0) | ((names == 1) & named)))
        row, by = row[near], k[near]
        ends = [w.first[w.at(runs[row], z[runs[row]])] for z in (self.begin, self.end)]
        new = w.first[w.at(runs[row], self.begin[runs[row]] + by)]
        gain = (self.cost[one] + self.cost[runs] + self.cost[two])[row]
        gain -= w.way_price(one[row], ends[0], new) + w.way_price(runs[row], ends[1], new)
        lines = (
            (one, self.begin[one], self.end[one], 0, 1),
            (runs, self.begin[runs], self.begin[runs], 1, 1),
            (two, self.begin[two] - counts, self.end[two], 1, 0),
        )
        self._keep_best(len(w.one) + runs, row, by, gain, lines)

    def _keep_best(self, places: np.ndarray, row: np.ndarray, by: np.ndarray, gain: np.ndarray, lines: tuple) -> None:
        """Keep the best move of each row in `places`, after the costs of new lines are taken from its gain.

        A line is a run, where it begins and ends, and how both move with `by`. Costs are not negative, so moves
        without a gain are not regarded any further.
        """
        for run, begin, end, first, last in lines:
            left = np.flatnonzero(gain > 0)
            row, by, gain = row[left], by[left], gain[left]
            gain -= self.walls.cost(run[row], begin[row] + first * by, end[row] + last * by)
        order = np.lexsort((-gain, row))
        order = order[np.diff(row[order], prepend=-1) > 0]
        self.gain[places[row[order]]] = np.maximum(gain[order], 0)
        self.way[places[row[order]]] = by[order]

    def move(self) -> bool:
        """Make the moves that gain most, at most one of each run; return False if no move gains anything."""
        w, count = self.walls, len(self.walls.one)
        found = np.flatnonzero(self.gain > 0)
        if not found.size:
            return False
        shifts, runs = found[found < count], found[found >= count] - count
        one, two = self._beside(runs)
        changed = np.concatenate([w.one[shifts], w.two[shifts], one, runs, two])
        k, j = np.arange(len(shifts)), len(shifts) + np.arange(len(runs))
        sets = np.concatenate([k, k, j, j, j])
        taken = independent(sets, changed, -self.gain[found], len(self.begin))
        self.stale[:] = False
        self.stale[changed[taken[sets]]] = True
        shifts, exits = shifts[taken[: len(shifts)]], taken[len(shifts) :]
        one, runs, two = one[exits], runs[exits], two[exits]
        # Ends move to a place; those of a run that leaves to the same one.
        by, over = self.way[shifts], self.way[count + runs]
        self.target[shifts] = w.first[w.at(w.one[shifts], self.end[w.one[shifts]] + by)]
        self.end[w.one[shifts]] += by
        self.begin[w.two[shifts]] += by
        point = w.first[w.at(runs, self.begin[runs] + over)]
        self.target[self.ends_of[0, runs]] = self.target[self.ends_of[1, runs]] = point
        self.end[one] += over
        self.begin[two] -= self.end[runs] - self.begin[runs] - over
        self.begin[runs] += over
        self.end[runs] = self.begin[runs]
        self.free[self.target >= 0] = False
        self._renew()
        return True


def _starlike(mesh: Faces) -> np.ndarray:
    """Return whether each cell's centroid sees all of its faces from inside, (n,); short faces do not count."""
    cell, p, q, origins = polygon_sides(mesh)
    areas, centroids = polygon_centroids(mesh)
    middle = (centroids - origins)[cell]
    seen = cross(p - middle, q - middle) > 0
    seen |= ((q - p) ** 2).sum(axis=1) < 2 * _SHORT**2 * areas[cell]
    return (areas > 0) & (np.bincount(cell, ~seen, mesh.n_cells) == 0)
