"""NACA 4-digit sections."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from ...arguments import check_choice, check_number
from ...errors import InputError, InputTypeError
from .arguments import check_point, cos_sin
from .curve import Curve, makes_curves
from .span import Span

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

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
