"""Points around skew and non-orthogonal faces move until these are good; cells stay convex and walls in place."""

import numpy as np
import pytest

import clvoro
from clvoro.finite_volumes import relaxation
from clvoro.finite_volumes.short_edges import CORNER, WALL, point_kinds
from tests.finite_volumes.test_straight_walls import concave_by, polygons

EDGES = 40


@pytest.fixture(scope="module")
def pair(ctx):
    """A coarse mesh in a rough bay, before and after."""
    rng, turn = np.random.default_rng(5), np.arange(EDGES) * (2 * np.pi / EDGES)
    r = 1 + 0.12 * rng.standard_normal(EDGES)
    domain = clvoro.Polygon(r[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))
    points = rng.uniform(-1.3, 1.3, (500, 2))
    adapter = clvoro.Adapter(ctx)
    diagram = adapter.diagram(domain, points[domain.contains(points)])
    inside = diagram.centroids[domain.contains(diagram.centroids)]
    diagram = adapter.diagram(domain, inside)
    parts = domain.boundaries.index
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relaxation, "ROUNDS", 0)
        before = diagram.solver_mesh()
    return before, relaxation.relax_bad_faces(before, parts), parts


def test_no_face_remains_bad(pair):
    before, after, _ = (*(p.measures for p in pair[:2]), None)
    assert before.skewness.max() > relaxation.SKEWNESS or before.non_orthogonality.max() > relaxation.ANGLE
    assert after.skewness.max() <= relaxation.SKEWNESS
    assert after.non_orthogonality.max() <= relaxation.ANGLE


def test_cells_stay_convex_and_faces_the_same(pair):
    before, after, _ = pair
    assert max(map(concave_by, polygons(after))) < 1e-3
    for name in ("corners", "owner", "neighbor"):
        assert np.array_equal(getattr(before, name), getattr(after, name))


def test_corners_stay_and_points_on_walls_slide(pair):
    before, after, parts = pair
    kind, moved = point_kinds(before, parts), np.hypot(*(after.points - before.points).T)
    assert moved.max() > 0
    assert moved[kind == CORNER].max() == 0
    off = after.domain.boundary_distance(after.points[kind == WALL])
    assert off.max() <= before.domain.boundary_distance(before.points[kind == WALL]).max() + 0.05
