"""Estimates: sizes on the cells of a mesh, with the error that they lead to; how they are combined and normalized."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any, Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..arguments import check_cell_values
from ..errors import InputError, InputTypeError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .arguments import check_positive, check_slope
from .cells import OnCells
from .derivatives import CellStencils, derivatives

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


LARGEST = 0.8
"""Largest size of an estimate, and of cells on a coarse level, over the largest one that a domain allows: a run may
still make all sizes a little larger to meet a number of cells."""
SMOOTHED = 2
"""Number of passes that smooth sizes from second derivatives. These are noisy, and 0 in the middle of a layer."""


class Estimate(OnCells):
    """Sizes on the cells of a mesh, a size field, with the error that they lead to.

    The field has these sizes at the generators, not at the centroids. In a graded mesh a generator is on the finer side
    of its cell, and the size at the generator becomes that of the cell.

    Attributes
    ----------
    mesh : Diagram
        The mesh of the solution.
    values : (n,) float64
        Size h in each of its cells, in the unit of the coordinates.
    error : (n,) float64
        Error that a cell of this size has there; for its unit see the function that made the estimate.
    order : float
        The error is proportional to h^order.
    p : float
        Exponent of the norm that is small for a number of cells.
    """

    def __init__(self, mesh: Result | Diagram, values: ArrayLike, error: ArrayLike, order: float = 2.0, p: float = 2.0):
        super().__init__(mesh, values)
        self.error = check_cell_values("Estimate error", error, len(self.values))
        self.order, self.p = order, p

    @property
    def _places(self) -> np.ndarray:
        """The generators: a run evaluates sizes there."""
        return self.mesh.points

    @property
    def norm(self) -> float:
        """The L^p norm of the error over the domain; the largest error for p = inf."""
        most = float(self.error.max(initial=0.0))
        if math.isinf(self.p) or most == 0:
            return most
        return most * float(np.sum(self.mesh.volumes * (self.error / most) ** self.p)) ** (1 / self.p)

    @property
    def n_cells(self) -> float:
        """Number of cells of these sizes, the integral of h^-d."""
        return float(np.sum(self.mesh.volumes * self.values**-self.mesh.domain.cell_dim))

    def with_sizes(self, values: np.ndarray) -> Estimate:
        """Return the estimate for other sizes (n,)."""
        return Estimate(self.mesh, values, self.error * (values / self.values) ** self.order, self.order, self.p)

    def __repr__(self) -> str:
        low, high = self.values.min(), self.values.max()
        return (
            f"Estimate({self.n_cells:,.0f} cells, h {low:.3g} to {high:.3g}, error {self.norm:.3g}; "
            f"from {len(self.values)} cells in {self.mesh.domain})"
        )


def curvature_of(values: object, on: Result | Diagram, p: float, weight: ArrayLike | None) -> np.ndarray:
    """Return the largest absolute eigenvalue of the Hessian in each cell, (n,), of one or several fields.

    Several are scaled so that for each the integral of l^(p d / (2 p + d)) is 1.
    """
    check_p("hessian_size", p)
    stencils = CellStencils.of(on)
    d = stencils.mesh.domain.cell_dim
    power = d / 2 if math.isinf(p) else p * d / (2 * p + d)
    fields, found = _fields(values, len(stencils)), []
    for field in fields:
        spectral = np.abs(np.linalg.eigvalsh(derivatives(field, stencils.mesh)[1])).max(axis=-1)
        found.append(_free_of_rounding(_lengths(spectral.reshape(len(field), -1)), field, stencils, 2))
    if len(fields) > 1:
        found = [_scaled(curvature, stencils.mesh.volumes, power) for curvature in found]
    most = np.maximum.reduce(found)
    if weight is None:
        return most
    return most * _not_negative("hessian_size weight", weight, len(stencils))


def steepness(values: ArrayLike | Sequence[ArrayLike], on: Result | Diagram) -> np.ndarray:
    """Return the length of the gradient in each cell, (n,) float64, of one or several fields.

    Several are scaled to the same mean; the largest counts. Of adjoint velocities it is the weight of a cell for the
    goals of these adjoints::

        weight = steepness([adjoint_of_drag, adjoint_of_lift], on=mesh)
        size = hessian_size(velocity, on=mesh, n_cells=6000, p=1, weight=weight)

    Parameters
    ----------
    values : (n,) or (n, k) array of float, or a sequence of them
    on : Result or Diagram

    Raises
    ------
    InputError, InputTypeError
        As for `derivatives`.
    """
    stencils = CellStencils.of(on)
    found = []
    for field in _fields(values, len(stencils)):
        gradients = derivatives(field, stencils.mesh)[0]
        steep = _lengths(gradients.reshape(len(field), -1))
        found.append(_free_of_rounding(steep, field, stencils, 1))
    if len(found) > 1:
        found = [_scaled(steep, stencils.mesh.volumes, 1.0) for steep in found]
    return np.maximum.reduce(found)


def force_weight(
    boundaries: str | Sequence[str], on: Result | Diagram, *, length: float | None = None, power: float = 2.0
) -> np.ndarray:
    """Return the weight of cells for the forces on boundaries, ``(1 + distance / length)**-power``, (n,) float64.

    It is a substitute for an adjoint solution, for `hessian_size` with p = 1. The gradient of the adjoint velocity of
    drag and lift decays with the distance from the body. The defaults are chosen on one flow, a cylinder in a channel
    at Reynolds number 20. Unlike the adjoint it does not know which cells are upstream, nor that other walls count.

    Parameters
    ----------
    boundaries : str or sequence of str
        Names of the domain's boundaries: those of the body.
    on : Result or Diagram
    length : float, optional
        By default 0.3 of the largest extent of these boundaries along an axis.
    power : float

    Raises
    ------
    InputError
        If the domain has no boundary of that name, or a number is not positive.
    """
    mesh = CellStencils.of(on).mesh
    wanted = (boundaries,) if isinstance(boundaries, str) else tuple(boundaries)
    known = list(mesh.domain.boundary_names)
    missing = [name for name in wanted if name not in known]
    if missing or not wanted:
        raise InputError(f"force_weight got boundaries {boundaries!r}, expected some of {', '.join(known) or 'none'}")
    faces = mesh.faces
    rows = np.isin(faces.boundary, [known.index(name) for name in wanted])
    if not rows.any():
        raise InputError(f"force_weight got boundaries {boundaries!r}, which have no faces here, expected others")
    corners = faces.points[faces.corners[np.repeat(rows, np.diff(faces.starts))]]
    scale = 0.3 * float(np.ptp(corners, axis=0).max()) if length is None else length
    check_positive("force_weight length", scale)
    check_positive("force_weight power", power)
    return (1 + scipy.spatial.KDTree(faces.center[rows]).query(mesh.centroids)[0] / scale) ** -power


def _fields(values: object, n: int) -> list[np.ndarray]:
    """Return the fields in `values`: an array is one, a list or tuple of arrays are several."""
    several = isinstance(values, list | tuple) and len(values) > 0 and all(np.ndim(v) > 0 for v in values)
    given: Sequence[object] = values if several else [values]  # type: ignore[assignment]
    names = [f"values[{k}]" for k in range(len(given))] if several else ["values"]
    return [check_cell_values(name, field, n) for name, field in zip(names, given, strict=True)]


def _not_negative(what: str, values: object, n: int) -> np.ndarray:
    """Return `values` as an array (n,) of numbers >= 0; raise InputError if it has others."""
    array = check_cell_values(what, values, n)
    if array.ndim != 1 or array.min() < 0:
        raise InputError(
            f"{what} has shape {array.shape} and values down to {array.min():g}, expected ({n},) numbers >= 0; take "
            "the absolute value, or numpy.maximum(values, 0)"
        )
    return array


def _lengths(rows: np.ndarray) -> np.ndarray:
    """Return the lengths of `rows` (n, k), which may be so large or so small that their squares are not finite or 0."""
    unit = np.ldexp(1.0, np.frexp(np.abs(rows).max(initial=0.0))[1])
    return unit * np.sqrt(((rows / unit) ** 2).sum(axis=1))


def _free_of_rounding(found: np.ndarray, field: np.ndarray, stencils: CellStencils, order: int) -> np.ndarray:
    """Return derivatives, 0 where they are round-off of the field's values."""
    n = len(field)
    lengths = np.full(n, np.inf)
    np.minimum.at(lengths, stencils.owners, stencils.lengths)
    noise = 64 * np.finfo(float).eps * np.abs(field).max()
    with np.errstate(invalid="ignore"):  # 0 times infinity in a cell without neighbors
        return np.where(found * lengths**order > noise, found, 0.0)


def _scaled(found: np.ndarray, volumes: np.ndarray, power: float) -> np.ndarray:
    """Return `found` over its mean of this power; as it is if it is 0."""
    most = float(found.max())
    if most == 0:
        return found
    mean = float(np.sum(volumes * (found / most) ** power)) / float(volumes.sum())
    return found / (most * mean ** (1 / power))


def estimate(
    what: str,
    on: Result | Diagram,
    indicator: np.ndarray,
    *,
    order: float,
    p: float = math.inf,
    constant: float = 1.0,
    growth: float,
    smoothed: int = 0,
    **bounds: Any,
) -> Estimate:
    """Return the sizes for which the error constant * indicator * h^order is least in L^p, with that error.

    The sizes are those of `best_sizes`, which also takes the `bounds`: `n_cells`, `eps`, `h_min` and `h_max`. They are
    smoothed in `smoothed` passes after their growth is limited, so that a peak of the indicator stays narrow. What is
    promised holds afterwards: growth is limited again, and sizes are scaled where the error exceeds `eps`. Before, gaps
    of the indicator less than two cells wide, which a mesh cannot follow, are filled up to a half of what is around.
    """
    slope = check_slope(what, growth, None)
    stencils = CellStencils.of(on)
    places = _places(stencils, slope, smoothed)
    around = stencils.bounds(stencils.bounds(indicator)[1])[0] if smoothed else indicator
    filled = np.maximum(indicator, around / 2)
    sizes = best_sizes(what, filled, places, order=order, p=p, constant=constant, **bounds)
    made = Estimate(stencils.mesh, sizes, constant * indicator * sizes**order, order, p)
    eps = bounds["eps"]
    if eps is None or made.norm <= eps * (1 + 1e-9):
        return made
    return made.with_sizes(np.maximum(sizes * (eps / made.norm) ** (1 / order), bounds["h_min"]))


def _places(stencils: CellStencils, slope: float, smoothed: int = 0) -> Places:
    domain = stencils.mesh.domain

    def limit(sizes: np.ndarray) -> np.ndarray:
        limited = stencils.limit_growth(sizes, slope)
        return stencils.limit_growth(stencils.smooth(limited, smoothed), slope) if smoothed else limited

    longest = min(float(domain.extent.max()), LARGEST * domain.largest_size)
    return Places(stencils.mesh.volumes, domain.cell_dim, longest, limit)


def sensor_size(
    sensor: ArrayLike,
    *,
    on: Result | Diagram,
    eps: float | None = None,
    n_cells: float | None = None,
    order: float = 1.0,
    h_min: float = 0.0,
    h_max: float = math.inf,
    growth: float = 1.2,
) -> Estimate:
    """Return the size by which ``sensor * h**order`` is the same in all cells: any feature of a flow, or a model's own.

    Parameters
    ----------
    sensor : (n,) array of float
        At least 0 in each cell: `vorticity`, `q_criterion`, `shock_sensor`, or an indicator of your own.
    on, n_cells, h_min, h_max, growth
        As for `hessian_size`.
    eps : float, optional
        In place of `n_cells`: the value of ``sensor * h**order``, the error of the estimate.
    order : float
        Power of h.

    Returns
    -------
    Estimate

    Raises
    ------
    InputError, InputTypeError
        As for `hessian_size`; if the sensor is negative.

    Examples
    --------
    Of the kinetic energy of turbulence, k_model is modeled with cells of size h0, and proportional to h^(2/3) in the
    inertial range. At least 80 % shall be resolved::

        share = k_model / (k_model + k_resolved)
        size = sensor_size(share / h0 ** (2 / 3), on=mesh, order=2 / 3, eps=0.2)
    """
    stencils = CellStencils.of(on)
    given = _not_negative("sensor", sensor, len(stencils))
    check_positive("sensor_size order", order)
    bounds = {"h_min": h_min, "h_max": h_max, "growth": growth}
    return estimate("sensor_size", on, given, order=order, n_cells=n_cells, eps=eps, **bounds)


def combine(*estimates: Estimate, by: Literal["max", "mean"] = "max") -> Estimate:
    """Return one estimate of several: of different features, or of several times.

    The running maximum over a window of time, ``combine(window, latest)``, keeps vortex streets and moving shocks
    inside of fine cells until the mesh is adapted again.

    Parameters
    ----------
    *estimates : Estimate
        Also of different meshes: all are evaluated on the mesh of the last one.
    by : "max" or "mean"
        Whether the smallest size counts in each cell, or the mean density of cells, h^-d.

    Returns
    -------
    Estimate
        The error is the largest, or the mean, of those predicted. It has a meaning if they have one unit. Its order is
        the least of theirs, its `p` the largest.

    Raises
    ------
    InputError
        If there is no estimate, or `by` is something else.
    """
    if not estimates or not all(isinstance(e, Estimate) for e in estimates):
        raise InputError(f"combine got {estimates!r:.60}, expected estimates; combine other fields by sizing.minimum")
    if by not in ("max", "mean"):
        raise InputError(f"combine got by={by!r}, expected 'max' or 'mean'")
    last = estimates[-1]
    d, x = last.mesh.domain.cell_dim, last._places
    sizes = [e.values if e.mesh is last.mesh else e(x) for e in estimates]
    errors = [e.error if e.mesh is last.mesh else OnCells(e.mesh, e.error)(x) for e in estimates]
    h = np.minimum.reduce(sizes) if by == "max" else np.mean([s**-d for s in sizes], axis=0) ** (-1 / d)
    scaled = [error * (h / s) ** e.order for e, s, error in zip(estimates, sizes, errors, strict=True)]
    error = np.maximum.reduce(scaled) if by == "max" else np.mean(scaled, axis=0)
    return Estimate(last.mesh, h, error, min(e.order for e in estimates), max(e.p for e in estimates))


def normalize(
    estimate: Estimate,
    *,
    n_cells: float | None = None,
    eps: float | None = None,
    h_min: float = 0.0,
    h_max: float = math.inf,
    growth: float = 1.2,
) -> Estimate:
    """Return an estimate times the factor for which it has a number of cells or an error.

    Parameters
    ----------
    estimate : Estimate
    n_cells : float, optional
        Number of cells, bounds and growth included.
    eps : float, optional
        In place of `n_cells`: the norm of the error (`Estimate.norm`), before bounds and growth.
    h_min, h_max, growth
        As for `hessian_size`.

    Returns
    -------
    Estimate

    Raises
    ------
    InputError, InputTypeError
        As for `hessian_size`.
    """
    wanted = check_one_of("normalize", n_cells, eps)
    slope = check_slope("normalize", growth, None)
    places = _places(CellStencils.of(estimate.mesh), slope)
    top = check_bounds("normalize", h_min, h_max, places.longest)
    factor = None
    if eps is not None:
        if estimate.norm == 0:
            raise InputError(f"normalize got eps={eps} for an estimate that is 0 everywhere; give n_cells")
        factor = (wanted / estimate.norm) ** (1 / estimate.order)
    unit = 1.0 if factor is not None else float(estimate.values.min())
    profile = estimate.values / unit
    sizes = scale_profile("normalize", profile, factor, n_cells, places, h_min, top)
    return estimate.with_sizes(sizes)


# Sensors: features of a flow.


def vorticity(velocity: ArrayLike, on: Result | Diagram) -> np.ndarray:
    """Return the size of the curl of `velocity` (n, d) in each cell, (n,) float64."""
    skew = _skew(_velocity_gradients("vorticity", velocity, on))
    return np.sqrt(2 * (skew**2).sum(axis=(1, 2)))


def q_criterion(velocity: ArrayLike, on: Result | Diagram) -> np.ndarray:
    """Return where rotation exceeds strain, max(0, (|W|^2 - |S|^2) / 2) of `velocity` (n, d), (n,) float64.

    S and W are the symmetric and the skew part of its gradient (Hunt, Wray and Moin 1988).
    """
    gradients = _velocity_gradients("q_criterion", velocity, on)
    skew = _skew(gradients)
    strain = gradients - skew
    return np.maximum(0, ((skew**2).sum(axis=(1, 2)) - (strain**2).sum(axis=(1, 2))) / 2)


def shock_sensor(velocity: ArrayLike, pressure: ArrayLike, on: Result | Diagram) -> np.ndarray:
    """Return |grad p| / p times the share of compression, s^2 / (s^2 + w^2), in each cell, (n,) float64.

    s = max(0, -div u) is the rate of compression, w the vorticity (Ducros et al. 1999, J. Comput. Phys. 152, 517). It
    is large in shocks and small in vortices and in expansions. With `sensor_size`, `eps` is the relative jump of the
    pressure over a cell.
    """
    gradients = _velocity_gradients("shock_sensor", velocity, on)
    p = check_cell_values("shock_sensor pressure", pressure, len(gradients))
    if p.ndim != 1 or p.min() <= 0:
        raise InputError(f"shock_sensor pressure has shape {p.shape}, expected ({len(p)},) positive numbers")
    pressing = np.maximum(0, -np.trace(gradients, axis1=1, axis2=2)) ** 2
    turning = 2 * (_skew(gradients) ** 2).sum(axis=(1, 2))
    share = pressing / np.maximum(pressing + turning, 1e-300)
    return share * np.linalg.norm(derivatives(p, on)[0], axis=1) / p


def interface_distance(level: ArrayLike, on: Result | Diagram) -> np.ndarray:
    """Return the distance of each cell from the interface where `level` (n,) changes its sign, (n,) float64.

    Along the graph of the cells, which is up to 15 % longer than the straight line. ``OnCells(mesh, h_min + slope *
    distance)`` is a size field around it; subtract .5 from a fraction of volume.

    Raises
    ------
    InputError
        If the sign is the same everywhere.
    """
    stencils = CellStencils.of(on)
    u = check_cell_values("level", level, len(stencils))
    if u.ndim != 1 or not (u.min() <= 0 <= u.max()):
        raise InputError(
            f"level has shape {u.shape} and values from {u.min():g} to {u.max():g}, expected ({len(u)},) numbers of "
            "both signs; subtract the value at the interface"
        )
    own, other = stencils.owners, stencils.neighbors
    crossed = (u[own] <= 0) != (u[other] <= 0)
    share = np.abs(u[own]) / np.maximum(np.abs(u[own]) + np.abs(u[other]), 1e-300)
    begin = np.full(len(u), 1e3 * (stencils.lengths.sum() + 1))
    np.minimum.at(begin, own[crossed], (share * stencils.lengths)[crossed])
    return stencils.limit_growth(np.maximum(begin, 1e-300), 1.0)


def _velocity_gradients(what: str, velocity: ArrayLike, on: Result | Diagram) -> np.ndarray:
    """Return the gradients (n, component, axis) of a velocity (n, d)."""
    stencils = CellStencils.of(on)
    u = check_cell_values(f"{what} velocity", velocity, len(stencils))
    d = stencils.mesh.domain.dim
    if u.shape != (len(u), d):
        raise InputError(f"{what} velocity has shape {u.shape}, expected ({len(u)}, {d}): a component for each axis")
    return derivatives(u, on)[0]


def _skew(gradients: np.ndarray) -> np.ndarray:
    return (gradients - gradients.transpose(0, 2, 1)) / 2
