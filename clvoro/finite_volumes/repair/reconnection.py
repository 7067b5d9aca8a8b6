"""Other connections of the cells of a patch: a face vanishes, or goes to the two cells at its ends.

Points alone do not help where a cell has a sliver along a wall, ends near a wall between two others, or has a
re-entrant corner of the boundary in the middle of its wall. `repaired` tries all changes of the faces there, each
followed by moves of the points, and takes the one with the lowest price.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from ...geometry.ring_coordinate import RingCoordinate
from .figures import LENGTH_GOAL
from .patch import BORDER, Patch, part_of, restored
from .pricing import PricedPatch
from .tasks import Move, Task, in_step
from .wall_corners import WallCorners, WallEdges

_OPENED = 0.25
"""Length of a new face over the size of its smallest cell."""
_ROOM = 0.6
"""The same over that of the wall face from which it is taken, at most."""
_TRIED = 0.5
"""Faces shorter than this over the size of the smaller cell are tried near those beyond a limit."""
_GAIN = 0.1
"""Least gain of a change, over the price of the cells that it is for."""
_SMALL = 1.5e-3
"""Price of a place at which faces remain as they are: a face there has less than 20 degrees and a skewness below 2."""
_RINGS = 5
"""Rings of cells around a bad place that are regarded."""
_TRIES = (1, 3)
"""Rings of cells whose points move before faces change."""
_FIRST_STEPS, _SECOND_STEPS, _STEPS = 2, 7, 15
"""Most steps of descent after each change, after the `_GOOD` best ones, and after the `_BEST` of these."""
_GOOD, _BEST = 10, 3
_MOST = 100
"""Most places that are regarded in a patch, the same ones again included."""


def repaired(given: PricedPatch, ring: RingCoordinate | None, walls: WallEdges | None = None) -> Task[PricedPatch]:
    """Find a patch of lower price: place by place points move, also along walls, and faces change.

    With the `walls` of the mesh only cells are regarded that OpenFOAM refuses, and corners of walls can be cut off.
    """
    left = np.ones(len(given.prices), bool)
    for _ in range(_MOST):
        bad = given.bad if walls is None else given.refused
        if not (left & bad).any():
            break
        worst = np.zeros(len(left), bool)
        worst[np.argmax(np.where(left & bad, given.prices, 0))] = True
        focus = given.near(worst, 2) & bad
        chosen = given.near(focus, _RINGS)
        local = PricedPatch.of(part_of(given.patch, chosen), given.goals[chosen])
        assert local is not None
        near = focus[chosen]
        best = yield from _settled(local, near, _TRIES, _STEPS)
        if best.prices[best.near(near, 2) & best.bad].sum() > _SMALL:
            beside = walls and walls.beside(given.patch.cells[chosen], local.patch.points)
            best = yield from _changed(best, near, ring, beside)
        if walls is not None and best.refused.sum() >= local.refused.sum():
            best = local
        if local.price - best.price < _GAIN * given.prices[focus].sum():
            left &= ~focus
        if best is not local:
            made = PricedPatch.of(restored(given.patch, best.patch), given.goals)
            assert made is not None
            given = made
    return given


def _changed(
    given: PricedPatch, focus: np.ndarray, ring: RingCoordinate | None, walls: WallEdges | None
) -> Task[PricedPatch]:
    """Find the best of a patch and those with one change for the cells `focus` (n,) bool; if none helps, with two."""
    first = yield from _best_changes(given, focus, ring, walls)
    enough = given.price - _GAIN * given.prices[focus].sum()
    if first and first[0].price > enough:
        second = yield from in_step([_best_changes(made, focus, ring, walls) for made in first])
        first = sorted([*first, *(made for some in second for made in some[:1])], key=_price)
    return min([given, *first[:1]], key=_price)


def _price(given: PricedPatch) -> float:
    return given.price


def _best_changes(
    given: PricedPatch, focus: np.ndarray, ring: RingCoordinate | None, walls: WallEdges | None
) -> Task[list[PricedPatch]]:
    """Find the best of the patches with one change for the cells `focus` (n,) bool, the best one first."""
    c = given.cells
    bent = np.zeros(len(given.patch.points), bool)
    bent[c.loop[given.bent]] = True
    tried = (given.lengths < _TRIED) | (given.face_prices > 0) | bent[c.ends].any(axis=1)
    tried &= focus[c.owner] | focus[c.neighbor]
    # A cell with a single neighbor gets another one if the cell beside it leaves the wall.
    narrow = np.bincount(c.row, c.between, len(c.area)) < 2
    beside = np.zeros(len(given.patch.points), bool)
    beside[c.loop[(narrow & focus)[c.row]]] = True
    tried |= c.wall & beside[c.ends].any(axis=1)
    connections = _Connections(given, ring)
    changes = [connections.changes(face) for face in c.faces[tried].tolist()]
    if walls is not None:
        changes.append(WallCorners(given, walls).changes(given.near(focus, 1)))
    made = [PricedPatch.of(patch, given.goals) for patch in chain.from_iterable(changes)]
    found = yield from in_step([_settled(patch, focus, (1,), _FIRST_STEPS) for patch in made if patch is not None])
    good = yield from _each_settled(sorted(found, key=_price)[:_GOOD], focus, (1,), _SECOND_STEPS)
    return (yield from _each_settled(good[:_BEST], focus, (2, 3), _STEPS))


def _each_settled(
    some: list[PricedPatch], focus: np.ndarray, rings: tuple[int, ...], steps: int
) -> Task[list[PricedPatch]]:
    """Settle patches one by one up to the first without a bad cell; return them with the lowest price first."""
    found: list[PricedPatch] = []
    for made in some:
        found.append((yield from _settled(made, focus, rings, steps)))
        if not found[-1].bad.any():
            break
    return sorted(found, key=_price)


def _settled(made: PricedPatch, focus: np.ndarray, rings: tuple[int, ...], steps: int) -> Task[PricedPatch]:
    """Return the patch after moves of points at and around the cells near `focus` (n,) bool that have a price."""
    for k in rings:
        priced = (made.prices > 0) & made.near(focus, 2)
        if not priced.any():
            break
        (now,) = yield [Move(made, made.near(priced, k), True, steps)]
        made = now if now.price < made.price else made
    return made


class _Connections:
    """What can become of the faces of a patch."""

    def __init__(self, given: PricedPatch, ring: RingCoordinate | None) -> None:
        self.patch, self.ring, self.sizes = given.patch, ring, given.goals[:, 1]
        self.on_wall = self.patch.on_walls
        self.faces_at: list[list[int]] = [[] for _ in self.patch.points]
        for face, ends in enumerate(self.patch.ends.tolist()):
            for end in ends:
                self.faces_at[end].append(face)

    def changes(self, face: int) -> Iterator[Patch]:
        """Yield what can become of a face."""
        p = self.patch
        if p.neighbor[face] == BORDER or p.held[p.ends[face]].any():
            return
        yield from self._collapsed(face)
        yield from self._flipped(face) if p.neighbor[face] >= 0 else self._closed(face)

    def _collapsed(self, face: int) -> Iterator[Patch]:
        """Yield the patch in which both ends of a face are one point; fixed points stay, and those on walls on them."""
        p, ring = self.patch, self.ring
        a, b = p.ends[face].tolist()
        rank = [2 * int(p.fixed[x]) + int(self.on_wall[x]) for x in (a, b)]
        is_wall = p.neighbor[face] < 0
        if min(rank) > 1 or (min(rank) > 0 and not is_wall):
            return
        if rank[0] < rank[1]:
            a, b = b, a
        points, positions, ends = p.points.copy(), p.positions.copy(), p.ends.copy()
        if rank[0] == rank[1]:
            if is_wall and ring is not None:
                s, t = positions[[a]], positions[[b]]
                positions[[a]] = ring.moved(s, ring.way(s, t) / 2)
                points[[a]] = ring.points(positions[[a]])
            else:
                points[a] = (points[a] + points[b]) / 2
        ends[ends == b] = a
        kept = np.arange(len(ends)) != face
        yield replace(
            p,
            points=points,
            positions=positions,
            ends=ends[kept],
            owner=p.owner[kept],
            neighbor=p.neighbor[kept],
            half_face=p.half_face[kept],
            aim=p.aim[kept],
        )

    def _beside(self, face: int, end: int, cell: int) -> int:
        """Return the other face of a cell at an end of one of its faces."""
        p = self.patch
        return next(f for f in self.faces_at[end] if f != face and cell in (p.owner[f], p.neighbor[f]))

    def _beyond(self, face: int, cell: int) -> int:
        """Return the cell across a face; a negative number if there is none."""
        p = self.patch
        return int(p.neighbor[face] if p.owner[face] == cell else p.owner[face])

    def _between(self, face: int, owner: int, neighbor: int, **changed: np.ndarray) -> Patch:
        """Return the patch with the `changed` arrays and `face` between two cells, or a cell and a wall."""
        p = self.patch
        made = replace(
            p,
            owner=p.owner.copy(),
            neighbor=p.neighbor.copy(),
            half_face=p.half_face.copy(),
            aim=p.aim.copy(),
            **changed,
        )
        made.owner[face], made.neighbor[face] = owner, neighbor
        made.half_face[face], made.aim[face] = -1, LENGTH_GOAL
        return made

    def _flipped(self, face: int) -> Iterator[Patch]:
        """Yield the patch in which a face is between the cells at its ends; at a wall it becomes a wall."""
        p = self.patch
        a, b = p.ends[face].tolist()
        left, right = int(p.owner[face]), int(p.neighbor[face])
        if self.on_wall[a]:
            a, b, left, right = b, a, right, left
        if self.on_wall[a] or len(self.faces_at[a]) != 3 or len(self.faces_at[b]) != 3:
            return
        # The cell `left` is on the left of the way from a to b.
        left_a, right_a = self._beside(face, a, left), self._beside(face, a, right)
        left_b, right_b = self._beside(face, b, left), self._beside(face, b, right)
        first = self._beyond(left_a, left)
        if first < 0:
            return
        if self.on_wall[b]:
            yield from self._opened(face, (a, b), first, (right_a, left_a), (right_b, left_b))
            return
        last = self._beyond(left_b, left)
        if last < 0 or last == first:
            return
        along = p.points[b] - p.points[a]
        aside = np.array([-along[1], along[0]]) / max(np.hypot(*along), 1e-300)
        aside *= _OPENED / 2 * self.sizes[[left, right, first, last]].min()
        middle = (p.points[a] + p.points[b]) / 2
        points, ends = p.points.copy(), p.ends.copy()
        # Point a goes to the left, b to the right. On the way from b to a the cell at a is on the left.
        points[a], points[b] = middle + aside, middle - aside
        ends[right_a][ends[right_a] == a] = b
        ends[left_b][ends[left_b] == b] = a
        ends[face] = (b, a) if first < last else (a, b)
        yield self._between(face, min(first, last), max(first, last), points=points, ends=ends)

    def _opened(
        self, face: int, ends_of_face: tuple[int, int], cell: int, inner: tuple[int, int], walls: tuple[int, int]
    ) -> Iterator[Patch]:
        """Yield the patch in which the cell at the inner end of a face has a wall face at the other end.

        Parameters
        ----------
        face : int
        ends_of_face : (int, int)
            Its end inside and that on the wall.
        cell : int
        inner, walls : (int, int)
            The other faces at both ends: that at the cell before the face along the wall first.
        """
        p, ring = self.patch, self.ring
        a, b = ends_of_face
        if ring is None or p.neighbor[walls[0]] >= 0 or p.neighbor[walls[1]] >= 0:
            return
        s, reach = p.positions[b], _OPENED * self.sizes[cell]
        room = [_ROOM * np.hypot(*np.diff(p.points[p.ends[f]], axis=0)[0]) for f in walls]
        for back, on in ((0.5, 0.5), (1.0, 0.0), (0.0, 1.0)):
            if p.fixed[b] and back and on:
                continue
            far = np.array([-min(back * reach, room[0]), min(on * reach, room[1])])
            # Point b stays at one end of the new face, or both move; a becomes the other.
            pair = (a, b) if back else (b, a)
            points, positions, ends = p.points.copy(), p.positions.copy(), p.ends.copy()
            moved = [k for k in range(2) if far[k] != 0]
            at = [pair[k] for k in moved]
            positions[at] = ring.moved(np.full(len(at), s), far[moved])
            points[at] = ring.points(positions[at])
            for k in range(2):
                ends[inner[k]][ends[inner[k]] == a] = pair[k]
                ends[walls[k]][ends[walls[k]] == b] = pair[k]
            ends[face] = pair
            wall = int(p.neighbor[walls[0 if back else 1]])
            yield self._between(face, cell, wall, points=points, positions=positions, ends=ends)

    def _closed(self, face: int) -> Iterator[Patch]:
        """Yield the patch in which a cell has left the wall, and the cells beside it there share a face."""
        p = self.patch
        cell, ends_of_face = int(p.owner[face]), p.ends[face].tolist()
        inner = [self._beside(face, x, cell) for x in ends_of_face]
        first, last = (self._beyond(f, cell) for f in inner)
        if min(first, last) < 0 or first == last:
            return
        far = [int(p.ends[f].sum()) - x for f, x in zip(inner, ends_of_face, strict=True)]
        for stays, goes in (ends_of_face, ends_of_face[::-1]):
            if p.fixed[goes]:
                continue
            points, positions, ends = p.points.copy(), p.positions.copy(), p.ends.copy()
            into = points[far].mean(axis=0) - points[stays]
            points[goes] = points[stays] + into * min(1.0, _OPENED * self.sizes[cell] / max(np.hypot(*into), 1e-300))
            positions[goes] = np.nan
            ends[ends == goes] = stays
            for f in inner:
                ends[f][ends[f] == stays] = goes
            # On the way from the wall into the domain, the first cell along the wall is on the left.
            ends[face] = (stays, goes) if first < last else (goes, stays)
            yield self._between(face, min(first, last), max(first, last), points=points, positions=positions, ends=ends)
