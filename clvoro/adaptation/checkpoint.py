"""Checkpoints: a run in one file, from which it continues.

A checkpoint has what the rest of a run follows from: generators in the order of the device with their labels and
velocities, starts of the solvers, weights, the history, and the state of the schedule. It is taken at the end of an
action. The run that goes on computes everything else anew from there, and so does the run that is resumed: both have
the same bits. The size field and the schedule are computed again and compared with the file.

Over ranks each rank writes its generators to a file of its own beside the checkpoint, a piece. When all pieces are on
the disk, rank 0 replaces the checkpoint, which names them. Then the pieces of earlier checkpoints are removed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
import secrets
import time
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from ..arguments import check_path, warn
from ..errors import CheckpointWarning, InputError, OutputError, RankError
from ..geometry.domain import Domain
from ..mesh.results import HISTORY_DTYPE, Displacements
from ..opencl.peers import ALONE, Peers
from ..tessellation.decomposition import distribute
from .insertion_deletion import Generators
from .options import RunArguments
from .plan.actions import Action, Step
from .plan.schedule import Begins
from .preparation import Beginning
from .state import Arrays, MeshState, Setup

if TYPE_CHECKING:
    from .run import Run

FORMAT, PIECE, VERSION = "clvoro-checkpoint", "clvoro-checkpoint-piece", 12
_GENERATORS = tuple(field.name for field in dataclasses.fields(Generators))
_OTHERS = ("potential", "multipliers", "weights")
_PROGRESS = ("position", "level", "n_start", "started", "steps", "pace")
_COUNTS = (*_PROGRESS, "levels", "next_label")


class Checkpointer:
    """Writes the state of a run to `path` every `every` seconds, at most once between two actions.

    - `every`: seconds between two checkpoints; 0 writes one after each action.
    - `fingerprint`: see `run_fingerprint`.
    - `schedule`: before it begins.
    - `peers`: the parts of the run. All of them write together.
    """

    def __init__(
        self, path: str | PathLike[str], every: float, fingerprint: dict, schedule: list[Action], peers: Peers = ALONE
    ) -> None:
        from ..io import check_writable

        path = check_path("checkpoint", path)
        if os.path.isdir(path) or not path:
            raise InputError(f"checkpoint is {path!r}, a folder, expected the name of a file")
        check_writable(path)
        _check_overwrite(path)
        self.path, self.every, self.fingerprint, self.peers = Path(path), every, fingerprint, peers
        self.schedule = schedule_digest(schedule)
        self._last = time.monotonic()

    def write_if_due(self, run: Run, stop: bool) -> None:
        """Write a checkpoint if it is due, or if the run stops.

        If it cannot be written, because the disk is full for instance, the run continues and the last one stays.
        """
        if not self.peers.any(stop or time.monotonic() - self._last >= self.every):
            return
        try:
            self.write(run)
        except (OutputError, RankError) as error:
            warn(f"{error}. The run continues without this checkpoint; the last one is unchanged", CheckpointWarning)
        self._last = time.monotonic()

    def write(self, run: Run) -> None:
        """Write the state of `run` between two actions. The file is replaced when the new one is complete."""
        from ..io.arrays import write_arrays

        mesh, kept = run.state, run.state.arrays
        found = {name: getattr(kept.generators, name) for name in _GENERATORS}
        found |= {name: getattr(kept, name) for name in _OTHERS if getattr(kept, name) is not None}
        rows = {f"mesh.{name}": array.get() for name, array in found.items()} | {"mesh.h": mesh.h.get()}
        arrays: dict[str, Any] = {"taken": mesh.taken, "history": np.concatenate(run.rows)}
        for part in ("initial", "final"):
            if getattr(run, part) is not None:
                arrays |= {f"{part}.{name}": array for name, array in vars(getattr(run, part)).items()}
        state = progress_of(run) | {
            "levels": run.levels,
            "beginning": run.beginning,
            "next_label": mesh.next_label,
            "size_factor": float(mesh.size_factor).hex(),
            "elapsed": time.perf_counter() - run.began,
        }
        about = {"fingerprint": self.fingerprint, "schedule": self.schedule, "state": state}
        pieces: list[tuple[str, int]] = []
        if self.peers.count == 1:
            arrays |= rows
        else:
            about["pieces"] = pieces = self._write_piece(rows)
        arrays["about"] = np.array(json.dumps(about))

        def write_index() -> None:
            if self.peers.number == 0:
                write_arrays(self.path, FORMAT, VERSION, arrays, compress=False)

        self.peers.agree(write_index)
        if self.peers.size > 1:
            self._remove_others({name for name, _ in pieces})

    def _write_piece(self, rows: dict[str, np.ndarray]) -> list[tuple[str, int]]:
        """Write the `rows` of this part to its piece; return file names and numbers of rows of all pieces."""
        from ..io.arrays import write_arrays

        peers = self.peers
        mark, *_ = peers.gather(np.array(secrets.randbits(62)))
        names = [f"{self.path.name}.{int(mark):016x}.{part}" for part in range(peers.count)]
        counts = [int(count) for count in peers.gather(np.array(len(rows["mesh.h"])))]
        path = self.path.with_name(names[peers.number])
        peers.agree(lambda: write_arrays(path, PIECE, VERSION, rows, compress=False))
        return list(zip(names, counts, strict=True))

    def _remove_others(self, names: set[str]) -> None:
        """Remove the pieces of earlier checkpoints of this path: all but those with these `names`."""
        for path in self.path.parent.iterdir():
            start, end = path.name[: len(self.path.name)], path.name[len(self.path.name) :]
            if start == self.path.name and re.fullmatch(r"\.[0-9a-f]{16}\.[0-9]+", end) and path.name not in names:
                path.unlink(missing_ok=True)


class Saved:
    """A checkpoint that has been read and is valid in itself.

    - `peers`: the parts of the resumed run. Each takes its share of the generators.

    Its attributes:
    - `levels`: number of coarser levels of the run.
    - `parts`: number of parts that work on the saved level.
    - `beginning`: what the run began with.

    Raises `InputError` if the file is missing, damaged, truncated or not a checkpoint.
    """

    def __init__(self, path: str | PathLike[str], peers: Peers = ALONE) -> None:
        from ..io.arrays import read_arrays

        self.peers, self.name = peers, check_path("resume", path)
        self.arrays = read_arrays(self.name, FORMAT, VERSION)
        version = self.arrays["version"].item()
        if version != VERSION:
            raise InputError(
                f"cannot resume from {self.name}: it is a checkpoint of version {version}, expected {VERSION}, that of "
                "this version of clvoro; start again without resume"
            )
        try:
            about = json.loads(self.arrays["about"].item())
            self.fingerprint, self.schedule = dict(about["fingerprint"]), str(about["schedule"])
            self.state = state = dict(about["state"])
            if any(type(state[name]) is not int or state[name] < 0 for name in _COUNTS):
                raise ValueError("counts")
            self.size_factor = float.fromhex(state["size_factor"])
            self.elapsed = float(state["elapsed"])
            pieces = [(str(name), int(count)) for name, count in about.get("pieces", [])]
            self.parts = peers.size if state["level"] == 0 else min(max(len(pieces), 1), peers.size)
            self._take_rows(pieces)
            begins, why = state["beginning"]
            self.levels, self.beginning = int(state["levels"]), Beginning(begins, str(why))
            if begins not in get_args(Begins):
                raise ValueError("beginning")
            if not (0 < self.size_factor < np.inf and 0 <= self.elapsed < np.inf and state["level"] <= self.levels):
                raise ValueError("size_factor")
            self._check(len(self.fingerprint["domain"]["lower"]), np.dtype(self.fingerprint["dtype"]))
        except (KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError) as error:
            raise self._damaged(error) from error

    def _take_rows(self, pieces: list[tuple[str, int]]) -> None:
        """Keep the generators of this part, from the `pieces` (file name, number of rows) or else from the checkpoint.

        If there are as many parts as pieces, each part gets the generators of its piece; otherwise equal shares.
        """
        from ..io.arrays import read_arrays

        part, parts = self.peers.number, self.parts
        counts = [count for _, count in pieces] or [len(self.arrays["mesh.points"])]
        self.moves = parts != len(counts) and parts > 1
        ends = np.cumsum(counts)
        begin, end = (ends[-1] * k // parts if part < parts else 0 for k in (part, part + 1))
        if parts == len(counts) and part < parts:
            begin, end = ends[part] - counts[part], ends[part]
        found = []
        for k, (last, count) in enumerate(zip(ends, counts, strict=True)):
            first, stop = max(begin, last - count), min(end, last)
            if first > stop or (first == stop and k):
                continue
            given = self.arrays
            if pieces:
                given = read_arrays(Path(self.name).with_name(Path(pieces[k][0]).name), PIECE, VERSION)
            if len(given["mesh.points"]) != count:
                raise ValueError(f"piece {k}")
            rows = slice(first - last + count, stop - last + count)
            found.append({name: array[rows] for name, array in given.items() if name.startswith("mesh.")})
        for name in found[0]:
            self.arrays[name] = np.concatenate([given[name] for given in found])

    def _damaged(self, error: Exception | str) -> InputError:
        return InputError(f"cannot resume from {self.name}: it is damaged ({error!r:.200})")

    def _check(self, d: int, real: np.dtype) -> None:
        """Check shapes, types and numbers of the arrays."""
        a = self.arrays
        n = len(a["mesh.points"])
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            **{f"mesh.{name}": ((n, d), real) for name in ("points", "velocity")},
            **{f"mesh.{name}": ((n,), real) for name in ("ever_changed", "h", "potential", "weights")},
            "mesh.labels": ((n,), np.int32),
            "mesh.signatures": ((n,), np.uint64),
            "mesh.multipliers": ((n,), np.float32),
            "history": ((len(a["history"]),), HISTORY_DTYPE),
            "taken": ((len(a["taken"]),), np.int32),
        }
        for name in {f"mesh.{name}" for name in _OTHERS} - a.keys():
            del shapes[name]
        for name, (shape, dtype) in shapes.items():
            if a[name].shape != shape or a[name].dtype != dtype:
                raise ValueError(f"{name} is {a[name].dtype} {a[name].shape}, expected {shape}")
            if a[name].dtype.kind == "f" and not np.isfinite(a[name]).all():
                raise ValueError(name)
        labels = a["mesh.labels"]
        known = n > 0 and labels.min() >= 0 and labels.max() < self.state["next_label"]
        known = known or (n == 0 and self.peers.count > 1)
        if not known or len(np.unique(labels)) < n:
            raise ValueError("labels")
        if not (a["mesh.h"] > 0).all():
            raise ValueError("sizes")

    def check_fingerprint(self, fingerprint: dict) -> None:
        """Compare the checkpoint with the `fingerprint` of this run.

        Raises `InputError` if the domain or a setting differs; the message has the first one.
        """
        fingerprint = json.loads(json.dumps(fingerprint))
        for name in {**self.fingerprint, **fingerprint}:
            was, now = self.fingerprint.get(name), fingerprint.get(name)
            if was == now:
                continue
            if name in ("points", "fixed"):
                was, now = ("none" if v is None else f"others ({v:.8}...)" for v in (was, now))
            if name == "domain":
                was, now = (_domain_name(v) for v in (was, now))
            raise InputError(
                f"cannot resume from {self.name}: it is from a run with {name} = {was}, but this run has {name} = "
                f"{now}; use the settings of that run, or start again without resume"
            )

    def mesh(self, setup: Setup, schedule: list[Action]) -> MeshState:
        """Return the mesh of the saved run, for a run with this `schedule`."""
        engine, a = setup.stages.engine, self.arrays
        self.peers.agree(lambda: self._compare(setup, schedule))
        on_device = {
            name.removeprefix("mesh."): engine.upload(array, array.dtype)
            for name, array in a.items()
            if name.startswith("mesh.") and name != "mesh.h"
        }
        if self.moves:
            on_device = distribute(engine, setup.domain, on_device)
        generators = Generators(**{name: on_device.pop(name) for name in _GENERATORS})
        others = (on_device.get(name) for name in _OTHERS)
        arrays = Arrays(generators, *others)  # type: ignore[arg-type]
        return MeshState(setup, self.size_factor, arrays, next_label=self.state["next_label"], taken=a["taken"])

    def _compare(self, setup: Setup, schedule: list[Action]) -> None:
        """Raise an error if points lie outside the domain, or if schedule or size field differ from the saved run."""
        engine, a = setup.stages.engine, self.arrays
        if len(a["mesh.h"]):
            self._check_points(setup.domain)
            saved, points = (engine.upload(a[f"mesh.{name}"], a[f"mesh.{name}"].dtype) for name in ("h", "points"))
            self._compare_sizes(setup, saved, points)  # first: another size field has another schedule, too
        if self.schedule != schedule_digest(schedule) or self.state["position"] > len(schedule):
            raise InputError(
                f"cannot resume from {self.name}: its plan of steps differs, as with another size "
                "field or version of clvoro; use those of that run, or start again without resume"
            )

    def _check_points(self, domain: Domain) -> None:
        x = self.arrays["mesh.points"].astype(float)
        lower, upper = (corner[: domain.dim] for corner in domain.device_corners(np.dtype(float)))
        origin, scale = domain.frame
        there = np.abs(domain.place(x * scale + origin, np.dtype(float)) - x).max() < 1e-3
        if not (there and (x >= lower).all() and (x <= upper).all()):
            raise self._damaged("points")

    def _compare_sizes(self, setup: Setup, saved: Any, points: Any) -> None:
        """Raise if the size field is not that of the saved run at generators that have its sizes."""
        sizes, labels, domain = setup.stages.engine.empty(len(points)), self.arrays["mesh.labels"], setup.domain
        setup.sizing.evaluate(points, len(points), sizes)
        was, now = saved.get().astype(float), sizes.get().astype(float) * self.size_factor
        moving = (labels >= setup.fixed) | (labels < setup.first_row)
        off = np.where(moving, np.abs(now / was - 1), 0.0)
        worst = int(np.argmax(off))
        if not off[worst] <= 1e4 * np.finfo(saved.dtype).eps:
            origin, scale = domain.frame
            place = domain.place_name(self.arrays["mesh.points"][worst] * scale + origin)
            unit = scale / self.size_factor
            raise InputError(
                f"cannot resume from {self.name}: its size field differs; at {place} the size of that run was "
                f"{was[worst] * unit:.6g}, this field's is {now[worst] * unit:.6g}. Use the field of that run, or "
                "start again"
            )

    def resume(self, run: Run) -> float:
        """Give `run` the progress of the saved one; return the seconds that it had taken."""
        state = self.state
        take_progress(run, state, self.arrays["history"])
        if self.peers.count == 1:
            run.initial, run.final = self._displacements("initial"), self._displacements("final")
        return self.elapsed

    def _displacements(self, part: str) -> Displacements | None:
        saved = [self.arrays.get(f"{part}.{f.name}") for f in dataclasses.fields(Displacements)]
        if any(array is None for array in saved):
            return None
        return Displacements(*saved)  # type: ignore[arg-type]


def progress_of(run: Run) -> dict[str, Any]:
    """Return plain values that say how far `run` has come in its schedule."""
    found = {name: getattr(run, name) for name in _PROGRESS}
    return found | {"methods": [_state_of(method) for method in _methods_of(run.schedule)]}


def take_progress(run: Run, found: dict[str, Any], history: np.ndarray) -> None:
    """Give `run` the progress of another, which `progress_of` has `found`, and its `history`."""
    for method, values in zip(_methods_of(run.schedule), found["methods"], strict=True):
        for name in _state_of(method):
            setattr(method, name, values[name])
    for name in _PROGRESS:
        setattr(run, name, found[name])
    steps = [action for action in run.schedule[: run.position] if isinstance(action, Step)]
    run.last = steps[-1].method if steps else None
    run.rows = [row.reshape(1) for row in history]


def run_fingerprint(arguments: RunArguments, dtype: np.dtype) -> dict[str, Any]:
    """Return plain values that identify a run with these checked `arguments`. A checkpoint of another is rejected."""
    domain, _, options, points, fixed, _ = arguments
    return {
        "domain": domain_fingerprint(domain),
        "dtype": dtype.name,
        "points": None if points is None else _digest(points),
        "fixed": _digest(fixed) if len(fixed) else None,
        **vars(options),
        "layers": [repr(layer) for layer in options.layers],
    }


def _digest(positions: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(positions).tobytes()).hexdigest()


def domain_fingerprint(domain: Domain) -> dict[str, Any]:
    """Return plain values that identify `domain` and determine the shapes of a file's arrays."""
    described = json.dumps(domain.describe() | domain.described_borders, sort_keys=True)
    return {
        "kind": type(domain).__name__,
        "lower": list(domain.lower),
        "upper": list(domain.upper),
        "periodic": list(domain.periodic),
        "walls": len(domain.boundary_index),
        "digest": hashlib.sha256(described.encode()).hexdigest(),
    }


def _domain_name(fingerprint: Any) -> str:
    """Return a domain as it appears in errors, from its fingerprint or from any other value in its place."""
    if not isinstance(fingerprint, dict):
        return repr(fingerprint)
    shown = {key: value for key, value in fingerprint.items() if key not in ("kind", "digest")}
    return f"{fingerprint.get('kind')}({shown}, {fingerprint.get('digest')!s:.8}...)"


def schedule_digest(schedule: Sequence[object]) -> str:
    """Return a hash of a schedule that has not begun."""
    return hashlib.sha256(repr(schedule).encode()).hexdigest()


def _check_overwrite(path: str) -> None:
    """Raise InputError if the file exists, is not empty and not a checkpoint."""
    from ..io.arrays import is_kind

    if os.path.exists(path) and os.path.getsize(path) and not is_kind(path, FORMAT):
        raise InputError(
            f"checkpoint is {path!r}, an existing file that is not a checkpoint; choose another name, or remove it"
        )


def _methods_of(schedule: list[Action]) -> list[Any]:
    """Return the methods of a schedule, each once, in the order of their first step."""
    return list({id(a.method): a.method for a in schedule if isinstance(a, Step)}.values())


def _state_of(method: Any) -> dict[str, float | int]:
    """Return the state of a method between two steps: its numbers, if it is not frozen."""
    if type(method).__dataclass_params__.frozen:
        return {}
    values = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {k: v for k, v in values.items() if isinstance(v, (int, float))}
