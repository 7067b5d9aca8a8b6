"""Sizes c l^(-q) from an indicator l: the common factor c for a number of cells or an error, within bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real
from typing import NamedTuple

import numpy as np

from ..errors import InputError, InputTypeError
from .arguments import check_positive

FLAT = 1e-12
"""Share of the largest derivative below which a derivative counts as 0."""
_NOTHING = "has nothing to follow: the derivatives (or the sensor, or the weight) are 0 everywhere"
_FIRST_STEP, _CLOSE = 0.1, 1e-7  # of the logarithm of a factor


def check_p(what: str, p: object) -> None:
    """Raise InputError unless `p` is the exponent of a norm."""
    if not (isinstance(p, Real) and float(p) >= 1):
        raise InputError(f"{what} p is {p!r}, expected at least 1; math.inf is allowed")


def check_one_of(what: str, n_cells: object, eps: object) -> float:
    """Return the one that is given.

    Raises `InputError` or `InputTypeError` if both or none are, or it is not positive.
    """
    if (n_cells is None) == (eps is None):
        raise InputError(f"{what} got n_cells={n_cells} and eps={eps}, expected exactly one of them")
    name = "eps" if n_cells is None else "n_cells"
    return check_positive(f"{what} {name}", eps if n_cells is None else n_cells)


def check_bounds(what: str, h_min: object, h_max: object, longest: float) -> float:
    """Return the largest size: `h_max`, at most `longest`, at least `h_min`.

    Raises `InputError` or `InputTypeError` if the bounds are not numbers in order.
    """
    for name, bound in (("h_min", h_min), ("h_max", h_max)):
        if not isinstance(bound, Real) or isinstance(bound, bool):
            raise InputTypeError(f"{what} {name} is {bound!r}, expected a number")
    if not (0 <= h_min <= h_max and h_min < math.inf and h_max > 0):  # type: ignore[operator]
        raise InputError(f"{what} got h_min={h_min} and h_max={h_max}, expected 0 <= h_min <= h_max")
    return max(float(h_min), min(float(h_max), longest))  # type: ignore[arg-type]


class Places(NamedTuple):
    """Where the values of an indicator are: the cells of a mesh, or the pixels of a raster."""

    volumes: np.ndarray
    """Volume that each value represents."""
    dim: int
    """Number of dimensions of the cells."""
    longest: float
    """The largest size."""
    limit: Callable[[np.ndarray], np.ndarray] | None = None
    """Returns sizes whose growth is limited, and which may be smoother. Larger sizes give larger ones."""


def best_sizes(
    what: str,
    indicator: np.ndarray,
    places: Places,
    *,
    order: float,
    p: float = math.inf,
    constant: float = 1.0,
    n_cells: float | None,
    eps: float | None,
    h_min: float,
    h_max: float,
) -> np.ndarray:
    """Return the sizes that make the L^p norm of the error e = constant * indicator * h^order least.

    With l the indicator, h = c l^(-p / (order p + d)), and c^d = (1 / N) integral l^(p d / (order p + d)) for N cells;
    h is then bounded, its growth limited, and c chosen again. An indicator that is 0 everywhere needs `h_max`.
    """
    wanted = check_one_of(what, n_cells, eps)
    top = check_bounds(what, h_min, h_max, places.longest)
    largest = float(indicator.max())
    if largest == 0 and eps is not None and math.isinf(h_max):
        raise InputError(f"{what} {_NOTHING}, so eps={eps:g} gives no size; give h_max")
    # l in units that neither overflow nor underflow.
    shape = indicator / largest if largest > 0 else np.zeros(indicator.shape)
    shape[shape < FLAT] = 0
    power = 1 / order if math.isinf(p) else p / (order * p + places.dim)
    with np.errstate(divide="ignore"):
        profile = shape**-power
    factor = None
    if eps is not None:
        norm = 1.0 if math.isinf(p) else float(np.sum(places.volumes * shape ** (power * places.dim))) ** (1 / p)
        factor = (wanted / (constant * largest * norm)) ** (1 / order) if largest > 0 else math.inf
    return scale_profile(what, profile, factor, n_cells, places, h_min, top)


def scale_profile(
    what: str,
    profile: np.ndarray,
    factor: float | None,
    n_cells: float | None,
    places: Places,
    h_min: float,
    top: float,
) -> np.ndarray:
    """Return factor * profile within the bounds. Without a factor, find the one that gives `n_cells`.

    - `profile`: infinite where sizes are largest.

    Raises `InputError` if no factor gives `n_cells`.
    """
    if n_cells is not None and not np.isfinite(profile).any():
        raise InputError(f"{what} {_NOTHING}, so n_cells={n_cells:g} cannot be distributed; use a number as size")

    limit = places.limit

    def sizes(factor: float) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.clip(np.where(np.isinf(profile), math.inf, factor * profile), h_min, top)

    def limited(factor: float) -> np.ndarray:
        return sizes(factor) if limit is None else np.clip(limit(sizes(factor)), h_min, top)

    if factor is not None:
        return limited(factor)

    def count(log_factor: float, of: Callable[[float], np.ndarray] = sizes) -> float:
        with np.errstate(over="ignore", divide="ignore"):
            return float(np.sum(places.volumes * of(math.exp(log_factor)) ** -places.dim))

    begin, end = math.log(top) - 600.0, math.log(top) + 1.0
    most, least = count(begin), count(end)
    if not least * (1 - 1e-9) <= n_cells <= most * (1 + 1e-9):  # type: ignore[operator]
        raise InputError(
            f"{what} n_cells is {n_cells:g}, but sizes from {h_min:g} to {top:g} give "
            f"{least:.6g} to {most:.6g} cells; change h_min, h_max or n_cells"
        )
    while begin < (middle := 0.5 * (begin + end)) < end:  # bisection: the number decreases with the factor
        begin, end = (middle, end) if count(middle) > n_cells else (begin, middle)  # type: ignore[operator]
    if limit is None:
        return sizes(math.exp(0.5 * (begin + end)))
    # Limited sizes are smaller, so that the factor is larger; smoothed ones may be larger.
    step = _FIRST_STEP
    while count(begin, limited) < n_cells:  # type: ignore[operator]
        begin, end, step = begin - step, begin, 2 * step
    while count(end, limited) > n_cells and end < math.log(top) + 1e3:  # type: ignore[operator]
        begin, end, step = end, end + step, 2 * step
    while end - begin > _CLOSE:
        middle = 0.5 * (begin + end)
        begin, end = (middle, end) if count(middle, limited) > n_cells else (begin, middle)  # type: ignore[operator]
    return limited(math.exp(end))
