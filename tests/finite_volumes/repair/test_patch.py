"""Patches of solver meshes: they go back as they came, and their points slide along the boundary."""

from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.finite_volumes.prisms import simple_loops
from clvoro.finite_volumes.repair.patch import BORDER, cell_sides, part_of, put_back, restored, take_patch
from clvoro.finite_volumes.repair.pricing import PricedPatch
from clvoro.finite_volumes.repair.relaxation import _with_positions
from clvoro.finite_volumes.repair.tasks import Move, moved
from clvoro.finite_volumes.short_edges import collapse_short_edges, point_kinds
from clvoro.geometry.ring_coordinate import RingCoordinate
from tests.finite_volumes.test_straight_walls import ELL, circle

DOMAINS = {
    "ell": clvoro.Polygon(ELL, names={"low": [0, 1], "rest": [2, 3, 4, 5]}),
    "ring": clvoro.Polygon(circle(40, 0.45), [circle(15, 0.15)]),
    "curve": clvoro.Polygon(clvoro.curves.circle((0.5, 0.5), 0.5), [clvoro.curves.circle((0.5, 0.4), 0.2)]),
    "periodic": clvoro.Box((0, 0), (1, 1), periodic=(True, False)),
}


@pytest.fixture(scope="module", params=DOMAINS)
def mesh(request, ctx):
    """Random generators after a step of Lloyd's."""
    domain = DOMAINS[request.param]
    points = np.random.default_rng(1).uniform(domain.lower, domain.upper, (160, 2))
    if isinstance(domain, clvoro.Polygon):
        points = points[domain.contains(points)]
    adapter = clvoro.Adapter(ctx)
    diagram = adapter.diagram(domain, adapter.diagram(domain, points).centroids)
    made = diagram.solver_mesh(collapse=False)
    return collapse_short_edges(made, domain.boundaries.index)


def some_cells(mesh, seed: int) -> np.ndarray:
    starts, loops, _ = simple_loops(mesh)
    corner = mesh.points[loops[starts[:-1]]]
    center = corner[np.random.default_rng(seed).integers(mesh.n_cells)]
    return np.hypot(*(corner - center).T) < 0.3


def with_positions(mesh, patch):
    ring = None
    if isinstance(mesh.domain, clvoro.Polygon):
        ring = RingCoordinate(mesh.domain)
    kinds = point_kinds(mesh, mesh.domain.boundaries.index)
    return _with_positions(patch, ring, kinds), ring


def faces_of(patch) -> set:
    """Faces in terms of the mesh, without borders."""
    there = np.where(patch.neighbor >= 0, patch.cells[np.maximum(patch.neighbor, 0)], patch.neighbor)
    rows = patch.neighbor != BORDER
    columns = (patch.ids[patch.ends[:, 0]], patch.ids[patch.ends[:, 1]], patch.cells[patch.owner], there)
    return set(zip(*(c[rows].tolist() for c in columns), strict=True))


@pytest.mark.sparse(3)
@pytest.mark.parametrize("seed", range(2))
def test_patches_go_back_as_they_came(mesh, seed):
    chosen = some_cells(mesh, seed)
    other = some_cells(mesh, seed + 5) & ~chosen
    patches = [take_patch(mesh, c) for c in (chosen, other) if c.any()]
    made = put_back(mesh, patches)
    for name in ("points", "starts", "corners", "owner", "neighbor", "twin", "shift", "half_face"):
        assert np.array_equal(getattr(made, name), getattr(mesh, name)), name
        assert getattr(made, name).dtype == getattr(mesh, name).dtype, name
    p = patches[0]
    k = mesh.n_inner
    held = set(p.ids[p.held].tolist())
    # Points at cells with a face to cells that are not in the patch, and at seams, stay.
    outside = ~chosen
    for f in range(len(mesh.owner)):
        cells = {int(mesh.owner[f])} | ({int(mesh.neighbor[f])} if f < k else set())
        if any(outside[c] for c in cells) or mesh.twin[f] >= 0:
            assert set(mesh.corners[2 * f : 2 * f + 2].tolist()) & set(p.ids.tolist()) <= held


def test_parts_of_patches_go_back_as_they_came(mesh):
    patch, _ = with_positions(mesh, take_patch(mesh, np.ones(mesh.n_cells, bool)))
    chosen = some_cells(mesh, 3)
    part = part_of(patch, chosen)
    assert faces_of(restored(patch, part)) == faces_of(patch)
    assert faces_of(part) == faces_of(take_patch(mesh, chosen))
    part.points += ~part.held[:, None] * 0.01
    back = restored(patch, part)
    moved = np.flatnonzero((back.points != patch.points).any(axis=1))
    assert set(moved.tolist()) == set(part.ids[~part.held].tolist())


def test_sides_go_around_each_cell(mesh):
    patch = take_patch(mesh, np.ones(mesh.n_cells, bool))
    starts, begins, faces = cell_sides(patch)
    known_starts, known, broken = simple_loops(mesh)
    assert not broken.size
    assert np.array_equal(starts, known_starts)
    for a, b in pairwise(starts):
        ring, expected = begins[a:b].tolist(), known[a:b].tolist()
        at = expected.index(ring[0])
        assert ring == expected[at:] + expected[:at]
        for k, face in enumerate(faces[a:b]):
            assert set(patch.ends[face].tolist()) == {ring[k], ring[(k + 1) % len(ring)]}


def test_cells_that_are_no_rings_have_no_sides(mesh):
    patch = take_patch(mesh, np.ones(mesh.n_cells, bool))
    kept = np.arange(len(patch.owner)) != 3
    patch.ends, patch.owner, patch.neighbor = (patch.ends[kept], patch.owner[kept], patch.neighbor[kept])
    assert cell_sides(patch) is None


def test_figures_are_those_of_the_solver_mesh(mesh):
    given = PricedPatch.of(take_patch(mesh, np.ones(mesh.n_cells, bool)))
    now, measures = given.cells.figures(*given.patch.points.T), mesh.measures
    assert np.array_equal(given.cells.faces, np.arange(mesh.n_outer))
    # OpenFOAM's centroids of concave cells are not exact.
    bent = np.zeros(mesh.n_cells, bool)
    bent[given.cells.row[given.bent]] = True
    rows = np.flatnonzero(~bent[given.cells.owner] & ~bent[given.cells.neighbor])
    assert len(rows) > 0.9 * mesh.n_outer
    angle = np.degrees(now.angle[rows])
    np.testing.assert_allclose(angle, measures.non_orthogonality[rows], atol=1e-6)
    np.testing.assert_allclose(now.skewness[rows], measures.skewness[rows], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(now.determinant, measures.determinant, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(now.area, measures.sizes**2, rtol=1e-9)
    assert np.array_equal(np.isclose(np.bincount(given.cells.row, now.turn), 2 * np.pi), np.ones(mesh.n_cells, bool))


@pytest.mark.parametrize("domain", [d for d in DOMAINS.values() if isinstance(d, clvoro.Polygon)])
def test_positions_run_along_the_rings(domain):
    ring = RingCoordinate(domain)
    rng = np.random.default_rng(0)
    s = rng.uniform(0, ring.begins[-1], 40)
    edges = domain.oriented.edge_numbers[ring.edges(s)]
    points = ring.points(s)
    on_edges = (
        ring.vertices[ring.edges(s)]
        + (s - ring.begins[ring.edges(s)])[:, None] * (ring.along / ring.lengths[:, None])[ring.edges(s)]
    )
    np.testing.assert_allclose(points, domain.on_curve(on_edges, edges), atol=1e-14)
    np.testing.assert_allclose(ring.find(on_edges, edges, np.full(40, 0.1)), s, atol=1e-9)
    # Around a whole ring and back; the way to a place ahead.
    whole = np.diff(ring.begins[ring.ring_starts])[ring._rings(s)]
    np.testing.assert_allclose(ring.moved(s, whole), s, atol=1e-9)
    ahead = ring.moved(s, 0.3 * whole)
    np.testing.assert_allclose(ring.way(s, ahead), 0.3 * whole, atol=1e-9)
    assert np.array_equal(ring._rings(ahead), ring._rings(s))


@pytest.mark.sparse(2)
def test_points_slide_along_the_boundary_and_fixed_ones_stay(mesh):
    patch, ring = with_positions(mesh, take_patch(mesh, np.ones(mesh.n_cells, bool)))
    given = PricedPatch.of(patch)
    assert given.bad.any()
    (made,) = moved([Move(given, given.near(given.bad, 3), True, 12)], ring)
    assert made.price < given.price
    after, at = made.patch, np.flatnonzero(patch.on_walls)
    changed = (after.points != patch.points).any(axis=1)
    assert not changed[patch.fixed & patch.on_walls].any()
    assert changed[~patch.on_walls & ~patch.held].any()
    if ring is None:
        assert not changed[at].any()
        return
    assert changed[at].any()
    np.testing.assert_allclose(ring.points(after.positions[at]), after.points[at], atol=1e-7)
    corners = point_kinds(mesh, mesh.domain.boundaries.index)[patch.ids] == 2
    assert not changed[corners].any()
