"""Transfer of cell data on spheres: comparison with Shapely and quadrature, and properties that hold on any mesh."""

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree, SphericalVoronoi

from clvoro import Sphere
from clvoro.errors import InputError
from clvoro.mesh.diagram import Diagram
from tests.reference.spheres import UNIT, clustered_points, grid_of_rings, random_points
from tests.remapping.test_transfer import check_mass_bounds_and_constants, mass_defect

ORDERS = pytest.mark.parametrize("order", [1, 2])
TURN = np.linalg.qr(np.random.default_rng(12).normal(size=(3, 3)))[0]
"""A rotation in a general direction, perhaps with a reflection."""


@pytest.fixture(scope="module")
def mesh(adapter):
    """Return a function that makes a diagram of n random generators."""
    made = {}

    def make(n, seed, radius=1.0):
        if (n, seed, radius) not in made:
            points = radius * random_points(n, seed)
            made[n, seed, radius] = adapter.diagram(Sphere(radius), points)
        return made[n, seed, radius]

    return make


def corner_rows(points):
    """Return the corners (k, 3) of each cell, in order, and the pairs of neighbors, computed by SciPy."""
    cells = SphericalVoronoi(points)
    cells.sort_vertices_of_regions()
    by_corner = [[] for _ in cells.vertices]
    for i, region in enumerate(cells.regions):
        for v in region:
            by_corner[v].append(i)
    rows = [set() for _ in points]
    for around in by_corner:
        for i in around:
            rows[i].update(j for j in around if j != i)
    return [cells.vertices[region] for region in cells.regions], [sorted(row) for row in rows]


def frame(x):
    """Return two tangents at x, and x, as rows."""
    one = np.cross(x, np.eye(3)[np.argmin(np.abs(x))])
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(x, one), x])


def projected(corners, axes):
    """Return the central projection (k, 2), or None if a corner is on the other side of the sphere."""
    local = corners @ axes.T
    return None if local[:, 2].min() < 0.02 else local[:, :2] / local[:, 2:]


NODES, WEIGHTS = np.polynomial.legendre.leggauss(14)
NODES, WEIGHTS = (NODES + 1) / 2, WEIGHTS / 2


def integrals(flat, axes):
    """Return the area of a projected polygon on the sphere, and the integral of the position, by quadrature.

    The area of the sphere per area of the tangent plane is (1 + |u|^2)^(-3/2).
    """
    area, moment = 0.0, np.zeros(3)
    s, t = np.meshgrid(NODES, NODES, indexing="ij")
    weight = np.outer(WEIGHTS * NODES, WEIGHTS).ravel()  # a square, of which one side becomes a point
    s, t = s.ravel()[:, None], t.ravel()[:, None]
    for b, c in pairwise(flat[1:]):
        a = flat[0]
        u = a + s * (b - a) + s * t * (c - b)
        size = abs(np.linalg.det(np.stack([b - a, c - a])))
        lengths = np.sqrt(1 + (u**2).sum(axis=1))
        part = weight * size / lengths**3
        area += part.sum()
        y = np.column_stack([u, np.ones(len(u))]) / lengths[:, None]
        moment += part @ y
    return area, moment @ axes


def overlaps(old, new):
    """Return areas (n_new, n_old) and integrals of the position (n_new, n_old, 3) of all intersections."""
    areas, moments = np.zeros((len(new), len(old))), np.zeros((len(new), len(old), 3))
    old_corners, new_corners = (corner_rows(d.points)[0] for d in (old, new))
    for i, mine in enumerate(new_corners):
        axes = frame(new.points[i])
        cell = shapely.Polygon(projected(mine, axes))
        for j, corners in enumerate(old_corners):
            flat = projected(corners, axes)
            both = shapely.Polygon() if flat is None else cell.intersection(shapely.Polygon(flat))
            if both.area > 0:
                outline = np.array(both.exterior.coords)[:-1]
                areas[i, j], moments[i, j] = integrals(outline, axes)
    return areas, moments


def slopes(x, q, means, limited):
    """Return slopes (n, 3) that fit the neighbors' values by least squares, in the tangent planes."""
    corners, neighbors = corner_rows(x)
    found = np.zeros_like(x)
    for i, row in enumerate(neighbors):
        tangents = frame(x[i])[:2]
        d = (means[row] - means[i]) @ tangents.T
        weight = 1 / np.linalg.norm(d, axis=1)
        flat = np.linalg.lstsq(d * weight[:, None], (q[row] - q[i]) * weight, rcond=None)[0]
        if limited:
            rise = (corners[i] - means[i]) @ tangents.T @ flat
            room = np.where(rise > 0, max(q[i], q[row].max()), min(q[i], q[row].min())) - q[i]
            flat = flat * min(1, (room / rise).min())
        found[i] = flat @ tangents
    return found


@pytest.mark.sparse(1)
@pytest.mark.parametrize("way", ["first", "second", "limited"])
def test_matches_intersections_by_shapely(mesh, adapter, way):
    old, new = mesh(90, 5), mesh(70, 6)
    q = np.random.default_rng(311).normal(size=90)
    areas, moments = overlaps(old, new)
    # All intersections are there.
    assert areas.sum() == pytest.approx(4 * np.pi, rel=1e-12)
    expected = areas @ q
    if way != "first":
        means = moments.sum(axis=0) / areas.sum(axis=0)[:, None]
        g = slopes(old.points, q, means, way == "limited")
        expected = expected + np.einsum("ijd,jd->i", moments - areas[:, :, None] * means, g)
    expected /= areas.sum(axis=1)
    got = old.transfer(q, new, 1 if way == "first" else 2, limited=way != "second", adapter=adapter)
    # The round-off of Shapely's intersections over the smallest cell.
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-11)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("counts", [(5, 40), (40, 5), (12, 12)])
def test_cells_as_wide_as_the_sphere(adapter, counts):
    """Cells of 70 degrees from generator to corner: shares of random points, within five standard deviations."""
    corners = UNIT.icosahedral_points(0)
    made = {5: np.array([(1, 0, 0.1), (-0.5, 0.8, 0), (-0.5, -0.9, 0), (0, 0, 1), (0.1, 0, -1)]), 12: corners}
    old = adapter.diagram(UNIT, made.get(counts[0], random_points(40, 3)))
    new = adapter.diagram(UNIT, made.get(counts[1], random_points(40, 4)) @ TURN)
    q = np.random.default_rng(8).normal(size=len(old))
    y = random_points(400_000, 77)
    here, there = KDTree(new.points).query(y)[1], KDTree(old.points).query(y)[1]
    count = np.bincount(here, minlength=len(new))
    mean = np.bincount(here, q[there], len(new)) / count
    spread = np.sqrt(np.maximum(np.bincount(here, q[there] ** 2, len(new)) / count - mean**2, 0))
    got = old.transfer(q, new, adapter=adapter)
    assert (np.abs(got - mean) <= 5 * spread / np.sqrt(count) + 1e-12).all()


@pytest.mark.sparse(8)
@ORDERS
@pytest.mark.parametrize("radius", [1.0, 6371229.0])
@pytest.mark.parametrize("counts", [(900, 700), (40, 2000), (2000, 40), (8, 3000), (3000, 8), (9, 8)])
def test_mass_bounds_and_constants(mesh, adapter, order, radius, counts):
    old, new = mesh(counts[0], 991, radius), mesh(counts[1], 4673, radius)
    check_mass_bounds_and_constants(old, new, order, adapter)


@ORDERS
@pytest.mark.parametrize("limited", [True, False])
def test_constants_without_bounds(mesh, adapter, order, limited):
    old, new = mesh(900, 991), mesh(700, 4673)
    got = old.transfer(np.full(900, -2.7), new, order, limited=limited, adapter=adapter)
    np.testing.assert_allclose(got, -2.7, rtol=1e-14)


def test_limited_values_stay_within_those_nearby(mesh, adapter):
    old, new = mesh(2000, 17), mesh(3000, 18)
    step = np.where(old.points[:, 2] > 0.2, 1.0, 0.0)
    got = old.transfer(step, new, 2, adapter=adapter)
    free = old.transfer(step, new, 2, limited=False, adapter=adapter)
    assert free.max() > 1.02
    assert got.max() <= 1
    # No new cell far from the step changes: cells of 2000 are 0.1 wide.
    z = new.points[:, 2]
    np.testing.assert_array_equal(got[z > 0.6], 1)
    np.testing.assert_array_equal(got[z < -0.2], 0)


@pytest.mark.sparse(1)
@ORDERS
@pytest.mark.parametrize("limited", [True, False])
def test_order_of_convergence(adapter, order, limited):
    """Between meshes of cells of about one size, without symmetries in which errors of first order cancel."""

    def function(y):
        return np.sin(3 * y[:, 0] + 1) * np.cos(2 * y[:, 1]) + y[:, 2]

    errors = []
    for k in (3, 5):
        points = UNIT.icosahedral_points(k)
        noise = 0.2 / 2**k * np.random.default_rng(k).normal(size=points.shape)
        old, new = (adapter.diagram(UNIT, UNIT.wrap(x)) for x in (points + noise, points @ TURN))
        got = old.transfer(function(old.centroids), new, order, limited=limited, adapter=adapter)
        errors.append(new.volumes @ np.abs(got - function(new.centroids)))
    rate = math.log(errors[0] / errors[1]) / math.log(4)
    # Parts of higher order make both rates look 0.2 better.
    assert rate > (0.9 if order == 1 else 1.9)
    assert order == 1 or errors[1] < 1e-3


@pytest.mark.sparse(4)
@ORDERS
@pytest.mark.parametrize(
    "points",
    [random_points(700, 1327), grid_of_rings(), UNIT.icosahedral_points(3), clustered_points(800, 9)],
    ids=["random", "rings", "icosahedral", "clustered"],
)
def test_same_mesh_is_the_identity(adapter, points, order):
    old = adapter.diagram(UNIT, points)
    q = np.random.default_rng(7).normal(size=len(old))
    got = old.transfer(q, old, order, adapter=adapter)
    # Intersections as thin as round-off: eps times perimeter over area of the smallest cell.
    np.testing.assert_allclose(got, q, rtol=0, atol=1e-11)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("levels", [(2, 3), (3, 2), (0, 4), (4, 0)])
def test_refined_icosahedra(adapter, levels, order):
    """Generators coincide with generators, and corners lie on faces."""
    old, new = (adapter.diagram(UNIT, UNIT.icosahedral_points(k)) for k in levels)
    q = np.random.default_rng(67).normal(size=len(old))
    got = old.transfer(q, new, order, adapter=adapter)
    assert mass_defect(old, new, q, got) < 1e-13
    if levels[0] < levels[1] and order == 1:
        # A cell around a common generator lies within the old cell.
        np.testing.assert_allclose(got[: len(old)], q, rtol=0, atol=1e-12)


def test_small_cells_keep_their_digits(adapter):
    """In a cap of 1e-4 linear functions are linear to 1e-8 of their range, if areas and centroids are precise."""
    rng = np.random.default_rng(23)
    meshes = []
    for _ in range(2):
        cap = UNIT.wrap(np.array([0.3, -0.5, 0.8]) + 1e-4 * (rng.random((3000, 3)) - 0.5))
        meshes.append(adapter.diagram(UNIT, np.vstack([random_points(60, 3), cap])))
    old, new = meshes
    center = UNIT.wrap(np.array([[0.3, -0.5, 0.8]]))
    slope = np.cross(center[0], [1.0, 2.0, 3.0])
    got = old.transfer((old.centroids - center) @ slope, new, 2, limited=False, adapter=adapter)
    inner = np.linalg.norm(new.centroids - center, axis=1) < 2e-5
    assert inner.sum() > 50
    exact = (new.centroids - center) @ slope
    # The sphere leaves its tangent plane by |u|^2 / 2, and a centroid on the sphere is not that in space.
    np.testing.assert_allclose(got[inner], exact[inner], rtol=0, atol=1e-12)


NAMES = ("volumes", "centroids", "neighbor_starts", "neighbors", "vertices", "cell_vertex_starts", "cell_vertices")


def with_points(diagram, points):
    return Diagram(diagram.domain, {**{k: getattr(diagram, k) for k in NAMES}, "points": points})


@pytest.mark.parametrize("moved", ["old", "new"])
def test_graphs_of_no_voronoi_diagram_are_rejected(mesh, moved):
    meshes = {"old": mesh(600, 1), "new": mesh(500, 2)}
    d = meshes[moved]
    meshes[moved] = with_points(d, np.roll(d.points, 1, axis=0))
    with pytest.raises(InputError, match=r"diagram\.check\(\)"):
        meshes["old"].transfer(np.ones(600), meshes["new"])
