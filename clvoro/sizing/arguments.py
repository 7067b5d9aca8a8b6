"""Checks of the numbers that define size fields."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from ..errors import InputError, InputTypeError

_MAX_GROWTH = 10  # a larger value is meant as a percentage


def check_positive(what: str, value: object) -> float:
    """Return `value` as a float.

    Raises
    ------
    InputError, InputTypeError
        If it is not a positive, finite number.
    """
    if not isinstance(value, Real) or isinstance(value, (bool, np.bool_)):
        raise InputTypeError(f"{what} is {value!r}, expected a positive number")
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not (number > 0 and math.isfinite(number)):
        raise InputError(f"{what} is {value!r:.60}, expected a positive, finite number")
    return number


def check_slope(what: str, growth: object, slope: object) -> float:
    """Return the slope dh/dx, which is given itself or by the growth rate per cell as ln(growth).

    Raises
    ------
    InputError
        If both or none are given, or the value is out of range.
    """
    if (growth is None) == (slope is None):
        raise InputError(f"{what} got growth={growth} and slope={slope}, expected exactly one of them")
    if growth is not None:
        rate = check_positive(f"{what} growth", growth)
        if not 1 <= rate <= _MAX_GROWTH:
            raise InputError(
                f"{what} growth is {growth}, expected 1 to {_MAX_GROWTH}: the ratio of the sizes of neighboring "
                "cells, such as 1.2; write slope= for dh/dx"
            )
        return math.log(rate)
    if not (isinstance(slope, Real) and 0 <= float(slope) < math.inf):
        raise InputError(f"{what} slope is {slope!r}, expected a finite number >= 0")
    return float(slope)
