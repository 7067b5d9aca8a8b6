"""Threads, processes and many runs: the same bits, no memory that stays."""

import hashlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import clvoro
from clvoro.device import create_context

BOX = clvoro.Box((0, 0), (2.5, 1.5))
SIZE = "0.07 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)"
WORK = [
    {"method": "coupled", "max_steps": 3, "seed": 1},
    {"method": "adaptive", "effort": "fast", "max_steps": 25, "seed": 2},
    {"method": "exact", "effort": "fast", "n_cells": 120, "max_steps": 20, "seed": 3},
    {"method": "weighted", "max_steps": 5, "seed": 4},
]  # fmt: skip


def digest(result):
    """A hash of every bit of the outcome but the times."""
    hashed = hashlib.sha256()
    d = result.diagram
    parts = [
        result.points,
        result.size,
        result.error,
        result.quality,
        d.volumes,
        d.neighbours,
        d.vertices,
    ]
    parts += [result.history[name] for name in result.history.dtype.names if name != "seconds"]
    for part in parts:
        hashed.update(np.ascontiguousarray(part).tobytes())
    return hashed.hexdigest()


def run(adapter, options):
    return digest(adapter.run(BOX, clvoro.sizing.Expression(SIZE), **options))


@pytest.fixture(scope="module")
def alone(ctx):
    return [run(clvoro.Adapter(ctx), options) for options in WORK]


@pytest.mark.parametrize("shared", ["context", "adapter", "nothing"])
def test_threads_do_not_disturb_each_other(ctx, alone, shared):
    adapter = clvoro.Adapter(ctx)

    def work(k):
        if shared == "adapter":  # one call waits for the other
            mine = adapter
        else:
            mine = clvoro.Adapter(ctx if shared == "context" else create_context())
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


def test_processes_find_the_same_bits(ctx, alone):
    program = (
        "import sys; sys.path.insert(0, 'tests'); import conftest, test_concurrency as t, clvoro\n"
    )
    program += "a = clvoro.Adapter()\nfor k in (3, 1): print(t.run(a, t.WORK[k]))"
    # Another seed of Python's hashes: no order of a set may matter.
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent.parent, text=True, check=True,
        capture_output=True, env={**os.environ, "PYTHONHASHSEED": "12345"},
    )  # fmt: skip
    assert done.stdout.split() == [alone[3], alone[1]]


def resident():
    """Memory of this process in MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


SHORE = [(0, 0), (3, -0.3), (4, 1), (2.6, 1.2), (2.5, 2.2), (1, 2)]
DOMAINS = {
    "box": (BOX, 0.06),
    "polygon": (clvoro.Polygon(SHORE, [[(1, 0.8), (1.6, 0.7), (1.5, 1.2)]]), 0.12),
    "periodic": (clvoro.Box((0, 0), (1, 1), periodic=True), 0.05),
    "space": (clvoro.Box((0, 0, 0), (1, 1, 1)), 0.2),
}
"""With a mean size: some hundred cells."""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
@pytest.mark.parametrize("name", list(DOMAINS))
def test_memory_of_two_hundred_runs_does_not_grow(ctx, name):
    """With `python -m pytest -m slow tests/test_concurrency.py`, up to a minute each."""
    domain, size = DOMAINS[name]
    kept = clvoro.Adapter(ctx)
    sizes = []
    for k in range(200):
        adapter = clvoro.Adapter(ctx) if k % 2 else kept
        options = {"method": "coupled", "max_steps": 2, "seed": k}
        adapter.run(domain, size * (1 + 0.01 * (k % 20)), **options).diagram.vertices  # noqa: B018
        if k % 20 == 19:
            sizes.append(resident())
    # From the first forty runs, after which all is compiled and the allocator has its pools, to the last.
    assert sizes[-1] - sizes[1] < 10, sizes
