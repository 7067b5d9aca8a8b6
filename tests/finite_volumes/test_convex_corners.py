"""Cells beside thin obstacles: joined faces, and corners that move."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.finite_volumes.convex_corners import join_faces, move_concave_points
from clvoro.mesh.faces import Faces
from tests.finite_volumes.test_straight_walls import concave_by, polygons

SLIT = [(0, 0), (1, 0), (1, 1), (0.5005, 1), (0.5, 0.3), (0.4995, 1), (0, 1)]


def square_in_four(middle: tuple[float, float]) -> Faces:
    """The unit square in quarters that meet in `middle`."""
    points = [(0, 0), (0.5, 0), (1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (0, 0.5), middle]
    inner = [(1, 8, 0, 1), (8, 7, 0, 3), (3, 8, 1, 2), (8, 5, 3, 2)]
    walls = [
        (7, 0, 0, -1),
        (6, 7, 3, -1),
        (2, 3, 1, -2),
        (3, 4, 2, -2),
        (0, 1, 0, -3),
        (1, 2, 1, -3),
        (4, 5, 2, -4),
        (5, 6, 3, -4),
    ]
    # The owner is on the left.
    inner = [(a, b, i, j) if i < j else (b, a, j, i) for a, b, i, j in inner]
    return mesh_of(points, inner, walls, 4)


def mesh_of(points, inner, walls, cells) -> Faces:
    inner = sorted(inner, key=lambda face: face[2:])
    a, b, owner, neighbor = np.array([*inner, *walls]).T
    count = len(a)
    return Faces(
        domain=clvoro.Box((0, 0), (1, 1)),
        generators=np.zeros((cells, 2)),
        points=np.array(points, float),
        starts=2 * np.arange(count + 1),
        corners=np.stack([a, b], axis=1).ravel(),
        owner=owner,
        neighbor=neighbor,
        twin=np.full(count, -1),
        shift=np.zeros((count, 2), np.int8),
        half_face=np.arange(count),
    )


@pytest.fixture(scope="module")
def slit(ctx) -> clvoro.Diagram:
    domain = clvoro.Polygon(SLIT)
    points = np.random.default_rng(2).random((600, 2))
    points = points[domain.contains(points)]
    adapter = clvoro.Adapter(ctx)
    return adapter.diagram(domain, adapter.diagram(domain, points).centroids)


def test_two_faces_between_two_cells_become_one():
    points = [(0, 0), (0.5, 0), (1, 0), (1, 1), (0.5, 1), (0, 1), (0.4, 0.5)]
    inner = [(1, 6, 0, 1), (6, 4, 0, 1)]
    walls = [(5, 0, 0, -1), (2, 3, 1, -2), (0, 1, 0, -3), (1, 2, 1, -3), (3, 4, 1, -4), (4, 5, 0, -4)]
    mesh = mesh_of(points, inner, walls, 2)
    assert [p.area for p in polygons(mesh)] == pytest.approx([0.45, 0.55])
    joined = join_faces(mesh)
    assert [p.area for p in polygons(joined)] == pytest.approx([0.5, 0.5])
    assert len(joined.owner) == 7
    assert len(joined.points) == 6
    # A wall face as long as round-off changes nothing.
    walls = [*walls[:5], (4, 7, 0, -4), (7, 5, 0, -4)]
    for away in (0, 1e-17, 1e-13):
        joined = join_faces(mesh_of([*points, (0.5 - away, 1)], inner, walls, 2))
        assert [p.area for p in polygons(joined)] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("middle", [(0.4, 0.45), (0.5, 0.5), (0.95, 0.9)])
def test_points_move_out_of_cells_that_are_not_convex(middle):
    mesh = square_in_four(middle)
    was = [concave_by(p) for p in polygons(mesh)]
    moved = move_concave_points(mesh)
    cells = polygons(moved)
    assert sum(p.area for p in cells) == pytest.approx(1)
    if max(was) < 0:
        assert np.array_equal(moved.points, mesh.points)
    assert max(concave_by(p) for p in cells) <= max(*was, -0.01)
    assert np.array_equal(moved.points[:8], mesh.points[:8])


def test_a_point_across_its_cell_moves_to_the_line():
    """Three cells in a square: one of them has a corner into it."""
    points = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0.2)]
    points += [(0.5, 0), (1, 0.6), (0, 0.6)]
    inner = [(5, 4, 0, 1), (4, 7, 0, 2), (6, 4, 1, 2)]
    walls = [(7, 0, 0, -1), (3, 7, 2, -1), (1, 6, 1, -2), (6, 2, 2, -2), (0, 5, 0, -3), (5, 1, 1, -3), (2, 3, 2, -4)]
    mesh = mesh_of(points, inner, walls, 3)
    assert max(concave_by(p) for p in polygons(mesh)) < 0
    bent = mesh_of([*points[:4], (0.5, 0.75), *points[5:]], inner, walls, 3)
    assert concave_by(polygons(bent)[2]) > 30
    moved = move_concave_points(bent)
    assert max(concave_by(p) for p in polygons(moved)) < 0
    assert moved.points[4] == pytest.approx((0.5, 0.6), abs=1e-3)


def test_beside_a_corner_on_a_wall_the_next_point_moves():
    """The upper cell has a corner of 184.6 degrees in (1, 0.5), on the wall; the lower one is right of x = 1."""
    points = [(0, 0.5), (1, 0.5), (1, 0), (2, 0), (2, 0.55), (2, 1), (0, 1), (1.5, 0.46)]
    inner = [(1, 7, 0, 1), (7, 4, 0, 1)]
    walls = [(0, 1, 0, -1), (1, 2, 1, -1), (2, 3, 1, -3), (3, 4, 1, -2), (4, 5, 0, -2), (5, 6, 0, -4), (6, 0, 0, -1)]
    mesh = mesh_of(points, inner, walls, 2)
    assert concave_by(polygons(mesh)[0]) == pytest.approx(np.degrees(np.arctan(0.08)))
    moved = move_concave_points(mesh)
    assert concave_by(polygons(moved)[0]) < 0
    assert np.array_equal(moved.points[:7], mesh.points[:7])


def test_cells_beside_a_slit_become_convex(slit):
    exact, mesh = slit.solver_mesh("exact", collapse=False), slit.solver_mesh()
    before = np.array([concave_by(p) for p in polygons(exact)])
    cells = polygons(mesh)
    now = np.array([concave_by(p) for p in cells])
    assert np.count_nonzero(before > 1e-6) > 10
    assert np.count_nonzero(now > 1e-6) <= 2
    assert sum(p.area for p in cells) == pytest.approx(slit.domain.measure * (1 + mesh.area_change))
    overlaps = shapely.STRtree(cells).query(cells, predicate="overlaps")
    one, other = np.array(cells)[overlaps]
    assert (shapely.area(shapely.intersection(one, other)) < 1e-12).all()
