"""Checkpoints: a run's whole state in one file, from which it goes on to the same end, bit for bit.

What a step leaves for the next one is saved as it is: generators in the device's order, their diagram (the next one is
repaired from it), sizes, velocities, the solvers' starts, the multigrid's coarse levels (which last for several steps),
and the few numbers that the host keeps. What is computed anew from these (the size field, the plan) is compared with
what the file says, so that a run does not go on from another's state.
"""

from __future__ import annotations

import dataclasses
import hashlib
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
from .schedule import Action, Step
from .stages import Stages

if TYPE_CHECKING:
    from .loop import Loop

FORMAT, VERSION = "clvoro-checkpoint", 7
MESH = ("points", "labels", "velocity", "signatures", "ever", "h", "potential")
PER_FACE = ("neighbors", "face_measures", "face_centroids")
DIAGRAM = (
    "starts", "neighbors", "face_measures", "face_centroids", "volumes", "offsets", "covariances",
)  # fmt: skip


def fingerprint(plan: list[Action]) -> str:
    """Return a hash of a plan that has not begun."""
    return hashlib.sha256(repr(plan).encode()).hexdigest()


class Checkpointer:
    """Writes a run's state to `path` every `every` seconds, at most once between two actions of its plan.

    Parameters
    ----------
    path : str or path
    every : float
        Seconds from one to the next; 0: after each action.
    made_by : dict
        Of `describe`.
    plan : list of Action
        Before it begins.
    """

    def __init__(
        self, path: str | PathLike[str], every: float, made_by: dict, plan: list[Action]
    ) -> None:
        from ..io import check_writable

        path = check_path("checkpoint", path)
        if os.path.isdir(path) or not path:
            raise InputError(f"checkpoint is {path!r}, a folder, expected the name of a file")
        check_writable(path)
        _check_own(path)
        self.path, self.every, self.made_by = Path(path), every, made_by
        self.plan = fingerprint(plan)
        self._last = time.monotonic()

    def offer(self, loop: Loop, stop: bool) -> None:
        """Write a checkpoint if it is time, or if the run stops here.

        One that cannot be written, as the disk is full, costs neither the run nor the one from before.
        """
        if not stop and time.monotonic() - self._last < self.every:
            return
        try:
            self.write(loop)
        except OutputError as error:
            warn(
                f"{error}. The run goes on without this checkpoint; the one before is as it was",
                CheckpointWarning,
            )
        self._last = time.monotonic()

    def write(self, loop: Loop) -> None:
        """Write the state of `loop`, which is between two actions; what was at `path` is replaced when all is written.

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
        arrays["summaries"] = mesh.summaries.values.get()
        starts = t.starts.get()
        m = int(starts[-1])
        for name in DIAGRAM:
            array = getattr(t, name)
            arrays[f"diagram.{name}"] = (array[:m] if name in PER_FACE else array).get()
        for name, array in mesh.stages.poisson.save(mesh.labels).items():
            arrays[f"multigrid.{name}"] = array
        torus = mesh.tessellator.torus
        if torus is not None:
            # Within what images are taken: in 3D, sums of a cell depend on it in their last bits.
            arrays["seam.needed"] = torus.margins.needed.get()
        for part in ("initial", "final"):
            if getattr(loop, part) is not None:
                for field in dataclasses.fields(Displacements):
                    arrays[f"{part}.{field.name}"] = getattr(getattr(loop, part), field.name)
        arrays["history"] = np.concatenate(loop.rows)
        state = {
            "position": loop.position, "level": loop.level, "n_start": loop.n_start,
            "steps": loop.steps, "next_label": mesh.next_label, "spare": len(t.neighbors) - m,
            "coarsening": float(mesh.coarsening).hex(),
            "elapsed": time.perf_counter() - loop.began,
            "methods": [state_of(method) for method in methods_of(loop.plan)],
            "capacities": capacities_of(mesh.stages), "levels": loop.levels,
            "seam_cells": 0 if torus is None else torus.margins.cells,
        }  # fmt: skip
        about = {"made_by": self.made_by, "plan": self.plan, "state": state}
        arrays["about"] = np.array(json.dumps(about))
        write_arrays(self.path, FORMAT, VERSION, arrays, compress=False)


def _check_own(path: str) -> None:
    """Refuse to replace a file that is no checkpoint, unless it is empty."""
    from ..io.arrays import is_kind

    if os.path.exists(path) and os.path.getsize(path) and not is_kind(path, FORMAT):
        raise InputError(
            f"checkpoint is {path!r}, a file that is there and is no checkpoint; choose another name, or remove it"
        )


def methods_of(plan: list[Action]) -> list[Any]:
    """Return the methods of a plan, each once, in the order in which they first come."""
    return list({id(a.method): a.method for a in plan if isinstance(a, Step)}.values())


def state_of(method: Any) -> dict[str, float | int]:
    """Return what a method keeps from step to step: the numbers of those that are not frozen."""
    if type(method).__dataclass_params__.frozen:
        return {}
    values = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {k: v for k, v in values.items() if isinstance(v, (int, float))}


def capacities_of(stages: Stages) -> list[int]:
    """Return the room for faces that the cells' kernels were built with: whether a repair finds it too small."""
    cells = stages.cells
    return [cells.cell_capacity, cells.row_capacity] if isinstance(cells, Cells) else []
