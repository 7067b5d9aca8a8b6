"""The loop of the paper's Figure 1: displace, move, tessellate, record, until the schedule ends."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InputTypeError
from ..mesh.results import HISTORY_DTYPE, Displacements, Result
from ..opencl.primitives import Summary
from ..solvers.linear_system import Solution
from .checkpoint import Checkpointer, Progress
from .diagnostics import warn_of_obtuse_triangles
from .estimates import MOST_SURPLUS
from .fixed_points import origins, put_back
from .moving.mmpde import MmpdeMethod
from .moving.monge_ampere import MongeAmpereMethod
from .plan.actions import (
    Action,
    BalanceCounts,
    CorrectCount,
    InsertDelete,
    Prescribe,
    Refine,
    RepairCells,
    ResetMomentum,
    Step,
)
from .plan.schedule import work_of
from .state import MeshState
from .transport.phase import PowerPhase

SAMPLING_GAIN = 0.26
"""The number of cells by sizes at the generators has an error. On the next finer level it is smaller by this factor:
0.25 is that of a smooth field, and a kink adds a little."""
WINDOW = 10
"""Steps over which error and quality are averaged to detect stagnation."""
LEAST_PROGRESS, MAX_OSCILLATIONS = 0.9, 2
"""Corrections of the number of cells end if they oscillate: if the number of missing cells changes its sign so often
without falling to this share of the smallest number so far. For smooth fields the sign changes at most once."""
INTERRUPTED = "interrupted"
COMPLETED, STALLED = "plan completed", "error and quality no longer improve"
SETTLED = "tolerance of the moving mesh met"
"""Reasons of converged runs."""


class Loop:
    """One run.

    Parameters
    ----------
    mesh : MeshState
        Mesh of the coarsest level.
    schedule : list of Action
    levels : int
        Number of coarser levels.
    max_steps : int or None
    tol : float or None
        Share by which error or quality must improve over a window of steps; 0 takes all steps. With None the run has
        converged when the schedule ends.
    callback : callable or None
        Called with each new row of the history; the run stops if it returns True.
    checkpoint : Checkpointer, optional
    progress : Progress, optional
        That of a saved run; by default the run starts. Its fields are attributes of the loop.

    Attributes
    ----------
    begun : int
        Number of steps begun.
    obtuse : int
        Number of obtuse triangles before they were last opened; 0 if none are left.
    """

    def __init__(
        self,
        mesh: MeshState,
        schedule: list[Action],
        levels: int,
        max_steps: int | None,
        tol: float | None,
        callback: Callable[[np.void], object] | None,
        checkpoint: Checkpointer | None = None,
        progress: Progress | None = None,
    ) -> None:
        p = Progress(levels, mesh.n, mesh.next_label, mesh.next_label) if progress is None else progress
        self.mesh, self.schedule, self.levels, self.checkpoint = mesh, schedule, levels, checkpoint
        self.level, self.position, self.begun, self.steps = p.level, p.position, p.steps, p.steps
        self.n_start, self.started, self.labeled = p.n_start, p.started, p.labeled
        self.rows = p.rows
        self.initial, self.final, self.last = p.initial, p.final, p.last
        self.began = time.perf_counter() - p.elapsed
        self.max_steps, self.tol, self.callback = max_steps, tol, callback
        self.solution: Solution | None = None
        self.obtuse = 0
        self._unit = mesh.domain.frame[1]
        steps = [position for position, action in enumerate(schedule) if isinstance(action, Step)]
        self.last_step = steps[-1] if steps and tol is None else None

    def run(self, n_cells: int | None, required: float, settings: dict[str, Any]) -> Result:
        """Carry out the schedule.

        Parameters
        ----------
        n_cells : int or None
            Number of cells of the finest level, for which the size field is scaled; None keeps the size field.
        required : float
            Integral of h^-d on the finest level.
        settings : dict
            Settings for the result.
        """
        self.n_cells, self.required = n_cells, required
        try:
            stop = not self.rows and self.record(0.0)
            if stop and self.checkpoint is not None:
                self.checkpoint.offer(self, stop)
            done = work_of(self.schedule, self.levels, self.mesh.engine.cell_dim, required)
            ahead = list(zip(self.schedule, [*done[1:], 1.0], strict=False))
            for action, progress in ahead[self.position :]:
                # A resumed run may have been stopped when it was about to end.
                reason = self.end_reason(stop)
                if reason:
                    break
                if isinstance(action, Step):
                    if not action.recent or self.count_changed(action.recent):
                        self.step(action)
                        stop = self.record(progress)
                elif isinstance(action, InsertDelete):
                    self.insert_delete(action)
                elif isinstance(action, RepairCells):
                    self.repair_cells(action)
                elif isinstance(action, CorrectCount):
                    self.correct_count(action.share, action.ahead)
                elif isinstance(action, BalanceCounts):
                    self.mesh.balance_counts()
                elif isinstance(action, Refine):
                    self.refine()
                elif isinstance(action, Prescribe):
                    stop = self.prescribe(action, progress)
                elif isinstance(action, ResetMomentum):
                    self.mesh.velocity.fill(0)
                self.position += 1
                # Weights are not saved. A run resumes before they are found.
                if self.checkpoint is not None and self.mesh.power is None:
                    self.checkpoint.offer(self, stop)
            else:
                reason = self.end_reason(stop, over=True)
        except KeyboardInterrupt:
            reason = INTERRUPTED
            self.mesh.update()
        # The result always has the required sizes and number of cells.
        while self.level > 0:
            self.refine()
        self.correct_count()
        if not self.is_recorded():
            if self.steps:
                self.mesh.walls.settle(self.mesh)
            self.solution = None
            self.add_row(float(self.rows[-1]["progress"][0]) if self.rows else 0.0)
        result = self.result(reason in (COMPLETED, STALLED, SETTLED), reason, settings)
        if self.obtuse and result.converged:
            warn_of_obtuse_triangles(result)
        return result

    @property
    def fixed_count(self) -> int | None:
        """Fixed number of cells of the present level; None if the size field determines it."""
        return self.n_cells if self.level == 0 else None

    def step(self, action: Step) -> None:
        """Displace and move all generators, and tessellate them."""
        self.begun = self.steps + 1
        with self.mesh.engine.workspace.frame():
            self.solution = action.method.displace(self.mesh)
            if self.initial is None:
                self.initial = self.displacements()
            if self.position == self.last_step:
                self.final = self.displacements()
            action.method.move(self.mesh)
            self.mesh.walls.adjust(self.mesh)
        self.mesh.update()
        for _ in range(action.openings):
            self.obtuse, opened = self.mesh.open_triangles()
            if not opened:
                break
        if self.fixed_count is not None:
            self.mesh.normalize_sizes()
        self.last = action.method
        self.steps += 1

    def prescribe(self, action: Prescribe, progress: float) -> bool:
        """Give the cells their target volumes, and move generators to the centroids; return whether to stop."""
        mesh, phase = self.mesh, PowerPhase(self.mesh)
        mesh.stages.clear_poisson()
        for move in range(action.moves + 1):
            self.begun = self.steps + 1
            with mesh.engine.workspace.frame():
                if move:
                    phase.aim()
                    self.final = self.displacements()
                    mesh.move_by_displacements()
                self.solution = phase.prescribe()
            self.steps += 1
            is_last = move == action.moves
            stop = self.record(progress if is_last else float(self.rows[-1]["progress"][0]))
            if self.end_reason(stop):
                return stop
        return False

    def insert_delete(self, action: InsertDelete) -> None:
        """Insert and delete generators."""
        if action.least and abs(self.missing()) <= action.least * self.mesh.n:
            return
        # The solver cannot reuse its large buffers for other generators.
        self.mesh.stages.clear_poisson()
        nuclei = round(action.nuclei * self.mesh.n)
        max_cells = math.inf if self.fixed_count is not None else self.max_cells()
        self.mesh.insert_delete(nuclei, self.fixed_count, climb_strain=action.climb_strain, most=max_cells)

    def repair_cells(self, action: RepairCells) -> None:
        """Delete or split the worst cells."""
        self.mesh.stages.clear_poisson()
        self.mesh.repair_cells(action.deficit, action.split)

    def count_changed(self, steps: int) -> bool:
        """Return whether the number of cells of this level has changed since the last `steps` steps."""
        rows = [row[0] for row in self.rows[-steps:]]
        return any(row["level"] == self.level and row["cells"] != self.mesh.n for row in rows)

    def missing(self) -> float:
        """Return the number of missing cells, by the fixed number or by the size field."""
        if self.fixed_count is not None:
            return float(self.fixed_count - self.mesh.n)
        return min(self.mesh.missing_cells(), self.max_cells() - self.mesh.n)

    def max_cells(self) -> float:
        """Return the largest number of cells of this level, if there is no fixed number.

        Sizes are evaluated at the generators. A small cell beside a jump of h covers a part of the coarse side and
        requires more cells there, which require more in turn. Where h is smooth the number is close to the integral.
        """
        factor = 2.0 ** (self.mesh.engine.cell_dim * self.level)
        rows = self.mesh.fixed - self.mesh.setup.first_row
        return rows + (1 + MOST_SURPLUS) * self.required / factor

    def missing_for_next_level(self, growth: float) -> float:
        """Return how many cells are missing so that refinement gives the number of the next finer level.

        Its number is `growth` times that by refinement now.

        The sum of V rho differs from the integral, because h is sampled at the generators; on the next level the
        difference is smaller by `SAMPLING_GAIN`. Refinement gives less than 2^d times as many cells, because cells at
        walls have fewer neighbors; their share halves with each level.
        """
        mesh = self.mesh
        factor = 2.0**mesh.engine.cell_dim
        # The number of cells on this level according to the integral.
        exact = self.required / factor**self.level
        bias = min((mesh.n + mesh.missing_cells()) / exact - 1, MOST_SURPLUS)
        lack = factor * mesh.n / (growth * mesh.refined_count()) - 1
        wanted = exact * (1 + SAMPLING_GAIN * bias)
        for level in range(self.level):
            wanted *= 1 + lack / 2**level
        return wanted - mesh.n

    def correct_count(self, share: float = 0.0, ahead: float = 0.0) -> None:
        """Correct the number of cells.

        Parameters
        ----------
        share : float
            Tolerance relative to the number that the size field requires. With 0 only a fixed number is corrected.
        ahead : float
            If not 0, correct towards the number from which refinement gives that of the next level, with this growth.
        """
        least, before, oscillations = math.inf, 0.0, 0
        while True:
            if share == 0 and self.fixed_count is None:
                break
            missing = self.missing_for_next_level(ahead) if ahead else self.missing()
            if abs(missing) <= share * self.mesh.n:
                break
            # At jumps of h each new cell changes the required number, so that it can oscillate without end. Changes
            # of one sign end by themselves.
            if abs(missing) < LEAST_PROGRESS * least:
                least, oscillations = abs(missing), 0
            elif missing * before < 0:
                oscillations += 1
            before = missing
            if oscillations == MAX_OSCILLATIONS:
                break
            target = self.mesh.n + round(missing) if ahead else self.fixed_count
            max_cells = math.inf if target is not None else self.max_cells()
            inserted, deleted = self.mesh.insert_delete(0, target, climb=False, most=max_cells)
            if inserted == deleted:
                break
        if self.fixed_count is not None:
            self.mesh.normalize_sizes()

    def refine(self) -> None:
        """Refine to the next finer level."""
        # The finer level needs another solver and more memory.
        self.mesh.stages.clear_poisson()
        self.mesh.engine.workspace.clear()
        finer = self.mesh.refine(finest=self.level == 1)
        # One assignment, because an interruption between two would leave a mesh that does not belong to its level.
        self.mesh, self.level = finer, self.level - 1

    def record(self, progress: float) -> bool:
        """Append a row to the history; return True if the callback stops the run."""
        self.add_row(progress)
        if self.callback is None:
            return False
        answer = self.callback(self.rows[-1][0].copy())
        try:
            return bool(answer)
        except ValueError as error:  # a NumPy array has no truth value
            raise InputTypeError(
                f"callback returned {answer!r:.60} of type {type(answer).__name__}, expected True to stop, False or "
                f"None to go on ({error})"
            ) from error

    def is_recorded(self) -> bool:
        """Return whether the last row of the history describes the present mesh."""
        if not self.rows:
            return False
        row, mesh = self.rows[-1][0], self.mesh
        same = (row["step"], row["level"], row["cells"]) == (self.begun, self.level, mesh.n)
        # Before the first step the sizes are not scaled to a fixed number.
        scaled = self.fixed_count is None or self.steps > 0
        return bool(same and scaled and self.labeled == mesh.next_label)

    def add_row(self, progress: float) -> None:
        """Append a row to the history."""
        mesh = self.mesh
        s, n, labeled = mesh.summaries.read(), mesh.n, mesh.next_label
        row: dict[str, float] = dict.fromkeys(HISTORY_DTYPE.fields or (), 0)
        row |= {"step": self.steps, "level": self.level, "cells": n, "progress": progress}
        row |= self.qualities(s)
        row["changed"], row["ever_changed"] = round(s["changed"].sum), s["ever_changed"].sum / n
        # Each inserted generator gets a new label.
        row["inserted"] = labeled - self.labeled
        before = int(self.rows[-1]["cells"][0]) if self.rows else self.n_start
        row["deleted"] = before + row["inserted"] - n
        if self.solution is not None:
            row["lloyd"], row["poisson"] = s["lloyd"].sum / n, s["correction"].sum / n
            row["iterations"], row["residual"] = self.solution.iterations, self.solution.residual
        row["seconds"] = time.perf_counter() - self.began
        # Faster than one field after the other.
        new = np.array([tuple(row.values())], HISTORY_DTYPE)
        # Without a call in between: after an interruption there, insertions would be counted twice.
        self.rows += [new]
        self.labeled = labeled

    def qualities(self, s: dict[str, Summary]) -> dict[str, float]:
        """Return errors, qualities and energy for a row of the history, from the summaries `s`."""
        mesh, n = self.mesh, self.mesh.n
        return {
            "mean_error": s["error"].magnitude / n,
            "max_error": s["error"].peak,
            "mean_quality": s["quality"].sum / n,
            "min_quality": s["quality"].least,
            "energy": s["energy"].sum * self._unit ** (mesh.engine.cell_dim + 2),
        }

    def end_reason(self, stop: bool, over: bool = False) -> str:
        """Return why the run ends, or "" if it continues. `over`: the schedule has ended."""
        if stop:
            return "stopped by the callback"
        if isinstance(self.last, MmpdeMethod | MongeAmpereMethod):
            if self.tol and self.last.finished:
                return SETTLED
        elif self.stalled():
            return STALLED
        if over and self.tol is None:
            return COMPLETED
        used_up = self.max_steps is not None and self.steps >= self.max_steps
        return "max_steps reached" if over or used_up else ""

    def stalled(self) -> bool:
        """Return whether both mean error and mean quality have improved by less than `tol` over the last steps."""
        if not self.tol or len(self.rows) <= 2 * WINDOW:
            return False
        history = np.concatenate(self.rows[-2 * WINDOW :])
        old, new = history[:WINDOW], history[WINDOW:]
        better_error = 1 - new["mean_error"].mean() / max(old["mean_error"].mean(), 1e-300)
        better_quality = new["mean_quality"].mean() / old["mean_quality"].mean() - 1
        return bool(max(better_error, better_quality) < self.tol)

    def displacements(self) -> Displacements:
        """Return the two displacements of the step, on the host."""
        mesh, (origin, scale) = self.mesh, self.mesh.domain.frame
        return Displacements(
            mesh.to_host(mesh.points, scale) + origin,
            mesh.to_host(mesh.lloyd, scale),
            mesh.to_host(mesh.correction, scale),
        )

    def result(self, converged: bool, reason: str, settings: dict[str, Any]) -> Result:
        """Return the result of the run.

        Raises
        ------
        InputError
            If cells of nearly coincident generators are wrong because of round-off.
        """
        mesh, final = self.mesh, self.final
        if self.steps and (final is None or self.rows[-1]["step"] == self.rows[-2]["step"]):
            # The last step was not known in advance, or generators have changed since.
            assert self.last is not None
            with mesh.engine.workspace.frame():
                self.last.displace(mesh)
                final = self.displacements()
        if mesh.finalize():
            # Faces shorter than round-off may have changed, and with them the quality.
            for name, value in self.qualities(mesh.summaries.read()).items():
                self.rows[-1][name] = value
        labels = mesh.ordered(mesh.labels)
        size = mesh.to_host(mesh.h, mesh.domain.frame[1])
        error, quality = mesh.to_host(mesh.error), mesh.to_host(mesh.quality)
        diagram = mesh.fetch_diagram()
        put_back(diagram, mesh.setup.points)
        return Result(
            points=diagram.points,
            diagram=diagram,
            target_size=size,
            size_error=error,
            quality=quality,
            # A given type is faster.
            history=np.concatenate(self.rows, dtype=HISTORY_DTYPE),
            converged=converged,
            stop_reason=reason,
            initial=self.initial,
            final=final,
            size_factor=mesh.size_factor,
            settings=settings,
            origin=origins(labels, self.started, mesh.taken),
        )
