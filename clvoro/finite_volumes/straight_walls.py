"""Straight walls in 2D: along the boundary each cell gets one face where the boundary turns by little.

A run is what a cell has of a ring of the domain, from one face end to the next. Its faces become chords (`_kept`).
Before that, a face end may move along the wall into a vertex of the domain: into a re-entrant corner, so that both
cells are convex, or into another kink that a chord would cut off. Each move must lower a cost: the area between the
boundary and the chords, and prices for their distance, for kinks into the cell, for slivers and for the way of the
face end.

Where the boundary is a curve, all points on walls lie on the curve itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import atan2, hypot, inf

import numpy as np

from ..geometry.polygon import Polygon
from ..mesh.diagram import Diagram
from ..mesh.straightening import SIDE_TURN, along_rings
from .geometry import polygon_areas, polygon_sides, sum_rows
from .solver_mesh import SolverMesh

REACH = 0.25
"""Farthest way of a face end into a vertex of the domain, over the smaller size of its two cells."""
_FILLED = 0.25
"""A kink into the cell is cut off if it is nearer than this to the chord, over the size of the cell."""
_CUT = 0.03
"""The same for a kink out of the cell."""
_SLIVER, _SHORT, _SHARP = 0.1, 0.03, np.pi / 3
_KINK_PRICE, _SHARP_PRICE, _SLIVER_PRICE, _OFF_PRICE, _WAY_PRICE = 0.5, 0.1, 0.02, 0.2, 0.02

Point = tuple[float, float]


@dataclass
class _Run:
    """A cell's part of a ring: wall faces, one after the other."""

    cell: int
    faces: list[int]
    before: _Run | None = None  # across the face end at the beginning; None if that end is fixed
    after: _Run | None = None
    end: tuple[int, int] = (-1, -1)
    """The face between two cells at the end, and which of its corners."""


def straight_walls(mesh: SolverMesh, diagram: Diagram, parts: np.ndarray) -> SolverMesh:
    """Return `mesh`, which has exact walls, with straight walls.

    Parameters
    ----------
    mesh : SolverMesh
        Of `diagram`, in 2D.
    diagram : Diagram
    parts : (k,) int
        Index of the named part of the boundary for each wall. A straight face has walls of one part.
    """
    if not isinstance(diagram.domain, Polygon):
        return mesh
    mesh = _on_curves(mesh, diagram.domain)
    work = _Work(mesh, diagram, parts)
    while True:
        made = work.straightened()
        if not work.spare(np.flatnonzero(~_starlike(made)).tolist()):
            return made


def _on_curves(mesh: SolverMesh, domain: Polygon) -> SolverMesh:
    """Return `mesh` with the points on walls moved from the domain's edges to its curves."""
    if not domain.curves:
        return mesh
    walls = slice(mesh.inner, mesh.outer)
    ends, edges = mesh.corners.reshape(-1, 2)[walls], -1 - mesh.neighbor[walls]
    rows, first = np.unique(ends, return_index=True)
    points = mesh.points.copy()
    # A point between two edges is a vertex of the domain, which is on the curves of both.
    points[rows] = domain.on_curve(points[rows], np.repeat(edges, 2)[first])
    return replace(mesh, points=points)


class _Work:
    """The walls of one mesh."""

    def __init__(self, mesh: SolverMesh, diagram: Diagram, parts: np.ndarray) -> None:
        self.mesh, self.walls = mesh, np.arange(mesh.inner, mesh.outer)
        self.points: list[Point] = list(map(tuple, mesh.points.tolist()))
        self.ends = mesh.corners.reshape(-1, 2)
        self.sizes = np.sqrt(np.maximum(polygon_areas(mesh), 0)).tolist()
        self.part = parts[-1 - mesh.neighbor[self.walls]].tolist()
        # 1: the ends of the cell do not move; 2: its walls remain as they are.
        self.spared, self.most = np.zeros(len(mesh), int), np.where(_starlike(mesh), 2, 1)
        self.next = self._following(diagram)
        self.at = self._single_faces()

    def _following(self, diagram: Diagram) -> list[int]:
        """Return the next wall face on the ring for each one, counted from the first; -1 at an end."""
        onward = along_rings(diagram, diagram.domain)
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
        a, b = self.ends[self.walls].T
        joined = (after >= 0) & (a[after] == b)
        return np.where(joined, after, -1).tolist()

    def _single_faces(self) -> dict[int, tuple[int, int]]:
        """Return the only inner face, and which of its ends, at points with exactly one inner and two wall faces."""
        k, v = self.mesh.inner, len(self.points)
        inner = self.ends[:k].ravel()
        walls = self.ends[self.walls].ravel()
        count = np.bincount(inner, minlength=v)
        single = (count == 1) & (np.bincount(walls, minlength=v) == 2)
        places = np.flatnonzero(single[inner])
        return {int(inner[p]): (int(p) // 2, int(p) % 2) for p in places}

    def spare(self, cells: list[int]) -> bool:
        """Do less in these cells, which straight walls turned inside out; return whether that is possible."""
        left = [c for c in cells if self.spared[c] < self.most[c]]
        self.spared[left] += 1
        return bool(left)

    def runs(self) -> list[_Run]:
        """Return the runs of all cells."""
        owner = self.mesh.owner[self.walls].tolist()
        begin = self.ends[self.walls, 0].tolist()
        previous = [-1] * len(owner)
        for i, j in enumerate(self.next):
            if j >= 0:
                previous[j] = i
        firsts = [i for i, p in enumerate(previous) if p < 0 or owner[p] != owner[i]]
        found: dict[int, _Run] = {}
        for i in firsts:
            run = _Run(owner[i], [i])
            found[i] = run
            j = self.next[i]
            while j >= 0 and owner[j] == run.cell and j != i:
                run.faces.append(j)
                j = self.next[j]
        for run in found.values():
            j = self.next[run.faces[-1]]
            other = found.get(j)
            if other is None or other is run or self.spared[[run.cell, other.cell]].any():
                continue
            at = self.at.get(begin[j])
            sides = {run.cell, other.cell}
            if at is None or {int(self.mesh.owner[at[0]]), int(self.mesh.neighbor[at[0]])} != sides:
                continue
            run.after, other.before, run.end = other, run, at
        return list(found.values())

    def line(self, faces: Sequence[int]) -> list[Point]:
        """Return the points along wall faces."""
        ends = self.ends[self.walls[list(faces)]].tolist()
        return [self.points[a] for a, _ in ends] + [self.points[ends[-1][1]]]

    def fixed(self, faces: Sequence[int]) -> list[bool]:
        """Return whether the name of the boundary changes in each inner point of a run."""
        return [self.part[a] != self.part[b] for a, b in pairwise(faces)]

    def cost(self, run: _Run, faces: Sequence[int]) -> float:
        """Return the cost of a run if it had these faces."""
        line, fixed = self.line(faces), self.fixed(faces)
        size = self.sizes[run.cell]
        kept = _kept(line, fixed, size)
        return _cost(line, fixed, kept, size)

    def move_ends(self, runs: list[_Run]) -> dict[tuple[int, int], int]:
        """Move the ends of runs where that lowers the cost; return the new point of the faces' ends that moved."""
        costs = {id(run): self.cost(run, run.faces) for run in runs}
        moved: dict[tuple[int, int], int] = {}
        for _ in range(2):
            order = sorted(
                (run for run in runs if run.after is not None),
                key=lambda r: -costs[id(r)] - costs[id(r.after)],
            )
            changed = False
            for run in order:
                other = run.after
                assert other is not None
                if run.end in moved:
                    continue
                size = min(self.sizes[run.cell], self.sizes[other.cell])
                now = costs[id(run)] + costs[id(other)]
                if now <= 1e-4 * size * size:
                    continue
                best = (now, run.faces, other.faces, 0.0, 0.0)
                for here, there in self._moves(run, other, size):
                    place = self.points[self.ends[self.walls[there[0]], 0]]
                    old = self.points[self.ends[self.walls[other.faces[0]], 0]]
                    way = hypot(place[0] - old[0], place[1] - old[1])
                    one, two = self.cost(run, here), self.cost(other, there)
                    total = one + two + _WAY_PRICE * way * size
                    if total < best[0]:
                        best = (total, here, there, one, two)
                if best[1] is not run.faces:
                    run.faces, other.faces = list(best[1]), list(best[2])
                    costs[id(run)], costs[id(other)] = best[3], best[4]
                    moved[run.end] = int(self.ends[self.walls[other.faces[0]], 0])
                    changed = True
            if not changed:
                break
        return moved

    def _moves(self, run: _Run, other: _Run, size: float) -> list[tuple[list[int], list[int]]]:
        """Return the faces of both runs for each vertex that their common end can move into."""
        found = []
        reach = REACH * size
        way = 0.0
        for k in range(1, len(other.faces)):
            way += self._length(other.faces[k - 1])
            if way > reach:
                break
            found.append((run.faces + other.faces[:k], other.faces[k:]))
        way = 0.0
        for k in range(1, len(run.faces)):
            way += self._length(run.faces[-k])
            if way > reach:
                break
            found.append((run.faces[:-k], run.faces[-k:] + other.faces))
        return found

    def _length(self, face: int) -> float:
        a, b = self.ends[self.walls[face]]
        (x, y), (u, v) = self.points[a], self.points[b]
        return hypot(u - x, v - y)

    def straightened(self) -> SolverMesh:
        """Return the mesh with straight walls."""
        mesh, runs = self.mesh, self.runs()
        moved = self.move_ends(runs)
        corners = self.ends.copy()
        for (face, side), point in moved.items():
            corners[face, side] = point
        a: list[int] = []
        b: list[int] = []
        cell: list[int] = []
        source: list[int] = []
        done = np.zeros(len(self.walls), bool)
        for run in runs:
            done[run.faces] = True
            count = len(run.faces)
            if self.spared[run.cell] == 2:
                kept = list(range(count + 1))
            else:
                kept = _kept(self.line(run.faces), self.fixed(run.faces), self.sizes[run.cell])
            for first, last in pairwise(kept):
                part = run.faces[first:last]
                longest = max(part, key=self._length)
                a.append(int(self.ends[self.walls[part[0]], 0]))
                b.append(int(self.ends[self.walls[part[-1]], 1]))
                cell.append(run.cell)
                source.append(int(self.walls[longest]))
        left = self.walls[~done]  # whole rings within one cell
        a += self.ends[left, 0].tolist()
        b += self.ends[left, 1].tolist()
        cell += mesh.owner[left].tolist()
        source += left.tolist()
        owner, rows = np.array(cell, mesh.owner.dtype), np.array(source, np.int64)
        order = np.lexsort((owner, -mesh.neighbor[rows]))
        k = mesh.inner
        rows = np.concatenate([np.arange(k), rows[order]])
        outer = np.stack([np.array(a, np.int64), np.array(b, np.int64)], axis=1)[order]
        ends = np.concatenate([corners[:k], outer])
        return replace(
            mesh,
            starts=2 * np.arange(len(ends) + 1),
            corners=ends.ravel(),
            owner=np.concatenate([mesh.owner[:k], owner[order]]),
            neighbor=mesh.neighbor[rows],
            twin=mesh.twin[rows],
            shift=mesh.shift[rows],
            half_face=mesh.half_face[rows],
        )


def _starlike(mesh: SolverMesh) -> np.ndarray:
    """Return whether each cell's centroid sees all of its faces from inside, (n,); short faces do not count."""
    cell, p, q, _ = polygon_sides(mesh)
    n, cross = len(mesh), _cross(p, q)
    area = np.bincount(cell, cross, n)
    safe = np.where(area > 0, area, np.inf)
    middle = sum_rows(cell, cross[:, None] * (p + q), n) / (3 * safe)[:, None]
    seen = _cross(p - middle[cell], q - middle[cell]) > 0
    seen |= ((q - p) ** 2).sum(axis=1) < _SHORT**2 * area[cell]
    return (area > 0) & (np.bincount(cell, ~seen, n) == 0)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _turn(a: Point, b: Point, c: Point) -> float:
    """Return the angle by which the way from a over b to c turns to the left."""
    x, y, u, v = b[0] - a[0], b[1] - a[1], c[0] - b[0], c[1] - b[1]
    return atan2(x * v - y * u, x * u + y * v)


def _offset(a: Point, b: Point, c: Point) -> float:
    """Return the distance of b from the straight line between a and c."""
    x, y, u, v = c[0] - a[0], c[1] - a[1], b[0] - a[0], b[1] - a[1]
    square = x * x + y * y
    t = min(max((x * u + y * v) / square, 0.0), 1.0) if square > 0 else 0.0
    return hypot(u - t * x, v - t * y)


def _kept(line: list[Point], fixed: list[bool], size: float) -> list[int]:
    """Return which points of a run remain, the first and the last included.

    A stretch that turns by at most 30 degrees in sum becomes straight. Then kinks near the chord are dropped.
    """
    last = len(line) - 1
    kept, turned = [0], 0.0
    for i in range(1, last):
        turned += _turn(line[i - 1], line[i], line[i + 1])
        if fixed[i - 1] or abs(turned) > SIDE_TURN:
            kept.append(i)
            turned = 0.0
    kept.append(last)
    while len(kept) > 2:
        best, where = inf, -1
        for k in range(1, len(kept) - 1):
            if fixed[kept[k] - 1]:
                continue
            a, b, c = (line[i] for i in kept[k - 1 : k + 2])
            offset = _offset(a, b, c)
            limit = _FILLED if _turn(a, b, c) < 0 else _CUT
            if offset < limit * size and offset < best:
                best, where = offset, k
        if where < 0:
            break
        del kept[where]
    _drop_for_area(line, fixed, kept, _FILLED * size)
    return kept


def _drop_for_area(line: list[Point], fixed: list[bool], kept: list[int], limit: float) -> None:
    """Drop kinks nearer than `limit` without which the area is nearer to the exact one: rough walls have such."""
    if len(kept) == 2:
        return
    lost = _area(line) - _area([line[i] for i in kept])
    while True:
        best, where, saved = abs(lost), -1, 0.0
        for k in range(1, len(kept) - 1):
            three = [line[i] for i in kept[k - 1 : k + 2]]
            area = _area(three)
            if fixed[kept[k] - 1] or _offset(*three) > limit:
                continue
            if abs(lost + area) < best:
                best, where, saved = abs(lost + area), k, area
        if where < 0:
            return
        lost += saved
        del kept[where]


def _area(line: list[Point]) -> float:
    """Return the area to the left of a line and to the right of its chord."""
    (x, y), area = line[0], 0.0
    for (u, v), (s, t) in pairwise(line[1:]):
        area += (u - x) * (t - y) - (v - y) * (s - x)
    return area / 2


def _cost(line: list[Point], fixed: list[bool], kept: list[int], size: float) -> float:
    """Return the cost of a run with the points `kept`."""
    total = 0.0
    for first, last in pairwise(kept):
        total += abs(_area(line[first : last + 1]))
        off, farthest = 0.0, first
        for i in range(first + 1, last):
            here = _offset(line[first], line[i], line[last])
            if here > off:
                off, farthest = here, i
        total += _OFF_PRICE * off * size
        if farthest > first and _turn(line[first], line[farthest], line[last]) < -_SHARP:
            total += _SHARP_PRICE * size * size
        (x, y), (u, v) = line[first], line[last]
        if hypot(u - x, v - y) < _SLIVER * size:
            total += _SLIVER_PRICE * size * size
    for k in range(1, len(kept) - 1):
        a, b, c = (line[i] for i in kept[k - 1 : k + 2])
        if _turn(a, b, c) < 1e-6:
            total += _KINK_PRICE * size * size
    return total
