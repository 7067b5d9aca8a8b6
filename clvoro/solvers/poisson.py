"""The Poisson equation on the neighbor graph, the paper's (3.2).

`Poisson.assemble` assembles the matrix, with the kernel `assemble_laplacian` in poisson.cl. `Poisson.solve` solves the
equation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ..errors import InputError
from ..opencl.engine import Engine, PartialSums
from ..opencl.kernels import Kernels
from ..opencl.launch import COSTS_ON_CPU, CostFactors, Launch, cost_factors, one_group_limit
from .components import connected_components
from .conjugate_gradient import CURVATURE, ConjugateGradient
from .linear_system import BreakdownError, Limits, Operator, Precondition, Solution
from .multigrid import Multigrid

if TYPE_CHECKING:
    from ..tessellation.part import Ghosts, Part

SINGLE_PRECISION_TOLERANCE = 1e-3
"""Tolerance from which on weights and the iteration's vectors are in float32 and the recurrence's residual is trusted.

The recurrence loses digits only far below this tolerance, and the solution is summed up in full precision.
"""
_MAX_CYCLES = 200
_MAX_EXTRA_ITERATIONS = 5
"""Iterations a solve with a reused multigrid may take more than the first one. A set-up costs about nine."""
_PRECONDITIONERS = ("auto", "jacobi", "multigrid")


def expected_costs(
    n: int, dim: int, tolerance: float, one_group: bool = False, factors: CostFactors = COSTS_ON_CPU
) -> tuple[float, float]:
    """Return the expected costs of a solve with Jacobi's preconditioner and with multigrid, set-up included.

    The costs are milliseconds. A part is for launches, and a part for cells. Both come from fits to random and adapted
    meshes of 500 to 10^6 cells with PoCL on two cores. On other devices the parts change by `factors`. Jacobi's
    iterations grow with the number of cells across the mesh, multigrid's do not. With `one_group` one work-group does
    all Jacobi iterations, which then cost little per launch.
    """
    digits, thousands = max(-math.log10(tolerance), 0.0), n / 1000
    launches, cells = factors
    iteration = launches * 0.04 + cells * 0.0085 * thousands
    if one_group:
        iteration = 0.001 + 0.0105 * thousands
    jacobi = n ** (1 / dim) * (1.2 + 0.7 * digits) * iteration
    cycle = launches * 0.3 + cells * 0.05 * thousands
    multigrid = launches * 6 + cells * 0.5 * thousands + (2 + 1.8 * digits) * cycle
    return jacobi, multigrid


def max_jacobi_iterations(n: int) -> int:
    """Return how many iterations Jacobi's preconditioner may take for `n` cells."""
    return 500 + 30 * math.isqrt(n)


@dataclass(frozen=True)
class Laplacian:
    """The assembled operator A = -Laplacian, symmetric to the last bit: device arrays."""

    starts: cla.Array
    """(n + 1,) int32."""
    neighbors: cla.Array
    """(m,) int32. Neighbors of the diagram, or ghosts with `part`; walls are negative."""
    weights: cla.Array
    """(m,) real or float32. w_ij = rho_ij l_ij / d_ij; 0 at walls."""
    part: Part | None = None
    """If neighbors are ghosts whose owners are in other parts."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def rows(self) -> tuple[cla.Array, cla.Array, cla.Array]:
        """The three arrays, as kernels take them."""
        return self.starts, self.neighbors, self.weights

    @property
    def ghosts(self) -> Ghosts | None:
        """Owners of the neighbors in other parts."""
        return None if self.part is None else self.part.ghosts


@dataclass(frozen=True)
class _Equation:
    """One system A phi = b and how accurately it is solved."""

    laplacian: Laplacian
    operator: Operator
    rhs: cla.Array
    potential: cla.Array
    tolerance: float


class Poisson:
    """Assembles and solves A phi = b with zero flux through the walls."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels: dict[tuple[np.dtype, np.dtype], Kernels] = {}
        self._conjugate_gradient = ConjugateGradient(engine)
        self._multigrid: Multigrid | None = None
        self._multigrid_of: Laplacian | None = None
        self._ordering: object = None
        # Iterations of the first and of the last solve with the present aggregates.
        self._first_iterations = self._last_iterations = 0

    def clear(self) -> None:
        """Free all buffers, and discard the data that the next solve could reuse."""
        self._multigrid_of = self._ordering = None
        if self._multigrid is not None:
            self._multigrid.clear()

    def _kernels_in(self, store: np.dtype, face: np.dtype | None = None) -> Kernels:
        """Return the kernels for vectors in `store` and face measures in `face`."""
        key = store, self.engine.face if face is None else face
        if key not in self._kernels:
            names = (self.engine.name_of(real) for real in key)
            defines: dict[str, object] = dict(zip(("STORE", "FACE"), names, strict=True))
            self._kernels[key] = self.engine.kernels("solvers/poisson", defines)
        return self._kernels[key]

    def assemble(
        self,
        starts: cla.Array,
        neighbors: cla.Array,
        face_measures: cla.Array,
        points: cla.Array,
        density: cla.Array | None = None,
        *,
        tolerance: float = 0.0,
        part: Part | None = None,
    ) -> Laplacian:
        """Assemble the Poisson matrix, the paper's (3.2) integrated over the cells.

        (A phi)_i = sum_j w_ij (phi_i - phi_j), w_ij = rho_ij l_ij / |x_i - x_j|.

        - `starts`: (n + 1,) int32
        - `neighbors` (m,) int32: negative entries are walls.
        - `face_measures`: (m,) real or single
        - `points` (n or more, d) real: generators, and ghosts that neighbors name.
        - `density` (n or more,) real: rho > 0, that of ghosts as well; rho_ij is the geometric mean. By default rho =
          1.
        - `tolerance`: tolerance of the solves to come. From `SINGLE_PRECISION_TOLERANCE` on weights and vectors are in
          float32.
        - `part`: the part whose rows `neighbors` names, if it has ghosts. If owners are in other parts, `apply` takes x
          with their values, and all parts call `solve` together.

        Its weights are in the workspace and valid to the end of the present frame.
        """
        engine = self.engine
        n = len(starts) - 1
        _check("points", points, (max(n, len(points)), engine.dim))
        _check("face_measures", face_measures, neighbors.shape)
        if density is not None:
            _check("density", density, (len(points),))
        store = np.dtype(np.float32) if tolerance >= SINGLE_PRECISION_TOLERANCE else engine.real
        weights = engine.scratch(len(neighbors), store)
        weights.fill(0)
        kernel = self._kernels_in(store, face_measures.dtype).assemble_laplacian
        faces = starts, neighbors, face_measures, points, points if density is None else density
        given = np.int32(n), np.int32(density is not None), *faces, weights, *engine.period_args
        engine.run(kernel, n, *given)
        return Laplacian(starts, neighbors, weights, None if part is None or part.peers is None else part)

    def inverse_diagonal(self, laplacian: Laplacian) -> cla.Array:
        """Return the inverse row sums of the weights (n,), 0 for a sum of 0, in the workspace."""
        n, store = len(laplacian), laplacian.weights.dtype
        inverse = self.engine.scratch(n, store)
        self.engine.run(
            self._kernels_in(store).invert_diagonal, n, np.int32(n), laplacian.starts, laplacian.weights, inverse
        )
        return inverse

    def subtract_mean_source(self, source: cla.Array, volumes: cla.Array, rhs: cla.Array) -> cla.Array:
        """Set rhs_i = V_i (s_i - mean s), mean s = sum V s / sum V, so that its sum is 0.

        The equation with zero flux through all walls has solutions only for such right sides.

        - `source`, `volumes`, `rhs` (n,) real: s, V and the result, which is also returned.
        """
        size = np.int32(len(rhs))
        # These kernels are the same for both precisions of the weights, which are mostly single.
        partial, kernels = self._conjugate_gradient.partial, self._kernels_in(np.dtype(np.float32))
        self.engine.run_blocks(kernels.sum_sources, size, source, volumes, partial)
        self.engine.sum_over_parts(PartialSums(partial, (0, 1)))
        self.engine.run_blocks(kernels.subtract_mean_source, size, source, volumes, rhs, partial)
        return rhs

    def apply(self, laplacian: Laplacian, x: cla.Array, y: cla.Array) -> None:
        """Enqueue y = A x, both in the precision of the weights; x may also be in that of the engine."""
        self._apply_of(laplacian)(x, y)

    def set_up_multigrid(self, laplacian: Laplacian, ordering: object = None) -> Multigrid:
        """Return the preconditioner for `laplacian`, built unless it was built last. `solve` calls this.

        With the `ordering` of the last call only its finest level is recomputed, as long as solves take at most
        `_MAX_EXTRA_ITERATIONS` iterations more than the first one.
        """
        if self._multigrid is None:
            self._multigrid = Multigrid(self.engine)
        if self._multigrid_of is laplacian:
            return self._multigrid
        if self._can_reuse(ordering):
            self._multigrid.update_finest(*laplacian.rows, laplacian.ghosts)
        else:
            self._multigrid.set_up(*laplacian.rows, laplacian.ghosts)
            self._first_iterations = self._last_iterations = 0
        self._multigrid_of, self._ordering = laplacian, ordering
        return self._multigrid

    def _can_reuse(self, ordering: object) -> bool:
        """Return whether the coarse levels of the last multigrid serve for cells in this ordering."""
        same = ordering is not None and ordering is self._ordering
        most = self._first_iterations + _MAX_EXTRA_ITERATIONS
        return same and 0 < self._last_iterations <= most

    def solve(
        self,
        laplacian: Laplacian,
        rhs: cla.Array,
        potential: cla.Array,
        *,
        tolerance: float = 1e-8,
        max_iterations: int | None = None,
        preconditioner: str = "auto",
        ordering: object = None,
        from_zero: bool = False,
        max_cycles: int | None = None,
    ) -> Solution:
        """Solve A phi = b, the paper's (3.2) integrated over the cells; phi has mean zero.

        - `rhs` (n,) real: its mean is removed, because the null space of A is the constants; see
          `subtract_mean_source`.
        - `potential` (n,) real: start on entry (zeros, or the solution of the last step), phi on return.
        - `tolerance`: relative residual. float32 reaches about 1e-5, less on large meshes with a smooth right side: the
          solve then ends as ``"stagnated"`` with the residual that it reached.
        - `preconditioner` ``"auto"``, ``"jacobi"`` or ``"multigrid"``: multigrid takes 15 to 22 iterations for any
          size; its set-up costs about as much as ten. ``"auto"`` takes the cheaper one by `expected_costs`: on CPUs, at
          tolerances of 1e-8 and 1e-2, multigrid from about 2000 and 3400 cells on in 2D, from 18,000 and 56,000 in 3D.
          If multigrid breaks down, stagnates early, or does not converge in 200 iterations without `max_iterations`,
          Jacobi's preconditioner continues; `Solution.reason` says so.
        - `ordering`: the same object as in an earlier call states that the cells are the same, in the same order, and
          have moved little. The coarse levels of the multigrid are then reused.
        - `from_zero`: start from zero and ignore `potential`.
        - `max_cycles`: most iterations with multigrid, whatever their residual.

        Raises `InputError` if an argument has the wrong size or value. Raises `SolverError` if a number is not finite,
        or the iteration breaks down with Jacobi's preconditioner. If the graph is not connected, the mean of the right
        side in each part of it is subtracted before a second try.
        """
        n, part = len(laplacian), laplacian.part
        _check("rhs", rhs, (n,))
        _check("potential", potential, (n,))
        if preconditioner not in _PRECONDITIONERS:
            raise InputError(f"preconditioner got {preconditioner!r}, expected one of {_PRECONDITIONERS}")
        if not tolerance > 0:
            raise InputError(f"tolerance got {tolerance!r}, expected a number > 0, such as 1e-8")
        rows = laplacian.rows if part is None else None
        operator = Operator(self._apply_of(laplacian), writes_curvature=True, singular=True, rows=rows, part=part)
        system = _Equation(laplacian, operator, rhs, potential, tolerance)
        if part is not None:
            n = int(self.engine.peers.total(n))
        if preconditioner == "auto":
            one_group = part is None and n <= one_group_limit(self.engine)
            factors = cost_factors(self.engine.queue.device)
            jacobi, multigrid = expected_costs(n, self.engine.cell_dim, tolerance, one_group, factors)
            preconditioner = "multigrid" if multigrid < jacobi else "jacobi"
        if preconditioner == "jacobi":
            most = max_jacobi_iterations(n) if max_iterations is None else max_iterations
            return self._solve_jacobi(system, most, from_zero)
        most = max_iterations if max_cycles is None else max_cycles
        return self._solve_multigrid(system, most, ordering, from_zero)

    def _solve_jacobi(self, system: _Equation, max_iterations: int, from_zero: bool) -> Solution:
        with self.engine.workspace.frame():
            inverse = self.inverse_diagonal(system.laplacian)
            try:
                return self._run(system, inverse, max_iterations, 64, from_zero)
            except BreakdownError:
                if (balanced := self._balanced(system)) is None:
                    raise
                return self._run(balanced, inverse, max_iterations, 64, from_zero=True)

    def _balanced(self, system: _Equation) -> _Equation | None:
        """Return a system without the mean of its right side in each connected part of the graph.

        It has no solution otherwise. None if there is one part, or cells are in other processes.
        """
        laplacian = system.laplacian
        if laplacian.part is not None:
            return None
        starts = laplacian.starts.get()
        weights, columns = (array.get()[: starts[-1]] for array in (laplacian.weights, laplacian.neighbors))
        component = connected_components(starts, np.where(weights > 0, columns, -1))
        values, sizes = system.rhs.get(), np.bincount(component)
        if len(sizes) == 1:
            return None
        means = np.bincount(component, values) / sizes
        # A cell without neighbors has no one that could absorb its round-off.
        values = np.where(sizes[component] == 1, 0, values - means[component]).astype(values.dtype)
        return replace(system, rhs=self.engine.upload(values, values.dtype))

    def _solve_multigrid(
        self, system: _Equation, max_iterations: int | None, ordering: object, from_zero: bool
    ) -> Solution:
        """Solve with multigrid, and with Jacobi's preconditioner from there if that fails."""
        most = _MAX_CYCLES if max_iterations is None else max_iterations
        try:
            multigrid = self.set_up_multigrid(system.laplacian, ordering)
            # An unnecessary iteration costs a cycle, which is much more than a read by the host. Parts make none.
            last = self._last_iterations
            lookahead = most if self.engine.peers.count > 1 else max(1, min(last - 1, 4)) if last else 4
            first = self._run(system, multigrid.apply, most, lookahead, from_zero)
            self._last_iterations = first.iterations
            self._first_iterations = self._first_iterations or first.iterations
            # Far above the limit of double precision the preconditioner, in float32, is the cause.
            double = system.laplacian.weights.dtype == np.float64
            if first.reason == "stagnated" and double and first.residual > 1e-8:
                cause = "multigrid stagnated"
            elif first.reason == "max_iterations" and max_iterations is None:
                cause = f"{most} iterations with multigrid"
            else:
                return first
            residuals = first.residuals
        except BreakdownError as breakdown:
            residuals, cause = breakdown.residuals, "multigrid broke down"
        if not residuals[-1] <= 1:
            system.potential.fill(0)
        done = len(residuals) - 1
        if max_iterations is None:
            most = max_jacobi_iterations(int(self.engine.peers.total(len(system.rhs))))
        else:
            most = max(max_iterations - done, 0)
        second = self._solve_jacobi(system, most, from_zero=False)
        return Solution(
            done + second.iterations,
            second.residual,
            np.concatenate([residuals[:-1], second.residuals]),
            second.converged,
            f"{second.reason} (Jacobi after {cause})",
        )

    def _run(
        self,
        system: _Equation,
        precondition: cla.Array | Precondition,
        max_iterations: int,
        lookahead: int,
        from_zero: bool,
    ) -> Solution:
        """Run conjugate gradients."""
        verify = system.tolerance < SINGLE_PRECISION_TOLERANCE
        limits = Limits(system.tolerance, max_iterations, lookahead, verify)
        return self._conjugate_gradient.solve(
            system.operator,
            system.rhs,
            system.potential,
            precondition,
            limits,
            from_zero=from_zero,
            store=system.laplacian.weights.dtype,
        )

    def _apply_of(self, laplacian: Laplacian) -> Callable[[cla.Array, cla.Array], None]:
        """Return a function that enqueues y = A x. It sets the kernel's arguments only when they change."""
        last: list = [None, None, None]

        def apply(x: cla.Array, y: cla.Array) -> None:
            if last[0] is not x or last[1] is not y:
                last[:] = x, y, Launch(self.engine, *self._launch(laplacian, x, y))
            last[2]()

        return apply

    def _launch(self, laplacian: Laplacian, x: cla.Array, y: cla.Array) -> tuple:
        """Return the kernel that applies the operator, and its arguments."""
        store = laplacian.weights.dtype
        kernels, n = self._kernels_in(store), np.int32(len(laplacian))
        if x.dtype != store:
            return kernels.apply_laplacian_full, n, *laplacian.rows, x, y
        partial = self._conjugate_gradient.partial
        return kernels.apply_laplacian, n, np.int32(CURVATURE), *laplacian.rows, x, y, partial


def _check(name: str, array: cla.Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(f"{name} got shape {array.shape}, expected {shape}")
