"""Find cells at curved walls that checkMesh takes for concave, and the faces whose collapse mends them."""

from __future__ import annotations

import numpy as np

from ...mesh.faces import Faces
from ..defects import DefectLimits
from ..gate import rejected_cells

_NARROW = 0.08
"""Faces between two cells are collapsed if they are smaller than this share of h^2 and a cell is concave there."""


def narrow_faces(faces: Faces, sizes: np.ndarray) -> np.ndarray:
    """Return the small faces between two cells at a wall with which a cell is concave, (f,) bool.

    Where a wall is curved, the common edge of two wall polygons may bulge out of the planes of both. So does the center
    of the face between their cells if that is small.
    """
    at_wall = np.zeros(faces.n_cells, bool)
    at_wall[faces.owner[faces.n_inner :]] = True
    chosen = np.zeros(len(faces), bool)
    chosen[faces.measures.concave_pairs(DefectLimits().concavity, at_wall)[0]] = True
    chosen[faces.n_inner :] = False
    h = np.minimum(sizes[faces.owner], sizes[np.maximum(faces.neighbor, 0)])
    return chosen & (faces.area < _NARROW * h**2)


def rejected_at_walls(faces: Faces) -> np.ndarray:
    """Return the cells at walls, or beside these, that OpenFOAM rejects, (k,) int."""
    k = faces.n_inner
    a, b = faces.owner[:k], faces.neighbor[:k]
    rings = [np.zeros(faces.n_cells, bool)]
    rings[0][faces.owner[k:]] = True
    for _ in range(2):
        ring = rings[-1].copy()
        ring[a[rings[-1][b]]] = ring[b[rings[-1][a]]] = True
        rings.append(ring)
    cells, part = np.flatnonzero(rings[2]), faces.part(rings[2])[0]
    # Other faces are those of the diagram, whose tetrahedra are right.
    at_wall = rings[0][cells]
    judged = np.flatnonzero(at_wall[part.owner] | (at_wall[np.maximum(part.neighbor, 0)] & (part.neighbor >= 0)))
    return cells[rejected_cells(part, judged) & rings[1][cells]]
