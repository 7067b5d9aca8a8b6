"""Checkpoints that are read: found sound in themselves and of the same run, and turned into its mesh and loop again."""

from __future__ import annotations

import dataclasses
import json
import time
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arguments import check_path
from ..errors import InputError
from ..geometry.polygon import Polygon
from ..mesh.results import HISTORY_DTYPE, Displacements
from ..tessellation.cells import Cells
from ..tessellation.periodic.ghost_images import block_count
from .checkpoint import (
    DIAGRAM,
    FORMAT,
    MESH,
    VERSION,
    capacities_of,
    fingerprint,
    methods_of,
    state_of,
)
from .fingerprint import named
from .schedule import Action, Step
from .stages import Stages
from .state import SUMMARIES, Mesh

if TYPE_CHECKING:
    from ..geometry.box import Domain
    from ..sizing import Sizing
    from .loop import Loop

_COUNTS = (
    "position",
    "level",
    "n_start",
    "steps",
    "next_label",
    "spare",
    "seam_cells",
)


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
        from ..io.arrays import read_arrays

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
        n, m = len(a["mesh.points"]), len(a["diagram.neighbors"])
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            **{f"mesh.{name}": ((n,), real) for name in MESH},
            **{f"mesh.{name}": ((n, d), real) for name in ("points", "velocity")},
            "mesh.labels": ((n,), np.int32), "mesh.signatures": ((n,), np.uint64),
            "diagram.starts": ((n + 1,), np.int32), "diagram.neighbors": ((m,), np.int32),
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
        starts, neighbors, labels = a["diagram.starts"], a["diagram.neighbors"], a["mesh.labels"]
        if n == 0 or starts[0] != 0 or starts[-1] != m or (np.diff(starts) < d + 1).any():
            raise ValueError("starts")
        if not (-walls <= neighbors.min() and neighbors.max() < n):
            raise ValueError("neighbors")
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
        arrays = {name: engine.upload(a[f"mesh.{name}"], a[f"mesh.{name}"].dtype) for name in MESH}
        points, n = arrays["points"], len(arrays["points"])
        sizes = engine.empty(n)
        sizing.evaluate(points, n, sizes)
        moving = a["mesh.labels"] >= fixed
        self._compare_sizes(sizes.get().astype(float) * self.coarsening, domain, moving)
        del sizes
        if "multipliers" in a:
            arrays["multipliers"] = engine.upload(a["multipliers"], np.float32)
        mesh = Mesh.saved(stages, domain, sizing, arrays, self.coarsening, free, fixed)
        faces = a["diagram.face_measures"].dtype
        if not isinstance(domain, Polygon) and faces != engine.face:
            raise InputError(f"cannot resume from {self.name}: it is damaged (faces are {faces})")
        diagram = {name: a[f"diagram.{name}"] for name in DIAGRAM}
        mesh.tessellation = mesh.tessellator.restore(points, diagram, state["spare"])
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
        for name in ("position", "level", "n_start", "steps"):
            setattr(loop, name, state[name])
        loop.begun = loop.steps
        loop.labeled = loop.n_start + int(self.arrays["history"]["inserted"].sum())
        for method, values in zip(methods_of(loop.plan), state["methods"], strict=True):
            for name in state_of(method):
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


def _set_capacities(stages: Stages, capacities: object) -> None:
    cells, known = stages.cells, capacities_of(stages)
    if isinstance(cells, Cells) and isinstance(capacities, list) and len(capacities) == len(known):
        wanted = [int(c) for c in capacities]
        if wanted != known and all(0 < c <= 2048 for c in wanted):
            cells._build(*wanted)
