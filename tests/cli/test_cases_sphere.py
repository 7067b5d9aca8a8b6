"""Cases on spheres: domain, caps, grids of longitude and latitude, files, and what is refused."""

import json

import numpy as np
import pytest
from scipy.io import netcdf_file

import clvoro
from clvoro import earth, sizing
from clvoro.cli import command as cli
from clvoro.cli.cases import Case, files, load_case
from clvoro.errors import InputError
from clvoro.io import load
from clvoro.sizing.field import on_domain

HEAD = "[domain]\nkind = 'sphere'\nradius = 1000.0\n"
SPHERE = clvoro.Sphere(1000)
X = SPHERE.wrap(np.random.default_rng(3).normal(size=(300, 3)))
LON, LAT = np.arange(0, 360, 10.0), np.linspace(90, -90, 19)
WAVES = 100 + 20 * np.cos(np.radians(LAT))[:, None] * np.sin(np.radians(LON))
RASTER = "[size]\nkind = 'raster'\nfile = '{}'\n"
SMALL = HEAD + "[size]\nkind = 'constant'\nvalue = 300\n[run]\neffort = 'fast'\nseed = 1\n"


def sizes(text, folder=None):
    case = Case.from_toml(HEAD + text, "my.toml", *([folder] if folder else []))
    return on_domain(case.domain, case.size_field())(X)


def call(*arguments):
    return cli.main([str(a) for a in arguments])


HERE = ("small.toml", SMALL)


def write_netcdf(path, packed=False):
    with netcdf_file(path, "w") as file:
        for name, values, unit in (("lat", LAT, "degrees_north"), ("lon", LON, "degrees_east")):
            file.createDimension(name, len(values))
            file.createVariable(name, "d", (name,))[:] = values
            file.variables[name].units = unit
        file.createDimension("time", 1)
        file.createDimension("nv", 2)
        file.createVariable("lat_bnds", "d", ("lat", "nv"))[:] = np.column_stack([LAT - 5, LAT + 5])
        if packed:
            h = file.createVariable("h", "h", ("time", "lat", "lon"))
            h[:] = np.round((WAVES - 100) / 0.01)
            h.scale_factor, h.add_offset, h.missing_value = 0.01, 100.0, np.int16(-32768)
            h[0, 3, 4] = -32768
        else:
            file.createVariable("h", "d", ("time", "lat", "lon"))[:] = WAVES


def test_domains():
    case = Case.from_toml(HEAD + "[size]\nkind = 'constant'\nvalue = 100", "my.toml")
    assert case.domain == SPHERE
    again = Case.from_toml(files.write_toml(case.table), "case.toml")
    assert (again.domain, again.table) == (SPHERE, case.table)
    assert load_case("ocean").domain == clvoro.Sphere()


def test_fields(tmp_path):
    text = """
[size]
kind = "min"
fields = [
  { kind = "caps", h_max = 200, slope = 0.2, regions = [{ center = [10, 20], radius = 300, size = 50 }] },
  { kind = "distance", h_min = 20, growth = 1.2, shapes = [
    { kind = "circle", center = [-120, 10], radius = 0 },
    { kind = "polyline", points = [[170, 0], [190, 40]] },
    { kind = "box", lower = [40, -30], upper = [50, -20] },
  ] },
  { kind = "expression", expression = "100 + abs(lat) + 0.1 * abs(lon)" },
]
"""
    shapes = [sizing.Circle((-120, 10), 0), sizing.Polyline([(170, 0), (190, 40)]), clvoro.Box((40, -30), (50, -20))]
    size = sizing.minimum(
        earth.Caps([((10, 20), 300, 50)], 200, slope=0.2, sphere=SPHERE),
        sizing.Distance(shapes, 20, growth=1.2),
        sizing.Expression("100 + abs(lat) + 0.1 * abs(lon)"),
    )
    assert sizes(text) == pytest.approx(on_domain(SPHERE, size)(X))


def test_a_ball_in_space_is_a_source_of_sizes():
    """The kind of shape of that name has three coordinates: distances are straight."""
    text = "[size]\nkind='distance'\nh_min=50\nslope=0.1\nshapes=[{kind='sphere',center=[1000,0,0],radius=200}]"
    away = np.abs(np.linalg.norm(X - (1000, 0, 0), axis=1) - 200)
    assert sizes(text) == pytest.approx(50 + 0.1 * away)


def test_grids_in_files(tmp_path):
    upward = sizing.Raster(WAVES[::-1], (0, -90), (350, 90))
    wanted = on_domain(SPHERE, upward)(X)
    write_netcdf(tmp_path / "h.nc")
    assert sizes(RASTER.format("h.nc"), tmp_path) == pytest.approx(wanted)
    assert sizes(RASTER.format("h.nc") + "variable = 'h'", tmp_path) == pytest.approx(wanted)
    np.savez(tmp_path / "h.npz", lon=LON, lat=LAT, h=WAVES, land=WAVES[0] > 100)
    assert sizes(RASTER.format("h.npz"), tmp_path) == pytest.approx(wanted)
    whole = np.c_[WAVES, WAVES[:, :1]]
    np.save(tmp_path / "h.npy", np.roll(whole[::-1, :-1], 18, axis=1))
    corners = "lower = [-180, -90]\nupper = [170, 90]"
    assert sizes(RASTER.format("h.npy") + corners, tmp_path) == pytest.approx(wanted)
    np.save(tmp_path / "whole.npy", np.full((5, 9), 70.0))
    assert sizes(RASTER.format("whole.npy"), tmp_path) == pytest.approx(70)


def test_packed_values_with_gaps(tmp_path):
    write_netcdf(tmp_path / "h.nc", packed=True)
    with pytest.raises(InputError, match="1 of 684 are missing"):
        sizes(RASTER.format("h.nc"), tmp_path)
    found = sizes(RASTER.format("h.nc") + "missing = 'nearest'", tmp_path)
    wanted = on_domain(SPHERE, sizing.Raster(WAVES[::-1], (0, -90), (350, 90)))(X)
    # Rounded to 0.01; beside the gap the value of a neighbor, 10 degrees away.
    assert np.abs(found - wanted).max() < 20 * np.radians(10)
    assert np.median(np.abs(found - wanted)) < 0.005


def test_grids_go_with_the_case(tmp_path):
    write_netcdf(tmp_path / "h.nc")
    out = tmp_path / "out"
    out.mkdir()
    Case.from_toml(HEAD + RASTER.format("h.nc"), "my.toml", tmp_path).write(out)
    (tmp_path / "h.nc").unlink()
    assert on_domain(SPHERE, load_case(out / "case.toml").size_field())(X).min() > 70


def test_graded_sizes():
    field = "[size.field]\nkind = 'expression'\nexpression = 'lat > 0 ? 50 : 200'\n"
    found = sizes(f"[size]\nkind = 'graded'\nslope = 0.2\n{field}")
    arc = 1000 * np.maximum(-np.arcsin(X[:, 2] / 1000), 0)
    assert found == pytest.approx(np.minimum(50 + 0.2 * arc, 200), abs=6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kind='caps'\nh_max=1\nregions=[]\nslope=1", "regions is .*length >= 1"),
        ("kind='caps'\nh_max=1\nregions=[{center=[0,0],radius=1}]\nslope=1", r"regions\[0\] lacks size"),
        ("kind='caps'\nh_max=1\nregions=[{center=[0,0],radius=1,size=1}]", "none of growth, slope"),
        ("kind='caps'\nh_max=1\nregions=[{center=[0,99],radius=1,size=1}]\nslope=1", "latitude"),
        ("kind='feature'", "a polygon in"),
        ("kind='hessian'\nfile='h.npy'\neps=1", "'hessian', which is not for Sphere"),
        ("kind='distance'\nh_min=1\nslope=1\nshapes=[{kind='boundary'}]", "no boundary"),
        ("kind='distance'\nh_min=1\nslope=1\nshapes=[{kind='box'}]", "box without corners"),
        ("kind='raster'\nfile='h.npy'\nvariable='h'", "variable is 'h'.*leave it out"),
        ("kind='raster'\nfile='h.nc'\nlower=[0,0]\nupper=[1,1]", "lower is given"),
        ("kind='raster'\nfile='h.nc'\nvariable='depth'", "variables lat_bnds, h.*'depth'"),
        ("kind='raster'\nfile='two.npz'", "variables g, h.*none of the 2"),
        ("kind='raster'\nfile='turned.npz'", r"shape \(36, 19\), expected .* \(19, 36\)"),
        ("kind='raster'\nfile='plain.npz'\nvariable='h'", "expected lon and lat, too"),
        ("kind='raster'\nfile='radians.npz'", "radians"),
        ("kind='raster'\nfile='text.nc'", "another kind of file"),
        ("kind='raster'\nfile='cut.nc'", "cut.nc"),
        ("kind='raster'\nfile='absent.nc'", "absent.nc"),
    ],
)
def test_mistakes_in_sizes(tmp_path, text, message):
    write_netcdf(tmp_path / "h.nc")
    np.save(tmp_path / "h.npy", WAVES)
    np.savez(tmp_path / "two.npz", lon=LON, lat=LAT, g=WAVES, h=WAVES)
    np.savez(tmp_path / "turned.npz", lon=LON, lat=LAT, h=WAVES.T)
    np.savez(tmp_path / "plain.npz", h=WAVES)
    np.savez(tmp_path / "radians.npz", lon=np.radians(LON), lat=np.radians(LAT), h=WAVES)
    (tmp_path / "text.nc").write_text("no grid")
    (tmp_path / "cut.nc").write_bytes((tmp_path / "h.nc").read_bytes()[:500])
    with pytest.raises(InputError, match=message):
        sizes(f"[size]\n{text}", tmp_path)


def test_grids_of_xarray(tmp_path):
    """netCDF-4, with packed values and a gap; longitudes from -180."""
    xarray, _ = pytest.importorskip("xarray"), pytest.importorskip("netCDF4")
    coords = {"latitude": LAT, "longitude": (LON + 180) % 360 - 180}
    data = xarray.DataArray(WAVES, coords, ("latitude", "longitude"), name="h").sortby("longitude")
    packing = {"dtype": "i2", "scale_factor": 0.01, "add_offset": 100.0, "_FillValue": -32768}
    data.where(data.latitude < 80).to_netcdf(tmp_path / "h.nc", encoding={"h": packing})
    found = sizes(RASTER.format("h.nc") + "variable = 'h'\nmissing = 'nearest'", tmp_path)
    wanted, south = on_domain(SPHERE, sizing.Raster(WAVES[::-1], (0, -90), (350, 90)))(X), X[:, 2] < 900
    assert found[south] == pytest.approx(wanted[south], abs=20 * np.radians(10))
    assert np.median(np.abs(found - wanted)) < 0.005


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[domain]\nradius = 1.0\n", 'kind = "sphere"'),
        ("[domain]\nkind = 'sphere'\nradius = -1\n", "radius is -1"),
        ("[domain]\nkind = 'sphere'\nperiodic = true\n", "'periodic'"),
        ("[domain]\nkind = 'ball'\n", "box, polygon, sphere"),
    ],
)
def test_mistakes_in_domains(text, message):
    with pytest.raises(InputError, match=message):
        Case.from_toml(f"size = 1\n{text}", "my.toml")


def test_ocean_is_what_it_says():
    case = load_case("ocean")
    size = case.size_field()
    found = size(case.domain.positions([(-40, 45), (140, -45)]))
    assert found == pytest.approx([40e3, 360e3])
    z = np.linspace(-1, 1, 100_001)[:-1] + 1e-5  # a spiral with evenly spread points
    turn, flat = np.pi * (1 + 5**0.5) * np.arange(len(z)), np.sqrt(1 - z**2)
    x = case.domain.radius * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    assert np.mean(size(x) ** -2.0) * case.domain.measure == pytest.approx(15700, rel=0.01)


@pytest.mark.slow
def test_run_writes_everything(here, capsys):
    options = ("--cells", 500, "--effort", "fast", "--json", "--format", "nc,mpas,metis", "--processors", 3)
    assert call("run", "ocean", *options) == cli.OK
    out = here / "out" / "ocean"
    result = load(out / "mesh.npz")
    result.check().demand()
    assert (len(result.points), result.diagram.domain) == (500, clvoro.Sphere())
    assert json.loads(capsys.readouterr().out)["cells"] == 500
    written = {p.name for p in out.iterdir()}
    assert {
        "mesh.vtu",
        "mesh.nc",
        "mesh-mpas.nc",
        "graph.info",
        "graph.info.part.3",
        "case.toml",
        "report.html",
    } <= written
    pictures = {p.stem for p in (out / "pictures").iterdir()}
    assert {"size", "plate", "cells", "history", "sides"} <= pictures
    with netcdf_file(out / "mesh-mpas.nc", mmap=False) as file:
        assert file.on_a_sphere == b"YES"
        assert file.dimensions["nCells"] == 500


def test_meshes_are_checked_and_converted(here, capsys):
    assert call("run", "small.toml", "--no-report", "--quiet", "--out", "a") == cli.OK
    assert call("check", "a/mesh.npz", "a/mesh.vtu") == cli.OK
    assert capsys.readouterr().out.count("properties hold") == 2
    assert call("check", "--for", "mpas", "a/mesh.npz") == cli.OK
    printed = capsys.readouterr().out
    assert "mpas: accepted" in printed
    assert "°, " in printed  # places are longitudes and latitudes
    assert call("check", "--for", "mpas", "--json", "a/mesh.npz") == cli.OK
    criteria = json.loads(capsys.readouterr().out)["criteria"]
    assert {c["unit"] for c in criteria} == {"°"}
    assert all(abs(c["place"][1]) <= 90 and len(c["place"]) == 2 for c in criteria)
    for name in ("b.nc", "b.vtu", "b.npz", "b.info"):
        assert call("convert", "a/mesh.npz", name) == cli.OK
    assert call("convert", "a/mesh.npz", "m.nc", "--convention", "mpas") == cli.OK
    assert call("check", "b.vtu", "b.npz") == cli.OK


@pytest.mark.sparse(3)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", "small.toml", "--format", "foam"), "format openfoam is for meshes in boxes"),
        (("run", "small.toml", "--check-solver", "openfoam"), "check-solver openfoam is for"),
        (("check", "--for", "openfoam", "a/mesh.npz"), "solver='mpas'"),
        (("convert", "a/mesh.npz", "a.foam"), "convention='mpas'"),
        (("convert", "a/mesh.npz", "a.nc", "--walls", "exact"), "walls"),
    ],
)
def test_what_makes_no_sense_on_a_sphere(here, capsys, arguments, message):
    call("run", "small.toml", "--no-report", "--quiet", "--out", "a")
    capsys.readouterr()
    assert call(*arguments) == cli.BAD_INPUT
    error = capsys.readouterr().err
    assert error.startswith("clvoro: ")
    assert error.count("\n") == 1
    assert message in error


def test_layers_are_refused(here, capsys):
    (here / "small.toml").write_text(SMALL + "[[layers]]\nheight = 10\n")
    assert call("run", "small.toml", "--quiet") == cli.BAD_INPUT
    assert "layers" in capsys.readouterr().err


def test_start_from_longitudes_and_latitudes(here):
    np.save(here / "start.npy", SPHERE.lonlat(X))
    (here / "small.toml").write_text(
        SMALL + "points = 'start.npy'\nmethod = 'lloyd'\nmax_steps = 0\n".replace("effort", "")
    )
    text = (here / "small.toml").read_text().replace("effort = 'fast'\n", "")
    (here / "small.toml").write_text(text)
    assert call("run", "small.toml", "--no-report", "--quiet") == cli.OK
    assert load(here / "out/small/mesh.npz").points == pytest.approx(X, rel=1e-9, abs=1e-6)


LAND = '{"type": "Polygon", "coordinates": [[[-60, -40], [20, -40], [20, 50], [-60, 50], [-60, -40]]]}'


def test_land_of_a_case_is_removed(here):
    (here / "land.geojson").write_text(LAND)
    case = 'size = 1.5e6\n[domain]\nkind = "sphere"\nland = "land.geojson"\n[run]\neffort = "fast"\n'
    (here / "ocean-1.toml").write_text(case)
    assert call("run", "ocean-1.toml", "--no-report", "--quiet", "--format", "mpas", "--out", "a") == cli.OK
    mesh = clvoro.load(here / "a/mesh.npz")
    assert mesh.diagram.domain.boundary_names == ("coast",)
    lon, lat = clvoro.Sphere().lonlat(mesh.points).T
    assert not ((lon > -60) & (lon < 20) & (lat > -40) & (lat < 50)).any()
    assert call("run", "a/case.toml", "--no-report", "--quiet", "--out", "b") == cli.OK
    assert np.array_equal(clvoro.load(here / "b/mesh.npz").points, mesh.points)
    (here / "ocean-1.toml").write_text(case.replace("land.geojson", "lnd.geojson"))
    assert call("run", "ocean-1.toml", "--out", "c") == cli.BAD_INPUT
    assert not (here / "c").exists()
