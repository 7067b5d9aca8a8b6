"""Threads, processes and many runs: the same bits, no memory that stays."""

import gc
import hashlib
import os
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import program
from clvoro.opencl.engine import Engine
from clvoro.solvers import poisson

BOX = clvoro.Box((0, 0), (2.5, 1.5))
SHORE = [(0, 0), (3, -0.3), (4, 1), (2.6, 1.2), (2.5, 2.2), (1, 2)]
ISLAND = [(1, 0.8), (1.6, 0.7), (1.5, 1.2)]
TORUS = clvoro.Box((0, 0), (1, 1), periodic=True)
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
SIZE = "0.07 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)"
WORK = [
    {"method": "coupled", "max_steps": 3, "seed": 1},
    {"method": "adaptive", "effort": "fast", "max_steps": 25, "seed": 2},
    {"method": "exact", "effort": "fast", "n_cells": 120, "max_steps": 20, "seed": 3},
    {"method": "weighted", "max_steps": 5, "seed": 4},
]


def digest(result):
    """A hash of every bit of the outcome but the times."""
    hashed = hashlib.sha256()
    d = result.diagram
    parts = [result.points, result.target_size, result.size_error, result.quality, d.volumes, d.neighbors, d.vertices]
    parts += [result.history[name] for name in result.history.dtype.names if name != "seconds"]
    for part in parts:
        hashed.update(np.ascontiguousarray(part).tobytes())
    return hashed.hexdigest()


def run(adapter, options):
    return digest(adapter.run(BOX, clvoro.sizing.Expression(SIZE), **options))


@pytest.fixture(scope="module")
def alone(ctx):
    return [run(clvoro.Adapter(ctx), options) for options in WORK]


@pytest.mark.slow
@pytest.mark.parametrize("shared", ["context", "adapter", "nothing"])
def test_threads_do_not_disturb_each_other(ctx, alone, shared):
    adapter = clvoro.Adapter(ctx)

    def work(k):
        if shared == "adapter":  # one call waits for the other
            mine = adapter
        else:
            mine = clvoro.Adapter(ctx if shared == "context" else cl.Context(ctx.devices))
        return run(mine, WORK[k % len(WORK)])

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(work, range(4 if shared == "nothing" else 8)))
    assert found == (alone if shared == "nothing" else 2 * alone)


def test_diagrams_from_many_threads(ctx):
    adapter = clvoro.Adapter(ctx)
    sets = [np.random.default_rng(60 + k).random((30 + 17 * k, 2)) for k in range(12)]
    expected = [adapter.diagram(BOX, points).volumes for points in sets]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda points: adapter.diagram(BOX, points).volumes, sets))
    assert all(np.array_equal(a, b) for a, b in zip(expected, found, strict=True))


@pytest.mark.slow
def test_processes_find_the_same_bits(ctx, alone):
    program = "import sys; sys.path.insert(0, '.'); import clvoro; from tests import conftest\n"
    program += "from tests.robustness import test_concurrency as t\n"
    program += "a = clvoro.Adapter()\nprint(a.queue.device.max_compute_units)\n"
    program += "for k in (0, 3, 1): print(t.run(a, t.WORK[k]))"
    # Another seed of Python's hashes, because no order of a set may matter, and another number of cores for PoCL.
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=Path(__file__).parents[2],
        text=True,
        check=True,
        capture_output=True,
        env={**os.environ, "PYTHONHASHSEED": "12345", "POCL_MAX_PTHREAD_COUNT": "1"},
    )
    units, *found = done.stdout.split()
    assert units == "1" or ctx.devices[0].platform.name != "Portable Computing Language"
    assert found == [alone[0], alone[3], alone[1]]


FAST = {"effort": "fast"}
RING = "0.015 + 0.03*fabs(hypot(x-0.9, y-0.75)-0.3)"
LARGE = {
    "plane": (BOX, RING, FAST, "float64"),
    "float32": (BOX, RING, FAST, "float32"),
    "multigrid": (BOX, RING, {"method": "coupled", "max_steps": 4}, "float64"),
    "exact": (BOX, "0.016 + 0.01*x", {"method": "exact", **FAST}, "float64"),
    "layers": (BOX, "0.022", {"layers": clvoro.Layers(0.008, count=3, growth=1.2), **FAST}, "float64"),
    "polygon": (clvoro.Polygon(SHORE, [ISLAND]), "0.018 + 0.01*x", FAST, "float64"),
    "periodic": (TORUS, "0.011 + 0.004*sin(6.283185307179586*x)", FAST, "float64"),
    "space": (CUBE, "0.045 + 0.02*x", FAST, "float64"),
    "periodic space": (clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), "0.053", FAST, "float64"),
}
"""Runs of 5,000 to 15,000 cells need many work-groups, unlike small ones."""


def run_large(name):
    """Return the cores that the device has, the cells of the run, and its digest."""
    domain, size, options, real = LARGE[name]
    adapter, field = clvoro.Adapter(dtype=real), clvoro.sizing.Expression(size)
    if name == "multigrid":  # in a process of its own
        clvoro.solvers.poisson.expected_costs = lambda *_: (2.0, 1.0)
    result = adapter.run(domain, field, seed=7, **options)
    return adapter.queue.device.max_compute_units, len(result.points), digest(result)


@pytest.fixture
def unoptimized(monkeypatch):
    """Return a function after which kernels are built without optimization."""
    plain = program.compile_text

    def compile_text(ctx, text, options, short=True):
        return plain(ctx, text, (*options, "-cl-opt-disable"), short)

    return lambda: monkeypatch.setattr(program, "compile_text", compile_text)


@pytest.mark.slow
def test_optimization_changes_no_bit(ctx, alone, unoptimized):
    """Kernels use strict floating point. The fast tests build most of them without optimization: see `conftest`."""
    unoptimized()
    assert run(clvoro.Adapter(cl.Context(ctx.devices)), WORK[1]) == alone[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LARGE))
def test_optimization_changes_no_bit_of_large_runs(name, unoptimized, monkeypatch):
    monkeypatch.setattr(poisson, "expected_costs", poisson.expected_costs)  # which a run replaces
    optimized = run_large(name)
    unoptimized()
    assert run_large(name) == optimized


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LARGE))
def test_one_core_finds_the_bits_of_two(ctx, name):
    """With `python -m pytest -m slow -k cores tests/robustness/test_concurrency.py`, some seconds each."""
    if ctx.devices[0].platform.name != "Portable Computing Language":
        pytest.skip("only PoCL has a variable for the number of cores")
    program = "import sys; sys.path.insert(0, '.'); from tests import conftest\n"
    program += "from tests.robustness import test_concurrency as t\n"
    program += "print(*t.run_large(sys.argv[1]))"
    found = []
    for cores in (1, 2):
        done = subprocess.run(
            [sys.executable, "-c", program, name],
            cwd=Path(__file__).parents[2],
            text=True,
            check=True,
            capture_output=True,
            env={**os.environ, "POCL_MAX_PTHREAD_COUNT": str(cores)},
        )
        found.append(done.stdout.split())
    (one, cells, bits), (two, *others) = found
    if two != "2":
        pytest.skip("there is one core")
    assert one == "1"
    assert 5000 <= int(cells) <= 15000
    assert [cells, bits] == others


def resident():
    """Memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


FEW = {"method": "coupled", "max_steps": 2}
PLANNED = {"effort": "fast", "max_steps": 12}
GROWS = {
    "box": (BOX, 0.06, FEW),
    "polygon": (clvoro.Polygon(SHORE, [ISLAND]), 0.12, FEW),
    "periodic": (TORUS, 0.05, FEW),
    "space": (CUBE, 0.2, FEW),
    "adaptive": (BOX, 0.06, {**PLANNED, "options": clvoro.MultilevelOptions(levels=1)}),
    "layers": (BOX, 0.1, {**FEW, "layers": clvoro.Layers(0.02, count=2, growth=1.2)}),
    "adaptive in space": (CUBE, 0.2, {"effort": "fast", "max_steps": 3}),
    "resumed": (BOX, 0.06, {"method": "weighted", "max_steps": 3}),
}
"""Domain, a mean size for some hundred cells, and options of the run."""


def buffers_left(work):
    """Return the bytes of device buffers that `work` has allocated and that remain, after each run."""
    left, alive = [], {}
    plain = cl.Buffer

    class Counted(plain):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            alive[id(self)] = self.size
            weakref.finalize(self, alive.pop, id(self), None)

    cl.Buffer = Counted
    try:
        for k in range(RUNS):
            work(k)
            if k % 20 == 19:
                gc.collect()
                left.append(sum(alive.values()))
    finally:
        cl.Buffer = plain
    return left


RUNS = 200
NOISE = 10
"""MiB by which the process may grow: memory that the allocator keeps, and fragments."""


def grown(work):
    """Return by how much 200 calls of `work` grow the process, in MiB, and what is on the device, in bytes.

    From the first forty, after which all is compiled and the allocator has its pools, to the last.
    """
    sizes = []

    def noted(k):
        work(k)
        if k in (39, RUNS - 1):
            gc.collect()
            sizes.append(resident())

    left = buffers_left(noted)
    return sizes[1] - sizes[0], left[-1] - left[1]


def runs_of(ctx, name, folder):
    """Return what does run k of a kind: every other one by an adapter that is kept, all of the diagram read."""
    domain, size, options = GROWS[name]
    kept, file = clvoro.Adapter(ctx), folder / "state"
    if name == "resumed":
        stopped = {"callback": lambda row: row["step"] == 1, "seed": 1}
        kept.run(domain, size, checkpoint=clvoro.Checkpoint(file, every=1e9), **options, **stopped)
        options = {**options, "checkpoint": clvoro.Checkpoint(resume=file), "seed": 1}

    def work(k):
        adapter = clvoro.Adapter(ctx) if k % 2 else kept
        # Every twentieth size is the same. The adapter keeps the buffers of the last run.
        factor = 1 if name == "resumed" else 1 + 0.01 * (k % 20)
        result = adapter.run(domain, size * factor, **{"seed": k, **options})
        for array in result.diagram._NAMES:
            getattr(result.diagram, array, None)

    return work


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
@pytest.mark.parametrize("name", list(GROWS))
def test_memory_of_two_hundred_runs_does_not_grow(ctx, name, tmp_path):
    """With `python -m pytest -m slow tests/robustness/test_concurrency.py`, up to a minute each."""
    process, device = grown(runs_of(ctx, name, tmp_path))
    assert process < NOISE
    # What the adapter keeps for the next run differs with the count of cells, which a seed changes by one or two.
    assert device < 2**16


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
@pytest.mark.parametrize("leak", ["on the device", "on the host"])
def test_a_leak_is_found(ctx, tmp_path, leak):
    """One array kept per run: a few kilobytes on the device; half a megabyte on the host, beyond what is free there."""
    work, kept = runs_of(ctx, "box", tmp_path), []
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))

    def leaking(k):
        work(k)
        kept.append(engine.zeros(600) if leak == "on the device" else np.ones(2**16))

    process, device = grown(leaking)
    assert (device >= 2**16) if leak == "on the device" else (process >= NOISE)
