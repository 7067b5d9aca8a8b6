"""A size field that grows with the distance to curves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, InputTypeError
from .field import Field, positive

if TYPE_CHECKING:
    from ..domain import Box
    from .bind import Binder

_FEW = 8  # up to so many items are faster looked at one by one than through a tree
_LEAF = 4  # items per leaf at most
_LANDMARKS = 1 << 14  # about so many landmarks at most, beside one per piece
_BLOCK = 1 << 20  # distances computed at once by the host


def _coordinates(what: str, values: object, ndim: int) -> np.ndarray:
    """Return `values` as a float array (d,) or (m, d) of finite numbers, d = 2 or 3."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputTypeError(f"{what} is {values!r}, expected numbers") from error
    if array.ndim != ndim or array.shape[-1] not in (2, 3):
        expected = "2 or 3 coordinates" if ndim == 1 else "shape (m, 2) or (m, 3)"
        raise InputError(f"{what} has shape {array.shape}, expected {expected}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = tuple(bad[0].tolist())
        raise InputError(f"{what}{list(index)} is {array[index]}, expected finite numbers")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Circle:
    """Circle, in 3D the sphere, of `centre` and `radius`; a radius of 0 makes it a point."""

    centre: np.ndarray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", _coordinates("Circle centre", self.centre, 1))
        if not isinstance(self.radius, Real):
            raise InputTypeError(f"Circle radius is {self.radius!r}, expected a number")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise InputError(f"Circle radius is {self.radius!r}, expected finite and not negative")

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return begins (m, d), ends (m, d) and radii (m,) of the pieces of the curve."""
        return self.centre[None], self.centre[None], np.array([float(self.radius)])


Sphere = Circle
"""The name of `Circle` in 3D."""


@dataclass(frozen=True, eq=False)
class Polyline:
    """Open chain of straight segments through `points` (m, d), m >= 2."""

    points: np.ndarray

    def __post_init__(self) -> None:
        name = type(self).__name__
        array = _coordinates(f"{name} points", self.points, 2)
        least = self._least()
        if len(array) < least:
            raise InputError(f"{name} got {len(array)} points, expected at least {least}")
        object.__setattr__(self, "points", array)

    @staticmethod
    def _least() -> int:
        return 2

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return begins (m, d), ends (m, d) and radii (m,) of the pieces of the curve."""
        return self.points[:-1], self.points[1:], np.zeros(len(self.points) - 1)


class Polygon(Polyline):
    """Closed chain of straight segments: `points` (m, d), m >= 3, the last joins the first."""

    @staticmethod
    def _least() -> int:
        return 3

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return begins (m, d), ends (m, d) and radii (m,) of the pieces of the curve."""
        return self.points, np.roll(self.points, -1, axis=0), np.zeros(len(self.points))


@dataclass(frozen=True, eq=False)
class Segment:
    """Straight segment from `a` to `b`."""

    a: np.ndarray
    b: np.ndarray

    def __post_init__(self) -> None:
        a, b = _coordinates("Segment a", self.a, 1), _coordinates("Segment b", self.b, 1)
        if a.shape != b.shape:
            raise InputError(
                f"Segment ends have {a.size} and {b.size} coordinates, expected the same number"
            )
        object.__setattr__(self, "a", a)
        object.__setattr__(self, "b", b)

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return begins (m, d), ends (m, d) and radii (m,) of the pieces of the curve."""
        return self.a[None], self.b[None], np.zeros(1)


Shape = Circle | Segment | Polyline


class Distance(Field):
    r"""Size that grows with the distance to curves: ``h = min(h_min + slope * distance, h_max)``.

    Parameters
    ----------
    shapes : shape or iterable of shapes
        `Circle`, `Segment`, `Polyline`, `Polygon`. The distance is to the curve itself, from both
        sides.
    h_min : float
        Size on the curves.
    growth : float, optional
        Geometric growth rate g >= 1, the ratio of the sizes of neighbouring cells (the paper's
        section 4: 1.3). A row of cells of sizes h_min, h_min g, h_min g^2, ... has log h growing by
        ln g over each h, so dh/dx = ln g: the slope is ln(growth).
    h_max : float, optional
        Upper bound of h.
    slope : float, optional
        dh/dx itself, in place of `growth`; 0.3 is a plain h = h_min + 0.3 * distance.

    Raises
    ------
    InputError, InputTypeError
        If a shape or number is missing, of the wrong kind, or out of range.
    """

    def __init__(
        self,
        shapes: Shape | Iterable[Shape],
        h_min: float,
        growth: float | None = None,
        h_max: float = math.inf,
        slope: float | None = None,
    ):
        self.shapes = (shapes,) if isinstance(shapes, Shape) else tuple(shapes)
        for shape in self.shapes:
            if not isinstance(shape, Shape):
                raise InputTypeError(
                    f"Distance got a shape of type {type(shape).__name__}, expected Circle, "
                    "Segment, Polyline or Polygon"
                )
        if not self.shapes:
            raise InputError("Distance got no shapes, expected at least one")
        if (growth is None) == (slope is None):
            raise InputError(
                f"Distance got growth={growth} and slope={slope}, expected exactly one of them"
            )
        if growth is not None:
            if positive("Distance growth", growth) < 1:
                raise InputError(f"Distance growth is {growth}, expected at least 1, such as 1.2")
            slope = math.log(growth)
        elif not (isinstance(slope, Real) and 0 <= slope < math.inf):
            raise InputError(f"Distance slope is {slope!r}, expected a finite number >= 0")
        self.slope = float(slope)
        self.h_min = positive("Distance h_min", h_min)
        if not (isinstance(h_max, Real) and h_max >= self.h_min):
            raise InputError(f"Distance h_max is {h_max!r}, expected at least h_min = {self.h_min}")
        self.h_max = float(h_max)

        parts = [shape.items() for shape in self.shapes]
        dims = {begin.shape[1] for begin, _, _ in parts}
        if len(dims) > 1:
            raise InputError("Distance got shapes of 2 and of 3 coordinates, expected one kind")
        self.dim = dims.pop()
        self._begin, self._end, self._radius = (np.concatenate(p) for p in zip(*parts, strict=True))

    def landmarks(self, domain: Box) -> np.ndarray:
        """Return points on the curves, 1/64 of the domain's shorter side apart or so."""
        spacing = domain.extent.min() / 64
        length = np.linalg.norm(self._end - self._begin, axis=1)
        around = 2 * np.pi * self._radius
        counts = np.maximum(np.maximum(length, around) / spacing, 1)
        if self.dim == 3:
            counts = np.maximum(counts, 4 * np.pi * (self._radius / spacing) ** 2)
        counts *= min(1.0, _LANDMARKS / counts.sum())
        counts = np.ceil(counts).astype(int)
        item = np.repeat(np.arange(len(counts)), counts)
        t = (np.arange(len(item)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[item]
        points = self._begin[item] + t[:, None] * (self._end - self._begin)[item]
        if self.dim == 2:
            offset = np.column_stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)])
        else:  # a spiral from pole to pole, in golden angles, for spheres
            z = 1 - 2 * (t + 0.5 / counts[item])
            turn = np.pi * (3 - math.sqrt(5)) * t * counts[item]
            flat = np.sqrt(1 - z**2)
            offset = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
        return np.concatenate([points + self._radius[item, None] * offset, self._end])

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, d) to the nearest curve, (n,) float64."""
        vector = self._end - self._begin
        length2 = (vector**2).sum(axis=1)
        inverse = np.divide(1.0, length2, out=np.zeros_like(length2), where=length2 > 0)
        best = np.full(len(points), math.inf)
        rows = max(1, _BLOCK // len(inverse))
        for first in range(0, len(points), rows):
            block = slice(first, first + rows)
            v = points[block, None, :] - self._begin
            t = np.clip(np.einsum("nmd,md->nm", v, vector) * inverse, 0, 1)
            v -= t[:, :, None] * vector
            away = np.abs(np.sqrt(np.einsum("nmd,nmd->nm", v, v)) - self._radius)
            best[block] = away.min(axis=1)
        return best

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return np.minimum(self.h_min + self.slope * self.distance(points), self.h_max)

    def _emit(self, binder: Binder) -> str:
        begin, end = (binder.normalise(p).astype(binder.real) for p in (self._begin, self._end))
        radius = (self._radius / binder.scale).astype(binder.real)
        law = (self.h_min / binder.scale, self.slope, self.h_max / binder.scale)
        n, rounded = len(begin), int(radius.any())
        if n <= _FEW:
            at = binder.store(*law, _pack(begin, end, radius))
            return binder.variable(f"size_distance_few(x, data + {at}, {n}, {rounded})")
        levels = max(0, math.ceil(math.log2(n / _LEAF)))
        order = _tree_order(0.5 * (begin + end), levels)
        begin, end, radius = begin[order], end[order], radius[order]
        boxes = _tree_boxes(begin, end, radius, levels)
        # Beyond this distance h is h_max whatever the curve; the margin covers rounding.
        reach = 1.01 * (law[2] - law[0]) / law[1] if law[1] > 0 else math.inf
        at = binder.store(*law, reach * reach, boxes, _pack(begin, end, radius))
        return binder.variable(f"size_distance_tree(x, data + {at}, {n}, {levels}, {rounded})")

    def __repr__(self) -> str:
        return (
            f"Distance({len(self.shapes)} shapes, h_min={self.h_min:g}, slope={self.slope:g}, "
            f"h_max={self.h_max:g})"
        )


def _pack(begin: np.ndarray, end: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the items (m, 2 d + 2) of the device: begin, vector, 1 / length^2, radius."""
    vector = end - begin
    length2 = (vector**2).sum(axis=1)
    tiny = np.finfo(length2.dtype).tiny
    inverse = np.divide(1.0, length2, out=np.zeros_like(length2), where=length2 > 4 * tiny)
    return np.column_stack([begin, vector, inverse, radius])


def _leaf_starts(n: int, level: int) -> np.ndarray:
    """Where the items of each node of a level begin, and the end: (2^level + 1,) int64."""
    return (np.arange((1 << level) + 1, dtype=np.int64) * n) >> level


def _tree_order(centre: np.ndarray, levels: int) -> np.ndarray:
    """Order the items so that each node of the tree halves its items across its longest side."""
    n = len(centre)
    order = np.arange(n)
    for level in range(levels):
        starts = _leaf_starts(n, level)
        inside = centre[order]
        extent = np.maximum.reduceat(inside, starts[:-1]) - np.minimum.reduceat(inside, starts[:-1])
        node = np.repeat(np.arange(1 << level), np.diff(starts))
        key = inside[np.arange(n), extent.argmax(axis=1)[node]]
        order = order[np.lexsort((key, node))]
    return order


def _tree_boxes(begin: np.ndarray, end: np.ndarray, radius: np.ndarray, levels: int) -> np.ndarray:
    """Return the boxes (2^(levels + 1) - 1, 2 d), lower and upper corners, in heap order."""
    # Rounding of centre -+ radius may cut a circle's box by an ulp: widen those.
    wide = (radius * (1 + 4 * np.finfo(radius.dtype).eps))[:, None]
    low, high = np.minimum(begin, end) - wide, np.maximum(begin, end) + wide
    found = []
    for level in range(levels + 1):
        starts = _leaf_starts(len(begin), level)[:-1]
        found.append(
            np.hstack([np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)])
        )
    return np.concatenate(found)
