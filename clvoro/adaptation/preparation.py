"""What a run begins with: its size field and number of cells, generators, mesh and plan."""

from __future__ import annotations

import math

import numpy as np

from ..arguments import Naming, warn
from ..errors import CoarseSizeWarning, InputError
from ..geometry.boundary_layers import apart_from, count_rows, free_domain, place_layers
from ..geometry.box import Domain
from ..geometry.geojson import may_be_degrees
from ..geometry.polygon import Polygon
from ..sizing import Sizing, as_field
from ..sizing.layers import limit_beside_layers
from .diagnostics import warn_of_mismatches
from .estimates import check_memory, memory_needed
from .forecast import images_expected, shore_expected, surplus_expected
from .methods import Relaxation, make_method
from .options import Options
from .precision import check_precision
from .sampling.quadrature import DensityTree
from .sampling.start import density_tree, sample_density, sample_uniform
from .schedule import Action, auto_levels, is_near, plan_adaptive, plan_steps
from .stages import Stages
from .state import Mesh

GRADIENT_STEP = 0.2
"""Step over h in which the exact projection sees the gradient of the size field."""
STEPS = 100
"""Steps of a method that repeats one kind of step, unless the caller says otherwise."""


class Preparation:
    """From options to a mesh and a plan.

    Parameters
    ----------
    stages : Stages
    domain : Domain
    size : number, callable or clvoro.sizing field
    points : (n, d) array, optional
        The caller's generators, checked.
    options : Options
    most_levels : int, optional
        Most coarser levels, where their number is left to this.

    Attributes
    ----------
    rows : (m, d) ndarray
        Generators of layers, which stay where they are.
    free : Domain
        What the layers leave.
    sizing : Sizing
    target : int
        Cells of the finest level.
    factor : float
        On the size field, so that it asks for `target` cells.
    levels : int
        Coarser levels that a plan begins with.
    memory : float
        Bytes that the run takes on the device, or reading its diagram, as far as can be told.

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
        most_levels: int | None = None,
    ) -> None:
        self.stages, self.domain, self.points, self.options = stages, domain, points, options
        n_cells, d = options.n_cells, domain.dim
        given = points is not None and not options.multilevel
        if points is not None and given and n_cells not in (None, len(points)):
            raise InputError(
                f"n_cells is {n_cells}, but {len(points)} points are given, and method {options.method!r} "
                "keeps their number; leave n_cells out, or use method='adaptive'"
            )
        self.rows, self.free = np.empty((0, d)), domain
        field = given_field = as_field(size)
        if options.layers:
            self._check_memory(count_rows(domain, options.layers))
            self.rows, self.free = (
                place_layers(domain, options.layers),
                free_domain(domain, options.layers),
            )
            if n_cells is not None and n_cells < len(self.rows) + self.free.n_pieces:
                raise InputError(
                    f"n_cells is {n_cells}, of which layers take {len(self.rows)}, expected at least "
                    f"{len(self.rows) + self.free.n_pieces}; leave n_cells out, or make the layers' cells wider"
                )
            field = limit_beside_layers(given_field, domain, options.layers)
        self.sizing = Sizing(stages.engine, domain, field, gradient_step=GRADIENT_STEP)
        self._tree: DensityTree | None = None
        if points is not None and given:
            asked = float(len(points))
        else:
            self._tree = density_tree(self.sizing, self.free)
            asked = self._tree.integral + len(self.rows)
        warn_of_mismatches(given_field, domain, options.layers)
        self.target = n_cells if n_cells is not None else max(1, round(asked))
        if n_cells is None and asked < 0.5:
            message = (
                f"the size field asks for {asked:.2g} cells in a domain of {domain.measure:.6g}, so that there will be "
                "one, too small; are h and the domain in the same unit of length?"
            )
            if isinstance(domain, Polygon) and may_be_degrees(domain.lower, domain.upper):
                message += (
                    " (Coordinates that are longitudes and latitudes have to be projected first.)"
                )
            warn(message, CoarseSizeWarning)
        most, images = max(self.target, 0 if points is None else len(points)), None
        scaled = options.multilevel and n_cells is not None
        self.factor = (asked / self.target) ** (1 / d) if scaled else 1.0
        self.levels = 0
        if options.multilevel:
            self.levels = self._count_levels()
            if options.levels == "auto" and most_levels is not None:
                self.levels = min(self.levels, most_levels)
        surplus, shore = 0.0, None
        if options.multilevel and self._tree is not None:
            # A coarser level has steeper sizes, and hands its generators on to the next; in the plane, where there is
            # none, as many come on the finest.
            reach = self.factor * (2 if self.levels or d == 2 else 1)
            surplus = surplus_expected(domain, self.sizing, self._tree, reach)
        if any(domain.periodic) and self._tree is not None:
            free = most * self._tree.integral / asked
            images = images_expected(domain, self.sizing, free, self._tree)
        held = self.sizing.device_bytes + self.sizing.bytes_for(most)
        self._check_memory(most, images, held=held, shore=0.0)
        if isinstance(domain, Polygon) and not given:
            shore = shore_expected(domain, lambda p: (asked / most) ** 0.5 * self.sizing(p))
        needed = self._check_memory(most, images, surplus, held, shore)
        # Of few cells, what has been done so far may take more than the run.
        self.memory = max(needed, float(self.sizing.peak_bytes))

    def _count_levels(self) -> int:
        """Return the number of coarser levels that lead to the cells, from the caller's points or from a sample."""
        d, levels, points = self.domain.dim, self.options.levels, self.points
        if levels == "auto":
            if points is None:
                return auto_levels(self.target, d)
            return max(0, round(math.log2(self.target / len(points)) / d))
        count = int(levels)
        most = int(math.log2(max(self.target, 1)) / d)
        if points is None and count > most:
            raise InputError(
                f"levels is {levels}, expected at most {most} for {self.target} cells, or 'auto': each "
                f"level has {2**d} times fewer"
            )
        begun = 0 if points is None else len(points) * 2.0 ** (d * min(count, 99))
        self._check_memory(begun)
        return count

    def _check_memory(
        self,
        n: float,
        images: float | None = None,
        surplus: float = 0.0,
        held: float = 0.0,
        shore: float | None = None,
    ) -> float:
        """Return the bytes that a run of `n` cells takes, if there are as many."""
        engine = self.stages.engine
        needed = memory_needed(engine, n, self.domain, images, surplus, held, shore)
        return check_memory(engine, n, needed)

    def generators(self) -> np.ndarray:
        """Return the first ones, (n, d): the caller's or a random sample of the coarsest level, after those of layers.

        Warns
        -----
        PrecisionWarning
            If their positions cannot tell sizes as small as those asked for.
        """
        options, real = self.options, self.stages.engine.real
        host = self.points
        if host is None:
            least = self.free.n_pieces if self.levels else 1
            cells = (self.target - len(self.rows)) / 2 ** (self.domain.dim * self.levels)
            n = max(least, round(cells))
            if options.start == "uniform":
                host = sample_uniform(self.free, n, options.seed, real)
            else:
                host = sample_density(self.sizing, self.free, n, options.seed, real, self._tree)
        self._tree = None
        check_precision(self.sizing, self.domain, host, self.factor)
        if len(self.rows):
            host = np.concatenate([self.rows, apart_from(host, self.rows, self.free)])
        return host

    def mesh(self) -> Mesh:
        """Return the mesh of the first generators."""
        host, real = self.generators(), self.stages.engine.real
        with Naming(host, self.domain, real):
            return Mesh(
                self.stages,
                self.domain,
                self.sizing,
                self.stages.engine.upload(self.domain.place(host, real)),
                coarsening=self.factor * 2.0**self.levels,
                free=self.free,
                fixed=len(self.rows),
            )

    @property
    def may_be_near(self) -> bool:
        """Whether the caller's points may be a mesh that only needs correction."""
        return self.points is not None and self.options.multilevel and self.levels == 0

    def plan(self, mesh: Mesh | None) -> list[Action]:
        """Return what is to be done. `mesh` (of `mesh`, as it begins) is looked at only if it `may_be_near`."""
        options = self.options
        if not options.multilevel:
            relaxation = Relaxation(options.alpha, options.k)
            steps = STEPS if options.max_steps is None else options.max_steps
            return plan_steps(make_method(options.method, relaxation), steps)
        near = self.may_be_near and mesh is not None and self._is_near(mesh)
        return plan_adaptive(
            self.domain.dim, options.effort, self.levels, options.method == "exact", options.error_target,
            warm=self.points is not None, near=near,
        )  # fmt: skip

    def _is_near(self, mesh: Mesh) -> bool:
        n, n_cells = mesh.n, self.options.n_cells
        missing = mesh.missing() if n_cells is None else float(n_cells - n)
        s = mesh.assess()
        return is_near(
            self.domain.dim, self.options.effort, n, missing, s["error"].magnitude / n, s["quality"].sum / n
        )  # fmt: skip
