"""Numbers that size fields are given."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from ..errors import InputError, InputTypeError

_MOST_GROWTH = 10  # more is meant as a percentage


def positive(what: str, value: object) -> float:
    """Return `value` as a float, or raise the error that `what` must be positive and finite."""
    if not isinstance(value, Real) or isinstance(value, (bool, np.bool_)):
        raise InputTypeError(f"{what} is {value!r}, expected a positive number")
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not (number > 0 and math.isfinite(number)):
        raise InputError(f"{what} is {value!r:.60}, expected a positive, finite number")
    return number


def slope_of(what: str, growth: object, slope: object) -> float:
    """Return dh/dx from exactly one of a growth rate per cell, ln(growth), and itself."""
    if (growth is None) == (slope is None):
        raise InputError(
            f"{what} got growth={growth} and slope={slope}, expected exactly one of them"
        )
    if growth is not None:
        rate = positive(f"{what} growth", growth)
        if not 1 <= rate <= _MOST_GROWTH:
            raise InputError(
                f"{what} growth is {growth}, expected 1 to {_MOST_GROWTH}: the ratio of neighboring cells, such as "
                "1.2 where each is a fifth larger; write slope= for dh/dx"
            )
        return math.log(rate)
    if not (isinstance(slope, Real) and 0 <= float(slope) < math.inf):
        raise InputError(f"{what} slope is {slope!r}, expected a finite number >= 0")
    return float(slope)
