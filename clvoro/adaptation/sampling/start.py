"""Generators with the density of a size field: random ones, or a lattice where sizes are the same."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import DTypeLike

from ...errors import InputError, InputTypeError
from ...geometry.domain import Domain
from ...sizing import as_field
from ..tuning import FAR, STRETCH
from .box_tree import BoxTree
from .coverage import CutCoverage, coverage_of
from .quadrature import DensityTree


class Charted:
    """A size field on a curved domain as a function of places in its chart.

    - `field`: h(points (n, d)) -> (n,).
    """

    def __init__(self, field: Callable[[np.ndarray], np.ndarray], domain: Domain) -> None:
        self._field, self._domain, self._chart = field, domain, domain.chart()

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return h at places in the chart, (n,)."""
        return self._field(self._chart.position(points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the field's landmarks in the chart `domain`; see `Field.landmarks`."""
        del domain
        known: Any = getattr(self._field, "landmarks", None)
        return self._chart.place(np.empty((0, self._domain.dim)) if known is None else known(self._domain))


def charted(
    domain: Domain, field: Callable[[np.ndarray], np.ndarray]
) -> tuple[Domain, Callable[[np.ndarray], np.ndarray]]:
    """Return the domain's chart, and the field there; `domain` and `field` if it is plane already."""
    chart = domain.chart().domain
    return (domain, field) if chart is domain else (chart, Charted(field, domain))


_ATTEMPTS = 60  # the last 40 halve the distance of a point from one that is inside
_ULPS = 4  # least distance of points from the boundary of a polygon
_MAX_BOXES = 1 << 15  # over a polygon, for uniform points
_MAX_EXPECTED, _MAX_EXPECTED_BESIDE = 1.0, 8.0  # points per box; beside lattices
_TOLERANCE = 1e-3  # relative error of the integral in the tree for sampling
_DEPTH = 0.05  # least distance of a lattice's points from walls, over their spacing
_CUBE = 4.0  # side of cubes of a lattice's points, over their spacing


def count_cells(field: Callable[[np.ndarray], np.ndarray] | float, domain: Domain, tolerance: float = 1e-4) -> float:
    """Return the number of cells that `field` requires: the integral of h^-d over the domain.

    - `field`: a `Sizing` is evaluated on its device, anything else on the host.
    - `tolerance`: relative error; see `clvoro.adaptation.sampling.quadrature.DensityTree`.

    The number is less than 1 if h is larger than the domain.

    Raises `SizeFieldError` if h is not positive and finite somewhere; names the place.
    """
    if not isinstance(tolerance, Real) or not 0 < tolerance < 1:
        raise InputError(f"tolerance is {tolerance!r}, expected a number between 0 and 1")
    chart, plane_field = charted(domain, _evaluator(field))
    return DensityTree(plane_field, chart, float(tolerance)).integral


def density_tree(field: Callable[[np.ndarray], np.ndarray] | float, domain: Domain) -> DensityTree:
    """Return the tree for `sample_density`. Its integral is the number of cells, with an error of 0.1 %."""
    chart, plane_field = charted(domain, _evaluator(field))
    return DensityTree(plane_field, chart, tolerance=_TOLERANCE)


def sample_density(
    field: Callable[[np.ndarray], np.ndarray] | float,
    domain: Domain,
    n: int,
    seed: int,
    real: DTypeLike | None = None,
    tree: DensityTree | None = None,
) -> np.ndarray:
    """Return `n` points distributed as h^-d.

    The domain is divided into boxes of at most one expected point each, in the order of a Hilbert curve. Points are
    distributed along the curve at equal steps of the cumulated expectation (systematic sampling), so that every box of
    the tree gets its share, rounded up or down. Within its box a point is drawn from a log-linear density.

    - `n`: at least 1.
    - `seed`: seed of numpy's PCG64.
    - `real`: precision in which the points are distinct in the device's coordinates; by default that of the field
      (`Sizing.real`) or float64.
    - `tree`: the tree of the field from `density_tree`. It is changed.

    The result is (n, d) float64: physical coordinates, distinct and strictly inside, in the order of the curve.
    """
    n, seed = _check_arguments(n, seed)
    field = _evaluator(field)
    precision = getattr(field, "real", np.float64) if real is None else real
    tree = density_tree(field, domain) if tree is None else tree
    return replace_far(np.empty((0, domain.dim)), tree, domain, n, seed, precision)[0]


def replace_far(
    points: np.ndarray,
    tree: DensityTree,
    domain: Domain,
    n: int,
    seed: int,
    real: DTypeLike,
    most: float = _MAX_EXPECTED,
) -> tuple[np.ndarray, np.ndarray]:
    """Replace `points` by those of `sample_density` where their number is far from that of the density.

    The boxes of `sample_density` are divided along the curve into stretches. In each stretch given and expected points
    together are `STRETCH`. Where there are more than ``FAR**d`` times as many of one kind as of the other, the expected
    points replace the given ones.

    - `points` (k, d) float64: inside the domain.
    - `tree`, `domain`, `n`, `seed`, `real`: as for `sample_density`.
    - `most`: most expected points of a box.

    Results:
    - (m, d) float64: those of `points` that are kept, then new ones. Without points, or if none is kept, these are the
      `n` points of `sample_density`.
    - (l,) int: rows in `points` of those that are kept.
    """
    chart = domain.chart()
    if chart.domain is not domain:
        found, rows = replace_far(chart.place(points), tree, chart.domain, n, seed, real)
        return np.concatenate([points[rows], chart.position(found[len(rows) :])]), rows
    boxes, coverage, slopes = tree.boxes, tree.coverage, tree.slopes
    share = tree.cells * (n / tree.integral)
    while (chosen := (share > most) & (boxes.level < 45)).any():
        share, slopes = _halve(tree, chosen, share, slopes)
    reached = np.cumsum(share)
    rng = np.random.Generator(np.random.PCG64(seed))
    marks = (np.arange(n) + rng.random()) * (reached[-1] / n)
    box = np.minimum(np.searchsorted(reached, marks, side="right"), len(boxes) - 1)
    inside = boxes.find_points(points)
    far = _are_far(share, np.bincount(inside, minlength=len(boxes)), domain.dim)
    rows = np.flatnonzero(~far[inside])
    box = box[far[box]] if len(points) else box

    def draw(wanted: np.ndarray, attempt: int) -> np.ndarray:
        mine = box[wanted]
        slope = slopes[mine] * coverage.relative_edges(mine)
        return coverage.draw(_log_linear(rng.random((len(wanted), domain.dim)), slope), mine, attempt)

    found = _distinct(draw, domain, points[rows], len(box), np.dtype(real))
    # The caller's points may be fewer than the pieces: later insertions reach the others.
    return _in_all_pieces(domain, found) if len(found) >= domain.n_pieces or not len(rows) else found, rows


def _are_far(expected: np.ndarray, given: np.ndarray, dim: int) -> np.ndarray:
    """Return for each box, (m,) bool, whether its stretch has far more or far fewer points than expected.

    `expected` and `given` (m,) are numbers of points in each box, in the order of the curve.
    """
    both = expected + given
    stretch = ((np.cumsum(both) - both) / STRETCH).astype(int)
    needs, has = np.bincount(stretch, expected), np.bincount(stretch, given)
    return ((has > FAR**dim * needs) | (needs > FAR**dim * has))[stretch]


def sample_uniform(domain: Domain, n: int, seed: int, real: DTypeLike = np.float64) -> np.ndarray:
    """Return `n` independent uniform random points, the start in the paper.

    - `n`: at least 1.
    - `seed`: seed of numpy's PCG64.
    - `real`: precision in which the points are distinct in the device's coordinates.

    The result is (n, d) float64: physical coordinates, distinct and strictly inside.
    """
    n, seed = _check_arguments(n, seed)
    chart = domain.chart()
    if chart.domain is not domain:
        return chart.position(sample_uniform(chart.domain, n, seed, real))
    rng = np.random.Generator(np.random.PCG64(seed))
    place = _uniform_in(domain, rng)

    def draw(rows: np.ndarray, attempt: int) -> np.ndarray:
        del attempt
        return place(len(rows))

    return _in_all_pieces(domain, _distinct(draw, domain, np.empty((0, domain.dim)), n, np.dtype(real)))


def sample_even(
    tree: DensityTree, domain: Domain, n: int, seed: int, real: DTypeLike, sizes: Sequence[float]
) -> np.ndarray:
    """Return about `n` points: those of lattices where h is one of `sizes`, and of `sample_density` elsewhere.

    - `tree`, `seed`, `real`: as for `sample_density`.
    - `domain`: in space, flat.
    - `sizes`: some of `DensityTree.even_sizes`.

    The result is (m, 3) float64.
    """
    scale = (tree.integral / n) ** (1 / 3)
    drawn = [sample_lattice(domain, scale * size, seed) for size in sizes]
    tree.leave_out(sizes)
    if others := round(tree.integral / scale**3):
        n, none = max(others, domain.n_pieces), np.empty((0, 3))
        drawn.append(replace_far(none, tree, domain, n, seed, real, _MAX_EXPECTED_BESIDE)[0])
    return _in_all_pieces(domain, np.concatenate([x[tree.which_size(x, sizes) == k] for k, x in enumerate(drawn)]))


def sample_lattice(domain: Domain, h: float, seed: int) -> np.ndarray:
    """Return the points of a body-centered cubic lattice of cells of size `h` that are inside, (m, 3) float64.

    The direction and the place of the lattice are random.

    Its cells are the best known ones for a constant size in space (Barnes and Sloane, SIAM J. Algebraic Discrete
    Methods 4, 1983): Q is 0.753.

    - `domain`: in space, flat.
    - `seed`: seed of numpy's PCG64.
    """
    rng = np.random.Generator(np.random.PCG64(seed))
    axes, shift = np.linalg.qr(rng.standard_normal((3, 3)))[0], rng.random(3)
    edge, middle = 2 ** (1 / 3) * h, (np.array(domain.lower) + domain.upper) / 2
    steps = np.arange(math.ceil(np.linalg.norm(domain.extent) / 2 / edge) + 2)
    steps = np.concatenate([-steps[:0:-1], steps])
    layer = np.stack(np.meshgrid(steps, steps, [0.0, 0.5], indexing="ij"), axis=-1).reshape(-1, 3)
    layer[:, :2] += layer[:, 2:]
    found = []
    for z in steps:  # one layer at a time: the lattice is some times as large as the domain
        x = middle + edge * (layer + shift + (0, 0, z)) @ axes.T
        found.append(x[((x > domain.lower) & (x < domain.upper)).all(axis=1)])
    points = np.concatenate(found)
    return points[_contained(domain, points, h)]


def _contained(domain: Domain, points: np.ndarray, spacing: float) -> np.ndarray:
    """Return for each of `points` (n, d) whether it is inside and off the boundary, (n,) bool.

    Only points in cubes that reach a wall are examined one by one.
    """
    side = _CUBE * spacing
    places = np.floor((points - domain.lower) / side).astype(np.int64)
    shape = places.max(axis=0, initial=0) + 1
    cubes, cube = np.unique(np.ravel_multi_index(tuple(places.T), tuple(shape)), return_inverse=True)
    middle = domain.lower + side * (np.stack(np.unravel_index(cubes, tuple(shape)), axis=1) + 0.5)
    found = domain.contains_well(middle, side * 3**0.5 / 2)[cube]
    near = np.flatnonzero(~found)
    found[near] = domain.contains_well(points[near], _DEPTH * spacing)
    return found


@runtime_checkable
class _Evaluator(Protocol):
    """A field with a precision, such as `Sizing`."""

    @property
    def real(self) -> np.dtype: ...

    def __call__(self, points: np.ndarray) -> np.ndarray: ...


def _evaluator(field: object) -> Callable[[np.ndarray], np.ndarray]:
    """Return `field` itself if it has a precision, else as a `Field`."""
    return field if isinstance(field, _Evaluator) else as_field(field)


def _check_arguments(n: int, seed: int) -> tuple[int, int]:
    for name, value, least in (("n", n, 1), ("seed", seed, 0)):
        if not isinstance(value, Integral) or isinstance(value, bool):
            raise InputTypeError(f"{name} is {value!r}, expected an integer")
        if value < least:
            raise InputError(f"{name} is {value}, expected at least {least}")
    return int(n), int(seed)


def _halve(
    tree: DensityTree, chosen: np.ndarray, share: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Split boxes of the tree and divide their shares among the children in proportion to h^-d at the centers.

    Returns the new shares and slopes; the slopes of a child are those between the centers of its siblings.
    """
    boxes, coverage, dim = tree.boxes, tree.coverage, tree.boxes.dim
    parent, child = coverage.split(chosen)
    new = child >= 0
    share, slopes = share[parent], slopes[parent]
    centers = boxes.points(np.full((1, dim), 0.5), new)
    reached = coverage.occupied[new]
    log_density = np.full(len(reached), -np.inf)
    log_density[reached] = -dim * np.log(tree.sizes(coverage.move_inside(centers, new)[reached, 0]))
    log_density = log_density.reshape(-1, 1 << dim)
    densest = log_density.max(axis=1, keepdims=True)
    # Siblings without a part inside the domain, because slivers were dropped.
    densest[densest == -np.inf] = 0
    weight = coverage.scale_by_share(np.exp(log_density - densest).ravel(), new).reshape(log_density.shape)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    # No slope towards the outside of the domain.
    log_density = np.where(log_density == -np.inf, densest, log_density)
    share[new] *= weight.ravel()
    # Side of each child in its parent, -1 or 1 per axis.
    middle = centers.reshape(-1, 1 << dim, dim)
    side = np.sign(middle - middle.mean(axis=1, keepdims=True))
    slope = np.einsum("pkd,pk->pd", side, log_density) / (1 << (dim - 1))
    slopes[new] = np.repeat(slope, 1 << dim, axis=0)
    return share, slopes


def _log_linear(u: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Transform uniform `u` to numbers in [0, 1] with a density proportional to exp(slope x)."""
    slope = np.clip(slope, -30, 30)
    flat = np.abs(slope) < 1e-6
    safe = np.where(flat, 1.0, slope)
    return np.where(flat, u, np.log1p(u * np.expm1(safe)) / safe)


def _distinct(
    draw: Callable[[np.ndarray, int], np.ndarray], domain: Domain, kept: np.ndarray, n: int, real: np.dtype
) -> np.ndarray:
    """Return the points `kept`, then `n` drawn ones, which are drawn again if they are not distinct or on a wall.

    Points are compared in precision `real`. ``draw(wanted, attempt)`` returns points for the rows `wanted` of the n.
    """
    (origin, scale), first = domain.frame, len(kept)
    points = np.concatenate([kept, np.empty((n, domain.dim))])
    rows, bad = np.arange(first, first + n), np.zeros(first + n, bool)
    for attempt in range(_ATTEMPTS):
        points[rows] = draw(rows - first, attempt)
        working = ((points - origin) / scale).astype(real)
        bad[rows] = ~_strictly_inside(domain, points[rows], working[rows])
        rows = first + np.flatnonzero((bad | _repeated(working))[first:])
        if not rows.size:
            return points
    raise InputError(
        f"n is {n}, but {real.name} has not as many distinct points for this size field; "
        + ("use dtype='float64' or " if real != np.float64 else "")
        + "use fewer cells"
    )


def _strictly_inside(domain: Domain, points: np.ndarray, working: np.ndarray) -> np.ndarray:
    """Return for each of `points` (n, d) whether it is inside and off the boundary, also after rounding.

    `working` are the points in the domain's frame.
    """
    origin, scale = domain.frame
    if domain.outline is not None or domain.curved_walls:
        return domain.contains_well(points, _ULPS * float(np.finfo(working.dtype).eps) * scale)
    lower, upper = (((np.array(c) - origin) / scale).astype(working.dtype) for c in (domain.lower, domain.upper))
    bad = ((working <= lower) | (working >= upper)).any(axis=1)
    bad |= ((points <= domain.lower) | (points >= domain.upper)).any(axis=1)
    return np.asarray(~bad)


def _in_all_pieces(domain: Domain, points: np.ndarray) -> np.ndarray:
    """Move points from the piece with most of them, so that each piece of the domain has one."""
    if domain.n_pieces == 1:
        return points
    if len(points) < domain.n_pieces:
        raise InputError(f"n is {len(points)}, expected at least {domain.n_pieces}, one per piece of the domain")
    piece = domain.piece_of(points)
    # By round-off, points of the caller may be in none.
    counts = np.bincount(piece[piece >= 0], minlength=domain.n_pieces)
    for missing in np.flatnonzero(counts == 0).tolist():
        most = int(np.argmax(counts))
        row = np.flatnonzero(piece == most)[-1]
        points[row] = domain.inner_points()[missing]
        piece[row] = missing
        counts[[most, missing]] += [-1, 1]
    return points


def _uniform_in(domain: Domain, rng: np.random.Generator) -> Callable[[int], np.ndarray]:
    """Return a function that draws a number of uniform random points in the domain.

    In a polygon or solid points are drawn in boxes, at least half of which is inside. Those outside are rejected.
    """
    boxes = BoxTree(domain)
    coverage = coverage_of(boxes, domain)
    if not isinstance(coverage, CutCoverage):
        return lambda n: domain.lower + domain.extent * rng.random((n, domain.dim))
    while True:
        areas = np.where(coverage.occupied, boxes.volumes(), 0)
        if areas.sum() <= 2 * domain.measure or len(boxes) >= _MAX_BOXES:
            break
        coverage.split(coverage.occupied & (coverage.share < 1))
    ends = np.cumsum(areas) / areas.sum()

    def place(n: int) -> np.ndarray:
        found = np.empty((0, domain.dim))
        while len(found) < n:
            m = 2 * (n - len(found)) + 16
            box = np.minimum(np.searchsorted(ends, rng.random(m), side="right"), len(boxes) - 1)
            x = boxes.points(rng.random((m, 1, domain.dim)), box)[:, 0]
            found = np.concatenate([found, x[coverage.contains(x)]])
        return found[:n]

    return place


def _repeated(points: np.ndarray) -> np.ndarray:
    """Return for each of `points` (n, d) whether it equals an earlier one."""
    repeated = np.zeros(len(points), bool)
    # Only points whose first coordinate occurs twice can coincide.
    order = np.argsort(points[:, 0], kind="stable")
    first = points[order, 0]
    twin = np.flatnonzero(first[1:] == first[:-1])
    candidates = np.unique(order[np.concatenate([twin, twin + 1])])
    if candidates.size:
        _, keep = np.unique(points[candidates], axis=0, return_index=True)
        repeated[np.delete(candidates, keep)] = True
    return repeated
