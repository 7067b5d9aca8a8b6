"""Points and angles that the makers of curves take."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError, InputTypeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def check_point(what: str, value: ArrayLike) -> list[float]:
    """Return two finite numbers."""
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
