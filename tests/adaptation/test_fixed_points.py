"""Fixed generators stay at the caller's positions, and their cells and those beside them have sizes and shapes."""

import re
import warnings

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.adaptation import run as run_module
from clvoro.adaptation.fixed_points import check_fixed, take_places
from clvoro.errors import InputError, InputTypeError, MismatchWarning

BOX = clvoro.Box((0, 0), (2, 1))
L_SHAPE = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 0.5), (0, 0.5)])
BANK = clvoro.Layers(0.03, 2, 1.2, spacing=0.06, edges=[0])
DEEP = clvoro.MultilevelOptions(levels=1)
WELLS = [(0.3, 0.2), (1.2, 0.6), (1.7, 0.31), (1.777, 0.35)]
RUNS = {
    "box": (BOX, 0.06, WELLS, {"effort": "default"}),
    "levels": (BOX, 0.06, WELLS, {"options": DEEP}),
    "exact": (BOX, 0.06, WELLS, {"method": "exact", "n_cells": 500}),
    "periodic": (clvoro.Box((0, 0), (2, 1), (True, False)), 0.06, [*WELLS, (0.0, 0.5)], {}),
    "polygon": (L_SHAPE, 0.05, [*WELLS, (1.04, 0.46)], {"options": DEEP}),
    "layers": (L_SHAPE, 0.07, WELLS, {"layers": BANK}),
    "3D": (clvoro.Box((0, 0, 0), (1, 1, 1)), 0.15, [(0.3, 0.2, 0.7), (0.5, 0.5, 0.5)], {}),
    "sphere": (clvoro.Sphere(6371), 1000, [(10, 50), (-70, -30), (0, 90)], {}),
}
LEAST_Q = {2: 0.87, 3: 0.5}
"""Least Q of fixed cells and their neighbors, over both precisions: 0.90 in 2D, 0.59 in 3D."""


def beside(mesh, k):
    """Return the cells next to the first `k` cells, and these."""
    d = mesh.diagram
    found = d.neighbors[: d.neighbor_starts[k]]
    return np.union1d(found[found >= 0], np.arange(k))


@pytest.mark.sparse(2)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("kind", list(RUNS))
def test_generators_stay_and_their_cells_have_the_sizes(ctx, monkeypatch, dtype, kind):
    domain, size, fixed, more = RUNS[kind]
    moved = []

    def put_back(diagram, of, positions):
        moved.append(np.abs(diagram.points[: len(positions)] - positions).max())
        return original(diagram, of, positions)

    original = run_module.put_back
    monkeypatch.setattr(run_module, "put_back", put_back)
    run = {"fixed": fixed, "effort": "fast", "seed": 2, **more}
    mesh = clvoro.Adapter(ctx, dtype).run(domain, size, **run)
    k, at = len(fixed), domain.check_rows("fixed", fixed)
    # The device rounds positions once, and reading rounds again.
    assert moved[0] <= 2 * np.finfo(dtype).eps * np.abs(at).max()
    assert np.array_equal(mesh.points[:k], at)
    assert mesh.settings["fixed"] == k
    assert mesh.diagram.volumes.sum() == pytest.approx(domain.measure, rel=1e-6)
    near = beside(mesh, k)
    assert np.abs(mesh.size_error[near]).max() < 0.06
    assert mesh.converged
    assert mesh.quality[near].min() > LEAST_Q[domain.cell_dim]
    assert mesh.check()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("method", ["lloyd", "poisson", "coupled", "weighted-lloyd", "weighted"])
def test_published_methods_keep_them_and_the_number_of_cells(adapter, method):
    start = np.random.default_rng(1).random((90, 2)) * (2, 1)
    mesh = adapter.run(BOX, 0.15, points=start, method=method, fixed=WELLS, max_steps=8)
    assert np.array_equal(mesh.points[: len(WELLS)], WELLS)
    assert len(mesh.points) == 90
    # They have taken the places of the nearest points.
    nearest = np.linalg.norm(start[:, None] - WELLS, axis=2).argmin(axis=0)
    assert mesh.origin[: len(WELLS)].tolist() == nearest.tolist()
    assert sorted(mesh.origin) == list(range(90))


def test_they_are_the_same_bits_from_run_to_run_and_in_a_warm_start(adapter):
    first, second = (adapter.run(BOX, 0.06, fixed=WELLS, effort="fast", options=DEEP) for _ in range(2))
    assert np.array_equal(first.points, second.points)
    after = adapter.run(BOX, 0.0601, points=first.points, fixed=WELLS, effort="fast")
    assert np.array_equal(after.points[: len(WELLS)], WELLS)
    assert after.origin[: len(WELLS)].tolist() == list(range(len(WELLS)))
    assert after.history["step"][-1] < first.history["step"][-1]


def test_a_run_that_is_stopped_on_a_coarser_level_has_them(adapter):
    mesh = adapter.run(BOX, 0.06, fixed=WELLS, options=DEEP, callback=lambda row: True)
    assert mesh.history["level"][0] == 1
    assert np.array_equal(mesh.points[: len(WELLS)], WELLS)


def test_more_of_them_than_the_sizes_require(adapter):
    with pytest.warns(clvoro.errors.SizeErrorWarning), pytest.warns(MismatchWarning, match="wall"):
        mesh = adapter.run(BOX, 1.4, fixed=WELLS[:3], effort="fast")
    assert np.array_equal(mesh.points, WELLS[:3])


@pytest.mark.parametrize("domain", [BOX, clvoro.Box((0, 0), (2, 1), True)])
def test_places_are_taken_in_the_order_of_distances(domain):
    rng = np.random.default_rng(8)
    points, fixed = rng.random((60, 2)) * (2, 1), rng.random((6, 2)) * (0.3, 1)
    labels = rng.permutation(60).astype(np.int32) + 6
    extent, rows = np.array(domain.extent), 12
    new, names, taken = take_places(domain.place(points, np.dtype(float)), labels, fixed, domain, rows)
    d = points[:, None] - fixed
    d -= np.rint(d / extent) * extent * np.array(domain.periodic)
    distance = np.linalg.norm(d, axis=2)
    distance[labels < rows] = np.inf
    expected = labels.copy()
    for _ in fixed:
        i, j = np.unravel_index(distance.argmin(), distance.shape)
        assert taken[j] == labels[i]
        expected[i] = j
        distance[i], distance[:, j] = np.inf, np.inf
    assert np.array_equal(names, expected)
    at = np.where((names < 6)[:, None], fixed[np.minimum(names, 5)], points)
    assert np.allclose(new * domain.frame[1], at, atol=1e-15)


def test_places_behind_a_wall_are_not_taken():
    slit = clvoro.Polygon([(0, 0), (1, 0), (1, 0.49), (0.1, 0.5), (1, 0.51), (1, 1), (0, 1)])
    points = slit.place(np.array([(0.7, 0.6), (0.6, 0.35), (0.2, 0.8)]), np.dtype(float))
    labels = np.arange(1, 4, dtype=np.int32)
    _, names, _ = take_places(points, labels, np.array([(0.7, 0.45)]), slit, 1)
    assert names.tolist() == [1, 0, 3]


def test_what_are_no_positions_is_refused_and_none_are_allowed(adapter):
    for value in (True, [("a", "b")], 3.0, {"type": "LineString", "coordinates": [(0, 0), (1, 1)]}):
        with pytest.raises(InputTypeError, match="fixed"):
            adapter.run(BOX, 0.1, fixed=value)
    assert adapter.run(BOX, 0.3, fixed=[], effort="fast").settings["fixed"] == 0


@pytest.mark.parametrize(
    ("fixed", "text"),
    [
        ([(0.5, 0.5), (0.5, 0.012)], r"fixed\[1\] is at \(0.5, 0.012\), 0.012 from a wall.*at most 0.06"),
        ([(1.5, 0.5), (0.5, 0.5), (0.53, 0.5)], r"fixed\[1\] .*0.03 from fixed\[2\], .*at most 0.075"),
        ([(1.5, 0.5), (0.5, 0.2), (0.4, 0.2)], None),
    ],
)
def test_positions_that_are_near_each_other_or_a_wall_give_a_warning(adapter, fixed, text):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        given = fixed if text else {"type": "MultiPoint", "coordinates": fixed}
        mesh = adapter.run(BOX, 0.1, fixed=given, effort="fast", max_steps=1)
    found = [str(w.message) for w in seen if w.category is MismatchWarning]
    assert len(found) == (text is not None)
    assert np.array_equal(mesh.points[: len(fixed)], fixed)
    if text is not None:
        assert re.search(text, found[0]), found[0]


@pytest.mark.parametrize(
    "points",
    [
        shapely.MultiPoint([(0.3, 0.4), (0.7, 0.6)]),
        [shapely.Point(0.3, 0.4), shapely.Point(0.7, 0.6)],
        np.array([shapely.Point(0.3, 0.4), shapely.Point(0.7, 0.6)]),
    ],
)
def test_points_of_shapely(points):
    box = clvoro.Box((0, 0), (1, 1))
    assert check_fixed(points, box, np.dtype(float)).tolist() == [[0.3, 0.4], [0.7, 0.6]]
    with pytest.raises(InputTypeError, match=r"LINESTRING.*expected points"):
        check_fixed(shapely.LineString([(0, 0), (1, 1)]), box, np.dtype(float))


def test_the_remedy_for_equal_points_keeps_their_order():
    fixed = np.array([(0.7, 0.6), (0.3, 0.4), (0.7, 0.6), (0.1, 0.9)])
    box = clvoro.Box((0, 0), (1, 1))
    with pytest.raises(InputError, match=r"keep the first of each: (fixed\[.*\])$") as raised:
        check_fixed(fixed, box, np.dtype(float))
    remedy = str(raised.value).split("keep the first of each: ")[1]
    kept = eval(remedy, {"numpy": np, "fixed": fixed})
    assert kept.tolist() == fixed[[0, 1, 3]].tolist()
    check_fixed(kept, box, np.dtype(float))
