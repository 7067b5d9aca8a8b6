"""Checkpoints: the whole state of a run in one file, from which it continues with the same bits.

The file has everything that a step passes to the next one: generators in the order of the device, their diagram (the
next one is updated from it), sizes, velocities, starts of the solvers, coarse levels of the multigrid, and the numbers
on the host. The size field and the schedule are computed again and compared with the file.
"""

from __future__ import annotations

import dataclasses
import json
import os
import time
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arguments import check_path, warn
from ..errors import CheckpointWarning, InputError, OutputError
from ..mesh.results import Displacements
from ..tessellation.cells import Cells
from .fingerprint import schedule_digest
from .methods import Method
from .plan.actions import Action, Step
from .stages import Stages

if TYPE_CHECKING:
    from .loop import Loop

FORMAT, VERSION = "clvoro-checkpoint", 9
MESH = ("points", "labels", "velocity", "signatures", "ever_changed", "h", "potential")
PER_FACE = ("neighbors", "face_measures", "face_centroids")
DIAGRAM = ("starts", "neighbors", "face_measures", "face_centroids", "volumes", "offsets", "covariances")
VERTICES = {"triples": 2, "keys": 1}
"""Arrays of a diagram in 3D that will be updated, and their entries per face. They may be longer than that."""


@dataclasses.dataclass
class Progress:
    """How far a run has come.

    Attributes
    ----------
    level : int
        The present level; 0 is the finest.
    n_start : int
        Number of generators at the start.
    started : int
        Number of labels at the start: those of fixed generators that enter later are among them.
    labeled : int
        Number of labels when the last row of the history was added.
    position : int
        Number of actions done.
    steps : int
        Number of steps done.
    rows : list of (1,) array
        The history.
    initial, final : Displacements or None
        Of the first and of the last step. If the last step is not known in advance, they are evaluated again at the
        end.
    last : Method or None
        Method of the last step.
    elapsed : float
        Seconds.
    """

    level: int
    n_start: int
    started: int
    labeled: int
    position: int = 0
    steps: int = 0
    rows: list[np.ndarray] = dataclasses.field(default_factory=list)
    initial: Displacements | None = None
    final: Displacements | None = None
    last: Method | None = None
    elapsed: float = 0.0


class Checkpointer:
    """Writes the state of a run to `path` every `every` seconds, at most once between two actions.

    Parameters
    ----------
    path : str or path
    every : float
        Seconds between two checkpoints; 0 writes one after each action.
    fingerprint : dict
        See `run_fingerprint`.
    schedule : list of Action
        Before it begins.
    """

    def __init__(self, path: str | PathLike[str], every: float, fingerprint: dict, schedule: list[Action]) -> None:
        from ..io import check_writable

        path = check_path("checkpoint", path)
        if os.path.isdir(path) or not path:
            raise InputError(f"checkpoint is {path!r}, a folder, expected the name of a file")
        check_writable(path)
        _check_overwrite(path)
        self.path, self.every, self.fingerprint = Path(path), every, fingerprint
        self.schedule = schedule_digest(schedule)
        self._last = time.monotonic()

    def offer(self, loop: Loop, stop: bool) -> None:
        """Write a checkpoint if it is due, or if the run stops.

        If it cannot be written, because the disk is full for instance, the run continues and the last one stays.
        """
        if not stop and time.monotonic() - self._last < self.every:
            return
        try:
            self.write(loop)
        except OutputError as error:
            warn(f"{error}. The run continues without this checkpoint; the last one is unchanged", CheckpointWarning)
        self._last = time.monotonic()

    def write(self, loop: Loop) -> None:
        """Write the state of `loop` between two actions. The file is replaced when the new one is complete.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        from ..io.arrays import write_arrays

        mesh, t = loop.mesh, loop.mesh.t
        arrays: dict[str, np.ndarray] = {f"mesh.{name}": getattr(mesh, name).get() for name in MESH}
        if mesh.multipliers is not None:
            arrays["multipliers"] = mesh.multipliers.get()
        arrays["taken"] = mesh.taken
        arrays["summaries"] = mesh.summaries.values.get()
        starts = t.starts.get()
        m = int(starts[-1])
        for name in DIAGRAM:
            array = getattr(t, name)
            arrays[f"diagram.{name}"] = (array[:m] if name in PER_FACE else array).get()
        for (name, per_face), array in zip(VERTICES.items(), t.vertices, strict=False):
            arrays[f"vertices.{name}"] = array[: per_face * m].get()
        for name, array in mesh.stages.poisson.save(mesh.labels).items():
            arrays[f"multigrid.{name}"] = array
        halo = mesh.tessellator.steps.halo
        if halo is not None:
            # The depth of the halo: in 3D the last bits of a cell depend on it.
            arrays["seam.needed"] = halo.required.get()
        for part in ("initial", "final"):
            if getattr(loop, part) is not None:
                for field in dataclasses.fields(Displacements):
                    arrays[f"{part}.{field.name}"] = getattr(getattr(loop, part), field.name)
        arrays["history"] = np.concatenate(loop.rows)
        state = {
            "position": loop.position,
            "level": loop.level,
            "n_start": loop.n_start,
            "started": loop.started,
            "steps": loop.steps,
            "next_label": mesh.next_label,
            "spare": len(t.neighbors) - m,
            "size_factor": float(mesh.size_factor).hex(),
            "elapsed": time.perf_counter() - loop.began,
            "methods": [state_of(method) for method in methods_of(loop.schedule)],
            "capacities": capacities_of(mesh.stages),
            "levels": loop.levels,
            "seam_cells": 0 if halo is None else halo.cells,
        }
        about = {"fingerprint": self.fingerprint, "schedule": self.schedule, "state": state}
        arrays["about"] = np.array(json.dumps(about))
        write_arrays(self.path, FORMAT, VERSION, arrays, compress=False)


def _check_overwrite(path: str) -> None:
    """Raise InputError if the file exists, is not empty and not a checkpoint."""
    from ..io.arrays import is_kind

    if os.path.exists(path) and os.path.getsize(path) and not is_kind(path, FORMAT):
        raise InputError(
            f"checkpoint is {path!r}, an existing file that is not a checkpoint; choose another name, or remove it"
        )


def methods_of(schedule: list[Action]) -> list[Any]:
    """Return the methods of a schedule, each once, in the order of their first step."""
    return list({id(a.method): a.method for a in schedule if isinstance(a, Step)}.values())


def state_of(method: Any) -> dict[str, float | int]:
    """Return the state of a method between two steps: its numbers, if it is not frozen."""
    if type(method).__dataclass_params__.frozen:
        return {}
    values = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {k: v for k, v in values.items() if isinstance(v, (int, float))}


def capacities_of(stages: Stages) -> list[int]:
    """Return the capacities for faces that the kernels of the cells were built with."""
    cells = stages.cells
    return [cells.cell_capacity, cells.row_capacity] if isinstance(cells, Cells) else []
