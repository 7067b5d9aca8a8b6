"""Move generators near walls a little after a run, by the cells of the mesh that is made of them.

During a run each cell at a wall ends at planes of its own. In the mesh cells end at the surface and fit together. So
their volumes and centroids differ from those of the run, most at creases and where the surface curves within a cell. A
few steps with the cells of the mesh make up for that: generators "settle".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from ...mesh.faces import Faces
from .mend import with_neighbors
from .wall_surface import WallSurface

_STEPS, _MOST = 5, 25_000
"""Largest number of steps, and largest product of the number of steps and that of cells: each step makes a mesh of all
cells, and of many cells few are at walls."""
_EXACT_STEPS, _LEAST = 12, 2
"""Largest and least number of steps by the exact method."""
_FEW = 0.03
"""No generator settles if more than this share of them has a face that is more oblique or skewed than wanted."""
_CHECKS = 6
"""Largest number of meshes that are made after the last step to put generators back."""
_DAMPING, _EXACT_DAMPING = 0.05, 0.17
"""Damping of the least squares: the weight of displacements over h, where volumes over h^3 have the weight 1."""
_STAYING = 0.1
"""Weight of the volume of a cell whose generator stays. By the exact method it is 1."""
_GOOD, _WORSE = 0.97, 1.001
"""A face may become as oblique or skewed as the first share of what is wanted. If it was worse before, it may become
worse by the second factor, which is round-off."""
_REACH = 2.5
"""Largest distance of generators that settle from the surface, over h."""
_LONGEST, _DEEP = 0.15, 0.05
"""Longest displacement in a step, and least depth of generators in the solid, over h."""


@dataclass(frozen=True)
class CellTargets:
    """What the steps after a run aim at.

    - `volumes` (n,) float: those that their cells are to have.
    - `fixed`: how many of the first generators stay.
    - `first`: whether volumes matter more than shapes.
    """

    volumes: np.ndarray
    fixed: int = 0
    first: bool = False


@dataclass(frozen=True)
class MadeCells:
    """The cells near walls in a mesh of n generators.

    - `faces`: Faces of m cells.
    - `generator` (m,) int: that of each cell; -1 for the rest of the mesh, which is one cell.
    - `worst` (n,) float: how oblique or skewed the faces of its cells are, over what is wanted; see `over_wanted`.
    """

    faces: Faces
    generator: np.ndarray
    worst: np.ndarray

    def around(self, rows: np.ndarray, rings: int = 1) -> np.ndarray:
        """Return the generators `rows` (n,) bool and those of `rings` of cells around theirs, (n,) bool."""
        near = self.generator >= 0
        found = np.zeros(len(rows), bool)
        found[self.generator[with_neighbors(self.faces, near & rows[self.generator], rings) & near]] = True
        return found


def settled(
    surface: WallSurface,
    points: np.ndarray,
    sizes: np.ndarray,
    targets: CellTargets,
    make: Callable[[np.ndarray], MadeCells],
) -> np.ndarray:
    """Return the generators (n, 3) after a few steps.

    Where faces become more oblique or skewed than wanted, the generators around are put back to where they were in the
    last mesh without such faces, and stay from then on. The result is the last one of these meshes.

    - `points` (n, 3) float: generators inside.
    - `sizes` (n,) float: h at the generators.
    - `make`: returns the cells of generators (n, 3).
    """
    steps = _MOST // max(len(points), 1)
    steps = int(np.clip(steps, _LEAST, _EXACT_STEPS)) if targets.first else min(steps, _STEPS)
    good, most = points, np.zeros(len(points))
    stays = surface.at_concave_creases(points, sizes) | ~surface.touches(points, _REACH * sizes)
    stays[: targets.fixed] = stays[surface.thin_parts(points, sizes)[0]] = True
    for step in range(steps + _CHECKS if steps else 0):
        made = make(points)
        if step == 0:
            if np.count_nonzero(made.worst > 1) > _FEW * len(points):
                break
            most = _WORSE * np.maximum(made.worst, _GOOD)
            stays |= made.around(made.worst > _GOOD)
        worse = made.worst > most
        if not worse.any():
            good = points
            if step >= steps:
                break
        back = made.around(worse, max(step - steps, 1))
        stays |= back
        if step < steps:
            points = points + _step(surface, made, points, sizes, targets, stays)
        points = np.where(back[:, None], good, points)
    return good


def _step(
    surface: WallSurface,
    made: MadeCells,
    points: np.ndarray,
    sizes: np.ndarray,
    targets: CellTargets,
    stays: np.ndarray,
) -> np.ndarray:
    """Return displacements (n, 3): to the centroids, and those that then give the cells their volumes.

    The second ones are a damped least-squares solution of the linearized volumes. The cell of x grows by
    A (y - c) . dy / |y - x| where its neighbor y moves by dy; A and c are area and centroid of the face between them.
    """
    f, g, n = made.faces, made.faces.measures.geometry, len(points)
    volumes = np.bincount(made.generator + 1, g.volumes, n + 1)[1:]
    moments = (np.bincount(made.generator + 1, g.volumes * c, n + 1)[1:] for c in g.centroids.T)
    free = ~stays & (volumes > 0)
    to_centroid = np.zeros((n, 3))
    to_centroid[free] = np.stack(list(moments), axis=1)[free] / volumes[free, None] - points[free]
    one, other = made.generator[f.owner[: f.n_inner]], made.generator[f.neighbor[: f.n_inner]]
    between = np.flatnonzero((one != other) & (one >= 0) & (other >= 0))
    one, other, center = one[between], other[between], f.center[between]
    scaled = f.area[between] / np.maximum(np.linalg.norm(points[other] - points[one], axis=1), 1e-3 * sizes[one])
    by_one, by_other = (scaled[:, None] * (points[c] - center) for c in (one, other))
    rows, columns = np.concatenate([one, one, other, other]), np.concatenate([other, one, one, other])
    entries = np.concatenate([by_other, -by_one, by_one, -by_other]) * free[columns, None]
    cells = np.flatnonzero(volumes > 0)
    weight = np.where(free | targets.first, 1.0, _STAYING) / sizes**2
    places = (np.repeat(rows, 3), (3 * columns[:, None] + np.arange(3)).ravel())
    matrix = scipy.sparse.csr_matrix(((weight[rows, None] * entries).ravel(), places), shape=(n, 3 * n))[cells]
    lack = (weight * (targets.volumes - volumes))[cells] - matrix @ to_centroid.ravel()
    damping = _EXACT_DAMPING if targets.first else _DAMPING
    way = to_centroid + scipy.sparse.linalg.lsqr(matrix, lack, damp=damping, iter_lim=60)[0].reshape(n, 3)
    way *= np.minimum(1, _LONGEST * sizes / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
    moved = np.flatnonzero(way.any(axis=1))
    there, h = points[moved] + way[moved], sizes[moved]
    way[moved[(surface.closest(there)[2] > -_DEEP * h) | surface.at_concave_creases(there, h)]] = 0
    return way
