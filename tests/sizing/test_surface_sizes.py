"""Sizes from the surface of a solid, against the formulas of simple ones."""

import numpy as np
import pytest

from clvoro import Box, Solid, sizing
from clvoro.errors import InputError, InputTypeError


def test_curved_walls_have_a_number_of_cells_per_turn():
    ball = Solid.ball((0, 0, 0), 0.5, edge=0.05)
    assert ball.curvature == pytest.approx(2, rel=0.1)
    size = sizing.curvature_size(ball, h_min=0.01, h_max=0.4, per_turn=20)
    wanted = 2 * np.pi * 0.5 / 20
    h = size(ball.surface.vertices)
    assert (h <= wanted * 1.1).all()
    assert (h > wanted / 1.6).all()
    assert size(np.zeros((1, 3)))[0] > 1.4 * wanted
    cube = Solid.box((0, 0, 0), (1, 1, 1))
    assert (sizing.curvature_size(cube, h_min=0.01, h_max=0.4)(cube.surface.vertices) == 0.4).all()


def test_gaps_have_a_number_of_cells_across():
    gap = Solid.outside(Solid.box((0, 0, 0.1), (1, 1, 0.5)), ((-1, -1, 0), (2, 2, 3)))
    size = sizing.gap_size(gap, h_min=0.01, h_max=0.5, cells=2)
    assert 0.035 <= size(np.array([(0.5, 0.5, 0.1)]))[0] <= 0.05
    assert size(np.array([(0.5, 0.5, 2.5)]))[0] > 0.3


def test_creases_are_shapes_and_wrong_numbers_are_refused():
    cube = Solid.box((0, 0, 0), (1, 1, 1))
    size = sizing.Distance(cube.crease_edges(), h_min=0.1, slope=1)
    assert size(np.array([(0.5, 0.5, 0.5), (0.5, 0, 0)])) == pytest.approx([0.1 + 0.5**0.5, 0.1])
    low = sizing.Distance(cube.crease_edges("zMin"), h_min=0.1, slope=1)
    assert low(np.array([(0.5, 0, 0), (0.5, 0, 0.4), (0.5, 0, 1)])) == pytest.approx([0.1, 0.5, 1.1])
    with pytest.raises(InputError, match="no concave creases at 'zMin'"):
        cube.crease_edges("zMin", concave=True)
    for field in (sizing.curvature_size, sizing.gap_size):
        with pytest.raises(InputTypeError, match=r"got a Box, expected a clvoro\.Solid"):
            field(Box((0, 0, 0), (1, 1, 1)), h_min=0.1, h_max=1)
    with pytest.raises(InputError, match="h_min <= h_max"):
        sizing.curvature_size(cube, h_min=1, h_max=0.1)
