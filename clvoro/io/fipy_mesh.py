"""Diagrams as meshes of FiPy. This module needs FiPy; `Diagram.to_fipy` imports it."""

from __future__ import annotations

from typing import Any

import numpy as np
from fipy.meshes.mesh import Mesh
from fipy.meshes.mesh2D import Mesh2D
from fipy.variables.faceVariable import FaceVariable

from ..connectivity import rows_of, take_rows
from ..errors import InputError
from ..finite_volumes.prisms import cell_loops
from ..finite_volumes.solver_mesh import WallShape
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces


class _AtGenerators:
    """Part of a mesh of FiPy that puts the cell centers at the generators.

    The center of a face is where the line between the generators crosses its plane, on walls the foot of the
    generator's perpendicular. FiPy's two-point flux and its values on faces are exact there for linear functions.
    A face at the seam of a periodic box lies between its two cells. Its corners and center are those on the upper side.
    """

    physicalFaces: dict[str, FaceVariable]  # noqa: N815  (as FiPy's meshes from Gmsh)

    def __init__(self, mesh: Faces, kept: np.ndarray, **arrays: Any) -> None:
        """`kept` are the faces of `mesh` that FiPy gets."""
        self._generators, self._volumes = mesh.generators.astype(float), _volumes(mesh)
        names = ("owner", "neighbor", "area", "normal", "foot")
        self._owner, self._neighbor, self._area, self._normal, self._foot = (getattr(mesh, n)[kept] for n in names)
        self._shift = mesh.shift[kept] * np.array(mesh.domain.extent)  # of the neighbor to its image beside the owner
        super().__init__(**arrays)

    def _calcCellCenters(self) -> np.ndarray:  # noqa: N802
        return self._generators.T.copy()

    def _calcCellVolumes(self) -> np.ndarray:  # noqa: N802
        return self._volumes

    def _calcFaceCenters(self) -> np.ndarray:  # noqa: N802
        return self._foot.T.copy()

    def _calcFaceAreas(self) -> np.ndarray:  # noqa: N802
        return self._area.copy()

    def _calcFaceNormals(self) -> np.ndarray:  # noqa: N802
        # FiPy's own come from the first three corners, which may be nearly in line.
        return np.where(self._owner_first(), 1.0, -1.0) * self._normal.T

    # FiPy's own vectors from cell to cell do not know of periodic images.

    def _calcFaceToCellDistAndVec(self) -> tuple[Any, Any]:  # noqa: N802
        here = self._foot - self._generators[self._owner]
        beyond = self._foot - self._generators[np.maximum(self._neighbor, 0)] - self._shift
        first = self._owner_first()[:, None]
        arms = np.stack([np.where(first, here, beyond), np.where(first, beyond, here)])
        mask = np.zeros(arms.shape, bool)
        mask[1, self._neighbor < 0] = True
        vectors = np.ma.array(arms, mask=mask).transpose(2, 0, 1)
        return np.ma.sqrt((vectors**2).sum(axis=0)), vectors

    def _calcCellDistAndVec(self) -> tuple[np.ndarray, np.ndarray]:  # noqa: N802
        arms = self._cellToFaceDistanceVectors  # type: ignore[attr-defined]
        vectors = np.ma.filled(arms[:, 0]) - np.ma.filled(arms[:, 1], 0.0)
        return np.linalg.norm(vectors, axis=0), vectors

    def _calcFaceCellToCellNormals(self) -> np.ndarray:  # noqa: N802
        unit = self._cellDistanceVectors / self._cellDistances  # type: ignore[attr-defined]
        return np.where((unit * self.faceNormals).sum(axis=0) < 0, -1.0, 1.0) * unit  # type: ignore[attr-defined]

    def _owner_first(self) -> np.ndarray:
        """Whether the first cell of ``faceCellIDs`` is the owner, (f,)."""
        return np.ma.filled(self.faceCellIDs[0], -1) == self._owner  # type: ignore[attr-defined]


class VoronoiMesh2D(_AtGenerators, Mesh2D):
    """A mesh of FiPy in 2D, with ``physicalFaces`` by the names of the domain's boundaries."""


class VoronoiMesh3D(_AtGenerators, Mesh):
    """A mesh of FiPy in 3D, with ``physicalFaces`` by the names of the domain's boundaries."""


_KINDS = {2: VoronoiMesh2D, 3: VoronoiMesh3D}


def make_fipy_mesh(diagram: Diagram, walls: WallShape) -> VoronoiMesh2D | VoronoiMesh3D:
    """Return the mesh of FiPy of `diagram`; see `Diagram.to_fipy`."""
    domain = diagram.domain
    mesh = diagram.solver_mesh(walls, collapse=False)
    own = np.flatnonzero(mesh.owner == mesh.neighbor)
    if own.size:
        raise InputError(
            f"cell {mesh.owner[own[0]]} borders on its own periodic image, and FiPy's faces lie between two different "
            "cells; use more cells"
        )
    # A face at a seam is kept once, as that of the upper side.
    rows = np.arange(len(mesh.owner))
    kept = np.flatnonzero((mesh.twin < 0) | (mesh.twin > rows))
    place = np.empty(len(rows), np.int64)
    place[kept] = np.arange(len(kept))
    seam = kept[mesh.twin[kept] >= 0]
    place[mesh.twin[seam]] = place[seam]
    starts, items = _cell_faces(mesh)
    made = _KINDS[domain.dim](
        mesh,
        kept,
        vertexCoords=mesh.points.T.copy(),
        faceVertexIDs=_padded(*take_rows(mesh.starts, mesh.corners, kept)),
        cellFaceIDs=_padded(starts, place[items]),
    )
    part = mesh.boundary[kept]
    made.physicalFaces = {
        name: FaceVariable(mesh=made, value=part == k) for k, name in enumerate(domain.boundary_names)
    }
    return made


def _volumes(mesh: Faces) -> np.ndarray:
    """Return the volumes of the cells, (n,): the sums of the pyramids from the generators to the faces."""
    cell, face = mesh.sides()
    sign = np.where(np.arange(len(face)) < len(mesh), 1.0, -1.0)
    heights = sign * ((mesh.center[face] - mesh.generators[cell]) * mesh.normal[face]).sum(axis=1)
    return np.bincount(cell, mesh.area[face] * heights / mesh.dim, mesh.n_cells)


def _cell_faces(mesh: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of each cell as ragged rows: starts (n + 1,) and faces; in 2D counter-clockwise."""
    cell, face = mesh.sides()
    if mesh.dim == 3:
        starts, sides = mesh.cell_faces()
        return starts, face[sides]
    key = cell * len(mesh.points) + mesh.side_ends()[0]
    order = np.argsort(key)
    starts, loops = cell_loops(mesh)
    wanted = rows_of(starts) * len(mesh.points) + loops
    return starts, face[order[np.searchsorted(key[order], wanted)]]


def _padded(starts: np.ndarray, items: np.ndarray) -> np.ndarray:
    """Return ragged rows as columns of an array, filled up with -1."""
    counts = np.diff(starts)
    row = np.repeat(np.arange(len(counts)), counts)
    table = np.full((int(counts.max(initial=0)), len(counts)), -1)
    table[np.arange(len(items)) - starts[row], row] = items
    return table
