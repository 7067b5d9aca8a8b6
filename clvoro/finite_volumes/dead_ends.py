"""Cells in 2D whose faces towards other cells are all parallel: at dead ends, and in channels that are one cell wide.

OpenFOAM refuses them: their determinant vanishes, as differences across such faces say nothing of the other direction.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product, takewhile

import numpy as np

from ..mesh.faces import Faces
from ..mesh.geometry import turns
from .measures import PlaneMeasures
from .short_edges import STRAIGHT, WALL, point_kinds

LEAST_DETERMINANT = 2e-3
"""Cells with a smaller determinant are changed; OpenFOAM's limit is 1e-3."""
TILT, MOST_TILT = 0.12, 0.4
"""How far the ends of a face move, over its length, and at most over that of a face on the wall."""
STRIPS, BESIDE = (0.4, 0.2), 0.1
"""Where cells at dead ends meet the second neighbor: share of the face between them, the second if the first would make
a cell concave, and of the way to a centroid."""
ROUNDS = 4

Side = tuple[int, int, int]
"""A face of a cell, and its first and last point with the cell on the left."""


def open_dead_ends(mesh: Faces, parts: np.ndarray) -> Faces:
    """Return `mesh` with determinants of cells as large as OpenFOAM demands, where that is possible.

    A cell with one neighbor takes from it the part beside one wall, up to the next cell. A face across a channel is
    tilted: its ends move along the walls in opposite directions.

    Parameters
    ----------
    mesh : Faces
        A mesh for solvers in 2D.
    parts : (k,) int
        Index of the named part of the boundary for each wall.
    """
    for _ in range(ROUNDS):
        measures = PlaneMeasures(mesh)
        bad = np.flatnonzero(measures.determinant < LEAST_DETERMINANT)
        if not bad.size or mesh.n_cells < 3:
            return mesh
        edit = _Edit(measures, parts)
        for cell in bad.tolist():
            edit.change(cell)
        if not edit.touched:
            return mesh
        mesh = edit.mesh()
    return mesh


class _Edit:
    """Changes of single cells of a mesh. Each cell is changed once."""

    def __init__(self, measures: PlaneMeasures, parts: np.ndarray) -> None:
        self.old = mesh = measures.mesh
        self.points = list(mesh.points)
        self.ends = mesh.corners.reshape(-1, 2).tolist()
        self.owner, self.neighbor = mesh.owner.tolist(), mesh.neighbor.tolist()
        self.centroids = measures.centroids
        self.slides = point_kinds(mesh, parts) == WALL
        self.starts, sides = mesh.cell_faces()
        self.faces = mesh.sides()[1][sides]
        self.touched: set[int] = set()
        self.dropped: list[int] = []

    def faces_of(self, cell: int) -> list[int]:
        """Return the faces of `cell`."""
        return self.faces[self.starts[cell] : self.starts[cell + 1]].tolist()

    def loop(self, cell: int) -> list[Side]:
        """Return the sides of `cell` counter-clockwise; empty if they are not one loop."""
        sides = {}
        for f in self.faces_of(cell):
            a, b = self.ends[f] if self.owner[f] == cell else self.ends[f][::-1]
            sides[a] = (f, a, b)
        found = [next(iter(sides.values()))]
        while len(found) < len(sides) and found[-1][2] in sides:
            found.append(sides[found[-1][2]])
        return found if found[-1][2] == found[0][1] and len({s[0] for s in found}) == len(found) else []

    def other(self, face: int, cell: int) -> int:
        """Return the cell on the other side of `face`; negative on a wall."""
        return self.neighbor[face] if self.owner[face] == cell else self.owner[face]

    def change(self, cell: int) -> None:
        """Give `cell` a second neighbor, or tilt one of its faces."""
        loop = self.loop(cell)
        inner = [side for side in loop if self.other(side[0], cell) >= 0]
        if len(inner) == 1:
            before = self.other(inner[0][0], cell)
            any(self._share(cell, before, inner[0][0], *way) for way in product(STRIPS, (True, False)))
            return
        for face, a, b in inner:
            if self._tilt(cell, face, a, b):
                return

    def _share(self, cell: int, before: int, face: int, strip: float, forward: bool) -> bool:
        """Give `cell` the part of cell `before` beside one wall, so that it borders on the cell beyond."""
        loop = self.loop(before)
        k = next((i for i, side in enumerate(loop) if side[0] == face), None)
        if k is None:
            return False
        # From `face` along the wall, counter-clockwise around `before` or against it.
        rest = [*loop[k + 1 :], *loop[:k]][:: 1 if forward else -1]
        walls = list(takewhile(lambda side: self.other(side[0], before) < 0, rest))
        if not walls or len(walls) == len(rest):
            return False
        along = [walls[0][1 if forward else 2], *(side[2 if forward else 1] for side in walls)]
        p, q, beyond = along[0], along[-1], rest[len(walls)][0]
        far, r = self.other(beyond, before), len(self.points)
        if {cell, before, far} & self.touched or far == cell:
            return False
        ends = self.ends[beyond]
        x, y = self.points[q], self.points[ends[0] if ends[1] == q else ends[1]]
        own, straight = self._wall_at(cell, p), bool(self.slides[p])  # a point on a straight wall is left out
        loops = [[side[1] for side in self.loop(c)] for c in (before, far, cell)]
        if own is None and straight:
            return False
        place = x + strip * (y - x)
        self.points.append(place + BESIDE * (self.centroids[before] - place))
        taken = along[1:] if straight else along
        gained = [*taken, r] if forward else [r, *taken[::-1]]
        after = [
            [r if x == p else x for x in loops[0] if x not in along[1:]],
            [y for x in loops[1] for y in (([r, q] if forward else [q, r]) if x == q else [x])],
            [y for x in loops[2] for y in (gained if x == p else [x])],
        ]
        if not all(map(self._is_convex, after)):
            self.points.pop()
            return False
        for f, old in ((face, p), (beyond, q)):
            self.ends[f][self.ends[f].index(old)] = r
        for wall, *_ in walls:
            self.owner[wall] = cell
        if straight and own is not None:
            self.ends[own[0]][self.ends[own[0]].index(p)] = along[1]
            self.dropped.append(walls[0][0])
        self.ends.append([r, q] if (far < cell) == forward else [q, r])
        self.owner.append(min(far, cell))
        self.neighbor.append(max(far, cell))
        self.touched |= {cell, before, far}
        return True

    def _wall_at(self, cell: int, point: int) -> tuple[int, int] | None:
        """Return the face of `cell` on a wall that has the point as one end, and its other end."""
        faces = (f for f in self.faces_of(cell) if self.neighbor[f] < 0 and point in self.ends[f])
        return next(((f, self.ends[f][self.ends[f][0] == point]) for f in faces), None)

    def _tilt(self, cell: int, face: int, a: int, b: int) -> bool:
        """Tilt `face` from `a` to `b` of `cell`: each end moves along the wall face that begins there."""
        other = self.other(face, cell)
        if {cell, other} & self.touched or not (self.slides[a] and self.slides[b]):
            return False
        loops = {c: self.loop(c) for c in (cell, other)}
        begins = {side[1]: side for c in loops for side in loops[c] if self.other(side[0], c) < 0}
        if a not in begins or b not in begins:
            return False
        saved, length = {x: self.points[x] for x in (a, b)}, np.hypot(*(self.points[b] - self.points[a]))
        for x in (a, b):
            way = self.points[begins[x][2]] - self.points[x]
            self.points[x] = self.points[x] + min(TILT * length / np.hypot(*way), MOST_TILT) * way
        if not all(self._is_convex([side[1] for side in loop]) for loop in loops.values()):
            for x, old in saved.items():
                self.points[x] = old
            return False
        self.touched |= {cell, other}
        return True

    def _is_convex(self, loop: list[int]) -> bool:
        """Return whether the points of `loop` are the corners of a convex polygon, straight ones allowed."""
        x = np.array([self.points[k] for k in loop])
        ahead = np.roll(x, -1, axis=0) - x
        turn = turns(x, np.roll(np.arange(len(x)), -1))
        return len(x) > 2 and bool((turn > -STRAIGHT).all() and (np.hypot(*ahead.T) > 0).all())

    def mesh(self) -> Faces:
        """Return the changed mesh."""
        owner, neighbor = np.array(self.owner, np.int32), np.array(self.neighbor, np.int32)
        inner = neighbor >= 0
        order = np.lexsort((np.where(inner, neighbor, owner), np.where(inner, owner, -1 - neighbor), ~inner))
        order = order[~np.isin(order, self.dropped)]
        count = len(order)
        return replace(
            self.old,
            points=np.array(self.points),
            corners=np.array(self.ends)[order].ravel(),
            starts=2 * np.arange(count + 1),
            owner=owner[order],
            neighbor=neighbor[order],
            twin=np.full(count, -1),
            shift=np.zeros((count, 2), np.int8),
            half_face=np.full(count, -1),
        ).compact()
