"""Workers build kernels of a first run, and a line on the terminal shows it."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import build_notice, prebuild
from clvoro.opencl.build_notice import BuildNotice, noticed_builds
from clvoro.opencl.engine import Engine
from clvoro.opencl.program import POCL

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))
import first_run

BUILD = """
import json, os, sys
import clvoro
from clvoro.opencl import prebuild
from clvoro.opencl.engine import Engine
prebuild._record = lambda: {"2D float64": json.loads(sys.argv[1])}
adapter = clvoro.Adapter()
engine = adapter._stages_for(clvoro.Box((0, 0), (1, 1))).engine
counts = [prebuild.build_ahead(engine) for _ in range(2)]
codes = [worker.wait() for worker in prebuild._workers]
print(json.dumps([counts, codes]))
"""


@pytest.fixture
def engine(ctx):
    if ctx.devices[0].platform.name.strip() != POCL:
        pytest.skip("for PoCL only")
    return Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))


@pytest.mark.parametrize(
    "kind",
    [
        "2D box",
        *(pytest.param(k, marks=pytest.mark.slow) for k in first_run.RECORDED if k != "2D box"),
    ],
)
def test_record_has_the_kernels_of_a_run(engine, kind):
    """If this fails: `python bench/first_run.py --record`."""
    name, found = first_run.record_kind(kind)
    recorded = prebuild._record()[name]

    def launches(record):
        programs = [json.dumps(program) for program in record["programs"]]
        return {(programs[p], *map(str, rest)) for p, *rest in record["launches"]}

    assert launches(found) == launches(recorded)


def test_workers_build_recorded_kernels_once(engine, tmp_path):
    record = {
        "programs": [["opencl/primitives", {}], ["adaptation/motion", {}]],
        "launches": [
            [0, "gather_rows", 64, [4, 0, 0, 4, 0]],
            [0, "scan_blocks", 1, [0, 4, 4, 0, 0, 0, 4]],
        ],
    }
    env = {
        **os.environ,
        "POCL_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": str(Path(clvoro.__file__).parents[1]),
    }
    ended = subprocess.run(
        [sys.executable, "-c", BUILD, json.dumps(record)],
        env=env,
        capture_output=True,
        text=True,
        check=True,
    )
    counts, codes = json.loads(ended.stdout)
    assert counts == [2, 0]
    assert codes == [0] * len(codes)
    workers = min(len(os.sched_getaffinity(0)) - 1, prebuild.MOST_WORKERS)
    assert len(codes) == workers
    built = {path.stem for path in tmp_path.rglob("*.so")}
    assert built >= ({"gather_rows", "scan_blocks"} if workers else set())


def test_workers_share_whole_programs_last_ones_first():
    launches = [
        prebuild.Launch(p, name, 1, []) for p, name in [(0, "a"), (1, "b"), (0, "c"), (2, "d")]
    ]
    names = [[launch.kernel for launch in prebuild._share(launches, i, 2)] for i in range(2)]
    assert names == [["d", "b"], ["c", "a"]]
    assert [launch.kernel for launch in prebuild._share(launches, 0, 1)] == ["d", "c", "b", "a"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_line_appears_after_a_while_and_is_cleared(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    notice = BuildNotice(3)
    notice.show(1)
    notice.clear()
    assert sys.stderr.getvalue() == ""
    monkeypatch.setattr(build_notice, "PATIENCE", 0)
    notice.show(2)
    assert sys.stderr.getvalue().startswith("\rclvoro builds kernels, once for this device: 2 of 3")
    notice.show(3)
    assert sys.stderr.getvalue().endswith("\r\x1b[K")
    length = len(sys.stderr.getvalue())
    notice.clear()
    assert len(sys.stderr.getvalue()) == length


@pytest.mark.parametrize(("new", "terminal", "lines"), [(5, True, 1), (5, False, 0), (0, True, 0)])
def test_only_first_runs_on_terminals_show_a_line(engine, monkeypatch, new, terminal, lines):
    monkeypatch.setattr(build_notice, "build_ahead", lambda _: new)
    monkeypatch.setattr(build_notice, "PATIENCE", 0)
    monkeypatch.setattr(sys, "stderr", Terminal() if terminal else io.StringIO())
    with noticed_builds(engine, None):
        assert engine.kernels("opencl/primitives").gather_rows
    assert sys.stderr.getvalue().count("1 of 5") == lines
    assert not sys.stderr.getvalue() or sys.stderr.getvalue().endswith("\r\x1b[K")


def test_callback_replaces_the_line(engine, monkeypatch):
    monkeypatch.setattr(build_notice, "build_ahead", lambda _: 2)
    monkeypatch.setattr(sys, "stderr", Terminal())
    told = []
    with noticed_builds(engine, lambda built, total: told.append((built, total))):
        kernels = engine.kernels("opencl/primitives")
        _ = kernels.gather_rows, kernels.gather_rows, kernels.scan_blocks, kernels.combine_blocks
    _ = kernels.summarize_blocks
    assert told == [(1, 2), (2, 2), (2, 2)]
    assert sys.stderr.getvalue() == ""
