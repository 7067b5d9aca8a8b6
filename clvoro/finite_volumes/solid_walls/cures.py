"""The last step of a mesh of a solid: what makes single cells acceptable that OpenFOAM rejects.

A cell with a concave edge, as at a concave crease, is cut by a plane through it. Cells that are too flat or skew are
merged with a neighbor, edges collapsed, vertices moved. Each cure is tried, and kept only if fewer cells are rejected
than before.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from ...mesh.faces import Faces
from .editing import Edits, edges_of, judge
from .mend import rejected_at_walls
from .wall_surface import WallSurface

_SNAPS = (0.1, 0.03)
"""Vertices this near to the plane of a cut, over h, are in it; the less where a cut is impossible with the first."""
_FOLD = 0.02
"""Height of the fold in a face that a cut divides, over its length. In one plane its parts would count as concave."""
_REFLEX = 2.0
"""Least angle beyond 180 degrees of an edge at which a cell is cut."""
_ROOM = 3.0
"""Least angle, in degrees, between a cut and the continuation of a face at the edge."""
_PLANES = 10
"""Most planes through an edge that are tried."""
_EDGES = 3
"""Most concave edges of a cell that are tried."""
_LEAST_GAIN = 0.05
"""Least fall of `Verdict.excess` for which a mesh is changed."""
_FOLDED = 100.0
"""Least angle beyond 180 degrees of faces that are folded back."""
_SHORT = 0.25
"""Shorter edges, and faces with a smaller radius, over h, may be collapsed."""
_SMALL = 0.4
"""Cells with a smaller volume over h^3 may be merged with a neighbor, and all that are parts of others."""
_REACH = 0.3
"""Distance over h of a crease or corner to which a vertex may be moved."""
_SLIVER, _TIP, _FEW = 0.05, 0.4, 4
"""Cells with a smaller volume over h^3 may be left out; those with fewer neighbors than this may be larger."""
_TOO_MANY = 0.2
"""Where more than this share of the cells are rejected, the solid is as thin as a cell, and no cure is tried."""
_BUDGET, _MOST = 12, 400
"""Most changes of one rejected cell at a time, and most searches for cures of a mesh."""

_AHEAD = 1
"""How many further cures may follow one that does not help by itself."""
_BRANCHES, _MOST_BAD = 2, 3
"""How many such cures are followed, and for how many cells."""

Edge = tuple[int, int]
"""Both ends, the lower one first."""
Gain = tuple[int, float, float]
"""Change of the number of rejected cells, and of their excess; the worst measure after it. See `judge`."""


class Cures:
    """Tries cures on the rejected cells of a mesh.

    Parameters
    ----------
    surface : WallSurface
    faces : Faces
    sizes : (n,) float
        h of the cells.
    """

    def __init__(self, surface: WallSurface, faces: Faces, sizes: np.ndarray) -> None:
        self.surface, self.edits, self.sizes = surface, Edits(faces), sizes
        self.home: dict[int, int] = {}
        self.changes, self.searches, self.changed, self.tried = 0, 0, dict[int, int](), dict[int, int]()

    def h(self, cell: int) -> float:
        """Return the size of a cell."""
        return float(self.sizes[self.home.get(cell, cell)])

    def cure(self, cell: int) -> bool:
        """Change the mesh around a cell if it is rejected and this helps; return whether it does."""
        edits = self.edits
        if self.tried.get(cell) == self.stamp(cell) or not edits.faces_of(cell) or judge([(edits, [cell])])[0][0] == 0:
            return False
        if self.searches >= _MOST:
            return False
        for last in (False, True):
            self.searches += 1
            if (found := self._best(edits, cell, _AHEAD, last)) is not None:
                edits.take(found[1])
                self.changes += 1
                self.changed |= dict.fromkeys(found[1].touched, self.changes)
                return True
        self.tried[cell] = self.stamp(cell)
        return False

    def stamp(self, cell: int) -> int:
        """Return the number of the last change of a cell or a neighbor."""
        return max(self.changed.get(c, 0) for c in {cell, *self.edits.neighbors(cell)})

    def _best(self, edits: Edits, cell: int, ahead: int, last: bool) -> tuple[Gain, Edits] | None:
        """Return the best cure of a cell, or None if there is none.

        `ahead` cures may follow one that does not help. The `last` ones leave out a crease.
        """
        cures = [self.cuts, self.transfers, self.collapses, self.mergers, self.halves]
        cures += [self.unions, self.losses] if last else []
        trials = [t for cure in cures for t in cure(edits, cell)]
        trials = [t for t in trials if all(t.is_sound(c) for c in t.touched if not t.is_vast(c))]
        if not trials:
            return None
        around = edits.alive(set().union(*(t.touched for t in trials)))
        before = dict(zip(around, judge([(edits, around)])[0][0].tolist(), strict=True))
        cells = [t.alive(t.touched) for t in trials]
        verdicts = judge(list(zip(trials, cells, strict=True)))
        options = []
        for trial, mine, (excess, worst) in zip(trials, cells, verdicts, strict=True):
            old = [before.get(c, 0.0) for c in trial.touched]
            fewer = int((excess > 0).sum()) - sum(e > 0 for e in old)
            gain = (fewer, float(excess.sum()) - sum(old), float(worst.max(initial=0)))
            options.append((gain, trial, [c for c, e in zip(mine, excess.tolist(), strict=True) if e > 0]))
        gain, trial, _ = min(options, key=lambda o: o[0])
        if _helps(gain):
            return gain, trial
        if not ahead:
            return None
        for gain, trial, bad in sorted(options, key=lambda o: o[0][1])[:_BRANCHES]:
            for c in bad[:_MOST_BAD]:
                if trial.faces_of(c) and (further := self._best(trial, c, ahead - 1, last)) is not None:
                    trial.take(further[1])
                    gain = (gain[0] + further[0][0], gain[1] + further[0][1], max(gain[2], further[0][2]))
            if _helps(gain):
                return gain, trial
        return None

    # Cuts.

    def _concave_edges(self, edits: Edits, cell: int) -> list[tuple[float, Edge, int, int, np.ndarray]]:
        """Return the edges where a cell is concave: angle, ends, both faces, and the normal of the first, left, one.

        The largest angle comes first.
        """
        sides: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
        for k in edits.faces_of(cell):
            loop = edits.seen(k, cell)
            normal = _area(edits.positions(loop))
            normal /= max(float(np.linalg.norm(normal)), 1e-300)
            for edge in edges_of(loop):
                sides[edge] = k, normal
        found = []
        for (a, b), (left, one) in sides.items():
            right, other = sides.get((b, a), (-1, one))
            if a > b or right < 0:
                continue
            x, y = edits.point(a), edits.point(b)
            sine = float(np.cross(one, other) @ (y - x)) / max(float(np.linalg.norm(y - x)), 1e-300)
            turn = math.degrees(math.atan2(-sine, float(one @ other)))
            if turn > _REFLEX:
                found.append((turn, (a, b), left, right, one))
        return sorted(found, key=lambda f: -f[0])

    def cuts(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Cut a cell at a concave edge."""
        for turn, edge, _, right, one in self._concave_edges(edits, cell)[:_EDGES]:
            for normal in self._planes(edits, cell, turn, edge, one):
                for near in _SNAPS:
                    trial = edits.trial()
                    if self._divided(trial, cell, edge, right, normal, near * self.h(cell)):
                        yield trial
                        break

    def _planes(self, edits: Edits, cell: int, turn: float, edge: Edge, one: np.ndarray) -> list[np.ndarray]:
        """Return the normals of planes through a concave edge that leave less than 180 degrees on both sides.

        They point to the side of the face with the outward normal `one`, which is left of the edge.
        """
        x = edits.point(edge[0])
        along = edits.point(edge[1]) - x
        along /= np.linalg.norm(along)
        across, inward = np.cross(one, along), -one
        across -= (across @ along) * along
        across /= np.linalg.norm(across)
        inward = np.cross(along, across) if np.cross(along, across) @ inward > 0 else -np.cross(along, across)
        least, most = math.radians(turn + _ROOM), math.radians(180 - _ROOM)
        middle = math.radians(180 + turn) / 2
        if least > most:
            angles = [middle]
        else:
            arms = edits.positions(sorted(edits.vertices(cell) - set(edge))) - x
            far = np.hypot(arms @ across, arms @ inward) > 0.2 * self.h(cell)
            at = np.arctan2(arms @ inward, arms @ across)[far] % (2 * math.pi)
            at = at[(at >= least) & (at <= most)]
            at = at[np.argsort(np.abs(at - middle))][: _PLANES - 5]
            angles = [middle, *at.tolist(), *(least + s * (most - least) for s in (0, 0.25, 0.75, 1))]
        return [math.sin(t) * across - math.cos(t) * inward for t in angles]

    def _divided(
        self, edits: Edits, cell: int, edge: tuple[int, int], below: int, normal: np.ndarray, snap: float
    ) -> bool:
        """Cut a cell by the plane through a concave edge into two parts; return False if there are not two.

        The face `below` lies right of the edge, on the lower side of the plane. Vertices near the plane are in it, and
        count as above. So the section leads along edges of the cell whose other end is below.
        """
        x0 = edits.point(edge[0])
        vertices = sorted(edits.vertices(cell))
        heights = dict(zip(vertices, ((edits.positions(vertices) - x0) @ normal).tolist(), strict=True))
        flat = {v for v, d in heights.items() if abs(d) < snap} | set(edge)
        up = {v for v, d in heights.items() if d > 0} | flat
        beside = {v for pair in edges_of(edits.face(below)[2]) if set(pair) & set(edge) for v in pair} - set(edge)
        beside = {v for v in beside if heights[v] < 2 * snap}
        up, flat = up - beside, flat - beside
        loops = {k: edits.seen(k, cell) for k in edits.faces_of(cell)}
        chords: dict[int, list[tuple[Edge, Edge]]] = {}
        at: dict[Edge, list[int]] = {}
        for k, loop in loops.items():
            chords[k] = self._chords(edits, loop, up, flat, normal, heights)
            for pair in chords[k]:
                for key in pair:
                    at.setdefault(key, []).append(k)
        first = [pair for pair in chords[below] if any(set(key) & set(edge) for key in pair)]
        if not first or any(len(faces) != 2 for faces in at.values()):
            return False
        # Follow the section through the faces.
        k, (here, there) = below, first[0]
        path = [(k, here, there)]
        first = here
        while there != first:
            here = there
            one, other = at[here]
            k = other if k == one else one
            there = next(q if p == here else p for p, q in chords[k] if here in (p, q))
            path.append((k, here, there))
            if len(path) > len(at):
                return False
        number: dict[Edge, int] = {}
        for _, key, _ in path:
            p, q = key if key[0] in up else key[::-1]
            if p in flat:
                number[key] = p
            else:
                high, deep = max(heights[p], 1e-9 * snap), max(-heights[q], 1e-9 * snap)
                share = high / (high + deep)
                place = (1 - share) * edits.point(p) + share * edits.point(q)
                number[key] = edits.divide_edge(cell, p, q, self._on_surface(edits, cell, p, q, place))
        section: list[int] = []
        parts_of: dict[int, list[tuple[int, ...]]] = {}
        for k, begin, end in path:
            i, j = number[begin], number[end]
            section.append(i)
            after: list[int] = []
            if i == j:
                continue
            loop = edits.seen(k, cell)
            if k in parts_of or i not in loop or j not in loop:
                return False
            p, q = loop.index(i), loop.index(j)
            forth, back = _between(loop, p, q), _between(loop, q, p)  # from i to j, and on
            higher, swap = (forth, False) if not any(v in heights and v not in up for v in forth) else (back, True)
            if flat.issuperset(higher):  # the section follows its sides
                section += (higher[::-1] if swap else higher)[1:-1]
                continue
            if k == below:  # which may also go on beyond the edge
                if i in edge and (forth[1] in edge or back[-2] in edge):
                    i = next(v for v in edge if v != i)
                    section.append(i)
                elif j in edge and (back[1] in edge or forth[-2] in edge):
                    last = j
                    j = next(v for v in edge if v != j)
                    after = [j, last]
                p, q = loop.index(i), loop.index(j)
                forth, back = _between(loop, p, q), _between(loop, q, p)
            middle = []
            if edits.across(k, cell) >= 0:
                middle = [edits.add_point(self._fold(edits, loop, i, j, normal))]
            parts_of[k] = [(*forth, *middle[::-1]), (*back, *middle)]
            section += middle + after
        section = [v for k, v in enumerate(section) if v != section[k - 1]]
        if len(section) < 3 or len(set(section)) != len(section):
            return False
        # Which parts of faces are on which side of the section?
        border = set(edges_of(tuple(section)))
        border |= {(q, p) for p, q in border}
        if edge not in border:
            return False
        pieces: list[tuple[int, int, tuple[int, ...]]] = []
        for k in edits.faces_of(cell):
            pieces += [(k, edits.across(k, cell), loop) for loop in parts_of.get(k, [edits.seen(k, cell)])]
        side = _components([loop for *_, loop in pieces], border)
        if max(side) != 1:
            return False
        upper = next(s for s, (*_, loop) in zip(side, pieces, strict=True) if edge in edges_of(loop))
        open_edges = {e for s, (_, _, loop) in zip(side, pieces, strict=True) if s == upper for e in edges_of(loop)}
        floor = tuple(section)
        if any((q, p) not in open_edges for p, q in edges_of(floor)):
            floor = floor[::-1]
            if any((q, p) not in open_edges for p, q in edges_of(floor)):
                return False
        new = edits.add_cell()
        self.home[new] = self.home.get(cell, cell)
        over = cell >= edits.mesh.n_cells or (edits.mesh.generators[cell] - x0) @ normal > 0
        mine = upper if over else 1 - upper
        for k in parts_of:
            edits.drop(k)
        for s, (k, n, loop) in zip(side, pieces, strict=True):
            if k in parts_of:
                edits.add(cell if s == mine else new, n, loop)
            elif s != mine:
                edits.drop(k)
                edits.put(k, new, n, loop)
        edits.add(cell if mine == upper else new, new if mine == upper else cell, floor)
        return True

    @staticmethod
    def _chords(
        edits: Edits, loop: tuple[int, ...], up: set[int], flat: set[int], normal: np.ndarray, heights: dict[int, float]
    ) -> list[tuple[Edge, Edge]]:
        """Return the lines in which a plane cuts a face, from edge to edge of the face."""
        ends = [(p, q) for p, q in edges_of(loop) if (p in up) != (q in up)]
        keys = [(min(e), max(e)) for e in ends]
        if len(ends) > 2:
            x = edits.positions(loop)
            along = np.cross(_area(x), normal)
            at = []
            for p, q in ends:
                share = abs(heights[p]) / max(abs(heights[p]) + abs(heights[q]), 1e-300)
                at.append(float(((1 - share) * edits.point(p) + share * edits.point(q)) @ along))
            keys = [keys[k] for k in np.argsort(at, kind="stable").tolist()]
        return list(zip(keys[::2], keys[1::2], strict=True))

    def _fold(self, edits: Edits, loop: tuple[int, ...], i: int, j: int, normal: np.ndarray) -> np.ndarray:
        """Return the middle of the line across a face that is divided, moved into the cell that is cut."""
        x, y = edits.point(i), edits.point(j)
        out = _area(edits.positions(loop))
        out -= (out @ normal) * normal
        out /= max(float(np.linalg.norm(out)), 1e-300)
        return (x + y) / 2 - _FOLD * float(np.linalg.norm(y - x)) * out

    def _on_surface(self, edits: Edits, cell: int, a: int, b: int, x: np.ndarray) -> np.ndarray:
        """Return a point on the edge from a to b, moved onto the patch or the crease that has the edge."""
        found = self._placed(edits.patches_at(cell, a, b), x, self.h(cell))
        return x if found is None else found

    def _placed(self, walls: set[int], x: np.ndarray, h: float) -> np.ndarray | None:
        """Return x moved onto all of the `walls` (negative numbers), or None if they do not meet near it."""
        patches = {-1 - n for n in walls}
        if not patches:
            return x
        if len(patches) == 1:
            triangle, foot, _ = self.surface.closest(x[None])
            return foot[0] if int(self.surface.patch[triangle[0]]) in patches else None
        if len(patches) == 2:
            one, other = (np.array([p]) for p in sorted(patches))
            edge, foot = self.surface.nearest_crease(x[None], np.array([_REACH * h]), (one, other))
            return foot[0] if edge[0] >= 0 else None
        far = np.linalg.norm(self.surface.corners - x, axis=1)
        for c in np.flatnonzero(far < _REACH * h).tolist():
            if patches <= set(self.surface.patches_of(self.surface.first_corner + c)):
                return self.surface.corners[c]
        return None

    # Other cures.

    def transfers(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Give a face of a cell that is folded back onto another one to the cell behind that."""
        for turn, _, left, right, _ in self._concave_edges(edits, cell)[: 2 * _EDGES]:
            if turn < _FOLDED:
                continue
            for given, kept in ((left, right), (right, left)):
                beyond = edits.across(kept, cell)
                if beyond < 0:
                    continue
                trial = edits.trial()
                loop = _joined(trial.seen(given, cell), trial.seen(kept, cell))
                if loop is None:
                    continue
                other, turned = trial.across(given, cell), trial.seen(given, cell)
                trial.drop(given)
                trial.drop(kept)
                trial.add(cell, beyond, loop)
                if other != beyond:
                    trial.add(beyond, other, turned)
                    yield trial

    def collapses(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Collapse a short edge or a small face of a cell."""
        h = self.h(cell)
        groups: set[frozenset[int]] = set()
        for k in edits.faces_of(cell):
            loop = edits.face(k)[2]
            x = edits.positions(loop)
            length = np.linalg.norm(x - np.roll(x, -1, axis=0), axis=1)
            groups |= {frozenset(e) for e, far in zip(edges_of(loop), length.tolist(), strict=True) if far < _SHORT * h}
            if np.linalg.norm(x - x.mean(axis=0), axis=1).max() < _SHORT * h:
                groups.add(frozenset(loop))
        for group in sorted(groups, key=sorted):
            vertices = sorted(group)
            walls = [edits.patches_at(cell, v) for v in vertices]
            every = set().union(*walls)
            x = edits.positions(vertices)
            held = [k for k, w in enumerate(walls) if w == every]
            targets = [x[k] for k in held] if every else [x.mean(axis=0)]
            if not held:
                place = self._placed(every, x.mean(axis=0), h)
                targets = [] if place is None else [place]
            for target in targets[:3]:
                trial = edits.trial()
                _collapse(trial, cell, vertices, target)
                yield trial

    def mergers(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Merge a cell with a neighbor."""
        for other in edits.alive(edits.neighbors(cell)):
            for gone, left in ((cell, other), (other, cell)):
                if gone >= edits.mesh.n_cells or self._volume(edits, gone) < _SMALL * self.h(gone) ** 3:
                    trial = edits.trial()
                    if _merge(trial, gone, left):
                        yield trial

    def unions(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Make one of two wall polygons that meet at a concave edge, also without its ends."""
        for _, edge, left, right, _ in self._concave_edges(edits, cell)[:_EDGES]:
            walls = [edits.across(k, cell) for k in (left, right)]
            loop = _joined(edits.seen(left, cell), edits.seen(right, cell))
            if max(walls) >= 0 or loop is None:
                continue
            areas = [float(np.linalg.norm(_area(edits.positions(edits.face(k)[2])))) for k in (left, right)]
            for gone in ((), edge):
                trial = edits.trial()
                trial.drop(left)
                trial.drop(right)
                trial.add(cell, walls[int(areas[1] > areas[0])], loop)
                for v in gone:
                    for k in set().union(*trial.faces_at(cell, v).values()):
                        owner, neighbor, corners = trial.face(k)
                        trial.put(k, owner, neighbor, [a for a in corners if a != v])
                yield trial

    def halves(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Divide a wall polygon along a diagonal."""
        for k in edits.faces_of(cell):
            owner, wall, loop = edits.face(k)
            for p, q in itertools.combinations(range(len(loop)) if wall < 0 else (), 2):
                if 1 < q - p < len(loop) - 1:
                    trial = edits.trial()
                    trial.drop(k)
                    trial.add(owner, wall, _between(loop, p, q))
                    trial.add(owner, wall, _between(loop, q, p))
                    yield trial

    def losses(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Leave out a small cell at a wall: its faces to others become walls in its place. Or a few without others."""
        part, beside = {cell}, edits.neighbors(cell)
        while not beside <= part and len(part) < _FEW:
            part |= beside
            beside = set().union(*(edits.neighbors(c) for c in part))
        if beside <= part and len(part) <= _FEW:
            trial = edits.trial()
            for k in set().union(*(edits.faces_of(c) for c in part)):
                trial.drop(k)
            yield trial
        walls = [k for k in edits.faces_of(cell) if edits.across(k, cell) < 0]
        inner = sorted(set(edits.faces_of(cell)) - set(walls))
        if walls and self._volume(edits, cell) < (_TIP if len(inner) < _FEW else _SLIVER) * self.h(cell) ** 3:
            areas = {k: float(np.linalg.norm(_area(edits.positions(edits.face(k)[2])))) for k in walls}
            wall = edits.across(max(walls, key=lambda k: areas[k]), cell)
            trial = edits.trial()
            for k in walls:
                trial.drop(k)
            for k in inner:
                other, loop = trial.across(k, cell), trial.seen(k, cell)[::-1]
                trial.drop(k)
                trial.put(k, other, wall, loop)
            yield trial

    @staticmethod
    def _volume(edits: Edits, cell: int) -> float:
        """Return the volume of a cell."""
        total = 0.0
        for k in edits.faces_of(cell):
            x = edits.positions(edits.seen(k, cell))
            total += float(x[0] @ _area(x))  # of a face that is nearly flat
        return total / 3


def _collapse(edits: Edits, cell: int, vertices: list[int], target: np.ndarray) -> None:
    """Make one vertex of several."""
    first, *others = vertices
    edits.move(cell, first, target)
    for v in others:
        for k in set().union(*edits.faces_at(cell, v).values()):
            owner, neighbor, loop = edits.face(k)
            loop = tuple(first if a in vertices else a for a in loop)
            loop = tuple(a for i, a in enumerate(loop) if a != loop[i - 1])
            edits.drop(k)
            if len(loop) > 2:
                edits.put(k, owner, neighbor, loop)


def _merge(edits: Edits, cell: int, other: int) -> bool:
    """Give all faces of a cell to a neighbor; faces to the same cell or wall that meet become one."""
    for k in sorted(edits.faces_of(cell)):
        n, loop = edits.across(k, cell), edits.seen(k, cell)
        edits.drop(k)
        if n != other:
            edits.put(k, other, n, loop)
    beyond: dict[int, list[int]] = {}
    for k in sorted(edits.faces_of(other)):
        beyond.setdefault(edits.across(k, other), []).append(k)
    for n, faces in beyond.items():
        while len(faces) > 1:
            pairs = [
                (i, j, loop)
                for s, i in enumerate(faces)
                for j in faces[s + 1 :]
                if (loop := _joined(edits.seen(i, other), edits.seen(j, other))) is not None
            ]
            if not pairs:
                break
            i, j, loop = pairs[0]
            edits.drop(i)
            edits.drop(j)
            faces.remove(j)
            edits.put(i, other, n, loop)
    return bool(edits.faces_of(other))


def _joined(one: tuple[int, ...], other: tuple[int, ...]) -> tuple[int, ...] | None:
    """Return the loop around two faces of a cell that share one path of edges, or None."""
    sides = set(edges_of(one)) | set(edges_of(other))
    left = [(a, b) for a, b in sides if (b, a) not in sides]
    after = dict(left)
    if len(left) == len(sides) or len(left) < 3 or len(after) < len(left):
        return None
    loop = [left[0][0]]
    while (b := after.get(loop[-1], -1)) != loop[0]:
        if b < 0 or len(loop) > len(left):
            return None
        loop.append(b)
    return tuple(loop) if len(loop) == len(left) else None


def _helps(gain: Gain) -> bool:
    """Return whether a change helps."""
    return gain[0] < 0 or (gain[0] == 0 and gain[1] < -_LEAST_GAIN)


def _area(x: np.ndarray) -> np.ndarray:
    """Return the area vector of a polygon x (k, 3)."""
    rows = x.tolist()
    u, v, w = rows[0]
    a = b = c = 0.0
    for (p, q, r), (s, t, z) in itertools.pairwise([(p - u, q - v, r - w) for p, q, r in rows[1:]]):
        a += q * z - r * t
        b += r * s - p * z
        c += p * t - q * s
    return np.array((0.5 * a, 0.5 * b, 0.5 * c))


def _between(loop: tuple[int, ...], p: int, q: int) -> tuple[int, ...]:
    """Return the corners of a loop from place p to place q."""
    return loop[p : q + 1] if p <= q else loop[p:] + loop[: q + 1]


def _components(loops: list[tuple[int, ...]], border: set[tuple[int, int]]) -> list[int]:
    """Return for each face the number of the part that it belongs to; parts meet at the `border` only."""
    at: dict[tuple[int, int], list[int]] = {}
    for k, loop in enumerate(loops):
        for edge in edges_of(loop):
            if edge not in border:
                at.setdefault((min(edge), max(edge)), []).append(k)
    part = [-1] * len(loops)
    number = 0
    for first in range(len(loops)):
        if part[first] >= 0:
            continue
        todo = [first]
        part[first] = number
        while todo:
            for p, q in edges_of(loops[todo.pop()]):
                for k in at.get((min(p, q), max(p, q)), ()):
                    if part[k] < 0:
                        part[k] = number
                        todo.append(k)
        number += 1
    return part


def cured(
    surface: WallSurface, faces: Faces, home: np.ndarray, own: np.ndarray, sizes: np.ndarray, rejected: np.ndarray
) -> tuple[Faces, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mesh with its `rejected` cells (k,) cured where that works, and `home`, `own` and what is rejected.

    Trials judge the cells that they touch. A mesh with more rejected cells in all than before is not taken.
    """
    if len(rejected) > _TOO_MANY * faces.n_cells:
        return faces, home, own, rejected
    cures = Cures(surface, faces, sizes)
    todo, changed = rejected.tolist(), True
    while changed:
        changed = False
        for cell in todo:
            for _ in range(_BUDGET):
                if not cures.cure(cell):
                    break
                changed = True
        todo = cures.edits.alive({*rejected.tolist(), *cures.edits.touched})
    made, cells = cures.edits.result()
    left = rejected_at_walls(made)
    if len(left) > len(rejected):
        return faces, home, own, rejected
    origin = np.array([cures.home.get(c, c) for c in cells.tolist()])
    is_own = (cells < len(own)) & np.append(own, np.zeros(cures.edits.next_cell, bool))[cells]
    return made, home[origin], is_own, left
