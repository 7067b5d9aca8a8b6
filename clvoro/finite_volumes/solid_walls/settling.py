"""Move generators near walls a little after a run, by the cells of the mesh that is made of them.

During a run each cell at a wall ends at planes of its own. In the mesh cells end at the surface and fit together. So
their volumes and centroids differ from those of the run, most at creases and where the surface curves within a cell. A
few steps with the cells of the mesh make up for that: generators "settle".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from ...connectivity import used_indices
from ...mesh.faces import Faces
from .mend import with_neighbors
from .wall_surface import WallSurface

_STEPS, _MOST = 8, 25_000
"""Largest number of steps, and largest product of the number of steps and that of cells: each step makes a mesh of all
cells, and of many cells few are at walls."""
_EXACT_STEPS, _LEAST = 24, 2
"""Largest number of steps by the exact method if there are few cells, and if there are many."""
_ENOUGH, _EXACT_ENOUGH = (0.0015, 2.0), (0.0008, 2.0)
"""No further step follows if mean size error and mean angle of faces, in degrees, are at most these near walls."""
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

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of `values` (m,) of the cells of each generator, (n,) float."""
        return np.bincount(self.generator + 1, values, len(self.worst) + 1)[1:]

    @cached_property
    def volumes(self) -> np.ndarray:
        """The volume that each generator has here, (n,) float; 0 if it has none."""
        return self.sums(self.faces.measures.geometry.volumes)

    @cached_property
    def pairs(self) -> np.ndarray:
        """Faces between cells of different generators, (k,) int."""
        one, other = self.generators
        return np.flatnonzero((one != other) & (one >= 0) & (other >= 0))

    @property
    def generators(self) -> tuple[np.ndarray, np.ndarray]:
        """The generators on both sides of inner faces, (f,) int each."""
        inner = slice(self.faces.n_inner)
        return self.generator[self.faces.owner[inner]], self.generator[self.faces.neighbor[inner]]

    def are_enough(self, targets: CellTargets) -> bool:
        """Return whether sizes and angles are good enough without further steps."""
        most_error, most_angle = _EXACT_ENOUGH if targets.first else _ENOUGH
        here = self.volumes > 0
        error = np.abs(np.cbrt(self.volumes[here] / targets.volumes[here]) - 1)
        angle = self.faces.measures.non_orthogonality[self.pairs]
        return not len(angle) or bool(error.mean() <= most_error and angle.mean() <= most_angle)


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
    if not steps:
        return points
    good, most = points, np.zeros(len(points))
    stays = surface.at_concave_creases(points, sizes) | ~surface.touches(points, _REACH * sizes)
    stays[: targets.fixed] = stays[surface.thin_parts(points, sizes)[0]] = True
    for step in range(steps + _CHECKS):
        made = make(points)
        if step == 0:
            if np.count_nonzero(made.worst > 1) > _FEW * len(points):
                break
            most = _WORSE * np.maximum(made.worst, _GOOD)
            stays |= made.around(made.worst > _GOOD)
        worse = made.worst > most
        if not worse.any():
            good = points
            if step >= steps or made.are_enough(targets):
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
    f, g, n, volumes = made.faces, made.faces.measures.geometry, len(points), made.volumes
    free = ~stays & (volumes > 0)
    to_centroid = np.zeros((n, 3))
    moments = np.stack([made.sums(g.volumes * c) for c in g.centroids.T], axis=1)
    to_centroid[free] = moments[free] / volumes[free, None] - points[free]
    between = made.pairs
    one, other, center = *(rows[between] for rows in made.generators), f.center[between]
    scaled = f.area[between] / np.maximum(np.linalg.norm(points[other] - points[one], axis=1), 1e-3 * sizes[one])
    by_one, by_other = (scaled[:, None] * (points[c] - center) for c in (one, other))
    rows, columns = np.concatenate([one, one, other, other]), np.concatenate([other, one, one, other])
    entries = np.concatenate([by_other, -by_one, by_one, -by_other])
    weight = np.where(free | targets.first, 1.0, _STAYING) / sizes**2
    # Only generators that are free move, and only their cells and those beside them change.
    kept = free[columns]
    rows, columns, entries = rows[kept], columns[kept], entries[kept] * weight[rows[kept], None]
    cells, rows = used_indices(rows, n)
    movable = np.flatnonzero(free)
    if not len(movable):
        return to_centroid
    columns = 3 * np.searchsorted(movable, columns)[:, None] + np.arange(3)
    matrix = scipy.sparse.csr_matrix(
        (entries.ravel(), (np.repeat(rows, 3), columns.ravel())), shape=(len(cells), 3 * len(movable))
    )
    lack = (weight * (targets.volumes - volumes))[cells] - matrix @ to_centroid[movable].ravel()
    damping = _EXACT_DAMPING if targets.first else _DAMPING
    way = to_centroid
    way[movable] += scipy.sparse.linalg.lsqr(matrix, lack, damp=damping, iter_lim=60)[0].reshape(-1, 3)
    way *= np.minimum(1, _LONGEST * sizes / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
    moved = np.flatnonzero(way.any(axis=1))
    there, h = points[moved] + way[moved], sizes[moved]
    way[moved[(surface.closest(there)[2] > -_DEEP * h) | surface.at_concave_creases(there, h)]] = 0
    return way
