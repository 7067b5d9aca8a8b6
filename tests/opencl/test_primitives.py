"""Scans, summaries and gathers agree with NumPy and exact sums, with work-groups of CPUs and of GPUs."""

import math

import numpy as np
import pytest

from clvoro.opencl.primitives import Gather, Lists, Scan, Summaries
from tests.reference import patch


@pytest.fixture(scope="module", params=[1, 128], ids=["cpu", "gpu"])
def group_size(request):
    return request.param


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request, group_size):
    return patch.make_engine(ctx, request.param, group_size=group_size)


@pytest.fixture(scope="module", params=[1, 32, 256])
def scan(ctx, request):
    return Scan(patch.make_engine(ctx, group_size=request.param))


@pytest.mark.sparse(11)
@pytest.mark.parametrize("n", [0, 1, 2, 7, 8, 9, 1000, 8192, 8193, 8200, 100003])
@pytest.mark.parametrize("first", [0, 5])
def test_scan(scan, n, first):
    values = np.random.default_rng(n + 31).integers(-50, 90, n + first + 3).astype(np.int32)
    device = scan.engine.upload(values, np.int32)
    out = scan.engine.upload(np.full(n + 3, -7), np.int32)
    scan.exclusive(device, out, n, first)
    expected = np.concatenate([[0], np.cumsum(values[first : first + n])])
    assert np.array_equal(out.get(), [*expected, -7, -7]), "or beyond n + 1 is written"
    assert np.array_equal(device.get(), values)


@pytest.mark.sparse(9)
@pytest.mark.parametrize("n", [1, 3, 1025, 4096, 50001])
def test_scan_in_place(scan, n):
    values = np.random.default_rng(n).integers(0, 5, n + 1).astype(np.int32)
    device = scan.engine.upload(values, np.int32)
    scan.exclusive(device, device, n)
    assert np.array_equal(device.get(), np.concatenate([[0], np.cumsum(values[:n])]))


@pytest.mark.sparse(8)
@pytest.mark.parametrize("n", [1, 2, 5, 129, 4096, 300007])
def test_summaries(engine, n):
    values = np.random.default_rng(n + 5).normal(0.01, 1, n).astype(engine.real)
    summaries = Summaries(engine, ("a", "b"))
    array = engine.upload(np.concatenate([values, [1e9]]))  # items after the first n are not read
    summaries.collect("b", array, n)
    summaries.collect("a", engine.upload(-values), n)
    a, b = (summaries.read()[name] for name in "ab")
    # Compensated sums: a few roundings of the result, and eps^2 of every term.
    eps = float(np.finfo(engine.real).eps)
    total, magnitude = math.fsum(values.tolist()), math.fsum(np.abs(values).tolist())
    assert b.sum == pytest.approx(total, abs=4 * eps * abs(total) + n * eps**2 * magnitude)
    assert b.magnitude == pytest.approx(magnitude, rel=4 * eps)
    assert (b.least, b.largest) == (values.min(), values.max())
    assert b.peak == np.abs(values).max()
    assert (a.sum, a.magnitude, a.least) == (-b.sum, b.magnitude, -b.largest)


@pytest.mark.sparse(4)
@pytest.mark.parametrize("count", [2, 7, 8])
def test_summaries_of_many_arrays_agree_with_single_ones(engine, count):
    n, rng = 3001, np.random.default_rng(count)
    arrays = {str(k): engine.upload(rng.normal(k, 1 + k, n + k)) for k in range(count)}
    together, alone = Summaries(engine, "76543210"), Summaries(engine, "01234567")
    together.collect_all(arrays, n)
    for name, array in arrays.items():
        alone.collect(name, array, n)
    found, expected = together.read(), alone.read()
    assert {name: found[name] for name in arrays} == {name: expected[name] for name in arrays}
    assert len({expected[name].sum for name in arrays}) == count


def test_summaries_are_read_together_with_integers(engine):
    """Slots keep their values until they are collected again. A slot that was never collected holds zeros."""
    rng, n = np.random.default_rng(8), 500
    arrays = {name: rng.normal(size=n).astype(engine.real) for name in "abc"}
    summaries, notes = (Summaries(engine, "zabc"), [engine.upload(k, np.int32) for k in ([-7], [5, 4])])
    for name, array in arrays.items():
        summaries.collect(name, engine.upload(array), n)
        assert summaries.read_one(name).largest == array.max()
    summaries.collect("b", engine.upload(2 * arrays["b"]), n)
    values = summaries.values.get()
    assert summaries.read_with(*notes) == [-7, 5, 4]
    assert summaries.read_with(notes[1]) == [5, 4]
    found = summaries.read()
    assert found["z"] == (0, 0, 0, 0)
    for name, factor in (("a", 1), ("b", 2), ("c", 1)):
        assert found[name].least == factor * arrays[name].min()
        assert found[name].largest == factor * arrays[name].max()
    assert np.array_equal(values, [found[name] for name in "zabc"])
    # Restored slots have their old values, also after later collections.
    summaries.collect("c", engine.upload(np.full(n, 9.0)), n)
    summaries.values.set(values)
    assert summaries.read() == found


def test_summaries_are_compensated(engine):
    """Large terms cancel; a plain sum would lose the small ones."""
    n = 200001
    values = np.full(n, 0.1, engine.real)
    large = engine.real.type(1e3 / np.finfo(engine.real).eps)
    values[: n // 2 : 2], values[1 : n // 2 : 2] = large, -large
    summaries = Summaries(engine, ("a",))
    summaries.collect("a", engine.upload(values), n)
    expected = math.fsum(values.tolist())
    assert expected == pytest.approx(0.1 * (n - n // 2), rel=1e-6)
    assert summaries.read()["a"].sum == pytest.approx(expected, rel=1e-6)


def test_summaries_repeat_bit_by_bit(engine):
    values = engine.upload(np.random.default_rng(17).normal(size=77777))
    summaries = Summaries(engine, ("a", "b"))
    summaries.collect("a", values, 77777)
    summaries.collect("b", values, 77777)
    assert summaries.read()["a"] == summaries.read()["b"]


@pytest.mark.sparse(12)
@pytest.mark.parametrize("n", [1, 7, 8, 5000])
@pytest.mark.parametrize("dim", [2, 3])
def test_lengths(ctx, engine, dim, n):
    """Lengths are summarized as if they had been computed before, to the last bit."""
    engine = patch.make_engine(ctx, engine.real, group_size=engine.group_size, dim=dim)
    rng = np.random.default_rng(n)
    u, v = rng.normal(size=(2, n, dim)).astype(engine.real)
    h = rng.uniform(0.1, 2, n).astype(engine.real)
    summaries, expected = Summaries(engine, "abc"), Summaries(engine, "abc")
    lengths = dict(zip("ca", map(engine.upload, (u, v)), strict=True))
    summaries.collect_all(lengths, len(h), engine.upload(h))
    for name, w in (("c", u), ("a", v)):
        square = w[:, 0] * w[:, 0] + w[:, 1] * w[:, 1]
        lengths = np.sqrt(square + w[:, 2] * w[:, 2] if dim == 3 else square) / h
        expected.collect(name, engine.upload(lengths), n)
    assert summaries.read() == expected.read()


def test_summary_shows_nan_and_infinity(engine):
    values = np.ones(1000)
    values[613] = np.nan
    summaries = Summaries(engine, ("a",))
    summaries.collect("a", engine.upload(values), 1000)
    assert math.isnan(summaries.read()["a"].sum)


@pytest.mark.sparse(12)
@pytest.mark.parametrize("dtype", [np.int32, np.float32, np.float64, np.uint64])
@pytest.mark.parametrize("width", [None, 2, 3])
def test_gather(scan, dtype, width):
    rng = np.random.default_rng(91)
    shape = (500,) if width is None else (500, width)
    array = rng.integers(0, 2**31, shape).astype(dtype)
    items = rng.integers(0, 500, 777).astype(np.int32)
    engine = scan.engine
    out = Gather(engine).rows(engine.upload(items, np.int32), engine.upload(array, dtype))
    assert out.dtype == dtype
    assert np.array_equal(out.get(), array[items])


@pytest.mark.sparse(12)
@pytest.mark.parametrize("dtype", [np.int32, np.float32, np.float64])
@pytest.mark.parametrize("width", [None, 2])
@pytest.mark.parametrize("n", [1, 300])
def test_gather_lists(scan, dtype, width, n):
    rng = np.random.default_rng(7 + n)
    counts, order = rng.integers(0, 9, n), rng.permutation(n)
    starts = np.concatenate([[0], np.cumsum(counts)])
    to = np.concatenate([[0], np.cumsum(counts[order])])
    items = rng.integers(-5, n, (starts[-1],) if width is None else (starts[-1], width))
    places = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in order])
    engine = scan.engine
    lists = Lists(*(engine.upload(a, np.int32) for a in (order, starts, to)))
    found = Gather(engine).lists(lists, engine.upload(items, dtype))
    assert found.dtype == dtype
    assert np.array_equal(found.get(), items[places].astype(dtype))
    if dtype == np.int32 and width is None:
        names = rng.permutation(n)
        renamed = Gather(engine).lists(lists, engine.upload(items, dtype), engine.upload(names, dtype))
        assert np.array_equal(renamed.get(), np.where(items >= 0, names[np.maximum(items, 0)], items)[places])
