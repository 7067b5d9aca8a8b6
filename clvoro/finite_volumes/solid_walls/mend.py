"""Find cells at curved walls that checkMesh takes for concave, and the faces whose collapse mends them."""

from __future__ import annotations

import numpy as np

from ...mesh.faces import Faces
from ..defects import DefectLimits
from ..gate import rejected_cells

_NARROW = 0.08
"""Faces between two cells smaller than this share of h^2 are collapsed if their cells are concave there."""


def narrow_faces(faces: Faces, sizes: np.ndarray) -> np.ndarray:
    """Return the small faces between two cells whose centers lie outside of the plane of another face, (f,) bool.

    At curved walls the chord between two cells may bulge out of both wall polygons. If their common face is small, its
    center does so, too.
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
    # Faces of other cells are those of the diagram.
    at_wall = rings[0][cells]
    judged = np.flatnonzero(at_wall[part.owner] | (at_wall[np.maximum(part.neighbor, 0)] & (part.neighbor >= 0)))
    return cells[rejected_cells(part, judged) & rings[1][cells]]
