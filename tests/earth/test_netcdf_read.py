"""Meshes on a sphere from netCDF files: what was saved comes back, and damaged files are refused."""

import sys

import numpy as np
import pytest
from scipy.io import netcdf_file

import clvoro
from clvoro.errors import InputError
from tests.reference.globes import CASES, EARTH, is_double, made, scattered
from tests.reference.netcdf_files import result_of

CONVENTIONS = ("mpas", "ugrid")


@pytest.fixture(scope="module", params=CASES, ids=str)
def result(ctx, request):
    return made(ctx, *request.param)


@pytest.fixture(scope="module")
def ocean(ctx):
    """A mesh with a coast and, at longitudes from 100 on, an open boundary."""
    globe = clvoro.Adapter(ctx).diagram(clvoro.Sphere(2), scattered(250))
    water = globe.subset(~clvoro.earth.inside(globe, clvoro.Polygon([(-40, -40), (30, -20), (0, 50)])))
    return result_of(water.subset(globe.domain.lonlat(water.points)[:, 0] < 100, "open"))


def folder_of(mesh, path, convention):
    mesh.to_netcdf(path / "mesh.nc", convention=convention)
    return clvoro.load(path / "mesh.nc")


@pytest.mark.sparse(6)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_round_trip(result, tmp_path, convention):
    found = folder_of(result, tmp_path, convention)
    assert isinstance(found, clvoro.Result) == (convention == "ugrid")
    if convention == "ugrid":
        for name in ("target_size", "size_error", "quality"):
            assert np.array_equal(getattr(found, name), getattr(result, name))
    d, e = result.diagram, getattr(found, "diagram", found)
    assert e.domain == d.domain
    same(d, e, 4e-15 if is_double(result) else 1e-6)
    if is_double(result):
        assert e.check().ok


def same(d, e, eps):
    """Generators and corners to `eps` of the radius, and the same neighbors, in the same order."""
    radius = d.domain.radius
    np.testing.assert_allclose(e.points, d.points, rtol=0, atol=eps * radius)
    assert np.array_equal(e.neighbor_starts, d.neighbor_starts)
    assert np.array_equal(np.maximum(e.neighbors, -1), np.maximum(d.neighbors, -1))
    np.testing.assert_allclose(e.vertices[e.cell_vertices], d.vertices[d.cell_vertices], rtol=0, atol=eps * radius)
    # Of small cells in the middle of large ones the round-off is that of the positions.
    widths = np.sqrt(d.volumes)
    np.testing.assert_allclose(e.volumes, d.volumes, rtol=0, atol=8 * eps * (radius * widths).max())


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_round_trip_of_an_ocean(ocean, tmp_path, convention):
    d, e = ocean.diagram, folder_of(ocean.diagram, tmp_path, convention)
    same(d, e, 4e-15)
    walls = d.neighbors < 0
    # The generators of removed cells, from faces that may be short.
    behind, expected = (np.asarray(m.domain.beyond)[-1 - m.neighbors[walls]] for m in (e, d))
    np.testing.assert_allclose(behind, expected, rtol=0, atol=1e-14 if convention == "mpas" else 1e-10)
    assert len(e.domain.beyond) == len(d.domain.beyond)
    assert e.domain.measure == pytest.approx(d.domain.measure, rel=1e-13)
    assert e.check().ok


def test_saved_again_it_is_the_same(ocean, tmp_path):
    """Positions on the sphere are those of the file, so that later round trips change no bit."""
    first = folder_of(ocean.diagram, tmp_path, "mpas")
    again = folder_of(first, tmp_path, "mpas")
    for name in ("points", "neighbors", "vertices", "cell_vertices"):
        np.testing.assert_allclose(getattr(again, name), getattr(first, name), rtol=0, atol=1e-15)


def changed(path, convention, change):
    """Write a mesh, change the variables of its file, and return the path."""
    clvoro.voronoi(EARTH, scattered(150)).to_netcdf(path / "good.nc", convention=convention)
    with netcdf_file(path / "good.nc", mmap=False) as good, netcdf_file(path / "bad.nc", "w") as bad:
        for name, length in good.dimensions.items():
            bad.createDimension(name, length)
        attributes = {k: v for k, v in good._attributes.items()}
        values = {k: (v.data.copy(), v.dimensions, v._attributes) for k, v in good.variables.items()}
        change(values, attributes)
        for key, value in attributes.items():
            setattr(bad, key, value)
        for name, (data, dimensions, about) in values.items():
            made_ = bad.createVariable(name, data.dtype, dimensions)
            made_[...] = data
            for key, value in about.items():
                setattr(made_, key, value)
    return path / "bad.nc"


def test_indices_as_real_numbers(tmp_path):
    """As xarray writes them."""

    def change(values, attributes):
        nodes, dims, about = values["mesh_face_nodes"]
        nodes = np.where(nodes == about["_FillValue"], np.nan, nodes)
        values["mesh_face_nodes"] = nodes, dims, {**about, "_FillValue": np.nan}

    mesh = clvoro.load(changed(tmp_path, "ugrid", change))
    assert np.array_equal(mesh.neighbors, clvoro.load(tmp_path / "good.nc").neighbors)


def put(name, at, value):
    def change(values, attributes):
        values[name][0][at] = value

    return change


@pytest.mark.parametrize(
    ("convention", "change", "message"),
    [
        ("mpas", put("verticesOnCell", (3, 0), 10**6), "verticesOnCell has an index out of range"),
        ("mpas", put("edgesOnCell", (3, 0), 0), "edgesOnCell has an index out of range"),
        ("mpas", put("xCell", 5, np.nan), "xCell has values that are not finite"),
        ("mpas", put("xCell", 5, 3e7), r"generators\[5\] is .*, not on the sphere"),
        ("mpas", put("nEdgesOnCell", 7, 1), "cell 7 has 1 corners"),
        ("mpas", put("nEdgesOnCell", 7, 99), "nEdgesOnCell|numbers of edges"),
        ("mpas", lambda v, a: a.update(on_a_sphere="NO"), "a mesh in the plane"),
        ("mpas", lambda v, a: v.pop("yCell"), "lacks the variable yCell"),
        ("ugrid", lambda v, a: v["mesh"][2].pop("face_coordinates"), "clvoro.voronoi"),
        ("ugrid", put("mesh_face_nodes", (0, slice(0, 2)), 1), "counter-clockwise|same side"),
        ("ugrid", lambda v, a: v["mesh"][2].update(cf_role="other"), "no mesh by MPAS or UGRID"),
        ("scrip", lambda v, a: None, "no mesh by MPAS or UGRID"),
    ],
)
def test_damaged_files_are_refused(tmp_path, convention, change, message):
    path = changed(tmp_path, convention, change)
    with pytest.raises(InputError, match=rf"cannot load .*bad\.nc: .*({message})"):
        clvoro.load(path)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "mesh.nc"
    for content, message in (
        (b"\x89HDF\r\n", "nccopy|NetCDF"),
        (b"CDF", "damaged or not a netCDF"),
        (b"", "another kind"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"cannot load .*mesh\.nc: .*{message}"):
            clvoro.load(path)
    plane = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), [(0.2, 0.3), (0.7, 0.8), (0.6, 0.1)])
    for convention in ("mpas", "ugrid"):
        plane.to_netcdf(path, convention=convention)
        with pytest.raises(InputError, match="a mesh in the plane, expected one on a sphere"):
            clvoro.load(path)
    with pytest.raises(InputError, match="No such file"):
        clvoro.load(tmp_path / "missing.nc")


def test_faces_whose_coordinates_have_no_units_are_taken_by_their_names(tmp_path):
    def rename(named, units):
        def change(v, a):
            old = v["mesh"][2]["face_coordinates"].decode().split()
            for name, new in zip(old, named, strict=True):
                v[new] = (*v.pop(name)[:2], {} if units is None else {"units": units})
            v["mesh"][2]["face_coordinates"] = " ".join(named)

        return change

    good = clvoro.load(changed(tmp_path, "ugrid", rename(("face_lon", "face_lat"), None)))
    assert len(good) > 0
    for named, units, says in (
        (("face_u", "face_v"), None, r"face_u has units None, .*expected 'degrees_east' and 'degrees_north'"),
        (("face_lon", "face_lat"), "cubits", "face_lon has units 'cubits'"),
    ):
        with pytest.raises(InputError, match=says):
            clvoro.load(changed(tmp_path, "ugrid", rename(named, units)))


def test_netcdf_4_needs_one_package(ocean, tmp_path, monkeypatch):
    netCDF4 = pytest.importorskip("netCDF4")
    ocean.to_netcdf(tmp_path / "old.nc")
    with netCDF4.Dataset(tmp_path / "old.nc") as old, netCDF4.Dataset(tmp_path / "new.nc", "w") as new:
        old.set_auto_maskandscale(False)
        new.setncatts({key: old.getncattr(key) for key in old.ncattrs()})
        for name, dimension in old.dimensions.items():
            new.createDimension(name, len(dimension))
        for name, variable in old.variables.items():
            about = {key: variable.getncattr(key) for key in variable.ncattrs()}
            made = new.createVariable(
                name, variable.dtype, variable.dimensions, fill_value=about.pop("_FillValue", None)
            )
            made.set_auto_maskandscale(False)
            made.setncatts(about)
            made[...] = variable[...]
    assert np.array_equal(clvoro.load(tmp_path / "new.nc").points, clvoro.load(tmp_path / "old.nc").points)
    monkeypatch.setitem(sys.modules, "netCDF4", None)
    with pytest.raises(InputError, match="pip install netCDF4"):
        clvoro.load(tmp_path / "new.nc")
