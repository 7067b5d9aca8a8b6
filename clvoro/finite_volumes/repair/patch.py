"""Patches of a solver mesh in 2D: groups of cells whose points and faces may change. All other cells stay."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...mesh.faces import Faces

if TYPE_CHECKING:
    from .wall_corners import CornerCut

BORDER = np.iinfo(np.int32).min
"""In place of the neighbor of a face that stays: the cell behind it is not in the patch."""
LIMITS = (np.radians(19), 1.9)
"""Non-orthogonality in radians and skewness; faces beyond one of these are improved."""


@dataclass(eq=False)
class Patch:
    """Cells of a mesh, with their faces.

    Attributes
    ----------
    cells : (n,) int64
        Their indices in the mesh, ascending.
    points : (v, 2) float64
    ids : (v,) int64
        Index of each point in the mesh; -1 for a new one.
    ends : (f, 2) int64
        Points of each face; the owner is on the left of the way from the first to the second.
    owner, neighbor : (f,) int64
        Cells of the patch, owner < neighbor; neighbor -1 - k on wall k of the domain, BORDER at other cells.
    half_face : (f,) int64
        Half-face of the diagram, -1 for a face that the diagram does not have.
    aim : (f,) float64
        Least length that is aimed at, over the smaller size of the cells; NaN if it is not known yet.
    held : (v,) bool
        Points that stay: those of cells with a border.
    fixed : (v,) bool
        Those, and points on walls that cannot slide along them.
    positions : (v,) float64
        Position of each point on a wall along the boundary; NaN for others.
    limits : (float, float)
        Non-orthogonality in radians and skewness beyond which faces are bad.
    cuts : tuple of Cut
        Corners of walls that have been cut off.
    """

    cells: np.ndarray
    points: np.ndarray
    ids: np.ndarray
    ends: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    half_face: np.ndarray
    aim: np.ndarray
    held: np.ndarray
    fixed: np.ndarray
    positions: np.ndarray
    limits: tuple[float, float] = LIMITS
    cuts: tuple[CornerCut, ...] = ()

    @property
    def walls(self) -> np.ndarray:
        """Whether each face is on a wall, (f,)."""
        return (self.neighbor < 0) & (self.neighbor != BORDER)

    @property
    def on_walls(self) -> np.ndarray:
        """Whether each point is on a wall, (v,)."""
        found = np.zeros(len(self.points), bool)
        found[self.ends[self.walls]] = True
        return found


def take_patch(mesh: Faces, chosen: np.ndarray) -> Patch:
    """Return the cells `chosen` (n,) bool of `mesh`, all points on walls fixed; faces at seams are borders."""
    neighbor = np.where(mesh.twin >= 0, BORDER, mesh.neighbor.astype(np.int64))
    v = len(mesh.points)
    whole = Patch(
        np.arange(mesh.n_cells),
        mesh.points,
        np.arange(v),
        mesh.corners.reshape(-1, 2),
        mesh.owner,
        neighbor,
        mesh.half_face,
        np.full(len(neighbor), np.nan),
        np.zeros(v, bool),
        np.zeros(v, bool),
        np.full(v, np.nan),
    )
    made = part_of(whole, chosen)
    made.fixed |= made.on_walls
    return made


def part_of(patch: Patch, chosen: np.ndarray) -> Patch:
    """Return the cells `chosen` (n,) bool of a patch; its `cells` and `ids` are those of `patch`."""
    cells = np.flatnonzero(chosen)
    place = np.full(len(patch.cells), -1, np.int64)
    place[cells] = np.arange(len(cells))
    other = np.maximum(patch.neighbor, 0)
    there = np.where(patch.neighbor >= 0, place[other], patch.neighbor)
    there[(patch.neighbor >= 0) & ~chosen[other]] = BORDER
    here = place[patch.owner]
    turned = (here < 0) & (there >= 0)
    rows = np.flatnonzero((here >= 0) | turned)
    here, there, turned = here[rows], there[rows], turned[rows]
    ends = patch.ends[rows]
    ends[turned] = ends[turned, ::-1]
    owner, neighbor = np.where(turned, there, here), np.where(turned, BORDER, there)
    ids, local = np.unique(ends, return_inverse=True)
    local = local.reshape(-1, 2)
    at_border = np.zeros(len(cells), bool)
    at_border[owner[neighbor == BORDER]] = True
    beyond = (neighbor >= 0) & at_border[np.maximum(neighbor, 0)]
    held = np.zeros(len(ids), bool)
    held[local[at_border[owner] | beyond]] = True
    return Patch(
        cells,
        patch.points[ids],
        ids,
        local,
        owner,
        neighbor,
        patch.half_face[rows],
        patch.aim[rows],
        held,
        held | patch.fixed[ids],
        patch.positions[ids],
        patch.limits,
    )


def restored(patch: Patch, part: Patch) -> Patch:
    """Return `patch` with the faces and points of a `part` of it, which may have changed."""
    within = np.zeros(len(patch.cells), bool)
    within[part.cells] = True
    whole = within[patch.owner]
    whole &= np.where(patch.neighbor >= 0, within[np.maximum(patch.neighbor, 0)], True)
    kept, rows = ~whole | (patch.neighbor == BORDER), part.neighbor != BORDER
    other = np.where(part.neighbor >= 0, part.cells[np.maximum(part.neighbor, 0)], part.neighbor)
    ids, more = _numbered(part.ids, len(patch.points))
    points, positions = (np.pad(patch.points, ((0, more), (0, 0))), np.pad(patch.positions, (0, more)))
    points[ids], positions[ids] = part.points, part.positions
    return replace(
        patch,
        points=points,
        ids=np.pad(patch.ids, (0, more), constant_values=-1),
        held=np.pad(patch.held, (0, more)),
        fixed=np.pad(patch.fixed, (0, more)),
        positions=positions,
        ends=np.concatenate([patch.ends[kept], ids[part.ends[rows]]]),
        owner=np.concatenate([patch.owner[kept], part.cells[part.owner[rows]]]),
        neighbor=np.concatenate([patch.neighbor[kept], other[rows]]),
        half_face=np.concatenate([patch.half_face[kept], part.half_face[rows]]),
        aim=np.concatenate([patch.aim[kept], part.aim[rows]]),
        cuts=patch.cuts + part.cuts,
    )


def _numbered(ids: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Return `ids` (v,) with numbers from `count` on for new points, and how many these are."""
    new = np.flatnonzero(ids < 0)
    made = ids.copy()
    made[new] = count + np.arange(len(new))
    return made, len(new)


def put_back(mesh: Faces, patches: list[Patch]) -> Faces:
    """Return `mesh` with the faces and points of `patches`, which have no cell in common."""
    new = [int((patch.ids < 0).sum()) for patch in patches]
    points, of, ids = np.pad(mesh.points, ((0, sum(new)), (0, 0))), np.full(mesh.n_cells, -1), []
    for i, patch in enumerate(patches):
        ids.append(_numbered(patch.ids, len(mesh.points) + sum(new[:i]))[0])
        points[ids[-1]] = patch.points
        of[patch.cells] = i
    n = mesh.n_outer
    here, there = mesh.owner[:n], mesh.neighbor[:n]
    within = (there < 0) | (of[np.maximum(there, 0)] == of[here])
    kept = np.flatnonzero(~within | (of[here] < 0))
    all_corners = mesh.corners.reshape(-1, 2)
    columns = [(all_corners[kept], here[kept], there[kept], mesh.half_face[kept])]
    for p, numbers in zip(patches, ids, strict=True):
        rows = p.neighbor != BORDER
        other = np.where(p.neighbor >= 0, p.cells[np.maximum(p.neighbor, 0)], p.neighbor)
        columns.append((numbers[p.ends[rows]], p.cells[p.owner[rows]], other[rows], p.half_face[rows]))
    ends, owner, neighbor, half = (np.concatenate(x) for x in zip(*columns, strict=True))
    wall = neighbor < 0
    first, second = np.where(wall, -neighbor, owner), np.where(wall, owner, neighbor)
    order = np.lexsort((second, first, wall))
    seams = slice(n, len(mesh.owner))
    before, count = len(order), len(order) + len(mesh.owner) - n
    twin = np.full(count, -1)
    twin[before:] = mesh.twin[seams] + before - n
    shift = np.zeros((count, 2), mesh.shift.dtype)
    shift[before:] = mesh.shift[seams]
    all_corners = np.concatenate([ends[order], all_corners[seams]])
    made = replace(
        mesh,
        points=points,
        starts=2 * np.arange(count + 1),
        corners=all_corners.ravel(),
        owner=np.concatenate([owner[order], mesh.owner[seams]]).astype(mesh.owner.dtype),
        neighbor=np.concatenate([neighbor[order], mesh.neighbor[seams]]).astype(mesh.owner.dtype),
        twin=twin,
        shift=shift,
        half_face=np.concatenate([half[order], mesh.half_face[seams]]),
    )
    return made.compact()


def cell_sides(patch: Patch) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the sides of each cell in their order around it: starts (n + 1,), first points (k,) and faces (k,).

    None if a cell is no simple ring of at least three sides.
    """
    inner = np.flatnonzero(patch.neighbor >= 0)
    n, v = len(patch.cells), len(patch.points)
    cell = np.concatenate([patch.owner, patch.neighbor[inner]])
    begin = np.concatenate([patch.ends[:, 0], patch.ends[inner, 1]])
    end = np.concatenate([patch.ends[:, 1], patch.ends[inner, 0]])
    face = np.concatenate([np.arange(len(patch.owner)), inner])
    key = cell * v + begin
    order = np.argsort(key, kind="stable")
    key, begin, face = key[order], begin[order], face[order]
    after = np.searchsorted(key, (cell * v + end)[order])
    counts = np.bincount(cell, minlength=n)
    if (np.diff(key) == 0).any() or counts.min(initial=3) < 3 or (after == len(key)).any():
        return None
    if (key[after] != (cell * v + end)[order]).any():
        return None
    starts = np.concatenate([[0], np.cumsum(counts)])
    rows, places = np.empty(len(key), np.int64), starts[:-1].copy()
    seen = np.zeros(len(key), bool)
    for step in range(int(counts.max(initial=0))):
        going = np.flatnonzero(counts > step)
        rows[starts[going] + step] = places[going]
        seen[places[going]] = True
        places[going] = after[places[going]]
    return (starts, begin[rows], face[rows]) if seen.all() else None
