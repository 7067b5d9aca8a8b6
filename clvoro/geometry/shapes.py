"""Curves that distances are measured from: circles (spheres), segments, polylines and edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
import shapely

from ..errors import InputError, InputTypeError


def coordinates(what: str, values: object, ndim: int) -> np.ndarray:
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
    """A circle in 2D, a sphere in 3D.

    Parameters
    ----------
    center : (2,) or (3,) float
    radius : float
        0 for a point.

    Raises
    ------
    InputError, InputTypeError
        If a coordinate or the radius is not a finite number, or the radius is negative.
    """

    center: np.ndarray
    radius: float

    def __post_init__(self) -> None:
        name = type(self).__name__
        object.__setattr__(self, "center", coordinates(f"{name} center", self.center, 1))
        if not isinstance(self.radius, Real):
            raise InputTypeError(f"{name} radius is {self.radius!r}, expected a number")
        if not (math.isfinite(self.radius) and self.radius >= 0):
            raise InputError(f"{name} radius is {self.radius!r}, expected finite and not negative")

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, d), (m, d) and radii (m,) of the segments that the curve consists of."""
        return self.center[None], self.center[None], np.array([float(self.radius)])


class Ball(Circle):
    """A sphere in 3D, which has the parameters of a `Circle`."""


@dataclass(frozen=True, eq=False)
class Polyline:
    """An open chain of straight segments.

    Parameters
    ----------
    points : (m, 2) or (m, 3) float
        Two or more vertices.

    Raises
    ------
    InputError, InputTypeError
        If there are too few points, one is not finite, or the array has another shape.
    """

    points: np.ndarray

    def __post_init__(self) -> None:
        name = type(self).__name__
        array = coordinates(f"{name} points", self.points, 2)
        least = self._least()
        if len(array) < least:
            raise InputError(f"{name} got {len(array)} points, expected at least {least}")
        object.__setattr__(self, "points", array)

    @staticmethod
    def _least() -> int:
        return 2

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, d), (m, d) and radii (m,) of the segments that the curve consists of."""
        return self.points[:-1], self.points[1:], np.zeros(len(self.points) - 1)


class ClosedPolyline(Polyline):
    """A closed chain of straight segments. It is a curve; `clvoro.Polygon` is a domain.

    Parameters
    ----------
    points : (m, 2) or (m, 3) float
        Three or more vertices; a segment joins the last one to the first.

    Raises
    ------
    InputError, InputTypeError
        If there are too few points, one is not finite, or the array has another shape.
    """

    @staticmethod
    def _least() -> int:
        return 3

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, d), (m, d) and radii (m,) of the segments that the curve consists of."""
        return self.points, np.roll(self.points, -1, axis=0), np.zeros(len(self.points))


@dataclass(frozen=True, eq=False)
class Edges:
    """Straight segments, connected or not. `clvoro.Polygon.boundary` returns edges of a domain.

    Parameters
    ----------
    begin, end : (m, 2) or (m, 3) float

    Raises
    ------
    InputError, InputTypeError
        If there is no segment, a coordinate is not finite, or the shapes differ.
    """

    begin: np.ndarray
    end: np.ndarray

    def __post_init__(self) -> None:
        begin, end = (coordinates("Edges begin", self.begin, 2), coordinates("Edges end", self.end, 2))
        if begin.shape != end.shape or not len(begin):
            raise InputError(
                f"Edges got begins of shape {begin.shape} and ends of shape {end.shape}, expected the same, "
                "at least one"
            )
        object.__setattr__(self, "begin", begin)
        object.__setattr__(self, "end", end)

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, d), (m, d) and radii (m,) of the segments that the curve consists of."""
        return self.begin, self.end, np.zeros(len(self.begin))


@dataclass(frozen=True, eq=False)
class Segment:
    """A straight segment.

    Parameters
    ----------
    a, b : (2,) or (3,) float
        Its ends.

    Raises
    ------
    InputError, InputTypeError
        If a coordinate is not a finite number, or the ends differ in dimension.
    """

    a: np.ndarray
    b: np.ndarray

    def __post_init__(self) -> None:
        a, b = coordinates("Segment a", self.a, 1), coordinates("Segment b", self.b, 1)
        if a.shape != b.shape:
            raise InputError(f"Segment ends have {a.size} and {b.size} coordinates, expected the same number")
        object.__setattr__(self, "a", a)
        object.__setattr__(self, "b", b)

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, d), (m, d) and radii (m,) of the segments that the curve consists of."""
        return self.a[None], self.b[None], np.zeros(1)


def shapes_of(geometry: Any) -> list[Circle | Polyline]:
    """Return the points, lines and rings of a shapely geometry as shapes in 2D.

    Raises `InputError` if the geometry is empty.
    """
    if geometry.is_empty:
        raise InputError(f"the shape is {geometry!r:.40}, expected a geometry that is not empty")
    found: list[Circle | Polyline] = []
    for part in shapely.get_parts(geometry):
        if isinstance(part, shapely.Polygon):
            rings = part.exterior, *part.interiors
            found += [ClosedPolyline(shapely.get_coordinates(ring)[:-1]) for ring in rings]
        elif isinstance(part, shapely.Point):
            found.append(Circle(shapely.get_coordinates(part)[0], 0.0))
        elif isinstance(part, shapely.LineString):
            found.append(Polyline(shapely.get_coordinates(part)))
        else:
            found += shapes_of(part)
    return found
