"""From one mesh to the next: a field that has moved a little takes a few steps, anything else the whole way."""

import numpy as np
import pytest

import clvoro
from clvoro import Box, sizing
from clvoro.adaptation.plan.efforts import EFFORTS, is_near
from clvoro.adaptation.plan.schedule import adaptive_schedule

BOXES = {2: Box((0, 0), (1, 0.8)), 3: Box((0, 0, 0), (1, 0.8, 0.7))}
SHORT = {dim: len(adaptive_schedule(dim, "default", 0, False, warm=True, near=True)) for dim in (2, 3)}


def field(dim, moved=0.0, factor=1.0):
    if dim == 2:
        return sizing.Distance(sizing.Circle((0.4 + moved, 0.4), 0.2), h_min=0.01, slope=0.1) * factor
    return sizing.Distance(sizing.Ball((0.4 + moved, 0.4, 0.35), 0.2), h_min=0.05, slope=0.15) * factor


class ByDimension(dict):
    """Makes a mesh when its dimension is first looked up."""

    def __init__(self, make):
        self.make = make

    def __missing__(self, dim):
        self[dim] = self.make(dim)
        return self[dim]


@pytest.fixture(scope="module")
def first(adapter):
    return ByDimension(lambda dim: adapter.run(BOXES[dim], field(dim), seed=4))


def steps_to_tolerance(history):
    within = (history["mean_error"] <= 0.004) & (history["max_error"] <= 0.04)
    return int(history["step"][np.argmax(within)]) if within.any() else None


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dim", [2, 3])
def test_moved_by_two_cells(adapter, first, dim):
    before = first[dim]
    smallest = {2: 0.01, 3: 0.05}[dim]
    after = adapter.run(BOXES[dim], field(dim, 2 * smallest), points=before.points)
    assert after.history["mean_error"][0] > 0.02
    assert steps_to_tolerance(after.history) <= 5
    assert after.history["step"][-1] < SHORT[dim]
    assert np.abs(after.size_error).mean() <= 0.004
    assert np.abs(after.size_error).max() <= 0.04
    assert after.quality.mean() > before.quality.mean() - 0.005
    assert after.converged


@pytest.mark.slow
@pytest.mark.parametrize("method", ["adaptive", "exact"])
def test_moved_again_and_again(adapter, first, method):
    points = first[2].points
    for k in range(1, 5):
        result = adapter.run(BOXES[2], field(2, 0.02 * k), points=points, method=method)
        points = result.points
        assert steps_to_tolerance(result.history) <= 5
    # The exact projection alone costs about 0.002 (compare default and exact in bench/convergence.py).
    lost = 0.004 if method == "adaptive" else 0.006
    assert result.quality.mean() > first[2].quality.mean() - lost
    if method == "exact":
        assert np.abs(result.size_error).max() < 0.002


def test_same_field_again_keeps_the_mesh(adapter, first):
    result = adapter.run(BOXES[2], field(2), points=first[2].points)
    moved = np.linalg.norm(result.points - first[2].points, axis=1) / first[2].target_size
    assert np.median(moved) < 0.1
    assert (result.origin >= 0).all()
    assert np.abs(result.size_error).mean() <= 0.004


def test_other_points_take_the_full_schedule(adapter, first):
    """Random points, and a good mesh with another number of cells."""
    n = len(first[2].points)
    box = BOXES[2]
    random = box.lower + box.extent * np.random.default_rng(553).random((n, 2))
    for points, size in ((random, field(2)), (first[2].points, field(2, factor=0.9))):
        result = adapter.run(box, size, points=points, max_steps=SHORT[2] + 5)
        assert result.history["step"][-1] == SHORT[2] + 5


def test_held_count(adapter, first):
    n = len(first[2].points) + 6
    result = adapter.run(BOXES[2], field(2, 0.02), points=first[2].points, n_cells=n)
    assert len(result.points) == n
    assert result.history["step"][-1] < SHORT[2]
    assert steps_to_tolerance(result.history) <= 6


def test_resumes_bit_for_bit(adapter, first, tmp_path):
    path, size, points = tmp_path / "state", field(2, 0.02), first[2].points
    every = {"checkpoint": clvoro.Checkpoint(path, every=0)}
    whole = adapter.run(BOXES[2], size, points=points, **every)
    adapter.run(BOXES[2], size, points=points, callback=lambda row: row["step"] == 6, **every)
    rest = adapter.run(BOXES[2], size, points=points, checkpoint=clvoro.Checkpoint(resume=path))
    np.testing.assert_array_equal(rest.points, whole.points)
    np.testing.assert_array_equal(rest.history["mean_error"], whole.history["mean_error"])


def test_near_by_every_measure():
    near = {"n": 10_000, "missing": 50.0, "mean_error": 0.1, "mean_quality": 0.99}
    assert is_near(2, "default", **near)
    assert is_near(3, "default", **{**near, "mean_quality": 0.68})
    for name, value in (("missing", -300.0), ("mean_error", 0.2), ("mean_quality", 0.95)):
        assert not is_near(2, "default", **{**near, name: value})
    assert not is_near(3, "default", **{**near, "mean_quality": 0.55})
    # A mesh of effort fast is good enough for fast, not for best.
    assert is_near(2, "fast", **{**near, "mean_quality": 0.98})
    assert not is_near(2, "best", **{**near, "mean_quality": 0.98})
    assert set(EFFORTS) == {"fast", "default", "best"}


def test_the_result_says_whether_it_was_corrected_and_why(ctx):
    box, adapter = clvoro.Box((0, 0), (1, 1)), clvoro.Adapter(ctx)
    mesh = adapter.run(box, 0.1, "fast")
    assert mesh.summary()["path"] is None
    near, far = (adapter.run(box, h, "fast", points=mesh.points) for h in (0.1, 0.085))
    assert near.settings["path"].startswith("the given mesh is near and only corrected (mean |e| 0.0")
    assert far.summary()["path"].startswith("the given mesh is not near, and all steps were taken (mean |e| 0.")
    assert near.summary()["steps"] < far.summary()["steps"]


def test_a_mesh_far_from_the_sizes_is_replaced(ctx, tmp_path):
    """Its fine cells are elsewhere: there is no path on one level from them to good cells of the right sizes."""
    box, adapter, state = clvoro.Box((0, 0), (4, 1)), clvoro.Adapter(ctx), tmp_path / "state"
    there, here = (sizing.Distance(sizing.Circle((x, 0.5), 0.1), 0.03, slope=0.3, h_max=0.3) for x in (0.5, 3.5))
    points = adapter.run(box, there, "fast").points
    one = clvoro.MultilevelOptions(levels=0)
    new, kept = adapter.run(box, here, "fast"), adapter.run(box, here, "fast", points=points, options=one)
    every = {"points": points, "checkpoint": clvoro.Checkpoint(state, every=0)}
    whole = adapter.run(box, here, "fast", **every)
    adapter.run(box, here, "fast", callback=lambda row: row["step"] == 6, **every)
    rest = adapter.run(box, here, "fast", points=points, checkpoint=clvoro.Checkpoint(resume=state))
    assert (kept.origin >= 0).any()
    assert np.abs(whole.size_error).mean() < 2 * np.abs(new.size_error).mean()
    for result in (whole, rest):
        np.testing.assert_array_equal(result.points, whole.points)
        assert result.settings["path"].startswith("the given mesh is far from the sizes, and a new one was made")
        assert result.settings["start"] == "density"
        assert (result.origin == -1).all()
