"""Diagrams as meshes of FiPy. This module needs FiPy; `Diagram.to_fipy` imports it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from fipy.meshes.mesh import Mesh
from fipy.meshes.mesh2D import Mesh2D
from fipy.variables.faceVariable import FaceVariable

from ..errors import InputError
from ..finite_volumes.prisms import cell_loops
from ..finite_volumes.two_point import TwoPointFaces, two_point_faces

if TYPE_CHECKING:
    from ..finite_volumes.solver_mesh import SolverMesh, WallShape
    from ..mesh.diagram import Diagram


class _AtGenerators:
    """Part of a mesh of FiPy that puts the cell centers at the generators.

    The center of a face is where the line between the generators crosses its plane, on walls the foot of the
    generator's perpendicular. FiPy's two-point flux and its values on faces are exact there for linear functions.
    """

    physicalFaces: dict[str, FaceVariable]  # noqa: N815  (as FiPy's meshes from Gmsh)

    def __init__(
        self, generators: np.ndarray, volumes: np.ndarray, faces: TwoPointFaces, **arrays: Any
    ) -> None:
        self._generators, self._volumes, self._faces = generators, volumes, faces
        super().__init__(**arrays)

    def _calcCellCenters(self) -> np.ndarray:  # noqa: N802
        return self._generators.T.astype(float)

    def _calcCellVolumes(self) -> np.ndarray:  # noqa: N802
        return self._volumes

    def _calcFaceCenters(self) -> np.ndarray:  # noqa: N802
        return self._faces.foot.T.copy()

    def _calcFaceAreas(self) -> np.ndarray:  # noqa: N802
        return self._faces.area.copy()

    def _calcFaceNormals(self) -> np.ndarray:  # noqa: N802
        # FiPy's normals come from the first three corners, which may be nearly in line, and point away from the first
        # cell of `faceCellIDs`, which need not be the owner.
        first = np.ma.filled(self.faceCellIDs[0], -1)  # type: ignore[attr-defined]
        return np.where(first == self._faces.owner, 1.0, -1.0) * self._faces.normal.T


class VoronoiMesh2D(_AtGenerators, Mesh2D):
    """A mesh of FiPy in 2D, with ``physicalFaces`` by the names of the domain's boundaries."""


class VoronoiMesh3D(_AtGenerators, Mesh):
    """A mesh of FiPy in 3D, with ``physicalFaces`` by the names of the domain's boundaries."""


def make_fipy_mesh(diagram: Diagram, walls: WallShape) -> VoronoiMesh2D | VoronoiMesh3D:
    """Return the mesh of FiPy of `diagram`; see `Diagram.to_fipy`."""
    domain = diagram.domain
    if any(domain.periodic):
        raise InputError(
            "FiPy's meshes of polygons have no periodic sides, and this box has; use a box without periodic directions"
        )
    mesh = diagram.solver_mesh(walls, collapse=False)
    faces = two_point_faces(mesh, diagram.points)
    kind = VoronoiMesh2D if domain.dim == 2 else VoronoiMesh3D
    made = kind(
        diagram.points,
        _volumes(mesh, faces, diagram.points),
        faces,
        vertexCoords=mesh.points.T.copy(),
        faceVertexIDs=_padded(mesh.starts, mesh.corners),
        cellFaceIDs=_padded(*_cell_faces(mesh)),
    )
    made.physicalFaces = {
        name: FaceVariable(mesh=made, value=faces.boundary == k)
        for k, name in enumerate(domain.boundary_names)
    }
    return made


def _volumes(mesh: SolverMesh, faces: TwoPointFaces, points: np.ndarray) -> np.ndarray:
    """Return the volumes of the cells, (n,): the sums of the pyramids from the generators to the faces."""
    k, n = mesh.inner, len(mesh)
    cell = np.concatenate([mesh.owner, mesh.neighbor[:k]])
    face = np.concatenate([np.arange(len(mesh.owner)), np.arange(k)])
    sign = np.where(np.arange(len(face)) < len(mesh.owner), 1.0, -1.0)
    heights = sign * ((faces.center[face] - points[cell]) * faces.normal[face]).sum(axis=1)
    return np.bincount(cell, faces.area[face] * heights / mesh.dim, n)


def _cell_faces(mesh: SolverMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of each cell as ragged rows: starts (n + 1,) and faces; in 2D counter-clockwise."""
    f, k, n = len(mesh.owner), mesh.inner, len(mesh)
    cell = np.concatenate([mesh.owner, mesh.neighbor[:k]]).astype(np.int64)
    face = np.concatenate([np.arange(f), np.arange(k)])
    if mesh.dim == 3:
        starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=n))])
        return starts, face[np.argsort(cell, kind="stable")]
    a, b = mesh.corners.reshape(-1, 2).T
    key = cell * len(mesh.points) + np.concatenate([a, b[:k]])
    order = np.argsort(key)
    starts, loops = cell_loops(mesh)
    wanted = np.repeat(np.arange(n), np.diff(starts)) * len(mesh.points) + loops
    return starts, face[order[np.searchsorted(key[order], wanted)]]


def _padded(starts: np.ndarray, items: np.ndarray) -> np.ndarray:
    """Return ragged rows as columns of an array, filled up with -1."""
    counts = np.diff(starts)
    row = np.repeat(np.arange(len(counts)), counts)
    table = np.full((int(counts.max(initial=0)), len(counts)), -1)
    table[np.arange(len(items)) - starts[row], row] = items
    return table
