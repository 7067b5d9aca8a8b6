"""Preparation of a run: size field, number of cells and levels, memory, initial generators, and schedule."""

from __future__ import annotations

import math

import numpy as np

from ..arguments import coincident_named, warn
from ..errors import CoarseSizeWarning, InputError, SizeFieldError
from ..geometry.boundary_layers import apart_from, count_rows, free_domain, place_layers
from ..geometry.box import Box
from ..geometry.domain import Domain
from ..geometry.geojson import may_be_degrees
from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..sizing import Sizing, as_field
from ..sizing.field import Field
from ..sizing.gaps import NARROW
from ..sizing.layers import limit_beside_layers
from ..sizing.on_domain import on_domain
from ..tessellation.power import require_power_domain
from .arrays import Setup
from .descent.quality_descent import OPENINGS
from .diagnostics import check_precision, narrow_parts, warn_of_mismatches, warn_of_narrow_parts
from .estimates import Extras, check_memory, expected_boundary_cells, expected_images, expected_surplus
from .fixed_points import check_room, take_places
from .methods import MOVING, Relaxation, make_method
from .moving.lattice import lattice_points
from .options import Options
from .plan.actions import Action, Prescribe
from .plan.efforts import LEAST_STEEP, choose_error_target, is_near, steep_share
from .plan.schedule import CELLS_ACROSS, MOVES, adaptive_schedule, auto_levels, repeated_schedule
from .sampling.charts import charted
from .sampling.quadrature import DensityTree
from .sampling.start import density_tree, sample_density, sample_uniform
from .stages import Stages
from .state import MeshState

GRADIENT_STEP = 0.2
"""Step over h of the differences for the gradient of the size field in exact projections."""
LEAST_ON_SPHERE, LEAST_ADAPTED = 4, 20
"""Least numbers of cells on a sphere: fewer leave a half of it free, at once or while sizes are corrected."""
EVEN_ON_SPHERE = 200
"""Random generators that are fewer may leave a half of a sphere free. The start is an even spiral then."""
_PLACES = 2000
"""Places on a sphere at which sizes are compared with its radius."""
STEPS = 100
"""Default number of steps of a method that repeats one kind of step."""


class Preparation:
    """From options to a mesh and a schedule.

    Parameters
    ----------
    stages : Stages
    domain : Domain
    size : number, callable or clvoro.sizing field
    points : (n, d) array, optional
        Generators of the caller, checked.
    options : Options
    max_levels : int, optional
        Largest automatic number of coarser levels.
    fixed : (k, d) array, optional
        Fixed generators, checked.

    Attributes
    ----------
    rows : (m, d) ndarray
        Generators of layers, which do not move.
    free : Domain
        The domain without the layers.
    sizing : Sizing
    target : int
        Cells of the finest level.
    factor : float
        Factor on the size field that gives `target` cells.
    lattice : (n, d) ndarray or None
        Generators at the start of a moving mesh.
    steep : float
        Share of the cells where sizes are steep (see `efforts.steep_share`), if it counts.
    error_target : float or None
        That of the schedule; None before there is one, and with methods that have none.
    levels : int
        Number of coarser levels.
    memory : float
        Estimated device memory of the run, or of reading its diagram, in bytes.

    Raises
    ------
    InputError, InputTypeError, SizeFieldError, MemoryLimitError
    """

    def __init__(
        self,
        stages: Stages,
        domain: Domain,
        size: object,
        points: np.ndarray | None,
        options: Options,
        max_levels: int | None = None,
        fixed: np.ndarray | None = None,
    ) -> None:
        self.stages, self.domain, self.points, self.options = stages, domain, points, options
        self.fixed = np.empty((0, domain.dim)) if fixed is None else fixed
        n_cells = options.n_cells
        if options.method == "transport":
            require_power_domain(domain)
        if len(self.fixed) and options.method in ("transport", *MOVING):
            raise InputError(
                f"fixed generators are given, but method {options.method!r} moves all generators; use "
                "method='adaptive' or 'exact'"
            )
        # The other methods keep the number of given points.
        fixed_count = points is not None and not options.multilevel
        if points is not None and fixed_count and n_cells not in (None, len(points)):
            raise InputError(
                f"n_cells is {n_cells}, but {len(points)} points are given, and method {options.method!r} "
                "keeps their number; leave n_cells out, or use method='adaptive'"
            )
        most = len(points) if points is not None and fixed_count else n_cells
        if most is not None and len(self.fixed) > most:
            what = "n_cells is" if points is None else "the number of points is"
            raise InputError(
                f"{what} {most}, but {len(self.fixed)} generators are fixed, expected at least as many; leave "
                "n_cells out, or give more of them"
            )
        if options.method in MOVING:
            _check_moving(domain, points, options)
        self.rows, self.free = np.empty((0, domain.dim)), domain
        field = given_field = on_domain(domain, as_field(size))
        if options.layers:
            field = self._place_layers(given_field)
        self.sizing = Sizing(stages.engine, domain, field, gradient_step=GRADIENT_STEP)
        self.error_target, self._smooth_target = None, None
        self._tree: DensityTree | None = None
        if points is not None and fixed_count:
            required = float(len(points))
        else:
            self._tree = density_tree(self.sizing, self.free)
            required = self._tree.integral + len(self.rows)
        warn_of_mismatches(given_field, domain, options.layers)
        self.target = n_cells if n_cells is not None else max(1, round(required))
        if isinstance(domain, Sphere):
            self._check_on_sphere(domain, required)
        if n_cells is None and required < 0.5:
            self._warn_of_coarse_size(required)
        scaled = options.multilevel and n_cells is not None
        self.factor = (required / self.target) ** (1 / domain.cell_dim) if scaled else 1.0
        if self._tree is not None and required * self.factor**-domain.cell_dim >= 0.5:
            warn_of_narrow_parts(domain, lambda x: self.factor * self.sizing(x))
        if len(self.fixed):
            check_room(self.fixed, domain, self.free, self.rows, self.factor * self.sizing(self.fixed))
        self.lattice = lattice_points(domain, self.target) if options.method in MOVING else None
        self.steep = self._measure_steepness()
        self.levels = 0
        if options.multilevel:
            self.levels = self._count_levels()
            if options.levels == "auto" and max_levels is not None:
                self.levels = min(self.levels, max_levels)
        self.memory = self._estimate_memory(required, fixed_count)

    @property
    def setup(self) -> Setup:
        """What all levels have in common."""
        n_fixed = len(self.fixed) + len(self.rows)
        return Setup(self.stages, self.domain, self.sizing, self.free, n_fixed, self.fixed, self.factor)

    def _place_layers(self, field: Field) -> Field:
        """Place the generators of the layers, and return the size field limited beside them."""
        domain, layers, n_cells = self.domain, self.options.layers, self.options.n_cells
        self._check_memory(count_rows(domain, layers))
        self.rows, self.free = place_layers(domain, layers), free_domain(domain, layers)
        least = len(self.rows) + max(self.free.n_pieces, len(self.fixed))
        if n_cells is not None and n_cells < least:
            raise InputError(
                f"n_cells is {n_cells}, but layers have {len(self.rows)} cells, expected at least {least}; leave "
                "n_cells out, or make the cells of the layers wider"
            )
        return limit_beside_layers(field, domain, layers)

    def _check_on_sphere(self, sphere: Sphere, required: float) -> None:
        """Raise if cells are too few or too large. `required` cells have the sizes of the field itself."""
        n_cells, places = self.options.n_cells, sphere.spiral_points(_PLACES)
        if self._tree is not None:
            scale = 1.0 if n_cells is None else (required / n_cells) ** 0.5
            h = scale * self.sizing(places)
            k = int(h.argmax())
            # As many equal cells as wanted have the size that they have.
            if h[k] > sphere.radius and (n_cells is None or h[k] > 1.01 * h.min()):
                lon, lat = sphere.lonlat(places[k : k + 1])[0]
                scaled = "" if n_cells is None else f" in a mesh of {n_cells} cells"
                remedy = (
                    "use smaller sizes, in the unit of the radius, or n_cells"
                    if n_cells is None
                    else "use more cells, or sizes that differ less"
                )
                raise SizeFieldError(
                    f"h{scaled} is {h[k]:.6g} at longitude {lon:.0f}, latitude {lat:.0f}, larger than the radius, "
                    f"{sphere.radius:g}; {remedy}"
                )
        least = LEAST_ADAPTED if self.options.multilevel else LEAST_ON_SPHERE
        if self.target < least:
            given = f"n_cells is {n_cells}" if n_cells else f"the size field requires {required:.2g} cells on {sphere}"
            fewer = f"; method='lloyd' makes {LEAST_ON_SPHERE} or more" if n_cells else ""
            raise InputError(
                f"{given}, expected at least {least} cells, on all sides of the sphere; use smaller sizes, in the unit "
                f"of the radius{fewer}"
            )

    def _warn_of_coarse_size(self, required: float) -> None:
        domain = self.domain
        message = (
            f"h is larger than the domain: the size field requires {required:.2g} cells in a domain of "
            f"{'area' if domain.cell_dim == 2 else 'volume'} {domain.measure:.6g}, and the mesh has a single cell; do "
            "h and the domain have the same unit of length?"
        )
        if isinstance(domain, Polygon) and may_be_degrees(domain.lower, domain.upper):
            message += " (Coordinates that are longitudes and latitudes must be projected first.)"
        warn(message, CoarseSizeWarning)

    def _estimate_memory(self, required: float, fixed_count: bool) -> float:
        """Return the bytes that the run needs on the device.

        Raises
        ------
        MemoryLimitError
        """
        domain, sizing, tree = self.domain, self.sizing, self._tree
        most = max(self.target, 0 if self.points is None else len(self.points))
        surplus, images, boundary = 0.0, None, None
        if self.options.multilevel and tree is not None:
            # Coarser levels have steeper sizes and pass their cells on to the next level. In 2D without coarser levels
            # as many additional cells appear on the finest one.
            reach = self.factor * (2 if self.levels or domain.cell_dim == 2 else 1)
            surplus = expected_surplus(*charted(domain, sizing), tree, reach)
        if any(domain.periodic) and tree is not None:
            free = most * tree.integral / required
            images = expected_images(domain, sizing, free, tree)
        field_bytes = sizing.device_bytes + sizing.bytes_for(most)
        self._check_memory(most, Extras(images, 0.0, field_bytes, 0.0))
        if isinstance(domain, Polygon) and not fixed_count:
            boundary = expected_boundary_cells(domain, lambda p: (required / most) ** 0.5 * sizing(p))
        needed = self._check_memory(most, Extras(images, surplus, field_bytes, boundary))
        # For few cells, the preparation may have taken more than the run.
        return max(needed, float(sizing.peak_bytes))

    def _is_narrow(self, coarseness: float) -> bool:
        """Return whether a gap between layers is narrower than `CELLS_ACROSS` cells of size ``coarseness * h``."""
        scale = CELLS_ACROSS / NARROW * coarseness * self.factor
        return narrow_parts(self.free, lambda x: scale * self.sizing(x))[0] is not None

    def _measure_steepness(self) -> float:
        """Return the share of the cells where sizes are steep; 0 where shape is not preferred to sizes.

        That is in 3D, on spheres, with few cells, which only serve a tight target, and with exact sizes.
        """
        tree, domain = self._tree, self.domain
        plane = isinstance(domain, Box | Polygon) and domain.dim == 2 and auto_levels(self.target, 2) > 0
        if tree is None or self.options.method != "adaptive" or not plane:
            return 0.0
        share = steep_share(self.factor * tree.slopes_of_size, tree.cells)
        return share if share >= LEAST_STEEP else 0.0

    def _count_levels(self) -> int:
        """Return the number of coarser levels, from the points of the caller or from a random sample."""
        d, levels, points = self.domain.cell_dim, self.options.levels, self.points
        if levels == "auto":
            if points is None:
                levels = auto_levels(self.target - len(self.rows), d)
                while levels and self.rows.size and self._is_narrow(2**levels):
                    levels -= 1
                return levels
            return max(0, round(math.log2(self.target / len(points)) / d))
        count = int(levels)
        least = LEAST_ADAPTED if isinstance(self.domain, Sphere) else 1
        most = int(math.log2(max(self.target / least, 1)) / d)
        if points is None and count > most:
            raise InputError(
                f"levels is {levels}, expected at most {most} for {self.target} cells, or 'auto': each "
                f"level has {2**d} times fewer"
            )
        begun = 0 if points is None else len(points) * 2.0 ** (d * min(count, 99))
        self._check_memory(begun)
        return count

    def _check_memory(self, n: float, extras: Extras | None = None) -> float:
        """Return the bytes that a run of `n` cells needs; raise if the device has less."""
        power = self.options.method == "transport"
        return check_memory(self.stages.engine, n, self.domain, extras, power=power)

    def generators(self) -> np.ndarray:
        """Return the initial generators (n, d): those of layers, then those of the caller or a random sample.

        Warns
        -----
        PrecisionWarning
            If positions do not resolve the sizes.
        """
        options, real = self.options, self.stages.engine.real
        host = self.points if self.lattice is None else self.lattice
        if host is None:
            least = self.free.n_pieces if self.levels else 1
            if isinstance(self.domain, Sphere):
                least = LEAST_ADAPTED if self.levels else LEAST_ON_SPHERE
            cells = (self.target - len(self.rows)) / 2 ** (self.domain.cell_dim * self.levels)
            n = max(least, round(cells))
            if isinstance(self.domain, Sphere) and n < EVEN_ON_SPHERE:
                host = self.domain.spiral_points(n)
            elif options.start == "uniform":
                host = sample_uniform(self.free, n, options.seed, real)
            else:
                host = sample_density(self.sizing, self.free, n, options.seed, real, self._tree)
        self._tree = None
        check_precision(self.sizing, self.domain, host, self.factor)
        if len(self.rows):
            host = np.concatenate([self.rows, apart_from(host, self.rows, self.free)])
        return host

    def mesh(self) -> MeshState:
        """Return the mesh of the initial generators."""
        host, real = self.generators(), self.stages.engine.real
        setup, upload = self.setup, self.stages.engine.upload
        placed = self.domain.place(host, real)
        labels = np.arange(setup.first_row, setup.first_row + len(host), dtype=np.int32)
        taken = np.full(len(self.fixed), -1, np.int32)
        if len(taken) and self.levels == 0:
            placed, labels, taken = take_places(placed, labels, self.fixed, self.domain, setup.fixed)
        with coincident_named(host, self.domain, real):
            start = {"points": upload(placed), "labels": upload(labels, np.int32)}
            mesh = MeshState(setup, self.factor * 2.0**self.levels, start)
        mesh.next_label, mesh.taken = setup.first_row + len(host), taken
        return mesh

    @property
    def may_need_correction_only(self) -> bool:
        """Whether the points of the caller may be a mesh that only needs a correction."""
        return self.points is not None and self.options.multilevel and self.levels == 0

    def schedule(self, mesh: MeshState | None) -> list[Action]:
        """Return the schedule. The initial `mesh` is only used if it `may_need_correction_only`."""
        options = self.options
        if not options.multilevel:
            relaxation = Relaxation(options.alpha, options.k)
            steps = STEPS if options.max_steps is None else options.max_steps
            method = make_method(options.method, relaxation, self.lattice, options.tol)
            return repeated_schedule(method, steps)
        near = self.may_need_correction_only and mesh is not None and self._is_near(mesh)
        dim, effort = self.domain.cell_dim, options.effort
        self._smooth_target = choose_error_target(dim, effort, self.levels, near)
        self.error_target = options.error_target or choose_error_target(dim, effort, self.levels, near, self.steep)
        exact = options.method in ("exact", "transport")
        schedule = adaptive_schedule(
            dim,
            effort,
            self.levels,
            exact,
            self.error_target,
            warm=self.points is not None,
            near=near,
            openings=OPENINGS if isinstance(self.domain, Sphere) else 0,  # models there have C grids
            narrow_parts=isinstance(self.domain, Polygon),
        )
        if options.method == "transport":
            schedule.append(Prescribe(MOVES))
        return schedule

    @property
    def trade(self) -> str:
        """The trade of sizes against shape, in words."""
        target = f"error target {self.error_target:.2g}"
        if self.options.error_target is not None:
            return f"{target}, as given"
        if self.steep == 0:
            return f"{target}: sizes come first"
        return (
            f"{target} in place of {self._smooth_target:.2g}, for cells of a better shape: sizes are steep for "
            f"{self.steep:.0%} of them"
        )

    def _is_near(self, mesh: MeshState) -> bool:
        n, n_cells = mesh.n, self.options.n_cells
        missing = mesh.missing_cells() if n_cells is None else float(n_cells - n)
        s = mesh.summaries.read()
        return is_near(
            self.domain.cell_dim, self.options.effort, n, missing, s["error"].magnitude / n, s["quality"].sum / n
        )


def _check_moving(domain: Domain, points: np.ndarray | None, options: Options) -> None:
    """Raise if a moving mesh cannot be made."""
    name = options.method
    if not isinstance(domain, Box) or any(domain.periodic):
        raise InputError(
            f"domain is {domain!r:.80}, expected a Box with walls for method {name!r}, which maps a lattice onto it; "
            "use method='adaptive'"
        )
    if points is not None or options.layers:
        given = "points are" if points is not None else "layers are"
        raise InputError(
            f"{given} given, but method {name!r} starts from a lattice of its own; leave them out, or use "
            "method='adaptive'"
        )
