"""The sphere as a domain: positions, longitudes and latitudes, errors."""

import numpy as np
import pytest

import clvoro
from clvoro.errors import ClvoroError

EARTH = clvoro.Sphere()


def test_positions_and_back():
    rng = np.random.default_rng(0)
    lonlat = np.column_stack([rng.uniform(-180, 180, 100), rng.uniform(-90, 90, 100)])
    x = EARTH.positions(lonlat)
    assert np.linalg.norm(x, axis=1) == pytest.approx(np.full(100, EARTH.radius), rel=1e-15)
    assert EARTH.lonlat(x) == pytest.approx(lonlat, abs=1e-12)
    assert EARTH.positions([(17, 90), (-123, -90)]).tolist() == [[0, 0, EARTH.radius], [0, 0, -EARTH.radius]]
    assert EARTH.positions([(190, 10)]) == pytest.approx(EARTH.positions([(-170, 10)]), rel=1e-15)


def test_vectors_of_any_length_are_positions():
    x = EARTH.check_rows("points", [(2, 0, 0), (0, -1e-3, 0)])
    assert x.tolist() == [[EARTH.radius, 0, 0], [0, -EARTH.radius, 0]]


def test_arcs():
    chord = np.linalg.norm(np.subtract(*EARTH.positions([(0, 0), (60, 0)])))
    assert EARTH.lengths([chord]) == pytest.approx([EARTH.radius * np.pi / 3])


def test_tangents():
    x = EARTH.wrap(np.random.default_rng(1).normal(size=(50, 3)))
    x = np.concatenate([x, np.diag([1, 1, 1]) * EARTH.radius, -np.diag([1, 1, 1]) * EARTH.radius])
    e, f = EARTH.tangents(x)
    assert np.cross(e, f) == pytest.approx(x / EARTH.radius, abs=1e-15)


@pytest.mark.parametrize("k", [0, 1, 4])
def test_icosahedral_points(k):
    x = clvoro.Sphere(1).icosahedral_points(k)
    assert len(x) == 10 * 4**k + 2
    gaps = np.linalg.norm(x[:, None] - x[None], axis=2) + 9 * np.eye(len(x)) if k < 4 else None
    if gaps is not None:
        assert gaps.min() > 0.8 / (k + 1)
    assert np.linalg.norm(x, axis=1) == pytest.approx(np.ones(len(x)), rel=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: clvoro.Sphere(0), "Sphere radius"),
        (lambda: clvoro.Sphere("1"), "Sphere radius"),
        (lambda: EARTH.positions([(10, 95)]), r"lonlat\[0\] is \[10. 95.\], expected a longitude and a latitude"),
        (lambda: EARTH.positions([(np.nan, 5)]), "finite"),
        (lambda: EARTH.positions([(1, 2, 3)]), "shape"),
        (lambda: EARTH.check_rows("points", [(1, 0, 0), (0, 0, 0)]), r"points\[1\]"),
        (lambda: EARTH.check_rows("points", [(1, np.inf, 0)]), r"points\[0\]"),
        (lambda: EARTH.icosahedral_points(12), "at most 11"),
        (lambda: clvoro.voronoi(EARTH, [(100, 50), (95, 95)]), "latitude"),
        (lambda: clvoro.adapt(EARTH, 1e6, layers=clvoro.Layers(1e5)), "layers are for a Box .* or a Polygon"),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(ClvoroError, match=message):
        call()
