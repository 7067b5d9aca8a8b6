"""What the two-point flux needs of a solver mesh: areas and distances of faces, with the unknowns at the generators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.read_only import Sealed
from .geometry import face_geometry
from .solver_mesh import SolverMesh

FLATTEST = 1e-3
"""Least distance of a generator from the plane of a face, over that from its center, at which the foot is used."""


@dataclass(frozen=True, eq=False)
class TwoPointFaces(Sealed):
    """The faces of a solver mesh for the flux ``area / (near + far) * (u[neighbor] - u[owner])``.

    Rows are those of the solver mesh: a face at a seam of a periodic box has two, one for each cell.

    Attributes
    ----------
    owner, neighbor : (f,) int32
        Cells; -1 - k on wall k.
    boundary : (f,) int32
        Index in ``domain.boundary_names``; -1 between cells.
    area : (f,) float64
        Area; length in 2D.
    normal : (f, d) float64
        Unit normal, out of the owner.
    center : (f, d) float64
        Centroid.
    foot : (f, d) float64
        Point of the plane of the face on the line from generator to generator; on a wall the foot of the
        generator's perpendicular, where the value of the wall belongs. It may lie beside the face.
    near, far : (f,) float64
        Distances of the plane from the generator of the owner and from that of the neighbor, which is 0 on walls.
        At a re-entrant corner the plane of a wall may pass through or behind the generator (`FLATTEST`): then the
        center is the foot, and the distance that from the center.
    """

    owner: np.ndarray
    neighbor: np.ndarray
    boundary: np.ndarray
    area: np.ndarray
    normal: np.ndarray
    center: np.ndarray
    foot: np.ndarray
    near: np.ndarray
    far: np.ndarray

    @property
    def conductance(self) -> np.ndarray:
        """Area over the sum of the distances, (f,)."""
        return self.area / (self.near + self.far)


def two_point_faces(mesh: SolverMesh, points: np.ndarray) -> TwoPointFaces:
    """Return what the two-point flux needs of the faces of `mesh`.

    Parameters
    ----------
    mesh : SolverMesh
    points : (n, d) float
        Generators.
    """
    center, vector = _vectors(mesh)
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.where(area > 0, area, 1)[:, None]
    inner = mesh.neighbor >= 0
    here = points[mesh.owner].astype(float)
    near, is_flat = _distances(center - here, normal)
    foot = here + near[:, None] * normal
    there = points[mesh.neighbor[inner]] + mesh.shift[inner] * np.array(mesh.domain.extent)
    far = np.zeros(len(area))
    far[inner], flat = _distances(there - center[inner], normal[inner])
    share = near[inner] / (near[inner] + far[inner])
    foot[inner] = here[inner] + share[:, None] * (there - here[inner])
    is_flat[inner] |= flat
    foot[is_flat] = center[is_flat]
    wall = np.where(inner, 0, -1 - mesh.neighbor)
    boundary = np.where(inner, -1, mesh.domain.boundary_index[wall]).astype(np.int32)
    return TwoPointFaces(mesh.owner, mesh.neighbor, boundary, area, normal, center, foot, near, far)


def _distances(arm: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of `arm` along `normal` (f, d), and where they are too short, so that lengths replace them."""
    along, length = (arm * normal).sum(axis=1), np.linalg.norm(arm, axis=1)
    is_flat = along < FLATTEST * length
    return np.where(is_flat, length, along), is_flat


def _vectors(mesh: SolverMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the centers and the area vectors of the faces, (f, d) each."""
    if mesh.dim == 3:
        return face_geometry(mesh.points, mesh.starts, mesh.corners)
    a, b = mesh.points[mesh.corners.reshape(-1, 2)].swapaxes(0, 1)
    along = b - a
    return (a + b) / 2, np.stack([along[:, 1], -along[:, 0]], axis=1)
