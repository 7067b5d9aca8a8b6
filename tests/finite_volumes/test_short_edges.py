"""Short faces in 2D are collapsed; cells remain convex, walls in place and seams equal on both sides."""

from itertools import pairwise

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.finite_volumes import short_edges
from clvoro.finite_volumes.prisms import cell_loops
from tests.finite_volumes.test_straight_walls import ELL, circle, concave_by, polygons


def widths(mesh) -> np.ndarray:
    """Four areas over the perimeter of each cell."""
    return np.array([4 * p.area / p.length for p in cells_of(mesh)])


def cells_of(mesh) -> list:
    """The cells as polygons; at seams from the loops of corners."""
    starts, loop = cell_loops(mesh)
    return [shapely.Polygon(mesh.points[loop[a:b]]) for a, b in pairwise(starts)]


def ratios(mesh) -> np.ndarray:
    """The length of each face over that below which it is short."""
    a, b = mesh.points[mesh.corners.reshape(-1, 2)].swapaxes(0, 1)
    areas = np.array([p.area for p in cells_of(mesh)])
    limit = np.minimum(short_edges.SHORT * np.sqrt(areas), short_edges.THIN * widths(mesh))
    there = np.where(mesh.neighbor >= 0, limit[np.maximum(mesh.neighbor, 0)], np.inf)
    return np.hypot(*(b - a).T) / np.minimum(limit[mesh.owner], there)


DOMAINS = {
    "box": clvoro.Box((0, 0), (1, 1)),
    "periodic": clvoro.Box((0, 0), (1, 2), periodic=True),
    "channel": clvoro.Box((-1, 0), (1, 2), periodic=(True, False)),
    "ell": clvoro.Polygon(ELL),
    "round": clvoro.Polygon(circle(50, 0.4)),
}


@pytest.fixture(scope="module", params=DOMAINS)
def pair(request, ctx):
    """A mesh of random generators, moved once to the centroids, before and after."""
    domain = DOMAINS[request.param]
    adapter = clvoro.Adapter(ctx)
    points = np.random.default_rng(3).uniform(domain.lower, domain.upper, (900, 2))
    if isinstance(domain, clvoro.Polygon):
        points = points[domain.contains(points)]
    diagram = adapter.diagram(domain, points)
    walls = "straight" if request.param == "round" else "exact"
    diagram = adapter.diagram(domain, diagram.centroids)
    return diagram.solver_mesh(walls, collapse=False), diagram.solver_mesh(walls)


@pytest.mark.sparse(1)
def test_short_faces_are_gone(pair):
    before, after = pair
    assert np.count_nonzero(ratios(before) < 1) > 10
    assert np.count_nonzero(ratios(after) < 1) <= 1
    assert len(after.owner) < len(before.owner) - 10
    assert after.n_cells == before.n_cells


@pytest.mark.sparse(1)
def test_cells_remain_convex_and_the_area_whole(pair):
    before, after = pair
    was = np.array([concave_by(p) for p in cells_of(before)])
    now = np.array([concave_by(p) for p in cells_of(after)])
    assert (now < np.maximum(was, 0) + 1e-9).all()
    assert min(p.area for p in cells_of(after)) > 0
    total = sum(p.area for p in cells_of(before))
    slack = 1e-12 if before.area_change == 0 else 1e-3
    assert sum(p.area for p in cells_of(after)) == pytest.approx(total, rel=slack)


def test_faces_are_in_order_and_few_points_moved(pair):
    before, after = pair
    k = after.n_inner
    pairs = list(zip(after.owner[:k].tolist(), after.neighbor[:k].tolist(), strict=True))
    assert pairs == sorted(pairs)
    known = {tuple(p) for p in before.points.tolist()}
    assert sum(tuple(p) in known for p in after.points.tolist()) > 0.8 * len(after.points)
    assert len(np.unique(after.corners)) == len(after.points)


def test_seams_are_equal_on_both_sides(pair):
    _, mesh = pair
    extent = np.array(mesh.domain.extent)
    ends = mesh.points[mesh.corners.reshape(-1, 2)]
    for f in range(mesh.n_outer, len(mesh.owner)):
        t = mesh.twin[f]
        assert mesh.twin[t] == f
        assert (mesh.shift[f] == -mesh.shift[t]).all()
        assert mesh.owner[f] == mesh.neighbor[t]
        assert ends[f] == pytest.approx(ends[t, ::-1] + mesh.shift[f] * extent, abs=1e-12)


def test_corners_and_changes_of_names_stay(ctx):
    """Faces shorter than a fiftieth of a cell on both sides of a corner, and of the end of a name."""
    ring = np.array([(0.0, 0), (0.501, 0), (1, 0), (1, 1), (0, 1)])
    domain = clvoro.Polygon(ring, names={"left": 0})
    points = np.array([(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.7502, 0.75), (0.999, 0.5)])
    mesh = clvoro.Adapter(ctx).diagram(domain, points).solver_mesh("exact")
    there = {tuple(p) for p in mesh.points.round(12).tolist()}
    assert {tuple(p) for p in ring.tolist()} <= there
    parts = [mesh.domain.boundary_names[mesh.domain.boundary_index[-1 - w]] for w in mesh.neighbor[mesh.n_inner :]]
    ends = mesh.points[mesh.corners.reshape(-1, 2)[mesh.n_inner :]]
    length = sum(np.hypot(*(b - a)) for (a, b), part in zip(ends, parts, strict=True) if part == "left")
    assert length == pytest.approx(0.501)
    assert sum(p.area for p in polygons(mesh)) == pytest.approx(1)


def test_a_throat_stays_open(ctx):
    """The only face between two cells is shorter than a fiftieth of them, from a wall to the tip of another one."""
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0.7, 1), (0.5, 0.005), (0.3, 1), (0, 1)])
    diagram = clvoro.Adapter(ctx).diagram(domain, np.array([(0.2, 0.5), (0.8, 0.5)]))
    mesh = diagram.solver_mesh()
    assert mesh.n_inner == 1
    assert ratios(mesh)[0] < 1
    assert sum(p.area for p in polygons(mesh)) == pytest.approx(domain.measure)


def test_rows_of_neighboring_columns_share_faces(ctx):
    """Columns of flat cells, each second one a little higher: its cells touch those of the next row by a sliver."""
    x, row = np.meshgrid(np.arange(10), np.arange(20), indexing="ij")
    points = np.stack([0.1 * x + 0.05, 0.005 * row + 0.0025 + 0.0004 * (x % 2)], axis=-1)
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0), (1, 0.1)), points.reshape(-1, 2))
    before, after = diagram.solver_mesh(collapse=False).measures, diagram.solver_mesh().measures
    assert before.shortest_edge.min() < 0.02
    assert after.shortest_edge.min() > 0.2
    assert np.isclose(after.geometry.volumes.sum(), before.geometry.volumes.sum(), rtol=1e-12)
    assert after.non_orthogonality.max() < 5
    assert not after.concave.any()


def test_flat_cells_of_layers_keep_their_faces(ctx):
    """Their corners are straight, as where a cell is hardly convex, but their faces are as long as they are thin."""
    domain = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)], [circle(60, 0.2)], names={"body": range(4, 64)})
    layers = clvoro.Layers(0.001, count=4, growth=1.3, spacing=0.03, edges="body")
    size = clvoro.sizing.Distance(domain.boundary("body"), 0.03, slope=0.2, h_max=0.1)
    mesh = clvoro.Adapter(ctx).run(domain, size, "fast", layers=layers).solver_mesh()
    assert mesh.measures.non_orthogonality.max() < 30
    assert not mesh.measures.concave.any()
