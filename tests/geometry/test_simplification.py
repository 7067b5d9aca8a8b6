"""Domains without what is smaller than a cell."""

import numpy as np
import pytest
import shapely
import shapely.affinity

import clvoro
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.simplification import Triangles, divided_boundary, narrow_parts

BOX = [(0, 0), (1, 0), (1, 1), (0, 1)]
H = 0.1


def rectangle(x, y, a, b):
    return [(x, y), (x + a, y), (x + a, y + b), (x, y + b)]


def rough(k, seed):
    """Return a ring of radius 1 with noise."""
    angle = np.arange(k) * (2 * np.pi / k)
    r = 1 + 0.03 * np.random.default_rng(seed).standard_normal(k)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)])


def joined(*rings):
    return shapely.union_all([shapely.Polygon(ring) for ring in rings])


def with_bay(width, depth):
    return clvoro.Polygon.from_shapely(joined(BOX, rectangle(0.9, 0.5 - width / 2, 0.1 + depth, width)))


def test_wide_domains_stay():
    for domain in (
        clvoro.Polygon(BOX, [rectangle(0.4, 0.4, 0.2, 0.15)]),
        clvoro.Polygon([(0, 0), (1, 0), (0.8, 0.7), (0.3, 0.8)]),
        with_bay(0.15, 0.5),
    ):
        same = domain.simplified(H)
        assert same.geometry.symmetric_difference(domain.geometry).area < 1e-12
        assert len(same.vertices) == len(domain.vertices)


@pytest.mark.parametrize("depth", [0.15, 0.6])
def test_narrow_bays_are_filled(depth):
    found = with_bay(0.07, depth).simplified(H)
    assert found.measure == pytest.approx(1, abs=2e-3)
    assert found.upper[0] < 1 + H / 2


def narrow_area(domain, h):
    """Return the area over h^2 that an erosion by 0.45 h and a dilation take away, but for corners."""
    water = domain.geometry
    opened = water.buffer(-0.45 * h, quad_segs=32).buffer(0.452 * h, quad_segs=32)
    area = shapely.area(shapely.get_parts(water.difference(opened))) / h**2
    return area[area > 0.15].sum()


@pytest.mark.parametrize("angle", [0, 17])
def test_channels_with_long_edges(angle):
    """Lakes in a row. The channels between them are 30 cells long, and their edges as well."""
    for width, pieces in ((0.5, 2), (0.9, 2), (0.98, 2), (1.02, 1)):
        y = width * H / 2
        parts = rectangle(-1, -1, 1, 2), rectangle(-0.1, -y, 3.2, 2 * y), rectangle(3, -0.7, 1, 1.9)
        lakes = shapely.affinity.rotate(joined(*parts), angle, origin=(0, 0))
        found = clvoro.Polygon.from_shapely(lakes).simplified(H)
        assert found.n_pieces == pieces
        if pieces == 2:
            assert found.measure == pytest.approx(3.9, abs=1e-3)


@pytest.mark.parametrize("width", [1e-2, 1e-6, 1e-9])
def test_slits(width):
    """A rock beside the shore is joined to it, however thin the slit between them is."""
    rock = rectangle(width * H, 0.4, 0.3, 0.3)
    found = clvoro.Polygon(BOX, [rock]).simplified(H)
    assert len(found.ring_starts) == 2
    assert found.measure == pytest.approx(0.91, abs=1e-2)


def test_no_narrow_water_is_left():
    """Combs, snowflakes and porous media: what shapely finds to be too narrow."""
    teeth = [rectangle(0.24 * k, 0, 0.09, 0.3 + 0.05 * k) for k in range(10)]
    comb = shapely.affinity.rotate(joined(rectangle(0, -0.5, 2.4, 0.51), *teeth), 31)
    turn, step = np.exp(1j * np.pi / 3), np.exp(-2j * np.pi / 3)
    flake = step ** np.arange(3)
    for _ in range(4):
        side = (np.roll(flake, -1) - flake) / 3
        flake = np.stack([flake, flake + side, flake + side * (1 + turn), flake + 2 * side], 1).ravel()
    middles = np.random.default_rng(3).uniform(0.2, 2, (60, 2))
    rocks = shapely.buffer(shapely.points(middles), 0.09, quad_segs=10)
    pores = shapely.box(0, 0, 2.2, 2.2).difference(shapely.union_all(rocks))
    for shape in (comb, shapely.Polygon(np.column_stack([flake.real, flake.imag])), pores):
        parts = [part for part in shapely.get_parts(shape) if part.area > H**2]
        domain = clvoro.Polygon.from_shapely(shapely.MultiPolygon(parts))
        found = domain.simplified(H)
        assert found.geometry.is_valid
        assert narrow_area(domain, H) > 0.5
        assert narrow_area(found, H) < 0.25
        assert (shapely.area(shapely.get_parts(found.geometry)) > 3.8 * H**2).all()


def test_channels_divide_the_domain():
    channel, lake = rectangle(0.9, 0.5, 0.7, 0.05), rectangle(1.5, 0, 0.7, 1)
    lakes = clvoro.Polygon.from_shapely(joined(BOX, channel, lake))
    left = np.flatnonzero(lakes.edge_ends(np.arange(len(lakes.vertices)))[0][:, 0] < 0.5)
    found = clvoro.Polygon(lakes.rings[0], names={"left": left}).simplified(H)
    assert found.n_pieces == 2
    assert found.measure == pytest.approx(1.7, abs=0.01)
    assert found.boundary_names[0] == "left"
    # A pond of two cells is dropped.
    pond = joined(BOX, channel, rectangle(1.5, 0.45, 0.15, 0.15))
    assert clvoro.Polygon.from_shapely(pond).simplified(H).n_pieces == 1


def test_islands():
    """Those that are small in all directions are dropped. Thin walls, and land between two bays, stay."""
    rock, large = rectangle(0.2, 0.2, 0.05, 0.08), rectangle(0.6, 0.2, 0.15, 0.15)
    wall = rectangle(0.2, 0.7, 0.6, 0.01)
    found = clvoro.Polygon(BOX, [rock, large, wall]).simplified(H)
    assert found.measure == pytest.approx(1 - 0.15**2 - 0.006, abs=1e-12)
    dam = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0.52), (0.8, 0.52), (0.8, 0.48), (0, 0.48)]
    found = clvoro.Polygon(dam).simplified(H)
    assert found.measure == pytest.approx(clvoro.Polygon(dam).measure, abs=2e-3)
    cape = [(0, 0), (0.5, 0), (0.51, 0.08), (0.54, 0.08), (0.55, 0), (1, 0), (1, 1), (0, 1)]
    assert clvoro.Polygon(cape).simplified(H).measure == pytest.approx(1, abs=2e-3)


def test_vertices_are_thinned():
    domain = clvoro.Polygon(rough(500, 1))
    fine = domain.simplified(H, 0)
    for tolerance in (0.05, 0.2):
        found = domain.simplified(H, tolerance)
        assert found.geometry.is_valid
        assert found.boundary_distance(fine.vertices).max() <= tolerance * H * (1 + 1e-9)
    assert len(found.vertices) < len(domain.simplified(H).vertices) < 250


def triangles_of(domain, h):
    boundary = divided_boundary(domain, lambda x: np.full(len(x), h))
    return Triangles(*boundary, lambda x: shapely.contains_xy(domain.geometry, *x.T))


def archipelago():
    middles = np.mgrid[-0.6:0.7:0.2, -0.6:0.7:0.2].reshape(2, -1).T
    return clvoro.Polygon(rough(900, 4), [c + 0.03 * rough(20, k) for k, c in enumerate(middles)])


def test_edges_are_sides_of_triangles():
    domain = archipelago()
    found = triangles_of(domain, 0.05)
    sides = np.concatenate([np.roll(found.corners, k, axis=1)[:, :2] for k in range(3)])
    assert {*map(tuple, found.edges.tolist())} <= {*map(tuple, sides.tolist())}
    assert found.area[found.water].sum() == pytest.approx(domain.measure, rel=1e-12)
    middles = found.x[found.corners].mean(axis=1)
    np.testing.assert_array_equal(found.water, shapely.contains_xy(domain.geometry, *middles.T))
    ends = found.x[found.edges]
    assert domain.boundary_distance(ends.mean(axis=1)).max() < 1e-12


@pytest.mark.parametrize("land", [False, True])
def test_narrow_parts(land):
    """Triangles cover what dilations and erosions leave; areas are those beside discs."""
    domain, h = archipelago(), 0.05
    triangles, water = triangles_of(domain, h), domain.geometry
    parts = narrow_parts(triangles, not land, 1)
    covered = shapely.union_all(shapely.polygons(triangles.x[triangles.corners[parts.row]]))
    radius = (1 if land else -1) * h / 2
    opened = water.buffer(radius, quad_segs=64).buffer(-radius, quad_segs=64)
    wanted = opened.difference(water) if land else water.difference(opened)
    # Edges are up to h / 3 long, so that the discs may reach over them a little.
    assert wanted.difference(covered).area < 0.003 * wanted.area
    assert parts.area.sum() == pytest.approx(wanted.area, rel=0.03)
    assert parts.count > 100


def test_water_that_touches_itself():
    """A cape ends above a narrow bay, which is filled: both lakes may have the corner there."""
    shore = [(0, 0), (0.96, 0), (0.96, -0.3), (1.04, -0.3), (1.04, 0), (2, 0)]
    cape = [(2, 1), (1.1, 1), (1, 0.01), (0.9, 1), (0, 1)]
    found = clvoro.Polygon(shore + cape).simplified(H)
    assert found.n_pieces == 2
    left, right = (piece.geometry for piece in found.split())
    assert left.distance(right) < 0.1 * H
    assert found.measure == pytest.approx(1.9, abs=0.02)


@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-9])
def test_thin_walls(width):
    """Walls far thinner than the edges that divide the boundary."""
    walls = [rectangle(0.2, 0.5, 0.6, width), rectangle(0.5, 0.2, width, 0.6)]
    domain = clvoro.Polygon.from_shapely(shapely.Polygon(BOX).difference(joined(*walls)))
    found = domain.simplified(H)
    assert found.measure == pytest.approx(1, abs=2 * width)
    assert found.n_pieces == 1
    assert len(found.ring_starts) == 3 or width < 1e-3 * H


def test_pieces():
    """The largest comes first, with its holes and the names of its edges."""
    pond, lake = [rectangle(2, 0, 0.5, 0.5)], [BOX, rectangle(0.4, 0.4, 0.2, 0.1)]
    domain = clvoro.Polygon.from_pieces([pond, lake], {"inlet": 1, "dam": [4, 5], "rock": range(8, 12)})
    large, small = domain.split()
    assert (large.measure, small.measure) == (pytest.approx(0.98), pytest.approx(0.25))
    assert large.boundary_names == ("dam", "rock", "outer")
    np.testing.assert_array_equal(large.boundary_index, [0, 0, 2, 2, 1, 1, 1, 1])
    assert small.boundary_names == ("inlet", "outer")
    np.testing.assert_array_equal(np.flatnonzero(small.boundary_index == 0), [1])


def test_names():
    domain = clvoro.Polygon(
        rough(600, 2),
        [rectangle(0, 0, 0.3, 0.3), rectangle(-0.5, 0, 0.02, 0.02)],
        names={"open": range(200), "rock": range(604, 608), "house": range(600, 604)},
    )
    found = domain.simplified(0.06)
    assert found.boundary_names == ("open", "house", "outer")
    middles = np.mean(found.edge_ends(np.arange(len(found.vertices))), axis=0)
    edges, _ = domain.nearest_edge(middles)
    wanted = np.array(domain.boundary_names)[domain.boundary_index[edges]]
    same = np.array(found.boundary_names)[found.boundary_index] == wanted
    assert same.mean() > 0.98
    # Curves become polylines with their names.
    disc = clvoro.Polygon(clvoro.curves.circle((0, 0), 1, name="rim")).simplified(0.1)
    assert disc.boundary_names == ("rim",)
    assert not disc.curves
    assert 8 < len(disc.vertices) < 80


def test_sizes_that_vary():
    """Bays of width 0.06 at both ends: cells are smaller than that at one of them."""
    bays = joined(rectangle(0, 0, 2, 1), rectangle(-0.5, 0.47, 3, 0.06))
    domain = clvoro.Polygon.from_shapely(bays)
    for size in (clvoro.sizing.Expression("x < 1 ? 0.02 : 0.1"), lambda p: np.where(p[:, 0] < 1, 0.02, 0.1)):
        found = domain.simplified(size)
        assert found.lower[0] == pytest.approx(-0.5)
        assert found.upper[0] < 2.05
    graded = clvoro.sizing.Distance(clvoro.sizing.Circle((-0.5, 0.5), 0.05), h_min=0.02, slope=0.05, h_max=0.2)
    found = domain.simplified(graded)
    assert found.lower[0] == pytest.approx(-0.5)
    assert found.upper[0] < 2.1


@pytest.mark.slow
def test_meshes_of_simplified_domains():
    """The boundary has spikes that are a third of a cell wide."""
    domain = clvoro.Polygon(rough(400, 4)).simplified(0.1)
    result = clvoro.adapt(domain, 0.05, seed=1)
    assert result.check(solver="openfoam")
    assert result.quality.min() > 0.6  # one cell between two spikes has 0.68


def test_bad_input():
    domain = clvoro.Polygon(BOX)
    with pytest.raises(InputError, match="nothing is left"):
        domain.simplified(1.5)
    for bad in (0, -1, float("nan")):
        with pytest.raises(InputError, match="size is"):
            domain.simplified(bad)
    with pytest.raises(InputTypeError, match="size is 'h'"):
        domain.simplified("h")
    with pytest.raises(InputError, match="tolerance"):
        domain.simplified(H, 0.7)
    with pytest.raises(InputError, match=r"size is 0 at"):
        domain.simplified(lambda p: np.zeros(len(p)))
    with pytest.raises(InputTypeError, match="shape"):
        domain.simplified(lambda p: p)
