"""Areas and arcs on the unit sphere."""

from __future__ import annotations

import numpy as np

_SHORT = 1e-4
"""Square of the sine of an arc below which a series replaces a difference."""


def triangle_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the areas of triangles of great circles with the corners a, b, c, unit vectors (n, 3) each: (n,).

    An area is positive if the corners are counter-clockwise as seen from outside, and smaller than 2 pi. With E the
    area, tan(E / 2) = a.(b x c) / (1 + a.b + b.c + c.a) (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983)
    125). The triple product is that of differences, so that small triangles keep their digits.
    """
    volume = (a * np.cross(b - a, c - a)).sum(axis=1)
    cosines = (a * b + b * c + c * a).sum(axis=1)
    return 2 * np.arctan2(volume, 1 + cosines)


def arc_excess(sines: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Return arc / sin(arc) - 1 for arcs with the given sines, not negative, and cosines."""
    s2 = sines**2
    series = s2 * (1 / 6 + s2 * (3 / 40 + s2 * (5 / 112)))
    direct = np.arctan2(sines, cosines) / np.where(s2 > _SHORT, sines, 1.0) - 1
    return np.where((s2 > _SHORT) | (cosines < 0), direct, series)
