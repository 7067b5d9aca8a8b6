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
import time
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ._arrays import check_path
from .cells import Cells
from .errors import InputError
from .made_by import named
from .mesh import SUMMARIES, Mesh
from .plans import Action, Step
from .polygon import Polygon
from .results import HISTORY_DTYPE, Displacements
from .seam import block_count
from .stages import Stages
from .tessellation import Tessellation

if TYPE_CHECKING:
    from .domain import Domain
    from .loop import Loop
    from .sizing import Sizing

FORMAT, VERSION = "clvoro-checkpoint", 5
_MESH = ("points", "labels", "velocity", "signatures", "ever", "h", "potential")
_PER_FACE = ("neighbours", "face_measures", "face_centroids")
_DIAGRAM = (
    "starts", "neighbours", "face_measures", "face_centroids", "volumes", "offsets", "covariances",
)  # fmt: skip
_COUNTS = (
    "position",
    "level",
    "n_start",
    "steps",
    "inserted",
    "deleted",
    "next_label",
    "spare",
    "seam_cells",
)


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
        from .io import check_writable

        path = check_path("checkpoint", path)
        if Path(path).is_dir():
            raise InputError(f"checkpoint is {str(path)!r}, a folder, expected the name of a file")
        check_writable(path)
        self.path, self.every, self.made_by = Path(path), every, made_by
        self.plan = fingerprint(plan)
        self._last = time.monotonic()

    def offer(self, loop: Loop, stop: bool) -> None:
        """Write a checkpoint if it is time, or if the run stops here."""
        if stop or time.monotonic() - self._last >= self.every:
            self.write(loop)
            self._last = time.monotonic()

    def write(self, loop: Loop) -> None:
        """Write the state of `loop`, which is between two actions; what was at `path` is replaced when all is written.

        Raises
        ------
        InputError
            If the file cannot be written.
        """
        from .io.arrays import write_arrays

        mesh, t = loop.mesh, loop.mesh.t
        arrays: dict[str, np.ndarray] = {
            f"mesh.{name}": getattr(mesh, name).get() for name in _MESH
        }
        if mesh.multipliers is not None:
            arrays["multipliers"] = mesh.multipliers.get()
        arrays["summaries"] = mesh.summaries.values.get()
        starts = t.starts.get()
        m = int(starts[-1])
        for name in _DIAGRAM:
            array = getattr(t, name)
            arrays[f"diagram.{name}"] = (array[:m] if name in _PER_FACE else array).get()
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
            "steps": loop.steps, "inserted": loop.inserted, "deleted": loop.deleted,
            "next_label": mesh.next_label, "spare": len(t.neighbours) - m,
            "coarsening": float(mesh.coarsening).hex(),
            "elapsed": time.perf_counter() - loop.began,
            "methods": [_state_of(method) for method in _methods(loop.plan)],
            "capacities": _capacities(mesh.stages), "levels": loop.levels,
            "seam_cells": 0 if torus is None else torus.margins.cells,
        }  # fmt: skip
        about = {"made_by": self.made_by, "plan": self.plan, "state": state}
        arrays["about"] = np.array(json.dumps(about))
        write_arrays(self.path, FORMAT, VERSION, arrays, compress=False)


class Saved:
    """A checkpoint that has been read and found sound in itself.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    InputError
        If the file is missing, damaged, cut off or no checkpoint; names the file and what is wrong.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        from .io.arrays import read_arrays

        self.name = check_path("resume", path)
        self.arrays = read_arrays(self.name, FORMAT, VERSION)
        version = self.arrays["version"].item()
        if version != VERSION:
            raise InputError(
                f"cannot resume from {self.name}: it is a checkpoint of version {version}, expected {VERSION}, as this "
                "version of clvoro writes; begin anew without resume"
            )
        try:
            about = json.loads(self.arrays["about"].item())
            self.made_by, self.plan = dict(about["made_by"]), str(about["plan"])
            self.state = state = dict(about["state"])
            if any(type(state[name]) is not int or state[name] < 0 for name in _COUNTS):
                raise ValueError("counts")
            self.coarsening = float.fromhex(state["coarsening"])
            self.elapsed = float(state["elapsed"])
            self.levels = int(state["levels"])
            if not (0 < self.coarsening < np.inf and 0 <= self.elapsed < np.inf):
                raise ValueError("coarsening")
            if not self.levels >= 0:
                raise ValueError("levels")
            domain = self.made_by["domain"]
            d = len(domain["lower"])
            self._check(d, int(domain["walls"]), np.dtype(self.made_by["dtype"]))
            if any(domain["periodic"]):
                self._check_seams(d)
        except (
            KeyError,
            ValueError,
            TypeError,
            AttributeError,
            IndexError,
            RecursionError,
        ) as error:
            raise InputError(
                f"cannot resume from {self.name}: it is damaged ({error!r:.200})"
            ) from error

    def _check(self, d: int, walls: int, real: np.dtype) -> None:
        """Check all that the device would otherwise index by, or divide by, unseen."""
        a = self.arrays
        n, m = len(a["mesh.points"]), len(a["diagram.neighbours"])
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            **{f"mesh.{name}": ((n,), real) for name in _MESH},
            **{f"mesh.{name}": ((n, d), real) for name in ("points", "velocity")},
            "mesh.labels": ((n,), np.int32), "mesh.signatures": ((n,), np.uint64),
            "diagram.starts": ((n + 1,), np.int32), "diagram.neighbours": ((m,), np.int32),
            "diagram.face_measures": ((m,), a["diagram.face_measures"].dtype),
            "diagram.face_centroids": ((m, d), a["diagram.face_measures"].dtype),
            "diagram.volumes": ((n,), real), "diagram.offsets": ((n, d), real),
            "diagram.covariances": ((n, d * (d + 1) // 2), real),
            "summaries": ((len(SUMMARIES), 4), real),
            "history": ((len(a["history"]),), HISTORY_DTYPE),
        }  # fmt: skip
        if "multipliers" in a:
            shapes["multipliers"] = ((n,), np.float32)
        for name, (shape, dtype) in shapes.items():
            if a[name].shape != shape or a[name].dtype != dtype:
                raise ValueError(f"{name} is {a[name].dtype} {a[name].shape}, expected {shape}")
        starts, neighbours, labels = a["diagram.starts"], a["diagram.neighbours"], a["mesh.labels"]
        if n == 0 or starts[0] != 0 or starts[-1] != m or (np.diff(starts) < d + 1).any():
            raise ValueError("starts")
        if not (-walls <= neighbours.min() and neighbours.max() < n):
            raise ValueError("neighbours")
        known = labels.min() >= 0 and labels.max() < self.state["next_label"]
        if not known or len(np.unique(labels)) < n:
            raise ValueError("labels")
        x, h = a["mesh.points"], a["mesh.h"]
        if not (np.isfinite(x).all() and x.min() >= 0 and x.max() <= 1):
            raise ValueError("points")
        if not ((h > 0).all() and np.isfinite(h).all()):
            raise ValueError("sizes")
        # Room that was made for the most cells that the run had is kept when there are fewer.
        cells = max(n, self.state["n_start"], int(a["history"]["cells"].max()))
        if self.state["spare"] > 64 * cells + 64:
            raise ValueError("spare")

    def _check_seams(self, d: int) -> None:
        """Check what a periodic box of `d` dimensions has beside."""
        needed = self.arrays["seam.needed"]
        if needed.shape != (block_count(d),) or needed.dtype != np.float32:
            raise ValueError("seam.needed")
        if not (np.isfinite(needed).all() and needed.min() >= 0):
            raise ValueError("seam.needed")

    def fit(self, made_by: dict) -> None:
        """Refuse a checkpoint of another domain or of other settings, naming the first that differs.

        Raises
        ------
        InputError
        """
        made_by = json.loads(json.dumps(made_by))
        for name in {**self.made_by, **made_by}:
            was, now = self.made_by.get(name), made_by.get(name)
            if was == now:
                continue
            if name == "points":
                was, now = ("none" if v is None else f"others ({v:.8}...)" for v in (was, now))
            if name == "domain":
                was, now = (named(v) for v in (was, now))
            raise InputError(
                f"cannot resume from {self.name}: it is of a run with {name} = {was}, and this one has {name} = "
                f"{now}; give the settings of that run, or begin anew without resume"
            )

    def restore(
        self,
        stages: Stages,
        domain: Domain,
        sizing: Sizing,
        plan: list[Action],
        free: Domain | None = None,
        fixed: int = 0,
    ) -> Mesh:
        """Return the mesh as the run left it, for a loop over `plan`.

        Raises
        ------
        InputError
            If plan or size field are others than those of the run that was saved.
        """
        state, engine, a = self.state, stages.engine, self.arrays
        if self.plan != fingerprint(plan) or state["position"] > len(plan):
            raise InputError(
                f"cannot resume from {self.name}: its plan is another, as of another version of clvoro; begin anew"
            )
        _set_capacities(stages, state["capacities"])
        points = engine.upload(a["mesh.points"])
        labels = engine.upload(a["mesh.labels"], np.int32)
        # Makes room in all stages, too: the arrays that it computes are then replaced.
        mesh = Mesh(stages, domain, sizing, points, labels, self.coarsening, free, fixed)
        sizes = engine.empty(mesh.n)
        sizing.evaluate(points, mesh.n, sizes)
        moving = self.arrays["mesh.labels"] >= fixed
        self._compare_sizes(sizes.get().astype(float) * self.coarsening, domain, moving)
        for name in _MESH:
            array = a[f"mesh.{name}"]
            setattr(mesh, name, engine.upload(array, array.dtype))
        if "multipliers" in a:
            mesh.multipliers = engine.upload(a["multipliers"], np.float32)
        t = {}
        for name in _DIAGRAM:
            array = a[f"diagram.{name}"]
            if name in _PER_FACE:  # as much spare room as there was
                array = np.concatenate(
                    [array, np.zeros((state["spare"], *array.shape[1:]), array.dtype)]
                )
            t[name] = engine.upload(array, array.dtype)
        if isinstance(domain, Polygon):
            # Trimmed from another diagram, which is not kept: made anew, it has the same bits.
            mesh.tessellation = mesh.tessellator.tessellate(mesh.points, mesh.n)
        elif t["face_measures"].dtype != engine.face:
            raise InputError(
                f"cannot resume from {self.name}: it is damaged (faces are {t['face_measures'].dtype})"
            )
        else:
            mesh.tessellation = Tessellation(n=mesh.n, points=mesh.points, **t)
        mesh.next_label = state["next_label"]
        torus = mesh.tessellator.torus
        if torus is not None:
            torus.margins.needed.set(a["seam.needed"])
            torus.margins.cells = state["seam_cells"]
        mesh._evaluate_metric()
        mesh.summaries.values.set(a["summaries"])
        levels = {
            k.removeprefix("multigrid."): v for k, v in a.items() if k.startswith("multigrid.")
        }
        try:
            stages.poisson.restore(levels, mesh.labels, mesh.n)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"cannot resume from {self.name}: it is damaged ({error!r:.200})"
            ) from error
        return mesh

    def _compare_sizes(self, now: np.ndarray, domain: Domain, moving: np.ndarray) -> None:
        saved = self.arrays["mesh.h"].astype(float)
        tolerance = 1e4 * np.finfo(self.arrays["mesh.h"].dtype).eps
        off = np.where(moving, np.abs(now / saved - 1), 0.0)
        worst = int(np.argmax(off))
        if not off[worst] <= tolerance:
            origin, scale = domain.frame
            place = self.arrays["mesh.points"][worst] * scale + origin
            raise InputError(
                f"cannot resume from {self.name}: its size field is another; at {place} the run's size was "
                f"{saved[worst] * scale / self.coarsening:.6g}, this field's is "
                f"{now[worst] * scale / self.coarsening:.6g}. Give the field of that run, or begin anew"
            )

    def set(self, loop: Loop) -> None:
        """Set a loop, which has the mesh from `restore`, to where the run was."""
        state = self.state
        for name in ("position", "level", "n_start", "steps", "inserted", "deleted"):
            setattr(loop, name, state[name])
        for method, values in zip(_methods(loop.plan), state["methods"], strict=True):
            for name in _state_of(method):
                setattr(method, name, values[name])
        loop.rows = [row.reshape(1) for row in self.arrays["history"]]
        steps = [action for action in loop.plan[: loop.position] if isinstance(action, Step)]
        if steps:
            loop.last = steps[-1].method
        for part in ("initial", "final"):
            saved = [self.arrays.get(f"{part}.{f.name}") for f in dataclasses.fields(Displacements)]
            if all(array is not None for array in saved):
                setattr(loop, part, Displacements(*saved))  # type: ignore[arg-type]
        loop.began = time.perf_counter() - self.elapsed


def _methods(plan: list[Action]) -> list[Any]:
    """Return the methods of a plan, each once, in the order in which they first come."""
    return list({id(a.method): a.method for a in plan if isinstance(a, Step)}.values())


def _state_of(method: Any) -> dict[str, float | int]:
    """Return what a method keeps from step to step: the numbers of those that are not frozen."""
    if type(method).__dataclass_params__.frozen:
        return {}
    values = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {k: v for k, v in values.items() if isinstance(v, (int, float))}


def _capacities(stages: Stages) -> list[int]:
    """Return the room for faces that the cells' kernels were built with: whether a repair finds it too small."""
    cells = stages.cells
    return [cells.cell_capacity, cells.row_capacity] if isinstance(cells, Cells) else []


def _set_capacities(stages: Stages, capacities: object) -> None:
    cells, known = stages.cells, _capacities(stages)
    if isinstance(cells, Cells) and isinstance(capacities, list) and len(capacities) == len(known):
        wanted = [int(c) for c in capacities]
        if wanted != known and all(0 < c <= 2048 for c in wanted):
            cells._build(*wanted)
