"""Derivatives of the terms of `CellGroup.terms` with respect to the coordinates of points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    CellGroup,
    Figures,
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


def slopes(cells: CellGroup, now: Figures) -> Slopes:
    """Return the derivatives of ``cells.terms(now)`` other than 0."""
    f, n = len(cells.faces), len(cells.area)
    made = _Slopes(cells, now)
    parts = [made.of_faces(), made.of_areas(3 * f), made.of_determinants(3 * f + n), made.of_turns(3 * f + 2 * n)]
    return Slopes(*(np.concatenate(z) for z in zip(*parts, strict=True)))


class _Slopes:
    """The corners of cells, and the derivatives of areas and centroids.

    Attributes
    ----------
    now : Figures
    ox, oy : (k,) float
        The previous corner of each one, relative to the origin of the cell.
    """

    def __init__(self, cells: CellGroup, now: Figures) -> None:
        self.cells, self.now = cells, now
        self.ox, self.oy = now.px[cells.before], now.py[cells.before]

    def of_areas(self, term: int) -> Slopes:
        """Return the derivatives of the terms for areas; `term` is the number of the first one."""
        c = self.cells
        weight = AREA_WEIGHT / 2 / c.area[c.row]
        return Slopes(term + c.row, c.loop, weight * (self.now.qy - self.oy), weight * (self.ox - self.now.qx))

    def of_faces(self) -> Slopes:
        """Return the derivatives of the terms of faces."""
        c, f, now = self.cells, len(self.cells.faces), self.now
        beyond = np.stack([now.angle > ANGLE_GOAL, now.skewness > SKEWNESS_GOAL, now.length < c.aim])
        rows = np.flatnonzero(beyond.any(axis=0))
        (a, b), owner, neighbor = c.ends[rows].T, c.owner[rows], c.neighbor[rows]
        centers = now.centers + c.origin.T
        at = np.empty((8, len(rows)))
        at[0], at[1], at[2], at[3] = now.x[a], now.y[a], now.x[b], now.y[b]
        at[4:6], at[6:] = centers[:, owner], centers[:, neighbor]
        # Differences by the eight coordinates on which the figures of a face depend.
        step = _STEP * c.smaller[rows]
        aside = at[:, None] + np.eye(8)[:, :, None] * step
        moved = face_figures(tuple(aside[:4]), tuple(aside[4:6]), tuple(aside[6:]), c.wall[rows])
        parts, terms, cells, by = [], [], [], []
        sign = (1.0, SKEW_WEIGHT, -LENGTH_WEIGHT / c.smaller[rows])
        for kind, figure in enumerate((now.angle, now.skewness, now.span)):
            used = beyond[kind, rows].nonzero()[0]
            term = kind * f + rows[used]
            slope = (sign[kind] * (moved[kind] - figure[rows]) / step)[:, used]
            parts.append(Slopes(term, a[used], slope[0], slope[1]))
            parts.append(Slopes(term, b[used], slope[2], slope[3]))
            if kind < 2:
                terms += [term, term]
                cells += [owner[used], neighbor[used]]
                by += [slope[4:6], slope[6:8]]
        by_centroids = np.concatenate(by, axis=1)
        parts.append(self._of_centroids(np.concatenate(terms), np.concatenate(cells), *by_centroids))
        return Slopes(*(np.concatenate(z) for z in zip(*parts, strict=True)))

    def _of_centroids(self, terms: np.ndarray, cells: np.ndarray, by_x: np.ndarray, by_y: np.ndarray) -> Slopes:
        """Return the derivatives of terms whose derivatives by the centroids of `cells` are known, (m,) each."""
        c = self.cells
        now, counts = self.now, c.counts[cells]
        which = np.repeat(np.arange(len(cells)), counts)
        begin = c.starts[cells] - np.cumsum(counts) + counts
        at = begin[which] + np.arange(len(which))
        px, py, qx, qy = now.px[at], now.py[at], now.qx[at], now.qy[at]
        ox, oy = self.ox[at], self.oy[at]
        both = now.twice[at] + now.twice[c.before[at]]
        next_x, next_y, last_x, last_y = px + qx, py + qy, ox + px, oy + py
        area_x, area_y = qy - oy, ox - qx
        cell = cells[which]
        (center_x, center_y), double = now.centers[:, cell], now.double[cell]
        xx = qy * next_x - oy * last_x + both - 3 * center_x * area_x
        xy = ox * last_x - qx * next_x - 3 * center_x * area_y
        yx = qy * next_y - oy * last_y - 3 * center_y * area_x
        yy = ox * last_y - qx * next_y + both - 3 * center_y * area_y
        u, v = by_x[which] / (3 * double), by_y[which] / (3 * double)
        return Slopes(terms[which], c.loop[at], u * xx + v * yx, u * xy + v * yy)

    def of_determinants(self, term: int) -> Slopes:
        """Return the derivatives of the terms for determinants; `term` is the number of the first one."""
        c, first, now = self.cells, self.cells.starts[:-1], self.now
        determinant, ux, uy = now.determinant, now.ux, now.uy
        low = (determinant < DETERMINANT_GOAL) & (determinant > 0)
        if not low.any():
            none = np.zeros(0, np.int64)
            return Slopes(none, none, np.zeros(0), np.zeros(0))
        xx, xy, yy = (np.add.reduceat(z, first) for z in (ux * ux, ux * uy, uy * uy))
        length = np.sqrt(ux * ux + uy * uy)
        mean = np.maximum(np.add.reduceat(length, first) / c.sides, 1e-75)
        at = low[c.row].nonzero()[0]
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
        now = self.now
        at = ((now.turn < TURN_GOAL) & ~c.bound).nonzero()[0]
        px, py = now.px[at], now.py[at]
        u, v = (
            np.stack([-p, q]) / np.maximum(p**2 + q**2, 1e-300)
            for p, q in ((py - self.oy[at], px - self.ox[at]), (now.qy[at] - py, now.qx[at] - px))
        )
        points = np.concatenate([c.loop[c.after[at]], c.loop[c.before[at]], c.loop[at]])
        slope = -TURN_WEIGHT * np.concatenate([v, u, -u - v], axis=1)
        return Slopes(np.tile(term + at, 3), points, *slope)
