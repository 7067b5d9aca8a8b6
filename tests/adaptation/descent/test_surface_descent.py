"""The gradient of the cell quality in 3D against finite differences of the energy, by diagrams from Qhull."""

from functools import cache

import numpy as np
import pytest

from clvoro.adaptation.descent import surface_descent
from clvoro.adaptation.descent.surface_descent import SurfaceDescent
from clvoro.geometry.box import Box
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.part import Part
from clvoro.tessellation.polyhedra import Polyhedra
from tests.reference import diagrams3d as reference3d
from tests.reference import patch

BOX = Box((0, 0, 0), (1, 0.75, 0.9))
"""Its frame is the unit cube's: normalized coordinates are physical ones."""
N, H, RATE, WEIGHT = 20, 0.3, 0.01, 5.0
MOVED = 2
"""Generators whose gradient is compared."""
KEPT = 7.0
"""The displacement of a cell whose vertices are not known, because a face is near round-off."""


def measures(points):
    """Q, surface and volume of each cell, (n, 3)."""
    cells = reference3d.box_voronoi(BOX.lower, BOX.upper, points)
    volume = np.array([c.volume for c in cells])
    surface = np.array([sum(c.faces.values()) for c in cells])
    return np.column_stack([36 * np.pi * volume**2 / surface**3, surface, volume])


@cache
def expected_descent():
    """Return generators, the quality of their cells, and -rate h^2 dE/dx of the first ones."""
    points = patch.random_points(N, 31, BOX).astype("float32").astype(float)
    quality = measures(points)[:, 0]
    return points, quality, -RATE * H**2 * gradient(points, 1 - WEIGHT * np.log(quality))


def gradient(points, omega):
    """dE/dx by central differences of E = sum omega (3 log S - 2 log V); omega stays that of the start."""

    def energy(x):
        _, surface, volume = measures(x).T
        return float((omega * (3 * np.log(surface) - 2 * np.log(volume))).sum())

    result, step = np.zeros((MOVED, 3)), 1e-6
    for i, a in np.ndindex(*result.shape):
        shift = np.zeros((N, 3))
        shift[i, a] = step
        result[i, a] = (energy(points + shift) - energy(points - shift)) / (2 * step)
    return result


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_descent_follows_the_gradient(ctx, monkeypatch, dtype):
    engine = patch.make_engine(ctx, dtype, dim=3)
    points, quality, expected = expected_descent()
    placed = engine.upload(points)
    t = Polyhedra(engine).tessellate(Part.alone(placed, BOX), Bins(engine).build(BOX, placed, N), exact=False)

    def descend(most):
        out = engine.empty((N, 3)).fill(KEPT)
        monkeypatch.setattr(surface_descent, "LONGEST_DESCENT", most)
        given = engine.upload(np.full(N, H)), engine.upload(quality)
        SurfaceDescent(engine).descend(t, *given, out, bad_cell_weight=WEIGHT, rate=RATE)
        return out.get()

    tolerance = 1e-6 if dtype == "float64" else 1e-3  # of the finite differences; of single precision
    found = descend(1e9)
    known = (found != KEPT).all(axis=1)
    assert known.sum() >= N - 5
    some = known[:MOVED]
    np.testing.assert_allclose(found[:MOVED][some], expected[some], atol=tolerance * np.abs(expected).max())
    bounded = np.linalg.norm(descend(1e-3)[known], axis=1)
    np.testing.assert_allclose(bounded, np.minimum(np.linalg.norm(found[known], axis=1), 1e-3 * H), rtol=1e-4)
