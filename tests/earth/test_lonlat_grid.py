"""Rasters of longitude and latitude from arrays with coordinates, as xarray has them."""

from types import SimpleNamespace

import numpy as np
import pytest

import clvoro
from clvoro import earth, sizing
from clvoro.errors import ClvoroError
from clvoro.sizing.field import on_domain

EARTH = clvoro.Sphere()
RNG = np.random.default_rng(12)
PLACES = np.column_stack([RNG.uniform(-180, 180, 2000), RNG.uniform(-90, 90, 2000)])
GLOBAL, CENTERED = np.arange(0, 360, 5.0), np.arange(-87.5, 90, 5)
POLES = np.linspace(-90, 90, 37)


def smooth(lon, lat):
    """Return a size that is bounded by a tenth of itself per 5 degrees."""
    return 3e5 + 5e4 * np.cos(np.radians(lat)) * np.sin(np.radians(lon)) + 300 * lat


def array(lon, lat, values=None, dims=("lat", "lon"), names=("lon", "lat"), attrs=({}, {}), **more):
    """Return what looks like a DataArray."""
    if values is None:
        values = smooth(*np.meshgrid(lon, lat))
    along = {
        name: SimpleNamespace(values=np.asarray(x), dims=(dim,), attrs=a)
        for name, x, dim, a in zip(names, (lon, lat), (dims[-1], dims[-2]), attrs, strict=True)
    }
    return SimpleNamespace(values=values, dims=dims, coords=along, name="h", **more)


def at(raster, places=PLACES):
    return on_domain(EARTH, raster)(EARTH.positions(places))


def error(raster, places=PLACES):
    return np.abs(at(raster, places) - smooth(*places.T)).max()


LINEAR = 5e4 * np.radians(5) ** 2 / 4
"""Bound of the error of bilinear interpolation with a spacing of 5 degrees: h^2 / 8 of each second derivative."""
SIDES = 5e4 * np.radians(2.5) + 300 * 2.5
"""The same within half a row of the poles, where grids that end before them have the nearest value."""

LAYOUTS = {
    "0 to 360": (GLOBAL, POLES),
    "-180 to 180": (np.arange(-180, 180, 5.0), POLES),
    "centers": (GLOBAL + 2.5, CENTERED),
    "repeated": (np.arange(0, 361, 5.0), POLES),
    "descending": (GLOBAL, POLES[::-1]),
    "westwards": (GLOBAL[::-1], POLES),
    "seam inside": (np.r_[np.arange(0, 180, 5.0), np.arange(-180, 0, 5.0)], POLES),
    "float32": (GLOBAL.astype(np.float32), POLES.astype(np.float32)),
    "far": (GLOBAL + 300, POLES),
    "varying": (np.sort(np.r_[GLOBAL, 1.0, 2.5, 3.7]), np.degrees(np.arcsin(np.linspace(-1, 1, 121)))),
    "open seam": (np.arange(0, 358, 3.5), POLES),
}


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_layouts(name):
    lon, lat = LAYOUTS[name]
    raster = earth.from_xarray(array(lon, lat))
    # Rows at equal steps of the sine are up to 7.4 degrees apart at the poles.
    bound = {"centers": SIDES, "varying": 2.5 * LINEAR}.get(name, LINEAR)
    assert error(raster) < bound
    # Exact at the given places, where the grid is kept.
    if name != "varying" and name != "open seam":
        given = np.stack(np.meshgrid(lon, lat), axis=-1).reshape(-1, 2).astype(float)
        assert error(raster, given) < 1e-6 * 3e5


def test_dimensions_may_have_other_orders_and_names():
    wanted = at(earth.from_xarray(array(GLOBAL, POLES)))
    values = smooth(*np.meshgrid(GLOBAL, POLES))
    along = {
        "XC": SimpleNamespace(values=GLOBAL, dims=("i",), attrs={"standard_name": "longitude"}),
        "YC": SimpleNamespace(values=POLES, dims=("j",), attrs={"units": "degrees_north"}),
        "time": SimpleNamespace(values=np.zeros(1), dims=("time",), attrs={}),
    }
    turned = SimpleNamespace(values=values.T[:, None], dims=("i", "time", "j"), coords=along)
    assert np.array_equal(at(earth.from_xarray(turned)), wanted)


def test_values_of_a_part_are_those_of_its_nearer_side():
    raster = earth.from_xarray(array(np.arange(170, 191, 5.0), np.arange(-10, 11, 5.0)))
    west, east = smooth(170, 0), smooth(190, 0)
    found = at(raster, [(165, 0), (170, 0), (-170, 0), (-165, 0), (100, 0), (-100, 0)])
    assert found == pytest.approx([west, west, east, east, west, east])


def test_missing_values_come_from_across_the_seam():
    values = smooth(*np.meshgrid(GLOBAL, POLES))
    values[:, :6] = np.nan  # 0 to 25 degrees; 355 is nearest to 0, and 30 to 25
    with pytest.raises(ClvoroError, match="missing"):
        earth.from_xarray(array(GLOBAL, POLES, values))
    raster = earth.from_xarray(array(GLOBAL, POLES, values), missing="nearest")
    assert at(raster, [(0, 0), (25, 0)]) == pytest.approx([smooth(355, 0), smooth(30, 0)])
    masked = np.ma.masked_array(np.nan_to_num(values), np.isnan(values))
    again = earth.from_xarray(array(GLOBAL, POLES, masked), missing="nearest")
    assert np.array_equal(again.values, raster.values)


def test_grids_that_reach_the_poles_with_their_pixels_cover_the_sphere():
    for lon, lat in ((GLOBAL + 2.5, CENTERED), (GLOBAL, POLES)):
        raster = earth.from_xarray(array(lon, lat), outside="error")
        assert sizing.generate_code(on_domain(EARTH, raster), EARTH).data.size
        assert at(raster, [(0, 90), (0, -90)]).min() > 0


def test_a_mesh_of_it(ctx):
    del ctx  # OpenCL is there
    size = 4 * earth.from_xarray(array(GLOBAL, POLES[::-1]))
    mesh = clvoro.adapt(EARTH, size, effort="fast")
    mesh.check().demand()
    expected = np.mean(4 * smooth(*EARTH.lonlat(mesh.points).T) / mesh.target_size)
    assert expected == pytest.approx(1, rel=0.01)


def radians(lon, lat, **attrs):
    return array(np.radians(lon), np.radians(lat), **attrs)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (array(GLOBAL, POLES, attrs=({"units": "m"}, {})), "unit 'm'"),
        (array(GLOBAL[:1], POLES), "at least 2"),
        (array(np.array([0, np.nan, 10.0]), POLES), "not finite"),
        (array(np.array(["a", "b"]), POLES, np.ones((37, 2))), "numbers"),
        (array(GLOBAL, POLES, np.full((37, 72), np.inf)), "finite"),
        (SimpleNamespace(data_vars={"h": 0}), r"Dataset of h.*dataset\['NAME'\]"),
    ],
)
def test_mistakes(given, message):
    with pytest.raises(ClvoroError, match=message):
        earth.from_xarray(given)


def test_small_regions_in_degrees_are_no_radians():
    raster = earth.from_xarray(array(np.linspace(0, 1, 11), np.linspace(0, 1, 11)))
    assert error(raster, np.array([(0.5, 0.5)])) < 1
    units = ({"units": "degrees_east"}, {"units": "degrees_north"})
    raster = earth.from_xarray(array(np.arange(0, 6.2, 0.1), np.linspace(0, 1, 11), attrs=units))
    assert error(raster, np.array([(3.0, 0.5)])) < 1


def test_xarray_itself():
    xarray = pytest.importorskip("xarray")
    data = xarray.DataArray(
        smooth(*np.meshgrid(GLOBAL, POLES[::-1])),
        {"latitude": POLES[::-1], "longitude": GLOBAL},
        ("latitude", "longitude"),
    )
    assert error(earth.from_xarray(data)) < LINEAR
    assert np.array_equal(earth.from_xarray(data.T).values, earth.from_xarray(data).values)
    with pytest.raises(ClvoroError, match="Dataset of h"):
        earth.from_xarray(data.to_dataset(name="h"))
