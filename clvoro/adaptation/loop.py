"""The loop of the paper's Figure 1: displace, move, tessellate anew, record, until the plan is done."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InputTypeError
from ..mesh.results import HISTORY_DTYPE, Displacements, Result
from ..opencl.primitives import Summary
from ..solvers.conjugate_gradient import Solution
from .checkpoint import Checkpointer
from .schedule import MOST_SURPLUS, Action, Mend, Refine, Reorganize, Rest, Settle, Step, work_of
from .state import Mesh

SAMPLING_GAIN = 0.36
"""Error in counting by sizes at generators over that on the next coarser level: measured on a kinked field."""
WINDOW = 10
"""Steps over which error and quality are watched for progress."""
LESS, MOST_SWINGS = 0.9, 2
"""Where a count comes to be too large after it has been too small, or the other way round, it has at most this share of
the cells missing that it has had at best; the second time that it has not, it is left at that. Counts of smooth fields
swing once on their way."""
INTERRUPTED = "interrupted"
COMPLETED, STALLED = "plan completed", "error and quality no longer improve"
"""Why runs end that have converged."""


class Loop:
    """One run.

    Parameters
    ----------
    mesh : Mesh
        On the coarsest level.
    plan : list of Action
    levels : int
        Coarser levels that the plan begins with.
    max_steps : int or None
    tol : float or None
        Share by which error or quality must improve over a window of steps; 0 takes all steps. None: the run has
        converged where the plan ends.
    callback : callable or None
        Takes the new row of the history; the run stops if it returns True.

    Attributes
    ----------
    position : int
        Actions of the plan that are done; a checkpoint sets it, and what follows.
    begun, steps : int
        Steps that have begun, and that are done.
    rows : list of (1,) array
        Of the history.
    labeled : int
        Labels that had been given when the last row was added.
    checkpoint : Checkpointer or None
    """

    def __init__(
        self,
        mesh: Mesh,
        plan: list[Action],
        levels: int,
        max_steps: int | None,
        tol: float | None,
        callback: Callable[[np.void], object] | None,
    ) -> None:
        self.mesh, self.plan, self.level, self.levels = mesh, plan, levels, levels
        self.n_start = mesh.n
        self.max_steps, self.tol, self.callback = max_steps, tol, callback
        self.rows: list[np.ndarray] = []
        self.begun, self.steps = 0, 0
        self.labeled = mesh.next_label
        self.solution: Solution | None = None
        self.initial: Displacements | None = None
        # Of a plan's last step; where no plan tells which that will be, they are evaluated once more in the end.
        self.final: Displacements | None = None
        steps = [position for position, action in enumerate(plan) if isinstance(action, Step)]
        self.last_step = steps[-1] if steps and tol is None else None
        self.began = time.perf_counter()
        self.position = 0
        self.checkpoint: Checkpointer | None = None

    def run(self, n_cells: int | None, asked: float, settings: dict[str, Any]) -> Result:
        """Carry out the plan.

        `asked` is the integral of h^-d on the finest level. `n_cells` holds the finest level's count, and a common
        factor on the size field follows; with None the size field decides.
        """
        self.n_cells, self.asked = n_cells, asked
        try:
            stop = not self.rows and self.record(0.0)
            if stop and self.checkpoint is not None:
                self.checkpoint.offer(self, stop)
            done = work_of(self.plan, self.levels, self.mesh.engine.dim, asked)
            ahead = list(zip(self.plan, [*done[1:], 1.0], strict=False))
            for action, progress in ahead[self.position :]:
                # Also where a run that goes on had been stopped just when it would have ended.
                reason = self.why_ended(stop)
                if reason:
                    break
                if isinstance(action, Step):
                    self.step(action)
                    stop = self.record(progress)
                elif isinstance(action, Reorganize):
                    self.reorganize(action)
                elif isinstance(action, Mend):
                    self.mend(action)
                elif isinstance(action, Settle):
                    self.settle(action.share, action.ahead)
                elif isinstance(action, Refine):
                    self.refine()
                elif isinstance(action, Rest):
                    self.mesh.velocity.fill(0)
                self.position += 1
                if self.checkpoint is not None:
                    self.checkpoint.offer(self, stop)
            else:
                reason = self.why_ended(stop, over=True)
        except KeyboardInterrupt:
            reason = INTERRUPTED
            self.mesh.update()
        # Whatever stopped the run, the mesh has the size and the count that were asked for.
        while self.level > 0:
            self.refine()
        self.settle()
        if not self.told():
            self.solution = None
            self.add_row(float(self.rows[-1]["progress"][0]) if self.rows else 0.0)
        return self.result(reason in (COMPLETED, STALLED), reason, settings)

    @property
    def held(self) -> int | None:
        """The count that the present level has to have; None: what the size field asks for."""
        return self.n_cells if self.level == 0 else None

    def step(self, action: Step) -> None:
        """Displace and move all generators, and tessellate anew."""
        self.begun = self.steps + 1
        with self.mesh.engine.workspace.frame():
            self.solution = action.method.displace(self.mesh)
            if self.initial is None:
                self.initial = self.displacements()
            if self.position == self.last_step:
                self.final = self.displacements()
            action.method.move(self.mesh)
        # The row that follows tells of bad sizes, too, unless they are scaled before.
        self.mesh.update(check=self.held is not None)
        if self.held is not None:
            self.mesh.match_size()
        self.last = action.method
        self.steps += 1

    def reorganize(self, action: Reorganize) -> None:
        """Insert and delete generators."""
        if action.least and abs(self.missing()) <= action.least * self.mesh.n:
            return
        # What the solver holds is of no use for other generators, and the largest of what is not needed here.
        self.mesh.stages.clear("poisson")
        nuclei = round(action.nuclei * self.mesh.n)
        most = math.inf if self.held is not None else self.most()
        self.mesh.reorganize(nuclei, self.held, theta=action.theta, most=most)

    def mend(self, action: Mend) -> None:
        """Delete or split the worst cells."""
        self.mesh.stages.clear("poisson")
        self.mesh.mend(action.flaw, action.split)

    def missing(self) -> float:
        """Cells that are missing: to the count that is held, or to what the size field asks for."""
        if self.held is not None:
            return float(self.held - self.mesh.n)
        return min(self.mesh.missing(), self.most() - self.mesh.n)

    def most(self) -> float:
        """Cells of this level, at most, where no count is held.

        A size counts where a generator is: one beside a jump owns a part of what is to be coarse, and asks for others
        there, which ask for more. Where cells can follow their sizes, they ask for little more than the integral.
        """
        factor = 2.0 ** (self.mesh.engine.dim * self.level)
        return self.mesh.fixed + (1 + MOST_SURPLUS) * self.asked / factor

    def missing_ahead(self) -> float:
        """Cells that are missing for refinement to make the count of the next finer level.

        What a level asks for, the sum of V rho, differs from the integral since h is sampled at the generators; the
        difference is less by `SAMPLING_GAIN` on the next level. Refinement makes less than 2^d times as many cells, as
        those at walls have fewer neighbors; their share halves with each level.
        """
        mesh = self.mesh
        factor = 2.0**mesh.engine.dim
        # What this level would ask for with exact sampling.
        exact = self.asked / factor**self.level
        bias = min((mesh.n + mesh.missing()) / exact - 1, MOST_SURPLUS)
        lack = factor * mesh.n / mesh.refined_count() - 1
        wanted = exact * (1 + SAMPLING_GAIN * bias)
        for level in range(self.level):
            wanted *= 1 + lack / 2**level
        return wanted - mesh.n

    def settle(self, share: float = 0.0, ahead: bool = False) -> None:
        """Bring the count to within `share` of what the size field asks for; without it, to the one that is held.

        `ahead`: to what makes the next level's count.
        """
        least, before, swings = math.inf, 0.0, 0
        while True:
            if share == 0 and self.held is None:
                break
            missing = self.missing_ahead() if ahead else self.missing()
            if abs(missing) <= share * self.mesh.n:
                break
            # Each one that comes beside a jump of sizes changes what they all ask for: the count may swing for ever.
            # In one direction it ends by itself, however few come or go at a time.
            if abs(missing) < LESS * least:
                least, swings = abs(missing), 0
            elif missing * before < 0:
                swings += 1
            before = missing
            if swings == MOST_SWINGS:
                break
            target = self.mesh.n + round(missing) if ahead else self.held
            most = math.inf if target is not None else self.most()
            inserted, deleted = self.mesh.reorganize(0, target, climb=False, most=most)
            if inserted == deleted:
                break
        if self.held is not None:
            self.mesh.match_size()

    def refine(self) -> None:
        """Go to the next finer level."""
        # The finer level needs another solver, and memory.
        self.mesh.stages.clear("poisson")
        self.mesh.engine.workspace.clear()
        finer = self.mesh.refine()
        # Together: an interruption between them would refine once too often.
        self.mesh, self.level = finer, self.level - 1

    def record(self, progress: float) -> bool:
        """Append a row to the history; True if the callback wants to stop."""
        self.add_row(progress)
        if self.callback is None:
            return False
        answer = self.callback(self.rows[-1][0].copy())
        try:
            return bool(answer)
        except ValueError as error:  # NumPy's, of arrays
            raise InputTypeError(
                f"callback returned {answer!r:.60} of type {type(answer).__name__}, expected True to stop, False or "
                f"None to go on ({error})"
            ) from error

    def told(self) -> bool:
        """Tell whether the last row is of the mesh as it is: not amid a step, of these generators, with their sizes."""
        if not self.rows:
            return False
        row, mesh = self.rows[-1][0], self.mesh
        same = (row["step"], row["level"], row["cells"]) == (self.begun, self.level, mesh.n)
        # Before the first step sizes are not yet scaled to the count that is held.
        scaled = self.held is None or self.steps > 0
        return bool(same and scaled and self.labeled == mesh.next_label)

    def add_row(self, progress: float) -> None:
        """Append a row to the history."""
        mesh = self.mesh
        s, n, labeled = mesh.assess(), mesh.n, mesh.next_label
        row = np.zeros(1, HISTORY_DTYPE)
        row["step"], row["level"], row["cells"] = self.steps, self.level, n
        row["progress"] = progress
        self.describe(row, s)
        row["changed"], row["ever_changed"] = round(s["changed"].sum), s["ever"].sum / n
        # Generators get a label each when they are inserted.
        row["inserted"] = labeled - self.labeled
        before = self.rows[-1]["cells"] if self.rows else self.n_start
        row["deleted"] = before + row["inserted"] - n
        if self.solution is not None:
            row["lloyd"], row["poisson"] = s["lloyd"].sum / n, s["correction"].sum / n
            row["iterations"], row["residual"] = self.solution.iterations, self.solution.residual
        row["seconds"] = time.perf_counter() - self.began
        # Together, without a call in between: an interruption there would tell of some insertions twice.
        self.rows += [row]
        self.labeled = labeled

    def describe(self, row: np.ndarray, s: dict[str, Summary]) -> None:
        """Write to `row` how good the mesh is, by its summaries `s`."""
        mesh, n = self.mesh, self.mesh.n
        row["mean_error"], row["max_error"] = s["error"].magnitude / n, s["error"].peak
        row["mean_quality"], row["min_quality"] = s["quality"].sum / n, s["quality"].least
        row["energy"] = s["energy"].sum * mesh.domain.frame[1] ** (mesh.engine.dim + 2)

    def why_ended(self, stop: bool, over: bool = False) -> str:
        """Return why nothing more is done; "" if there is something: `over` says that the plan has no more."""
        if stop:
            return "stopped by the callback"
        if self.stalled():
            return STALLED
        if over and self.tol is None:
            return COMPLETED
        used_up = self.max_steps is not None and self.steps >= self.max_steps
        return "max_steps reached" if over or used_up else ""

    def stalled(self) -> bool:
        """Tell whether neither mean error nor mean quality has improved by `tol` over the last steps."""
        if not self.tol or len(self.rows) <= 2 * WINDOW:
            return False
        history = np.concatenate(self.rows[-2 * WINDOW :])
        old, new = history[:WINDOW], history[WINDOW:]
        better_error = 1 - new["mean_error"].mean() / max(old["mean_error"].mean(), 1e-300)
        better_quality = new["mean_quality"].mean() / old["mean_quality"].mean() - 1
        return bool(max(better_error, better_quality) < self.tol)

    def displacements(self) -> Displacements:
        """Fetch the two halves of the step."""
        mesh, (origin, scale) = self.mesh, self.mesh.domain.frame
        return Displacements(
            mesh.values(mesh.points, scale) + origin,
            mesh.values(mesh.lloyd, scale),
            mesh.values(mesh.correction, scale),
        )

    def result(self, converged: bool, reason: str, settings: dict[str, Any]) -> Result:
        """Fetch what the run has come to.

        Raises
        ------
        InputError
            If rounding has made cells of generators near each other wrong.
        """
        mesh, final = self.mesh, self.final
        if self.steps and (final is None or self.rows[-1]["step"] == self.rows[-2]["step"]):
            # No step was known to be the last, or generators have been inserted or deleted since.
            with mesh.engine.workspace.frame():
                self.last.displace(mesh)
                final = self.displacements()
        if mesh.complete():
            # Faces of no more than rounding may have come and gone, and with them sides of cells.
            self.describe(self.rows[-1], mesh.assess())
        labels = np.sort(mesh.labels.get())
        size = mesh.values(mesh.h, mesh.domain.frame[1])
        error, quality = mesh.values(mesh.error), mesh.values(mesh.quality)
        diagram = mesh.finish()
        return Result(
            points=diagram.points,
            diagram=diagram,
            target_size=size,
            size_error=error,
            quality=quality,
            # With the type it need not be found out from all of them.
            history=np.concatenate(self.rows, dtype=HISTORY_DTYPE),
            converged=converged,
            stop_reason=reason,
            initial=self.initial,
            final=final,
            size_factor=mesh.coarsening,
            settings=settings,
            origin=np.where(labels < self.n_start, labels, -1).astype(np.int32),
        )
