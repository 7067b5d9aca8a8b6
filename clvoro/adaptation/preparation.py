"""Preparation of a run: size field, number of cells and levels, memory, initial generators, and schedule."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arguments import coincident_named, warn
from ..errors import CoarseSizeWarning, InputError, SizeFieldError
from ..geometry.domain import Domain
from ..geometry.fixed_generators import FixedGenerators
from ..geometry.gaps import NARROW
from ..sizing import Sizing, as_field
from ..sizing.estimates import LARGEST
from ..sizing.field import on_domain
from .diagnostics import check_precision, warn_of_narrow_parts
from .estimates import SAMPLE, Extras, check_memory, check_prisms, expected_images, expected_surplus, holder_of_all
from .fixed_points import check_beside_borders, check_room, place_in_corners
from .layers import Layout, lay_out
from .methods import MOVING, Relaxation, make_method
from .moving.lattice import lattice_points
from .options import Options, RunArguments
from .plan.actions import Action, Prescribe
from .plan.efforts import NEAR_COUNT, NEAR_ERROR, choose_error_target, is_near, steep_share
from .plan.schedule import Begins, adaptive_schedule, auto_levels, repeated_schedule
from .sampling.quadrature import DensityTree
from .sampling.start import charted, density_tree, replace_far, sample_density, sample_even, sample_uniform
from .stages import Stages
from .state import MeshState, Setup
from .tuning import CELLS_ACROSS, GRADIENT_STEP, LATTICE, LEAST_STEEP, MOVES, NEAR_SIZE, OPENINGS, SAMPLED_SIZES, STEPS

_APART = 0.7
"""Least distance of generators around concave creases from those beside surfaces inside, over h."""


class CellCount(NamedTuple):
    """Number of cells of a run, and what it follows from."""

    tree: DensityTree | None
    """Number of cells in each part of the domain; None if the method keeps the number of given points."""
    required: float
    """Number of cells that the size field requires, or of given points if the method keeps it."""
    target: int
    """Number of cells of the finest level."""
    factor: float
    """The size field times this factor asks for `target` cells."""


@dataclass(frozen=True)
class Prepared:
    """What a run needs before it begins."""

    options: Options
    setup: Setup
    points: np.ndarray | None
    """(n, d) ndarray or None. Points of the caller, or some of them, then new ones (`without_far`)."""
    layout: Layout
    count: CellCount
    lattice: np.ndarray | None
    """(n, d) ndarray or None. Generators at the start of a moving mesh."""
    levels: int
    """Number of coarser levels."""
    kept_rows: np.ndarray | None
    """(n,) int or None. For each of `points` its index in those of the caller, or -1; None if all are those of the
    caller."""
    even: tuple[float, ...]
    """Sizes that many cells have. Where h is one of them, a run without given points starts from a lattice."""
    memory: float
    """Estimated device memory of the run, or of reading its diagram, in bytes."""

    @property
    def drawn(self) -> Begins:
        """What generators are at the start where the caller gives none."""
        return "lattice" if self.even else "random"

    @property
    def origins(self) -> np.ndarray | None:
        """For each generator at the start its index in the points of the caller, or -1; None without `points`."""
        if self.points is None:
            return None
        own = np.arange(len(self.points)) if self.kept_rows is None else self.kept_rows
        return np.concatenate([np.full(len(self.layout.layers.points), -1), own]).astype(np.int32)


class Beginning(NamedTuple):
    """What a run begins with."""

    begins: Begins
    why: str = ""
    """The reason, for the settings of the result; empty if there are no points, or the method keeps their number."""


@dataclass(frozen=True)
class Plan:
    """The schedule of a run."""

    schedule: list[Action]
    error_target: float | None = None
    """float or None. None with methods that have none."""
    trade: str = ""
    """The trade of sizes against shape, in words."""


def prepare(stages: Stages, arguments: RunArguments, max_levels: int | None = None) -> Prepared:
    """Check the `arguments` of a run, which are checked one by one, against each other; count cells, levels and bytes.

    - `max_levels`: largest automatic number of coarser levels.

    Raises `InputError`, `InputTypeError`, `SizeFieldError` or `MemoryLimitError`.
    """
    domain, _, options, points, fixed, _ = arguments
    _check_together(arguments)
    size = on_domain(domain, as_field(arguments.size))
    layout = lay_out(
        stages.engine, domain, size, options.layers, options.n_cells, len(fixed), scaled=options.multilevel
    )
    kept_rows = None
    if points is not None and options.layers:
        kept_rows = layout.beyond(points)
        points = points[kept_rows]
    sizing = Sizing(stages.engine, domain, layout.field, gradient_step=GRADIENT_STEP)
    count = _count(layout, sizing, points, options, speaks=stages.engine.peers.number == 0)
    most = max(count.target, 0 if points is None else len(points))
    check_memory(stages.engine, most, domain)  # before creases have generators
    setup = _set_up(stages, layout, sizing, count, fixed, options)
    lattice = lattice_points(domain, count.target) if options.method in MOVING else None
    even = _even_sizes(domain, count, options)
    levels = 0
    if options.multilevel and (points is not None or not even):
        levels = _count_levels(setup, points, count.target, len(layout.layers.points), options)
    if options.levels == "auto" and max_levels is not None:
        levels = min(levels, max_levels)
    check_prisms(layout.layers.prisms(lambda x: count.factor * sizing(x)))
    memory = _estimate_memory(setup, options, count, most, levels)
    return Prepared(options, setup, points, layout, count, lattice, levels, kept_rows, even, memory)


def _even_sizes(domain: Domain, count: CellCount, options: Options) -> tuple[float, ...]:
    """Return the sizes of the cells of the lattices that a run without given points starts from, in space.

    At least half of all cells have one of these sizes; else there are none.
    """
    if not options.multilevel or options.start != "density" or options.levels != "auto" or count.tree is None:
        return ()
    even = count.tree.even_sizes(LATTICE[domain.cell_dim] * count.tree.integral / count.target)
    return tuple(even) if 2 * sum(even.values()) >= count.tree.integral else ()


def _set_up(
    stages: Stages, layout: Layout, sizing: Sizing, count: CellCount, fixed: np.ndarray, options: Options
) -> Setup:
    """Return what all levels have in common: the generators that do not move, and the factors on the size field."""
    domain, free, rows = layout.domain, layout.layers.free, layout.layers.points
    if len(fixed):
        check_room(fixed, domain, free, rows, count.factor * sizing(fixed))
    own = 1.0
    if not options.multilevel and (count.tree is not None or domain.cutting_edges):
        own = _own_factor(sizing, free, count)
    scale = count.factor if domain.borders is not None else count.factor * own
    around = _place_around(layout, fixed, lambda x: scale * np.asarray(sizing(x)), count)
    if around is not None:
        fixed = np.concatenate([fixed, around.points])
    held = len(fixed) + len(rows)
    return Setup(stages, domain, sizing, free, held, fixed, count.factor, own, around, layout.after_layers)


def _place_around(
    layout: Layout, fixed: np.ndarray, size: Callable[[np.ndarray], np.ndarray], count: CellCount
) -> FixedGenerators | None:
    """Return generators beside borders, and, if the others are random, in corners and creases, if there are any."""
    domain, free, rows, drawn = layout.domain, layout.layers.free, layout.layers.points, count.tree is not None
    if domain.borders is None:
        return place_in_corners(domain, free, fixed, rows, size, count.target) if drawn else None
    around = domain.borders.place(domain, free, size)
    check_beside_borders(around, domain, fixed)
    if drawn and domain.sheets is not None:
        corners = place_in_corners(domain, free, fixed, rows, size, count.target)
        around = around.with_others(corners, lambda x: _APART * np.asarray(size(x)))
    if (held := len(fixed) + len(around)) > count.target:
        raise InputError(
            f"the mesh has {count.target} cells, but {held} generators are beside the {domain.borders.word} or fixed, "
            "expected at least as many cells; use smaller sizes, or more cells"
        )
    return around


def _own_factor(sizing: Sizing, free: Domain, count: CellCount) -> float:
    """Return the size of the cells over that of the size field; 1 if it is near 1."""
    tree = density_tree(sizing, free) if count.tree is None else count.tree
    factor = (tree.integral / count.target) ** (1 / free.cell_dim)
    return factor if not 1 / NEAR_SIZE < factor < NEAR_SIZE else 1.0


def _check_together(arguments: RunArguments) -> None:
    """Raise if the arguments of a run do not fit together."""
    domain, _, options, points, fixed, _ = arguments
    n_cells, method = options.n_cells, options.method
    if n_cells is not None:
        domain.require_no_holes("n_cells is given")
    if method == "transport":
        domain.require_power_diagrams()
    if (len(fixed) or domain.borders) and method in ("transport", *MOVING):
        inside = domain.borders.word if domain.borders else ""
        given = "fixed generators are given" if len(fixed) else f"the domain has {inside}"
        raise InputError(f"{given}, but method {method!r} moves all generators; use method='adaptive' or 'exact'")
    kept = points is not None and not options.multilevel
    if points is not None and kept and n_cells not in (None, len(points)):
        raise InputError(
            f"n_cells is {n_cells}, but {len(points)} points are given, and method {method!r} "
            "keeps their number; leave n_cells out, or use method='adaptive'"
        )
    most = len(points) if points is not None and kept else n_cells
    if most is not None and len(fixed) > most:
        what = "n_cells is" if points is None else "the number of points is"
        raise InputError(
            f"{what} {most}, but {len(fixed)} generators are fixed, expected at least as many; leave "
            "n_cells out, or give more of them"
        )
    if method not in MOVING:
        return
    if not domain.plain:
        raise InputError(
            f"domain is {domain!r:.80}, expected a Box with walls for method {method!r}, which maps a lattice onto it; "
            "use method='adaptive'"
        )
    if points is not None or options.layers:
        given = "points are" if points is not None else "layers are"
        raise InputError(
            f"{given} given, but method {method!r} starts from a lattice of its own; leave them out, or use "
            "method='adaptive'"
        )


def _count(layout: Layout, sizing: Sizing, points: np.ndarray | None, options: Options, speaks: bool) -> CellCount:
    """Return the number of cells that the size field requires, and that of the finest level.

    - `speaks`: whether to warn of narrow parts, which one part of the domain does for all.
    """
    domain, n_cells = layout.domain, options.n_cells
    # The other methods keep the number of given points.
    kept = points is not None and not options.multilevel
    tree = None if kept else density_tree(sizing, layout.layers.free)
    required = float(len(points)) if points is not None and tree is None else tree.integral + len(layout.layers.points)  # type: ignore[union-attr]
    layout.warn_of_mismatches()
    target = n_cells if n_cells is not None else max(1, round(required))
    _check_sizes(domain, sizing, tree, required, target, options)
    if n_cells is None and required < 0.5:
        _warn_of_coarse_size(domain, required)
    scaled = options.multilevel and n_cells is not None
    factor = (required / target) ** (1 / domain.cell_dim) if scaled else 1.0
    if speaks and tree is not None and required * factor**-domain.cell_dim >= 0.5:
        warn_of_narrow_parts(domain, lambda x: factor * sizing(x))
    return CellCount(tree, required, target, factor)


def _check_sizes(
    domain: Domain, sizing: Sizing, tree: DensityTree | None, required: float, target: int, options: Options
) -> None:
    """Raise if cells are too few or too large. `required` cells have the sizes of the field itself."""
    n_cells, largest = options.n_cells, domain.largest_size
    if tree is not None and largest < math.inf:
        places = domain.even_points(SAMPLED_SIZES)
        scale = 1.0 if n_cells is None else (required / n_cells) ** 0.5
        h = scale * sizing(places)
        k = int(h.argmax())
        # As many equal cells as wanted have the size that they have.
        if h[k] > largest and (n_cells is None or h[k] > 1.01 * h.min()):
            scaled = "" if n_cells is None else f" in a mesh of {n_cells} cells"
            remedy = (
                "use smaller sizes, in the unit of the radius, or n_cells"
                if n_cells is None
                else "use more cells, or sizes that differ less"
            )
            raise SizeFieldError(
                f"h{scaled} is {h[k]:.6g} at {domain.place_name(places[k])}, larger than the radius, {largest:g}; "
                f"{remedy}"
            )
    least = _least_cells(domain, options.multilevel)
    if target < least:
        given = f"n_cells is {n_cells}" if n_cells else f"the size field requires {required:.2g} cells on {domain}"
        fewer = f"; method='lloyd' makes {domain.least_cells(False)} or more" if n_cells else ""
        raise InputError(
            f"{given}, expected at least {least} cells, on all sides of the sphere; use smaller sizes, in the unit "
            f"of the radius{fewer}"
        )


def _least_cells(domain: Domain, adapted: bool) -> int:
    """Return the least number of cells that is not refused. Where pieces are more, starts have one in each of them."""
    return domain.least_cells(adapted) if domain.evenly_below else 1


def _warn_of_coarse_size(domain: Domain, required: float) -> None:
    message = (
        f"h is larger than the domain: the size field requires {required:.2g} cells in a domain of "
        f"the measure {domain.measure:.6g}, and the mesh has a single cell; do "
        "h and the domain have the same unit of length?"
    )
    warn(message + domain.unit_hint, CoarseSizeWarning)


def _estimate_memory(setup: Setup, options: Options, count: CellCount, most: int, levels: int) -> float:
    """Return the bytes that the run of at most `most` cells needs on the device."""
    tree, required = count.tree, count.required
    domain, sizing, engine, power = setup.domain, setup.sizing, setup.stages.engine, options.method == "transport"
    surplus, images, boundary = 0.0, None, None
    if options.multilevel and tree is not None:
        # Coarser levels have steeper sizes and pass their cells on to the next level. In 2D without coarser levels
        # as many additional cells appear on the finest one.
        reach = setup.factor * (2 if levels or domain.cell_dim == 2 else 1)
        surplus = expected_surplus(*charted(domain, sizing), tree, reach)
    if any(domain.periodic) and tree is not None:
        images = expected_images(domain, sizing, most * tree.integral / required, tree)
    field_bytes = sizing.device_bytes + sizing.bytes_for(most)
    if tree is not None:
        boundary = domain.along_cutting_edges(lambda p: 1 / ((required / most) ** 0.5 * sizing(p)), SAMPLE)
    exact = options.method == "exact"
    extras = Extras(images, surplus, field_bytes, boundary)
    needed = check_memory(engine, most, domain, extras, power=power, exact=exact)
    if engine.peers.gathers:
        holder_of_all(engine, most, domain)
    # For few cells, the preparation may have taken more than the run.
    return max(needed, float(sizing.peak_bytes))


def _count_levels(setup: Setup, points: np.ndarray | None, target: int, n_rows: int, options: Options) -> int:
    """Return the number of coarser levels, from the points of the caller or from a random sample."""
    domain, levels = setup.domain, options.levels
    d = domain.cell_dim
    if levels == "auto":
        if points is not None:
            return max(0, round(math.log2(max(target - n_rows, 1) / len(points)) / d))
        levels = auto_levels(target - n_rows, d)
        while levels and ((n_rows and _is_narrow(setup, 2**levels)) or _is_large(setup, 2**levels)):
            levels -= 1
        return levels
    count = int(levels)
    most = int(math.log2(max(target / _least_cells(domain, True), 1)) / d)
    if points is None and count > most:
        raise InputError(
            f"levels is {levels}, expected at most {most} for {target} cells, or 'auto': each "
            f"level has {2**d} times fewer"
        )
    begun = 0 if points is None else len(points) * 2.0 ** (d * min(count, 99))
    check_memory(setup.stages.engine, begun, domain, power=options.method == "transport")
    return count


def _is_narrow(setup: Setup, coarseness: float) -> bool:
    """Return whether a gap between layers is narrower than `CELLS_ACROSS` cells of size ``coarseness * h``."""
    scale = CELLS_ACROSS / NARROW * coarseness * setup.factor
    return setup.free.narrow_parts(lambda x: scale * setup.sizing(x))[0] is not None


def _is_large(setup: Setup, coarseness: float) -> bool:
    """Return whether cells of size ``coarseness * h`` may leave a half of a sphere free."""
    largest = setup.domain.largest_size
    h = coarseness * setup.factor * setup.sizing(setup.domain.even_points(SAMPLED_SIZES)) if largest < math.inf else 0.0
    return float(np.max(h)) > LARGEST * largest


def start(prepared: Prepared) -> MeshState:
    """Return the mesh of the initial generators: those of layers, then those of the caller or a random sample."""
    setup, layout, levels = prepared.setup, prepared.layout, prepared.levels
    domain, engine, fixed = setup.domain, setup.stages.engine, setup.points
    host = prepared.points if prepared.lattice is None else prepared.lattice
    if host is None:
        host = _sample(prepared)
    check_precision(setup.sizing, domain, host, setup.factor)
    if len(layout.layers.points):
        host = np.concatenate([layout.layers.points, host[layout.beyond(host)]])
    placed = domain.place(host, engine.real)
    labels = np.arange(setup.first_row, setup.first_row + len(host), dtype=np.int32)
    taken = np.full(len(fixed), -1, np.int32)
    if len(taken) and levels == 0:
        placed, labels, taken = setup.place_fixed(placed, labels)
    with coincident_named(host, domain, engine.real):
        peers = engine.peers
        begin, end = (part * len(placed) // peers.count for part in (peers.number, peers.number + 1))
        arrays = {"points": engine.upload(placed[begin:end]), "labels": engine.upload(labels[begin:end], np.int32)}
        next_label = setup.first_row + len(host)
        return MeshState(setup, setup.factor * 2.0**levels, arrays, next_label=next_label, taken=taken)


def _sample(prepared: Prepared) -> np.ndarray:
    """Return the generators at the start of a run without given points: those of the coarsest level."""
    setup, options = prepared.setup, prepared.options
    domain, real = setup.domain, setup.stages.engine.real
    n = _cells_at_start(prepared)
    if n < domain.evenly_below:
        return domain.even_points(n)
    if prepared.even:
        assert prepared.count.tree is not None
        return sample_even(prepared.count.tree, setup.free, n, options.seed, real, prepared.even)
    if options.start == "uniform":
        return sample_uniform(setup.free, n, options.seed, real)
    return sample_density(setup.sizing, setup.free, n, options.seed, real, prepared.count.tree)


def _cells_at_start(prepared: Prepared) -> int:
    """Return the number of cells of the coarsest level, without those of layers."""
    layout, levels = prepared.layout, prepared.levels
    cells = (prepared.count.target - len(layout.layers.points)) / 2 ** (layout.domain.cell_dim * levels)
    return max(layout.layers.free.least_cells(levels > 0), round(cells))


def without_far(prepared: Prepared, max_levels: int | None = None) -> Prepared:
    """Return the same run with random points in place of those of the caller that are far from the sizes.

    If all points are far, the run begins as one without points.
    """
    given, setup, options = prepared.points, prepared.setup, prepared.options
    assert given is not None
    assert prepared.count.tree is not None
    n, real = _cells_at_start(prepared), setup.stages.engine.real
    points, rows = replace_far(given, prepared.count.tree, setup.free, n, options.seed, real)
    if len(rows) == len(given):
        return prepared
    before = np.arange(len(given)) if prepared.kept_rows is None else prepared.kept_rows
    if len(rows):
        new = np.full(len(points) - len(rows), -1)
        return replace(prepared, points=points, kept_rows=np.concatenate([before[rows], new]))
    levels = 0
    if not prepared.even:
        levels = _count_levels(setup, None, prepared.count.target, len(prepared.layout.layers.points), options)
        levels = levels if max_levels is None else min(levels, max_levels)
    # Points are drawn for the coarsest level from the tree as it was.
    tree = density_tree(setup.sizing, setup.free)
    return replace(prepared, points=None, kept_rows=None, levels=levels, count=prepared.count._replace(tree=tree))


def judge_points(prepared: Prepared, mesh: MeshState) -> tuple[Beginning, Prepared]:
    """Return how the run uses the points of the caller, whose mesh is `mesh`, and the run without far ones."""
    options, n = prepared.options, mesh.total
    if prepared.points is None or not options.multilevel:
        return Beginning(prepared.drawn if prepared.points is None else "mesh"), prepared
    s = mesh.summaries.read()
    mean, quality = s["error"].magnitude / n, s["quality"].sum / n
    missing = mesh.missing_cells() if options.n_cells is None else float(options.n_cells - n)
    near = not prepared.levels and is_near(prepared.setup.domain.cell_dim, options.effort, n, missing, mean, quality)
    off = f"{abs(missing) / n:.1%} of the cells too {'few' if missing > 0 else 'many'}"
    found = f"mean |e| {mean:.2g}, {off}, mean Q {quality:.3f}"
    if near and options.correct:
        return Beginning("near", f"the given mesh is near and only corrected ({found})"), prepared
    if near:
        return Beginning("mesh", f"the given mesh is near, and all steps were taken ({found}; correct=False)"), prepared
    if options.levels == "auto" and (after := without_far(prepared)) is not prepared:
        if after.points is None:
            return Beginning(
                after.drawn, f"the given points are all far from the sizes, and were replaced ({found})"
            ), after
        assert after.kept_rows is not None
        share = f"{1 - np.count_nonzero(after.kept_rows >= 0) / len(prepared.points):.0%} of the given points are"
        return Beginning("partly random", f"{share} far from the sizes, and were replaced ({found})"), after
    why = (
        f"the given points are too few to be corrected: {prepared.levels} refinements led to the sizes"
        if prepared.levels
        else f"the given mesh is not near, and all steps were taken ({found}; near means at most {NEAR_ERROR:g}, "
        f"{NEAR_COUNT:.0%}, and regular cells)"
    )
    return Beginning("mesh", why), prepared


def plan(prepared: Prepared, begins: Begins) -> Plan:
    """Return the schedule of the run."""
    options, levels, domain = prepared.options, prepared.levels, prepared.setup.domain
    if not options.multilevel:
        relaxation = Relaxation(options.alpha, options.k)
        steps = STEPS if options.max_steps is None else options.max_steps
        method = make_method(options.method, relaxation, prepared.lattice, options.tol)
        return Plan(repeated_schedule(method, steps))
    near = begins == "near"
    dim, effort, steep = domain.cell_dim, options.effort, _steepness(prepared)
    smooth = choose_error_target(dim, effort, levels, near)
    target = options.error_target or choose_error_target(dim, effort, levels, near, steep)
    schedule = adaptive_schedule(
        dim,
        effort,
        levels,
        options.method in ("exact", "transport"),
        target,
        begins=begins,
        openings=OPENINGS if domain.for_c_grids else 0,
        narrow_parts=domain.cuts_cells,
        most=options.max_steps,
        cells=prepared.count.target,
    )
    if options.method == "transport":
        schedule += [Prescribe(), *[Prescribe(move=True)] * MOVES]
    trade = f"error target {target:.2g}"
    if options.error_target is not None:
        trade += ", as given"
    elif steep == 0:
        trade += ": sizes come first"
    else:
        trade += f" in place of {smooth:.2g}, for cells of a better shape: sizes are steep for {steep:.0%} of them"
    return Plan(schedule, target, trade)


def _steepness(prepared: Prepared) -> float:
    """Return the share of the cells where sizes are steep; 0 where shape is not preferred to sizes.

    That is in 3D, on spheres, with few cells, which only serve a tight target, and with exact sizes.
    """
    tree, setup = prepared.count.tree, prepared.setup
    plane = setup.domain.dim == 2 and auto_levels(prepared.count.target, 2) > 0
    if tree is None or prepared.options.method != "adaptive" or not plane:
        return 0.0
    share = steep_share(setup.factor * tree.slopes_of_size, tree.cells)
    return share if share >= LEAST_STEEP else 0.0
