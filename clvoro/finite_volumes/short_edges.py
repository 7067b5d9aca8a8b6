"""Collapse of short faces in 2D: their two ends become one point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mesh.connectivity import following, take_rows
from ..mesh.straightening import cross
from .geometry import turns
from .independent import independent
from .prisms import simple_loops
from .solver_mesh import SolverMesh

SHORT = 0.02
"""A face is short if it is shorter than this, over the width of the thinner of its cells."""
SHORT_ON_WALL = 0.05
"""The same for a face on a wall: OpenFOAM divides the skewness of such a face by its length."""
_SHARP = np.pi / 6
"""Turn of a wall that is a corner: its point does not move."""
_STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell; OpenFOAM counts cells with less than about 1e-6 as concave."""
_ROUNDS = 12
_FREE, _WALL, _CORNER = range(3)
"""Kinds of points: of two with different kinds, the one of the larger kind stays."""


def collapse_short_edges(mesh: SolverMesh, parts: np.ndarray) -> SolverMesh:
    """Return a mesh in 2D without short faces, as far as its cells remain convex.

    A corner of the domain and a point where the name of the boundary changes stay where they are. Of two points on a
    wall one takes the place of both. Inside, the middle of the face is tried first, then its ends. The images of a
    point at the seams of a periodic box move together.

    Parameters
    ----------
    mesh : SolverMesh
    parts : (k,) int
        Index of the named part of the boundary for each wall.
    """
    failed = np.empty(0, np.int64)
    for _ in range(_ROUNDS):
        made, failures = _collapse_some(mesh, parts, failed)
        if made is None:
            break
        failed = np.empty(0, np.int64) if made is not mesh else np.concatenate([failed, failures])
        mesh = made
    return mesh


def _collapse_some(
    mesh: SolverMesh, parts: np.ndarray, failed: np.ndarray
) -> tuple[SolverMesh | None, np.ndarray]:
    """Collapse short faces that share no cell; return the mesh, the same if none could be, and the faces that failed.

    Without any face to try the mesh is None.
    """
    starts, loop, broken = simple_loops(mesh)
    n, counts = len(mesh), np.diff(starts)
    images = mesh.images if any(mesh.domain.periodic) else np.arange(len(mesh.points))
    kind = _kinds(mesh, parts, images)
    cell = np.repeat(np.arange(n), counts)
    a, b = mesh.corners.reshape(-1, 2).T
    lengths = np.linalg.norm(mesh.points[b] - mesh.points[a], axis=1)
    k = mesh.inner
    both = np.concatenate([mesh.owner, mesh.neighbor[:k]])
    here = mesh.points[loop]
    there = here[following(starts)]
    base = here[np.minimum(starts[:-1], len(here) - 1)][cell]
    area = np.bincount(cell, cross(here - base, there - base), n) / 2
    perimeter = np.bincount(both, np.concatenate([lengths, lengths[:k]]), n)
    width = 4 * area / np.maximum(perimeter, 1e-300)
    width[broken] = 0
    thinner = width[mesh.owner]
    coupled = mesh.neighbor >= 0
    thinner[coupled] = np.minimum(thinner[coupled], width[mesh.neighbor[coupled]])
    ratio = lengths / np.maximum(thinner, 1e-300) / np.where(coupled, SHORT, SHORT_ON_WALL)
    # One side of each seam; no face between cells that joins two walls, and none on a wall between two corners.
    tried = (ratio < 1) & (mesh.twin < np.arange(len(a))) & (images[a] != images[b])
    tried &= np.minimum(kind[a], kind[b]) == np.where(coupled, _FREE, _WALL)
    tried[failed] = False
    faces = np.flatnonzero(tried)
    if not faces.size:
        return None, faces
    faces = _independent(
        faces[np.argsort(ratio[faces], kind="stable")], a, b, images, loop, cell, n
    )
    edge_of = np.full(images.max() + 1, -1)  # of each class of points
    edge_of[images[a[faces]]] = edge_of[images[b[faces]]] = np.arange(len(faces))
    p, q = mesh.points[a[faces]], mesh.points[b[faces]]
    touched = np.unique(cell[edge_of[images[loop]] >= 0])
    rows, corners = take_rows(starts, loop, touched)
    row = np.repeat(np.arange(len(touched)), np.diff(rows))
    edge = np.full(len(touched), -1)
    np.maximum.at(edge, row, edge_of[images[corners]])
    before = _least_turns(mesh.points[corners], rows)
    merged = _representatives(mesh, images, edge_of, a[faces], b[faces])
    done = np.full(len(faces), False)
    target = p.copy()
    choices = [(p + q) / 2, p, q]
    equal = kind[a[faces]] == kind[b[faces]]
    # The middle of two points on a wall may be off a curve.
    free = equal & (kind[a[faces]] == _FREE)
    allowed = [
        free,
        equal | (kind[a[faces]] > kind[b[faces]]),
        equal | (kind[a[faces]] < kind[b[faces]]),
    ]
    kept = merged[corners] != merged[corners[following(rows)]]
    left = np.bincount(row, kept, len(touched)).astype(int)
    new_rows = np.concatenate([[0], np.cumsum(left)])
    for choice, fits in zip(choices, allowed, strict=True):
        open_ = fits & ~done
        trial = np.where(done[:, None], target, choice)
        moved = _moved(mesh, images, edge_of, a[faces], b[faces], trial, merged)
        after = _least_turns(moved[merged[corners[kept]]], new_rows)
        good = (left >= 3) & (after >= np.minimum(before, _STRAIGHT))
        accepted = open_ & (np.bincount(edge, ~good, len(faces)) == 0)
        target[accepted] = choice[accepted]
        done |= accepted
    if not done.any():
        return mesh, faces
    # Classes of edges that failed do not move.
    edge_of[edge_of >= 0] = np.where(done[edge_of[edge_of >= 0]], edge_of[edge_of >= 0], -1)
    merged = _representatives(mesh, images, edge_of, a[faces], b[faces])
    points = _moved(mesh, images, edge_of, a[faces], b[faces], target, merged)
    ends = merged[mesh.corners].reshape(-1, 2)
    made = replace(mesh, points=points, corners=ends.ravel())
    return made.take_faces(ends[:, 0] != ends[:, 1]), faces[~done]


def _kinds(mesh: SolverMesh, parts: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Return whether each point is free, on a wall, or fixed in a corner, (v,) int."""
    walls = slice(mesh.inner, mesh.outer)
    a, b = mesh.corners.reshape(-1, 2)[walls].T
    part = parts[-1 - mesh.neighbor[walls]]
    classes = int(images.max()) + 1
    along = mesh.points[b] - mesh.points[a]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    ahead, behind = np.full((classes, 3), np.nan), np.full((classes, 3), np.nan)
    ahead[images[a]] = np.column_stack([along, part])
    behind[images[b]] = np.column_stack([along, part])
    met = np.bincount(images[a], minlength=classes) + np.bincount(images[b], minlength=classes)
    turn = np.abs(
        np.arctan2(cross(behind[:, :2], ahead[:, :2]), (behind[:, :2] * ahead[:, :2]).sum(axis=1))
    )
    smooth = (met == 2) & (turn < _SHARP) & (ahead[:, 2] == behind[:, 2])
    return np.where(met == 0, _FREE, np.where(smooth, _WALL, _CORNER))[images]


def _independent(
    faces: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    images: np.ndarray,
    loop: np.ndarray,
    cell: np.ndarray,
    n: int,
) -> np.ndarray:
    """Return those of `faces`, the first ones preferred, whose points and their images touch no common cell."""
    moving = np.zeros(images.max() + 1, bool)
    moving[images[a[faces]]] = moving[images[b[faces]]] = True
    rows = np.flatnonzero(moving[images[loop]])
    pairs = np.unique(images[loop[rows]] * n + cell[rows])
    of_class, cells = pairs // n, pairs % n
    first = np.searchsorted(of_class, np.arange(images.max() + 2))
    ends = np.concatenate([images[a[faces]], images[b[faces]]])
    rank = np.tile(np.arange(len(faces)), 2)
    starts, touched = take_rows(first, cells, ends)
    ranks = np.repeat(rank, np.diff(starts))
    return faces[independent(ranks, touched, np.arange(len(faces)), n)]


def _shifts(mesh: SolverMesh, points: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Return by how many periods `points` are away from `origins`, (k, 2) int."""
    extent = np.array(mesh.domain.extent)
    period = np.where(mesh.domain.periodic, extent, np.inf)
    return np.rint((points - origins) / period).astype(np.int64)


def _representatives(
    mesh: SolverMesh, images: np.ndarray, edge_of: np.ndarray, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Return for each point the one that takes its place, (v,): where two ends of a face merge, one of them."""
    merged = np.arange(len(mesh.points))
    moving = np.flatnonzero(edge_of[images] >= 0)
    edge = edge_of[images[moving]]
    origin = np.where(images[moving] == images[a[edge]], a[edge], b[edge])
    shift = _shifts(mesh, mesh.points[moving], mesh.points[origin])
    key = np.column_stack([edge, shift])
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    merged[moving] = moving[first][which.ravel()]
    return merged


def _moved(
    mesh: SolverMesh,
    images: np.ndarray,
    edge_of: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    target: np.ndarray,
    merged: np.ndarray,
) -> np.ndarray:
    """Return the points, (v, 2), where the ends `a` and `b` of each face go to `target` (k, 2)."""
    points = mesh.points.copy()
    moving = np.flatnonzero((edge_of[images] >= 0) & (merged == np.arange(len(points))))
    edge = edge_of[images[moving]]
    origin = np.where(images[moving] == images[a[edge]], a[edge], b[edge])
    shift = _shifts(mesh, points[moving], points[origin])
    points[moving] = target[edge] + shift * np.array(mesh.domain.extent)
    return points


def _least_turns(corners: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the least angle to the left in the corners of polygons, given as ragged rows; -pi for fewer than 3."""
    turn = turns(corners, following(starts))
    enough = np.diff(starts) >= 3
    least = np.full(len(starts) - 1, -np.pi)
    rows = np.repeat(np.arange(len(least)), np.diff(starts))
    full = np.full(len(least), np.inf)
    np.minimum.at(full, rows, turn)
    least[enough] = full[enough]
    return least
