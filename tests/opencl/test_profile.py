"""Profiles count every command, their times add up, and other queues are not affected."""

import json

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

import clvoro
from clvoro.cli import command as cli
from clvoro.errors import InputError
from clvoro.opencl import hooks as _hooks
from clvoro.opencl import profile, ranges
from clvoro.opencl.engine import Engine
from clvoro.opencl.launch import one_group_limit
from clvoro.opencl.profile import Profile, copy_bandwidth, profiled_queue
from clvoro.solvers.multigrid import Multigrid

BOX = clvoro.Box((0, 0), (1.4, 1))
SETTINGS = {"method": "coupled", "max_steps": 5, "options": clvoro.PaperOptions(tol=0), "n_cells": 301, "seed": 6151}


@pytest.fixture(scope="module")
def adapter(ctx):
    made = clvoro.Adapter(ctx)
    made.run(BOX, 0.07, **SETTINGS)
    return made


@pytest.fixture(scope="module")
def run(adapter):
    with Profile(adapter) as taken:
        result = adapter.run(BOX, 0.07, **SETTINGS)
    return taken, result


@pytest.fixture
def engine(ctx):
    return Engine(ctx, profiled_queue(ctx), 2, np.dtype(np.float64))


def originals():
    return [getattr(place, name) for place, name, _ in _hooks._HOOKS]


def test_numbers_add_up(run):
    taken, _ = run
    kernels = sum(cost.seconds for cost in taken.costs.values())
    stages = taken.stages()
    close = {"rel": 1e-12, "abs": 0}  # sums of the same numbers in another order
    assert kernels > 0
    assert taken.device == pytest.approx(kernels, **close)
    assert sum(cost.seconds for cost in stages.values()) == pytest.approx(kernels, **close)
    assert sum(sum(s.stages.values()) for s in taken.spans) == pytest.approx(kernels, **close)
    assert taken.of(*stages) == pytest.approx(kernels, **close)
    assert taken.device + taken.host == pytest.approx(taken.wall, **close)
    # The device executes one command at a time, between opening and closing.
    assert 0 < taken.device < taken.wall
    # Spans follow each other without a gap, from opening to closing.
    assert sum(s.wall for s in taken.spans) == pytest.approx(taken.wall, rel=1e-9)
    assert sum(cost.calls for cost in stages.values()) == taken.launches


def test_steps_are_those_of_the_history(run):
    taken, result = run
    rows = [(s.step, s.level, s.cells) for s in taken.spans[:-1]]
    assert rows == [(r["step"], r["level"], r["cells"]) for r in result.history]
    assert taken.spans[-1].step is None
    assert [s.step for s in taken.steps] == [1, 2, 3, 4, 5]
    for span in taken.steps:  # each step solves, moves, and tessellates
        assert min(span.stages[name] for name in ("incremental", "cells", "conjugate_gradient", "motion")) > 0


def test_all_kinds_of_commands_are_counted(run, engine):
    taken, result = run
    calls = {key: cost.calls for key, cost in taken.costs.items()}
    tessellations = len(result.history)
    assert calls["cells", "measure_cells"] >= tessellations
    assert calls["motion", "move_generators"] >= 5  # more in ranges
    # With few cells a solve takes one or two launches, which the solver enqueues itself. Small groups take them apart.
    if len(result.points) <= one_group_limit(engine):
        assert tessellations <= calls["conjugate_gradient", "solve_by_group"] <= 2 * tessellations
        assert ("poisson", "apply_laplacian") not in calls
    else:
        assert ("conjugate_gradient", "solve_by_group") not in calls
        assert calls["poisson", "apply_laplacian"] >= tessellations
    assert calls[_hooks.MEMORY, "read"] > 0
    assert calls[_hooks.MEMORY, "write"] > 0
    assert calls[_hooks.MEMORY, "fill"] > 0


def test_repeated_launches_are_counted(engine, monkeypatch):
    monkeypatch.setattr(ranges, "LONGEST", 10.0)
    n = 900  # a ring, large enough for two levels
    place = np.arange(n)
    columns = np.column_stack([(place - 1) % n, (place + 1) % n]).ravel()
    with Profile(engine.queue) as taken:
        multigrid = Multigrid(engine)
        multigrid.set_up(
            engine.upload(2 * np.arange(n + 1), np.int32),
            engine.upload(columns, np.int32),
            engine.upload(np.ones(2 * n)),
        )
        r, u = engine.upload(np.cos(place)), engine.empty(n)
        multigrid.apply(r, u)
        first = taken.launches + len(taken._pending)
        multigrid.apply(r, u)  # the kernels and their arguments are those of the first
        second = taken.launches + len(taken._pending) - first
    assert len(multigrid.sizes) > 1
    cost = taken.stages()["multigrid"]
    assert cost.calls >= 2 * second > 0
    assert cost.seconds_known == cost.seconds
    assert taken.stages()["aggregation"].calls > 0


def test_calls_and_bytes_of_known_launches(engine):
    n = 5000
    values, copy = engine.upload(np.arange(n), np.int32), engine.empty(n, np.int32)
    items = engine.upload(np.arange(n)[::-1], np.int32)
    gather = engine.kernels("opencl/primitives").gather_rows
    with Profile(engine.queue) as taken:
        for _ in range(7):
            engine.run_each(gather, n, items, values, np.int32(1), copy)
        engine.run_each(gather, n, items, items, np.int32(1), copy)  # one buffer bound twice
        cla.Array.fill(values, 3)  # by a kernel of PyOpenCL's
        values.copy()
        engine.zeros(n, np.int32)
        copy.get()
    whole = 4 * n
    costs = taken.costs
    gathers = costs["primitives", "gather_rows"]
    assert (gathers.calls, gathers.bytes) == (8, (7 * 3 + 2) * whole)
    assert costs[_hooks.MEMORY, "copy"].bytes == 2 * whole  # read and written
    assert costs[_hooks.ARRAYS, "fill"].bytes == whole
    assert costs[_hooks.MEMORY, "fill"].bytes == whole
    assert costs[_hooks.MEMORY, "read"].rate is None
    assert taken.launches == 12


def test_times_are_those_of_the_events(engine):
    x = engine.zeros(200_000)
    kernel = engine.kernels("opencl/primitives").summarize_blocks
    args = (*[x] * 8, np.int32(1), np.int32(len(x)), np.zeros(8, np.int32), engine.empty(6 * engine.groups), 0, x)
    with Profile(engine.queue) as taken:
        events = [engine.run_blocks(kernel, *args) for _ in range(9)]
    seconds = sum(1e-9 * (e.profile.end - e.profile.start) for e in events)
    assert seconds > 0
    assert taken.of("primitives") == pytest.approx(seconds, rel=1e-12)


def test_few_events_are_kept(engine, monkeypatch):
    monkeypatch.setattr(profile, "PENDING", 10)
    x, kernel = engine.zeros(64), engine.kernels("opencl/primitives").summarize_blocks
    args = (*[x] * 8, np.int32(1), np.int32(64), np.zeros(8, np.int32), engine.empty(6 * engine.groups), 0, x)
    most = 0
    with Profile(engine.queue) as taken:
        for _ in range(57):
            engine.run_blocks(kernel, *args)
            most = max(most, len(taken._pending))
    assert 0 < most < 10
    assert taken._pending == []
    assert taken.launches == 57


def test_other_queues_are_not_profiled(ctx, engine):
    other = cl.CommandQueue(ctx)
    with Profile(engine.queue) as taken:
        cla.zeros(other, 100, np.float32).fill(2)
    assert taken.launches == 0
    assert taken.table()


def test_runs_without_a_profile_keep_no_events(adapter, run, monkeypatch):
    taken, result = run
    assert not adapter.queue.properties & cl.command_queue_properties.PROFILING_ENABLE
    before = taken.launches, originals()
    assert not any(hook in before[1] for _, _, hook in _hooks._HOOKS)
    monkeypatch.setattr(Profile, "_add", None)  # would fail if anything called it
    again = adapter.run(BOX, 0.07, **SETTINGS)
    assert np.array_equal(again.points, result.points)  # and a profile does not change the result
    assert (taken.launches, originals()) == before


def test_hooks_are_removed_after_an_error(adapter):
    before = originals(), adapter.queue, adapter._stages
    with pytest.raises(InputError), Profile(adapter) as outer, Profile(adapter):
        adapter.run(BOX, -1.0)
    assert (originals(), adapter.queue, adapter._stages) == before
    assert outer.wall > 0


def test_callback_still_stops_the_run(adapter):
    with Profile(adapter) as taken:
        result = adapter.run(BOX, 0.07, **SETTINGS, callback=lambda row: row["step"] == 2)
    assert result.history["step"].max() == 2
    assert [s.step for s in taken.spans] == [0, 1, 2, None]


def test_open_profile_has_no_table(engine):
    with Profile(engine.queue) as taken:
        for figures in (taken.table, taken.as_dict):
            with pytest.raises(InputError, match="with"):
                figures()
    assert taken.table()


def test_bandwidth_is_plausible(ctx, monkeypatch):
    monkeypatch.setattr(profile, "LARGE", 32 << 20)
    # From an old single channel to more than any device of today has.
    assert 1e8 < copy_bandwidth(ctx, repeat=2) < 1e15


def test_table_agrees_with_the_profile(run):
    taken, _ = run
    stages, kernels, notes = taken.table().split("\n\n")
    rows = {line.split()[0]: line.split()[1:] for line in stages.splitlines()}
    assert set(rows) == {"stage", "host", "wall", *taken.stages()}
    assert int(rows["cells"][0]) == taken.stages()["cells"].calls
    milliseconds = {name: float(row[1]) for name, row in rows.items() if name in taken.stages()}
    # Each figure is rounded to 0.05 ms.
    assert sum(milliseconds.values()) == pytest.approx(1e3 * taken.device, abs=0.05 * len(rows))
    step = sum(s.stages["cells"] for s in taken.steps) / 5
    assert float(rows["cells"][-1]) == pytest.approx(1e3 * step, abs=0.006)
    assert float(rows["host"][0]) == pytest.approx(1e3 * taken.host, abs=0.06)
    _, *lines = (line.split() for line in kernels.splitlines())
    assert sum(int(line[-7]) for line in lines) == taken.launches
    assert "copy:" in notes


def test_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Kernels of a small share of the time are not listed apart: which those are, the machine's load decides.
    monkeypatch.setattr(profile, "SMALL", 0.0)
    options = "run paper --cells 90 --steps 3 --method coupled --no-report".split()
    assert cli.main([*options, "--json"]) == cli.OK
    assert "profile" not in json.loads(capsys.readouterr().out)
    assert cli.main([*options, "--json", "--profile"]) == cli.OK
    found = json.loads(capsys.readouterr().out)["profile"]
    kernels = sum(entry["seconds"] for entry in found["kernels"])
    assert kernels == pytest.approx(found["device"], rel=1e-12)
    assert sum(entry["share"] for entry in found["stages"]) == pytest.approx(
        1 - found["host"] / found["wall"], rel=1e-9
    )
    assert [span["step"] for span in found["spans"]] == [0, 1, 2, 3, None]
    assert found["bandwidth"] > 0
    assert cli.main([*options, "--profile"]) == cli.OK
    assert "cells.measure_cells" in capsys.readouterr().out
