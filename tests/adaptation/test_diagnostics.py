"""Warnings for mismatched units and positions, and none for correct input."""

import json
import math
import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import shapely

import clvoro
from clvoro import sizing
from clvoro.adaptation.diagnostics import warn_of_errors, warn_of_narrow_parts
from clvoro.cli import command as cli
from clvoro.errors import CoarseSizeWarning, MismatchWarning, SizeErrorWarning
from clvoro.geometry.boundary_layers import LayerRows

BOX = clvoro.Box((0, 0), (2, 1))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
SHORE = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)])


def near(shapes, **options):
    return sizing.Distance(shapes, **{"h_min": 0.05, "growth": 1.2, "h_max": 0.2, **options})


def body(scale, at=(0.4, 0.4, 0.4)):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)]) * scale + at
    return sizing.Surface(corners, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])


VALUES = np.full((9, 9), 0.1)
SPREAD = np.random.default_rng(3).random((50, 2))
FIELDS = {
    # name: (domain, the mistake, what it says, the right use beside it)
    "circle in millimeters": (
        BOX,
        near(sizing.Circle((900, 400), 200)),
        "change nothing",
        near(sizing.Circle((0.9, 0.4), 0.2)),
    ),
    "segment beside the domain": (
        BOX,
        near(sizing.Segment((0, 2), (2, 2))),
        "change nothing",
        near(sizing.Segment((0, 1.7), (2, 1.7))),
    ),
    "no upper bound, but far": (
        BOX,
        near(sizing.Circle((900, 400), 200), growth=1.0001, h_max=np.inf),
        "times its diagonal",
        near(sizing.Circle((9, 4), 2), growth=1.0001, h_max=np.inf),
    ),
    "circle all around": (BOX, near(sizing.Circle((1, 0.5), 9)), "change nothing", near(sizing.Circle((1, 0.5), 1.5))),
    "one shape of two": (
        BOX,
        near([sizing.Circle((900, 400), 200), sizing.Circle((800, 400), 2)]),
        "change nothing",
        near([sizing.Circle((900, 400), 200), sizing.Circle((0.9, 0.4), 0.2)]),
    ),
    "within others": (
        BOX,
        sizing.Graded(2 * sizing.minimum(near(sizing.Circle((900, 400), 200)), 0.1), growth=1.2),
        "change nothing",
        sizing.Graded(2 * sizing.minimum(near(sizing.Circle((0.9, 0.4), 0.2)), 0.1), growth=1.2),
    ),
    "part in millimeters": (CUBE, near(body(200, (400, 400, 400))), "change nothing", near(body(0.2))),
    "part in kilometers": (CUBE, near(body(2e-4)), "less than a cell", near(body(0.06))),
    "raster of another place": (
        BOX,
        sizing.Raster(VALUES, (-9, -9), (0.2, 0.9)),
        "covers 0.09 of",
        sizing.Raster(VALUES, (-9, -9), (1.2, 0.9)),
    ),
    "raster in millimeters": (
        BOX,
        sizing.Raster(VALUES, (0, 0), (2000, 1000)),
        "lies between two values",
        sizing.Raster(VALUES, (0, 0), (20, 10)),
    ),
    "raster that is meant so": (
        BOX,
        sizing.Raster(VALUES, (0, 0), (0.2, 0.1)),
        "covers 0.01 of",
        sizing.Raster(VALUES, (0, 0), (0.2, 0.1), outside="nearest"),
    ),
    "raster of a polygon": (
        SHORE,
        sizing.Raster(VALUES, (0, 0), (0.9, 1)),
        "covers 0.45 of",
        sizing.Raster(VALUES, (0, 0), (1.1, 1)),
    ),
    "few values": (
        BOX,
        sizing.Raster(VALUES, (0, 0), (0.2, 0.1)),
        "covers",
        sizing.Raster([[0.1, 0.2]], (0, 0), (2000, 1000)),
    ),
    "growth limited elsewhere": (
        BOX,
        sizing.Graded(0.2, growth=1.2, box=clvoro.Box((0, 0), (0.5, 1))),
        "covers 0.25 of",
        sizing.Graded(0.2, growth=1.2, box=clvoro.Box((0, 0), (1.5, 1))),
    ),
    "data in a corner": (
        BOX,
        sizing.Scattered(0.3 * SPREAD, SPREAD[:, 0] + 1, BOX.lower, BOX.upper),
        "Scattered of 50 points covers",
        sizing.Scattered(SPREAD * (2, 1), SPREAD[:, 0] + 1, BOX.lower, BOX.upper),
    ),
    "a profile": (
        BOX,
        sizing.Scattered(0.3 * SPREAD, SPREAD[:, 0] + 1),
        "covers",
        sizing.Scattered(
            np.column_stack([2 * SPREAD[:, 0], np.full(50, 0.5)]),
            SPREAD[:, 0] + 1,
            BOX.lower,
            BOX.upper,
            method="nearest",
        ),
    ),
    "features of another domain": (
        clvoro.Polygon([(5, 0), (6, 0), (6, 1)]),
        sizing.FeatureSize(SHORE),
        "does not overlap",
        sizing.FeatureSize(clvoro.Polygon([(5, 0), (6, 0), (6, 1)])),
    ),
}


@pytest.mark.parametrize("name", list(FIELDS))
def test_warnings_of_fields(name):
    domain, wrong, message, right = FIELDS[name]
    (found,) = wrong.warnings(domain)
    assert message in found
    assert right.warnings(domain) == []
    # What is said is so: the sizes are those of the whole field without the part in question.
    if "change nothing" in message and domain.dim == 2 and not isinstance(wrong, sizing.Graded):
        x = np.random.default_rng(5).uniform(domain.lower, domain.upper, (500, 2))
        assert np.ptp(wrong(x)) == 0 < np.ptp(right(x))


def test_far_shapes_are_detected_safely():
    """The distance is a lower bound: random shapes with an effect cause no warning."""
    rng = np.random.default_rng(11)
    said = 0
    for _ in range(300):
        corners = rng.uniform(-4, 4, (3, 2))
        shape = [sizing.Circle(corners[0], rng.uniform(0, 6)), sizing.Polyline(corners)][rng.integers(2)]
        field = near(shape, growth=rng.uniform(1.02, 2))
        x = np.concatenate([rng.uniform(BOX.lower, BOX.upper, (3000, 2)), [(0, 0), (2, 0), (2, 1), (0, 1)]])
        if field.warnings(BOX):
            said += 1
            assert (field(x) == field.h_max).all()
    assert 20 < said < 280


@pytest.mark.parametrize(
    ("layer", "size", "message"),
    [
        ({"height": 0.1, "count": 2}, 0.02, "sizes jump"),
        ({"height": 1e-5, "count": 3}, 0.2, "is the last layer's height"),
        ({"height": 0.01, "count": 9, "growth": 1.5, "spacing": 0.1}, 0.02, "wide and 0.256 high"),
        ({"height": 0.02, "count": 3}, 0.02, None),
        ({"height": 1e-5, "count": 3, "spacing": 0.02}, 0.02, None),
        ({"height": 1e-3, "count": 3}, 0.2, None),
        ({"height": 0.05, "spacing": 0.1, "count": 1}, 0.05, None),
    ],
)
@pytest.mark.parametrize("domain", [BOX, SHORE], ids=["box", "polygon"])
def test_warnings_of_layers(layer, size, message, domain):
    # The field is coarse far away: what counts is beside the layers.
    field = sizing.Distance(sizing.Segment((0, 0), (2, 0)), h_min=size, slope=0.05)
    edges = (2,) if domain is BOX else (0,)
    found = LayerRows(domain, [clvoro.Layers(**layer, edges=edges)]).mismatches(field)
    assert len(found) == (message is not None)
    assert message is None or message in found[0]


def test_runs_warn(ctx):
    adapter, options = clvoro.Adapter(ctx), {"method": "lloyd", "max_steps": 0}
    with pytest.warns(MismatchWarning, match="change nothing") as given:
        adapter.run(BOX, near(sizing.Circle((900, 400), 200)), **options)
    assert given[0].filename == __file__
    with pytest.warns(MismatchWarning, match="sizes jump"):
        adapter.run(BOX, 0.05, layers=clvoro.Layers(0.2, edges=[2]), **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        adapter.run(BOX, near(sizing.Circle((0.9, 0.4), 0.2)), **options)
        adapter.run(BOX, 0.1, layers=clvoro.Layers(0.05, edges=[2]), **options)


def lake(latitude, crs, east=8.0):
    ring = [[east, latitude], [east + 0.2, latitude], [east + 0.2, latitude + 0.1], [east, latitude]]
    named = {} if crs is None else {"crs": {"type": "name", "properties": {"name": crs}}}
    return {"type": "Polygon", "coordinates": [ring], **named}


@pytest.mark.parametrize(
    ("crs", "east"),
    [("urn:ogc:def:crs:OGC:1.3:CRS84", 8), ("EPSG:4326", 8), ("urn:ogc:def:crs:EPSG::4326", 8), (None, 8), (None, 238)],
)
def test_longitudes_and_latitudes(tmp_path, crs, east):
    path = tmp_path / "lake.geojson"
    path.write_text(json.dumps(lake(46.2, crs, east)))
    what = "coordinates like degrees" if crs is None else "longitudes and latitudes"
    with pytest.warns(MismatchWarning, match=rf"lake\.geojson has {what}.* 0\.69 times"):
        clvoro.Polygon.from_geojson(path)


@pytest.mark.parametrize(
    ("latitude", "crs"),
    [(0.2, None), (460.2, None), (46.2, "urn:ogc:def:crs:EPSG::25832"), (460.2, "EPSG:4326"), (3.0, "EPSG:4326")],
)
def test_no_warning_for_projected_coordinates(latitude, crs):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clvoro.Polygon.from_geojson(lake(latitude, crs))


RING = [(-70.5, 60.5), (-70.5, 61.5), (-69.0, 61.5), (-69.0, 60.5)]
PLAN = [(-70.5, 0.5), (-69.0, 0.5), (-69.0, 61.5), (-70.5, 61.5)]


@pytest.mark.parametrize(
    "make",
    [
        clvoro.Polygon,
        lambda ring: clvoro.Polygon.from_shapely(shapely.Polygon(ring)),
        lambda ring: clvoro.Polygon.from_wkt(shapely.Polygon(ring).wkt),
    ],
)
def test_degrees_are_warned_of_however_they_come(adapter, make):
    with pytest.warns(MismatchWarning, match="the domain has coordinates like degrees"):
        adapter.run(make(RING), 0.5, max_steps=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", MismatchWarning)
        make(RING)  # it may be an area on a sphere
        adapter.run(make(PLAN), 0.8, max_steps=0)


CASE = """[domain]
lower = [0, 0]
upper = [2, 1]
[size]
kind = "distance"
shapes = [{ kind = "circle", center = [CENTER], radius = 0.2 }]
h_min = 0.1
growth = 1.3
h_max = 0.3
[run]
effort = "fast"
"""


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("center", "said"), [("900, 400", True), ("0.9, 0.4", False)])
def test_the_command_line_warns(tmp_path, capfd, center, said):
    (tmp_path / "c.toml").write_text(CASE.replace("CENTER", center))
    code = cli.main(["run", str(tmp_path / "c.toml"), "--out", str(tmp_path / "out"), "--no-report", "--quiet"])
    errors = capfd.readouterr().err
    assert code == 0
    assert ("warning: the shapes of Distance" in errors) == said


JUMP = sizing.Expression("x < 0.95 ? 0.05 : 0.01")
"""Of a twentieth of a cell at the wall: the cells beside it ask for what no neighbor of theirs can be."""


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("size", "n_cells", "category", "advice"),
    [
        (0.8, None, SizeErrorWarning, "do not fill evenly: use smaller sizes, or n_cells"),
        (3.0, None, CoarseSizeWarning, "do h and the domain have the same unit"),
        (0.8, 2, None, None),
        (0.1, None, None, None),
    ],
)
def test_warnings_of_coarse_sizes(ctx, size, n_cells, category, advice):
    """Sizes do not grow there, so the message does not advise a bound of the growth."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        clvoro.Adapter(ctx).run(clvoro.Box((0, 0), (1, 1)), size, n_cells=n_cells, effort="fast")
    assert [w.category for w in caught] == ([] if category is None else [category])
    for w in caught:
        assert advice in str(w.message)
        assert "Graded" not in str(w.message)
        assert w.filename == __file__


@pytest.mark.parametrize(("growth", "advice"), [(0.0, "do not fill evenly"), (9.0, "sizing.Graded")])
def test_sizes_of_their_own_are_not_steep(growth, advice):
    """Cells at creases have sizes of their own: the field tells whether sizes grow."""
    diagram = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), np.random.default_rng(4).random((30, 2)))
    sizes, errors = np.full(30, 0.2), np.full(30, 0.01)
    worst = 3
    errors[worst] = 9.0
    sizes[int(diagram.neighbors[slice(*diagram.neighbor_starts[worst : worst + 2])].max())] = 0.05
    result = SimpleNamespace(
        diagram=diagram, target_size=sizes, size_error=errors, points=diagram.points, settings={}, size_factor=1.0
    )
    with pytest.warns(SizeErrorWarning, match=advice):
        warn_of_errors(result, lambda x: 0.2 + growth * x[:, 0])


def test_size_errors_in_polygons_have_a_remedy():
    """A small piece shall be left out, and a narrow part be filled."""
    pond, lake = [(2, 0), (2.12, 0), (2.12, 0.12), (2, 0.12)], [(0, 0), (1, 0), (1, 1), (0, 1)]
    both = clvoro.Polygon.from_pieces([[pond], [lake]])
    why = both.why_sizes_are_missed(np.array([2.05, 0.05]), 0.1, 100)
    assert "a piece of the domain that 1.4 cells would fill" in why
    assert "domain.split()[0]" in why
    assert "domain.simplified(size)" in both.why_sizes_are_missed(np.array([0.5, 0.5]), 0.1, 100)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "effort", "factor"), [("adaptive", "fast", 1), ("adaptive", "fast", 5), ("exact", "default", 1)]
)
def test_warning_of_size_errors(ctx, method, effort, factor):
    """The run ends, although the number of cells oscillates, and the warning has the worst cell."""
    square, adapter = clvoro.Box((0, 0), (1, 1)), clvoro.Adapter(ctx)
    given = {"method": method, "effort": effort, "seed": 1}
    if factor > 1:
        given["n_cells"] = len(adapter.run(square, JUMP, "fast", max_steps=0))
    advice = r"sizing.Graded\(size" if factor == 1 else r"sizing.Graded\((5|4\.9|5\.0)\d* \* size"
    with pytest.warns(SizeErrorWarning, match="mean .e. is .*" + advice) as told:
        result = adapter.run(square, JUMP / factor, **given)
    assert result.converged or factor > 1
    worst = np.abs(result.size_error).argmax()
    x, y = (float(v) for v in re.search(r"\(([^)]*)\)", str(told[0].message))[1].split(","))
    assert result.points[worst] == pytest.approx((x, y), rel=1e-5)
    assert told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error", SizeErrorWarning)
        adapter.run(square, sizing.Graded(JUMP, growth=1.2), method=method, effort=effort, seed=1)
        # No warning for unfinished runs, or for methods that do not promise to meet the sizes.
        adapter.run(square, JUMP, method=method, effort="fast", seed=1, callback=lambda row: row["step"] == 9)
        adapter.run(square, JUMP, method="lloyd", max_steps=2, seed=1)


# --- domains that are narrower than cells

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
STRAIT = [(0, 0), (1, 0), (1, 0.49), (2, 0.48), (2, 0), (3, 0), (3, 1), (2, 1), (2, 0.5), (1, 0.5), (1, 1), (0, 1)]


def bay(width, depth):
    """Return a square with a bay above."""
    return [*SQUARE[:3], (0.5 + width, 1), (0.5 + width, 1 + depth), (0.5, 1 + depth), (0.5, 1), (0, 1)]


ISLAND = [(0.01, 0.3), (0.3, 0.3), (0.3, 0.7), (0.02, 0.7)]
NARROW = {
    # name: (domain, h, width, a place on the line from - to); no place where nothing is narrow
    "strait": (clvoro.Polygon(STRAIT), 0.04, 0.01, ((1, 0.495), (1.05, 0.495))),
    "strait of wide cells": (clvoro.Polygon(STRAIT), 0.019, None, None),
    "island": (clvoro.Polygon(SQUARE, [ISLAND]), 0.05, 0.01, ((0.005, 0.3), (0.006, 0.35))),
    "islands": (
        clvoro.Polygon(SQUARE, [clvoro.curves.circle((0.3, 0.5), 0.1), clvoro.curves.circle((0.51, 0.5), 0.1)]),
        0.05,
        0.01,
        ((0.405, 0.49), (0.405, 0.51)),
    ),
    "needle": (clvoro.Polygon([(0, 0), (1, 0), (1, 0.01)]), 0.05, None, ((0.15, 0), (0.2, 0.002))),
    "corner of 30 degrees": (clvoro.Polygon([(0, 0), (1, 0), (1, math.tan(math.pi / 6))]), 0.02, None, None),
    "short bay": (
        clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0.52, 1), (0.52, 1.1), (0.5, 1.1), (0.5, 1), (0, 1)]),
        0.1,
        None,
        None,
    ),
    "bay of depth 1.5": (clvoro.Polygon(bay(0.08, 0.15)), 0.1, None, None),
    "wide bay": (clvoro.Polygon(bay(0.12, 0.5)), 0.1, None, None),
    "thin hole": (clvoro.Polygon(SQUARE, [[(0.3, 0.5), (0.7, 0.499), (0.7, 0.501)]]), 0.1, None, None),
    "square": (clvoro.Polygon(SQUARE), 0.1, None, None),
    "box": (clvoro.Box((0, 0), (8, 0.1)), 0.4, 0.1, ((4, 0.05), (4, 0.05))),
    "periodic box": (clvoro.Box((0, 0), (8, 0.1), periodic=(False, True)), 0.4, None, None),
    "box in 3D": (clvoro.Box((0, 0, 0), (2, 2, 0.1)), 0.3, 0.1, ((1, 1, 0.05), (1, 1, 0.05))),
}


@pytest.mark.parametrize(("domain", "h", "width", "line"), NARROW.values(), ids=NARROW)
def test_narrow_parts(domain, h, width, line):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_narrow_parts(domain, lambda x: np.full(len(x), h))
    if line is None:
        assert not caught
        return
    (message,) = [str(w.message) for w in caught]
    found, place = re.search(r"half a cell: (\S+) wide at \((.*)\), where the size field is ", message).groups()
    assert width is None or float(found) == pytest.approx(width, rel=0.06)
    place = np.array(place.split(", "), float)
    low, high = np.array(line)
    slack = 0.01 if isinstance(domain, clvoro.Polygon) else 1e-9
    assert (place >= low - slack).all()
    assert (place <= high + slack).all()


@pytest.mark.parametrize(
    ("domain", "width"),
    [(clvoro.Polygon(bay(0.07, 0.3)), 0.07), (clvoro.Polygon([(0, 0), (1, 0), (1, math.tan(math.radians(20)))]), None)],
    ids=["bay", "corner of 20 degrees"],
)
def test_dead_ends(domain, width):
    with pytest.warns(MismatchWarning, match=r"dead end .*simplified") as caught:
        warn_of_narrow_parts(domain, lambda x: np.full(len(x), 0.1))
    (message,) = [str(w.message) for w in caught]
    found, place = re.search(r"a cell: (\S+) wide at \((.*)\), where", message).groups()
    assert width is None or float(found) == pytest.approx(width, rel=0.01)
    assert domain.contains(np.array([place.split(", ")], float))
    warn_of_narrow_parts(domain.simplified(0.1), lambda x: np.full(len(x), 0.1))  # no warning


def test_narrow_parts_are_those_of_the_size_field():
    domain = clvoro.Polygon(STRAIT)
    size = near(sizing.Segment((1, 0.5), (2, 0.5)), h_min=0.005, growth=1.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_narrow_parts(domain, size)
        clvoro.adapt(BOX, 9.0, "fast", n_cells=20)  # scaled
    with pytest.warns(MismatchWarning, match=r"0.01\d* wide at \(1.0"):
        clvoro.adapt(domain, 0.1, "fast")
