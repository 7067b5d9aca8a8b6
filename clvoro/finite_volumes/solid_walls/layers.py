"""Layers of prisms along walls of a solid: walls move inward, and their polygons are extruded back to the surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
import scipy

from ...arguments import format_point, warn
from ...connectivity import distinct, following, rows_and_places, rows_of, rows_with, take_rows
from ...errors import MismatchWarning
from ...geometry.boundary_layers import DEEPER, INNER_DEPTH, OF_GAP, Layers
from ...mesh.diagram import Diagram
from ...mesh.faces import Faces
from ...mesh.geometry import sum_rows
from ...mesh.results import thickness_in_words
from ..collapse import collapse_short
from ..gate import judged_thoroughly, rejected_cells
from .mend import narrow_faces, spoiled_near_walls, with_neighbors
from .mesh import diagram_of

if TYPE_CHECKING:
    from ...geometry.domain import Domain
    from ...geometry.solid.solid import Solid

_SUITED = 0.25
"""A vertex should move away from each of its patches by the thickness there. Layers end if this fails by more than this
share of it."""
_LONGEST = 2.2
"""Longest way of a vertex over the thickness: three walls at right angles need 1.73."""
_SAME = 0.15
"""Patches at a vertex count as parallel if the tangent of half the angle between their normals is less than this."""
_SHORTENED, _EVENED = 0.5, 20
"""Largest share of its length that a side of a wall polygon may lose; most passes that average how its ends move."""
_SLOPE = 0.6
"""Largest change of the thickness along a wall, over the distance."""
_SWEEPS = 100
"""Steps that make the ways of vertices along walls smooth."""
_RESIDUAL, _MOST = 1e-3, 60
"""Relative residual and most iterations of the linear systems for the ways of inner vertices."""
_ROUNDS, _THINNER, _THINNED = 15, 0.6, 3
"""Largest number of rounds in which layers change where cells are rejected. In each round they become thinner there by
this factor; after so many rounds they end there."""
_FLATTENED, _FARTHER, _LEAST_FREE = 3, 1.3, 0.3
"""How often small faces that bulge out move back, by which factor farther than their centers have to, and the least
share of their vertices that counts as moving."""
_STEEP = 65.0
"""Non-orthogonality, in degrees, beyond which cells count as rejected."""
_FLAT = 500
"""Prisms with a larger ratio of width and height are not made thinner."""
_LEAST = 0.08
"""Where layers would be thinner than this share of the full thickness, there are none."""
_FULL = 0.9
"""Layers count as full from this share of the thickness on."""


def add_layers(diagram: Diagram, layers: Sequence[Layers]) -> tuple[Diagram, list[dict[str, float]]]:
    """Return the mesh of a solid with layers of prisms along patches, and how thick they are.

    The polygons of these patches move inward by the thickness of the layers, and vertices near them follow. Between
    the polygons and the surface are the prisms. They end at patches without layers, on which their sides lie.

    Layers are thinner in gaps, and where cells would be invalid. They taper to nothing where they cannot end on a patch
    without layers, or where patches meet at a sharp edge.

    - `diagram`: of a `Solid`.
    - `layers`: as `check_extruded` accepts them.

    Results:
    - `diagram`: the cells of `diagram`, then the prisms, polygon by polygon, the innermost first. Its `layer` says
      which one.
    - `thickness`: how thick each of `layers` is; see `clvoro.mesh.results.thickness_in_words`.

    Warns with `MismatchWarning` where layers are thinner: how many polygons, and the place of the thinnest.
    """
    walls = _LayeredWalls(diagram.domain, diagram.solver_mesh(), layers)
    share = walls.first_shares()
    best, attempt = None, 0
    while attempt < _ROUNDS:
        made = walls.extruded(share)
        bad = walls.rejected(made)
        if best is None or bad.count < best[0].count:
            best = bad, made, share, walls
        if not bad.count:
            break
        if (smoother := walls.without(bad.bulging)) is not walls:
            share = smoother.smooth(np.minimum(share[smoother.row_before], smoother.first_shares()))
            walls = smoother
        else:
            share = walls.thinner(share, bad)
            attempt += 1
    assert best is not None
    _, made, share, walls = best
    faces, n = made.faces, len(diagram)
    middles = faces.measures.geometry.centroids[n:]
    found = diagram_of(replace(faces, generators=np.concatenate([faces.generators[:n], middles])))
    assert diagram.home is not None
    own = np.where(diagram.home < 0, -1 - diagram.home, diagram.home)
    beside = walls.faces.owner[walls.rows[made.wall]]
    found.home = np.concatenate([diagram.home, -1 - own[beside]])
    return found, walls.reached(share, layers)


@dataclass(frozen=True)
class _RejectedCells:
    """Cells that OpenFOAM rejects.

    - `count`: their number.
    - `vertices` (k,) int: those of walls whose layers are to blame.
    - `corners` (j,) int: vertices of the inner ones in the mesh without layers.
    - `bulging` (f,) bool: small faces of the mesh without layers that make cells concave with them.
    """

    count: int
    vertices: np.ndarray
    corners: np.ndarray
    bulging: np.ndarray


@dataclass(frozen=True)
class _Layered:
    """A mesh with layers."""

    faces: Faces
    wall: np.ndarray
    """(m,) int. The wall polygon, among those with layers, of each prism."""


class _LayeredWalls:
    """The walls of a mesh, as layers need them.

    - `faces`: of the mesh without layers.
    - `rows` (w,) int: its faces on walls.
    - `patch`: (w,) int
    - `starts`, `corners` (w + 1,), (c,) int: vertices around each of `rows`.
    - `vertices` (u,) int: vertices on walls, ascending; the arrays below have a row for each.
    - `row_before`: (u,) int. The row of each of them, or of the nearest one, before a collapse.
    """

    def __init__(self, domain: Domain, faces: Faces, layers: Sequence[Layers]) -> None:
        self.solid, self.faces = cast("Solid", domain), faces
        self.layers, f = layers, faces
        self.rows = np.arange(f.n_inner, len(f))
        self.patch = -1 - f.neighbor[self.rows].astype(np.int64)
        self.starts, corners = take_rows(f.starts, f.corners, self.rows)
        self.face = rows_of(self.starts)
        self.vertices, place = np.unique(corners, return_inverse=True)
        self.corners = place.reshape(-1)
        self._last, self.row_before = cast("np.ndarray | None", None), np.arange(len(self.vertices))
        self._blamed, self._stays = np.zeros(len(self.vertices), np.int64), np.zeros(len(f.points), bool)
        self._read(layers)
        self._meet()

    def _read(self, layers: Sequence[Layers]) -> None:
        """Set thickness and count of each patch, and the shares of the thickness at which its layers end."""
        p = self.solid.n_patches
        self.thickness, self.count = np.zeros(p), np.zeros(p, np.int64)
        self.ends = np.ones((p, max(layer.count for layer in layers) + 1))
        for layer in layers:
            chosen = self.solid.boundaries.select("Layers edges", layer.edges)
            self.thickness[chosen], self.count[chosen] = layer.thickness, layer.count
            self.ends[chosen, : layer.count + 1] = np.concatenate([[0], np.cumsum(layer.heights) / layer.thickness])
        self.layered = self.count[self.patch] > 0

    def _meet(self) -> None:
        """Set for each vertex the patches it lies on, and the way on which it moves by the full thickness.

        `way` (u, 3) is 0 where layers end; `along` (u, 3, 3) leaves of a vector what is parallel to all these patches.
        """
        p, u = self.solid.n_patches, len(self.vertices)
        keys, pair = np.unique(self.corners * p + self.patch[self.face], return_inverse=True)
        pair = pair.reshape(-1)
        vector = self.faces.vectors[1][self.rows][self.face]
        normal = sum_rows(pair, vector, len(keys))
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        self.pair_vertex, self.pair_patch, self.pair_normal = keys // p, keys % p, normal
        first = np.searchsorted(self.pair_vertex, np.arange(u + 1))
        self.n_patches = np.diff(first)
        normals, wanted = np.zeros((u, self.n_patches.max(), 3)), np.zeros((u, self.n_patches.max()))
        place = np.arange(len(keys)) - first[self.pair_vertex]
        normals[self.pair_vertex, place] = normal
        wanted[self.pair_vertex, place] = -self.thickness[self.pair_patch]
        solve = np.linalg.pinv(normals, rcond=_SAME)
        self.along = np.eye(3) - solve @ normals
        way = np.einsum("uij,uj->ui", solve, wanted)
        off = np.abs(np.einsum("uji,ui->uj", normals, way) - wanted).max(axis=1)
        full = np.abs(wanted).max(axis=1)
        self.column = full > 0  # vertices of polygons with layers
        suited = self.column & (off < _SUITED * full) & (np.linalg.norm(way, axis=1) < _LONGEST * full)
        self.way = np.where(suited[:, None], way, 0.0)
        with_layers = np.bincount(self.pair_vertex, self.count[self.pair_patch] > 0, u)
        self.border = suited & (with_layers < self.n_patches)
        rows = np.flatnonzero(self.border)  # these must also stay on their patches without layers
        wanted = self.faces.points[self.vertices[rows]] + self.way[rows]
        off = np.linalg.norm(self._onto_patches(rows, wanted, bare=True) - wanted, axis=1)
        self.way[rows[off > _SUITED * full[rows]]] = 0
        self.border &= self.way.any(axis=1)
        chosen = self.count[self.pair_patch] > 0
        self.levels, self.level_ends = np.zeros(u, np.int64), np.zeros((u, self.ends.shape[1]))
        np.maximum.at(self.levels, self.pair_vertex[chosen], self.count[self.pair_patch[chosen]])
        np.add.at(self.level_ends, self.pair_vertex[chosen], self.ends[self.pair_patch[chosen]])
        self.level_ends /= np.maximum(with_layers, 1)[:, None]
        self._pair_sides()

    def _pair_sides(self) -> None:
        """Find the side of another wall polygon at each side of one; layers end where there is none, or several."""
        begin, end = self.corners, self.corners[following(self.starts)]
        low, high = np.minimum(begin, end), np.maximum(begin, end)
        _, edge, number = np.unique(low * len(self.vertices) + high, return_inverse=True, return_counts=True)
        edge = edge.reshape(-1)
        order = np.argsort(edge, kind="stable")
        twice = (number == 2)[edge[order]]
        sides = order[twice].reshape(-1, 2)
        self.beyond = np.arange(len(begin))
        self.beyond[sides], self.begin, self.end = sides[:, ::-1], begin, end
        alone = np.flatnonzero(self.beyond == np.arange(len(begin)))
        self.way[np.concatenate([begin[alone], end[alone]])] = 0
        self._keep_short_sides()

    def _keep_short_sides(self) -> None:
        """Make both ends of a side move alike, so that no side within a patch loses more than half of its length.

        The normals of a curved wall at its vertices are those of the polygons there, and as rough as these.
        """
        x, smooth = self.faces.points[self.vertices], self.way.any(axis=1) & (self.n_patches == 1)
        sides = np.flatnonzero(smooth[self.begin] & smooth[self.end])
        a, b = self.begin[sides], self.end[sides]
        side = x[b] - x[a]
        for _ in range(_EVENED):
            change = ((self.way[b] - self.way[a]) * side).sum(axis=1)
            short = change < -_SHORTENED * (side * side).sum(axis=1)
            rows = np.concatenate([a[short], b[short]])
            total, count = self.way.copy(), np.ones(len(x))
            np.add.at(total, rows, self.way[np.concatenate([b[short], a[short]])])
            np.add.at(count, rows, 1)
            if not len(rows):
                return
            self.way = total / count[:, None]

    def _onto_patches(self, rows: np.ndarray, places: np.ndarray, bare: bool = False) -> np.ndarray:
        """Return `places` (k, 3) of the vertices `rows` (k,), as far from their patches as the vertices are.

        `bare`: only from those without layers.
        """
        place = np.full(len(self.vertices), -1)
        place[rows] = np.arange(len(rows))
        mine = place[self.pair_vertex] >= 0
        if bare:
            mine &= self.count[self.pair_patch] == 0
        row, patch, normal = place[self.pair_vertex[mine]], self.pair_patch[mine], self.pair_normal[mine]
        found, off = places.copy(), np.empty((len(row), 3))
        patches = [(p, np.flatnonzero(patch == p)) for p in np.unique(patch).tolist()]
        for p, k in patches:
            x = self.faces.points[self.vertices[rows[row[k]]]]
            high = ((x - self.solid.feet_on_patch(p, x)) * normal[k]).sum(axis=1)
            off[k] = high[:, None] * normal[k]
        for _ in range(3):  # by turns, where there are several
            for p, k in patches:
                found[row[k]] = self.solid.feet_on_patch(p, found[row[k]]) + off[k]
        return found

    @cached_property
    def sizes(self) -> np.ndarray:
        """Size h at each vertex: the mean of the cells at walls, (u,)."""
        h = np.cbrt(self.faces.volumes[self.faces.owner[self.rows]])[self.face]
        count = np.bincount(self.corners, minlength=len(self.vertices))
        return np.bincount(self.corners, h, len(self.vertices)) / count

    @property
    def _reach(self) -> np.ndarray:
        """How far from each vertex that moves others follow it, (u,)."""
        return INNER_DEPTH * self.sizes + DEEPER * np.linalg.norm(self.way, axis=1)

    @cached_property
    def _room(self) -> np.ndarray:
        """How far each vertex is, on its way, from another wall, (u,); inf if that is far, or it does not move."""
        length = np.linalg.norm(self.way, axis=1)
        room, rows = np.full(len(length), np.inf), np.flatnonzero(length)
        x = self.faces.points[self.vertices[rows]]
        order = np.argsort(~(self.count[self.pair_patch] > 0), kind="stable")  # those with layers first
        patch = np.zeros(len(self.vertices), np.int64)
        patch[self.pair_vertex[order[::-1]]] = self.pair_patch[order[::-1]]
        far = 2 * self._reach[rows]
        room[rows] = self.solid.clearance(x, self.way[rows] / length[rows, None], far, patch[rows])
        return room

    def first_shares(self) -> np.ndarray:
        """Return the shares (u,) of the full way that vertices move: less in gaps, and near places without layers."""
        length = np.linalg.norm(self.way, axis=1)
        share, rows = (length > 0).astype(float), np.flatnonzero(length)
        share[rows] = np.minimum(1, OF_GAP * self._room[rows] / length[rows])
        return self.smooth(share)

    def smooth(self, share: np.ndarray) -> np.ndarray:
        """Return `share` (u,), made smaller where it would change too fast along walls, or is near 0."""
        share = np.where(share < _LEAST, 0.0, share)
        length = np.linalg.norm(self.way, axis=1)
        sides = np.flatnonzero(self.layered[self.face])
        a, b = self.begin[sides], self.end[sides]
        apart = np.linalg.norm(np.diff(self.faces.points[self.vertices[np.stack([a, b])]], axis=0)[0], axis=1)
        while True:
            high = share * length
            most = np.full(len(share), np.inf)
            for here, there in ((a, b), (b, a)):
                np.minimum.at(most, here, high[there] + _SLOPE * apart)
            lower = np.where(most < high, most / np.maximum(length, 1e-300), share)
            lower[lower < _LEAST] = 0.0
            # Prisms with thickness at one corner only would be slivers.
            active = np.bincount(self.face, lower[self.corners] > 0, len(self.rows))
            lone = self.layered & (active == 1)
            lower[self.corners[lone[self.face]]] = 0.0
            if (lower >= share - 1e-3).all():
                return np.minimum(share, lower)
            share = np.minimum(share, lower)

    def thinner(self, share: np.ndarray, rejected: _RejectedCells) -> np.ndarray:
        """Return the shares (u,), smaller at the vertices of `rejected`, and around them where they are 0 already.

        Layers end where vertices have been bad more than `_THINNED` times, each time farther around them. Corners of
        rejected cells stay where they are from then on.
        """
        bad, blamed = rejected.vertices, self._blamed
        blamed[bad] += 1
        leader = self._leader[rejected.corners]
        self._stays[rejected.corners[(leader >= 0) & (share[leader] == 0)]] = True
        less = share.copy()
        less[bad] *= np.where(blamed[bad] > _THINNED, 0, _THINNER)
        rings = np.zeros(len(share), np.int64)
        rings[bad] = np.where(share[bad] == 0, blamed[bad] - _THINNED, 0)
        for _ in range(rings.max(initial=0) - 1):
            np.maximum.at(rings, self.end, rings[self.begin] - 1)
        less[rings > 0] = 0
        return self.smooth(less)

    # Vertices that follow.

    @cached_property
    def _followers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices that follow others: which, the nearest of the others, and its weight as a first guess, (b,) each.

        First those of walls with layers, which slide along their patches, as vertices of creases move; then all others
        near walls that move.
        """
        x, moving = self.faces.points, self.way.any(axis=1)
        found = []
        taken = np.zeros(len(x), bool)
        taken[self.vertices[self.column]] = True
        creases = moving & (self.n_patches > 1)
        smooth = moving & (self.n_patches < 3)
        # Along a wall up to the middle between two creases.
        half = np.minimum(self._reach, self._room / 2 / np.sqrt(self.n_patches))
        slides = (creases, self.vertices[smooth], half)
        for leaders, free, reach in (slides, (moving, np.flatnonzero(~taken), self._reach)):
            leaders = np.flatnonzero(leaders)
            if not len(leaders):
                continue
            reach = reach[leaders]
            tree = scipy.spatial.KDTree(x[self.vertices[leaders]])
            away, near = tree.query(x[free], distance_upper_bound=reach.max())
            rows = np.flatnonzero(np.isfinite(away))
            rows = rows[away[rows] < reach[near[rows]]]
            found.append((free[rows], leaders[near[rows]], 1 - away[rows] / reach[near[rows]]))
        who, near, weight = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return who, near, weight

    @cached_property
    def _outward(self) -> np.ndarray:
        """Vertices of creases that move away from their polygons, (u,) bool, as at concave creases.

        Other vertices of the wall follow them along it, but the points above these, on the surface, stay.
        """
        arm = self.faces.center[self.rows][self.face] - self.faces.points[self.vertices[self.corners]]
        inward = (arm * self.way[self.corners]).sum(axis=1) * self.layered[self.face]
        return (np.bincount(self.corners, inward, len(self.vertices)) < 0) & (self.n_patches > 1)

    @cached_property
    def _wall(self) -> np.ndarray:
        """Row in `vertices` of each vertex of the mesh, -1 inside, (v,)."""
        wall = np.full(len(self.faces.points), -1)
        wall[self.vertices] = np.arange(len(self.vertices))
        return wall

    @cached_property
    def _leader(self) -> np.ndarray:
        """Row in `vertices` of each vertex of the mesh, or of the one that it follows; -1 for others, (v,)."""
        wall, (band, leader, _) = self._wall.copy(), self._followers
        inside = wall[band] < 0
        wall[band[inside]] = leader[inside]
        return wall

    @cached_property
    def _links(self) -> scipy.sparse.csr_array:
        """Weights of the neighbors of each vertex that follows, (b, v). Those of walls are on the same walls."""
        f, band, wall = self.faces, self._followers[0], self._wall
        place = np.full(len(f.points), -1)
        place[band] = np.arange(len(band))
        begin, end = f.corners, f.corners[following(f.starts)]
        begin, end = np.concatenate([begin, end]), np.concatenate([end, begin])
        kept = place[begin] >= 0
        key = distinct(begin[kept].astype(np.int64) * len(f.points) + end[kept])
        begin, end = key // len(f.points), key % len(f.points)
        on = np.flatnonzero(wall[begin] >= 0)
        first = np.searchsorted(self.pair_vertex, np.arange(len(self.vertices) + 1))
        starts, patch = take_rows(first, self.pair_patch, wall[begin[on]])
        other = np.repeat(wall[end[on]], np.diff(starts))
        known = self.pair_vertex * self.solid.n_patches + self.pair_patch
        shared = (other >= 0) & np.isin(other * self.solid.n_patches + patch, known)
        fits = np.ones(len(begin), bool)
        fits[on] = np.add.reduceat(shared, starts[:-1]) == np.diff(starts) if len(on) else True
        begin, end = begin[fits], end[fits]
        row = place[begin]
        weight = 1 / np.maximum(np.linalg.norm(f.points[end] - f.points[begin], axis=1), 1e-300)
        return scipy.sparse.csr_array((weight, (row, end)), (len(band), len(f.points)))

    def moved(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where each vertex of the mesh moves, (v, 3), and the points of walls above these, (u, 3)."""
        x = self.faces.points
        way, moved = share[:, None] * self.way, np.zeros_like(x)
        band, near, weight = self._followers
        on = np.flatnonzero(self._wall[band] >= 0)
        rows, leaders = self._wall[band[on]], near[on]
        links, sums = self._links, np.maximum(self._links.sum(axis=1), 1e-300)
        slides, back = links[on][:, self.vertices], np.where(self._outward, way.T, 0).T
        whole, above, stays = way.copy(), way.copy(), self._stays[self.vertices]
        for sweep in range(_SWEEPS + 1):
            for field, source in ((whole, 0), (above, back)):
                pull = (
                    slides @ (field - source) / sums[on, None] if sweep else weight[on, None] * (way - source)[leaders]
                )
                field[rows] = way[rows] + np.einsum("uij,uj->ui", self.along[rows], pull) * ~stays[rows, None]
        moved[self.vertices] = whole
        inside = np.flatnonzero(self._wall[band] < 0)
        moved[band[inside]] = 0
        pulls, start = links[inside] @ moved, self._last
        if start is None:
            start = weight[inside, None] * moved[self.vertices[near[inside]]]
        matrix = scipy.sparse.diags_array(sums[inside]) - links[inside][:, band[inside]]
        inverse = scipy.sparse.diags_array(1 / sums[inside])
        for a in range(3):
            found, _ = scipy.sparse.linalg.cg(
                matrix, pulls[:, a], start[:, a], rtol=_RESIDUAL, maxiter=_MOST, M=inverse
            )
            moved[band[inside], a] = found
        self._last = moved[band[inside]]
        moved[self._stays] = 0
        slid = above - way
        rows = np.flatnonzero(np.linalg.norm(slid, axis=1) > 1e-9 * self.sizes)
        walls = x[self.vertices]
        walls[rows] = self._onto_patches(rows, walls[rows] + slid[rows])
        moved += x
        moved[self.vertices] = walls + way + (whole - above)
        sliding = self.border & whole.any(axis=1) | ~self.column & (whole != above).any(axis=1)
        rows = np.flatnonzero(sliding)
        moved[self.vertices[rows]] = self._onto_patches(rows, moved[self.vertices[rows]], bare=True)
        return moved, walls

    # Prisms.

    def extruded(self, share: np.ndarray) -> _Layered:
        """Return the mesh with layers whose thickness is `share` (u,) of the full one."""
        f = self.faces
        (moved, walls), active = self.moved(share), share > 0
        here = self.layered & (np.bincount(self.face, active[self.corners], len(self.rows)) > 0)
        chosen = np.flatnonzero(here)
        counts = np.where(here, self.count[self.patch], 0)
        innermost = f.n_cells + np.cumsum(counts) - counts
        points, base = self._level_points(moved, walls, active)

        def at(vertices: np.ndarray, level: int) -> np.ndarray:
            """Return the points of wall vertices at a level, 0 on the surface."""
            between = active[vertices] & (level < self.levels[vertices])
            return np.where(between, base[vertices] + level, self.vertices[vertices])

        others = np.setdiff1d(np.arange(len(f)), self.rows[chosen])
        parts = [(*take_rows(f.starts, f.corners, others), f.owner[others], f.neighbor[others])]
        for level in range(int(counts.max(initial=0)) + 1):
            there = chosen[counts[chosen] >= level]
            starts, corners = take_rows(self.starts, self.corners, there)
            outside = innermost[there] + counts[there] - level
            owner = np.where(level == counts[there], f.owner[self.rows[there]], outside - 1)
            neighbor = outside if level else -1 - self.patch[there]
            parts.append((starts, at(corners, level), owner, neighbor))
            if level:
                parts.append(self._sides(level, here, counts, innermost + counts - level, active, at))
        prism = np.repeat(chosen, counts[chosen])
        row = counts[prism] - (np.arange(len(prism)) + f.n_cells - innermost[prism])
        return self._assembled(parts, points, moved, prism, row, others)

    def _level_points(self, moved: np.ndarray, walls: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the moved vertices and those of all levels but the innermost, (k, 3), and the first of these, (u,)."""
        counts = np.where(active, self.levels, 0)
        base = len(moved) + np.cumsum(counts) - counts
        vertex, level = rows_and_places(counts)
        way = moved[self.vertices[vertex]] - walls[vertex]
        points = walls[vertex] + self.level_ends[vertex, level][:, None] * way
        sliding = np.flatnonzero(self.border[vertex] & (level > 0))
        for k in np.unique(level[sliding]).tolist():
            rows = sliding[level[sliding] == k]
            points[rows] = self._onto_patches(vertex[rows], points[rows], bare=True)
        return np.concatenate([moved, points]), base

    def _sides(
        self,
        level: int,
        here: np.ndarray,
        counts: np.ndarray,
        prism: np.ndarray,
        active: np.ndarray,
        at: Callable[[np.ndarray, int], np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the faces between levels `level` - 1 and `level` as starts, corners, owners and neighbors."""
        face, other = self.face, self.face[self.beyond]
        there = here[face] & (counts[face] >= level) & (active[self.begin] | active[self.end])
        inner = there & here[other]
        side = np.flatnonzero((inner & (face < other)) | (there & ~here[other]))
        a, b = self.begin[side], self.end[side]
        corners = np.stack([at(a, level), at(b, level), at(b, level - 1), at(a, level - 1)], axis=1)
        kept = np.stack([active[a], np.ones(len(a), bool), active[b], np.ones(len(a), bool)], axis=1)
        neighbor = np.where(inner[side], prism[other[side]], -1 - self.patch[other[side]])
        return np.append(0, np.cumsum(kept.sum(axis=1))), corners[kept], prism[face[side]], neighbor

    def _assembled(
        self,
        parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
        points: np.ndarray,
        moved: np.ndarray,
        prism: np.ndarray,
        row: np.ndarray,
        kept: np.ndarray,
    ) -> _Layered:
        """Put all faces together; the first ones are the faces `kept` (k,) of the mesh without layers."""
        f = self.faces
        counts = np.concatenate([np.diff(part[0]) for part in parts])
        corners, owner, neighbor = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
        inside = neighbor >= 0
        order = np.lexsort((np.where(inside, neighbor, owner), np.where(inside, owner, -neighbor), ~inside))
        starts, corners = take_rows(np.append(0, np.cumsum(counts)), corners, order)
        moved = moved - f.points
        sides, face = f.sides()
        number = np.diff(f.starts)[face]
        total = np.add.reduceat(moved[f.corners], f.starts[:-1])[face]
        way = _sums(sides, total) / np.bincount(sides, number)[:, None]
        k = len(order)
        made = replace(
            f,
            generators=np.concatenate([f.generators + way, np.zeros((len(prism), 3))]),
            points=points,
            starts=starts,
            corners=corners.astype(np.int32),
            owner=owner[order].astype(np.int32),
            neighbor=neighbor[order].astype(np.int32),
            twin=np.full(k, -1),
            shift=np.zeros((k, 3), np.int8),
            half_face=np.append(kept, np.full(k - len(kept), -1))[order],
            layer=np.concatenate([np.zeros(f.n_cells, np.int16), row.astype(np.int16)]),
        ).compact()
        return _Layered(self._flattened(made), prism)

    def _flattened(self, faces: Faces) -> Faces:
        """Return a mesh with layers in which small faces of inner cells bulge out less where that helps.

        Their inner vertices move by the distance of the face's center from the plane of the face that it is beyond.
        """
        none = np.zeros(faces.n_cells - self.faces.n_cells, bool)
        near, around = self._near
        around = np.append(around, ~none)
        part, number = faces.part(around)
        judged = np.append(near & ~self._rejected_before, none)[around]
        inner = judged_thoroughly(part)[1] & (part.neighbor >= 0)
        free = np.ones(len(part.points), bool)
        free[take_rows(part.starts, part.corners, np.flatnonzero(~inner))[1]] = False
        points, fewest = faces.points, np.inf
        for _ in range(_FLATTENED + 1):
            (one, other), cells, _ = part.measures.concave_pairs(judged=judged)
            if len(cells) < fewest:
                fewest, points = len(cells), points.copy()
                points[number] = part.points
            if not len(cells):
                break
            g = part.measures.geometry
            normal = g.areas[one] * np.where(part.owner[one] == cells, 1, -1)[:, None]
            normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
            beyond = ((g.centers[other] - g.centers[one]) * normal).sum(axis=1)
            rows = np.flatnonzero(part.area[other] <= part.area[one])
            starts, corners = take_rows(part.starts, part.corners, other[rows])
            of, moving = rows_of(starts), free[corners]
            share = np.bincount(of, moving, len(rows)) / np.diff(starts)
            step = _FARTHER * np.maximum(beyond[rows], 0) / np.maximum(share, _LEAST_FREE)
            rows, corners = rows[of[moving]], corners[moving]
            total = np.stack([np.bincount(corners, -normal[rows, k] * step[of[moving]], len(free)) for k in range(3)])
            number_of = np.maximum(np.bincount(corners, minlength=len(free)), 1)
            part = replace(part, points=part.points + (total / number_of).T)
        return replace(faces, points=points)

    # What is wrong.

    @cached_property
    def _near(self) -> tuple[np.ndarray, np.ndarray]:
        """Cells with vertices that may move, and these with their neighbors, (n,) bool each."""
        f, moving = self.faces, np.zeros(len(self.faces.points), bool)
        moving[self._followers[0]] = moving[self.vertices[self.column]] = True
        face = rows_with(f.starts, moving[f.corners])
        near = np.zeros(f.n_cells, bool)
        k = f.n_inner
        near[f.owner[face]] = near[f.neighbor[:k][face[:k]]] = True
        around = near.copy()
        around[f.owner[:k][near[f.neighbor[:k]]]] = around[f.neighbor[:k][near[f.owner[:k]]]] = True
        return near, around

    @cached_property
    def _rejected_before(self) -> np.ndarray:
        """Cells that OpenFOAM rejects without layers, (n,) bool."""
        return self._rejected_of(self.faces, *self._near)

    def _rejected_of(self, faces: Faces, judged: np.ndarray, kept: np.ndarray) -> np.ndarray:
        """Return which of the cells `judged` (n,) OpenFOAM rejects; measures are those of the cells `kept`."""
        part, found = faces.part(kept)[0], np.zeros(faces.n_cells, bool)
        bad = rejected_cells(part, np.arange(len(part)), judged[kept])
        steep = part.measures.non_orthogonality > _STEEP
        bad[part.owner[steep]] = bad[part.neighbor[steep]] = True  # no wall has an angle
        if part.layer is not None:  # thinner prisms would not be better
            bad &= (part.layer == 0) | (part.measures.aspect_ratio < _FLAT)
        found[np.flatnonzero(kept)] = bad
        return found & judged

    def without(self, bulging: np.ndarray) -> _LayeredWalls:
        """Return the walls of the mesh without those faces `bulging` (f,) bool that can go, or these if none can."""
        faces, none = self.faces, np.zeros(len(bulging), bool)
        made = collapse_short(faces, None, bulging, suspects=none)
        if len(made) < len(faces) and (spoiled := spoiled_near_walls(faces, made) & ~self._rejected_before).any():
            spoiled = with_neighbors(faces, spoiled)
            held = spoiled[faces.owner] | spoiled[np.maximum(faces.neighbor, 0)]
            made = collapse_short(faces, None, bulging & ~held, ~held, none)
        if len(made) == len(faces):
            return self
        walls = _LayeredWalls(self.solid, made, self.layers)
        walls.row_before = _nearest(self.faces.points[self.vertices], made.points[walls.vertices])
        walls._rejected_before, walls._blamed = self._rejected_before, self._blamed[walls.row_before]
        walls._stays = self._stays[_nearest(self.faces.points, made.points)]
        return walls

    def rejected(self, made: _Layered) -> _RejectedCells:
        """Return the cells that OpenFOAM rejects because of layers."""
        n, g = self.faces.n_cells, self.faces
        near, around = (np.concatenate([mask, np.ones(len(made.wall), bool)]) for mask in self._near)
        bad = self._rejected_of(made.faces, near, around)
        bad[:n] &= ~self._rejected_before
        count, core = int(bad.sum()), bad[:n]
        # The vertices of their prisms, those of bad cells, and those that these follow.
        sides, face = g.sides()
        _, corners = take_rows(g.starts, g.corners, face[core[sides]])
        corners = distinct(corners)
        found = self._leader[corners]
        of_prisms = self.corners[np.isin(self.face, made.wall[np.flatnonzero(bad[n:])])]
        vertices = distinct(np.concatenate([of_prisms, found[found >= 0]]))
        bad[n:] = False
        part = made.faces.part(around)[0]
        rows, bulging = part.half_face[narrow_faces(part, np.cbrt(part.volumes), bad[around])], np.zeros(len(g), bool)
        bulging[rows[rows >= 0]] = True
        return _RejectedCells(count, vertices, corners, bulging)

    def reached(self, share: np.ndarray, layers: Sequence[Layers]) -> list[dict[str, float]]:
        """Return how thick the `layers` are; `share` (u,) is that at vertices. Warn where they are thin."""
        sums = np.add.reduceat(share[self.corners], self.starts[:-1])
        mean = sums / np.diff(self.starts)
        area, center, found = self.faces.area[self.rows], self.faces.center[self.rows], []
        for k, layer in enumerate(layers):
            rows = np.flatnonzero(np.isin(self.patch, self.solid.boundaries.select("Layers edges", layer.edges)))
            part, weight, thick = mean[rows], area[rows], layer.thickness
            full = float(weight[part >= _FULL].sum() / weight.sum())
            average = float((part * weight).sum() / weight.sum())
            least, most = thick * float(part.min()), thick * float(part.max())
            found.append({"asked": thick, "min": least, "mean": thick * average, "max": most, "full_share": full})
            if part.min() < _FULL:
                place = format_point(center[rows[part.argmin()]])
                remedy = (
                    "Use thinner layers or smaller cells there, or give the patches around them layers, too"
                    if most > 0
                    else "On curved walls each layer must be higher than a polygon of the wall bends: use thicker "
                    "layers or smaller cells"
                )
                warn(
                    f"{thickness_in_words(found)[k]}: {np.count_nonzero(part < _FULL)} of {len(rows)} wall polygons "
                    "have thinner ones, or none, because of gaps, sharp edges or borders, or curved walls, the "
                    f"thinnest at {place}. {remedy}",
                    MismatchWarning,
                )
        return found


def _nearest(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return for each of `places` (k, 3) the row of the nearest of `points` (n, 3), (k,) int."""
    return scipy.spatial.KDTree(points).query(places)[1]


def _sums(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sum of the `values` (k, ...) of each row, (r, ...)."""
    total = np.zeros((int(rows.max()) + 1, *values.shape[1:]))
    np.add.at(total, rows, values)
    return total
