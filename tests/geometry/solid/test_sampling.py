"""The number of cells in a solid, and random starts there."""

import numpy as np
import pytest

from clvoro import Solid, sizing
from clvoro.adaptation.sampling.start import count_cells, density_tree, sample_density, sample_uniform

BALL = Solid.ball((0, 0, 0), 1, edge=0.2)


@pytest.mark.parametrize("solid", [BALL, Solid.box((0, 0, 0), (1, 1, 0.01))])
def test_uniform_sizes_need_cells_in_proportion_to_the_volume(solid):
    h = (solid.measure / 300) ** (1 / 3)
    tree = density_tree(h, solid)
    assert tree.integral == pytest.approx(300)
    for x in (sample_density(h, solid, 300, seed=1, tree=tree), sample_uniform(solid, 300, seed=1)):
        assert len(x) == 300
        assert (solid.signed_distance(x) < 0).all()
        assert np.abs(x.mean(axis=0) - np.add(solid.lower, solid.upper) / 2).max() < 0.1 * solid.extent.max()


def test_sizes_that_grow_from_the_wall_need_cells_by_the_integral():
    """In a ball of radius 1 with h = a + b (1 - r) the integral is one of r only."""
    size = sizing.as_field(lambda x: 0.08 + 0.3 * (1 - np.linalg.norm(x, axis=1)))
    r = (np.arange(20000) + 0.5) / 20000
    expected = (4 * np.pi * r**2 / (0.08 + 0.3 * (1 - r)) ** 3).mean() * BALL.measure / (4 / 3 * np.pi)
    assert count_cells(size, BALL, 1e-2) == pytest.approx(expected, rel=0.04)
