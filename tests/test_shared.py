"""`clvoro.adapt` and `clvoro.voronoi`: one shared adapter for all callers."""

import inspect
import threading

import numpy as np
import pytest

import clvoro
from clvoro import shared as module
from clvoro.errors import DeviceError, InputError

BOX = clvoro.Box((0, 0), (1, 1))


def test_adapt_is_a_run():
    """With the same arguments in the same order."""
    of_adapt, of_run = (list(inspect.signature(f).parameters) for f in (clvoro.adapt, clvoro.Adapter.run))
    assert of_run[1:] == of_adapt
    mesh = clvoro.adapt(BOX, 0.2, "fast", seed=3)
    again = clvoro.Adapter().run(BOX, 0.2, effort="fast", seed=3)
    assert np.array_equal(mesh.points, again.points)
    assert mesh.settings == again.settings


def test_voronoi_is_a_diagram():
    points = np.random.default_rng(1).random((30, 2))
    assert np.array_equal(clvoro.voronoi(BOX, points).volumes, clvoro.Adapter().diagram(BOX, points).volumes)
    with pytest.raises(InputError, match="outside"):
        clvoro.voronoi(BOX, points + 1)


def test_threads_share_one_adapter(monkeypatch):
    """It is created once, however many ask for it at the same time; their calls do not mix."""
    made = []

    class Counted(clvoro.Adapter):
        def __init__(self, *given, **named):
            made.append(self)
            super().__init__(*given, **named)

    monkeypatch.setattr(module, "Adapter", Counted)
    monkeypatch.setattr(module, "_shared", None)
    begin, results = threading.Barrier(4), {}

    def work(k):
        begin.wait()
        results[k] = clvoro.adapt(BOX, 0.25 - 0.02 * k, "fast", seed=k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    for k, mesh in results.items():
        alone = clvoro.adapt(BOX, 0.25 - 0.02 * k, "fast", seed=k)
        assert np.array_equal(mesh.points, alone.points)
    with pytest.raises(InputError, match="a callback may not use it"):
        clvoro.adapt(BOX, 0.3, callback=lambda row: clvoro.adapt(BOX, 0.3))


def test_without_double_precision(monkeypatch):
    """The best device that there is, in single precision."""
    given = []

    def without(ctx=None, dtype="float64"):
        given.append(dtype)
        if dtype == "float64":
            raise DeviceError("no device computes in float64")
        return "the adapter"

    monkeypatch.setattr(module, "Adapter", without)
    monkeypatch.setattr(module, "_shared", None)
    assert module.shared_adapter() == "the adapter"
    assert given == ["float64", "float32"]
