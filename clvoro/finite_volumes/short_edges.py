"""Collapse of short faces in 2D: their two ends become one point."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from ..connectivity import following, independent, rows_of, starts_of, take_rows
from ..geometry.rings import WALL_CORNER
from ..mesh.faces import Faces
from ..mesh.geometry import polygon_areas, smaller_size, turns
from ..mesh.straightening import cross
from .prisms import simple_loops

SHORT, THIN = 0.055, 0.2
"""A face is short if it is shorter than both, over the smaller size of its cells and over the width of the thinner one.

Between columns of boundary layers cells are much longer than wide: there the second one holds."""
STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell; OpenFOAM counts cells with less than about 1e-6 as concave."""
_ROUNDS = 12
_FREE, WALL, CORNER = range(3)
"""Kinds of points: of two with different kinds, the one of the larger kind stays."""


def collapse_short_edges(mesh: Faces, parts: np.ndarray) -> Faces:
    """Return a mesh in 2D without short faces, as far as its cells remain convex.

    A corner of the domain and a point where the name of the boundary changes stay where they are. Of two points on a
    wall one takes the place of both. Inside, the middle of the face is tried first, then its ends. The images of a
    point at the seams of a periodic box move together.

    - `parts` (k,) int: index of the named part of the boundary for each wall.
    """
    failed = np.empty(0, np.int64)
    for _ in range(_ROUNDS):
        current = _Round(mesh, parts, failed)
        if not current.faces.size:
            break
        target, done = current.find_targets()
        if done.any():
            mesh, failed = current.collapsed(target, done), np.empty(0, np.int64)
        else:
            failed = np.concatenate([failed, current.faces])
    return mesh


class _Round:
    """Short faces that share no cell, and the points that move if they collapse.

    - `mesh`: Faces
    - `starts`, `loop`, `cell`: points around each cell as ragged rows, and the cell of each item.
    - `images` (v,) int: class of each point; points of a class are periodic images of one another.
    - `kind` (v,) int: free, on a wall, or in a corner.
    - `faces` (e,) int: the shortest first.
    - `a`, `b` (e,) int: their ends.
    - `face_of` (v,) int: index in `faces` of the face that the point, or an image of it, is an end of; -1 for other
      points.
    - `shift` (v, 2) int: by how many periods the point is away from that end.
    - `into` (v,) int: the point that takes its place: where two ends of a face merge, one of them.
    """

    def __init__(self, mesh: Faces, parts: np.ndarray, failed: np.ndarray) -> None:
        """Choose among the short faces of `mesh` without those of `failed`."""
        self.mesh, v = mesh, len(mesh.points)
        self.starts, self.loop, broken = simple_loops(mesh)
        self.cell = rows_of(self.starts)
        self.images = mesh.images if any(mesh.domain.periodic) else np.arange(v)
        self.kind = _point_kinds(mesh, parts, self.images)
        ratio = _lengths_over_limits(mesh, broken)
        ends = mesh.corners.reshape(-1, 2)
        first, second = self.images[ends].T
        # One side of each seam; no face between cells that joins two walls, and none on a wall between two corners.
        tried = (ratio < 1) & (mesh.twin < np.arange(len(ends))) & (first != second)
        tried &= self.kind[ends].min(axis=1) == np.where(mesh.neighbor >= 0, _FREE, WALL)
        tried[failed] = False
        faces = np.flatnonzero(tried)
        self.faces = self._independent(faces[np.argsort(ratio[faces], kind="stable")])
        self.a, self.b = ends[self.faces].T
        face_of = np.full(self.images.max(initial=-1) + 1, -1)  # of each class
        face_of[first[self.faces]] = face_of[second[self.faces]] = np.arange(len(self.faces))
        self.face_of = face_of[self.images]
        self.shift, self.into = self._follow_images()

    def _independent(self, faces: np.ndarray) -> np.ndarray:
        """Return those of `faces`, the first ones preferred, whose points and their images touch no common cell."""
        if not faces.size:
            return faces
        n, classes = self.mesh.n_cells, self.images.max() + 1
        ends = self.images[self.mesh.corners.reshape(-1, 2)[faces]].T.ravel()
        moving = np.zeros(classes, bool)
        moving[ends] = True
        rows = np.flatnonzero(moving[self.images[self.loop]])
        of_class, cells = np.divmod(np.unique(self.images[self.loop[rows]] * n + self.cell[rows]), n)
        starts, touched = take_rows(np.searchsorted(of_class, np.arange(classes + 1)), cells, ends)
        ranks = np.repeat(np.tile(np.arange(len(faces)), 2), np.diff(starts))
        return faces[independent(ranks, touched, np.arange(len(faces)), n)]

    def _follow_images(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `shift` and `into`."""
        points, v = self.mesh.points, len(self.mesh.points)
        moving = np.flatnonzero(self.face_of >= 0)
        face = self.face_of[moving]
        at_a = self.images[moving] == self.images[self.a[face]]
        end = np.where(at_a, self.a[face], self.b[face])
        period = np.where(self.mesh.domain.periodic, self.mesh.domain.extent, np.inf)
        shift, into = np.zeros((v, 2), np.int64), np.arange(v)
        shift[moving] = np.rint((points[moving] - points[end]) / period)
        key = np.column_stack([face, shift[moving]])
        _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        into[moving] = moving[first][which.ravel()]
        return shift, into

    def find_targets(self) -> tuple[np.ndarray, np.ndarray]:
        """Return to which place both ends of each face can move, (e, 2), and whether they can, (e,) bool."""
        p, q = self.mesh.points[self.a], self.mesh.points[self.b]
        kind, other = self.kind[self.a], self.kind[self.b]
        done, target = np.zeros(len(self.faces), bool), p.copy()
        for choice, allowed in (
            # The middle of two points on a wall may be off a curve.
            ((p + q) / 2, (kind == _FREE) & (other == _FREE)),
            (p, kind >= other),
            (q, kind <= other),
        ):
            accepted = allowed & ~done & self._are_good(choice)
            target[accepted] = choice[accepted]
            done |= accepted
        return target, done

    def _are_good(self, target: np.ndarray) -> np.ndarray:
        """Return for each face whether all cells around it remain convex if its ends go to `target` (e, 2), (e,)."""
        before, corners, row, least = self._around
        every, face, into = np.ones(len(self.faces), bool), self.face_of[corners], self.into[corners]
        kept = into != into[following(before)]
        left = np.bincount(row, kept, len(least)).astype(int)
        after, into = starts_of(left), into[kept]
        # Beside an island a cell would touch itself if it has both ends of the face, but not the face.
        key = np.sort(row[kept] * len(self.mesh.points) + into)
        bad = left < 3
        bad[key[1:][np.diff(key) == 0] // len(self.mesh.points)] = True
        bad |= ~(_least_turns(self._moved(target, every)[into], after) >= np.minimum(least, STRAIGHT))
        return np.bincount(face[face >= 0], bad[row[face >= 0]], len(every)) == 0

    @cached_property
    def _around(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The cells around the faces as ragged rows of points, the row of each point, and the cells' least turns."""
        touched = np.unique(self.cell[self.face_of[self.loop] >= 0])
        starts, corners = take_rows(self.starts, self.loop, touched)
        row = rows_of(starts)
        return starts, corners, row, _least_turns(self.mesh.points[corners], starts)

    def _moved(self, target: np.ndarray, done: np.ndarray) -> np.ndarray:
        """Return the points, (v, 2), where both ends of the faces `done` (e,) go to `target` (e, 2)."""
        moving = (self.face_of >= 0) & done[self.face_of]
        points, face = self.mesh.points.copy(), self.face_of[moving]
        points[moving] = target[face] + self.shift[moving] * np.array(self.mesh.domain.extent)
        return points

    def collapsed(self, target: np.ndarray, done: np.ndarray) -> Faces:
        """Return the mesh in which both ends of the faces `done` (e,) are at `target` (e, 2)."""
        into = np.where((self.face_of >= 0) & done[self.face_of], self.into, np.arange(len(self.into)))
        ends = into[self.mesh.corners].reshape(-1, 2)
        made = replace(self.mesh, points=self._moved(target, done), corners=ends.ravel())
        return made.take_faces(ends[:, 0] != ends[:, 1]).compact()


def _lengths_over_limits(mesh: Faces, broken: np.ndarray) -> np.ndarray:
    """Return the length of each face over that below which it is short, (f,).

    The width of a cell is 4 times its area over its perimeter; `broken` are cells that are no simple polygons.
    """
    a, b = mesh.points[mesh.corners.reshape(-1, 2)].swapaxes(0, 1)
    lengths = np.linalg.norm(b - a, axis=1)
    both = np.concatenate([mesh.owner, mesh.neighbor[: mesh.n_inner]])
    perimeter = np.bincount(both, np.concatenate([lengths, lengths[: mesh.n_inner]]), mesh.n_cells)
    area = np.maximum(polygon_areas(mesh), 0)
    limit = np.minimum(SHORT * np.sqrt(area), THIN * 4 * area / np.maximum(perimeter, 1e-300))
    limit[broken] = 0
    return lengths / np.maximum(smaller_size(mesh.owner, mesh.neighbor, limit), 1e-300)


def _point_kinds(mesh: Faces, parts: np.ndarray, images: np.ndarray) -> np.ndarray:
    """Return whether each point is free, on a wall, or fixed in a corner, (v,) int.

    `images` (v,) int is the class of each point; points of a class are periodic images of one another.
    """
    walls = slice(mesh.n_inner, mesh.n_outer)
    a, b = mesh.corners.reshape(-1, 2)[walls].T
    part = parts[-1 - mesh.neighbor[walls]]
    classes = int(images.max()) + 1
    along = mesh.points[b] - mesh.points[a]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
    ahead, behind = np.full((classes, 3), np.nan), np.full((classes, 3), np.nan)
    ahead[images[a]] = np.column_stack([along, part])
    behind[images[b]] = np.column_stack([along, part])
    met = np.bincount(images[a], minlength=classes) + np.bincount(images[b], minlength=classes)
    turn = np.abs(np.arctan2(cross(behind[:, :2], ahead[:, :2]), (behind[:, :2] * ahead[:, :2]).sum(axis=1)))
    smooth = (met == 2) & (turn < WALL_CORNER) & (ahead[:, 2] == behind[:, 2])
    return np.where(met == 0, _FREE, np.where(smooth, WALL, CORNER))[images]


def _least_turns(corners: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the least angle to the left in the corners of polygons, given as ragged rows; -pi for fewer than 3."""
    turn = turns(corners, following(starts))
    enough = np.diff(starts) >= 3
    least = np.full(len(starts) - 1, -np.pi)
    rows = rows_of(starts)
    full = np.full(len(least), np.inf)
    np.minimum.at(full, rows, turn)
    least[enough] = full[enough]
    return least
