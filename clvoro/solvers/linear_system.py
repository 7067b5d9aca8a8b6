"""What an iterative solver is given, and what it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl.array as cla

from ..errors import SolverError

if TYPE_CHECKING:
    from ..tessellation.part import Part

Apply = Callable[[cla.Array, cla.Array], object]
Precondition = Callable[[cla.Array, cla.Array, cla.Array], object]


@dataclass(frozen=True)
class Solution:
    """Outcome of an iterative solve.

    - `iterations`: int
    - `residual`: True relative residual ||b - A x|| / ||b|| (2-norm), evaluated from x at the end. If `Limits.verify`
      is False, that of the recurrence.
    - `residuals` (iterations + 1,) float64: relative residual before each iteration, by the recurrence, and the final
      one.
    - `converged`: whether `residual` is within the tolerance.
    - `reason`: ``"converged"``, ``"zero right side"``, ``"stagnated"`` (limited by the precision) or
      ``"max_iterations"``. ``" (Jacobi after ...)"`` follows if the solver changed to Jacobi's preconditioner;
      iterations and residuals are then those of both.
    """

    iterations: int
    residual: float
    residuals: np.ndarray
    converged: bool
    reason: str

    @classmethod
    def zero(cls) -> Solution:
        """Return the outcome for a right side of zero."""
        return cls(0, 0.0, np.zeros(1), True, "zero right side")


class SolutionToRead(Solution):
    """A solution that the host reads when one of its attributes is first used, so that it need not wait before.

    - `read`: returns the solution. It is called once.
    """

    def __init__(self, read: Callable[[], Solution]) -> None:
        vars(self)["_read"] = read

    def read(self) -> None:
        """Read the solution, if it has not been read."""
        if "_read" in vars(self):
            vars(self).update(vars(vars(self).pop("_read")()))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or "_read" not in vars(self):
            raise AttributeError(name)
        self.read()
        return getattr(self, name)


class BreakdownError(SolverError):
    """The operator or the preconditioner is not positive definite, or not finite.

    - `residuals` (iterations + 1,) float64: as in `Solution`. The iterate is that of the last valid iteration.
    """

    def __init__(self, message: str, residuals: list[float]) -> None:
        super().__init__(message)
        self.residuals = np.array(residuals)


@dataclass(frozen=True)
class Operator:
    """A symmetric positive (semi-)definite operator A.

    - `apply` callable (x, y): enqueues y = A x on the engine's queue. y has the dtype of the iteration's vectors, and
      so has x, except for the start and the solution.
    - `writes_curvature`: `apply` also writes the partial sums of (x, y) to row `CURVATURE` of
      `ConjugateGradient.partial`.
    - `singular`: the null space of A is the constants: the mean of the right side is removed first, that of x at the
      end.
    - `rows`: starts, columns and weights of A, if it is a matrix (see solvers/sparse_rows.h). One work-group then
      solves systems of few unknowns, if the preconditioner is diagonal. On GPUs an iteration takes a launch less.
    - `part`: if there are other parts, which solve with this one: x then has rows for ghosts, whose values are known
      when `apply` is called, and sums are those of all parts.
    """

    apply: Apply
    writes_curvature: bool = False
    singular: bool = False
    rows: tuple[cla.Array, ...] | None = None
    part: Part | None = None


@dataclass(frozen=True)
class Limits:
    """When an iteration ends.

    - `tolerance`: relative residual in the 2-norm.
    - `max_iterations`: int
    - `lookahead`: iterations to enqueue at most before the host reads the record. The first read is after as many as
      the last solve took, but at least 4, if that is less.
    - `verify`: evaluate the true residual at the end. Otherwise that of the recurrence is trusted.
    """

    tolerance: float
    max_iterations: int
    lookahead: int = 64
    verify: bool = True
