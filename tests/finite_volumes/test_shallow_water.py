"""Shallow water on the C grid of an MPAS file by `bench/_trisk.py`: operators, identities, test cases."""

import sys
from pathlib import Path

import numpy as np
import pytest

import clvoro

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))
import _trisk as trisk
import shallow_water

ROUND_OFF = 1e-14
"""Sums of at most some 1000 terms, relative to their magnitudes; each rounds by 1e-16."""


@pytest.fixture(scope="module", params=["uniform", "graded", "graded+2"])
def diagram(ctx, request):
    return shallow_water.make_mesh(clvoro.Adapter(ctx), request.param, 642, "fast")


@pytest.fixture(scope="module")
def mesh(diagram):
    return trisk.mesh_of(diagram)


@pytest.fixture
def random_model(mesh):
    """Return a model with random bottom and f, and a state that is far from steady."""
    random = np.random.default_rng(1)
    n, m, v = len(mesh.points), len(mesh.dc), len(mesh.corners)
    model = trisk.ShallowWater(mesh, 9.8, 1e-4 * random.standard_normal(v), 500 * random.random(n))
    return model, 1000 + 500 * random.random(n), 10 * random.standard_normal(m)


def rotation(mesh, axis):
    """Return normal and tangential components on edges of the velocity of a rotation about `axis`."""
    normal, along = (
        trisk.unit(np.diff(x[ends], axis=1)[:, 0])
        for x, ends in ((mesh.points, mesh.edge_cells), (mesh.corners, mesh.edge_vertices))
    )
    velocity = np.cross(axis, mesh.crossings)
    return np.einsum("ij,ij->i", velocity, normal), np.einsum("ij,ij->i", velocity, along)


def rms(x):
    return np.sqrt((x**2).mean())


def test_operators_on_a_rotation(mesh):
    """The signs are right, and the errors those of 642 cells: squares of 0.15, the angle between neighbors."""
    axis, o = np.array([0.6, 0.0, 0.8]), trisk.Operators(mesh)
    normal, along = rotation(mesh, axis)
    # TRiSK's tangential field is of zeroth to first order: here 2 percent in the mean square after steps of Lloyd's
    # method, 10 and 12 before. A wrong sign is 200.
    assert rms(o.tangential @ normal - along) < 0.15 * rms(along)
    vorticity = 2 * (mesh.corners @ axis) / shallow_water.RADIUS
    assert rms(o.curl @ normal - vorticity) < 0.02 * rms(vorticity)
    slope = np.diff((mesh.points @ axis)[mesh.edge_cells], axis=1)[:, 0] / mesh.dc
    assert o.grad @ (mesh.points @ axis) == pytest.approx(slope, rel=1e-10)
    kinetic = (1 - (mesh.points @ axis) ** 2) / 2
    assert rms(o.kinetic @ normal**2 - kinetic) < 0.04 * rms(kinetic)


def test_constants_and_potentials(mesh):
    o, random = trisk.Operators(mesh), np.random.default_rng(2)
    for mean in (o.cell_to_edge, o.vertex_to_edge, o.cell_to_vertex, o.vertex_to_cell):
        assert mean.sum(axis=1) == pytest.approx(1, abs=ROUND_OFF)
    potential = random.standard_normal(len(mesh.points))
    stream = random.standard_normal(len(mesh.corners))
    for outer, inner, of in ((o.curl, o.grad, potential), (o.div, o.along, stream)):
        magnitude = np.abs(outer) @ (np.abs(inner) @ np.abs(of))
        assert (np.abs(outer @ (inner @ of)) / magnitude).max() < ROUND_OFF


def test_balances_of_a_random_state(random_model):
    model, h, u = random_model
    found = trisk.balances(model, h, u)
    assert set(found) == set(shallow_water.BALANCES)
    assert max(found.values()) < ROUND_OFF


def test_balances_notice_a_wrong_weight(random_model):
    model, h, u = random_model
    model.operators.tangential = model.operators.tangential.copy()
    weights = model.operators.tangential.data
    weights[len(weights) // 2] += 0.1
    found = trisk.balances(model, h, u)
    # One weight of thousands. What does not depend on the weights stays.
    assert min(found[k] for k in ("coriolis_work", "energy_rate")) > 1e-10
    assert min(found[k] for k in ("dual_divergence", "geostrophic")) > 1e-4
    assert found["mass_rate"] < ROUND_OFF


@pytest.mark.sparse(1)
def test_upwinding_does_no_work_and_dissipates_enstrophy(mesh):
    case = shallow_water.set_up(5, mesh, 0.0)
    changes = {}
    for upwinding in (0.0, 0.5):
        model = trisk.ShallowWater(mesh, 9.8, case.coriolis, case.bottom, upwinding)
        changes[upwinding] = shallow_water.integrate(model, case, 2 * 86400.0, 0.8)[2]
        assert changes[upwinding]["stable"]
    assert changes[0.5]["enstrophy"] < changes[0.0]["enstrophy"]
    # Both lose energy to the steps in time only.
    assert abs(changes[0.5]["energy"]) < 1e-5


@pytest.mark.sparse(2)
@pytest.mark.parametrize("alpha", [0.0, 60.0])
def test_steady_flow_of_case_2(mesh, alpha):
    case = shallow_water.set_up(2, mesh, alpha)
    model = trisk.ShallowWater(mesh, shallow_water.GRAVITY, case.coriolis, case.bottom)
    runs = [shallow_water.integrate(model, case, 86400.0, courant) for courant in (0.8, 0.4)]
    (h, _, record), (_, _, halved) = runs
    assert record["stable"]
    # A flow that ignores rotation changes its height by a tenth.
    assert shallow_water.norms(mesh.cell_areas, h - case.h, case.h)["l2"] < 0.01
    # Each step adds a rounding error of 1e-16 or so; there are some 50.
    assert abs(record["mass"]) < 1e-14
    # Energy changes by the error in time only: RK4 loses dt^5 per time.
    assert abs(record["energy"]) < 2e-5
    assert abs(halved["energy"]) < abs(record["energy"]) / 12


def test_too_long_steps_are_unstable(mesh):
    case = shallow_water.set_up(2, mesh, 0.0)
    model = trisk.ShallowWater(mesh, shallow_water.GRAVITY, case.coriolis, case.bottom)
    _, _, record = shallow_water.integrate(model, case, 10 * 86400.0, 2.0)
    assert not record["stable"]


def test_interpolation_is_exact_for_what_it_fits(mesh):
    """A linear function of the position is a parabola in the tangent plane up to the fourth power of the distance."""
    at = trisk.unit(np.random.default_rng(3).standard_normal((50, 3)))
    slope = np.array([0.3, -0.5, 0.8])
    found = shallow_water.interpolate(mesh, mesh.points @ slope, at)
    assert np.abs(found - at @ slope).max() < 0.3**4


def test_icosahedral_mesh(ctx):
    made = shallow_water.make_mesh(clvoro.Adapter(ctx), "icosahedral+3", 162, "fast")
    sides = np.diff(made.neighbor_starts)
    assert (np.bincount(sides) == [0, 0, 0, 0, 0, 12, 150]).all()
    with pytest.raises(ValueError, match="2563 cells; expected"):
        shallow_water.make_mesh(clvoro.Adapter(ctx), "icosahedral", 2563, "fast")
