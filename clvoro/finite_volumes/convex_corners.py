"""Cells in 2D that are not convex away from walls: several faces between two cells become one, points move.

Beside thin obstacles a cell has a part that the boundary has cut off from another cell. Its border with a third cell
then has a kink, or the point where three cells meet is a corner into one of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mesh.connectivity import following
from .prisms import simple_loops
from .solver_mesh import SolverMesh

_STRAIGHT = 1e-4
_ASIDE = 1e-3
"""Turn in a corner after its point has moved."""
_ROUNDS = 8


def join_faces(mesh: SolverMesh) -> SolverMesh:
    """Return `mesh` with a straight face for two that follow each other between the same cells, where convexity gains.

    The sum of both cells' angles beyond 180 degrees must become less, and their areas stay positive.
    """
    while True:
        ends = mesh.corners.reshape(-1, 2)
        k, v = mesh.inner, len(mesh.points)
        once = np.bincount(mesh.corners, minlength=v) == 2
        before, behind = np.full(v, -1), np.full(v, -1)
        behind[ends[:k, 0]] = np.arange(k)
        before[ends[:k, 1]] = np.arange(k)
        middles = np.flatnonzero(once & (before >= 0) & (behind >= 0))
        if not middles.size:
            return mesh
        starts, loops, broken = simple_loops(mesh)
        spoiled = set(broken.tolist())
        drop: list[int] = []
        ends = ends.copy()
        for p in middles.tolist():
            f, g = int(before[p]), int(behind[p])
            cells = {int(mesh.owner[f]), int(mesh.neighbor[f])}
            if cells != {int(mesh.owner[g]), int(mesh.neighbor[g])} or cells & spoiled:
                continue
            rows = [loops[starts[c] : starts[c + 1]] for c in cells]
            now = sum(_bent(mesh.points[row]) for row in rows)
            if sum(_bent(mesh.points[row[row != p]]) for row in rows) < now:
                ends[f, 1] = ends[g, 1]
                drop.append(g)
                spoiled |= cells
        if not drop:
            return mesh
        kept = np.ones(len(ends), bool)
        kept[drop] = False
        mesh = replace(mesh, corners=ends.ravel()).take_faces(kept)


def move_concave_points(mesh: SolverMesh) -> SolverMesh:
    """Return `mesh` with points away from walls and seams moved out of cells that have a concave corner there.

    Such a point moves onto the line between the corners before and after it. The sum of the angles beyond 180 degrees
    of the cells around it must become less, and their areas stay positive.
    """
    points = mesh.points.copy()
    held = np.zeros(len(points), bool)
    held[mesh.corners[mesh.starts[mesh.inner] :]] = True
    starts, loops, broken = simple_loops(mesh)
    after = following(starts)
    cell = np.repeat(np.arange(len(mesh)), np.diff(starts))
    held[loops[np.isin(cell, broken)]] = True
    by_point = np.argsort(loops, kind="stable")
    first = np.searchsorted(loops[by_point], np.arange(len(points) + 1))
    for _ in range(_ROUNDS):
        ahead = points[loops[after]] - points[loops]
        behind = np.empty_like(ahead)
        behind[after] = ahead
        turn = behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0]
        size = (behind * ahead).sum(axis=1)
        places = np.flatnonzero((np.arctan2(turn, size) < _STRAIGHT) & ~held[loops])
        moved = False
        for place in places.tolist():
            p, at = int(loops[place]), int(starts[cell[place]])
            row = loops[at : starts[cell[place] + 1]]
            k = place - at
            a, b = points[row[k - 1]], points[row[(k + 1) % len(row)]]
            along = b - a
            length = np.hypot(*along)
            outward = np.array([along[1], -along[0]]) / length
            share = np.clip((points[p] - a) @ along / length**2, 0.1, 0.9)
            target = a + share * along + _ASIDE * share * (1 - share) * length * outward
            cells = cell[by_point[first[p] : first[p + 1]]]
            rows = [loops[starts[c] : starts[c + 1]] for c in cells]
            now = sum(_bent(points[row]) for row in rows)
            old = points[p].copy()
            points[p] = target
            if sum(_bent(points[row]) for row in rows) < now:
                moved = True
            else:
                points[p] = old
        if not moved:
            break
    return replace(mesh, points=points)


def _bent(corners: np.ndarray) -> float:
    """Return the sum of the angles of a polygon beyond 180 degrees, infinite if it is not simple."""
    ahead = np.roll(corners, -1, axis=0) - corners
    behind = np.roll(ahead, 1, axis=0)
    turn = np.arctan2(
        behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0], (behind * ahead).sum(axis=1)
    )
    if len(corners) < 3 or abs(turn.sum() - 2 * np.pi) > 1:
        return np.inf
    return float(np.maximum(_STRAIGHT - turn, 0).sum())
