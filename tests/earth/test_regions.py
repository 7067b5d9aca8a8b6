"""Cells of oceans and limited areas: land in longitudes and latitudes, lines, lakes, rings of neighbors."""

import json
import warnings
from itertools import pairwise

import numpy as np
import pytest
import shapely
from scipy.sparse.csgraph import connected_components, shortest_path

import clvoro
from clvoro import earth
from clvoro.earth.regions import narrow_cells, widen_straits
from clvoro.errors import InputError, InputTypeError, MismatchWarning
from tests.reference.spheres import grid_of_rings, random_points

EARTH = clvoro.Sphere()
BLOB = np.array([(-20, -35), (15, -50), (40, -10), (55, 20), (30, 12), (10, 45), (-35, 30), (-5, 0)])


@pytest.fixture(scope="module")
def globe(ctx):
    return clvoro.Adapter(ctx).diagram(EARTH, random_points(3000, 5))


@pytest.fixture(scope="module")
def lonlat(globe):
    return EARTH.lonlat(globe.points)


def by_rays(ring, points):
    """Which points are inside a ring in the plane: an odd number of edges lie to the north."""
    found = np.zeros(len(points), bool)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        there = (x0 <= x) != (x1 <= x)
        with np.errstate(all="ignore"):
            found ^= there & (y0 + (x - x0) / (x1 - x0) * (y1 - y0) > y)
    return found


def turned(ring, by):
    """The ring further east, with longitudes in [-180, 180)."""
    return np.column_stack([np.mod(ring[:, 0] + by + 180, 360) - 180, ring[:, 1]])


def moved(ring, east):
    return ring + np.array([east, 0.0])


def box(west, south, east, north):
    return np.array([(west, south), (east, south), (east, north), (west, north)], float)


# --- inside ---


@pytest.mark.parametrize("by", [0, 100, 140, 180, -150])
@pytest.mark.parametrize("order", [1, -1])
def test_rings_cross_the_date_line(globe, lonlat, by, order):
    """The reference turns the points back, into the plane."""
    expected = by_rays(BLOB, turned(lonlat, -by))
    assert 200 < expected.sum() < 600
    ring = turned(BLOB, by)[::order]
    found = earth.inside(globe, shapely.Polygon(ring))
    assert np.array_equal(found, expected)
    continuous = moved(BLOB[::order], by)
    assert np.array_equal(earth.inside(globe, clvoro.Polygon(continuous)), expected)


def test_positions_may_be_on_both_sides_of_the_date_line(globe, lonlat):
    ring = [(170, -30), (180, -30), (-180, -30), (-160, -30), (-160, 20), (-180, 25), (180, 25)]
    expected = by_rays(np.array([(170, -30), (200, -30), (200, 20), (180, 25)]), moved(turned(lonlat, 180), 180))
    assert expected.sum() > 50
    assert np.array_equal(earth.inside(globe, shapely.Polygon(ring)), expected)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("pole", [1, -1])
def test_rings_around_a_pole(globe, lonlat, pole, order):
    lon = np.arange(-175, 180, 10.0)
    ring = np.column_stack([lon, pole * (60 + 10 * np.sin(np.radians(3 * lon)))])[::order]
    edge = np.interp(
        lonlat[:, 0], [*(lon - 360), *lon, *(lon + 360)], np.tile(60 + 10 * np.sin(np.radians(3 * lon)), 3)
    )
    expected = pole * lonlat[:, 1] > edge
    assert np.array_equal(earth.inside(globe, shapely.Polygon(ring)), expected)
    # Closed along the pole, as in most files, and then also across the equator.
    lon = lon[::order]
    for height in (60, -20):
        wavy = pole * (height + 10 * np.sin(np.radians(3 * np.arange(-180, 181, 10))))
        closed = [*np.column_stack([np.arange(-180.0, 181, 10), wavy]), (180, 90 * pole), (-180, 90 * pole)]
        inside = pole * lonlat[:, 1] > pole * np.interp(lonlat[:, 0], np.arange(-180, 181, 10), wavy)
        assert np.array_equal(earth.inside(globe, shapely.Polygon(closed[::order])), inside)


def test_boxes_of_whole_parallels(globe, lonlat):
    found = earth.inside(globe, shapely.box(-180, -30, 180, 90))
    assert np.array_equal(found, lonlat[:, 1] >= -30)
    assert earth.inside(globe, shapely.box(-180, -90, 180, 90)).all()
    assert earth.inside(globe, shapely.box(0, -90, 360, 90)).all()


def test_poles_are_inside_or_in_holes(ctx):
    globe = clvoro.Adapter(ctx).diagram(EARTH, grid_of_rings())
    lat = EARTH.lonlat(globe.points)[:, 1]
    lon = np.arange(0.0, 360, 30)
    cap, hole = (np.column_stack([lon, np.full(12, y)]) for y in (45.0, 75.0))
    assert np.array_equal(earth.inside(globe, shapely.Polygon(cap)), lat > 45)
    # Holes may begin at another longitude.
    ring = shapely.Polygon(cap, [np.roll(hole[::-1], 5, axis=0)])
    assert np.array_equal(earth.inside(globe, ring), (lat > 45) & (lat < 75))
    assert np.array_equal(earth.inside(globe, shapely.Polygon(-cap)), lat < -45)


def test_all_kinds_of_land_are_the_same(globe, lonlat, tmp_path):
    hole, other = box(0, -10, 12, 3), box(100, 40, 130, 60)
    shape = shapely.MultiPolygon([(BLOB, [hole]), (other, [])])
    expected = (by_rays(BLOB, lonlat) & ~by_rays(hole, lonlat)) | by_rays(other, lonlat)
    geojson = {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(shape)}
    path = tmp_path / "land.geojson"
    path.write_text(
        json.dumps(
            {
                "type": "FeatureCollection",
                "features": [geojson],
                "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
            }
        )
    )
    lands = [
        shape,
        clvoro.Polygon.from_shapely(shape),
        geojson,
        path,
        str(path),
        path.read_text(),
        expected,
        expected.tolist(),
        lambda x: expected[shapely.STRtree(shapely.points(lonlat)).nearest(shapely.points(x))],
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for land in lands:
            assert np.array_equal(earth.inside(globe, land), expected)


# --- lines ---


@pytest.mark.sparse(1)
@pytest.mark.parametrize("line", [[(-30, -20), (50, 40), (20, 70)], [(150, 10), (-160, -35)]], ids=str)
def test_lines_cross_the_cells_of_their_points(globe, line):
    """The cells that hold 400,000 points of the line; which cell that is, SciPy's tree says."""
    x = np.array(line, float)
    x[:, 0] = np.unwrap(x[:, 0], period=360)
    shares = np.linspace(0, 1, 400_001 // (len(x) - 1))
    places = np.concatenate([a + shares[:, None] * (b - a) for a, b in pairwise(x)])
    expected = np.unique(globe.locate(EARTH.positions(places)))
    found = np.flatnonzero(earth.crossed(globe, line))
    assert np.array_equal(found, expected)
    assert connected_components(globe.adjacency[found][:, found])[0] == 1


def test_all_kinds_of_lines_are_the_same(globe, tmp_path):
    one, two = [(-30, -20), (50, 40)], [(100, 0), (140, 0), (140, 20)]
    expected = earth.crossed(globe, one) | earth.crossed(globe, np.array(two))
    shape = shapely.MultiLineString([one, two])
    path = tmp_path / "lines.geojson"
    path.write_text(json.dumps(shapely.geometry.mapping(shape)))
    lines = [shapely.LineString(one), shapely.LineString(two)]
    collection = {
        "type": "FeatureCollection",
        "features": [{"type": "Feature", "geometry": shapely.geometry.mapping(line)} for line in lines],
    }
    for given in (shape, path, [one, two], [np.array(one), two], lines, collection):
        assert np.array_equal(earth.crossed(globe, given), expected)


def test_lines_through_vertices_are_a_cell_wide(ctx):
    """Cells of longitudes and latitudes: on a diagonal they touch in vertices only."""
    globe = clvoro.Adapter(ctx).diagram(EARTH, grid_of_rings())
    for line in ([(-40, -20), (0, 20)], [(-35, -25), (35, 45)], [(-45, 5), (45, 5)], [(5, -80), (5, 80)]):
        found = np.flatnonzero(earth.crossed(globe, line))
        assert len(found) > 5
        assert connected_components(globe.adjacency[found][:, found])[0] == 1


def test_short_and_polar_lines(globe):
    place = EARTH.lonlat(globe.points[7:8])[0]
    assert np.flatnonzero(earth.crossed(globe, [place, place + 1e-9])).tolist() == [7]
    assert np.flatnonzero(earth.crossed(globe, [place, place])).tolist() == [7]
    over = earth.crossed(globe, [(20, 80), (20, 90), (200, 90), (200, 80)])
    assert connected_components(globe.adjacency[over][:, over])[0] == 1


# --- oceans ---


def parts_of(globe, kept):
    return connected_components(globe.adjacency[kept][:, kept])[0]


RING = shapely.Polygon(box(-60, -40, 60, 40), [box(-30, -20, 30, 20)])
"""Land around a lake."""


def test_lakes_are_removed(globe, lonlat):
    outside, lake = ~by_rays(box(-60, -40, 60, 40), lonlat), by_rays(box(-30, -20, 30, 20), lonlat)
    assert np.array_equal(earth.ocean(globe, RING), outside)
    assert np.array_equal(earth.ocean(globe, RING, least_cells=5), outside | lake)
    assert np.array_equal(earth.ocean(globe, RING, least_cells=int(lake.sum()) + 1), outside)
    assert parts_of(globe, outside | lake) == 2


def test_the_largest_part_is_that_with_the_largest_area(ctx):
    """Many small cells in the lake, few in the ocean."""
    rng = np.random.default_rng(3)
    fine = EARTH.positions(np.column_stack([rng.uniform(-35, 35, 2000), rng.uniform(-25, 25, 2000)]))
    points = np.concatenate([fine, random_points(600, 4) * EARTH.radius])
    globe = clvoro.Adapter(ctx).diagram(EARTH, points)
    kept = earth.ocean(globe, RING)
    assert kept.sum() < 700
    assert EARTH.lonlat(globe.points[kept])[:, 0].min() < -150


def test_passages_stay_open_and_blockages_close_them(globe):
    strait, wall = [(0, 0), (0, 60)], [(-50, 30), (50, 30)]
    kept = earth.ocean(globe, RING, passages=strait)
    crossed = earth.crossed(globe, strait)
    assert np.array_equal(kept, earth.ocean(globe, RING, least_cells=5) | crossed)
    assert parts_of(globe, kept) == 1
    globe.subset(kept).check().demand()
    # A channel that is open is closed by a line; a passage has precedence.
    channel = RING.difference(shapely.box(-8, 0, 8, 50))
    lake = np.flatnonzero(earth.crossed(globe, [(0, 0), (10, 0)]))
    assert earth.ocean(globe, channel)[lake].all()
    closed = earth.ocean(globe, channel, blockages=wall)
    assert not closed[lake].any()
    assert not closed[earth.crossed(globe, wall)].any()
    assert earth.ocean(globe, channel, blockages=wall, passages=strait)[lake].all()


def slow_narrow(globe, water):
    """Water cells whose neighbors in the water are not connected with each other around the cell."""
    graph, found = globe.adjacency.tocsr(), np.zeros(len(globe), bool)
    beside = [set(row.tolist()) for row in np.split(graph.indices, graph.indptr[1:-1])]
    for i in np.flatnonzero(water):
        rest = {j for j in beside[i] if water[j]}
        reached = {rest.pop()} if rest else set()
        while more := {j for j in rest if beside[j] & reached}:
            reached |= more
            rest -= more
        found[i] = bool(rest)
    return found


def land_and_water(globe, water):
    return parts_of(globe, water), parts_of(globe, ~water)


# Two straits into the lake, each a cell wide, beside which a passage crosses an isthmus of land.
STRAITS = [[(0, 0), (0, 60)], [(0, 0), (90, 5)]]


def test_straits_are_widened(globe):
    kept = earth.ocean(globe, RING, passages=STRAITS)
    assert np.array_equal(narrow_cells(globe, kept), slow_narrow(globe, kept))
    assert slow_narrow(globe, kept).sum() > 10
    wide = earth.ocean(globe, RING, passages=STRAITS, straits="widen")
    assert not slow_narrow(globe, wide).any()
    assert wide[kept].all()
    # Not more than a row of cells beside each strait.
    assert (wide & ~kept).sum() < 2 * slow_narrow(globe, kept).sum()
    assert land_and_water(globe, wide) == land_and_water(globe, kept) == (1, 2)
    globe.subset(wide).check().demand()


@pytest.mark.parametrize("seed", [11, 12])
def test_widening_keeps_land_bridges_and_islands(globe, seed):
    """Scattered land, where many straits and isthmuses are a cell wide."""
    rng = np.random.default_rng(seed)
    x = globe.points / EARTH.radius
    water = sum(np.sin(rng.uniform(2, 9) * x @ v) for v in rng.standard_normal((6, 3))) < 1
    fixed = rng.random(len(globe)) < 0.1
    wide, left = widen_straits(globe, water, fixed)
    assert wide[water].all()
    assert not (wide & fixed & ~water).any()
    assert land_and_water(globe, wide) == land_and_water(globe, water)
    assert np.array_equal(np.flatnonzero(slow_narrow(globe, wide)), left)
    assert len(left) < slow_narrow(globe, water).sum() / 2


def test_straits_between_blockages_stay(globe):
    """Land on both sides of a passage has to stay."""
    beside = [[(-6, 12), (-6, 45)], [(6, 12), (6, 45)], [(-1, 50), (-14, 50)]]
    with pytest.warns(MismatchWarning, match=r"remain one cell wide.*first one is at longitude [-\d]"):
        kept = earth.ocean(globe, RING, passages=STRAITS[:1], blockages=[*beside, [(0, 12), (0, 45)]], straits="widen")
    blocked = earth.crossed(globe, beside) & ~earth.crossed(globe, STRAITS[:1])
    assert not kept[blocked].any()
    with pytest.raises(InputError, match="straits is 'wide', expected"):
        earth.ocean(globe, RING, straits="wide")


def test_a_passage_into_a_lake_is_warned_of(globe):
    with pytest.warns(MismatchWarning, match=r"passages\[0\] leads to water that is not connected"):
        kept = earth.ocean(globe, RING, passages=[(0, 0), (0, 30)])
    assert np.array_equal(kept, earth.ocean(globe, RING))


def test_rings_of_neighbors(globe):
    keep = earth.inside(globe, shapely.Polygon(BLOB))
    ring = earth.rings(globe, keep, 4)
    steps = shortest_path(globe.adjacency, unweighted=True, indices=np.flatnonzero(keep)).min(axis=0)
    assert np.array_equal(ring, np.where(steps <= 4, steps, -1))
    assert earth.rings(globe, keep).max() == 7
    # In a part of the mesh there are no rings beyond its boundary.
    part = globe.subset(ring >= 0, "open")
    assert np.array_equal(earth.rings(part, keep[ring >= 0], 9), ring[ring >= 0])


def test_parts_have_parts(globe):
    ocean = globe.subset(earth.ocean(globe, RING))
    kept = earth.ocean(ocean, shapely.Polygon(moved(BLOB, 150)))
    both = earth.ocean(globe, shapely.union_all([RING, shapely.Polygon(moved(BLOB, 150))]))
    assert np.array_equal(ocean.subset(kept).points[:, 0], globe.points[both, 0])
    with pytest.raises(InputError, match=r"lines\[0\] crosses no cell of the mesh: it is outside"):
        earth.crossed(ocean, [(0, -30), (0, 30)])
    assert earth.crossed(ocean, [(0, 30), (0, 60)]).any()


# --- errors ---


@pytest.mark.parametrize(
    ("land", "kind", "message"),
    [
        (np.ones(2999, bool), InputError, r"land has shape \(2999,\), expected \(3000,\)"),
        (lambda x: x[:, 0], InputTypeError, "land returned an array of shape .* expected"),
        (shapely.box(0, 0, 10, 91), InputError, r"land has the position \(10, 0\)|land has the position \(10, 91\)|91"),
        (shapely.Polygon([(-40, 100), (20, 120), (0, 170)]), InputError, "in the order latitude, longitude"),
        (shapely.box(0, 0, 1000, 10), InputError, r"the position \(1000, 0\)"),
        (7, InputTypeError, "land is a int, expected a clvoro.Polygon"),
        ("no_such_file.geojson", InputError, "cannot read no_such_file.geojson"),
        (shapely.Polygon([(k * 100, 50 + k) for k in range(7)]), InputError, "around the globe|times|position"),
        (None, InputTypeError, "land is a NoneType"),
    ],
    ids=lambda x: None,
)
def test_wrong_land_is_refused(globe, land, kind, message):
    with pytest.raises(kind, match=message):
        earth.ocean(globe, land)


@pytest.mark.parametrize(
    ("lines", "kind", "message"),
    [
        ([(0, 0), (0, 95)], InputError, r"passages\[0\] has the position \(0, 95\)"),
        ([[(0, 0), (5, 5)], [(0, 0)]], InputError, r"passages\[1\] has 1 position"),
        ([(0, np.nan), (0, 5)], InputError, "passages has the vertex"),
        ([], InputTypeError, r"passages has \[\], expected points"),
        (3, InputTypeError, "passages has 3"),
        (shapely.Point(0, 0), InputTypeError, "passages has a Point"),
        ({"type": "Polygon", "coordinates": []}, InputError, "passages is empty"),
    ],
)
def test_wrong_lines_are_refused(globe, lines, kind, message):
    with pytest.raises(kind, match=message):
        earth.ocean(globe, RING, passages=lines)


def test_radians_are_warned_of(globe):
    with pytest.warns(MismatchWarning, match="area has .* look like radians"):
        earth.inside(globe, shapely.Polygon(np.radians(BLOB)))
    with pytest.warns(MismatchWarning, match="lines has .* look like radians"):
        earth.crossed(globe, np.radians([(0, 0), (100, 30)]))


def test_other_wrong_arguments_are_refused(ctx, globe):
    with pytest.raises(InputError, match="least_cells is 4000, and the largest part"):
        earth.ocean(globe, RING, least_cells=4000)
    with pytest.raises(InputTypeError, match="least_cells"):
        earth.ocean(globe, RING, least_cells=2.5)
    with pytest.raises(InputTypeError, match="mesh is a Sphere"):
        earth.inside(EARTH, RING)
    plane = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0), (1, 1)), [(0.5, 0.5)])
    with pytest.raises(InputError, match=r"regions are for meshes on a clvoro\.Sphere"):
        earth.inside(plane, RING)
    with pytest.raises(InputError, match="keep selects no cell"):
        earth.rings(globe, np.zeros(3000, bool))
    with pytest.raises(InputError, match="count is -1"):
        earth.rings(globe, np.ones(3000, bool), -1)
