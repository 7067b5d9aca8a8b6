"""Checks of results of runs in boxes, against the formulas of their cells."""

import numpy as np
import pytest

from clvoro.adaptation.options import METHODS, uses
from tests.reference import diagrams

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


def quality_2d(result, box, eps):
    """Q by the vertices of the cells, and the error of the device's."""
    d = result.diagram
    areas, perimeters = np.empty((2, len(d)))
    for i, polygon in enumerate(polygons(d)):
        areas[i], _ = diagrams.measures(polygon)
        perimeters[i] = np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T).sum()
    sides = np.diff(d.neighbor_starts)
    # Round-off of vertices is eps times the domain, that of areas of cells of length L about eps / L.
    bound = 2e3 * eps * box.extent.max() / np.sqrt(d.volumes.min())
    return 4 * areas * sides * np.tan(np.pi / sides) / perimeters**2, bound


def quality_3d(result, eps):
    """Q by faces and volumes, which are the device's numbers."""
    d = result.diagram
    surfaces = np.add.reduceat(d.face_measures, d.neighbor_starts[:-1])
    return 36 * np.pi * d.volumes**2 / surfaces**3, 64 * eps


def check(result, field, box, real="float64"):
    """Check that the cells fill the box, all numbers are those of the cells, and the history ends with them."""
    n, eps, dim = len(result.points), float(np.finfo(real).eps), box.dim
    d, h = result.diagram, result.history
    assert np.isfinite(result.points).all()
    assert box.contains(result.points).all()
    assert np.array_equal(d.points, result.points)
    assert (d.volumes > 0).all()
    assert d.volumes.sum() == pytest.approx(box.measure, rel=64 * eps)
    lengths = [len(a) for a in (result.target_size, result.size_error, result.quality, d.volumes)]
    assert lengths == [n] * 4
    if field.on_device:  # a jump of h can be closer to a generator than round-off
        size = field(result.points) * result.size_factor
        assert np.isclose(result.target_size, size, rtol=1e4 * eps).mean() > 0.99
    length = d.volumes ** (1 / dim)
    error = (length - result.target_size) / np.minimum(length, result.target_size)
    assert np.abs(result.size_error - error).max() <= 1e4 * eps * max(1, np.abs(error).max())
    quality, bound = quality_2d(result, box, eps) if dim == 2 else quality_3d(result, eps)
    assert np.abs(result.quality - quality).max() <= bound
    assert ((result.quality > 0) & (result.quality < 1 + 16 * eps)).all()
    # The history is complete, and its last row describes the mesh.
    assert np.array_equal(np.diff(h["cells"]), (h["inserted"] - h["deleted"])[1:])
    assert h["inserted"][0] == h["deleted"][0] == 0
    assert (h["cells"][-1], h["level"][-1]) == (n, 0)
    errors = np.abs(result.size_error)
    # Volumes are round-off apart between the run and its result: exact sizes have errors of a few eps.
    assert h["mean_error"][-1] == pytest.approx(errors.mean(), rel=1e4 * eps, abs=16 * eps)
    assert h["max_error"][-1] == pytest.approx(errors.max(), rel=1e4 * eps, abs=16 * eps)
    # In 2D the lengths of faces are in single precision during a run.
    close = 2 * float(np.finfo(np.float32).eps) if dim == 2 else 64 * eps
    assert h["mean_quality"][-1] == pytest.approx(result.quality.mean(), rel=close)
    assert h["min_quality"][-1] == pytest.approx(result.quality.min(), rel=close)
    assert set(np.diff(h["step"])) <= {0, 1}
    assert h["step"][0] == 0
    assert (np.diff(h["level"]) <= 0).all()
    assert (np.diff(h["seconds"]) >= 0).all()
    assert (np.diff(h["progress"]) >= 0).all()
    for name in h.dtype.names:
        assert np.isfinite(h[name]).all(), name
    if dim == 3:
        result.check().demand()
