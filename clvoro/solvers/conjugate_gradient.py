"""Preconditioned conjugate gradients on the device, for any operator that enqueues itself (`conjugate_gradient.cl`)."""

from __future__ import annotations

import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import SolverError
from ..opencl.engine import Engine, PartialSums
from ..opencl.kernels import Kernels
from ..opencl.launch import Launch, one_group_limit
from ..opencl.workspace import framed
from .linear_system import BreakdownError, Limits, Operator, Precondition, Solution

# Rows of the partial sums (as in conjugate_gradient.cl) and columns of the record (as in partial_sums.h).
CURVATURE, _GAMMA, _ROWS = 3, 6, 12
_SUM_B, _MAX_B, _NORM_B, _NORM_R, _SUM_R, _START, _SUM_X = 0, 1, 2, 4, 8, 10, 11
_ALONG, _LENGTH = _SUM_B, _START
"""Rows of the sums (r, q) and (q, q), where q = A p. Only runs in parts need them; what these rows hold at the start is
not needed any more."""
RECORD_NORM, RECORD_RUNNING, RECORD_CURVATURE = 0, 2, 3
_STATE = 8
_FIRST_READ = 32
"""Iterations whose record is read together with the state that `solve_by_group` leaves."""
NEARLY = 1 + 1e-6
"""Ratio of the squared residual to its target below which the host, which knows the sum over all parts, reads from the
device whether iterations end."""
CLEARLY = 2
"""The same ratio, of |r|^2 - 2 alpha (r, q) + alpha^2 (q, q), above which iterations surely go on."""


class ConjugateGradient:
    """Conjugate gradients for a symmetric positive (semi-)definite operator.

    All vectors and scalars stay on the device. The host enqueues as many iterations as it expects from the
    convergence so far, and then reads one row of scalars per iteration. The iterate is frozen on the device when the
    tolerance is met, so the result does not depend on when the host reads. From zero the first read also fetches the
    norm of the right side.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._ahead = 4
        self._kernels: dict[np.dtype, Kernels] = {}
        self.partial = engine.zeros(_ROWS * engine.groups)
        """Partial sums, one row per quantity."""
        self.state = engine.zeros(6)
        self.counts = engine.empty(2, np.int32)
        self._record_capacity = 0
        self._group_state = engine.zeros(_STATE + 4)
        self._one_group_limit = one_group_limit(engine)

    def kernels_in(self, store: np.dtype) -> Kernels:
        """Return the kernels for vectors in `store`."""
        if store not in self._kernels:
            self._kernels[store] = self.engine.kernels(
                "solvers/conjugate_gradient", {"STORE": self.engine.name_of(store)}
            )
        return self._kernels[store]

    @framed
    def solve(
        self,
        operator: Operator,
        rhs: cla.Array,
        x: cla.Array,
        precondition: cla.Array | Precondition,
        limits: Limits,
        *,
        from_zero: bool = False,
        store: np.dtype | None = None,
    ) -> Solution:
        """Solve A x = b from the start `x`, in place.

        - `rhs`: (n,) real, device
        - `x`: (n,) real, device
        - `precondition` (n,) store or callable (r, u, work): inverse of a diagonal, or a function that enqueues u =
          M^-1 r, M symmetric positive definite, all in `store`. It may overwrite `work`.
        - `from_zero`: start from zero and ignore `x`. This saves an application of the operator.
        - `store`: type of the iteration's vectors: the engine's precision, or float32 for a large tolerance.

        Raises `SolverError` if the right side, the start or the operator is not finite. Raises `BreakdownError` if the
        operator or the preconditioner is not positive definite.
        """
        store = self.engine.real if store is None else np.dtype(store)
        if limits.max_iterations > self._record_capacity:
            self._record_capacity = limits.max_iterations
            self.record = self.engine.zeros(4 * (limits.max_iterations + 2))
            self._group_state = self.engine.zeros(_STATE + 4 * (limits.max_iterations + 1))
        jacobi = isinstance(precondition, cla.Array)
        inverse, function = (precondition, None) if jacobi else (None, precondition)
        if operator.rows is not None and inverse is not None and len(rhs) <= self._one_group_limit:
            return self._solve_by_group(operator, rhs, x, inverse, limits, from_zero, store)
        system = _Iteration(self, operator, rhs, x, inverse, function, limits.tolerance, store)
        iterations, history, reason = 0, [], "max_iterations"
        # From zero the relative residual is 1; the host reads the norm of b with the first iterations.
        begun = from_zero and 0 < limits.max_iterations and limits.tolerance < 1
        if begun:
            system.start(from_zero)
            residual = 1.0
        else:
            residual = system.measure(from_zero)
        while True:
            if residual < 0:
                x.fill(0)
                return Solution.zero()
            if residual <= limits.tolerance:
                reason = "converged"
                break
            if iterations >= limits.max_iterations:
                break
            done = self._iterate(system, iterations, limits, residual, history, unknown=begun)
            if done is None:
                residual = -1.0
                continue
            iterations, begun = iterations + done, False
            over = self._final <= limits.tolerance or iterations >= limits.max_iterations
            if over and not limits.verify:
                residual = self._final
                reason = "converged" if residual <= limits.tolerance else reason
                break
            before, residual = residual, system.measure()
            # A restart gains digits only if the recurrence was the limit, not the precision of x.
            stagnated = residual > max(limits.tolerance, 0.5 * before)
            if stagnated and iterations < limits.max_iterations:
                reason = "stagnated"
                break
        if operator.singular:
            system.center()
        converged = residual <= limits.tolerance
        return Solution(iterations, residual, np.array([*history, residual]), converged, reason)

    def _solve_by_group(
        self,
        operator: Operator,
        rhs: cla.Array,
        x: cla.Array,
        inverse_diagonal: cla.Array,
        limits: Limits,
        from_zero: bool,
        store: np.dtype,
    ) -> Solution:
        """Solve with one work-group: one launch per start of the recurrence."""
        engine, real, tolerance = self.engine, self.engine.real.type, limits.tolerance
        vectors = (engine.scratch(len(rhs), store) for _ in range(4))
        assert operator.rows is not None
        given = (*operator.rows, inverse_diagonal, rhs, x, *vectors, self.partial, self._group_state)
        size, center = np.int32(len(rhs)), np.int32(len(rhs) if operator.singular else 0)
        kernel = self.kernels_in(store).solve_by_group
        done, history, stagnated = 0, [], math.inf
        while True:
            left = limits.max_iterations - done
            Launch(
                engine,
                kernel,
                size,
                np.int32(from_zero),
                center,
                np.int32(left),
                real(0.95 * tolerance),
                real(tolerance),
                real(min(stagnated, float(np.finfo(real).max))),
                *given,
                groups=1,
            )()
            host = self._group_state[: _STATE + 4 * min(left, _FIRST_READ)].get()
            residual = self.relative_residual(host[2], *host[4:6])
            if residual < 0:
                x.fill(0)
                return Solution.zero()
            converged = residual <= tolerance
            if converged or left == 0 or residual > stagnated:
                reason = "converged" if converged else "stagnated" if left else "max_iterations"
                break
            stop = self._read_record(host[_STATE:], 0, tolerance, history)
            if stop is None and left > _FIRST_READ:
                host = self._group_state[_STATE : _STATE + 4 * left].get()
                stop = self._read_record(host[4 * _FIRST_READ :], _FIRST_READ, tolerance, history)
            done += left if stop is None else stop
            if not limits.verify and self._final <= tolerance:
                residual, converged, reason = self._final, True, "converged"
                break
            # As in `solve`.
            from_zero, stagnated = False, max(tolerance, 0.5 * residual)
        return Solution(done, residual, np.array([*history, residual]), converged, reason)

    def relative_residual(self, removed: float, norm_b: float, norm_r: float) -> float:
        """Return the relative residual; negative if b is zero but for the part of |b|^2 that centering has removed."""
        if not (math.isfinite(norm_b) and math.isfinite(norm_r)):
            raise SolverError(
                "the linear solve got a right side, start or operator that is not finite: |b|^2 = "
                f"{norm_b} and |b - A x|^2 = {norm_r} after scaling. Check the input"
            )
        # A constant right side leaves only round-off.
        if norm_b <= (8 * np.finfo(self.engine.real).eps) ** 2 * removed:
            return -1.0
        self._norm_b = float(norm_b)
        return math.sqrt(norm_r / norm_b)

    def _iterate(
        self, system: _Iteration, begun: int, limits: Limits, residual: float, history: list[float], unknown: bool
    ) -> int | None:
        """Iterate from the present residual until a stop, or up to `max_iterations`; return the number of iterations.

        `begun` iterations have been done before. With `unknown` the norm of the right side has not been read; None if
        it is zero.
        """
        most, tolerance = limits.max_iterations - begun, limits.tolerance
        done, ahead, first = 0, min(self._ahead, limits.lookahead), residual
        system.begin()
        while done < most:
            end = min(done + ahead, most)
            for k in range(done, end):
                if system.iterate(k):
                    end = k + 1
                    break
            system.record_norm()
            *rows, (removed, norm_b, *_) = self.record[4 * done : 4 * (end + 2)].get().reshape(-1, 4)
            if unknown and self.relative_residual(removed, norm_b, rows[0][RECORD_NORM]) < 0:
                return None
            unknown = False
            stop = self._read_record(np.array(rows), done, tolerance, history)
            if stop is not None:
                self._ahead = max(stop + 1, 4)
                return stop
            self._final = residual = history.pop()  # the next iteration records it again
            done = end
            rate = math.log(first / residual) / done if residual < first else 0.0
            left = math.log(residual / tolerance) / rate if rate > 0 else limits.lookahead
            ahead = min(max(math.ceil(left), 1), limits.lookahead)
        return done

    def _read_record(self, record: np.ndarray, begin: int, tolerance: float, history: list[float]) -> int | None:
        """Append the record from iteration `begin` on to `history`; return the iteration that stopped, if any."""
        self._final = math.inf
        for k, row in enumerate(record.reshape(-1, 4).astype(np.float64), start=begin):
            residual = math.sqrt(row[RECORD_NORM] / self._norm_b)
            if row[RECORD_RUNNING] == 0 or not row[RECORD_CURVATURE] > 0:
                self._final = residual
                self._check_stop(k, row, residual, tolerance, history)
                return k
            history.append(residual)
        return None

    def _check_stop(self, k: int, row: np.ndarray, residual: float, tolerance: float, history: list[float]) -> None:
        """Raise if iteration `k` stopped neither at the tolerance nor at the limit of the precision."""
        if residual <= tolerance:
            return
        # Close to the limit of the precision round-off can change the signs. The true residual then decides.
        if k > 0 and residual < 1e-3:
            return
        curvature = row[RECORD_CURVATURE] if row[RECORD_RUNNING] else math.nan
        raise BreakdownError(
            f"conjugate gradients broke down at iteration {k}: (r, M^-1 r) = {row[1]:.3g} and "
            f"(p, A p) = {curvature:.3g}, expected positive finite numbers; relative residual {residual:.3g}. "
            "The operator or its preconditioner is not positive definite",
            [*history, residual],
        )


class _Iteration:
    """One linear system with the vectors and launches of its iteration; `inverse` is that of the diagonal, or None."""

    def __init__(
        self,
        solver: ConjugateGradient,
        operator: Operator,
        rhs: cla.Array,
        x: cla.Array,
        inverse: cla.Array | None,
        precondition: Precondition | None,
        tolerance: float,
        store: np.dtype,
    ) -> None:
        self._solver, self._engine, n = solver, solver.engine, len(rhs)
        self._operator, self._inverse, self._precondition = operator, inverse, precondition
        self._rhs, self._x = rhs, x
        self._kernels = k = solver.kernels_in(store)
        scratch = self._engine.scratch
        rows, all_n = n if operator.part is None else operator.part.count, int(self._engine.peers.total(n))
        self._r, self._q = (scratch(n, store) for _ in range(2))
        # Each part finds the directions of its ghosts, too.
        self._u, self._p = (scratch(rows, store) for _ in range(2))
        self._tolerance, self._target, self._norm, self._gamma = 0.95 * tolerance, 0.0, 0.0, 0.0
        # On CPUs it costs more to evaluate directions of neighbors again than to store them.
        self._merged = operator.rows is not None and self._engine.group_size > 1
        directions = (self._p, scratch(n, store)) if self._merged else (self._p, self._p)
        self._sums = (_NORM_R, _SUM_R) if inverse is None else (_NORM_R, _SUM_R, _GAMMA)
        self._size, self._center = np.int32(n), np.int32(all_n if operator.singular else 0)
        # The recurrence stops slightly below the tolerance, so that the true residual is within it.
        limit = self._engine.real.type(self._tolerance)
        self._tail = (solver.partial, solver.state, solver.record)
        first = solver.counts
        self._find_direction, self._update_solution = [], []
        for p, old in (directions[::-1], directions):
            if self._merged:
                assert operator.rows is not None
                direction = (k.apply_to_direction, first, self._size, limit, *operator.rows, self._u, old, p, self._q)
            else:
                direction = k.update_direction, first, np.int32(rows), limit, self._u, p
            self._find_direction.append(Launch(self._engine, *direction, *self._tail))
            vectors = p, self._q, x, self._r
            if inverse is None:
                solution = k.update_solution, first, self._size, self._center, *vectors
            else:
                solution = k.update_solution_jacobi, first, self._size, self._center, inverse, *vectors, self._u
            self._update_solution.append(Launch(self._engine, *solution, *self._tail))

    def measure(self, from_zero: bool = False) -> float:
        """Do the same as `start`, and return the relative norm of r; negative if b is zero."""
        self.start(from_zero)
        partial, state, _ = self._tail
        self._launch_one_group(self._kernels.read_norms, partial, state, np.int32(self._engine.groups))
        _, _, removed, _, *norms = state.get()
        return self._solver.relative_residual(removed, *norms)

    def start(self, from_zero: bool) -> None:
        """Set r to the true residual, of x or of zero."""
        if not from_zero:
            part = self._operator.part
            (x,) = [self._x] if part is None else part.with_ghosts(self._engine, self._x)
            self._operator.apply(x, self._q)
        k, anew = self._kernels, np.int32(from_zero)
        partial, state, _ = self._tail
        self._launch(k.sum_right_sides, self._size, anew, self._rhs, self._q, partial)
        self._engine.sum_over_parts(PartialSums(partial, (_SUM_B, _START, _MAX_B), largest=_MAX_B))
        vectors = self._rhs, self._q, self._x, self._r, self._p
        self._launch(k.start_residual, self._size, anew, self._center, *vectors, partial, state, self._solver.counts)
        totals = self._engine.sum_over_parts(PartialSums(partial, (_NORM_B, _NORM_R, _SUM_R)))
        if len(totals):
            self._target, self._norm = (self._tolerance**2) * totals[0], float(totals[1])
        # Rows that are to be summed over all parts with the next exchange.
        self._left: tuple[int, ...] = ()
        if len(self._p) > len(self._rhs):
            self._p.fill(0)

    def begin(self) -> None:
        """Precondition the first residual."""
        if self._inverse is not None:
            self._launch(self._kernels.precondition_jacobi, self._size, self._inverse, self._r, self._u, self._tail[0])
            self._sum(_GAMMA, of=self._u)

    def iterate(self, k: int) -> bool:
        """Enqueue iteration k. Return whether the residual is known to be within the tolerance.

        It is known where there are other parts, and then not by the last digits. With a function as preconditioner
        |r|^2 is summed with the next (r, u), unless it may be within: (p, q) alone makes the parts wait for a sum.
        """
        function, rows, over = self._precondition, (CURVATURE,), False
        if function is not None:
            function(self._r, self._u[: len(self._r)], self._q)
            self._dot_product(_GAMMA + (k & 1), self._r, self._u)
            over = self._sum_norms(_GAMMA + (k & 1))
        direction, solution = self._find_direction[k & 1], self._update_solution[k & 1]
        direction()
        totals: list[float] = []
        if not self._merged:
            self._operator.apply(self._p, self._q)
            if not self._operator.writes_curvature:
                self._dot_product(CURVATURE, self._p, self._q)
            if function is not None and self._engine.peers.count > 1:
                self._dot_product(_ALONG, self._r, self._q)
                self._dot_product(_LENGTH, self._q, self._q)
                rows = CURVATURE, _ALONG, _LENGTH
            totals = self._sum(*rows).tolist()
        solution()
        self._left = tuple(row + (k + 1) % 2 for row in self._sums)
        if len(totals) == 3:
            curvature, along, length = totals
            if not self._gamma > 0 < curvature:
                return True
            alpha = self._gamma / curvature
            if self._norm - 2 * alpha * along + alpha**2 * length > self._target * CLEARLY:
                return over
        return self._sum_norms() or over

    def _sum_norms(self, *gamma: int) -> bool:
        """Sum the rows that are left, and `gamma`; return whether this shows a residual within the tolerance."""
        rows, self._left = self._left + gamma, ()
        exchanged = len(gamma) > 0 or self._inverse is not None
        totals = self._sum(*rows, of=self._u if exchanged else None).tolist()
        if totals and gamma:
            self._gamma = totals[-1]
        if len(totals) < 2:
            return False
        self._norm = totals[0]
        return self._norm <= self._target * NEARLY

    def _sum(self, *rows: int, of: cla.Array | None = None) -> np.ndarray:
        """Sum these rows over all parts, and get the values of ghosts in `of`, if given; return the totals."""
        sums, part = PartialSums(self._tail[0], rows), self._operator.part
        if part is None or of is None:
            return self._engine.sum_over_parts(sums)
        return part.forward(self._engine, of, sums=sums)

    def record_norm(self) -> None:
        """Record the residual before the next iteration, and whether it is needed."""
        if self._left:
            self._sum_norms()
        groups = np.int32(self._engine.groups)
        self._launch_one_group(self._kernels.record_norm, self._solver.counts, *self._tail, groups)

    def center(self) -> None:
        """Subtract its mean from x."""
        self._sum(_SUM_X)
        self._launch(self._kernels.center_solution, self._size, self._center, self._x, self._tail[0])

    def _dot_product(self, row: int, a: cla.Array, b: cla.Array) -> None:
        self._launch(self._kernels.dot_product, self._size, np.int32(row), a, b, self._tail[0])

    def _launch(self, kernel: cl.Kernel, *args: object) -> None:
        self._engine.run_blocks(kernel, *args)

    def _launch_one_group(self, kernel: cl.Kernel, *args: object) -> None:
        self._engine.run_groups(kernel, 1, *args)
