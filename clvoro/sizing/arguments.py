"""Arguments of size fields, and advice where a field hardly fits its domain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, InputTypeError
from ..geometry.domain import Domain

_MAX_GROWTH = 10  # a larger value is meant as a percentage


def check_positive(what: str, value: object) -> float:
    """Return `value` as a float.

    Raises `InputError` or `InputTypeError` if it is not a positive, finite number.
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

    Raises `InputError` if both or none are given, or the value is out of range.
    """
    if (growth is None) == (slope is None):
        raise InputError(f"{what} got growth={growth} and slope={slope}, expected exactly one of them")
    if growth is not None:
        rate = check_positive(f"{what} growth", growth)
        if not 1 <= rate <= _MAX_GROWTH:
            raise InputError(
                f"{what} growth is {growth}, expected 1 to {_MAX_GROWTH}: the ratio of the sizes of neighboring "
                "cells, such as 1.2"
            )
        return math.log(rate)
    if not (isinstance(slope, Real) and 0 <= float(slope) < math.inf):
        raise InputError(f"{what} slope is {slope!r}, expected a finite number >= 0")
    return float(slope)


_MAX_CELLS = 1e6
"""Largest number of cells to which a proposed lower bound of h leads, even if h has that value everywhere."""
_LEAST_COVERED = 0.5
"""Share of the domain that the box of a field covers at least without a warning."""


def advice_for_size(value: float, domain: Domain, on_device: bool, most: float = math.inf) -> str:
    """Return how to correct a size field on `domain` that has the invalid size `value`.

    - `on_device`: whether the field runs on the device (see `Field`), or is a Python function.
    - `most`: largest valid size.
    """
    if math.isnan(value):
        by = "fmax(x, 0)" if on_device else "numpy.where or numpy.nan_to_num"
        return (
            "it has to be a number everywhere: look for roots and logarithms of negative values and for 0 / 0, and "
            f"give a value there, for instance by {by}"
        )
    if value > most or value == math.inf:
        return f"bound it, for instance by clvoro.sizing.minimum(field, {_round(domain.extent.max()):g})"
    least = (domain.measure / _MAX_CELLS) ** (1 / domain.cell_dim)
    data = "if it stands for missing data, make it NaN and give Raster missing='nearest'; else "
    missing = data if value < 0 else ""
    return (
        f"{missing}bound it, for instance by clvoro.sizing.maximum(field, {_round(least):g}), which allows for at most "
        f"{_MAX_CELLS:,.0f} cells here"
    )


def _round(length: float) -> float:
    """Return the smallest power of ten that is not smaller, up to round-off."""
    return 10.0 ** math.ceil(math.log10(length) - 1e-9)


def covered_share(domain: Domain, lower: ArrayLike, upper: ArrayLike) -> float:
    """Return the share of `domain` that lies in the box from `lower` to `upper`.

    Along an axis in which the box is flat, it counts as unbounded.
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    flat = low == high
    begin, end = np.array(domain.lower), np.array(domain.upper)
    if ((high < begin) | (low > end)).any():
        return 0.0
    low, high = (np.where(flat, begin, np.maximum(low, begin)), np.where(flat, end, np.minimum(high, end)))
    return domain.share_within(low, high)


def coverage_warnings(
    what: str, domain: Domain, lower: Sequence[float] | np.ndarray, upper: Sequence[float] | np.ndarray, remedy: str
) -> list[str]:
    """Return a warning if `what`, with values from `lower` to `upper`, covers little of `domain`; else nothing."""
    share = covered_share(domain, lower, upper)
    if share >= _LEAST_COVERED:
        return []
    low, high = np.asarray(lower).tolist(), np.asarray(upper).tolist()
    return [
        f"{what} covers {share:.2g} of the domain, from {low} to {high}; elsewhere the nearest value is used. Do units "
        f"and the order of the coordinates (x, y) agree? Otherwise {remedy}"
    ]
