"""Cells in 2D that are not convex away from walls: several faces between two cells become one, points move.

Beside thin obstacles a cell has a part that the boundary has cut off from another cell. Its border with a third cell
then has a kink, or the point where three cells meet is a corner into one of them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mesh.connectivity import following
from ..mesh.faces import Faces
from ..mesh.geometry import turns
from .prisms import simple_loops

_STRAIGHT = 1e-4
"""Least turn in a corner of a convex cell."""
_ASIDE = 1e-3
"""Turn in a corner after its point has moved."""
_ROUNDS = 8
_NO_LENGTH = 1e-12
"""Length of an edge, over the extent of its cell, below which it has no direction."""


def join_faces(mesh: Faces) -> Faces:
    """Return `mesh` with a straight face for two that follow each other between the same cells, where convexity gains.

    The sum of both cells' angles beyond 180 degrees must become less, and their areas stay positive.
    """
    while True:
        ends = mesh.corners.reshape(-1, 2)
        k, v = mesh.n_inner, len(mesh.points)
        once = np.bincount(mesh.corners, minlength=v) == 2
        before, behind = np.full(v, -1), np.full(v, -1)
        behind[ends[:k, 0]] = np.arange(k)
        before[ends[:k, 1]] = np.arange(k)
        middles = np.flatnonzero(once & (before >= 0) & (behind >= 0))
        if not middles.size:
            return mesh
        starts, loops, broken = simple_loops(mesh)
        # Only cells that are not convex become less concave.
        cell, bent = np.repeat(np.arange(mesh.n_cells), np.diff(starts)), np.zeros(mesh.n_cells, bool)
        bent[cell[turns(mesh.points[loops], following(starts)) < _STRAIGHT]] = True
        sides = before[middles]
        middles = middles[bent[mesh.owner[sides]] | bent[mesh.neighbor[sides]]]
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
        mesh = replace(mesh, corners=ends.ravel()).take_faces(kept).compact()


def move_concave_points(mesh: Faces) -> Faces:
    """Return `mesh` with points away from walls and seams moved so that cells with a concave corner become convex.

    The point in that corner moves onto the line between the corners before and after it. If it is on a wall, one of
    these two moves instead, onto the line through the corner. The sum of the angles beyond 180 degrees of the cells
    around the point must become less, and their areas stay positive.
    """
    points = mesh.points.copy()
    held = np.zeros(len(points), bool)
    held[mesh.corners[mesh.starts[mesh.n_inner] :]] = True
    starts, loops, broken = simple_loops(mesh)
    after = following(starts)
    cell = np.repeat(np.arange(mesh.n_cells), np.diff(starts))
    in_broken = np.isin(cell, broken)
    held[loops[in_broken]] = True
    by_point = np.argsort(loops, kind="stable")
    first = np.searchsorted(loops[by_point], np.arange(len(points) + 1))

    def around(p: int) -> np.ndarray:
        return cell[by_point[first[p] : first[p + 1]]]

    changes, changed, tried = 0, np.zeros(mesh.n_cells, np.int64), np.full(len(loops), -1)

    def moves(p: int, target: np.ndarray) -> bool:
        """Move point p if that makes the cells around it less concave; return whether it does."""
        nonlocal changes
        cells = around(p)
        rows = [loops[starts[c] : starts[c + 1]] for c in cells]
        now, old = sum(_bent(points[row]) for row in rows), points[p].copy()
        points[p] = target
        if sum(_bent(points[row]) for row in rows) < now:
            changes += 1
            changed[cells] = changes
            return True
        points[p] = old
        return False

    for _ in range(_ROUNDS):
        turn = turns(points[loops], after)
        moved = False
        for place in np.flatnonzero((turn < _STRAIGHT) & ~in_broken).tolist():
            at, end = starts[cell[place]], starts[cell[place] + 1]
            p = int(loops[place])
            a = int(loops[place - 1 if place > at else end - 1])
            b = int(loops[place + 1 if place + 1 < end else at])
            if all(changed[around(x)].max() <= tried[place] for x in (p, a, b)):
                continue
            tried[place] = changes
            if not held[p]:
                moved |= moves(p, _onto_line(points[p], points[a], points[b]))
                continue
            for x, y, side in ((b, a, 1), (a, b, -1)):
                if held[x] or (points[p] == points[y]).all():
                    continue
                if moves(x, _beyond(points[x], points[p], points[y], side)):
                    moved = True
                    break
        if not moved:
            break
    return replace(mesh, points=points)


def _onto_line(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the projection of p onto the line from a to b, moved a little to its right."""
    along = b - a
    square = along @ along
    share = np.clip((p - a) @ along / square, 0.1, 0.9)
    outward = np.array([along[1], -along[0]])
    return a + share * along + _ASIDE * share * (1 - share) * outward


def _beyond(x: np.ndarray, p: np.ndarray, y: np.ndarray, side: int) -> np.ndarray:
    """Return the place of x on the line from y through p, a little to the left of it, or to the right (side -1)."""
    along = (p - y) / np.hypot(*(p - y)) * np.hypot(*(x - p))
    return p + along + side * _ASIDE * np.array([-along[1], along[0]])


def _bent(corners: np.ndarray) -> float:
    """Return the sum of the angles of a polygon beyond 180 degrees, infinite if it is not simple."""
    x, y = corners.T
    u, v = (np.append(z[1:], z[:1]) - z for z in (x, y))
    length = np.maximum(abs(u), abs(v))
    extent = max(x.max() - x.min(), y.max() - y.min())
    kept = length > _NO_LENGTH * extent
    if not kept.all():
        return _bent(corners[kept]) if kept.sum() > 2 else np.inf
    behind = np.append(u[-1:], u[:-1]), np.append(v[-1:], v[:-1])
    turn = np.arctan2(behind[0] * v - behind[1] * u, behind[0] * u + behind[1] * v)
    if len(corners) < 3 or abs(turn.sum() - 2 * np.pi) > 1:
        return np.inf
    return float(np.maximum(_STRAIGHT - turn, 0).sum())
