"""The size field as a density: excess, gradient and weighted centroids against sums and quadrature."""

import numpy as np
import pytest

from clvoro.adaptation.density import Density
from tests.reference import diagrams as reference
from tests.reference import patch

N = 250


@pytest.fixture(
    scope="module", params=[("float64", None), ("float32", None), ("float64", 16)], ids=["float64", "float32", "gpu"]
)
def engine(ctx, request):
    real, group_size = request.param
    return patch.make_engine(ctx, real, group_size=group_size)


@pytest.mark.sparse(2)
def test_excess(engine):
    t = patch.tessellate(engine, patch.random_points(N, 111))
    h = np.random.default_rng(5).uniform(0.01, 0.2, N)
    density = Density(engine)
    w = density.lloyd_weights(t, engine.upload(h))
    volumes, rel = t.volumes.get().astype(float), 64 * float(np.finfo(engine.real).eps)
    assert w.density.get() == pytest.approx(h**-2, rel=rel)
    assert w.weight.get() == pytest.approx(volumes / h**2, rel=rel)
    assert w.log_ratio.get() == pytest.approx(2 * np.log(np.sqrt(volumes) / h), abs=rel)
    weighed, weights = density.sum_log_ratio(w).get().reshape(2, -1).sum(axis=1)
    mean = np.average(np.log(volumes / h**2), weights=volumes / h**2)
    assert weighed / weights == pytest.approx(mean, abs=rel)


@pytest.mark.sparse(1)
def test_gradient_of_an_exponential(engine):
    """A linear log h is fitted exactly, also at walls and in corners, with at least two neighbors."""
    points = patch.random_points(N, 112)
    slope = np.array([-1.1, 2.3])
    h = 0.03 * np.exp(points @ slope)
    t = patch.tessellate(engine, points)
    gradient = Density(engine).lloyd_weights(t, engine.upload(h)).gradient.get()
    host = patch.fetch(t)
    told = np.bincount(host.owners[host.neighbors >= 0], minlength=N) > 1
    assert told.sum() == N - 1, "one cell fills a corner alone"
    # log h, about 5, has a round-off of a few eps, over distances of at least 0.003.
    assert np.abs(gradient[told] - slope).max() < 8000 * np.finfo(engine.real).eps
    assert not gradient[~told].any()


@pytest.mark.parametrize(
    "points",
    [
        [[0.3, 0.4]],
        [[0.3, 0.4], [0.8, 0.1]],
        np.stack([np.linspace(0.1, 0.9, 12), np.full(12, 0.3)], axis=1),
        np.stack([np.linspace(0.1, 0.7, 9)] * 2, axis=1),
    ],
)
def test_gradient_without_enough_neighbors_is_zero(engine, points):
    """One cell, two cells and collinear cells give the gradient 0."""
    points = np.array(points)
    w = Density(engine).lloyd_weights(patch.tessellate(engine, points), engine.upload(0.1 + 0.3 * points[:, 0]))
    assert not w.gradient.get().any()
    assert np.isfinite(w.lloyd.get()).all()


def weighted_centroid(polygon, slope, power):
    """Centroid of a polygon weighted by exp(power slope . y): Gauss quadrature over its triangles."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    nodes, weights = (nodes + 1) / 2, weights / 2
    u, v = (a.ravel() for a in np.meshgrid(nodes, nodes, indexing="ij"))
    w = np.outer(weights, weights).ravel() * u  # the square folded onto the triangle
    origin = polygon.mean(axis=0)
    mass, moment = 0.0, np.zeros(2)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        y = origin + u[:, None] * ((1 - v)[:, None] * (a - origin) + v[:, None] * (b - origin))
        twice = (a - origin)[0] * (b - origin)[1] - (a - origin)[1] * (b - origin)[0]
        share = twice * w * np.exp(power * (y - origin) @ slope)
        mass += share.sum()
        moment += share @ y
    return moment / mass


def test_weighted_centroids(ctx):
    """Against quadrature of h^-(d + 2), h exponential: right to first order in the change of h across the cell."""
    engine = patch.make_engine(ctx)
    points = patch.relaxed_points(120, 113)
    cells = reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)
    t = patch.tessellate(engine, points)
    offsets = t.offsets.get()
    worst = []
    for factor in (1.0, 0.5):
        slope = factor * np.array([0.8, -0.5])
        h = 0.1 * np.exp(points @ slope)
        lloyd = Density(engine).lloyd_weights(t, engine.upload(h)).lloyd.get()
        exact = np.array([weighted_centroid(c.polygon, slope, -4) for c in cells]) - points
        size = np.sqrt([c.area for c in cells])
        off = np.linalg.norm(lloyd - exact, axis=1) / size
        shift = np.linalg.norm(exact - offsets, axis=1) / size
        assert off.max() < 0.1 * shift.max()
        worst.append(off.max())
    # What is left is of second order: a quarter at half the slope.
    assert worst[1] < 0.3 * worst[0]
