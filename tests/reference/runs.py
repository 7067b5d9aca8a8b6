"""Checks of results of runs in boxes."""

import numpy as np

from clvoro.adaptation.options import METHODS, uses

FROM_POINTS = [method for method in METHODS if uses(method, "start")]
"""Methods that take generators of any number at any place; the others begin with a lattice."""


def random_points(n, seed, box):
    return np.random.default_rng(seed).random((n, box.dim)) * box.extent + box.lower


def figures(result):
    """Return mean and largest error, mean and least quality."""
    e, q = np.abs(result.size_error), result.quality
    return e.mean(), e.max(), q.mean(), q.min()


def polygons(diagram):
    corners = diagram.vertices[diagram.cell_vertices]
    return np.split(corners, diagram.cell_vertex_starts[1:-1])


def check(result, field, box, real="float64"):
    """Check cells, errors, quality and history by `Result.check`, and that the sizes are those of the field."""
    result.check().demand()
    assert result.diagram.domain == box
    h = result.history
    assert h["inserted"][0] == h["deleted"][0] == 0
    if field.on_device:  # a jump of h can be closer to a generator than round-off
        size = field(result.points) * result.size_factor
        assert np.isclose(result.target_size, size, rtol=1e4 * float(np.finfo(real).eps)).mean() > 0.99
