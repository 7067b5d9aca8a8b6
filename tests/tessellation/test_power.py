"""Power diagrams against brute force, against Voronoi diagrams, and in files."""

from contextlib import nullcontext

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import EmptyCellsWarning, InputError, InputTypeError
from tests.reference.power_diagrams import polygon_power_cells, power_cells
from tests.reference.spheres import SphericalDiagram, random_points

BOXES = {2: clvoro.Box((-1, 0), (2, 1.5)), 3: clvoro.Box((0, 0, 5), (1, 2, 6))}
SQUARE = clvoro.Box((0, 0), (1, 1))
BAYS = clvoro.Polygon(
    [(0, 0), (4, 0), (4, 3), (2.2, 3), (2.2, 1.2), (1.8, 1.2), (1.8, 3), (0, 3)],
    [[(2.7, 0.5), (3.3, 0.5), (3.3, 0.9), (2.7, 0.9)], [(0.5, 1), (1, 0.9), (0.9, 1.6)]],
)
"""Two bays with a wall between them, thinner than a cell, and two islands."""


def random_case(dim, n, spread, seed=31, periodic=False):
    """Return a box, generators, and weights up to `spread` times the square of their distance."""
    rng, box = np.random.default_rng(seed), BOXES[dim]
    box = clvoro.Box(box.lower, box.upper, periodic=periodic)
    points = rng.uniform(box.lower, box.upper, (n, dim))
    return box, points, spread * (box.measure / n) ** (2 / dim) * rng.random(n) + 7


@pytest.mark.sparse(3)
@pytest.mark.parametrize(
    ("dim", "real", "periodic"),
    [
        (2, "float64", False),
        (2, "float32", False),
        (3, "float64", False),
        (2, "float64", True),
        (2, "float32", True),
        (2, "float64", (True, False)),
        (3, "float64", True),
        pytest.param(3, "float32", (False, True, True), marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::clvoro.errors.EmptyCellsWarning")
def test_cells_are_those_of_the_definition(ctx, dim, real, periodic):
    adapter = clvoro.Adapter(ctx, real)
    box, points, weights = random_case(dim, 50 if dim == 2 else 30, 3.0, periodic=periodic)
    d = adapter.power_diagram(box, points, weights)
    volumes, centroids = power_cells(box, points, weights)
    noise = 2e3 * np.finfo(adapter.dtype).eps * max(np.abs(box.upper))
    assert 2 < len(d.empty_cells) < 2 * len(points) / 3
    assert d.empty_cells.tolist() == np.flatnonzero(volumes == 0).tolist()
    np.testing.assert_allclose(d.volumes, volumes, atol=noise)
    filled = volumes > 1e-3 * volumes.mean()
    np.testing.assert_allclose(d.centroids[filled], centroids[filled], atol=1e3 * noise)
    assert d.check(), d.check()
    assert d.weights.tolist() == weights.tolist()
    # Cells are found by the power distance.
    inside = d.domain.wrap(d.centroids[filled])
    assert d.locate(inside).tolist() == np.flatnonzero(filled).tolist()


@pytest.mark.sparse(1)
@pytest.mark.filterwarnings("ignore::clvoro.errors.EmptyCellsWarning")
@pytest.mark.parametrize(
    ("spread", "slope", "real"),
    [
        (3.0, (0, 0), "float64"),
        (0.5, (1.4, -1.0), "float64"),
        pytest.param(3.0, (0, 0), "float32", marks=pytest.mark.slow),
    ],
)
def test_cells_in_a_polygon_are_those_of_the_definition(ctx, spread, slope, real):
    """Slopes of the weights move cells away from their generators, also out of the domain."""
    rng = np.random.default_rng(18)
    points = rng.uniform(BAYS.lower, BAYS.upper, (60, 2))
    points = points[BAYS.contains(points)]
    n = len(points)
    weights = spread * BAYS.measure / n * rng.random(n) + points @ slope
    d = clvoro.Adapter(ctx, real).power_diagram(BAYS, points, weights)
    cells = polygon_power_cells(BAYS, points, weights)
    areas = shapely.area(cells)
    noise = 2e4 * np.finfo(real).eps
    np.testing.assert_allclose(d.volumes, areas, atol=noise)
    filled = areas > 1e-2 * areas.mean()
    centroids = shapely.get_coordinates(shapely.centroid(np.array(cells)[filled]))
    np.testing.assert_allclose(d.centroids[filled], centroids, atol=1e3 * noise)
    assert d.empty_cells.tolist() == np.flatnonzero(areas == 0).tolist() != []
    assert d.check(), d.check()
    # Some cells lie on both sides of the wall.
    assert sum(c.geom_type == "MultiPolygon" for c in cells) > 0
    places = rng.uniform(BAYS.lower, BAYS.upper, (300, 2))
    places = places[BAYS.contains(places)]
    squares = ((places[:, None] - points) ** 2).sum(axis=2) - weights
    assert d.locate(places).tolist() == squares.argmin(axis=1).tolist()


@pytest.mark.sparse(1)
@pytest.mark.filterwarnings("ignore::clvoro.errors.EmptyCellsWarning")
@pytest.mark.parametrize("dim", [2, 3])
def test_images_carry_the_weights_of_their_generators(ctx, dim):
    """Few cells with very different weights: their neighbors are far images, also their own."""
    adapter, rng = clvoro.Adapter(ctx), np.random.default_rng(12)
    for n, spread in ((1, 0.0), (2, 0.5), (3, 2.0), (7, 2.0), (7, 8.0)):
        box, points, _ = random_case(dim, n, 0.0, seed=n, periodic=True)
        weights = spread * (box.measure / n) ** (2 / dim) * rng.random(n)
        d = adapter.power_diagram(box, points, weights)
        np.testing.assert_allclose(d.volumes, power_cells(box, points, weights)[0], atol=1e-12)
        assert d.volumes.sum() == pytest.approx(box.measure, rel=1e-13)
        assert d.check(), d.check()


@pytest.mark.sparse(1)
@pytest.mark.filterwarnings("ignore::clvoro.errors.EmptyCellsWarning")
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_cells_on_a_sphere_are_those_of_the_definition(ctx, real):
    """Weights of random size leave cells empty; those that grow to the north move cells by a third of a radian."""
    sphere, x, rng = clvoro.Sphere(2.0), random_points(120, 3), np.random.default_rng(14)
    noise = 2e3 * np.finfo(real).eps
    for weights, least in ((0.1 * rng.random(120) + 5, 5), (0.5 * x[:, 2], 0)):
        d = clvoro.Adapter(ctx, real).power_diagram(sphere, 2 * x, 4 * weights)
        reference = SphericalDiagram(x, weights)
        np.testing.assert_allclose(d.volumes, 4 * reference.areas, atol=noise)
        assert d.empty_cells.tolist() == np.flatnonzero(reference.areas == 0).tolist()
        assert len(d.empty_cells) >= least
        assert [sorted(d.cell(i).neighbors) for i in range(9)] == [sorted(row) for row in reference.neighbors[:9]]
        filled = reference.areas > 1e-2
        np.testing.assert_allclose((d.centroids / 2 - x)[filled], reference.offsets[filled], atol=10 * noise)
        assert d.check(), d.check()
        places = random_points(300, 4)
        assert d.locate(places).tolist() == (places @ x.T * np.exp(weights / 2)).argmax(axis=1).tolist()
    assert np.linalg.norm(d.centroids / 2 - x, axis=1).max() > 0.3


def test_weights_of_a_moved_periodic_diagram(ctx):
    """Weights with a smooth wave along x move the cells: the generators do not lie in them."""
    rng, box = np.random.default_rng(5), clvoro.Box((0, 0), (1, 1), periodic=True)
    points = rng.random((800, 2))
    weights = 0.05 * np.sin(2 * np.pi * points[:, 0])
    d = clvoro.Adapter(ctx).power_diagram(box, points, weights)
    away = np.abs(d.centroids - points)[:, 0]
    assert away.max() > 0.1  # three spacings; half the derivative of the weights is 0.16
    np.testing.assert_allclose(d.volumes, power_cells(box, points, weights)[0], atol=1e-12)
    assert d.check(), d.check()


@pytest.mark.parametrize("dim", [2, 3])
def test_equal_weights_give_the_voronoi_diagram(ctx, dim):
    box, points, _ = random_case(dim, 300, 0.0)
    adapter = clvoro.Adapter(ctx)
    power, voronoi = (adapter.power_diagram(box, points, np.full(300, -3.0)), adapter.diagram(box, points))
    rows = np.diff(voronoi.neighbor_starts)
    assert np.diff(power.neighbor_starts).tolist() == rows.tolist()
    for i in range(0, 300, 7):
        assert set(power.cell(i).neighbors) == set(voronoi.cell(i).neighbors)
    np.testing.assert_allclose(power.volumes, voronoi.volumes, rtol=1e-12)


def test_weights_that_are_linear_move_the_diagram(ctx):
    """|y - x|^2 - 2 a.x is |y + a - x|^2 up to a term without x: generators are far from their cells."""
    rng, shift = np.random.default_rng(8), np.array([0.31, -0.17])
    points = rng.random((3000, 2))
    inside = SQUARE.contains(points - shift)
    d = clvoro.Adapter(ctx).power_diagram(SQUARE, points[inside], 2 * points[inside] @ shift)
    moved = clvoro.Adapter(ctx).diagram(SQUARE, points[inside] - shift)
    assert len(d.empty_cells) == 0
    np.testing.assert_allclose(d.volumes, moved.volumes, rtol=1e-9)
    assert (d.neighbors >= 0).sum() == (moved.neighbors >= 0).sum()


@pytest.mark.parametrize("dim", [2, 3])
def test_many_cells_in_a_point(ctx, dim):
    """In a lattice with two weights in turn all corners are shared by more cells than faces determine."""
    line = (np.arange(6) + 0.5) / 6
    points = np.stack(np.meshgrid(*[line] * dim, indexing="ij"), -1).reshape(-1, dim)
    turn = np.stack(np.meshgrid(*[np.arange(6)] * dim, indexing="ij"), -1).reshape(-1, dim).sum(axis=1) % 2
    box = clvoro.Box((0,) * dim, (1,) * dim)
    for step in (0.0, 0.01, 0.03):
        with pytest.warns(EmptyCellsWarning) if step == 0.03 else nullcontext():
            d = clvoro.Adapter(ctx).power_diagram(box, points, step * turn)
        assert d.check(), d.check()
        # The square of the spacing is 0.0278. Cells with neighbors on both sides along an axis are empty.
        between = ((points > line[0]) & (points < line[-1])).any(axis=1)
        empty = np.flatnonzero((turn == 0) & between) if step == 0.03 else []
        assert d.empty_cells.tolist() == list(empty)


@pytest.mark.parametrize(
    ("points", "sizes"),
    [
        ([(0.31, 0.42), (0.81, 0.47), (0.52, 0.88)], (1e-4, 1e-7, 1e-10, 1e-13)),
        ([(0.2, 0.22, 0.18), (0.8, 0.25, 0.7), (0.3, 0.8, 0.75), (0.75, 0.7, 0.2)], (1e-4, 1e-8)),
    ],
)
def test_small_cells_pass_the_check(ctx, points, sizes):
    """The last cell grows from the vertex of the others, which is far from its generator for its size."""
    x, dim = np.array(points), len(points[0])
    w, last = 0.01 * np.arange(len(x)), np.full(dim, 0.5)
    squares = (x**2).sum(axis=1) - w
    vertex = np.linalg.solve(2 * (x[1:] - x[0]), squares[1:] - squares[0])
    least = ((vertex - last) ** 2).sum() - ((vertex - x[0]) ** 2).sum() + w[0]
    box = clvoro.Box((0,) * dim, (1,) * dim)
    for more in sizes:
        d = clvoro.Adapter(ctx).power_diagram(box, [*x, last], [*w, least + more])
        # The distances of the generators are about 0.5.
        assert 0 < d.volumes[-1] < (30 * more) ** dim
        assert d.check(), d.check()


@pytest.mark.filterwarnings("ignore::clvoro.errors.EmptyCellsWarning")
def test_the_first_and_the_last_row_are_empty(ctx):
    """Nothing is read beside the graph, where labels would be those of no generator."""
    adapter, points = clvoro.Adapter(ctx), np.random.default_rng(3).random((50, 2))
    for i in range(10):
        d = adapter.power_diagram(SQUARE, points, np.where(np.arange(50) == i, 2.0, 0.0))
        assert sorted(d.neighbors) == [-4, -3, -2, -1]
        assert d.volumes[i] == 1


def test_files_pictures_and_other_libraries(ctx, tmp_path):
    rng = np.random.default_rng(4)
    points, weights = rng.random((40, 2)), 0.02 * rng.random(40)
    with pytest.warns(EmptyCellsWarning, match="of 40 cells are empty"):
        d = clvoro.Adapter(ctx).power_diagram(SQUARE, points, weights)
    assert "power diagram" in repr(d)
    d.save(tmp_path / "d.npz")
    assert clvoro.load(tmp_path / "d.npz").weights.tolist() == weights.tolist()
    assert d.measures.quality[d.empty_cells].tolist() == [0] * len(d.empty_cells)
    d.plot("quality")
    with pytest.raises(InputError, match="leave out their generators"):
        d.save(tmp_path / "d.vtu")
    kept = d.volumes > 0
    full = clvoro.Adapter(ctx).power_diagram(SQUARE, points[kept], weights[kept])
    np.testing.assert_allclose(full.volumes, d.volumes[kept], rtol=1e-9)
    full.save(tmp_path / "d.vtu")
    loaded = clvoro.load(tmp_path / "d.vtu")
    assert loaded.check()
    assert loaded.weights.tolist() == full.weights.tolist()
    assert "weights[3] is nan" in str(
        full.with_arrays(weights=np.where(np.arange(len(full)) == 3, np.nan, full.weights)).check()
    )
    full.to_openfoam(tmp_path / "polyMesh", check=False)
    # Dual triangles cover the same part of the plane, counter-clockwise.
    a, b, c = points[kept][full.triangles()].swapaxes(0, 1)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    assert (ux * vy - uy * vx > 0).all()
    for refused in (
        full.to_disv,
        lambda: full.to_netcdf(tmp_path / "d.nc", convention="mpas"),
        lambda: full.check("mpas"),
    ):
        with pytest.raises(InputError, match="Voronoi"):
            refused()


def test_bad_input(ctx):
    adapter, points = clvoro.Adapter(ctx), np.array([(0.2, 0.3), (0.7, 0.2), (0.8, 0.8)])
    for weights, error, words in (
        ([0, 1], InputError, "shape"),
        ([0, 1, np.nan], InputError, "finite"),
        (["a", "b", "c"], InputTypeError, "real numbers"),
    ):
        with pytest.raises(error, match=words):
            adapter.power_diagram(SQUARE, points, weights)
    with pytest.raises(InputError, match="coincide"):
        adapter.power_diagram(SQUARE, points[[0, 0, 1]], [0, 1, 2])
    with pytest.raises(InputError, match="finite differences"):
        adapter.power_diagram(SQUARE, points, [1e308, -1e308, 0])
    with pytest.raises(InputError, match="leave a half of it free"):
        adapter.power_diagram(clvoro.Sphere(), [(0, 0, 1)], [0])
    globe = clvoro.Sphere(1.0)
    with pytest.raises(InputError, match="weights that differ less"):
        adapter.power_diagram(globe, globe.even_points(40), np.where(np.arange(40) == 3, 1e300, 0))
    with pytest.warns(EmptyCellsWarning, match="2 of 3"):
        d = adapter.power_diagram(SQUARE, points, [0, 1e300, 0])
    assert d.volumes.tolist() == [0, 1, 0]
    torus = clvoro.Box((0, 0), (1, 1), periodic=True)
    with pytest.warns(EmptyCellsWarning, match="2 of 3"):
        d = adapter.power_diagram(torus, points, [0, 1e300, 0])
    assert d.volumes.tolist() == [0, 1, 0]
