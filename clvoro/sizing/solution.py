"""Sizes from a solution on a raster, by its second derivatives (Hessian) or its gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, InputTypeError
from .arguments import check_positive
from .raster import Raster, check_box, fill_missing

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_FLAT = 1e-12  # share of the largest curvature below which curvature counts as 0


def hessian_size(
    values: ArrayLike,
    lower: Sequence[float],
    upper: Sequence[float],
    *,
    n_cells: float | None = None,
    eps: float | None = None,
    p: float = 2.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
    at: str = "nodes",
    missing: str = "error",
) -> Raster:
    r"""Return the size that interpolates a solution best in the L^p norm.

    Loseille and Alauzet (Continuous mesh framework, I and II, SIAM J. Numer. Anal. 49, 2011) minimize
    the L^p norm of the interpolation error of u over all metrics of complexity N,

        M = D (det |H|)^(-1 / (2 p + d)) |H|,   D = N^(2/d) (integral (det |H|)^(p / (2 p + d)))^(-2/d),

    with the Hessian H of u and |H| = its absolute value. For isotropic cells |H| is replaced by l times the identity, l
    the largest absolute eigenvalue of H, which bounds the error in all directions. Then det |H| = l^d, M = h^-2 times
    the identity, and

        h = c l^(-p / (2 p + d)),   c^d = (1 / N) integral l^(p d / (2 p + d)),

    so that the integral of h^-d is N. The larger p, the more weight have the largest errors; for p = inf,
    h = c l^(-1/2) makes the error constant.

    Parameters
    ----------
    values : (ny, nx) or (nz, ny, nx) array of real numbers
        The solution, arranged as in `Raster`.
    lower, upper : sequences of 2 or 3 floats
        The box that the array covers.
    n_cells : float, optional
        Number of cells N in the box, bounds included.
    eps : float, optional
        In place of `n_cells`: the L^p norm over the box of e = h^2 l / 8, the error of linear interpolation along an
        edge h, in the unit of u times length^(d / p). The bounds of h apply afterwards.
    p : float
        At least 1, or `math.inf`.
    h_min, h_max : float
        Bounds. Where the Hessian is 0, h is `h_max`, by default the longest side of the box.
    at, missing
        As for `Raster`.

    Returns
    -------
    Raster

    Raises
    ------
    InputError, InputTypeError
        If the array has fewer than 3 values along an axis or an argument is out of range; if no
        common factor meets `n_cells` within the bounds.

    Notes
    -----
    Second derivatives are central differences of neighboring values; on the sides, those of the next row inside. They
    magnify noise by 1 / spacing^2: smooth noisy data first.

    On a layer (bench/interpolation.py) the default p within `Graded`, with growth 1.2 to 1.4 and an `h_max` of a tenth
    of the box or more, interpolates best. p = 1 is as good in L^1. A larger p decreases the largest error and increases
    the mean.

    Examples
    --------
    About 5000 cells, small where a tanh bends and large elsewhere. Between its two bends, and
    wherever else a second derivative is zero, the formula gives large cells. `Graded`
    fills such gaps, and `n_cells` of the run restores the count::

        x, y = np.meshgrid(np.linspace(0, 1, 401), np.linspace(0, 1, 401))
        u = np.tanh(50 * (x + y - 1))
        size = Graded(hessian_size(u, (0, 0), (1, 1), n_cells=5000, h_max=0.1), growth=1.2)
        clvoro.Adapter().run(clvoro.Box((0, 0), (1, 1)), size, n_cells=5000).plot("size")
    """
    u, corners, spacing = _check_solution("hessian_size", values, lower, upper, at, missing, least=3)
    if not (isinstance(p, Real) and p >= 1):
        raise InputError(f"hessian_size p is {p!r}, expected at least 1; math.inf is allowed")
    d = u.ndim
    curvature = _curvature(u, spacing)
    largest = curvature.max()
    if largest <= 0:
        shape = np.zeros(u.shape)
    else:
        shape = curvature / largest  # l in units that neither overflow nor underflow
        shape[shape < _FLAT] = 0
    power = 0.5 if math.isinf(p) else p / (2 * p + d)
    with np.errstate(divide="ignore"):
        profile = shape**-power
    wanted = _check_one_of("hessian_size", n_cells, eps)
    if eps is not None:
        # e = c^2 l^(1 - 2 power) / 8 with c for l / largest: divided by `largest`.
        norm = 1.0
        if not math.isinf(p):
            norm = float(np.sum(shape ** (power * d) * _weights(u.shape, spacing, at)) ** (1 / p))
        factor = math.sqrt(8 * wanted / (largest * norm)) if largest > 0 else math.inf
    else:
        factor = None
    return _sizes_from_profile("hessian_size", profile, factor, n_cells, h_min, h_max, corners, spacing, at)


def gradient_size(
    values: ArrayLike,
    lower: Sequence[float],
    upper: Sequence[float],
    *,
    eps: float | None = None,
    n_cells: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
    at: str = "nodes",
    missing: str = "error",
) -> Raster:
    """Return the size over which a solution changes by a constant amount.

    ``h = eps / |grad u|``, within the bounds.

    Parameters
    ----------
    values, lower, upper, at, missing
        As for `hessian_size`; at least 2 values along each axis.
    eps : float, optional
        Change of u over a cell, in the unit of u.
    n_cells : float, optional
        In place of `eps`: number of cells in the box, bounds included.
    h_min, h_max : float
        Bounds. Where the gradient is 0, h is `h_max`, by default the longest side of the box.

    Returns
    -------
    Raster

    Raises
    ------
    InputError, InputTypeError
        As for `hessian_size`.

    Examples
    --------
    Cells over which the temperature changes by two degrees, none longer than 0.1::

        size = gradient_size(temperature, (0, 0), (2, 1), eps=2.0, h_max=0.1)
    """
    u, corners, spacing = _check_solution("gradient_size", values, lower, upper, at, missing, least=2)
    slopes = np.gradient(u, *spacing[::-1])
    steep = np.sqrt(sum(s**2 for s in slopes))
    largest = float(steep.max())
    with np.errstate(divide="ignore"):
        profile = 1 / np.where(steep < _FLAT * largest, 0, steep / (largest or 1))
    wanted = _check_one_of("gradient_size", n_cells, eps)
    factor = None
    if eps is not None:
        factor = wanted / largest if largest > 0 else math.inf
    return _sizes_from_profile("gradient_size", profile, factor, n_cells, h_min, h_max, corners, spacing, at)


def _check_solution(
    what: str, values: ArrayLike, lower: ArrayLike, upper: ArrayLike, at: str, missing: str, least: int
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the checked values, the corners and the spacing of the values along x, y (, z)."""
    shape = np.shape(values)
    low, high = check_box(what, shape, lower, upper, at)
    counts = np.array(shape[::-1])
    if counts.min(initial=least) < least:
        raise InputError(
            f"{what} values have shape {shape}, expected at least {least} along each axis; derivatives need neighbors"
        )
    spacing = (high - low) / (counts - 1 if at == "nodes" else counts)
    return fill_missing(f"{what} values", values, missing, spacing), (low, high), spacing


def _curvature(u: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Return the largest absolute eigenvalue of the Hessian, the shape of `u`."""
    d = u.ndim
    hessian = np.empty((*u.shape, d, d))
    steps = spacing[::-1]
    for a in range(d):
        second = np.diff(u, 2, axis=a) / steps[a] ** 2
        pad = [(int(k == a),) * 2 for k in range(d)]
        hessian[..., a, a] = np.pad(second, pad, mode="edge")
        for b in range(a):
            mixed = np.gradient(np.gradient(u, steps[a], axis=a), steps[b], axis=b)
            hessian[..., a, b] = hessian[..., b, a] = mixed
    return np.abs(np.linalg.eigvalsh(hessian)).max(axis=-1)


def _weights(shape: tuple[int, ...], spacing: np.ndarray, at: str) -> np.ndarray:
    """Return the volume that each value represents: half a spacing at the sides for nodes."""
    total = np.ones(shape)
    for axis, step in enumerate(spacing[::-1]):
        along = np.full(shape[axis], float(step))
        if at == "nodes":
            along[[0, -1]] *= 0.5
        total *= along.reshape([-1 if k == axis else 1 for k in range(len(shape))])
    return total


def _check_one_of(what: str, n_cells: object, eps: object) -> float:
    if (n_cells is None) == (eps is None):
        raise InputError(f"{what} got n_cells={n_cells} and eps={eps}, expected exactly one of them")
    name = "eps" if n_cells is None else "n_cells"
    return check_positive(f"{what} {name}", eps if n_cells is None else n_cells)


def _sizes_from_profile(
    what: str,
    profile: np.ndarray,
    factor: float | None,
    n_cells: float | None,
    h_min: float,
    h_max: float,
    corners: tuple[np.ndarray, np.ndarray],
    spacing: np.ndarray,
    at: str,
) -> Raster:
    """Return factor * profile within the bounds. Without a factor, find the one that gives `n_cells`."""
    for name, bound in (("h_min", h_min), ("h_max", h_max)):
        if not isinstance(bound, Real) or isinstance(bound, bool):
            raise InputTypeError(f"{what} {name} is {bound!r}, expected a number")
    if not (0 <= h_min <= h_max and h_min < math.inf and h_max > 0):
        raise InputError(f"{what} got h_min={h_min} and h_max={h_max}, expected 0 <= h_min <= h_max")
    if n_cells is not None and not np.isfinite(profile).any():
        raise InputError(
            f"{what} values have no derivatives other than 0, so n_cells={n_cells:g} cannot be "
            "distributed; use a number as size"
        )
    low, high = corners
    top = float(min(h_max, (high - low).max()) if math.isinf(h_max) else h_max)

    def sizes(factor: float) -> np.ndarray:
        with np.errstate(over="ignore", invalid="ignore"):
            return np.clip(np.where(np.isinf(profile), math.inf, factor * profile), h_min, top)

    if factor is None:
        weights = _weights(profile.shape, spacing, at)

        def count(log_factor: float) -> float:
            with np.errstate(over="ignore", divide="ignore"):
                return float(np.sum(weights * sizes(math.exp(log_factor)) ** -profile.ndim))

        begin, end = math.log(top) - 600.0, math.log(top) + 1.0
        most, least = count(begin), count(end)
        if not least * (1 - 1e-9) <= n_cells <= most * (1 + 1e-9):  # type: ignore[operator]
            raise InputError(
                f"{what} n_cells is {n_cells:g}, but sizes from {h_min:g} to {top:g} give "
                f"{least:.6g} to {most:.6g} cells; change h_min, h_max or n_cells"
            )
        for _ in range(100):  # bisection: the number decreases with the factor
            middle = 0.5 * (begin + end)
            begin, end = (middle, end) if count(middle) > n_cells else (begin, middle)  # type: ignore[operator]
        factor = math.exp(0.5 * (begin + end))
    return Raster(sizes(factor), low, high, at=at)
