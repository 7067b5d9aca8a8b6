"""The MPAS mesh specification on a sphere, compared with formulas other than those of the package.

Arcs are those of cross products, and areas of triangles those of l'Huilier's theorem from their three sides. The
operators on such a file are in `tests/finite_volumes/test_shallow_water.py`.
"""

import numpy as np
import pytest
from scipy.spatial import SphericalVoronoi

import clvoro
from clvoro.geometry.sphere import arc_excess, triangle_areas
from tests.earth.test_netcdf_mpas import MEASURES, TABLES, Mesh, check_divergence, check_energy, check_weights
from tests.reference.globes import CASES, arcs, is_double, made, triangles


@pytest.fixture(scope="module", params=CASES, ids=str)
def result(ctx, request):
    return made(ctx, *request.param)


class Globe(Mesh):
    """The tables of a file on a sphere; positions in units of its radius."""

    def __init__(self, path):
        super().__init__(path, "globe")
        self.radius = float(self.file.attributes["sphere_radius"])
        self.cell, self.edge, self.vertex = (
            np.stack([self[f"{axis}{what}"] for axis in "xyz"], axis=1) / self.radius
            for what in ("Cell", "Edge", "Vertex")
        )


@pytest.fixture(scope="module")
def mesh(result, tmp_path_factory):
    path = tmp_path_factory.mktemp("mpas") / "mesh.nc"
    result.to_netcdf(path, convention="mpas")
    return Globe(path)


# --- areas and arcs ---


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-6])
def test_areas_of_triangles(size):
    rng = np.random.default_rng(2)
    a = rng.standard_normal((200, 3))
    a /= np.linalg.norm(a, axis=1)[:, None]
    b, c = (x / np.linalg.norm(x, axis=1)[:, None] for x in a + size * rng.standard_normal((2, 200, 3)))
    # l'Huilier loses digits in the difference of sides: where a triangle is flat.
    scale = size**2
    np.testing.assert_allclose(triangle_areas(a, b, c), triangles(a, b, c), rtol=0, atol=1e-8 * scale)
    assert np.array_equal(np.sign(triangle_areas(a, c, b)), -np.sign(triangle_areas(a, b, c)))
    octant = np.eye(3)[:, None]
    assert triangle_areas(*octant) == pytest.approx(np.pi / 2, rel=1e-15)


def test_excess_of_arcs_has_no_step():
    arc = np.concatenate([np.geomspace(1e-9, 3, 500), 0.01 + np.linspace(-1e-5, 1e-5, 200)])
    series = arc**2 / 6 + 7 * arc**4 / 360 + 31 * arc**6 / 15120  # of arc / sin(arc) - 1
    found = arc_excess(np.sin(arc), np.cos(arc))
    np.testing.assert_allclose(found, arc / np.sin(arc) - 1, rtol=1e-12, atol=5e-16)
    short = arc < 0.02
    # Next to the series the difference of numbers near 1 has a round-off of 2e-16, a few 1e-11 of its value.
    np.testing.assert_allclose(found[short], series[short], rtol=1e-10)


# --- the file ---


@pytest.mark.sparse(2)
def test_the_file_has_all_variables_of_the_specification(result, mesh):
    file, sphere = mesh.file, result.diagram.domain
    assert file.attributes["on_a_sphere"] == b"YES"
    assert file.attributes["is_periodic"] == b"NO"
    assert file.attributes["mesh_spec"] == b"1.0"
    assert file.attributes["sphere_radius"] == sphere.radius
    for name, dimensions in {**TABLES, **MEASURES}.items():
        assert file.dimensions_of[name] == dimensions
        assert np.isfinite(file[name]).all()
    assert file.dimensions["vertexDegree"] == 3
    assert (file["cellsOnVertex"] > 0).all()
    assert (file["cellsOnEdge"] > 0).all()
    assert mesh.n - mesh.e + mesh.v == 2
    density = result.target_size**-4.0
    np.testing.assert_allclose(file["meshDensity"], density / density.max(), rtol=1e-13)


def test_coordinates_are_on_the_sphere(result, mesh):
    places = {"Cell": mesh.cell, "Edge": mesh.edge, "Vertex": mesh.vertex}
    for what, points in places.items():
        assert np.linalg.norm(points, axis=1) == pytest.approx(1, abs=1e-15)
        lon, lat = mesh[f"lon{what}"], mesh[f"lat{what}"]
        assert ((lon >= 0) & (lon < 2 * np.pi) & (np.abs(lat) <= np.pi / 2)).all()
        again = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        np.testing.assert_allclose(again, points, rtol=0, atol=1e-15)
    radius, eps = mesh.radius, 1e-15 if is_double(result) else 2e-7
    np.testing.assert_allclose(mesh.cell, result.points / radius, rtol=0, atol=eps)
    # Vertices in the order of the half-edges, not in that of the diagram.
    given = np.sort(result.diagram.vertices[:, 0]) / radius
    np.testing.assert_allclose(np.sort(mesh.vertex[:, 0]), given, rtol=0, atol=eps)


def test_edges_are_where_the_generators_arcs_cross_them(mesh):
    one, other = mesh.cell[np.array(mesh.cellsOnEdge)].swapaxes(0, 1)
    begin, end = mesh.vertex[np.array(mesh.verticesOnEdge)].swapaxes(0, 1)
    half = arcs(one, other) / 2
    # Short arcs are differences of positions with the round-off of numbers near 1.
    near = {"rtol": 1e-13, "atol": 1e-15}
    np.testing.assert_allclose(arcs(one, mesh.edge), half, **near)
    np.testing.assert_allclose(arcs(other, mesh.edge), half, **near)
    np.testing.assert_allclose(mesh["dcEdge"] / mesh.radius, 2 * half, **near)
    np.testing.assert_allclose(mesh["dvEdge"] / mesh.radius, arcs(begin, end), **near)
    # Right-handed: from above, the way from the first vertex to the second is 90 degrees left of the normal.
    turn = (np.cross(other - one, end - begin) * mesh.edge).sum(axis=1)
    assert (turn >= 0).all()
    full = arcs(one, other) * arcs(begin, end)
    assert (turn > 0.9 * np.sin(full))[full > 1e-6].all()


def test_edges_lie_on_bisectors(result, mesh):
    one, other = mesh.cell[np.array(mesh.cellsOnEdge)].swapaxes(0, 1)
    eps = np.finfo(float if is_double(result) else np.float32).eps
    for column in np.array(mesh.verticesOnEdge).T:
        off = np.abs(((other - one) * mesh.vertex[column]).sum(axis=1)) / arcs(one, other)
        # The round-off of a bisector grows with the inverse distance of its generators, here 1e-4 at least.
        assert off.max() < 1e4 * eps


def test_kites_are_spherical_quadrilaterals(mesh):
    kites, cells = mesh["kiteAreasOnVertex"] / mesh.radius**2, np.array(mesh.cellsOnVertex)
    edges = mesh["edgesOnVertex"] - 1
    of_cells = np.zeros(mesh.n)
    for k in range(3):
        place, generator = mesh.vertex, mesh.cell[cells[:, k]]
        before, after = mesh.edge[edges[:, k]], mesh.edge[edges[:, (k + 1) % 3]]
        expected = triangles(place, before, generator) + triangles(place, generator, after)
        # l'Huilier's theorem subtracts sides: it has half of the digits where they are nearly in line.
        np.testing.assert_allclose(kites[:, k], expected, rtol=1e-7, atol=1e-9 * np.abs(kites).max())
        of_cells += np.bincount(cells[:, k], kites[:, k], mesh.n)
    np.testing.assert_allclose(of_cells, mesh["areaCell"] / mesh.radius**2, rtol=1e-13)
    generators = mesh.cell[cells].swapaxes(0, 1)
    whole = mesh["areaTriangle"] / mesh.radius**2
    np.testing.assert_allclose(whole, triangles(*generators), rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(whole, kites.sum(axis=1), rtol=1e-13, atol=1e-16)
    for areas in (mesh["areaCell"], mesh["areaTriangle"]):
        assert areas.sum() == pytest.approx(4 * np.pi * mesh.radius**2, rel=1e-13)


def test_areas_are_those_of_scipy(result, mesh):
    voronoi = SphericalVoronoi(mesh.cell)
    # Round-off of corners, which are near other cells' bisectors, times the perimeters of the smallest cells. Quotients
    # of float32 may be off by 2.5 ulp.
    near = {"rtol": 1e-12, "atol": 1e-14} if is_double(result) else {"rtol": 4e-5, "atol": 1e-8}
    areas = mesh["areaCell"] / mesh.radius**2
    np.testing.assert_allclose(areas, voronoi.calculate_areas(), **near)
    np.testing.assert_allclose(areas, result.diagram.volumes / mesh.radius**2, **near)


def test_angles_are_from_the_east(mesh):
    """A sphere that turns about an axis: velocity axis x position, with its parts to the east and north by hand."""
    one, other = mesh.cell[np.array(mesh.cellsOnEdge)].swapaxes(0, 1)
    normal = (other - one) / np.linalg.norm(other - one, axis=1)[:, None]
    lon, lat, angle = mesh["lonEdge"], mesh["latEdge"], mesh["angleEdge"]
    assert (np.abs(angle) <= np.pi).all()
    flows = {
        (0, 0, 1): (np.cos(lat), 0 * lat),
        (1, 0, 0): (-np.sin(lat) * np.cos(lon), np.sin(lon)),
        (0, 1, 0): (-np.sin(lat) * np.sin(lon), -np.cos(lon)),
    }
    for axis, (east, north) in flows.items():
        expected = (np.cross(axis, mesh.edge) * normal).sum(axis=1)
        found = east * np.cos(angle) + north * np.sin(angle)
        # Round-off of a normal: that of positions over the distance of generators, 1e-3 at least.
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_an_edge_at_a_pole_has_the_east_of_longitude_0(mesh):
    (at_pole,) = np.flatnonzero(mesh["latEdge"] > 1.57)
    first = np.flatnonzero(np.abs(mesh.cell - (0.3 / 1.09**0.5, 0, 1 / 1.09**0.5)).max(axis=1) < 1e-6)[0]
    assert mesh["lonEdge"][at_pole] == 0
    # From the generator at longitude 0 to that at 180 degrees: to the north.
    assert mesh.cellsOnEdge[at_pole] == [first, first + 1]
    assert mesh["angleEdge"][at_pole] == pytest.approx(np.pi / 2)


@pytest.mark.sparse(2)
def test_tables_are_counter_clockwise(mesh):
    for i in range(mesh.n):
        corners = mesh.vertex[mesh.verticesOnCell[i]]
        fan = triangles(np.broadcast_to(mesh.cell[i], corners.shape), corners, np.roll(corners, -1, axis=0))
        # The theorem of l'Huilier has half of the digits in flat triangles.
        assert fan.sum() == pytest.approx(mesh["areaCell"][i] / mesh.radius**2, rel=1e-4)
        k = len(corners)
        for a, e in enumerate(mesh.edgesOnCell[i]):
            onward, vertex = mesh.edgesOnCell[i][(a + 1) % k], mesh.verticesOnCell[i][a]
            assert vertex in mesh.verticesOnEdge[e]
            assert vertex in mesh.verticesOnEdge[onward]
            assert sorted([i, mesh.cellsOnCell[i][a]]) == sorted(mesh.cellsOnEdge[e])
    generators = mesh.cell[np.array(mesh.cellsOnVertex)].swapaxes(0, 1)
    assert (triangles(*generators) >= 0).all()


@pytest.mark.sparse(2)
def test_weights_are_those_of_the_formula(mesh):
    check_weights(mesh)


def test_more_than_three_cells_may_share_a_vertex(ctx, tmp_path):
    """Rings of generators, one above the other: cells are quadrilaterals, and around the poles polygons."""
    lon, lat = np.meshgrid(np.arange(0, 360, 30), np.arange(-60, 61, 20))
    places = np.column_stack([lon.ravel(), lat.ravel()])
    poles = [(0.0, 90.0), (0.0, -90.0)]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Sphere(1), np.concatenate([places, poles]))
    diagram.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    mesh = Globe(tmp_path / "mesh.nc")
    assert (mesh.n, mesh.e, mesh.v) == (86, 7 * 24 + 12, 8 * 12)
    assert mesh.file.dimensions["vertexDegree"] == 4
    cells = np.array(mesh.cellsOnVertex)
    assert ((cells >= 0).sum(axis=1) == np.where(np.abs(mesh["latVertex"]) > 1, 3, 4)).all()
    for areas in (mesh["areaCell"], mesh["areaTriangle"]):
        assert areas.sum() == pytest.approx(4 * np.pi, rel=1e-14)
    assert len(np.unique(mesh["areaCell"].round(12))) == 5
    assert (mesh["meshDensity"] <= 1).all()
    check_energy(mesh)
    check_divergence(mesh)
    diagram.save(tmp_path / "mesh.vtu")
    assert np.array_equal(clvoro.load(tmp_path / "mesh.vtu").neighbors, diagram.neighbors)
