"""Volume projection: the smallest displacement that gives all cells their volumes, to first order.

The kernels are in volume_projection.cl. The paper's Poisson step approximates this projection, as an approximate
projection does in incompressible flow.
"""

from __future__ import annotations

import math
from typing import NamedTuple
from weakref import ReferenceType, ref

import numpy as np
import pyopencl.array as cla

from ..errors import SolverError
from ..opencl.device_array import read_numbers
from ..opencl.engine import Engine, PartialSums
from ..opencl.kernels import Kernels
from ..opencl.launch import Launch, one_group_limit
from ..opencl.workspace import framed
from ..tessellation.device_diagram import Tessellation
from .conjugate_gradient import NEARLY, RECORD_CURVATURE, RECORD_NORM, RECORD_RUNNING
from .linear_system import Limits, Solution, SolutionToRead

SINGLE_PRECISION_TOLERANCE = 1e-4
"""Tolerance from which on the vectors of the iteration are in single precision."""
_ROWS, _NORM, _GAMMA, _CURVATURE = 5, 0, 2, 4
"""Number of rows of partial sums, and which they are, as in volume_projection.cl: two norms and two products."""
_SPARE = 1
"""Number of iterations that are enqueued beyond those of the last solve. A solve that takes one more needs no second
read then. Further ones cost two launches each."""


class Targets(NamedTuple):
    """Cells against the size field, on the device."""

    h: cla.Array
    """(n,) real. Target size, the unit of displacements."""
    gradient: cla.Array
    """(n, d) real. grad log h."""
    log_ratio: cla.Array
    """(n,) real. r = log(V / h^d)."""
    quality: cla.Array
    """(n,) real. Q."""
    sums: cla.Array | None = None
    """(2 k,) real, optional. Sums of V rho r and V rho over k parts of the cells: the mean of r is subtracted. See
    `Density.sum_log_ratio`."""


class Penalty(NamedTuple):
    """The penalty eps that trades accuracy of the volumes for a shorter displacement.

    eps_i = min(3, eps (1 + q_i^2 / quality_scale^2)) / (1 + |r_i / log_ratio_scale|^power), q = (1 - Q) / sqrt Q of the
    worst cell among i and its neighbors. The power is 2 or 4. A scale of 0 leaves its factor out. In cells on walls the
    quality scale is `at_walls` times as large, and eps at most `most_at_walls`: walls limit their quality, and missed
    sizes help less.
    """

    eps: float
    quality_scale: float = 0.0
    log_ratio_scale: float = 0.0
    at_walls: float = 1.0
    power: int = 2
    most_at_walls: float = math.inf


class _Arrays(NamedTuple):
    """Arrays of one iteration, as volume_projection.cl names them."""

    rows: cla.Array
    columns: cla.Array
    own: cla.Array
    eps: cla.Array
    inverse: cla.Array
    p: cla.Array
    s: cla.Array
    u: cla.Array
    y: cla.Array
    r: cla.Array
    z: cla.Array


class VolumeProjection:
    """Solve for the correction u' in ``u = Ld + u'``, ``u' = -W J^T y``, ``(J W J^T + eps) y = r + J Ld``.

    J is the derivative of the log ratios r with respect to the generators, W = diag(h^2). With eps = 0 the log ratios
    vanish to first order. A penalty eps > 0 gives a shorter displacement and damps the modes that barely change any
    volume.

    Conjugate gradients with a diagonal preconditioner start from y = 0, or along the last solution. An iteration takes
    two kernels. The host enqueues as many iterations as the last solve took, and one more, and then reads their record.
    The iterate is frozen on the device when the tolerance is met, so the result does not depend on when the host reads.
    Where cells are few one work-group does all of it, and the host reads the record when the solution is first used.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._partial = engine.empty(_ROWS * engine.groups)
        # The host may read rows that no kernel has written.
        self._record = engine.zeros(4 * 64)
        self._counts = engine.empty(2, np.int32)
        self._kernels: dict[np.dtype, Kernels] = {}
        self._ahead = 8
        self._unread: ReferenceType[SolutionToRead] | None = None
        self._one_group_limit = one_group_limit(engine)

    def _kernels_in(self, store: np.dtype) -> Kernels:
        if store not in self._kernels:
            self._kernels[store] = self.engine.kernels(
                "solvers/volume_projection", {"STORE": self.engine.name_of(store)}
            )
        return self._kernels[store]

    def _reserve(self, n: int, rows: int, m: int, store: np.dtype, max_iterations: int) -> _Arrays:
        """Return the arrays for `n` cells and `m` faces, and enlarge the record for `max_iterations`.

        Those that neighbors are read from have `rows` rows: cells and ghosts.
        """
        engine, d = self.engine, self.engine.cell_dim
        if 4 * (max_iterations + 1) > len(self._record):
            self._record = engine.zeros(4 * (max_iterations + 1))
        vector, number = ((n, d), store), (n, store)
        derivatives = ((d, m), np.dtype(np.float32))
        shapes = {name: number for name in _Arrays._fields} | {name: vector for name in ("own", "u")}
        shapes |= {"rows": derivatives, "columns": derivatives, "s": ((rows, d), store), "z": (rows, store)}
        return _Arrays(*(engine.scratch(*shape) for shape in shapes.values()))

    @framed
    def project(
        self,
        t: Tessellation,
        targets: Targets,
        displacement: cla.Array,
        correction: cla.Array,
        penalty: Penalty,
        limits: Limits,
        *,
        labels: cla.Array | None = None,
        fixed: int = 0,
        start: cla.Array | None = None,
        warm: bool = False,
    ) -> Solution:
        """Write the correction of `displacement` (n, d) to `correction` (n, d).

        - `limits`: the relative residual is that of the recurrence. From `SINGLE_PRECISION_TOLERANCE` on the vectors
          are in single precision.
        - `labels`: (n,) int32
        - `fixed`: generators with labels below `fixed` do not move.
        - `start` (n,) float32: receives the solution y.
        - `warm`: start from the content of `start`: the solution of a similar system.

        `residual` is that of the recurrence, too.

        Raises `SolverError` if a number is not finite: where cells are few when the solution is first used, with both
        displacements 0.
        """
        unread = None if self._unread is None else self._unread()
        if unread is not None:
            unread.read()
        engine, n, m = self.engine, t.n, t.neighbors.shape[0]
        real, most = engine.real.type, limits.max_iterations
        single = limits.tolerance >= SINGLE_PRECISION_TOLERANCE
        store = np.dtype(np.float32) if single else engine.real
        v, k = self._reserve(n, t.rows, m, store, most), self._kernels_in(store)
        start = engine.scratch(n, np.float32) if start is None else start
        iteration = (n, most, m, int(warm), real(limits.tolerance), *t.graph, *v, self._partial)
        assembly = self._assembly(t, targets, displacement, penalty, labels, fixed)
        given, rest = (*iteration, self._record), (*assembly, start, *engine.period_args)
        if n <= self._one_group_limit and t.part is None:
            Launch(engine, k.project_by_group, *given, correction, *rest, groups=1)()
            solution = SolutionToRead(lambda: self._solution(self._read(most), limits.tolerance))
            self._unread = ref(solution)
            return solution
        if "OWN_WALLS" in engine.traits.macros:
            engine.run_each(k.mark_walls, n, *t.graph, v.p)
        Launch(engine, k.assemble_projection, *given, self._counts, *rest)()
        direction = Launch(engine, k.update_projection_direction, *given, self._counts)
        update = Launch(engine, k.update_projection, *given, self._counts)
        rows = self._iterate(t, v, direction, update, limits)
        solution = self._solution(rows, limits.tolerance)
        if solution.iterations:
            engine.run_each(k.write_correction, n, v.u, v.y, targets.h, t.points, correction, start)
        else:
            correction.fill(0)
        return solution

    def _assembly(
        self,
        t: Tessellation,
        targets: Targets,
        displacement: cla.Array,
        penalty: Penalty,
        labels: cla.Array | None,
        fixed: int,
    ) -> tuple[object, ...]:
        """Return ASSEMBLY_ARGS of volume_projection.cl but for the start."""
        real, sums = self.engine.real.type, targets.sums
        summed = None if sums is None else PartialSums(sums, (0, 1))
        of_all = t.with_ghosts(self.engine, t.volumes, targets.h, targets.quality, displacement, sums=summed)
        volumes, h, quality, displacement = of_all
        cells = t.face_measures, t.face_centroids, volumes, t.points
        aims = targets.gradient, h, quality, targets.log_ratio, displacement
        at_walls = min(penalty.eps, penalty.most_at_walls), penalty.at_walls * penalty.quality_scale
        scales = penalty.eps, penalty.quality_scale, *at_walls, penalty.log_ratio_scale
        totals = (self._partial, 0) if sums is None else (sums, len(sums) // 2)
        fixed_args = t.fixed_args(self.engine, labels, fixed)
        return *cells, *aims, *map(real, scales), penalty.power, *totals, *fixed_args

    def _iterate(
        self, t: Tessellation, v: _Arrays, direction: Launch, update: Launch, limits: Limits
    ) -> list[list[float]]:
        """Iterate until the tolerance is met, or `max_iterations` times; return the record up to there or further."""

        def send(values: cla.Array, *rows: int) -> np.ndarray:
            return t.forward(self.engine, values, sums=PartialSums(self._partial, rows))

        # The host knows the norms where there are other parts.
        target = NEARLY * limits.tolerance**2 * sum(send(v.z, _NORM, _GAMMA)[:1])
        direction()
        done, ahead, most = 0, self._ahead, limits.max_iterations
        while True:
            end = min(done + ahead, most)
            for turn in range(done, end):
                send(v.s, _CURVATURE)
                update()
                norm = send(v.z, _NORM + (turn + 1) % 2, _GAMMA + (turn + 1) % 2)[:1]
                direction()
                if (norm <= target).any():
                    end = turn + 1
                    break
            rows = self._read(end)
            if not all(row[RECORD_RUNNING] for row in rows):
                self._ahead = _first_stop(rows) + _SPARE
                return rows
            done, ahead = end, 4

    def _read(self, end: int) -> list[list[float]]:
        """Return the rows of the record up to iteration `end`."""
        return read_numbers(self._record, 0, 4 * (end + 1)).reshape(-1, 4).tolist()

    def _solution(self, rows: list[list[float]], tolerance: float) -> Solution:
        """Return the outcome by the record.

        Raises `SolverError` if a number is not finite.
        """
        iterations = _first_stop(rows)
        flat = bool(iterations and not rows[iterations - 1][RECORD_CURVATURE] > 0)
        iterations -= flat
        norms = [row[RECORD_NORM] for row in rows[: iterations + 1]]
        curvature = rows[iterations][RECORD_CURVATURE]
        # A curvature of 0 means that the residual is below the limit of the precision.
        if not all(map(math.isfinite, norms)) or (flat and curvature != 0):
            raise SolverError(
                "the volume projection got sizes, a displacement or a diagram that is not finite: squared residuals "
                f"{norms}, curvature {curvature}. Check the input"
            )
        if norms[0] == 0:
            return Solution.zero()
        residuals = np.sqrt(np.array(norms) / norms[0])
        converged = bool(residuals[-1] <= tolerance)
        reason = "converged" if converged else "stagnated" if flat else "max_iterations"
        return Solution(iterations, float(residuals[-1]), residuals, converged, reason)


def _first_stop(rows: list[list[float]]) -> int:
    """Return the first iteration that was not carried out. Later rows of the record have no meaning."""
    return next(k for k, row in enumerate(rows) if row[RECORD_RUNNING] == 0)
