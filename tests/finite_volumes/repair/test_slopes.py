"""Derivatives of the terms of patches, against differences."""

from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.finite_volumes.repair.figures import LENGTH_GOAL
from clvoro.finite_volumes.repair.patch import take_patch
from clvoro.finite_volumes.repair.pricing import PricedPatch
from clvoro.finite_volumes.repair.slopes import slopes


@pytest.fixture(scope="module")
def patch(ctx):
    """A few cells, with points moved so that terms of all kinds are positive."""
    domain = clvoro.Polygon([(0, 0), (1.6, 0), (1.6, 0.1), (1, 0.1), (0.5, 0.5), (0.4, 1), (0, 1)])
    rng = np.random.default_rng(3)
    passage = [(1.1, 0.05), (1.2, 0.06), (1.3, 0.05), (1.4, 0.04), (1.5, 0.05)]  # one cell wide
    points = np.concatenate([rng.random((50, 2)), passage])
    diagram = clvoro.Adapter(ctx).diagram(domain, points[domain.contains(points)])
    mesh = diagram.solver_mesh(collapse=False)
    given = PricedPatch.of(take_patch(mesh, np.ones(mesh.n_cells, bool)))
    x, y = given.patch.points.T + rng.normal(0, 0.002, given.patch.points.T.shape)
    given.cells.aim = np.full(len(given.cells.faces), LENGTH_GOAL)
    return given.cells, x, y


def test_slopes_are_differences(patch):
    cells, x, y = patch
    terms = cells.terms(cells.figures(x, y))
    f, n = len(cells.faces), len(cells.area)
    starts = [0, f, 2 * f, 3 * f, 3 * f + n, 3 * f + 2 * n, len(terms)]
    found, known = np.zeros((2, 2, len(terms), len(x)))
    made = slopes(cells, cells.figures(x, y))
    for axis, part in enumerate((made.x, made.y)):
        np.add.at(found[axis], (made.terms, made.points), part)
    step = 1e-6
    for axis in range(2):
        for p in range(len(x)):
            aside = np.array([x, y])
            aside[axis, p] += step
            ahead = cells.terms(cells.figures(*aside))
            aside[axis, p] -= 2 * step
            known[axis, :, p] = (ahead - cells.terms(cells.figures(*aside))) / (2 * step)
    for first, last in pairwise(starts):
        part, exact = found[:, first:last], known[:, first:last]
        scale = np.abs(exact).max()
        assert scale > 0  # this kind of terms occurs
        # Near parallel faces the round-off of determinants, 1e-16, over the step and the root.
        assert np.abs(part - exact).max() < 1e-3 * scale
