"""Adaptive quadrature of the cell density h^-d over a quadtree (octree)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from ...arguments import format_point
from ...errors import InputTypeError, SizeFieldError
from ...geometry.domain import Domain
from ...sizing.arguments import advice_for_size
from .box_tree import BoxTree, hilbert_tables
from .coverage import coverage_of, gauss_rule

_BASE = {2: 1024, 3: 4096}  # initial boxes inside the domain, at least
_MAX_BASE = {2: 16384, 3: 65536}  # initial boxes in total, at most
_MAX_BOXES = {2: 1 << 17, 3: 1 << 17}  # at which refinement ends
_BATCH = 1 << 19  # points evaluated at once
_EVEN = 1.01  # ratio of sizes that count as the same

# Ratios of sizes for refinement beyond the error estimate: see `DensityTree`.
_STEEP = 2.0
_JUMP = 4.0


def _slopes(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the root mean square of |grad value| in boxes, (m,), by differences of neighboring Gauss points.

    - `points` (m, 3^d, d) float: Gauss points. Some may have been moved, even onto each other.
    - `values`: (m, 3^d) float
    """
    m, _, dim = points.shape
    rows = (m, *(3,) * dim)
    squares = np.zeros(m)
    for axis in range(1, dim + 1):
        step = np.diff(points.reshape(*rows, dim), axis=axis).reshape(m, -1, dim)
        rise = np.diff(values.reshape(rows), axis=axis).reshape(m, -1)
        length2 = (step**2).sum(axis=2)
        squares += np.divide(rise**2, length2, out=np.zeros_like(rise), where=length2 > 0).mean(axis=1)
    return np.sqrt(squares)


def _which(sizes: Sequence[float], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the index of the first of `sizes` within one percent of `low` and `high` (n,), (n,) int.

    It is ``len(sizes)`` if there is none.
    """
    same = [(low * _EVEN >= size) & (high <= size * _EVEN) for size in sizes]
    return np.argmax([*same, np.ones(len(low), bool)], axis=0)


class DensityTree:
    """The number of cells h^-d dV in each box of an adaptive tree over the domain.

    A box is split

    (a) while it has one of the largest error estimates whose sum exceeds `tolerance` times the integral. The estimate
        is half the change by the last split or, where h jumps by more than a factor of 4 between the box and its
        neighbors, the integral that the samples can miss beyond the last Gauss point;
    (b) while it is longer than the smallest known h in it and its neighbors, and h varies by more than a factor of 2
        among these: a local minimum with one sample in it is resolved down to its own h;
    (c) while it is more than twice as large as a neighbor. With (b) and (c) a thin minimum along a curve is followed
        from box to box.

    Known values are those at the 3^d Gauss points of each box, at a grid of at least 33 x 33 nodes (17^3 in 3D), walls
    included, and at the landmarks of the field (on the curves of a `Distance`, at minima of a `Raster`). A local
    minimum is certainly found if it contains a landmark or is wider than about 1/40 of the domain's shorter side (1/25
    in 3D); a thinner one in a formula or a callable can be missed.

    Work is bounded: refinement ends at 2^17 boxes or about 30 levels (20 in 3D). `error` has the error reached.

    - `field`: h(points (n, d)) -> (n,); a `Field`, or a `Sizing` (evaluated on its device).
    - `domain`: boxes at its boundary count by their exact share inside. h is evaluated inside only: Gauss points
      outside are replaced by a point inside the box.
    - `tolerance`: relative error of the integral.

    Its attributes:
    - `boxes`: BoxTree
    - `coverage`: the part of each box inside the domain.
    - `cells` (m,) float: integral of h^-d over the part of each box inside the domain.
    - `slopes` (m, d) float: mean change of log(h^-d) across each box.
    - `slopes_of_size` (m,) float: |grad h| in each box: the root mean square of the slopes between samples, which a
      kink does not cancel.
    - `error`: sum of the error estimates, in cells.

    Raises `SizeFieldError` if h is not positive and finite, or h^-d is not finite, at a sampled point.
    """

    def __init__(self, field: Callable[[np.ndarray], np.ndarray], domain: Domain, tolerance: float = 1e-4):
        if not callable(field):
            raise InputTypeError(f"field is {type(field).__name__}, expected a field of clvoro.sizing")
        self.field, self._domain, self.boxes = field, domain, BoxTree(domain)
        self.coverage = coverage_of(self.boxes, domain)
        dim = domain.dim
        least = self.coverage.filling * _BASE[dim]
        while np.count_nonzero(self.coverage.occupied) << dim < least and len(self.boxes) << dim < _MAX_BASE[dim]:
            self.coverage.split(self.coverage.occupied)
        m = len(self.boxes)
        self.cells, self._differences, self._low, self._high = np.zeros((4, m))
        self.slopes, self.slopes_of_size = np.zeros((m, dim)), np.zeros(m)
        self._integrate(np.ones(m, bool))
        self._evaluate_landmarks(domain)
        self._refine(np.ones(m, bool))
        while True:
            chosen = self._to_split(tolerance)
            if not chosen.any():
                break
            self._refine(chosen)
        self.cells *= self.coverage.balance()

    @property
    def integral(self) -> float:
        """Number of cells in the domain."""
        return float(self.cells.sum())

    @property
    def error(self) -> float:
        """Sum of the error estimates, in cells."""
        return float(self._errors.sum())

    def even_sizes(self, least: float) -> dict[float, float]:
        """Return each size that at least `least` cells have within one percent, with the number of these cells."""
        even = np.flatnonzero(self.coverage.occupied & (self._high <= _EVEN * self._low))
        even = even[np.argsort(self._low[even], kind="stable")]
        found = {}
        while even.size:
            low, total = self._low[even], np.cumsum(np.append(0, self.cells[even]))
            end = np.searchsorted(low, _EVEN * low, side="right")
            first = int(np.argmax(total[end] - total[:-1]))
            chosen = even[first : end[first]]
            if (number := self.cells[chosen].sum()) < least:
                break
            middle = np.sqrt(self._low[chosen] * self._high[chosen])
            found[float(np.average(middle, weights=self.cells[chosen]))] = float(number)
            even = np.delete(even, slice(first, end[first]))
        return found

    def leave_out(self, sizes: Sequence[float]) -> None:
        """Set the number of cells to 0 in boxes where h is within one percent of one of `sizes`."""
        self.cells[_which(sizes, self._low, self._high) < len(sizes)] = 0

    def which_size(self, points: np.ndarray, sizes: Sequence[float]) -> np.ndarray:
        """Return the index of the first of `sizes` within one percent of h at `points` (n, d), (n,) int.

        It is ``len(sizes)`` if there is none.
        """
        h = self.sizes(points)
        return _which(sizes, h, h)

    def sizes(self, points: np.ndarray) -> np.ndarray:
        """Return h at `points` (n, d), (n,) float64.

        Raises
        ------
        SizeFieldError
            If a value is not positive and finite; the message has the point.
        """
        found = np.empty(len(points))
        for first in range(0, len(points), _BATCH):
            part = points[first : first + _BATCH]
            h = np.asarray(self.field(part), dtype=float)
            bad = np.flatnonzero(~((h > 0) & np.isfinite(h)))
            if bad.size:
                where = format_point(part[bad[0]])
                raise SizeFieldError(
                    f"the size field is {h[bad[0]]:g} at {where}, expected a positive, finite "
                    f"size on the whole domain; {self._advice(float(h[bad[0]]))}"
                )
            found[first : first + _BATCH] = h
        return found

    def _advice(self, value: float) -> str:
        return advice_for_size(value, self._domain, getattr(self.field, "on_device", False))

    def _integrate(self, chosen: np.ndarray) -> None:
        """Apply the Gauss rule to the boxes where `chosen` is true."""
        outside = chosen & ~self.coverage.occupied
        self.cells[outside], self.slopes[outside] = 0, 0
        self._low[outside], self._high[outside] = np.inf, 0
        chosen = chosen & ~outside
        at, weight = gauss_rule(self.boxes.dim)
        points = self.coverage.move_inside(self.boxes.points(at, chosen), chosen)
        m, p, dim = points.shape
        h = self.sizes(points.reshape(-1, dim)).reshape(m, p)
        with np.errstate(over="ignore"):
            # Number of cells in the box for the size at each sample.
            density = reduce(np.multiply, (e[:, None] / h for e in self.boxes.edges(chosen).T))
        if not np.isfinite(density).all():
            i, j = np.argwhere(~np.isfinite(density))[0]
            where = format_point(points[i, j])
            raise SizeFieldError(
                f"the size field is {h[i, j]:g} at {where}: the number of cells overflows; "
                f"{self._advice(float(h[i, j]))}"
            )
        offset = at - 0.5
        self.cells[chosen] = self.coverage.scale_by_share(density @ weight, chosen)
        samples = np.ascontiguousarray(h.T)  # faster than NumPy along a short axis
        self._low[chosen], self._high[chosen] = samples.min(axis=0), samples.max(axis=0)
        logs = np.log(h)
        self.slopes[chosen] = -dim * (logs @ offset) / (offset[:, 0] ** 2).sum()
        self.slopes_of_size[chosen] = _slopes(points, logs) * h.mean(axis=1)

    def _evaluate_landmarks(self, domain: Domain) -> None:
        """Evaluate h at the landmarks: a grid of corners of boxes, and the landmarks of the field."""
        boxes, dim = self.boxes, self.boxes.dim
        step = 0.5 ** (1 + int(boxes.level.max()))
        axes = [np.arange(round(end / step) + 1) * step for end in boxes.end]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
        grid = grid[self.coverage.contains(boxes.origin + boxes.root * grid)]
        named = getattr(self.field, "landmarks", None)
        if named is not None:
            named = named(domain)
            named = named[domain.contains(named)]
            grid = np.concatenate([grid, (named - boxes.origin) / boxes.root])
        points = np.clip(boxes.origin + boxes.root * grid, boxes.origin, boxes.upper)
        sizes = self.sizes(points)
        # A landmark on the upper walls belongs to the last box.
        self._landmarks = np.clip(grid, 0, boxes.end - 2.0 ** -(boxes.deepest + 1))
        self._landmark_sizes = sizes
        self._landmark_box = boxes.find(self._landmarks)
        self._lower_by_landmarks()

    def _lower_by_landmarks(self) -> None:
        np.minimum.at(self._low, self._landmark_box, self._landmark_sizes)
        np.maximum.at(self._high, self._landmark_box, self._landmark_sizes)

    def _to_split(self, tolerance: float) -> np.ndarray:
        boxes, dim = self.boxes, self.boxes.dim
        here, there = boxes.neighbors()
        low, high = self._low.copy(), self._high.copy()
        for i, j in ((here, there), (there, here)):
            np.minimum.at(low, i, self._low[j])
            np.maximum.at(high, i, self._high[j])

        # (a) All but the small errors whose sum is within the tolerance. The rule does not see jumps beyond the last
        # sample, which are up to 0.056 of the box.
        volumes = self.coverage.scale_by_share(boxes.volumes(), np.ones(len(boxes), bool))
        reached = self.coverage.occupied
        jumps = reached & (high > _JUMP * low)
        sliver = np.zeros(len(boxes))
        with np.errstate(over="ignore"):  # too many cells are rejected later
            sliver[jumps] = 0.056 * volumes[jumps] * (low[jumps] ** -dim - high[jumps] ** -dim)
        self._errors = np.maximum(self._differences, sliver)
        by_error = np.argsort(self._errors, kind="stable")
        within = np.cumsum(self._errors[by_error]) <= tolerance * self.integral
        chosen = np.zeros(len(boxes), bool)
        chosen[by_error[~within]] = True
        # (b) Local minima that are not resolved.
        chosen |= (boxes.longest() > low) & (high > _STEEP * low)
        # (c) Neighbors of much smaller boxes.
        chosen[there[boxes.level[there] < boxes.level[here] - 1]] = True
        chosen &= reached & (boxes.level < boxes.deepest)

        room = (_MAX_BOXES[dim] - len(boxes)) // ((1 << dim) - 1)
        if np.count_nonzero(chosen) > room:
            worst = np.argsort(np.where(chosen, -self._errors, 1.0), kind="stable")[: max(room, 0)]
            chosen[:] = False
            chosen[worst] = True
        return chosen

    def _refine(self, chosen: np.ndarray) -> None:
        boxes = self.boxes
        _, _, rank = hilbert_tables(boxes.dim)
        # The child box of each landmark.
        box = self._landmark_box
        half = 0.5 ** (boxes.level[box] + 1.0)[:, None]
        bits = (self._landmarks >= boxes.corner[box] + half) @ (1 << np.arange(boxes.dim))
        child_rank = np.where(chosen[box], rank[boxes.state[box], bits], 0)
        parent, child = self.coverage.split(chosen)
        first = np.searchsorted(parent, np.arange(len(chosen)))
        self._landmark_box = first[box] + child_rank
        fresh = child >= 0
        before = self.cells[chosen] * self.coverage.correction
        for name in ("cells", "_differences", "_low", "_high", "slopes", "slopes_of_size"):
            setattr(self, name, getattr(self, name)[parent])
        self._integrate(fresh)
        self._lower_by_landmarks()
        # The change is approximately the parents' error. The sum of the children's errors is 1/4 of it at a kink of h,
        # and 1/64 where h is smooth. The estimate is half of it, because a change can be small by chance.
        family = self.cells[fresh].reshape(-1, 1 << boxes.dim)
        change = np.abs(family.sum(axis=1) - before) / 2
        reached = self.coverage.occupied[fresh].reshape(family.shape)
        change /= np.maximum(np.count_nonzero(reached, axis=1), 1)
        self._differences[fresh] = (change[:, None] * reached).ravel()
