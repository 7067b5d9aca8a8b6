"""Balls of the medial axis, from which gaps are found."""

import math

import numpy as np
import pytest

import clvoro
from clvoro.geometry.gaps import FACING, _balls

from ..reference.gaps import largest_radius


def rough_pond() -> clvoro.Polygon:
    """Return a ring with noise, long straight edges, and islands of few vertices."""
    rng = np.random.default_rng(3)
    angle = np.arange(60) * (2 * np.pi / 60)
    r = 1 + 0.1 * rng.standard_normal(60)
    shore = np.column_stack([r * np.cos(angle), r * np.sin(angle)])[10:]
    islands = [[(-0.5, 0.1), (-0.1, 0.2), (-0.6, 0.15)], [(-0.2, -0.6), (0.0, -0.5), (0.0, -0.3)]]
    return clvoro.Polygon(shore, islands)


@pytest.mark.parametrize("most", [0.6, 3.0])
def test_balls(most: float) -> None:
    domain = rough_pond()
    start, following = domain.oriented.vertices, domain.oriented.next_vertex
    edge = np.repeat(start[following] - start, 4, axis=0)
    share = np.tile([0.1, 0.35, 0.6, 0.85], len(start))[:, None]
    points = np.repeat(start, 4, axis=0) + share * edge
    normals = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.hypot(*edge.T)[:, None]
    begin, end, radius = _balls(domain, points, normals, most)
    wanted = [
        largest_radius(domain, x, n, most / (2 * math.sin(FACING / 2))) for x, n in zip(points, normals, strict=True)
    ]
    np.testing.assert_array_equal(begin, points)
    found = np.isfinite(radius)
    assert 10 < found.sum() < 0.9 * len(points)
    # The bisection calls a ball empty if the boundary is inside by less than 1e-10.
    np.testing.assert_allclose(radius[found], np.array(wanted)[found], rtol=1e-6)
    center = points[found] + radius[found, None] * normals[found]
    np.testing.assert_allclose(np.hypot(*(end[found] - center).T), radius[found], rtol=1e-12)
    assert domain.boundary_distance(end[found]).max() < 1e-12
