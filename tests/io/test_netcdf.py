"""netCDF files by the UGRID conventions, and properties of all netCDF files."""

import json
import os
import re
from collections import Counter

import numpy as np
import pytest
from scipy.io import netcdf_file

import clvoro
from clvoro.errors import InputError, InputTypeError
from clvoro.io import netcdf
from tests.reference import netcdf_files
from tests.reference.netcdf_files import MESHES, made, read, result_of, shoelace

BOTH = ("ugrid", "mpas")


@pytest.fixture(scope="module")
def room(ctx):
    return made(ctx, "room")


@pytest.fixture(scope="module", params=MESHES)
def result(request, ctx):
    return made(ctx, request.param)


@pytest.fixture
def mesh(result, tmp_path):
    result.save(tmp_path / "mesh.nc")
    return read(tmp_path / "mesh.nc")


def rows(mesh, name):
    """Rows of a table without missing items."""
    table = mesh[f"mesh_{name}s"]
    missing = mesh.about[f"mesh_{name}s"].get("_FillValue", -1)
    assert missing == -1
    lengths = (table != -1).sum(axis=1)
    assert all((row[k:] == -1).all() for row, k in zip(table, lengths, strict=True))
    return [row[:k].tolist() for row, k in zip(table, lengths, strict=True)]


def places(mesh, location):
    return np.stack([mesh[f"mesh_{location}_{axis}"] for axis in "xy"], axis=1)


def sides(corners):
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


# --- UGRID ---


@pytest.mark.sparse(3)
def test_topology_names_all_variables(mesh):
    assert b"UGRID-1.0" in mesh.attributes["Conventions"]
    topology = mesh.about["mesh"]
    assert topology["cf_role"] == b"mesh_topology"
    assert topology["topology_dimension"] == 2
    assert mesh["mesh"].shape == ()
    for place in ("node", "edge", "face"):
        for name in topology[f"{place}_coordinates"].decode().split():
            assert mesh.dimensions_of[name] == (f"mesh_{place}s",)
    tables = [k for k in topology if k.endswith("_connectivity")]
    assert {"face_node_connectivity", "edge_node_connectivity", "edge_face_connectivity"} < {*tables}
    for role in tables:
        name = topology[role].decode()
        assert mesh.about[name]["cf_role"] == role.encode()
        assert mesh.about[name]["start_index"] == 0
        assert mesh.dimensions_of[name][0] == f"mesh_{role[:4]}s"
        assert mesh[name].dtype == np.int32


def test_faces_are_the_cells(result, mesh):
    d = result.diagram
    nodes, faces = places(mesh, "node"), rows(mesh, "face_node")
    assert np.array_equal(nodes, d.vertices)
    assert np.array_equal(places(mesh, "face"), result.points)
    starts = d.cell_vertex_starts
    for i, corners in enumerate(faces):
        expected = d.cell_vertices[starts[i] : starts[i + 1]].tolist()
        expected = [a for a, b in sides(expected) if a != b]
        assert sorted(corners) == sorted(expected)
        assert len(corners) >= 3
        # Round-off of a dozen products of coordinates below 4.
        assert shoelace(nodes[corners]) == pytest.approx(d.volumes[i], rel=0, abs=1e-14)
    assert np.array_equal(mesh["area"], d.volumes)
    for name, attribute in (("size", "target_size"), ("error", "size_error"), ("quality", "quality")):
        assert np.array_equal(mesh[name], getattr(result, attribute))
        assert mesh.about[name]["mesh"] == b"mesh"
        assert mesh.about[name]["location"] == b"face"


def test_edges_have_their_faces_on_both_sides(result, mesh):
    """Compared with all sides of all faces: an edge is a pair of opposite ones, or a single one."""
    faces, face_edges = rows(mesh, "face_node"), rows(mesh, "face_edge")
    ends, beside = mesh["mesh_edge_nodes"], mesh["mesh_edge_faces"]
    directed = Counter((a, b, i) for i, corners in enumerate(faces) for a, b in sides(corners))
    assert set(directed.values()) == {1}
    found = set()
    for (a, b), (left, right) in zip(ends.tolist(), beside.tolist(), strict=True):
        found.add((a, b, left))
        if right >= 0:
            found.add((b, a, right))
    assert found == set(directed)
    assert len(found) == len(ends) + (beside >= 0).all(axis=1).sum()
    for i, corners in enumerate(faces):
        assert [set(ends[e]) for e in face_edges[i]] == [set(side) for side in sides(corners)]
    middles = places(mesh, "node")[ends].mean(axis=1)
    assert np.array_equal(places(mesh, "edge"), middles)


def test_neighbors_are_the_diagrams(result, mesh):
    d = result.diagram
    face_edges, table = rows(mesh, "face_edge"), mesh["mesh_face_faces"]
    starts, straight = d.neighbor_starts, ~d.shifts.any(axis=1)
    for i, edges in enumerate(face_edges):
        across = table[i, : len(edges)].tolist()
        assert (table[i, len(edges) :] == -1).all()
        for e, j in zip(edges, across, strict=True):
            assert sorted(mesh["mesh_edge_faces"][e].tolist()) == sorted([i, j])
        row = slice(starts[i], starts[i + 1])
        inner = straight[row] & (d.neighbors[row] >= 0) & (d.face_measures[row] > 0)
        assert sorted(j for j in across if j >= 0) == sorted(d.neighbors[row][inner].tolist())


def test_walls_are_numbered(result, mesh):
    domain, wall = result.diagram.domain, mesh["wall"]
    assert mesh.about["wall"]["location"] == b"edge"
    ends = places(mesh, "node")[mesh["mesh_edge_nodes"]]
    lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    single = (mesh["mesh_edge_faces"] < 0).any(axis=1)
    assert (wall[~single] == -1).all()
    if any(domain.periodic):
        # Edges at seams have one face and no wall.
        assert (single & (wall == -1)).sum() == result.diagram.shifts.any(axis=1).sum()
    else:
        assert (wall[single] >= 0).all()
    for number in np.unique(wall[wall >= 0]):
        these = wall == number
        if isinstance(domain, clvoro.Polygon):
            a, b = (end[0] for end in domain.edge_ends(np.array([number])))
        else:
            axis, upper = divmod(int(number), 2)
            assert not domain.periodic[axis]
            a, b = np.array([domain.lower, domain.upper])
            (a if upper else b)[axis] = (b if upper else a)[axis]
        along = (b - a) / np.hypot(*(b - a))
        off = (ends[these] - a) @ (-along[1], along[0])
        assert np.abs(off).max() < 8e-15  # coordinates are below 4, each rounded a few times
        assert lengths[these].sum() == pytest.approx(np.hypot(*(b - a)), rel=1e-12)


def test_a_face_around_an_island_has_its_loops_joined(ctx, tmp_path):
    diagram = clvoro.Adapter(ctx).diagram(*netcdf_files.around_an_island())
    onward = diagram.half_faces.next
    assert len(onward) > 0
    last = onward <= np.arange(len(onward))
    assert last.sum() == len(diagram) + 1  # one cell has two loops
    result_of(diagram).save(tmp_path / "mesh.nc")
    mesh = read(tmp_path / "mesh.nc")
    nodes, faces = places(mesh, "node"), rows(mesh, "face_node")
    areas = [shoelace(nodes[corners]) for corners in faces]
    assert areas == pytest.approx(diagram.volumes.tolist(), rel=1e-12)
    assert sum(areas) == pytest.approx(diagram.domain.measure, rel=1e-12)
    bridges = [len(f) - len(e) for f, e in zip(faces, rows(mesh, "face_edge"), strict=True)]
    assert sorted(bridges) == [0] * (len(diagram) - 1) + [2]


# --- other readers ---


def test_as_ugrids_checker_reads_it(result, tmp_path):
    checks = pytest.importorskip("ugrid_checks.check")
    result.save(tmp_path / "mesh.nc")
    said = checks.check_dataset(tmp_path / "mesh.nc", print_summary=False).checking_report()
    assert not re.findall(r"(?:WARN|FAIL) (\w+)", said), said


def test_units_are_the_callers(room, tmp_path):
    """Coordinates have units: lengths of a projection, or degrees of longitude and latitude."""
    wanted = {
        None: ("m", "m", "m2", "projection_x_coordinate"),
        "km": ("km", "km", "km2", "projection_x_coordinate"),
        "0.3048 m": ("0.3048 m", "0.3048 m", "(0.3048 m)^2", "projection_x_coordinate"),
        "degrees": ("degrees_east", "degrees", "degrees2", "longitude"),
    }
    for unit, (x, size, area, name) in wanted.items():
        room.to_netcdf(tmp_path / "mesh.nc", units=unit)
        about = read(tmp_path / "mesh.nc").about
        for place in ("node", "edge", "face"):
            assert about[f"mesh_{place}_x"]["units"].decode() == x
            assert about[f"mesh_{place}_x"]["standard_name"].decode() == name
        assert about["size"]["units"].decode() == size
        assert about["area"]["units"].decode() == area
        assert about["quality"]["units"] == b"1"
    room.to_netcdf(tmp_path / "mesh.nc", units="km", convention="mpas")
    about = read(tmp_path / "mesh.nc").about
    found = {name: about[name]["units"].decode() for name in ("xCell", "zVertex", "dcEdge", "areaCell", "latEdge")}
    assert found == {"xCell": "km", "zVertex": "km", "dcEdge": "km", "areaCell": "km2", "latEdge": "rad"}
    for unit in (3, "", "µm"):
        with pytest.raises(InputTypeError, match="units is"):
            room.to_netcdf(tmp_path / "mesh.nc", units=unit)


def test_as_xarray_reads_it(room, tmp_path):
    xarray = pytest.importorskip("xarray")
    for convention in BOTH:
        room.to_netcdf(tmp_path / "mesh.nc", convention=convention)
        expected = read(tmp_path / "mesh.nc")
        for engine in ("scipy", "netcdf4"):
            if engine == "netcdf4":
                pytest.importorskip("netCDF4")
            with xarray.open_dataset(tmp_path / "mesh.nc", engine=engine, mask_and_scale=False) as found:
                assert {*found.variables} == {*expected.values}
                for name, values in expected.values.items():
                    assert np.array_equal(found[name].values, values)


@pytest.mark.sparse(3)
@pytest.mark.filterwarnings("ignore:Projected")  # about areas on a sphere, which are not used
def test_as_uxarray_reads_it(result, tmp_path):
    uxarray = pytest.importorskip("uxarray")
    result.save(tmp_path / "mesh.nc")
    grid = uxarray.open_grid(tmp_path / "mesh.nc")
    d = result.diagram
    assert (grid.n_face, grid.n_node) == (len(d), len(d.vertices))
    x, y = grid.node_lon.values, grid.node_lat.values
    counts, table = grid.n_nodes_per_face.values, grid.face_node_connectivity.values
    for i, k in enumerate(counts):
        corners = np.stack([x[table[i, :k]], y[table[i, :k]]], axis=1)
        assert shoelace(corners) == pytest.approx(d.volumes[i], rel=0, abs=1e-14)
    data = uxarray.open_dataset(tmp_path / "mesh.nc", tmp_path / "mesh.nc")
    assert np.array_equal(data["quality"].values, result.quality)


# --- both conventions ---


@pytest.mark.parametrize("convention", BOTH)
def test_the_same_mesh_gives_the_same_bytes(room, tmp_path, convention):
    for name in ("a.nc", "b.NC"):
        room.to_netcdf(tmp_path / name, convention=convention)
    data = (tmp_path / "a.nc").read_bytes()
    assert data == (tmp_path / "b.NC").read_bytes()
    assert data[:4] == b"CDF\2"
    settings = json.loads(read(tmp_path / "a.nc").attributes["clvoro_settings"])
    assert settings == room.settings


def test_ugrid_is_the_default(room, tmp_path):
    room.save(tmp_path / "a.nc")
    room.to_netcdf(tmp_path / "b.nc", convention="ugrid")
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


@pytest.mark.parametrize("convention", ["MPAS", "", 3, ["mpas"]])
def test_other_conventions_are_refused(room, tmp_path, convention):
    with pytest.raises(InputError, match=r"convention is .*expected one of 'ugrid', 'mpas', 'scrip'"):
        room.to_netcdf(tmp_path / "mesh.nc", convention=convention)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("convention", BOTH)
def test_variables_too_large_for_the_format_are_refused(room, tmp_path, monkeypatch, convention):
    largest = {"ugrid": "mesh_face_nodes", "mpas": "edgesOnEdge"}[convention]
    room.to_netcdf(tmp_path / "mesh.nc", convention=convention)
    size = read(tmp_path / "mesh.nc")[largest].nbytes
    (tmp_path / "mesh.nc").unlink()
    monkeypatch.setattr(netcdf, "_MOST", size - 1)
    named = rf"mesh\.nc: {largest} \(\d+ x \d+\) has {size} bytes"
    with pytest.raises(InputError, match=named):
        room.to_netcdf(tmp_path / "mesh.nc", convention=convention)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("convention", BOTH)
@pytest.mark.parametrize("where", ["write", "sync"])
def test_a_full_disk_leaves_the_old_file(room, tmp_path, monkeypatch, convention, where):
    path = tmp_path / "mesh.nc"
    path.write_text("the old one")

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        if where == "sync":
            patched.setattr(os, "fsync", full)
        else:
            patched.setattr(netcdf_file, "_write_var_data", full)
        with pytest.raises(InputError, match=r"mesh\.nc: No space left"):
            room.to_netcdf(path, convention=convention)
    assert path.read_text() == "the old one"
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.nc"]
    with pytest.raises(InputError, match="create it first"):
        room.to_netcdf(tmp_path / "absent" / "mesh.nc", convention=convention)
    room.to_netcdf(path, convention=convention)
    assert len(read(path).values) > 10
