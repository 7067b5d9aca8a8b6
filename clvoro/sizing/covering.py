"""How much of a domain the box of a size field covers, and what is to be said if that is little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import shapely

from ..geometry.polygon import Polygon

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..geometry.box import Domain

LEAST = 0.5
"""Share of a domain that a box covers if it is meant for that domain."""


def covered_share(domain: Domain, lower: ArrayLike, upper: ArrayLike) -> float:
    """Return the share of `domain` that lies in the box from `lower` to `upper`.

    Along an axis that the box is flat in, it is taken for as wide as all.
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    flat = low == high
    begin, end = np.array(domain.lower), np.array(domain.upper)
    if ((high < begin) | (low > end)).any():
        return 0.0
    low, high = (
        np.where(flat, begin, np.maximum(low, begin)),
        np.where(flat, end, np.minimum(high, end)),
    )
    if isinstance(domain, Polygon):
        inside = shapely.intersection(domain.geometry, shapely.box(*low, *high))
        return float(inside.area / domain.measure)
    return float(np.prod((high - low) / domain.extent))


def uncovered(
    what: str,
    domain: Domain,
    lower: Sequence[float] | np.ndarray,
    upper: Sequence[float] | np.ndarray,
    remedy: str,
) -> list[str]:
    """Return what is to be said of `what`, which knows sizes from `lower` to `upper`, if that is little of `domain`."""
    share = covered_share(domain, lower, upper)
    if share >= LEAST:
        return []
    low, high = np.asarray(lower).tolist(), np.asarray(upper).tolist()
    return [
        f"{what} covers {share:.2g} of the domain, from {low} to {high}: everywhere else the nearest size holds on. "
        f"Are units and the order of the coordinates (x, y) the same? Otherwise {remedy}"
    ]
