"""Cells with corners of the boundary."""

import numpy as np
import pytest

import clvoro
from clvoro.mesh.straightening import have_corners
from tests.finite_volumes.test_straight_walls import ELL, circle

CORNERS = {
    # Generators, and which of their cells have a corner.
    "square": (
        [(0, 0), (1, 0), (1, 1), (0, 1)],
        [(0.1, 0.1), (0.5, 0.1), (0.9, 0.1), (0.1, 0.9), (0.5, 0.9), (0.9, 0.9), (0.5, 0.5)],
        [1, 0, 1, 1, 0, 1, 0],
    ),
    # A face ends in the re-entrant corner.
    "ell": (ELL, [(x, y) for x in (0.25, 0.75) for y in (0.25, 0.75) if x + y < 1.4], [1, 1, 1]),
    # Turns of 9 degrees make corners of cells only if one cell has several of them.
    "round, few cells": (circle(40, 0.4), [(0.3, 0.5), (0.7, 0.5)], [1, 1]),
    "thin": ([(0, 0), (9, 0), (9, 1), (0, 1)], [(x + 0.5, 0.5) for x in range(9)], [1, *[0] * 7, 1]),
}


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", CORNERS)
def test_cells_have_corners(ctx, name):
    ring, points, expected = CORNERS[name]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(ring), points)
    assert have_corners(diagram).tolist() == np.array(expected, bool).tolist()


def test_a_corner_between_two_cells_belongs_to_both(ctx):
    """Mirror images across the diagonal of a square: their face ends in two of its corners."""
    points = [(0.3, 0.7), (0.7, 0.3)]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)]), points)
    assert have_corners(diagram).all()


def test_many_cells_on_a_circle_have_none(ctx):
    angle = np.arange(40) * (np.pi / 20)
    rows = [np.column_stack([np.cos(angle), np.sin(angle)]) * r + 0.5 for r in (0.37, 0.3)]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(circle(40, 0.4)), np.concatenate(rows))
    assert not have_corners(diagram).any()
