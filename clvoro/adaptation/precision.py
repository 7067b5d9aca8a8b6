"""Is the precision enough for a size field? Said before a run begins.

Positions are rounded in the domain's frame: by the frame's unit times 2^-25 in single precision, half the spacing of
numbers below 1. What is asked of a cell is its size, so it is the spacing over h that tells.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..arguments import warn
from ..errors import InputError, PrecisionWarning

if TYPE_CHECKING:
    from ..geometry.box import Domain
    from ..sizing import Sizing

ADDED = 0.1
"""Mean |e| per spacing over h: generators off by up to half a spacing, at random, change the error of cells of size h
by 0.095 (0.07 in 3D) of spacing / h on average (`bench/precision.py --noise`)."""
MOST_ADDED = 1e-3
"""Mean |e| by rounding alone from which a run warns."""
COARSE = 1 / 16
"""Spacing over the least h from which a run warns: random starts have pairs of generators far nearer than h."""


def check_precision(
    sizing: Sizing, domain: Domain, points: np.ndarray, factor: float = 1.0
) -> float:
    """Refuse or warn where `sizing` times `factor` asks for cells that the device's precision does not resolve.

    Parameters
    ----------
    points : (n, d) float64
        Generators, or a sample of them on a coarser level: as dense as the cells will be, so that their mean is that
        over the cells.

    Returns
    -------
    float
        The mean over `points` of the spacing of positions over h.

    Raises
    ------
    InputError
        If at one of `points` h is less than the spacing of positions: no two generators would be apart.

    Warns
    -----
    PrecisionWarning
        If rounding adds more than `MOST_ADDED` to the mean error, or the spacing is more than `COARSE` of h somewhere.
    """
    real = sizing.real
    spacing = float(np.finfo(real).eps) / 2 * domain.frame[1]
    h = sizing(points) * factor
    remedy = "use dtype='float64', a smaller domain or larger sizes"
    if real == np.float64:
        remedy = "use a smaller domain or larger sizes"
    least = int(np.argmin(h))
    if h[least] < spacing:
        where = ", ".join(f"{c:.6g}" for c in points[least])
        raise InputError(
            f"the size field asks for cells of {h[least]:.3g} at ({where}), and positions in {real} are "
            f"{spacing:.3g} apart in this domain: generators would coincide; {remedy}"
        )
    mean = float((spacing / h).mean())
    if ADDED * mean > MOST_ADDED or spacing > COARSE * h[least]:
        warn(
            f"positions in {real} are {spacing:.3g} apart in this domain, a share of {mean:.2g} of the cells' "
            f"sizes on average ({spacing / h[least]:.2g} of the least): that alone makes a mean error of "
            f"{ADDED * mean:.2g}, and generators may come to coincide; {remedy}",
            PrecisionWarning,
        )
    return mean
