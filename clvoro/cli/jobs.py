"""The command `clvoro run`: run the methods of a case from one start and write all files."""

from __future__ import annotations

import json
import math
import re
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import earth
from ..adaptation.options import Checkpoint, Options, arguments_of_run, uses, warn_of_unused
from ..adaptation.run import INTERRUPTED, MISSES, STOPPED
from ..errors import Aborted, ClvoroError, InputError, Interrupted, SolverWarning
from ..finite_volumes.gate import Solver
from ..finite_volumes.solver_mesh import WallShape
from ..io import save, write, write_history
from ..io.check_mesh import run_check_mesh
from ..io.foam import PatchType, patch_types
from ..mesh.results import Result, boundary_line, summary, thickness_in_words
from ..opencl.memory_limits import available_memory, in_bytes
from ..opencl.peers import ALONE, Peers
from ..opencl.profile import Profile
from ..opencl.program import build_seconds
from ..version import __version__
from .cases import Case
from .outputs import MESH_FILES, PLANE, check_folder, do_all, refuse_own_files, require_plots
from .progress import ProgressDisplay, during

_REPEATED = ("effort", "levels", "error_target", "start", "n_cells", "max_steps", "tol", "alpha", "k", "seed", "dtype")
"""Settings that `case.toml` of the output fixes, so that other defaults of later versions do not change the run."""

STATE = "run.checkpoint"
"""Checkpoint in the output folder of a run that is stopped, unless --checkpoint names another one."""
_MANY = 5000
"""From this many cells on, the writing of files and pictures is announced."""
_STOPPING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGXCPU")
"""Signals that end a run after its step and keep the mesh: Ctrl-C, batch systems, a lost terminal."""
_MUCH = 2**26
"""From this many bytes on, the memory on the device is announced."""


@dataclass
class Job:
    """One call of `clvoro run`.

    - `case`: Case
    - `out`: folder for the files; created if needed.
    - `device`: as `clvoro.create_context` takes it. Several devices, separated by commas without blanks, share the run.
    - `report`: whether to draw pictures and write `report.html`.
    - `mesh_formats`: further mesh files, keys of `MESH_FILES`.
    - `picture_formats`: kinds of picture files.
    - `quiet`, `as_json`: no progress and no summary; one JSON object per finished run on the standard output.
    - `profile`: whether to time every kernel, and print where the time went.
    - `checkpoint`, `resume`: Path or None
    - `checkpoint_every`: as `Adapter.run` takes them; for one method only.
    - `walls` "straight", "exact" or None: as `save` takes it, for the mesh file of OpenFOAM and the check.
    - `command`: the arguments of the command, to be repeated after an interruption.
    - `types`: types of OpenFOAM's patches by name, before those of the case.
    - `unchecked`: write a mesh for OpenFOAM even if its checkMesh rejects it.
    - `solver` "openfoam" or None: check the mesh by the criteria of this solver, and with its own program if that is
      installed.
    - `processors`: also write a decomposed case for OpenFOAM, or the partition of `graph.info`, with this number of
      processors.
    - `peers`: the ranks that share the run under `mpiexec`. Each has the same job; rank 0 gathers the mesh and writes
      it.
    - `pieces`: each rank writes its own cells, and rank 0 does not gather the mesh.
    - `share_gpus`: whether several ranks may have one GPU.
    """

    case: Case
    out: Path
    device: str | None = None
    report: bool = True
    mesh_formats: tuple[str, ...] = ()
    picture_formats: tuple[str, ...] = ("png",)
    quiet: bool = False
    as_json: bool = False
    profile: bool = False
    checkpoint: Path | None = None
    checkpoint_every: float | None = None
    resume: Path | None = None
    walls: WallShape | None = None
    types: dict[str, PatchType] = field(default_factory=dict)
    unchecked: bool = False
    solver: Solver | None = None
    command: tuple[str, ...] = ()
    processors: int | None = None
    peers: Peers = ALONE
    pieces: bool = False
    share_gpus: bool = False
    interrupted: bool = field(default=False, init=False)
    rejected: bool = field(default=False, init=False)
    missed: bool = field(default=False, init=False)

    def run(self) -> bool:
        """Run all methods, write the files, print the summary; return whether it was interrupted.

        Raises `ClvoroError` if the input is bad, there is no device, or a run fails. Raises `OSError` if the output
        cannot be written.
        """
        size, settings = self.peers.agree(self._prepare)
        adapter = self.peers.agree(self._make_adapter)
        device = adapter.ctx.devices[0]
        where = f"{device.platform.name.strip()} / {device.name.strip()}"
        more = max(self.peers.count, len(adapter.devices)) - 1
        where += f" and {more} more" if more else ""
        results: dict[str, Result] = {}
        profiles: dict[str, Profile] = {}
        with self._stopping_cleanly():
            try:
                for method in self.case.methods:  # the same seed: the same start
                    profile = Profile(adapter) if self.profile else None
                    with profile or nullcontext():
                        result = self._run_one(adapter, size, method, settings)
                    name = str(method or result.settings.get("method", "default"))
                    results[name] = result
                    if profile is not None:
                        profiles[name] = profile
                    self._announce(name, result, where, profile)
                    if self.interrupted:
                        break
            except ClvoroError:
                if results and not self.pieces:  # keep the meshes of earlier methods
                    self._write(adapter, size, results, where)
                raise
            self.peers.agree(lambda: self._write(adapter, size, results, where))
        self.missed = any(result.stop_reason.startswith(MISSES) for result in results.values())
        self._summarize(results, where, profiles)
        self._tell_how_to_continue(results)
        if self.solver is not None and self.peers.number == 0:
            self._check_for_solver(results)
        return self.interrupted

    def _prepare(self) -> tuple[Any, dict[str, Any]]:
        """Check all that can be checked before the run; return the size field and the settings of the run."""
        settings = self.case.run_arguments()
        size = self._during("preparing the size field", self.case.size_field)
        warn_of_unused(self.case.run, [m or Options.method for m in self.case.methods])
        self._land = self.case.land
        self._refuse_formats()
        self._refuse_pieces()
        self.case = self.case.with_patches(self.types)
        patch_types(self.case.domain.boundary_names, self.case.patches)
        state = self._state  # refuses what does not fit, before the folder is made
        named = {"checkpoint": self.checkpoint, "resume": self.resume}
        named |= {source.name: source for source in self.case.sources()}
        refuse_own_files(self.out, named)
        check_folder(self.out)
        if state is not None and self.checkpoint is None and self.resume is None and self.peers.number == 0:
            (self.out / STATE).unlink(missing_ok=True)  # of an earlier run
        if self.report:
            require_plots()
        return size, settings

    def _make_adapter(self) -> Any:
        from .. import Adapter, create_context

        dtype, names = self.case.run.get("dtype", "float64"), self._devices
        if len(names) > 1:
            return Adapter(dtype=dtype, devices=names, share_gpus=self.share_gpus)
        context = create_context(self.device, fp64=dtype == "float64", comm=self.peers)
        return Adapter(context, dtype, self.peers, self.share_gpus)

    @property
    def _devices(self) -> list[str]:
        """The devices that share the run. A comma before a blank is part of a name."""
        return re.split(",(?! )", self.device or "")

    def _refuse_pieces(self) -> None:
        """Raise an error if ranks cannot share the run, or if its files cannot be written in pieces."""
        if self.peers.count == 1:
            if self.pieces:
                raise InputError(
                    "pieces are given, and one process has the whole mesh; start several with mpiexec -n, or leave "
                    "--pieces out"
                )
            return
        if len(self._devices) > 1:
            raise InputError(
                f"{self.case.name}: the run has {len(self._devices)} devices, expected one, since ranks share it; run "
                "it without mpiexec"
            )
        self.report = self.report and not self.pieces
        others = [kind for kind in self.mesh_formats if kind != "openfoam"]
        if self.pieces and (others or self.solver is not None or self._land is not None):
            given = f"format {others[0]}" if others else "check-solver" if self.solver else "land"
            raise InputError(f"{given} needs the whole mesh, and pieces are given; leave --pieces out")

    def _run_one(self, adapter: Any, size: Any, method: str | None, settings: dict[str, Any]) -> Result:
        # Settings that only other methods of the case use are left out.
        used = {k: v for k, v in settings.items() if uses(method or Options.method, k)}
        arguments = arguments_of_run(used)
        if method is not None:
            arguments["method"] = method
        most = arguments.get("max_steps")
        title = f"{self.case.name} {method or ''}".strip()
        progress: Any = nullcontext() if self.quiet else ProgressDisplay(title, most)
        with progress as shown:

            def callback(row: np.void) -> bool:
                if shown is not None:
                    shown(row)
                return self.interrupted

            def announce(needed: float) -> None:
                if shown is not None and (shown.live or needed >= _MUCH):
                    there = in_bytes(available_memory(adapter.ctx.devices[0]))
                    shown.tell(f"{title}: takes {in_bytes(needed)} of the device's {there}")

            def show_builds(built: int, total: int) -> None:
                if shown is not None:
                    shown.show_builds(built, total)

            adapter.on_memory, adapter.on_build = announce, show_builds
            adapter.on_work = None if shown is None else shown.show_work
            try:
                domain, state = self.case.domain, self._state
                result: Result = adapter.run(domain, size, callback=callback, checkpoint=state, **arguments)
            except Interrupted as stopped:
                result = stopped.result
            finally:
                adapter.on_memory = adapter.on_build = adapter.on_work = None
        unfinished = result.stop_reason in (INTERRUPTED, STOPPED)
        self.interrupted = self.peers.any(self.interrupted or unfinished)
        if not self.pieces:
            result = result.gather() or result
        if self._land is not None and result.parts is None:
            result = result.subset(earth.ocean(result, self._land))
        return replace(result, stop_reason=INTERRUPTED) if unfinished else result

    def _during(self, work: str, task: Callable[[], Any]) -> Any:
        return during(f"{self.case.name}: {work}", self.quiet, task)

    def _now_and_then(self) -> Callable[[str], None]:
        """Return a function that prints a progress text, but not too often."""
        from .progress import EVERY

        shown = time.monotonic()

        def tell(text: str) -> None:
            nonlocal shown
            if not self.quiet and time.monotonic() - shown >= EVERY:
                print(f"{self.case.name}: {text}", file=sys.stderr, flush=True)
                shown = time.monotonic()

        return tell

    def _refuse_formats(self) -> None:
        """Raise an error before the run if a format cannot hold its mesh, or an option is for another format."""
        if self.walls is not None and self.solver is None and "openfoam" not in self.mesh_formats:
            raise InputError(
                f"walls is {self.walls!r}, and no mesh is written for OpenFOAM; add --format openfoam, or leave it out"
            )
        if self.processors is not None and not {"openfoam", "metis"} & set(self.mesh_formats):
            raise InputError("processors are given, and nothing is written for them; add --format openfoam or metis")
        if self.types and "openfoam" not in self.mesh_formats:
            raise InputError("types are given, and no mesh is written for OpenFOAM; add --format openfoam")
        name, domain = self.case.name, self.case.domain
        if self.solver is not None or "openfoam" in self.mesh_formats:
            what = "format openfoam" if self.solver is None else f"check-solver {self.solver}"
            remedy = "expected --format mpas or nc, and clvoro check --for mpas"
            domain.require_flat(f"{name}: {what} is for meshes in boxes, polygons and solids", remedy)
        if "scrip" in self.mesh_formats:
            domain.require_globe(
                f"{name}: format scrip is for meshes on a sphere", "expected nc, mpas or another format"
            )
        for kind in self.mesh_formats:
            if kind in PLANE and self.case.domain.cell_dim != 2:
                raise InputError(
                    f"{self.case.name}: format {kind} is for meshes in 2D, and the domain is in 3D; expected openfoam"
                )

    @cached_property
    def _state(self) -> Checkpoint | None:
        """The checkpoint of the run, if any."""
        given = {"checkpoint": self.checkpoint, "checkpoint_every": self.checkpoint_every, "resume": self.resume}
        given = {name: value for name, value in given.items() if value is not None}
        if "checkpoint_every" in given and self.checkpoint is None:
            raise InputError("checkpoint_every is given, and no checkpoint; say which file: --checkpoint FILE")
        if given and len(self.case.methods) > 1:
            raise InputError(
                f"{self.case.name}: {next(iter(given))} is for a run of one method, and the case has "
                f"{len(self.case.methods)}; choose one with --method"
            )
        if len(self.case.methods) > 1:
            return None
        if self.checkpoint is None:  # written only if the run is stopped
            return Checkpoint(self.out / STATE, math.inf, self.resume)
        every = Checkpoint.every if self.checkpoint_every is None else self.checkpoint_every
        return Checkpoint(self.checkpoint, every, self.resume)

    def _tell_how_to_continue(self, results: dict[str, Result]) -> None:
        """After an interruption, print the command that continues, or that no step is left."""
        if not self.interrupted or self._state is None:
            return
        if all(result.stop_reason != INTERRUPTED for result in results.values()):
            print("clvoro: no step was left: the mesh is complete", file=sys.stderr)
            return
        if not Path(str(self._state.path)).exists():
            return
        words = list(self.command)
        for option in [word for word in words if word.startswith("--resume")]:
            at = words.index(option)
            del words[at : at + (1 if "=" in option else 2)]
        launcher = ["mpiexec", "-n", str(self.peers.count)] if self.peers.count > 1 else []
        again = [*launcher, "clvoro", *words, "--resume", str(self._state.path)]
        print(f"clvoro: to go on: {shlex.join(again)}", file=sys.stderr)

    @contextmanager
    def _stopping_cleanly(self) -> Iterator[None]:
        """Let the first of the signals end the run after its step, and the second at once."""

        def stop(number: int, _: object) -> None:
            if self.interrupted:
                raise Aborted
            self.interrupted = True
            print("\nclvoro: stopping after this step; once more to quit without writing", file=sys.stderr)

        previous = {}
        try:
            for number in (getattr(signal, name, None) for name in _STOPPING):
                # Ignored signals stay ignored, as under nohup and in background jobs.
                if number and signal.getsignal(number) not in (None, signal.SIG_IGN):
                    previous[number] = signal.signal(number, stop)
        except ValueError:  # not the main thread: no signal handlers
            pass
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    @property
    def _mesh_files(self) -> tuple[str, ...]:
        """Names of the files that each mesh is written to."""
        return ("mesh.pvtu",) if self.pieces else ("mesh.vtu", "mesh.npz")

    def _mesh_file_of(self, other: str) -> str:
        """Return the file name of the mesh of the method `other`, which is not the last of the case."""
        return f"mesh-{other}{Path(self._mesh_files[-1]).suffix}"

    def _write(self, adapter: Any, size: Any, results: dict[str, Result], where: str) -> None:
        """Write all files on rank 0. With `pieces` each rank writes its own cells."""
        if self.peers.number and not self.pieces:
            return
        *others, (_, main) = results.items()
        if not self.quiet and (sys.stderr.isatty() or len(main.points) > _MANY):
            work = "mesh and report" if self.report else "mesh"
            print(f"{self.case.name}: writing {work} into {self.out}", file=sys.stderr, flush=True)
        tasks: list[Callable[[], object]] = [partial(save, main, self.out / name) for name in self._mesh_files]
        for kind in self.mesh_formats:
            name, convention = MESH_FILES[kind]
            options: dict[str, Any] = {"convention": convention}
            if kind == "openfoam":
                options = {"walls": self.walls, "types": self.case.patches, "check": not self.unchecked}
                options["processors"] = self.processors
            task = partial(write, main, self.out / name, **options)
            work = "solver mesh" if kind == "openfoam" else name
            tasks.append(partial(self._during, f"writing the {work}", task))
            if kind == "metis" and self.processors:
                tasks.append(partial(save, main, self.out / f"{name}.part.{self.processors}"))
        tasks += [partial(save, result, self.out / self._mesh_file_of(other)) for other, result in others]
        if self.peers.number:  # rank 0 writes all other files
            do_all(tasks)
            return
        tasks.append(partial(write_history, main, self.out / "history.csv"))
        tasks += [partial(write_history, result, self.out / f"history-{other}.csv") for other, result in others]
        note = "; interrupted: the mesh beside it is that of an earlier step" * (main.stop_reason == INTERRUPTED)
        header = (f"Written by clvoro {__version__} on {where}{note}.", "Repeat it with: clvoro run case.toml")
        repeatable = self._repeatable(results)
        tasks.append(partial(repeatable.write, self.out, header))
        if self.report:
            tasks.append(lambda: self._report(adapter, size, results, where, repeatable.text(header)))
        do_all(tasks)

    def _report(self, adapter: Any, size: Any, results: dict[str, Result], where: str, case: str) -> None:
        from ..plotting import write_report

        *_, main = results.values()
        write_report(
            results,
            self.out,
            initial=self._initial(adapter, size, main),
            size=size,
            title=self.case.title,
            case=case,
            facts={"device": where, "precision": str(adapter.dtype)},
            formats=self.picture_formats,
            tell=self._now_and_then(),
        )

    def _repeatable(self, results: dict[str, Result]) -> Case:
        """Return the case with all default settings written out."""
        settings: dict[str, Any] = {}
        for result in results.values():  # the last one is the main one
            settings |= result.settings
        known = {key: settings.get(key) for key in _REPEATED}
        if known["start"] == "points":
            known["start"] = None
        if len(self.case.methods) > 1:  # of which each may choose its own levels and error target
            given = self.case.run.get("error_target") if "error_target" in settings else None
            own = {"levels": None, "error_target": given}
            return self.case.with_run(**{**known, **own}, methods=self.case.run["methods"])
        return self.case.with_run(**known, method=settings.get("method"))

    def _initial(self, adapter: Any, size: Any, main: Result) -> Result | None:
        """Return the mesh before the first step."""
        domain = self.case.domain
        if main.initial is None or main.history["level"][0] > 0:
            return None  # there was no step, or the first level was not the finest
        if main.diagram.has_moved_vertices:
            return None  # walls of so irregular cells take longer than the run
        points = np.clip(main.initial.points, domain.lower, domain.upper)
        return adapter.run(domain, size, points=points, method="lloyd", max_steps=0)

    def _check_for_solver(self, results: dict[str, Result]) -> None:
        """Check the main mesh by the criteria of the solver; its own program has the last word."""
        *_, main = results.values()
        walls = self.walls or "straight"
        assert self.solver is not None
        report = self._during("checking the mesh", partial(main.check, self.solver, walls=walls))
        # OpenFOAM cannot hold cells around islands.
        simple = report.criteria[0].name != "cells around islands"
        verdict = self._during("checkMesh", partial(run_check_mesh, main, walls)) if simple else None
        self.rejected = not (report.ok if verdict is None else verdict.ok)
        if simple and verdict is None:
            warnings.warn(
                "OpenFOAM's checkMesh is not installed: the mesh is checked by the same criteria as clvoro computes "
                "them; install OpenFOAM (Debian: apt-get install openfoam), or put checkMesh on the PATH",
                SolverWarning,
                stacklevel=2,
            )
        if self.as_json:
            said = None if verdict is None else verdict.complaints
            checked = {"case": self.case.name, **report.as_dict(), "checkMesh": said}
            print(json.dumps({**checked, "ok": not self.rejected}), flush=True)
        elif not self.quiet or self.rejected:
            print(report)
            if verdict is not None:
                print("checkMesh: " + ("Mesh OK" if verdict.ok else "; ".join(verdict.complaints)))

    def _announce(self, name: str, result: Result, where: str, profile: Profile | None) -> None:
        """Print the run as JSON, if requested."""
        if self.as_json:
            entry = {
                "case": self.case.name,
                "method": name,
                "device": where,
                "out": str(self.out),
                **summary(result),
                "settings": result.settings,
            }
            if profile is not None:
                entry["profile"] = profile.as_dict()
            print(json.dumps(entry, default=_plain), flush=True)

    def _summarize(self, results: dict[str, Result], where: str, profiles: dict[str, Profile]) -> None:
        """Print a table."""
        if self.quiet or self.as_json:
            return
        print(f"{self.case.title} on {where}")
        print(
            f"{'method':10}{'cells':>9}{'steps':>7}{'mean |e|':>10}{'max |e|':>10}"
            f"{'mean Q':>9}{'min Q':>8}{'seconds':>9}  stopped"
        )
        for name, result in results.items():
            s = summary(result)
            print(
                f"{name:10}{s['cells']:9d}{s['steps']:7d}{s['mean_error']:10.4f}"
                f"{s['max_error']:10.3f}{s['mean_quality']:9.4f}{s['min_quality']:8.3f}"
                f"{s['seconds']:9.2f}  {s['stop_reason']}"
            )
        if build_seconds() > 2:
            print(f"building kernels took {build_seconds():.1f} s; the driver keeps them for later runs")
        for name, result in results.items():
            thickness = thickness_in_words(result.settings.get("thickness", ()))
            for said in (result.scaling, result.settings.get("widths"), *thickness):
                if said:
                    print(f"{name}: {said}")
            if "trade" in result.settings:
                print(f"{name}: {result.settings['trade']}")
            if self.pieces:
                continue
            if result.diagram.domain.cell_dim == 3:
                print(f"{name}: {result.measures.line()}")
            if line := boundary_line(result):
                print(f"{name}: {line}")
        print(f"written into {self.out}: {', '.join(self._written(results))}")
        for name, profile in profiles.items():
            print(f"\nwhere the time of {name} went:\n{profile.table()}")

    def _written(self, results: dict[str, Result]) -> list[str]:
        """Return the names of all files and folders that the run has written."""
        *others, _ = results
        found = [*self._mesh_files, "history.csv"]
        places = "constant/polyMesh" + ", processor0, ..." * (self.pieces or self.processors is not None)
        for kind in self.mesh_formats:
            found.append(MESH_FILES[kind][0] + f" (with {places})" * (kind == "openfoam"))
            found += [f"{MESH_FILES[kind][0]}.part.{self.processors}"] if kind == "metis" and self.processors else []
        found += [name for other in others for name in (self._mesh_file_of(other), f"history-{other}.csv")]
        found += ["case.toml", *self.case.copies()]
        return found + ["report.html", "pictures/"] * self.report


def _plain(value: Any) -> Any:
    """Convert NumPy numbers and arrays, and any other object, for JSON."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
