"""Transfer of cell data: comparison with plain clipping, and properties that hold on any mesh."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, HalfspaceIntersection

import clvoro
from clvoro import Box
from clvoro.errors import InputError, InputTypeError
from clvoro.mesh.diagram import Diagram
from tests.reference.diagrams3d import polygon

BOXES = {2: Box((-0.3, 0.2), (1.7, 1.1)), 3: Box((-0.3, 0.2, 5), (0.8, 1.1, 5.9))}
DIMS = pytest.mark.parametrize("dim", [2, 3])


@pytest.fixture(scope="module")
def mesh(adapter):
    """Return a function that makes a diagram of n random generators."""
    made = {}

    def make(dim, n, seed):
        if (dim, n, seed) not in made:
            box = BOXES[dim]
            points = box.lower + box.extent * np.random.default_rng(seed).random((n, dim))
            made[dim, n, seed] = adapter.diagram(box, points)
        return made[dim, n, seed]

    return make


def lattice(adapter, dim, side):
    """Return a diagram whose cells are equal boxes."""
    box = BOXES[dim]
    axes = [low + (high - low) * (np.arange(side) + 0.5) / side for low, high in zip(box.lower, box.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    return adapter.diagram(box, grid)


def mass_defect(old, new, values, carried):
    whole = (old.volumes * np.abs(values).T).sum(axis=-1)
    gone = (old.volumes * values.T).sum(axis=-1)
    return np.abs((new.volumes * carried.T).sum(axis=-1) - gone).max() / whole.max()


def check_mass_bounds_and_constants(old, new, order, adapter):
    rng = np.random.default_rng(88)
    q = np.column_stack([rng.normal(size=len(old)), np.full(len(old), -2.7), rng.random(len(old)) > 0.7])
    got = old.transfer(q, new, order, adapter=adapter)
    assert got.shape == (len(new), 3)
    # The round-off of a sum of a thousand products is about 1e-14.
    assert mass_defect(old, new, q, got) < 1e-13
    assert (got >= q.min(axis=0)).all()
    assert (got <= q.max(axis=0)).all()
    np.testing.assert_array_equal(got[:, 1], -2.7)


def half_spaces(diagram, i):
    """Return rows (a, b) of the half-spaces a.y + b <= 0 of cell i, walls included."""
    x, box = diagram.points, diagram.domain
    others = np.delete(x, i, axis=0)
    normals = others - x[i]
    planes = np.column_stack([normals, -((others**2).sum(axis=1) - (x[i] ** 2).sum()) / 2])
    eye = np.eye(box.dim)
    walls = np.vstack([np.column_stack([eye, -np.array(box.upper)]), np.column_stack([-eye, box.lower])])
    planes = np.vstack([planes, walls])
    return planes / np.linalg.norm(planes[:, :-1], axis=1, keepdims=True)


def clip_polygon(corners, plane):
    kept = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        sa, sb = plane[:2] @ a + plane[2], plane[:2] @ b + plane[2]
        if sa <= 0:
            kept.append(a)
        if (sa <= 0) != (sb <= 0):
            kept.append(a + (b - a) * sa / (sa - sb))
    return np.array(kept).reshape(-1, 2)


def flat_part(box, planes):
    """Return area and centroid of the intersection of a 2D box with half-planes."""
    (x0, y0), (x1, y1) = box.lower, box.upper
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    for plane in planes:
        corners = clip_polygon(corners, plane)
        if len(corners) < 3:
            return 0.0, np.zeros(2)
    flat = np.column_stack([corners, np.zeros(len(corners))])
    area, centroid, _ = polygon(flat, flat.mean(axis=0))
    return area, centroid[:2]


def solid_part(planes):
    """Return volume and centroid of the intersection of half-spaces, computed by Qhull from an inner point."""
    from scipy.optimize import linprog

    ones = np.ones(len(planes))
    ball = linprog(
        [0, 0, 0, -1], np.column_stack([planes[:, :3], ones]), -planes[:, 3], bounds=[(None, None)] * 3 + [(0, None)]
    )
    if not ball.success or ball.x[3] < 1e-7:
        return 0.0, np.zeros(3)
    corners = HalfspaceIntersection(planes, ball.x[:3]).intersections
    hull = ConvexHull(corners)
    middle = corners.mean(axis=0)
    tetrahedra = corners[hull.simplices] - middle
    volumes = np.abs(np.linalg.det(tetrahedra)) / 6
    centroid = middle + (volumes[:, None] * tetrahedra.sum(axis=1) / 4).sum(axis=0) / volumes.sum()
    return volumes.sum(), centroid


@cache
def overlaps(old, new):
    """Return volumes (n_new, n_old) and first moments (n_new, n_old, d) of all intersections."""
    dim = old.domain.dim
    volumes = np.zeros((len(new), len(old)))
    moments = np.zeros((len(new), len(old), dim))
    old_planes = [half_spaces(old, j) for j in range(len(old))]
    for i in range(len(new)):
        mine = half_spaces(new, i)
        for j, planes in enumerate(old_planes):
            both = np.vstack([mine, planes])
            volume, centroid = flat_part(old.domain, both) if dim == 2 else solid_part(both)
            volumes[i, j], moments[i, j] = volume, volume * centroid
    return volumes, moments


def slopes(diagram, q):
    """Return least-squares slopes, and the extremes over each cell and its neighbors."""
    found = np.zeros_like(diagram.centroids)
    least, most = q.copy(), q.copy()
    for i, c in enumerate(diagram.centroids):
        row = diagram.neighbors[diagram.neighbor_starts[i] : diagram.neighbor_starts[i + 1]]
        row = row[row >= 0]
        d = diagram.centroids[row] - c
        weight = 1 / np.linalg.norm(d, axis=1)
        found[i] = np.linalg.lstsq(d * weight[:, None], (q[row] - q[i]) * weight, rcond=None)[0]
        least[i], most[i] = min(q[i], q[row].min()), max(q[i], q[row].max())
    return found, least, most


def corners(diagram, i):
    """Return the corners of a cell."""
    if diagram.domain.dim == 2:
        a, b = diagram.cell_vertex_starts[i : i + 2]
        return diagram.vertices[diagram.cell_vertices[a:b]]
    faces = range(*diagram.neighbor_starts[i : i + 2])
    starts = diagram.face_vertex_starts
    rows = np.concatenate([diagram.face_vertices[starts[f] : starts[f + 1]] for f in faces])
    return diagram.vertices[np.unique(rows)]


@pytest.mark.sparse(2)
@DIMS
@pytest.mark.parametrize("way", ["first", "second", "limited"])
def test_matches_plain_clipping(mesh, adapter, dim, way):
    old, new = mesh(dim, 23, 5821), mesh(dim, 19 if dim == 2 else 5, 7717)
    q = np.random.default_rng(311).normal(size=23)
    volumes, moments = overlaps(old, new)
    if dim == 3:
        # Qhull drops intersections that it takes for flat.
        assert volumes.sum() == pytest.approx(old.domain.measure, rel=1e-6)
    expected = volumes @ q
    if way != "first":
        g, least, most = slopes(old, q)
        if way == "limited":
            for j in range(23):
                rise = (corners(old, j) - old.centroids[j]) @ g[j]
                room = np.where(rise > 0, most[j] - q[j], least[j] - q[j])
                g[j] *= min(1, np.min(np.where(rise == 0, np.inf, room / rise)))
        offset = moments - volumes[:, :, None] * old.centroids
        expected = expected + np.einsum("ijd,jd->i", offset, g)
    expected /= volumes.sum(axis=1)
    order = 1 if way == "first" else 2
    got = old.transfer(q, new, order, limited=way != "second", adapter=adapter)
    # In 3D the reference drops intersections thinner than 1e-7.
    np.testing.assert_allclose(got, expected, atol=1e-12 if dim == 2 else 1e-5)


@pytest.mark.sparse(8)
@DIMS
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("counts", [(400, 300), (40, 900), (900, 40), (1, 50), (50, 1), (1, 1)])
def test_mass_bounds_and_constants(mesh, adapter, dim, order, counts):
    check_mass_bounds_and_constants(mesh(dim, counts[0], 991), mesh(dim, counts[1], 4673), order, adapter)


@pytest.mark.sparse(1)
@DIMS
def test_linear_functions_are_exact_without_limiter(mesh, adapter, dim):
    old, new = mesh(dim, 500, 2203), mesh(dim, 700, 6101)
    slope = np.array([0.7, -1.3, 2.1])[:dim]
    got = old.transfer(2 + old.centroids @ slope, new, 2, limited=False, adapter=adapter)
    # The round-off of a slope is eps * value / distance of neighbors.
    np.testing.assert_allclose(got, 2 + new.centroids @ slope, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "points",
    [
        [(0.1, 0.13), (0.5, 0.8), (0.9, 0.2), (0.7, 0.5), (0.05, 0.04)],
        [(0.2, 0.3), (0.7, 0.6)],
        [(0.1, 0.2, 0.3), (0.5, 0.9, 0.4), (0.8, 0.3, 0.9)],
    ],
)
def test_too_few_neighbors_give_slopes_of_least_norm(adapter, points):
    """A corner cell with one neighbor, or cells in a row, do not determine all slopes."""
    dim = len(points[0])
    box = Box((0,) * dim, (1,) * dim)
    old = adapter.diagram(box, points)
    new = adapter.diagram(box, np.random.default_rng(1789).random((300, dim)))
    q = np.random.default_rng(8).normal(size=len(old))
    got = old.transfer(q, new, 2, limited=False, adapter=adapter)
    g, _, _ = slopes(old, q)
    owner = ((new.points[:, None] - old.points) ** 2).sum(axis=2).argmin(axis=1)
    # New cells whose corners all lie in one old cell.
    whole = [
        i
        for i in range(len(new))
        if (((corners(new, i)[:, None] - old.points) ** 2).sum(axis=2).argmin(axis=1) == owner[i]).all()
    ]
    assert len(whole) > 50
    expected = q[owner] + ((new.centroids - old.centroids[owner]) * g[owner]).sum(axis=1)
    # Singular systems are solved to sqrt(eps).
    np.testing.assert_allclose(got[whole], expected[whole], rtol=0, atol=1e-6)


def test_limiter_keeps_linear_functions_in_the_interior_of_good_meshes(adapter):
    box = Box((0, 0), (1, 1))
    old = adapter.run(box, 0.06, seed=93, effort="fast").diagram
    new = adapter.run(box, 0.05, seed=57, effort="fast").diagram
    linear = 1 + old.centroids @ [2.0, -0.6]
    got = old.transfer(linear, new, 2, adapter=adapter)
    exact = 1 + new.centroids @ [2.0, -0.6]
    inner = (np.abs(new.centroids - 0.5) < 0.3).all(axis=1)
    # Corners of most cells lie within the hull of the neighbors' centroids, where the limiter changes nothing.
    assert np.mean(np.abs(got - exact)[inner] < 1e-12) > 0.8
    assert np.abs(got - exact)[inner].mean() < 0.05 * 0.06 * math.hypot(2, 0.6)


@DIMS
@pytest.mark.parametrize("order", [1, 2])
def test_same_mesh_is_the_identity(mesh, adapter, dim, order):
    old = mesh(dim, 700, 1327)
    q = np.random.default_rng(7).normal(size=700)
    got = old.transfer(q, old, order, adapter=adapter)
    # Intersections as thin as round-off: eps times surface over volume of the smallest cell.
    np.testing.assert_allclose(got, q, rtol=0, atol=1e-12)


@pytest.mark.sparse(4)
@DIMS
@pytest.mark.parametrize("sides", [(6, 6, 0.0), (6, 12, 0.0), (12, 6, 0.0), (6, 9, 0.0), (6, 6, 0.5)])
def test_lattices(adapter, dim, sides):
    """Faces coincide with faces, corners with corners, generators with corners."""
    coarse, fine, shift = sides
    old = lattice(adapter, dim, coarse)
    new = lattice(adapter, dim, fine)
    if shift:
        # Corners of the old cells become generators.
        box, edge = BOXES[dim], BOXES[dim].extent / coarse
        axes = [box.lower[a] + edge[a] * np.arange(1, coarse) for a in range(dim)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
        new = adapter.diagram(box, points)
    q = np.random.default_rng(67).normal(size=len(old))
    got = old.transfer(q, new, adapter=adapter)
    assert mass_defect(old, new, q, got) < 1e-13
    # The volume of an intersection of two boxes is the product of the overlaps along the axes.
    old_ends = np.linspace(0, 1, coarse + 1)
    new_ends = np.linspace(0, 1, fine + 1)
    if shift:
        new_ends = np.concatenate([[0], (np.arange(1, coarse - 1) + 0.5) / coarse, [1]])
    lower = np.maximum(new_ends[:-1, None], old_ends[None, :-1])
    upper = np.minimum(new_ends[1:, None], old_ends[None, 1:])
    share = np.maximum(upper - lower, 0) / np.diff(new_ends)[:, None]
    expected = q.reshape((coarse,) * dim)
    for axis in range(dim):
        expected = np.moveaxis(np.tensordot(share, expected, (1, axis)), 0, axis)
    np.testing.assert_allclose(got, expected.ravel(), rtol=0, atol=1e-12)


@pytest.mark.sparse(1)
@DIMS
def test_transfer_to_refined_mesh_and_back(mesh, adapter, dim):
    """The finer mesh contains the old generators; mass and bounds are kept both ways."""
    old = mesh(dim, 150, 3037)
    rng = np.random.default_rng(45)
    near = old.points.repeat(20, axis=0)
    near += 1e-3 * rng.normal(size=near.shape)
    inside = old.domain.contains(near)
    new = adapter.diagram(old.domain, np.vstack([old.points, near[inside]]))
    q = rng.normal(size=150)
    there = old.transfer(q, new, adapter=adapter)
    back = new.transfer(there, old, adapter=adapter)
    assert mass_defect(old, new, q, there) < 1e-13
    assert mass_defect(old, old, q, back) < 1e-13
    # The cells of the old generators in the new mesh lie within their old cells.
    assert np.abs(there[:150] - q).max() < 1e-12
    assert np.abs(back - q).mean() < np.abs(q).mean()


@pytest.mark.sparse(1)
@DIMS
def test_size_ratio_of_a_million(adapter, dim):
    """One mesh has a cluster of 1e-6 of the box: a cell overlaps thousands, or lies within one."""
    box = BOXES[dim]
    rng = np.random.default_rng(191)
    wide = box.lower + box.extent * rng.random((60, dim))
    cluster = wide[0] + 1e-6 * (rng.random((1500, dim)) - 0.5)
    one = adapter.diagram(box, np.vstack([wide[1:], cluster]))
    other = adapter.diagram(box, box.lower + box.extent * rng.random((70, dim)))
    for old, new in ((one, other), (other, one)):
        q = rng.normal(size=len(old))
        for order in (1, 2):
            got = old.transfer(q, new, order, adapter=adapter)
            assert mass_defect(old, new, q, got) < 1e-13
            assert got.min() >= q.min()
            assert got.max() <= q.max()
        linear = old.transfer(old.centroids[:, 0], new, 2, limited=False, adapter=adapter)
        np.testing.assert_allclose(linear, new.centroids[:, 0], rtol=0, atol=1e-9)


def test_lists_grow_for_a_cell_with_many_overlaps(mesh, adapter):
    old, new = mesh(2, 20_000, 401), mesh(2, 3, 83)
    got = old.transfer(old.centroids[:, 0], new, 2, limited=False, adapter=adapter)
    np.testing.assert_allclose(got, new.centroids[:, 0], rtol=0, atol=1e-11)


@pytest.mark.parametrize("dim", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_cells_of_many_faces(adapter, dim):
    """A ring or a sphere of generators around one gives the middle cell 90 faces."""
    box = Box((0,) * dim, (1,) * dim)
    turns = 2 * np.pi * np.arange(90)
    height = (2 * np.arange(90) + 1) / 90 - 1 if dim == 3 else np.zeros(90)
    angle = turns / 90 if dim == 2 else turns * (np.sqrt(5) - 1) / 2
    around = np.sqrt(1 - height**2)
    sphere = np.column_stack([around * np.cos(angle), around * np.sin(angle), height])[:, :dim]
    old = adapter.diagram(box, 0.5 + 0.3 * np.vstack([np.zeros(dim), sphere]))
    new = adapter.diagram(box, old.points + 0.01 * np.eye(dim)[0])
    assert np.diff(old.neighbor_starts).max() == 90
    got = old.transfer(old.centroids[:, 1], new, 2, limited=False, adapter=adapter)
    np.testing.assert_allclose(got, new.centroids[:, 1], rtol=0, atol=1e-11)
    # The new cell lies within one old cell. Their intersection needs room for 90 faces.
    wide = adapter.diagram(box, np.array([0.5] * dim) + np.array([[-0.49], [-0.41]]) * np.eye(dim)[0])
    again = clvoro.Adapter(adapter.ctx)
    got = wide.transfer(wide.centroids[:, 0], new, 2, limited=False, adapter=again)
    # Singular systems are solved to sqrt(eps).
    np.testing.assert_allclose(got, new.centroids[:, 0], rtol=0, atol=1e-7)


def test_faces_that_differ_by_round_off(adapter):
    """Move the common face of two prisms by about the round-off of its corners.

    Some corners are then beyond the new face while others between them are not.
    """
    angle = 2 * np.pi * np.arange(40) / 40
    ring = 0.5 + 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    layer = np.column_stack([np.vstack([[0.5, 0.5], ring]), np.full(41, 0.25)])
    box, q = Box((0, 0, 0), (1, 1, 1)), np.random.default_rng(68).normal(size=82)
    old = adapter.diagram(box, np.vstack([layer, layer + np.array([0, 0, 0.5])]))
    for roundings in (*range(-20, -4), *range(5, 21)):
        higher = layer + np.array([0, 0, 0.5 + roundings * 2.0**-53])
        new = adapter.diagram(box, np.vstack([layer, higher]))
        got = old.transfer(q, new, adapter=adapter)
        assert mass_defect(old, new, q, got) < 1e-13
        np.testing.assert_allclose(got, q, rtol=0, atol=1e-12)


def test_order_of_convergence(adapter):
    box = Box((0, 0), (1, 1))
    errors = []
    for size in (0.08, 0.02):
        old = adapter.run(box, size, seed=29, effort="fast").diagram
        new = adapter.run(box, size, seed=83, effort="fast").diagram
        f = lambda x: np.sin(3 * x[:, 0] + 1) * np.cos(2 * x[:, 1])  # noqa: E731
        found = [old.transfer(f(old.centroids), new, order, adapter=adapter) for order in (1, 2)]
        errors.append([new.volumes @ np.abs(q - f(new.centroids)) for q in found])
    first, second = np.log(np.divide(*errors)) / math.log(4)
    assert first > 0.9
    assert second > 1.7  # the limiter at walls costs some


def test_repeats_bit_for_bit_and_needs_no_adapter(mesh):
    old, new = mesh(2, 300, 21), mesh(2, 400, 22)
    q = np.random.default_rng(5).normal(size=(300, 2))
    once = old.transfer(q, new, 2)
    np.testing.assert_array_equal(old.transfer(q, new, 2), once)
    np.testing.assert_array_equal(old.transfer(q[:, 1], new, 2), once[:, 1])


@pytest.mark.sparse(1)
@DIMS
def test_results_in_single_precision(ctx, dim):
    single = clvoro.Adapter(ctx, dtype="float32")
    box = BOXES[dim]
    runs = [single.run(box, size, seed=61, method="weighted", max_steps=5) for size in (0.17, 0.14)]
    q = np.sin(7 * runs[0].diagram.centroids[:, 0])
    got = runs[0].transfer(q, onto=runs[1], order=2, adapter=single)
    assert mass_defect(runs[0].diagram, runs[1].diagram, q, got) < 1e-12
    assert got.min() >= q.min()
    assert got.max() <= q.max()


@pytest.mark.sparse(1)
@DIMS
def test_device_without_double_precision(mesh, ctx, monkeypatch, dim):
    from clvoro.remapping import cell_data

    real = np.dtype(np.float32)
    engine = cell_data.Engine
    monkeypatch.setattr(cell_data, "Engine", lambda c, queue, d, _, traits: engine(c, queue, d, real, traits))
    old, new = mesh(dim, 200, 17), mesh(dim, 250, 18)
    q = np.random.default_rng(3).normal(size=200)
    got = old.transfer(q, new, 1, adapter=clvoro.Adapter(ctx))
    monkeypatch.undo()
    assert mass_defect(old, new, q, got) < 1e-13
    # Single precision over the width of a cell; small cells have the largest error.
    np.testing.assert_allclose(got, old.transfer(q, new), rtol=0, atol=3e-4)


def test_large_and_small_numbers(mesh, adapter):
    old, new = mesh(2, 90, 71), mesh(2, 80, 72)
    q = np.random.default_rng(13).normal(size=90)
    plain = old.transfer(q, new, 2, adapter=adapter)
    for factor in (2.0**1000, 2.0**-900):
        np.testing.assert_array_equal(old.transfer(q * factor, new, 2, adapter=adapter), plain * factor)
    np.testing.assert_array_equal(old.transfer(np.zeros(90), new, adapter=adapter), 0)
    assert np.isfinite(old.transfer(np.copysign(1.7e308, q), new, 2, adapter=adapter)).all()


@settings(max_examples=25)
@given(data=st.data(), dim=st.sampled_from([2, 3]), order=st.sampled_from([1, 2]))
def test_any_mesh(adapter, data, dim, order):
    """Generators on a coarse grid are cocircular, collinear, on walls, and few."""
    box = Box((0,) * dim, (1,) * dim)
    place = st.tuples(*[st.integers(0, 8)] * dim)
    meshes = [
        adapter.diagram(box, np.array(data.draw(st.lists(place, min_size=1, max_size=25, unique=True))) / 8)
        for _ in range(2)
    ]
    old, new = meshes
    q = np.linspace(-1, 1, len(old)) ** 3
    got = old.transfer(q, new, order, adapter=adapter)
    assert mass_defect(old, new, q, got) < 1e-13
    assert got.min() >= q.min()
    assert got.max() <= q.max()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.ones(7), r"shape \(7,\), expected \(9,\) or \(9, k\)"),
        (np.ones((2, 9)), r"pass values\.T"),
        (np.ones((9, 2, 2)), r"\(9, 2, 2\)"),
        (np.where(np.arange(9) == 4, np.nan, 1.0), r"values\[4\] is nan.*1 of 9"),
        (np.full(9, np.inf), r"values\[0\] is inf"),
        (1.0, r"shape \(\)"),
    ],
)
def test_bad_values(mesh, values, said):
    with pytest.raises(InputError, match=said):
        mesh(2, 9, 1).transfer(values, mesh(2, 8, 2))


def test_other_bad_input(mesh, adapter):
    old, new = mesh(2, 9, 1), mesh(2, 8, 2)
    with pytest.raises(InputTypeError, match="complex128"):
        old.transfer(np.ones(9, complex), new)
    with pytest.raises(InputTypeError, match="onto is a ndarray"):
        old.transfer(np.ones(9), new.points)
    with pytest.raises(InputError, match="order is 3, expected 1 or 2"):
        old.transfer(np.ones(9), new, 3)
    assert old.transfer(np.ones((9, 0)), new).shape == (8, 0)


@pytest.mark.parametrize("kind", ["coincident", "permuted"])
@pytest.mark.parametrize("which", ["old", "new"])
def test_meshes_that_are_not_of_their_points_are_rejected(mesh, adapter, kind, which):
    meshes = {"old": mesh(3, 60, 1), "new": mesh(3, 50, 2)}
    given = meshes[which]
    points = given.points.copy()
    if kind == "permuted":
        points = np.roll(points, 1, axis=0)
    else:
        beside = given.neighbors[slice(*given.neighbor_starts[7:9])]
        points[7] = points[beside[beside >= 0][0]]
    names = ("volumes", "centroids", "neighbor_starts", "neighbors")
    meshes[which] = Diagram(given.domain, {**{name: getattr(given, name) for name in names}, "points": points})
    with pytest.raises(InputError, match="distinct generators"):
        meshes["old"].transfer(np.ones(60), meshes["new"], adapter=adapter)
