"""Arguments of kernels are set only when they have changed, and arrays are not kept in memory for the comparison."""

import sys

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import engine as engines
from clvoro.opencl import kernels
from clvoro.opencl.engine import Engine
from clvoro.opencl.kernels import bind
from clvoro.opencl.launch import Launch
from clvoro.opencl.primitives import Gather, Summaries
from clvoro.solvers import poisson

SOURCE = """
kernel void put(const int n, const double x, const int2 shift, global const double *from, global double *to)
{
    const int i = get_global_id(0);
    if (i < n) to[i] = from[i] + shift.s0 + 10 * shift.s1 + (signbit(x) ? -1000 : x);
}
"""


@pytest.fixture
def settings(monkeypatch):
    """The numbers of the arguments that each call of `set_changed` sets."""
    plain, calls = kernels.set_changed, []

    def noted(kernel, args, changed):
        calls.append(list(changed))
        plain(kernel, args, changed)

    monkeypatch.setattr(kernels, "set_changed", noted)
    return calls


@pytest.fixture
def kernel(engine):
    return cl.Kernel(cl.Program(engine.ctx, SOURCE).build(), "put")


def put(engine, kernel, source, to, x=0.0, shift=(0, 0), n=4):
    arguments = np.float64(x), np.array(shift, np.int32), source, to
    engine.run_each(kernel, n, *arguments)


def test_changed_arguments_are_set(engine, kernel, settings):
    """Each argument changes in turn: numbers, the sign of zero, vectors, arrays, views."""
    source = engine.upload(np.arange(8.0))
    first, second = engine.zeros(8), engine.zeros(8)
    cases = [
        ({}, 0),
        ({"x": 0.5}, 0.5),
        ({"x": -0.0}, -1000),
        ({"x": 0.0}, 0),
        ({"shift": (1, 2)}, 21),
        ({"shift": (2, 1)}, 12),
        ({"n": 3}, 0),
        ({"n": 4}, 0),
    ]
    for to in (first, second, first[:5], second[:4], first):
        for how, more in cases:
            to.fill(-5)
            put(engine, kernel, source, to, **how)
            n = how.get("n", 4)
            assert to.get()[:n] == pytest.approx(np.arange(8.0)[:n] + more, abs=0)
            assert (to.get()[n:] == -5).all()
    # At first all; then those that have changed, of which there are at most two: one is reset.
    assert settings[0] == list(range(5))
    assert {k for changed in settings[1:] for k in changed} == {0, 1, 2, 4}
    assert all(1 <= len(changed) <= 3 for changed in settings[1:])


def test_unchanged_arguments_are_not_set(engine, kernel, settings):
    source, to = engine.upload(np.arange(8.0)), engine.zeros(8)
    for turn in range(9):
        to.fill(0)
        # Views of the first rows, and numbers of other objects, are the same arguments.
        put(engine, kernel, source[:6], to, 0.25 + 0 * turn, (3, 0))
        assert to.get()[:4].tolist() == [3.25, 4.25, 5.25, 6.25]
    assert settings == [list(range(5))]
    tail = to[2:]
    with pytest.raises(cl.array.ArrayHasOffsetError):
        put(engine, kernel, source, tail)
    put(engine, kernel, source, to)
    assert len(settings) == 3
    assert settings[-1] == list(range(5))


def test_a_wrong_number_of_arguments_is_an_error(engine, kernel):
    with pytest.raises(TypeError, match="got 4 arguments, expected 5"):
        bind(kernel, (4, np.float64(0), np.zeros(2, np.int32), engine.zeros(8)))


def test_arguments_do_not_keep_arrays(engine, kernel):
    """A new array, probably at the address of one that was freed, is another argument."""
    for turn in range(20):
        source, to = engine.upload(np.full(8, float(turn))), engine.zeros(8)
        held = sys.getrefcount(to.base_data), sys.getrefcount(to)
        put(engine, kernel, source, to)
        assert held == (sys.getrefcount(to.base_data), sys.getrefcount(to))
        assert (to.get()[:4] == turn).all()


def test_launch_alternates_with_other_launches(engine):
    """Each sets its arguments again where the other one has changed them."""
    text = "kernel void put(const int k, global int *to) { to[get_global_id(0)] = k; }"
    kernel = cl.Kernel(cl.Program(engine.ctx, text).build(), "put")
    to = engine.zeros(engine.groups * engine.group_size, np.int32)
    launches = [Launch(engine, kernel, k, to) for k in (3, 4)]
    for _ in range(3):
        for k, launch in enumerate(launches, start=3):
            launch()
            assert (to.get() == k).all()
        engine.run_blocks(kernel, np.int32(7), to)
        assert (to.get() == 7).all()


def test_groups_are_as_small_as_the_device_requires(ctx, monkeypatch):
    """A block-wise kernel that needs too many registers is built for smaller groups; its sum stays right."""
    monkeypatch.setattr(engines, "group_sizes", lambda _: engines.GroupSizes(5, 32))
    limits = {"summarize_blocks": 13, "combine_blocks": 1, "gather_rows": 24}
    monkeypatch.setattr(kernels, "group_limit", lambda k: limits.get(k.function_name, 4096))
    launched, plain = {}, cl.enqueue_nd_range_kernel

    def noted(queue, kernel, size, group, *args, **options):
        launched[kernel.function_name] = size[0], group[0]
        return plain(queue, kernel, size, group, *args, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", noted)
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))
    values = np.arange(1.0, 1001.0)
    summaries, array = Summaries(engine, ["x"]), engine.upload(values)
    summaries.collect("x", array, 1000)
    summary = summaries.read_one("x")
    assert (summary.sum, summary.least, summary.largest) == (500500.0, 1.0, 1000.0)
    order = np.arange(999, -1, -3, dtype=np.int32)
    rows = Gather(engine).rows(engine.upload(order, np.int32), array)
    assert (rows.get() == values[order]).all()
    assert launched["summarize_blocks"] == (5 * 8, 8)
    assert launched["combine_blocks"][1] == 1
    assert launched["gather_rows"] == (336, 16)


@pytest.mark.slow
def test_coarse_levels_take_smaller_groups(ctx, monkeypatch):
    """Multigrid does coarse levels in one group each; some of its kernels are limited to groups of 8."""
    monkeypatch.setattr(engines, "group_sizes", lambda _: engines.GroupSizes(5, 32))
    names = "cycle_by_group", "smooth_pairs"
    monkeypatch.setattr(kernels, "group_limit", lambda k: 8 if k.function_name in names else 4096)
    monkeypatch.setattr(poisson, "expected_costs", lambda *_: (1.0, 0.5))
    launched, plain = {}, cl.enqueue_nd_range_kernel

    def noted(queue, kernel, size, group, *args, **options):
        launched[kernel.function_name] = kernel.stage, size[0], group[0]
        return plain(queue, kernel, size, group, *args, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", noted)
    adapter = clvoro.Adapter(ctx)
    method = {"method": "coupled", "max_steps": 2, "options": clvoro.PaperOptions(tol=0)}
    result = adapter.run(clvoro.Box((0, 0), (1, 1)), 0.02, seed=1, **method)
    assert result.diagram.volumes.sum() == pytest.approx(1)
    assert np.abs(result.size_error).max() < 1
    of_one_group = {group for stage, size, group in launched.values() if stage == "multigrid" and size == group}
    assert of_one_group == {8, 32}
