"""Workers build kernels of a first run, and a line on the terminal shows it."""

import io
import json
import os
import queue
import subprocess
import sys
import threading
import warnings
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import engine as engines
from clvoro.opencl import prebuild, program
from clvoro.opencl.engine import Engine
from clvoro.opencl.prebuild import BuildNotice, report_builds
from clvoro.opencl.program import POCL, UNOPTIMIZED

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


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["2D box", *(pytest.param(k, marks=pytest.mark.slow) for k in first_run.RECORDED if k != "2D box")]
)
def test_record_has_the_kernels_of_a_run(engine, kind):
    """If this fails: `python bench/first_run.py --record`."""
    name, found = first_run.record_kind(kind)
    recorded = prebuild._record()[name]

    def launches(record):
        programs = [json.dumps(program) for program in record["programs"]]
        return {(programs[p], *map(str, rest)) for p, *rest in record["launches"]}

    assert launches(found) == launches(recorded)


@pytest.mark.slow
def test_workers_build_recorded_kernels_once(engine, tmp_path):
    record = {
        "programs": [["opencl/primitives", {}], ["adaptation/motion", {}]],
        "launches": [[0, "gather_rows", 64, [4, 0, 0, 4, 0]], [0, "scan_blocks", 1, [0, 4, 4, 0, 0, 0, 4]]],
    }
    env = {**os.environ, "POCL_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(clvoro.__file__).parents[1])}
    ended = subprocess.run(
        [sys.executable, "-c", BUILD, json.dumps(record)], env=env, capture_output=True, text=True, check=True
    )
    counts, codes = json.loads(ended.stdout)
    assert counts == [2, 0]
    assert codes == [0] * len(codes)
    workers = min(len(os.sched_getaffinity(0)) - 1, prebuild.MOST_WORKERS)
    assert len(codes) == workers
    built = {path.stem for path in tmp_path.rglob("*.so")}
    assert built >= ({"gather_rows", "scan_blocks"} if workers else set())


def test_workers_build_what_this_process_will_need(engine, tmp_path, monkeypatch):
    """The text is the key of PoCL's cache. With another, all kernels would be built twice."""
    sent, texts, plain = queue.Queue(), [], cl.Program
    monkeypatch.setattr(prebuild, "_marker", lambda *_: tmp_path / "marker")
    monkeypatch.setattr(prebuild, "_known", set())
    monkeypatch.setattr(prebuild, "_under_way", [])
    monkeypatch.setattr(prebuild, "_waiting", ["a worker"])
    monkeypatch.setattr(program, "quick", set())
    monkeypatch.setattr(prebuild, "_send", lambda _, work: sent.put(work))
    assert prebuild.build_ahead(engine) > 20
    work = sent.get(timeout=30)
    monkeypatch.setattr(program, "_programs", {})
    monkeypatch.setattr(program.cl, "Program", lambda ctx, text: texts.append(text) or plain(ctx, text))
    assert engine.kernels("opencl/primitives").gather_rows
    assert texts[0] in [text for text, _ in work.programs]
    assert [UNOPTIMIZED in options for _, options in work.programs[:: work.patient]] == [True, False]


class Worker:
    """A process that has not ended yet, or with `code`."""

    code = None

    def poll(self):
        return self.code


@pytest.mark.parametrize("code", [0, 1])
def test_optimized_kernels_replace_the_first_ones(engine, tmp_path, monkeypatch, code):
    """Also if a worker fails; then the next process begins again."""
    worker, marker, texts, plain = Worker(), tmp_path / "marker", [], cl.Program.build
    mine = [program.program_text("opencl/primitives.cl", engine.all_defines("opencl/primitives", {}), "")]
    monkeypatch.setattr(program, "_programs", {})
    monkeypatch.setattr(program, "quick", set(mine))
    monkeypatch.setattr(prebuild, "_under_way", [prebuild.Optimization(mine, [worker], marker)])
    monkeypatch.setattr(cl.Program, "build", lambda p, options: texts.append(options) or plain(p, options))
    kernels, engine.pool.optimized = engine.kernels("opencl/primitives"), prebuild._optimized
    first = kernels.gather_rows
    prebuild.renew(engine)
    assert kernels.gather_rows is first
    worker.code = code
    prebuild.renew(engine)
    assert kernels.gather_rows is not first
    assert [UNOPTIMIZED in options for options in texts] == [True, False]
    assert marker.exists() == (code == 0)
    assert not program.quick


def test_workers_share_whole_programs_last_ones_first():
    launches = [prebuild.FirstLaunch(p, name, 1, []) for p, name in [(0, "a"), (1, "b"), (0, "c"), (2, "d")]]
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
    monkeypatch.setattr(prebuild, "PATIENCE", 0)
    notice.show(2)
    assert sys.stderr.getvalue().startswith("\rclvoro builds kernels, once for this device: 2 of 3")
    notice.show(3)
    assert sys.stderr.getvalue().endswith("\r\x1b[K")
    length = len(sys.stderr.getvalue())
    notice.clear()
    assert len(sys.stderr.getvalue()) == length


@pytest.mark.parametrize(("new", "terminal", "lines"), [(5, True, 1), (5, False, 0), (0, True, 0)])
def test_only_first_runs_on_terminals_show_a_line(engine, monkeypatch, new, terminal, lines):
    monkeypatch.setattr(prebuild, "build_ahead", lambda *_: new)
    monkeypatch.setattr(prebuild, "PATIENCE", 0)
    monkeypatch.setattr(sys, "stderr", Terminal() if terminal else io.StringIO())
    with report_builds(engine, None):
        assert engine.kernels("opencl/primitives").gather_rows
    assert sys.stderr.getvalue().count("1 of 5") == lines
    assert not sys.stderr.getvalue() or sys.stderr.getvalue().endswith("\r\x1b[K")


def test_callback_replaces_the_line(engine, monkeypatch):
    monkeypatch.setattr(prebuild, "build_ahead", lambda *_: 2)
    monkeypatch.setattr(sys, "stderr", Terminal())
    told = []
    with report_builds(engine, lambda built, total: told.append((built, total))):
        kernels = engine.kernels("opencl/primitives")
        _ = kernels.gather_rows, kernels.gather_rows, kernels.scan_blocks, kernels.combine_blocks
    _ = kernels.summarize_blocks
    assert told == [(1, 2), (2, 2), (2, 2)]
    assert sys.stderr.getvalue() == ""


def test_threads_build_programs_once(ctx, monkeypatch):
    """The main thread builds, too. It waits for a program that a thread builds, and finds its error."""
    built, started, go_on = [], threading.Event(), threading.Event()

    def slow(ctx, text, options, short=True):
        built.append((text, threading.current_thread() is threading.main_thread()))
        if text == "first":
            started.set()
            go_on.wait(30)
        if text == "wrong":
            raise cl.RuntimeError("wrong")
        return text.upper()

    monkeypatch.setattr(program, "compile_text", slow)
    monkeypatch.setattr(program, "_programs", {})
    monkeypatch.setattr(program, "_threads", [])
    monkeypatch.setattr(program, "on_pocl", lambda _: False)
    texts = ["first", "second", "wrong", "last"]
    program.build_in_threads(ctx, [(text, ()) for text in texts], 1)
    assert started.wait(30)
    assert program._build_once(ctx, "second", ()) == "SECOND"
    go_on.set()
    assert program._build_once(ctx, "first", ()) == "FIRST"
    for thread in program._threads:
        thread.join(30)
    with pytest.raises(cl.RuntimeError, match="wrong"):
        program._build_once(ctx, "wrong", ())
    assert program._build_once(ctx, "last", ()) == "LAST"
    assert built == [("first", False), ("second", True), ("wrong", False), ("last", False), ("wrong", True)]


def test_warnings_of_compilers_are_ignored_in_all_threads(recwarn):
    def warn():
        with program._silenced():
            barrier.wait(30)
            warnings.warn("a compiler's", cl.CompilerWarning, stacklevel=1)
            barrier.wait(30)

    barrier, before = threading.Barrier(3), list(warnings.filters)
    threads = [threading.Thread(target=warn) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert not recwarn.list
    assert list(warnings.filters) == before


@pytest.mark.slow
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("kind", ["2D box", "3D box", "2D polygon"])
def test_threads_know_the_programs_of_gpus(ctx, monkeypatch, real, kind):
    """The record is from PoCL in float64; all but a few programs of a run are built ahead on other devices, too."""
    monkeypatch.setattr(engines, "group_sizes", lambda _: engines.GroupSizes(5, 32))
    monkeypatch.setattr(prebuild, "on_pocl", lambda _: False)
    monkeypatch.setattr(prebuild, "_is_new", lambda *_: True)
    monkeypatch.setattr(prebuild, "_known", set())
    ahead, built, plain = [], set(), program.program_text
    monkeypatch.setattr(prebuild, "build_in_threads", lambda _, programs, threads: ahead.extend(programs))

    def noted(name, defines, prelude):
        text = plain(name, defines, prelude)
        built.add(text)
        return text

    monkeypatch.setattr(program, "program_text", noted)
    domain, size = first_run.RUNS[kind]
    adapter, counts = clvoro.Adapter(ctx, real), []
    adapter.on_build = lambda *count: counts.append(count)
    adapter.run(eval(domain), 2 * size)
    missed = built - {(text, tuple(options)) for text, options in ahead}
    assert len(missed) <= 2, [o for _, o in missed]
    assert len(ahead) >= 10
    assert counts[-1][0] > 20
