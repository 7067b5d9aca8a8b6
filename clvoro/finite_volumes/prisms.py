"""The cells of a solver mesh as polyhedra: in 2D one layer of prisms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arguments import check_number, format_point
from ..errors import InputError
from ..mesh.connectivity import take_rows
from ..mesh.read_only import Sealed

if TYPE_CHECKING:
    from .solver_mesh import SolverMesh


@dataclass(frozen=True, eq=False)
class Polyhedra(Sealed):
    """Polyhedral cells: the faces of a solver mesh, then in 2D the bottoms of the prisms, then the tops.

    Attributes
    ----------
    points : (v, 3) float64
    starts : (f + 1,) int64
    corners : (k,) int64
        Corners of each face, counter-clockwise as seen from outside of the owner.
    owner : (f,) int32
        Of bottom and top of cell i, i.
    """

    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray


def polyhedra(mesh: SolverMesh, thickness: float | None = None) -> Polyhedra:
    """Return the cells of `mesh` as polyhedra.

    Parameters
    ----------
    mesh : SolverMesh
    thickness : float, optional
        In 2D: height of the prisms, whose bottoms are at z = 0. By default the mean width of a cell.

    Raises
    ------
    InputError, InputTypeError
        If `thickness` is not positive, or given in 3D; in 2D for a cell around an island or one that touches itself.
    """
    if mesh.dim == 3:
        if thickness is not None:
            raise InputError("thickness is for meshes in 2D, and the mesh has 3 dimensions; leave it out")
        return Polyhedra(mesh.points, mesh.starts, mesh.corners, mesh.owner)
    height = (
        float(np.sqrt(mesh.domain.measure / len(mesh)))
        if thickness is None
        else check_number("thickness", thickness, above=0)
    )
    v = len(mesh.points)
    points = np.pad(np.concatenate([mesh.points, mesh.points]), ((0, 0), (0, 1)))
    points[v:, 2] = height
    a, b = mesh.corners.reshape(-1, 2).T
    sides = np.stack([a, b, b + v, a + v], axis=1)
    lower = (mesh.twin >= 0) & (mesh.twin < np.arange(len(mesh.twin)))
    sides[lower] = np.roll(sides[lower], -1, axis=1)  # begins with the image of the twin's first
    starts, loops = cell_loops(mesh)
    cells = np.arange(len(mesh), dtype=mesh.owner.dtype)
    _, bottoms = take_rows(starts, loops, cells, np.ones(len(cells), bool))
    lengths = np.concatenate([np.full(len(sides), 4), np.diff(starts), np.diff(starts)])
    return Polyhedra(
        points,
        np.concatenate([[0], np.cumsum(lengths)]),
        np.concatenate([sides.ravel(), bottoms, loops + v]),
        np.concatenate([mesh.owner, cells, cells]),
    )


def cell_loops(mesh: SolverMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of each cell in 2D as ragged rows, counter-clockwise: starts (n + 1,) and points.

    Raises
    ------
    InputError
        For a cell around an island, or one that touches itself.
    """
    starts, loop, broken = simple_loops(mesh)
    if broken.size:
        own = mesh.owner == broken[0]
        place = mesh.points[mesh.corners.reshape(-1, 2)[own]].mean(axis=(0, 1))
        raise InputError(
            f"cell {broken[0]} ({len(broken)} in all) goes around a part of the boundary or touches itself, at "
            f"{format_point(place)}, and the cells of solvers have no holes; use smaller cells there, drop the hole, "
            "as domain.simplified(size) does, or save as .vtu"
        )
    return starts, loop


def simple_loops(mesh: SolverMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return starts and points as `cell_loops`, and the cells that are no simple polygons, whose rows mean nothing."""
    a, b = mesh.corners.reshape(-1, 2).T
    k, v = mesh.inner, len(mesh.points)
    cell = np.concatenate([mesh.owner, mesh.neighbor[:k]]).astype(np.int64)
    begin, end = np.concatenate([a, b[:k]]), np.concatenate([b, a[:k]])
    key = cell * v + begin
    order = np.argsort(key, kind="stable")
    key, cell, begin, end = key[order], cell[order], begin[order], end[order]
    counts = np.bincount(cell, minlength=len(mesh))
    starts = np.concatenate([[0], np.cumsum(counts)])
    after = np.minimum(np.searchsorted(key, cell * v + end), len(key) - 1)
    loop = begin.copy()
    seen = np.zeros(len(key), bool)
    cells, place = np.flatnonzero(counts), starts[:-1][counts > 0]
    for step in range(int(counts.max(initial=0))):
        going = counts[cells] > step
        cells, place = cells[going], place[going]
        loop[starts[cells] + step] = begin[place]
        seen[place] = True
        place = after[place]
    return starts, loop, np.unique(cell[~seen | np.concatenate([[False], np.diff(key) == 0])])
