"""Launches of many work-items in ranges, as on GPUs that a system interrupts."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import engine, ranges
from clvoro.opencl.engine import Engine
from clvoro.solvers import poisson
from tests.robustness.test_concurrency import LARGE, WORK, digest

SOURCE = """
kernel void count(const int size, global int *times, global int *last)
{
    const int i = get_global_id(0);
    if (i >= size)
        return;
    times[i] += 1;
    if (i == size - 1)
        *last = i;
}
"""


@pytest.fixture(autouse=True)
def limits(monkeypatch):
    """The limits of devices, where the whole suite runs with others."""
    monkeypatch.setattr(ranges, "FIRST", 1 << 16)
    monkeypatch.setattr(ranges, "LONGEST", 0.2)


@pytest.fixture
def clock(monkeypatch):
    """A clock whose ranges take 1 ms for each thousand items, and the launches: begin and size."""
    monkeypatch.setattr(engine.ranges, "may_be_interrupted", lambda _: True)
    launches, now, plain = [], [0.0], cl.enqueue_nd_range_kernel

    def noted(queue, kernel, size, group, offset=(0,)):
        launches.append((offset[0], size[0]))
        now[0] += 1e-6 * size[0]
        return plain(queue, kernel, size, group, offset)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", noted)
    monkeypatch.setattr(ranges.time, "perf_counter", lambda: now[0])
    return launches


def test_ranges_cover_all_items_once(ctx, clock):
    """The first range is small. The next ones take 0.2 s, and later launches are not divided if they take less."""
    on_device = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))
    kernel = cl.Kernel(cl.Program(ctx, SOURCE).build(), "count")
    times, last = on_device.zeros(700_000, np.int32), on_device.zeros(1, np.int32)
    for n, expected in (
        (65_536, [(0, 65_536)]),
        (650_001, [(0, 65_536), (65_536, 200_000), (265_536, 200_000), (465_536, 184_512)]),
        (199_990, [(0, 200_000)]),
    ):
        clock.clear()
        times.fill(0)
        on_device.run_each(kernel, n, times, last)
        assert (times.get()[:n] == 1).all()
        assert int(last.get()[0]) == n - 1
        assert clock == expected


def test_ranges_grow_after_a_slow_first_one():
    """It may have included the compilation of the kernel."""
    limit = ranges.Range()
    limit.learn(65_536, 6.5536)
    assert limit.items == pytest.approx(2000)
    limit.learn(2000, 1e-5)
    assert limit.items == 16_000


def test_only_gpus_are_interrupted(ctx):
    class Device:
        type = cl.device_type.GPU

    assert ranges.may_be_interrupted(Device)
    Device.type |= cl.device_type.CPU  # a simulator
    assert not ranges.may_be_interrupted(Device)


QUICK = {"coupled": (0.05, WORK[0]), "exact number": (0.1, WORK[2])}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["plane", *(pytest.param(name, marks=pytest.mark.slow) for name in (*QUICK, *LARGE) if name != "plane")]
)
def test_ranges_change_no_bit(ctx, monkeypatch, name):
    """Runs of all kinds, in ranges of one to many groups: kernels do not depend on the number of a group."""
    if name in QUICK:
        domain, real = clvoro.Box((0, 0), (2.5, 1.5)), "float64"
        size, options = QUICK[name]
    else:
        domain, size, options, real = LARGE[name]
        size, options = clvoro.sizing.Expression(f"2 * ({size})"), {**options, "seed": 7}
    monkeypatch.setattr(poisson, "expected_costs", lambda *_: (2.0, 1.0))
    whole = digest(clvoro.Adapter(ctx, real).run(domain, size, **options))
    count, plain = [0], ranges.enqueue_ranges

    def few(queue, kernel, items, group, limit):
        limit.items, limit.known = group * (1 + items // group // 3), True
        count[0] += 1
        return plain(queue, kernel, items, group, limit)

    monkeypatch.setattr(engine.ranges, "may_be_interrupted", lambda _: True)
    monkeypatch.setattr(engine, "enqueue_ranges", few)
    assert digest(clvoro.Adapter(ctx, real).run(domain, size, **options)) == whole
    assert count[0] > 200
