"""Remedies in messages: what to write in place of what a newcomer tried, with coordinates of maps."""

import re
import warnings

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.arguments import format_point
from clvoro.cli.cases import Case
from clvoro.errors import ClvoroError, SizeErrorWarning
from clvoro.geometry.surface import Surface

BOX = clvoro.Box((0, 0), (1, 1))
RING = [(0, 0), (1, 0), (1, 1), (0, 1)]
EAST, NORTH = 500_000, 5_400_000  # of a national grid, meters


@pytest.fixture(scope="module")
def mesh(ctx):
    points = np.random.default_rng(5).random((30, 2))
    return clvoro.Adapter(ctx).run(BOX, 0.2, points=points, method="lloyd", max_steps=0)


@pytest.mark.parametrize(
    ("call", "remedy"),
    [
        (lambda a: a.run(RING, 0.1), "clvoro.Polygon(domain)"),
        (lambda a: a.run(np.array(RING), 0.1), "clvoro.Polygon(domain)"),
        (lambda a: a.run("lake.geojson", 0.1), "clvoro.Polygon.from_geojson(domain)"),
        (lambda a: a.run("part.stl", 0.1), "clvoro.Solid.read(domain)"),
        (lambda a: a.run(BOX, 0.1, np.array(RING)), "the effort third"),
        (lambda a: a.run(BOX, 0.1, method=np.array(RING)), "expected one of adaptive"),
        (lambda _: sizing.gradient_size(np.arange(30)), "gradient_size(values, on=mesh)"),
        (lambda a: sizing.Region(0.1, RING), "such as Region("),
        (lambda a: sizing.Distance([(0, 1)], 0.1, 1.2), "Circle(p, radius=0) for a point p"),
        (lambda a: sizing.Distance(np.array(RING), 0.1, 1.2), "Polyline(points) for a line"),
        (lambda a: a.run(BOX, sizing.Raster(-9999 * np.ones((2, 2)), (0, 0), (1, 1))), "make it NaN"),
        (lambda a: sizing.Expression("x % 2"), "fmod(a, b)"),
    ],
)
def test_mistakes_and_remedies(ctx, call, remedy: str) -> None:
    with pytest.raises(ClvoroError, match=re.escape(remedy)):
        call(clvoro.Adapter(ctx))


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("a.png", "mesh.plot().savefig(path)"),
        ("a.shp", "geopandas.GeoDataFrame(geometry=mesh.to_shapely()"),
        ("a.foo", "QGIS"),
    ],
)
def test_suffixes_of_other_files(mesh, tmp_path, name: str, remedy: str) -> None:
    with pytest.raises(ClvoroError, match=re.escape(remedy)):
        mesh.save(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_shapefiles(tmp_path) -> None:
    path = tmp_path / "lake.shp"
    path.write_bytes(b"\x00\x00\x27\x0a\xff\xfe")
    with pytest.raises(ClvoroError, match=r"geopandas\.read_file\(path\)\.union_all"):
        clvoro.Polygon.from_geojson(path)
    with pytest.raises(ClvoroError, match=r"expected GeoJSON$"):
        clvoro.Polygon.from_geojson(tmp_path / "lake.json")
    with pytest.raises(ClvoroError, match=r"wells\.csv is a \.csv file, expected GeoJSON; pass points as an array"):
        clvoro.adapt(clvoro.Box((0, 0), (1, 1)), 0.5, fixed="wells.csv")
    with pytest.raises(ClvoroError, match=r"a file is read first, as by rasterio\.open"):
        clvoro.sizing.Raster("dem.tif", (0, 0), (1, 1))


def test_arrays_of_the_diagram(mesh) -> None:
    assert len(mesh) == len(mesh.diagram) == 30
    for name in ("volumes", "domain", "faces", "neighbors"):
        assert getattr(mesh, name) is getattr(mesh.diagram, name)
    assert mesh.locate([(0.5, 0.5)]) == mesh.diagram.locate([(0.5, 0.5)])
    with pytest.raises(AttributeError, match=r"a Result has no 'areas'$"):
        _ = mesh.areas


def test_coordinates_of_maps() -> None:
    """Six digits of 5,400,000 m are ten meters."""
    assert format_point((0.123456789, -2e-9)) == "(0.123457, -2e-09)"
    assert format_point((EAST, NORTH + 1234.56)) == "(500000, 5401234.6)"
    assert format_point((-99_999.96, 1e12)) == "(-100000, 1e+12)"
    assert format_point((-70.5, 42.25), "°") == "(-70.5°, 42.25°)"
    ring = np.add([(0, 0), (3000, 0), (3000, 2123), (0, 2000)], (EAST, NORTH))
    assert "within (500000, 5400000) and (503000, 5402123)" in repr(clvoro.Polygon(ring))
    crossed = ring[[0, 2, 1, 3]]
    with pytest.raises(ClvoroError, match=r"Self-intersection at \(50\d{4}\.\d, 540\d{4}\.\d\)"):
        clvoro.Polygon(crossed)
    corners = np.add([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], (EAST, NORTH, 0))
    with pytest.raises(ClvoroError, match="5400001"):
        Surface(corners, [(0, 1, 2), (0, 1, 3), (0, 2, 3)]).require_closed()


@pytest.mark.slow
def test_shapes_at_a_seam_are_to_be_repeated(ctx) -> None:
    torus, adapter = clvoro.Box((0, 0), (1, 1), periodic=True), clvoro.Adapter(ctx)
    spots = [sizing.Circle((0.05 + k, 0.5), radius=0.02) for k in (0, -1, 1)]
    with pytest.warns(SizeErrorWarning, match="repeat its shapes one period away"):
        adapter.run(torus, sizing.Distance(spots[0], h_min=0.03, growth=1.2), effort="fast")
    with warnings.catch_warnings():
        warnings.simplefilter("error", SizeErrorWarning)
        adapter.run(torus, sizing.Distance(spots, h_min=0.03, growth=1.2), effort="fast")


def test_an_effort_for_a_method_is_recognized(ctx):
    with pytest.raises(ClvoroError, match="method is 'fast', which is an effort; write effort='fast'"):
        clvoro.Adapter(ctx).run(BOX, 0.1, method="fast")
    with pytest.raises(
        ClvoroError, match=r"run\.method is 'best' \(it is an effort: write effort = 'best', or --effort best\)"
    ):
        Case.from_toml("size = 1\n[domain]\nlower = [0, 0]\nupper = [1, 1]\n[run]\nmethod = 'best'\n", "a")
    with pytest.raises(ClvoroError, match="Ball radius is -1"):
        sizing.Ball((0, 0, 0), -1)
