"""Points of a solver mesh in 2D moved a little, where faces are skew or far from orthogonal.

The points around such faces minimize a sum of squares,

    sum_f [max(0, angle_f - a)^2 + max(0, skewness_f - s)^2 + max(0, b - l_f / L_f)^2]
        + sum_i [(A_i / A_i0 - 1)^2 + max(0, d - det_i)^2] + sum_c max(0, t - turn_c)^2 + sum_p |move_p|^2 / width_p^2,

each term with a weight. The sums are over faces f (non-orthogonality and skewness as OpenFOAM defines them, and length
l over the smaller size L of both cells), cells i (area A, and OpenFOAM's determinant), corners c of cells, points p.
Points on walls and at seams do not move.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.sparse

from ..mesh.connectivity import following, take_rows
from ..mesh.straightening import cross
from .geometry import polygon_centroids, sum_rows, turns
from .prisms import simple_loops
from .solver_mesh import SolverMesh

_ANGLE, _SKEWNESS = np.radians(19), 1.9
"""Faces beyond one of these are improved."""
_ANGLE_GOAL, _SKEWNESS_GOAL = np.radians(16), 1.5
_TURN = 0.02
"""Least turn in the corners of cells that is aimed at, unless it is less before."""
_STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell."""
_LENGTH_GOAL, _SHORT = 0.15, 0.05
"""Length of a face over the size of its smaller cell that is aimed at, and below which it does not fall."""
_DETERMINANT_GOAL, _LEAST_DETERMINANT = 0.02, 3e-3
"""Determinant of a cell that is aimed at, and below which it does not fall; OpenFOAM refuses cells below 1e-3."""
_SHORTENED = 0.9
"""Least length of a face below `_SHORT`, over its length before."""
_SKEW_WEIGHT, _LENGTH_WEIGHT, _AREA_WEIGHT, _TURN_WEIGHT, _DETERMINANT_WEIGHT = (
    0.3,
    5.0,
    0.5,
    5.0,
    10.0,
)
_MOVE_WEIGHT = 0.1
_RINGS = 1, 2, 3, 4, 5, 5
"""Rings of cells around bad faces whose points move, in one round after the other."""
_EVALUATIONS, _TOLERANCE = 25, 1e-3
_MOST, _SHARE = 50, 0.02
"""Nothing moves if more faces are bad than this number, and than this share: the generators were not adapted."""


_BLAS = threading.Lock()
"""Held while BLAS has one thread, which is a setting of the process."""


def relax_points(mesh: SolverMesh) -> SolverMesh:
    """Return `mesh` with points away from walls moved so that fewer faces are skew or far from orthogonal.

    A group of points moves only if its worst face becomes better, no convex cell becomes concave, and no face short.
    """
    for rings in _RINGS:
        angle, skewness = face_measures(mesh)
        bad = np.flatnonzero((angle > _ANGLE) | (skewness > _SKEWNESS))
        if not 0 < bad.size <= max(_MOST, _SHARE * len(angle)):
            break
        moved = _Patches(mesh, bad, rings).solve()
        if moved is not None:
            mesh = replace(mesh, points=moved)
    return mesh


def face_measures(mesh: SolverMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return non-orthogonality in radians and skewness of each face in 2D, (f,) each; 0 at seams."""
    _, centroids = polygon_centroids(mesh)
    k = mesh.outer
    ends = mesh.points[mesh.corners.reshape(-1, 2)[:k]]
    there = mesh.neighbor[:k]
    found = np.zeros((2, len(mesh.owner)))
    found[:, :k] = _measures(
        ends[:, 0],
        ends[:, 1],
        centroids[mesh.owner[:k]],
        centroids[np.maximum(there, 0)],
        there < 0,
    )
    return found[0], found[1]


def _measures(
    a: np.ndarray, b: np.ndarray, here: np.ndarray, there: np.ndarray, wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return non-orthogonality in radians and skewness of faces from a to b with centroids on both sides, (f,) each."""
    along = b - a
    length = np.maximum(np.hypot(*along.T), 1e-300)
    along = along / length[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    arm = (a + b) / 2 - here
    height = (arm * normal).sum(axis=1)
    line = np.where(wall[:, None], height[:, None] * normal, there - here)
    through, aside = (line * normal).sum(axis=1), (line * along).sum(axis=1)
    ratio = np.where(np.abs(through) > 1e-300, aside / np.where(through == 0, 1, through), 0.0)
    offset = np.abs((arm * along).sum(axis=1) - height * ratio)
    least = np.where(wall, 0.4, 0.2) * np.hypot(*line.T)
    angle = np.where(wall, 0.0, np.arctan2(np.abs(aside), through))
    return angle, offset / np.maximum(length / 2, np.maximum(least, 1e-300))


class _Figures(NamedTuple):
    """What the sum of squares is computed from.

    Attributes
    ----------
    angle, skewness, length : (f,) float
        Of the faces; lengths over the smaller size of their cells.
    area, determinant : (n,) float
        Of the cells.
    turn : (k,) float
        Angles to the left in the corners of the cells.
    """

    angle: np.ndarray
    skewness: np.ndarray
    length: np.ndarray
    area: np.ndarray
    determinant: np.ndarray
    turn: np.ndarray


class _Patches:
    """Points around bad faces, and the faces and cells that they change."""

    def __init__(self, mesh: SolverMesh, bad: np.ndarray, rings: int) -> None:
        self.mesh = mesh
        n, v = len(mesh), len(mesh.points)
        starts, loops, broken = simple_loops(mesh)
        cell = np.repeat(np.arange(n), np.diff(starts))
        free = np.ones(v, bool)
        free[mesh.corners[mesh.starts[mesh.inner] :]] = False
        free[loops[np.isin(cell, broken)]] = False
        near = np.zeros(n, bool)
        near[mesh.owner[bad]] = True
        inner = bad[mesh.neighbor[bad] >= 0]
        near[mesh.neighbor[inner]] = True
        for _ in range(rings - 1):
            touched = np.zeros(v, bool)
            touched[loops[near[cell]]] = True
            near[cell[touched[loops]]] = True
        chosen = np.zeros(v, bool)
        chosen[loops[near[cell]]] = True
        self.active = np.flatnonzero(chosen & free)
        moving = np.zeros(v, bool)
        moving[self.active] = True
        changed = np.zeros(n, bool)
        changed[cell[moving[loops]]] = True
        self.cells = np.flatnonzero(changed)
        self.place = np.full(n, len(self.cells))
        self.place[self.cells] = np.arange(len(self.cells))
        self.starts, self.loops = take_rows(starts, loops, self.cells)
        self.row = np.repeat(np.arange(len(self.cells)), np.diff(self.starts))
        self.after = following(self.starts)
        areas, self.centroids = polygon_centroids(mesh)
        self.areas = areas[self.cells]
        k = mesh.outer
        there = mesh.neighbor[:k]
        self.faces = np.flatnonzero(
            changed[mesh.owner[:k]] | (changed[np.maximum(there, 0)] & (there >= 0))
        )
        self.owner, self.neighbor = mesh.owner[self.faces], mesh.neighbor[self.faces]
        self.wall = self.neighbor < 0
        self.neighbor = np.where(self.wall, self.owner, self.neighbor)
        self.ends = mesh.corners.reshape(-1, 2)[self.faces]
        self.origin = mesh.points[self.loops[self.starts[:-1]]]
        # Width of the thinnest cell at each point that moves.
        p = mesh.points[self.loops]
        perimeter = np.bincount(self.row, np.hypot(*(p[self.after] - p).T), len(self.cells))
        width = 4 * self.areas / perimeter
        scale = np.full(v, np.inf)
        np.minimum.at(scale, self.loops, width[self.row])
        self.scale = scale[self.active]
        wall_ends = mesh.corners.reshape(-1, 2)[mesh.inner :]
        key = self.loops * v + self.loops[self.after]
        self.between = ~np.isin(key, wall_ends[:, 0] * v + wall_ends[:, 1])
        sizes = np.sqrt(areas)
        self.size = np.minimum(sizes[self.owner], sizes[self.neighbor])
        self.first = self._measure(mesh.points)
        self.length_goal = np.minimum(self.first.length, _LENGTH_GOAL)
        self.determinant_goal = np.minimum(self.first.determinant, _DETERMINANT_GOAL)
        self.turn_goal = np.minimum(self.first.turn, _TURN)

    def _points(self, move: np.ndarray) -> np.ndarray:
        points = self.mesh.points.copy()
        points[self.active] += move.reshape(-1, 2) * self.scale[:, None]
        return points

    def _measure(self, points: np.ndarray) -> _Figures:
        """Return the figures of the faces and cells for these points of the mesh."""
        p = points[self.loops] - self.origin[self.row]
        q = p[self.after]
        twice = cross(p, q)
        count = len(self.cells)
        double = np.bincount(self.row, twice, count)
        middles = sum_rows(self.row, twice[:, None] * (p + q), count)
        centroids = self.centroids.copy()
        centroids[self.cells] = (
            self.origin + middles / (3 * np.where(double > 0, double, np.inf))[:, None]
        )
        a, b = points[self.ends].swapaxes(0, 1)
        angle, skewness = _measures(
            a, b, centroids[self.owner], centroids[self.neighbor], self.wall
        )
        length = np.hypot(*(b - a).T) / self.size
        determinant = self._determinants((q - p)[self.between])
        return _Figures(angle, skewness, length, double / 2, determinant, turns(p, self.after))

    def _determinants(self, along: np.ndarray) -> np.ndarray:
        """Return the determinant of each cell, as `SolverMeasures.determinant`, from its sides (k, 2) between cells."""
        row, count = self.row[self.between], len(self.cells)
        mean = np.bincount(row, np.hypot(*along.T), count) / np.maximum(
            np.bincount(row, minlength=count), 1
        )
        x, y = along.T / np.maximum(mean, 1e-300)[row]
        xx, xy, yy = (np.bincount(row, products, count) for products in (x * x, x * y, y * y))
        return (xx * yy - xy * xy) / 8

    def _residuals(self, move: np.ndarray) -> np.ndarray:
        now = self._measure(self._points(move))
        return np.concatenate(
            [
                np.maximum(now.angle - _ANGLE_GOAL, 0),
                _SKEW_WEIGHT * np.maximum(now.skewness - _SKEWNESS_GOAL, 0),
                _LENGTH_WEIGHT * np.maximum(self.length_goal - now.length, 0),
                _AREA_WEIGHT * (now.area / self.areas - 1),
                _DETERMINANT_WEIGHT * np.maximum(self.determinant_goal - now.determinant, 0),
                _TURN_WEIGHT * np.maximum(self.turn_goal - now.turn, 0),
                _MOVE_WEIGHT * move,
            ]
        )

    def _pattern(self) -> scipy.sparse.csr_array:
        """Return which residuals depend on which components of moves."""
        m, count = len(self.active), len(self.cells)
        index = np.full(len(self.mesh.points), -1)
        index[self.active] = np.arange(m)
        moves = index[self.loops] >= 0

        def incidence(
            rows: np.ndarray, columns: np.ndarray, height: int, width: int
        ) -> scipy.sparse.csr_array:
            return scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), (height, width))

        of_cells = incidence(self.row[moves], index[self.loops[moves]], count, m)
        f = np.arange(len(self.faces))
        sides = [
            (f[k], self.place[c[k]])
            for c in (self.owner, self.neighbor)
            for k in [self.place[c] < count]
        ]
        rows, columns = (np.concatenate(x) for x in zip(*sides, strict=True))
        of_faces = incidence(rows, columns, len(f), count) @ of_cells
        of_turns = incidence(np.arange(len(self.row)), self.row, len(self.row), count) @ of_cells
        of_moves = scipy.sparse.identity(2 * m, format="csr")
        both = [
            scipy.sparse.kron(x, np.ones((1, 2)))
            for x in (*[of_faces] * 3, *[of_cells] * 2, of_turns)
        ]
        return scipy.sparse.vstack([*both, of_moves], format="csr")

    def solve(self) -> np.ndarray | None:
        """Return the points of the mesh, some of them moved; None if none is."""
        from scipy.optimize import least_squares
        from threadpoolctl import threadpool_limits

        if not self.active.size:
            return None
        pattern = self._pattern()
        # The last bits of sums in BLAS depend on its number of threads.
        with _BLAS, threadpool_limits(1, user_api="blas"):
            found = least_squares(
                self._residuals,
                np.zeros(2 * len(self.active)),
                jac_sparsity=pattern,
                max_nfev=_EVALUATIONS,
                ftol=_TOLERANCE,
                xtol=_TOLERANCE,
                tr_options={"maxiter": 40},
            )
        return self._accept(found.x.reshape(-1, 2), pattern)

    def _accept(self, move: np.ndarray, pattern: scipy.sparse.csr_array) -> np.ndarray | None:
        """Return the points moved in those groups that become better."""
        m, f = len(self.active), len(self.faces)
        faces = scipy.sparse.csr_array(pattern[:f, ::2])
        cells = scipy.sparse.csr_array(pattern[3 * f : 3 * f + len(self.cells), ::2])
        corners = scipy.sparse.csr_array(pattern[3 * f + 2 * len(self.cells) : -2 * m, ::2])
        group = scipy.sparse.csgraph.connected_components(faces.T @ faces, directed=False)[1]
        new = self._measure(self._points(move))
        of_face, of_cell, of_corner = (_first_columns(x, group) for x in (faces, cells, corners))
        groups = int(group.max()) + 1

        def worst(figures: _Figures) -> np.ndarray:
            """Return the largest non-orthogonality or skewness over its limit in each group."""
            found = np.zeros(groups)
            np.maximum.at(
                found, of_face, np.maximum(figures.angle / _ANGLE, figures.skewness / _SKEWNESS)
            )
            return found

        bent = new.turn < np.minimum(self.first.turn, _STRAIGHT)
        short = new.length < np.minimum(_SHORTENED * self.first.length, _SHORT)
        low = new.determinant < np.minimum(self.first.determinant, _LEAST_DETERMINANT)
        spoiled = np.concatenate([of_corner[bent], of_face[short], of_cell[low]])
        good = (worst(new) < worst(self.first)) & (np.bincount(spoiled, minlength=groups) == 0)
        return self._points(np.where(good[group][:, None], move, 0)) if good.any() else None


def _first_columns(pattern: scipy.sparse.csr_array, group: np.ndarray) -> np.ndarray:
    """Return the group of the points that each row of `pattern` depends on; all are of one group."""
    return group[pattern.indices[pattern.indptr[:-1]]]
