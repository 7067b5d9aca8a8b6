"""The metric correction's Poisson equation on the neighbor graph, the paper's (3.2)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..errors import InputError
from ..opencl.launch import Launch, most_alone
from ..opencl.program import Engine, Kernels
from .conjugate_gradient import CURVATURE, BreakdownError, ConjugateGradient, Precondition, Solution
from .multigrid import Multigrid

_MOST_CYCLES = 200
ROUGH = 1e-3
"""Tolerance from which on the recurrence, whose vectors are then in single precision, is trusted with the residual.

It loses digits only far down, and the solution itself is summed up in full precision.
"""
_MOST_LOST = 5
"""Iterations that a solve may take more than the first with the same multigrid; a set-up costs about nine."""
_PRECONDITIONERS = ("auto", "jacobi", "multigrid")


def expected_costs(n: int, dim: int, tolerance: float, alone: bool = False) -> tuple[float, float]:
    """Return the expected cost of a solve with Jacobi's method and with multigrid, its set-up included.

    In milliseconds of processor time with PoCL on two cores, from fits to random and adapted
    meshes of 500 to 10^6 cells; on other devices the parts (enqueueing, cells) are larger or
    smaller alike. Jacobi's iterations grow with the mesh's width in cells, multigrid's do not; they cost next to
    nothing but the cells where one work-group goes through them `alone`.
    """
    digits, thousands = max(-math.log10(tolerance), 0.0), n / 1000
    iteration = 0.001 + 0.0105 * thousands if alone else 0.04 + 0.0085 * thousands
    jacobi = n ** (1 / dim) * (1.2 + 0.7 * digits) * iteration
    multigrid = 6 + 0.5 * thousands + (2 + 1.8 * digits) * (0.3 + 0.05 * thousands)
    return jacobi, multigrid


def most_iterations(n: int) -> int:
    """Return how many iterations Jacobi's method may take for `n` cells."""
    return 500 + 30 * math.isqrt(n)


@dataclass(frozen=True)
class Laplacian:
    """The assembled operator A = -Laplacian, symmetric to the last bit: device arrays.

    Attributes
    ----------
    starts : (n + 1,) int32
    neighbors : (m,) int32
        The diagram's: walls are negative.
    weights : (m,) real or float32
        w_ij = rho_ij l_ij / d_ij; 0 at walls.
    """

    starts: cla.Array
    neighbors: cla.Array
    weights: cla.Array

    def __len__(self) -> int:
        return len(self.starts) - 1


class Poisson:
    """Assembles and solves A phi = b with zero flux through the walls.

    Parameters
    ----------
    engine : Engine
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels: dict[tuple[np.dtype, np.dtype], Kernels] = {}
        self._krylov = ConjugateGradient(engine)
        self._multigrid: Multigrid | None = None
        self._prepared: Laplacian | None = None
        self._numbering: object = None
        self._at_best = self._latest = 0

    def clear(self) -> None:
        """Let go of all buffers, and of what the next solve might take over from the last."""
        self._prepared = self._numbering = None
        if self._multigrid is not None:
            self._multigrid.clear()

    def _kernels_in(self, store: np.dtype, face: np.dtype | None = None) -> Kernels:
        """Return the kernels for vectors, and measures of faces, in these precisions."""
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
    ) -> Laplacian:
        """Build (A phi)_i = sum_j w_ij (phi_i - phi_j), w_ij = rho_ij l_ij / |x_i - x_j|.

        Parameters
        ----------
        starts : (n + 1,) int32
        neighbors : (m,) int32
            Negative entries are walls.
        face_measures : (m,) real or single
        points : (n, d) real
            Generators.
        density : (n,) real, optional
            rho > 0; rho_ij is the geometric mean. Without it rho = 1.
        tolerance : float
            Of the solves to come. From `ROUGH` on, weights and the vectors of the iteration are in float32.

        Returns
        -------
        Laplacian
            Its weights are of the workspace: they last as long as the present frame.
        """
        engine = self.engine
        n = len(starts) - 1
        _check("points", points, (n, engine.dim))
        _check("face_measures", face_measures, neighbors.shape)
        if density is not None:
            _check("density", density, (n,))
        store = np.dtype(np.float32) if tolerance >= ROUGH else engine.real
        weights = engine.scratch(len(neighbors), store)
        weights.fill(0)
        engine.run(
            self._kernels_in(store, face_measures.dtype).assemble, n, np.int32(n),
            np.int32(density is not None), starts, neighbors, face_measures, points,
            points if density is None else density, weights, *self.engine.period_args,
        )  # fmt: skip
        return Laplacian(starts, neighbors, weights)

    def inverse_diagonal(self, laplacian: Laplacian) -> cla.Array:
        """Return the inverses of the sums of weights (n,), 0 of 0, in the workspace."""
        n, store = len(laplacian), laplacian.weights.dtype
        inverse = self.engine.scratch(n, store)
        self.engine.run(
            self._kernels_in(store).invert_diagonal, n, np.int32(n), laplacian.starts,
            laplacian.weights, inverse,
        )  # fmt: skip
        return inverse

    def compatible(self, source: cla.Array, volumes: cla.Array, rhs: cla.Array) -> cla.Array:
        """Set rhs_i = V_i (s_i - mean s), the mean weighted by volume, so that its sum is 0.

        Parameters
        ----------
        source, volumes, rhs : (n,) real
            s, V, and where the result goes (also returned).
        """
        size = np.int32(len(rhs))
        partial, kernels = self._krylov.partial, self._kernels_in(self.engine.real)
        self.engine.run_blocks(kernels.source_sums, size, source, volumes, partial)
        self.engine.run_blocks(kernels.compatible, size, source, volumes, rhs, partial)
        return rhs

    def apply(self, laplacian: Laplacian, x: cla.Array, y: cla.Array) -> None:
        """Enqueue y = A x, both in the precision of the weights; x may be in the engine's."""
        kernel, *args = self._launch(laplacian, x, y)
        self.engine.run_blocks(kernel, *args)

    def set_up_multigrid(self, laplacian: Laplacian, numbering: object = None) -> Multigrid:
        """Make the preconditioner for `laplacian` unless it was made last; `solve` does so.

        With the `numbering` of the last call only its finest level is made anew, as long as that
        costs the solves no more than `_MOST_LOST` iterations.
        """
        if self._multigrid is None:
            self._multigrid = Multigrid(self.engine)
        if self._prepared is laplacian:
            return self._multigrid
        operator = laplacian.starts, laplacian.neighbors, laplacian.weights
        if self._is_similar(numbering):
            self._multigrid.renew(*operator)
        else:
            self._multigrid.set_up(*operator)
            self._at_best = self._latest = 0
        self._prepared, self._numbering = laplacian, numbering
        return self._multigrid

    def save(self, numbering: object) -> dict[str, np.ndarray]:
        """Return what the next solve with this `numbering` takes over from the last; nothing if it begins anew."""
        if self._multigrid is None or not self._is_similar(numbering):
            return {}
        iterations = np.array([self._at_best, self._latest])
        return {"iterations": iterations, **self._multigrid.save()}

    def restore(self, arrays: Mapping[str, np.ndarray], numbering: object, n: int) -> None:
        """Go on from what `save` has returned, with the `numbering` of the `n` cells now.

        Raises
        ------
        KeyError, ValueError
            If it is unsound.
        """
        self._prepared = self._numbering = None
        if not arrays:
            return
        if self._multigrid is None:
            self._multigrid = Multigrid(self.engine)
        at_best, latest = map(int, arrays["iterations"])
        self._multigrid.restore(arrays, n)
        self._at_best, self._latest, self._numbering = at_best, latest, numbering

    def _is_similar(self, numbering: object) -> bool:
        """Tell whether the last multigrid will do for cells with this numbering."""
        similar = numbering is not None and numbering is self._numbering
        return similar and 0 < self._latest <= self._at_best + _MOST_LOST

    def solve(
        self,
        laplacian: Laplacian,
        rhs: cla.Array,
        potential: cla.Array,
        *,
        tolerance: float = 1e-8,
        max_iterations: int | None = None,
        preconditioner: str = "auto",
        numbering: object = None,
        from_zero: bool = False,
    ) -> Solution:
        """Solve A phi = b, the paper's (3.2) integrated over the cells; phi has mean zero.

        Parameters
        ----------
        laplacian : Laplacian
        rhs : (n,) real
            Its mean is taken away, as the operator's null space is the constants; see `compatible`.
        potential : (n,) real
            Start on entry (zeros, or the last step's), phi on return.
        tolerance : float
            Of the relative residual. In float32 about 1e-5 can be had, less on large meshes with a
            smooth right side: the solve then ends as ``"stagnated"``, with the residual reached.
        max_iterations : int, optional
        preconditioner : ``"auto"``, ``"jacobi"`` or ``"multigrid"``
            Multigrid leaves 15 to 22 iterations whatever the size; its set-up costs about as much
            as ten of them. ``"auto"`` takes what is expected to cost less (`expected_costs`): at
            tolerances of 1e-8 and 1e-2 multigrid from about 2000 and 3400 cells on in the plane,
            from 18,000 and 56,000 in space. Should multigrid break down, stagnate early, or not
            converge in 200 iterations where `max_iterations` is not given, Jacobi's method takes over
            from there; `Solution.reason` says so.
        numbering : object, optional
            One that is the same as in an earlier call tells that the cells are the same, in the same
            order, and have only moved a little: most of the multigrid is then used again.
        from_zero : bool
            Start from zero, whatever `potential` holds.

        Returns
        -------
        Solution

        Raises
        ------
        InputError
            If an argument has the wrong size or value.
        SolverError
            If a number is not finite, or the iteration breaks down with Jacobi's method.
        """
        n = len(laplacian)
        _check("rhs", rhs, (n,))
        _check("potential", potential, (n,))
        if preconditioner not in _PRECONDITIONERS:
            raise InputError(
                f"preconditioner got {preconditioner!r}, expected one of {_PRECONDITIONERS}"
            )
        if not tolerance > 0:
            raise InputError(f"tolerance got {tolerance!r}, expected a number > 0, such as 1e-8")
        operator = self._operator(laplacian)

        def run(precondition: cla.Array | Precondition, most: int, lookahead: int) -> Solution:
            return self._krylov.solve(
                operator,
                rhs,
                potential,
                precondition=precondition,
                tolerance=tolerance,
                max_iterations=most,
                fused=True,
                center=True,
                lookahead=lookahead,
                from_zero=from_zero,
                verify=tolerance < ROUGH,
                store=laplacian.weights.dtype,
                rows=(laplacian.starts, laplacian.neighbors, laplacian.weights),
            )

        def run_jacobi(most: int) -> Solution:
            with self.engine.workspace.frame():
                return run(self.inverse_diagonal(laplacian), most, 64)

        default = most_iterations(n)
        if preconditioner == "auto":
            alone = n <= most_alone(self.engine)
            jacobi, multigrid = expected_costs(n, self.engine.dim, tolerance, alone)
            preconditioner = "multigrid" if multigrid < jacobi else "jacobi"
        if preconditioner == "jacobi":
            most = default if max_iterations is None else max_iterations
            return run_jacobi(most)
        try:
            most = _MOST_CYCLES if max_iterations is None else max_iterations
            multigrid = self.set_up_multigrid(laplacian, numbering)
            # What is enqueued in vain costs a cycle each, a look of the host much less.
            first = run(
                multigrid.apply, most, max(1, min(self._latest - 1, 4)) if self._latest else 4
            )
            self._latest = first.iterations
            self._at_best = self._at_best or first.iterations
            # Far above what the precision allows it is the preconditioner, in float32, that is stuck.
            stuck = laplacian.weights.dtype == np.float64 and first.residual > 1e-8
            if first.reason == "stagnated" and stuck:
                cause = "multigrid stagnated"
            elif first.reason == "max_iterations" and max_iterations is None:
                cause = f"{most} iterations with multigrid"
            else:
                return first
            residuals = first.residuals
        except BreakdownError as breakdown:
            residuals, cause = breakdown.residuals, "multigrid broke down"
        if not residuals[-1] <= 1:
            potential.fill(0)
        done = len(residuals) - 1
        most = default if max_iterations is None else max(max_iterations - done, 0)
        from_zero = False
        second = run_jacobi(most)
        return Solution(
            done + second.iterations,
            second.residual,
            np.concatenate([residuals[:-1], second.residuals]),
            second.converged,
            f"{second.reason} (Jacobi after {cause})",
        )

    def _operator(self, laplacian: Laplacian) -> Callable[[cla.Array, cla.Array], None]:
        """Return `apply` for one operator; it sets the kernel's arguments when they change only."""
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
        operator = (laplacian.starts, laplacian.neighbors, laplacian.weights, x, y)
        if x.dtype != store:
            return kernels.apply_full, n, *operator
        return kernels.apply, n, np.int32(CURVATURE), *operator, self._krylov.partial


def _check(name: str, array: cla.Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(f"{name} got shape {array.shape}, expected {shape}")
