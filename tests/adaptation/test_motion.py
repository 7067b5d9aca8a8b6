"""The correction's displacement, its relaxation and the move itself against their formulas in NumPy."""

import numpy as np
import pytest

from clvoro.adaptation.motion import Displacement, Motion
from clvoro.geometry.box import Box
from clvoro.opencl.primitives import Summaries
from tests.reference import patch

N = 250


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param)


@pytest.fixture(scope="module")
def t(engine):
    return patch.tessellate(engine, patch.random_points(N, 904))


def follow(engine, t, psi):
    u = engine.empty((t.n, 2))
    Motion(engine).compute_potential_gradient(t, engine.upload(psi), u)
    return u.get()


def at_walls(host):
    wall = np.zeros(host.n, bool)
    wall[host.owners[host.neighbors < 0]] = True
    return wall


def test_gradient_of_a_linear_potential(engine, t):
    host, slope = patch.fetch(t), np.array([0.7, -1.3])
    u = follow(engine, t, 5 + host.points.astype(float) @ slope)
    closed = ~at_walls(host)
    assert 100 < closed.sum() < N
    # Differences of psi (about 5) are divided by distances of at least 0.003. The contribution of a face, a few times
    # the gradient in a cell that is not round, has the round-off of measures and centroids.
    rounding = 4000 * np.finfo(engine.real).eps + 8 * np.finfo(engine.face).eps
    assert np.abs(u[closed] - slope).max() < rounding
    assert np.abs(u[~closed] - slope).max() > 0.1, "a wall lets no flux through"


@pytest.mark.sparse(3)
@pytest.mark.parametrize(("limit", "k"), [(2.0, 0.5), (2.0, 1e3), (0.25, 0.5), (7.0, 1e-3)])
def test_relax_globally(engine, limit, k):
    """One alpha for all, alpha = min(limit, k / max(|u| / h))."""
    rng = np.random.default_rng(19)
    u, speed = rng.normal(size=(N, 2)), rng.uniform(0, 3, N)
    summaries = Summaries(engine, ("other", "speed"))
    summaries.collect("other", engine.upload(10 * speed), N)
    on_device = engine.upload(u)
    summaries.collect("speed", engine.upload(speed), N)
    Motion(engine).relax_correction(summaries, "speed", limit, k, on_device)
    alpha = min(limit, k / speed.max())
    eps = float(np.finfo(engine.real).eps)
    assert on_device.get() == pytest.approx(alpha * u, rel=8 * eps)


def test_relax_nothing(engine):
    """All displacements zero: alpha is the limit, and no 0 / 0 arises."""
    summaries = Summaries(engine, ("speed",))
    u = engine.zeros((N, 2))
    summaries.collect("speed", engine.zeros(N), N)
    Motion(engine).relax_correction(summaries, "speed", 2.0, 0.5, u)
    assert not u.get().any()


def move(engine, box, points, lloyd, a, correction, b, h, clip):
    on_device = engine.upload(points)
    velocity = engine.empty(points.shape)
    d = Displacement(engine.upload(lloyd), engine.upload(correction), engine.upload(h), a, b, clip)
    Motion(engine).move_generators(box, on_device, d, velocity)
    return on_device.get(), velocity.get()


def test_move_keeps_everything_inside(engine):
    """Displacements across the whole box and beyond, from walls and corners."""
    box = Box((0, 0), (1, 0.75))
    corners = np.array([[0, 0], [1, 0], [1, 0.75], [0, 0.75], [0.5, 0], [0, 0.3]])
    points = np.repeat(corners, 40, axis=0)
    d = np.random.default_rng(37).normal(0, 3, points.shape)
    new, velocity = move(engine, box, points, d, 1.0, 0 * d, 0.0, np.ones(len(d)), 0.0)
    assert box.contains(new).all()
    assert np.abs(points.astype(engine.real) + velocity - new).max() < 1e-6


def test_add_momentum(engine):
    rng = np.random.default_rng(43)
    lloyd, velocity = rng.normal(size=(2, N, 2))
    on_device = engine.upload(lloyd)
    Motion(engine).add_momentum(1.3, on_device, engine.upload(velocity), 0.7)
    expected = 1.3 * lloyd + 0.7 * velocity
    assert on_device.get() == pytest.approx(expected, abs=16 * float(np.finfo(engine.real).eps))
