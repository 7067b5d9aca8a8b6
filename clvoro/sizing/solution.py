"""Sizes from a solution on a raster or on the cells of a mesh, by its second derivatives (Hessian) or its gradient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, InputTypeError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .estimates import SMOOTHED, Estimate, Places, best_sizes, check_p, curvature_of, estimate, steepness
from .raster import Raster

_GROWTH = 1.2


@overload
def hessian_size(
    values: Raster,
    *,
    n_cells: float | None = None,
    eps: float | None = None,
    p: float = 2.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
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
    values: Raster | ArrayLike | Sequence[ArrayLike],
    *,
    on: Result | Diagram | None = None,
    n_cells: float | None = None,
    eps: float | None = None,
    p: float = 2.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
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
    values : Raster, or arrays of real numbers on a mesh
        The solution. On a mesh (n,), or (n, c) for a vector with c components, or a list of such arrays: several
        fields. Each is scaled so that it alone would give as many cells as the others; the largest curvature counts.
    on : Result or Diagram, optional
        The mesh on whose cells the values are, in any domain.
    n_cells : float, optional
        Number of cells N in the box of the raster, or the mesh, bounds included.
    eps : float, optional
        In place of `n_cells`: the L^p norm over the box of e = h^2 l / 8, the error of linear interpolation along an
        edge h, in the unit of u times length^(d / p). The bounds of h apply afterwards.
    p : float
        At least 1, or `math.inf`.
    h_min, h_max : float
        Bounds. Where the Hessian is 0, h is `h_max`, by default and at most the longest side of the box, or 0.8 of the
        radius of the sphere.
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
        If a raster has fewer than 3 values along an axis or an argument is out of range; if no common factor meets
        `n_cells` within the bounds; on a mesh, if there is not a row of finite numbers for each cell.

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
        solution = Raster(u, (0, 0), (1, 1))
        size = Graded(hessian_size(solution, n_cells=5000, h_max=0.1), growth=1.2)
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
    shape = {"order": 2, "p": p, "constant": 1 / 8}
    bounds = {"n_cells": n_cells, "eps": eps, "h_min": h_min, "h_max": h_max}
    if on is not None:
        bent = curvature_of(values, on, p, weight)
        return estimate("hessian_size", on, bent, smoothed=SMOOTHED, growth=growth, **shape, **bounds)
    grid = _checked("hessian_size", values, growth, weight, least=3)
    check_p("hessian_size", p)
    return grid.with_values(best_sizes("hessian_size", _curvature(grid), _pixels(grid), **shape, **bounds))


@overload
def gradient_size(
    values: Raster,
    *,
    eps: float | None = None,
    n_cells: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
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
    values: Raster | ArrayLike | Sequence[ArrayLike],
    *,
    on: Result | Diagram | None = None,
    eps: float | None = None,
    n_cells: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
    growth: float = _GROWTH,
) -> Raster | Estimate:
    """Return the size over which a solution changes by a constant amount.

    ``h = eps / |grad u|``, within the bounds.

    Parameters
    ----------
    values, on, growth
        As for `hessian_size`; of a raster at least 2 values along each axis.
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

        size = gradient_size(Raster(temperature, (0, 0), (2, 1)), eps=2.0, h_max=0.1)

    Eight cells across a flame, whose progress variable goes from 0 to 1 (or any other field, whatever its range)::

        size = gradient_size(progress, on=mesh, eps=np.ptp(progress) / 8, h_max=0.1)
    """
    bounds = {"n_cells": n_cells, "eps": eps, "h_min": h_min, "h_max": h_max}
    if on is not None:
        steep = steepness(values, on)  # type: ignore[arg-type]
        return estimate("gradient_size", on, steep, order=1, growth=growth, **bounds)
    grid = _checked("gradient_size", values, growth, None, least=2)
    steep = np.sqrt(sum(s**2 for s in np.gradient(grid.values, *grid.spacing[::-1])))
    return grid.with_values(best_sizes("gradient_size", steep, _pixels(grid), order=1, **bounds))


def _checked(what: str, values: object, growth: float, weight: object, least: int) -> Raster:
    """Return the raster `values`; raise if it is none, is too small, or has arguments that are for meshes."""
    if not isinstance(values, Raster):
        raise InputTypeError(
            f"{what} got values of type {type(values).__name__}, expected a Raster, or values in the cells of a mesh; "
            f"write {what}(Raster(values, lower, upper)), or {what}(values, on=mesh)"
        )
    if growth != _GROWTH or weight is not None:
        raise InputError(f"{what} got growth or weight for a raster; write Graded(...) around it, or give on= a mesh")
    if min(values.values.shape) < least:
        raise InputError(
            f"{what} values have shape {values.values.shape}, expected at least {least} along each axis; derivatives "
            "need neighbors"
        )
    return values


def _pixels(grid: Raster) -> Places:
    """Return the volume of each value: half a spacing at the sides for nodes."""
    total = np.ones(grid.values.shape)
    for axis, step in enumerate(grid.spacing[::-1]):
        along = np.full(total.shape[axis], float(step))
        if grid.at == "nodes":
            along[[0, -1]] *= 0.5
        total *= along.reshape([-1 if k == axis else 1 for k in range(total.ndim)])
    return Places(total, total.ndim, float((grid.upper - grid.lower).max()))


def _curvature(grid: Raster) -> np.ndarray:
    """Return the largest absolute eigenvalue of the Hessian."""
    u, d, steps = grid.values, grid.values.ndim, grid.spacing[::-1]
    hessian = np.empty((*u.shape, d, d))
    for a in range(d):
        second = np.diff(u, 2, axis=a) / steps[a] ** 2
        pad = [(int(k == a),) * 2 for k in range(d)]
        hessian[..., a, a] = np.pad(second, pad, mode="edge")
        for b in range(a):
            mixed = np.gradient(np.gradient(u, steps[a], axis=a), steps[b], axis=b)
            hessian[..., a, b] = hessian[..., b, a] = mixed
    return np.abs(np.linalg.eigvalsh(hessian)).max(axis=-1)
