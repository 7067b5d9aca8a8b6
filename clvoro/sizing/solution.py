"""Sizes from a solution on a raster or on the cells of a mesh, by its second derivatives (Hessian) or its gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .estimates import SMOOTHED, Estimate, Places, best_sizes, check_p, curvature_of, estimate, steepness
from .raster import Raster, check_box, fill_missing

_GROWTH = 1.2


@overload
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
) -> Raster: ...


@overload
def hessian_size(
    values: ArrayLike | Sequence[ArrayLike],
    *,
    on: Result | Diagram,
    n_cells: float | None = None,
    eps: float | None = None,
    p: float = 2.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
    growth: float = _GROWTH,
    weight: ArrayLike | None = None,
) -> Estimate: ...


def hessian_size(
    values: ArrayLike | Sequence[ArrayLike],
    lower: Sequence[float] | None = None,
    upper: Sequence[float] | None = None,
    *,
    on: Result | Diagram | None = None,
    n_cells: float | None = None,
    eps: float | None = None,
    p: float = 2.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
    at: str = "nodes",
    missing: str = "error",
    growth: float = _GROWTH,
    weight: ArrayLike | None = None,
) -> Raster | Estimate:
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
        The solution, arranged as in `Raster`. On a mesh (n,), or (n, c) for a vector with c components, or a list of
        such arrays: several fields. Each is scaled so that it alone would give as many cells as the others; the
        largest curvature counts.
    lower, upper : sequences of 2 or 3 floats
        The box that the array covers.
    on : Result or Diagram, optional
        In place of the box: the mesh on whose cells the values are, in any domain.
    n_cells : float, optional
        Number of cells N in the box, bounds included.
    eps : float, optional
        In place of `n_cells`: the L^p norm over the box of e = h^2 l / 8, the error of linear interpolation along an
        edge h, in the unit of u times length^(d / p). The bounds of h apply afterwards.
    p : float
        At least 1, or `math.inf`.
    h_min, h_max : float
        Bounds. Where the Hessian is 0, h is `h_max`, by default and at most the longest side of the box, or 0.8 of the
        radius of the sphere.
    at, missing
        As for `Raster`, of rasters only.
    growth : float
        On a mesh only: ratio of the sizes of neighboring cells at most. `hessian_size` also smooths the sizes over two
        rings of neighbors. Around a raster write `Graded`.
    weight : (n,) array of float, optional
        On a mesh only: factor of the curvature in each cell. For a goal such as drag it is the `steepness` of the
        adjoint velocity, with p = 1 (Loseille, Dervieux and Alauzet 2010, J. Comput. Phys. 229, 2866); `force_weight`
        is a substitute that needs no adjoint.

    Returns
    -------
    Raster or Estimate
        On a mesh an `Estimate`: sizes with the error that they lead to.

    Raises
    ------
    InputError, InputTypeError
        If the array has fewer than 3 values along an axis or an argument is out of range; if no
        common factor meets `n_cells` within the bounds; on a mesh, if there is not a row of finite numbers for each
        cell.

    Notes
    -----
    Second derivatives are central differences of neighboring values; on the sides, those of the next row inside. They
    magnify noise by 1 / spacing^2: smooth noisy data first.

    On a layer the default p within `Graded`, with growth 1.2 to 1.4 and an `h_max` of a tenth
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

    From the solution on a mesh to the next mesh:

    >>> box = clvoro.Box((0, 0), (1, 1))
    >>> mesh = clvoro.adapt(box, 0.04, "fast")
    >>> u = np.tanh(20 * (mesh.centroids.sum(axis=1) - 1))
    >>> size = clvoro.sizing.hessian_size(u, on=mesh, n_cells=800)
    >>> after = clvoro.adapt(box, size, "fast", n_cells=800)
    >>> len(after), bool(size.values.max() > 5 * size.values.min())
    (800, True)
    """
    if on is not None:
        _refuse_raster("hessian_size", lower, upper, at, missing)
        bounds = {"n_cells": n_cells, "eps": eps, "h_min": h_min, "h_max": h_max, "growth": growth}
        bent = curvature_of(values, on, p, weight)
        return estimate("hessian_size", on, bent, order=2, p=p, constant=1 / 8, smoothed=SMOOTHED, **bounds)
    grid = _Grid.of("hessian_size", values, lower, upper, at, missing, growth, weight, least=3)
    check_p("hessian_size", p)
    bounds = {"n_cells": n_cells, "eps": eps, "h_min": h_min, "h_max": h_max}
    return grid.raster(
        best_sizes("hessian_size", grid.curvature(), grid.places, order=2, p=p, constant=1 / 8, **bounds)
    )


@overload
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
) -> Raster: ...


@overload
def gradient_size(
    values: ArrayLike | Sequence[ArrayLike],
    *,
    on: Result | Diagram,
    eps: float | None = None,
    n_cells: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
    growth: float = _GROWTH,
) -> Estimate: ...


def gradient_size(
    values: ArrayLike | Sequence[ArrayLike],
    lower: Sequence[float] | None = None,
    upper: Sequence[float] | None = None,
    *,
    on: Result | Diagram | None = None,
    eps: float | None = None,
    n_cells: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
    at: str = "nodes",
    missing: str = "error",
    growth: float = _GROWTH,
) -> Raster | Estimate:
    """Return the size over which a solution changes by a constant amount.

    ``h = eps / |grad u|``, within the bounds.

    Parameters
    ----------
    values, lower, upper, on, at, missing, growth
        As for `hessian_size`; on a raster at least 2 values along each axis.
    eps : float, optional
        Change of u over a cell, in the unit of u.
    n_cells : float, optional
        In place of `eps`: number of cells in the box, bounds included.
    h_min, h_max : float
        Bounds. Where the gradient is 0, h is `h_max`, by default and at most the longest side of the box, or 0.8 of the
        radius of the sphere.

    Returns
    -------
    Raster or Estimate

    Raises
    ------
    InputError, InputTypeError
        As for `hessian_size`.

    Examples
    --------
    Cells over which the temperature changes by two degrees, none longer than 0.1::

        size = gradient_size(temperature, (0, 0), (2, 1), eps=2.0, h_max=0.1)

    Eight cells across a flame, whose progress variable goes from 0 to 1 (or any other field, whatever its range)::

        size = gradient_size(progress, on=mesh, eps=np.ptp(progress) / 8, h_max=0.1)
    """
    if on is not None:
        _refuse_raster("gradient_size", lower, upper, at, missing)
        bounds = {"h_min": h_min, "h_max": h_max, "growth": growth}
        return estimate("gradient_size", on, steepness(values, on), order=1, n_cells=n_cells, eps=eps, **bounds)
    grid = _Grid.of("gradient_size", values, lower, upper, at, missing, growth, None, least=2)
    bounds = {"n_cells": n_cells, "eps": eps, "h_min": h_min, "h_max": h_max}
    return grid.raster(best_sizes("gradient_size", grid.steepness(), grid.places, order=1, **bounds))


@dataclass(frozen=True)
class _Grid:
    """Values of a solution (ny, nx) or (nz, ny, nx), and their spacing along x, y (, z)."""

    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spacing: np.ndarray
    at: str

    @classmethod
    def of(
        cls,
        what: str,
        values: object,
        lower: Sequence[float] | None,
        upper: Sequence[float] | None,
        at: str,
        missing: str,
        growth: float,
        weight: object,
        least: int,
    ) -> _Grid:
        if lower is None or upper is None:
            raise InputError(
                f"{what} got lower={lower!r:.60} and upper={upper!r:.60}, expected the corners of the box that the "
                f"array covers, or the mesh on whose cells the values are: write {what}(values, on=mesh)"
            )
        if growth != _GROWTH or weight is not None:
            raise InputError(
                f"{what} got growth or weight for a raster; write Graded(...) around it, or give on= a mesh"
            )
        shape = np.shape(values)  # type: ignore[arg-type]
        low, high = check_box(what, shape, lower, upper, at)
        counts = np.array(shape[::-1])
        if counts.min(initial=least) < least:
            raise InputError(
                f"{what} values have shape {shape}, expected at least {least} along each axis; derivatives need "
                "neighbors"
            )
        spacing = (high - low) / (counts - 1 if at == "nodes" else counts)
        return cls(fill_missing(f"{what} values", values, missing, spacing), low, high, spacing, at)

    @property
    def places(self) -> Places:
        """The volume of each value: half a spacing at the sides for nodes."""
        total = np.ones(self.values.shape)
        for axis, step in enumerate(self.spacing[::-1]):
            along = np.full(total.shape[axis], float(step))
            if self.at == "nodes":
                along[[0, -1]] *= 0.5
            total *= along.reshape([-1 if k == axis else 1 for k in range(total.ndim)])
        return Places(total, total.ndim, float((self.high - self.low).max()))

    def raster(self, sizes: np.ndarray) -> Raster:
        """Return sizes as a field."""
        return Raster(sizes, self.low, self.high, at=self.at)

    def steepness(self) -> np.ndarray:
        """Return the length of the gradient."""
        return np.sqrt(sum(s**2 for s in np.gradient(self.values, *self.spacing[::-1])))

    def curvature(self) -> np.ndarray:
        """Return the largest absolute eigenvalue of the Hessian."""
        u, d, steps = self.values, self.values.ndim, self.spacing[::-1]
        hessian = np.empty((*u.shape, d, d))
        for a in range(d):
            second = np.diff(u, 2, axis=a) / steps[a] ** 2
            pad = [(int(k == a),) * 2 for k in range(d)]
            hessian[..., a, a] = np.pad(second, pad, mode="edge")
            for b in range(a):
                mixed = np.gradient(np.gradient(u, steps[a], axis=a), steps[b], axis=b)
                hessian[..., a, b] = hessian[..., b, a] = mixed
        return np.abs(np.linalg.eigvalsh(hessian)).max(axis=-1)


def _refuse_raster(what: str, lower: object, upper: object, at: str, missing: str) -> None:
    if lower is not None or upper is not None or at != "nodes" or missing != "error":
        raise InputError(f"{what} got on= and lower, upper, at or missing, which are for rasters; leave these out")
