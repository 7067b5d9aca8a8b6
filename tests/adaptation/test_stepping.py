"""Runs that go on step by step, show their mesh on the way, and follow other size fields."""

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.run import COMPLETED, UNDER_WAY
from clvoro.adaptation.state import MeshState
from clvoro.errors import InputError, SizeFieldError

FEW = {"effort": "fast", "seed": 4}
RUNS = {
    "2D": (clvoro.Box((0, 0), (1, 1)), "0.04 + 0.05*x", FEW),
    "3D": (clvoro.Box((0, 0, 0), (1, 1, 1)), "0.15 + 0.1*x", FEW),
    "polygon": (clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), "0.08 + 0.04*x", FEW),
    "sphere": (clvoro.Sphere(1.0), "0.2 + 0*x", FEW),
    "periodic": (clvoro.Box((0, 0), (1, 1), periodic=True), "0.05 + 0.01*sin(2*pi*x)", FEW),
    "transport": (clvoro.Box((0, 0), (1, 1)), "0.08 + 0.05*x", {**FEW, "method": "transport"}),
    "coupled": (clvoro.Box((0, 0), (1, 1)), "0.08 + 0.05*x", {"method": "coupled", "max_steps": 5}),
    "two levels": (
        clvoro.Box((0, 0), (1, 1)),
        "0.05 + 0.02*x",
        {**FEW, "options": clvoro.MultilevelOptions(levels=2), "n_cells": 280},
    ),
}


OF_BOXES = ("2D", "3D", "periodic")


def assert_same(a, b):
    for name in ("points", "target_size", "size_error", "quality", "origin"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    assert np.array_equal(a.diagram.neighbors, b.diagram.neighbors)
    assert np.array_equal(a.history["mean_error"], b.history["mean_error"])
    assert (a.stop_reason, a.settings, a.size_factor) == (b.stop_reason, b.settings, b.size_factor)


@pytest.mark.parametrize("kind", list(RUNS))
def test_stepped_runs_end_the_same(ctx, kind):
    """Even if they show their mesh on the way, and the adapter does other work between two steps."""
    domain, size, options = RUNS[kind]
    field, adapter = clvoro.sizing.Expression(size), clvoro.Adapter(ctx)
    whole = adapter.run(domain, field, **options)
    run, rows = adapter.start(domain, field, **options), 0
    while run.step():
        rows += 1
        assert len(run.history) == rows
        assert run.history["step"][-1] == run.steps
        if rows in (2, len(whole.history) - 1):
            now = run.mesh()
            assert now.check()
            assert (now.stop_reason, now.converged) == (UNDER_WAY, False)
            assert len(now.history) >= rows
            adapter.diagram(domain, now.points)
            if "n_cells" in options:
                assert len(now.points) == options["n_cells"]
    assert run.level == 0
    assert not run.step()
    assert run.finish() is run.mesh()
    assert_same(run.finish(), whole)


@pytest.mark.parametrize("kind", ["polygon", "sphere", *(pytest.param(k, marks=pytest.mark.slow) for k in OF_BOXES)])
def test_runs_follow_other_sizes(ctx, kind):
    """As runs from the points that are there, whether or not they have ended."""
    domain, size, options = RUNS[kind]
    field, adapter = clvoro.sizing.Expression(size), clvoro.Adapter(ctx)
    run = adapter.start(domain, field, **options)
    first = run.finish()
    run.follow(0.98 * field)
    assert run.stop_reason == ""
    second = run.finish()
    assert second.stop_reason == COMPLETED
    assert_same(second, adapter.run(domain, 0.98 * field, points=first.points, **options))
    run.follow(field)
    while run.steps < 2:
        run.step()
    points = run.mesh().points
    run.follow(0.97 * field)
    third = run.finish()
    assert third.check()
    assert len(points) > 0
    assert third.converged


def test_followed_sizes_are_checked(ctx):
    run = clvoro.Adapter(ctx).start(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
    run.step()
    with pytest.raises(SizeFieldError):
        run.follow(lambda x: 0.1 - x[:, 0])
    assert run.finish().converged, "it goes on with its own sizes"
    moving = clvoro.Adapter(ctx).start(clvoro.Box((0, 0), (1, 1)), 0.1, method="mmpde", max_steps=2)
    moving.finish()
    with pytest.raises(InputError, match="starts from a lattice of its own"):
        moving.follow(0.09)


def test_a_run_shows_its_start(ctx):
    """Before its first step, too."""
    run = clvoro.Adapter(ctx).start(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
    assert run.history.shape == (0,)
    assert run.step()
    assert run.mesh().history["step"].tolist() == [0]
    assert run.history["step"].tolist() == [0]


@pytest.mark.parametrize("at", [5, 9])
def test_a_run_goes_on_after_an_interrupted_step(adapter, monkeypatch, at):
    """Ctrl-C comes when the generators have changed, and their mesh is not there yet."""
    run = adapter.start(clvoro.Box((0, 0), (1, 1)), 0.06, "fast")
    update, calls = MeshState.update, []

    def interrupted(self, *args, **options):
        calls.append(None)
        if len(calls) == at:
            raise KeyboardInterrupt
        return update(self, *args, **options)

    monkeypatch.setattr(MeshState, "update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        sum(1 for _ in iter(run.step, False))
    shown, result = run.mesh(), run.finish()
    assert shown.check()
    assert result.check()
    assert (shown.stop_reason, result.stop_reason) == ("under way", "plan completed")
