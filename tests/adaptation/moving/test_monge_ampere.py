"""Optimally transported generators: derivatives on the lattice, and the transport in one direction."""

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.adaptation.moving.lattice import lattice_points
from clvoro.adaptation.moving.monge_ampere import LatticeMap
from clvoro.errors import TangledMeshWarning
from tests.reference import moving

BOXES = {2: clvoro.Box((0, 0), (1.5, 1)), 3: clvoro.Box((0, 0, 0), (1, 1.2, 1))}


@pytest.mark.parametrize(("dim", "n"), [(2, 211), (3, 260)])
def test_derivatives_of_quadratics(dim, n):
    """The fit is exact away from walls; at walls, functions without a slope there are mirrored with small errors."""
    box, rng = BOXES[dim], np.random.default_rng(21)
    lattice = LatticeMap(box, lattice_points(box, n))
    x, g, h = lattice.points, rng.normal(size=dim), rng.normal(size=(dim, dim))
    h = h + h.T
    phi = x @ g + ((x @ h) * x).sum(axis=1) / 2
    spacing = (box.measure / n) ** (1 / dim)
    inner = ((x > 1.6 * spacing) & (x < box.extent - 1.6 * spacing)).all(axis=1)
    assert inner.sum() > 5
    assert lattice.jacobian(phi)[inner] - np.eye(dim) == pytest.approx(np.tile(h, (inner.sum(), 1, 1)))
    even = np.cos(np.pi * x / box.extent).sum(axis=1) * spacing**2
    slope = -np.pi / box.extent * np.sin(np.pi * x / box.extent) * spacing**2
    assert np.abs(lattice.place(even) - x - slope).mean() < 0.05 * np.abs(slope).mean()
    assert lattice.jacobian(0 * phi) == pytest.approx(np.tile(np.eye(dim), (n, 1, 1)))


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_transport_in_one_direction(adapter, dim):
    """Sizes depend on x: the transport is that of the marginal densities, to a small part of a cell."""
    box, n = BOXES[dim], {2: 600, 3: 300}[dim]
    size = sizing.Expression("0.04 + 0.06 * x")
    result = adapter.run(box, size, method="monge-ampere", n_cells=n, max_steps=20)
    xi = lattice_points(box, n)
    expected = moving.transported(xi[:, 0], lambda x: (0.04 + 0.06 * x) ** -dim, box.extent[0])
    off = np.column_stack([expected, xi[:, 1:]]) - result.points
    assert np.abs(off / result.target_size[:, None]).mean() < 0.06
    assert result.converged
    assert result.stop_reason == "tolerance of the moving mesh met"


def test_a_fold_is_reported(adapter):
    """Sizes jump by a factor of ten: the map stops before it folds."""
    size = sizing.Expression("x < 0.75 ? 0.02 : 0.2")
    with pytest.warns(TangledMeshWarning, match=r"fold at \d+ of 500 generators"):
        result = adapter.run(BOXES[2], size, method="monge-ampere", n_cells=500, max_steps=40)
    assert np.isfinite(result.points).all()
    assert not result.converged
