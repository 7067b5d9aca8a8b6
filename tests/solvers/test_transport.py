"""Prescribed volumes: Newton's steps, the volumes that they reach, and what is refused."""

import numpy as np
import pyopencl as cl
import pytest
import shapely

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.errors import InputError, InputTypeError, SizeErrorWarning
from clvoro.opencl.engine import Engine
from clvoro.tessellation.tessellator import Tessellator
from tests.reference.power_diagrams import polygon_power_cells, power_cells
from tests.reference.spheres import SphericalDiagram, random_points

BOXES = {2: clvoro.Box((-1, 0), (2, 1.5)), 3: clvoro.Box((0, 0, 5), (1, 2, 6))}


def random_case(dim, n, ratio, seed=61, periodic=False):
    """Return a box, generators, and volumes that differ by up to `ratio`."""
    rng, box = np.random.default_rng(seed), BOXES[dim]
    box = clvoro.Box(box.lower, box.upper, periodic=periodic)
    volumes = ratio ** rng.random(n)
    return box, rng.uniform(box.lower, box.upper, (n, dim)), volumes * box.measure / volumes.sum()


@pytest.mark.sparse(1)
@pytest.mark.parametrize(
    ("dim", "real", "periodic"),
    [
        (2, "float64", False),
        pytest.param(2, "float32", False, marks=pytest.mark.slow),
        (3, "float64", False),
        (2, "float64", True),
        pytest.param(2, "float32", (False, True), marks=pytest.mark.slow),
        (3, "float64", True),
    ],
)
def test_cells_get_any_volumes(ctx, dim, real, periodic):
    box, points, volumes = random_case(dim, 60, 30.0, periodic=periodic)
    found = clvoro.Adapter(ctx, real).transport(box, points, volumes)
    tolerance = 1e-10 if real == "float64" else 1e-3
    assert found.converged
    assert found.errors[-1] <= tolerance < found.errors[-2]
    assert len(found.errors) == len(found.shares) + 1 < 15
    d = found.diagram
    np.testing.assert_allclose(d.volumes, volumes, rtol=2 * tolerance)
    # The weights alone give these volumes.
    reference = power_cells(box, points, d.weights)[0]
    np.testing.assert_allclose(reference, volumes, rtol=1e-9 if real == "float64" else 3e-3)
    assert d.check(), d.check()


def test_newton_with_far_neighbors(ctx):
    """In a periodic box of four cells most neighbors are not nearest images. Newton's steps are still exact."""
    box, points, volumes = random_case(2, 4, 3.0, periodic=True)
    found = clvoro.Adapter(ctx).transport(box, points, volumes)
    assert found.converged
    # With the distances of nearest images the error falls by a constant factor, in 16 steps or more.
    assert len(found.shares) < 9


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_cells_on_a_sphere_get_any_areas(ctx, real):
    """Areas that grow sixfold to the north move cells far from their generators."""
    sphere, x = clvoro.Sphere(3.0), random_points(80, 5)
    areas = np.exp(0.9 * x[:, 2])
    areas *= sphere.measure / areas.sum()
    found = clvoro.Adapter(ctx, real).transport(sphere, 3 * x, areas)
    tolerance = 1e-10 if real == "float64" else 1e-3
    assert found.converged
    assert len(found.shares) < 12
    np.testing.assert_allclose(found.diagram.volumes, areas, rtol=2 * tolerance)
    reference = SphericalDiagram(x, found.diagram.weights / 9)
    np.testing.assert_allclose(9 * reference.areas, areas, rtol=1e-9 if real == "float64" else 3e-3)
    assert found.diagram.check(), found.diagram.check()


def test_newton_on_a_sphere_of_few_cells(ctx):
    """Its matrix has the derivatives of areas by weights, by differences of those of the reference."""
    x, step = random_points(16, 6), 1e-6
    weights = 0.2 * np.random.default_rng(3).random(16)
    sphere = clvoro.Sphere(1.0)
    engine = Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(np.float64), sphere.traits(np.dtype(np.float64)))
    power = Tessellator(Stages(engine), sphere, weighted=True)
    t = power.tessellate_weighted(engine.upload(x), engine.upload(weights), 16, exact=True)
    starts, neighbors, measures = (a.get() for a in (t.starts, t.neighbors, power.laplacian_measures(t)))
    matrix, owner = np.zeros((16, 16)), np.repeat(np.arange(16), np.diff(starts))
    np.add.at(matrix, (owner, neighbors[: len(owner)]), -measures[: len(owner)])
    matrix /= 2 * np.maximum(np.linalg.norm(x[:, None] - x, axis=2), 1e-9)
    for j in range(0, 16, 5):
        more, less = (SphericalDiagram(x, weights + s * step * (np.arange(16) == j)).areas for s in (1, -1))
        slope = (more - less) / (2 * step)
        others = np.arange(16) != j
        np.testing.assert_allclose(matrix[others, j], slope[others], atol=1e-6)


@pytest.mark.slow
def test_cells_in_a_polygon_get_any_volumes(ctx):
    """A wall is thinner than a cell, so that cells lie on both sides of it."""
    points = np.random.default_rng(7).uniform((0, 0), (2, 1), (80, 2))
    domain = clvoro.Polygon(
        [(0, 0), (2, 0), (2, 1), (1.02, 1), (1.02, 0.3), (0.98, 0.3), (0.98, 1), (0, 1)],
        [[(1.4, 0.4), (1.7, 0.4), (1.5, 0.7)]],
    )
    points = points[domain.contains(points)]
    volumes = 10 ** np.random.default_rng(9).random(len(points))
    volumes *= domain.measure / volumes.sum()
    found = clvoro.Adapter(ctx).transport(domain, points, volumes)
    assert found.converged
    assert len(found.shares) < 15
    np.testing.assert_allclose(found.diagram.volumes, volumes, rtol=1e-10)
    areas = shapely.area(polygon_power_cells(domain, points, found.diagram.weights))
    np.testing.assert_allclose(areas, volumes, rtol=1e-8)


def test_volumes_in_pieces_of_a_domain(ctx):
    pieces = shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(1.2, 0, 3, 1)])
    domain = clvoro.Polygon.from_shapely(pieces)
    points = np.random.default_rng(2).uniform((0, 0), (3, 1), (60, 2))
    points = points[domain.contains(points)]
    first = points[:, 0] < 1.1
    volumes = np.where(first, 1 / first.sum(), 1.8 / (~first).sum())
    found = clvoro.Adapter(ctx).transport(domain, points, volumes)
    assert found.converged
    np.testing.assert_allclose(found.diagram.volumes, volumes, rtol=1e-10)
    with pytest.raises(InputError, match="in piece 0 of the domain"):
        clvoro.Adapter(ctx).transport(domain, points, np.full(len(points), 2.8 / len(points)))


def test_steps_do_not_depend_on_the_number_of_cells(ctx):
    adapter = clvoro.Adapter(ctx)
    steps = []
    for n in (100, 6000):
        box, points, _ = random_case(2, n, 1.0)
        found = adapter.transport(box, points, np.full(n, box.measure / n))
        assert found.converged
        steps.append(len(found.shares))
    assert max(steps) <= min(steps) + 3


def test_the_same_bits(ctx):
    box, points, volumes = random_case(2, 400, 5.0)
    one, two = (clvoro.Adapter(ctx).transport(box, points, volumes).diagram for _ in range(2))
    for name in ("weights", "volumes", "neighbors", "vertices"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()


def test_bad_input(ctx):
    adapter, (box, points, volumes) = clvoro.Adapter(ctx), random_case(2, 50, 3.0)
    for wrong, words in (
        (1.01 * volumes, "expected that of the domain"),
        (np.where(np.arange(50) < 3, 0, volumes), "3 of 50"),
        (volumes[:-1], "shape"),
        (np.where(np.arange(50) < 2, np.nan, volumes), "2 of 50 are not"),
        (np.where(np.arange(50) < 1, np.inf, volumes), "finite"),
    ):
        with pytest.raises(InputError, match=words):
            adapter.transport(box, points, wrong)
    with pytest.raises(InputTypeError, match="3 masked numbers"):
        adapter.transport(box, points, np.ma.masked_where(np.arange(50) < 3, volumes))
    # Volumes in single precision cannot have the sum of the domain more accurately.
    single = volumes.astype(np.float32)
    assert abs(single.sum(dtype=float) / box.measure - 1) > 1e-9
    assert adapter.transport(box, points, single).converged
    with pytest.warns(SizeErrorWarning, match="of 50 cells differ .* more max_steps"):
        found = adapter.transport(box, points, volumes, max_steps=1)
    assert not found.converged
    assert clvoro.Adapter(ctx).transport(box, points[:1], [box.measure]).diagram.volumes == [4.5]
    # On a sphere no cell can be larger than a half.
    globe = clvoro.Sphere(1.0)
    areas = np.where(np.arange(40) == 0, globe.measure - 0.039, 1e-3)
    with pytest.warns(SizeErrorWarning, match="nearer to those of the Voronoi cells"):
        assert not adapter.transport(globe, globe.even_points(40), areas).converged


def test_relaxed_cells_are_round_and_have_their_volumes(ctx):
    """Lloyd's moves between transports, one by one with the public interface, give the same generators."""
    adapter, rng = clvoro.Adapter(ctx), np.random.default_rng(4)
    box = clvoro.Box((0, 0), (1, 1), periodic=True)
    points, volumes = rng.random((40, 2)), rng.uniform(0.5, 1.5, 40)
    volumes /= volumes.sum()
    relaxed = adapter.transport(box, points, volumes, relax=2)
    assert relaxed.diagram.volumes == pytest.approx(volumes, rel=1e-9)
    for _ in range(2):
        points = box.wrap(adapter.transport(box, points, volumes, tolerance=1e-2).diagram.centroids)
    assert relaxed.diagram.points == pytest.approx(points, abs=1e-12)
    off = np.linalg.norm(relaxed.diagram.centroids - relaxed.diagram.points, axis=1)
    assert off.mean() < 0.05 * 40**-0.5 * 4
