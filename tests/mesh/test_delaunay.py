"""The dual triangulation of a diagram in the plane, against SciPy's Delaunay triangulation."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

import clvoro

BOX = clvoro.Box((0, 0), (2, 1))


def circumcenters(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    b, c = b - a, c - a
    b2, c2 = (b**2).sum(axis=1), (c**2).sum(axis=1)
    area4 = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    x = (c[:, 1] * b2 - b[:, 1] * c2) / area4
    y = (b[:, 0] * c2 - c[:, 0] * b2) / area4
    return a + np.column_stack([x, y])


def areas(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    (bx, by), (cx, cy) = (b - a).T, (c - a).T
    return 0.5 * (bx * cy - by * cx)


def as_set(triangles):
    return set(map(tuple, np.sort(triangles, axis=1).tolist()))


def test_triangles_are_delaunays_with_circumcenters_inside(adapter):
    points = np.random.default_rng(310).random((2000, 2)) * (2, 1)
    found = adapter.diagram(BOX, points).triangles()
    assert found.dtype == np.int32
    assert found.shape[1:] == (3,)
    wanted = Delaunay(points).simplices
    inside = BOX.contains(circumcenters(points, wanted))
    assert 0 < (~inside).sum()  # some are left out
    assert as_set(found) == as_set(wanted[inside])
    assert len(found) == inside.sum()  # each once
    assert (areas(points, found) > 0).all()  # counter-clockwise


def test_squares_of_a_lattice_are_cut_in_two(adapter):
    x, y = np.meshgrid(np.arange(8) + 0.5, np.arange(5) + 0.5)
    points = np.column_stack([x.ravel(), y.ravel()])
    triangles = adapter.diagram(clvoro.Box((0, 0), (8, 5)), points).triangles()
    assert len(triangles) == 2 * 7 * 4
    assert areas(points, triangles) == pytest.approx(np.full(len(triangles), 0.5))
    # Together they cover the area between the generators, each square by two triangles.
    squares = np.floor(points[triangles].mean(axis=1) - 0.5) @ [1, 100]
    assert (np.unique(squares, return_counts=True)[1] == 2).all()


def test_around_a_hole(adapter):
    square, hole = ([(0, 0), (2, 0), (2, 2), (0, 2)], [(0.8, 0.8), (1.2, 0.8), (1.2, 1.2), (0.8, 1.2)])
    domain = clvoro.Polygon(square, [hole])
    points = np.random.default_rng(311).random((900, 2)) * 2
    points = points[domain.contains(points)]
    diagram = adapter.diagram(domain, points)
    found = diagram.triangles()
    wanted = Delaunay(points).simplices
    # Far from the hole the circumcenter sees the generators.
    centers = circumcenters(points, wanted)
    clear = domain.contains(centers) & (np.abs(centers - 1).max(axis=1) > 0.6)
    assert clear.sum() > 500
    assert as_set(wanted[clear]) <= as_set(found)
    assert (areas(points, found) > 0).all()
    # Neighbors in a triangle share a face.
    owners = np.repeat(np.arange(len(points)), np.diff(diagram.neighbor_starts))
    faces = {*zip(owners.tolist(), diagram.neighbors.tolist(), strict=True)}
    sides = [tuple(s) for t in found.tolist() for s in (t[:2], t[1:], t[::2])]
    assert faces.issuperset(sides)


@pytest.mark.parametrize("n", [1, 2])
def test_few_cells_have_no_triangles(adapter, n):
    points = np.array([[0.5, 0.5], [1.5, 0.5]])[:n]
    assert adapter.diagram(BOX, points).triangles().shape == (0, 3)
