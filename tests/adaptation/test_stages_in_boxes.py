"""Stages against NumPy, from the faces of diagrams: in 2D and 3D, at walls and across seams."""

import numpy as np
import pytest

from clvoro.adaptation.density import Density
from clvoro.adaptation.metric import Metric
from clvoro.adaptation.motion import Displacement, Motion
from clvoro.adaptation.refinement import Refinement
from tests.reference import patch

N = 250


@pytest.fixture(scope="module", params=list(patch.BOXES))
def box(request):
    return patch.BOXES[request.param]


@pytest.fixture(scope="module")
def engine(ctx, box):
    return patch.make_engine(ctx, dim=box.dim, box=box)


@pytest.fixture(scope="module")
def t(engine, box):
    return patch.tessellate_box(engine, box, N, 5601)


def inner_faces(host):
    """Places of the faces between cells, the cells on both sides."""
    k = np.flatnonzero(host.neighbors >= 0)
    return k, host.owners[k], host.neighbors[k]


@pytest.mark.sparse(2)
def test_gradient_of_log_h(engine, box, t):
    """The gradient is a least-squares fit with weights 1 / distance^2. Weighted centroids follow from it."""
    h = np.random.default_rng(5602).uniform(0.02, 0.2, N)
    w = Density(engine).lloyd_weights(t, engine.upload(h))
    host, dim = patch.fetch(t), box.dim
    ways, gradient, lloyd = patch.ways(host, box), w.gradient.get(), w.lloyd.get()
    k, i, j = inner_faces(host)
    scaled = ways[k] / np.linalg.norm(ways[k], axis=1)[:, None]
    rises = np.log(h[j] / h[i]) / np.linalg.norm(ways[k], axis=1)
    upper = np.triu_indices(dim)
    for cell in range(N):
        own = i == cell
        expected, _, _, singular = np.linalg.lstsq(scaled[own], rises[own], rcond=None)
        # Normal equations: round-off grows with the square of the condition number.
        rel = 64 * np.finfo(float).eps * (singular[0] / singular[-1]) ** 2
        size = np.abs(rises[own]).max()
        assert gradient[cell] == pytest.approx(expected, rel=0, abs=rel * size)
        covariance = np.zeros((dim, dim))
        covariance[upper] = host.covariances[cell]
        covariance = covariance + np.triu(covariance, 1).T
        shift = -(dim + 2) * covariance @ gradient[cell]
        assert lloyd[cell] == pytest.approx(host.offsets[cell] + shift, rel=0, abs=1e-14)


def test_gradient_of_a_potential(engine, box, t):
    psi, u = np.random.default_rng(5603).normal(size=N), engine.empty((N, box.dim))
    Motion(engine).compute_potential_gradient(t, engine.upload(psi), u)
    host, expected = patch.fetch(t), np.zeros((N, box.dim))
    k, i, j = inner_faces(host)
    distances = np.linalg.norm(patch.ways(host, box)[k], axis=1)
    flux = host.face_measures[k] / distances * (psi[j] - psi[i])
    np.add.at(expected, i, flux[:, None] * host.face_centroids[k])
    expected /= host.volumes[:, None]
    assert u.get() == pytest.approx(expected, rel=1e-11, abs=1e-11)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("clip", [0.0, 0.7])
def test_moves(engine, box, clip):
    """Walls reflect, seams are crossed, and h limits the displacement. Fixed generators do not move."""
    rng = np.random.default_rng(5604)
    points = box.place(patch.random_points(N, 5605, box), engine.real)
    lloyd, correction = rng.normal(0, 0.05, (2, N, box.dim))
    h = rng.uniform(0.02, 0.2, N)
    labels = rng.permutation(N)
    held = labels < 60
    points[held & (labels % 2 > 0), 1] = 0.75  # on a wall, or as far as the period goes
    d = 0.7 * lloyd - 1.3 * correction
    if clip:
        length = np.linalg.norm(d, axis=1)
        assert 20 < (length > clip * h).sum() < N - 20
        d *= np.minimum(1, clip * h / length)[:, None]
    on_device, velocity = engine.upload(points), engine.empty((N, box.dim))
    ways = [engine.upload(a) for a in (lloyd, correction)]
    for way in ways:
        Motion(engine).zero_fixed_displacements(engine.upload(labels, np.int32), 60, way)
        assert not way.get()[held].any()
    for way, given in zip(ways, (lloyd, correction), strict=True):
        assert np.array_equal(way.get()[~held], given[~held])
    displacement = Displacement(*ways, engine.upload(h), 0.7, -1.3, clip)
    Motion(engine).move_generators(box, on_device, displacement, velocity)
    new, moved = on_device.get(), velocity.get()
    assert np.array_equal(new[held], points[held])
    assert not moved[held].any()
    expected, periodic = points + d, np.array(box.periodic)
    assert ((expected < 0) | (expected > box.extent)).any(axis=0).all()
    round_about = expected % box.extent
    reflected = np.abs(expected)
    reflected = np.where(reflected > box.extent, 2 * box.extent - reflected, reflected)
    where = np.where(periodic, round_about, reflected)
    # Positions are on a grid of eps along periods.
    eps = np.finfo(float).eps
    assert new[~held] == pytest.approx(where[~held], rel=0, abs=4 * eps)
    way = np.where(periodic, d, where - points)
    assert moved[~held] == pytest.approx(way[~held], rel=0, abs=4 * eps)


def test_moves_longer_than_the_domain(engine, box):
    """The thickness may be far below h; generators must not coincide in corners."""
    points = box.place(patch.random_points(N, 5608, box), engine.real)
    way = np.random.default_rng(5609).normal(0, 1e7, (N, box.dim))
    on_device, none = engine.upload(points), engine.upload(np.zeros_like(way))
    d = Displacement(engine.upload(way), none, engine.upload(np.ones(N)))
    Motion(engine).move_generators(box, on_device, d, engine.empty((N, box.dim)))
    new, walls = on_device.get(), ~np.array(box.periodic)
    assert ((new >= 0) & (new <= box.extent)).all()
    assert all(len(np.unique(x)) == N for x in new[:, walls].T)


def test_sizes_that_are_held(engine, box, t):
    """Cells of layers have the right size, unless they are more than half too large."""
    rng = np.random.default_rng(5606)
    labels, lengths = rng.permutation(N), t.volumes.get() ** (1 / box.dim)
    h = lengths / rng.uniform(0.5, 2.5, N)
    on_device = engine.upload(h)
    for _ in range(2):  # again with its own result
        Metric(engine).set_fixed_sizes(engine.upload(labels, np.int32), 20, 90, t.volumes, on_device)
        right = (labels >= 20) & (labels < 90) & (lengths <= 1.5 * h)
        assert 0 < np.count_nonzero(right) < 70
        expected = np.where(right, lengths, h)
        assert on_device.get() == pytest.approx(expected, rel=4 * np.finfo(float).eps)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("fixed", [0, 90])
def test_children(engine, box, t, fixed):
    """New generators are at midpoints across large faces and at walls, but not at fixed generators."""
    rng = np.random.default_rng(5607)
    labels, h = rng.permutation(N), rng.uniform(0.02, 0.1, N)
    given = [engine.upload(labels, np.int32), fixed] if fixed else []
    finer = Refinement(engine).refine(box, t, engine.upload(h), *given).get()
    host = patch.fetch(t)
    children = patch.children(host, box, h, labels < fixed)
    assert np.array_equal(finer[:N], host.points)
    # The children of a generator follow in the order of its faces.
    assert finer[N:] == pytest.approx(children, rel=0, abs=2 * np.finfo(float).eps)
