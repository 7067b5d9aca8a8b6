"""Generators around concave creases: their bisectors contain the creases, and their cells have the size h."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from clvoro import Polygon, Solid
from clvoro.adaptation.fixed_points import place_in_corners
from clvoro.errors import MismatchWarning
from clvoro.geometry.fixed_generators import FixedGenerators
from clvoro.geometry.solid.stations import chain_line

L = Solid.extruded(Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), 0, 1)


def cubes(*places):
    """Unit cubes at integer places, as one solid; common sides are left out."""
    quads = {}
    for place in places:
        for axis in range(3):
            for up in (0, 1):
                u, v = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
                a = np.array(place) + up * np.eye(3, dtype=int)[axis]
                ring = [a, a + u, a + u + v, a + v] if up else [a, a + v, a + u + v, a + u]
                key = frozenset(map(lambda p: tuple(p.tolist()), ring))
                quads[key] = None if key in quads else ring
    rings = np.array([ring for ring in quads.values() if ring is not None], float)
    corner = 4 * np.arange(len(rings))[:, None]
    return Solid(rings.reshape(-1, 3), np.vstack([corner + np.array(t) for t in ((0, 1, 2), (0, 2, 3))]))


FICHERA = cubes(*[(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1) if (i, j, k) != (1, 1, 1)])
BOSS = cubes(*[(i, j, 0) for i in range(3) for j in range(3)], (1, 1, 1))
STEPPED = Solid.turned([(0, 0), (1, 0), (1, 0.6), (0.5, 0.6), (0.5, 1.2), (0, 1.2)], edge=0.02)


def ties(stations, points, k):
    """Distances (n, k) of points to their nearest generators, in units of the smallest of them."""
    distance = KDTree(stations.points).query(points, k=k)[0]
    return distance / distance[:, :1]


@pytest.mark.parametrize(("solid", "count"), [(L, 3 * 5), (FICHERA, 3 * 15 - 3 + 1), (BOSS, None), (STEPPED, None)])
def test_creases_are_equidistant_from_the_generators_around_them(solid, count):
    h = 0.2
    stations = solid.stations(lambda x: np.full(len(x), h))
    assert len(stations.left_out) == 0
    assert count is None or len(stations) == count
    assert (solid.signed_distance(stations.points) < -0.3 * h).all()
    concave = np.unique(solid.creases.chain[solid.creases.concave])
    assert concave.size
    for chain in concave:
        line = chain_line(solid, chain)
        at = np.linspace(0, line.at[-1], 200)
        assert ties(stations, line.along(line.points, at), 3) == pytest.approx(
            1, abs=1e-9 if solid is not STEPPED else 0.12
        )
    if solid is FICHERA:
        assert ties(stations, np.array([[1.0, 1, 1]]), 7) == pytest.approx(1, abs=1e-12)


def test_stations_follow_the_sizes_along_a_crease():
    tall = Solid.extruded(Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), 0, 4)
    stations = tall.stations(lambda x: 0.05 + 0.05 * x[:, 2])
    z = np.unique(np.round(stations.points[:, 2], 9))
    middle = (z[1:] + z[:-1]) / 2
    assert np.diff(z) == pytest.approx(0.05 + 0.05 * middle, rel=0.03)
    assert len(stations) == 3 * len(z)


def test_places_without_room_are_reported():
    """Above a ledge that is narrower than the cells, and in a run."""
    ledge = Polygon([(0, 0), (1.005, 0), (1.005, 1), (1, 1), (1, 2), (0, 2)])
    solid = Solid.extruded(ledge, 0, 0.6)
    left = solid.stations(lambda x: np.full(len(x), 0.2)).left_out
    assert left[:, :2] == pytest.approx(np.tile([1.0, 1.0], (3, 1)))
    with pytest.warns(MismatchWarning, match="no room at 3 places on concave creases, the first at \\(1, 1, 0.1\\)"):
        place_in_corners(solid, solid, *np.empty((2, 0, 3)), lambda x: np.full(len(x), 0.2), 1000)


def test_generators_come_nearer_to_creases_where_there_is_little_room():
    """Around a post and a wall with sides of h and 1.25 h. None of their creases is left out, and no ball is taken."""
    h = 0.2
    parts = cubes(*[(i, j, 0) for i in range(3) for j in range(3)], (1, 1, 1), (2, 1, 1), (2, 2, 1))
    solid = Solid(parts.surface.vertices * [0.5, 0.25, 1.0], parts.surface.triangles)
    stations = solid.stations(lambda x: np.full(len(x), h))
    assert len(stations.left_out) == 0
    assert 0 < stations.n_sized < len(stations)
    assert stations.size[: -stations.n_sized] == pytest.approx(h, rel=0.3)
    assert (stations.size[-stations.n_sized :] < 0.81 * h).all()
    assert (KDTree(stations.points).query(stations.centers)[0] > 0.9 * stations.radii).all()
    # Without the last one, which is too near to another generator, the others that have their own sizes remain.
    none = np.empty(0, np.int32)
    other = FixedGenerators(stations.points[-1:], np.empty((0, 3)), none, np.zeros(2, np.int32), none, np.empty((0, 3)))
    assert other.with_others(stations, lambda x: np.full(len(x), 1e-3)).n_sized == stations.n_sized - 1


@pytest.mark.parametrize("thickness", [0.02, 0.08, 0.18])
def test_creases_on_both_sides_of_a_narrow_facet_share_the_sectors_around_them(thickness):
    """All around a thin plate cells have their whole size, and the creases are equidistant from two generators.

    One of them is beyond the middle of the facet, for both creases.
    """
    h, y = 0.2, 0.5 * thickness
    solid = Solid.outside(Solid.box((0, -y, 0), (1, y, 1)), ((-1, -1, -1), (2, 1, 2)))
    stations = solid.stations(lambda x: np.full(len(x), h))
    assert len(stations.left_out) == stations.n_sized == 0
    at = np.column_stack([np.linspace(0.01, 0.99, 50), np.full(50, y), np.full(50, 1.0)])
    assert ties(stations, at, 2) == pytest.approx(1, abs=1e-9)
    # The facet belongs to the cells beyond it.
    inner = KDTree(stations.points).query(at - [0, 0.25 * y, 0])[1]
    assert (stations.points[inner, 2] > 1).all()
    assert stations.points[inner, 1] == pytest.approx(0, abs=1e-9)


def test_cells_around_narrow_curves_have_their_own_sizes():
    for h, share in ((0.2, 0), (0.25, 1)):
        stations = STEPPED.stations(lambda x, h=h: np.full(len(x), h))
        assert stations.n_sized == share * len(stations)


@pytest.mark.parametrize(("length", "count"), [(0.15, 0), (0.2, 3), (0.5, 3)])
def test_short_creases_have_one_chord(length, count):
    short = Solid.extruded(Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), 0, length)
    assert len(short.stations(lambda x: np.full(len(x), 0.6))) == count


def test_given_generators_in_balls_are_reported():
    with pytest.warns(MismatchWarning, match="fixed\\[0\\] .* from a concave crease"):
        place_in_corners(L, L, np.array([[0.9, 0.9, 0.5]]), np.empty((0, 3)), lambda x: np.full(len(x), 0.2), 1000)


def test_solids_without_concave_creases_have_no_stations():
    assert len(Solid.box((0, 0, 0), (1, 1, 1)).stations(lambda x: np.full(len(x), 0.1))) == 0


@pytest.mark.parametrize("slope", [(0, 0.3, -0.3), (0, 1, 0.7), (1.8, -3.1, 1)])
def test_of_two_creases_beside_a_facet_one_may_have_larger_cells(slope):
    """The facet is narrow for one of them only."""
    plate = Solid.extruded(Polygon([(0, 0), (0.7, 0), (0.6, 0.07), (0.1, 0.18)]), 0, 0.5)
    air = Solid.outside(plate, ((-1, -1, -1), (2, 2, 2)))
    placed = air.stations(lambda x: 0.15 * np.exp(0.8 * np.sin(3 * x @ slope)))
    assert (air.signed_distance(placed.points) < 0).all()
