"""Changes of a patch at walls, for cells that OpenFOAM refuses and no other change helps.

A cell is concave at a corner between two of its wall faces, as at the tip of a spit whose two corners are less than a
cell apart. Either the nearest face end along the wall moves into it, or a chord cuts it off. In a dead end the last
cell has one neighbor. It gets another one if the cell beside it leaves the wall.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .figures import LENGTH_GOAL
from .patch import Patch

if TYPE_CHECKING:
    from .pricing import PricedPatch

_STEPS = 4
"""Most wall faces that go to another cell at a time."""
_OPENED = 0.25
"""Length of a new face over the size of the cell that leaves the wall."""
_FARTHEST = 1.0
"""Farthest corner that is cut off, as its distance from the chord over the size of the cell."""


class CornerCut(NamedTuple):
    """A corner of a wall that has been cut off.

    Attributes
    ----------
    x, y : float
    far : float
        Distance from the chord.
    size : float
        Of the cell.
    """

    x: float
    y: float
    far: float
    size: float


@dataclass(frozen=True)
class WallEdges:
    """The walls of a mesh.

    Attributes
    ----------
    ends : (w, 2, 2) float
    owner : (w,) int
    parts : (k,) int
        Index of the named part of the boundary for each wall of the domain.
    """

    ends: np.ndarray
    owner: np.ndarray
    parts: np.ndarray

    def beside(self, cells: np.ndarray, points: np.ndarray) -> WallEdges:
        """Return the walls of other cells than `cells` (n,) that are near `points` (v, 2)."""
        low, high = points.min(axis=0), points.max(axis=0)
        near = (self.ends.max(axis=1) >= low).all(axis=1) & (self.ends.min(axis=1) <= high).all(axis=1)
        near &= ~np.isin(self.owner, cells)
        return replace(self, ends=self.ends[near], owner=self.owner[near])


class WallCorners:
    """Changes of a patch at its walls, for cells that are concave or have fewer than two neighbors.

    Attributes
    ----------
    given : PricedPatch
    patch : Patch
    walls : WallEdges
        Those of other cells.
    """

    def __init__(self, given: PricedPatch, walls: WallEdges) -> None:
        self.given, self.patch, self.walls = given, given.patch, walls
        self.sizes, self.is_wall = given.goals[:, 1], given.patch.walls
        self.faces_at: list[list[int]] = [[] for _ in self.patch.points]
        for face, ends in enumerate(self.patch.ends.tolist()):
            for end in ends:
                self.faces_at[end].append(face)

    def changes(self, near: np.ndarray) -> Iterator[Patch]:
        """Yield what can become of the walls of the cells `near` (n,) bool."""
        c = self.given.cells
        for point in np.unique(c.loop[self.given.bent & near[c.row]]).tolist():
            if not self.patch.held[point] and self._bound(self.patch, point):
                for face in self.faces_at[point]:
                    yield from self._entered(point, face)
                yield from self._cut(point)
        for cell in np.flatnonzero(near).tolist():
            yield from self._left(cell)

    def _bound(self, patch: Patch, point: int) -> bool:
        """Return whether a point has two wall faces of one cell, and no other faces."""
        if patch is self.patch:
            faces = self.faces_at[point]
        else:
            faces = np.flatnonzero((patch.ends == point).any(axis=1)).tolist()
        if len(faces) != 2:
            return False
        return bool(patch.walls[faces].all()) and patch.owner[faces[0]] == patch.owner[faces[1]]

    def _beyond(self, face: int, cell: int) -> int:
        """Return the cell across a face; a negative number if there is none."""
        p = self.patch
        return int(p.neighbor[face] if p.owner[face] == cell else p.owner[face])

    def _entered(self, point: int, face: int) -> Iterator[Patch]:
        """Yield the patch in which the next face end along the wall, beyond `face`, has moved into corner `point`."""
        p = self.patch
        cell, taken, end = int(p.owner[face]), [face], int(p.ends[face].sum()) - point
        while self._bound(p, end) and len(taken) < _STEPS:
            taken.append(next(f for f in self.faces_at[end] if f != taken[-1]))
            end = int(p.ends[taken[-1]].sum()) - end
        inner = [f for f in self.faces_at[end] if not self.is_wall[f]]
        if p.held[end] or len(self.faces_at[end]) != 3 or len(inner) != 1:
            return
        side = inner[0]
        other = self._beyond(side, cell)
        if other < 0 or cell not in (p.owner[side], p.neighbor[side]):
            return
        made = self._with_walls(taken, other)
        made.ends[side][made.ends[side] == end] = point
        yield self._smooth(made, [end])

    def _with_walls(self, faces: list[int], cell: int) -> Patch:
        """Return a copy of the patch in which the wall faces `faces` belong to `cell`."""
        p = self.patch
        made = replace(p, ends=p.ends.copy(), owner=p.owner.copy(), half_face=p.half_face.copy(), aim=p.aim.copy())
        made.owner[faces], made.half_face[faces], made.aim[faces] = cell, -1, LENGTH_GOAL
        return made

    def _smooth(self, patch: Patch, points: list[int]) -> Patch:
        """Return the patch without those of `points` that are no corners of the boundary and have no face end."""
        for point in points:
            if not patch.fixed[point] and self._bound(patch, point):
                patch = _without(patch, point)
        return patch

    def _left(self, cell: int) -> Iterator[Patch]:
        """Yield the patch in which a cell has left a wall, and the cells beside it there share a face.

        The cell had some wall faces, or only a point. The new face begins in one of their ends.
        """
        c, p = self.given.cells, self.patch
        at = slice(c.starts[cell], c.starts[cell + 1])
        sides, loop = self.given.sides[at].tolist(), c.loop[at].tolist()
        count, on_wall = len(sides), p.on_walls
        for k, point in enumerate(loop):
            before = sides[k - 1]
            if self.is_wall[before] or not on_wall[point]:
                continue
            run = [point]
            while self.is_wall[sides[(k + len(run) - 1) % count]]:
                run.append(loop[(k + len(run)) % count])
            taken = [sides[(k + i) % count] for i in range(len(run) - 1)]
            behind = sides[(k + len(taken)) % count]
            first, last = self._beyond(before, cell), self._beyond(behind, cell)
            if len(taken) > _STEPS or min(first, last) < 0 or first == last or p.held[run].any():
                continue
            pair = (min(first, last), max(first, last))
            if ((p.owner == pair[0]) & (p.neighbor == pair[1])).any():
                continue
            far = [int(p.ends[before].sum()) - point, int(p.ends[behind].sum()) - run[-1]]
            for i, stays in enumerate(run):
                into = p.points[far].mean(axis=0) - p.points[stays]
                reach = _OPENED * self.sizes[cell] / max(np.hypot(*into), 1e-300)
                new, made = len(p.points), self._with_walls(taken, last)
                made.owner[taken[:i]] = first
                made.ends[before][made.ends[before] == point] = new
                made.ends[behind][made.ends[behind] == run[-1]] = new
                # On the way from the wall into the domain, the first cell along the wall is on the left.
                ends = (stays, new) if first < last else (new, stays)
                made = replace(
                    made,
                    points=np.concatenate([p.points, [p.points[stays] + into * min(1.0, reach)]]),
                    ids=np.append(p.ids, -1),
                    ends=np.concatenate([made.ends, [ends]]),
                    owner=np.append(made.owner, pair[0]),
                    neighbor=np.append(made.neighbor, pair[1]),
                    half_face=np.append(made.half_face, -1),
                    aim=np.append(made.aim, LENGTH_GOAL),
                    held=np.append(p.held, False),
                    fixed=np.append(p.fixed, False),
                    positions=np.append(p.positions, np.nan),
                )
                yield self._smooth(made, [x for x in run if x != stays])

    def _cut(self, point: int) -> Iterator[Patch]:
        """Yield the patch in which a chord cuts off a corner."""
        p = self.patch
        faces = self.faces_at[point]
        parts = self.walls.parts[-1 - p.neighbor[faces]]
        a, b = (int(p.ends[f].sum()) - point for f in faces)
        if parts[0] != parts[1] or a == b:
            return
        x = p.points[[a, point, b]]
        chord, u = x[2] - x[0], x[1] - x[0]
        far = float(abs(chord[0] * u[1] - chord[1] * u[0]) / max(np.hypot(*chord), 1e-300))
        size = float(self.sizes[p.owner[faces[0]]])
        if far > _FARTHEST * size or self._obstructed((a, point, b), x):
            return
        yield replace(_without(p, point), cuts=(*p.cuts, CornerCut(float(x[1, 0]), float(x[1, 1]), far, size)))

    def _obstructed(self, corners: tuple[int, int, int], x: np.ndarray) -> bool:
        """Return whether another wall meets the triangle `x` (3, 2) of the points `corners`."""
        p = self.patch
        ends = p.ends[self.is_wall]
        own = np.isin(ends, corners)
        apart = ~own.any(axis=1)
        beside = ends[~apart & ~own.all(axis=1)]
        tips = p.points[beside[~np.isin(beside, corners)]]
        others = np.concatenate([self.walls.ends, p.points[ends[apart]], np.stack([tips, tips], axis=1)])
        return bool(_meet(x, others).any())


def _without(patch: Patch, point: int) -> Patch:
    """Return the patch without a point of the wall: its two wall faces become one."""
    p = patch
    first, last = np.flatnonzero((p.ends == point).any(axis=1)).tolist()
    if p.ends[first, 1] != point:
        first, last = last, first
    lengths = np.hypot(*(p.points[p.ends[[first, last], 1]] - p.points[p.ends[[first, last], 0]]).T)
    longer = (first, last)[int(np.argmax(lengths))]
    ends, neighbor, half, aim = p.ends.copy(), p.neighbor.copy(), p.half_face.copy(), p.aim.copy()
    ends[first, 1] = ends[last, 1]
    neighbor[first], half[first], aim[first] = neighbor[longer], half[longer], LENGTH_GOAL
    kept = np.arange(len(ends)) != last
    return replace(
        p, ends=ends[kept], owner=p.owner[kept], neighbor=neighbor[kept], half_face=half[kept], aim=aim[kept]
    )


def _meet(triangle: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Return which segments (k, 2, 2) have a point in a triangle (3, 2): no line separates the two."""
    along = np.roll(triangle, -1, axis=0) - triangle
    meet = np.ones(len(segments), bool)
    for direction in along:
        normal = np.array([-direction[1], direction[0]])
        s, t = segments @ normal, triangle @ normal
        meet &= (s.max(axis=1) >= t.min()) & (s.min(axis=1) <= t.max())
    way = segments[:, 1] - segments[:, 0]
    normals = np.stack([-way[:, 1], way[:, 0]], axis=1)
    heights = (triangle[None] - segments[:, :1]) @ normals[:, :, None]
    return meet & (heights.max(axis=1)[:, 0] >= 0) & (heights.min(axis=1)[:, 0] <= 0)
