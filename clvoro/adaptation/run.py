"""A run: the loop of the paper's Figure 1, displace, move, tessellate, record, until the schedule ends."""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from ..arguments import check_points
from ..errors import InputError, InputTypeError, Interrupted
from ..mesh.diagram import Diagram
from ..mesh.results import HISTORY_DTYPE, Displacements, Result, figures
from ..mesh.straightening import cell_quality
from ..mesh.subset import without_holes
from ..opencl.prebuild import renew
from ..opencl.primitives import Summary
from ..solvers.linear_system import Solution
from ..tessellation.periodic.images import FewCellsError
from ..tessellation.readback.parts import LaterDiagram
from .checkpoint import Checkpointer, Saved, progress_of, run_fingerprint, take_progress
from .diagnostics import MISSED, warn_of_errors, warn_of_moved_points, warn_of_obtuse_triangles, warn_of_other_sizes
from .fixed_points import origins, put_back
from .gathering import ResultParts
from .methods import MOVING
from .motion import Displacement, Method
from .options import RunArguments, uses
from .plan.actions import CorrectCount, Refine, Step
from .plan.efforts import EFFORTS
from .plan.schedule import work_of
from .preparation import Beginning, Plan, Prepared, judge_points, plan, prepare, start, without_far
from .stages import Stages
from .state import MeshState
from .tuning import PART_CELLS, REACHED, RENEWAL, WINDOW

INTERRUPTED, STOPPED, UNDER_WAY = "interrupted", "stopped by the callback", "under way"
MISSES = "plan ended, but the sizes are missed"
COMPLETED, STALLED = "plan completed", "error and quality no longer improve"
SETTLED = "tolerance of the moving mesh met"
"""Reasons of converged runs."""


def not_interrupted(result: Result) -> Result:
    """Return a result, or raise `Interrupted` with it if the run did not end."""
    if result.stop_reason == INTERRUPTED:
        raise Interrupted(result)
    return result


def check_shared(arguments: RunArguments) -> None:
    """Raise if ranks or devices cannot share such a run."""
    domain, _, options, *_ = arguments
    what = ""
    if not domain.may_have_parts:
        what = f"domain is {domain!r:.80}, expected one in 2D, a Sphere or a Box, without lines or surfaces inside"
    elif options.method in ("transport", *MOVING):
        what = f"method is {options.method!r}, expected one other than {', '.join(map(repr, ('transport', *MOVING)))}"
    elif options.layers:
        what = "layers are given, expected none"
    if what:
        raise InputError(f"{what}, since ranks or devices share the run; use an Adapter without comm and devices")


class Run:
    """A run that goes on step by step, shows its mesh at any time, and follows other size fields.

    `Adapter.start` begins one. The other attributes are for the actions of its schedule.

    Attributes
    ----------
    steps : int
        Number of steps done.
    level : int
        The present level; 0 is the finest.
    stop_reason : str
        Why the run has ended; "" while it goes on.

    Examples
    --------
    >>> run = clvoro.Adapter().start(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
    >>> while run.step() and run.steps < 3:
    ...     error = run.history["mean_error"][-1]
    >>> now, finished = run.mesh(), run.finish()
    >>> now.stop_reason, finished.stop_reason
    ('under way', 'plan completed')
    >>> run.follow(0.09)
    >>> len(run.finish().points) > len(finished.points)
    True
    """

    def __init__(
        self,
        stages: Stages,
        arguments: RunArguments,
        callback: Callable[[np.void], object] | None = None,
        on_memory: Callable[[float], object] | None = None,
        alone: Callable[[Stages], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        arguments = arguments.checked(stages.engine.real)
        self._stages, self._domain, self._options = stages, arguments.domain, arguments.options
        self._callback, self._on_memory, self._alone = callback, on_memory, alone
        self._is_part = stages.engine.peers.count > 1
        peers, source = stages.engine.peers, arguments.checkpoint.source
        self._begin(arguments, saved=None if source is None else peers.agree(lambda: Saved(source, peers)))

    def __repr__(self) -> str:
        return (
            f"Run({self.steps} steps, {self.state.total} cells on level {self.level}; {self.stop_reason or UNDER_WAY})"
        )

    def _begin(
        self,
        arguments: RunArguments,
        max_levels: int | None = None,
        saved: Saved | None = None,
        beginning: Beginning | None = None,
    ) -> None:
        """Prepare a run, and make its first mesh or read it from a checkpoint.

        `beginning` is what a first try has found, or the checkpoint has.
        """
        stages, files, peers = self._stages, arguments.checkpoint, self._stages.engine.peers
        peers.lead(peers.size)
        identity: dict[str, Any] = {}
        if saved is not None or files.path is not None or peers.count > 1:
            identity = run_fingerprint(arguments, stages.engine.real)
        if saved is not None:
            peers.agree(lambda: saved.check_fingerprint(identity))
            max_levels, beginning = saved.levels, saved.beginning
        prepared = peers.agree(
            lambda: _prepared(stages, arguments, max_levels, beginning),
            lambda made: {
                **identity,
                "cells": made.count.target,
                "levels": made.levels,
                "cells for the size field": made.count.required,
            },
        )
        if hasattr(self, "state"):
            stages.release()  # memory of the mesh that the run has had
        if self._on_memory is not None:
            self._on_memory(prepared.memory)
            self._on_memory = None
        self.arguments, self._setup = arguments, prepared.setup
        self.target, self.levels = float(prepared.count.target), prepared.levels
        parts = self._parts_on(prepared.levels if prepared.points is None else 0)
        peers.lead(parts if saved is None else saved.parts)
        if peers.rests:
            beginning = beginning or Beginning("random")
        elif saved is None:
            try:
                self.state = start(prepared)
                if beginning is None:
                    beginning, after = judge_points(prepared, self.state)
                    if after is not prepared:
                        stages.release()
                        prepared, self.levels = after, after.levels
                        self.state = start(prepared)
            except FewCellsError as error:
                self._begin(arguments, self._fewer_levels(error), beginning=beginning)
                return
        assert beginning is not None
        self.beginning = beginning
        planned = plan(prepared, beginning.begins)
        self._writer = None
        if files.path is not None:
            path = files.path
            self._writer = peers.agree(lambda: Checkpointer(path, files.every, identity, planned.schedule, peers))
        self._renews = saved is not None or (self._writer is not None and files.every < math.inf)
        self.pace = RENEWAL if files.every else 0
        if saved is not None and not peers.rests:
            self.state = saved.mesh(prepared.setup, planned.schedule)
        self._set_out(prepared, planned, saved)
        self._settings = self._describe(prepared, planned)

    def _set_out(self, prepared: Prepared, planned: Plan, saved: Saved | None) -> None:
        """Set how far the run has come: it begins, or it goes on where it was saved."""
        multilevel = self._options.multilevel
        self.schedule, self.level = planned.schedule, prepared.levels
        self._origins = prepared.origins
        self.n_cells = self._options.n_cells if multilevel else None
        self._tol = None if multilevel else self._options.tol
        rests = self._stages.engine.peers.rests
        self.n_start, self.started = (0, 0) if rests else (self.state.total, self.state.next_label)
        self.position = self.steps = self.obtuse = 0
        self.rows: list[np.ndarray] = []
        self.initial: Displacements | None = None
        self.final: Displacements | None = None
        self.last: Method | None = None
        self.solution: Solution | None = None
        self.stop_reason, self._stop, self._acts = "", False, False
        self._result: Result | None = None
        elapsed = 0.0 if saved is None else saved.resume(self)
        self.began, self.begun, self._renewed = time.perf_counter() - elapsed, self.steps, self.steps
        self.labeled = self.started + sum(int(row["inserted"][0]) for row in self.rows)
        done = work_of(self.schedule, self.levels, self._domain.cell_dim, self.target)
        self._progress = [*done[1:], 1.0]
        steps = [position for position, action in enumerate(self.schedule) if isinstance(action, Step)]
        self._last_step = steps[-1] if steps and self._tol is None else None

    def _describe(self, prepared: Prepared, planned: Plan) -> dict[str, Any]:
        """Return the settings for the result: those that the method uses."""
        options = self._options
        settings = {
            **vars(options),
            "start": options.start if self._origins is None else "points",
            "levels": self.levels,
            "error_target": planned.error_target,
            "dtype": self._stages.engine.real.name,
            "layers": [repr(layer) for layer in options.layers],
            "fixed": len(self.arguments.fixed),
        }
        used = {name: value for name, value in settings.items() if uses(options.method, name)}
        layout = prepared.layout
        used |= {"widths": widths} if (widths := layout.layers.narrow(layout.given)) else {}
        used |= {"path": self.beginning.why} if self.beginning.why else {}
        return {**used, "trade": planned.trade} if options.multilevel else used

    def _fewer_levels(self, error: FewCellsError) -> int:
        """Return fewer levels after `error`: a periodic box has too few cells around it on the coarsest of them."""
        if self._options.levels != "auto" or self.levels == 0:
            raise error
        peers = self._stages.engine.peers
        peers.call(peers.size, self.levels - 1)
        return self.levels - 1

    def _parts_on(self, level: int) -> int:
        """Return how many parts work on a level: all of them on the finest one, fewer where there are few cells."""
        size = self._stages.engine.peers.size
        cells = self.target / 2.0 ** (self._domain.cell_dim * level)
        return size if level == 0 else min(max(int(cells / PART_CELLS[self._domain.cell_dim]), 1), size)

    def call_parts(self, mesh: dict[str, Any]) -> None:
        """Call further parts to the next finer level, if it has work for them; `mesh` are arguments of its mesh."""
        peers = self._stages.engine.peers
        count = self._parts_on(self.level - 1)
        if count > peers.count:
            state = {name: getattr(self, name) for name in ("begun", "_renewed", "labeled", "_stop", "stop_reason")}
            peers.call(count, (mesh, progress_of(self), np.concatenate(self.rows), state))
            self._stages.drop_poisson()

    def _join(self) -> bool:
        """Wait for work, and join a run that others have refined; return whether it goes on."""
        message = self._stages.engine.peers.rest()
        if isinstance(message, int):
            self._begin(self.arguments, message)
            return True
        mesh, progress, history, state = message
        take_progress(self, progress, history)
        vars(self).update(state)
        engine = self._stages.engine
        none = {"points": engine.empty((0, engine.dim)), "labels": engine.empty(0, np.int32)}
        self.state, self.level = MeshState(self._setup, start=none, **mesh), self.level - 1
        if not self.stop_reason:
            self.position += 1
            self._keep()
        return not self.stop_reason

    @property
    def history(self) -> np.ndarray:
        """The rows so far; see `Result.history`."""
        return np.concatenate([np.empty(0, HISTORY_DTYPE), *self.rows], dtype=HISTORY_DTYPE)

    def step(self) -> bool:
        """Go on to the next row of the history: first the start, then one step at a time.

        Returns
        -------
        bool
            Whether there is one; False at the end.
        """
        with self._alone(self._stages):
            return self._advance()

    def finish(self) -> Result:
        """Go on to the end, and return the mesh.

        Raises
        ------
        Interrupted
            On Ctrl-C; it carries the mesh so far.
        """
        with self._alone(self._stages):
            return not_interrupted(self.conclude())

    def mesh(self) -> Result:
        """Return the mesh that the run would give if it ended now; the run goes on as if nothing had happened.

        It is a mesh of the finest level and has the required number of cells. It needs the memory of another run.
        """
        with self._alone(self._stages):
            if self.stop_reason:
                return self.conclude()
            self._mend()
            other = copy.copy(self)
            other.state, other.rows, other.last = self.state.copy(), [r.copy() for r in self.rows], copy.copy(self.last)
            other.stop_reason = UNDER_WAY
            return other._end()

    def follow(self, size: object) -> None:
        """Go on with another size field, from the generators that are there.

        The run then does what a run from given points does: it only corrects and polishes a mesh that nearly has the
        sizes. Its history begins anew, and `Result.origin` counts from the present generators.

        Parameters
        ----------
        size : number, callable or clvoro.sizing field

        Raises
        ------
        InputError, InputTypeError, SizeFieldError, MemoryLimitError
            As `Adapter.run`.
        """
        with self._alone(self._stages):
            if self._result is None:
                origin, scale = self._domain.frame
                points = self.state.to_host(self.state.points, scale) + origin
            else:
                points = self._result.points
            self._begin(self.arguments._replace(size=size, points=check_points(points, self._domain)))

    def _advance(self) -> bool:
        """Do actions up to the next row of the history; return whether there is one."""
        known = len(self.rows)
        self._mend()
        try:
            if self._stages.engine.peers.rests:
                return self._join()
            if not self.rows:
                self.record(0.0)
                if self._stop:
                    self._keep()
            while len(self.rows) == known and not self.stop_reason:
                self.stop_reason = self._end_reason(self.position == len(self.schedule))
                if not self.stop_reason:
                    renew(self._stages.engine)
                    self._acts = True
                    self.schedule[self.position].apply(self)
                    self._acts = False
                    self.position += 1
                    self._keep()
        except FewCellsError as error:
            known = self.beginning if _replaces(self.arguments, self.beginning) else None
            self._begin(self.arguments, self._fewer_levels(error), beginning=known)
            return self._advance()
        return len(self.rows) > known

    def _mend(self) -> None:
        """Compute the mesh of the present generators, if an error or Ctrl-C has ended an action halfway."""
        if self._acts:
            self.state.update()
            self._acts = False

    def _keep(self) -> None:
        """At the end of an action, compute the mesh anew and write a checkpoint, if they are due."""
        due = self._renews and self.steps - self._renewed >= self.pace
        if due and not self._stop:
            self.state, self._renewed = self.state.renewed(), self.steps
        if self._writer is not None and (due or self._stop):
            self._writer.write_if_due(self, self._stop)

    def conclude(self) -> Result:
        """Do as `finish`, for a caller that excludes other threads; after Ctrl-C return the mesh so far."""
        if self._result is None:
            try:
                while self._advance():
                    pass
            except KeyboardInterrupt:
                if self._is_part:  # the other parts wait for this one
                    raise
                self.stop_reason = INTERRUPTED
                # Of a step that has not ended the generators are good: the run that is resumed does it again.
                resumable = not self._acts or isinstance(self.schedule[self.position], Step)
                self.state.update()
                self._acts = False
                if self._writer is not None and resumable and self.rows:
                    self._writer.write_if_due(self, stop=True)
            self._result = self._end()
        return self._result

    @property
    def fixed_count(self) -> int | None:
        """Fixed number of cells of the present level; None if the size field determines it."""
        return self.n_cells if self.level == 0 else None

    def note(self, displacement: Displacement) -> None:
        """Keep the displacement of the first and of the last step on the host. Parts swap generators, and keep none."""
        if not self._is_part and self.initial is None:
            self.initial = self.state.displacements(displacement)
        if not self._is_part and self.position == self._last_step:
            self.final = self.state.displacements(displacement)
        self.solution = displacement.solution

    def record(self, progress: float | None = None) -> None:
        """Append a row to the history, and let the callback stop the run."""
        self._add_row(self._progress[self.position] if progress is None else progress)
        if self._callback is None:
            return
        answer = self._callback(self.rows[-1][0].copy())
        try:
            self._stop = self._stages.engine.peers.any(bool(answer))
        except ValueError as error:  # a NumPy array has no truth value
            raise InputTypeError(
                f"callback returned {answer!r:.60} of type {type(answer).__name__}, expected True to stop, False or "
                f"None to go on ({error})"
            ) from error

    def _is_recorded(self) -> bool:
        """Return whether the last row of the history describes the present mesh."""
        if not self.rows:
            return False
        row, mesh = self.rows[-1][0], self.state
        same = (row["step"], row["level"], row["cells"]) == (self.begun, self.level, mesh.total)
        # Before the first step the sizes are not scaled to a fixed number.
        scaled = self.fixed_count is None or self.steps > 0
        return bool(same and scaled and self.labeled == mesh.next_label)

    def _add_row(self, progress: float) -> None:
        mesh = self.state
        s, n, labeled = mesh.summaries.read(), mesh.total, mesh.next_label
        row: dict[str, float] = dict.fromkeys(HISTORY_DTYPE.fields or (), 0)
        row |= {"step": self.steps, "level": self.level, "cells": n, "progress": progress}
        row |= self._qualities(s)
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

    def _qualities(self, s: dict[str, Summary]) -> dict[str, float]:
        """Return errors, qualities and energy for a row of the history, from the summaries `s`."""
        mesh, n = self.state, self.state.total
        return {
            "mean_error": s["error"].magnitude / n,
            "max_error": s["error"].peak,
            "mean_quality": s["quality"].sum / n,
            "min_quality": s["quality"].least,
            "energy": s["energy"].sum * mesh.domain.frame[1] ** (mesh.engine.cell_dim + 2),
        }

    def _end_reason(self, over: bool) -> str:
        """Return why the run ends, or "" if it goes on. `over`: the schedule has ended."""
        if self._stop:
            return STOPPED
        finished = None if self.last is None else self.last.finished
        if finished is None and self._stalled():
            return STALLED
        if finished and self._tol:
            return SETTLED
        if over and self._tol is None:
            return COMPLETED
        used_up = self._options.max_steps is not None and self.steps >= self._options.max_steps
        return "max_steps reached" if over or used_up else ""

    def _stalled(self) -> bool:
        """Return whether both mean error and mean quality have improved by less than `tol` over the last steps."""
        if not self._tol or len(self.rows) <= 2 * WINDOW:
            return False
        history = np.concatenate(self.rows[-2 * WINDOW :])
        old, new = history[:WINDOW], history[WINDOW:]
        better_error = 1 - new["mean_error"].mean() / max(old["mean_error"].mean(), 1e-300)
        better_quality = new["mean_quality"].mean() / old["mean_quality"].mean() - 1
        return bool(max(better_error, better_quality) < self._tol)

    def _end(self) -> Result:
        """Return the result: it always has the required sizes and number of cells."""
        while self.level > 0:
            Refine().apply(self)
        CorrectCount().apply(self)
        if not self._is_recorded():
            self.solution = None
            self._add_row(float(self.rows[-1]["progress"][0]) if self.rows else 0.0)
        result = self._read_result()
        if not self._options.multilevel:
            warn_of_other_sizes(result)
        if result.converged and self._options.multilevel:
            mean, last, reason = float(result.history["mean_error"][-1]), result.history[-WINDOW:], ""
            if mean > max(MISSED, self._options.error_target or 0.0):
                reason = f"{MISSES}: mean |e| {mean:.2g}"
            # One cycle of multigrid, as the first steps after a refinement take, may raise the residual.
            elif len(wild := last["step"][(last["residual"] > 1) & (last["iterations"] > 1)]):
                reason = f"plan ended, but step {wild[-1]} did not converge: cells are less regular than usual"
            if reason:
                warn_of_errors(result, self.state.sizing)
                return dataclasses.replace(result, converged=False, stop_reason=reason)
        if result.converged:
            self._note_end_of_trade(result)
            if self.obtuse:
                warn_of_obtuse_triangles(result)
            if self._options.multilevel:
                warn_of_errors(result, self.state.sizing)
        return result

    def _read_result(self) -> Result:
        """Read the mesh. Raises InputError if cells of nearly coincident generators are wrong because of round-off."""
        mesh, final = self.state, self._final_displacements()
        if mesh.finalize():
            # Faces shorter than round-off may have changed, and with them the quality.
            for name, value in self._qualities(mesh.summaries.read()).items():
                self.rows[-1][name] = value
        labels = mesh.ordered(mesh.labels)
        size = mesh.to_host(mesh.h, mesh.domain.frame[1])
        error, quality = mesh.to_host(mesh.error), mesh.to_host(mesh.quality)
        origin, fixed = origins(labels, self.started, mesh.taken), mesh.setup.points
        if self._origins is not None:
            origin = np.where(origin < 0, -1, self._origins[origin])
        elif self.arguments.points is not None:
            origin = np.full_like(origin, -1)
        held = self.arguments.fixed
        extrudes = bool(self._options.layers) and self._domain.extrudes_layers
        # Layers of prisms become thinner where generators below them have settled.
        targets = None if extrudes else mesh.cell_targets(self._options.method == "exact")
        diagram, settings, parts = mesh.fetch_diagram(len(held), targets), dict(self._settings), None
        if self._is_part:
            assert isinstance(diagram, LaterDiagram)
            parts = ResultParts(mesh.engine, self._domain, diagram.rows, labels, fixed)
        if extrudes:
            from ..finite_volumes.solid_walls.layers import add_layers

            diagram, settings["thickness"] = add_layers(diagram, self._options.layers)
            # Vertices have moved, and generators with them.
            warn_of_moved_points(held, diagram, size)
            fixed = fixed[:0]
        if (home := diagram.home) is not None:
            # Cells may have been cut along creases: further parts come last. Generators in thin places may have none.
            own, home = home >= 0, np.where(home < 0, -1 - home, home)
            origin, fixed = np.where(own, origin[home], -1), fixed[home[own & (home < len(fixed))]]
            size = self._sizes_in_mesh(diagram, size[home])
            error, quality = self._measured_again(diagram, size)
        put_back(diagram, self._domain, fixed[labels[labels < len(fixed)]] if self._is_part else fixed)
        result = Result(
            points=diagram.points,
            diagram=diagram,
            target_size=size,
            size_error=error,
            quality=quality,
            history=self.history,
            converged=self.stop_reason in (COMPLETED, STALLED, SETTLED),
            stop_reason=self.stop_reason,
            initial=self.initial,
            final=final,
            size_factor=mesh.size_factor,
            settings=settings,
            origin=origin,
            parts=parts,
        )
        return without_holes(result)

    def _final_displacements(self) -> Displacements | None:
        """Return those of the last step, computed again if it was not known in advance or generators have changed."""
        known = self.final is not None and (len(self.rows) < 2 or self.rows[-1]["step"] != self.rows[-2]["step"])
        if self._is_part or not self.steps or known:
            return self.final
        assert self.last is not None
        with self.state.engine.workspace.frame():
            return self.state.displacements(self.last.step(self.state))

    def _sizes_in_mesh(self, diagram: Diagram, size: np.ndarray) -> np.ndarray:
        """Return the target sizes of the cells of `diagram`, in a solid, after layers have compressed them."""
        after, factor = self.state.setup.after_layers, self.state.size_factor
        if after is None:
            return size
        return np.where(diagram.layer > 0, np.cbrt(diagram.volumes), factor * after(diagram.points))

    def _measured_again(self, diagram: Diagram, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return error and quality of the cells of `diagram`, in a solid, and put their figures into the history.

        The device's cells at curved walls are a little different from those of the diagram.
        """
        length = np.cbrt(diagram.volumes)
        with np.errstate(divide="ignore"):  # cells without volume have the error -inf
            error = (length - size) / np.minimum(length, size)
        quality = cell_quality(diagram, np.add.reduceat(diagram.face_measures, diagram.neighbor_starts[:-1]))
        row = self.rows[-1]
        more = len(diagram) - int(row["cells"][0])
        row["inserted" if more > 0 else "deleted"] += abs(more)
        for name, value in {"cells": len(diagram), **figures(error, quality)}.items():
            row[name] = value
        return error, quality

    def _note_end_of_trade(self, result: Result) -> None:
        """Add to `trade` in the settings where the error ends, if it is far below the target of the caller."""
        options = self._options
        target, own = options.error_target, EFFORTS[options.effort].error_target
        if options.method != "adaptive" or self._domain.cell_dim == 3 or not target:
            return
        error = float(result.history["mean_error"][-1])
        if target > own and error < REACHED * target:
            # Effort "fast" ends there because its steps end, not because the shape is as good as it gets.
            why = "" if options.effort == "fast" else ", as larger errors hardly give a better shape"
            result.settings["trade"] += f"; it ends at {error:.2g}{why}"


def _prepared(stages: Stages, arguments: RunArguments, max_levels: int | None, beginning: Beginning | None) -> Prepared:
    """Prepare a run, with random points in place of those that are known to be far from the sizes."""
    made = prepare(stages, arguments, max_levels)
    return without_far(made, max_levels) if beginning is not None and _replaces(arguments, beginning) else made


def _replaces(arguments: RunArguments, beginning: Beginning) -> bool:
    """Return whether random points replace some of those of the caller, or all."""
    return arguments.points is not None and beginning.begins in ("random", "lattice", "partly random")
