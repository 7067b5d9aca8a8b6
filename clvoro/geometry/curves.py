"""Curves for the boundaries of 2D domains: circles, arcs, ellipses, NACA sections and splines.

A curve takes the place of a ring of a `clvoro.Polygon`, or of some vertices within a ring. The device sees a polyline
whose vertices lie on the curve. The domain keeps the curve itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, ParamSpec

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..arguments import check_choice, check_integer, check_number, check_rows, format_point
from ..errors import InputError, InputTypeError
from .boundary_names import check_word
from .domain import LARGEST_EDGE


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles from vectors `a` to `b`, (n, 2) each, -pi to pi."""
    return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))


LARGEST_TURN = math.radians(2)
"""Largest turn of a smooth curve from one edge of its polyline to the next."""
SAMPLES = 64
"""Least number of equal intervals of the parameter over which the turns of a span are measured."""
_MOST_SAMPLES = 1 << 16
_SAMPLE_TURN = 0.1  # radians between samples, at most, up to `_MOST_SAMPLES`
_MOST_EDGES = 1 << 20  # of one span
_SLACK = 1.04  # an edge is divided if its sagitta exceeds the tolerance by this factor
_ROUNDS = 50


@dataclass(frozen=True)
class Span:
    """A smooth part of a curve, for parameters from `begin` to `end`."""

    begin: float
    end: float
    at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Takes parameters (n,) and returns points (n, 2) and derivatives (n, 2) by the parameter."""
    samples: int = SAMPLES
    """Number of equal intervals of the parameter over which turns are measured at first."""

    def nearest(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the parameters (n,) from `lower` to `upper`, (n,) each, of the nearest points to `points` (n, 2).

        Gauss-Newton iteration. It converges for points whose distance is less than the radius of curvature, and
        reaches round-off in a few steps beside the curve.
        """
        begin, end = self.at(lower)[0], self.at(upper)[0]
        along = end - begin
        share = ((points - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        t = lower + np.clip(share, 0, 1) * (upper - lower)
        for _ in range(_ROUNDS):
            at, ahead = self.at(t)
            step = ((points - at) * ahead).sum(axis=1) / (ahead**2).sum(axis=1)
            new = np.clip(t + step, lower, upper)
            done = np.abs(new - t) <= 4 * np.finfo(float).eps * np.maximum(np.abs(t), upper - lower)
            t = new
            if done.all():
                break
        return t

    def resolve(self, tolerance: float) -> np.ndarray:
        """Return parameters (k + 1,), from `begin` to `end`, of a polyline with equal sagittas below `tolerance`."""
        m = self.samples
        while True:
            t = np.linspace(self.begin, self.end, m + 1)
            points, ahead = self.at(t)
            turns = np.abs(angles(ahead[:-1], ahead[1:]))
            if turns.max() <= _SAMPLE_TURN or m >= _MOST_SAMPLES:
                break
            m *= 2
        lengths = np.hypot(*np.diff(points, axis=0).T)
        # An arc of n edges that turns by a over the length s has the sagitta a s / (8 n^2).
        counts = np.maximum(np.sqrt(turns * lengths / (8 * tolerance)), turns / LARGEST_TURN)
        total = counts.sum()
        if total > _MOST_EDGES:
            raise InputError(
                f"the curve needs {total:.3g} edges for a tolerance of {tolerance:g}, expected at most {_MOST_EDGES}; "
                "give a larger tolerance"
            )
        n = max(1, math.ceil(total - 1e-9))
        reached = np.concatenate([[0.0], np.cumsum(counts)])
        found = np.interp(np.linspace(0, reached[-1], n + 1), reached, t) if total > 0 else t[:1]
        found = np.append(found[:n], self.end)
        found[0] = self.begin
        # Beside inflections curvature changes within an edge.
        wide = np.flatnonzero(self._sagittas(found) > _SLACK * tolerance)
        return np.sort(np.concatenate([found, (found[wide] + found[wide + 1]) / 2]))

    def _sagittas(self, t: np.ndarray) -> np.ndarray:
        """Return the largest distance of the curve from each edge between the parameters `t` (k + 1,), (k,)."""
        ends = self.at(t)[0]
        along = np.diff(ends, axis=0)
        along /= np.maximum(np.hypot(*along.T), 1e-300)[:, None]
        away = []
        for share in (0.25, 0.5, 0.75):
            off = self.at(t[:-1] + share * np.diff(t))[0] - ends[:-1]
            away.append(np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]))
        return np.max(away, axis=0)


def check_point(what: str, value: ArrayLike) -> list[float]:
    """Return `value` as two finite numbers, (2,) float; errors call it `what`."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputTypeError(f"{what} is {value!r:.60}, expected two numbers") from error
    if array.shape != (2,) or not np.isfinite(array).all():
        raise InputError(f"{what} is {value!r:.60}, expected two finite numbers")
    return [float(c) for c in array]


def cos_sin(degrees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine, exact at multiples of 90 degrees."""
    quarter = np.rint(degrees / 90)
    rest = np.radians(degrees - 90 * quarter)
    c, s, q = np.cos(rest), np.sin(rest), quarter.astype(np.int64) % 4
    return np.choose(q, [c, -s, -c, s]), np.choose(q, [s, c, -s, -c])


_P = ParamSpec("_P")

TOLERANCE = 1e-6
"""Default distance between curve and polyline, as a share of the curve's extent: 1572 edges on a circle."""
CLOSE = 1e-9
"""Ends of curves and points that are this close, as a share of the ring's extent, are one vertex."""
MAKERS: dict[str, Callable[..., Curve]] = {}
"""The functions that make curves, by their names: the kinds of curves."""
_DIGITS = 2.0**-40  # smallest extent, as a share of the largest coordinate
_ROUNDINGS = 16  # least tolerance, in units of round-off of the largest coordinate


class Curve:
    """A curve in the plane, for the boundary of a `clvoro.Polygon`; also a shape for `clvoro.sizing.Distance`.

    `circle`, `arc`, `ellipse`, `naca` and `spline` make curves. Curves with equal arguments are equal.

    Attributes
    ----------
    kind : str
        The function that made the curve: "circle", "arc", ...
    arguments : dict
        Its arguments, as numbers, strings and lists.
    closed : bool
        Whether the curve is a whole ring.
    name : str or None
        Name of the boundary.
    tolerance : float
        Largest distance between the curve and its polyline.
    spans : tuple
        The smooth parts of the curve, one after the other.

    Examples
    --------
    >>> walls = [(0, 0), (2.2, 0), (2.2, 0.41), (0, 0.41)]
    >>> cylinder = clvoro.curves.circle((0.2, 0.2), 0.05, name="cylinder")
    >>> channel = clvoro.Polygon(walls, [cylinder])
    >>> channel.boundary_names, round(channel.measure - 2.2 * 0.41 + np.pi * 0.05**2, 7)
    (('outer', 'cylinder'), 0.0)
    """

    def __init__(self, kind: str, arguments: Mapping[str, Any], spans: Iterable[Span], closed: bool):
        self.kind, self.spans, self.closed = kind, tuple(spans), closed
        self.arguments = {key: value for key, value in arguments.items() if value is not None}
        name = self.name = arguments.get("name")
        if name is not None:
            check_word(f"{kind} name is", name)
        points = np.concatenate([s.at(np.linspace(s.begin, s.end, s.samples + 1))[0] for s in self.spans])
        self.extent = float(np.ptp(points, axis=0).max())
        far = float(np.abs(points).max())
        if not np.isfinite(points).all() or self.extent < _DIGITS * far:
            raise InputError(
                f"{kind} has an extent of {self.extent:g} at {format_point(points[0])}, expected more "
                "than round-off; make it larger, or move it to the origin"
            )
        if not 1 / LARGEST_EDGE <= self.extent <= LARGEST_EDGE:
            raise InputError(
                f"{kind} has an extent of {self.extent:g}, expected {1 / LARGEST_EDGE:g} to {LARGEST_EDGE:g}; choose "
                "another unit of length"
            )
        given = arguments.get("tolerance")
        least = _ROUNDINGS * float(np.finfo(float).eps) * far
        if given is not None and check_number(f"{kind} tolerance", given, above=0) < least:
            raise InputError(
                f"{kind} tolerance is {given:g}, expected at least {least:.2g}: round-off of its coordinates"
            )
        self.tolerance = max(TOLERANCE * self.extent, least) if given is None else float(given)
        if given is not None:
            self.arguments["tolerance"] = self.tolerance

    @cached_property
    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters at both ends of each edge of the polyline, (k, 2), and the span of each edge, (k,)."""
        found = [span.resolve(self.tolerance) for span in self.spans]
        ends = [np.column_stack([t[:-1], t[1:]]) for t in found]
        return np.concatenate(ends), np.repeat(np.arange(len(found)), [len(e) for e in ends])

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices of the polyline, (k, 2); those of a closed curve without a closing vertex."""
        ends, span = self.nodes
        points = np.concatenate(
            [s.at(ends[span == i, 0])[0] for i, s in enumerate(self.spans)] + [self.spans[-1].at(ends[-1:, 1])[0]]
        )
        if self.closed and np.hypot(*(points[-1] - points[0])) <= CLOSE * self.extent:
            points = points[:-1]
        points.setflags(write=False)
        return points

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, 2), (m, 2) and radii (m,) of the segments of the polyline, for `sizing.Distance`."""
        begin, end = self.vertices, np.roll(self.vertices, -1, axis=0)
        if not self.closed:
            begin, end = begin[:-1], end[:-1]
        return begin, end, np.zeros(len(begin))

    def describe(self) -> dict[str, Any]:
        """Return plain values from which `described` makes an equal curve."""
        return {"kind": self.kind, **self.arguments}

    @staticmethod
    def described(values: Mapping[str, Any]) -> Curve:
        """Return the curve from the values that `describe` returns.

        Raises
        ------
        InputError, InputTypeError
            If the values do not describe a curve.
        """
        rest = {key: value for key, value in values.items() if key != "kind"}
        kind = values.get("kind")
        if not isinstance(kind, str) or kind not in MAKERS:
            raise InputError(f"curve has the kind {kind!r:.60}, expected one of {', '.join(MAKERS)}")
        try:
            made = MAKERS[kind](**rest)
        except TypeError as error:
            raise InputTypeError(f"the description of a {kind} is damaged ({error})") from error
        return made

    def __eq__(self, other: object) -> bool:
        return self.describe() == other.describe() if isinstance(other, Curve) else NotImplemented

    def __hash__(self) -> int:
        return hash(repr(self.describe()))

    def __repr__(self) -> str:
        shown = {
            key: f"<{len(value)} points>" if key == "points" else repr(value) for key, value in self.arguments.items()
        }
        return f"{self.kind}({', '.join(f'{key}={value}' for key, value in shown.items())})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Curve.described, (self.describe(),)


def makes_curves(function: Callable[_P, Curve]) -> Callable[_P, Curve]:
    """Decorate a function that makes curves, so that `Curve.described` finds it by its name."""
    MAKERS[function.__name__] = function
    return function


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
