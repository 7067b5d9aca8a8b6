"""The cells of a diagram rebuilt from their corners, by NumPy on the host: for checks, and for what files leave out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .results import Diagram


class Rebuilt:
    """The cells of a diagram, from nothing but generators, corners and the graph.

    Attributes
    ----------
    owner : (m,) int
        Cell of each face.
    areas : (m, d) float
        Outward normal of each face times its measure.
    middles : (m, d) float
        Centroids of the faces.
    perimeters : (n,) float
        Sum of the faces' measures (surface in 3D).
    volumes, centroids : (n,) and (n, d) float
    cells, corners : (k,) int
        Every corner of every cell: the cell and the vertex.
    unit : float
        The rounding of a position.
    """

    def __init__(self, d: Diagram) -> None:
        dim, n = d.domain.dim, len(d)
        self.real = _precision(d)
        far = max(map(abs, (*d.domain.lower, *d.domain.upper)))
        size = float(np.linalg.norm(d.domain.extent))
        # What is on the host is in float64 again: the way from the origin rounds in that.
        self.unit = float(np.finfo(self.real).eps) * size + np.finfo(float).eps * far
        self.owner = np.repeat(np.arange(n), np.diff(d.neighbour_starts))
        x = d.vertices
        # All lengths relative to the cell's generator: small cells far from the origin keep their digits.
        at = d.points[self.owner]
        if dim == 2:
            following = np.arange(1, len(d.cell_vertices) + 1)
            ends = d.cell_vertex_starts[1:]
            following[ends[ends > d.cell_vertex_starts[:-1]] - 1] = d.cell_vertex_starts[:-1][
                ends > d.cell_vertex_starts[:-1]
            ]
            a = x[d.cell_vertices] - at
            b = x[d.cell_vertices[following]] - at
            edge = b - a
            self.areas = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
            self.middles = (a + b) / 2
            self.cells, self.corners = self.owner, d.cell_vertices
        else:
            face = np.repeat(np.arange(len(self.owner)), np.diff(d.face_vertex_starts))
            first = d.face_vertex_starts[:-1][face]
            following = np.arange(1, len(face) + 1)
            last = np.flatnonzero(np.diff(face, append=-1))
            following[last] = first[last]
            a = x[d.face_vertices] - at[face]
            b = x[d.face_vertices[following]] - at[face]
            o = x[d.face_vertices[first]] - at[face]
            triangle = np.cross(a - o, b - o) / 2
            m = len(self.owner)
            self.areas = np.stack([np.bincount(face, triangle[:, k], m) for k in range(3)], axis=1)
            total = np.linalg.norm(self.areas, axis=1)
            normal = self.areas / np.where(total > 0, total, 1)[:, None]
            weight = np.einsum("ij,ij->i", triangle, normal[face])
            moment = weight[:, None] * (a + b + o) / 3
            sums = np.stack([np.bincount(face, moment[:, k], m) for k in range(3)], axis=1)
            self.middles = np.where(
                (total > 0)[:, None], sums / np.where(total > 0, total, 1)[:, None], 0.0
            )
            self.cells, self.corners = self.owner[face], d.face_vertices
            self.edges = (face, d.face_vertices, d.face_vertices[following])
        self.measures = np.linalg.norm(self.areas, axis=1)
        # The cell as the sum of the cones from its generator to its faces.
        cones = np.einsum("ij,ij->i", self.areas, self.middles) / dim
        self.volumes = np.bincount(self.owner, cones, minlength=n)
        share = dim / (dim + 1)
        moments = [
            np.bincount(self.owner, cones * share * self.middles[:, k], n) for k in range(dim)
        ]
        safe = np.where(self.volumes > 0, self.volumes, 1)
        self.centroids = np.stack(moments, axis=1) / safe[:, None]
        self.perimeters = np.bincount(self.owner, self.measures, minlength=n)
        self.reach = np.zeros(n)
        np.maximum.at(
            self.reach, self.cells, np.linalg.norm(x[self.corners] - d.points[self.cells], axis=1)
        )


def _precision(d: Diagram) -> np.dtype:
    """Return the precision in which `d` was made: float32 shows, as the device's unit is a power of two."""
    scale, dim = d.domain.frame[1], d.domain.dim
    volumes = d.volumes / scale**dim
    single = bool((volumes == volumes.astype(np.float32)).all())
    return np.dtype(np.float32 if single else np.float64)


def rebuild(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return what the corners of a diagram give of its other arrays: measures and centroids of faces, centroids."""
    g = Rebuilt(diagram)
    return {
        "face_measures": g.measures,
        "face_centroids": g.middles + diagram.points[g.owner],
        "centroids": g.centroids + diagram.points,
    }
