"""The derivative of the volumes against differences of Qhull's, and the projection against NumPy."""

import math
import warnings

import numpy as np
import pytest

from clvoro.adaptation.density import Density
from clvoro.errors import SolverError
from clvoro.opencl.engine import Engine
from clvoro.solvers import volume_projection as projection
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.volume_projection import Penalty, Targets, VolumeProjection
from tests.reference import diagrams as reference
from tests.reference import patch

N = 60
SOME = range(0, N, 3)
SLOPE = np.array([0.9, -1.4])


@pytest.fixture(
    scope="module",
    params=[(None, 0), (16, 0), (None, 1000), (16, 1000)],
    ids=["cpu", "gpu", "cpu, one group", "gpu, one group"],
)
def engine(ctx, request):
    """On a CPU and as on a GPU; in many launches and in one."""
    group_size, alone = request.param
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(projection, "one_group_limit", lambda engine: alone)
        yield patch.make_engine(ctx, group_size=group_size)


def sizes(points):
    return 0.1 * np.exp(points @ SLOPE)


def log_ratios(points, h=None):
    """r = log(V / h^2), V by Qhull; h moves with the field unless it is given."""
    cells = reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)
    return np.log([c.area for c in cells]) - 2 * np.log(sizes(points) if h is None else h)


class Assembled:
    """The operator of a projection in NumPy, from the assembled arrays."""

    def __init__(self, engine, points, h, gradient, r=None, displacement=None, **options):
        n = len(points)
        t, projection = patch.tessellate(engine, points), VolumeProjection(engine)
        given = {"r": np.zeros(n), "displacement": np.zeros((n, 2)), "quality": np.ones(n)}
        given |= {"r": r} if r is not None else {}
        given |= {"displacement": displacement} if displacement is not None else {}
        given["quality"] = options.pop("quality", given["quality"])
        taken, reserve = [], projection._reserve
        projection._reserve = lambda *args: taken.append(reserve(*args)) or taken[-1]
        sums = options.pop("sums", None)
        targets = Targets(
            *map(engine.upload, (h, gradient, given["r"], given["quality"])),
            sums=None if sums is None else engine.upload(sums),
        )
        projection.project(
            t, targets, engine.upload(given["displacement"]), engine.empty((n, 2)), Penalty(**options), Limits(1e-12, 0)
        )
        host, (v,) = patch.fetch(t), taken
        self.eps, self.rhs = v.eps.get(), v.r.get()
        inner = host.neighbors >= 0
        i, j = host.owners[inner], host.neighbors[inner]
        m = len(host.neighbors)
        self.B = np.zeros((n, n, 2))  # J h, for displacements over h
        np.add.at(self.B, (i, j), v.rows.get()[:, :m][:, inner].T)
        self.B[np.arange(n), np.arange(n)] = v.own.get()
        self.h = h

    def derivative(self):
        """J = dr / dx, dense (n, n, 2)."""
        return self.B / self.h[:, None]

    def correction(self, b):
        """-W J^T (J W J^T + eps)^-1 b."""
        B = self.B.reshape(len(self.h), -1)
        u = -B.T @ np.linalg.solve(B @ B.T + np.diag(self.eps), b)
        return u.reshape(-1, 2) * self.h[:, None]


@pytest.fixture(scope="module")
def points():
    return patch.relaxed_points(N, 606, steps=4)


@pytest.fixture(scope="module")
def assembled(engine, points):
    return Assembled(engine, points, sizes(points), np.tile(SLOPE, (N, 1)), eps=0.3)


@pytest.fixture(scope="module")
def differences(points):
    """dr/dx of the generators `SOME` by central differences of new diagrams, (n, k, 2)."""
    step, J = 1e-6, np.zeros((N, len(SOME), 2))
    for k, j in enumerate(SOME):
        for a in range(2):
            ahead, behind = points.copy(), points.copy()
            ahead[j, a] += step
            behind[j, a] -= step
            J[:, k, a] = (log_ratios(ahead) - log_ratios(behind)) / (2 * step)
    return J


@pytest.mark.sparse(1)
def test_derivative(assembled, differences):
    """Every cell by every third generator, walls included; the field's own gradient is on the diagonal."""
    # Volumes of 0.01 to 1e-13 of the box over a step of 1e-6; single precision is finer.
    assert pytest.approx(differences, abs=1e-4) == assembled.derivative()[:, SOME]
    assert np.abs(assembled.derivative()).max() > 5


def test_mean_is_subtracted(engine, points):
    """Partial sums of V rho r and V rho, of any number of groups: their ratio is the mean of r."""
    r, given = log_ratios(points), (engine, points, sizes(points), np.tile(SLOPE, (N, 1)))
    penalty = {"eps": 0.3, "log_ratio_scale": 0.4}
    parts = np.random.default_rng(3).uniform(0.5, 2, (2, 37))
    made = Assembled(*given, r, sums=parts.ravel(), **penalty)
    mean = parts[0].sum() / parts[1].sum()
    assert made.rhs == pytest.approx(r - mean, abs=1e-13)
    expected = Assembled(*given, r - mean, **penalty)
    assert made.eps == pytest.approx(expected.eps, rel=1e-6)


def project(engine, points, h, gradient, r, displacement, tolerance=1e-6, **options):
    out = engine.empty((len(points), 2))
    targets = Targets(*map(engine.upload, (h, gradient, r, np.ones(len(points)))))
    penalty = Penalty(
        options.pop("eps"), log_ratio_scale=options.pop("log_ratio_scale", 0.0), power=options.pop("power", 2)
    )
    solution = VolumeProjection(engine).project(
        patch.tessellate(engine, points),
        targets,
        engine.upload(displacement),
        out,
        penalty,
        Limits(tolerance, options.pop("max_iterations")),
        **options,
    )
    return out.get(), solution


@pytest.mark.sparse(2)
@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3, 1e-5])
def test_tolerance(engine, points, tolerance):
    """The residual by dense algebra equals that of the recurrence; vectors are in single precision down to 1e-4."""
    r, h, gradient = log_ratios(points), sizes(points), np.tile(SLOPE, (N, 1))
    made = Assembled(engine, points, h, gradient, r, eps=0.05)
    u, solution = project(
        engine, points, h, gradient, r, np.zeros((N, 2)), eps=0.05, max_iterations=60, tolerance=tolerance
    )
    assert solution.converged
    assert solution.residual <= tolerance < solution.residuals[-2]
    # u = -W J^T y for some y. The residual of the best y for this u is nearly the reported one.
    B, scaled = made.B.reshape(N, -1), (u / h[:, None]).ravel()
    y = -np.linalg.lstsq(B.T, scaled, rcond=None)[0]
    left = np.linalg.norm(r - (B @ B.T + np.diag(made.eps)) @ y) / np.linalg.norm(r)
    assert left == pytest.approx(solution.residual, rel=0.05)


def test_max_iterations(engine, points):
    given = (points, sizes(points), np.tile(SLOPE, (N, 1)), log_ratios(points), np.zeros((N, 2)))
    _, solution = project(engine, *given, eps=0.02, max_iterations=5, tolerance=1e-9)
    assert (solution.iterations, solution.converged) == (5, False)
    assert solution.reason == "max_iterations"


def test_unwritten_rows_of_the_record_cause_no_warning(ctx, points, monkeypatch):
    """The host may read unwritten rows of the record, and new memory can contain signaling NaNs."""
    engine, plain = patch.make_engine(ctx, "float32"), Engine.empty

    def full_of_nan(self, shape, dtype=None):
        array = plain(self, shape, dtype)
        if array.dtype == np.float32 and array.size:
            array.view(np.uint32).fill(np.uint32(0x7FA00001))
        return array

    given = (points, sizes(points), np.tile(SLOPE, (N, 1)), log_ratios(points), np.zeros((N, 2)))
    monkeypatch.setattr(Engine, "empty", full_of_nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, solution = project(engine, *given, eps=0.1, max_iterations=40, tolerance=1e-3)
    assert solution.converged


@pytest.mark.sparse(1)
def test_result_does_not_depend_on_the_lookahead(engine, points):
    given = (points, sizes(points), np.tile(SLOPE, (N, 1)), log_ratios(points))
    t, results = patch.tessellate(engine, points), []
    for ahead in (1, 2, 7, 40):
        projection, out = VolumeProjection(engine), engine.empty((N, 2))
        projection._ahead = ahead
        h, gradient, r = (engine.upload(a) for a in given[1:])
        solution = projection.project(
            t,
            Targets(h, gradient, r, engine.upload(np.ones(N))),
            engine.zeros((N, 2)),
            out,
            Penalty(0.1),
            Limits(1e-3, 40),
        )
        results.append((out.get(), solution.residuals))
    for u, residuals in results[1:]:
        assert np.array_equal(u, results[0][0])
        assert np.array_equal(residuals, results[0][1])


@pytest.mark.sparse(6)
@pytest.mark.parametrize("of", ["solution", "scaled", "turned", "other", "zero"])
def test_start(engine, points, of):
    """The solution does not depend on the start, and becomes the next start; a good start saves iterations."""
    given = (points, sizes(points), np.tile(SLOPE, (N, 1)), log_ratios(points), np.zeros((N, 2)))
    made = Assembled(engine, *given, eps=0.05)
    B = made.B.reshape(N, -1)
    y = np.linalg.solve(B @ B.T + np.diag(made.eps), made.rhs)
    start = {
        "solution": y,
        "scaled": 1e6 * y,
        "turned": -y,
        "zero": 0 * y,
        "other": np.random.default_rng(31).normal(size=N),
    }[of]
    options = {"eps": 0.05, "max_iterations": 1000, "tolerance": 1e-12}
    _, cold = project(engine, *given, **options)
    on_device = engine.upload(start, np.float32)
    u, solution = project(engine, *given, **options, start=on_device, warm=True)
    assert solution.converged
    assert len(solution.residuals) == solution.iterations + 1
    # B and its transpose differ by 1e-7 of the faces'; the condition number is a few hundred.
    expected = made.correction(made.rhs)
    assert u == pytest.approx(expected, abs=3e-5 * np.abs(expected).max())
    assert on_device.get() == pytest.approx(y, abs=3e-5 * np.abs(y).max())
    # A start in single precision leaves the residual at some 1e-7 of the right side.
    good = of in ("solution", "scaled", "turned")
    assert (solution.residuals[1] < 1e-5) == good
    assert solution.iterations < cold.iterations if good else solution.iterations <= cold.iterations + 5
    # A projection from a start that is at its target needs no more.
    rough = {**options, "tolerance": 1e-5}
    _, again = project(engine, *given, **rough, start=on_device, warm=True)
    assert again.iterations == 1


def test_not_finite(engine, points):
    """Where the host learns of it later, nothing moves; a further projection does not hide the error."""
    r, stage = log_ratios(points), VolumeProjection(engine)
    r[7] = np.nan
    t, gradient = patch.tessellate(engine, points), np.tile(SLOPE, (N, 1))
    targets = Targets(*map(engine.upload, (sizes(points), gradient, r, np.ones(N))))
    moves = engine.upload(np.full((2, N, 2), 0.3))
    both = [moves[0].copy(), moves[1].copy()]
    solutions = []

    def project_twice():
        solutions.append(stage.project(t, targets, *both, Penalty(0.1), Limits(1e-6, 9)))
        assert not any(move.get().any() for move in both)
        stage.project(t, targets, *both, Penalty(0.1), Limits(1e-6, 90))

    with pytest.raises(SolverError, match="not finite"):
        project_twice()


def test_penalty_of_bad_cells(engine, points, assembled):
    """eps grows with (1 - Q) / sqrt Q of the worst cell around, up to 3; walls have a scale and a bound."""
    quality = np.random.default_rng(15).uniform(0.3, 1, N)
    host = patch.fetch(patch.tessellate(engine, points))
    worst = quality.copy()
    inner = host.neighbors >= 0
    np.minimum.at(worst, host.owners[inner], quality[host.neighbors[inner]])

    def penalties(scale, penalty=0.2):
        return np.minimum(penalty * (1 + (1 - worst) ** 2 / worst / scale**2), 3)

    eps = penalties(0.3)
    on_wall = np.zeros(N, bool)
    on_wall[host.owners[~inner]] = True
    assert 5 < on_wall.sum() < N - 5
    assert 5 < (eps == 3).sum() < N - 5
    for at_walls, most in ((1.0, math.inf), (2.0, math.inf), (1.0, 0.05)):
        made = Assembled(
            engine,
            points,
            sizes(points),
            np.tile(SLOPE, (N, 1)),
            eps=0.2,
            quality_scale=0.3,
            at_walls=at_walls,
            most_at_walls=most,
            quality=quality,
        )
        expected = np.where(on_wall, penalties(0.3 * at_walls, min(most, 0.2)), eps)
        assert made.eps == pytest.approx(expected, rel=1e-5)  # of single precision


@pytest.mark.sparse(2)
def test_perturbed_mesh_converges_quadratically(engine):
    """Targets are a mesh's own sizes, so that log ratios arise from the perturbation; one projection squares them."""
    points = patch.relaxed_points(N, 607)
    h = np.exp(log_ratios(points, np.ones(N)) / 2)
    noise = np.random.default_rng(21).normal(size=(N, 2))
    left = []
    for amount in (2e-3, 1e-3, 5e-4):
        moved = points + amount * noise
        r = log_ratios(moved, h)
        weight = np.exp(r)
        r -= np.average(r, weights=weight)
        u, _ = project(
            engine, moved, h, np.zeros((N, 2)), r, np.zeros((N, 2)), eps=1e-6, max_iterations=3000, tolerance=1e-8
        )
        after = log_ratios(moved + u, h)
        left.append(np.abs(after - after.mean()).max())
        assert left[-1] < 0.1 * np.abs(r).max()
    # Each half of the perturbation leaves a quarter.
    assert left[1] < 0.35 * left[0]
    assert left[2] < 0.35 * left[1]


def test_one_cell(engine):
    """No neighbors: nothing can be done, and nothing breaks."""
    one = np.array([[0.4, 0.3]])
    t = patch.tessellate(engine, one)
    w = Density(engine).lloyd_weights(t, engine.upload([0.2]))
    u, _ = project(
        engine, one, np.array([0.2]), w.gradient.get(), w.log_ratio.get(), np.zeros((1, 2)), eps=0.1, max_iterations=40
    )
    assert not u.any()
