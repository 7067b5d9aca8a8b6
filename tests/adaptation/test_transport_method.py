"""The method "transport": a run that ends with a power diagram of cells with their target volumes."""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError

BOX, CUBE = clvoro.Box((0, 0), (2, 1)), clvoro.Box((0, 0, 0), (1, 1, 1))
LAKE = clvoro.Polygon([(0, 0), (2, 0), (2.2, 1), (0.3, 1.2)], [[(1, 0.4), (1.4, 0.5), (1.1, 0.7)]])


def size(points):
    return 0.07 + 0.08 * points[:, 0]


@pytest.mark.sparse(1)
@pytest.mark.parametrize(
    ("domain", "h", "real"),
    [
        (BOX, size, "float64"),
        pytest.param(BOX, size, "float32", marks=pytest.mark.slow),
        (CUBE, 0.16, "float64"),
        (clvoro.Box((0, 0), (1, 1), periodic=True), 0.1, "float64"),
        pytest.param(clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), 0.16, "float64", marks=pytest.mark.slow),
        pytest.param(clvoro.Box((0, 0), (2, 1), periodic=(False, True)), size, "float32", marks=pytest.mark.slow),
        pytest.param(LAKE, size, "float64", marks=pytest.mark.slow),
        (clvoro.Sphere(1.0), lambda points: 0.25 + 0.1 * points[:, 2], "float64"),
    ],
)
def test_all_cells_have_their_size(ctx, domain, h, real):
    result = clvoro.Adapter(ctx, real).run(domain, h, method="transport", effort="fast", seed=3)
    noise = 1e-10 if real == "float64" else 1e-3
    assert result.converged
    assert np.abs(result.size_error).max() < noise
    assert result.diagram.is_power
    assert len(result.diagram.empty_cells) == 0
    field = h(result.points) if callable(h) else h
    np.testing.assert_allclose(result.target_size, result.size_factor * field, rtol=1e-6)
    assert 0.9 < result.size_factor < 1.1
    assert result.check(), result.check()
    # The last two rows are the first power diagram, and that after the move to the centroids.
    assert (result.history["max_error"][-2:] < noise).all()
    assert np.linalg.norm(result.final.lloyd, axis=1).max() > 0 == np.abs(result.final.poisson).max()


@pytest.mark.slow
def test_a_run_that_is_stopped_between_its_power_diagrams_has_weights(ctx):
    adapter, run = clvoro.Adapter(ctx), {"method": "transport", "effort": "fast", "n_cells": 90}
    last = int(adapter.run(BOX, size, **run).history["step"][-1])
    stopped = adapter.run(BOX, size, **run, callback=lambda row: row["step"] == last - 1)
    assert stopped.stop_reason == "stopped by the callback"
    assert stopped.diagram.is_power
    assert stopped.check()


def test_what_is_refused(ctx):
    adapter = clvoro.Adapter(ctx)
    with pytest.raises(InputError, match="power diagrams"):
        adapter.run(clvoro.Solid.box((0, 0, 0), (1, 1, 1)), 0.4, method="transport")
    with pytest.raises(InputError, match="layers"):
        adapter.run(BOX, 0.1, method="transport", layers=clvoro.Layers(0.01))
