"""Convex polygons of great circles: cells on a sphere, and what half-spaces leave of them.

The central projection onto the tangent plane at a cell's generator x maps arcs of great circles to straight lines. A
corner y has the coordinates u with y = (x + u) / |x + u|. No corner is farther than 80 degrees from its generator.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.sphere import arc_excess
from ..mesh.check.rebuilt import bisector_corners
from ..mesh.connectivity import face_owners, following, neighbor_points, take_rows
from ..mesh.diagram import Diagram

STRAIGHT = 1e-6
"""Sine of the angle between two faces below which their corner is taken from the diagram."""


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of the rows of two arrays (n, d), (n,)."""
    return np.einsum("ij,ij->i", a, b)


@dataclass(frozen=True)
class Pieces:
    """Convex polygons in tangent planes, in ragged rows.

    Attributes
    ----------
    starts : (n + 1,) int
    corners : (c, 2) float64
        Central projections, counter-clockwise. An empty row is an empty polygon.
    labels : (c,) int
        Label of the edge from a corner to the next one; -1 for edges of the cell itself.
    """

    starts: np.ndarray
    corners: np.ndarray
    labels: np.ndarray

    def __len__(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def owners(self) -> np.ndarray:
        """The polygon of each corner, (c,) int."""
        return np.repeat(np.arange(len(self)), np.diff(self.starts))

    def take(self, rows: np.ndarray) -> Pieces:
        """Return the polygons `rows` (k,)."""
        starts, places = take_rows(self.starts, np.arange(len(self.corners)), rows)
        return Pieces(starts, self.corners[places], self.labels[places])

    def between(self, begin: int, end: int) -> Pieces:
        """Return the polygons from `begin` to `end`, without the latter."""
        starts = self.starts[begin : end + 1]
        part = slice(starts[0], starts[-1])
        return Pieces(starts - starts[0], self.corners[part], self.labels[part])

    def cut(self, normals: np.ndarray, levels: np.ndarray, depths: np.ndarray, labels: np.ndarray) -> Pieces:
        """Keep u.normal <= level of each polygon.

        Parameters
        ----------
        normals : (n, 2) float64
        levels, depths : (n,) float64
            Corners beyond the line by no more than the depth count as inside.
        labels : (n,) int
            Labels of the new edges.
        """
        owner = self.owners
        s = dot(self.corners, normals[owner]) - levels[owner]
        out = s > depths[owner]
        if not out.any():
            return self
        after = following(self.starts)
        crossed = np.flatnonzero(out != out[after])
        counts = (~out).astype(np.int64)
        counts[crossed] += 1
        places = np.concatenate([[0], np.cumsum(counts)])
        corners, edges = np.empty((places[-1], 2)), np.empty(places[-1], self.labels.dtype)
        inside = np.flatnonzero(~out)
        corners[places[inside]], edges[places[inside]] = self.corners[inside], self.labels[inside]
        leaves = ~out[crossed]
        a, b = np.where(leaves, [crossed, after[crossed]], [after[crossed], crossed])
        low = np.minimum(s[a], 0)
        share = (low / (low - s[b]))[:, None]
        at = places[crossed] + leaves
        corners[at] = self.corners[a] + share * (self.corners[b] - self.corners[a])
        edges[at] = np.where(leaves, labels[owner[crossed]], self.labels[crossed])
        return Pieces(places[self.starts], corners, edges)

    def measure(self) -> tuple[np.ndarray, np.ndarray]:
        """Return areas (n,), and the integrals (n, 3) of y - x, of the polygons on the unit sphere.

        The components are those along the two tangents and the generator x. The area is the sum of triangles around the
        first corner (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125). The integral of y is half the
        sum over the edges, from v to w, of arc n, with n the unit vector along v x w (Gauss).
        """
        n, owner, u = len(self), self.owners, self.corners
        w, o = u[following(self.starts)], u[self.starts[owner]]
        # Lengths of the vectors x + u, x + w and x + o.
        p, q, r = (np.sqrt(1 + dot(c, c)) for c in (u, w, o))
        volume, cosine = _cross(u - o, w - o), 1 + dot(u, w)
        cosines = p * q * r + (1 + dot(o, u)) * q + cosine * r + (1 + dot(w, o)) * p
        area = np.bincount(owner, 2 * np.arctan2(volume, cosines), n)
        step, turn = w - u, _cross(u, w)
        cross = np.column_stack([-step[:, 1], step[:, 0], turn]) / (p * q)[:, None]
        excess = arc_excess(np.sqrt(dot(cross, cross)), cosine / (p * q))
        # Of the vectors v x w the parts with x add up to zero. Without them small cells lose no digits.
        a, b = -dot(u, u) / (p * (1 + p)), -dot(w, w) / (q * (1 + q))
        u, w = u / p[:, None], w / q[:, None]
        small = np.column_stack([u[:, 1] * b - a * w[:, 1], a * w[:, 0] - u[:, 0] * b, _cross(u, w)])
        terms = (small + excess[:, None] * cross) / 2
        integral = np.column_stack([np.bincount(owner, t, n) for t in terms.T])
        integral[:, 2] -= area
        return area, integral


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products a x b of rows in the plane, (n,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def join(parts: list[Pieces]) -> Pieces:
    """Return the polygons of all `parts`, one part after the other."""
    counts = np.concatenate([np.diff(part.starts) for part in parts])
    corners = np.concatenate([part.corners for part in parts])
    labels = np.concatenate([part.labels for part in parts])
    return Pieces(np.concatenate([[0], np.cumsum(counts)]), corners, labels)


class TangentCells:
    """The cells of a diagram on the unit sphere.

    Attributes
    ----------
    x : (n, 3) float64
        Generators.
    tangents : pair of (n, 3) float64
        Unit vectors of the tangent planes there.
    starts, neighbors : (n + 1,), (m,) int
        Neighbors are -1 or less where cells have been removed.
    there : (m, 3) float64
        The generators behind the faces, also those of removed cells.
    pieces : Pieces
    reach : (n,) float64
        Largest distance of a projected corner from the generator.
    """

    def __init__(self, diagram: Diagram) -> None:
        sphere, owner = diagram.domain.globe, face_owners(diagram)
        assert sphere is not None
        radius, on_sphere = sphere.frame[1], sphere.wrap(diagram.points)
        self.x, self.tangents = on_sphere / radius, sphere.tangents(on_sphere)
        self.starts = np.asarray(diagram.neighbor_starts, np.int64)
        self.neighbors = np.asarray(diagram.neighbors, np.int64)
        self.there = self.x[self.neighbors]
        walls = np.flatnonzero(self.neighbors < 0)
        self.there[walls] = sphere.wrap(neighbor_points(diagram, walls)) / radius
        between = self.there - self.x[owner]
        # The bisectors of two neighbors are the lines n.u = |d|^2 / 2.
        normals = self.along_tangents(between, owner)
        corners, sines = bisector_corners(self.starts, normals, dot(between, between) / 2)
        bad = np.flatnonzero(~(sines > STRAIGHT))
        if bad.size:
            i = owner[bad]
            off = sphere.wrap(diagram.vertices[diagram.cell_vertices[bad]]) / radius - self.x[i]
            corners[bad] = self.along_tangents(off, i) / (1 + dot(off, self.x[i]))[:, None]
        self.pieces = Pieces(self.starts, corners, np.full(len(owner), -1))
        self.reach = np.zeros(len(self.x))
        np.maximum.at(self.reach, owner, np.sqrt(dot(corners, corners)))

    def __len__(self) -> int:
        return len(self.x)

    def along_tangents(self, vectors: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the components of `vectors` (k, 3) along the tangents of `cells` (k,), (k, 2)."""
        return np.column_stack([dot(vectors, axis[cells]) for axis in self.tangents])

    def in_space(self, components: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the vectors (k, 3) with `components` (k, 3) along tangents and generators of `cells` (k,)."""
        axes = (*self.tangents, self.x)
        one, two, three = (components[:, a, None] * axes[a][cells] for a in range(3))
        return one + two + three

    def intersections(self, i: np.ndarray, old: TangentCells, j: np.ndarray) -> tuple[np.ndarray, Pieces]:
        """Intersect cells i (k,) with cells j (k,) of `old`.

        Returns
        -------
        pairs : (k,) int
            The pair that each intersection belongs to.
        pieces : Pieces
            In the tangent planes of the cells i. Labels are cells of `old` behind the edges.
        """
        degrees = np.diff(old.starts)[j]
        pairs = np.argsort(-degrees, kind="stable")
        i, j, degrees = i[pairs], j[pairs], degrees[pairs]
        pieces, done = self.pieces.take(i), []
        for face in range(degrees[0]):
            count = int(np.searchsorted(-degrees, -face))  # those of more than `face` faces
            if count < len(pieces):
                done.append(pieces.between(count, len(pieces)))
                pieces = pieces.between(0, count)
            faces = old.starts[j[:count]] + face
            pieces = pieces.cut(*self._half_planes(i[:count], old, j[:count], faces), old.neighbors[faces])
        return pairs, join([pieces, *reversed(done)])

    def _half_planes(
        self, i: np.ndarray, old: TangentCells, j: np.ndarray, faces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return normals, levels and depths, in the tangent planes of cells i, of half-planes that `faces` of j bound.

        Both cells of a face get the same line with opposite signs, so that their pieces are complementary.
        """
        x = self.x[i]
        a, b = old.x[j] - x, old.there[faces] - x
        normal = old.there[faces] - old.x[j]
        far = np.sqrt(np.maximum(dot(a, a), dot(b, b)))
        noise = 4 * np.finfo(float).eps * np.sqrt(dot(normal, normal))
        depths = noise * (self.reach[i] + far)
        return self.along_tangents(normal, i), dot(normal, a + b) / 2, depths
