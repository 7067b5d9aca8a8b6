"""Generators in corners that rings share: they see a small part of the domain, and their cell lies on one side."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.adaptation.insertion_deletion import CellSizes, Change, Generators, InsertionDeletion, Present
from clvoro.adaptation.stages import Stages
from clvoro.solvers.components import connected_components
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch
from tests.reference.shores import TOUCHING, scattered


def shared_corners(domain):
    corners, times = np.unique(domain.oriented.vertices, axis=0, return_counts=True)
    return corners[times > 1]


def tessellate(ctx, domain, points):
    engine = patch.make_engine(ctx, box=domain)
    placed = engine.upload(domain.place(points, engine.real))
    return engine, Tessellator(Stages(engine), domain).tessellate(placed, len(points))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exact", "adaptive", "coupled", "weighted"])
@pytest.mark.parametrize("name", TOUCHING)
def test_runs_from_shared_corners(ctx, name, method):
    """New generators once coincided with those in the corners, and pieces exchanged their sources."""
    domain = TOUCHING[name]()
    corners = shared_corners(domain)[:3]
    for real, others in (("float64", 0), ("float64", 20), ("float32", 3)):
        points = np.concatenate([corners, scattered(domain, others, 1)]) if others else corners
        counts = method in ("exact", "adaptive")
        options = {"effort": "fast"} if counts else {"max_steps": 30}
        result = clvoro.Adapter(ctx, real).run(domain, 0.1, points=points, method=method, seed=1, **options)
        report = result.check()
        assert report, report
        assert len(result.points) >= len(points)
        if method in ("exact", "adaptive"):  # these choose the number
            assert len(result.points) * 0.01 == pytest.approx(domain.measure, rel=0.2)


@pytest.mark.parametrize("name", TOUCHING)
def test_generators_from_a_split_are_distinct(ctx, name):
    """Both halves would coincide with the generator: it stays, and the new one moves to the farthest face."""
    domain = TOUCHING[name]()
    corner = shared_corners(domain)[:1]
    engine, t = tessellate(ctx, domain, corner)
    expected, origin, scale = [], *domain.frame
    host = patch.fetch(t)
    centers = (host.points[host.owners] + host.face_centroids) * scale + origin
    along = domain.oriented.vertices[domain.oriented.next_vertex] - domain.oriented.vertices
    along /= np.hypot(*along.T)[:, None]
    way = np.sqrt(domain.measure) / 4
    for m, label in zip(centers, host.neighbors, strict=True):
        inwards = np.array([-along[-1 - label, 1], along[-1 - label, 0]])
        line = shapely.LineString([m + 1e-12 * inwards, m + way * inwards])
        inside = min(shapely.get_parts(shapely.intersection(line, domain.geometry)), key=shapely.Point(m).distance)
        free = inside.length > way * (1 - 1e-9)
        expected.append(m + (way if free else inside.length / 2) * inwards)
    expected = np.array(expected)
    new = reorganized(engine, domain, t, 1.0)
    assert (new.inserted, new.deleted) == (1, 0)
    found = new.generators.points.get() * scale + origin
    assert found[0] == pytest.approx(corner[0], abs=1e-15)
    farthest = np.hypot(*(expected - corner).T)
    at = expected[farthest >= farthest.max() - 1e-12]  # round-off chooses between equal ones
    assert np.abs(at - found[1]).max(axis=1).min() < 1e-12


def reorganized(engine, domain, t, total):
    """Return the generators after the count has changed by `total`, where cells have their target size."""
    one = engine.upload(np.ones(t.n))
    rows = Generators(
        t.points,
        engine.upload(np.arange(t.n), np.int32),
        engine.zeros((t.n, 2)),
        engine.zeros(t.n, np.uint64),
        engine.zeros(t.n),
    )
    sizes = CellSizes(one, one, engine.zeros(t.n))
    return InsertionDeletion(engine).insert_delete(Present(domain, t, rows, t.n), sizes, Change(total, climb=False))


def test_components_follow_from_the_graph_not_from_positions(ctx):
    """The generator in the corner has its cell in one of two pieces, or in both if there are no others."""
    domain = TOUCHING["pieces"]()
    corner = shared_corners(domain)
    for others, count in (([(0.2, 0.3), (0.7, 0.6)], 2), ([(0.2, 0.3), (0.1, 0.1)], 1)):
        _, t = tessellate(ctx, domain, np.concatenate([corner, others]))
        assert connected_components(t.starts.get(), t.neighbors.get()).max() + 1 == count
