"""Measures of a solver mesh as OpenFOAM's `checkMesh` computes them."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..connectivity import following, rows_of, slices, starts_of, take_rows
from ..mesh.faces import Faces
from ..mesh.geometry import Geometry, cell_geometry, cross_columns, dots, lengths, polygon_sides, smaller_size, sum_rows
from ..mesh.straightening import cross
from .defects import concave_pairs
from .prisms import polyhedra

PLANAR_COSINE = 1e-6
"""Least distance of the center of a face from the plane of another face of its cell, over the distance of both centers;
else the two faces are concave."""
_TINY = 1e-150
_CHUNK = 1 << 13
"""Faces that are read at a time: their arrays fit the caches."""
_ROOTS = {2: np.sqrt, 3: np.cbrt}
_LEAST_QUALITY = 1e-30 * (8 / 27 * 3**0.5)
"""Of a tetrahedron: its volume over the cube of the radius of its circumsphere."""


class SolverMeasures:
    """Measures of a solver mesh, each computed when first used.

    In 2D they are those of one layer of prisms. Measures of faces have one row per face of the solver mesh, then in 2D
    one per bottom and one per top of a cell. Source of the formulas: OpenFOAM v1912, `primitiveMeshTools` and
    `polyMeshTools`. Unknowns are at the centroids.
    """

    def __init__(self, mesh: Faces, thickness: float | None = None) -> None:
        self.mesh, self.thickness = mesh, thickness

    @cached_property
    def cells(self) -> Faces:
        """The cells as polyhedra: in 2D prisms.

        Raises `InputError` in 2D for a cell around an island or one that touches itself, as a face of OpenFOAM has no
        hole.
        """
        return polyhedra(self.mesh, self.thickness)

    @cached_property
    def geometry(self) -> Geometry:
        """Centers, areas, centroids and volumes of the polyhedra."""
        p, k = self.cells, self.mesh.n_inner
        centers, areas = p.vectors
        made = cell_geometry(centers, areas, p.owner, self.mesh.neighbor[:k], self.mesh.n_cells)
        return Geometry(centers, areas, *made)

    @property
    def volumes(self) -> np.ndarray:
        """Volume of each polyhedron, (n,)."""
        return self.geometry.volumes

    @cached_property
    def face_areas(self) -> np.ndarray:
        """Area of each face."""
        return np.linalg.norm(self.geometry.areas, axis=1)

    @cached_property
    def face_cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The cell, the face and the sign of the normal for each side of each face, three arrays (s,)."""
        cell, face = self.cells.sides()
        sign = np.where(np.arange(len(face)) < len(self.cells), 1.0, -1.0)
        return cell, face, sign

    @cached_property
    def coupled(self) -> np.ndarray:
        """Faces with a cell on both sides, those at seams included, (c,) int."""
        return np.flatnonzero(self.mesh.neighbor >= 0)

    @cached_property
    def _across(self) -> np.ndarray:
        """Centroid of the neighbor of each coupled face, beside the owner, (c, 3)."""
        mesh = self.mesh
        period = mesh.shift[self.coupled] * np.array(mesh.domain.extent)
        period = np.pad(period, ((0, 0), (0, 3 - mesh.dim)))
        return self.geometry.centroids[mesh.neighbor[self.coupled]] + period

    @cached_property
    def non_orthogonality(self) -> np.ndarray:
        """Angle in degrees between the normal of each face and the line from centroid to centroid; 0 on walls."""
        g, c = self.geometry, self.coupled
        line = self._across - g.centroids[self.cells.owner[c]]
        angle = np.zeros(len(g.centers))
        across = np.linalg.norm(np.cross(line, g.areas[c]), axis=1)
        angle[c] = np.degrees(np.arctan2(across, np.einsum("ij,ij->i", line, g.areas[c])))
        return angle

    @cached_property
    def skewness(self) -> np.ndarray:
        """Offset of each face's center from the line between the centroids, over the extent of the face that way.

        The least extent is a fifth of the distance of the centroids. On a wall the line is normal to the face.
        """
        g, p = self.geometry, self.cells
        arm = g.centers - g.centroids[p.owner]
        square = np.maximum(np.einsum("ij,ij->i", g.areas, g.areas), _TINY**2)
        line = g.areas * (np.einsum("ij,ij->i", g.areas, arm) / square)[:, None]
        least = 0.4 * np.linalg.norm(line, axis=1)
        line[self.coupled] = self._across - g.centroids[p.owner[self.coupled]]
        least[self.coupled] = 0.2 * np.linalg.norm(line[self.coupled], axis=1)
        along = np.einsum("ij,ij->i", g.areas, line) + _TINY
        offset = arm - (np.einsum("ij,ij->i", g.areas, arm) / along)[:, None] * line
        size = np.linalg.norm(offset, axis=1)
        direction = offset / (size + _TINY)[:, None]
        extent = least
        for part in slices(len(extent), _CHUNK):
            starts = p.starts[part.start : part.stop + 1]
            face = part.start + rows_of(starts)
            arms = p.points.take(p.corners[starts[0] : starts[-1]], axis=0) - g.centers[face]
            reach = np.abs(np.einsum("ij,ij->i", arms, direction[face]))
            extent[part] = np.maximum(np.maximum.reduceat(reach, starts[:-1] - starts[0]), least[part])
        return size / (extent + _TINY)

    @cached_property
    def weight(self) -> np.ndarray:
        """The smaller of the distances of both centroids from the face over their sum; 1/2 is best, 1 on walls."""
        g, c = self.geometry, self.coupled
        here = np.einsum("ij,ij->i", g.areas[c], g.centers[c] - g.centroids[self.cells.owner[c]])
        there = np.einsum("ij,ij->i", g.areas[c], self._across - g.centers[c])
        here, there = np.abs(here), np.abs(there)
        weight = np.ones(len(g.centers))
        weight[c] = np.minimum(here, there) / (here + there + _TINY**2)
        return weight

    @cached_property
    def volume_ratio(self) -> np.ndarray:
        """Smaller over larger volume of the two cells at each face; 1 on walls."""
        v, c = self.geometry.volumes, self.coupled
        here, there = v[self.cells.owner[c]], v[self.mesh.neighbor[c]]
        ratio = np.ones(len(self.cells.owner))
        ratio[c] = np.minimum(here, there) / (np.maximum(here, there) + _TINY**2)
        return ratio

    @cached_property
    def flatness(self) -> np.ndarray:
        """Area of each face over the sum of the areas of its triangles about the center; 1 for a flat convex face."""
        g, p = self.geometry, self.cells
        counts = np.diff(p.starts)
        center = np.repeat(g.centers, counts, axis=0)
        here, there = p.points[p.corners], p.points[p.corners[following(p.starts)]]
        triangles = np.linalg.norm(np.cross(there - here, center - here), axis=1) / 2
        sums = np.add.reduceat(triangles, p.starts[:-1])
        return np.where(counts > 3, self.face_areas / (sums + _TINY), 1.0)

    @cached_property
    def pyramids(self) -> np.ndarray:
        """Smaller volume of the two pyramids of each face, with the centroids of its cells as tips."""
        g, k = self.geometry, self.mesh.n_inner
        arm = g.centers - g.centroids[self.cells.owner]
        volumes = np.einsum("ij,ij->i", g.areas, arm) / 3
        beyond = g.centroids[self.mesh.neighbor[:k]] - g.centers[:k]
        volumes[:k] = np.minimum(volumes[:k], np.einsum("ij,ij->i", g.areas[:k], beyond) / 3)
        return volumes

    @cached_property
    def openness(self) -> np.ndarray:
        """Largest component of the sum of each cell's area vectors over the sum of its absolute values, (n,)."""
        cell, face, sign = self.face_cells
        areas = self.geometry.areas[face] * sign[:, None]
        return (np.abs(sum_rows(cell, areas, self.mesh.n_cells)) / (self._spread + _TINY)).max(axis=1)

    @cached_property
    def _spread(self) -> np.ndarray:
        """Sum of the absolute components of each cell's area vectors, (n, 3)."""
        cell, face, _ = self.face_cells
        return sum_rows(cell, np.abs(self.geometry.areas[face]), self.mesh.n_cells)

    @cached_property
    def aspect_ratio(self) -> np.ndarray:
        """Largest over smallest extent along the axes, and in 3D surface over volume to 2/3 (1 for a cube), (n,)."""
        spread = self._spread[:, : self.mesh.dim]
        ratio = spread.max(axis=1) / (spread.min(axis=1) + _TINY)
        if self.mesh.dim == 2:
            return ratio
        volumes = np.maximum(self.geometry.volumes, _TINY)
        return np.maximum(ratio, spread.sum(axis=1) / (6 * volumes ** (2 / 3)))

    @cached_property
    def determinant(self) -> np.ndarray:
        """Determinant of the sum of products of the area vectors between cells, 1 for a cube within others, (n,)."""
        cell, face, _ = self.face_cells
        between = np.zeros(len(self.cells.owner), bool)
        between[self.coupled] = True
        kept = between[face]
        cell, areas, n = cell[kept], self.geometry.areas[face[kept]], self.mesh.n_cells
        mean = np.bincount(cell, np.linalg.norm(areas, axis=1), n)
        counts = np.bincount(cell, minlength=n)
        scaled = areas / np.maximum(mean / np.maximum(counts, 1), _TINY)[cell][:, None]
        products = (scaled[:, :, None] * scaled[:, None, :]).reshape(-1, 9)
        tensors = sum_rows(cell, products, n).reshape(-1, 3, 3)
        for a in range(self.mesh.dim, 3):
            tensors[:, a, a] = 1
        return np.where(counts > 0, np.abs(np.linalg.det(tensors)) / 8, 0.0)

    @cached_property
    def concave(self) -> np.ndarray:
        """Whether OpenFOAM counts the cell as concave: a face's center is beyond the plane of another one, (n,)."""
        concave = np.zeros(self.mesh.n_cells, bool)
        concave[self.concave_pairs()[1]] = True
        return concave

    def concave_pairs(
        self, limit: float = -PLANAR_COSINE, judged: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pairs of faces with a cosine above `limit`, see `defects.concave_pairs`, of the cells `judged`.

        Results:
        - `faces`: (2, p) int
        - `cells`: (p,) int
        - `sine` (p,) float: how far the center of the second face is beyond the plane of the first, over the distance
          of the centers.
        """
        cell, face, sign = self.face_cells
        places = self.cells.cell_faces()[1]
        places = places if judged is None else places[judged[cell[places]]]
        cell, face = cell[places], face[places]
        starts = starts_of(np.bincount(cell, minlength=self.mesh.n_cells))
        centers = np.ascontiguousarray(self.geometry.centers[face].T)
        areas = np.ascontiguousarray((self.geometry.areas[face] * sign[places, None]).T)
        i, j = concave_pairs(centers, areas, starts, limit, np.ones(len(face), bool))
        line = centers[:, j] - centers[:, i]
        size = np.linalg.norm(areas[:, i], axis=0) * np.linalg.norm(line, axis=0)
        sine = (areas[:, i] * line).sum(axis=0) / np.maximum(size, 1e-300)
        return face[np.stack([i, j])], cell[i], np.maximum(sine, 0)

    @cached_property
    def concavity(self) -> np.ndarray:
        """Largest angle between two faces of each cell beyond 180 degrees, in degrees, (n,)."""
        g, p, (cell, face, sign) = self.geometry, self.cells, self.face_cells
        edge = self.edge_of_corner
        starts, places = take_rows(p.starts, np.arange(len(p.corners)), face)
        side = rows_of(starts)
        order = np.lexsort((edge[places], cell[side]))
        places, side = places[order], side[order]
        pairs = np.flatnonzero((np.diff(edge[places]) == 0) & (np.diff(cell[side]) == 0))
        a, b, places = side[pairs], side[pairs + 1], places[pairs]
        one, two = (g.areas[face[x]] * sign[x, None] for x in (a, b))
        across = np.cross(one, two)
        # Around the first face, counter-clockwise as seen from outside of the cell.
        along = p.points[p.corners[following(p.starts)[places]]] - p.points[p.corners[places]]
        concave = np.einsum("ij,ij->i", across, along) * sign[a] < 0
        size = np.linalg.norm(across, axis=1)
        angle = np.degrees(np.arctan2(size, np.einsum("ij,ij->i", one, two)))
        worst = np.zeros(self.mesh.n_cells)
        np.maximum.at(worst, cell[a], np.where(concave, angle, 0.0))
        return worst

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """The edge that follows each corner of a face, (k,), and the two points of each edge, (e, 2)."""
        p = self.cells
        ends = np.sort(np.stack([p.corners, p.corners[following(p.starts)]], axis=1), axis=1)
        key = ends[:, 0].astype(np.int64) * len(p.points) + ends[:, 1]
        _, first, edge = np.unique(key, return_index=True, return_inverse=True)
        return edge.ravel(), ends[first]

    @property
    def edge_of_corner(self) -> np.ndarray:
        """The edge that follows each corner of a face, (k,)."""
        return self._edges[0]

    @property
    def edges(self) -> np.ndarray:
        """The two points of each edge of the polyhedra, (e, 2)."""
        return self._edges[1]

    @cached_property
    def edge_spans(self) -> np.ndarray:
        """Length of each edge of the polyhedra, (e,)."""
        a, b = self.cells.points[self.edges].swapaxes(0, 1)
        return np.linalg.norm(b - a, axis=1)

    @cached_property
    def bad_tetrahedra(self) -> np.ndarray:
        """Number of OpenFOAM's complaints about each face's tetrahedra with the centroids, (f,) int.

        One for each cell in which a triangle about the face's center has no positive volume. One more if no corner of
        the face is the base of a fan of triangles with positive volumes on both sides.
        """
        return self.bad_tetrahedra_of(np.arange(len(self.cells)))

    def bad_tetrahedra_of(self, faces: np.ndarray) -> np.ndarray:
        """Return `bad_tetrahedra` of some of the faces (k,)."""
        points = np.ascontiguousarray(self.cells.points.T)
        across = np.full((len(self.cells), 3), np.nan)
        across[self.coupled] = self._across
        found = [self._bad_tetrahedra(faces[part], points, across) for part in slices(len(faces), _CHUNK)]
        return np.concatenate([np.zeros(0, int), *found])

    def _bad_tetrahedra(self, faces: np.ndarray, points: np.ndarray, across: np.ndarray) -> np.ndarray:
        """Return `bad_tetrahedra` of `faces`, with the `points` (3, v), and the centroids `across` all faces (f, 3)."""
        g, p = self.geometry, self.cells
        starts, corners = take_rows(p.starts, p.corners, faces)
        counts, x = np.diff(starts), points.take(corners, axis=1)
        y, face = x.take(following(starts), axis=1), np.repeat(np.arange(len(faces)), counts)
        tips = [g.centroids[p.owner[faces]].T, across[faces].T]
        center = g.centers[faces].T.take(face, axis=1)
        bad = np.zeros(len(faces), int)
        for side, rows in ((0, np.arange(len(face))), (1, np.flatnonzero(faces[face] < self.mesh.n_inner))):
            tip = tips[side].take(face[rows], axis=1)
            fine = _positive(x.take(rows, axis=1), y.take(rows, axis=1), center.take(rows, axis=1), tip, side)
            bad += np.bincount(face[rows], ~fine, len(faces)) > 0
        # Fans from the first corner; others only where these fail.
        left, base = np.arange(len(faces)), 0
        while left.size:
            begin, items = take_rows(starts, np.arange(len(corners)), left)
            row = rows_of(begin)
            apart = (np.arange(len(items)) - begin[row] - base) % counts[left][row]
            used = (apart > 0) & (apart < counts[left][row] - 1)
            items, row = items[used], row[used]
            a, b, foot = x.take(items, axis=1), y.take(items, axis=1), x.take(starts[left[row]] + base, axis=1)
            fine = _positive(a, b, foot, tips[0].take(left[row], axis=1), 0)
            two = np.flatnonzero(np.isfinite(tips[1][0, left[row]]))
            a, b, foot = (v.take(two, axis=1) for v in (a, b, foot))
            fine[two] &= _positive(a, b, foot, tips[1].take(left[row[two]], axis=1), 1)
            failed = left[np.bincount(row, ~fine, len(left)) > 0]
            base += 1
            ended = counts[failed] <= base
            bad[failed[ended]] += 1
            left = failed[~ended]
        return bad

    # Short edges and small faces, relative to the size of a cell.

    @cached_property
    def sizes(self) -> np.ndarray:
        """Size of each cell: its volume to the power 1/3, in 2D the root of its area, (n,)."""
        return _ROOTS[self.mesh.dim](np.maximum(self.mesh.volumes, 0))

    @cached_property
    def _face_sizes(self) -> np.ndarray:
        """Smaller size of the cells at each face of the solver mesh, (f,)."""
        smaller = smaller_size(self.mesh.owner, self.mesh.neighbor, self.sizes)
        return np.maximum(smaller, _TINY)

    def _least(self, values: np.ndarray) -> np.ndarray:
        """Return the least of `values` (f,) among the faces of each cell, (n,)."""
        k = self.mesh.n_inner
        least = np.full(self.mesh.n_cells, np.inf)
        np.minimum.at(least, self.mesh.owner, values)
        np.minimum.at(least, self.mesh.neighbor[:k], values[:k])
        return least

    @cached_property
    def shortest_edge(self) -> np.ndarray:
        """Length of the shortest edge of each cell over the smaller size of the cells at its face, (n,)."""
        points, starts, corners = self.mesh.points, self.mesh.starts, self.mesh.corners
        lengths = np.linalg.norm(points[corners[following(starts)]] - points[corners], axis=1)
        return self._least(np.minimum.reduceat(lengths, starts[:-1]) / self._face_sizes)

    @cached_property
    def smallest_face(self) -> np.ndarray:
        """Area of the smallest face of each cell over the square of the smaller size of its cells; 2D: length, (n,)."""
        return self._least(self.mesh.area / self._face_sizes ** (self.mesh.dim - 1))

    def line(self) -> str:
        """Return the worst of the measures as one line of text."""
        s = self.summary()
        return (
            f"non-orthogonality mean {s['mean_non_orthogonality']:.2f}°, max {s['max_non_orthogonality']:.1f}°; "
            f"skewness max {s['max_skewness']:.2f}; concave cells {s['concave_cells']}; shortest edge "
            f"{s['min_edge']:.2g} of a cell, 1 % below {s['edge_percentile_1']:.2g}"
        )

    def __repr__(self) -> str:
        return f"SolverMeasures({self.line()})"

    def summary(self) -> dict[str, float]:
        """Return the extremes, the means and for edges and faces the percentiles, by name."""
        c = self.coupled
        # Of the two faces at a seam only one counts, the lower one.
        angle = self.non_orthogonality[c[self.mesh.twin[c] < c]]
        found = {
            "max_non_orthogonality": float(angle.max(initial=0)),
            "mean_non_orthogonality": _mean_angle(angle),
            "max_skewness": float(self.skewness.max(initial=0)),
            "max_concavity": float(self.concavity.max(initial=0)),
            "concave_cells": int(self.concave.sum()),
        }
        for name, values in (("edge", self.shortest_edge), ("face", self.smallest_face)):
            found[f"min_{name}"] = float(values.min(initial=np.inf))
            for share in (0.1, 1, 10):
                found[f"{name}_percentile_{share:g}"] = float(np.percentile(values, share))
        return found


class PlaneMeasures:
    """Measures of faces and cells of a mesh in 2D: those of its prisms, in a fraction of the time.

    - `areas`: (n,) float64
    - `centroids`: (n, 2) float64
    """

    def __init__(self, mesh: Faces) -> None:
        self.mesh = mesh
        cell, p, q, origins = polygon_sides(mesh)
        twice = cross(p, q)
        self.areas = np.bincount(cell, twice, mesh.n_cells) / 2
        moments = sum_rows(cell, twice[:, None] * (p + q), mesh.n_cells)
        self.centroids = origins + moments / (6 * np.maximum(self.areas, _TINY**2))[:, None]
        self.inner = mesh.neighbor >= 0
        self.centers, self.vectors = mesh.vectors
        self.lengths = np.maximum(np.hypot(*self.vectors.T), _TINY)
        self.normals = self.vectors / self.lengths[:, None]
        self._arms = self.centers - self.centroids[mesh.owner]
        self._along = (self.normals * self._arms).sum(axis=1)
        self._lines = self.normals * self._along[:, None]
        across = self.centroids[mesh.neighbor[self.inner]] + mesh.shift[self.inner] * np.array(mesh.domain.extent)
        self._lines[self.inner] = across - self.centroids[mesh.owner[self.inner]]

    @cached_property
    def skewness(self) -> np.ndarray:
        """See `SolverMeasures.skewness`, (f,)."""
        least = np.where(self.inner, 0.2, 0.4) * np.hypot(*self._lines.T)
        along = (self.normals * self._lines).sum(axis=1) + _TINY
        offset = self._arms - (self._along / along)[:, None] * self._lines
        return np.hypot(*offset.T) / (np.maximum(self.lengths / 2, least) + _TINY)

    @cached_property
    def non_orthogonality(self) -> np.ndarray:
        """See `SolverMeasures.non_orthogonality`, (f,)."""
        across = np.abs(cross(self._lines, self.normals))
        angle = np.degrees(np.arctan2(across, (self._lines * self.normals).sum(axis=1)))
        return np.where(self.inner, angle, 0.0)

    @cached_property
    def weight(self) -> np.ndarray:
        """See `SolverMeasures.weight`, (f,)."""
        here = np.abs(self._along)
        there = np.abs((self.normals * self._lines).sum(axis=1) - self._along)
        return np.where(self.inner, np.minimum(here, there) / (here + there + _TINY**2), 1.0)

    @cached_property
    def volume_ratio(self) -> np.ndarray:
        """See `SolverMeasures.volume_ratio`, (f,)."""
        here, there = self.areas[self.mesh.owner], self.areas[np.maximum(self.mesh.neighbor, 0)]
        return np.where(self.inner, np.minimum(here, there) / (np.maximum(here, there) + _TINY**2), 1.0)

    @cached_property
    def aspect_ratio(self) -> np.ndarray:
        """See `SolverMeasures.aspect_ratio`, (n,)."""
        cell, face = self.mesh.sides()
        spread = sum_rows(cell, np.abs(self.vectors[face]), self.mesh.n_cells)
        return spread.max(axis=1) / (spread.min(axis=1) + _TINY)

    @cached_property
    def determinant(self) -> np.ndarray:
        """See `SolverMeasures.determinant`, (n,)."""
        mesh, n = self.mesh, self.mesh.n_cells
        k = np.flatnonzero(self.inner)
        once = k[mesh.twin[k] < 0]
        cell = np.concatenate([mesh.owner[k], mesh.neighbor[once]])
        x, y = np.concatenate([self.vectors[k], self.vectors[once]]).T
        mean = np.bincount(cell, np.hypot(x, y), n) / np.maximum(np.bincount(cell, minlength=n), 1)
        xx, xy, yy = (np.bincount(cell, product, n) for product in (x * x, x * y, y * y))
        return np.abs(xx * yy - xy * xy) / np.maximum(mean**4, _TINY**2) / 8


def _mean_angle(degrees: np.ndarray) -> float:
    """Return the angle in degrees whose cosine is the mean of the cosines, as OpenFOAM prints it."""
    if not len(degrees):
        return 0.0
    return float(np.degrees(np.arccos(np.clip(np.cos(np.radians(degrees)).mean(), -1, 1))))


def _positive(a: np.ndarray, b: np.ndarray, c: np.ndarray, tip: np.ndarray, side: int) -> np.ndarray:
    """Return whether tetrahedra have a volume above OpenFOAM's least quality, on the side 0 (owner) or 1, (k,).

    Corners are columns, (3, k) each.

    The quality is the volume over that of the regular tetrahedron with the same circumsphere, the limit 1e-30.
    """
    u, v, w = b - a, c - a, tip - a
    six = dots(cross_columns(u, v), w)
    signed, squares = six if side else -six, [dots(x, x) for x in (u, v, w)]
    longest = np.maximum.reduce(squares)
    # An upper bound of the radius settles nearly all.
    fine = signed / 6 > _LEAST_QUALITY * np.minimum(1.5 * longest**2 / np.maximum(np.abs(six), _TINY), 1e15) ** 3
    rest = np.flatnonzero(~fine & (signed > 0))
    if not rest.size:
        return fine
    u, v, w, six = u[:, rest], v[:, rest], w[:, rest], six[rest]
    top = sum(x[rest] * cross_columns(*pair) for x, pair in zip(squares, ((v, w), (w, u), (u, v)), strict=True))
    radius = lengths(top) / np.maximum(2 * np.abs(six), _TINY)
    fine[rest] = signed[rest] / 6 > _LEAST_QUALITY * np.minimum(radius, 1e15) ** 3
    return fine
