"""Fixed generators around re-entrant corners."""

import numpy as np
import pytest

import clvoro

L = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])


def test_stations_stand_around_corners_with_room():
    """Three around a corner of 270 degrees, at one distance, each in a sector of 90; none where there is no room."""
    corner = int(np.flatnonzero(L.oriented.turns < 0)[0])
    none = np.empty((0, 2))
    stations = L.stations(lambda x: np.full(len(x), 0.05), L, none)
    away = stations.points - L.oriented.vertices[corner]
    assert np.allclose(np.hypot(*away.T), 0.05 / np.sqrt(2))
    assert np.allclose(np.degrees(np.arctan2(*away.T[::-1])) % 90, 45)
    assert np.allclose(L.boundary_distance(stations.points)[[0, 2]], 0.025)
    for given, h in ((stations.points[1:2] + 0.01, 0.05), (none, 0.5)):
        assert len(L.stations(lambda x, h=h: np.full(len(x), h), L, given)) == 0


@pytest.mark.parametrize(("h", "count"), [(0.1, 2), (0.35, 0)])
def test_corners_with_short_sides_have_no_stations(h, count):
    stairs = clvoro.Polygon([(0, 0), (4, 0), (4, 1), (2.5, 1), (2.5, 1.5), (2, 1.5), (2, 2.5), (0, 2.5)])
    stations = stairs.stations(lambda x: np.full(len(x), h), stairs, np.empty((0, 2)))
    assert len(stations) == 3 * count


@pytest.mark.parametrize("method", ["adaptive", "exact"])
def test_stations_stay_and_their_faces_end_in_the_corner(ctx, method):
    result = clvoro.Adapter(ctx).run(L, 0.08, effort="fast", seed=2, method=method)
    corner = L.oriented.vertices[np.flatnonzero(L.oriented.turns < 0)]
    away = result.diagram.points[:3] - corner
    assert np.allclose(np.hypot(*away.T), np.hypot(*away[0]))
    if method == "adaptive":  # faces of weighted cells are off by little
        inner = result.solver_mesh()
        gap = np.hypot(*(inner.points - corner).T)
        ends = inner.corners.reshape(-1, 2)[: inner.n_inner]
        assert np.count_nonzero((gap < 1e-9)[ends].any(axis=1)) == 2
    assert result.check(solver="openfoam")
