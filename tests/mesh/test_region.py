"""Meshes on a sphere from which cells were removed: arrays, faces, measures, and checks that find faults."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

import clvoro
from clvoro.geometry.subdomain import SphereRegion
from clvoro.mesh.diagram import Diagram
from clvoro.mesh.results import HISTORY_DTYPE
from tests.reference.netcdf_files import result_of
from tests.reference.spheres import grid_of_rings, random_points

EARTH = clvoro.Sphere()


@pytest.fixture(scope="module")
def globe(ctx):
    return clvoro.Adapter(ctx).diagram(EARTH, random_points(400, 31))


def ocean_of(diagram):
    """All but a cap, a band around half of the globe, and three lone cells."""
    lon, lat = diagram.domain.lonlat(diagram.points).T
    keep = ~((lat > 60) | ((np.abs(lat - 10) < 15) & (lon > 0)))
    south = np.flatnonzero(lat < -40)
    keep[south[[0, 9, 30]]] = False
    return keep


@pytest.fixture(scope="module")
def part(globe):
    return globe.subset(ocean_of(globe))


def test_the_distance_from_the_boundary_is_that_of_its_faces(part):
    """0 at corners on the boundary, elsewhere at most the distance from them."""
    domain, f = part.domain, part.faces
    outer = np.flatnonzero(f.boundary >= 0)
    wall = -1 - f.neighbor[outer]
    own, beyond = part.points[f.owner[outer]], domain.beyond[wall]
    edge = part.vertices[f.corners.reshape(-1, 2)[outer]].reshape(-1, 3)
    assert domain.boundary_distance(edge) == pytest.approx(0, abs=1e-9 * EARTH.radius)
    exact = np.linalg.norm(part.points[:, None] - edge, axis=2).min(axis=1)
    found = domain.boundary_distance(part.points)
    assert (found > 0).all()
    assert (found <= exact).all()
    normals, anchors = domain.wall_planes(wall)
    on_face = np.abs(((edge[::2] - anchors) * normals).sum(axis=1)) < 1e-9 * EARTH.radius
    assert set(wall) == set(wall[on_face])  # the plane of one face of each wall
    assert domain.wall_distance(wall, own) == pytest.approx(np.linalg.norm(beyond - own, axis=1) / 2)


def test_the_check_accepts_parts(globe, part):
    part.check().demand()
    again = part.subset(EARTH.lonlat(part.points)[:, 0] > -100, "open")
    again.check().demand()
    globe.subset(np.arange(len(globe)) == 5).check().demand()
    globe.subset(np.arange(len(globe)) % 2 == 0).check().demand()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_vertices_of_four_cells(ctx, dtype):
    """Corners of removed cells touch there, or kept ones do."""
    globe = clvoro.Adapter(ctx, dtype).diagram(clvoro.Sphere(1), grid_of_rings())
    lonlat = globe.domain.lonlat(globe.points)
    board = (np.rint(lonlat).astype(int).sum(axis=1) // 10) % 2 == 0
    alone = np.zeros(len(globe), bool)
    alone[200] = True
    for keep in (board, ~alone, np.abs(lonlat[:, 1]) < 45):
        part = globe.subset(keep)
        part.check().demand()
        assert (part.measures.c_grid.vertex_cells > 0).all()


def test_faces_at_the_boundary(globe, part):
    f = part.faces
    outer = np.arange(len(f)) >= f.n_inner
    assert (f.boundary[outer] == 0).all()
    assert part.domain.boundary_names == ("coast",)
    beyond = part.domain.beyond[-1 - f.neighbor[outer]]
    between = beyond - part.points[f.owner[outer]]
    # Arcs by angles of vectors; half of the way to the removed generator.
    a, b = part.points[f.owner[outer]] / EARTH.radius, beyond / EARTH.radius
    arcs = EARTH.radius * np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
    np.testing.assert_allclose(f.distance[outer], arcs / 2, rtol=1e-13)
    length = np.linalg.norm(between, axis=1)
    np.testing.assert_allclose((f.normal[outer] * between).sum(axis=1), length, rtol=1e-14)
    # All arcs at the boundary are arcs of the whole mesh.
    whole = globe.faces
    rows = np.flatnonzero(ocean_of(globe))
    kept = np.isin(whole.owner, rows).astype(int) + np.isin(whole.neighbor, rows)
    assert outer.sum() == (kept == 1).sum()
    assert f.n_inner == (kept == 2).sum()
    assert f.area[outer].sum() == pytest.approx(whole.area[kept == 1].sum(), rel=1e-14)


def test_measures_are_those_of_the_whole_mesh(globe, part):
    kept = ocean_of(globe)
    of = np.repeat(kept, np.diff(globe.neighbor_starts))
    here, whole = part.measures, globe.measures
    for name in ("quality", "face_ratio", "faces"):
        assert np.array_equal(getattr(here, name), getattr(whole, name)[kept])
    np.testing.assert_allclose(here.skewness, whole.skewness[of], rtol=1e-12)  # differences of positions
    assert (here.centroid_angle[~here.inner] == 0).all()
    grid, all_around = here.c_grid, whole.c_grid
    assert len(grid.angles) < len(all_around.angles)
    assert np.isin(grid.angles.round(9), all_around.angles.round(9)).all()
    assert part.check(solver="mpas").ok == (grid.obtuse == 0 and grid.negative_kites == 0)


def test_points_are_located(globe, part):
    points = random_points(5000, 8) * EARTH.radius
    number = np.full(len(globe), -1)
    number[ocean_of(globe)] = np.arange(len(part))
    expected = number[globe.locate(points)]
    assert np.array_equal(part.locate(points), expected)
    assert np.array_equal(part.domain.contains(EARTH.lonlat(points)), expected >= 0)


def test_boundaries_keep_their_names(globe):
    lon, lat = EARTH.lonlat(globe.points).T
    one = globe.subset(lat < 50, "ice")
    two = one.subset(EARTH.lonlat(one.points)[:, 0] > -100, "open")
    three = two.subset(EARTH.lonlat(two.points)[:, 1] > -50)
    assert three.domain.boundary_names == ("ice", "open", "coast")
    f = three.faces
    for k, where in enumerate((lat >= 50, lon <= -100, lat <= -50)):
        walls = np.unique(-1 - f.neighbor[f.boundary == k])
        found = np.isin(globe.points[:, 0], three.domain.beyond[walls, 0])
        assert found.any()
        assert where[found].all()
    three.check().demand()
    # Selecting at once gives the same cells and the same walls.
    whole = globe.subset((lat < 50) & (lon > -100) & (lat > -50))
    assert np.array_equal(whole.points, three.points)
    assert np.array_equal(np.sort(whole.domain.beyond, axis=0), np.sort(three.domain.beyond, axis=0))


def test_results_keep_their_data(globe):
    run = replace(result_of(globe), history=np.zeros(3, HISTORY_DTYPE))
    keep = run.points[:, 2] < 0.3 * EARTH.radius
    part = run.subset(keep)
    for name in ("target_size", "size_error", "quality", "points"):
        assert np.array_equal(getattr(part, name), getattr(run, name)[keep])
    assert part.history["cells"].tolist() == [0, 0, keep.sum()]
    assert part.history["max_error"][-1] == np.abs(run.size_error[keep]).max()
    assert part.stop_reason.startswith(f"{keep.sum()} of 400 cells; ")
    part.diagram.check().demand()
    assert part.settings == run.settings
    assert run.subset(np.ones(400, bool)) is run


def test_domains_are_equal_by_content(part):
    again = pickle.loads(pickle.dumps(part)).domain
    assert again == part.domain
    assert hash(again) == hash(part.domain)
    assert part.domain != EARTH
    assert EARTH != part.domain
    other = SphereRegion.described(**{**part.domain.describe(), "area": 1.0})
    assert other != part.domain
    assert SphereRegion.described(**part.domain.describe()) == part.domain


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        # The first cell on the boundary is moved, so that its face there is on no bisector.
        ("points", "nearest generators|faces"),
        ("volumes", "volumes"),
        ("vertices", "volumes|face measures"),
    ],
)
def test_the_check_finds_faults(part, change, finding):
    owner = np.repeat(np.arange(len(part)), np.diff(part.neighbor_starts))
    i = owner[np.flatnonzero(part.neighbors < 0)[0]]
    values = getattr(part, change).copy()
    k = part.cell_vertices[part.cell_vertex_starts[i]] if change == "vertices" else i
    values[k] = values[k] * 1.01 if change == "volumes" else EARTH.wrap([values[k] + 1e4])[0]
    arrays = {n: getattr(part, n) for n in Diagram._NAMES if n in part._arrays}
    report = Diagram(part.domain, {**arrays, change: values}).check()
    assert not report
    found = str(report)
    assert any(word in found for word in finding.split("|"))


def test_a_wrong_wall_is_found(part):
    neighbors = part.neighbors.copy()
    wall = np.flatnonzero(neighbors < 0)[0]
    neighbors[wall] = -1 - (-neighbors[wall] % len(part.domain.beyond))
    arrays = {n: getattr(part, n) for n in Diagram._NAMES if n in part._arrays}
    assert not Diagram(part.domain, {**arrays, "neighbors": neighbors}).check()


def test_made_up_results_are_parts_too(part):
    result = result_of(part)
    assert len(result.subset(part.points[:, 0] > 0).target_size) == (part.points[:, 0] > 0).sum()


@pytest.mark.slow
@pytest.mark.parametrize("most", [10, 60_000])
def test_pictures_leave_removed_cells_out(globe, monkeypatch, most):
    """As polygons and, with many cells, as pixels; more walls than cells."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.setattr("clvoro.plotting.cells.MOST_POLYGONS", most)
    north = globe.subset(np.arange(len(globe)) % 3 == 0)
    assert len(north.domain.beyond) > len(north)
    figure = north.plot(edges=False)
    if most == 10:
        (image,) = figure.axes[0].images
        share = 1 - np.mean(np.ma.getmaskarray(image.get_array()))
        # The disk is pi/4 of its square, and a third of the cells is left.
        assert share == pytest.approx(np.pi / 12, rel=0.15)
    pyplot.close(figure)
