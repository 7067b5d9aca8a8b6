"""Build kernels of a first run in other processes, or in threads.

Drivers other than PoCL build whole programs and keep the binaries, or PyOpenCL keeps them: see
`pyopencl.characterize.has_src_build_cache`. So threads begin to build the programs of a run when it begins.

A process builds one PoCL program or kernel at a time, whatever the number of threads. So, before a first run with PoCL,
worker processes (`build_worker`) build kernels into PoCL's cache. `first_kernels.json` lists the kernels of each kind
of run; `bench/first_run.py --record` writes it. The workers begin with the kernels that are needed last. This process
builds those that it needs before a worker has built them.

The kernels of a first run are built without optimization: in less than half of the time, and with the same results to
the last bit. The workers then build the optimized ones, which replace them (`renew`).
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import json
import os
import pickle
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyopencl as cl

from . import program as _program
from .engine import Engine
from .program import UNOPTIMIZED, build_in_threads, on_pocl, program_text, text_for_driver
from .runtimes import cache_home

PATIENCE = 0.5
"""Seconds that kernels are built before a line on the terminal says so."""


class BuildNotice:
    """A line on the terminal while kernels are built; it is cleared before anything else is printed.

    - `total`: kernels that the run will need.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._shown = False
        self._began = time.monotonic()

    def show(self, built: int) -> None:
        """Show the number of kernels that are `built`."""
        if time.monotonic() - self._began < PATIENCE:
            return
        text = f"clvoro builds kernels, once for this device: {built} of {self._total}"
        columns = shutil.get_terminal_size().columns
        self._write(f"\r{text[: columns - 1]}\x1b[K")
        self._shown = True
        if built >= self._total:
            self.clear()

    def clear(self, row: object = None) -> None:
        """Clear the line. `row`, a row of the history, is ignored."""
        if self._shown:
            self._write("\r\x1b[K")
            self._shown = False

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


@contextmanager
def report_builds(
    engine: Engine, on_build: Callable[[int, int], object] | None, job: str = ""
) -> Iterator[BuildNotice | None]:
    """Let workers build kernels of a first run, and report the progress inside the ``with`` block.

    - `on_build`: called with the number of kernels built and of all. With None, the standard error shows a line if it
      is a terminal.
    - `job`: what is done in place of a run: "transport".

    Return the line, if there is one.
    """
    total, notice = build_ahead(engine, job), None
    if total and on_build is None and sys.stderr is not None and sys.stderr.isatty():
        notice = BuildNotice(total)
        on_build = lambda built, _: notice.show(built)  # noqa: E731
    if total and on_build is not None:
        report = on_build
        engine.pool.on_kernel = lambda built: report(min(built, total), total)
    try:
        yield notice
    finally:
        engine.pool.on_kernel = None
        if notice is not None:
            notice.clear()


MOST_WORKERS = 3
"""Largest number of processes that build kernels beside this one."""
MOST_THREADS = 8
"""Largest number of threads that build programs."""
_RECORD = Path(__file__).with_name("first_kernels.json")
_workers: list[subprocess.Popen[bytes]] = []
_waiting: list[subprocess.Popen[bytes]] = []
"""Workers that have no work yet."""
_known: set[tuple[str, int]] = set()
"""Kinds of runs, and devices, of this process."""
_lock = threading.Lock()
_under_way: list[Optimization] = []
_optimized = 0
"""Number of optimizations that have ended."""


class FirstLaunch(NamedTuple):
    """The first launch of a kernel: index of its program, size of its group, bytes of its arguments (0: a buffer)."""

    program: int
    kernel: str
    group: int
    sizes: list[int]


class Work(NamedTuple):
    """What a worker builds: text and options of programs, and launches in the order of building.

    From the first launch of program number `patient`, or a later one, the worker has a lower priority.
    """

    programs: list[tuple[str, tuple[str, ...]]]
    launches: list[FirstLaunch]
    patient: int = 0


class Optimization(NamedTuple):
    """Programs that `workers` build with optimization, and the file `marker` that says later that they have done so."""

    programs: list[tuple[str, tuple[str, ...]]]
    workers: list[subprocess.Popen[bytes]]
    marker: Path


def start_workers(device: cl.Device) -> None:
    """Start workers for `device` if no kernel has been built for it. They load the compiler and wait for work."""
    if on_pocl(device) and _is_new("device", device):
        _start(device)


def build_ahead(engine: Engine, job: str = "") -> int:
    """Let workers build the kernels of a run on `engine`, or of another `job`, if this is the first one of its kind.

    Return the number of recorded kernels; 0 if this is not the first, or nothing is recorded.
    """
    kind, device = kind_of(engine, job), engine.queue.device
    in_processes = on_pocl(device)
    recorded = _record().get(kind if in_processes else kind.replace("float32", "float64"))
    if recorded is None or (kind, device.int_ptr) in _known:
        return 0
    _known.add((kind, device.int_ptr))
    work = _work(engine, recorded)
    if not in_processes:
        # Also if they are in the driver's cache: to load them takes time, too.
        build_in_threads(engine.ctx, work.programs, min(_other_cores(), MOST_THREADS))
        return len(work.launches) if _is_new(repr(work.programs), device) else 0
    marker = _marker(repr(work.programs), device)
    if marker is None or marker.exists():
        return 0
    if not _waiting:
        _start(device)
    if not _waiting:
        _mark(marker)
        return len(work.launches)
    quick = [(text, (*options, UNOPTIMIZED)) for text, options in work.programs]
    texts = [text_for_driver(engine.ctx, *program) for program in (*quick, *work.programs)]
    for index, worker in enumerate(_waiting):
        mine = _share(work.launches, index, len(_waiting))
        later = [launch._replace(program=launch.program + len(quick)) for launch in mine]
        # A worker reads once it has loaded the compiler, and a pipe holds less than the work.
        sent = Work(texts, mine + later, len(quick))
        threading.Thread(target=_send, args=(worker, sent), daemon=True).start()
    _program.quick.update(work.programs)
    _under_way.append(Optimization(work.programs, list(_waiting), marker))
    _waiting.clear()
    return len(work.launches) if _is_new(repr(quick), device) else 0


def renew(engine: Engine) -> None:
    """Let `engine` use optimized kernels if workers have finished some since the last call."""
    global _optimized
    with _lock:
        for optimization in _under_way[:]:
            codes = [worker.poll() for worker in optimization.workers]
            if None in codes:
                continue
            if not any(codes):
                _mark(optimization.marker)
            _program.quick.difference_update(optimization.programs)
            _under_way.remove(optimization)
            _optimized += 1
    if engine.pool.optimized < _optimized:
        engine.pool.optimized = _optimized
        engine.pool.renew()


def kind_of(engine: Engine, job: str = "") -> str:
    """Return the kind of a run: dimension, precision and kind of domain, and the `job`, if it is not a run."""
    return " ".join([f"{engine.dim}D", engine.real.name, *engine.traits.macros, *job.split()])


@cache
def _record() -> dict[str, dict]:
    return json.loads(_RECORD.read_text())


def _work(engine: Engine, recorded: dict) -> Work:
    """Return the programs and launches that were `recorded`, as they are on `engine`.

    The record is from PoCL in float64, where some programs work in the lanes of vectors.
    """
    programs, places = [], {}
    lanes = engine.group_size == 1 and engine.real == np.float64
    for index, (stage, defines) in enumerate(recorded["programs"]):
        if not lanes:
            if stage.startswith("simd/"):
                continue
            reals = {"double": engine.name_of(engine.real)}
            defines = {k: reals.get(v, v) for k, v in defines.items()}
            defines |= {"IN_LANES": "0"} if "IN_LANES" in defines else {}
        places[index] = len(programs)
        programs.append(program_text(f"{stage}.cl", engine.all_defines(stage, defines), ""))
    launches = [FirstLaunch(places[index], *rest) for index, *rest in recorded["launches"] if index in places]
    return Work(programs, launches)


def _share(launches: list[FirstLaunch], index: int, count: int) -> list[FirstLaunch]:
    """Return the launches for worker `index` of `count`: those of whole programs, in reverse order."""
    order = list(dict.fromkeys(launch.program for launch in reversed(launches)))
    mine = order[index::count]
    return [launch for launch in reversed(launches) if launch.program in mine]


def _is_new(what: str, device: cl.Device) -> bool:
    """Return whether the cache has no marker for `what` on `device`, and add the marker."""
    marker = _marker(what, device)
    return marker is not None and _mark(marker)


def _marker(what: str, device: cl.Device) -> Path | None:
    """Return the file that says that `what` is in the cache of `device`; None if there is no cache to write to."""
    if on_pocl(device) and os.environ.get("POCL_KERNEL_CACHE") == "0":
        return None
    with contextlib.suppress(OSError, RuntimeError):
        folder = cache_home()
        if on_pocl(device):
            folder = Path(os.environ.get("POCL_CACHE_DIR") or folder / "pocl" / "kcache")
        folder /= "clvoro"
        folder.mkdir(parents=True, exist_ok=True)
        version = device.version, device.driver_version, device.name, what
        if os.access(folder, os.W_OK):
            return folder / hashlib.sha256(repr(version).encode()).hexdigest()[:16]
    return None


def _mark(marker: Path) -> bool:
    """Make the file `marker`; return False if it is there already, or cannot be made."""
    with contextlib.suppress(OSError):
        marker.open("x").close()
        return True
    return False


def _start(device: cl.Device) -> None:
    """Start a worker for each other core; none if this process cannot start others."""
    name = Path(sys.executable or "").name
    if not name.startswith(("python", "pypy")):  # Python is embedded in an application
        return
    index = _index_of(device)
    code = f"import runpy; runpy.run_path({str(Path(__file__).with_name('build_worker.py'))!r}, run_name='__main__')"
    for _ in range(min(_other_cores(), MOST_WORKERS)):
        with contextlib.suppress(OSError, ValueError):
            worker = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, index)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            _workers.append(worker)
            _waiting.append(worker)
    if _workers:
        atexit.unregister(_stop_workers)
        atexit.register(_stop_workers)


def _other_cores() -> int:
    """Return the number of cores beside that of this thread."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (cores or 1) - 1


def _index_of(device: cl.Device) -> tuple[int, int]:
    for p, platform in enumerate(cl.get_platforms()):
        if platform == device.platform:
            return p, platform.get_devices().index(device)
    raise ValueError(f"device {device.name.strip()!r} is not in the list of any OpenCL platform")


def _send(worker: subprocess.Popen[bytes], work: Work) -> None:
    """Send `worker` its work, unless it has ended."""
    assert worker.stdin is not None
    with contextlib.suppress(OSError, ValueError):
        pickle.dump((work.programs, [tuple(launch) for launch in work.launches], work.patient), worker.stdin)
        worker.stdin.close()


def _stop_workers() -> None:
    """End the workers. What they have not built the next process builds."""
    for optimization in _under_way:
        if all(worker.poll() == 0 for worker in optimization.workers):
            _mark(optimization.marker)
    for worker in _workers:
        if worker.poll() is None:
            worker.kill()
        worker.wait()
        if worker.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                worker.stdin.close()
