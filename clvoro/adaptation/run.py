"""A run: preparation, start or restart, loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..arguments import check_callable
from ..errors import InputTypeError
from ..geometry.domain import Domain
from ..mesh.results import Result
from ..tessellation.periodic.images import FewCellsError
from .checkpoint import Checkpointer
from .fingerprint import run_fingerprint
from .loop import Loop
from .options import Checkpoint, Options, uses
from .plan.efforts import EFFORTS
from .preparation import Preparation
from .resume import Saved
from .stages import Stages

REACHED = 0.8
"""Share of an error target, larger than the effort's own, below which `trade` says where the error ends. Where such
targets are met, the error is at least 0.82 of them (`bench/front.py`)."""


def check_run(domain: object, size: object, callback: Callable[[np.void], object] | None) -> None:
    """Check the kinds of arguments of `Adapter.run` before a run begins."""
    if callback is not None and not callable(callback):
        raise InputTypeError(
            f"callback is {callback!r} of type {type(callback).__name__}, expected a function of a row of the history"
        )
    if callback is not None:
        check_callable("callback", callback, "a row of the history", "write lambda row: callback(...)")
    if isinstance(size, Domain) and not isinstance(domain, Domain):
        raise InputTypeError(
            f"size is the domain {size!r}, and domain is a {type(domain).__name__}; exchange them: run(domain, size)"
        )


def run_adaptation(
    stages: Stages,
    domain: Domain,
    size: object,
    points: np.ndarray | None,
    fixed: np.ndarray,
    options: Options,
    files: Checkpoint,
    callback: Callable[[np.void], object] | None,
    on_memory: Callable[[float], object] | None,
) -> Result:
    """Return the result of a run.

    If a periodic box has too few cells around it on the coarsest level, the run starts again with fewer levels.
    `on_memory` is called once with the bytes that the run needs on the device, before it begins; `callback` with each
    row of the history. Raises and warns as `Adapter.run` does.
    """
    source = files.source
    saved = None if source is None else Saved(source)
    fingerprint = {}
    if saved is not None or files.path is not None:
        fingerprint = run_fingerprint(domain, vars(options), stages.engine.real, points, fixed)
    if saved is not None:
        saved.check_fingerprint(fingerprint)
    max_levels = None if saved is None else saved.levels
    while True:
        prepared = Preparation(stages, domain, size, points, options, max_levels, fixed)
        if on_memory is not None:
            on_memory(prepared.memory)
            on_memory = None
        try:
            loop = _start(prepared, fingerprint, saved, files, callback)
            result = loop.run(
                options.n_cells if options.multilevel else None, float(prepared.target), _settings(prepared)
            )
            _note_end_of_trade(result, options)
            return result
        except FewCellsError:
            if options.levels != "auto" or prepared.levels == 0:
                raise
            max_levels = prepared.levels - 1


def _note_end_of_trade(result: Result, options: Options) -> None:
    """Add to `trade` in the settings where the error ends, if it is far below the target of the caller."""
    target, own = options.error_target, EFFORTS[options.effort].error_target
    planar = result.diagram.domain.cell_dim == 2
    if not (options.method == "adaptive" and planar and target and result.converged):
        return
    error = float(np.abs(result.size_error).mean())
    if target > own and error < REACHED * target:
        # Effort "fast" ends there because its steps end, not because the shape is as good as it gets.
        why = "" if options.effort == "fast" else ", as larger errors hardly give a better shape"
        result.settings["trade"] += f"; it ends at {error:.2g}{why}"


def _start(
    prepared: Preparation,
    fingerprint: dict[str, Any],
    saved: Saved | None,
    files: Checkpoint,
    callback: Callable[[np.void], object] | None,
) -> Loop:
    """Return the loop at its beginning, or where it was saved."""
    options, mesh, progress = prepared.options, None, None
    if saved is None or prepared.may_need_correction_only:
        mesh = prepared.mesh()
    schedule = prepared.schedule(mesh)
    writer = None
    if files.path is not None:
        writer = Checkpointer(files.path, files.every, fingerprint, schedule)
    if saved is not None:
        mesh = None  # free its memory
        mesh = saved.restore(prepared.setup, schedule)
        progress = saved.progress(schedule)
    assert mesh is not None
    tol = None if options.multilevel else options.tol
    return Loop(mesh, schedule, prepared.levels, options.max_steps, tol, callback, writer, progress)


def _settings(prepared: Preparation) -> dict[str, Any]:
    """Return the settings for the result: those that the method uses."""
    options = prepared.options
    settings = {
        **vars(options),
        "start": options.start if prepared.points is None else "points",
        "levels": prepared.levels,
        "error_target": prepared.error_target,
        "dtype": prepared.stages.engine.real.name,
        "layers": [repr(layer) for layer in options.layers],
        "fixed": len(prepared.fixed),
    }
    used = {name: value for name, value in settings.items() if uses(options.method, name)}
    return {**used, "trade": prepared.trade} if options.multilevel else used
