"""Cells that OpenFOAM would reject are divided anew, together with another cell."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import MismatchWarning
from tests.finite_volumes.test_straight_walls import concave_by, polygons

ROOM = np.array([(0.0, 0), (3, 0), (3, 3), (2, 3), (2, 5.2), (1, 5.2), (1, 3), (0, 3)])
"""A room of three by three cells, and a channel that is one cell wide and ends after two."""


@pytest.fixture(scope="module")
def room(ctx) -> clvoro.Diagram:
    x, y = np.meshgrid([0.5, 1.5, 2.5], [0.5, 1.5, 2.5])
    rows = np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(3).uniform(-0.1, 0.1, (9, 2))
    rows[[6, 7, 8]] = (0.6, 2.6), (1.5, 2.6), (2.4, 2.6)
    channel = [(1.5, 3.4), (1.5, 4.4)]
    return clvoro.Adapter(ctx).diagram(clvoro.Polygon(ROOM), np.concatenate([rows, channel]))


def test_all_determinants_are_large(room):
    before, after = room.solver_mesh(collapse=False), room.solver_mesh()
    assert before.measures.determinant.min() < 1e-12
    assert after.measures.determinant.min() > 1e-3
    assert room.check(solver="openfoam")


def test_cells_stay_convex_and_fill_the_domain(room):
    cells = polygons(room.solver_mesh())
    assert max(map(concave_by, cells)) < 1e-6
    assert sum(p.area for p in cells) == pytest.approx(room.domain.measure, rel=1e-12)


def test_a_cell_has_one_face_on_a_wall(room):
    """OpenFOAM counts a cell with two faces in one plane as concave."""
    mesh = room.solver_mesh()
    walls = list(zip(mesh.owner[mesh.n_inner :].tolist(), mesh.neighbor[mesh.n_inner :].tolist(), strict=True))
    assert len(set(walls)) == len(walls)


def test_a_channel_of_cells_is_accepted(ctx):
    """Both faces of each cell are parallel at first."""
    channel = clvoro.Polygon([(0, 0), (6, 0), (6, 1), (0, 1)])
    diagram = clvoro.Adapter(ctx).diagram(channel, np.column_stack([np.arange(6) + 0.5, np.full(6, 0.5)]))
    mesh = diagram.solver_mesh()
    assert mesh.measures.determinant.min() > 1e-3
    assert sum(p.area for p in polygons(mesh)) == pytest.approx(6, rel=1e-12)


def test_a_cell_in_a_lagoon_is_accepted(ctx):
    """The cell in the throat lies on both sides of it, and a corner of its wall stands between lagoon and sea."""
    sea = [(-2.4, 3.3), (-4.6, 1.3), (-4.6, -4), (3.5, -4), (3.5, -0.32), (0.29, 1.5)]
    lagoon = [(3.6, -0.05), (4.14, 2.07), (1.68, 4.21), (0.3, 1.59)]
    near = [(2.42, 1.64), (0.41, 1.42), (1.41, -0.32), (-0.96, -0.43), (-3.49, 1.91)]
    away = [(-0.4, -2.6), (2.2, -2.5), (-3.3, -0.6), (-3.0, -2.8)]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(sea + lagoon), near + away)
    mesh = diagram.solver_mesh()
    assert mesh.measures.determinant[0] > 1e-2
    assert max(map(concave_by, polygons(mesh))) < 0
    assert diagram.check(solver="openfoam")


def test_a_corner_between_an_inner_face_and_a_wall_moves(ctx):
    """A cell goes around an island; no cut of it, nor of it and a neighbor, helps."""
    island = [(23, 24), (24, 24), (24, 25), (23, 25)]
    sea = [(20.5, 22.5), (26, 22.5), (26, 26), (20.5, 26), (20.5, 24), (22, 24), (22, 23), (20.5, 23)]
    points = [(24.56, 23.47), (24.18, 25.19), (24.54, 22.51), (22.43, 25.42)]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(sea, [island]), points)
    with pytest.warns(MismatchWarning):
        assert diagram.check(solver="openfoam")
    assert max(map(concave_by, polygons(diagram.solver_mesh()))) < 0


def test_cells_in_a_throat_and_without_neighbors_take_a_part_of_others(ctx):
    """One cell lies on both sides of a throat of 1e-8, and two in a slit behind it, which no face leaves."""
    left, right = 1.5 - 5e-9, 1.5 + 5e-9
    x, y = np.meshgrid([0.5, 1.5, 2.5], [0.5, 1.5, 2.5])
    inner = np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(2).uniform(-0.05, 0.05, (9, 2))
    hall = [(left, 4), (0, 3), (0, 0), (3, 0), (3, 3), (right, 4)]
    slit = [(1.6, 4.1), (1.6, 8), (1.5, 8), (1.5, 4.1)]
    diagram = clvoro.Adapter(ctx).diagram(
        clvoro.Polygon(hall + slit), np.concatenate([inner, [(1.5, 4.0), (1.55, 5.5), (1.55, 7.3)]])
    )
    with pytest.warns(MismatchWarning):
        mesh = diagram.solver_mesh()
    assert diagram.check(solver="openfoam")
    cells = polygons(mesh)
    assert len(cells) == 12
    assert max(map(concave_by, cells)) < 1e-6
    assert sum(p.area for p in cells) == pytest.approx(10.5, rel=0.1)
    assert all(p.contains(shapely.Point(x)) for p, x in zip(cells, mesh.generators, strict=True))
    before = {tuple(x) for x in diagram.points.tolist()}
    assert 0 < len(before - {tuple(x) for x in mesh.generators.tolist()}) <= 4
