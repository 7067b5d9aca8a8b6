"""Preconditioned conjugate gradients on the device, for any operator that can enqueue itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import SolverError
from ..opencl.launch import Launch, most_alone
from ..opencl.program import Engine, Kernels
from ..opencl.workspace import framed

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
        self.state = engine.zeros(6)
        self._record_capacity = 0
        self._alone = engine.zeros(_STATE + 4)
        self._most_alone = most_alone(engine)

    def kernels_in(self, store: np.dtype) -> Kernels:
        """Return the kernels whose vectors are in `store`."""
        if store not in self._kernels:
            self._kernels[store] = self.engine.kernels(
                "solvers/conjugate_gradient", {"STORE": self.engine.name_of(store)}
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
        center: bool = False,
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
        center : bool
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
            Starts, columns and weights of the operator's matrix, if it has one (see solvers/sparse_rows.h). Where
            unknowns are few and the preconditioner is a diagonal, one work-group then solves alone.

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
            self.record = self.engine.zeros(4 * (max_iterations + 1))
            self._alone = self.engine.zeros(_STATE + 4 * (max_iterations + 1))
        if rows is not None and isinstance(precondition, cla.Array) and n <= self._most_alone:
            return self._solve_alone(
                store, rows, rhs, x, precondition, tolerance, max_iterations, center, from_zero, verify
            )  # fmt: skip
        system = _System(self, apply, precondition, rhs, x, store, tolerance, fused, center)
        iterations, history, reason = 0, [], "max_iterations"
        residual = system.measure(from_zero)
        if residual < 0:
            x.fill(0)
            return Solution(0, 0.0, np.zeros(1), True, "zero right side")
        while True:
            if residual <= tolerance:
                reason = "converged"
                break
            if iterations >= max_iterations:
                break
            most = max_iterations - iterations
            iterations += self._cycle(system, most, tolerance, residual, lookahead, history)
            if not verify and self._left <= tolerance:
                residual, reason = self._left, "converged"
                break
            before, residual = residual, system.measure()
            # A restart gains digits as long as the recurrence, not x's precision, was the limit.
            if residual > max(tolerance, 0.5 * before) and iterations < max_iterations:
                reason = "stagnated"
                break
        if center:
            system.center()
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
        center: bool,
        from_zero: bool,
        verify: bool,
    ) -> Solution:
        """Have one work-group solve, in a launch for each time that the recurrence is begun."""
        engine, real, n = self.engine, self.engine.real.type, len(rhs)
        vectors = (engine.scratch(n, store) for _ in range(4))
        given = (*rows, inverse_diagonal, rhs, x, *vectors, self.partial, self._alone)
        kernel, done, history, most = self.kernels_in(store).solve_alone, 0, [], math.inf
        while True:
            left = max_iterations - done
            Launch(
                engine, kernel, np.int32(n), np.int32(from_zero), np.int32(center),
                np.int32(left), real(0.95 * tolerance), real(tolerance),
                real(min(most, float(np.finfo(real).max))), *given, groups=1,
            )()  # fmt: skip
            host = self._alone[: _STATE + 4 * min(left, _FIRST_READ)].get()
            residual = self.relate(*host[2:6])
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

    def relate(self, taken: float, _: float, norm_b: float, norm_r: float) -> float:
        """Return the relative residual by words 2 to 5 of the device's state; negative: b is zero."""
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
        system: _System,
        most: int,
        tolerance: float,
        residual: float,
        lookahead: int,
        history: list[float],
    ) -> int:
        """Iterate from the residual in place until it stops, or `most` times; return how often."""
        done, ahead, first = 0, min(8, lookahead), residual
        system.begin()
        while done < most:
            end = min(done + ahead, most)
            for k in range(done, end):
                system.iterate(k)
            system.look(end)
            rows = self.record[4 * done : 4 * (end + 1)].get()
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


class _System:
    """One linear system, the vectors of its iteration, and what all work-groups do to them together."""

    def __init__(
        self,
        solver: ConjugateGradient,
        apply: Apply,
        precondition: cla.Array | Precondition,
        rhs: cla.Array,
        x: cla.Array,
        store: np.dtype,
        tolerance: float,
        fused: bool,
        center: bool,
    ) -> None:
        self._solver, self._engine, n = solver, solver.engine, len(rhs)
        self._apply, self._precondition, self._fused = apply, precondition, fused
        self._rhs, self._x = rhs, x
        self._kernels = k = solver.kernels_in(store)
        self._r, self._u, self._p, self._q = (self._engine.scratch(n, store) for _ in range(4))
        self._size, self._center = np.int32(n), np.int32(center)
        # The recurrence stops a little lower, so that the true residual is within the tolerance.
        limit = self._engine.real.type(0.95 * tolerance)
        self._tail = (solver.partial, solver.state, solver.record)
        first = np.int32(0)
        self._direction = Launch(
            self._engine, k.direction, first, self._size, limit, self._u, self._p, *self._tail
        )  # fmt: skip
        vectors = self._p, self._q, x, self._r
        if isinstance(precondition, cla.Array):
            self._update = Launch(
                self._engine, k.update_jacobi, first, self._size, self._center, precondition, *vectors, self._u,
                *self._tail,
            )  # fmt: skip
        else:
            self._update = Launch(
                self._engine, k.update, first, self._size, self._center, *vectors, *self._tail
            )  # fmt: skip

    def measure(self, zero: bool = False) -> float:
        """Set r to the true residual, of x or of `zero`, and return its relative norm; negative: b is zero."""
        if not zero:
            self._apply(self._x, self._q)
        k, anew = self._kernels, np.int32(zero)
        partial, state, _ = self._tail
        self._launch(k.residual, self._size, anew, self._rhs, self._q, partial)
        self._launch(
            k.begin, self._size, anew, self._center, self._rhs, self._q, self._x, self._r, self._p, partial, state
        )  # fmt: skip
        self._alone(k.sum_norms, partial, state, np.int32(self._engine.groups))
        return self._solver.relate(*state.get()[2:])

    def begin(self) -> None:
        """Make the first u of the residual in place."""
        if isinstance(self._precondition, cla.Array):
            self._launch(
                self._kernels.jacobi, self._size, self._precondition, self._r, self._u, self._tail[0]
            )  # fmt: skip

    def iterate(self, k: int) -> None:
        """Enqueue iteration k."""
        if not isinstance(self._precondition, cla.Array):
            self._precondition(self._r, self._u, self._q)
            self._dot_product(_GAMMA + (k & 1), self._r, self._u)
        self._direction.set_first(k)
        self._direction()
        self._apply(self._p, self._q)
        if not self._fused:
            self._dot_product(CURVATURE, self._p, self._q)
        self._update.set_first(k)
        self._update()

    def look(self, k: int) -> None:
        """Have row k of the record tell whether there is an iteration k."""
        self._alone(self._kernels.look, np.int32(k), *self._tail, np.int32(self._engine.groups))

    def center(self) -> None:
        """Take the mean of x away."""
        for kernel in (self._kernels.add_up, self._kernels.remove_mean):
            self._launch(kernel, self._size, self._x, self._tail[0])

    def _dot_product(self, row: int, a: cla.Array, b: cla.Array) -> None:
        self._launch(self._kernels.dot_product, self._size, np.int32(row), a, b, self._tail[0])

    def _launch(self, kernel: cl.Kernel, *args: object) -> None:
        self._engine.run_blocks(kernel, *args)

    def _alone(self, kernel: cl.Kernel, *args: object) -> None:
        """Enqueue a kernel of one work-group."""
        group = self._engine.group_size
        self._engine.run(kernel, group, *args, group=group)
