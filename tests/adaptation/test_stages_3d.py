"""The stages of a step in three dimensions, on diagrams of the device, against NumPy and Qhull."""

import numpy as np
import pytest

from clvoro.adaptation.density import Density
from clvoro.adaptation.metric import Metric
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.volume_projection import Penalty, Targets, VolumeProjection
from tests.reference import diagrams3d as reference3d
from tests.reference import patch

BOX = patch.BOXES["space"]
N = 150
SLOPE = np.array([0.9, -1.4, 0.6])


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param, dim=3)


@pytest.fixture(scope="module")
def double(ctx):
    return patch.make_engine(ctx, dim=3)


def random_points(n, seed, real="float64"):
    return patch.random_points(n, seed, BOX).astype(real).astype(float)


def relaxed_points(n, seed):
    return patch.relaxed_points(n, seed, 3, BOX)


def cells_of(points):
    return reference3d.box_voronoi(BOX.lower, BOX.upper, points)


# Metric.


@pytest.mark.sparse(1)
def test_metric(engine):
    points = random_points(N, 618, engine.real)
    rng = np.random.default_rng(55)
    h = np.exp(rng.uniform(np.log(0.03), np.log(0.6), N)).astype(engine.real).astype(float)
    out = [engine.empty(N) for _ in range(4)]
    Metric(engine).evaluate(patch.tessellate(engine, points, BOX), engine.upload(h), *out)
    error, quality, energy, reach = (a.get() for a in out)
    # Faces and volumes of cells of 0.15 carry eps of the unit box over those lengths.
    rel = 4000 * float(np.finfo(engine.real).eps)
    for i, cell in enumerate(cells_of(points)):
        length = np.cbrt(cell.volume)
        smaller = min(length, h[i])
        assert error[i] == pytest.approx((length - h[i]) / smaller, abs=rel * length / smaller)
        assert reach[i] == pytest.approx(smaller, rel=rel)
        surface = sum(cell.faces.values())
        assert quality[i] == pytest.approx(36 * np.pi * cell.volume**2 / surface**3, rel=rel)
        moment = np.trace(cell.covariance) + ((cell.centroid - points[i]) ** 2).sum()
        assert energy[i] == pytest.approx(cell.volume * moment, rel=rel)


# Density.


def test_density(engine):
    points = random_points(N, 111, engine.real)
    t, density = patch.tessellate(engine, points, BOX), Density(engine)
    h = 0.1 * np.exp(points @ SLOPE)
    w = density.lloyd_weights(t, engine.upload(h))
    volumes, eps = t.volumes.get().astype(float), float(np.finfo(engine.real).eps)
    assert w.density.get() == pytest.approx(h**-3, rel=64 * eps)
    assert w.weight.get() == pytest.approx(volumes / h**3, rel=64 * eps)
    excess = np.log(volumes / h**3)
    assert w.log_ratio.get() == pytest.approx(excess, abs=64 * eps)
    # log h linear is fitted exactly; it rounds by a few eps over distances of 0.03 and more.
    assert np.abs(w.gradient.get() - SLOPE).max() < 8000 * eps
    weighed, weights = density.sum_log_ratio(w).get().reshape(2, -1).sum(axis=1)
    mean = np.average(excess, weights=volumes / h**3)
    assert weighed / weights == pytest.approx(mean, abs=256 * eps)


# VolumeProjection.


def excess_of(points):
    """r = log(V / h^3), V by Qhull, h = 0.1 exp(SLOPE . x)."""
    volumes = np.array([c.volume for c in cells_of(points)])
    return np.log(volumes) - 3 * (np.log(0.1) + points @ SLOPE)


def test_projection_uses_the_derivative_of_the_volumes(double):
    """With a tiny penalty one step removes small log ratios up to second order."""
    points = relaxed_points(60, 606)
    h, left = 0.1 * np.exp(points @ SLOPE), []
    base = excess_of(points)
    t = patch.tessellate(double, points, BOX)
    for size in (0.02, 0.01):
        # Required changes of the volumes. Their mean needs motion along grad h.
        ask = size * np.random.default_rng(3).normal(size=60)
        u = double.empty((60, 3))
        solution = VolumeProjection(double).project(
            t,
            Targets(*map(double.upload, (h, np.tile(SLOPE, (60, 1)), ask, np.ones(60)))),
            double.zeros((60, 3)),
            u,
            Penalty(1e-9),
            Limits(1e-11, 2000),
        )
        assert solution.residual < 1e-9
        change = excess_of(points + u.get()) - base
        left.append(np.abs(change + ask).max())
        assert left[-1] < 0.2 * np.abs(ask).max()
    assert left[1] < 0.3 * left[0], "a quarter at half the size"


# Refinement.
