"""From one mesh to the next: a field that has moved a little takes a few steps, anything else the whole way."""

import numpy as np
import pytest

import clvoro
from clvoro import Box, sizing
from clvoro.adaptation.plan.efforts import EFFORTS, is_near
from clvoro.adaptation.plan.schedule import adaptive_schedule, n_steps

BOXES = {2: Box((0, 0), (1, 0.8)), 3: Box((0, 0, 0), (1, 0.8, 0.7))}
FITTED = {n: n_steps(adaptive_schedule(2, "default", 0, False, begins="mesh", most=n)) for n in (None, 40)}
SHORT = {dim: len(adaptive_schedule(dim, "default", 0, False, begins="near")) for dim in (2, 3)}


def field(dim, moved=0.0, factor=1.0, h_min=0.01):
    if dim == 2:
        return sizing.Distance(sizing.Circle((0.4 + moved, 0.4), 0.2), h_min=h_min, slope=0.1) * factor
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
def test_moved_again_and_again(adapter, method):
    """With 3500 cells: those of `first` are too few for shapes to recover from moves by two cells that follow."""
    begin = adapter.run(BOXES[2], field(2, h_min=0.006), seed=4)
    points = begin.points
    for k in range(1, 5):
        result = adapter.run(BOXES[2], field(2, 0.012 * k, h_min=0.006), points=points, method=method)
        points = result.points
        assert steps_to_tolerance(result.history) <= 5
    # The exact projection alone costs about 0.002 (compare default and exact in bench/convergence.py).
    lost = 0.004 if method == "adaptive" else 0.006
    assert result.quality.mean() > begin.quality.mean() - lost
    if method == "exact":
        assert np.abs(result.size_error).max() < 0.002


def test_same_field_again_keeps_the_mesh(adapter, first):
    result = adapter.run(BOXES[2], field(2), points=first[2].points)
    moved = np.linalg.norm(result.points - first[2].points, axis=1) / first[2].target_size
    assert np.median(moved) < 0.1
    assert (result.origin >= 0).all()
    assert np.abs(result.size_error).mean() <= 0.004


def test_other_points_take_the_full_schedule(adapter, first):
    """Random points, and a good mesh with another number of cells. Fewer steps leave out sweeps, not the last steps."""
    box, n = BOXES[2], len(first[2].points)
    random = box.lower + box.extent * np.random.default_rng(553).random((n, 2))
    for points, size in ((random, field(2)), (first[2].points, field(2, factor=0.9))):
        result = adapter.run(box, size, points=points, max_steps=40)
        assert result.history["step"][-1] == FITTED[40]
        assert result.stop_reason == "plan completed"
        assert np.abs(result.size_error).mean() < 0.01


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
    all_steps = clvoro.MultilevelOptions(correct=False)
    more = adapter.run(box, 0.1, "fast", points=mesh.points, options=all_steps, max_steps=60)
    assert more.settings["path"].startswith("the given mesh is near, and all steps were taken (mean |e| 0.0")
    assert near.summary()["steps"] < more.summary()["steps"] <= 60


FAR_BOX = clvoro.Box((0, 0), (4, 1))


def far_field(x):
    return sizing.Distance(sizing.Circle((x, 0.5), 0.1), 0.03, slope=0.3, h_max=0.3)


def test_points_far_from_the_sizes_are_replaced(ctx, tmp_path):
    """The fine cells are elsewhere. Points between them, which have about the right number, stay."""
    adapter, state = clvoro.Adapter(ctx), tmp_path / "state"
    points = adapter.run(FAR_BOX, far_field(0.5), "fast").points
    new = adapter.run(FAR_BOX, far_field(3.5), "fast")
    every = {"points": points, "checkpoint": clvoro.Checkpoint(state, every=0)}
    whole = adapter.run(FAR_BOX, far_field(3.5), "fast", **every)
    adapter.run(FAR_BOX, far_field(3.5), "fast", callback=lambda row: row["step"] == 6, **every)
    rest = adapter.run(FAR_BOX, far_field(3.5), "fast", points=points, checkpoint=clvoro.Checkpoint(resume=state))
    assert np.abs(whole.size_error).mean() < 1.5 * np.abs(new.size_error).mean()
    assert whole.quality.mean() > new.quality.mean() - 0.01
    assert whole.history["mean_error"][0] < 0.5
    kept = whole.origin >= 0
    # Those around the old circle are not there any more, and those far from both have hardly moved.
    assert (np.linalg.norm(points[whole.origin[kept]] - [0.5, 0.5], axis=1) > 0.1).mean() > 0.9
    assert 0.05 < kept.mean() < 0.6
    moved = np.linalg.norm(whole.points[kept] - points[whole.origin[kept]], axis=1) / whole.target_size[kept]
    assert np.median(moved) < 2
    for result in (whole, rest):
        np.testing.assert_array_equal(result.points, whole.points)
        np.testing.assert_array_equal(result.origin, whole.origin)
        assert "of the given points are far from the sizes, and were replaced" in result.settings["path"]
        assert result.settings["start"] == "points"


def test_points_beside_layers_keep_their_numbers(ctx):
    """`origin` counts the points of the caller, among which are those of layers. These are placed anew."""
    adapter, layers = clvoro.Adapter(ctx), [clvoro.Layers(0.02, count=2)]
    mesh = adapter.run(FAR_BOX, 0.1, "fast", layers=layers)
    again = adapter.run(FAR_BOX, 0.1, "fast", points=mesh.points, layers=layers)
    kept = again.origin >= 0
    assert 0.4 < kept.mean() < 0.9
    moved = np.linalg.norm(again.points[kept] - mesh.points[again.origin[kept]], axis=1)
    assert np.median(moved) < 0.02
    assert again.settings["path"].startswith("the given mesh is near")


def test_levels_that_are_given_keep_all_points(ctx):
    adapter = clvoro.Adapter(ctx)
    points = adapter.run(FAR_BOX, far_field(0.5), "fast").points
    one = clvoro.MultilevelOptions(levels=0)
    kept = adapter.run(FAR_BOX, far_field(3.5), "fast", points=points, options=one, max_steps=2)
    assert (kept.origin >= 0).mean() > 0.9
    # Without them, points in a corner are all replaced, and the mesh is that of a run without points.
    corner = 0.01 + 0.05 * np.random.default_rng(4).random((300, 2))
    again, new = (adapter.run(FAR_BOX, far_field(3.5), "fast", points=x) for x in (corner, None))
    np.testing.assert_array_equal(again.points, new.points)
    assert (again.origin == -1).all()
    assert again.settings["path"].startswith("the given points are all far from the sizes, and were replaced")


def test_a_front_that_moves_far_keeps_its_quality(ctx):
    """Of a front that moves by many widths again and again, each mesh is as good as the first one after 21 steps."""
    adapter = clvoro.Adapter(ctx)
    run = adapter.start(FAR_BOX, far_field(0.5), "fast", max_steps=21)
    first = adapter.run(FAR_BOX, far_field(0.5), "fast")
    for x in (1.2, 2.4, 3.6):
        run.finish()
        run.follow(far_field(x))
        after = run.finish()
        assert int(after.history["step"][-1]) <= 21
        assert np.abs(after.size_error).mean() < 0.01
        assert after.quality.mean() > first.quality.mean() - 0.025
