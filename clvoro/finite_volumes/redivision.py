"""Cells in 2D that OpenFOAM rejects: each is divided anew, together with a neighbor.

The union of both cells is cut by another straight face. Where no cut of a union helps, the place of the cell is left
out of the mesh, and the cell gets a part of another one. So cells at dead ends and in channels that are one cell wide
have faces in two directions. Throats and needles that are narrower than a cell have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..connectivity import rows_of
from ..geometry.polygon import Polygon
from ..mesh.faces import Faces
from ..mesh.straightening import cross
from .gate import not_convex, rejected_polygons
from .measures import PlaneMeasures
from .short_edges import STRAIGHT

WORST = {"skewness": 3.5, "non_orthogonality": 60.0, "weight": 0.07, "volume_ratio": 0.015, "determinant": 2e-3}
"""Limits of the measures of cells after a cut, a little stricter than OpenFOAM's."""
SMALLER = ("weight", "volume_ratio", "determinant")
"""Measures with a lower limit; the others have an upper one."""
SHARES = (0.25, 0.5, 0.75)
"""Places on a side where a cut may end, as shares of its length; a cut may also end in corners."""
BESIDE = 0.05
"""Displacement of a new point on a face, over its length: away from the cell beyond, which stays convex."""
LEAST_SHARE = 0.15
"""Least area of each half of a cut polygon, as a share of the whole."""
FLAT, MOST_FILLED = 1e-3, 0.1
"""Largest turn to the left, in radians, of a wall that is made straight. Largest area that a polygon gains there, over
its own."""
MOVED = (1e-3, 0.02, 0.1)
"""Where corners go in which a cell is not convex: beyond the line between their neighbors, as shares of its length."""
SHARPEST = 0.1
"""Least sine of the angles between a cut and the sides on which it ends."""
TRIED = 24
"""Largest number of cuts of one polygon whose measures are computed: those with the roundest halves."""
FAR = 10
"""Number of nearest cells of which one may be cut for a rejected cell, if cuts of its neighbors do not help."""
ROUNDS = 16
"""Largest number of rounds in which bad cells are divided anew."""

Side = tuple[int, int, int]
"""First and last point of a side, counter-clockwise around its cell, and the cell beyond; on a wall -1 - wall."""
Loops = dict[int, list[Side]]
"""The sides of each cell, by its number."""


def redivide(mesh: Faces, parts: np.ndarray) -> Faces:
    """Return `mesh` with the cells that OpenFOAM rejects, and those of a small determinant, divided anew if it helps.

    - `mesh`: a mesh for solvers in 2D.
    - `parts` (k,) int: index of the named part of the boundary for each wall.
    """
    rejected = rejected_polygons(mesh) | (PlaneMeasures(mesh).determinant < WORST["determinant"])
    for _ in range(ROUNDS):
        if not rejected.any() or mesh.n_cells < 3:
            return mesh
        edit = _Edit(mesh, parts)
        for cell in np.flatnonzero(rejected).tolist():
            if cell not in edit.changed:
                edit.change(cell)
        if not edit.changed:
            return mesh
        mesh = edit.mesh()
        rejected = badness(mesh) > 1
    return mesh


def badness(mesh: Faces) -> np.ndarray:
    """Return how bad each cell is, (n,): the largest ratio of its measures, and those of its faces, to `WORST`.

    Cells above 1 are bad. Those that are not convex have inf.
    """
    m, worst = PlaneMeasures(mesh), np.zeros(mesh.n_cells)
    for name, limit in WORST.items():
        values = getattr(m, name)
        values = limit / np.maximum(values, 1e-12) if name in SMALLER else values / limit
        if name == "determinant":
            np.maximum(worst, values, out=worst)
            continue
        np.maximum.at(worst, mesh.owner, values)
        np.maximum.at(worst, mesh.neighbor[: mesh.n_inner], values[: mesh.n_inner])
    worst[not_convex(mesh, STRAIGHT / 2) | (m.areas <= 0)] = np.inf
    return worst


class _Cut(NamedTuple):
    """A cut of a polygon: the sides of both halves without the cut, its ends, and the places of new points.

    New points have negative numbers. The first half reaches from the first end along the outline to the second end.
    """

    first: list[Side]
    second: list[Side]
    ends: tuple[int, int]
    points: dict[int, np.ndarray]


class _Change(NamedTuple):
    """The sides of cells after a change, and places of points: moved ones, and new ones, with negative numbers."""

    loops: Loops
    points: dict[int, np.ndarray]


class _Edit:
    """Changes of single cells of a mesh, one after the other.

    - `points` list of (2,) float64: those of the mesh, and new ones.
    - `changed`: the sides that cells have now.
    """

    def __init__(self, mesh: Faces, parts: np.ndarray) -> None:
        self.old, self.parts = mesh, parts
        self.domain: Polygon = mesh.domain  # type: ignore[assignment]
        self.points = list(mesh.points)
        face = mesh.sides()[1]
        begin, end = mesh.side_ends()
        other = np.where(np.arange(len(face)) < len(mesh), mesh.neighbor[face], mesh.owner[face])
        self.sides = np.column_stack([begin, end, other])
        self.starts, self.rows = mesh.cell_faces()
        self.changed: Loops = {}

    def sides_of(self, cell: int) -> list[Side]:
        """Return the sides of `cell`, in their order around it if they are one loop."""
        if cell in self.changed:
            return self.changed[cell]
        sides = [tuple(s) for s in self.sides[self.rows[self.starts[cell] : self.starts[cell + 1]]].tolist()]
        after = {side[0]: side for side in sides}
        found = [sides[0]]
        while len(found) < len(sides) and found[-1][1] in after:
            found.append(after[found[-1][1]])
        return found if found[-1][1] == found[0][0] and len({s[0] for s in found}) == len(sides) else sides

    def change(self, cell: int) -> None:
        """Divide `cell` and another one anew, if that helps: a neighbor, or else one of the nearest cells."""
        near = sorted({side[2] for side in self.sides_of(cell) if side[2] >= 0} - {cell})
        if any(self._try(cell, near, partial(self._divided, union)) for union in (True, False)):
            return
        if self._try(cell, near[:1], self._moved):
            return
        order = np.argsort(((self.old.generators - self.old.generators[cell]) ** 2).sum(axis=1), kind="stable")
        far = [c for c in order[1:FAR].tolist() if c not in near]
        self._try(cell, far, partial(self._divided, False))

    def _try(self, cell: int, others: list[int], changes: Callable[[int, int, Loops], list[_Change]]) -> bool:
        """Make the best change of a cell and one of `others` if it leaves fewer bad cells; return whether it does.

        `changes` returns those to try, given both cells and the sides of all cells around them. The best one leaves
        the fewest bad cells, and of such changes has the best worst cell.
        """
        best: tuple[tuple[int, float], _Change] | None = None
        for other in others:
            local = self._around(cell, other)
            made = [_Change(local, {}), *changes(cell, other, local)]
            (count, _), *scores = self._scores(made, [cell, other])
            for (left, worst), change in zip(scores, made[1:], strict=True):
                if left < count and (best is None or (left - count, worst) < best[0]):
                    best = (left - count, worst), change
        if best is None:
            return False
        change = best[1]
        new = [name for name in change.points if name < 0]
        place = {name: len(self.points) + k for k, name in enumerate(new)}
        self.points += [change.points[name] for name in new]
        moved = change.points.keys() - new
        for name in moved:
            self.points[name] = change.points[name]
        for c, loop in change.loops.items():
            if loop != self.sides_of(c) or any(side[0] in moved for side in loop):
                self.changed[c] = [(place.get(a, a), place.get(b, b), other) for a, b, other in loop]
        return True

    def _divided(self, union: bool, cell: int, other: int, local: Loops) -> list[_Change]:
        """Return the cells `local` after each cut of the `union` of two cells, or of the other one alone.

        Then walls take the place of `cell`.
        """
        outline, walled = (self._union(cell, other), {}) if union else self._without(cell, other, local)
        cuts = self._cuts(self._straightened(outline)) if len(outline) > 2 else []
        return [self._changed(cell, other, cut, {**local, **walled}) for cut in cuts]

    def _moved(self, cell: int, other: int, local: Loops) -> list[_Change]:
        """Return the cells `local` with all corners moved where `cell` is not convex, once for each of `MOVED`."""
        del other
        loop, found = local[cell], []
        for share in MOVED:
            new: dict[int, np.ndarray] = {}
            for (a, p, _), (_, b, _) in zip(loop, [*loop[1:], loop[0]], strict=True):
                x, y, z = (new[k] if k in new else self.points[k] for k in (a, p, b))
                way = z - x
                off = (y - x)[0] * way[1] - (y - x)[1] * way[0]
                if off < STRAIGHT * (way @ way):
                    new[p] = y + (share - off / (way @ way)) * np.array([way[1], -way[0]])
            found += [_Change(local, new)] if new else []
        return found

    def _around(self, cell: int, other: int) -> Loops:
        """Return the sides of two cells and of their neighbors."""
        near = {side[2] for c in (cell, other) for side in self.sides_of(c) if side[2] >= 0}
        return {c: self.sides_of(c) for c in sorted(near | {cell, other})}

    def _union(self, cell: int, other: int) -> list[Side]:
        """Return the sides of the union of two cells; empty if it is no simple polygon."""
        found = []
        for a, b in ((cell, other), (other, cell)):
            loop = self.sides_of(a)
            inner = [side[2] == b for side in loop]
            first = [k for k in range(len(loop)) if inner[k - 1] and not inner[k]]
            if len(first) != 1:
                return []
            loop = loop[first[0] :] + loop[: first[0]]
            found += [side for side in loop if side[2] != b]
        closed = all(found[k - 1][1] == found[k][0] for k in range(len(found)))
        return found if closed and len({side[0] for side in found}) == len(found) else []

    def _without(self, cell: int, other: int, local: Loops) -> tuple[list[Side], Loops]:
        """Return the sides of `other`, and those of the neighbors of `cell`, with walls in place of `cell`."""
        loops: Loops = {}
        for near in {side[2] for side in local[cell] if side[2] >= 0}:
            loop = []
            for a, b, beyond in local[near]:
                if beyond == cell:
                    middle = (self.points[a] + self.points[b]) / 2
                    beyond = -1 - int(self.domain.closest_walls(middle[None])[0])
                loop.append((a, b, beyond))
            loops[near] = loop
        return loops.get(other, local[other]), loops

    def _changed(self, cell: int, other: int, cut: _Cut, loops: Loops) -> _Change:
        """Return the cells after a cut: `cell` and `other` get one half each, near their generators."""
        halves, (p, q) = (cut.first, cut.second), cut.ends
        places = {**cut.points, **{s[0]: self.points[s[0]] for half in halves for s in half if s[0] >= 0}}
        middles = np.array([np.mean([places[s[0]] for s in half], axis=0) for half in halves])
        x = self.old.generators[[cell, other]]
        if np.hypot(*(x - middles).T).sum() > np.hypot(*(x - middles[::-1]).T).sum():
            halves, (p, q) = halves[::-1], (q, p)
        made = {**loops, cell: [*halves[0], (q, p, other)], other: [*halves[1], (p, q, cell)]}
        # Cells beyond see other cells, and new points on their sides.
        beyond = [(b, a, name, near) for half, name in zip(halves, (cell, other), strict=True) for a, b, near in half]
        for near in {side[3] for side in beyond if side[3] >= 0}:
            ahead = {a: (a, b, name) for a, b, name, owner in beyond if owner == near}
            made[near] = []
            for a, b, behind in loops[near]:
                if behind not in (cell, other):
                    made[near].append((a, b, behind))
                    continue
                while a != b and a in ahead:
                    made[near].append(ahead[a])
                    a = ahead[a][1]
        return _Change(made, cut.points)

    def _straightened(self, outline: list[Side]) -> list[Side]:
        """Return a polygon without points between two walls where it is flat or not convex; see `MOST_FILLED`.

        Points stay where the named part changes.
        """
        found, k = list(outline), 0
        x = np.array([self.points[side[0]] for side in outline])
        most = MOST_FILLED * np.abs(cross(x - x[0], np.roll(x, -1, axis=0) - x[0]).sum())
        while k < len(found) and len(found) > 3:
            (a, b, wall), (_, d, after) = found[k - 1], found[k]
            u, v = self.points[b] - self.points[a], self.points[d] - self.points[b]
            turn = u[0] * v[1] - u[1] * v[0]
            same = wall < 0 and after < 0 and self.parts[-1 - wall] == self.parts[-1 - after]
            if same and -most < turn < FLAT * np.hypot(*u) * np.hypot(*v):
                found[k - 1] = (a, d, wall)
                del found[k]
                k = max(k - 1, 0)
            else:
                k += 1
        return found

    def _cuts(self, outline: list[Side]) -> list[_Cut]:
        """Return the cuts of a polygon into two convex halves, the roundest first.

        A cut ends in corners or in new points on sides. Its less round half counts: area over squared perimeter.
        """
        count, step = len(outline), len(SHARES) + 1
        corner = np.array([self.points[side[0]] for side in outline])
        way = np.roll(corner, -1, axis=0) - corner
        beyond = np.array([side[2] for side in outline])
        inner, walls = beyond >= 0, np.repeat(-1 - beyond[beyond < 0], len(SHARES))
        x = corner[:, None] + np.array([0, *SHARES])[:, None] * way[:, None]
        if self.domain.curves:
            x[~inner, 1:] = self.domain.on_curve(x[~inner, 1:].reshape(-1, 2), walls).reshape(-1, len(SHARES), 2)
        x[:, 1:] += (BESIDE * inner[:, None] * np.column_stack([-way[:, 1], way[:, 0]]))[:, None]
        x = x.reshape(-1, 2)
        ahead = np.repeat(way / np.maximum(np.hypot(*way.T), 1e-300)[:, None], step, axis=0)
        back = ahead.copy()
        back[::step] = np.roll(ahead[::step], 1, axis=0)
        bent = np.cumsum(cross(back, ahead) < np.where(np.arange(len(x)) % step == 0, STRAIGHT, -1.0))
        i, j = np.triu_indices(len(x), 1)
        sides = (j - 1) // step - i // step  # 0 if both ends are on one side
        apart = (sides > 0) & ~((i == 0) & (j // step == count - 1))
        i, j = i[apart], j[apart]
        cut = x[j] - x[i]
        length = np.maximum(np.hypot(*cut.T), 1e-300)
        cut /= length[:, None]
        sines = [cross(-cut, ahead[i]), cross(back[j], -cut), cross(cut, ahead[j]), cross(back[i], cut)]
        good = np.min(sines, axis=0) > SHARPEST
        good &= (bent[j - 1] == bent[i]) & (bent[-1] - bent[j] + np.where(i > 0, bent[i - 1], 0) == 0)
        along = np.roll(x, -1, axis=0) - x
        swept = np.append(0, np.cumsum(cross(x - x[0], x + along - x[0])))
        walked = np.append(0, np.cumsum(np.hypot(*along.T)))
        area = (swept[j] - swept[i] + cross(x[j] - x[0], x[i] - x[0])) / 2
        other = swept[-1] / 2 - area
        around = walked[j] - walked[i]
        round_ = np.minimum(area / (around + length) ** 2, other / (walked[-1] - around + length) ** 2)
        good &= np.minimum(area, other) >= LEAST_SHARE * (area + other)
        chosen = np.flatnonzero(good)
        found = []
        for k in chosen[np.argsort(-round_[chosen], kind="stable")][:TRIED].tolist():
            (first, f), (last, g) = divmod(int(i[k]), step), divmod(int(j[k]), step)
            a, b, near = outline[first]
            c, d, far = outline[last]
            p, q = -2 if f else a, -3 if g else c
            one = [(p, b, near), *outline[first + 1 : last], *([(c, q, far)] if g else [])]
            two = [(q, d, far), *outline[last + 1 :], *outline[:first], *([(a, p, near)] if f else [])]
            new = {name: place for name, place in ((p, x[i[k]]), (q, x[j[k]])) if name < 0}
            found.append(_Cut(one, two, (p, q), new))
        return found

    def _scores(self, meshes: list[_Change], judged: list[int]) -> list[tuple[int, float]]:
        """Return the number of bad cells among those `judged`, and the badness of the worst, of each of `meshes`."""
        names = sorted(meshes[0].loops)
        place = {c: k for k, c in enumerate(names)}
        x: list[np.ndarray] = []
        ends, owner, neighbor = [], [], []
        for number, (loops, new) in enumerate(meshes):
            base, known = number * len(names), {}
            for c, loop in loops.items():
                for a, b, other in loop:
                    if other > c or other not in place:
                        for p in (a, b):
                            if p not in known:
                                known[p] = len(x)
                                x.append(new[p] if p in new else self.points[p])
                        ends.append((known[a], known[b]))
                        owner.append(base + place[c])
                        neighbor.append(base + place[other] if other in place else -1)
        nowhere = np.zeros((len(meshes) * len(names), 2))
        made = _faces(self.old, nowhere, np.array(x), np.array(ends), np.array(owner), np.array(neighbor))
        worst = badness(made).reshape(len(meshes), len(names))[:, [place[c] for c in judged]]
        return [(int((row > 1).sum()), float(row.max())) for row in worst]

    def mesh(self) -> Faces:
        """Return the changed mesh."""
        cell = rows_of(self.starts)
        kept = ~np.isin(cell, list(self.changed))
        sides = [np.column_stack([cell, self.sides[self.rows]])[kept]]
        sides += [np.array([(c, *side) for side in loop]) for c, loop in self.changed.items()]
        owner, begin, end, other = np.concatenate(sides).T
        once = (other < 0) | (owner < other)
        ends = np.column_stack([begin, end])[once]
        generators = self.old.generators.copy()
        for c, loop in self.changed.items():
            x = np.array([self.points[side[0]] for side in loop])
            if (cross(np.roll(x, -1, axis=0) - x, generators[c] - x) < 0).any():
                generators[c] = x.mean(axis=0)
        points = np.array(self.points)
        return _faces(self.old, generators, points, ends, owner[once], other[once]).compact()


def _faces(
    old: Faces, generators: np.ndarray, points: np.ndarray, ends: np.ndarray, owner: np.ndarray, neighbor: np.ndarray
) -> Faces:
    """Return the mesh of faces with these `ends` (f, 2) and cells (f,). Inner faces come first, as in all meshes."""
    inner = neighbor >= 0
    order = np.lexsort((np.where(inner, neighbor, owner), np.where(inner, owner, -1 - neighbor), ~inner))
    return replace(
        old,
        generators=generators,
        points=points,
        corners=ends[order].ravel(),
        starts=2 * np.arange(len(order) + 1),
        owner=owner[order].astype(np.int32),
        neighbor=neighbor[order].astype(np.int32),
        twin=np.full(len(order), -1),
        shift=np.zeros((len(order), 2), np.int8),
        half_face=np.full(len(order), -1),
    )
