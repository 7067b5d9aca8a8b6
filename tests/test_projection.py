"""The derivative of the volumes against differences of Qhull's, and the projection against NumPy."""

import numpy as np
import patch
import pytest
import reference

from clvoro.density import Density
from clvoro.projection import Projection

N = 60
SLOPE = np.array([0.9, -1.4])


@pytest.fixture(scope="module")
def engine(ctx):
    return patch.make_engine(ctx)


def sizes(points):
    return 0.1 * np.exp(points @ SLOPE)


def excess(points, h=None):
    """r = log(V / h^2), V by Qhull; h moves with the field unless it is given."""
    cells = reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)
    return np.log([c.area for c in cells]) - 2 * np.log(sizes(points) if h is None else h)


class Assembled:
    """The operators of a projection, callable with NumPy arrays."""

    def __init__(self, engine, points, h, gradient, eps=None):
        self.engine, self.t = engine, patch.tessellate(engine, points)
        self.n, self.h = len(points), h
        self.projection = Projection(engine)
        self.kernels = self.projection._kernels
        self.eps = engine.upload(np.zeros(self.n) if eps is None else eps)
        self.on_device = engine.upload(h)
        self.projection._reserve(self.n, self.t.neighbours.shape[0])
        p, t = self.projection, self.t
        engine.run_each(
            self.kernels.assemble_derivative, self.n, t.starts, t.neighbours, t.face_measures,
            t.face_centroids, t.volumes, t.points, engine.upload(gradient), self.on_device, self.eps,
            p._rows, p._columns, p._own, p._inverse,
        )  # fmt: skip

    def derivative(self, u, y=None):
        """J u + eps y."""
        p, t, out = self.projection, self.t, self.engine.empty(self.n)
        y = np.zeros(self.n) if y is None else y
        self.engine.run_each(
            self.kernels.apply_derivative, self.n, t.starts, t.neighbours, p._rows, p._own,
            self.engine.upload(u), self.eps, self.engine.upload(y), out,
        )  # fmt: skip
        return out.get()

    def transpose(self, y):
        """W J^T y."""
        p, t, out = self.projection, self.t, self.engine.empty((self.n, 2))
        self.engine.run_each(
            self.kernels.apply_transpose, self.n, t.starts, t.neighbours, p._columns, p._own,
            self.on_device, self.engine.upload(y), out,
        )  # fmt: skip
        return out.get()

    def matrix(self):
        """J, dense (n, 2 n)."""
        columns = np.eye(2 * self.n).reshape(-1, self.n, 2)
        return np.stack([self.derivative(u) for u in columns], axis=1)


@pytest.fixture(scope="module")
def points():
    return patch.relaxed_points(N, 606, steps=4)


@pytest.fixture(scope="module")
def assembled(engine, points):
    eps = np.random.default_rng(88).uniform(0.1, 0.5, N)
    return Assembled(engine, points, sizes(points), np.tile(SLOPE, (N, 1)), eps)


@pytest.fixture(scope="module")
def differences(points):
    """dr/dx by central differences of diagrams made anew, (n, n, 2)."""
    step, J = 1e-6, np.zeros((N, N, 2))
    for j in range(N):
        for a in range(2):
            ahead, behind = points.copy(), points.copy()
            ahead[j, a] += step
            behind[j, a] -= step
            J[:, j, a] = (excess(ahead) - excess(behind)) / (2 * step)
    return J


def test_derivative(assembled, differences):
    """Every cell by every generator, walls included; the field's own gradient is on the diagonal."""
    J = assembled.matrix().reshape(N, N, 2)
    # Volumes of 0.01 to 1e-13 of the box over a step of 1e-6.
    assert pytest.approx(differences, abs=1e-4) == J
    assert np.abs(J).max() > 5


def test_transpose(assembled):
    """<J u, y> = <u, J^T y>, with W = h^2 taken out."""
    rng = np.random.default_rng(3)
    for _ in range(3):
        u, y = rng.normal(size=(N, 2)), rng.normal(size=N)
        left = assembled.derivative(u) @ y
        right = (u * assembled.transpose(y) / assembled.h[:, None] ** 2).sum()
        assert left == pytest.approx(right, rel=1e-12, abs=1e-12)


def test_penalty_and_diagonal(assembled):
    rng = np.random.default_rng(4)
    u, y = rng.normal(size=(N, 2)), rng.normal(size=N)
    eps = assembled.eps.get()
    assert assembled.derivative(u, y) == pytest.approx(assembled.derivative(u) + eps * y, rel=1e-12)
    J = assembled.matrix()
    W = np.repeat(assembled.h**2, 2)
    diagonal = np.einsum("ij,j,ij->i", J, W, J) + eps
    # The dense matrix is made of the faces' derivatives in single precision, the diagonal is not.
    assert assembled.projection._inverse.get() == pytest.approx(1 / diagonal, rel=1e-6)


def project(engine, points, h, gradient, r, displacement, **options):
    out = engine.empty((len(points), 2))
    quality = options.pop("quality", np.ones(len(points)))
    solution = Projection(engine).project(
        patch.tessellate(engine, points), engine.upload(h), engine.upload(gradient), engine.upload(r),
        engine.upload(displacement), out, engine.upload(quality), **options,
    )  # fmt: skip
    return out.get(), solution


@pytest.mark.parametrize("bound", [0.0, 0.2])
def test_projection(engine, points, assembled, bound):
    """u' = -W J^T (J W J^T + eps)^-1 (r + J Ld), by dense algebra; a cell that is far off has the smaller eps."""
    r, lloyd = excess(points), np.random.default_rng(14).normal(0, 0.01, (N, 2))
    eps = 0.02 / (1 + (r / bound) ** 2 if bound else np.ones(N))
    J, W = assembled.matrix(), np.repeat(assembled.h**2, 2)
    y = np.linalg.solve(J * W @ J.T + np.diag(eps), r + J @ lloyd.ravel())
    expected = -(W * (J.T @ y)).reshape(N, 2)
    correction, solution = project(
        engine, points, assembled.h, np.tile(SLOPE, (N, 1)), r, lloyd, eps=0.02, bound=bound,
        max_iterations=1000, tolerance=1e-12,
    )  # fmt: skip
    assert solution.converged
    assert correction == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())


def test_lenience(engine, points, assembled):
    """eps grows with -log Q of the worst cell around, up to 3."""
    r, nothing = excess(points), np.zeros((N, 2))
    quality = np.random.default_rng(15).uniform(0.3, 1, N)
    host = patch.fetch(assembled.t)
    worst = quality.copy()
    inner = host.neighbours >= 0
    np.minimum.at(worst, host.owners[inner], quality[host.neighbours[inner]])
    eps = np.minimum(0.2 * (1 + (np.log(worst) / 0.3) ** 2), 3)
    assert 5 < (eps == 3).sum() < N - 5
    J, W = assembled.matrix(), np.repeat(assembled.h**2, 2)
    expected = -(W * (J.T @ np.linalg.solve(J * W @ J.T + np.diag(eps), r))).reshape(N, 2)
    correction, _ = project(
        engine, points, assembled.h, np.tile(SLOPE, (N, 1)), r, nothing, eps=0.2, lenience=0.3,
        quality=quality, max_iterations=1000, tolerance=1e-12,
    )  # fmt: skip
    assert correction == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(expected).max())


def test_perturbed_mesh_is_mended_quadratically(engine):
    """Targets are a mesh's own sizes, so that excess arises by the perturbation alone; one projection squares it."""
    points = patch.relaxed_points(N, 607)
    h = np.exp(excess(points, np.ones(N)) / 2)
    noise = np.random.default_rng(21).normal(size=(N, 2))
    left = []
    for amount in (2e-3, 1e-3, 5e-4):
        moved = points + amount * noise
        r = excess(moved, h)
        weight = np.exp(r)
        r -= np.average(r, weights=weight)
        u, _ = project(
            engine, moved, h, np.zeros((N, 2)), r, np.zeros((N, 2)), eps=1e-9, max_iterations=3000, tolerance=1e-12
        )  # fmt: skip
        after = excess(moved + u, h)
        left.append(np.abs(after - after.mean()).max())
        assert left[-1] < 0.1 * np.abs(r).max()
    # Each half of the perturbation leaves a quarter.
    assert left[1] < 0.35 * left[0]
    assert left[2] < 0.35 * left[1]


def test_single_precision(ctx, points):
    engine = patch.make_engine(ctx, "float32")
    r = excess(points)
    gradient, nothing = np.tile(SLOPE, (N, 1)), np.zeros((N, 2))
    options = {"eps": 0.05, "max_iterations": 60}
    u, solution = project(engine, points, sizes(points), gradient, r, nothing, **options)
    exact, _ = project(
        patch.make_engine(ctx), points, sizes(points), gradient, r, nothing, **options
    )
    assert solution.residual < 1e-5
    assert np.abs(u - exact).max() < 1e-4 * np.abs(exact).max()


def test_one_cell(engine):
    """No neighbours: nothing can be done, and nothing breaks."""
    one = np.array([[0.4, 0.3]])
    t = patch.tessellate(engine, one)
    w = Density(engine).evaluate(t, engine.upload([0.2]))
    u, _ = project(
        engine, one, np.array([0.2]), w.gradient.get(), w.excess.get(), np.zeros((1, 2)), eps=0.1, max_iterations=40
    )  # fmt: skip
    assert not u.any()
