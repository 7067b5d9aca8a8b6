"""The gradient of quality against finite differences of the energy, by diagrams from Qhull."""

import numpy as np
import patch
import pytest
import reference

from clvoro.shape import Shape

N = 40


def qualities(points):
    """Q, perimeter and area of each cell, (n, 3)."""
    rows = []
    for cell in reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points):
        n = len(cell.neighbours)
        perimeter = np.hypot(*(np.roll(cell.polygon, -1, axis=0) - cell.polygon).T).sum()
        rows.append((4 * cell.area * n * np.tan(np.pi / n) / perimeter**2, perimeter, cell.area))
    return np.array(rows)


def energy(points, omega):
    """E = sum omega (2 log P - log A); omega stays that of the start."""
    _, perimeter, area = qualities(points).T
    return float((omega * (2 * np.log(perimeter) - np.log(area))).sum())


def descend(engine, points, h, emphasis, rate=0.1, longest=0.2, quality=None):
    t = patch.tessellate(engine, points)
    quality = engine.upload(qualities(points)[:, 0] if quality is None else quality)
    out = engine.empty((len(points), 2))
    Shape(engine).descend(
        t, engine.upload(h), quality, out, emphasis=emphasis, rate=rate, longest=longest
    )
    return out.get()


@pytest.mark.parametrize("emphasis", [0.0, 20.0])
def test_gradient(ctx, emphasis):
    """Every generator, those at walls and in corners included, moves by -rate h^2 dE/dx."""
    points = patch.relaxed_points(N, 2112, steps=3)
    h = np.random.default_rng(6).uniform(0.05, 0.2, N)
    u = descend(patch.make_engine(ctx), points, h, emphasis, rate=0.3, longest=1e9)
    omega = 1 - emphasis * np.log(qualities(points)[:, 0])
    step = 1e-5
    gradient = np.zeros((N, 2))
    for i in range(N):
        for a in range(2):
            ahead, behind = points.copy(), points.copy()
            ahead[i, a] += step
            behind[i, a] -= step
            gradient[i, a] = (energy(ahead, omega) - energy(behind, omega)) / (2 * step)
    expected = -0.3 * h[:, None] ** 2 * gradient
    # Central differences: rounding of E (about 100 (1 + emphasis)) over the step, curvature times its square.
    assert u == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())


def test_descends(ctx):
    """A step of the real size lowers E."""
    points = patch.relaxed_points(N, 2113, steps=3)
    h = np.full(N, np.sqrt(0.75 / N))
    u = descend(patch.make_engine(ctx), points, h, 5.0)
    omega = 1 - 5 * np.log(qualities(points)[:, 0])
    before, after = energy(points, omega), energy(points + u, omega)
    slope = -((u / (0.1 * h[:, None])) ** 2).sum() * 0.1
    assert after - before == pytest.approx(slope, rel=0.5)


def test_longest(ctx):
    points = patch.relaxed_points(N, 2114, steps=0)
    h = np.full(N, 0.1)
    engine = patch.make_engine(ctx)
    free = descend(engine, points, h, 5.0, longest=1e9)
    u = descend(engine, points, h, 5.0, longest=0.03)
    length = np.linalg.norm(free, axis=1)
    assert 3 < (length > 0.003).sum() < N
    assert u == pytest.approx(free * np.minimum(1, 0.003 / length)[:, None], rel=1e-9, abs=1e-15)


def test_a_regular_mesh_stays(ctx):
    """Squares are at rest, though four meet in each corner; at walls that corner has a kink and no gradient."""
    xy = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    u = descend(patch.make_engine(ctx), (xy + 0.5) / 8, np.full(48, 0.125), 5.0)
    inside = ((xy > 0) & (xy < [7, 5])).all(axis=1)
    assert np.abs(u[inside]).max() < 1e-12
    assert np.linalg.norm(u, axis=1).max() < 0.1 * 0.125


@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize(
    "points",
    [
        [[0.3, 0.4]],
        [[0.3, 0.4], [0.6, 0.2]],
        [[0, 0], [1, 0.75], [0, 0.75], [1, 0]],
        np.stack([np.linspace(0.05, 0.95, 10), np.full(10, 0.375)], axis=1),
        [[0.5, 0.375], [0.5, 0.375 + 1e-6], [0.1, 0.1], [0.9, 0.7]],
    ],
)
def test_degenerate(ctx, real, points):
    n = len(points)
    some = np.full(n, 0.5)
    u = descend(
        patch.make_engine(ctx, real), np.array(points, float), np.full(n, 0.3), 5.0, quality=some
    )
    assert np.isfinite(u).all()
    assert np.linalg.norm(u, axis=1).max() <= 0.2 * 0.3 * 1.001
