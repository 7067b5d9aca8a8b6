"""Points of a patch moved so that its faces are less skew and nearer to orthogonal: a least-squares problem.

Points on walls slide along the boundary or stay. The sum of squares is that of `patch_figures`; its derivatives are
differences. Whether a patch becomes better is decided by its price, the sum of what is beyond the limits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from ..geometry.ring_coordinate import RingCoordinate
from ..mesh.connectivity import following
from .patch import BORDER, Patch, cell_sides
from .patch_figures import LENGTH_GOAL, Cells

ANGLE, SKEWNESS = np.radians(19), 1.9
"""Faces beyond one of these are improved."""
STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell."""
_SHORT = 0.05
"""A shorter face raises the price of the patch. Lengths are relative to the smaller of its two cells."""
LEAST_DETERMINANT = 3e-3
"""A cell with a smaller determinant raises the price of the patch. OpenFOAM refuses cells below 1e-3."""
_MOST_EXCESS = 4
"""Faces that exceed a limit by more than this times it have the same price."""
_INVERTED_PRICE, _CONCAVE_PRICE = 100.0, 3.0
"""Prices of a cell without a positive area, and of a concave corner for each radian."""
_MOVE_WEIGHT = 0.1
_STEP = 1e-6
"""Step of differences, over the width of a cell."""
_TOLERANCE = 1e-3
"""Relative change of the sum of squares at which the moves end."""


class Descent:
    """A patch, its prices, and the moves of its points that lower them.

    Attributes
    ----------
    patch : Patch
    cells : Cells
        All of them, and all faces but those at borders.
    goals : (n, 2) float
        Area and size of each cell at first.
    prices : (n,) float
        What is beyond the limits in each cell and at its faces.
    bad : (n,) bool
        Whether a cell or one of its faces is beyond a limit; short faces are not counted.
    face_prices, lengths : (f,) float
        Of ``cells.faces``.
    sides : (k,) int
        The face of the patch that begins in each corner of a cell.
    bent : (k,) bool
        Corners in which a cell is concave.
    """

    def __init__(self, patch: Patch, sides: tuple[np.ndarray, ...], goals: np.ndarray | None):
        """`sides` are those of `cell_sides`."""
        self.patch = patch
        starts, loop, self.sides = sides
        row = np.repeat(np.arange(len(patch.cells)), np.diff(starts))
        faces = np.flatnonzero(patch.neighbor != BORDER)
        wall = patch.neighbor[faces] < 0
        after = following(starts)
        on_wall = patch.walls[self.sides]
        before = np.empty_like(after)
        before[after] = np.arange(len(after))
        origin = patch.points[loop[starts[:-1]]]
        if goals is None:
            p = patch.points[loop] - origin[row]
            q = p[after]
            area = np.add.reduceat(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0], starts[:-1]) / 2
            area = np.maximum(area, 1e-6 * area.max())
            goals = np.column_stack([area, np.sqrt(area)])
        self.goals = goals
        owner = patch.owner[faces]
        self.cells = Cells(
            starts, loop, row, ~on_wall, on_wall & on_wall[before], faces, patch.ends[faces], owner,
            np.where(wall, owner, patch.neighbor[faces]), wall, patch.aim[faces], goals[:, 0], goals[:, 1], origin,
        )  # fmt: skip
        self._set_prices()
        fresh = np.isnan(self.cells.aim)
        if fresh.any():
            known = np.where(self.bad[owner] | self.bad[self.cells.neighbor], np.inf, self.lengths)
            self.cells.aim = np.where(fresh, np.minimum(known, LENGTH_GOAL), self.cells.aim)
            patch.aim = patch.aim.copy()
            patch.aim[faces] = self.cells.aim

    @classmethod
    def of(cls, patch: Patch, goals: np.ndarray | None = None) -> Descent | None:
        """Return the descent of a patch, None if a cell is no simple ring."""
        sides = cell_sides(patch)
        return None if sides is None else cls(patch, sides, goals)

    @property
    def price(self) -> float:
        """Sum of the prices of all cells."""
        return float(self.prices.sum())

    def _set_prices(self) -> None:
        c = self.cells
        now = c.figures(*self.patch.points.T[:, None])
        excess = np.minimum(np.maximum(now.angle[0] / ANGLE - 1, 0), _MOST_EXCESS) ** 2
        excess += np.minimum(np.maximum(now.skewness[0] / SKEWNESS - 1, 0), _MOST_EXCESS) ** 2
        beyond = excess > 0
        excess += np.maximum(1 - now.length[0] / _SHORT, 0) ** 2
        n, turn = len(c.area), now.turn[0]
        self.bent = turn < STRAIGHT
        prices = np.bincount(c.row, self.bent * (1 + _CONCAVE_PRICE * np.maximum(-turn, 0)), n)
        prices += now.determinant[0] < LEAST_DETERMINANT
        prices += _INVERTED_PRICE * (now.area[0] <= 0)
        self.bad = prices > 0
        self.bad[c.owner[beyond]] = self.bad[c.neighbor[beyond]] = True
        prices += (np.bincount(c.owner, excess, n) + np.bincount(c.neighbor, excess, n)) / 2
        self.prices, self.face_prices, self.lengths = prices, excess, now.length[0]

    def near(self, chosen: np.ndarray, rings: int) -> np.ndarray:
        """Return the cells `chosen` (n,) bool and some rings of cells around them, (n,) bool."""
        c, near = self.cells, chosen.copy()
        for _ in range(rings):
            touched = np.zeros(len(self.patch.points), bool)
            touched[c.loop[near[c.row]]] = True
            near[c.row[touched[c.loop]]] = True
        return near

    def solve(
        self, near: np.ndarray, ring: RingCoordinate | None, slide: bool, steps: int
    ) -> Descent:
        """Return the descent after points of the cells `near` (n,) bool moved, in at most so many `steps`.

        Points on walls `slide` along the boundary `ring` or stay.
        """
        p, c = self.patch, self.cells
        on_wall = p.on_walls
        free = ~p.held & (~on_wall | (slide & (ring is not None) & ~p.fixed))
        chosen = np.zeros(len(free), bool)
        chosen[c.loop[near[c.row]]] = True
        active = np.flatnonzero(chosen & free)
        m = len(active)
        if not m:
            return self
        moving = np.zeros(len(free), bool)
        moving[active] = True
        changed = np.zeros(len(c.area), bool)
        changed[c.row[moving[c.loop]]] = True
        faces = np.flatnonzero(changed[c.owner] | changed[c.neighbor])
        used = changed.copy()
        used[c.owner[faces]] = used[c.neighbor[faces]] = True
        part = c.part(np.flatnonzero(used), faces)
        slides = np.flatnonzero(on_wall[active])
        motion = _Motion(p, active, slides, self._widths()[active], ring)
        found = _minimum(part, motion, part.pattern(active, len(free)), steps)
        points = p.points.copy()
        points.T[:, active] = [z[0, active] for z in motion.placed(found)]
        positions = p.positions.copy()
        if slides.size and ring is not None:
            at = active[slides]
            positions[at] = ring.moved(positions[at], found[0, slides, 0] * motion.scale[slides])
        made = replace(p, points=points, positions=positions)
        return Descent(made, (c.starts, c.loop, self.sides), self.goals)

    def _widths(self) -> np.ndarray:
        """Return the width of the thinnest cell at each point, (v,): four times its area over its perimeter."""
        c, p = self.cells, self.patch.points[self.cells.loop]
        perimeter = np.add.reduceat(np.hypot(*(p[c.after] - p).T), c.starts[:-1])
        widths = np.maximum(4 * c.area / perimeter, 0.2 * c.size)
        found = np.full(len(self.patch.points), np.inf)
        np.minimum.at(found, c.loop, widths[c.row])
        return found


@dataclass(eq=False)
class _Motion:
    """How points move: the `active` ones freely, but those of them that `slides` selects along the boundary.

    Moves are over `scale` (m,). The second component of a move along the boundary is 0.
    """

    patch: Patch
    active: np.ndarray
    slides: np.ndarray
    scale: np.ndarray
    ring: RingCoordinate | None

    def placed(self, moves: np.ndarray) -> np.ndarray:
        """Return the coordinates of all points (2, g, v) for `moves` (g, m, 2)."""
        found = np.repeat(self.patch.points.T[:, None], len(moves), axis=1)
        far = moves * self.scale[:, None]
        found[:, :, self.active] += np.moveaxis(far, 2, 0)
        if self.slides.size and self.ring is not None:
            at = self.active[self.slides]
            s = self.ring.moved(self.patch.positions[at], far[:, self.slides, 0])
            found[:, :, at] = np.moveaxis(self.ring.points(s), 2, 0)
        return found


def _minimum(
    cells: Cells, motion: _Motion, pattern: scipy.sparse.csr_array, steps: int
) -> np.ndarray:
    """Return the moves (1, m, 2) after some steps towards a minimum of the sum of squares."""
    from scipy.optimize import least_squares

    m = len(motion.active)

    def residuals(moves: np.ndarray) -> np.ndarray:
        terms = cells.residuals(*motion.placed(moves))
        return np.concatenate([terms, _MOVE_WEIGHT * moves.reshape(len(moves), -1)], axis=1)

    color = _colors(pattern)
    rows, points = pattern.nonzero()
    rows, columns = np.tile(rows, 2), np.concatenate([2 * points, 2 * points + 1])
    groups = np.concatenate([2 * color[points], 2 * color[points] + 1])
    steps_aside = np.zeros((2 * color.max() + 2, m, 2))
    for axis in range(2):
        steps_aside[2 * color + axis, np.arange(m), axis] = _STEP
    steps_aside[:, motion.slides, 1] = 0

    def at(x: np.ndarray) -> np.ndarray:
        return residuals(x.reshape(1, m, 2))[0]

    def jacobian(x: np.ndarray) -> scipy.sparse.csr_array:
        slope = (residuals(x.reshape(1, m, 2) + steps_aside) - at(x)) / _STEP
        return scipy.sparse.csr_array(
            (slope[groups, rows], (rows, columns)), (len(slope[0]), 2 * m)
        )

    found = least_squares(
        at, np.zeros(2 * m), jacobian, ftol=_TOLERANCE, max_nfev=steps, tr_solver="lsmr"
    )
    return found.x.reshape(1, m, 2)


def _colors(pattern: scipy.sparse.csr_array) -> np.ndarray:
    """Return a number for each column, (m,) int, such that no row has two columns with the same number."""
    conflict = scipy.sparse.csr_array(pattern.T @ pattern)
    starts: list[int] = np.asarray(conflict.indptr).tolist()
    others: list[int] = np.asarray(conflict.indices).tolist()
    color = [-1] * (len(starts) - 1)
    for i in range(len(color)):
        taken = {color[j] for j in others[starts[i] : starts[i + 1]]}
        color[i] = next(k for k in range(len(taken) + 1) if k not in taken)
    return np.array(color)
