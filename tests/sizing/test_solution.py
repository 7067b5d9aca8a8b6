"""Sizes from solutions, scattered points and rasters with gaps."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clvoro import Box, sizing
from clvoro.errors import InputError, InputTypeError
from clvoro.opencl.engine import Engine
from clvoro.sizing import Raster


def grid(lower, upper, counts):
    """Coordinates on the nodes, each an array with axes (z,) y, x."""
    axes = [np.linspace(*ends, n) for *ends, n in zip(lower, upper, counts, strict=True)]
    return np.meshgrid(*axes[::-1], indexing="ij")[::-1]


def node_weights(lower, upper, counts):
    total = 1.0
    for k, (low, high, n) in enumerate(zip(lower, upper, counts, strict=True)):
        w = np.full(n, (high - low) / (n - 1))
        w[[0, -1]] /= 2
        shape = [1] * len(counts)
        shape[len(counts) - 1 - k] = n
        total = total * w.reshape(shape)
    return total


LOWER, UPPER = (1.0, -2.0, 0.5), (3.0, -1.0, 1.1)
COUNTS = (41, 31, 13)
FLAT = Raster(np.ones((3, 3)), (0, 0), (1, 1))


@pytest.mark.sparse(3)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("p", [1, 2, 4.5, math.inf])
def test_a_parabola_gets_equal_cells(d, p):
    """Its Hessian is the same everywhere: h = (volume / N)^(1/d)."""
    lower, upper, counts = LOWER[:d], UPPER[:d], COUNTS[:d]
    x = grid(lower, upper, counts)
    u = 3 * x[0] ** 2 - 5 * x[1] ** 2 + 2 * x[0] * x[1] + x[-1]
    size = sizing.hessian_size(Raster(u, lower, upper), n_cells=777, p=p)
    volume = np.prod(np.subtract(upper, lower))
    assert size.values == pytest.approx((volume / 777) ** (1 / d), rel=1e-9)
    # |H| = 5.8...: the largest absolute eigenvalue of [[6, 2], [2, -10]].
    largest = np.abs(np.linalg.eigvalsh([[6, 2], [2, -10]])).max()
    size = sizing.hessian_size(Raster(u, lower, upper), eps=1e-3, p=p)
    # e = h^2 l / 8 everywhere, so its norm is e volume^(1/p).
    e = 1e-3 / (1 if math.isinf(p) else volume ** (1 / p))
    assert size.values == pytest.approx(math.sqrt(8 * e / largest), rel=1e-9)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("p", [1, 2, 6])
def test_sizes_follow_the_formula(d, p):
    """u = cosh(3 x) has l = 9 cosh(3 x) up to the error of second differences."""
    lower, upper, counts = (0, 0, 0)[:d], (1, 1, 1)[:d], (201, 7, 5)[:d]
    x = grid(lower, upper, counts)
    size = sizing.hessian_size(Raster(np.cosh(3 * x[0]), lower, upper), n_cells=5000, p=p)
    curved = 9 * np.cosh(3 * x[0])
    w = node_weights(lower, upper, counts)
    power = p / (2 * p + d)
    c = (np.sum(w * curved ** (power * d)) / 5000) ** (1 / d)
    # (3 dx)^2 / 12 inside; at the two sides the neighbor's value stands in, 3 dx off.
    assert size.values[..., 1:-1] == pytest.approx((c * curved**-power)[..., 1:-1], rel=1e-3)
    assert size.values == pytest.approx(c * curved**-power, rel=2e-2)
    assert np.sum(w * size.values ** -float(d)) == pytest.approx(5000, rel=1e-9)


@pytest.mark.parametrize("p", [1, 2, 8])
def test_sizes_are_optimal_for_their_number(p):
    lower, upper, counts = (0, 0), (2, 1), (61, 41)
    x, y = grid(lower, upper, counts)
    # Bends in one direction alone, so that l = |u_xx| is known without the code under test.
    u = np.exp(-20 * (x - 0.7) ** 2) + 0.2 * x**2
    second = np.diff(u, 2, axis=1)
    curved = np.abs(np.pad(second, ((0, 0), (1, 1)), mode="edge")) * 30**2
    w = node_weights(lower, upper, counts)
    h = sizing.hessian_size(Raster(u, lower, upper), n_cells=3000, p=p, h_max=1e3).values

    def norm(h):
        return np.sum(w * (h**2 * curved) ** p) ** (1 / p)

    assert np.sum(w / h**2) == pytest.approx(3000)
    rng = np.random.default_rng(271)
    for _ in range(20):
        kx, ky, phase = rng.uniform(1, 9, 3)
        other = h * np.exp(0.2 * np.sin(kx * x + phase) * np.cos(ky * y))
        other *= math.sqrt(np.sum(w / other**2) / 3000)
        assert norm(other) > norm(h)
    uniform = np.full_like(h, math.sqrt(2 / 3000))
    assert norm(uniform) > 1.3 * norm(h)


def test_front_is_interpolated_better_than_by_equal_cells():
    """The interpolation error e = h^2 |u''| / 8 of a tanh layer: its mean over the domain."""
    x, y = grid((0, 0), (1, 1), (401, 401))
    u = np.tanh(60 * (x + 0.5 * y - 0.75))
    size = sizing.hessian_size(Raster(u, (0, 0), (1, 1)), n_cells=4000, p=1, h_max=0.1)
    t = 60 * (x + 0.5 * y - 0.75)
    curved = 1.25 * 60**2 * np.abs(2 * np.tanh(t) / np.cosh(t) ** 2)
    w = node_weights((0, 0), (1, 1), (401, 401))
    assert np.sum(w * curved / 4000) / np.sum(w * curved * size.values**2) > 5


def test_bounds_keep_the_number_of_cells():
    x, y = grid((0, 0), (1, 1), (101, 81))
    u = np.tanh(30 * (x - 0.5)) + 0.01 * y**2
    options = {"h_min": 0.01, "h_max": 0.05}
    size = sizing.hessian_size(Raster(u, (0, 0), (1, 1)), n_cells=2000, **options)
    assert (size.values.min(), size.values.max()) == (0.01, 0.05)
    w = node_weights((0, 0), (1, 1), (101, 81))
    assert np.sum(w / size.values**2) == pytest.approx(2000, rel=1e-9)
    with pytest.raises(InputError, match="400 to 10000 cells; change h_min, h_max or n_cells"):
        sizing.hessian_size(Raster(u, (0, 0), (1, 1)), n_cells=300, **options)
    pixels = sizing.hessian_size(Raster(u, (0, 0), (1, 1), at="centers"), n_cells=2000, **options)
    assert np.mean(1 / pixels.values**2) == pytest.approx(2000, rel=1e-9)


def test_gradient_size_gives_a_constant_change_per_cell():
    x, y = grid((0, 0), (2, 1), (81, 41))
    size = sizing.gradient_size(Raster(3 * x + 4 * y, (0, 0), (2, 1)), eps=0.1)
    assert size.values == pytest.approx(0.1 / 5)
    size = sizing.gradient_size(Raster(x * x, (0, 0), (2, 1)), eps=0.1, h_min=0.04, h_max=0.2)
    # The derivative of x^2 is exact inside, and by half a step off at the sides.
    expected = np.clip(0.1 / np.maximum(2 * x, 1e-9), 0.04, 0.2)
    assert size.values[:, 1:-1] == pytest.approx(expected[:, 1:-1])
    counted = sizing.gradient_size(Raster(np.cosh(x) + y, (0, 0), (2, 1)), n_cells=900)
    w = node_weights((0, 0), (2, 1), (81, 41))
    assert np.sum(w / counted.values**2) == pytest.approx(900, rel=1e-9)


def test_constant_solutions_give_h_max():
    flat = np.ones((5, 6))
    with pytest.raises(InputError, match=r"eps=0.1 gives no size; give h_max"):
        sizing.hessian_size(Raster(flat, (0, 0), (3, 1)), eps=0.1)
    assert sizing.gradient_size(Raster(flat, (0, 0), (3, 1)), eps=0.1, h_max=0.5).values.max() == 0.5
    with pytest.raises(InputError, match=r"are 0 everywhere.*use a number"):
        sizing.hessian_size(Raster(flat, (0, 0), (3, 1)), n_cells=100)


@pytest.mark.parametrize("scale", [1e-120, 1e120])
def test_units_do_not_matter(scale):
    x, y = grid((0, 0), (1, 1), (31, 31))
    u = np.sin(5 * x) * y
    plain = sizing.hessian_size(Raster(u, (0, 0), (1, 1)), n_cells=500).values
    assert sizing.hessian_size(Raster(u * scale, (0, 0), (1, 1)), n_cells=500).values == pytest.approx(plain)


def test_on_the_device(ctx):
    import pyopencl as cl

    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype("float32"))
    x, y = grid((0, 0), (1, 1), (65, 65))
    size = sizing.hessian_size(Raster(np.tanh(9 * (x - y)), (0, 0), (1, 1)), n_cells=500, h_max=0.2)
    stage = sizing.Sizing(engine, Box((0, 0), (1, 1)), size)
    points = np.random.default_rng(2).random((100, 2))
    assert stage(points) == pytest.approx(size(points), rel=1e-5)


# --- gaps and scattered points -------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(9, 14), (5, 6, 7)])
def test_gaps_are_filled_with_the_nearest_value(shape):
    rng = np.random.default_rng(92)
    values = rng.uniform(1, 2, shape)
    spacing = np.array([0.5, 0.2, 0.3])[: len(shape)]
    gaps = rng.random(shape) < 0.6
    holed = np.where(gaps, np.nan, values)
    upper = spacing * (np.array(shape[::-1]) - 1)
    found = Raster(holed, (0,) * len(shape), upper, missing="nearest").values
    assert np.array_equal(found[~gaps], values[~gaps])
    places = np.argwhere(np.ones(shape, bool)) * spacing[::-1]
    known = ~gaps.ravel()
    least = cKDTree(places[known]).query(places)[0]
    for place, value, near in zip(places, found.ravel(), least, strict=True):
        away = np.linalg.norm(places[known] - place, axis=1)
        assert value in values.ravel()[known][away <= near * (1 + 1e-12)]
    masked = np.ma.masked_array(values, gaps)
    assert np.array_equal(Raster(masked, (0,) * len(shape), upper, missing="nearest").values, found)
    u = sizing.hessian_size(Raster(holed, (0,) * len(shape), upper, missing="nearest"), eps=0.1)
    v = sizing.hessian_size(Raster(found, (0,) * len(shape), upper), eps=0.1)
    assert np.array_equal(u.values, v.values)


def test_linear_data_are_interpolated_exactly():
    rng = np.random.default_rng(64)
    for d in (2, 3):
        points = np.vstack([rng.random((200, d)), np.argwhere(np.ones((2,) * d))]) + 10
        values = 1 + points @ np.arange(1, d + 1)
        field = sizing.Scattered(points, values, resolution=17)
        assert field.values.shape == (17,) * d
        x = 10 + rng.random((100, d))
        assert field(x) == pytest.approx(1 + x @ np.arange(1, d + 1), rel=1e-9)


def test_nearest_value_outside_of_the_hull():
    rng = np.random.default_rng(65)
    points, values = rng.random((50, 2)), rng.uniform(1, 2, 50)
    field = sizing.Scattered(points, values, (-1, -1), (2, 3), resolution=(25, 41), method="nearest")
    nodes = np.stack(grid((-1, -1), (2, 3), (25, 41)), axis=-1).reshape(-1, 2)
    away = np.linalg.norm(nodes[:, None] - points, axis=2)
    assert np.array_equal(field.values.ravel(), values[away.argmin(axis=1)])
    linear = sizing.Scattered(points, values, (-1, -1), (2, 3), resolution=(25, 41))
    far = (nodes < -0.2).any(axis=1)
    assert np.array_equal(linear.values.ravel()[far], field.values.ravel()[far])
    assert linear.values.min() >= values.min() * (1 - 1e-12)


def test_default_resolution_follows_the_points():
    rng = np.random.default_rng(66)
    field = sizing.Scattered(rng.random((400, 2)) * (4, 1), np.ones(400), (0, 0), (4, 1))
    assert field.values.shape == (21, 81)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: Raster([[1, np.nan], [np.nan, 2]], (0, 0), (1, 1)),
            InputError,
            r"\[0, 1\] is nan.*2 of 4 are missing.*missing='nearest'",
        ),
        (lambda: Raster([[np.nan]], (0, 0), (1, 1), missing="nearest"), InputError, "all missing"),
        (lambda: Raster([[1, np.inf]], (0, 0), (1, 1), missing="nearest"), InputError, r"\[0, 1\] is inf"),
        (lambda: Raster([[1]], (0, 0), (1, 1), missing="zero"), InputError, "'nearest'"),
        (lambda: sizing.hessian_size(FLAT), InputError, "exactly one"),
        (lambda: sizing.hessian_size(Raster(np.ones((2, 3)), (0, 0), (1, 1)), eps=1), InputError, "at least 3"),
        (lambda: sizing.hessian_size(FLAT, eps=1, p=0.5), InputError, "at least 1"),
        (lambda: sizing.hessian_size(FLAT, eps=0), InputError, "hessian_size eps"),
        (lambda: sizing.gradient_size(FLAT, eps=1, h_min=2, h_max=1), InputError, "h_min <= h_max"),
        (lambda: Raster(np.ones((3, 3)), (0, 0), (1, 0)), InputError, "Raster got lower"),
        (lambda: Raster("ab", (0, 0), (1, 1)), InputError, "shape"),
        (lambda: sizing.gradient_size(np.ones((3, 3)), eps=1), InputTypeError, r"gradient_size\(Raster\(values"),
        (lambda: sizing.Scattered([(0, 0)], [1]), InputError, "pass lower and upper"),
        (lambda: sizing.Scattered(np.zeros((0, 2)), []), InputError, "no points"),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], [1, 2], (0, 0), (1, 1)), InputError, "method='nearest'"),
        (lambda: sizing.Scattered([(0, 0), (1, 1), (2, 2), (3, 3)], [1, 2, 3, 4]), InputError, "on a line"),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], [1]), InputError, r"shape \(1,\) for 2"),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], [1, np.nan]), InputError, r"values\[1\] is nan"),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], ["a", "b"]), InputTypeError, "real numbers"),
        (
            lambda: sizing.Scattered([(0, 0), (1, 0), (0, 1), (1, 0)], [1, 2, 3, 4]),
            InputError,
            r"points\[1\] and points\[3\] are at the same place",
        ),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], [1, 2], method="cubic"), InputError, "'linear' or 'nearest'"),
        (lambda: sizing.Scattered([(0, 0), (1, 1)], [1, 2], resolution=1), InputError, "at least 2"),
    ],
)
def test_bad_input(make, error, message):
    with pytest.raises(error, match=message):
        make()
