"""Methods of diagrams for cells and faces, against loops over half-faces, brute force and shapely."""

import pickle

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import InputError, InputTypeError

TEETH = clvoro.Polygon(
    [
        (0, 0),
        (6, 0),
        (6, 3),
        (4.1, 3),
        (4.1, 0.4),
        (3.9, 0.4),
        (3.9, 3),
        (2.1, 3),
        (2.1, 0.4),
        (1.9, 0.4),
        (1.9, 3),
        (0, 3),
    ],
    [[(0.5, 1), (1.2, 1), (1.2, 1.7), (0.5, 1.7)]],
    names={"inlet": 11, "island": "hole-1"},
)
"""Thin walls that cut parts of cells off, and a hole."""
DOMAINS = {
    "box": (clvoro.Box((-1, 0), (2, 1.5)), 60),
    "torus": (clvoro.Box((40, 0), (43, 1.5), periodic=True), 40),
    "channel": (clvoro.Box((-1, 0), (2, 1.5), periodic=(True, False), names={"walls": ["yMin", "yMax"]}), 30),
    "few in a torus": (clvoro.Box((0, 0), (1, 1), periodic=True), 2),
    "polygon": (TEETH, 14),
    "island in a cell": (TEETH, 5),
    "space": (clvoro.Box((0, 0, 5), (1, 2, 6)), 60),
    "periodic space": (clvoro.Box((0, 0, 5), (1, 2, 6), periodic=(True, True, False)), 40),
    "few in periodic space": (clvoro.Box((0, 0, 0), (1, 2, 1), periodic=True), 2),
}


def random_points(domain, n, seed=5):
    points = np.random.default_rng(seed).uniform(domain.lower, domain.upper, (40 * n, domain.dim))
    return points[domain.contains(points)][:n]


KINDS = [(name, real) for name in DOMAINS for real in ("float64", "float32")]


@pytest.fixture(scope="module", params=KINDS, ids="-".join)
def case(request, ctx):
    """Return a diagram, and the round-off of its numbers."""
    name, real = request.param
    domain, n = DOMAINS[name]
    diagram = clvoro.Adapter(ctx, real).diagram(domain, random_points(domain, n))
    return diagram, 5e2 * np.finfo(real).eps * max(np.abs(domain.upper))


def half_faces(diagram):
    """Yield (cell, place in the graph) of each half-face that has a measure."""
    for i in range(len(diagram)):
        for k in range(diagram.neighbor_starts[i], diagram.neighbor_starts[i + 1]):
            if diagram.face_measures[k] > 0:
                yield i, k


@pytest.mark.sparse(6)
def test_every_face_is_there_once(case):
    diagram, noise = case
    f = diagram.faces
    rows = list(half_faces(diagram))
    walls = [k for _, k in rows if diagram.neighbors[k] < 0]
    assert len(f) == f.n_inner + np.count_nonzero(f.neighbor < 0)
    assert (f.neighbor[: f.n_inner] >= f.owner[: f.n_inner]).all()
    assert sorted(f.half_face[f.n_inner :]) == walls
    # A face with almost no measure may exist in one of its cells only.
    assert abs(2 * f.n_inner - (len(rows) - len(walls))) <= np.count_nonzero(diagram.face_measures < noise)
    np.testing.assert_array_equal(f.area, diagram.face_measures[f.half_face])
    parts = np.zeros(len(diagram))
    np.add.at(parts, f.owner, f.area)
    np.add.at(parts, f.neighbor[: f.n_inner], f.area[: f.n_inner])
    expected = np.zeros(len(diagram))
    for i, k in rows:
        expected[i] += diagram.face_measures[k]
    np.testing.assert_allclose(parts, expected, atol=10 * noise)


def test_faces_close_cells(case):
    """The areas sum to zero as vectors, and the volume follows from Gauss's theorem, with centers beside the owner."""
    diagram, noise = case
    f, d = diagram.faces, diagram.domain.dim
    inner = f.n_inner
    np.testing.assert_allclose(np.linalg.norm(f.normal, axis=1), 1, atol=1e-12)
    vectors, volumes = np.zeros((len(diagram), d)), np.zeros(len(diagram))
    back = f.center[:inner] - f.shift[:inner] * diagram.domain.extent
    sides = [(f.owner, f.center, f.normal, f.area), (f.neighbor[:inner], back, -f.normal[:inner], f.area[:inner])]
    for cell, center, normal, area in sides:
        np.add.at(vectors, cell, area[:, None] * normal)
        arm = ((center - diagram.points[cell]) * normal).sum(axis=1)
        np.add.at(volumes, cell, area * arm / d)
    np.testing.assert_allclose(vectors, 0, atol=20 * noise)
    np.testing.assert_allclose(volumes, diagram.volumes, atol=20 * noise)


def test_geometry_of_faces(case):
    diagram, noise = case
    f, domain = diagram.faces, diagram.domain
    for k in range(f.n_inner):
        image = diagram.points[f.neighbor[k]] + f.shift[k] * domain.extent
        between = image - diagram.points[f.owner[k]]
        assert f.distance[k] == pytest.approx(np.linalg.norm(between))
        assert f.boundary[k] == -1
    assert (f.shift[f.n_inner :] == 0).all()
    for k in range(f.n_inner, len(f)):
        wall = -1 - f.neighbor[k]
        assert f.boundary[k] == domain.boundary_index[wall]
        foot = diagram.points[f.owner[k]] + f.distance[k] * f.normal[k]
        assert abs((f.center[k] - foot) @ f.normal[k]) < noise


@pytest.mark.sparse(6)
def test_corners_of_faces_go_around_the_normal(case):
    diagram, noise = case
    f = diagram.faces
    for k in np.flatnonzero(f.area > 1e3 * noise):
        corners = f.points[f.corners[f.starts[k] : f.starts[k + 1]]]
        if f.neighbor[k] < f.owner[k] and f.neighbor[k] >= 0:
            continue
        if corners.shape[1] == 2:
            begin, end = corners
            turned = np.array([(end - begin)[1], (begin - end)[0]])
        else:
            arms = corners - corners[0]
            turned = np.cross(arms[1:-1], arms[2:]).sum(axis=0) / 2
        assert np.linalg.norm(turned) == pytest.approx(f.area[k], rel=1e-2, abs=noise)
        assert turned @ f.normal[k] == pytest.approx(f.area[k], rel=1e-2, abs=noise)


def test_adjacency(case):
    diagram, noise = case
    graph = diagram.adjacency.toarray()
    expected = np.zeros_like(graph)
    for i, k in half_faces(diagram):
        if diagram.neighbors[k] >= 0:
            expected[i, diagram.neighbors[k]] += diagram.face_measures[k]
    np.testing.assert_array_equal(graph, graph.T)
    np.testing.assert_allclose(graph, expected, atol=10 * noise)


@pytest.mark.sparse(6)
def test_cells(case):
    diagram, noise = case
    for i in range(len(diagram)):
        cell = diagram.cell(i)
        assert (cell.generator == diagram.points[i]).all()
        assert cell.volume == diagram.volumes[i]
        assert len(cell.faces) == len(cell.neighbors) == len(cell.areas)
        assert len(np.unique(cell.vertices, axis=0)) == len(cell.vertices)
        used = np.concatenate([face for face in cell.faces])
        assert set(used) == set(range(len(cell.vertices)))
        volume = 0.0
        for corners in cell.faces:
            x = cell.vertices[corners] - cell.generator
            if x.shape[1] == 2:
                volume += np.linalg.det(x) / 2
            elif len(x):
                volume += sum(np.linalg.det([x[0], *x[j : j + 2]]) / 6 for j in range(1, len(x) - 1))
        assert volume == pytest.approx(cell.volume, abs=20 * noise)
    assert diagram.cell(-1).index == len(diagram) - 1


def nearest(diagram, points):
    """The nearest generator by brute force over images."""
    domain = diagram.domain
    best, found = np.full(len(points), np.inf), np.zeros(len(points), int)
    for step in np.ndindex(*(3 if p else 1 for p in domain.periodic)):
        away = (np.array(step) - np.array(domain.periodic)) * domain.extent
        distance = np.linalg.norm(points[:, None] - (diagram.points + away), axis=2)
        closer = distance.min(axis=1) < best
        found[closer] = distance.argmin(axis=1)[closer]
        best = np.minimum(best, distance.min(axis=1))
    return found


def winds_around(diagram, i, point):
    """Whether the faces of cell i wind around the point."""
    angle = 0.0
    for corners in diagram.cell(i).faces:
        a, b = diagram.cell(i).vertices[corners] - point
        angle += np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
    return abs(angle) > np.pi


@pytest.mark.sparse(6)
def test_locate(case):
    diagram, _ = case
    domain = diagram.domain
    points = random_points(domain, 50, seed=77)
    if isinstance(domain, clvoro.Polygon):
        expected = [next(i for i in range(len(diagram)) if winds_around(diagram, i, x)) for x in points]
        assert (expected != nearest(diagram, points)).any()
    else:
        expected = nearest(diagram, points)
    found = diagram.locate(points)
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(diagram.locate(diagram.points), np.arange(len(diagram)))


def test_locate_outside(case):
    diagram, _ = case
    domain = diagram.domain
    for axis, periodic in enumerate(domain.periodic):
        beside = diagram.points.copy()
        beside[:, axis] += domain.extent[axis] * (2 if periodic else 1)
        expected = np.arange(len(diagram)) if periodic else np.full(len(diagram), -1)
        np.testing.assert_array_equal(diagram.locate(beside), expected)
    assert diagram.locate([[np.nan] * domain.dim]).tolist() == [-1]
    assert diagram.locate(np.empty((0, domain.dim))).shape == (0,)


def test_points_on_seams_are_found(ctx):
    for domain in (DOMAINS["torus"][0], clvoro.Box((1e7, 0), (1e7 + 0.1, 1), periodic=True)):
        diagram = clvoro.Adapter(ctx).diagram(domain, random_points(domain, 9))
        corners = np.array([domain.lower, domain.upper, np.nextafter(domain.upper, domain.lower)])
        assert len(set(diagram.locate(corners))) == 1


def test_points_in_a_hole_are_outside(ctx):
    diagram = clvoro.Adapter(ctx).diagram(TEETH, random_points(TEETH, 20))
    assert diagram.locate([(0.8, 1.3), (2.0, 2.0), (2.0, 0.2)]).tolist()[:2] == [-1, -1]
    assert diagram.locate([(2.0, 0.2)])[0] >= 0


def test_names_of_boundaries(ctx):
    diagram = clvoro.Adapter(ctx).diagram(TEETH, random_points(TEETH, 40))
    f = diagram.faces
    length = {name: f.area[f.boundary == b].sum() for b, name in enumerate(TEETH.boundary_names)}
    outer = 6 + 3 + 2 * 1.9 + 1.8 + 4 * 2.6 + 2 * 0.2
    assert length == pytest.approx({"inlet": 3.0, "island": 2.8, "outer": outer})


def test_cells_on_boundaries(ctx):
    hole = [(0.4, 0.4), (0.6, 0.4), (0.5, 0.6)]
    outer = [(0, 0), (1, 0), (1, 1), (0, 1)]
    domains = (
        clvoro.Polygon(outer, [hole], names={"south": 0, "rest": [1, 2, 3]}),
        clvoro.Box((0, 0), (1, 1), periodic=(True, False), names={"south": "yMin"}),
        clvoro.Box((0, 0, 0), (1, 1, 1), names={"south": "yMin"}),
    )
    for domain in domains:
        points = np.random.default_rng(3).random((60, domain.dim))
        d = clvoro.Adapter(ctx).diagram(domain, points[domain.contains(points)])
        f = d.faces
        for name in domain.boundary_names:
            owners = f.owner[f.boundary == domain.boundary_names.index(name)]
            assert d.boundary_cells(name).tolist() == sorted(set(owners.tolist()))
        assert d.boundary_cells().tolist() == sorted(set(f.owner[f.neighbor < 0].tolist()))
        with pytest.raises(InputError, match="boundary is 'river', expected the name"):
            d.boundary_cells("river")
    globe = clvoro.Adapter(ctx).diagram(clvoro.Sphere(1), np.vstack([np.eye(3), -np.eye(3)]))
    assert globe.boundary_cells().size == 0


def test_to_shapely(case):
    diagram, noise = case
    if diagram.domain.dim == 3:
        with pytest.raises(InputError, match="in 3D or on a sphere; use to_pyvista"):
            diagram.to_shapely()
        return
    shapes = diagram.to_shapely()
    np.testing.assert_allclose(shapely.area(shapes), diagram.volumes, atol=20 * noise)
    centers = shapely.get_coordinates(shapely.centroid(shapes))
    np.testing.assert_allclose(centers, diagram.centroids, atol=1e2 * noise)
    shapes[0] = None
    assert diagram.to_shapely()[0] is not None


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda d: d.cell(3), InputError, "i is 3, expected at most 2: the diagram has 3 cells"),
        (lambda d: d.cell(-4), InputError, "i is -4, expected at least -3"),
        (lambda d: d.cell(1.0), InputTypeError, "i is 1.0 of type float, expected an integer"),
        (lambda d: d.locate([(1, 2, 3)]), InputError, r"points has shape \(1, 3\)"),
        (lambda d: d.locate("here"), InputTypeError, "expected an array of real numbers"),
    ],
)
def test_bad_arguments(ctx, call, error, message):
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0), (1, 1)), [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8)])
    with pytest.raises(error, match=message):
        call(diagram)


def test_pickled_diagrams_are_the_same(ctx):
    diagram = clvoro.Adapter(ctx).diagram(TEETH, random_points(TEETH, 20))
    faces, again = diagram.faces, pickle.loads(pickle.dumps(diagram))
    np.testing.assert_array_equal(again.faces.normal, faces.normal)
    np.testing.assert_array_equal(again.neighbors, diagram.neighbors)
    cell = pickle.loads(pickle.dumps(diagram.cell(3)))
    assert not cell.vertices.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        faces.area[0] = 1
