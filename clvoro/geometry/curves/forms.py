"""Circles, arcs, ellipses, sections of wings, and splines."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy

from ...arguments import check_choice, check_integer, check_number, check_rows, format_point
from ...errors import InputError, InputTypeError
from .curve import SAMPLES, Curve, Span, check_point, cos_sin, makes_curves

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


TrailingEdge = Literal["closed", "blunt"]

# Half thickness over thickness / 5, in powers of sqrt(x): 1, 2, 4, 6, 8.
_CLOSED = (0.2969, -0.1260, -0.3516, 0.2843, -0.1036)
_BLUNT = (*_CLOSED[:4], -0.1015)


@makes_curves
def naca(
    code: str,
    chord: float = 1.0,
    leading_edge: ArrayLike = (0.0, 0.0),
    angle_of_attack: float = 0.0,
    trailing_edge: TrailingEdge = "closed",
    *,
    name: str | None = None,
    tolerance: float | None = None,
) -> Curve:
    """Return the outline of a NACA 4-digit section, counter-clockwise from its trailing edge.

    With t the thickness, m the largest camber, p its place, and x from 0 to 1, in chords (Jacobs, Ward, Pinkerton,
    NACA Report 460, 1933)::

        half thickness   y_t = 5 t (.2969 sqrt(x) - .1260 x - .3516 x^2 + .2843 x^3 - .1015 x^4)
        camber line      y_c = m / p^2 (2 p x - x^2)                      for x < p
                         y_c = m / (1 - p)^2 (1 - 2 p + 2 p x - x^2)      beyond
        outline          (x -+ y_t sin(theta), y_c +- y_t cos(theta)),   tan(theta) = dy_c/dx

    A closed trailing edge has .1036 in place of .1015.

    Parameters
    ----------
    code : str
        Four digits: m in hundredths, p in tenths, t in hundredths of the chord; "2412" for example.
    chord : float
    leading_edge : (2,) array_like
    angle_of_attack : float
        Angle in degrees between the chord and the x axis: nose up about the leading edge.
    trailing_edge : "closed" or "blunt"
        "blunt" ends in a straight edge of the thickness that the formula gives at x = 1.
    name : str, optional
        Name of the boundary.
    tolerance : float, optional
        Largest distance between the curve and its polyline; by default 1e-6 of the extent of the section.

    Raises
    ------
    InputError, InputTypeError
        If `code` is no 4-digit section with a thickness, or the chord is not positive.

    Examples
    --------
    >>> wing = clvoro.curves.naca("0012", chord=2, leading_edge=(-1, 0), angle_of_attack=5)
    >>> wing.closed, wing.vertices[0].round(4).tolist()
    (True, [0.9924, -0.1743])
    """
    if not isinstance(code, str):
        raise InputTypeError(f'naca code is {code!r:.60}, expected a string of four digits: "2412"')
    digits = len(code) == 4 and code.isascii() and code.isdigit()
    if not digits or code[2:] == "00" or (code[0] == "0") != (code[1] == "0"):
        raise InputError(
            f"naca code is {code!r:.60}, expected four digits: camber, its place, and two of the thickness; "
            '"0012" or "2412" for example'
        )
    length = check_number("naca chord", chord, above=0)
    place, turn = (check_point("naca leading_edge", leading_edge), check_number("naca angle", angle_of_attack))
    check_choice("naca trailing_edge", trailing_edge, ("closed", "blunt"))
    m, p, thickness = int(code[0]) / 100, int(code[1]) / 10, int(code[2:]) / 100
    c, s = cos_sin(np.array(-turn))
    rotation = length * np.array([[c, -s], [s, c]])
    half = np.zeros(9)
    half[[1, 2, 4, 6, 8]] = _CLOSED if trailing_edge == "closed" else _BLUNT
    half *= 5 * thickness

    def at(t: np.ndarray, fore: bool, side: int) -> tuple[np.ndarray, np.ndarray]:
        # The parameter is sqrt(x), negative on the upper side: the outline is smooth at the nose.
        root = np.abs(t)
        x, dx = t**2, 2 * t
        y = side * np.polynomial.polynomial.polyval(root, half)
        dy = np.sign(t) * side * np.polynomial.polynomial.polyval(root, np.polynomial.polynomial.polyder(half))
        dy[t == 0] = -half[1]
        q, dq, camber = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        if m > 0:
            k = 2 * m / (p if fore else 1 - p) ** 2
            q, dq = k * (p - x), -k * dx
            camber = k / 2 * ((0 if fore else 1 - 2 * p) + 2 * p * x - x**2)
        norm = np.sqrt(1 + q**2)
        normal = np.column_stack([-q, np.ones_like(q)]) / norm[:, None]
        turned = -(dq / norm**3)[:, None] * np.column_stack([np.ones_like(q), q])
        points = np.column_stack([x, camber]) + y[:, None] * normal
        ahead = np.column_stack([dx, q * dx]) + dy[:, None] * normal + y[:, None] * turned
        return place + points @ rotation.T, ahead @ rotation.T

    crest = math.sqrt(p) if m > 0 else 0.0
    spans = []
    for begin, end in ((-1.0, -crest), (-crest, 0.0), (0.0, crest), (crest, 1.0)):
        if begin < end:
            fore, side = abs(begin + end) / 2 < crest, 1 if end <= 0 else -1
            spans.append(Span(begin, end, lambda t, f=fore, s=side: at(t, f, s)))
    arguments = {
        "code": code,
        "chord": length,
        "leading_edge": place,
        "angle_of_attack": turn,
        "trailing_edge": trailing_edge,
        "name": name,
        "tolerance": tolerance,
    }
    return Curve("naca", arguments, spans, closed=True)


@makes_curves
def spline(
    points: ArrayLike,
    closed: bool = False,
    corners: Iterable[int] = (),
    *,
    name: str | None = None,
    tolerance: float | None = None,
) -> Curve:
    """Return a cubic spline through points (`scipy.interpolate.CubicSpline`).

    The parameter is the length of the polyline through the points, for which the order of accuracy of the spline is
    four (Floater, Numer. Math. 103 (2006) 1). The spline has two continuous derivatives, except in corners. A closed
    spline without corners is periodic; at other ends the third derivative is continuous in the last point but one.

    Parameters
    ----------
    points : (k, 2) array_like
    closed : bool
        Whether the curve returns to the first point, which may be repeated at the end.
    corners : sequence of int
        Numbers of points in which the curve has a corner.
    name : str, optional
        Name of the boundary.
    tolerance : float, optional
        Largest distance between the curve and its polyline; by default 1e-6 of the extent of the curve.

    Raises
    ------
    InputError, InputTypeError
        If there are less than 2 points (3 if closed), points that follow each other coincide, or a corner is not the
        number of a point.

    Examples
    --------
    A drop with its tip at the first point:

    >>> drop = [(0, 0), (1, 0.6), (1.6, 0), (1, -0.6)]
    >>> pond = clvoro.Polygon(clvoro.curves.spline(drop, closed=True, corners=[0]))
    >>> round(pond.measure, 2)
    1.31
    """
    array = check_rows("spline points", points, 2)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise InputError(f"spline points[{bad[0]}] is {array[bad[0]].tolist()}, expected finite numbers")
    if closed and len(array) > 1 and (array[0] == array[-1]).all():
        array = array[:-1]
    if len(array) < 2 + bool(closed):
        raise InputError(f"spline got {len(array)} distinct points, expected at least {2 + bool(closed)}")
    n, given = len(array), array.tolist()
    chosen = sorted({check_integer("spline corners", k, 0) for k in corners})
    if chosen and chosen[-1] >= n:
        raise InputError(f"spline corners has {chosen[-1]}, expected numbers from 0 to {n - 1}")
    if closed:
        # Begin in a corner if there is one.
        first = chosen[0] if chosen else 0
        array = np.roll(array, -first, axis=0)
        array = np.concatenate([array, array[:1]])
        stops = [0, *(k - first for k in chosen if k > first), n]
    else:
        first, stops = 0, sorted({0, *chosen, n - 1})
    steps = np.hypot(*np.diff(array, axis=0).T)
    k = int(np.argmin(steps))
    if not steps[k] > 1e-12 * np.abs(array - array[0]).max():
        raise InputError(
            f"spline points[{(k + first) % n}] and points[{(k + first + 1) % n}] coincide at "
            f"{format_point(array[k])}, expected distinct points; leave one of them out"
        )
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    periodic = bool(closed) and not chosen
    spans = [
        _spline_span(lengths[a : b + 1], array[a : b + 1], "periodic" if periodic else "not-a-knot")
        for a, b in pairwise(stops)
    ]
    arguments = {"points": given, "closed": bool(closed), "corners": chosen}
    return Curve("spline", {**arguments, "name": name, "tolerance": tolerance}, spans, bool(closed))


def _spline_span(lengths: np.ndarray, points: np.ndarray, ends: str) -> Span:
    # Imported when it is needed: this takes a fifth of the time of importing clvoro.

    curve = scipy.interpolate.CubicSpline(lengths, points, bc_type=ends)
    slope = curve.derivative()
    return Span(
        float(lengths[0]), float(lengths[-1]), lambda t: (curve(t), slope(t)), max(SAMPLES, 8 * (len(points) - 1))
    )
