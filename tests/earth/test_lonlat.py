"""Size fields on the sphere: device against host, host against formulas."""

import warnings

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro import earth, sizing
from clvoro.errors import ClvoroError, MismatchWarning
from clvoro.opencl.engine import Engine
from clvoro.sizing.field import on_domain

EARTH = clvoro.Sphere()
POINTS = np.concatenate(
    [
        EARTH.wrap(np.random.default_rng(0).normal(size=(3000, 3))),
        EARTH.positions([(0, 90), (0, -90), (180, 0), (-180, 0), (0, 0), (-45, 45), (135, -45)]),
    ]
)
LON, LAT = EARTH.lonlat(POINTS).T
NORTH = np.linspace(-90, 90, 19)
WAVES = 3e5 + 1e5 * np.cos(np.radians(NORTH))[:, None] * np.sin(np.radians(np.arange(0, 360, 10.0)))


def arc(center):
    """Return the distance of `POINTS` from a point by the haversine formula."""
    lon, lat = np.radians(center)
    a = np.sin((np.radians(LAT) - lat) / 2) ** 2
    a += np.cos(np.radians(LAT)) * np.cos(lat) * np.sin((np.radians(LON) - lon) / 2) ** 2
    return 2 * EARTH.radius * np.arcsin(np.sqrt(np.minimum(a, 1)))


def bilinear(values, west, step):
    """Return the interpolation of a raster over all longitudes, whose rows are 10 degrees apart."""
    t, s = ((LON - west) / step) % (360 / step), (LAT + 90) / 10
    i, j = t.astype(int), np.minimum(s.astype(int), len(values) - 2)
    a, b = t - i, s - j
    k = (i + 1) % values.shape[1]
    i %= values.shape[1]
    return (1 - b) * ((1 - a) * values[j, i] + a * values[j, k]) + b * (
        (1 - a) * values[j + 1, i] + a * values[j + 1, k]
    )


FIELDS = {
    "expression": (sizing.Expression("2e5 + 1e3*abs(lat) + 200*abs(lon)"), 2e5 + 1e3 * abs(LAT) + 200 * abs(LON)),
    "function": (earth.LonLat(lambda p: 2e5 + 1e3 * abs(p[:, 1])), 2e5 + 1e3 * abs(LAT)),
    "raster": (sizing.Raster(WAVES, (0, -90), (350, 90)), bilinear(WAVES, 0, 10)),
    "repeated": (sizing.Raster(np.c_[WAVES, WAVES[:, :1]], (0, -90), (360, 90)), bilinear(WAVES, 0, 10)),
    "from-the-west": (sizing.Raster(np.roll(WAVES, 18, axis=1), (-180, -90), (170, 90)), bilinear(WAVES, 0, 10)),
    "point": (
        sizing.Distance(sizing.Circle((-45, 45), 0), h_min=5e4, growth=1.2, h_max=5e5),
        np.minimum(5e4 + np.log(1.2) * arc((-45, 45)), 5e5),
    ),
    "circle": (
        sizing.Distance(sizing.Circle((-45, 45), 20), h_min=5e4, growth=1.2, h_max=5e5),
        np.minimum(5e4 + np.log(1.2) * abs(arc((-45, 45)) - np.radians(20) * EARTH.radius), 5e5),
    ),
    "equator": (
        sizing.Distance(sizing.Polyline([(-180, 0), (0, 0), (180, 0)]), h_min=5e4, slope=0.2, h_max=5e5),
        np.minimum(5e4 + 0.2 * EARTH.radius * np.radians(abs(LAT)), 5e5),
    ),
    "caps": (
        earth.Caps([((-45, 45), 3e6, 2e5), ((-45, 45), 1e6, 1e5)], h_max=4e5, growth=1.1),
        np.minimum.reduce(
            [
                np.full(len(POINTS), 4e5),
                2e5 + np.log(1.1) * np.maximum(arc((-45, 45)) - 3e6, 0),
                1e5 + np.log(1.1) * np.maximum(arc((-45, 45)) - 1e6, 0),
            ]
        ),
    ),
    "combined": (
        2 * sizing.minimum(sizing.Expression("2e5 + 1e3*abs(lat)"), sizing.Raster(WAVES, (0, -90), (350, 90)), 25e4),
        2 * np.minimum(np.minimum(2e5 + 1e3 * abs(LAT), bilinear(WAVES, 0, 10)), 25e4),
    ),
    "mixed": (
        sizing.minimum(
            earth.Caps([((-45, 45), 1e6, 1e5)], h_max=4e5, growth=1.1), 2 * sizing.Raster(WAVES, (0, -90), (350, 90))
        ),
        np.minimum(
            np.minimum(1e5 + np.log(1.1) * np.maximum(arc((-45, 45)) - 1e6, 0), 4e5), 2 * bilinear(WAVES, 0, 10)
        ),
    ),
    "cartesian": (sizing.Expression("3e5 + 0.01*z"), 3e5 + 0.01 * POINTS[:, 2]),
}
COARSE = {"circle": 5e-4}
"""Relative error of curves that stand for others; that of chords is a thousandth of h_min at most."""


@pytest.mark.sparse(4)
@pytest.mark.parametrize("name", list(FIELDS))
def test_values(name):
    field, expected = FIELDS[name]
    assert on_domain(EARTH, field)(POINTS) == pytest.approx(
        expected, rel=COARSE.get(name, 1e-4 if name == "equator" else 1e-9)
    )


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("name", list(FIELDS))
def test_on_the_device(ctx, name, real):
    field, kind = FIELDS[name][0], np.dtype(real)
    engine = Engine(ctx, cl.CommandQueue(ctx), 3, kind, EARTH.traits(kind))
    found = sizing.Sizing(engine, EARTH, field)(POINTS)
    # A longitude near 180 degrees may be rounded to the other side, where a raster has the same value.
    assert found == pytest.approx(on_domain(EARTH, field)(POINTS), rel=500 * float(np.finfo(kind).eps))


def test_landmarks_are_on_the_sphere():
    for name in ("raster", "circle", "caps"):
        marks = on_domain(EARTH, FIELDS[name][0]).landmarks(EARTH)
        assert np.linalg.norm(marks, axis=1) == pytest.approx(np.full(len(marks), EARTH.radius), rel=1e-3)


def test_fields_of_the_plane_stay():
    box, field = clvoro.Box((0, 0), (1, 1)), sizing.Expression("0.1 + 0.1*lon")
    assert on_domain(box, field) is field
    assert field(np.array([(0.5, 0.0)])) == pytest.approx([0.15])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sizing.Expression("x + lon"), "lon and lat, or x, y and z"),
        (lambda: earth.Caps([], 1e5, 1.1), "no regions"),
        (lambda: earth.Caps([((0, 95), 1e5, 1e5)], 1e5, 1.1), "latitude"),
        (lambda: earth.Caps([((0, 5), -1, 1e5)], 1e5, 1.1), "radius"),
        (lambda: earth.Caps([((0, 5), 1e5)], 1e5, 1.1), r"regions\[0\]"),
        (lambda: earth.Caps([((0, 5), 1e5, 1e5)], 1e5, 1.1, sphere=3), "expected a clvoro.Sphere"),
        (lambda: clvoro.adapt(EARTH, sizing.Distance(sizing.Circle((3, 100), 5), 1e5, 1.1)), r"position \(3, 100\)"),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(ClvoroError, match=message):
        call()


@pytest.mark.parametrize(
    "make",
    [
        lambda: sizing.Distance(sizing.Polyline([(-0.5, 0.7), (1.2, 0.2)]), h_min=1e5, growth=1.1),
        lambda: sizing.Distance(sizing.Circle((-0.5, 0.7), 0.1), h_min=1e5, growth=1.1),
        lambda: earth.Caps([((-0.785, 0.785), 3e6, 9e4)], 27e4, 1.1),
    ],
)
def test_radians_are_warned_of(make):
    with pytest.warns(MismatchWarning, match="look like radians"):
        on_domain(EARTH, make())


def test_whole_degrees_are_not_taken_for_radians():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        earth.Caps([((0, 0), 3e6, 9e4)], 27e4, 1.1)


def test_columns_of_one_longitude_that_differ_are_warned_of(recwarn):
    h = np.full((19, 37), 5e5)
    earth.LonLat(sizing.Raster(h, (-180, -90), (180, 90)))
    assert not recwarn
    h[9, -1] = 2e5
    with pytest.warns(MismatchWarning, match="longitudes -180 and 180, which are the same place: at latitude 0 5.*2"):
        earth.LonLat(sizing.Raster(h, (-180, -90), (180, 90)))
