"""Transfer between meshes of different domains: values and covered shares, against exact areas and constants."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import InputError, MismatchWarning

RNG = np.random.default_rng(5)
LAKE = clvoro.Polygon([(0.2, 0.1), (1.8, 0.15), (1.9, 0.8), (0.9, 0.95)])


def in_box(adapter, lower, upper, count, periodic=False):
    domain = clvoro.Box(lower, upper, periodic=periodic)
    return adapter.diagram(domain, RNG.uniform(lower, upper, (count, len(lower))))


@pytest.fixture(scope="module")
def pairs(ctx):
    """Pairs of meshes, each with the measure of their common part."""
    adapter = clvoro.Adapter(ctx)
    earth = clvoro.Sphere()
    globe, fine = (adapter.diagram(earth, earth.icosahedral_points(k)) for k in (2, 3))
    north, east = (g.subset(g.points[:, axis] > 0) for g, axis in ((globe, 2), (fine, 1)))
    grid = in_box(adapter, (0, 0), (2, 1), 60)
    points = RNG.uniform(0, 2, (400, 2))
    lake = adapter.diagram(LAKE, points[LAKE.contains(points)])
    rough, whole = (in_box(adapter, (0, 0, 0), (1, 1, 1), n) for n in (80, 50))
    part = in_box(adapter, (0.2, 0.3, 0.1), (1.4, 0.9, 0.8), 70)
    ring, tile = (in_box(adapter, (0, 0), (1, 1), n, True) for n in (40, 30))
    column, tube = (in_box(adapter, (0, 0, 0), (1, 1, 2), n, (True, True, False)) for n in (60, 50))
    shell = whole.subset(np.linalg.norm(whole.points - 0.5, axis=1) > 0.3)
    slabs = in_box(adapter, (0, 0, 0), (1, 1, 1), 800)
    slabs = slabs.subset(np.abs(slabs.points[:, 2] - 0.5) > 0.2)
    drop = in_box(adapter, (0.6, 0.7, 0.1), (1.4, 1.2, 0.8), 30)
    strips = in_box(adapter, (0, 0), (1, 1), 400)
    strips = strips.subset(np.abs(strips.points[:, 1] - 0.5) > 0.1)
    return {
        "globe to its part": (globe, north, north.volumes.sum()),
        "part of a globe to the globe": (north, globe, north.volumes.sum()),
        "parts of a globe": (north, east, None),
        "box to lake": (grid, lake, LAKE.measure),
        "lake to box": (lake, grid, LAKE.measure),
        "lake to periodic box": (lake, ring, 1.0),
        "periodic box to box": (ring, in_box(adapter, (0.2, 0), (0.9, 1), 20), 0.7),
        "periodic boxes": (ring, tile, 1.0),
        "boxes in 3D": (rough, part, 0.8 * 0.6 * 0.7),
        "part of a box in 3D": (shell, rough, shell.volumes.sum()),
        "periodic boxes in 3D": (column, tube, 2.0),
        "periodic box to box in 3D": (column, drop, 0.8 * 0.5 * 0.7),
        "box to periodic box in 3D": (drop, column, 0.8 * 0.5 * 0.7),
        "parts that lie apart in 3D": (slabs, in_box(adapter, (0, 0, 0), (1, 1, 1), 9), slabs.volumes.sum()),
        "parts that lie apart": (strips, in_box(adapter, (0, 0), (1, 1), 7), strips.volumes.sum()),
    }


KINDS = (
    "globe to its part",
    "part of a globe to the globe",
    "parts of a globe",
    "box to lake",
    "lake to box",
    "periodic box to box",
    "periodic boxes",
    "boxes in 3D",
    "part of a box in 3D",
    "periodic boxes in 3D",
    "periodic box to box in 3D",
    "box to periodic box in 3D",
    "parts that lie apart in 3D",
    "parts that lie apart",
)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_constants_stay_and_the_covered_shares_are_right(pairs, kind, order):
    old, new, common = pairs[kind]
    values = np.column_stack([np.full(len(old), 3.0), RNG.random(len(old))])
    got, share = old.transfer(values, new, order, covered=True)
    seen = share > 0
    assert np.array_equal(np.isnan(got).any(axis=1), ~seen)
    assert got[seen, 0] == pytest.approx(3.0, rel=1e-12)
    assert got[seen, 1].min() >= values[:, 1].min()
    assert got[seen, 1].max() <= values[:, 1].max()
    assert share.max() <= 1
    if common is not None:
        assert (share * new.volumes).sum() == pytest.approx(common, rel=1e-9)
    if common is not None and old.volumes.sum() == pytest.approx(common, rel=1e-12):  # the new mesh covers the old one
        mass = np.nansum(got[:, 1] * share * new.volumes)
        assert mass == pytest.approx((values[:, 1] * old.volumes).sum(), rel=1e-9 if order == 1 else 0.02)


def test_means_are_those_of_the_intersections(pairs):
    old, new, _ = pairs["lake to box"]
    values = RNG.random(len(old))
    got, share = old.transfer(values, new, covered=True)
    a, b = old.to_shapely(), new.to_shapely()
    areas = np.array([shapely.area(shapely.intersection(cell, a)) for cell in b])
    assert share == pytest.approx(areas.sum(axis=1) / new.volumes, abs=1e-12)
    seen = share > 0
    assert got[seen] == pytest.approx((areas @ values)[seen] / areas.sum(axis=1)[seen], rel=1e-12)


def test_values_of_an_ocean_are_those_of_its_globe(pairs):
    globe, north, _ = pairs["globe to its part"]
    values = RNG.random(len(globe))
    assert globe.transfer(values, north) == pytest.approx(values[globe.points[:, 2] > 0], rel=1e-12)


def test_what_is_not_covered_is_said(pairs, ctx):
    old, new, _ = pairs["lake to box"]
    with pytest.warns(MismatchWarning, match="covered=True"):
        old.transfer(np.ones(len(old)), new)
    adapter = clvoro.Adapter(ctx)
    others = {
        "one space": in_box(adapter, (0, 0, 0), (1, 1, 1), 20),
        "one period": in_box(adapter, (0, 0), (2, 1), 20, True),
    }
    with pytest.raises(InputError, match="one space"):
        old.transfer(np.ones(len(old)), others["one space"])
    with pytest.raises(InputError, match="one period"):
        pairs["periodic boxes"][0].transfer(np.ones(40), others["one period"])
    globe, earth = pairs["globe to its part"][0], clvoro.Sphere(2.0)
    other = adapter.diagram(earth, earth.icosahedral_points(3))
    with pytest.raises(InputError, match="one radius"):
        globe.transfer(np.ones(len(globe)), other)


def test_parts_of_a_polygon():
    """The second part lies in the first one."""
    rng, bay = np.random.default_rng(5), clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 0.7), (0, 1)])
    whole, other = (clvoro.voronoi(bay, bay.nearest(rng.random((150, 2)) * (1.9, 0.6) + 0.05)) for _ in range(2))
    old, new = whole.subset(whole.points[:, 0] > 0.9), other.subset(other.points[:, 0] > 1.3)
    assert old.transfer(np.full(len(old), 3.0), new) == pytest.approx(3)


def test_pieces_at_a_sharp_tail():
    """A face that meets the tail but for round-off makes a triangle without an area."""
    corners = [(-9.5, -10), (10.5, -10), (10.5, 10), (-9.5, 10)]
    domain = clvoro.Polygon(corners, [clvoro.curves.naca("0012")])
    old = [
        (1.0705332228555686, -0.06563809236423206),
        (0.9395958919237616, 0.07506422865202093),
        (0.939595891923761, -0.07506422865202052),
        (0.8006209515312168, -0.09254249967492711),
        (0.8908827656226865, -0.2063764464238993),
        (0.870948168644345, 0.2085332592330147),
    ]
    new = clvoro.voronoi(domain, [(0.9685904877271423, -0.039032623544783186)])
    assert clvoro.voronoi(domain, old).transfer(np.ones(6), new) == pytest.approx(1)


@pytest.mark.parametrize("shape", ["ball", "bracket"])
def test_cells_of_solids_are_those_of_the_mesh(ctx, shape):
    """Their faces at walls and creases are not on bisectors. In a box around them nothing of them is lost."""
    adapter = clvoro.Adapter(ctx)
    corner = clvoro.Polygon([(-1, -1), (1, -1), (1, 0), (0, 0), (0, 1), (-1, 1)])
    solids = {
        "ball": (clvoro.Solid.ball((0, 0, 0), 1.0), 0.45),
        "bracket": (clvoro.Solid.extruded(corner, 0, 0.5), 0.3),
    }
    solid, h = solids[shape]
    old = adapter.run(solid, h, "fast").diagram
    new = adapter.diagram(solid, old.points[:, [1, 0, 2]])  # the generators mirrored, as both solids are symmetric
    part = new.subset(np.arange(len(new)) > 0)
    values, shares = old.transfer(np.ones(len(old)), part, covered=True)
    assert shares.min() > 0.8
    np.testing.assert_allclose(values, 1, rtol=1e-12)
    grid = in_box(adapter, (-1.1, -1.1, -1.1), (1.1, 1.1, 1.1), 60)
    given = RNG.random(len(old))
    for order in (1, 2):
        values, shares = old.transfer(given, grid, order, covered=True)
        assert (shares * grid.volumes).sum() == pytest.approx(old.volumes.sum(), rel=1e-9)
        assert np.nansum(shares * grid.volumes * values) == pytest.approx((old.volumes * given).sum(), rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_power_diagrams_keep_mass_and_constants(ctx, dim):
    """Some of their cells are empty, and some do not contain their generators."""
    box, rng = clvoro.Box((0,) * dim, (1,) * dim, periodic=True), np.random.default_rng(4)
    power = clvoro.power_diagram(box, rng.random((90, dim)), rng.uniform(0, 0.02 * (dim - 1) ** 2, 90))
    other = clvoro.Adapter(ctx).diagram(box, rng.random((60, dim)))
    assert len(power.empty_cells)
    for old, new in ((power, other), (other, power)):
        values = np.column_stack([np.full(len(old), 3.0), rng.random(len(old))])
        got = old.transfer(values, new, 2)
        assert got[:, 0] == pytest.approx(3.0, rel=1e-12)
        assert new.volumes @ got[:, 1] == pytest.approx(old.volumes @ values[:, 1], rel=1e-12)
