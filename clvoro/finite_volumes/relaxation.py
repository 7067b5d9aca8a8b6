"""Relaxation of bad faces in 2D: points around them move until skewness and non-orthogonality are small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mesh.connectivity import following, inverse, take_rows
from ..mesh.faces import Faces
from ..mesh.geometry import turns
from .independent import independent
from .measures import PlaneMeasures
from .prisms import simple_loops
from .short_edges import CORNER, STRAIGHT, WALL, point_kinds

SKEWNESS, ANGLE = 1.95, 24.0
"""Faces are bad beyond these: skewness, and non-orthogonality in degrees."""
LEAST_LENGTH, LEAST_DETERMINANT = 0.05, 4e-3
"""Where points move, faces do not become shorter than this over the smaller size of their cells, and cells not worse
than this determinant: OpenFOAM's limit is 1e-3."""
RINGS = 3
"""Rings of cells around bad faces that are looked at: points move in the first, and change faces in the second."""
FIRST_STEP, LAST_STEP = 0.12, 0.02
"""How far points are tried to move, over the size of the smallest cell around: half as far after each failure."""
DIRECTIONS = 8
ROUNDS, ROUNDS_OF_ZONE = 10, 5
POWER = 16
"""The badness of faces around a point is the mean of this power, which is nearly the largest and minds the others."""
GAIN = 1e-3
"""Least share by which the badness must decrease."""


def relax_bad_faces(mesh: Faces, parts: np.ndarray) -> Faces:
    """Return a mesh in 2D whose bad faces are less bad, with the same faces, cells convex as before, walls as before.

    Points inside move freely, those on walls along the boundary, and corners stay.

    Parameters
    ----------
    mesh : Faces
        A mesh for solvers, without seams.
    parts : (k,) int
        Index of the named part of the boundary for each wall.
    """
    step: np.ndarray | None = None
    kind = None
    for _ in range(ROUNDS):
        bad = _badness(PlaneMeasures(mesh)) > 1
        if not bad.any():
            break
        if kind is None or step is None:
            kind, step = point_kinds(mesh, parts), np.full(len(mesh.points), FIRST_STEP)
        near = np.zeros(mesh.n_cells, bool)
        k = mesh.n_inner
        near[mesh.owner[bad]] = near[mesh.neighbor[:k][bad[:k]]] = True
        zone, left = _Zone(mesh, near, kind, step), True
        for _ in range(ROUNDS_OF_ZONE):
            left = left and zone.improve()
        points = mesh.points.copy()
        points[zone.points], step[zone.points] = zone.part.points, zone.step
        mesh = replace(mesh, points=points)
        if not left:
            break
    return mesh


def _badness(measures: PlaneMeasures) -> np.ndarray:
    return np.maximum(measures.skewness / SKEWNESS, measures.non_orthogonality / ANGLE)


class _Zone:
    """The cells around bad faces.

    Attributes
    ----------
    part : Faces
    points : (v,) int
        Their numbers in the whole mesh.
    kind : (v,) int
        Free, on a wall, or fixed.
    sizes : (v,) float64
        Size of the smallest cell around each point.
    step : (v,) float64
        How far to try next, over that size.
    """

    def __init__(self, mesh: Faces, near: np.ndarray, kind: np.ndarray, step: np.ndarray) -> None:
        a, b = mesh.owner[: mesh.n_inner], mesh.neighbor[: mesh.n_inner]
        rings = [near]
        for _ in range(RINGS):
            grown = rings[-1].copy()
            grown[a[rings[-1][b]]] = grown[b[rings[-1][a]]] = True
            rings.append(grown)
        cells = np.flatnonzero(rings[-1])
        self.part, self.points = mesh.part(rings[-1])
        self.kind, self.step = kind[self.points], step[self.points]
        self.starts, self.loop, broken = simple_loops(self.part)
        self.cell = np.repeat(np.arange(len(cells)), np.diff(self.starts))
        inner = np.ones(len(self.points), bool)
        inner[self.loop[~rings[1][cells][self.cell]]] = False  # all cells around are in the first ring
        self.kind[~inner] = CORNER
        self.kind[self.loop[np.isin(self.cell, broken)]] = CORNER
        # Cells around points; faces of these cells; cells on both sides of these faces.
        starts, sides = self.part.cell_faces()
        self.around = inverse(self.starts, self.loop, len(self.points))
        self.faces = starts, self.part.sides()[1][sides]
        self.sides = np.stack([self.part.owner, np.maximum(self.part.neighbor, -1)], axis=1)
        area = np.abs(PlaneMeasures(self.part).areas)
        self.sizes = np.full(len(self.points), np.inf)
        np.minimum.at(self.sizes, self.loop, np.sqrt(area)[self.cell])
        walls = slice(self.part.n_inner, None)
        begin, end = self.part.corners.reshape(-1, 2)[walls].T
        self.after, self.before = np.arange(len(self.points)), np.arange(len(self.points))
        self.after[begin], self.before[end] = end, begin

    def improve(self) -> bool:
        """Move points that share no faces to better places; return whether there were points to try."""
        bad = _badness(PlaneMeasures(self.part))
        worst = np.zeros(len(self.sizes))
        wrong = np.flatnonzero(bad > 1)
        of_face = self.sides[wrong]
        for cells in of_face.T:
            there = cells >= 0
            starts, corners = take_rows(self.starts, self.loop, cells[there])
            np.maximum.at(worst, corners, np.repeat(bad[wrong[there]], np.diff(starts)))
        tried = np.flatnonzero((worst > 1) & (self.kind != CORNER) & (self.step >= LAST_STEP))
        if not tried.size:
            return False
        tried = tried[np.argsort(-worst[tried], kind="stable")]
        row, face = self._faces_around(tried)
        touched = self.sides[face]
        rows = np.concatenate([row, row])[np.concatenate(touched.T) >= 0]
        touched = np.concatenate(touched.T)
        chosen = independent(rows, touched[touched >= 0], np.arange(len(tried)), self.part.n_cells)
        tried = tried[chosen]
        row, face = self._faces_around(tried)
        least, place = self._judge(tried, row, face, self.part.points), self.part.points[tried]
        first, limit = least.copy(), least * (1 - GAIN)
        points = self.part.points
        for choice in self._choices(tried):
            moved = points.copy()
            moved[tried] = choice
            found = self._judge(tried, row, face, moved)
            better = found < np.minimum(least, limit)
            least[better], place[better] = found[better], choice[better]
        moved = least < first
        new = points.copy()
        new[tried] = place
        self.part = replace(self.part, points=new)
        cells = self.sides[face[moved[row]]].ravel()
        corners = take_rows(self.starts, self.loop, np.unique(cells[cells >= 0]))[1]
        self.step[corners] = np.maximum(self.step[corners], LAST_STEP)
        self.step[tried[~moved]] /= 2
        return True

    def _faces_around(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the faces of all cells around `points`, as rows and faces."""
        starts, cells = take_rows(*self.around, points)
        row = np.repeat(np.arange(len(points)), np.diff(starts))
        starts, faces = take_rows(*self.faces, cells)
        return np.repeat(row, np.diff(starts)), faces

    def _choices(self, points: np.ndarray) -> list[np.ndarray]:
        """Return places to which `points` may move, each (k, 2)."""
        x, step, wall = self.part.points[points], self.step[points] * self.sizes[points], self.kind[points] == WALL
        found = []
        for k in range(DIRECTIONS):
            angle = 2 * np.pi * k / DIRECTIONS
            choice = x + step[:, None] * np.array([np.cos(angle), np.sin(angle)])
            way = self.part.points[(self.after if k % 2 else self.before)[points[wall]]] - x[wall]
            length = np.maximum(np.hypot(*way.T), 1e-300)
            far = np.minimum(step[wall] * (1 + k // 2) / 2, 0.4 * length) / length
            choice[wall] = x[wall] + far[:, None] * way
            found.append(choice)
        return found

    def _judge(self, points: np.ndarray, row: np.ndarray, face: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the badness around each of `points` if all points are at `x`; infinite if a cell is not convex.

        `row` and `face` are the faces around the points.
        """
        part = replace(self.part, points=x)
        measures = PlaneMeasures(part)
        size = np.sqrt(np.maximum(measures.areas, 0))
        bad = np.maximum(_badness(measures), LEAST_LENGTH * size[self.sides].min(axis=1) / measures.lengths)
        sums = np.bincount(row, np.minimum(bad, 1e3)[face] ** POWER, len(points)) ** (1 / POWER)
        poor = LEAST_DETERMINANT / np.maximum(measures.determinant, 1e-6)
        poor[self.cell[turns(x[self.loop], following(self.starts)) < STRAIGHT]] = np.inf
        starts, cells = take_rows(*self.around, points)
        worst = np.maximum.reduceat(poor[cells], starts[:-1])
        return np.where(worst > 1, worst + sums, sums)
