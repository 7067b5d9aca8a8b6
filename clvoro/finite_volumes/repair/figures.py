"""Figures of patches, and the terms of the sum of squares that `PricedPatch` minimizes.

The sum is

    sum_f [max(0, angle_f - a)^2 + max(0, skewness_f - s)^2 + max(0, b - l_f / L_f)^2]
        + sum_i [(A_i / A_i0 - 1)^2 + max(0, d - sqrt(det_i))^2] + sum_c max(0, t - turn_c)^2
        + sum_p |move_p|^2 / width_p^2,

each term with a weight. The sums are over faces f (non-orthogonality and skewness as OpenFOAM defines them, and length
l over the smaller size L of both cells), cells i (area A, and OpenFOAM's determinant), corners c of cells, points p.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...mesh.connectivity import following, take_rows

LENGTH_GOAL = 0.15
"""Length of a face over the size of its smaller cell that is aimed at.

Faces that are shorter at first, and not at a bad cell, need not become longer.
"""
ANGLE_GOAL, SKEWNESS_GOAL = np.radians(16), 1.5
TURN_GOAL = 0.02
"""Turns in the corners of cells are to be at least this large, in radians."""
DETERMINANT_GOAL = 0.02
"""Determinant of a cell that is aimed at."""
SKEW_WEIGHT, LENGTH_WEIGHT, AREA_WEIGHT, TURN_WEIGHT, DETERMINANT_WEIGHT = (0.3, 5.0, 0.5, 5.0, 1.5)


class Figures(NamedTuple):
    """Figures of faces, cells and corners.

    Attributes
    ----------
    angle, skewness, length : (f,) float
        Of faces; lengths over the smaller size of their cells.
    area, determinant : (n,) float
        Of cells.
    turn : (k,) float
        Angles to the left in the corners of cells.
    x, y : (v,) float
        Coordinates of the points.
    px, py, qx, qy : (k,) float
        Each corner of a cell and the next one, relative to the origin of the cell.
    twice : (k,) float
        Twice the areas of the triangles between them and the origin.
    double : (n,) float
        Twice the area of each cell; infinite if it is not positive.
    centers : (2, n) float
        Centroids relative to the origins.
    span : (f,) float
        Lengths of the faces.
    ux, uy : (k,) float
        The way from each corner to the next one; 0 on walls.
    """

    angle: np.ndarray
    skewness: np.ndarray
    length: np.ndarray
    area: np.ndarray
    determinant: np.ndarray
    turn: np.ndarray
    x: np.ndarray
    y: np.ndarray
    px: np.ndarray
    py: np.ndarray
    qx: np.ndarray
    qy: np.ndarray
    twice: np.ndarray
    double: np.ndarray
    centers: np.ndarray
    span: np.ndarray
    ux: np.ndarray
    uy: np.ndarray


def face_figures(
    ends: tuple[np.ndarray, ...], here: tuple[np.ndarray, ...], there: tuple[np.ndarray, ...], wall: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return non-orthogonality in radians, skewness and length of faces, (..., f) each.

    Parameters
    ----------
    ends : x and y of the first end, x and y of the second
    here, there : x and y of the centroids on both sides
    wall : (f,) bool
        Faces without a cell behind them.
    """
    ax, ay, bx, by = ends
    ux, uy = bx - ax, by - ay
    length = np.maximum(np.sqrt(ux * ux + uy * uy), 1e-300)
    ux, uy = ux / length, uy / length
    x, y = (ax + bx) / 2 - here[0], (ay + by) / 2 - here[1]
    height = x * uy - y * ux
    s, t = there[0] - here[0], there[1] - here[1]
    through = np.where(wall, height, s * uy - t * ux)
    aside = np.where(wall, 0.0, s * ux + t * uy)
    ratio = np.where(np.abs(through) > 1e-300, aside / np.where(through == 0, 1, through), 0.0)
    offset = np.abs(x * ux + y * uy - height * ratio)
    least = np.where(wall, 0.4, 0.2) * np.sqrt(through * through + aside * aside)
    angle = np.where(wall, 0.0, np.arctan2(np.abs(aside), through))
    return angle, offset / np.maximum(length / 2, np.maximum(least, 1e-300)), length


@dataclass(eq=False)
class CellGroup:
    """Some cells of a patch, and the faces whose figures depend on these cells only.

    Attributes
    ----------
    starts, loop, row : int
        Points around each cell as ragged rows, and the cell of each.
    between : (k,) bool
        Whether another cell is behind the side that begins there.
    bound : (k,) bool
        Corners of walls within a cell.
    faces : (f,) int
        Faces of the patch.
    ends : (f, 2) int
    owner, neighbor : (f,) int
        Among these cells; the neighbor is the owner on a `wall`.
    wall : (f,) bool
    aim : (f,) float
    area, size : (n,) float
        Of the cells at first.
    origin : (n, 2) float
        A point near each cell.
    """

    starts: np.ndarray
    loop: np.ndarray
    row: np.ndarray
    between: np.ndarray
    bound: np.ndarray
    faces: np.ndarray
    ends: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    wall: np.ndarray
    aim: np.ndarray
    area: np.ndarray
    size: np.ndarray
    origin: np.ndarray

    def __post_init__(self) -> None:
        self.after, self.counts = following(self.starts), np.diff(self.starts)
        self.before = np.empty_like(self.after)
        self.before[self.after] = np.arange(len(self.after))
        self.origin_of_corner = self.origin[self.row].T
        self.smaller = np.minimum(self.size[self.owner], self.size[self.neighbor])
        sides = np.add.reduceat(self.between.astype(np.int64), self.starts[:-1])
        self.sides = np.maximum(sides, 1)

    def part(self, cells: np.ndarray, faces: np.ndarray) -> CellGroup:
        """Return the part with these cells, (m,) int in ascending order, and these faces, (e,) int."""
        starts, at = take_rows(self.starts, np.arange(len(self.loop)), cells)
        place = np.full(len(self.area), -1)
        place[cells] = np.arange(len(cells))
        return CellGroup(
            starts,
            self.loop[at],
            place[self.row[at]],
            self.between[at],
            self.bound[at],
            self.faces[faces],
            self.ends[faces],
            place[self.owner[faces]],
            place[self.neighbor[faces]],
            self.wall[faces],
            self.aim[faces],
            self.area[cells],
            self.size[cells],
            self.origin[cells],
        )

    @classmethod
    def joined(cls, parts: list[CellGroup], begins: list[int]) -> CellGroup:
        """Return the cells of all `parts`; points of a part are counted from its number in `begins` on."""
        cells = np.cumsum([0] + [len(p.area) for p in parts]).tolist()
        corners = np.cumsum([0] + [len(p.loop) for p in parts]).tolist()

        def all_of(name: str, add: list[int] | None = None) -> np.ndarray:
            arrays = [getattr(p, name) for p in parts]
            if add is not None:
                arrays = [x + i for x, i in zip(arrays, add, strict=False)]
            return np.concatenate(arrays)

        starts = [p.starts[:-1] + i for p, i in zip(parts, corners, strict=False)]
        return cls(
            np.concatenate([*starts, corners[-1:]]),
            all_of("loop", begins),
            all_of("row", cells),
            all_of("between"),
            all_of("bound"),
            all_of("faces"),
            all_of("ends", begins),
            all_of("owner", cells),
            all_of("neighbor", cells),
            all_of("wall"),
            all_of("aim"),
            all_of("area"),
            all_of("size"),
            all_of("origin"),
        )

    def figures(self, x: np.ndarray, y: np.ndarray) -> Figures:
        """Return the figures for points with these coordinates, (v,) each."""
        first, after = self.starts[:-1], self.after
        ox, oy = self.origin_of_corner
        px, py = x[self.loop] - ox, y[self.loop] - oy
        qx, qy = px[after], py[after]
        twice = px * qy - py * qx
        double = np.add.reduceat(twice, first)
        positive = np.where(double > 0, double, np.inf)
        centers = np.empty((2, len(double)))
        np.add.reduceat(twice * (px + qx), first, out=centers[0])
        np.add.reduceat(twice * (py + qy), first, out=centers[1])
        centers /= 3 * positive
        cx, cy = centers + self.origin.T
        a, b = self.ends.T
        angle, skewness, length = face_figures(
            (x[a], y[a], x[b], y[b]),
            (cx[self.owner], cy[self.owner]),
            (cx[self.neighbor], cy[self.neighbor]),
            self.wall,
        )
        ux, uy = qx - px, qy - py
        vx, vy = ux[after], uy[after]
        turn = np.empty(len(ux))
        turn[after] = np.arctan2(ux * vy - uy * vx, ux * vx + uy * vy)
        ux, uy = ux * self.between, uy * self.between
        xx, xy, yy = (np.add.reduceat(z, first) for z in (ux * ux, ux * uy, uy * uy))
        mean = np.add.reduceat(np.sqrt(ux * ux + uy * uy), first) / self.sides
        determinant = (xx * yy - xy * xy) / (8 * np.maximum(mean, 1e-75) ** 4)
        return Figures(
            angle,
            skewness,
            length / self.smaller,
            double / 2,
            determinant,
            turn,
            x,
            y,
            px,
            py,
            qx,
            qy,
            twice,
            positive,
            centers,
            length,
            ux,
            uy,
        )

    def terms(self, now: Figures) -> np.ndarray:
        """Return the terms of the sum of squares but those of the moves, (3 f + 2 n + k,)."""
        terms = (
            np.maximum(now.angle - ANGLE_GOAL, 0),
            SKEW_WEIGHT * np.maximum(now.skewness - SKEWNESS_GOAL, 0),
            LENGTH_WEIGHT * np.maximum(self.aim - now.length, 0),
            AREA_WEIGHT * (now.area / self.area - 1),
            # The root has a slope where the faces of a cell are parallel.
            DETERMINANT_WEIGHT * np.maximum(DETERMINANT_GOAL**0.5 - np.sqrt(np.maximum(now.determinant, 0)), 0),
            TURN_WEIGHT * np.where(self.bound, 0, np.maximum(TURN_GOAL - now.turn, 0)),
        )
        return np.concatenate(terms)
