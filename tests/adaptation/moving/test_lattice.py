"""The lattice of moving meshes, and its mirror images."""

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.moving.lattice import lattice_points, mirrored


@pytest.mark.parametrize(
    ("box", "n"), [(clvoro.Box((-1, 2), (1.5, 3.5)), 601), (clvoro.Box((0, 0, 1), (1, 1.3, 2)), 517)]
)
def test_cells_have_the_same_volume(adapter, box, n):
    """A dislocation changes a few; the rows are as wide as their numbers say."""
    points = lattice_points(box, n)
    assert len(points) == n
    volumes = adapter.diagram(box, points).volumes * n / box.measure
    assert np.abs(volumes - 1).mean() < 0.04
    assert 0.6 < volumes.min() < volumes.max() < 1.5


def test_mirror_images():
    """Two walls meet in each corner: a point near it has three images."""
    points = np.array([(0.1, 0.2), (0.5, 0.5), (0.5, 0.95)])
    images = mirrored(points, np.zeros(2), np.ones(2), 0.3)
    expected = {(0, -0.1, 0.2), (0, 0.1, -0.2), (0, -0.1, -0.2), (2, 0.5, 1.05)}
    found = zip(images.owners[3:], *images.points[3:].T, strict=True)
    assert {(int(i), round(x, 9), round(y, 9)) for i, x, y in found} == expected
    assert sorted(images.codes[3:].tolist()) == [1, 4, 5, 8]
