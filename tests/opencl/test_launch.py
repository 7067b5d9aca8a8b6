"""Arguments of kernels are set only when they have changed, and arrays are not kept in memory for the comparison."""

import sys

import numpy as np
import pyopencl as cl
import pytest

from clvoro.opencl.engine import Engine
from clvoro.opencl.kernels import bind
from clvoro.opencl.launch import Launch

SOURCE = """
kernel void put(const int n, const double x, const int2 shift, global const double *from, global double *to)
{
    const int i = get_global_id(0);
    if (i < n) to[i] = from[i] + shift.s0 + 10 * shift.s1 + (signbit(x) ? -1000 : x);
}
"""


@pytest.fixture
def engine(ctx):
    return Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))


@pytest.fixture
def settings(monkeypatch):
    """The calls of `set_args`."""
    plain, calls = cl.Kernel.set_args, []

    def noted(kernel, *args):
        calls.append(args)
        plain(kernel, *args)

    monkeypatch.setattr(cl.Kernel, "set_args", noted)
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
        ({}, 0), ({"x": 0.5}, 0.5), ({"x": -0.0}, -1000), ({"x": 0.0}, 0), ({"shift": (1, 2)}, 21),
        ({"shift": (2, 1)}, 12), ({"n": 3}, 0), ({"n": 4}, 0),
    ]  # fmt: skip
    for to in (first, second, first[:5], second[:4], first):
        for how, more in cases:
            to.fill(-5)
            put(engine, kernel, source, to, **how)
            n = how.get("n", 4)
            assert to.get()[:n] == pytest.approx(np.arange(8.0)[:n] + more, abs=0)
            assert (to.get()[n:] == -5).all()
    assert len(settings) >= 5 * len(cases) - 4


def test_unchanged_arguments_are_not_set(engine, kernel, settings):
    source, to = engine.upload(np.arange(8.0)), engine.zeros(8)
    for turn in range(9):
        to.fill(0)
        # Views of the first rows, and numbers of other objects, are the same arguments.
        put(engine, kernel, source[:6], to, 0.25 + 0 * turn, (3, 0))
        assert to.get()[:4].tolist() == [3.25, 4.25, 5.25, 6.25]
    assert len(settings) == 1
    tail = to[2:]
    with pytest.raises(cl.array.ArrayHasOffsetError):
        put(engine, kernel, source, tail)
    put(engine, kernel, source, to)
    assert len(settings) == 2


def test_arguments_do_not_keep_arrays(engine, kernel):
    """A new array, probably at the address of one that was freed, is another argument."""
    for turn in range(20):
        source, to = engine.upload(np.full(8, float(turn))), engine.zeros(8)
        held = sys.getrefcount(to.base_data), sys.getrefcount(to)
        put(engine, kernel, source, to)
        assert held == (sys.getrefcount(to.base_data), sys.getrefcount(to))
        assert (to.get()[:4] == turn).all()


def test_launch_alternates_with_other_launches(engine):
    text = "kernel void put(const int k, global int *to) { to[get_global_id(0)] = k; }"
    kernel = cl.Kernel(cl.Program(engine.ctx, text).build(), "put")
    to = engine.zeros(engine.groups * engine.group_size, np.int32)
    for _ in range(3):
        launch = Launch(engine, kernel, np.int32(7), to)
        launch()
        assert (to.get() == 7).all()
        for k in range(5):
            launch.set_first(k)
            launch()
            assert (to.get() == k).all()
        # The same arguments as those of the launch before its first one was changed.
        bind(kernel, (np.int32(7), to))
        engine.run_blocks(kernel, np.int32(7), to)
        assert (to.get() == 7).all()
