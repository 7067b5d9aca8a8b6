"""Preconditioned conjugate gradients on the device, for any operator that can enqueue itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ._launch import Launch, most_alone
from ._program import Engine, Kernels
from ._workspace import framed
from .errors import SolverError

Apply = Callable[[cla.Array, cla.Array], object]
Precondition = Callable[[cla.Array, cla.Array, cla.Array], object]

# Rows of the array of partial sums, and columns of the record: as in cl_kernels/krylov.cl.
CURVATURE, _GAMMA, _ROWS = 3, 6, 11
_NORM, _RUNNING, _CURVATURE = 0, 2, 3
_STATE = 8
_FIRST_READ = 32
"""Iterations whose record is read together with the state that `solve_alone` leaves."""


@dataclass(frozen=True)
class Solution:
    """How an iterative solve went.

    Attributes
    ----------
    iterations : int
    residual : float
        True relative residual ||b - A x|| / ||b|| (2-norm), evaluated from x at the end; the
        recurrence's where only few digits are asked for.
    residuals : (iterations + 1,) float64
        The relative residual before each iteration, as the recurrence tracks it, and the last one.
    converged : bool
        Whether `residual` is within the tolerance.
    reason : str
        ``"converged"``, ``"zero right side"``, ``"stagnated"`` (the precision allows no less) or
        ``"max_iterations"``; followed by ``" (Jacobi after ...)"`` where the preconditioner asked
        for was given up on the way. Iterations and residuals are then those of both.
    """

    iterations: int
    residual: float
    residuals: np.ndarray
    converged: bool
    reason: str


class BreakdownError(SolverError):
    """The operator or the preconditioner was found not to be positive definite, or not finite.

    Attributes
    ----------
    residuals : (iterations + 1,) float64
        As in `Solution`. The iterate is that of the last good iteration.
    """

    def __init__(self, message: str, residuals: list[float]) -> None:
        super().__init__(message)
        self.residuals = np.array(residuals)


class ConjugateGradient:
    """Conjugate gradients for a symmetric positive (semi-)definite operator.

    All vectors and scalars stay on the device. The host enqueues iterations ahead, as many as the
    convergence so far lets it expect, and then reads one row of scalars for each; the iterate is
    frozen on the device when the tolerance is met, so the result does not depend on when the host
    looks.

    Parameters
    ----------
    engine : Engine
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels: dict[np.dtype, Kernels] = {}
        self.partial = engine.zeros(_ROWS * engine.groups)
        """Partial sums; a fused operator leaves those of (x, A x) in row `CURVATURE`."""
        self._state = engine.zeros(6)
        self._record_capacity = 0
        self._alone = engine.zeros(_STATE + 4)
        self._most_alone = most_alone(engine)

    def _kernels_in(self, store: np.dtype) -> Kernels:
        if store not in self._kernels:
            self._kernels[store] = self.engine.kernels(
                "krylov", {"STORE": self.engine.name_of(store)}
            )
        return self._kernels[store]

    @framed
    def solve(
        self,
        apply: Apply,
        rhs: cla.Array,
        x: cla.Array,
        *,
        precondition: cla.Array | Precondition,
        tolerance: float,
        max_iterations: int,
        fused: bool = False,
        centre: bool = False,
        lookahead: int = 64,
        from_zero: bool = False,
        verify: bool = True,
        store: np.dtype | None = None,
        rows: tuple[cla.Array, ...] | None = None,
    ) -> Solution:
        """Solve A x = b from the start `x`, in place.

        Parameters
        ----------
        apply : callable (x, y)
            Enqueues y = A x on the engine's queue; y is in `store`, and so is x but for the start and the solution.
            The operator must be symmetric.
        rhs, x : (n,) real, device
        precondition : (n,) store or callable (r, u, spare)
            The inverse of a diagonal, or what enqueues u = M^-1 r, M symmetric positive definite, all in `store`;
            `spare` is a vector that it may use.
        tolerance : float
            Of the relative residual in the 2-norm.
        max_iterations : int
        fused : bool
            `apply` leaves the partial sums of (x, y) in row `CURVATURE` of `partial` itself.
        centre : bool
            The operator's null space is the constants: take the mean of the right side away first
            and that of x at the end.
        lookahead : int
            The most iterations to enqueue before the host looks; the first look is after that many, or 8.
        from_zero : bool
            Start from zero, whatever `x` holds: saves an application of the operator.
        verify : bool
            Evaluate the true residual at the end; else trust the recurrence's that it is within the tolerance.
        store : numpy.dtype, optional
            Of the iteration's vectors: the engine's precision or, where few digits are asked for, float32.
        rows : tuple of device arrays, optional
            Starts, columns and weights (see cl_kernels/common/rows.h) where the operator has them: where unknowns are
            few and the preconditioner is a diagonal, one work-group then solves alone.

        Returns
        -------
        Solution

        Raises
        ------
        SolverError
            If a number of the right side, start or operator is not finite.
        BreakdownError
            If the operator or preconditioner is not positive definite: a SolverError, too.
        """
        store = self.engine.real if store is None else np.dtype(store)
        n = len(rhs)
        if max_iterations > self._record_capacity:
            self._record_capacity = max_iterations
            self._record = self.engine.zeros(4 * (max_iterations + 1))
            self._alone = self.engine.zeros(_STATE + 4 * (max_iterations + 1))
        diagonal = isinstance(precondition, cla.Array)
        if rows is not None and diagonal and n <= self._most_alone:
            return self._solve_alone(
                store, rows, rhs, x, precondition, tolerance, max_iterations, centre, from_zero, verify
            )  # fmt: skip
        kernels, launch = self._kernels_in(store), self.engine.run_blocks
        r, u, p, q = (self.engine.scratch(n, store) for _ in range(4))
        size, zero, mean = np.int32(n), np.int32(0), np.int32(centre)
        groups, group = np.int32(self.engine.groups), self.engine.group_size
        # The recurrence stops a little lower, so that the true residual is within the tolerance.
        limit = self.engine.real.type(0.95 * tolerance)
        tail = (self.partial, self._state, self._record)
        direction = Launch(self.engine, kernels.direction, zero, size, limit, u, p, *tail)
        if diagonal:
            update = Launch(
                self.engine,
                kernels.update_jacobi,
                zero,
                size,
                mean,
                precondition,
                p,
                q,
                x,
                r,
                u,
                *tail,
            )
        else:
            update = Launch(self.engine, kernels.update, zero, size, mean, p, q, x, r, *tail)

        def alone(kernel: cl.Kernel, *args: object) -> None:
            """Enqueue a kernel of one work-group."""
            self.engine.run(kernel, group, *args, group=group)

        def look(k: int) -> None:
            """Have row k of the record tell whether there is an iteration k."""
            alone(kernels.look, np.int32(k), *tail, groups)

        def measure(zero: bool = False) -> float:
            """Set r to the true residual and return its relative norm; negative: b is zero."""
            if not zero:
                apply(x, q)
            anew = np.int32(zero)
            launch(kernels.residual, size, anew, rhs, q, self.partial)
            launch(
                kernels.begin, size, anew, mean, rhs, q, x, r, p, self.partial, self._state
            )  # fmt: skip
            alone(kernels.sum_norms, self.partial, self._state, groups)
            return self._relate(*self._state.get()[2:])

        def iterate(k: int) -> None:
            if not isinstance(precondition, cla.Array):
                precondition(r, u, q)
                launch(kernels.dot_product, size, np.int32(_GAMMA + (k & 1)), r, u, self.partial)
            direction.set_first(k)
            direction()
            apply(p, q)
            if not fused:
                launch(kernels.dot_product, size, np.int32(CURVATURE), p, q, self.partial)
            update.set_first(k)
            update()

        iterations, history, reason = 0, [], "max_iterations"
        residual = measure(from_zero)
        if residual < 0:
            x.fill(0)
            return Solution(0, 0.0, np.zeros(1), True, "zero right side")
        while True:
            if residual <= tolerance:
                reason = "converged"
                break
            if iterations >= max_iterations:
                break
            if diagonal:
                launch(kernels.jacobi, size, precondition, r, u, self.partial)
            most = max_iterations - iterations
            iterations += self._cycle(iterate, look, most, tolerance, residual, lookahead, history)
            if not verify and self._left <= tolerance:
                residual, reason = self._left, "converged"
                break
            before, residual = residual, measure()
            # A restart gains digits as long as the recurrence, not x's precision, was the limit.
            if residual > max(tolerance, 0.5 * before) and iterations < max_iterations:
                reason = "stagnated"
                break
        if centre:
            launch(kernels.add_up, size, x, self.partial)
            launch(kernels.remove_mean, size, x, self.partial)
        residuals = np.array([*history, residual])
        return Solution(iterations, residual, residuals, residual <= tolerance, reason)

    def _solve_alone(
        self,
        store: np.dtype,
        rows: tuple[cla.Array, ...],
        rhs: cla.Array,
        x: cla.Array,
        inverse_diagonal: cla.Array,
        tolerance: float,
        max_iterations: int,
        centre: bool,
        from_zero: bool,
        verify: bool,
    ) -> Solution:
        """Have one work-group solve, in a launch for each time that the recurrence is begun."""
        engine, real, n = self.engine, self.engine.real.type, len(rhs)
        vectors = (engine.scratch(n, store) for _ in range(4))
        given = (*rows, inverse_diagonal, rhs, x, *vectors, self.partial, self._alone)
        kernel, done, history, most = self._kernels_in(store).solve_alone, 0, [], math.inf
        while True:
            left = max_iterations - done
            Launch(
                engine, kernel, np.int32(n), np.int32(from_zero), np.int32(centre),
                np.int32(left), real(0.95 * tolerance), real(tolerance),
                real(min(most, float(np.finfo(real).max))), *given, groups=1,
            )()  # fmt: skip
            host = self._alone[: _STATE + 4 * min(left, _FIRST_READ)].get()
            residual = self._relate(*host[2:6])
            if residual < 0:
                x.fill(0)
                return Solution(0, 0.0, np.zeros(1), True, "zero right side")
            converged = residual <= tolerance
            if converged or left == 0 or residual > most:
                reason = "converged" if converged else "stagnated" if left else "max_iterations"
                break
            taken = self._follow(host[_STATE:], 0, tolerance, history)
            if taken is None and left > _FIRST_READ:
                host = self._alone[_STATE : _STATE + 4 * left].get()
                taken = self._follow(host[4 * _FIRST_READ :], _FIRST_READ, tolerance, history)
            done += left if taken is None else taken
            if not verify and self._left <= tolerance:
                residual, converged, reason = self._left, True, "converged"
                break
            # As in `solve`.
            from_zero, most = False, max(tolerance, 0.5 * residual)
        return Solution(done, residual, np.array([*history, residual]), converged, reason)

    def _relate(self, taken: float, _: float, norm_b: float, norm_r: float) -> float:
        """Return the relative residual by the state of the device; negative: b is zero."""
        if not (math.isfinite(norm_b) and math.isfinite(norm_r)):
            raise SolverError(
                f"the linear solve got a right side, start or operator that is not finite: "
                f"|b|^2 = {norm_b}, |b - A x|^2 = {norm_r} after scaling; check the input"
            )
        # What is left of a constant right side is rounding.
        if norm_b <= (8 * np.finfo(self.engine.real).eps) ** 2 * taken:
            return -1.0
        self._norm_b = float(norm_b)
        return math.sqrt(norm_r / norm_b)

    def _cycle(
        self,
        iterate: Callable[[int], None],
        look: Callable[[int], None],
        most: int,
        tolerance: float,
        residual: float,
        lookahead: int,
        history: list[float],
    ) -> int:
        """Iterate from the residual in place until it stops, or `most` times; return how often."""
        done, ahead, first = 0, min(8, lookahead), residual
        while done < most:
            end = min(done + ahead, most)
            for k in range(done, end):
                iterate(k)
            look(end)
            rows = self._record[4 * done : 4 * (end + 1)].get()
            stop = self._follow(rows, done, tolerance, history)
            if stop is not None:
                return stop
            residual = history.pop()  # the next iteration leaves it again
            done = end
            rate = math.log(first / residual) / done if residual < first else 0.0
            left = math.log(residual / tolerance) / rate if rate > 0 else lookahead
            ahead = min(max(math.ceil(left), 1), lookahead)
        return done

    def _follow(
        self, record: np.ndarray, begin: int, tolerance: float, history: list[float]
    ) -> int | None:
        """Take over the record from iteration `begin` on; return the iteration that stopped, if one did."""
        self._left = math.inf
        for k, row in enumerate(record.reshape(-1, 4).astype(np.float64), start=begin):
            residual = math.sqrt(row[_NORM] / self._norm_b)
            if row[_RUNNING] == 0 or not row[_CURVATURE] > 0:
                self._left = residual
                self._judge(k, row, residual, tolerance, history)
                return k
            history.append(residual)
        return None

    def _judge(
        self, k: int, row: np.ndarray, residual: float, tolerance: float, history: list[float]
    ) -> None:
        """Tell a stop at the tolerance, or at the precision's limit, from a breakdown at k."""
        if residual <= tolerance:
            return
        # Far down, rounding may take the sign of these; the true residual then decides what to do.
        if k > 0 and residual < 1e-3:
            return
        curvature = row[_CURVATURE] if row[_RUNNING] else math.nan
        raise BreakdownError(
            f"conjugate gradients broke down at iteration {k}: (r, M^-1 r) = {row[1]:.3g}, "
            f"curvature (p, A p) = {curvature:.3g}, relative residual {residual:.3g}; the first "
            "two must be positive and finite: the operator or its preconditioner is not "
            "positive definite",
            [*history, residual],
        )
