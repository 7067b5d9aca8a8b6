"""Straight walls in 2D: along the boundary each cell gets one face where the boundary turns by little.

A run is the part of a ring of the domain that belongs to one cell, from one face end to the next. Its faces become
chords; see `chord_points`. Before that, a face end may move along the wall into a vertex of the domain: into a
re-entrant corner, so that both cells are convex, or into another kink that a chord would cut off. Each move must lower
a cost: that of the chords, for corners that are not convex, for skew faces, and for the way of the face end. A cell
with a short run may leave the wall: both ends of the run move into one point.

Where the boundary is a curve, all points on walls lie on the curve itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from math import atan2, hypot

import numpy as np

from ..geometry.polygon import Polygon
from ..mesh.diagram import Diagram
from ..mesh.straightening import along_rings, cross
from .chords import Point, chord_cost, chord_points, concave_price, skewness
from .geometry import polygon_centroids, polygon_sides
from .prisms import simple_loops
from .solver_mesh import SolverMesh

REACH = 0.4
"""Farthest way of a face end into a vertex of the domain, over the smaller size of its two cells."""
_SHORT = 0.03
"""Faces shorter than this over the size of the cell may be bad."""
_SKEW_PRICE, _WAY_PRICE, _TILT_PRICE = 0.1, 0.02, 0.6
"""Prices in squares of the size of the cell: for the square of the skewness above 1, for the way of a face end over the
size, and for the square of the angle by which its face turns, in radians."""


@dataclass(eq=False)
class _Run:
    """A cell's part of a ring: wall faces, one after the other."""

    cell: int
    faces: list[int]
    behind: list[Point]
    """The two points before the run in the loop around the cell, if it is known."""
    ahead: list[Point]
    """The two points after it."""
    before: _Run | None = None
    """The run across the face end at the beginning; None if that end does not move."""
    after: _Run | None = None
    end: tuple[int, int] = (-1, -1)
    """The face between two cells at the end, and which of its corners."""
    cost: float = 0.0


@dataclass(frozen=True)
class _Move:
    """New faces of some runs; those of a run that leaves the wall are empty."""

    faces: list[tuple[_Run, list[int]]]
    point: int
    ends: list[tuple[int, int]]
    price: float


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
    domain = diagram.domain
    assert isinstance(domain, Polygon)
    work = _Work(_on_curves(mesh, domain), along_rings(diagram, domain), parts)
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

    def __init__(self, mesh: SolverMesh, onward: np.ndarray, parts: np.ndarray) -> None:
        self.mesh, self.walls = mesh, np.arange(mesh.inner, mesh.outer)
        self.points: list[Point] = list(map(tuple, mesh.points.tolist()))
        self.ends = mesh.corners.reshape(-1, 2)
        self.begin, self.final = (c.tolist() for c in self.ends[self.walls].T)
        areas, centroids = polygon_centroids(mesh)
        self.sizes = np.sqrt(np.maximum(areas, 0)).tolist()
        self.centroids: list[Point] = list(map(tuple, centroids.tolist()))
        self.part = parts[-1 - mesh.neighbor[self.walls]].tolist()
        # 1: the ends of the cell do not move; 2: its walls remain as they are.
        self.spared, self.most = np.zeros(len(mesh), int), np.where(_starlike(mesh), 2, 1)
        self.next = self._following(onward)
        self.at = self._single_faces()
        self.starts, self.loops, broken = simple_loops(mesh)
        self.broken = set(broken.tolist())
        self.costs: dict[tuple[int, int, int], float] = {}
        # Points that remain, by the cell and by the first and last face of a run.
        self.chords: dict[tuple[int, int, int], list[int]] = {}

    def _following(self, onward: np.ndarray) -> list[int]:
        """Return the next wall face on the ring for each one, counted from the first; -1 at an end.

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

    # Runs.

    def runs(self) -> list[_Run]:
        """Return the runs of all cells."""
        owner = self.mesh.owner[self.walls].tolist()
        previous = [-1] * len(owner)
        for i, j in enumerate(self.next):
            if j >= 0:
                previous[j] = i
        found: dict[int, _Run] = {}
        for i, p in enumerate(previous):
            if p >= 0 and owner[p] == owner[i]:
                continue
            faces, j = [i], self.next[i]
            while j >= 0 and owner[j] == owner[i] and j != i:
                faces.append(j)
                j = self.next[j]
            found[i] = _Run(owner[i], faces, *self._beside(owner[i], faces))
        for run in found.values():
            j = self.next[run.faces[-1]]
            other = found.get(j)
            if other is None or other is run or self.spared[[run.cell, other.cell]].any():
                continue
            at = self.at.get(self.begin[j])
            sides = {run.cell, other.cell}
            if at is None or {int(self.mesh.owner[at[0]]), int(self.mesh.neighbor[at[0]])} != sides:
                continue
            if run.ahead and other.behind:
                run.after, other.before, run.end = other, run, at
        return list(found.values())

    def _beside(self, cell: int, faces: list[int]) -> tuple[list[Point], list[Point]]:
        """Return the two points before and the two after some wall faces in the loop around their cell."""
        loop = self.loops[self.starts[cell] : self.starts[cell + 1]].tolist()
        if cell in self.broken or len(loop) < len(faces) + 3:
            return [], []
        first, last = loop.index(self.begin[faces[0]]), loop.index(self.final[faces[-1]])
        behind = [loop[first - 2], loop[first - 1]]
        ahead = [loop[(last + k) % len(loop)] for k in (1, 2)]
        return [self.points[p] for p in behind], [self.points[p] for p in ahead]

    def line(self, faces: Sequence[int]) -> list[Point]:
        """Return the points along wall faces."""
        return [self.points[self.begin[f]] for f in faces] + [self.points[self.final[faces[-1]]]]

    def fixed(self, faces: Sequence[int]) -> list[bool]:
        """Return whether the name of the boundary changes in each inner point of a run."""
        return [self.part[a] != self.part[b] for a, b in pairwise(faces)]

    def kept(self, run: _Run) -> list[int]:
        """Return which points of a run remain."""
        if self.spared[run.cell] == 2:
            return list(range(len(run.faces) + 1))
        return self.chords_of(run, run.faces)

    def chords_of(self, run: _Run, faces: Sequence[int]) -> list[int]:
        """Return which points of a run remain if it has these faces."""
        key = (run.cell, faces[0], faces[-1])
        if key not in self.chords:
            self.chords[key] = chord_points(
                self.line(faces), self.fixed(faces), self.sizes[run.cell]
            )
        return self.chords[key]

    def cost(self, run: _Run, faces: Sequence[int], point: int) -> float:
        """Return the cost of a run if it had these faces, or only this point if there are none."""
        key = (run.cell, *((faces[0], faces[-1]) if faces else (-1, point)))
        if key not in self.costs:
            self.costs[key] = self._cost_of(run, faces, point)
        return self.costs[key]

    def _cost_of(self, run: _Run, faces: Sequence[int], point: int) -> float:
        size = self.sizes[run.cell]
        if faces:
            line, kept = self.line(faces), self.chords_of(run, faces)
            total, left = chord_cost(line, kept, size), [line[i] for i in kept]
            for a, b in pairwise(left):
                skew = skewness(a, b, self.centroids[run.cell])
                total += _SKEW_PRICE * (max(skew - 1, 0) * size) ** 2
        else:
            total, left = 0.0, [self.points[point]]
        return total + concave_price([*run.behind, *left, *run.ahead]) * size * size

    # Face ends that move.

    def move_ends(self, runs: list[_Run]) -> dict[tuple[int, int], int]:
        """Move the ends of runs where that lowers the cost; return the new point of the faces' ends that moved."""
        for run in runs:
            run.cost = self.cost(run, run.faces, -1)
        moved: dict[tuple[int, int], int] = {}
        for _ in range(2):
            changed = False
            for run in sorted(runs, key=lambda r: -r.cost):
                if run.cost <= 1e-4 * self.sizes[run.cell] ** 2 or not run.faces:
                    continue
                best, gain = None, 0.0
                for move in self._moves(run, moved):
                    saved = sum(r.cost for r, _ in move.faces) - move.price
                    for r, faces in move.faces:
                        if saved <= gain:  # costs are not negative
                            break
                        saved -= self.cost(r, faces, move.point)
                    if saved > gain:
                        best, gain = move, saved
                if best is None:
                    continue
                for r, faces in best.faces:
                    r.faces, r.cost = faces, self.cost(r, faces, best.point)
                    if not faces:  # two faces end in the point now
                        r.before.after = r.after.before = None  # type: ignore[union-attr]
                        r.before = r.after = None
                moved |= dict.fromkeys(best.ends, best.point)
                changed = True
            if not changed:
                break
        return moved

    def _moves(self, run: _Run, moved: dict[tuple[int, int], int]) -> Iterator[_Move]:
        """Return how the ends of a run can move into vertices of the domain, or the run can leave the wall."""
        for one, two in ((run.before, run), (run, run.after)):
            if one is not None and two is not None and one.end not in moved:
                yield from self._shifts(one, two)
        one, two = run.before, run.after
        if one is None or two is None or one is two or one.end in moved or run.end in moved:
            return
        reach = REACH * min(self.sizes[r.cell] for r in (one, run, two))
        ways = [0.0, *accumulate(map(self._length, run.faces))]
        if ways[-1] > 2 * reach:
            return
        points = [self.begin[f] for f in run.faces] + [self.final[run.faces[-1]]]
        fixed = [k + 1 for k, here in enumerate(self.fixed(run.faces)) if here]
        for k, point in enumerate(points):
            if fixed and fixed != [k]:
                continue
            price = self._price(one, points[0], point) + self._price(run, points[-1], point)
            faces = [(one, one.faces + run.faces[:k]), (run, []), (two, run.faces[k:] + two.faces)]
            if max(ways[k], ways[-1] - ways[k]) <= reach:
                yield _Move(faces, point, [one.end, run.end], price)

    def _shifts(self, one: _Run, two: _Run) -> Iterator[_Move]:
        """Return how the common end of two runs can move."""
        reach = REACH * min(self.sizes[one.cell], self.sizes[two.cell])
        old = self.begin[two.faces[0]]
        way = 0.0
        for k in range(1, len(two.faces)):
            way += self._length(two.faces[k - 1])
            if way > reach:
                break
            point = self.begin[two.faces[k]]
            faces = [(one, one.faces + two.faces[:k]), (two, two.faces[k:])]
            yield _Move(faces, point, [one.end], self._price(one, old, point))
        way = 0.0
        for k in range(1, len(one.faces)):
            way += self._length(one.faces[-k])
            if way > reach:
                break
            point = self.begin[one.faces[-k]]
            faces = [(one, one.faces[:-k]), (two, one.faces[-k:] + two.faces)]
            yield _Move(faces, point, [one.end], self._price(one, old, point))

    def _price(self, run: _Run, old: int, new: int) -> float:
        """Return the price for moving the end of a run: for its way, and for the angle by which the face turns."""
        (x, y), (u, v), (s, t) = self.points[old], self.points[new], run.ahead[0]
        size = self.sizes[run.cell]
        x, y, u, v = x - s, y - t, u - s, v - t
        tilt = atan2(x * v - y * u, x * u + y * v)
        return _WAY_PRICE * hypot(u - x, v - y) * size + _TILT_PRICE * (tilt * size) ** 2

    def _length(self, face: int) -> float:
        (x, y), (u, v) = self.points[self.begin[face]], self.points[self.final[face]]
        return hypot(u - x, v - y)

    def straightened(self) -> SolverMesh:
        """Return the mesh with straight walls."""
        mesh, runs = self.mesh, self.runs()
        moved = self.move_ends(runs)
        corners = self.ends.copy()
        for (face, side), point in moved.items():
            corners[face, side] = point
        rows: list[tuple[int, int, int, int]] = []  # two points, cell, wall face
        done = np.zeros(len(self.walls), bool)
        for run in runs:
            done[run.faces] = True
            for first, last in pairwise(self.kept(run) if run.faces else []):
                part = run.faces[first:last]
                longest = max(part, key=self._length)
                rows.append((self.begin[part[0]], self.final[part[-1]], run.cell, longest))
        for face in np.flatnonzero(~done).tolist():  # whole rings within one cell
            cell = int(mesh.owner[self.walls[face]])
            rows.append((self.begin[face], self.final[face], cell, face))
        a, b, owner, source = np.array(rows, np.int64).reshape(-1, 4).T
        source = self.walls[source]
        order = np.lexsort((owner, -mesh.neighbor[source]))
        k = mesh.inner
        taken = np.concatenate([np.arange(k), source[order]])
        ends = np.concatenate([corners[:k], np.stack([a, b], axis=1)[order]])
        return replace(
            mesh,
            starts=2 * np.arange(len(ends) + 1),
            corners=ends.ravel(),
            owner=np.concatenate([mesh.owner[:k], owner[order].astype(mesh.owner.dtype)]),
            neighbor=mesh.neighbor[taken],
            twin=mesh.twin[taken],
            shift=mesh.shift[taken],
            half_face=mesh.half_face[taken],
        )


def _starlike(mesh: SolverMesh) -> np.ndarray:
    """Return whether each cell's centroid sees all of its faces from inside, (n,); short faces do not count."""
    cell, p, q, origins = polygon_sides(mesh)
    areas, centroids = polygon_centroids(mesh)
    middle = (centroids - origins)[cell]
    seen = cross(p - middle, q - middle) > 0
    seen |= ((q - p) ** 2).sum(axis=1) < 2 * _SHORT**2 * areas[cell]
    return (areas > 0) & (np.bincount(cell, ~seen, len(mesh)) == 0)
