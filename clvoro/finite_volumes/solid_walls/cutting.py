"""Cut cells of a Voronoi diagram along the concave creases that pass through them.

A cell that contains a part of a concave crease has no convex part inside of the solid. Where no generators stand at one
distance from the crease, the cell is cut by the surface through the crease that bisects the angle between the two
walls. The vertices of the diagram decide: all cells that a crease cuts see the same points on their common edges.
"""

from __future__ import annotations

import itertools
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
            faces = _Cutter(faces, generators, sizes).cut(part.tolist(), Bisecting(surface.solid, c))
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


class _Cutter:
    """Cuts cells by one surface."""

    def __init__(self, faces: CellFaces, generators: np.ndarray, sizes: np.ndarray) -> None:
        self.faces, self.generators, self.sizes = faces, generators, sizes

    def cut(self, cells: list[int], by: Bisecting) -> CellFaces:
        """Return the faces with those of `cells` cut that fall into two parts."""
        while cells:
            try:
                return self._cut(cells, by)
            except _UncutError as odd:
                cells = [c for c in cells if c not in odd.cells]
        return self.faces

    def _cut(self, cells: list[int], by: Bisecting) -> CellFaces:
        f = self.faces
        rows = np.flatnonzero(np.isin(f.owner, cells) | np.isin(f.neighbor, cells))
        loops = [f.corners[f.starts[r] : f.starts[r + 1]].tolist() for r in rows]
        sides = self._sides(rows, loops, by)
        n, points = len(f.home), [f.points]
        v = len(f.points)
        # The part with the generator keeps the number.
        keeps = by.at(self.generators[f.home[cells]])[0] > 0
        above = {c: c if up else n + k for k, (c, up) in enumerate(zip(cells, keeps.tolist(), strict=True))}
        below = {c: n + k if up else c for k, (c, up) in enumerate(zip(cells, keeps.tolist(), strict=True))}
        crossing: dict[tuple[int, int], int] = {}
        # Edges that the surface crosses.
        for loop in loops:
            for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
                key = (min(a, b), max(a, b))
                if sides[a][0] * sides[b][0] < 0 and key not in crossing:
                    crossing[key] = v + len(crossing)
                    da, db = sides[key[0]][1], sides[key[1]][1]
                    points.append(((f.points[key[0]] * db - f.points[key[1]] * da) / (db - da))[None])
        at = {v + k: (0, 0.0) for k in range(len(crossing))}
        sides |= at
        position = np.concatenate(points)
        extra: list[np.ndarray] = []
        owner, neighbor, made = [], [], []
        borders: dict[int, list[tuple[int, int]]] = {c: [] for c in cells}
        for r, loop in zip(rows.tolist(), loops, strict=True):
            i, j = int(f.owner[r]), int(f.neighbor[r])
            full: list[int] = []
            for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
                full.append(a)
                if (key := (min(a, b), max(a, b))) in crossing:
                    full.append(crossing[key])
            side = [sides[a][0] for a in full]
            if min(side) >= 0 or max(side) <= 0:
                up = max(side) > 0
                owner.append((above if up else below).get(i, i))
                neighbor.append((above if up else below).get(j, j))
                made.append(full)
                continue
            m = len(full)
            ends = [k for k in range(m) if side[k] == 0 and side[k - 1] * side[(k + 1) % m] < 0]
            if len(ends) != 2 or any(side[k] * side[k - 1] < 0 for k in range(m)):
                raise _UncutError({i, j} & above.keys())
            p, q = ends
            one, other = full[p : q + 1], full[q:] + full[: p + 1]  # both from end to end
            if side[(p + 1) % m] < 0:
                one, other = other, one  # `one` is above
            if (i in above) != (j in above):
                # Fold the face away from the neighbor that is not cut.
                a, b = position[one[-1]], position[one[0]]
                out = np.cross(position[full] - position[full].mean(axis=0), np.roll(position[full], -1, axis=0)).sum(0)
                if j in above:
                    out = -out
                normal = by.at((a + b)[None] / 2)[1][0]
                out -= (out @ normal) * normal
                out *= _FOLD * np.linalg.norm(a - b) / max(np.linalg.norm(out), 1e-300)
                middle = [len(position) + len(extra)]
                extra.append((a + b) / 2 - out)
            else:
                middle = []
            for number, part, way in ((above, one, middle), (below, other, middle[::-1])):
                owner.append(number.get(i, i))
                neighbor.append(number.get(j, j))
                made.append(part + way)
            # From the last corner of the part above to its first one, as seen from the owner.
            line = [one[-1], *middle, one[0]]
            for c, way in ((i, line), (j, line[::-1])):
                if c in above:
                    borders[c] += itertools.pairwise(way)
        for c in cells:
            loop = _closed(borders[c])
            if loop is None:
                raise _UncutError({c})
            owner.append(below[c])
            neighbor.append(above[c])
            made.append(loop)
        # The new vertices on edges of the faces of other cells.
        kept = np.ones(len(f.owner), bool)
        kept[rows] = False
        edge_owner, edge_neighbor, edge_loops = self._with_vertices(kept, crossing)
        owner, neighbor, made = owner + edge_owner, neighbor + edge_neighbor, made + edge_loops
        turned = [k for k in range(len(made)) if neighbor[k] >= 0 and owner[k] > neighbor[k]]
        for k in turned:
            owner[k], neighbor[k], made[k] = neighbor[k], owner[k], made[k][::-1]
        left = np.flatnonzero(kept)
        starts, corners = take_rows(f.starts, f.corners, left)
        counts = np.concatenate([np.diff(starts), [len(loop) for loop in made]])
        return replace(
            f,
            owner=np.concatenate([f.owner[left], owner]).astype(np.int64),
            neighbor=np.concatenate([f.neighbor[left], neighbor]).astype(np.int64),
            starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            corners=np.concatenate([corners, [a for loop in made for a in loop]]).astype(np.int64),
            points=np.concatenate([position, np.reshape(extra, (-1, 3))]),
            home=np.append(f.home, f.home[cells]),
            row=np.concatenate([f.row[left], np.full(len(made), -1)]),
            cuts=(*f.cuts, *(CreaseCut(c, below[c], above[c], by) for c in cells)),
        )

    def _sides(self, rows: np.ndarray, loops: list[list[int]], by: Bisecting) -> dict[int, tuple[int, float]]:
        """Return for each corner on which side it lies, or 0 if it is in the surface, and its distance."""
        f = self.faces
        of: dict[int, float] = {}
        beside: dict[int, set[int]] = {}
        for r, loop in zip(rows.tolist(), loops, strict=True):
            cells = [c for c in (f.owner[r], f.neighbor[r]) if 0 <= c < len(f.home) and f.home[c] < len(self.sizes)]
            h = min(float(self.sizes[f.home[c]]) for c in cells)
            for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
                of[a] = min(of.get(a, np.inf), h)
                beside.setdefault(a, set()).add(b)
                beside.setdefault(b, set()).add(a)
        corner = np.array(sorted(of))
        height = dict(zip(corner.tolist(), by.at(f.points[corner])[0].tolist(), strict=True))
        sides = {a: (1 if d > 0 else -1, d) for a, d in height.items()}
        inside: set[int] = set()
        for a in sorted(of, key=lambda k: (abs(height[k]), k)):
            if abs(height[a]) < _SNAP * of[a] and not beside[a] & inside:
                inside.add(a)
                sides[a] = (0, 0.0)
        return sides

    def _with_vertices(self, kept: np.ndarray, crossing: dict[tuple[int, int], int]):
        """Return the faces of `kept` with new vertices on their edges, and take them out of `kept`."""
        f = self.faces
        owner: list[int] = []
        neighbor: list[int] = []
        loops: list[list[int]] = []
        if not crossing:
            return owner, neighbor, loops
        ends = np.unique(np.array(list(crossing)))
        hits = np.add.reduceat(np.isin(f.corners, ends).astype(np.int64), f.starts[:-1])
        for r in np.flatnonzero(kept & (hits > 1)).tolist():
            loop = f.corners[f.starts[r] : f.starts[r + 1]].tolist()
            full: list[int] = []
            for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
                full.append(a)
                if (key := (min(a, b), max(a, b))) in crossing:
                    full.append(crossing[key])
            if len(full) > len(loop):
                kept[r] = False
                owner.append(int(f.owner[r]))
                neighbor.append(int(f.neighbor[r]))
                loops.append(full)
        return owner, neighbor, loops


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
