"""Relaxation of bad faces in 2D: points around them move until skewness and non-orthogonality are small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..mesh.connectivity import following, independent, inverse, take_rows
from ..mesh.faces import Faces
from ..mesh.geometry import smaller_size, turns
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
CONCAVE = 1e4
"""The badness of a cell that is just not convex; others have at most a tenth of it."""
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
        measures = PlaneMeasures(mesh)
        bad, near = _badness(measures) > 1, measures.determinant < LEAST_DETERMINANT
        near[_concave_cells(mesh)] = True
        if not (bad.any() or near.any()):
            break
        if kind is None or step is None:
            kind, step = point_kinds(mesh, parts), np.full(len(mesh.points), FIRST_STEP)
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
    copies : Faces
        One for the places where points are, and one for each direction in which they may move.
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
        self.border = ~rings[1][cells]
        inner = np.ones(len(self.points), bool)
        inner[self.loop[self.border[self.cell]]] = False  # all cells around are in the first ring
        self.kind[~inner] = CORNER
        self.kind[self.loop[np.isin(self.cell, broken)]] = CORNER
        # Cells around points; faces of these cells; cells on both sides of these faces.
        starts, sides = self.part.cell_faces()
        self.around = inverse(self.starts, self.loop, len(self.points))
        self.faces = starts, self.part.sides()[1][sides]
        self.copies, self.face_of_copy = _copies(self.part, 1 + DIRECTIONS)
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
        measures = PlaneMeasures(self.part)
        bad, of_cell = _badness(measures), self._poorness(measures, self.part.points[None])[0]
        of_cell[self.border] = 0
        for cells in self.sides.T:
            np.maximum.at(of_cell, cells[cells >= 0], bad[cells >= 0])
        worst = np.zeros(len(self.sizes))
        np.maximum.at(worst, self.loop, of_cell[self.cell])
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
        places = np.repeat(self.part.points[None], 1 + DIRECTIONS, axis=0)
        places[1:, tried] = self._choices(tried)
        found = self._judge(tried, row, face, places)
        moved = found[1:].min(axis=0) < (1 - GAIN) * found[0]
        best = np.where(moved, 1 + found[1:].argmin(axis=0), 0)
        new = places[0]
        new[tried] = places[best, tried]
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

    def _choices(self, points: np.ndarray) -> np.ndarray:
        """Return places to which `points` (k,) may move, (c, k, 2)."""
        x, step, wall = self.part.points[points], self.step[points] * self.sizes[points], self.kind[points] == WALL
        angle = 2 * np.pi / DIRECTIONS * np.arange(DIRECTIONS)
        found = x + step[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
        for k in range(DIRECTIONS):
            way = self.part.points[(self.after if k % 2 else self.before)[points[wall]]] - x[wall]
            length = np.maximum(np.hypot(*way.T), 1e-300)
            far = np.minimum(step[wall] * (1 + k // 2) / 2, 0.4 * length) / length
            found[k, wall] = x[wall] + far[:, None] * way
        return found

    def _judge(self, points: np.ndarray, row: np.ndarray, face: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Return the badness around `points` (k,) for each choice of the `places` (c, v, 2) of all points, (c, k).

        It is large if a cell is not convex or has a small determinant. `row` and `face` are the faces around them.
        """
        part = replace(self.copies, points=places.reshape(-1, 2))
        measures = PlaneMeasures(part)
        size = smaller_size(part.owner, part.neighbor, np.sqrt(np.maximum(measures.areas, 0)))
        bad = np.maximum(_badness(measures), LEAST_LENGTH * size / measures.lengths)[self.face_of_copy]
        sums = np.add.reduceat(np.minimum(bad, 1e2)[:, face] ** POWER, np.flatnonzero(np.diff(row, prepend=-1)), axis=1)
        poor = self._poorness(measures, places)
        starts, cells = take_rows(*self.around, points)
        worst = np.maximum.reduceat(poor[:, cells], starts[:-1], axis=1)
        return sums ** (1 / POWER) + np.where(worst > 1, worst, 0)

    def _poorness(self, measures: PlaneMeasures, places: np.ndarray) -> np.ndarray:
        """Return for each cell of each choice of `places` (c, v, 2) a number above 1 if OpenFOAM refuses it, (c, n)."""
        count = len(places)
        poor = (LEAST_DETERMINANT / np.maximum(measures.determinant, 4e-6)).reshape(count, -1)
        after = (following(self.starts) + len(self.loop) * np.arange(count)[:, None]).ravel()
        turn = turns(places[:, self.loop].reshape(-1, 2), after).reshape(count, -1)
        copy, corner = np.nonzero(turn < STRAIGHT)
        np.maximum.at(poor, (copy, self.cell[corner]), CONCAVE * (1 + STRAIGHT - turn[copy, corner]))
        return poor


def _concave_cells(mesh: Faces) -> np.ndarray:
    starts, loop, _ = simple_loops(mesh)
    concave = turns(mesh.points[loop], following(starts)) < STRAIGHT
    return np.repeat(np.arange(mesh.n_cells), np.diff(starts))[concave]


def _copies(part: Faces, count: int) -> tuple[Faces, np.ndarray]:
    """Return `count` copies of a mesh in 2D side by side as one mesh, and the place of each face there, (count, f)."""
    f, v, n, inner = len(part), len(part.points), part.n_cells, part.n_inner
    copy, row = np.arange(count)[:, None], np.arange(f)
    order = np.argsort((row >= inner) + 0 * copy, axis=None, kind="stable")
    place = np.empty(count * f, np.int64)
    place[order] = np.arange(count * f)
    corners = (part.corners + v * copy).reshape(-1, 2)[order]
    neighbor = np.where(part.neighbor >= 0, part.neighbor + n * copy, part.neighbor)
    made = replace(
        part,
        generators=np.tile(part.generators, (count, 1)),
        points=np.tile(part.points, (count, 1)),
        starts=2 * np.arange(count * f + 1),
        corners=corners.ravel(),
        owner=(part.owner + n * copy).ravel()[order],
        neighbor=neighbor.ravel()[order],
        twin=np.full(count * f, -1),
        shift=np.zeros((count * f, 2), np.int8),
        half_face=np.full(count * f, -1),
    )
    return made, place.reshape(count, f)
