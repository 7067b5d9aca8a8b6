"""Read checkpoints, check that they are valid and of the same run, and restore mesh and progress from them."""

from __future__ import annotations

import dataclasses
import json
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arguments import check_path
from ..errors import InputError
from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..mesh.results import HISTORY_DTYPE, Displacements
from ..tessellation.cells import Cells
from ..tessellation.periodic.halo import block_count
from ..tessellation.polyhedra_update import are_triples
from .arrays import SUMMARIES, Setup
from .checkpoint import DIAGRAM, FORMAT, MESH, VERSION, VERTICES, Progress, capacities_of, methods_of, state_of
from .fingerprint import domain_name, schedule_digest
from .insertion_deletion import Generators
from .plan.actions import Action, Step
from .stages import Stages
from .state import MeshState

if TYPE_CHECKING:
    from ..geometry.domain import Domain

_COUNTS = ("position", "level", "n_start", "started", "steps", "next_label", "spare", "seam_cells")


class Saved:
    """A checkpoint that has been read and is valid in itself.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    InputError
        If the file is missing, damaged, truncated or not a checkpoint.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        from ..io.arrays import read_arrays

        self.name = check_path("resume", path)
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
            self.levels = int(state["levels"])
            if not (0 < self.size_factor < np.inf and 0 <= self.elapsed < np.inf):
                raise ValueError("size_factor")
            if not self.levels >= 0:
                raise ValueError("levels")
            domain = self.fingerprint["domain"]
            d = len(domain["lower"])
            spherical = domain["kind"] == Sphere.__name__
            real = np.dtype(self.fingerprint["dtype"])
            self._check(d, int(domain["walls"]), real, spherical)
            if any(domain["periodic"]):
                self._check_seams(d)
        except (KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError) as error:
            raise InputError(f"cannot resume from {self.name}: it is damaged ({error!r:.200})") from error

    def _check(self, d: int, walls: int, real: np.dtype, spherical: bool) -> None:
        """Check everything that the device uses as an index or divides by."""
        a = self.arrays
        n, m = len(a["mesh.points"]), len(a["diagram.neighbors"])
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            **{f"mesh.{name}": ((n,), real) for name in MESH},
            **{f"mesh.{name}": ((n, d), real) for name in ("points", "velocity")},
            "mesh.labels": ((n,), np.int32),
            "mesh.signatures": ((n,), np.uint64),
            "diagram.starts": ((n + 1,), np.int32),
            "diagram.neighbors": ((m,), np.int32),
            "diagram.face_measures": ((m,), a["diagram.face_measures"].dtype),
            "diagram.face_centroids": ((m, d), a["diagram.face_measures"].dtype),
            "diagram.volumes": ((n,), real),
            "diagram.offsets": ((n, d), real),
            "diagram.covariances": ((n, 3 if spherical or d == 2 else 6), real),
            "summaries": ((len(SUMMARIES), 4), real),
            "history": ((len(a["history"]),), HISTORY_DTYPE),
            "taken": ((len(a["taken"]),), np.int32),
        }
        if "multipliers" in a:
            shapes["multipliers"] = ((n,), np.float32)
        if d == 3 and "vertices.triples" in a:
            shapes["vertices.triples"] = (2 * m,), np.uint32
            shapes["vertices.keys"] = (m,), np.uint32
        for name, (shape, dtype) in shapes.items():
            if a[name].shape != shape or a[name].dtype != dtype:
                raise ValueError(f"{name} is {a[name].dtype} {a[name].shape}, expected {shape}")
        starts, neighbors, labels = a["diagram.starts"], a["diagram.neighbors"], a["mesh.labels"]
        if n == 0 or starts[0] != 0 or starts[-1] != m or (np.diff(starts) < (3 if spherical else d + 1)).any():
            raise ValueError("starts")
        if not (-walls <= neighbors.min() and neighbors.max() < n):
            raise ValueError("neighbors")
        if d == 3 and "vertices.triples" in a and not are_triples(starts, a["vertices.triples"]):
            raise ValueError("triples")
        known = labels.min() >= 0 and labels.max() < self.state["next_label"]
        if not known or len(np.unique(labels)) < n:
            raise ValueError("labels")
        x, h = a["mesh.points"], a["mesh.h"]
        inside = np.abs(np.linalg.norm(x, axis=1) - 1).max() < 1e-3 if spherical else x.min() >= 0
        if not (np.isfinite(x).all() and inside and x.max() <= 1):
            raise ValueError("points")
        if not ((h > 0).all() and np.isfinite(h).all()):
            raise ValueError("sizes")
        # Capacities for the largest number of cells so far are kept when there are fewer.
        cells = max(n, self.state["n_start"], int(a["history"]["cells"].max()))
        if self.state["spare"] > 64 * cells + 64:
            raise ValueError("spare")

    def _check_seams(self, d: int) -> None:
        """Check the arrays of a periodic box of `d` dimensions."""
        needed = self.arrays["seam.needed"]
        if needed.shape != (block_count(d),) or needed.dtype != np.float32:
            raise ValueError("seam.needed")
        if not (np.isfinite(needed).all() and needed.min() >= 0):
            raise ValueError("seam.needed")

    def check_fingerprint(self, fingerprint: dict) -> None:
        """Compare the checkpoint with the `fingerprint` of this run.

        Raises
        ------
        InputError
            If the domain or a setting differs; the message has the first one.
        """
        fingerprint = json.loads(json.dumps(fingerprint))
        for name in {**self.fingerprint, **fingerprint}:
            was, now = self.fingerprint.get(name), fingerprint.get(name)
            if was == now:
                continue
            if name in ("points", "fixed"):
                was, now = ("none" if v is None else f"others ({v:.8}...)" for v in (was, now))
            if name == "domain":
                was, now = (domain_name(v) for v in (was, now))
            raise InputError(
                f"cannot resume from {self.name}: it is from a run with {name} = {was}, but this run has {name} = "
                f"{now}; use the settings of that run, or start again without resume"
            )

    def restore(self, setup: Setup, schedule: list[Action]) -> MeshState:
        """Return the mesh of the saved run, for a loop over `schedule`.

        Raises
        ------
        InputError
            If schedule or size field differ from those of the saved run.
        """
        stages, domain, sizing = setup.stages, setup.domain, setup.sizing
        state, engine, a = self.state, stages.engine, self.arrays
        if self.schedule != schedule_digest(schedule) or state["position"] > len(schedule):
            raise InputError(
                f"cannot resume from {self.name}: its schedule differs, as with another version of clvoro; start again"
            )
        _set_capacities(stages, state["capacities"])
        arrays = {name: engine.upload(a[f"mesh.{name}"], a[f"mesh.{name}"].dtype) for name in MESH}
        h, potential = arrays.pop("h"), arrays.pop("potential")
        generators = Generators(**arrays)
        points, n = generators.points, len(generators)
        sizes = engine.empty(n)
        sizing.evaluate(points, n, sizes)
        labels = a["mesh.labels"]
        moving = (labels >= setup.fixed) | (labels < setup.first_row)
        self._compare_sizes(sizes.get().astype(float) * self.size_factor, domain, moving)
        del sizes
        multipliers = engine.upload(a["multipliers"], np.float32) if "multipliers" in a else None
        mesh = MeshState.restore(setup, self.size_factor, generators, h, potential, multipliers)
        faces = a["diagram.face_measures"].dtype
        if not isinstance(domain, Polygon) and faces != engine.face:
            raise InputError(f"cannot resume from {self.name}: it is damaged (faces are {faces})")
        diagram = {name: a[f"diagram.{name}"] for name in DIAGRAM}
        vertices = [a[f"vertices.{name}"] for name in VERTICES if f"vertices.{name}" in a]
        mesh.tessellation = mesh.tessellator.restore(points, diagram, state["spare"], vertices)
        mesh.next_label, mesh.taken = state["next_label"], a["taken"]
        halo = mesh.tessellator.steps.halo
        if halo is not None:
            halo.required.set(a["seam.needed"])
            halo.cells = state["seam_cells"]
        mesh.evaluate_metric()
        mesh.summaries.values.set(a["summaries"])
        levels = {k.removeprefix("multigrid."): v for k, v in a.items() if k.startswith("multigrid.")}
        try:
            stages.poisson.restore(levels, mesh.labels, mesh.n)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"cannot resume from {self.name}: it is damaged ({error!r:.200})") from error
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
                f"cannot resume from {self.name}: its size field differs; at {place} the size of that run was "
                f"{saved[worst] * scale / self.size_factor:.6g}, this field's is "
                f"{now[worst] * scale / self.size_factor:.6g}. Use the field of that run, or start again"
            )

    def progress(self, schedule: list[Action]) -> Progress:
        """Return how far the saved run had come, and set the state of the methods in `schedule`."""
        state, history = self.state, self.arrays["history"]
        for method, values in zip(methods_of(schedule), state["methods"], strict=True):
            for name in state_of(method):
                setattr(method, name, values[name])
        steps = [action for action in schedule[: state["position"]] if isinstance(action, Step)]
        return Progress(
            level=state["level"],
            n_start=state["n_start"],
            started=state["started"],
            labeled=state["started"] + int(history["inserted"].sum()),
            position=state["position"],
            steps=state["steps"],
            rows=[row.reshape(1) for row in history],
            initial=self._displacements("initial"),
            final=self._displacements("final"),
            last=steps[-1].method if steps else None,
            elapsed=self.elapsed,
        )

    def _displacements(self, part: str) -> Displacements | None:
        saved = [self.arrays.get(f"{part}.{f.name}") for f in dataclasses.fields(Displacements)]
        if any(array is None for array in saved):
            return None
        return Displacements(*saved)  # type: ignore[arg-type]


def _set_capacities(stages: Stages, capacities: object) -> None:
    cells, known = stages.cells, capacities_of(stages)
    if isinstance(cells, Cells) and isinstance(capacities, list) and len(capacities) == len(known):
        wanted = [int(c) for c in capacities]
        if wanted != known and all(0 < c <= 2048 for c in wanted):
            cells._build(*wanted)
