"""Fields on cells, derivatives on the neighbor graph, and sizes from a solution."""

import math
import warnings

import numpy as np
import pytest
import scipy

import clvoro
from clvoro import sizing
from clvoro.errors import InputError, InputTypeError
from clvoro.sizing.derivatives import CellStencils, Derivatives
from tests.reference.derivatives import fit_quadratics

RNG = np.random.default_rng(3)
SQUARE = clvoro.Box((0, 0), (1, 1))
DOMAINS = {
    "box": SQUARE,
    "periodic": clvoro.Box((5, 0), (6, 1), (True, False)),
    "polygon": clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]),
    "space": clvoro.Box((0, 0, 0), (1, 1, 2)),
    "sphere": clvoro.Sphere(10.0),
}


def nearly_regular(domain):
    """Return a few hundred generators, far from any lattice."""
    if domain.curved:
        t = np.arange(400) + 0.5
        z, angle = 1 - t / 200, t * np.pi * (3 - np.sqrt(5))
        return np.column_stack([np.cos(angle), np.sin(angle), z / np.sqrt(1 - z**2)]) * np.sqrt(1 - z**2)[:, None] * 10
    axes = [
        np.arange(low + 0.05, high, 0.1 * domain.dim - 0.1)
        for low, high in zip(domain.lower, domain.upper, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, domain.dim)
    points = points + np.random.default_rng(2).uniform(-0.03, 0.03, points.shape)
    return points[domain.contains(points)]


@pytest.fixture(scope="module")
def meshes():
    return {name: clvoro.voronoi(domain, nearly_regular(domain)) for name, domain in DOMAINS.items()}


@pytest.fixture(scope="module")
def fine():
    return clvoro.adapt(SQUARE, 0.025, "fast")


@pytest.mark.parametrize("name", ["periodic", "polygon", "space"])
def test_derivatives_agree_with_the_reference(meshes, make_engine, name):
    mesh = meshes[name]
    u = RNG.uniform(-1, 1, len(mesh))
    engine = make_engine(mesh.domain.dim)
    got = Derivatives(engine, False).fit_quadratics(CellStencils.of(mesh), u[:, None], 1.0)
    for found, expected in zip(got, fit_quadratics(mesh, u), strict=True):
        rough = 1e-9 if engine.real == np.float64 else 1e-3
        assert np.abs(found[:, 0] - expected).max() < rough * np.abs(expected).max()


@pytest.mark.parametrize("name", ["box", "polygon", "space"])
def test_quadratic_functions_are_exact_at_walls_too(meshes, name):
    x = meshes[name].centroids.T
    u = 3 * x[0] ** 2 - 5 * x[1] ** 2 + 2 * x[0] * x[1] + 7 * x[-1]
    gradients, hessians = sizing.derivatives(np.stack([u, -u], axis=1), on=meshes[name])
    assert gradients[:, 0, 0] == pytest.approx(6 * x[0] + 2 * x[1])
    assert hessians[:, 1, :2, :2] == pytest.approx(np.broadcast_to([[-6, -2], [-2, 10]], (len(u), 2, 2)), abs=1e-8)


def test_derivatives_on_a_sphere(meshes):
    """u = x y is a spherical harmonic of degree 2: its Laplacian is -6 u / R^2. Its slope is at most R."""
    c = meshes["sphere"].centroids
    gradients, hessians = sizing.derivatives(c[:, 0] * c[:, 1], on=meshes["sphere"])
    assert np.abs((gradients * c).sum(axis=1)).max() < 1e-9
    inward = 0.02 * (c[:, 0] * c[:, 1])[:, None] * c
    assert gradients == pytest.approx(np.stack([c[:, 1], c[:, 0], 0 * c[:, 0]], axis=1) - inward, abs=0.8)
    laplacian = np.trace(hessians, axis1=1, axis2=2)
    assert laplacian == pytest.approx(-0.06 * c[:, 0] * c[:, 1], abs=0.3)


def test_gradients_are_of_second_order(fine):
    """At walls, too: with half the size a quarter of the error."""
    errors = []
    for mesh in (clvoro.adapt(SQUARE, 0.05, "fast"), fine):
        x, y = mesh.centroids.T
        gradients, _ = sizing.derivatives(np.sin(4 * x) * np.exp(y), on=mesh)
        exact = np.stack([4 * np.cos(4 * x), np.sin(4 * x)], axis=1) * np.exp(y)[:, None]
        errors.append(np.linalg.norm(gradients - exact, axis=1)[mesh.boundary_cells()].max())
    assert errors[0] / errors[1] > 3


def test_few_cells_have_derivatives():
    """One cell, two cells, and three in a row: what is unknown is 0."""
    for points in ([(0.5, 0.5)], [(0.2, 0.5), (0.7, 0.5)], [(0.1, 0.5), (0.5, 0.5), (0.8, 0.5)]):
        mesh = clvoro.voronoi(SQUARE, points)
        gradients, hessians = sizing.derivatives(2 * mesh.centroids[:, 0], on=mesh)
        assert gradients == pytest.approx(np.tile([2.0 * (len(points) > 1), 0], (len(points), 1)))
        assert hessians == pytest.approx(0, abs=1e-9)
        size = sizing.OnCells(mesh, np.full(len(points), 0.1))
        assert size([(0.3, 0.3)]) == pytest.approx(0.1)


@pytest.mark.parametrize("name", DOMAINS)
def test_fields_on_cells_are_the_same_on_the_device(meshes, make_engine, name):
    mesh = meshes[name]
    domain = mesh.domain
    x = mesh.centroids / domain.frame[1]
    field = sizing.OnCells(mesh, 0.1 + 0.05 * np.sin(3 * x[:, 0]) * np.cos(2 * x[:, 1]))
    points = mesh.points[RNG.integers(len(mesh), size=400)]
    points = points + RNG.normal(size=points.shape) * 0.05 * domain.frame[1]
    if domain.curved:
        points *= 10 / np.linalg.norm(points, axis=1)[:, None]
    points = points[domain.contains(points)]
    engine = make_engine(domain.dim)
    found = sizing.Sizing(engine, domain, field)(points)
    assert found == pytest.approx(field(points), abs=1e-12 if engine.real == np.float64 else 1e-5)


def test_fields_on_cells_interpolate(meshes, fine):
    """They have the values at the centroids, are of second order at walls, too, and continuous, and stay in bounds."""
    x, y = fine.centroids.T
    u = 1 + 0.5 * x * y
    field = sizing.OnCells(fine, u)
    assert field(fine.centroids) == pytest.approx(u, abs=1e-12)
    points = RNG.uniform(0, 1, (2000, 2))
    error = np.abs(field(points) - 1 - 0.5 * points.prod(axis=1))
    assert (error.mean(), error.max()) < (1e-4, 0.01)
    line = np.column_stack([np.linspace(0, 1, 100_001), np.full(100_001, 0.37)])
    steps = np.abs(np.diff(sizing.OnCells(fine, 1.0 + (x > 0.5))(line)))
    assert steps.max() < 1e-2
    jump = sizing.OnCells(fine, np.where(x > y, 1.0, 0.01))(points)
    assert jump.min() >= 0.01 * (1 - 1e-12)
    assert jump.max() <= 1 + 1e-12
    seam = meshes["periodic"]
    wave = sizing.OnCells(seam, 2 + np.sin(2 * np.pi * seam.centroids[:, 0]))
    assert wave([(5.0, 0.4)]) == pytest.approx(wave([(6.0, 0.4)]), abs=1e-9)


def test_growth_is_limited_around_walls(meshes):
    mesh = meshes["polygon"]
    stencils = CellStencils.of(mesh)
    rough = RNG.uniform(0.05, 1, len(mesh))
    limited = stencils.limit_growth(rough, 0.2)
    assert (limited <= rough).all()
    rise = limited[stencils.neighbors] - limited[stencils.owners]
    assert (rise <= 0.2 * stencils.lengths + 1e-12).all()
    # The end of one arm of the L is farther from that of the other than the straight line.
    start = np.where(mesh.centroids[:, 0] > 1.9, 1e-9, 100.0)
    way = stencils.limit_growth(start, 1.0)[mesh.locate([(0.9, 1.95)])[0]]
    assert way > np.hypot(1.1, 0.95)


@pytest.mark.parametrize("p", [1, 2, math.inf])
def test_sizes_follow_the_formula(fine, p):
    """u = cosh(3 x) has l = 9 cosh(3 x)."""
    x = fine.centroids[:, 0]
    made = sizing.hessian_size(np.cosh(3 * x), on=fine, n_cells=5000, p=p, growth=10)
    power = 0.5 if math.isinf(p) else p / (2 * p + 2)
    exact = np.cosh(3 * x) ** -power
    exact *= math.sqrt(np.sum(fine.volumes / exact**2) / 5000)
    assert made.values == pytest.approx(exact, rel=0.06)
    assert made.n_cells == pytest.approx(5000, rel=1e-6)
    assert made.error == pytest.approx(made.values**2 * 9 * np.cosh(3 * x) / 8, rel=0.12)
    again = sizing.hessian_size(np.cosh(3 * x), on=fine, eps=made.norm, p=p, growth=10)
    assert again.values == pytest.approx(made.values, rel=0.02)
    # A layer, whose sizes are smoothed: growth and error keep their limits.
    thin = sizing.hessian_size(np.tanh(20 * (x - 0.5)), on=fine, eps=made.norm, p=p)
    stencils = CellStencils.of(fine)
    rise = thin.values[stencils.neighbors] - thin.values[stencils.owners]
    assert (rise <= math.log(1.2) * stencils.lengths * (1 + 1e-9)).all()
    assert thin.norm <= made.norm * (1 + 1e-9)


def test_the_predicted_error_is_that_of_the_next_mesh(fine):
    """Of linear interpolation between the generators: h^2 l / 8 is its largest value in an edge h."""

    def layer(x):
        return np.tanh(20 * (x.sum(axis=-1) - 1))

    coarse, finer = (sizing.hessian_size(layer(fine.centroids), on=fine, n_cells=n, growth=3) for n in (1000, 4000))
    assert coarse.norm / finer.norm == pytest.approx(4, rel=0.1)
    predicted = sizing.hessian_size(layer(fine.centroids), on=fine, n_cells=1000)
    after = clvoro.adapt(SQUARE, predicted, "fast", n_cells=1000)
    assert np.abs(after.size_error).mean() < 0.03
    x = np.random.default_rng(0).uniform(0.1, 0.9, (20_000, 2))
    error = scipy.interpolate.LinearNDInterpolator(after.points, layer(after.points))(x) - layer(x)
    assert np.sqrt((error**2).mean()) == pytest.approx(predicted.norm, rel=0.3)


def test_both_sides_of_a_layer_count(fine):
    """u'' changes its sign in a layer that is three cells thick: in its middle cells are small, too."""
    x = fine.centroids[:, 0]
    made = sizing.hessian_size(np.tanh(20 * (x - 0.5)), on=fine, n_cells=2000, growth=2)
    inside = made.values[np.abs(x - 0.5) < 0.05]
    assert inside.max() < 1.2 * inside.min()
    # A run evaluates sizes at the generators.
    assert made(fine.points) == pytest.approx(made.values, rel=1e-12)


@pytest.mark.parametrize("h_max", [np.inf, 1e9])
def test_sizes_on_a_sphere_stay_below_its_radius(meshes, h_max):
    """Larger ones are refused by a run, which scales them to a number of cells."""
    mesh = meshes["sphere"]
    made = sizing.hessian_size(np.tanh(2 * mesh.centroids[:, 2]), on=mesh, n_cells=300, h_max=h_max, growth=10)
    assert made.values.max() == pytest.approx(0.8 * mesh.domain.radius, rel=1e-6)


def test_fields_of_other_units_count_alike(fine):
    x, y = fine.centroids.T
    u, w = np.tanh(20 * (x - 0.5)), 1e6 * np.tanh(20 * (y - 0.5))
    both = sizing.hessian_size([u, w], on=fine, n_cells=2000)
    swapped = sizing.hessian_size([1e-6 * w, 1e6 * u], on=fine, n_cells=2000)
    assert both.values == pytest.approx(swapped.values, rel=1e-6)
    near = [both([p])[0] for p in ((0.52, 0.1), (0.1, 0.52), (0.1, 0.1))]
    assert near[0] == pytest.approx(near[1], rel=0.2)
    assert near[2] > 2 * near[0]
    # The components of a vector have one unit.
    vector = sizing.hessian_size(np.stack([u, w], axis=1), on=fine, n_cells=2000)
    assert vector([(0.52, 0.1)]) > 2 * vector([(0.1, 0.52)])
    weighted = sizing.hessian_size(u, on=fine, n_cells=2000, weight=(y < 0.5).astype(float))
    assert weighted([(0.52, 0.9)]) > 2 * weighted([(0.52, 0.1)])
    both, large = (sizing.hessian_size(u[:, None] * [1, 2] * f, on=fine, n_cells=800) for f in (1, 1e290))
    assert large.values == pytest.approx(both.values, rel=1e-9)
    small = sizing.gradient_size(u * 1e-290, on=fine, n_cells=800)
    assert small.values == pytest.approx(sizing.gradient_size(u, on=fine, n_cells=800).values, rel=1e-9)


def test_weights_of_goals(fine):
    """By the distance from a boundary, and by the gradients of adjoint velocities."""
    x, y = fine.centroids.T
    found = sizing.force_weight("xMin", fine)
    assert found == pytest.approx((1 + x / 0.3) ** -2, rel=0.03)
    assert sizing.force_weight(["xMin", "yMin"], fine, length=0.1, power=1) == pytest.approx(
        1 / (1 + np.minimum(x, y) / 0.1), rel=0.04
    )
    assert sizing.steepness(np.stack([3 * x, 4 * y], axis=1), fine) == pytest.approx(5)
    # The means over the domain are those of the fields, scaled to 1.
    assert sizing.steepness([x, 7 * y**2], fine) == pytest.approx(np.maximum(1, 2 * y), rel=0.01)


def test_gradients_and_sensors(fine):
    x, y = fine.centroids.T - 0.5
    u = np.tanh(20 * x)
    across = sizing.gradient_size(u, on=fine, eps=2 / 8, h_max=0.2)
    assert across.error.max() <= 0.25 * (1 + 1e-9)
    assert across([(0.5, 0.5)]) == pytest.approx(0.25 / 20, rel=0.2)
    turning, strained = np.stack([-y, x], axis=1), np.stack([x, -y], axis=1)
    assert sizing.vorticity(turning, fine) == pytest.approx(2, rel=1e-9)
    assert sizing.vorticity(strained, fine) == pytest.approx(0, abs=1e-9)
    assert sizing.q_criterion(turning, fine) == pytest.approx(1, rel=1e-9)
    assert sizing.q_criterion(strained, fine) == pytest.approx(0, abs=1e-9)
    pressure = 2 + np.tanh(20 * x)
    pressing = sizing.shock_sensor(np.stack([-u, 0 * u], axis=1), pressure, fine)
    assert pressing.max() > 5
    assert sizing.shock_sensor(-np.stack([-u, 0 * u], axis=1), pressure, fine).max() < 1
    share = np.full(len(fine), 0.4)
    resolved = sizing.sensor_size(share / 0.1 ** (2 / 3), on=fine, order=2 / 3, eps=0.2)
    assert resolved.values == pytest.approx(0.1 * 0.5**1.5, rel=1e-9)
    distance = sizing.interface_distance(x, fine)
    assert distance == pytest.approx(np.abs(x), rel=0.17, abs=0.01)


def test_combinations_and_numbers(fine):
    x, y = fine.centroids.T
    left, low = (sizing.hessian_size(np.tanh(30 * (a - 0.3)), on=fine, n_cells=1500) for a in (x, y))
    both, mean = sizing.combine(left, low), sizing.combine(left, low, by="mean")
    assert (both.values == np.minimum(left.values, low.values)).all()
    assert mean.n_cells == pytest.approx(1500, rel=1e-3)
    assert (both.values <= mean.values * (1 + 1e-12)).all()
    again = sizing.normalize(both, n_cells=1500, h_max=0.1)
    assert again.n_cells == pytest.approx(1500, rel=1e-5)
    assert again.values.max() <= 0.1
    assert sizing.normalize(both, eps=both.norm / 4, growth=10).values == pytest.approx(both.values / 2, rel=1e-6)
    # Estimates of other orders, in any sequence.
    steep = sizing.gradient_size(x**2, on=fine, eps=0.05, h_max=0.2)
    made = [sizing.combine(*pair) for pair in ((left, steep), (steep, left))]
    assert [(e.order, e.p) for e in made] == [(1, math.inf)] * 2
    # A window in time, over meshes that differ.
    other = clvoro.adapt(SQUARE, 0.05, "fast")
    later = sizing.hessian_size(np.tanh(30 * (other.centroids[:, 0] - 0.6)), on=other, n_cells=1500)
    window = sizing.combine(left, later)
    assert len(window.values) == len(other)
    assert all(window([(at, 0.5)]) < 1.3 * e([(at, 0.5)]) for at, e in ((0.3, left), (0.6, later)))


GRID = sizing.Raster(np.ones((4, 4)), (0, 0), (1, 1))


@pytest.mark.parametrize(
    ("call", "kind", "text"),
    [
        (lambda m: sizing.OnCells(m, np.ones(3)), InputError, "a row for each cell"),
        (lambda m: sizing.OnCells(m, np.full(len(m), np.nan)), InputError, r"values\[0\] is nan"),
        (lambda m: sizing.OnCells(m, np.ones((len(m), 2))), InputError, "one for each cell"),
        (lambda m: sizing.OnCells("mesh", [1]), InputTypeError, "expected a clvoro.Result"),
        (lambda m: sizing.OnCells(m, ["a"] * len(m)), InputTypeError, "real numbers"),
        (
            lambda m: sizing.hessian_size(np.ones(len(m)), on=m, n_cells=50),
            InputError,
            "nothing to follow: the derivatives",
        ),
        (lambda m: sizing.hessian_size(m.centroids[:, 0], on=m, n_cells=50), InputError, "are 0 everywhere"),
        (lambda m: sizing.hessian_size(np.ones(len(m)), on=m), InputError, "exactly one"),
        (lambda m: sizing.hessian_size(GRID, on=m, eps=1), InputTypeError, "values"),
        (lambda m: sizing.hessian_size(np.ones((4, 4)), n_cells=9), InputTypeError, "on=mesh"),
        (lambda m: sizing.hessian_size(GRID, n_cells=9, growth=1.1), InputError, "Graded"),
        (lambda m: sizing.hessian_size([], on=m, eps=1), InputError, "a row for each"),
        (lambda m: sizing.hessian_size(m.points[:, 0], on=m, eps=1, weight=-np.ones(len(m))), InputError, "absolute"),
        (lambda m: sizing.hessian_size(m.points[:, 0] ** 2, on=m, n_cells=9, h_max=0.01), InputError, "change h_min"),
        (lambda m: sizing.gradient_size(m.points[:, 0], on=m, eps=1, growth=0.5), InputError, "growth"),
        (lambda m: sizing.sensor_size(np.zeros(len(m)), on=m, n_cells=9), InputError, r"the sensor.* are 0 everywhere"),
        (lambda m: sizing.sensor_size(-np.ones(len(m)), on=m, eps=1), InputError, "absolute value"),
        (lambda m: sizing.interface_distance(np.ones(len(m)), m), InputError, "both signs"),
        (lambda m: sizing.vorticity(np.ones((len(m), 3)), m), InputError, "component for each axis"),
        (lambda m: sizing.shock_sensor(m.points, -np.ones(len(m)), m), InputError, "positive"),
        (lambda m: sizing.combine(), InputError, "expected estimates"),
        (lambda m: sizing.force_weight("wing", m), InputError, "some of xMin, xMax"),
        (lambda m: sizing.force_weight("xMin", m, length=0), InputError, "length"),
    ],
)
def test_bad_input_is_refused(meshes, call, kind, text):
    with pytest.raises(kind, match=text):
        call(meshes["box"])


def test_a_cell_without_neighbors_has_the_largest_size():
    mesh = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), [(0.3, 0.5)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sizing.hessian_size([1.0], on=mesh, eps=0.01, h_max=0.2).values.tolist() == [0.2]
