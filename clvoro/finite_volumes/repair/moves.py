"""Move points so that faces become less skew and closer to orthogonal.

The points of each patch are found by nonlinear least squares, with the terms of `figures` and the derivatives of
`slopes`. Points on walls slide along the boundary or stay. Many patches are solved in one go: they are independent, but
a patch is so small that calling NumPy for it alone takes longer than its arithmetic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ...geometry.ring_coordinate import RingCoordinate
from .figures import CellGroup
from .slopes import slopes

_MOVE_WEIGHT = 0.1
_STEP = 1e-6
"""Step of the finite differences along the boundary, relative to the width of a cell."""
_TOLERANCE = 1e-3
"""Relative change of the sum of squares at which the moves end."""
_DAMPING, _RISE, _FALL = 1.0, 5.0, 5.0
"""First damping of Levenberg and Marquardt; its factors after a step that fails, and after one that succeeds."""
_MOST_DENSE = 200
"""Unknowns up to which matrices are dense."""


@dataclass(eq=False)
class Problem:
    """Points that move, and the cells whose figures change.

    Moves are over `scale`. The second component of a move along the boundary is 0.

    Attributes
    ----------
    cells : CellGroup
    points : (2, v) float
        Coordinates of all points before they move.
    positions : (v,) float
        Their positions along the boundary; NaN for points inside.
    active : (m,) int
        Points that move.
    slides : (s,) int
        Those of the active points that move along the boundary.
    scale : (m,) float
    """

    cells: CellGroup
    points: np.ndarray
    positions: np.ndarray
    active: np.ndarray
    slides: np.ndarray
    scale: np.ndarray

    @classmethod
    def joined(cls, problems: Sequence[Problem]) -> Problem:
        """Return several problems as one: their cells, points and unknowns one after the other."""
        if len(problems) == 1:
            return problems[0]
        v = _begins([len(p.positions) for p in problems])
        m = _begins([len(p.active) for p in problems])
        return cls(
            cells=CellGroup.joined([p.cells for p in problems], v),
            points=np.concatenate([p.points for p in problems], axis=1),
            positions=np.concatenate([p.positions for p in problems]),
            active=np.concatenate([p.active + i for p, i in zip(problems, v, strict=False)]),
            slides=np.concatenate([p.slides + i for p, i in zip(problems, m, strict=False)]),
            scale=np.concatenate([p.scale for p in problems]),
        )

    def placed(self, moves: np.ndarray, ring: RingCoordinate | None) -> np.ndarray:
        """Return the coordinates of all points (2, v) for `moves` (m, 2)."""
        found = self.points.copy()
        far = moves * self.scale[:, None]
        found[:, self.active] += far.T
        if self.slides.size and ring is not None:
            at = self.active[self.slides]
            s = ring.moved(self.positions[at], far[self.slides, 0])
            found[:, at] = ring.points(s).T
        return found

    def frames(self, moves: np.ndarray, ring: RingCoordinate | None) -> np.ndarray:
        """Return the derivatives of the active points' coordinates by their moves, (2, 2, m)."""
        found = np.zeros((2, 2, len(self.active)))
        found[0, 0] = found[1, 1] = self.scale
        if self.slides.size and ring is not None:
            here = moves[self.slides, 0]
            far = np.stack([here + _STEP, here]) * self.scale[self.slides]
            s = ring.moved(self.positions[self.active[self.slides]], far)
            there, here = ring.points(s)
            found[:, 0, self.slides] = (there - here).T / _STEP
            found[:, 1, self.slides] = 0
        return found


def minimize(problems: Sequence[Problem], steps: Sequence[int], ring: RingCoordinate | None) -> list[np.ndarray]:
    """Lower the sum of squares of each problem by some steps of Levenberg and Marquardt; return its moves, (m, 2).

    Parameters
    ----------
    problems : sequence of Problem
    steps : sequence of int
        Most steps of each problem.
    ring : RingCoordinate or None
        The boundary along which points slide.
    """
    searches = [_Search(p, left) for p, left in zip(problems, steps, strict=True)]
    joint = _Joint(searches, ring)
    costs = joint.evaluate([search.moves for search in searches])
    for search, cost in zip(searches, costs, strict=True):
        search.cost = cost
    joint.set_equations(np.ones(len(searches), bool))
    while going := [search for search in searches if search.left]:
        if len(going) < len(joint.searches):
            joint = _Joint(going, ring)
        tried = [search.moves - search.step() for search in going]
        costs = joint.evaluate(tried)
        better = [s.judge(x, cost) for s, x, cost in zip(going, tried, costs, strict=True)]
        joint.set_equations(np.array([b and s.left > 0 for b, s in zip(better, going, strict=True)]))
    return [search.moves for search in searches]


class _Search:
    """The state of the minimization of one problem.

    Attributes
    ----------
    problem : Problem
    left : int
        Most steps that are left.
    moves : (m, 2) float
    cost : float
        Sum of squares there.
    matrix, gradient
        The normal equations there, with the weight of moves and the last damping.
    entries, places, diagonal
        The matrix as one array, where its diagonal lies there, and the diagonal without damping.
    """

    def __init__(self, problem: Problem, left: int) -> None:
        self.problem, self.left = problem, left
        self.moves = np.zeros((len(problem.active), 2))
        self.cost, self.damping = np.inf, _DAMPING
        self.matrix: np.ndarray | scipy.sparse.csc_array

    def set_equations(self, jacobian: np.ndarray | scipy.sparse.csr_array, gradient: np.ndarray) -> None:
        """Take the derivatives of the terms at `moves`, (t, 2 m), and half of those of the sum of squares, (2 m,)."""
        k, weight = len(gradient), _MOVE_WEIGHT**2
        self.gradient = gradient + weight * self.moves.ravel()
        product = jacobian.T @ jacobian
        if isinstance(product, np.ndarray):
            self.matrix = product
            self.entries, self.places = product.reshape(-1), np.arange(k) * (k + 1)
            self.entries[self.places] += weight
        else:
            self.matrix = scipy.sparse.csc_array(product + scipy.sparse.eye_array(k) * weight)
            self.matrix.sort_indices()
            self.entries = self.matrix.data
            column = np.repeat(np.arange(k), np.diff(self.matrix.indptr))
            self.places = np.flatnonzero(self.matrix.indices == column)
        self.diagonal = self.entries[self.places]

    def step(self) -> np.ndarray:
        """Return the step (m, 2) of Levenberg and Marquardt; NaN if the equations have no solution."""
        from scipy.linalg.lapack import dposv
        from scipy.sparse.linalg import splu

        self.entries[self.places] = self.diagonal + self.damping
        found = np.full(len(self.gradient), np.nan)
        if isinstance(self.matrix, np.ndarray):
            _, solution, failed = dposv(self.matrix, self.gradient)
            found = found if failed else solution
        elif np.isfinite(self.entries).all():
            factors = splu(self.matrix, "MMD_AT_PLUS_A", options={"SymmetricMode": True})
            found = factors.solve(self.gradient)
        return found.reshape(-1, 2)

    def judge(self, tried: np.ndarray, cost: float) -> bool:
        """Take the moves `tried` (m, 2), at which the terms have the sum of squares `cost`, if they are better."""
        self.left -= 1
        lower = self.cost - cost - _MOVE_WEIGHT**2 * float((tried * tried).sum())
        if not lower > 0:
            self.damping *= _RISE
            return False
        self.moves, self.cost, self.damping = tried, self.cost - lower, self.damping / _FALL
        if lower < _TOLERANCE * self.cost:
            self.left = 0
        return True


class _Joint:
    """The problems of several searches as one."""

    def __init__(self, searches: list[_Search], ring: RingCoordinate | None) -> None:
        self.searches, self.ring = searches, ring
        problems = [search.problem for search in searches]
        self.problem = Problem.joined(problems)
        self.counts = np.array([len(p.active) for p in problems])
        blocks = np.arange(len(searches))
        of_face, of_cell, of_corner = (
            np.repeat(blocks, [len(getattr(p.cells, name)) for p in problems]) for name in ("faces", "area", "loop")
        )
        self.of_term = np.concatenate([of_face] * 3 + [of_cell] * 2 + [of_corner])

    def evaluate(self, moves: list[np.ndarray]) -> list[float]:
        """Return the sum of squares of each problem for its moves, without that of the moves."""
        cells = self.problem.cells
        self.moves = np.concatenate(moves)
        self.at = cells.figures(*self.problem.placed(self.moves, self.ring))
        self.terms = cells.terms(self.at)
        found: list[float] = np.bincount(self.of_term, self.terms**2, len(self.searches)).tolist()
        return found

    def set_equations(self, wanted: np.ndarray) -> None:
        """Give the searches that are `wanted` (n,) bool the equations at the moves that were evaluated last."""
        if not wanted.any():
            return
        problem, n = self.problem, len(self.searches)
        number, of_unknown = (np.full(len(problem.positions), -1), np.repeat(np.arange(n), self.counts))
        chosen = wanted[of_unknown]
        number[problem.active[chosen]] = np.flatnonzero(chosen)
        found = slopes(problem.cells, self.at)
        points = number[found.points]
        used = (points >= 0).nonzero()[0]
        rows, points = found.terms[used], points[used]
        frames = problem.frames(self.moves, self.ring)[:, :, points]
        values = (found.x[used] * frames[0] + found.y[used] * frames[1]).ravel()
        columns, rows = np.concatenate([2 * points, 2 * points + 1]), np.concatenate([rows, rows])
        gradient = np.bincount(columns, values * self.terms[rows], 2 * len(of_unknown))
        # The rows of a problem are the terms that have a derivative other than 0.
        has = np.zeros(len(self.terms), bool)
        has[rows] = True
        kept = np.flatnonzero(has)
        block = self.of_term[kept]
        heights = np.bincount(block, minlength=n)
        row = np.empty(len(has), np.int64)
        order = np.argsort(block, kind="stable")
        row[kept[order]] = np.arange(len(kept)) - np.repeat(np.cumsum(heights) - heights, heights)
        widths = 2 * self.counts
        begins = np.cumsum(widths) - widths
        of = self.of_term[rows]
        rows, columns = row[rows], columns - begins[of]
        order = np.argsort(of, kind="stable")
        ends = np.searchsorted(of[order], np.arange(n + 1))
        for i in np.flatnonzero(wanted).tolist():
            at, k, height = order[ends[i] : ends[i + 1]], int(widths[i]), int(heights[i])
            entries = values[at], rows[at], columns[at]
            self.searches[i].set_equations(_matrix(*entries, (height, k)), gradient[begins[i] : begins[i] + k])


def _matrix(
    values: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]
) -> np.ndarray | scipy.sparse.csr_array:
    """Return a matrix whose entries are the sums of `values` (s,) at the same place."""
    height, width = shape
    if width > _MOST_DENSE:
        return scipy.sparse.csr_array((values, (rows, columns)), shape)
    return np.bincount(rows * width + columns, values, height * width).reshape(height, width)


def _begins(counts: list[int]) -> list[int]:
    return [0, *np.cumsum(counts).tolist()]
