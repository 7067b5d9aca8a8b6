"""A run: prepared, begun anew or where it was saved, carried out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..geometry.box import Domain
from ..mesh.results import Result
from ..tessellation.periodic.torus import FewCellsError
from .checkpoint import Checkpointer
from .fingerprint import describe
from .loop import Loop
from .options import Checkpoint, Options, uses
from .preparation import Preparation
from .resume import Saved
from .stages import Stages


def carry_out(
    stages: Stages,
    domain: Domain,
    size: object,
    points: np.ndarray | None,
    options: Options,
    files: Checkpoint,
    callback: Callable[[np.void], object] | None,
    on_memory: Callable[[float], object] | None,
) -> Result:
    """Return the result of a run, which has fewer coarse levels where a periodic box has too few cells around it.

    `on_memory` is called once with the bytes that the run needs on the device, before it begins; `callback` with each
    row of the history. Raises and warns as `Adapter.run` does.
    """
    source = files.source
    saved = None if source is None else Saved(source)
    made_by = {}
    if saved is not None or files.path is not None:
        made_by = describe(domain, vars(options), stages.engine.real, points)
    if saved is not None:
        saved.fit(made_by)
    most = None if saved is None else saved.levels
    while True:
        prepared = Preparation(stages, domain, size, points, options, most)
        if on_memory is not None:
            on_memory(prepared.memory)
            on_memory = None
        try:
            loop = _begin(prepared, made_by, saved, files, callback)
            return loop.run(
                options.n_cells if options.multilevel else None,
                float(prepared.target),
                _settings(prepared),
            )
        except FewCellsError:
            if options.levels != "auto" or prepared.levels == 0:
                raise
            most = prepared.levels - 1


def _begin(
    prepared: Preparation,
    made_by: dict,
    saved: Saved | None,
    files: Checkpoint,
    callback: Callable[[np.void], object] | None,
) -> Loop:
    """Return the loop at its beginning, or where it was when it was saved."""
    options, mesh = prepared.options, None
    if saved is None or prepared.may_be_near:
        mesh = prepared.mesh()
    plan = prepared.plan(mesh)
    writer = None
    if files.path is not None:
        writer = Checkpointer(files.path, files.every, made_by, plan)
    if saved is not None:
        mesh = None  # and with it the room that the one from there takes
        mesh = saved.restore(
            prepared.stages, prepared.domain, prepared.sizing, plan, prepared.free, len(prepared.rows)
        )  # fmt: skip
    assert mesh is not None
    tol = None if options.multilevel else options.tol
    loop = Loop(mesh, plan, prepared.levels, options.max_steps, tol, callback)
    loop.checkpoint = writer
    if saved is not None:
        saved.set(loop)
    return loop


def _settings(prepared: Preparation) -> dict[str, Any]:
    """Return what the result says of how it was made: what was asked for, as far as it matters to the method."""
    options = prepared.options
    told = {
        **vars(options),
        "start": options.start if prepared.points is None else "points",
        "levels": prepared.levels,
        "dtype": prepared.stages.engine.real.name,
        "layers": [repr(layer) for layer in options.layers],
    }
    return {name: value for name, value in told.items() if uses(options.method, name)}
