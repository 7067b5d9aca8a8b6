"""A patch and its price: how far its cells and faces are beyond the limits. A change is kept if the price falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...geometry.ring_coordinate import RingCoordinate
from ...mesh.connectivity import following
from .figures import LENGTH_GOAL, CellGroup
from .moves import Problem
from .patch import BORDER, Patch, cell_sides

STRAIGHT = 2e-5
"""Least turn in a corner of a convex cell."""
_SHORT = 0.05
"""A shorter face raises the price of the patch. Lengths are relative to the smaller of its two cells."""
LEAST_DETERMINANT = 3e-3
"""A cell with a smaller determinant raises the price of the patch. OpenFOAM refuses cells below 1e-3."""
_REFUSED_DETERMINANT = 1.1e-3
"""A cell with a smaller determinant counts as refused."""
_MOST_EXCESS = 4
"""The price of a face grows until the face exceeds a limit by this many times the limit."""
_INVERTED_PRICE, _CONCAVE_PRICE, _CUT_PRICE = 100.0, 3.0, 0.5
"""Prices of a cell without a positive area, of a concave corner for each radian, and of a corner that is cut off for
the square of its distance from the chord over the size of the cell."""


class PricedPatch:
    """A patch and its prices.

    Attributes
    ----------
    patch : Patch
    cells : CellGroup
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
        self.cells = CellGroup(
            starts,
            loop,
            row,
            ~on_wall,
            bound,
            faces,
            patch.ends[faces],
            owner,
            np.where(wall, owner, patch.neighbor[faces]),
            wall,
            patch.aim[faces],
            goals[:, 0],
            goals[:, 1],
            origin,
        )
        self._set_prices()
        fresh = np.isnan(self.cells.aim)
        if fresh.any():
            known = np.where(self.bad[owner] | self.bad[self.cells.neighbor], np.inf, self.lengths)
            self.cells.aim = np.where(fresh, np.minimum(known, LENGTH_GOAL), self.cells.aim)
            patch.aim = patch.aim.copy()
            patch.aim[faces] = self.cells.aim

    @classmethod
    def of(cls, patch: Patch, goals: np.ndarray | None = None) -> PricedPatch | None:
        """Return `patch` with its prices; None if a cell is not a simple polygon."""
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
        """Return a mask (n,) of the cells `chosen` (n,) bool and of some rings of cells around them."""
        c, near = self.cells, chosen.copy()
        for _ in range(rings):
            touched = np.zeros(len(self.patch.points), bool)
            touched[c.loop[near[c.row]]] = True
            near[c.row[touched[c.loop]]] = True
        return near

    def problem(self, near: np.ndarray, slide: bool) -> Problem | None:
        """Return the least-squares problem for the points of the cells `near` (n,) bool; None if no point can move.

        Points on walls `slide` along the boundary or stay.
        """
        p, c = self.patch, self.cells
        on_wall = p.on_walls
        free = ~p.held & (~on_wall | (slide & ~p.fixed))
        chosen = np.zeros(len(free), bool)
        chosen[c.loop[near[c.row]]] = True
        active = np.flatnonzero(chosen & free)
        if not len(active):
            return None
        moving = np.zeros(len(free), bool)
        moving[active] = True
        changed = np.zeros(len(c.area), bool)
        changed[c.row[moving[c.loop]]] = True
        faces = np.flatnonzero(changed[c.owner] | changed[c.neighbor])
        used = changed.copy()
        used[c.owner[faces]] = used[c.neighbor[faces]] = True
        return Problem(
            cells=c.part(np.flatnonzero(used), faces),
            points=p.points.T,
            positions=p.positions,
            active=active,
            slides=np.flatnonzero(on_wall[active]),
            scale=self._widths()[active],
        )

    def moved(self, problem: Problem, moves: np.ndarray, ring: RingCoordinate | None) -> PricedPatch:
        """Return the patch after the `moves` (m, 2) of the points of `problem`. Those on walls slide along `ring`."""
        points, positions = self.patch.points.copy(), self.patch.positions.copy()
        points[problem.active] = problem.placed(moves, ring)[:, problem.active].T
        slides = problem.slides
        if slides.size and ring is not None:
            at = problem.active[slides]
            positions[at] = ring.moved(positions[at], moves[slides, 0] * problem.scale[slides])
        made = replace(self.patch, points=points, positions=positions)
        return PricedPatch(made, (self.cells.starts, self.cells.loop, self.sides), self.goals)

    def _widths(self) -> np.ndarray:
        """Return the width of the thinnest cell at each point, (v,): four times its area over its perimeter."""
        c, p = self.cells, self.patch.points[self.cells.loop]
        perimeter = np.add.reduceat(np.hypot(*(p[c.after] - p).T), c.starts[:-1])
        widths = np.maximum(4 * c.area / perimeter, 0.2 * c.size)
        found = np.full(len(self.patch.points), np.inf)
        np.minimum.at(found, c.loop, widths[c.row])
        return found
