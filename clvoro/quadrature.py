"""Adaptive quadrature of the cell density h^-d: a quadtree (octree) of boxes in Hilbert order."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from .errors import InputTypeError, SizeFieldError

if TYPE_CHECKING:
    from .domain import Box

_BASE = {2: 1024, 3: 4096}  # boxes that are looked at in any case
_MOST = {2: 1 << 17, 3: 1 << 17}  # boxes after which refinement ends, whatever the error
_BITS = {2: 31, 3: 21}  # of a place per axis in a Morton key of 64 bits
_HALVED = 0.5 ** np.arange(64)
_BATCH = 1 << 19  # points evaluated at once

# Refinement below the error estimate's demand: see `DensityTree`.
_STEEP = 2.0


@lru_cache
def hilbert_tables(dim: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tables of the Hilbert curve in `dim` dimensions.

    A state is an entry corner e and a direction a. The curve visits the children of a box in
    Gray-code order, turned by a and reflected by e.

    Returns
    -------
    place : (states, 2^d, d) int
        Which half of the box, 0 or 1 per axis, is the k-th child on the curve.
    after : (states, 2^d) int
        State of that child.
    rank : (states, 2^d) int
        The inverse of `place`: k of the child whose halves are the bits of the index (axis 0 the
        lowest).
    """
    full, states = 1 << dim, dim << dim

    def rotate(bits: int, by: int) -> int:
        by %= dim
        return ((bits << by) | (bits >> (dim - by))) & (full - 1)

    def gray(i: int) -> int:
        return i ^ (i >> 1)

    def trailing_ones(i: int) -> int:
        return (~i & (i + 1)).bit_length() - 1

    place = np.zeros((states, full, dim), np.int64)
    after, rank = np.zeros((2, states, full), np.int8)
    for entry, axis, k in product(range(full), range(dim), range(full)):
        state = entry * dim + axis
        bits = rotate(gray(k), axis + 1) ^ entry
        place[state, k] = [(bits >> a) & 1 for a in range(dim)]
        rank[state, bits] = k
        corner = gray(2 * ((k - 1) // 2)) if k else 0
        turn = 0 if k == 0 else trailing_ones(k - 1 if k % 2 == 0 else k)
        next_entry, next_axis = entry ^ rotate(corner, axis + 1), (axis + turn + 1) % dim
        after[state, k] = next_entry * dim + next_axis
    return place, after, rank


class Boxes:
    """Boxes that tile the domain, in the order of a Hilbert curve.

    Attributes
    ----------
    corner : (m, d) float
        Lower corners in units of the root boxes' edges: multiples of powers of two, hence exact.
    level : (m,) int8
        The edges are 2^-level root edges.
    state : (m,) int8
        State of the curve in each box.
    """

    def __init__(self, domain: Box):
        self.origin = np.array(domain.lower)
        # As many roots per axis as make them nearly cubes; a needle's stay long.
        shape = np.clip(np.rint(domain.extent / domain.extent.min()), 1, 64).astype(int)
        self.root = domain.extent / shape
        self.upper = np.array(domain.upper)
        self.corner = _snake(shape).astype(float)
        self.level = np.zeros(len(self.corner), np.int8)
        self.state = np.zeros(len(self.corner), np.int8)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.corner.shape[1]

    def __len__(self) -> int:
        return len(self.level)

    def edges(self, chosen: object = slice(None)) -> np.ndarray:
        """Return the physical edge lengths (m, d)."""
        return self.root * _HALVED[self.level[chosen]][:, None]

    def points(self, at: np.ndarray, chosen: object = slice(None)) -> np.ndarray:
        """Return the points (m, p, d) at relative positions `at` (p, d) or (m, p, d) in [0, 1]."""
        step = _HALVED[self.level[chosen]][:, None, None]
        x = self.origin + self.root * (self.corner[chosen][:, None, :] + step * at)
        return np.clip(x, self.origin, self.upper)

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the boxes where `chosen` (m,) is true by their children, in place on the curve.

        Returns
        -------
        parent : (m',) int
            For each box now, the index before of itself or of its parent.
        child : (m',) int8
            Rank among the siblings, -1 for boxes that were not split.
        """
        place, after, _ = hilbert_tables(self.dim)
        counts = np.where(chosen, 1 << self.dim, 1)
        parent = np.repeat(np.arange(len(self)), counts)
        child = np.full(len(parent), -1, np.int8)
        new = np.flatnonzero(chosen[parent])
        child[new] = np.tile(np.arange(1 << self.dim, dtype=np.int8), len(new) >> self.dim)
        # The children of the split boxes, each family together: (families, 2^d, ...).
        corner, level, state = self.corner[parent], self.level[parent], self.state[parent]
        level[new] += 1
        half = _HALVED[self.level[chosen] + 1][:, None, None] * place[self.state[chosen]]
        corner[new] += half.reshape(-1, self.dim)
        state[new] = after[self.state[chosen]].ravel()
        self.corner, self.level, self.state = corner, level, state
        return parent, child


def _snake(shape: np.ndarray) -> np.ndarray:
    """Order the boxes of a grid so that each touches the one before: (m, d) int."""
    rows = np.zeros((1, 0), np.int64)
    for count in shape[::-1]:
        line = np.arange(count)
        lines = [line if i % 2 == 0 else line[::-1] for i in range(len(rows))]
        rows = np.column_stack([np.concatenate(lines), np.repeat(rows, count, axis=0)])
    return rows


@lru_cache
def _rule(dim: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (p, d) in [0, 1] and the weights of the Gauss rules of degrees 5 and 3.

    The first is the product rule; the second, inside it, takes the centre and the outermost points.
    All weights are positive.
    """
    far = math.sqrt(0.6)
    nodes = np.array(list(product((-far, 0.0, far), repeat=dim)))
    weight = np.prod(np.where(nodes == 0, 4 / 9, 5 / 18), axis=1)
    corner, centre = (nodes != 0).all(axis=1), (nodes == 0).all(axis=1)
    inner = corner * (5 / 9 / 2**dim) + centre * (4 / 9)
    return 0.5 + 0.5 * nodes, weight, inner


class DensityTree:
    """The number of cells h^-d dV in each box of an adaptive tree over the domain.

    A box is split
    (a) while it has one of the largest error estimates (difference of two embedded Gauss rules,
    degrees 5 and 3)
        whose sum exceeds `tolerance` times the integral;
    (b) while it is longer than the least h known in it and h varies in it by more than a factor of
    2: so a dip of which
        one sample has been seen is resolved down to its own h;
    (c) while it is more than twice as large as a neighbour: so a thin dip along a curve is followed
    from box
        to box.
    Known values are those at the 3^d Gauss points of each box, at a grid of 33 x 33 nodes or more
    (17^3 in 3D), walls included, and at the `landmarks` that the field names (on the curves of a
    `Distance`, at the lowest values of a `Raster`). A dip is found for certain if it holds a
    landmark or is wider than about 1/40 of the domain's shorter side (1/25 in 3D); a thinner one in
    a formula or a callable may be missed.

    Work is bounded: refinement ends at 2^17 boxes or 30 levels (20), and `error` then
    tells what was reached.

    Parameters
    ----------
    field : callable
        h(points (n, d)) -> (n,); a `Field`, or a `Sizing` (evaluated on its device).
    domain : Box
    tolerance : float
        Relative to the integral.

    Attributes
    ----------
    boxes : Boxes
    cells : (m,) float
        Integral of h^-d over each box.
    slopes : (m, d) float
        Mean change of log(h^-d) from side to side of each box.
    error : float
        Sum of the error estimates, in cells.

    Raises
    ------
    SizeFieldError
        If h is not positive and finite, or too small for h^-d to be finite, at a point that was
        looked at.
    """

    def __init__(
        self, field: Callable[[np.ndarray], np.ndarray], domain: Box, tolerance: float = 1e-4
    ):
        if not callable(field):
            raise InputTypeError(
                f"field is {type(field).__name__}, expected a field of clvoro.sizing"
            )
        self.field, self.boxes = field, Boxes(domain)
        dim = domain.dim
        while len(self.boxes) < _BASE[dim]:
            self.boxes.split(np.ones(len(self.boxes), bool))
        self._deepest = _BITS[dim] - int((domain.extent / self.boxes.root).max()).bit_length()
        self._integrate_all()
        self._mark(domain)
        while True:
            chosen = self._to_split(tolerance)
            if not chosen.any():
                break
            self._refine(chosen)

    @property
    def integral(self) -> float:
        """Number of cells in the domain."""
        return float(self.cells.sum())

    @property
    def error(self) -> float:
        """Sum of the error estimates, in cells."""
        return float(self._errors.sum())

    def sizes(self, points: np.ndarray) -> np.ndarray:
        """Return h at `points` (n, d), (n,) float64, or raise SizeFieldError naming the place."""
        found = np.empty(len(points))
        for first in range(0, len(points), _BATCH):
            part = points[first : first + _BATCH]
            h = np.asarray(self.field(part), dtype=float)
            bad = np.flatnonzero(~((h > 0) & np.isfinite(h)))
            if bad.size:
                where = ", ".join(f"{c:.6g}" for c in part[bad[0]])
                raise SizeFieldError(
                    f"the size field is {h[bad[0]]:g} at ({where}), expected a positive, finite "
                    "size on the whole domain; bound it, for instance by "
                    "clvoro.sizing.maximum(field, 1e-3)"
                )
            found[first : first + _BATCH] = h
        return found

    def _integrate_all(self) -> None:
        m, dim = len(self.boxes), self.boxes.dim
        self.cells, self._errors, self._low, self._high = np.empty((4, m))
        self.slopes = np.empty((m, dim))
        self._fresh = np.ones(m, bool)
        self._integrate(self._fresh)

    def _integrate(self, chosen: np.ndarray) -> None:
        """Apply the rules to the boxes where `chosen` is true."""
        at, weight, inner = _rule(self.boxes.dim)
        points = self.boxes.points(at, chosen)
        m, p, dim = points.shape
        h = self.sizes(points.reshape(-1, dim)).reshape(m, p)
        edges = self.boxes.edges(chosen)
        with np.errstate(over="ignore"):
            # The cells that the box would hold at each sample's size.
            density = np.prod(edges[:, None, :] / h[:, :, None], axis=2)
        if not np.isfinite(density).all():
            i, j = np.argwhere(~np.isfinite(density))[0]
            where = ", ".join(f"{c:.6g}" for c in points[i, j])
            raise SizeFieldError(
                f"the size field is {h[i, j]:g} at ({where}): the number of cells overflows; "
                "bound it, for instance by clvoro.sizing.maximum(field, 1e-3)"
            )
        offset = at - 0.5
        self.cells[chosen] = density @ weight
        self._errors[chosen] = np.abs(density @ (weight - inner))
        self._low[chosen], self._high[chosen] = h.min(axis=1), h.max(axis=1)
        self.slopes[chosen] = -dim * (np.log(h) @ offset) / (offset[:, 0] ** 2).sum()

    def _mark(self, domain: Box) -> None:
        """Evaluate the landmarks: the base boxes' corners and what the field names."""
        boxes, dim = self.boxes, self.boxes.dim
        step = _HALVED[boxes.level[0]]
        counts = np.rint(domain.extent / boxes.root / step).astype(int)
        axes = [np.arange(c + 1) * step for c in counts]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
        named = getattr(self.field, "landmarks", None)
        if named is not None:
            named = named(domain)
            named = named[domain.contains(named)]
            grid = np.concatenate([grid, (named - boxes.origin) / boxes.root])
        points = np.clip(boxes.origin + boxes.root * grid, boxes.origin, boxes.upper)
        sizes = self.sizes(points)
        # A landmark on the upper walls belongs to the last box.
        end = domain.extent / boxes.root
        self._landmarks = np.clip(grid, 0, end - 2.0 ** -(_BITS[dim] + 2))
        self._landmark_sizes = sizes
        self._landmark_box = self._find(self._landmarks)
        self._lower_by_landmarks()

    def _lower_by_landmarks(self) -> None:
        np.minimum.at(self._low, self._landmark_box, self._landmark_sizes)
        np.maximum.at(self._high, self._landmark_box, self._landmark_sizes)

    def _keys(self, places: np.ndarray) -> np.ndarray:
        """Interleave the bits of `places` (n, d), in root units, to Morton keys."""
        dim = self.boxes.dim
        whole = np.floor(places * 2.0**self._deepest).astype(np.uint64)
        key = np.zeros(len(places), np.uint64)
        for a in range(dim):
            key |= _spread(whole[:, a], dim) << np.uint64(a)
        return key

    def _find(self, places: np.ndarray) -> np.ndarray:
        """Return the index of the box that holds each of `places` (n, d), in root units."""
        starts = self._keys(self.boxes.corner)
        order = np.argsort(starts)
        at = np.searchsorted(starts[order], self._keys(places), side="right") - 1
        return order[at]

    def _to_split(self, tolerance: float) -> np.ndarray:
        boxes, dim = self.boxes, self.boxes.dim
        open_ = boxes.level < self._deepest
        # (a) All but the small errors whose sum is within the tolerance.
        by_error = np.argsort(self._errors, kind="stable")
        within = np.cumsum(self._errors[by_error]) <= tolerance * self.integral
        chosen = np.zeros(len(boxes), bool)
        chosen[by_error[~within]] = self._errors.sum() > tolerance * self.integral
        # (b) Dips that are not resolved.
        longest = boxes.edges().max(axis=1)
        chosen |= (longest > self._low) & (self._high > _STEEP * self._low)
        # (c) Neighbours of much smaller boxes.
        chosen |= self._too_large()
        chosen &= open_
        room = (_MOST[dim] - len(boxes)) // ((1 << dim) - 1)
        if np.count_nonzero(chosen) > room:
            worst = np.argsort(np.where(chosen, -self._errors, 1.0), kind="stable")[: max(room, 0)]
            chosen[:] = False
            chosen[worst] = True
        return chosen

    def _too_large(self) -> np.ndarray:
        """Tell which boxes are more than twice as large as a neighbour among the fresh ones."""
        boxes = self.boxes
        large = np.zeros(len(boxes), bool)
        fresh = np.flatnonzero(self._fresh & (boxes.level > boxes.level.min() + 1))
        if not fresh.size:
            return large
        step = _HALVED[boxes.level[fresh]][:, None]
        middle = boxes.corner[fresh] + 0.5 * step
        level = np.tile(boxes.level[fresh], 2 * boxes.dim)
        out = np.concatenate([s * e for s in (-1, 1) for e in np.eye(boxes.dim)[:, None, :]])
        places = (middle + step * out[:, None, :]).reshape(-1, boxes.dim)
        end = np.rint((boxes.upper - boxes.origin) / boxes.root)
        inside = ((places > 0) & (places < end)).all(axis=1)
        there = self._find(places[inside])
        large[there[boxes.level[there] < level[inside] - 1]] = True
        return large

    def _refine(self, chosen: np.ndarray) -> None:
        boxes = self.boxes
        _, _, rank = hilbert_tables(boxes.dim)
        # Which child of its box each landmark falls into.
        box = self._landmark_box
        half = _HALVED[boxes.level[box] + 1][:, None]
        bits = (self._landmarks >= boxes.corner[box] + half) @ (1 << np.arange(boxes.dim))
        child_rank = np.where(chosen[box], rank[boxes.state[box], bits], 0)
        parent, child = boxes.split(chosen)
        first = np.searchsorted(parent, np.arange(len(chosen)))
        self._landmark_box = first[box] + child_rank
        self._fresh = child >= 0
        for name in ("cells", "_errors", "_low", "_high", "slopes"):
            setattr(self, name, getattr(self, name)[parent])
        self._integrate(self._fresh)
        self._lower_by_landmarks()


def _spread(bits: np.ndarray, dim: int) -> np.ndarray:
    """Put dim - 1 zeros between the bits of `bits` (uint64, up to 31 bits in 2D, 21 in 3D)."""
    steps = {
        2: ((16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F),
            (2, 0x3333333333333333), (1, 0x5555555555555555)),
        3: ((32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)),
    }  # fmt: skip
    for shift, mask in steps[dim]:
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    return bits
