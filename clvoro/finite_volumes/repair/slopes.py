"""Derivatives of the terms of `Cells.terms` with respect to the coordinates of points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...mesh.connectivity import take_rows
from .figures import (
    ANGLE_GOAL,
    AREA_WEIGHT,
    DETERMINANT_GOAL,
    DETERMINANT_WEIGHT,
    LENGTH_WEIGHT,
    SKEW_WEIGHT,
    SKEWNESS_GOAL,
    TURN_GOAL,
    TURN_WEIGHT,
    Cells,
    face_figures,
)

_STEP = 1e-6
"""Step of differences over the size of a cell. Only figures of single faces are differentiated like that, by their ends
and centroids."""


class Slopes(NamedTuple):
    """Derivatives of terms by the coordinates of points; the same term and point may occur several times.

    Attributes
    ----------
    terms, points : (s,) int
    x, y : (s,) float
    """

    terms: np.ndarray
    points: np.ndarray
    x: np.ndarray
    y: np.ndarray


def slopes(cells: Cells, x: np.ndarray, y: np.ndarray) -> Slopes:
    """Return the derivatives of ``cells.terms(x, y)`` other than 0."""
    c, f, n = cells, len(cells.faces), len(cells.area)
    px, py = (z[c.loop] - o for z, o in zip((x, y), c.origin_of_corner, strict=True))
    made = _Slopes(c, px, py)
    parts = [
        made.of_faces(x, y),
        made.of_areas(3 * f),
        made.of_determinants(3 * f + n),
        made.of_turns(3 * f + 2 * n),
    ]
    return Slopes(*(np.concatenate(z) for z in zip(*parts, strict=True)))


class _Slopes:
    """The corners of cells, and the derivatives of areas and centroids.

    Attributes
    ----------
    px, py, qx, qy, ox, oy : (k,) float
        Each corner, the next and the previous one, relative to the origin of the cell.
    double : (n,) float
        Twice the area of each cell; infinite if it is not positive.
    centers : (2, n) float
        Centroids relative to the origins.
    """

    def __init__(self, cells: Cells, px: np.ndarray, py: np.ndarray) -> None:
        self.cells, self.px, self.py = cells, px, py
        self.qx, self.qy = px[cells.after], py[cells.after]
        self.ox, self.oy = px[cells.before], py[cells.before]
        self.twice = px * self.qy - py * self.qx
        first = cells.starts[:-1]
        double = np.add.reduceat(self.twice, first)
        self.double = np.where(double > 0, double, np.inf)
        sums = [np.add.reduceat(self.twice * z, first) for z in (px + self.qx, py + self.qy)]
        self.centers = np.stack(sums) / (3 * self.double)

    def of_areas(self, term: int) -> Slopes:
        """Return the derivatives of the terms for areas; `term` is the number of the first one."""
        c = self.cells
        weight = AREA_WEIGHT / 2 / c.area[c.row]
        return Slopes(
            term + c.row, c.loop, weight * (self.qy - self.oy), weight * (self.ox - self.qx)
        )

    def of_faces(self, x: np.ndarray, y: np.ndarray) -> Slopes:
        """Return the derivatives of the terms of faces."""
        c, f = self.cells, len(self.cells.faces)
        centers = self.centers + c.origin.T
        a, b = c.ends.T
        at = np.stack([
            x[a], y[a], x[b], y[b], *centers[:, c.owner], *centers[:, c.neighbor],
        ])  # fmt: skip
        now = face_figures(tuple(at[:4]), tuple(at[4:6]), tuple(at[6:]), c.wall)
        beyond = np.stack([now[0] > ANGLE_GOAL, now[1] > SKEWNESS_GOAL, now[2] / c.smaller < c.aim])
        rows = np.flatnonzero(beyond.any(axis=0))
        # Differences by the eight coordinates on which the figures of a face depend.
        step = _STEP * c.smaller[rows]
        aside = at[:, None, rows] + np.eye(8)[:, :, None] * step
        moved = face_figures(tuple(aside[:4]), tuple(aside[4:6]), tuple(aside[6:]), c.wall[rows])
        parts, terms, cells, by = [], [], [], []
        sign = (1.0, SKEW_WEIGHT, -LENGTH_WEIGHT / c.smaller[rows])
        for kind in range(3):
            slope = sign[kind] * (moved[kind] - now[kind][rows]) / step
            used = np.flatnonzero(beyond[kind, rows])
            slope, faces = slope[:, used], rows[used]
            for end in range(2):
                parts.append(
                    Slopes(kind * f + faces, c.ends[faces, end], *slope[2 * end : 2 * end + 2])
                )
            if kind < 2:
                terms += [kind * f + faces] * 2
                cells += [c.owner[faces], c.neighbor[faces]]
                by += [slope[4:6], slope[6:8]]
        by_centroids = np.concatenate(by, axis=1)
        parts.append(
            self._of_centroids(np.concatenate(terms), np.concatenate(cells), *by_centroids)
        )
        return Slopes(*(np.concatenate(z) for z in zip(*parts, strict=True)))

    def _of_centroids(
        self, terms: np.ndarray, cells: np.ndarray, by_x: np.ndarray, by_y: np.ndarray
    ) -> Slopes:
        """Return the derivatives of terms whose derivatives by the centroids of `cells` are known, (m,) each."""
        c = self.cells
        starts, at = take_rows(c.starts, np.arange(len(c.loop)), cells)
        which = np.repeat(np.arange(len(cells)), np.diff(starts))
        px, py, qx, qy, ox, oy = (
            z[at] for z in (self.px, self.py, self.qx, self.qy, self.ox, self.oy)
        )
        both = self.twice[at] + self.twice[c.before[at]]
        next_x, next_y, last_x, last_y = px + qx, py + qy, ox + px, oy + py
        area_x, area_y = qy - oy, ox - qx
        (center_x, center_y), double = self.centers[:, c.row[at]], self.double[c.row[at]]
        xx = qy * next_x - oy * last_x + both - 3 * center_x * area_x
        xy = ox * last_x - qx * next_x - 3 * center_x * area_y
        yx = qy * next_y - oy * last_y - 3 * center_y * area_x
        yy = ox * last_y - qx * next_y + both - 3 * center_y * area_y
        u, v = by_x[which] / (3 * double), by_y[which] / (3 * double)
        return Slopes(terms[which], c.loop[at], u * xx + v * yx, u * xy + v * yy)

    def of_determinants(self, term: int) -> Slopes:
        """Return the derivatives of the terms for determinants; `term` is the number of the first one."""
        c, first = self.cells, self.cells.starts[:-1]
        ux, uy = (self.qx - self.px) * c.between, (self.qy - self.py) * c.between
        xx, xy, yy = (np.add.reduceat(z, first) for z in (ux * ux, ux * uy, uy * uy))
        length = np.sqrt(ux * ux + uy * uy)
        mean = np.maximum(np.add.reduceat(length, first) / c.sides, 1e-75)
        determinant = (xx * yy - xy * xy) / (8 * mean**4)
        low = (determinant < DETERMINANT_GOAL) & (determinant > 0)
        at = np.flatnonzero(low[c.row])
        row, ux, uy = c.row[at], ux[at], uy[at]
        mean, determinant = mean[row], determinant[row]
        scale = 4 * determinant / (mean * c.sides[row] * np.maximum(length[at], 1e-300))
        of_side = np.stack([ux * yy[row] - uy * xy[row], uy * xx[row] - ux * xy[row]])
        of_side = of_side / (4 * mean**4) - scale * np.stack([ux, uy])
        of_side *= -DETERMINANT_WEIGHT / (2 * np.sqrt(determinant))
        terms = np.tile(term + row, 2)
        points = np.concatenate([c.loop[c.after[at]], c.loop[at]])
        return Slopes(terms, points, *np.concatenate([of_side, -of_side], axis=1))

    def of_turns(self, term: int) -> Slopes:
        """Return the derivatives of the terms for turns in corners; `term` is the number of the first one."""
        c = self.cells
        ux, uy, vx, vy = self.px - self.ox, self.py - self.oy, self.qx - self.px, self.qy - self.py
        turn = np.arctan2(ux * vy - uy * vx, ux * vx + uy * vy)
        at = np.flatnonzero((turn < TURN_GOAL) & ~c.bound)
        u, v = (
            np.stack([-p[at], q[at]]) / np.maximum(p[at] ** 2 + q[at] ** 2, 1e-300)
            for p, q in ((uy, ux), (vy, vx))
        )
        points = np.concatenate([c.loop[c.after[at]], c.loop[c.before[at]], c.loop[at]])
        slope = -TURN_WEIGHT * np.concatenate([v, u, -u - v], axis=1)
        return Slopes(np.tile(term + at, 3), points, *slope)
