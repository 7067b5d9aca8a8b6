"""Measures for C grids against triangles of other libraries and lattices known by hand, and the check for MPAS."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

import clvoro
from clvoro.earth.c_grid import measure_c_grid
from tests.mesh.test_sphere_check import icosahedron, scattered

RADIUS = 3.0


@pytest.fixture(scope="module")
def globe(ctx):
    return clvoro.Adapter(ctx, "float64").diagram(clvoro.Sphere(RADIUS), scattered(300))


def lattice(ctx, points, lengths):
    box = clvoro.Box((0, 0), lengths, periodic=(True, True))
    return clvoro.Adapter(ctx, "float64").diagram(box, points)


def flat_angles(points, triangles):
    """All angles of triangles in degrees, (t, 3), by the law of cosines."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    sides = [np.linalg.norm(x, axis=1) for x in (c - b, a - c, b - a)]
    cosines = [
        (sides[k - 1] ** 2 + sides[k - 2] ** 2 - sides[k] ** 2) / (2 * sides[k - 1] * sides[k - 2]) for k in range(3)
    ]
    return np.degrees(np.arccos(np.stack(cosines, axis=1)))


def outside(points, triangles):
    """Whether the point of the sphere at the same distance from three corners is outside of their triangle."""
    a, b, c = points[triangles].transpose(1, 0, 2)
    center = np.cross(b - a, c - a)
    center *= np.sign((center * a).sum(axis=1))[:, None]
    turns = [(np.cross(p, q) * center).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]
    return np.ptp(np.sign(turns), axis=0) > 0


def area(*corners):
    """Area of a spherical triangle as the sum of its angles minus pi, with the sign of its orientation."""
    a, b, c = (x / np.linalg.norm(x) for x in corners)
    total = -np.pi
    for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
        one, two = np.cross(p, q), np.cross(p, r)
        total += np.arctan2(np.linalg.norm(np.cross(one, two)), one @ two)
    return total * np.sign(np.linalg.det([a, b, c]))


def test_angles_are_those_of_the_convex_hull(globe):
    """The Delaunay triangles on a sphere are the faces of the convex hull of the generators."""
    m = measure_c_grid(globe)
    triangles = ConvexHull(globe.points).simplices
    expected = flat_angles(globe.points, triangles)
    # arccos loses digits at the ends.
    assert np.sort(m.angles) == pytest.approx(np.sort(expected.ravel()), abs=1e-6)
    assert m.obtuse == np.count_nonzero(outside(globe.points, triangles)) > 100
    assert m.obtuse == np.count_nonzero(m.edge_offset > 0.5) / 2


def test_each_angle_belongs_to_its_corner(globe):
    m, starts = measure_c_grid(globe), globe.half_faces.ends[:, 0]
    meeting = [[] for _ in globe.vertices]
    for cell, vertex in zip(globe.half_faces.owner, starts, strict=True):
        meeting[vertex].append(cell)
    for k in range(0, len(m.corners), 17):
        face = m.corners[k]
        i, j = globe.half_faces.owner[face], globe.neighbors[face]
        (third,) = set(meeting[starts[face]]) - {i, j}
        expected = flat_angles(globe.points, np.array([[third, i, j]]))[0, 0]
        assert m.angles[k] == pytest.approx(expected, abs=1e-6)


def test_kites_one_by_one(globe):
    m, d = measure_c_grid(globe), globe
    owner, begin = d.half_faces.owner, d.half_faces.ends[:, 0]
    for k in range(0, len(m.corners), 13):
        face = m.corners[k]
        i = owner[face]
        first, last = d.neighbor_starts[i], d.neighbor_starts[i + 1]
        before = face - 1 if face > first else last - 1
        middles = [d.points[i] + d.points[d.neighbors[f]] for f in (before, face)]
        own, vertex = d.points[i], d.vertices[begin[face]]
        expected = area(own, middles[0], vertex) + area(own, vertex, middles[1])
        # Sums of angles have the round-off of 1; cells have 0.04.
        assert m.kites[k] == pytest.approx(expected * RADIUS**2 / d.volumes[i], abs=1e-10)
    assert m.negative_kites == np.count_nonzero(m.kites < 0) > 0


def test_kites_fill_each_cell(globe):
    total = np.bincount(globe.half_faces.owner[measure_c_grid(globe).corners], globe.measures.c_grid.kites)
    assert total == pytest.approx(1, rel=1e-11)


def test_edges_one_by_one(globe):
    m, d, owner = measure_c_grid(globe), globe, globe.half_faces.owner

    def arc(a, b):
        return np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)

    for face in range(0, len(owner), 7):
        begin, end = d.vertices[d.half_faces.ends[face]]
        one, other = d.points[owner[face]], d.points[d.neighbors[face]]
        offset, length = arc(begin + end, one + other), arc(begin, end)
        # Middles have the round-off 1e-16, and the shortest edge is 1e-4 long.
        assert m.edge_offset[face] == pytest.approx(offset / length, rel=1e-8, abs=1e-11)
        assert m.length_ratio[face] == pytest.approx(length / arc(one, other), rel=1e-10)
        skewness = d.measures.skewness[face]
        assert skewness == pytest.approx(offset / arc(one, other), rel=1e-8, abs=1e-11)
    for i in range(len(d)):
        away = RADIUS * arc(d.points[i], d.centroids[i]) / np.sqrt(d.volumes[i])
        arcs = d.face_measures[d.neighbor_starts[i] : d.neighbor_starts[i + 1]]
        assert m.centroid_offset[i] == pytest.approx(away, rel=1e-9)
        assert m.edge_ratio[i] == arcs.min() / arcs.max()


def test_angle_of_centroids_is_along_the_sphere(globe):
    d, owner = globe, globe.half_faces.owner
    for face in range(0, len(owner), 11):
        i, j = owner[face], d.neighbors[face]
        up = d.points[i] + d.points[j]
        up /= np.linalg.norm(up)
        line, between = (x - (x @ up) * up for x in (d.points[j] - d.points[i], d.centroids[j] - d.centroids[i]))
        cosine = line @ between / np.linalg.norm(line) / np.linalg.norm(between)
        expected = np.degrees(np.arccos(min(cosine, 1)))
        # arccos has the error sqrt(eps) at 0, 1e-6 degrees.
        assert d.measures.centroid_angle[face] == pytest.approx(expected, abs=2e-6)


def test_icosahedron(ctx):
    d = clvoro.Adapter(ctx, "float64").diagram(clvoro.Sphere(RADIUS), icosahedron())
    m = measure_c_grid(d)
    assert m.angles == pytest.approx(60)
    assert m.kites == pytest.approx(1 / 5)
    # Zero but for round-off.
    assert m.edge_offset == pytest.approx(0, abs=1e-14)
    assert m.centroid_offset == pytest.approx(0, abs=1e-14)
    assert m.edge_ratio == pytest.approx(1)
    # Edges of a dodecahedron and an icosahedron, seen from the center: 41.81 and 63.43 degrees.
    assert m.length_ratio == pytest.approx(np.arccos(5**0.5 / 3) / np.arctan(2))
    assert m.vertex_cells.tolist() == [3] * 60
    assert m.first.sum() == 20
    assert d.measures.skewness == pytest.approx(0, abs=1e-14)


def test_hexagons(ctx):
    height = 3**0.5 / 2
    x, y = np.meshgrid(np.arange(6.0), np.arange(6.0))
    points = np.stack([(x + (y % 2) / 2) + 0.25, height * (y + 0.5)], axis=-1).reshape(-1, 2)
    m = lattice(ctx, points, (6, 6 * height)).measures.c_grid
    assert m.angles == pytest.approx(60)
    assert m.kites == pytest.approx(1 / 6)
    assert m.edge_offset == pytest.approx(0, abs=1e-13)
    assert m.length_ratio == pytest.approx(1 / 3**0.5)
    assert m.first.sum() == 72
    assert (m.obtuse, m.negative_kites) == (0, 0)


def test_squares(ctx):
    """Four cells meet at each vertex; the halves of a square have angles of 45 degrees opposite to its sides."""
    points = np.stack(np.meshgrid(*2 * [np.arange(5) + 0.5]), axis=-1).reshape(-1, 2)
    m = measure_c_grid(lattice(ctx, points, (5, 5)))
    assert m.angles == pytest.approx(45)
    assert m.kites == pytest.approx(1 / 4)
    assert m.vertex_cells.tolist() == [4] * 100
    assert m.first.sum() == 25


def test_box_with_walls(ctx):
    points = np.random.default_rng(8).random((150, 2))
    box = clvoro.Box((0, 0), (1, 1))
    d = clvoro.Adapter(ctx, "float64").diagram(box, points)
    m = measure_c_grid(d)
    triangles = Delaunay(points).simplices
    a, b, c = points[triangles].transpose(1, 0, 2)
    # The vertices in the box are the centers of those circles that lie in it.
    lines = np.stack([b - a, c - a], axis=1)
    centers = a + np.linalg.solve(lines, (lines**2).sum(axis=2)[..., None] / 2)[..., 0]
    inside = ((centers > 0) & (centers < 1)).all(axis=1)
    expected = flat_angles(points, triangles[inside])
    assert np.sort(m.angles) == pytest.approx(np.sort(expected.ravel()), abs=1e-6)
    assert m.obtuse == np.count_nonzero(expected > 90) > 50
    walls = d.neighbors < 0
    assert not m.edge_offset[walls].any()
    assert not m.length_ratio[walls].any()


def test_convex_polygons_are_as_boxes(ctx):
    points = np.random.default_rng(8).random((60, 2))
    boxes = clvoro.Box((0, 0), (1, 1)), clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
    box, polygon = (clvoro.Adapter(ctx).diagram(domain, points).check(solver="mpas") for domain in boxes)
    assert polygon["edges at a vertex"].ok
    assert polygon["edge off its bisector"].ok
    for criterion in box.criteria:
        assert polygon[criterion.name].value == pytest.approx(criterion.value, rel=1e-9)


def test_summary_has_them_on_spheres(globe):
    m, summary = globe.measures.c_grid, globe.measures.summary()
    assert summary["obtuse"] == m.obtuse
    assert summary["max_angle"] == m.angles.max()
    assert summary["max_edge_offset"] == m.edge_offset.max()
    assert f"{m.obtuse} obtuse triangles" in repr(m)


def test_random_mesh_is_rejected_for_mpas(globe):
    m, report = globe.measures.c_grid, globe.check(solver="mpas")
    assert not report
    assert report.solver == "mpas"
    largest = report["largest angle of triangle"]
    assert largest.value == m.angles.max()
    assert largest.limit == pytest.approx(90, abs=1e-3)
    assert largest.count == m.obtuse
    corner = m.corners[np.argmax(m.angles)]
    assert largest.cell == globe.half_faces.owner[corner]
    place = globe.vertices[globe.half_faces.ends[[corner], 0]]
    assert largest.place == pytest.approx(globe.domain.lonlat(place)[0])
    assert report["kite area over cell area"].count == m.negative_kites
    assert report["edge offset"].count == m.obtuse
    assert not report["edge offset"].demanded
    assert report["cells at a vertex"].value == 3
    assert report.faces == 3 * 300 - 6
    with pytest.raises(clvoro.ClvoroError, match="rejected: largest angle of triangle"):
        report.demand()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_bisected_icosahedron_is_accepted_for_mpas(ctx, dtype):
    points = clvoro.Sphere(1.0).icosahedral_points(3)
    assert len(points) == 642
    d = clvoro.Adapter(ctx, dtype).diagram(clvoro.Sphere(1.0), points)
    report = d.check(solver="mpas")
    assert report, report
    assert report["largest angle of triangle"].value < 75
    assert report["cells at a vertex"].value == 3
    assert all(criterion.ok for criterion in report.criteria)


def test_result_has_the_check_and_the_measures(ctx):
    result = clvoro.Adapter(ctx, "float64").run(clvoro.Sphere(1.0), 0.3, n_cells=150, method="lloyd", max_steps=5)
    assert result.measures.c_grid.angles.size == 3 * (2 * 150 - 4)
    report = result.check(solver="mpas")
    assert report["largest angle of triangle"].value == result.measures.c_grid.angles.max()


def test_squares_warn_of_four_cells_at_a_vertex(ctx):
    points = np.stack(np.meshgrid(*2 * [np.arange(5) + 0.5]), axis=-1).reshape(-1, 2)
    report = lattice(ctx, points, (5, 5)).check(solver="mpas")
    assert report
    assert report["cells at a vertex"].count == 25
    assert report.faces == 50
