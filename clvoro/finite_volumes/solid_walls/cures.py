"""The last step of a mesh of a solid: change it around single cells that OpenFOAM rejects, so that it accepts them.

A cell that is concave at an edge, as at a concave crease, is cut in two. Other cures collapse short edges and small
faces, merge cells, and change or divide faces; the last ones leave out a part of the solid. All are tried on a rejected
cell. The best one is kept if it leaves fewer cells rejected than before, or as many, but nearer to what is accepted.

At the end faces that are oblique, between cells that OpenFOAM accepts, are turned or collapsed in the same way, and
small wall polygons that are skewed, as at the tips of strips, become parts of others.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import numpy as np

from ...mesh.faces import Faces
from .cutting import CellCut, planes_through
from .editing import REJECTED, WANTED_ANGLE, Edge, Edits, Matches, area_of, between, edges_of, judge
from .mend import rejected_among, touching_walls, with_neighbors
from .wall_surface import WallSurface

_SNAPS = (0.1, 0.03)
"""Distances over h up to which vertices count as in the plane of a cut. The second is tried if the first fails."""
_REFLEX = 2.0
"""Degrees beyond 180 from which the angle of a cell at an edge counts as concave."""
_EDGES = 3
"""Most concave edges of a cell that are tried."""
_LEAST_GAIN = 0.05
"""Where no fewer cells are rejected, a change is kept if their excess, see `judge`, falls by more than this."""
_FOLDED = 100.0
"""Degrees beyond 180 from which the angle between two faces of a cell counts as folded."""
_SHORT = 0.25, 0.3
"""Length over h below which edges may be collapsed, and faces whose corners are all that near to their mean: in cells
that are rejected, and where faces are oblique or skewed."""
_SMALL = 0.4
"""Cells with a smaller volume, over h^3, may be merged with a neighbor; new parts of cells always may."""
_TURNS = (0.3, 0.6, 1.0)
"""Shares of the angle by which oblique faces are turned."""
_SLIDES, _SKEWED = (-0.3, -0.15, 0.15, 0.3, 0.5), 0.9
"""Shares of an edge by which its first end moves to the second one; skewness, see `_facing`, from which it may."""
_REACH = 0.3
"""Largest distance over h of a crease or corner onto which a vertex may be moved."""
_SLIVER, _TIP, _FEW = 0.05, 0.4, 4
"""Cells at walls with a volume below `_SLIVER`, over h^3, may be left out; below `_TIP` with fewer than `_FEW` faces to
others. So may up to `_FEW` cells without faces to others."""
_TIP_AREA = 0.2
"""Wall polygons with a smaller area, over h^2, may be joined with others where they are skewed."""
_TOO_MANY, _TRIED = 0.2, 40
"""Share of rejected cells above which no cure is tried, as the solid is as thin as a cell, unless they are so few."""
_BUDGET, _MOST = 12, 1000
"""Most changes of a rejected cell before others have their turn, and most searches for cures in meshes that are made
one after another."""
_EACH = 6
"""Most searches in one mesh over the number of its rejected cells: parts of a cell may be cut again and again."""
_OBLIQUE = 100
"""Most searches at oblique faces, besides one for each cell that has such faces."""
_AHEAD = 1
"""Where no cure of a cell helps, cures of the cells that OpenFOAM rejects after it may follow: how many in turn."""
_BRANCHES, _MORE_BRANCHES, _MOST_BAD = 2, 6, 3
"""After how many of the cures of a cell others are tried, of those with oblique faces that are left then, and for how
many rejected cells."""

Gain = tuple[int, float, float]
"""Change of the number of rejected cells, and of their excess; the worst measure after it. See `judge`."""
Option = tuple[Gain, Edits, list[int]]
"""What a cure gains, its changes, and which of the cells that they touch are rejected after it."""
_Facing = tuple[tuple[int, ...], np.ndarray, np.ndarray, np.ndarray, float]
"""Measures of a face to another cell; see `Cures._facing`."""


class Cures:
    """Tries cures on the rejected cells of a mesh.

    - `names` (n,) int: the generator of each cell. Two meshes share a cell only if its name is the same in both.
    - `sizes` (n,) float: h of the cells.
    - `earlier`: those of an earlier mesh. They are repeated in cells that both meshes share.
    - `strictly`: mend oblique and skewed faces, see `judge`; else rejected cells only.

    Its attributes:
    - `edits`: the mesh with all changes that are kept.
    - `searches`: how often cures have been tried on a cell, also by the earlier cures.
    - `most`: the number of searches after which no cure is tried.
    - `branches`: after how many of the cures of a cell others are tried.
    - `tell`: called with the work and how far it is.
    """

    def __init__(
        self,
        surface: WallSurface,
        faces: Faces,
        names: np.ndarray,
        sizes: np.ndarray,
        earlier: Cures | None = None,
        strictly: bool = False,
    ) -> None:
        self.surface, self.edits, self.names, self.sizes = surface, Edits(faces), names, sizes
        self.changes, self.searches, self.changed, self.tried = 0, 0, dict[int, int](), dict[int, tuple[int, int]]()
        self.most, self.branches, self.strictly = _MOST, _BRANCHES, strictly
        self.tell: Callable[[str], object] = lambda _: None
        self.excess: dict[int, tuple[int, float]] = {}
        self.judged: dict[tuple[Edits, int, bool], list[Option]] = {}
        self.concave: dict[tuple[Edits, int], list[tuple[float, Edge, int, int, np.ndarray]]] = {}
        if earlier is not None:
            self._take_over(earlier)

    def _take_over(self, earlier: Cures) -> None:
        """Repeat earlier cures in the cells that both meshes share; note those of these cells that no cure helped."""
        old = earlier.edits
        matches = Matches(old, earlier.names, self.edits, self.names)
        cells = self.edits.repeat(old, matches)
        self.changes, self.searches = earlier.changes, earlier.searches
        self.changed = {cells[c]: when for c, when in earlier.changed.items() if c in cells}
        changed = old.touched
        for c, (when, branches) in earlier.tried.items():
            around = {c, *old.neighbors(c)}
            if when == earlier.stamp(c) and all(n in cells or (n not in changed and matches.find(n)) for n in around):
                self.tried[cells[c] if c in cells else matches.cells[c]] = when, branches

    @property
    def are_spent(self) -> bool:
        """Return whether no more searches are made."""
        return self.searches >= _MOST

    def h(self, edits: Edits, cell: int) -> float:
        """Return the size of a cell."""
        return float(self.sizes[edits.origins.get(cell, cell)])

    def cure(self, cell: int) -> bool:
        """Make the best change to the mesh around a cell if it is rejected; return whether one helps."""
        edits = self.edits
        when, branches = self.tried.get(cell, (-1, 0))
        known = when == self.stamp(cell) and branches >= self.branches
        if known or not edits.faces_of(cell) or self.searches >= self.most:
            return False
        self.measure([cell])
        if self.excess[cell][1] == 0:
            return False
        self.judged, self.concave = {}, {}
        for last in (False, True):
            self.searches += 1
            if (found := self._best(edits, cell, _AHEAD, last)) is not None:
                edits.take(found[1])
                self.changes += 1
                self.changed |= dict.fromkeys(found[1].touched, self.changes)
                return True
        self.tried[cell] = self.stamp(cell), self.branches
        return False

    def work_on(self, cells: list[int]) -> None:
        """Cure these cells, and those that cures change, until no cure helps any more."""
        self.most = min(self.most, self.searches + _EACH * len(cells))
        todo, again, work = cells, True, "oblique faces" if self.strictly else "cells that are rejected at walls"
        while again:
            again = False
            todo = self.edits.alive(todo)
            self.measure(todo)
            for number, cell in enumerate(todo):
                self.tell(f"{work}: {number} of {len(todo)}")
                for _ in range(_BUDGET):
                    if not self.cure(cell):
                        break
                    again = True
            todo = {*cells, *self.edits.touched}

    def result(self, rejected: np.ndarray) -> tuple[Faces, np.ndarray, np.ndarray]:
        """Return the mesh, the number of each of its cells, and those that OpenFOAM rejects, `rejected` (k,) before.

        Cells beside the rest, see `NearWalls`, are not judged if they have not changed: they are right.
        """
        made, cells = self.edits.result()
        changed = np.isin(cells, [*rejected.tolist(), *self.edits.touched])
        rest = (cells < len(self.names)) & (self.names[np.minimum(cells, len(self.names) - 1)] < 0)
        judged = with_neighbors(made, changed) & (changed | ~with_neighbors(made, rest))
        return made, cells, rejected_among(made, judged, changed | touching_walls(made))

    def measure(self, cells: list[int]) -> None:
        """Judge cells that have changed, or with neighbors that have, since they were judged."""
        stamps = {c: self.stamp(c) for c in cells}
        new = [c for c, when in stamps.items() if self.excess.get(c, (-1, 0))[0] != when]
        if new:
            found = judge([(self.edits, new)], self.strictly)[0][0].tolist()
            self.excess |= {c: (stamps[c], excess) for c, excess in zip(new, found, strict=True)}

    def stamp(self, cell: int) -> int:
        """Return the number of the last change of a cell or a neighbor."""
        return max(self.changed.get(c, 0) for c in {cell, *self.edits.neighbors(cell)})

    def _best(self, edits: Edits, cell: int, ahead: int, last: bool) -> tuple[Gain, Edits] | None:
        """Return the best cure of a cell: what it gains, and the changes; None if no cure helps.

        Up to `ahead` cures of other cells may follow one that does not help by itself. With `last` cures are also
        tried that leave out a crease or a part of the solid, or slide corners of oblique and skewed faces.
        """
        options = self._options(edits, cell, last)
        if not options:
            return None
        gain, trial, _ = min(options, key=lambda o: o[0])
        if _helps(gain):
            return gain, trial
        if not ahead:
            return None
        for gain, trial, bad in sorted(options, key=lambda o: o[0][1])[: self.branches]:
            for c in bad[:_MOST_BAD]:
                if trial.faces_of(c) and (further := self._best(trial, c, ahead - 1, last)) is not None:
                    gain = (gain[0] + further[0][0], gain[1] + further[0][1], max(gain[2], further[0][2]))
                    trial = further[1]
            if _helps(gain):
                return gain, trial
        return None

    def _options(self, edits: Edits, cell: int, last: bool) -> list[Option]:
        """Return all cures of a cell that leave cells closed. Each search judges them once."""
        if (edits, cell, last) not in self.judged:
            cures = [self.cuts, self.transfers, self.collapses, self.mergers, self.halves]
            if self.strictly:
                cures = [self.collapses, self.tilts, self.mergers, self.joins]
            if last:
                cures = [self.slides] if self.strictly else [self.unions, self.losses]
            self.judged[edits, cell, last] = self._judged(edits, [t for cure in cures for t in cure(edits, cell)])
        options = self.judged[edits, cell, last]
        return self._options(edits, cell, False) + options if last else options

    def _judged(self, edits: Edits, trials: list[Edits]) -> list[Option]:
        """Return what those trials gain that leave cells closed."""
        trials = [
            t
            for t in trials
            if not any(map(t.is_vast, t.touched)) and (t.shape() is not t or all(map(t.is_sound, t.touched)))
        ]
        if not trials:
            return []
        around = edits.alive(set().union(*(t.touched for t in trials)))
        cells = [t.alive(t.touched) for t in trials]
        (old, _), *verdicts = judge([(edits, around), *zip(trials, cells, strict=True)], self.strictly)
        before = dict(zip(around, old.tolist(), strict=True))
        options = []
        for trial, mine, (excess, worst) in zip(trials, cells, verdicts, strict=True):
            known = [before.get(c, 0.0) for c in trial.touched]
            least = REJECTED - 1 if self.strictly else 0.0
            fewer = int((excess > least).sum()) - sum(e > least for e in known)
            gain = (fewer, float(excess.sum()) - sum(known), float(worst.max(initial=0)))
            options.append((gain, trial, [c for c, e in zip(mine, excess.tolist(), strict=True) if e > 0]))
        return options

    # Cuts.

    def _concave_edges(self, edits: Edits, cell: int) -> list[tuple[float, Edge, int, int, np.ndarray]]:
        """Return the edges where a cell is concave, the one with the largest angle first.

        Each is a tuple: the angle beyond 180 degrees, the ends, the faces left and right of the edge, as seen from
        outside, and the outward normal of the left one. Each search finds them once.
        """
        if (edits, cell) not in self.concave:
            self.concave[edits, cell] = self._found_concave(edits, cell)
        return self.concave[edits, cell]

    def _found_concave(self, edits: Edits, cell: int) -> list[tuple[float, Edge, int, int, np.ndarray]]:
        sides: dict[tuple[int, int], tuple[int, np.ndarray]] = {}
        for k in edits.faces_of(cell):
            loop = edits.seen(k, cell)
            normal = area_of(edits.positions(loop))
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
        h = self.h(edits, cell)
        for turn, edge, _, right, one in self._concave_edges(edits, cell)[:_EDGES]:
            for normal in planes_through(edits, cell, edge, turn, one, h):
                for near in _SNAPS:
                    trial = edits.trial()
                    if CellCut(trial, cell, edge, right, normal, near * h).make(self._on_surface):
                        yield trial
                        break

    def _on_surface(self, edits: Edits, cell: int, edges: list[Edge], x: np.ndarray) -> np.ndarray:
        """Return x (k, 3) on `edges` of a cell moved onto the patches or creases that have the edges."""
        fits, places = self._all_placed([edits.patches_at(cell, *e) for e in edges], x, self.h(edits, cell))
        return np.where(fits[:, None], places, x)

    def _all_placed(self, walls: list[set[int]], x: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Return for each of the points x (k, 3) whether its `walls` meet near it, and the place there, (k, 3)."""
        fits, places = np.ones(len(x), bool), x.copy()
        patches = [sorted(-1 - n for n in w) for w in walls]
        count = np.array([len(p) for p in patches])
        on, at = np.flatnonzero(count == 1), np.flatnonzero(count == 2)
        if len(on):
            triangle, places[on], _ = self.surface.closest(x[on])
            fits[on] = self.surface.patch[triangle] == [patches[k][0] for k in on]
        if len(at):
            one, other = np.array([patches[k] for k in at]).T
            edge, places[at] = self.surface.nearest_crease(x[at], np.full(len(at), _REACH * h), (one, other))
            fits[at] = edge >= 0
        for k in np.flatnonzero(count > 2).tolist():
            near = np.flatnonzero(np.linalg.norm(self.surface.corners - x[k], axis=1) < _REACH * h)
            corners = [c for c in near if {*patches[k]} <= {*self.surface.patches_of(self.surface.first_corner + c)}]
            fits[k] = len(corners) > 0
            places[k] = self.surface.corners[corners[0]] if corners else x[k]
        return fits, places

    # Other cures.

    def transfers(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Where two faces of a cell are folded onto each other, give one of them to the cell behind the other."""
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
        h, groups = self.h(edits, cell), set[frozenset[int]]()
        short = _SHORT[self.strictly] * h
        for k in edits.faces_of(cell):
            loop = edits.face(k)[2]
            x = edits.positions(loop)
            length = np.linalg.norm(x - np.roll(x, -1, axis=0), axis=1)
            groups |= {frozenset(e) for e, far in zip(edges_of(loop), length.tolist(), strict=True) if far < short}
            if np.linalg.norm(x - x.mean(axis=0), axis=1).max() < short:
                groups.add(frozenset(loop))
        ordered = [sorted(group) for group in sorted(groups, key=sorted)]
        walls = [[edits.patches_at(cell, v) for v in vertices] for vertices in ordered]
        every = [set[int]().union(*w) for w in walls]
        x = [edits.positions(vertices) for vertices in ordered]
        fits, places = self._all_placed(every, np.array([y.mean(axis=0) for y in x]).reshape(-1, 3), h)
        for k, vertices in enumerate(ordered):
            held = x[k][[bool(w) and w == every[k] for w in walls[k]]]
            for target in held[:3] if len(held) else places[k : k + 1] if fits[k] else ():
                trial = edits.trial()
                _collapse(trial, cell, vertices, target)
                yield trial

    def mergers(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Merge a cell with a neighbor."""
        is_small = self._is_small(edits, cell)
        for other in edits.alive(edits.neighbors(cell)):
            for gone, left in ((cell, other), (other, cell)):
                if is_small if gone == cell else self._is_small(edits, other):
                    trial = edits.trial()
                    if _merge(trial, gone, left):
                        yield trial

    def tilts(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Turn an oblique face of a cell, about its center or a corner, towards the line through both centroids."""
        for loop, x, normal, line, _ in self._facing(edits, cell):
            if normal @ line > math.cos(math.radians(WANTED_ANGLE)):
                continue
            # One row for each share and pivot.
            pivots = np.tile([x.mean(axis=0), *x], (len(_TURNS), 1))
            turned = normal + np.repeat(_TURNS, len(x) + 1)[:, None] * (line - normal)
            far = ((pivots[:, None] - x) @ turned[:, :, None])[..., 0] / (turned @ normal)[:, None]
            moved = x + far[..., None] * normal
            walls = [edits.patches_at(cell, v) for v in loop]
            cells = [edits.faces_at(cell, v).keys() for v in loop]
            fits, places = self._all_placed(walls * len(moved), moved.reshape(-1, 3), self.h(edits, cell))
            for fit, place in zip(fits.reshape(len(moved), -1), places.reshape(moved.shape), strict=True):
                trial = edits.trial()
                for i in np.flatnonzero(fit).tolist():
                    trial.move(cells[i], loop[i], place[i])
                yield trial

    def slides(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Move one corner of an oblique or skewed face along the line of an edge of the cell, to either side."""
        bad = set[int]()
        for loop, _, normal, line, skewness in self._facing(edits, cell):
            if normal @ line < math.cos(math.radians(WANTED_ANGLE)) or skewness > _SKEWED:
                bad.update(loop)
        edges = sorted({e for k in edits.faces_of(cell) for e in edges_of(edits.seen(k, cell)) if e[0] in bad})
        if not edges:
            return
        x, y = (edits.positions(ends)[:, None] for ends in zip(*edges, strict=True))
        walls = {v: edits.patches_at(cell, v) for v in bad}
        moved = (x + np.array(_SLIDES)[:, None] * (y - x)).reshape(-1, 3)
        vertices = [v for v, _ in edges for _ in _SLIDES]
        fits, places = self._all_placed([walls[v] for v in vertices], moved, self.h(edits, cell))
        for k in np.flatnonzero(fits).tolist():
            trial = edits.trial()
            trial.move(edits.faces_at(cell, vertices[k]).keys(), vertices[k], places[k])
            yield trial

    def _facing(self, edits: Edits, cell: int) -> Iterator[_Facing]:
        """Return the measures of each face to another cell: (corners, places, normal, line, skewness).

        `line` is the direction of the line through both centroids. The skewness is about that of OpenFOAM: how far the
        line passes from the mean of the corners, over the largest distance of a corner from it.
        """
        beyond = [(k, n) for k in edits.faces_of(cell) if (n := edits.across(k, cell)) >= 0 and not edits.is_vast(n)]
        center, *centers = edits.middles([(edits, c) for c in (cell, *(n for _, n in beyond))])[:, :3]
        for (k, _), other in zip(beyond, centers, strict=True):
            loop = edits.seen(k, cell)
            x = edits.positions(loop)
            normal, line, middle = area_of(x), other - center, x.mean(axis=0)
            normal, line = normal / np.linalg.norm(normal), line / np.linalg.norm(line)
            off = center + line * ((middle - center) @ normal) / max(line @ normal, 1e-6) - middle
            reach = np.linalg.norm(x - middle, axis=1).max()
            yield loop, x, normal, line, float(np.linalg.norm(off) / reach)

    def unions(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Join two wall polygons that meet at a concave edge; the ends of the edge stay, or are left out."""
        for _, edge, left, right, _ in self._concave_edges(edits, cell)[:_EDGES]:
            walls = [edits.across(k, cell) for k in (left, right)]
            loop = _joined(edits.seen(left, cell), edits.seen(right, cell))
            if max(walls) >= 0 or loop is None:
                continue
            areas = [float(np.linalg.norm(area_of(edits.positions(edits.face(k)[2])))) for k in (left, right)]
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

    def joins(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Join a small wall polygon, as at the tip of a strip, with one of the cell that has the same name."""
        h, name = self.h(edits, cell), self.surface.solid.boundaries.index
        walls = {k: edits.seen(k, cell) for k in sorted(edits.faces_of(cell)) if edits.across(k, cell) < 0}
        for small, loop in walls.items():
            if np.linalg.norm(area_of(edits.positions(loop))) < _TIP_AREA * h**2:
                for k, around in walls.items():
                    wall, joined = edits.across(k, cell), _joined(loop, around)
                    if joined is not None and name[-1 - wall] == name[-1 - edits.across(small, cell)]:
                        trial = edits.trial()
                        trial.drop(small)
                        trial.drop(k)
                        trial.add(cell, wall, joined)
                        yield trial

    def halves(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Divide a wall polygon along a diagonal."""
        for k in edits.faces_of(cell):
            owner, wall, loop = edits.face(k)
            for p, q in itertools.combinations(range(len(loop)) if wall < 0 else (), 2):
                if 1 < q - p < len(loop) - 1:
                    trial = edits.trial()
                    trial.drop(k)
                    trial.add(owner, wall, between(loop, loop[p], loop[q]))
                    trial.add(owner, wall, between(loop, loop[q], loop[p]))
                    yield trial

    def losses(self, edits: Edits, cell: int) -> Iterator[Edits]:
        """Leave out a small cell at a wall: its faces to others become walls. Or a few cells that touch no others."""
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
        if walls and self._volume(edits, cell) < (_TIP if len(inner) < _FEW else _SLIVER) * self.h(edits, cell) ** 3:
            areas = {k: float(np.linalg.norm(area_of(edits.positions(edits.face(k)[2])))) for k in walls}
            wall = edits.across(max(walls, key=lambda k: areas[k]), cell)
            trial = edits.trial()
            for k in walls:
                trial.drop(k)
            for k in inner:
                other, loop = trial.across(k, cell), trial.seen(k, cell)[::-1]
                trial.drop(k)
                trial.put(k, other, wall, loop)
            yield trial

    def _is_small(self, edits: Edits, cell: int) -> bool:
        """Return whether a cell may be merged with a neighbor."""
        return cell >= edits.mesh.n_cells or self._volume(edits, cell) < _SMALL * self.h(edits, cell) ** 3

    @staticmethod
    def _volume(edits: Edits, cell: int) -> float:
        return float(edits.middles([(edits, cell)])[0, 3])


def _collapse(edits: Edits, cell: int, vertices: list[int], target: np.ndarray) -> None:
    """Make one vertex, at `target`, of several; faces with fewer than three corners left vanish."""
    first, *others = vertices
    edits.move(edits.faces_at(cell, first), first, target)
    for v in others:
        for k in set().union(*edits.faces_at(cell, v).values()):
            owner, neighbor, loop = edits.face(k)
            loop = tuple(first if a in vertices else a for a in loop)
            loop = tuple(a for i, a in enumerate(loop) if a != loop[i - 1])
            edits.drop(k)
            if len(loop) > 2:
                edits.put(k, owner, neighbor, loop)


def _merge(edits: Edits, cell: int, other: int) -> bool:
    """Give all faces of a cell to a neighbor, and join its faces that meet and have the same cell or wall behind them.

    Return whether the neighbor has faces.
    """
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
    """Return whether fewer cells are rejected, or as many with clearly less excess."""
    return gain[0] < 0 or (gain[0] == 0 and gain[1] < -_LEAST_GAIN)


def cured(
    surface: WallSurface,
    faces: Faces,
    names: np.ndarray,
    own: np.ndarray,
    sizes: np.ndarray,
    rejected: np.ndarray,
    earlier: Cures | None = None,
    oblique: np.ndarray | None = None,
    tell: Callable[[str], object] = lambda _: None,
) -> tuple[Faces, np.ndarray, np.ndarray, np.ndarray, Cures | None]:
    """Cure the `rejected` cells (k,) of a mesh where that works. If `oblique` cells (k,) are given, mend their faces.

    The mesh stays as it is if cures would leave more cells rejected, or no cells. `earlier` cures are those of an
    earlier mesh of the solid; see `Cures`. Return the mesh; which of the given cells each of its cells was; `own` and
    the cells that are still rejected, as in `_Made`; and the cures. `tell` is called with the work and how far it is.
    """
    if len(rejected) > max(_TRIED, _TOO_MANY * faces.n_cells):
        return faces, np.arange(faces.n_cells), own, rejected, None
    begun = (rejected if oblique is None else oblique).tolist()
    cures = Cures(surface, faces, names, sizes, earlier, oblique is not None)
    cures.tell = tell
    if oblique is not None:
        cures.most = cures.searches + _OBLIQUE + len(begun)
    for branches in (_BRANCHES,) if oblique is None else (_BRANCHES, _MORE_BRANCHES):
        cures.branches = branches
        cures.work_on(begun)
    made, cells, left = cures.result(rejected)
    if len(left) > len(rejected) or not len(cells):
        return faces, np.arange(faces.n_cells), own, rejected, None
    origin = np.array([cures.edits.origins.get(c, c) for c in cells.tolist()])
    is_own = (cells < len(own)) & np.append(own, np.zeros(cures.edits.next_cell, bool))[cells]
    return made, origin, is_own, left, cures
