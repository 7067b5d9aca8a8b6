"""Power diagrams of the caller's generators, by their weights or by the volumes of their cells."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla
import shapely

from ..arguments import check_integer, check_number, check_points, coincident_named, format_point, warn
from ..errors import EmptyCellsWarning, InputError, InputTypeError, SizeErrorWarning
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import Transported
from ..solvers.transport import TOLERANCE
from ..tessellation.readback.diagram import fetch_diagram
from ..tessellation.tessellator import Tessellator
from .estimates import check_memory
from .stages import Stages

RELAXED = 1e-2
"""Largest relative error of volumes before generators move to the centroids of their cells."""
SUM_TOLERANCE = 1e-9
"""Largest relative difference of the sum of volumes from the measure of the domain, if the round-off of the volumes is
not larger."""
WITHIN_REACH = 4.0
"""A cell is empty if its weight is less than the largest one by more than the square of the domain's diameter. Lower
weights are raised to this multiple of it, so that nothing overflows."""


def power_diagram_of(stages: Stages, domain: Domain, points: object, weights: object) -> Diagram:
    """Return the power diagram of `points` with `weights`; see `clvoro.power_diagram`."""
    power = Tessellator(stages, domain, weighted=True)
    host = check_points(points, domain)
    n, given = len(host), _check_numbers("weights", weights, len(host))
    if not np.isfinite(float(given.max()) - float(given.min())):
        raise InputError(
            f"weights are between {given.min():.3g} and {given.max():.3g}, expected finite differences; scale them"
        )
    check_memory(stages.engine, n, domain, run=False, power=True)
    # Only differences count. Around 0 weights have the least round-off.
    near = np.maximum(given - given.max(), -WITHIN_REACH * float((domain.extent**2).sum()))
    scaled = (near - near.mean()) / domain.frame[1] ** 2
    with coincident_named(host, domain, stages.engine.real):
        labels, sorted_points = _sorted(power, host)
        device_weights = stages.engine.upload(scaled[labels.get()])
        t = power.tessellate_weighted(sorted_points, device_weights, n, exact=True, complete=True)
        assert t is not None
        t = power.final(t)
    diagram = fetch_diagram(power.stages.engine, domain, t, labels)
    diagram = diagram.with_arrays(weights=given)
    empty = diagram.empty_cells
    if len(empty):
        warn(
            f"{len(empty)} of {n} cells are empty, the first is {empty[0]}: other generators with larger weights are "
            "nearer everywhere, by the power distance; diagram.empty_cells lists them",
            EmptyCellsWarning,
        )
    return diagram


def transport_to(
    stages: Stages, domain: Domain, points: object, volumes: object, tolerance: float | None, max_steps: int
) -> Transported:
    """Return the power diagram of `points` whose cells have `volumes`; see `clvoro.transport`."""
    engine = stages.engine
    power = Tessellator(stages, domain, weighted=True)
    host = check_points(points, domain)
    n, given = len(host), _check_numbers("volumes", volumes, len(host))
    most = check_integer("max_steps", max_steps, 0, 10**6)
    if tolerance is None:
        tolerance = TOLERANCE[engine.real.name]
    tolerance = check_number("tolerance", tolerance, above=0)
    kind = np.asarray(volumes).dtype
    rounding = float(np.finfo(kind).eps) if kind.kind == "f" else 0.0
    _check_held(host, domain)
    _check_volumes(given, domain, rounding)
    _check_pieces(host, given, domain, rounding)
    check_memory(engine, n, domain, run=False, power=True)
    with coincident_named(host, domain, engine.real):
        labels, sorted_points = _sorted(power, host)
        prescribed = given[labels.get()] / domain.frame[1] ** domain.cell_dim
        t, _, newton = stages.transport.solve(
            power, sorted_points, engine.upload(prescribed), None, tolerance, most, exact=True
        )
        t = power.final(t)
    diagram = fetch_diagram(power.stages.engine, domain, t, labels)
    result = Transported(diagram, np.array(newton.errors), np.array(newton.shares), newton.converged)
    if not newton.converged:
        warn(
            f"the volumes of {newton.far} of {n} cells differ from the prescribed ones by more than {tolerance:.3g}, "
            f"the largest relative error is {newton.errors[-1]:.3g} after {len(newton.shares)} steps; use "
            f"{_remedy(engine.real, len(newton.shares) >= most, newton.errors[-1])}",
            SizeErrorWarning,
        )
    return result


def _remedy(real: np.dtype, used_up: bool, error: float) -> str:
    if used_up:
        return "more max_steps"
    if error > RELAXED:
        return "volumes that are nearer to those of the Voronoi cells"
    return "a larger tolerance" if real == np.float64 else "a larger tolerance or dtype='float64'"


def _sorted(power: Tessellator, host: np.ndarray) -> tuple[cla.Array, cla.Array]:
    """Return the rows of the generators in the order of the bins, and their positions on the device."""
    engine, domain, n = power.stages.engine, power.domain, len(host)
    places = np.asarray(domain.place(host, engine.real), engine.real)
    # The bins of generators with weights: others would be a further program.
    sites = engine.upload(np.pad(places, ((0, 0), (0, 1))))
    labels = power.stages.bins.build(domain, sites, n).items[:n].copy()
    return labels, engine.upload(places[labels.get()])


def _check_numbers(name: str, value: object, n: int) -> np.ndarray:
    """Return `value` as a float64 array (n,) of finite numbers."""
    try:
        array = np.asarray(value)
    except Exception as error:  # arrays of other libraries raise anything
        raise InputTypeError(f"{name} is not an array ({error}), expected one real number per point") from error
    if np.ma.is_masked(value):
        raise InputTypeError(
            f"{name} is a masked array with {np.ma.count_masked(value)} masked numbers, expected one number per point; "
            "fill them, or leave out their points"
        )
    if array.dtype.kind not in "fiu":
        raise InputTypeError(f"{name} has dtype {array.dtype}, expected real numbers")
    if array.shape != (n,):
        raise InputError(f"{name} has shape {array.shape}, expected ({n},), one number per point")
    array = array.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise InputError(f"{name}[{bad[0]}] is {array[bad[0]]}, expected finite numbers ({bad.size} of {n} are not)")
    return array


def _check_volumes(volumes: np.ndarray, domain: Domain, rounding: float) -> None:
    """Raise InputError unless `volumes` (n,) with a relative `rounding` are positive and fill the domain."""
    bad = np.flatnonzero(~(volumes > 0))
    if bad.size:
        raise InputError(
            f"volumes[{bad[0]}] is {volumes[bad[0]]}, expected numbers > 0 ({bad.size} of {len(volumes)} are not); "
            "leave out generators whose cells are to be empty"
        )
    total = float(volumes.sum())
    if not abs(total - domain.measure) <= max(SUM_TOLERANCE, rounding) * domain.measure:
        raise InputError(
            f"the sum of the {len(volumes)} volumes is {total:.12g}, expected that of the domain, "
            f"{domain.measure:.12g}; scale them: volumes * (domain.measure / volumes.sum())"
        )


def _check_held(points: np.ndarray, domain: Domain) -> None:
    """Raise InputError if a piece of the domain has none of the generators `points`."""
    if domain.n_pieces == 1:
        return
    held = np.unique(domain.piece_of(points))
    empty = np.setdiff1d(np.arange(domain.n_pieces), held)
    if empty.size:
        k = int(empty[0])
        place = domain.inner_points()[k]
        raise InputError(
            f"piece {k} of the domain, at {format_point(place)}, has no generator ({empty.size} of {domain.n_pieces} "
            "pieces have none), so that its area belongs to no cell; add a generator there, or leave the piece out, as "
            "domain.split() returns the pieces"
        )


def _check_pieces(points: np.ndarray, volumes: np.ndarray, domain: Domain, rounding: float) -> None:
    """Raise InputError unless `volumes` fill each piece of the domain that holds the generators `points`."""
    if domain.n_pieces == 1:
        return
    for k, piece in enumerate(shapely.get_parts(domain.region)):
        inside = shapely.dwithin(piece, shapely.points(points), 0)
        total = float(volumes[inside].sum())
        if not abs(total - piece.area) <= max(SUM_TOLERANCE, rounding) * domain.measure:
            raise InputError(
                f"the sum of the volumes of the {inside.sum()} generators in piece {k} of the domain is {total:.12g}, "
                f"expected the area of the piece, {piece.area:.12g}; scale these by "
                f"{piece.area / total:.6g}, so that the generators of each piece fill it"
            )
