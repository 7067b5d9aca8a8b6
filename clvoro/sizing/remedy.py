"""What to do about a size that is none."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..geometry.box import Domain

_MANY = 1e6
"""Cells that a size field makes at most which is nowhere under the bound that is proposed."""


def remedy_for(value: float, domain: Domain, on_device: bool, most: float = math.inf) -> str:
    """Return what may help where a size field on `domain` is `value`, which is no size.

    Parameters
    ----------
    on_device : bool
        Whether it has a device form, and is no Python function (see `Field`).
    most : float
        Largest size that there may be.
    """
    if math.isnan(value):
        by = "fmax(x, 0), say" if on_device else "numpy.where or numpy.nan_to_num, say"
        return (
            "it has to be a number everywhere: look for roots and logarithms of what may be negative, and for "
            f"0 / 0, and give a value there, by {by}"
        )
    if value > most or value == math.inf:
        return f"bound it, for instance by clvoro.sizing.minimum(field, {_round(domain.extent.max()):g})"
    least = (domain.measure / _MANY) ** (1 / domain.dim)
    return (
        f"bound it, for instance by clvoro.sizing.maximum(field, {_round(least):g}), which allows for at most "
        f"{_MANY:,.0f} cells here"
    )


def _round(length: float) -> float:
    """Return the next power of ten that is no less, but for rounding."""
    return 10.0 ** math.ceil(math.log10(length) - 1e-9)
