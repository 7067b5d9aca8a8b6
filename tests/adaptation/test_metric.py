"""Error, quality, energy and changed neighbors against what their definitions say of reference cells."""

import numpy as np
import pytest

from clvoro.adaptation.metric import Metric, Neighborhoods
from clvoro.tessellation.cells import Cells
from tests.reference import diagrams as reference
from tests.reference import patch

N = 300


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param)


def evaluate(engine, t, h, compared=None):
    out = [engine.empty(t.n) for _ in range(4)]
    Metric(engine).evaluate(t, engine.upload(h), *out, compared)
    return [a.get() for a in out]


@pytest.mark.sparse(1)
def test_definitions(engine):
    points = patch.random_points(N, 618).astype(engine.real).astype(float)
    rng = np.random.default_rng(55)
    h = np.exp(rng.uniform(np.log(0.01), np.log(0.3), N)).astype(engine.real).astype(float)
    t = patch.tessellate(engine, points)
    _, rough, *_ = evaluate(engine, t, h)
    t = Cells(engine).measure_faces(patch.BOX, t)
    error, quality, energy, reach = evaluate(engine, t, h)
    # The sum of faces in single precision, in the device's precision, is accurate to half an eps.
    assert rough == pytest.approx(quality, rel=2 * float(np.finfo(np.float32).eps))
    cells = reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)
    # Areas and lengths of cells of 0.05 carry eps of the unit box, and relative errors so 20 to 400 eps.
    close = {"rel": 2000 * float(np.finfo(engine.real).eps)}
    both = set()
    for i, cell in enumerate(cells):
        length = np.sqrt(cell.area)
        smaller = min(length, h[i])
        both.add(length < h[i])
        assert error[i] == pytest.approx((length - h[i]) / smaller, abs=close["rel"] * length / smaller)
        assert reach[i] == pytest.approx(smaller, **close)
        perimeter = np.hypot(*(np.roll(cell.polygon, -1, axis=0) - cell.polygon).T).sum()
        n = len(cell.neighbors)
        expected = 4 * cell.area * n * np.tan(np.pi / n) / perimeter**2
        assert quality[i] == pytest.approx(expected, **close)
        assert energy[i] == pytest.approx(reference.second_moment(cell.polygon, points[i]), **close)
    assert both == {True, False}, "both branches of the error"


def test_squares(engine):
    """A square is as good as four sides allow, Q = 1; its energy is h^4 / 6."""
    a = 0.125
    xy = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    error, quality, energy, _ = evaluate(engine, patch.tessellate(engine, (xy + 0.5) * a), np.full(48, a))
    eps = float(np.finfo(engine.real).eps)
    assert np.abs(error).max() < 16 * eps
    assert np.abs(quality - 1).max() < 16 * eps
    assert energy == pytest.approx(np.full(48, a**4 / 6), rel=64 * eps)


def neighbor_sets(t, labels):
    host = patch.fetch(t)
    return {
        labels[i]: {labels[j] if j >= 0 else j for j in host.neighbors[host.starts[i] : host.starts[i + 1]]}
        for i in range(t.n)
    }


def compare_neighbors(engine, t, labels, first, *arrays):
    evaluate(engine, t, np.ones(N), Neighborhoods(engine.upload(labels, np.int32), *arrays, first))


def test_compare_neighbors(ctx):
    engine = patch.make_engine(ctx)
    rng = np.random.default_rng(717)
    labels = rng.permutation(5 * N)[:N].astype(np.int32)  # any distinct names
    points = patch.random_points(N, 31)
    signatures, changed = engine.zeros(N, np.uint64), engine.empty(N)
    ever = engine.upload(np.full(N, 0.25))

    def compare(points, labels, first):
        t = patch.tessellate(engine, points)
        compare_neighbors(engine, t, labels, first, signatures, changed, ever)
        return neighbor_sets(t, labels), changed.get(), ever.get()

    before, now, so_far = compare(points, labels, True)
    assert not now.any()
    assert not so_far.any(), "the first call starts anew"
    past = np.zeros(N)
    for amount in (0.0, 1e-3, 3e-3, 1e-2):
        points = np.clip(points + rng.normal(0, amount, points.shape), 0.001, [0.999, 0.749])
        after, now, so_far = compare(points, labels, False)
        expected = np.array([before[name] != after[name] for name in labels])
        assert np.array_equal(now, expected)
        assert amount == 0 or 0 < expected.sum() < N
        past = np.maximum(past, expected)
        assert np.array_equal(so_far, past)
        before = after


def test_neighbor_changes_ignore_order_and_numbering(ctx):
    """In another order the same cells have other indices, but the same labels, and so the same neighbors."""
    engine = patch.make_engine(ctx)
    order = np.random.default_rng(3).permutation(N)
    points, labels = patch.random_points(N, 31), np.arange(N) + 7
    signatures, changed, ever = engine.zeros(N, np.uint64), engine.empty(N), engine.zeros(N)
    t = patch.tessellate(engine, points)
    compare_neighbors(engine, t, labels, True, signatures, changed, ever)
    moved = engine.upload(signatures.get()[order], np.uint64)
    t = patch.tessellate(engine, points[order])
    compare_neighbors(engine, t, labels[order], False, moved, changed, ever)
    assert not changed.get().any()
    compare_neighbors(engine, t, labels, False, moved, changed, ever)
    assert changed.get().all(), "other names are other neighbors"


def test_scale_sizes(engine):
    h = engine.upload(np.arange(1, 200) / 64)
    Metric(engine).scale_sizes(0.5, h)
    assert np.array_equal(h.get(), np.arange(1, 200).astype(engine.real) / 128)
