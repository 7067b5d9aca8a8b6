"""The correction's displacement, its relaxation and the move itself against their formulas in NumPy."""

import numpy as np
import pytest

from clvoro.adaptation.motion import Displacement, Motion
from clvoro.geometry.solid.solid import Solid
from clvoro.opencl.primitives import Summaries
from tests.reference import patch

N = 250


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param)


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


def test_add_momentum(engine):
    rng = np.random.default_rng(43)
    lloyd, velocity = rng.normal(size=(2, N, 2))
    on_device = engine.upload(lloyd)
    Motion(engine).add_momentum(1.3, on_device, engine.upload(velocity), 0.7)
    expected = 1.3 * lloyd + 0.7 * velocity
    assert on_device.get() == pytest.approx(expected, abs=16 * float(np.finfo(engine.real).eps))


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_generators_near_a_wall_of_a_solid_stay(ctx, real):
    """A step over a wall ends half-way to it. Near the wall there is none: distances would fall to round-off."""
    solid = Solid.box((0, 0, 0), (1, 1, 1))
    engine = patch.make_engine(ctx, real, 3, box=solid)
    depths = np.array([0.01, 0.1, 0.4])
    origin, scale = solid.frame
    x = np.column_stack([1 - depths, np.full((3, 2), 0.5)])
    points, way = engine.upload((x - origin) / scale), engine.upload(np.array([[0.3, 0, 0]] * 3) / scale)
    none, velocity = engine.zeros((3, 3)), engine.zeros((3, 3))
    step = Displacement(way, none, engine.upload(np.ones(3)))
    Motion(engine).move_generators(solid, points, step, velocity)
    moved = (origin + scale * points.get() - x)[:, 0]
    assert moved == pytest.approx([0, 0.05, 0.3], abs=1e-5 if real == "float32" else 1e-12)
