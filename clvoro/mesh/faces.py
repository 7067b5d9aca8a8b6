"""The faces of a diagram, each once, with what finite-volume methods need of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..geometry.sphere_region import SphereRegion
from .connectivity import face_topology, neighbor_points
from .read_only import Sealed

if TYPE_CHECKING:
    from .connectivity import FaceTopology
    from .diagram import Diagram

OFF_BISECTOR = 1e-3
"""Largest distance of a face from the bisector of its generators over their distance, and largest slope against it.

In a polygonal domain a part of a cell that the boundary cuts off belongs to another cell. Its faces are not on the
bisector of the generators of the two cells."""


@dataclass(frozen=True, eq=False)
class Faces(Sealed):
    """Every face of a diagram once, seams and walls included; see `Diagram.faces`.

    The faces between two cells come first, sorted by (owner, neighbor). The faces on walls follow, wall by wall. Faces
    without measure are left out. Signs and positions are those of the owner.

    Attributes
    ----------
    owner : (f,) int32
        Cell on the side from which the normal points away.
    neighbor : (f,) int32
        Cell on the other side, owner <= neighbor (equal where a cell borders on its own periodic image); -1 - k on
        wall k of the domain.
    boundary : (f,) int32
        Index in ``domain.boundary_names`` for faces on walls; -1 between cells.
    area : (f,) float64
        Area; length in 2D.
    normal : (f, d) float64
        Unit normal, from owner to neighbor, or out of the domain.
    center : (f, d) float64
        Centroid of the face. In a periodic box it lies beside the owner, possibly outside of the box.
    distance : (f,) float64
        Distance between the two generators (on a sphere along a great circle), or of the owner's generator from the
        plane of the wall (on a sphere from the arc towards a removed cell). On a wall it is 0 or negative where the
        generator lies on that plane or behind it, as can happen at re-entrant corners of polygons.
    shift : (f, d) int8
        The neighbor lies at ``points[neighbor] + shift * domain.extent``: not 0 only at seams.
    half_face : (f,) int64
        Place of the face in the arrays of the diagram that have one entry per half-face, as ``face_measures``.
    vertex_starts : (f + 1,) int64
    vertices : (k,) int32
        Corners of face i, ``vertices[vertex_starts[i]:vertex_starts[i + 1]]``. In 2D the owner lies to the left of the
        way from the first corner to the second. In 3D the order is counter-clockwise as seen from the neighbor.
    """

    owner: np.ndarray
    neighbor: np.ndarray
    boundary: np.ndarray
    area: np.ndarray
    normal: np.ndarray
    center: np.ndarray
    distance: np.ndarray
    shift: np.ndarray
    half_face: np.ndarray
    vertex_starts: np.ndarray
    vertices: np.ndarray

    @property
    def n_inner(self) -> int:
        """Number of faces between two cells: the first ones."""
        return int(np.count_nonzero(self.neighbor >= 0))

    def __len__(self) -> int:
        return len(self.owner)

    def __repr__(self) -> str:
        return f"Faces({len(self)} faces, {self.n_inner} of them between two cells)"


def make_faces(diagram: Diagram) -> Faces:
    """Return every face of `diagram` that has a measure, once."""
    t = face_topology(diagram)
    domain, d = diagram.domain, diagram.domain.dim
    inner = t.neighbor >= 0
    walls = -1 - t.neighbor[~inner]
    boundary = np.full(len(inner), -1, np.int32)
    boundary[~inner] = domain.boundary_index[walls]
    shift = diagram.shifts[t.rows]
    center = diagram.face_centroids[t.rows].astype(float)
    if t.flipped.any():  # only the neighbor has the face, so its position is beside the neighbor
        shift = np.where(t.flipped[:, None], -shift, shift)
        center = center + np.where(t.flipped[:, None], shift * domain.extent, 0.0)
    normal, distance = np.empty((len(inner), d)), np.empty(len(inner))
    across = diagram.points[t.neighbor[inner]] + shift[inner] * domain.extent
    between = across - diagram.points[t.owner[inner]]
    distance[inner] = np.linalg.norm(between, axis=1)
    normal[inner] = between / distance[inner, None]
    if isinstance(domain, SphereRegion):
        outward = neighbor_points(diagram, t.rows[~inner]) - diagram.points[t.owner[~inner]]
        distance[~inner] = np.linalg.norm(outward, axis=1)
        normal[~inner] = outward / distance[~inner, None]
    else:
        normal[~inner], anchors = domain.wall_planes(walls)
        apart = anchors - diagram.points[t.owner[~inner]]
        distance[~inner] = (apart * normal[~inner]).sum(axis=1)
    if isinstance(domain, Sphere):
        distance = domain.lengths(distance)
        distance[~inner] /= 2  # the face is halfway to the removed cell
    if isinstance(domain, Polygon):
        _correct_cut_faces(diagram, t, normal, distance, center)
    return Faces(
        owner=t.owner,
        neighbor=t.neighbor,
        boundary=boundary,
        area=diagram.face_measures[t.rows],
        normal=normal,
        center=center,
        distance=distance,
        shift=shift,
        half_face=t.rows,
        vertex_starts=t.starts,
        vertices=t.corners,
    )


def _correct_cut_faces(
    diagram: Diagram, t: FaceTopology, normal: np.ndarray, distance: np.ndarray, center: np.ndarray
) -> None:
    """Take the normals of faces that are not on the bisector of their generators from their ends."""
    k = np.flatnonzero(t.neighbor >= 0)
    middle = (diagram.points[t.owner[k]] + diagram.points[t.neighbor[k]]) / 2
    off = np.abs(((center[k] - middle) * normal[k]).sum(axis=1))
    begin, end = diagram.vertices[t.corners.reshape(-1, 2)[k]].swapaxes(0, 1)
    along = end - begin
    length = np.hypot(*along.T)
    slope = np.abs((along * normal[k]).sum(axis=1))
    far = OFF_BISECTOR * distance[k]
    cut = (off > far) | (slope > np.maximum(OFF_BISECTOR * length, far))
    normal[k[cut]] = np.stack([along[cut, 1], -along[cut, 0]], axis=1) / length[cut, None]
