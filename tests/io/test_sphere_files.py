"""Files of meshes on a sphere: UGRID, npz, vtu, METIS, and formats that cannot hold them."""

import re
import sys

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError
from clvoro.mesh.diagram import Diagram
from tests.reference.globes import CASES, arcs, is_double, made, scattered
from tests.reference.netcdf_files import random_points, read


@pytest.fixture(scope="module", params=CASES, ids=str)
def result(ctx, request):
    return made(ctx, *request.param)


# --- SCRIP ---


@pytest.mark.sparse(2)
def test_scrip(result, tmp_path):
    result.to_netcdf(tmp_path / "mesh.nc", convention="scrip")
    file, d = read(tmp_path / "mesh.nc"), result.diagram
    n, sides = len(d), np.diff(d.neighbor_starts)
    eps = 2e-15 if is_double(result) else 2e-7
    assert file["grid_dims"].tolist() == [n]
    assert file["grid_imask"].tolist() == [1] * n
    assert file["grid_area"].sum() == pytest.approx(4 * np.pi, rel=50 * eps)
    assert file.about["grid_corner_lat"]["units"] == b"degrees"
    lon, lat = file["grid_corner_lon"], file["grid_corner_lat"]
    assert lon.shape == (n, sides.max())
    for i in range(0, n, 17):
        row = d.cell_vertices[d.cell_vertex_starts[i] : d.cell_vertex_starts[i + 1]]
        row = np.append(row, np.repeat(row[-1], sides.max() - len(row)))
        corners = d.domain.positions(np.column_stack([lon[i], lat[i]]))
        np.testing.assert_allclose(corners, d.vertices[row], rtol=0, atol=eps * d.domain.radius)
    center = np.column_stack([file["grid_center_lon"], file["grid_center_lat"]])
    np.testing.assert_allclose(d.domain.positions(center), d.centroids, rtol=0, atol=eps * d.domain.radius)


# --- UGRID ---


def test_ugrid_has_degrees(result, tmp_path):
    result.to_netcdf(tmp_path / "mesh.nc", units="km")
    file, d = read(tmp_path / "mesh.nc"), result.diagram
    for place in ("node", "edge", "face"):
        for axis, name, units in (("x", "longitude", "degrees_east"), ("y", "latitude", "degrees_north")):
            about = file.about[f"mesh_{place}_{axis}"]
            assert about["standard_name"] == name.encode()
            assert about["units"] == units.encode()
    positions = {place: d.domain.positions(lonlat(file, place)) for place in ("node", "edge", "face")}
    radius, eps = d.domain.radius, 2e-15 if is_double(result) else 2e-7
    np.testing.assert_allclose(positions["node"] / radius, d.vertices / radius, rtol=0, atol=eps)
    np.testing.assert_allclose(positions["face"] / radius, d.points / radius, rtol=0, atol=eps)
    ends = positions["node"][file["mesh_edge_nodes"]] / radius
    middle = positions["edge"] / radius
    np.testing.assert_allclose(arcs(middle, ends[:, 0]), arcs(middle, ends[:, 1]), rtol=0, atol=10 * eps)
    assert np.array_equal(file["area"], d.volumes)
    assert file.about["area"]["units"] == b"km2"
    assert file.about["area"]["grid_mapping"] == b"globe"
    assert file.about["globe"]["grid_mapping_name"] == b"latitude_longitude"
    assert "earth_radius" not in file.about["globe"]
    result.save(tmp_path / "meters.nc")
    assert read(tmp_path / "meters.nc").about["globe"]["earth_radius"] == radius


def lonlat(file, place):
    return np.stack([file[f"mesh_{place}_{axis}"] for axis in "xy"], axis=1)


def test_ugrid_topology_is_that_of_the_cells(result, tmp_path):
    result.save(tmp_path / "mesh.nc")
    file, d = read(tmp_path / "mesh.nc"), result.diagram
    beside, ends = file["mesh_edge_faces"], file["mesh_edge_nodes"]
    assert (beside >= 0).all()
    assert len(d) - len(ends) + len(d.vertices) == 2
    starts = d.cell_vertex_starts
    for i in range(len(d)):
        corners = d.cell_vertices[starts[i] : starts[i + 1]].tolist()
        count = len(corners)
        assert file["mesh_face_nodes"][i, :count].tolist() == corners
        assert (file["mesh_face_nodes"][i, count:] == -1).all()
        assert file["mesh_face_faces"][i, :count].tolist() == d.neighbors[starts[i] : starts[i + 1]].tolist()
        for e, a, b in zip(file["mesh_face_edges"][i], corners, corners[1:] + corners[:1], strict=False):
            assert set(ends[e]) == {a, b}
            # The first face is on the left of the way from the first end to the second.
            assert beside[e, 0 if ends[e].tolist() == [a, b] else 1] == i


# --- files to read again ---


@pytest.mark.sparse(2)
def test_npz_is_exact(result, tmp_path):
    for mesh in (result, result.diagram):
        mesh.save(tmp_path / "mesh.npz")
        again = clvoro.load(tmp_path / "mesh.npz")
        assert type(again) is type(mesh)
        one, other = (getattr(m, "diagram", m) for m in (mesh, again))
        assert other.domain == one.domain
        assert isinstance(other.domain, clvoro.Sphere)
        same_arrays(one, other)


def same_arrays(one, other, names=None):
    there = [name for name in Diagram._NAMES if name == "shifts" or name in one._arrays]
    for name in names or there:
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.sparse(2)
def test_vtu_reads_back(result, tmp_path):
    for mesh in (result, result.diagram):
        mesh.save(tmp_path / "mesh.vtu")
        again = clvoro.load(tmp_path / "mesh.vtu")
        assert type(again) is type(mesh)
        one, other = (getattr(m, "diagram", m) for m in (mesh, again))
        assert other.domain == one.domain
        exact = ("points", "volumes", "neighbor_starts", "neighbors", "vertices", "cell_vertex_starts", "cell_vertices")
        same_arrays(one, other, exact)
        radius = one.domain.radius
        # The round-off of corners, which are shared in the file, over the width of a cell, 1e-3.
        eps = 1e-13 if is_double(result) else 1e-4
        for name in ("face_measures", "face_centroids", "centroids"):
            np.testing.assert_allclose(
                getattr(other, name) / radius, getattr(one, name) / radius, rtol=0, atol=eps, err_msg=name
            )
    for name in ("target_size", "size_error", "quality"):
        result.save(tmp_path / "mesh.vtu")
        assert np.array_equal(getattr(clvoro.load(tmp_path / "mesh.vtu"), name), getattr(result, name))


@pytest.mark.parametrize("radius", [1.5, 1 + 1e-4, -1.0, np.nan])
def test_vtu_of_another_sphere_is_refused(ctx, tmp_path, radius):
    sphere = clvoro.Sphere(1)
    diagram = clvoro.Adapter(ctx).diagram(sphere, scattered(150))
    arrays = {name: np.array(getattr(diagram, name)) for name in diagram._arrays}
    object.__setattr__(sphere, "radius", radius)
    Diagram(sphere, arrays).save(tmp_path / "mesh.vtu")
    with pytest.raises(InputError, match=r"mesh\.vtu: .*[Ss]phere"):
        clvoro.load(tmp_path / "mesh.vtu")


def test_vtu_with_a_hole_is_refused(ctx, tmp_path):
    """A cell is missing, so that faces around it lead to no cell."""
    d = clvoro.Adapter(ctx).diagram(clvoro.Sphere(1), scattered(150))
    k = d.neighbor_starts[-2]
    arrays = {name: np.array(getattr(d, name)) for name in Diagram._NAMES if name in d._arrays}
    for name in ("points", "volumes", "centroids", "neighbor_starts", "cell_vertex_starts"):
        arrays[name] = arrays[name][:-1]
    for name in ("neighbors", "face_measures", "face_centroids", "cell_vertices"):
        arrays[name] = arrays[name][:k]
    Diagram(d.domain, arrays).save(tmp_path / "mesh.vtu")
    with pytest.raises(InputError, match="neighbors have an index out of range"):
        clvoro.load(tmp_path / "mesh.vtu")


# --- METIS ---


def graph(path):
    """Return the head and the rows of a graph for METIS."""
    head, *rows = path.read_text().splitlines()
    return [int(x) for x in head.split()], [[int(x) - 1 for x in row.split()] for row in rows]


def test_graph_for_metis_has_the_neighbors(result, tmp_path):
    result.save(tmp_path / "graph.info")
    (n, edges), rows = graph(tmp_path / "graph.info")
    d = result.diagram
    assert (n, 2 * edges) == (len(d), len(d.neighbors))
    assert rows == [sorted(row.tolist()) for row in np.split(d.neighbors, d.neighbor_starts[1:-1])]
    result.save(tmp_path / "graph.info.part.7")
    part = np.loadtxt(tmp_path / "graph.info.part.7", int)
    assert np.ptp(np.bincount(part, minlength=7)) <= 1
    cut = sum(part[i] < part[j] for i, row in enumerate(rows) for j in row)
    assert cut < 5 * 7**0.5 * n**0.5
    with pytest.raises(InputError, match="expected 1 to"):
        result.save(tmp_path / f"graph.info.part.{n + 1}")
    with pytest.raises(InputError, match="cell_data"):
        result.save(tmp_path / "graph.info.part.2", cell_data={"mine": np.zeros(n)})


def test_graph_for_metis_in_other_domains(ctx, tmp_path):
    """No cell is its own neighbor, and two cells that share several faces are neighbors once."""
    torus = clvoro.Box((0, 0), (1, 1), periodic=True)
    for points, expected in (([(0.5, 0.5)], [[]]), ([(0.25, 0.5), (0.75, 0.5)], [[1], [0]])):
        clvoro.Adapter(ctx).diagram(torus, points).save(tmp_path / "a.graph")
        (n, edges), rows = graph(tmp_path / "a.graph")
        assert rows == expected
        assert (n, edges) == (len(points), len(points) - 1)
    box = clvoro.Box((0, 0, 0), (2, 1, 1))
    solid = clvoro.Adapter(ctx).diagram(box, [(0.5, 0.5, 0.5), (1.5, 0.5, 0.5)])
    solid.save(tmp_path / "solid.graph")
    assert (tmp_path / "solid.graph").read_text() == "2 1\n2\n1\n"


def test_graph_for_metis_in_parts(ctx, tmp_path, monkeypatch):
    room = clvoro.Box((0, 0), (1, 1))
    diagram = clvoro.Adapter(ctx).diagram(room, random_points(room, 50))
    diagram.save(tmp_path / "whole.info")
    monkeypatch.setattr("clvoro.io.convert._CHUNK", 7)
    diagram.save(tmp_path / "parts.info")
    assert (tmp_path / "parts.info").read_bytes() == (tmp_path / "whole.info").read_bytes()
    with pytest.raises(InputError, match="cell_data"):
        diagram.save(tmp_path / "data.info", cell_data={"a": np.zeros(50)})


# --- formats for other domains ---


@pytest.mark.parametrize(
    ("work", "why"),
    [
        (lambda d, to: d.save(to / "mesh.foam"), r"cannot write .*mesh\.foam: OpenFOAM.*Sphere.*\.nc"),
        (lambda d, to: d.save(to / "constant" / "polyMesh"), "OpenFOAM.*Sphere"),
        (lambda d, to: d.to_vtu(to / "mesh.vtu", walls="straight"), "solvers .*Sphere.*walls='exact'"),
        (lambda d, _: d.solver_mesh(), "solvers .*Sphere"),
        (lambda d, _: d.check(solver="openfoam"), "polyhedra, and the cells on Sphere"),
        (lambda d, _: d.to_disv(), "DISV .*Sphere.*Polygon"),
        (lambda d, _: d.to_fipy(), "FiPy .*Sphere.*faces"),
        (lambda d, _: d.to_shapely(), "shapely .*Sphere.*to_pyvista"),
    ],
)
def test_formats_without_curved_surfaces_are_refused(ctx, tmp_path, work, why, monkeypatch):
    monkeypatch.setitem(sys.modules, "fipy", None)  # the reason is not that it is missing
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Sphere(1), scattered(150))
    with pytest.raises(InputError, match=re.compile(why, re.DOTALL)):
        work(diagram, tmp_path)
    assert not list(tmp_path.iterdir())
