"""One step of each method, against the same formulas in dense NumPy algebra."""

from types import SimpleNamespace

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.adaptation.methods import (
    PUBLISHED,
    ProjectedMethod,
    PublishedMethod,
    Relaxation,
    WeightedMethod,
    make_method,
)
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.tuning import AT_WALLS_OF_BOXES, PENALTY_PER_ERROR
from clvoro.errors import SizeErrorWarning, SizeFieldError
from clvoro.sizing import Sizing
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.volume_projection import Penalty, Targets
from tests.reference import graphs, patch

N = 150
FIELD = sizing.Distance(sizing.Circle((0.4, 0.35), 0.12), 0.03, slope=0.3)


@pytest.fixture(scope="module")
def stages(ctx):
    return Stages(patch.make_engine(ctx))


def make_mesh(stages, points=None, field=FIELD):
    points = patch.relaxed_points(N, 5005, steps=2) if points is None else points
    engine = stages.engine
    mesh = patch.make_mesh(stages, patch.BOX, Sizing(engine, patch.BOX, field), engine.upload(points))
    return mesh, patch.fetch(mesh.t)


def gradient(host, psi):
    """grad psi as the sum over faces, walls without flux."""
    out = np.zeros((host.n, 2))
    inner = host.neighbors >= 0
    i, j = host.owners[inner], host.neighbors[inner]
    distance = np.linalg.norm(host.points[j] - host.points[i], axis=1)
    flux = host.face_measures[inner] / distance * (psi[j] - psi[i]) / host.volumes[i]
    np.add.at(out, i, flux[:, None] * host.face_centroids[inner])
    return out


def solve(host, rhs, density=None):
    A = graphs.laplacian_matrix(host.points, host.starts, host.neighbors, host.face_measures, density)
    return np.linalg.lstsq(A.toarray(), rhs, rcond=None)[0]


def test_published_displacements(stages):
    """Lloyd: centroid - x. Poisson: -div grad psi = e, its volume-weighted mean removed, u = alpha grad psi."""
    mesh, host = make_mesh(stages)
    method = PublishedMethod(Relaxation(alpha=1.7, k=0.4, tolerance=1e-12), lloyd=True, poisson=True)
    d = method.step(mesh)
    assert d.solution.converged
    assert d.lloyd.get() == pytest.approx(host.offsets)
    h = FIELD(host.points)
    length = np.sqrt(host.volumes)
    e = (length - h) / np.minimum(length, h)
    psi = solve(host, host.volumes * (e - np.average(e, weights=host.volumes)))
    u = gradient(host, psi)
    speed = np.linalg.norm(u, axis=1) / h
    alpha = min(1.7, 0.4 / speed.max())
    assert alpha < 1.7
    assert d.correction.get() == pytest.approx(alpha * u, rel=1e-7, abs=1e-10)
    summaries = mesh.summaries.read()
    assert summaries["correction"].sum == pytest.approx(alpha * speed.sum(), rel=1e-7)
    assert summaries["correction"].peak == pytest.approx(0.4)
    assert summaries["lloyd"].sum == pytest.approx((np.linalg.norm(host.offsets, axis=1) / h).sum())


def test_alpha_is_the_dimension_by_default(stages):
    """k so large that it does not bind."""
    mesh, _ = make_mesh(stages)
    free = PublishedMethod(Relaxation(alpha=1.0, k=1e9), lloyd=False, poisson=True)
    one = free.step(mesh).correction.get()
    two = make_method("poisson", Relaxation(k=1e9)).step(mesh).correction.get()
    # The second solve starts from the potential of the first.
    assert two == pytest.approx(2 * one, rel=1e-2, abs=1e-3 * np.abs(one).max())


@pytest.mark.parametrize(("name", "a", "b"), [("lloyd", 1, 0), ("poisson", 0, 1), ("coupled", 1, 1)])
def test_published_moves(stages, name, a, b):
    mesh, host = make_mesh(stages)
    method = make_method(name, Relaxation(k=0.3))
    d = method.step(mesh)
    expected = host.points + a * d.lloyd.get() + b * d.correction.get()
    inside = patch.BOX.contains(expected)
    assert inside.sum() > N - 10
    mesh.move(d)
    assert mesh.points.get()[inside] == pytest.approx(expected[inside], abs=1e-15)
    assert patch.BOX.contains(mesh.points.get()).all()


def test_weighted_displacements(stages):
    """-div(rho grad psi) = rho (r - mean r), r = log(V / h^2), u = grad psi, rho = h^-2."""
    mesh, host = make_mesh(stages)
    d = WeightedMethod(tolerance=1e-12).step(mesh)
    assert d.solution.converged
    h = FIELD(host.points)
    rho, r = h**-2, np.log(host.volumes / h**2)
    weight = host.volumes * rho
    psi = solve(host, weight * (r - np.average(r, weights=weight)), rho)
    assert d.correction.get() == pytest.approx(gradient(host, psi), rel=1e-7, abs=1e-9)
    w = stages.density.lloyd_weights(mesh.t, mesh.h)
    assert np.array_equal(d.lloyd.get(), w.lloyd.get())


@pytest.mark.parametrize("cautious", [True, False])
@pytest.mark.parametrize(("lloyd", "poisson"), [(True, True), (True, False), (False, True)])
def test_weighted_moves_at_most_k(stages, lloyd, poisson, cautious):
    """Each displacement is clipped separately, at k h or, if cautious, at k min(h, L)."""
    mesh, host = make_mesh(stages, patch.random_points(N, 11))
    method = WeightedMethod(k=0.25, lloyd=lloyd, poisson=poisson, cautious=cautious)
    displacement = method.step(mesh)
    d = lloyd * displacement.lloyd.get() + poisson * displacement.correction.get()
    h = FIELD(host.points)
    longest = 0.25 * (np.minimum(h, np.sqrt(host.volumes)) if cautious else h)
    length = np.linalg.norm(d, axis=1)
    assert 3 < (length > longest).sum() < N
    expected = host.points + d * np.minimum(1, longest / length)[:, None]
    inside = patch.BOX.contains(expected)
    assert inside.sum() > N - 10
    mesh.move(displacement)
    assert mesh.points.get()[inside] == pytest.approx(expected[inside], abs=1e-13)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("name", [*PUBLISHED, "glide", "polish"])
def test_perfect_mesh_does_not_change(stages, name):
    """A square lattice of the target size is at rest, also at walls."""
    xy = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    points = (xy + 0.5) / 8
    mesh, host = make_mesh(stages, points, sizing.Constant(0.125))
    method = {
        "glide": ProjectedMethod("lloyd", 1.3, 0.7),
        "polish": ProjectedMethod(
            "quality", 0.0, penalty=0.3, quality_scale=0.03, log_ratio_scale=0.02, error_target=0.002
        ),
    }.get(name) or make_method(name, Relaxation())
    for _ in range(5):
        mesh.move(method.step(mesh))
        mesh.update()
    assert np.abs(mesh.points.get() - host.points).max() < 1e-12


def test_projected_displacements(stages):
    """The projection gets Lloyd's displacement times the relaxation, plus a share of the last displacement."""
    mesh, _ = make_mesh(stages)
    velocity = np.random.default_rng(9).normal(0, 0.003, (N, 2))
    mesh.velocity.set(velocity)
    w = stages.density.lloyd_weights(mesh.t, mesh.h)
    lloyd, r = w.lloyd.get(), w.log_ratio.get()
    sums = stages.density.sum_log_ratio(w)
    expected = 1.3 * lloyd + 0.6 * velocity
    correction = stages.engine.empty((N, 2))
    stages.volume_projection.project(
        mesh.t,
        Targets(mesh.local_length, w.gradient, w.log_ratio, mesh.quality, sums),
        stages.engine.upload(expected),
        correction,
        Penalty(0.2, 0.1, 0.3, AT_WALLS_OF_BOXES),
        Limits(1e-2, 25),
    )
    method = ProjectedMethod("lloyd", 1.3, 0.6, penalty=0.2, quality_scale=0.1, log_ratio_scale=0.3, iterations=25)
    d = method.step(mesh)
    assert d.lloyd.get() == pytest.approx(expected, abs=1e-15)
    assert np.array_equal(d.correction.get(), correction.get())
    assert np.abs(r).max() > 0.1


def test_penalty_is_controlled_to_the_error_target(stages):
    """The penalty falls while the error exceeds the target, and grows below it: by a bounded factor, within bounds."""
    mesh, host = make_mesh(stages)
    h = FIELD(host.points)
    error = np.abs(np.log(np.sqrt(host.volumes) / h)).mean()
    assert mesh.mean_log_ratio_error(stages.density.cell_weights(mesh.t, mesh.h)) == pytest.approx(error, rel=1e-9)
    for aim, factor in ((error / 1.2, 1 / 1.2), (error / 50, 0.75), (1.1 * error, 1.1), (50 * error, 1.33)):
        method = ProjectedMethod(penalty=0.1, error_target=aim)
        for _ in range(3):
            method.step(mesh)
        assert method.penalty == 0.1, "the first steps only settle in"
        method.step(mesh)
        assert method.penalty == pytest.approx(0.1 * factor, rel=1e-6)
        for _ in range(40):
            method.step(mesh)
        largest = max(3.0, PENALTY_PER_ERROR * aim)
        assert method.penalty == pytest.approx(np.clip(0.1 * factor**41, 1e-3, largest))
    assert largest > 3.0, "penalties are larger for loose targets"
    # Where walls shape cells, exact projections do not force sizes that are far off.
    for walls, missed, expected in ((False, 0.1, 1e-3), (True, 0.1, 4 * 0.099), (True, 1e-3, 1e-3)):
        at = SimpleNamespace(cuts_cells=False, shapes_cells=walls)
        state = SimpleNamespace(domain=at, mean_log_ratio_error=lambda w, e=missed: e)
        assert ProjectedMethod(penalty=1e-3, careful=True)._penalty_for(state, None).eps == pytest.approx(expected)
    close = ProjectedMethod(penalty=2.9, error_target=0.003)
    close._control_penalty(1e-9)
    assert close.penalty == 3.0


def test_mean_log_ratio_error_of_perfect_cells(stages):
    """An error of 0 is no divisor."""
    mesh, _ = make_mesh(stages, np.array([[0.5, 0.375]]), sizing.Constant(np.sqrt(0.75)))
    method = ProjectedMethod("quality", error_target=0.002)
    for _ in range(6):
        method.step(mesh)
    assert np.isfinite(method.penalty)


def test_updates_check_sizes(stages):
    engine, good = stages.engine, np.array([[0.2, 0.3], [0.6, 0.6], [0.5, 0.1]])
    size = Sizing(engine, patch.BOX, sizing.Expression("x > 0.7 ? 0.0/0.0 : 0.05"))
    mesh = patch.make_mesh(stages, patch.BOX, size, engine.upload(good), size_factor=4)
    first = mesh.summaries.read()["error"].magnitude
    assert first > 0
    mesh.points.set(np.array([[0.2, 0.3], [0.8, 0.6], [0.5, 0.1]]))
    with pytest.raises(SizeFieldError, match=r"nan at \(0\.8, 0\.6\)"):
        mesh.update()
    mesh.points.set(good)
    mesh.update()
    assert mesh.summaries.read()["error"].magnitude == first


def test_names():
    for name in PUBLISHED:
        method = make_method(name, Relaxation(k=0.7))
        if name.startswith("weighted"):
            assert isinstance(method, WeightedMethod)
            assert (method.k, method.poisson) == (0.7, name == "weighted")
        else:
            assert isinstance(method, PublishedMethod)
            assert (method.lloyd, method.poisson) == (name != "poisson", name != "lloyd")


def test_lloyd_in_a_polygon_does_not_depend_on_the_size(ctx):
    """Corners work with the size that the cells have; errors of 20 are said."""
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
    points = np.random.default_rng(0).uniform(0, 1, (300, 2))
    points = points[domain.contains(points)][:120]
    own = (domain.measure / len(points)) ** 0.5
    run = {"points": points, "method": "lloyd", "max_steps": 40, "options": clvoro.PaperOptions(tol=0)}
    adapter = clvoro.Adapter(ctx)
    with pytest.warns(SizeErrorWarning, match="times the sizes of the size field"):
        far = adapter.run(domain, 30 * own, **run)
    assert far.points == pytest.approx(adapter.run(domain, own, **run).points, abs=1e-3 * own)
