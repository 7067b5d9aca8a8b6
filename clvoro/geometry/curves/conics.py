"""Circles, arcs and ellipses."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ...arguments import check_number
from ...errors import InputError
from .arguments import check_point, cos_sin
from .curve import Curve, makes_curves
from .span import Span

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@makes_curves
def circle(center: ArrayLike, radius: float, *, name: str | None = None, tolerance: float | None = None) -> Curve:
    """Return a circle.

    Parameters
    ----------
    center : (2,) array_like
    radius : float
    name : str, optional
        Name of the boundary.
    tolerance : float, optional
        Largest distance between the curve and its polyline; by default 1e-6 of the diameter.

    Raises
    ------
    InputError, InputTypeError
        If the radius is not positive, or smaller than round-off of the center.

    Examples
    --------
    >>> clvoro.curves.circle((0.2, 0.2), 0.05).vertices.shape
    (1572, 2)
    """
    place = check_point("circle center", center)
    r = check_number("circle radius", radius, above=0)
    arguments = {"center": place, "radius": r, "name": name, "tolerance": tolerance}
    return Curve("circle", arguments, _arcs(place, (r, r), 0.0, 0.0, 360.0), closed=True)


@makes_curves
def arc(
    center: ArrayLike,
    radius: float,
    start: float,
    end: float,
    *,
    name: str | None = None,
    tolerance: float | None = None,
) -> Curve:
    """Return an arc of a circle, an open curve from `start` to `end`.

    Parameters
    ----------
    center : (2,) array_like
    radius : float
    start, end : float
        Angles in degrees from the x axis, counter-clockwise. If `end` is less than `start`, the arc runs clockwise.
    name : str, optional
        Name of the boundary.
    tolerance : float, optional
        Largest distance between the curve and its polyline; by default 1e-6 of the extent of the arc.

    Raises
    ------
    InputError, InputTypeError
        If the radius is not positive, or the arc has no length or is a whole turn or more.

    Examples
    --------
    A half-disc: a straight line joins the ends of the arc.

    >>> half = clvoro.Polygon([clvoro.curves.arc((0, 0), 1, 0, 180, name="dome")])
    >>> half.boundary_names, round(half.measure, 4)
    (('dome', 'outer'), 1.5708)
    """
    place = check_point("arc center", center)
    r = check_number("arc radius", radius, above=0)
    a, b = check_number("arc start", start), check_number("arc end", end)
    if not 0 < abs(b - a) < 360:
        raise InputError(
            f"arc goes from {a:g} to {b:g} degrees around ({place[0]:g}, {place[1]:g}), expected more than 0 and less "
            "than 360 degrees; write circle(...) for a whole turn"
        )
    arguments = {"center": place, "radius": r, "start": a, "end": b}
    arguments |= {"name": name, "tolerance": tolerance}
    return Curve("arc", arguments, _arcs(place, (r, r), 0.0, a, b), closed=False)


@makes_curves
def ellipse(
    center: ArrayLike,
    semi_axes: ArrayLike,
    angle: float = 0.0,
    start: float = 0.0,
    end: float = 360.0,
    *,
    name: str | None = None,
    tolerance: float | None = None,
) -> Curve:
    """Return an ellipse, or a part of one.

    The point of the parameter t is ``center + rotation(angle) (a cos t, b sin t)``.

    Parameters
    ----------
    center : (2,) array_like
    semi_axes : (2,) array_like
        Half the width a and half the height b before the rotation.
    angle : float
        Rotation in degrees, counter-clockwise.
    start, end : float
        Parameters t of the ends in degrees; by default the whole ellipse.
    name : str, optional
        Name of the boundary.
    tolerance : float, optional
        Largest distance between the curve and its polyline; by default 1e-6 of the extent of the curve.

    Raises
    ------
    InputError, InputTypeError
        If a semi-axis is not positive, or the ends coincide without a whole turn.

    Examples
    --------
    The elliptic nose of a plate of thickness 2:

    >>> nose = clvoro.curves.ellipse((0, 0), (3, 1), start=90, end=270)
    >>> clvoro.Polygon([(10, -1), (10, 1), nose]).lower
    (-3.0, -1.0)
    """
    place = check_point("ellipse center", center)
    axes = check_point("ellipse semi_axes", semi_axes)
    for value in axes:
        check_number("ellipse semi_axes", value, above=0)
    turn = check_number("ellipse angle", angle)
    a, b = check_number("ellipse start", start), check_number("ellipse end", end)
    if not 0 < abs(b - a) <= 360:
        raise InputError(
            f"ellipse goes from {a:g} to {b:g} degrees around ({place[0]:g}, {place[1]:g}), expected more than 0 and "
            "at most 360 degrees"
        )
    arguments = {"center": place, "semi_axes": axes, "angle": turn, "start": a, "end": b}
    arguments |= {"name": name, "tolerance": tolerance}
    spans = _arcs(place, (axes[0], axes[1]), turn, a, b)
    return Curve("ellipse", arguments, spans, closed=abs(b - a) == 360)


def _arcs(center: list[float], axes: tuple[float, float], angle: float, start: float, end: float) -> list[Span]:
    """Return the parts of an ellipse between multiples of 90 degrees, so that extreme points are vertices."""
    sign, (c, s) = (1.0 if end > start else -1.0), cos_sin(np.array(angle))
    rotation = np.array([[c, -s], [s, c]])

    def at(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cos, sin = cos_sin(start + sign * t)
        points = np.column_stack([axes[0] * cos, axes[1] * sin])
        ahead = sign * math.pi / 180 * np.column_stack([-axes[0] * sin, axes[1] * cos])
        return center + points @ rotation.T, ahead @ rotation.T

    low, high = min(start, end), max(start, end)
    inner = 90.0 * np.arange(math.floor(low / 90) + 1, math.ceil(high / 90))
    stops = np.sort(np.abs(np.concatenate([[start], inner, [end]]) - start))
    return [Span(float(a), float(b), at) for a, b in pairwise(stops)]
