"""The cells of a solver mesh as polyhedra: in 2D one layer of prisms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arguments import check_number, format_point
from ..connectivity import starts_of, take_rows
from ..errors import InputError
from ..mesh.faces import Faces


def polyhedra(mesh: Faces, thickness: float | None = None) -> Faces:
    """Return the cells of `mesh` as polyhedra: in 2D one layer of prisms.

    The bottoms of the prisms follow the faces of `mesh`, then the tops. Bottom and top of cell i have the neighbors
    -1 - w and -2 - w, with w the number of walls of the domain.

    - `thickness`: in 2D: height of the prisms, whose bottoms are at z = 0. By default the mean width of a cell.

    Raises `InputError` or `InputTypeError` if `thickness` is not positive, or given in 3D; in 2D for a cell around an
    island or one that touches itself.
    """
    if mesh.dim == 3:
        if thickness is not None:
            raise InputError("thickness is for meshes in 2D, and the mesh has 3 dimensions; leave it out")
        return mesh
    n, v = mesh.n_cells, len(mesh.points)
    height = (
        float(np.sqrt(mesh.domain.measure / n)) if thickness is None else check_number("thickness", thickness, above=0)
    )
    points = np.pad(np.concatenate([mesh.points, mesh.points]), ((0, 0), (0, 1)))
    points[v:, 2] = height
    a, b = mesh.corners.reshape(-1, 2).T
    sides = np.stack([a, b, b + v, a + v], axis=1)
    lower = (mesh.twin >= 0) & (mesh.twin < np.arange(len(mesh.twin)))
    sides[lower] = np.roll(sides[lower], -1, axis=1)  # begins with the image of the twin's first
    starts, loops = cell_loops(mesh)
    cells = np.arange(n, dtype=mesh.owner.dtype)
    _, bottoms = take_rows(starts, loops, cells, np.ones(n, bool))
    lengths = np.concatenate([np.full(len(sides), 4), np.diff(starts), np.diff(starts)])
    walls = len(mesh.domain.boundary_index)
    return replace(
        mesh,
        generators=np.pad(mesh.generators, ((0, 0), (0, 1))),
        points=points,
        starts=starts_of(lengths),
        corners=np.concatenate([sides.ravel(), bottoms, loops + v]),
        owner=np.concatenate([mesh.owner, cells, cells]),
        neighbor=np.concatenate([mesh.neighbor, np.repeat(np.array([-1 - walls, -2 - walls], np.int32), n)]),
        twin=np.pad(mesh.twin, (0, 2 * n), constant_values=-1),
        shift=np.pad(mesh.shift, ((0, 2 * n), (0, 1))),
        half_face=np.pad(mesh.half_face, (0, 2 * n), constant_values=-1),
    )


def cell_loops(mesh: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of each cell in 2D as ragged rows, counter-clockwise: starts (n + 1,) and points.

    Raises `InputError` for a cell around an island, or one that touches itself.
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


def simple_loops(mesh: Faces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return starts and points as `cell_loops`, and the cells that are no simple polygons, whose rows mean nothing."""
    v, cell, (begin, end) = len(mesh.points), mesh.sides()[0], mesh.side_ends()
    key = cell * v + begin
    order = np.argsort(key, kind="stable")
    key, cell, begin, end = key[order], cell[order], begin[order], end[order]
    counts = np.bincount(cell, minlength=mesh.n_cells)
    starts = starts_of(counts)
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
