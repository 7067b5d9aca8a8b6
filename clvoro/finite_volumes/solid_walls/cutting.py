"""Cut cells of a Voronoi diagram along the concave creases that pass through them.

A cell that contains a part of a concave crease has no convex part inside of the solid. Where no generators stand at one
distance from the crease, the cell is cut by the surface through the crease that bisects the angle between the two
walls. The vertices of the diagram decide: all cells that a crease cuts see the same points on their common edges.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ...geometry.solid.stations import chain_line
from ...mesh.connectivity import take_rows
from .chains import Crossings
from .wall_surface import WallSurface, nearest

if TYPE_CHECKING:
    from ...geometry.solid.solid import Solid

_SPACING = 0.05
"""Distance over h between the points of a crease around which cells are looked up."""
_AROUND = 24
"""Directions around a crease in which cells are looked up."""
_RADIUS = 0.15
"""Distance over h from the crease at which cells are looked up around it."""
_HALF = np.radians(140)
"""A cell is cut if it takes more of the angle around the crease."""
_LONG = 0.1
"""Least length of a crease in a cell that it cuts, over h."""
_SNAP = 0.08
"""Vertices this near to the surface of a cut, over h, are in it."""
_FOLD = 0.06
"""Height of the fold in a face of a neighbor that a cut divides, over its length: in one plane, the two parts would
count as concave."""
_ROUNDS = 50


class Bisecting:
    """The surface through a chain of creases that bisects the angle between the walls.

    Parameters
    ----------
    solid : Solid
    chain : int
    """

    def __init__(self, solid: Solid, chain: int) -> None:
        self.chain = chain
        line = chain_line(solid, chain)
        self.points = line.points
        across = np.cross(line.tangents, line.left + line.right)
        flat = np.linalg.norm(across, axis=1) < 1e-6
        across[flat] = line.left[flat]
        self.normals = across / np.linalg.norm(across, axis=1)[:, None]

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the signed distance of points x (k, 3) from the surface, and its normals (k, 3)."""
        begin, along = self.points[:-1], np.diff(self.points, axis=0)
        height, normal = np.zeros(len(x)), np.zeros((len(x), 3))
        for k in range(0, len(x), 256):
            here = x[k : k + 256]
            share = ((here[:, None] - begin) * along).sum(axis=2) / (along**2).sum(axis=1)
            share = np.clip(share, 0, 1)
            foot = begin + share[:, :, None] * along
            edge = ((here[:, None] - foot) ** 2).sum(axis=2).argmin(axis=1)
            row = np.arange(len(here))
            t = share[row, edge][:, None]
            n = (1 - t) * self.normals[edge] + t * self.normals[edge + 1]
            n /= np.linalg.norm(n, axis=1)[:, None]
            normal[k : k + 256] = n
            height[k : k + 256] = ((here - foot[row, edge]) * n).sum(axis=1)
        return height, normal


@dataclass(frozen=True)
class CreaseCut:
    """A cell that is cut by a surface into a part below and one above; one of them keeps the number of the cell."""

    cell: int
    below: int
    above: int
    by: Bisecting


@dataclass(frozen=True)
class CellFaces:
    """Faces of cells that are closed.

    Attributes
    ----------
    owner, neighbor : (f,) int
    starts, corners : (f + 1,), (k,) int
        Corners, counter-clockwise as seen from the neighbor.
    points : (v, 3) float
    home : (n,) int
        Of each cell the cell of the diagram that it is a part of.
    row : (f,) int
        The face of the diagram that each is; -1 for new ones.
    cuts : list of CreaseCut
    """

    owner: np.ndarray
    neighbor: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    points: np.ndarray
    home: np.ndarray
    row: np.ndarray
    cuts: tuple[CreaseCut, ...] = ()

    def locate(self, points: np.ndarray, cell: np.ndarray, chain: np.ndarray | None = None) -> np.ndarray:
        """Return the part of the cell of the diagram `cell` (k,) in which each of `points` (k, 3) lies, (k,).

        A point on the surface of a cut lies above it if `chain` (k,) is the chain of that surface.
        """
        found = cell.copy()
        for cut in self.cuts:
            rows = np.flatnonzero(found == cut.cell)
            if len(rows):
                above = cut.by.at(points[rows])[0] > 0
                if chain is not None:
                    above |= chain[rows] == cut.by.chain
                found[rows] = np.where(above, cut.above, cut.below)
        return found

    def within(self, n: int) -> CellFaces:
        """Return the faces between two of the first `n` cells of the diagram, or parts of these."""
        inner = np.append(self.home < n, False)
        rows = np.flatnonzero(inner[self.owner] & inner[np.maximum(self.neighbor, -1)])
        number = np.cumsum(inner) - 1
        starts, corners = take_rows(self.starts, self.corners, rows)
        return replace(
            self,
            owner=number[self.owner[rows]],
            neighbor=number[self.neighbor[rows]],
            starts=starts,
            corners=corners,
            home=self.home[inner[:-1]],
            row=self.row[rows],
            cuts=tuple(
                replace(cut, **{name: int(number[getattr(cut, name)]) for name in ("cell", "below", "above")})
                for cut in self.cuts
            ),
        )


def cut_at_creases(
    surface: WallSurface, tree: scipy.spatial.KDTree, sizes: np.ndarray, faces: CellFaces, chosen: np.ndarray
) -> CellFaces:
    """Cut the cells that contain a part of a concave crease, of the `chosen` ones (n,).

    Parameters
    ----------
    surface : WallSurface
    tree : KDTree
        Of the generators (n, 3).
    sizes : (n,) float
        h at the generators.
    faces : CellFaces
        Of the Voronoi diagram; the cells beyond `sizes` are outside.
    """
    creases = surface.solid.creases
    if not chosen.any():
        return faces
    x, edge, step = sample_creases(surface, np.flatnonzero(creases.concave), tree, sizes)
    row, cell = _reflex(surface, tree, sizes, x, edge)
    row, cell = row[chosen[cell]], cell[chosen[cell]]
    x, chain, step = x[row], creases.chain[edge[row]], step[row]
    generators = np.asarray(tree.data)
    for c in np.unique(chain).tolist():
        rows = np.flatnonzero(chain == c)
        part, at = np.unique(faces.locate(x[rows], cell[rows]), return_inverse=True)
        part = part[np.bincount(at, step[rows]) > _LONG * sizes[faces.home[part]]]
        if len(part):
            faces = _cut(faces, generators, sizes, part.tolist(), Bisecting(surface.solid, c))
    return faces


def _reflex(
    surface: WallSurface, tree: scipy.spatial.KDTree, sizes: np.ndarray, x: np.ndarray, edge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of the places x (k, 3) on crease edges, and the cells that have more than half of a turn there."""
    none = np.zeros(0, np.int64)
    if not len(x):
        return none, none
    creases, solid = surface.solid.creases, surface.solid
    along = surface.ends[edge, 1] - surface.ends[edge, 0]
    along /= np.linalg.norm(along, axis=1)[:, None]
    normal = solid.normals[creases.triangles[edge, 0]]
    across = np.cross(normal, along)
    angle = creases.angle[edge]
    h = sizes[nearest(tree, x)[1]]
    turn = (np.arange(_AROUND) + 0.5) / _AROUND * angle[:, None]
    ways = -np.sin(turn)[..., None] * normal[:, None] + np.cos(turn)[..., None] * across[:, None]
    places = x[:, None] + _RADIUS * h[:, None, None] * ways
    cells = nearest(tree, places.reshape(-1, 3))[1].reshape(len(x), -1)
    sector = angle / _AROUND
    count = (cells[:, :, None] == cells[:, None, :]).sum(axis=2)
    wide = count * sector[:, None] > _HALF
    rows = np.flatnonzero(wide.any(axis=1))
    return rows, cells[rows, count[rows].argmax(axis=1)]


def sample_creases(
    surface: WallSurface, edges: np.ndarray, tree: scipy.spatial.KDTree, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places in the middle of short pieces of crease edges, (k, 3), their edges (k,) and lengths (k,)."""
    ends = surface.ends[edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    h = np.minimum(sizes[nearest(tree, ends.mean(axis=1))[1]], 4 * sizes.min())
    count = np.maximum(1, np.ceil(length / (_SPACING * h))).astype(np.int64)
    row = np.repeat(np.arange(len(edges)), count)
    number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    share = ((number + 0.5) / count[row])[:, None]
    return ends[row, 0] + share * (ends[row, 1] - ends[row, 0]), edges[row], (length / count)[row]


def _cut(faces: CellFaces, generators: np.ndarray, sizes: np.ndarray, cells: list[int], by: Bisecting) -> CellFaces:
    """Return the faces with those of `cells` cut that the surface divides into two parts."""
    while cells:
        try:
            return _Cut(faces, generators, sizes, cells, by).result()
        except _UncutError as odd:
            cells = [c for c in cells if c not in odd.cells]
    return faces


class _Cut:
    """Cells that one surface cuts, and what their faces become.

    Attributes
    ----------
    rows : (r,) int
        The faces of the cells.
    loops : list of list of int
        Their corners.
    above, below : dict
        The number of each cell's part on either side. The part with the generator keeps the number of the cell.
    sides : dict
        See `_sides`.
    crossings : dict
        The new vertex on each edge (lower corner, higher corner) that the surface crosses.
    points : (v, 3) float
        Corners, with the new vertices.
    folds : list of (3,) float
        Further points, within faces.
    made : list of (owner, neighbor, loop)
        New faces.
    borders : dict
        The sides of each cell's cut, as seen from the part above.
    """

    def __init__(
        self, faces: CellFaces, generators: np.ndarray, sizes: np.ndarray, cells: list[int], by: Bisecting
    ) -> None:
        self.faces, self.sizes, self.cells, self.by = faces, sizes, cells, by
        self.rows = np.flatnonzero(np.isin(faces.owner, cells) | np.isin(faces.neighbor, cells))
        self.loops = [self._loop(r) for r in self.rows.tolist()]
        keeps = (by.at(generators[faces.home[cells]])[0] > 0).tolist()
        parts = [(c, up, len(faces.home) + k) for k, (c, up) in enumerate(zip(cells, keeps, strict=True))]
        self.above = {c: c if up else further for c, up, further in parts}
        self.below = {c: further if up else c for c, up, further in parts}
        self.sides = self._sides()
        self.crossings: dict[tuple[int, int], int] = {}
        self.points = faces.points
        self.folds: list[np.ndarray] = []
        self.made: list[tuple[int, int, list[int]]] = []
        self.borders: dict[int, list[tuple[int, int]]] = {c: [] for c in cells}

    def result(self) -> CellFaces:
        """Return all faces, with the cells cut."""
        f = self.faces
        self._cross_edges()
        for r, loop in zip(self.rows.tolist(), self.loops, strict=True):
            self._divide(int(f.owner[r]), int(f.neighbor[r]), loop)
        self._close_parts()
        left = np.setdiff1d(np.arange(len(f.owner)), np.concatenate([self.rows, self._add_vertices_to_others()]))
        made = [(j, i, loop[::-1]) if 0 <= j < i else (i, j, loop) for i, j, loop in self.made]
        owner, neighbor, loops = zip(*made, strict=True)
        starts, corners = take_rows(f.starts, f.corners, left)
        counts = np.concatenate([np.diff(starts), [len(loop) for loop in loops]])
        return replace(
            f,
            owner=np.concatenate([f.owner[left], owner]).astype(np.int64),
            neighbor=np.concatenate([f.neighbor[left], neighbor]).astype(np.int64),
            starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            corners=np.concatenate([corners, list(itertools.chain(*loops))]).astype(np.int64),
            points=np.concatenate([self.points, np.reshape(self.folds, (-1, 3))]),
            home=np.append(f.home, f.home[self.cells]),
            row=np.concatenate([f.row[left], np.full(len(made), -1)]),
            cuts=(*f.cuts, *(CreaseCut(c, self.below[c], self.above[c], self.by) for c in self.cells)),
        )

    def _loop(self, row: int) -> list[int]:
        """Return the corners of a face."""
        return self.faces.corners[self.faces.starts[row] : self.faces.starts[row + 1]].tolist()

    def _sides(self) -> dict[int, tuple[int, float]]:
        """Return for each corner on which side it lies, or 0 if it is in the surface, and its distance."""
        f = self.faces
        of: dict[int, float] = {}
        beside: dict[int, set[int]] = {}
        for r, loop in zip(self.rows.tolist(), self.loops, strict=True):
            cells = [c for c in (f.owner[r], f.neighbor[r]) if 0 <= c < len(f.home) and f.home[c] < len(self.sizes)]
            h = min(float(self.sizes[f.home[c]]) for c in cells)
            for a, b in _edges(loop):
                of[a] = min(of.get(a, np.inf), h)
                beside.setdefault(a, set()).add(b)
                beside.setdefault(b, set()).add(a)
        corner = np.array(sorted(of))
        height = dict(zip(corner.tolist(), self.by.at(f.points[corner])[0].tolist(), strict=True))
        sides = {a: (1 if d > 0 else -1, d) for a, d in height.items()}
        inside: set[int] = set()
        for a in sorted(of, key=lambda k: (abs(height[k]), k)):
            if abs(height[a]) < _SNAP * of[a] and not beside[a] & inside:
                inside.add(a)
                sides[a] = (0, 0.0)
        return sides

    def _cross_edges(self) -> None:
        """Put a vertex on each edge that the surface crosses."""
        x, found = self.points, []
        for loop in self.loops:
            for edge in _edges(loop):
                a, b = min(edge), max(edge)
                (side_a, da), (side_b, db) = self.sides[a], self.sides[b]
                if side_a * side_b < 0 and (a, b) not in self.crossings:
                    self.crossings[a, b] = len(x) + len(found)
                    found.append((x[a] * db - x[b] * da) / (db - da))
        self.sides |= dict.fromkeys(self.crossings.values(), (0, 0.0))
        self.points = np.concatenate([x, np.reshape(found, (-1, 3))])

    def _with_vertices(self, loop: list[int]) -> list[int]:
        """Return the corners of a face with the new vertices on its edges."""
        full: list[int] = []
        for a, b in _edges(loop):
            full.append(a)
            if (key := (min(a, b), max(a, b))) in self.crossings:
                full.append(self.crossings[key])
        return full

    def _divide(self, i: int, j: int, loop: list[int]) -> None:
        """Divide the face with the corners `loop` between cells i and j if it is on both sides of the surface."""
        above, below = self.above, self.below
        full = self._with_vertices(loop)
        side = [self.sides[a][0] for a in full]
        if min(side) >= 0 or max(side) <= 0:
            number = above if max(side) > 0 else below
            self.made.append((number.get(i, i), number.get(j, j), full))
            return
        m = len(full)
        ends = [k for k in range(m) if side[k] == 0 and side[k - 1] * side[(k + 1) % m] < 0]
        if len(ends) != 2 or any(side[k] * side[k - 1] < 0 for k in range(m)):
            raise _UncutError({i, j} & above.keys())
        p, q = ends
        one, other = full[p : q + 1], full[q:] + full[: p + 1]  # both from end to end
        if side[(p + 1) % m] < 0:
            one, other = other, one  # `one` is above
        middle: list[int] = []
        if (i in above) != (j in above):
            middle = [len(self.points) + len(self.folds)]
            self.folds.append(self._fold(full, one[-1], one[0], toward_owner=i in above))
        for number, part, way in ((above, one, middle), (below, other, middle[::-1])):
            self.made.append((number.get(i, i), number.get(j, j), part + way))
        # From the last corner of the part above to its first one, as seen from the owner.
        line = [one[-1], *middle, one[0]]
        for c, way in ((i, line), (j, line[::-1])):
            if c in above:
                self.borders[c] += itertools.pairwise(way)

    def _fold(self, loop: list[int], begin: int, end: int, toward_owner: bool) -> np.ndarray:
        """Return the middle of the line from `begin` to `end` across a face, moved into the cell that is cut."""
        x, a, b = self.points[loop], self.points[begin], self.points[end]
        out = np.cross(x - x.mean(axis=0), np.roll(x, -1, axis=0)).sum(axis=0)
        if not toward_owner:
            out = -out
        normal = self.by.at((a + b)[None] / 2)[1][0]
        out -= (out @ normal) * normal
        out *= _FOLD * np.linalg.norm(a - b) / max(np.linalg.norm(out), 1e-300)
        return (a + b) / 2 - out

    def _close_parts(self) -> None:
        """Put a face between the two parts of each cell."""
        for c in self.cells:
            loop = _closed(self.borders[c])
            if loop is None:
                raise _UncutError({c})
            self.made.append((self.below[c], self.above[c], loop))

    def _add_vertices_to_others(self) -> np.ndarray:
        """Make the faces of other cells again on whose edges new vertices lie; return which ones, (k,)."""
        f, found = self.faces, []
        if self.crossings:
            hits = np.add.reduceat(np.isin(f.corners, np.unique(list(self.crossings))).astype(np.int64), f.starts[:-1])
            for r in np.setdiff1d(np.flatnonzero(hits > 1), self.rows).tolist():
                loop = self._loop(r)
                full = self._with_vertices(loop)
                if len(full) > len(loop):
                    found.append(r)
                    self.made.append((int(f.owner[r]), int(f.neighbor[r]), full))
        return np.array(found, np.int64)


def _edges(loop: list[int]) -> Iterator[tuple[int, int]]:
    """Return each corner of a loop with the next one."""
    return zip(loop, loop[1:] + loop[:1], strict=True)


class _UncutError(Exception):
    """A surface does not cut these cells into two parts."""

    def __init__(self, cells: set[int]) -> None:
        self.cells = cells


def _closed(sides: list[tuple[int, int]]) -> list[int] | None:
    """Return the vertices of the loop that directed sides form; None if they do not form exactly one."""
    after = dict(sides)
    if len(after) != len(sides) or len(sides) < 3:
        return None
    loop = [sides[0][0]]
    while (a := after.get(loop[-1], -1)) != loop[0]:
        if a < 0 or len(loop) > len(sides):
            return None
        loop.append(a)
    return loop if len(loop) == len(sides) else None


def cross_cuts(surface: WallSurface, tree: scipy.spatial.KDTree, sizes: np.ndarray, faces: CellFaces) -> Crossings:
    """Return where creases cross the surfaces at which cells are cut, and where cut creases end there."""
    creases, solid = surface.solid.creases, surface.solid
    homes = np.unique(faces.home[[cut.cell for cut in faces.cuts]])
    x, edge, _ = sample_creases(surface, np.arange(len(creases)), tree, sizes)
    chain = creases.chain[edge]
    cell = nearest(tree, x)[1]
    part = np.where(np.isin(cell, homes), faces.locate(x, cell, chain), cell)
    after = np.arange(1, len(x) + 1) % max(len(x), 1)
    for c in range(creases.n_chains):
        if creases.closed(c):
            rows = np.flatnonzero(chain == c)
            after[rows[-1]] = rows[0]
    k = np.flatnonzero((chain == chain[after]) & (cell == cell[after]) & (part != part[after]))
    low, high, begin, end = x[k], x[after[k]], part[k], part[after[k]]
    for _ in range(_ROUNDS):
        middle = (low + high) / 2
        first = faces.locate(middle, cell[k], chain[k]) == begin
        low, high = np.where(first[:, None], middle, low), np.where(first[:, None], high, middle)
    found, foot = surface.nearest_crease(low, 0.1 * sizes[cell[k]])
    sound = found >= 0
    cells, points, edges = [np.stack([begin, end], axis=1)[sound]], [foot[sound]], [found[sound]]
    corner_cell = nearest(tree, surface.corners)[1]
    for c in np.flatnonzero(np.isin(corner_cell, homes)).tolist():
        here, home = surface.corners[c][None], corner_cell[c][None]
        for by in {cut.by.chain: cut.by for cut in faces.cuts if faces.home[cut.cell] == home[0]}.values():
            if solid.corners[c] in creases.vertices(by.chain):
                away = 1e-3 * sizes[home[0]] * by.at(here)[1]
                pair = [faces.locate(here + sign * away, home)[0] for sign in (-1, 1)]
                if pair[0] != pair[1]:
                    cells.append(np.array([pair]))
                    points.append(here)
                    edges.append(np.array([len(surface.ends) + c]))
    return Crossings(np.sort(np.concatenate(cells), axis=1), np.concatenate(points), np.concatenate(edges))
