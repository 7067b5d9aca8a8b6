"""Steps of generators that would leave a polygon: they stay inside."""

from itertools import pairwise

import numpy as np
import pyopencl as cl
import pytest
import shapely

import clvoro
from clvoro.adaptation.motion import Displacement, Motion
from clvoro.geometry.edge_bins import bin_edges
from clvoro.opencl.engine import Engine
from tests.reference.shores import POLYGONS, coast, scattered

NAMES = ("triangle", "burr", "holes", "islands", "fine comb", "slit", "thin slit", "thin spit", "koch")


@pytest.fixture(scope="module", params=["float64", "float32"])
def move(ctx, request):
    """Positions (n, 2) after a displacement, both in the device's coordinates."""
    queue = cl.CommandQueue(ctx)
    real = np.dtype(request.param)
    engine = Engine(ctx, queue, 2, real, POLYGONS["square"]().traits(real))
    motion = Motion(engine)

    def moved(domain, points, way):
        n = len(points)
        on_device, zeros = engine.upload(points), engine.zeros((n, 2))
        sizes, velocity = engine.upload(np.ones(n)), engine.empty((n, 2))
        motion.move_generators(domain, on_device, Displacement(engine.upload(way), zeros, sizes), velocity)
        return on_device.get()

    moved.real = real
    return moved


def in_frame(domain):
    """The domain in the device's coordinates."""
    origin, scale = domain.frame
    return shapely.transform(domain.geometry, lambda x: (x - origin) / scale)


@pytest.mark.sparse(6)
@pytest.mark.parametrize("name", NAMES)
def test_one_step_agrees_with_shapely(move, name):
    domain = POLYGONS[name]()
    n, rng, eps = 600, np.random.default_rng(3), float(np.finfo(move.real).eps)
    origin, scale = domain.frame
    x = ((scattered(domain, n, 5) - origin) / scale).astype(move.real)
    way = (rng.standard_normal((n, 2)) * 10 ** rng.uniform(-3, 0, (n, 1))).astype(move.real)
    y = move(domain, x, way).astype(float)
    whole, shore = in_frame(domain), in_frame(domain).boundary
    shapely.prepare(shore)
    goal = (x + way).astype(float)
    ways = shapely.linestrings(np.stack([x.astype(float), goal], axis=1))
    free = ~shapely.intersects(shore, ways)
    # A free path is followed; a path that ends inside crosses no edge.
    near = shapely.distance(shore, ways) < 64 * eps
    sure = ~near & (shapely.distance(shore, shapely.points(x)) > 64 * eps)
    assert np.abs(y - goal)[free & sure].max() < 4 * eps
    hit = np.flatnonzero(~free & (shapely.distance(shore, shapely.points(x)) > 64 * eps))
    assert len(hit) > 50
    assert shapely.covers(whole, shapely.points(y)).all()
    thin = 1e-6 if name.startswith("thin") else 0
    for i in hit:
        # Half-way to the first edge, or the mirror image of the target if its path is free.
        crossing = shapely.intersection(shore, ways[i])
        first = min(np.linalg.norm(p - x[i]) for p in shapely.get_coordinates(crossing))
        length = np.linalg.norm(goal[i] - x[i])
        half = x[i] + first / 2 / length * (goal[i] - x[i])
        # Paths cross edges at angles down to 1/200.
        if np.linalg.norm(y[i] - half) < 1024 * eps:
            continue
        taken = shapely.LineString([x[i].astype(float), y[i]])
        assert not shapely.crosses(taken, shore) or thin, (name, i)
        middle = shapely.Point((y[i] + goal[i]) / 2)  # on the line through the edge
        a, b = (np.array(e) for e in zip(*edges(domain, origin, scale), strict=True))
        e = b - a
        to = [middle.x, middle.y] - a
        off = np.abs(e[:, 0] * to[:, 1] - e[:, 1] * to[:, 0]) / np.hypot(*e.T)
        assert off.min() < 64 * eps * max(1, length)


def edges(domain, origin, scale):
    begins = (domain.oriented.vertices - origin) / scale
    return list(zip(begins, begins[domain.oriented.next_vertex], strict=True))


@pytest.mark.sparse(6)
@pytest.mark.parametrize("name", NAMES)
def test_generators_pushed_outwards_stay_inside(move, name):
    domain = POLYGONS[name]()
    n, rng = 1000, np.random.default_rng(4)
    origin, scale = domain.frame
    x = ((scattered(domain, n, 6) - origin) / scale).astype(move.real)
    ahead = 0.05 * rng.standard_normal((n, 2))
    for step in range(90):
        # Half of them are always pushed in one direction, and come as near to the boundary as possible.
        way = rng.standard_normal((n, 2)) * 10 ** rng.uniform(-6, 0, (n, 1))
        way[::2] = ahead[::2]
        x = move(domain, x, way)
        if step % 15 == 14:
            assert domain.covers(x.astype(float) * scale + origin).all()
    near = domain.boundary_distance(x.astype(float) * scale + origin) / scale
    assert (near < 100 * np.finfo(move.real).eps).sum() > 200
    # They can move away again.
    back = move(domain, x, -ahead * 1e-3)
    moved = np.abs(back - x).max(axis=1) > 0
    assert moved[::2].mean() > 0.8


def test_generators_on_the_boundary_may_leave_it(move):
    domain = POLYGONS["burr"]()
    origin, scale = domain.frame
    v = domain.oriented.vertices
    e = v[domain.oriented.next_vertex] - v
    x = ((v + e / 3 - origin) / scale).astype(move.real)
    inwards = 1e-4 * np.column_stack([-e[:, 1], e[:, 0]]) / np.hypot(*e.T)[:, None]
    y = move(domain, x, inwards)
    assert np.abs(y - x - inwards).max() < 4 * np.finfo(move.real).eps
    y = move(domain, x, -inwards)
    # Those that are pushed out are mirrored.
    distance = domain.boundary_distance(y.astype(float) * scale + origin) / scale
    assert distance.max() < 1e-4 + 32 * np.finfo(move.real).eps
    off = ~domain.covers(y.astype(float) * scale + origin)
    assert domain.boundary_distance(y.astype(float) * scale + origin)[off].max(initial=0) < (
        2 * scale * np.finfo(move.real).eps
    )


@pytest.mark.parametrize("name", ["square", "koch", "far", "thin spit"])
def test_bins_list_all_edges_in_them(name):
    domain = POLYGONS[name]()
    begins, ends = domain.oriented.vertices, domain.oriented.vertices[domain.oriented.next_vertex]
    frame, shape, starts, listed = bin_edges(begins, ends)
    held = [set(listed[a:b].tolist()) for a, b in pairwise(starts)]
    # Points on each edge are in bins that list it.
    for t in np.linspace(0, 1, 200):
        at = (((1 - t) * begins + t * ends - frame[:2]) * frame[2]).astype(int)
        at = np.clip(at, 0, shape[:2] - 1)
        for e, (column, row) in enumerate(at.tolist()):
            assert e in held[row * shape[0] + column]


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("method", ["lloyd", "poisson", "coupled", "weighted", "exact", "adaptive"])
def test_runs_stay_inside(ctx, method, real):
    domain = clvoro.Polygon(coast(256))
    size = float(np.sqrt(domain.measure / 100))
    result = clvoro.Adapter(ctx, real).run(
        domain, size, method=method, max_steps=25, seed=7, options=clvoro.PaperOptions(tol=0), effort="fast"
    )
    assert domain.contains(result.points).all()
    assert result.diagram.volumes.sum() == pytest.approx(domain.measure, rel=64 * float(np.finfo(real).eps))


def test_refinement_from_generators_on_a_slanted_edge_far_from_0(ctx):
    """There they are off the edge by more than the round-off of the device; midpoints between them are outside."""
    vee = np.array([(0, 0), (1, 0.37), (2, 0), (2, 1), (1, 1.37), (0, 1)]) - (6168.3, 244326.7)
    domain, adapter = clvoro.Polygon(vee), clvoro.Adapter(ctx)
    for seed in range(10):
        t = np.random.default_rng(seed).random((3, 1))
        points = np.concatenate([vee[0] + t * (vee[1] - vee[0]), vee[1] + (1 - t) * (vee[2] - vee[1])])
        result = adapter.run(
            domain, 0.25, points=points, options=clvoro.MultilevelOptions(levels=1), max_steps=0, method="exact"
        )
        result.check().demand()
