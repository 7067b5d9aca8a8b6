"""Points of a patch moved so that its faces are less skew and nearer to orthogonal: a least-squares problem.

Points on walls slide along the boundary or stay. The sum of squares is that of `figures`; its derivatives are
those of `slopes`. Whether a patch becomes better is decided by its price, the sum of what is beyond the limits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from ...geometry.ring_coordinate import RingCoordinate
from ...mesh.connectivity import following
from .figures import LENGTH_GOAL, Cells, Figures
from .patch import BORDER, Patch, cell_sides
from .slopes import slopes

STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell."""
_SHORT = 0.05
"""A shorter face raises the price of the patch. Lengths are relative to the smaller of its two cells."""
LEAST_DETERMINANT = 3e-3
"""A cell with a smaller determinant raises the price of the patch. OpenFOAM refuses cells below 1e-3."""
_REFUSED_DETERMINANT = 1.1e-3
"""A cell with a smaller determinant counts as refused."""
_MOST_EXCESS = 4
"""Faces that exceed a limit by more than this times it have the same price."""
_INVERTED_PRICE, _CONCAVE_PRICE, _CUT_PRICE = 100.0, 3.0, 0.5
"""Prices of a cell without a positive area, of a concave corner for each radian, and of a corner that is cut off for
the square of its distance from the chord over the size of the cell."""
_MOVE_WEIGHT = 0.1
_STEP = 1e-6
"""Step of differences along the boundary, over the width of a cell."""
_TOLERANCE = 1e-3
"""Relative change of the sum of squares at which the moves end."""
_DAMPING, _RISE, _FALL = 1.0, 5.0, 5.0
"""First damping of Levenberg and Marquardt; its factors after a step that fails, and after one that succeeds."""
_MOST_DENSE = 200
"""Unknowns up to which matrices are dense."""


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
    refused : (n,) bool
        Cells that are concave, have no area, or have a determinant that OpenFOAM refuses.
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
        bound = np.empty_like(on_wall)  # corners between two faces on walls
        bound[after] = on_wall & on_wall[after]
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
            starts, loop, row, ~on_wall, bound, faces, patch.ends[faces], owner,
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
        """Sum of the prices of all cells and of all corners that have been cut off."""
        cuts = sum(_CUT_PRICE * (cut.far / cut.size) ** 2 for cut in self.patch.cuts)
        return float(self.prices.sum()) + cuts

    def _set_prices(self) -> None:
        c, (angle, skewness) = self.cells, self.patch.limits
        now = c.figures(*self.patch.points.T)
        excess = np.minimum(np.maximum(now.angle / angle - 1, 0), _MOST_EXCESS) ** 2
        excess += np.minimum(np.maximum(now.skewness / skewness - 1, 0), _MOST_EXCESS) ** 2
        beyond = excess > 0
        excess += np.maximum(1 - now.length / _SHORT, 0) ** 2
        n, turn = len(c.area), now.turn
        self.bent = turn < STRAIGHT
        prices = np.bincount(c.row, self.bent * (1 + _CONCAVE_PRICE * np.maximum(-turn, 0)), n)
        prices += now.determinant < LEAST_DETERMINANT
        prices += _INVERTED_PRICE * (now.area <= 0)
        self.bad = prices > 0
        self.refused = np.bincount(c.row, self.bent, n) > 0
        self.refused |= (now.determinant < _REFUSED_DETERMINANT) | (now.area <= 0)
        self.bad[c.owner[beyond]] = self.bad[c.neighbor[beyond]] = True
        prices += (np.bincount(c.owner, excess, n) + np.bincount(c.neighbor, excess, n)) / 2
        self.prices, self.face_prices, self.lengths = prices, excess, now.length

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
        moves = _minimum(part, motion, steps)
        points = p.points.copy()
        points[active] = motion.placed(moves)[:, active].T
        positions = p.positions.copy()
        if slides.size and ring is not None:
            at = active[slides]
            positions[at] = ring.moved(positions[at], moves[slides, 0] * motion.scale[slides])
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
        """Return the coordinates of all points (2, v) for `moves` (m, 2)."""
        found = self.patch.points.T.copy()
        far = moves * self.scale[:, None]
        found[:, self.active] += far.T
        if self.slides.size and self.ring is not None:
            at = self.active[self.slides]
            s = self.ring.moved(self.patch.positions[at], far[self.slides, 0])
            found[:, at] = self.ring.points(s).T
        return found

    def frames(self, moves: np.ndarray) -> np.ndarray:
        """Return the derivatives of the active points' coordinates by their moves, (2, 2, m)."""
        found = np.zeros((2, 2, len(self.active)))
        found[0, 0] = found[1, 1] = self.scale
        if self.slides.size:
            here = moves[self.slides, 0]
            far = np.stack([here + _STEP, here]) * self.scale[self.slides]
            assert self.ring is not None
            s = self.ring.moved(self.patch.positions[self.active[self.slides]], far)
            there, here = self.ring.points(s)
            found[:, 0, self.slides] = (there - here).T / _STEP
            found[:, 1, self.slides] = 0
        return found


def _minimum(cells: Cells, motion: _Motion, steps: int) -> np.ndarray:
    """Return the moves (m, 2) after some steps of Levenberg and Marquardt towards a minimum of the sum of squares."""
    m = len(motion.active)
    moves = np.zeros((m, 2))
    at = cells.figures(*motion.placed(moves))
    terms = cells.terms(at)
    cost, damping, left = float(terms @ terms), _DAMPING, steps
    while left:
        equations = _Equations(cells, motion, moves, at, terms)
        while left:
            left -= 1
            tried = moves - equations.solve(damping)
            there = cells.figures(*motion.placed(tried))
            now = cells.terms(there)
            lower = cost - float(now @ now) - _MOVE_WEIGHT**2 * float((tried * tried).sum())
            if lower > 0:
                break
            damping *= _RISE
        else:
            break
        moves, at, terms, cost = tried, there, now, cost - lower
        damping /= _FALL
        if lower < _TOLERANCE * cost:
            break
    return moves


class _Equations:
    """The normal equations for a step from `moves` (m, 2)."""

    def __init__(
        self, cells: Cells, motion: _Motion, moves: np.ndarray, at: Figures, terms: np.ndarray
    ) -> None:
        v, m = len(motion.patch.points), len(motion.active)
        number = np.full(v, -1)
        number[motion.active] = np.arange(m)
        found = slopes(cells, at)
        points = number[found.points]
        used = (points >= 0).nonzero()[0]
        rows, points = found.terms[used], points[used]
        frames = motion.frames(moves)[:, :, points]
        values = (found.x[used] * frames[0] + found.y[used] * frames[1]).ravel()
        columns, k = np.concatenate([2 * points, 2 * points + 1]), 2 * m
        rows = np.concatenate([rows, rows])
        self.gradient = np.bincount(columns, values * terms[rows], k)
        self.gradient += _MOVE_WEIGHT**2 * moves.ravel()
        if k <= _MOST_DENSE:
            place = np.zeros(len(terms), np.int64)
            place[rows] = 1
            height = int(place.sum())
            place = np.cumsum(place) - 1
            jacobian = np.bincount(place[rows] * k + columns, values, height * k)
            jacobian = jacobian.reshape(height, k)
            self.matrix = jacobian.T @ jacobian
            self.entries, self.diagonal = self.matrix.ravel(), np.arange(k) * (k + 1)
            self.entries[self.diagonal] += _MOVE_WEIGHT**2
        else:
            jacobian = scipy.sparse.csr_array((values, (rows, columns)), (len(terms), k))
            product = jacobian.T @ jacobian + scipy.sparse.eye_array(k) * _MOVE_WEIGHT**2
            self.matrix = scipy.sparse.csc_matrix(product)
            self.matrix.sort_indices()
            self.entries = self.matrix.data
            column = np.repeat(np.arange(k), np.diff(self.matrix.indptr))
            self.diagonal = np.flatnonzero(self.matrix.indices == column)
        self.damping = 0.0

    def solve(self, damping: float) -> np.ndarray:
        """Return the Levenberg-Marquardt step (m, 2); `damping` is added to the diagonal of the matrix."""
        from scipy.sparse.linalg import splu

        matrix = self.matrix
        self.entries[self.diagonal] += damping - self.damping
        self.damping = damping
        if isinstance(matrix, np.ndarray):
            found = np.linalg.solve(matrix, self.gradient)
        elif not np.isfinite(self.entries).all():
            found = np.full(len(self.gradient), np.nan)  # as of dense matrices; the step is refused
        else:
            factors = splu(matrix, "MMD_AT_PLUS_A", options={"SymmetricMode": True})
            found = factors.solve(self.gradient)
        return found.reshape(-1, 2)
