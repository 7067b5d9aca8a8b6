"""Walls in 2D: what the cells of a polygon look like in the mesh for solvers.

Each cell is taken without the boundary first: convex, between the bisectors with other generators. A vertex of these
cells has a name, the three generators that meet there. The boundary is asked once for each name, so that all cells with
the vertex agree: does it lie inside, outside, or on the boundary? Then

- a face between two vertices inside stays as it is,
- a face that leaves the domain ends where it crosses the boundary,
- a face outside vanishes,
- a gap that is left in the outline of a cell is closed along the boundary: by one straight face, or by several with the
  convex corners of the domain and the ends of its named parts between them.

Runs let faces end in the re-entrant corners of the domain. So all cells are convex, and what is smaller than a cell is
left out: needles, slits, stairs of pixels, points in which islands touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ..connectivity import components, first_nodes, rows_of, starts_of
from ..geometry.polygon import Polygon
from ..geometry.rings import WALL_CORNER, OrientedRings
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.straightening import chain_areas, choose_corners, cross

FAR = 20.0
"""Distance of four additional generators, which close all cells, over the extent of the domain."""
ON_WALL = 0.1
"""Vertices that are nearer to the boundary than this lie on it, over the width of the thinnest cell there."""
BEHIND_WALL = 2.0
"""Length over that distance from which on a face that leads outward from a vertex on the boundary is kept."""
SNAP = 0.12
"""A face ends in a convex corner of the domain, or at the end of a named part of it, that is nearer than this along the
boundary, over the width of its cells."""
AROUND = 4.0
"""Largest area between a wall face and the boundary behind it, over that of the cell."""
BULGE = 1e-4
"""Turn, in radians, of a wall at the end of a named part where the boundary is re-entrant between two face ends."""
NO_LENGTH = 1e-9
"""Length of a face over the size of its cell at which its ends are one point."""
CLOSED = 1e-3
"""Length of a face between two points on the boundary over the size of its cell at which they are one.

So throats close, of which a determinant of OpenFOAM would vanish, and the mouths of slits."""
INSIDE, ON, OUTSIDE = 1, 0, -1
"""Places of a vertex."""


class RingCoordinate:
    """The length along the rings of a polygon, one ring after the other, with the domain on the left.

    The positions of a ring reach from that of its first vertex to that of the next ring's first vertex, without it.

    - `begins` (k + 1,) float64: position of each vertex of `rings`, and the length of all rings.
    - `ring_starts` (r + 1,) int64: first vertex of each ring.
    """

    def __init__(self, domain: Polygon) -> None:
        self.domain, self.rings = domain, domain.oriented
        self.begins = np.concatenate([[0.0], np.cumsum(self.rings.lengths)])
        self.ring_starts = self.rings.ring_starts.astype(np.int64)

    def ring_of(self, s: np.ndarray) -> np.ndarray:
        """Return the ring of each position, (k,) int."""
        return self.begins[self.ring_starts[1:-1]].searchsorted(s, side="right")

    def span(self, ring: int) -> tuple[float, float]:
        """Return the first position of a ring, and its length."""
        begin, end = self.begins[self.ring_starts[ring : ring + 2]].tolist()
        return begin, end - begin

    def position(self, edge: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the positions at `share` (k,), from 0 to 1, of edges (k,), given by their first vertices."""
        s, end = self.begins[edge] + share * self.rings.lengths[edge], self.begins[edge + 1]
        return np.where(s < end, s, self.begins[self.rings.next_vertex[edge]])

    def edges(self, s: np.ndarray) -> np.ndarray:
        """Return the edge at each position, by its first vertex."""
        found = self.begins.searchsorted(s, side="right") - 1
        return np.minimum(np.maximum(found, 0), len(self.begins) - 2)

    def points(self, s: np.ndarray) -> np.ndarray:
        """Return the points at positions (k,): (k, 2), on curves if the boundary has some."""
        edge = self.edges(s)
        share = (s - self.begins[edge]) / self.rings.lengths[edge]
        found = self.rings.vertices[edge] + share[:, None] * self.rings.along[edge]
        return self.domain.on_curve(found, self.rings.edge_numbers[edge]) if self.domain.curves else found


@dataclass(frozen=True)
class ConvexFaces:
    """The faces between the convex cells of generators in the whole plane.

    - `left`, `right` (f,) int: generators on both sides of the way from `begin` to `end`.
    - `begin`, `end` (f,) int: rows of `vertices`.
    - `vertices`: (v, 2) float64
    """

    left: np.ndarray
    right: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    vertices: np.ndarray


def convex_faces(points: np.ndarray, weights: np.ndarray, extent: float) -> ConvexFaces:
    """Return the faces of the power diagram of `points` (n, 2) with `weights` (n,).

    Without weights its dual is the Delaunay triangulation, else the lower hull of the points (x, y, x^2 + y^2 - w)
    (Aurenhammer 1987, SIAM J. Comput. 16, 78). Its vertices within `extent` are right.
    """
    n, low = len(points), points.min(axis=0)
    extent = max(extent, float(np.sqrt(np.ptp(weights))))
    around = np.array([(1.0, 0.3), (-0.3, 1.0), (-1.0, -0.3), (0.3, -1.0)])
    x = np.concatenate([points - low, FAR * extent * around])
    w = np.concatenate([weights, np.full(4, weights.min())])
    if np.ptp(weights):
        hull = scipy.spatial.ConvexHull(np.column_stack([x, (x**2).sum(axis=1) - w]))
        lower = hull.equations[:, 2] < 0
        triangles, neighbors = hull.simplices[lower], hull.neighbors[lower]
        neighbors = np.where(lower, np.cumsum(lower) - 1, -1)[neighbors]
    else:
        dual = scipy.spatial.Delaunay(x)
        triangles, neighbors = dual.simplices, dual.neighbors
    a, b, c = x[triangles].swapaxes(0, 1)
    turned = cross(b - a, c - a) < 0
    triangles, neighbors = (np.where(turned[:, None], t[:, [0, 2, 1]], t) for t in (triangles, neighbors))
    a, b, c = x[triangles].swapaxes(0, 1)
    ab, ac = b - a, c - a
    wa, wb, wc = w[triangles].T
    # The point v of equal power: 2 ab . (v - a) = |ab|^2 - (wb - wa), and the same with c.
    p, q = (ab**2).sum(axis=1) - (wb - wa), (ac**2).sum(axis=1) - (wc - wa)
    across = np.column_stack([p * ac[:, 1] - q * ab[:, 1], q * ab[:, 0] - p * ac[:, 0]])
    vertices = low + a + across / (2 * cross(ab, ac))[:, None]
    # The face between the generators of a side leads from the triangle on its right to that on its left.
    left, right = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()
    here, there = np.repeat(np.arange(len(triangles)), 3), neighbors.ravel()
    once = (left < n) & (right < n) & (there > here)
    return ConvexFaces(left[once], right[once], there[once], here[once], vertices)


def straight_walls(diagram: Diagram, domain: Polygon, parts: np.ndarray) -> Faces:
    """Return the mesh for solvers of `diagram` in `domain`; see the head of this module.

    - `domain`: that of the diagram.
    - `parts` (k,) int: index of the named part of the boundary for each wall. A face on the boundary has walls of one
      part.
    """
    maker = _WallMaker(diagram, domain, parts)
    maker.place_vertices()
    maker.cut_faces()
    maker.name_points()
    maker.move_into_corners()
    maker.close_cells()
    return maker.faces()


class _WallMaker:
    """The steps from convex cells to a mesh, and what they find.

    - `convex`: ConvexFaces
    - `size` (n,) float64: square root of the area of each cell.
    - `width` (f,) float64: the least size, or distance to another generator, of the two cells of each face.
    - `least` (v,) float64: the least width of the faces at each vertex.
    - `place` (v,) int: `INSIDE`, `ON` (the boundary) or `OUTSIDE`.
    - `kept` (f,) bool: whether a part of the face lies inside.
    - `crossed` (f, 2) float64: position on the boundary where the face ends, for both ends; nan for an end in a vertex.
    - `ends` (f, 2) int: points of the faces that are kept.
    - `points`: (p, 2) float64
    - `position` (p,) float64: position of points on the boundary; nan for others.
    - `walls` tuple of (w,) int, (w,) int and (w, 2) int: faces on the boundary: cells, walls, points.
    """

    def __init__(self, diagram: Diagram, domain: Polygon, parts: np.ndarray) -> None:
        self.diagram, self.domain = diagram, domain
        self.rings = domain.oriented
        self.generators = diagram.points
        self.along = RingCoordinate(domain)
        self.changes_part = _changes(self.rings, parts)
        self.convex = f = convex_faces(self.generators, diagram.weights, float(domain.extent.max()))
        self.size = np.sqrt(diagram.volumes)
        apart = np.linalg.norm(self.generators[f.right] - self.generators[f.left], axis=1)
        width = self.size.copy()
        for cell in (f.left, f.right):
            np.minimum.at(width, cell, apart)
        self.width = np.minimum(width[f.left], width[f.right])
        self.walls = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2), np.int64)

    def place_vertices(self) -> None:
        """Ask the boundary for the place of each vertex."""
        f, v = self.convex, self.convex.vertices
        self.least = np.full(len(v), np.inf)
        for end in (f.begin, f.end):
            np.minimum.at(self.least, end, self.width)
        used = np.flatnonzero(np.isfinite(self.least))
        self.place = np.full(len(v), OUTSIDE)
        covered = used[self.domain.covers(v[used])]
        self.place[covered] = INSIDE
        reach = ON_WALL * self.least[used, None]
        near = ((v[used] >= self.domain.lower - reach) & (v[used] <= self.domain.upper + reach)).all(axis=1)
        rows, _ = self.domain.edges_within(v[used[near]], reach[near, 0])
        self.place[used[near][rows]] = ON

    def cut_faces(self) -> None:
        """Find the part of each face that is kept."""
        f, x = self.convex, self.generators
        begin, end = self.place[f.begin], self.place[f.end]
        self.kept = (begin >= ON) & (end >= ON)
        self.crossed = np.full((len(begin), 2), np.nan)
        cut = np.flatnonzero((begin + end < 2 * INSIDE) & ((begin != ON) | (end != ON)))
        a, way = f.vertices[f.begin[cut]], f.vertices[f.end[cut]] - f.vertices[f.begin[cut]]
        row, parts = self._parts_inside(a, way)
        length = np.maximum(np.hypot(*way.T), 1e-300)
        middle = (((x[f.left[cut]] + x[f.right[cut]]) / 2 - a) * way).sum(axis=1) / length / length
        margin = ON_WALL * self.width[cut] / length
        on = np.column_stack([begin[cut] == ON, end[cut] == ON])
        # From a vertex inside the part there. A face that both vertices have is whole if it nearly reaches the other.
        low, high, m = parts[:, 0], parts[:, 1], middle[row]
        order = np.lexsort((low - high, (low > m) | (m > high), row))
        first, last = np.searchsorted(row, np.arange(len(cut))), np.searchsorted(row, np.arange(len(cut)), "right") - 1
        seen = first <= last
        first, last, best = (np.minimum(rows, max(len(row) - 1, 0)) for rows in (first, last, order[first * seen]))
        from_begin, from_end = begin[cut] == INSIDE, end[cut] == INSIDE
        part = parts[np.where(from_begin, first, np.where(from_end, last, best))]
        gap = BEHIND_WALL * margin
        whole = from_begin & on[:, 1] & (high[last] >= 1 - gap)
        whole |= ~from_begin & from_end & on[:, 0] & (low[first] <= gap)
        part[whole] = 0, 1, np.nan, np.nan
        self.kept[cut] = seen & (~on.any(axis=1) | (part[:, 1] - part[:, 0] >= gap))
        part[on[:, 0] & (part[:, 0] < margin), 2] = np.nan
        part[on[:, 1] & (part[:, 1] > 1 - margin), 3] = np.nan
        self.crossed[cut] = part[:, 2:]
        spans = np.stack([f.vertices[f.begin], f.vertices[f.end]], axis=1)
        spans[cut] = a[:, None] + part[:, :2, None] * way[:, None]
        # Without a vertex inside, a face may lie on the far side of a thin wall from one of its cells.
        loose = np.flatnonzero(self.kept & (begin != INSIDE) & (end != INSIDE))
        for cells in (f.left, f.right):
            seen = np.zeros(len(loose), bool)
            for share in (0.25, 0.5, 0.75):
                places = (1 - share) * spans[loose, 0] + share * spans[loose, 1]
                hidden = self.domain.crossings(x[cells[loose]], places)[0]
                seen |= np.bincount(hidden, minlength=len(loose)) == 0
            self.kept[loose[~seen]] = False
        # But a cell that would have no face keeps them, as in a lagoon that one cell fills.
        kept = np.flatnonzero(self.kept)
        alone = np.bincount(np.concatenate([f.left[kept], f.right[kept]]), minlength=len(x)) == 0
        self.kept[loose[alone[f.left[loose]] | alone[f.right[loose]]]] = True

    def _parts_inside(self, a: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts of segments from `a` (k, 2) to `a + way` that lie inside: segments (p,) and parts (p, 4).

        A part has its begin and end, from 0 to 1 along the segment, and the positions on the boundary there; nan at an
        end of the segment. Between two crossings a segment is inside or outside: its middle tells.
        """
        row, edge, t, u = self.domain.crossings(a, a + way)
        ends = np.arange(len(a))
        row, t = np.concatenate([ends, row, ends]), np.concatenate([np.zeros(len(a)), t, np.ones(len(a))])
        blank = np.full(len(a), np.nan)
        s = np.concatenate([blank, self.along.position(edge, u), blank])
        kind = np.repeat([0, 1, 2], [len(a), len(edge), len(a)])
        order = np.lexsort((t, kind, row))
        row, t, s = row[order], t[order], s[order]
        middle = (t[:-1] + t[1:]) / 2
        inside = (row[:-1] == row[1:]) & self.domain.covers(a[row[:-1]] + middle[:, None] * way[row[:-1]])
        begins = np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))
        ends = np.flatnonzero(inside & ~np.concatenate([inside[1:], [False]])) + 1
        return row[begins], np.column_stack([t[begins], t[ends], s[begins], s[ends]])

    def name_points(self) -> None:
        """Give each end of a kept face its point.

        A vertex inside is one point. A vertex on the boundary is one point for all cells around it that kept faces
        join: the two sides of a thin wall have a point each.
        """
        f, n = self.convex, len(self.generators)
        kept = np.flatnonzero(self.kept)
        vertex, crossed = np.stack([f.begin[kept], f.end[kept]], axis=1), self.crossed[kept]
        is_crossing = ~np.isnan(crossed)
        on = ~is_crossing & (self.place[vertex] == ON)
        inner = ~is_crossing & ~on
        ends = np.empty(vertex.shape, np.int64)
        used, ends[inner] = np.unique(vertex[inner], return_inverse=True)
        count, crossings = len(used), np.count_nonzero(is_crossing)
        ends[is_crossing] = count + np.arange(crossings)
        row, side = np.nonzero(on)
        at, face = vertex[row, side], kept[row]
        sights = self._ahead_of(at, vertex[row, 1 - side], face)
        feet = self._feet(f.vertices[at], sights, ON_WALL * self.least[at])
        # Two faces end in one point if a cell lies between them, and they come to the same side of the wall.
        cells = np.concatenate([f.left[face], f.right[face]]).astype(np.int64)
        key, of_end = np.tile(at, 2) * n + cells, np.tile(np.arange(len(at)), 2)
        order = np.argsort(key, kind="stable")
        one, two = of_end[order[:-1]], of_end[order[1:]]
        near = (np.diff(key[order]) == 0) & self._are_near(feet[one], feet[two], 2 * ON_WALL * self.least[at[one]])
        _, group = components(len(at), one[near], two[near])
        ends[on] = count + crossings + group
        feet = feet[np.unique(group, return_index=True)[1]]
        self.position = np.concatenate([np.full(count, np.nan), crossed[is_crossing], feet])
        self.points = np.full((len(self.position), 2), np.nan)
        self.points[:count] = f.vertices[used]
        self.ends = np.full((len(self.kept), 2), -1)
        self.ends[kept] = ends

    def _ahead_of(self, vertex: np.ndarray, other: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Return points on faces before they reach `vertex`, half a width of their cells away, (k, 2)."""
        x = self.convex.vertices[vertex]
        way = self.convex.vertices[other] - x
        length = np.maximum(np.hypot(*way.T), 1e-300)
        return x + np.minimum(1, self.width[face] / 2 / length)[:, None] * way

    def _are_near(self, s: np.ndarray, t: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return whether positions on the boundary are on one ring and not farther apart than `reach`, (k,) bool."""
        ring, gap = self.along.ring_of(s), np.abs(s - t)
        total = np.diff(self.along.begins[self.along.ring_starts])[ring]
        return (ring == self.along.ring_of(t)) & (np.minimum(gap, total - gap) <= reach)

    def _feet(self, points: np.ndarray, sights: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return positions within `reach` of `points` (k, 2): re-entrant corners, edges that face `sights`, others."""
        row, edge = self.domain.edges_within(points, 1.001 * reach)
        begin, way = self.rings.vertices[edge], self.rings.along[edge]
        share = np.clip(((points[row] - begin) * way).sum(axis=1) / self.rings.lengths[edge] ** 2, 0, 1)
        at_corner = (self.rings.turns[edge] < -WALL_CORNER) & (np.hypot(*(begin - points[row]).T) <= reach[row])
        share[at_corner] = 0
        off = np.hypot(*(begin + share[:, None] * way - points[row]).T)
        faces_away = cross(way, sights[row] - begin) <= 0
        order = np.lexsort((off, faces_away, ~at_corner, row))
        order = order[np.diff(row[order], prepend=-1) > 0]
        return self.along.position(edge[order], share[order])

    def move_into_corners(self) -> None:
        """Move the nearest face end on the boundary into each convex corner and each end of a named part."""
        width = np.full(len(self.points), np.inf)
        for end in self.ends[self.kept].T:
            np.minimum.at(width, end, self.width[self.kept])
        on = np.flatnonzero(~np.isnan(self.position))
        turns, begins = self.rings.turns, self.along.begins
        corners = np.flatnonzero((turns > WALL_CORNER) | self.changes_part)
        s, ring, near = self.position[on], self.along.ring_of(self.position[on]), []
        ring_of_corner = self.along.ring_of(begins[corners])
        for r in np.intersect1d(ring, ring_of_corner).tolist():
            here, mine = np.flatnonzero(ring == r), np.flatnonzero(ring_of_corner == r)
            place = np.searchsorted(begins[corners[mine]], s[here])
            for k in (mine[place % len(mine)], mine[place - 1]):
                gap = np.abs(begins[corners[k]] - s[here])
                gap = np.minimum(gap, self.along.span(r)[1] - gap)
                near += [(g, c, p) for g, c, p in zip(gap, k, on[here], strict=True) if g <= SNAP * width[p]]
        taken: set[int] = set()
        moved: set[int] = set()
        for _, corner, point in sorted(near):
            if corner not in taken and point not in moved:
                taken.add(corner)
                moved.add(point)
                self.position[point] = begins[corners[corner]]
        self.points[on] = self.along.points(self.position[on])

    def close_cells(self) -> None:
        """Close the gaps in the outlines of cells along the boundary."""
        f, n = self.convex, len(self.generators)
        kept = np.flatnonzero(self.kept)
        cell = np.concatenate([f.left[kept], f.right[kept]])
        toward = self.generators[f.right[kept]] - self.generators[f.left[kept]]
        toward = np.concatenate([toward, -toward])
        ends = np.concatenate([self.ends[kept], self.ends[kept][:, ::-1]])
        # The faces around a convex cell follow each other as their normals do.
        order = np.lexsort((np.arctan2(toward[:, 1], toward[:, 0]), cell))
        cell, ends = cell[order], ends[order]
        starts = np.searchsorted(cell, np.arange(n + 1))
        filled = np.diff(starts) > 0
        after = np.arange(1, len(cell) + 1)
        after[starts[1:][filled] - 1] = starts[:-1][filled]
        gaps = np.flatnonzero(ends[:, 1] != ends[after, 0])
        cell, gap = cell[gaps], np.column_stack([ends[gaps, 1], ends[after[gaps], 0]])
        # Where rings touch, and where a cell touches the boundary, the ends of a gap are on different parts of it.
        straight = self._close(cell, gap)
        walls = self.domain.closest_walls(self.points[gap[straight]].mean(axis=1))
        self._add_walls(cell[straight], walls, gap[straight])
        for c in np.flatnonzero(~filled).tolist():
            self._take_piece(c)

    def _take_piece(self, cell: int) -> None:
        """Give a cell without neighbors the outer ring of its piece of the domain."""
        piece = self.domain.piece_of(self.generators[cell : cell + 1])[0]
        ring = int(np.flatnonzero(self.domain.piece_of_ring == piece)[0])
        first, last = self.rings.ring_starts[ring : ring + 2].tolist()
        begin = len(self.points) + np.arange(last - first)
        self.points = np.concatenate([self.points, self.rings.vertices[first:last]])
        wall = self.rings.edge_numbers[first:last]
        self._add_walls(np.full(last - first, cell), wall, np.column_stack([begin, np.roll(begin, -1)]))

    def _add_walls(self, cell: np.ndarray, wall: np.ndarray, ends: np.ndarray) -> None:
        """Add faces on the boundary: cells, walls, and two points each."""
        cells, walls, points = self.walls
        self.walls = np.append(cells, cell), np.append(walls, wall), np.concatenate([points, ends])

    def _close(self, cell: np.ndarray, gap: np.ndarray) -> np.ndarray:
        """Close gaps from points `gap[:, 0]` to `gap[:, 1]` of cells (g,), with corners of the domain between.

        Results:
        - `left` (k,) int: gaps that are left: their ends are on two rings, or in the opposite order.
        """
        if not len(cell):
            return np.empty(0, np.int64)
        count, along, (s, t) = len(cell), self.along, self.position[gap].T
        every, ring = np.arange(count), along.ring_of(s)
        joined = (ring == along.ring_of(t)) & ~np.isnan(s + t)
        every, cell, gap, s, t, ring = (values[joined] for values in (every, cell, gap, s, t, ring))
        chain, path, starts = self._chains(ring, s, t, gap)
        joined = chain_areas(chain, starts[:-1], starts[1:] - 1) <= AROUND * self.size[cell] ** 2
        left = np.setdiff1d(np.arange(count), every[joined])
        cell, gap, s, t, ring = (values[joined] for values in (cell, gap, s, t, ring))
        chain, path, starts = self._chains(ring, s, t, gap)
        begin = along.begins[along.ring_starts[:-1]][ring]
        total = along.begins[along.ring_starts[1:]][ring] - begin
        row = rows_of(starts)
        chosen = (path < 0) | self.changes_part[path]
        choose_corners(chain, chosen, self.size[cell][row])
        kept = np.flatnonzero(chosen)
        added = path[kept] >= 0
        names = np.empty(len(kept), np.int64)
        names[added] = len(self.points) + np.arange(np.count_nonzero(added))
        corners = _without_dents(chain[kept], added)
        self.points = np.concatenate([self.points, corners[added]])
        row = row[kept]
        kept_starts = np.searchsorted(row, np.arange(len(cell) + 1))
        names[kept_starts[:-1]], names[kept_starts[1:] - 1] = gap.T
        marks = (along.begins[path[kept]] - s[row]) % total[row]
        marks[kept_starts[:-1]], marks[kept_starts[1:] - 1] = 0, (t - s) % total
        side = np.flatnonzero(row[:-1] == row[1:])
        middles = s[row[side]] - begin[row[side]] + (marks[side] + marks[side + 1]) / 2
        edges = along.edges(begin[row[side]] + middles % total[row[side]])
        self._add_walls(
            cell[row[side]], self.rings.edge_numbers[edges], np.column_stack([names[side], names[side + 1]])
        )
        return left

    def _chains(
        self, ring: np.ndarray, s: np.ndarray, t: np.ndarray, gap: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the way along the boundary for each gap: the first point, the vertices between, the last point.

        Ragged rows: points (k, 2), vertices of the domain (k,), -1 for both ends, and starts.
        """
        along = self.along
        begin, end = along.ring_starts[ring], along.ring_starts[ring + 1]
        first = np.maximum(np.searchsorted(along.begins, s, side="right"), begin)
        last = np.clip(np.searchsorted(along.begins, t, side="left"), begin, end)
        count = np.maximum(last - first + np.where(t < s, end - begin, 0), 0)
        starts = starts_of(count + 2)
        row = np.repeat(np.arange(len(count)), count + 2)
        path = first[row] + np.arange(starts[-1]) - starts[row] - 1
        path = begin[row] + (path - begin[row]) % (end - begin)[row]
        chain = along.rings.vertices[path]
        for place, points in ((starts[:-1], gap[:, 0]), (starts[1:] - 1, gap[:, 1])):
            chain[place], path[place] = self.points[points], -1
        return chain, path, starts

    def faces(self) -> Faces:
        """Return the mesh."""
        kept = np.flatnonzero(self.kept)
        left, right = self.convex.left[kept], self.convex.right[kept]
        ends = np.where((left > right)[:, None], self.ends[kept][:, ::-1], self.ends[kept])
        owner, neighbor = np.minimum(left, right), np.maximum(left, right)
        order = np.lexsort((neighbor, owner))
        cell, wall, wall_ends = self.walls
        by_wall, points = np.lexsort((cell, wall)), self.points
        ends = np.concatenate([ends[order], wall_ends[by_wall]])
        owner = np.concatenate([owner[order], cell[by_wall]]).astype(np.int32)
        # Corners of two rings that touch are one point, faces without length vanish, and narrow throats close.
        on_boundary = np.ones(len(points), bool)
        on_boundary[: len(self.position)] = ~np.isnan(self.position)
        least = np.where(on_boundary[ends].all(axis=1), CLOSED, NO_LENGTH) * self.size[owner]
        short = np.hypot(*(points[ends[:, 1]] - points[ends[:, 0]]).T) <= least
        ends = first_nodes(len(points), *ends[short].T)[ends]
        count = len(ends)
        made = Faces(
            domain=self.domain,
            generators=self.generators,
            points=points,
            starts=2 * np.arange(count + 1),
            corners=ends.ravel(),
            owner=owner,
            neighbor=np.concatenate([neighbor[order], -1 - wall[by_wall]]).astype(np.int32),
            twin=np.full(count, -1),
            shift=np.zeros((count, 2), np.int8),
            half_face=np.full(count, -1),
        )
        return made.take_faces(ends[:, 0] != ends[:, 1])


def _changes(rings: OrientedRings, parts: np.ndarray) -> np.ndarray:
    """Return whether the named part of the boundary changes in each vertex of `rings`, (k,) bool."""
    part, found = parts[rings.edge_numbers], np.empty(len(rings.vertices), bool)
    found[rings.next_vertex] = part != part[rings.next_vertex]
    return found


def _without_dents(chains: np.ndarray, movable: np.ndarray) -> np.ndarray:
    """Return points of chains (k, 2), those `movable` (k,) that are re-entrant moved just beyond a straight wall.

    So a cell in whose wall a named part ends is convex.
    """
    x, inner = chains.copy(), np.flatnonzero(movable)
    before, after = x[inner - 1], x[inner + 1]
    way = after - before
    length = np.maximum(np.hypot(*way.T), 1e-300)
    share = ((x[inner] - before) * way).sum(axis=1) / length**2
    off = cross(x[inner] - before, way) / length
    least = BULGE * np.minimum(share, 1 - share) * length
    dents = (off < least) & (share > 0) & (share < 1)
    outward = np.column_stack([way[:, 1], -way[:, 0]]) / length[:, None]
    x[inner[dents]] += ((least - off)[:, None] * outward)[dents]
    return x
