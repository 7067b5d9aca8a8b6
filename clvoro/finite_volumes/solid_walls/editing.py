"""Polyhedra whose faces and vertices are changed one at a time, on trial, and judged as OpenFOAM does.

`merging` collapses edges and faces all over a large mesh, many at once, in arrays. Here are few cells, but any change
of their faces, and many trials of each, which store what they change and read all else from the mesh.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...connectivity import starts_of, take_rows
from ...mesh.faces import Faces
from ...mesh.geometry import cell_geometry, face_geometry
from ..gate import LEAST_DETERMINANT, LEAST_MEASURE
from ..measures import SolverMeasures

_MOST_FACES = 200
"""A cell with more faces than this is no cell of the mesh. It stands for all cells far from walls; see `NearWalls`."""
WANTED_ANGLE, WANTED_SKEWNESS = 19.0, 2.0
"""Largest non-orthogonality of a face in degrees, and largest skewness. Faces near walls that exceed one of them are
turned or collapsed. Non-orthogonality is the angle between the normal and the line through the centroids of both cells;
`solver_mesh`, which collapses short edges, may add two degrees."""
REJECTED = 1000.0
"""How much worse what OpenFOAM rejects is than a face that is oblique."""
_ROUNDING = 1e-9
"""Vertices of two meshes at the same place differ by at most this share of the extent of the mesh."""
Face = tuple[int, int, tuple[int, ...]]
"""Owner, neighbor and corners; see `Faces`."""
Edge = tuple[int, int]
"""Both ends."""


class Edits:
    """A mesh in 3D with some faces, cells and points changed.

    - `parent`: changes on top of which these come.

    Its attributes:
    - `touched`: cells whose faces, or whose points, have changed, also those that are gone.
    - `origins`: the cell of `mesh` of which each new cell is a part.
    - `taken`: trials that have become a part of these edits, in turn.
    """

    def __init__(self, mesh: Faces, parent: Edits | None = None) -> None:
        self.mesh, self.parent = mesh, parent
        self._faces: dict[int, Face | None] = {}
        self._cells: dict[int, frozenset[int]] = {}
        self._points: dict[int, np.ndarray] = {}
        self.touched: set[int] = set()
        self.taken: list[Edits] = []
        self.origins: dict[int, int] = {} if parent is None else dict(parent.origins)
        self._middles: dict[int, np.ndarray] = {}
        if parent is None:
            self.next_face, self.next_cell, self.next_point = len(mesh), mesh.n_cells, len(mesh.points)
            starts, places = mesh.cell_faces()
            self._of_cell, self._face_of = starts, mesh.sides()[1][places]
            self._known_faces: dict[int, Face] = {}
            self._known_cells: dict[int, frozenset[int]] = {}
        else:
            self._of_cell, self._face_of = parent._of_cell, parent._face_of
            self._known_faces, self._known_cells = parent._known_faces, parent._known_cells
            self.next_face, self.next_cell, self.next_point = parent.next_face, parent.next_cell, parent.next_point

    def trial(self) -> Edits:
        """Return changes on top of these, none at first. They can be dropped, or become part of these; see `take`."""
        return Edits(self.mesh, self)

    def shape(self) -> Edits:
        """Return the latest edits that changed faces: those after them only moved vertices."""
        at = self
        while at.parent is not None and not at._faces:
            at = at.parent
        return at

    def take(self, trial: Edits) -> None:
        """Make the changes of a trial part of these, also of a trial of a trial."""
        if trial.parent is not self:
            assert trial.parent is not None
            self.take(trial.parent)
        self.taken.append(trial)
        self._faces |= trial._faces
        self._cells |= trial._cells
        self._points |= trial._points
        self.touched |= trial.touched
        for c in trial.touched:
            self._middles.pop(c, None)
        self._middles |= trial._middles
        self.origins = trial.origins
        self.next_face, self.next_cell, self.next_point = trial.next_face, trial.next_cell, trial.next_point

    # Reading.

    def face(self, k: int) -> Face:
        """Return a face."""
        at = self
        while k not in at._faces:
            if at.parent is None:
                return self.mesh_face(k)
            at = at.parent
        found = at._faces[k]
        assert found is not None
        return found

    def faces_of(self, cell: int) -> frozenset[int]:
        """Return the faces of a cell."""
        at = self
        while cell not in at._cells:
            if at.parent is None:
                if cell not in self._known_cells:
                    self._known_cells[cell] = frozenset(self.mesh_faces(cell))
                return self._known_cells[cell]
            at = at.parent
        return at._cells[cell]

    def mesh_faces(self, cell: int) -> list[int]:
        """Return the faces of a cell before all changes."""
        rows = slice(*self._of_cell[cell : cell + 2]) if cell < self.mesh.n_cells else slice(0)
        return self._face_of[rows].tolist()

    def mesh_face(self, k: int) -> Face:
        """Return a face before all changes."""
        if k not in self._known_faces:
            m = self.mesh
            loop = tuple(m.corners[m.starts[k] : m.starts[k + 1]].tolist())
            self._known_faces[k] = int(m.owner[k]), int(m.neighbor[k]), loop
        return self._known_faces[k]

    def is_vast(self, cell: int) -> bool:
        """Return whether a cell stands for all that are far from walls."""
        return len(self.faces_of(cell)) > _MOST_FACES

    def point(self, v: int) -> np.ndarray:
        """Return the position of a vertex."""
        at: Edits | None = self
        while at is not None:
            if v in at._points:
                return at._points[v]
            at = at.parent
        return self.mesh.points[v]

    def positions(self, vertices: Iterable[int]) -> np.ndarray:
        """Return the positions of vertices, (k, 3)."""
        numbers = list(vertices)
        x = self.mesh.points[np.minimum(np.array(numbers, np.int64), len(self.mesh.points) - 1)]
        changed: dict[int, np.ndarray] = {}
        wanted = set(numbers)
        at: Edits | None = self
        while at is not None:
            changed = {v: at._points[v] for v in wanted & at._points.keys()} | changed
            at = at.parent
        if changed:
            for k, v in enumerate(numbers):
                if v in changed:
                    x[k] = changed[v]
        return x

    def across(self, k: int, cell: int) -> int:
        """Return the cell behind a face of `cell`; negative for walls."""
        owner, neighbor, _ = self.face(k)
        return neighbor if owner == cell else owner

    def seen(self, k: int, cell: int) -> tuple[int, ...]:
        """Return the corners of a face, counter-clockwise as seen from outside of `cell`."""
        owner, _, loop = self.face(k)
        return loop if owner == cell else loop[::-1]

    def neighbors(self, cell: int) -> set[int]:
        """Return the cells behind the faces of a cell."""
        return {n for k in self.faces_of(cell) if (n := self.across(k, cell)) >= 0}

    def vertices(self, cell: int) -> set[int]:
        """Return the vertices of a cell."""
        return {v for k in self.faces_of(cell) for v in self.face(k)[2]}

    @staticmethod
    def middles(cells: list[tuple[Edits, int]]) -> np.ndarray:
        """Return centroid and volume of each of some cells in some edits, (k, 4) float. Each is computed once."""
        found = list[tuple[Edits, int]]()
        for at, cell in cells:
            while at.parent is not None and cell not in at.touched:
                at = at.parent
            found.append((at, cell))
        new = list({(at, c): None for at, c in found if c not in at._middles})
        if new:
            sides = [(row, *loop) for row, (at, c) in enumerate(new) for loop in at._loops(c)]
            counts = [len(x) for _, _, x in sides]
            center, area = face_geometry(
                np.concatenate([x for _, _, x in sides]), np.cumsum([0, *counts]), np.arange(sum(counts))
            )
            area *= np.array([sign for _, sign, _ in sides])[:, None]
            owner = np.array([row for row, _, _ in sides])
            made = np.column_stack(cell_geometry(center, area, owner, owner[:0], len(new)))
            for (at, c), row in zip(new, made, strict=True):
                at._middles[c] = row
        return np.array([at._middles[c] for at, c in found]).reshape(-1, 4)

    def _loops(self, cell: int) -> Iterator[tuple[float, np.ndarray]]:
        """Return the corners of each face of a cell, (k, 3), after the sign of its normal."""
        for k in sorted(self.faces_of(cell)):
            owner, _, loop = self.face(k)
            yield 1.0 if owner == cell else -1.0, self.positions(loop)

    def faces_at(self, cell: int, *vertices: int) -> dict[int, set[int]]:
        """Return the faces that have all of `vertices`, for each cell with such faces; they lead there from `cell`."""
        found: dict[int, set[int]] = {}
        todo = [cell]
        while todo:
            c = todo.pop()
            if c in found:
                continue
            found[c] = {k for k in self.faces_of(c) if all(v in self.face(k)[2] for v in vertices)}
            todo += [n for k in found[c] if (n := self.across(k, c)) >= 0]
        return found

    def patches_at(self, cell: int, *vertices: int) -> set[int]:
        """Return the walls, as negative numbers, of the wall polygons that have all of the vertices."""
        at = self.faces_at(cell, *vertices)
        return {n for faces in at.values() for k in faces if (n := self.face(k)[1]) < 0}

    # Changing.

    def drop(self, k: int) -> None:
        """Remove a face."""
        for c in self.face(k)[:2]:
            if c >= 0:
                self._cells[c] = self.faces_of(c) - {k}
                self.touched.add(c)
        self._faces[k] = None

    def put(self, k: int, cell: int, other: int, loop: Iterable[int]) -> None:
        """Put a face between `cell` and `other`: `loop` is counter-clockwise as seen from outside of `cell`."""
        loop = tuple(loop)
        self._faces[k] = (cell, other, loop) if other < 0 or cell < other else (other, cell, loop[::-1])
        for c in (cell, other):
            if c >= 0:
                self._cells[c] = self.faces_of(c) | {k}
                self.touched.add(c)

    def add(self, cell: int, other: int, loop: Iterable[int]) -> int:
        """Add a face; see `put`. Return its number."""
        self.next_face += 1
        self.put(self.next_face - 1, cell, other, loop)
        return self.next_face - 1

    def add_cell(self, part_of: int) -> int:
        """Return the number of a new cell, without faces, that becomes a part of another one."""
        self.origins[self.next_cell] = self.origins.get(part_of, part_of)
        self._cells[self.next_cell] = frozenset()
        self.touched.add(self.next_cell)
        self.next_cell += 1
        return self.next_cell - 1

    def add_point(self, x: np.ndarray) -> int:
        """Return the number of a new vertex."""
        self._points[self.next_point] = x
        self.next_point += 1
        return self.next_point - 1

    def move(self, cells: Iterable[int], vertex: int, x: np.ndarray) -> None:
        """Move a vertex of these `cells`."""
        self._points[vertex] = x
        self.touched.update(cells)

    def divide_edge(self, cell: int, a: int, b: int, x: np.ndarray) -> int:
        """Put a vertex at x on an edge of `cell`, into all faces that have the edge; return its number."""
        new = self.add_point(x)
        for k in set().union(*self.faces_at(cell, a, b).values()):
            owner, neighbor, loop = self.face(k)
            for place, (p, q) in enumerate(edges_of(loop)):
                if {p, q} == {a, b}:
                    self.put(k, owner, neighbor, [*loop[: place + 1], new, *loop[place + 1 :]])
                    break
        return new

    def is_sound(self, cell: int) -> bool:
        """Return whether the faces of a cell close it: each edge has two of them, and no face a corner twice."""
        faces, edges = self.faces_of(cell), list[Edge]()
        for k in faces:
            owner, neighbor, loop = self.face(k)
            if owner == neighbor or len(loop) < 3 or len(set(loop)) < len(loop):
                return False
            after = loop[1:] + loop[:1]
            edges += zip(loop, after, strict=True) if owner == cell else zip(after, loop, strict=True)
        once = set(edges)
        closed = len(once) == len(edges) and all((b, a) in once for a, b in once)
        return not faces or (len(faces) > 3 and closed)

    def repeat(self, other: Edits, matches: Matches) -> dict[int, int]:
        """Repeat the changes that other edits have made to their mesh, in the cells that both meshes share.

        - `other`: those of another mesh of the same solid.
        - `matches`: between that mesh and this one. It gets the new faces and vertices as well.

        Return for each cell of the other mesh whose changes have all been repeated its number in this mesh.
        """
        cells, faces, points = dict[int, int](), matches.faces, matches.points
        different = set[int]()
        for done in other.taken:
            if done.touched & different or not all(
                c in cells or c in done.origins or matches.find(c) for c in done.touched
            ):
                different |= done.touched
                continue
            trial = self.trial()
            cells |= {c: matches.cells[c] for c in done.touched if c in matches.cells}
            for c in sorted(done.origins.keys() & done.touched - cells.keys()):
                cells[c] = trial.add_cell(cells[done.origins[c]])
            for v, x in sorted(done._points.items()):
                if v not in points:
                    points[v] = trial.next_point
                    trial.next_point += 1
                trial._points[points[v]] = x
            for k, face in sorted(done._faces.items()):
                if k not in faces:
                    faces[k] = trial.next_face
                    trial.next_face += 1
                trial._faces[faces[k]] = face and (
                    cells[face[0]],
                    cells[face[1]] if face[1] >= 0 else face[1],
                    tuple(points[v] for v in face[2]),
                )
            trial._cells = {cells[c]: frozenset(faces[k] for k in mine) for c, mine in done._cells.items()}
            trial.touched = {cells[c] for c in done.touched}
            self.take(trial)
        return {c: twin for c, twin in cells.items() if c not in different}

    # Results.

    def alive(self, cells: Iterable[int]) -> list[int]:
        """Return those of `cells` that have faces, but not the one for all that are far from walls."""
        return sorted(c for c in cells if self.faces_of(c) and not self.is_vast(c))

    def result(self) -> tuple[Faces, np.ndarray]:
        """Return the mesh with all changes, and the number of each of its cells in these edits."""
        assert self.parent is None
        m = self.mesh
        kept = np.ones(len(m), bool)
        kept[[k for k in self._faces if k < len(m)]] = False
        rows = np.flatnonzero(kept)
        new = [f for f in self._faces.values() if f is not None]
        owner = np.concatenate([m.owner[rows], [f[0] for f in new]]).astype(np.int64)
        neighbor = np.concatenate([m.neighbor[rows], [f[1] for f in new]]).astype(np.int64)
        cells = np.union1d(owner, neighbor[neighbor >= 0])
        owner, inner = np.searchsorted(cells, owner), neighbor >= 0
        neighbor = np.where(inner, np.searchsorted(cells, neighbor), neighbor)
        order = np.lexsort((np.where(inner, neighbor, owner), np.where(inner, owner, -neighbor), ~inner))
        starts, corners = take_rows(m.starts, m.corners, rows)
        counts = np.concatenate([np.diff(starts), [len(f[2]) for f in new]]).astype(np.int64)
        corners = np.concatenate([corners, [v for f in new for v in f[2]]]).astype(np.int32)
        starts, corners = take_rows(starts_of(counts), corners, order)
        points = np.concatenate([m.points, np.zeros((self.next_point - len(m.points), 3))])
        for v, x in self._points.items():
            points[v] = x
        old = cells < m.n_cells
        generators = np.zeros((len(cells), 3))
        generators[old] = m.generators[cells[old]]
        faces = Faces(
            domain=m.domain,
            generators=generators,
            points=points,
            starts=starts,
            corners=corners,
            owner=owner[order].astype(np.int32),
            neighbor=neighbor[order].astype(np.int32),
            twin=np.full(len(order), -1),
            shift=np.zeros((len(order), 3), np.int8),
            half_face=np.concatenate([m.half_face[rows], np.full(len(new), -1)])[order],
        )
        return faces.compact(), cells


class Matches:
    """Cells of two meshes that are the same up to rounding. Each is searched for once.

    - `one`, `other`: all changes are ignored.
    - `names_of_one`, `names_of_other` (n,) int: cells with one name may be the same.

    Its attributes:
    - `cells`, `faces`, `points`: numbers in the other mesh.
    """

    def __init__(self, one: Edits, names_of_one: np.ndarray, other: Edits, names_of_other: np.ndarray) -> None:
        self._one, self._other = one, other
        named = dict(zip(names_of_other.tolist(), range(len(names_of_other)), strict=True))
        self._named = [named.get(name, -1) for name in names_of_one.tolist()]
        self._near = _ROUNDING * float(np.ptp(one.mesh.points, axis=0).max())
        self._known: dict[int, bool] = {}
        self.cells, self.faces, self.points = dict[int, int](), dict[int, int](), dict[int, int]()

    def find(self, cell: int) -> bool:
        """Return whether the other mesh has a cell, too."""
        if cell not in self._known:
            self._known[cell] = self._match(cell)
        return self._known[cell]

    def _match(self, cell: int) -> bool:
        twin, mine = self._named[cell], self._one.mesh_faces(cell)
        theirs = self._other.mesh_faces(twin) if twin >= 0 else []
        if len(mine) != len(theirs) or len(mine) > _MOST_FACES:
            return False
        faces, points = dict[int, int](), dict[int, int]()
        beyond = [(k, self._other.mesh_face(k)) for k in theirs]
        for k in mine:
            owner, neighbor, loop = self._one.mesh_face(k)
            sides = self._named[owner], self._named[neighbor] if neighbor >= 0 else neighbor
            for q, (i, j, around) in beyond:
                if (i, j) == sides and (turned := self._turned(loop, around)):
                    faces[k] = q
                    points |= zip(loop, turned, strict=True)
                    break
            else:
                return False
        self.cells[cell] = twin
        self.faces |= faces
        self.points |= points
        return len(set(faces.values())) == len(faces)

    def _turned(self, loop: tuple[int, ...], other: tuple[int, ...]) -> tuple[int, ...]:
        """Return the loop `other` from the corner on with which `loop` begins; empty if they are not the same."""
        if len(loop) != len(other):
            return ()
        x, y = self._one.mesh.points[list(loop)], self._other.mesh.points[list(other)]
        first = int(np.abs(y - x[0]).sum(axis=1).argmin())
        return other[first:] + other[:first] if np.abs(np.roll(y, -first, axis=0) - x).max() < self._near else ()


def edges_of(loop: tuple[int, ...]) -> Iterator[tuple[int, int]]:
    """Return each corner of a loop with the next one."""
    return zip(loop, loop[1:] + loop[:1], strict=True)


def area_of(x: np.ndarray) -> np.ndarray:
    """Return the area vector of a polygon x (k, 3)."""
    rows = x.tolist()
    u, v, w = rows[0]
    a = b = c = 0.0
    for (p, q, r), (s, t, z) in itertools.pairwise([(p - u, q - v, r - w) for p, q, r in rows[1:]]):
        a += q * z - r * t
        b += r * s - p * z
        c += p * t - q * s
    return np.array((0.5 * a, 0.5 * b, 0.5 * c))


def between(loop: tuple[int, ...], begin: int, end: int) -> tuple[int, ...]:
    """Return the corners of a loop from one to another."""
    p, q = loop.index(begin), loop.index(end)
    return loop[p : q + 1] if p <= q else loop[p:] + loop[: q + 1]


def judge(trials: list[tuple[Edits, list[int]]], strictly: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """Judge some cells of each trial by the criteria of OpenFOAM, all together, as cells of one mesh.

    The result is a list of (excess, worst): by how much limits are exceeded, summed over all faces and pairs of faces
    of a cell, above 0 if OpenFOAM rejects it, (k,) float; and the worst of its measures over their limits, (k,) float.
    With `strictly`, faces count, too, that are more oblique or skewed than wanted, far less than what is rejected.
    """
    regions: dict[tuple[Edits, tuple[int, ...]], _Region] = {}
    parts, points, beside = list[_Region](), list[np.ndarray](), list[tuple[Edits, int]]()
    for edits, chosen in trials:
        key = edits.shape(), tuple(chosen)
        if key not in regions:
            regions[key] = _region(*key)
        parts.append(regions[key])
        points.append(edits.positions(parts[-1].vertices))
        beside += [(edits, c) for c in parts[-1].beside]
    begun = np.cumsum([0, *(len(c) + len(p.beside) for (_, c), p in zip(trials, parts, strict=True))])
    cells, faces, corners = int(begun[-1]), [len(p.owner) for p in parts], [len(p.corners) for p in parts]
    one = np.concatenate([p.owner for p in parts]) + np.repeat(begun[:-1], faces)
    other = np.concatenate([p.neighbor for p in parts])
    other = np.where(other < 0, -1, other + np.repeat(begun[:-1], faces))
    first = np.cumsum([0, *(len(x) for x in points)])[:-1]
    loops = np.concatenate([p.corners for p in parts]) + np.repeat(first, corners)
    order = np.argsort(other < 0, kind="stable")
    starts = np.cumsum([0, *np.concatenate([p.counts for p in parts]).tolist()])
    starts, loops = take_rows(starts, loops, order)
    mesh = Faces(
        domain=trials[0][0].mesh.domain,
        generators=np.zeros((cells, 3)),
        points=np.concatenate(points),
        starts=starts,
        corners=loops.astype(np.int32),
        owner=one[order].astype(np.int32),
        neighbor=other[order].astype(np.int32),
        twin=np.full(len(order), -1),
        shift=np.zeros((len(order), 3), np.int8),
        half_face=np.full(len(order), -1),
    )
    rows = np.concatenate([k + np.arange(len(chosen)) for k, (_, chosen) in zip(begun.tolist(), trials, strict=False)])
    mine = np.zeros(cells, bool)
    mine[rows] = True
    excess, worst = _measured(mesh, mine, Edits.middles(beside), strictly)
    ends = np.cumsum([len(chosen) for _, chosen in trials])[:-1]
    return list(zip(np.split(np.round(excess[rows], 6), ends), np.split(worst[rows], ends), strict=True))


class _Region(NamedTuple):
    """The faces of some cells. Their neighbors have higher numbers.

    - `owner`, `neighbor`, `counts` (f,) int: the cells of each face and the number of its corners.
    - `corners` (k,) int: rows of `vertices`.
    - `vertices`: their numbers in the mesh.
    - `beside`: the neighbors.
    """

    owner: np.ndarray
    neighbor: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    vertices: list[int]
    beside: list[int]


def _region(edits: Edits, cells: tuple[int, ...]) -> _Region:
    """Return the faces of some cells."""
    number = {c: k for k, c in enumerate(cells)}
    owner, neighbor, counts, corners = list[int](), list[int](), list[int](), list[int]()
    for k in set().union(*map(edits.faces_of, cells)):
        i, j, loop = edits.face(k)
        if i not in number and edits.is_vast(i):
            i, j, loop = j, -1, loop[::-1]
        elif j >= 0 and j not in number and edits.is_vast(j):
            j = -1
        a, b = number.setdefault(i, len(number)), j if j < 0 else number.setdefault(j, len(number))
        if 0 <= b < a:
            a, b, loop = b, a, loop[::-1]
        owner.append(a)
        neighbor.append(b)
        counts.append(len(loop))
        corners += loop
    vertices, rows = np.unique(np.array(corners, np.int64), return_inverse=True)
    one, other, count = (np.array(x, np.int64) for x in (owner, neighbor, counts))
    return _Region(one, other, count, rows, vertices.tolist(), list(number)[len(cells) :])


def over_wanted(measures: SolverMeasures) -> np.ndarray:
    """Return angle or skewness of each face over what is wanted, the larger one, (f,) float."""
    return np.maximum(measures.non_orthogonality / WANTED_ANGLE, measures.skewness / WANTED_SKEWNESS)


def _measured(mesh: Faces, mine: np.ndarray, others: np.ndarray, strictly: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return excess and worst as `judge` does, (n,) each, right for the cells that are `mine` (n,) bool.

    `others` (k, 4) are centroids and volumes of the other cells, of which the mesh has some faces only.
    """
    m, g, n = mesh.measures, mesh.measures.geometry, mesh.n_cells
    centroids, volumes = g.centroids.copy(), g.volumes.copy()
    centroids[~mine], volumes[~mine] = others[:, :3], others[:, 3]
    m.geometry = g = replace(g, centroids=centroids, volumes=volumes)
    c = m.coupled
    inner = mesh.neighbor >= 0
    worst = np.maximum(m.skewness / 4, m.non_orthogonality / 90)
    worst[c] = np.maximum(worst[c], 0.05 / np.maximum(m.weight[c], 1e-3))
    worst[c] = np.maximum(worst[c], 0.01 / np.maximum(m.volume_ratio[c], 1e-3))
    wrong = np.clip(worst - 1, 0, 3)
    wrong += (worst > 1) | (m.pyramids < -1e-15)
    wrong += np.linalg.norm(g.areas, axis=1) < LEAST_MEASURE
    wrong += m.bad_tetrahedra
    excess, most = np.zeros(n), np.zeros(n)
    for cells, rows in ((mesh.owner, slice(None)), (mesh.neighbor[inner], inner)):
        excess += np.bincount(cells, wrong[rows], n)
        np.maximum.at(most, cells, worst[rows])
    _, cells, sine = m.concave_pairs(judged=mine)
    excess += np.bincount(cells, 1 + sine, n)
    flat = LEAST_DETERMINANT / np.maximum(m.determinant, 1e-9)
    excess += (g.volumes < LEAST_MEASURE) + (flat > 1) + (m.aspect_ratio > 1000)
    if strictly:
        over = over_wanted(m)
        wrong = np.clip(over - 1, 0, 3) + (over > 1)
        excess *= REJECTED
        for cells, rows in ((mesh.owner, slice(None)), (mesh.neighbor[inner], inner)):
            excess += np.bincount(cells, wrong[rows], n)
            np.maximum.at(most, cells, over[rows])
    return excess, np.maximum(most, flat)
