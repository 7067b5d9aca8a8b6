"""NACA 4-digit wing sections from their formula."""

from __future__ import annotations

import math

import numpy as np

from ...errors import InputError

# Half thickness over thickness; the last coefficient is the one that closes the trailing edge.
_THICKNESS = (0.2969, -0.1260, -0.3516, 0.2843, -0.1036)


def naca4(
    digits: str,
    chord: float = 1.0,
    leading_edge: tuple[float, float] = (0.0, 0.0),
    angle: float = 0.0,
    n_points: int = 200,
) -> np.ndarray:
    """Return the outline of a NACA 4-digit section, counter-clockwise from its trailing edge.

    With t the thickness, m the largest camber and p its place (in chords), and x in [0, 1]::

        half thickness   y_t = 5 t (.2969 sqrt(x) - .1260 x - .3516 x^2 + .2843 x^3 - .1036 x^4)
        camber line      y_c = m / p^2 (2 p x - x^2)                      for x < p
                         y_c = m / (1 - p)^2 (1 - 2 p + 2 p x - x^2)      beyond
        outline          (x -+ y_t sin(theta), y_c +- y_t cos(theta)),   tan(theta) = dy_c/dx

    Parameters
    ----------
    digits : str
        Four digits: m in hundredths, p in tenths, t in hundredths of the chord; "2412" for example.
    chord : float
    leading_edge : (x, y)
    angle : float
        Angle of attack in degrees: nose up about the leading edge, the flow coming along +x.
    n_points : int
        Segments along each side, spaced by the cosine rule (dense at both edges).

    Returns
    -------
    (2 * n_points, 2) float
        The outline's corners, each once; the last joins the first (a closed trailing edge).

    Raises
    ------
    InputError
        For anything but four digits with a thickness, a chord that is not positive, or fewer
        than 3 segments.
    """
    if len(digits) != 4 or not (digits.isascii() and digits.isdigit()) or digits[2:] == "00":
        raise InputError(
            f'digits is {digits!r}, expected four digits with a thickness; write "2412" for example'
        )
    if not (chord > 0 and math.isfinite(chord)) or n_points < 3:
        raise InputError(
            f"chord is {chord} and n_points is {n_points}, expected a positive chord and at least "
            "3 points"
        )
    m, p, t = int(digits[0]) / 100, int(digits[1]) / 10, int(digits[2:]) / 100
    x = 0.5 * (1 - np.cos(np.linspace(0, math.pi, n_points + 1)))
    powers = np.stack([np.sqrt(x), x, x**2, x**3, x**4], axis=1)
    half = 5 * t * powers @ _THICKNESS
    half[-1] = 0.0  # the coefficients add up to zero, their floating-point sum nearly so
    camber, slope = np.zeros_like(x), np.zeros_like(x)
    if m > 0 and p > 0:
        fore = x < p
        camber = np.where(
            fore, m / p**2 * (2 * p * x - x**2), m / (1 - p) ** 2 * (1 - 2 * p + 2 * p * x - x**2)
        )
        slope = np.where(fore, 2 * m / p**2 * (p - x), 2 * m / (1 - p) ** 2 * (p - x))
    theta = np.arctan(slope)
    normal = np.stack([-np.sin(theta), np.cos(theta)], axis=1) * half[:, None]
    line = np.stack([x, camber], axis=1)
    outline = np.concatenate([(line + normal)[::-1], (line - normal)[1:-1]])
    a = math.radians(angle)
    turn = np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])
    return np.asarray(leading_edge, float) + chord * outline @ turn.T
