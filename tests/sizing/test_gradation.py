"""Gradation limiting: the scheme against a plain solver, and against min f(y) + g |x - y|."""

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import clvoro
from clvoro import Box, earth, sizing
from clvoro.errors import InputError, InputTypeError, MemoryLimitError
from clvoro.opencl.engine import Engine
from clvoro.opencl.memory_limits import host_memory
from clvoro.sizing.field import on_domain
from clvoro.sizing.gradation import Gradation, globe_columns


def jacobi(values, spacing, slope):
    """The fixed point of Godunov's scheme, all nodes at once, again and again; axes (y, x)."""
    u = values.copy()
    d = spacing[::-1]
    while True:
        lesser = []
        for axis in range(u.ndim):
            pad = [(1, 1) if a == axis else (0, 0) for a in range(u.ndim)]
            wide = np.pad(u, pad, constant_values=1e9)
            below = np.take(wide, range(u.shape[axis]), axis)
            above = np.take(wide, range(2, u.shape[axis] + 2), axis)
            lesser.append(np.minimum(below, above))
        # Bisection for sum (max(u - a_k, 0) / d_k)^2 = slope^2.
        low = np.min(lesser, axis=0)
        high = np.min([a + slope * s for a, s in zip(lesser, d, strict=True)], axis=0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            steep = sum((np.maximum(middle - a, 0) / s) ** 2 for a, s in zip(lesser, d, strict=True))
            low = np.where(steep < slope**2, middle, low)
            high = np.where(steep < slope**2, high, middle)
        fresh = np.minimum(u, high)
        if np.array_equal(fresh, u) or (u - fresh).max() < 1e-15:
            return fresh
        u = fresh


def cones(values, spacing, slope):
    """The least of f(y) + slope |x - y| over all nodes y."""
    axes = [np.arange(n) * s for n, s in zip(values.shape, spacing[::-1], strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, values.ndim)
    away = np.linalg.norm(x[:, None] - x, axis=2)
    return (values.ravel() + slope * away).min(axis=1).reshape(values.shape)


def limit(engine, values, spacing, slope):
    on_device = engine.upload(values.ravel())
    Gradation(engine).sweep_tiles(on_device, values.shape[::-1], spacing, slope)
    return on_device.get().astype(float).reshape(values.shape)


# Not whole tiles, one tile, thin strips; spacings differ along the axes.
SHAPES = [(45, 37), (16, 16), (3, 70), (1, 40), (1, 1), (11, 9, 18), (8, 8, 8), (2, 1, 30)]


@pytest.mark.sparse(3)
@pytest.mark.parametrize("shape", SHAPES)
def test_scheme_is_solved(make_engine, shape):
    engine = make_engine(len(shape))
    rng = np.random.default_rng(sum(shape))
    spacing = (0.02, 0.03, 0.025)[: len(shape)]
    values = rng.uniform(0.01, 0.2, shape) * 10 ** rng.uniform(-1, 1, shape)
    found = limit(engine, values, spacing, 0.4)
    # Decreases below 8 ulps are ignored, up to one at each node on the way.
    allowed = 16 * float(np.finfo(engine.real).eps) * max(shape)
    assert found == pytest.approx(jacobi(values, spacing, 0.4), rel=allowed)
    assert (found <= values.astype(engine.real)).all()
    # Converged: another sweep changes no more than that.
    assert limit(engine, found, spacing, 0.4) == pytest.approx(found, rel=allowed)


@pytest.mark.sparse(6)
@pytest.mark.parametrize("shape", SHAPES)
def test_minima_of_tiles(make_engine, shape):
    """They determine the order in which tiles are swept. Wrong minima would cost time, not accuracy."""
    engine = make_engine(len(shape))
    stage, counts = Gradation(engine), (*shape[::-1], 1)[:3]
    values = np.random.default_rng(sum(shape)).random(shape).astype(engine.real)
    starts = [np.arange(0, n, stage._tile) for n in shape]
    expected = values
    for axis, start in enumerate(starts):
        expected = np.minimum.reduceat(expected, start, axis)
    lowest = engine.empty(expected.size)
    engine.run_each(
        stage._kernels.tile_minima, expected.size, *map(np.int32, counts), engine.upload(values.ravel()), lowest
    )
    assert np.array_equal(lowest.get(), expected.ravel())


@pytest.mark.sparse(1)
@pytest.mark.parametrize("shape", [(61, 41), (17, 13, 15)])
@pytest.mark.parametrize("seeds", [1, 5, 400])
def test_result_is_close_to_the_smallest_cone(make_engine, shape, seeds):
    """Against the definition. The error of the scheme is towards larger values, except where fronts meet."""
    engine = make_engine(len(shape))
    rng = np.random.default_rng(seeds + 29)
    spacing = np.array([0.02, 0.03, 0.025])[: len(shape)]
    slope = 0.3
    values = np.full(shape, 1.0)
    values.ravel()[rng.integers(0, values.size, seeds)] = rng.uniform(0.05, 0.1, seeds)
    found, exact = limit(engine, values, spacing, slope), cones(values, spacing, slope)
    if seeds == 1:
        assert (found >= exact * (1 - 100 * np.finfo(engine.real).eps)).all()
    # |u - distance| <= c d log(1 / d) about a source for a scheme of first order; c is about 1.
    widest, farthest = spacing.max(), np.linalg.norm(spacing * shape[::-1])
    allowed = slope * widest * math.log(farthest / widest) * 0.5
    assert 0 < np.abs(found - exact).max() < allowed


def test_error_falls_with_the_spacing(make_engine):
    """A line source at an angle: the error of a plane front is zero, that of its end first order."""
    engine = make_engine(2)
    errors = []
    for n in (33, 65, 129, 257):
        x = np.linspace(0, 1, n)
        r = np.hypot(x[None, :] - 0.5, x[:, None] - 0.5)
        exact = 0.05 + 0.2 * np.maximum(r - 0.2, 0)
        values = np.where(r <= 0.2, 0.05, 1.0)
        # Nodes beside the disc have exact values, so that its staircase adds no error.
        values = np.where(r < 0.2 + 2.5 / 32, exact, values)
        errors.append(np.abs(limit(engine, values, (1 / (n - 1),) * 2, 0.2) - exact).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert orders.min() > 0.85


@pytest.mark.sparse(1)
def test_graded_values_stay_as_they_are(make_engine):
    for dim in (2, 3):
        engine = make_engine(dim)
        n = {2: 50, 3: 20}[dim]
        x = np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * dim, indexing="ij"))
        values = (0.1 + 0.19 * np.linalg.norm(x - 0.4, axis=0)).astype(engine.real).astype(float)
        assert np.array_equal(limit(engine, values, (1 / (n - 1),) * dim, 0.2), values)


@pytest.mark.filterwarnings("error")
def test_large_growth_changes_nothing(make_engine):
    """Also such as single precision has no number for."""
    engine, values = make_engine(2), np.random.default_rng(3).uniform(1e-3, 1, 33 * 20)
    values = values.astype(engine.real)
    for slope in (1e30, 1e300):
        u = engine.upload(values)
        Gradation(engine).sweep_tiles(u, (33, 20), (0.1, 0.05), slope)
        assert np.array_equal(u.get(), values)


def test_zero_growth_gives_the_minimum(make_engine):
    engine = make_engine(2)
    values = np.random.default_rng(5).uniform(1, 2, (40, 40))
    found = limit(engine, values, (0.1, 0.1), 0.0)
    assert found == pytest.approx(values.min(), rel=200 * float(np.finfo(engine.real).eps))


@pytest.mark.sparse(1)
def test_sizes_grow_around_obstacles(make_engine):
    """From corner to corner of a grid of many tiles."""
    engine = make_engine(2)
    values = np.full((300, 500), 9.0)
    values[0, 0] = 1.0
    found = limit(engine, values, (0.01, 0.01), 1.0)
    assert found[0] == pytest.approx(1 + 0.01 * np.arange(500), rel=1e-3)
    assert found[-1, -1] == pytest.approx(1 + 0.01 * np.hypot(299, 499), rel=1e-2)
    assert np.array_equal(found, limit(engine, values, (0.01, 0.01), 1.0))


# --- the field -----------------------------------------------------------------------------------

PLANE = Box((-1.0, 3.0), (1.0, 4.0))
JUMP = sizing.Expression("x < 0.1 ? 0.02 : 0.5")


@pytest.mark.sparse(1)
def test_a_jump_becomes_a_ramp(make_engine):
    engine = make_engine(2)
    field = sizing.Graded(JUMP, slope=0.25)
    stage = sizing.Sizing(engine, PLANE, field)
    x = np.random.default_rng(77).uniform(PLANE.lower, PLANE.upper, (2000, 2))
    ramp = np.minimum(0.02 + 0.25 * np.maximum(x[:, 0] - 0.1, 0), 0.5)
    # The jump lies somewhere within one spacing (the least size, 0.02).
    assert np.abs(stage(x) - ramp).max() < 0.25 * 0.02 + 1e-6
    assert field(x) == pytest.approx(stage(x), rel=1e-5)
    raster = field.raster(PLANE, engine)
    assert raster.values.shape == (65, 129)  # 129 along the longest side at least
    nodes = np.stack(np.meshgrid(np.linspace(-1, 1, 129), np.linspace(3, 4, 65)), -1)
    assert (raster.values.ravel() <= JUMP(nodes.reshape(-1, 2))).all()


@pytest.mark.sparse(1)
def test_slopes_are_bounded(make_engine):
    """Along the axes strictly; of the gradient to first order."""
    engine = make_engine(2)
    field = sizing.Graded(
        sizing.Distance([sizing.Circle((0.2, 3.4), 0.2), sizing.Segment((-1, 3), (0, 4))], 0.01, slope=3),
        slope=0.2,
        box=PLANE,
        resolution=(401, 201),
    )
    values = field.raster(engine=engine).values
    d = 2 / 400
    dx, dy = np.diff(values, axis=1) / d, np.diff(values, axis=0) / d
    noise = 1 + 1e-3 * (engine.real == np.float32) + 1e-9
    assert max(np.abs(dx).max(), np.abs(dy).max()) <= 0.2 * noise
    steep = np.hypot(0.5 * (dx[1:] + dx[:-1]), 0.5 * (dy[:, 1:] + dy[:, :-1]))
    assert np.quantile(steep, 0.99) < 0.2 * 1.05
    assert np.median(steep) > 0.2 * 0.97


def test_minima_between_nodes_are_included(make_engine):
    """A point source between nodes lowers the nodes around it."""
    engine = make_engine(2)
    source = np.array([0.3071, 3.4567])
    field = sizing.Graded(
        sizing.Distance(sizing.Circle(source, 0), 0.001, slope=50, h_max=1), slope=0.1, box=PLANE, resolution=41
    )
    raster = field.raster(engine=engine)
    x = np.random.default_rng(3).uniform(PLANE.lower, PLANE.upper, (500, 2))
    exact = 0.001 + 0.1 * np.linalg.norm(x - source, axis=1)
    # Interpolation of the tip and the scheme's error, both of the order of slope times spacing.
    assert np.abs(raster(x) - exact).max() < 0.1 * 0.05
    assert raster(source[None])[0] < 0.001 + 0.1 * 0.05


@settings(max_examples=12)
@given(st.integers(2, 40), st.integers(2, 40), st.floats(0, 2), st.integers(0, 2**32))
def test_result_is_below_the_field_and_idempotent(ctx, nx, ny, slope, seed):
    import pyopencl as cl

    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(float))
    values = np.random.default_rng(seed).uniform(0.1, 1, (ny, nx))
    field = sizing.Raster(values, (0, 0), (1, 2))
    graded = sizing.Graded(field, slope=slope, box=Box((0, 0), (1, 2)), resolution=(nx, ny))
    once = graded.raster(engine=engine)
    assert (once.values <= values * (1 + 1e-12)).all()
    assert once.values.min() == pytest.approx(values.min(), rel=1e-14)
    again = sizing.Graded(once, slope=slope, box=graded.box, resolution=(nx, ny))
    # The least values are landmarks, whose cones are exact to the corners of their pixels, where
    # the scheme is of first order: 1 + 1 / sqrt(2) of a spacing where sqrt(2) is exact.
    spacing = 1 / (nx - 1) + 2 / (ny - 1)
    assert again.raster(engine=engine).values == pytest.approx(once.values, rel=1e-12, abs=0.3 * slope * spacing)


@pytest.mark.sparse(1)
def test_3d_and_combined_fields(make_engine):
    engine = make_engine(3)
    domain = Box((0, 0, 0), (1, 1, 0.5))
    ball = sizing.Distance(sizing.Ball((0.5, 0.5, 0.2), 0.2), 0.02, slope=4, h_max=0.3)
    plain = sizing.Distance(sizing.Ball((0.5, 0.5, 0.2), 0.2), 0.02, slope=0.3, h_max=0.3)
    stage = sizing.Sizing(engine, domain, 2 * sizing.minimum(sizing.Graded(ball, slope=0.3), 0.2))
    x = np.random.default_rng(12).uniform(domain.lower, domain.upper, (1000, 3))
    expected = 2 * np.minimum(plain(x), 0.2)
    # First order in the spacing of 0.02, twice for the factor.
    assert np.abs(stage(x) - expected).max() < 2 * 0.3 * 0.02
    hosted = sizing.Sizing(engine, domain, sizing.minimum(sizing.Graded(ball, slope=0.3), lambda p: 0.2 + 0 * p[:, 0]))
    assert 2 * hosted(x) == pytest.approx(stage(x), rel=1e-5)


def test_result_is_cached(make_engine, monkeypatch):
    engine = make_engine(2)
    field = sizing.Graded(JUMP, slope=0.25)
    sizing.Sizing(engine, PLANE, field)
    monkeypatch.setattr(sizing.Graded, "_compute", None)
    sizing.Sizing(engine, PLANE, 2 * field)
    assert len(field.landmarks(PLANE)) > 0
    assert field([(0.0, 3.5)])[0] == pytest.approx(0.02)


def test_callables_are_graded(make_engine):
    engine = make_engine(2)
    graded = sizing.Graded(lambda p: np.where(p[:, 0] < 0.1, 0.02, 0.5), slope=0.25)
    assert graded.on_device
    x = np.random.default_rng(8).uniform(PLANE.lower, PLANE.upper, (200, 2))
    twin = sizing.Sizing(engine, PLANE, sizing.Graded(JUMP, slope=0.25))
    assert sizing.Sizing(engine, PLANE, graded)(x) == pytest.approx(twin(x), rel=1e-5)


def test_a_run_on_a_graded_field():
    size = sizing.Graded(sizing.Expression("x < 1 ? 0.05 : 0.4"), growth=1.3)
    result = clvoro.Adapter().run(clvoro.Box((0, 0), (2, 1)), size, max_steps=3)
    x = result.points[:, 0]
    ramp = np.minimum(0.05 + math.log(1.3) * np.maximum(x - 1, 0), 0.4)
    assert np.abs(result.target_size - ramp).max() < 1.01 * math.log(1.3) / 64  # one spacing


def test_resolution_is_chosen_and_capped(queue, monkeypatch):
    engine = Engine(queue.context, queue, 2, np.dtype(float))

    def shape(field, **options):
        return sizing.Graded(field, 1.2, box=PLANE, **options).raster(engine=engine).values.shape

    assert shape(0.3) == (65, 129)
    assert shape(0.004) == (251, 501)
    assert shape(0.3, resolution=21) == (11, 21)
    assert shape(0.3, resolution=(7, 5)) == (5, 7)
    tiny = sizing.Distance(sizing.Circle((0, 3.5), 0), 1e-5, slope=1)
    monkeypatch.setattr("clvoro.sizing.graded._MOST_NODES", 2**16)
    ny, nx = shape(tiny)
    assert 0.9 * 2**16 < nx * ny <= 2**16
    assert nx == pytest.approx(2 * ny, rel=0.01)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: sizing.Graded(1.0), InputError, "exactly one"),
        (lambda: sizing.Graded(1.0, slope=-1), InputError, "slope"),
        (lambda: sizing.Graded(1.0, 1.2, box=(0, 1)), InputTypeError, "clvoro.Box"),
        (lambda: sizing.Graded(1.0, 1.2, resolution=1), InputError, "at least 2"),
        (lambda: sizing.Graded(1.0, 1.2, resolution=(5, 5, 5), box=PLANE), InputError, "per axis"),
        (lambda: sizing.Graded(1.0, 1.2, resolution=2.5), InputTypeError, "integers"),
    ],
)
def test_bad_input(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_too_many_nodes_are_rejected_before_allocation(make_engine, monkeypatch):
    field = sizing.Graded(sizing.Expression("x < 0.5 ? 0.1 : 0.3"), slope=0.2, resolution=200)
    box = Box((0, 0), (1, 0.5))
    n = 200 * 101
    engine = make_engine(2)
    monkeypatch.setattr("clvoro.sizing.graded.host_memory", lambda: 48 * n - 1)
    monkeypatch.setattr(sizing.Graded, "_at_nodes", None)  # is not reached
    with pytest.raises(MemoryLimitError, match=r"resolution is 200, .* 2.02e\+04 nodes .* the host has"):
        field.raster(box, engine)
    monkeypatch.undo()
    monkeypatch.setattr("clvoro.sizing.graded.host_memory", lambda: 48 * n)
    assert field.raster(box, engine).values.size == n


@pytest.mark.slow
def test_host_memory_is_the_limit_of_the_process():
    pytest.importorskip("resource")
    whole = host_memory()
    assert 1e8 < whole < 1e15
    text = (
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (3 << 30, 3 << 30))\n"
        "from clvoro.opencl.memory_limits import host_memory; print(host_memory())"
    )
    found = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert int(found.stdout) == min(3 << 30, whole)


# --- on a sphere ---


def globe_cones(sphere, values, slope):
    """The least of f(y) + slope arc(x, y) over all nodes y of a grid in longitude and latitude."""
    ny, nx = values.shape
    lon, lat = np.meshgrid((np.arange(nx) + 0.5) * 360 / nx, (np.arange(ny) + 0.5) * 180 / ny - 90)
    x = sphere.positions(np.column_stack([lon.ravel(), lat.ravel()]))
    arcs = np.arccos(np.clip(x @ x.T / sphere.radius**2, -1, 1)) * sphere.radius
    return (values.ravel() + slope * arcs).min(axis=1).reshape(values.shape)


# One node, by longitude and latitude: on the equator, at the date line, beside the poles; and many.
SOURCES = {"equator": [(91, 1)], "date-line": [(180.1, 40)], "north": [(11, 89.9)], "south": [(-100, -87)]}


@pytest.mark.sparse(1)
@pytest.mark.parametrize("where", [*SOURCES, "many"])
def test_growth_on_a_sphere_is_along_great_circles(make_engine, where):
    engine, slope = make_engine(2), 0.3
    nx = globe_columns(90)
    ny, unit = nx // 2, clvoro.Sphere(1)
    rng, values = np.random.default_rng(71), np.full((ny, nx), 2.0)
    if where == "many":
        values.ravel()[rng.integers(0, values.size, 30)] = rng.uniform(0.05, 0.3, 30)
    for lon, lat in SOURCES.get(where, []):
        values[int((lat + 90) / 180 * ny), int(lon % 360 / 360 * nx)] = 0.05
    on_device = engine.upload(values.ravel())
    Gradation(engine, globe=True).sweep_tiles(on_device, (nx, ny), (2 * np.pi / nx, np.pi / ny), slope)
    found, exact = on_device.get().reshape(ny, nx), globe_cones(unit, values, slope)
    spacing = np.pi / ny
    # As in the plane. Fronts meet at the far side, where values are too low by less than half a step.
    assert (found >= exact - 0.5 * slope * spacing).all()
    assert np.abs(found - exact).max() < slope * spacing * math.log(np.pi / spacing) * 0.5
    assert nx % 64 == 32


def test_graded_on_a_sphere():
    """Small cells beside a pole and across the date line, in a function of longitude and latitude."""
    globe, slope = clvoro.Sphere(), math.log(1.2)
    marks = globe.positions([(50, 89), (180, -20)])

    def jump(lonlat):
        away = np.linalg.norm(globe.positions(lonlat)[:, None] - marks, axis=2).min(axis=1)
        return np.where(away < 5e5, 1e5, 1e6)

    given = sizing.Graded(earth.LonLat(jump), growth=1.2, resolution=300)
    field = on_domain(globe, given)
    x = globe.wrap(np.random.default_rng(72).normal(size=(2000, 3)))
    away = globe.lengths(np.linalg.norm(x[:, None] - marks, axis=2)).min(axis=1)
    expected = np.minimum(1e5 + slope * np.maximum(away - 5e5, 0), 1e6)
    step = 2 * np.pi * globe.radius / globe_columns(300)
    assert field(x) == pytest.approx(expected, abs=1.5 * slope * step)
    # Over the pole and across the date line there is no step.
    for ways in ([(a, b) for a in (0, 90, 180, 270) for b in (89.9,)], [(179.99, 30), (-179.99, 30)]):
        assert np.ptp(field(globe.positions(ways))) < 1.5 * slope * step
    assert (2 * given).map_parts(lambda f: on_domain(globe, f))(x) == pytest.approx(2 * field(x))


@pytest.mark.parametrize(
    ("options", "message"),
    [({"box": clvoro.Box((0, 0), (1, 1))}, "leave out box"), ({"resolution": (64, 32)}, "nodes along the equator")],
)
def test_mistakes_on_a_sphere(options, message):
    with pytest.raises(InputError, match=message):
        clvoro.adapt(clvoro.Sphere(), sizing.Graded(sizing.Expression("1e6 + 0*lat"), 1.1, **options))
