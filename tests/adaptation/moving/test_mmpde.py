"""The descent of Huang's functional, against differences of the functional itself, and runs of both moving meshes."""

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.adaptation.moving.lattice import lattice_points
from clvoro.adaptation.moving.mmpde import LONGEST, RATE, ROOM, MmpdeMethod, connect
from clvoro.adaptation.stages import Stages
from clvoro.errors import TangledMeshWarning
from clvoro.sizing import Sizing
from tests.reference import moving, patch, runs

COUNT = {2: 90, 3: 140}
FIELDS = {2: "0.05 + 0.1 * x + 0.03 * sin(3 * y)", 3: "0.1 + 0.1 * x * z + 0.03 * sin(3 * y)"}


def make_mesh(ctx, dim, real="float64", shift=0.0):
    """A mesh with generators up to `shift` spacings off its lattice, and the lattice, in the order of the points."""
    box = patch.BOXES["plane" if dim == 2 else "space"]
    lattice = lattice_points(box, COUNT[dim])
    spacing = (box.measure / len(lattice)) ** (1 / dim)
    points = lattice + np.random.default_rng(11).uniform(-shift, shift, lattice.shape) * spacing
    engine = patch.make_engine(ctx, real, dim, box=box)
    size = Sizing(engine, box, sizing.Expression(FIELDS[dim]))
    mesh = patch.make_mesh(Stages(engine), box, size, engine.upload(points))
    order = mesh.labels.get()
    return mesh, lattice[order], points[order]


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dim", [2, 3])
def test_descent_is_that_of_the_functional(ctx, dim):
    """-rate dI/dx / D at generators inside, at a wall and in a corner."""
    mesh, lattice, points = make_mesh(ctx, dim, shift=0.15 if dim == 2 else 0.05)
    engine, field, n = mesh.engine, mesh.sizing.field, mesh.n
    descent, gradient = engine.empty(points.shape), engine.empty(points.shape)
    room, sizes = engine.empty(n), engine.empty(n)
    mesh.sizing.evaluate_with_gradient(mesh.points, n, sizes, gradient)
    c = connect(engine, mesh.domain, lattice)
    energy, _, folded = mesh.stages.mmpde.descend_functional(mesh, c, gradient, descent, room)
    assert folded == 0
    images = c.owners.get(), c.codes.get()
    x, xi = (moving.with_images(v, *images, mesh.domain) for v in (points, lattice))
    h = field(points)[np.concatenate([np.arange(n), images[0]])]
    rows = np.repeat(np.arange(n), np.diff(c.starts.get()))
    simplices = np.column_stack([rows, c.vertices.get()])
    volumes = np.abs(np.linalg.det(xi[simplices][:, 1:] - xi[simplices][:, :1])) / (2 if dim == 2 else 6)
    # The diagonals of cospherical points at walls are not those of their images.
    assert volumes.sum() / (dim + 1) == pytest.approx(mesh.domain.measure, rel=0.03)
    terms = moving.functional(x, xi, h, simplices)
    assert energy == pytest.approx(terms.sum() / (dim + 1))
    places = (points.mean(axis=0), [0, 0.4, 0.4][:dim], [0, 0, 0][:dim])
    for i in (int(np.abs(points - place).sum(axis=1).argmin()) for place in places):
        around = simplices[rows == i]
        force, step = np.zeros(dim), 1e-6
        for axis in range(dim):
            for sign in (1, -1):
                moved, changed = x.copy(), h.copy()
                moved[i, axis] += sign * step
                changed[i] = field(moved[i : i + 1])[0]
                force[axis] += sign * moving.functional(moved, xi, changed, around).sum() / (2 * step)
        # The shape functions of each simplex: 1 and x are their sums with the vertices' values.
        shapes = np.linalg.inv(np.concatenate([np.ones((*around.shape, 1)), x[around]], axis=2))
        slopes = np.linalg.norm(shapes[:, 1:, :], axis=1)
        alignment, distribution = moving.functional(x, xi, h, around)
        stiffness = 1.5 * ((alignment + 1.5 * distribution) * slopes[:, 0] ** 2).sum()
        # The gradient of h is a difference over a thousandth of a cell.
        assert descent.get()[i] == pytest.approx(-RATE * force / stiffness, rel=1e-4, abs=1e-7)
        assert room.get()[i] == pytest.approx(1 / slopes.max())


def test_displacements_are_bounded(ctx):
    """By the size of the cell, and by the room in which simplices do not turn over."""
    mesh, _, points = make_mesh(ctx, 2, shift=0.15)
    rng, engine = np.random.default_rng(8), mesh.engine
    step, velocity, room = (rng.normal(size=points.shape), rng.normal(size=points.shape), rng.random(len(points)))
    mesh.velocity.set(velocity)
    displacement = engine.upload(step * 0.02)
    mesh.stages.mmpde.bound_displacement(mesh, displacement, 0.01, engine.upload(room * 0.2))
    wanted = 0.02 * step + 0.01 * velocity
    most = np.minimum(LONGEST * mesh.local_length.get(), ROOM * 0.2 * room)
    length = np.linalg.norm(wanted, axis=1)
    assert (length > most).any()
    assert (length < most).any()
    assert displacement.get() == pytest.approx(wanted * np.minimum(1, most / length)[:, None])


def test_folded_simplices_are_reported(ctx):
    """Two generators have changed places."""
    mesh, lattice, points = make_mesh(ctx, 2)
    middle = np.argsort(np.abs(points - points.mean(axis=0)).sum(axis=1))[:2]
    points[middle] = points[middle[::-1]]
    mesh.points.set(points)
    method = MmpdeMethod(lattice[np.argsort(mesh.labels.get())])
    with pytest.warns(TangledMeshWarning, match=r"mmpde: \d+ of 90 generators"):
        displacement = method.step(mesh)
    assert np.isfinite(displacement.lloyd.get()).all()


# Runs.

SIZE = sizing.Distance(sizing.Circle((0.5, 0.4), 0.2), h_min=0.03, slope=0.2)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("method", ["mmpde", "monge-ampere"])
@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_runs_reduce_the_error(ctx, method, dtype):
    """No generator is lost, and both precisions lead to the same mesh."""
    box, adapter = clvoro.Box((0, 0), (1, 1)), clvoro.Adapter(ctx, dtype)
    result = adapter.run(box, SIZE, method=method, max_steps=60)
    runs.check(result, SIZE, box, dtype)
    first, last = result.history["mean_error"][[0, -1]]
    assert last < (0.5 if method == "mmpde" else 0.1) * first
    assert np.array_equal(adapter.run(box, SIZE, method=method, max_steps=60).points, result.points)


@pytest.mark.parametrize("method", ["mmpde", "monge-ampere"])
def test_a_lattice_of_the_right_size_stays(adapter, method):
    box = clvoro.Box((0, 0), (1, 1))
    result = adapter.run(box, 0.1, method=method, max_steps=3)
    assert np.abs(result.points - lattice_points(box, 100)).max() < 1e-9
