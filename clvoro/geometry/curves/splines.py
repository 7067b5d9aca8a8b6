"""Cubic splines through points."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ...arguments import check_integer, check_rows, format_point
from ...errors import InputError
from .curve import Curve, makes_curves
from .span import SAMPLES, Span

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
