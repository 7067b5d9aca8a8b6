"""The projection against dense algebra in 2D and 3D, in periodic boxes, a ball, on a sphere, and with fixed ones."""

import numpy as np
import pytest

from clvoro.geometry.solid.solid import Solid
from clvoro.geometry.sphere import Sphere
from clvoro.solvers import volume_projection as projection
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.volume_projection import Penalty, Targets, VolumeProjection
from tests.reference import patch

BALL = Solid.ball((0.5, 0.5, 0.5), 0.5, edge=0.2)
EPS, QUALITY_SCALE, LOG_RATIO_SCALE = 0.2, 0.3, 0.4


class Given:
    """A diagram with random targets, so that nothing cancels."""

    def __init__(self, engine, box, share):
        self.box, self.n = box, 250 if box.dim == 3 and any(box.periodic) else 70
        self.fixed, rng = int(share * self.n), np.random.default_rng(5501)
        self.engine, self.power = engine, 4 if share else 2
        self.t = patch.tessellate_box(engine, box, self.n, 5502)
        self.labels = rng.permutation(self.n)
        self.held = self.labels < self.fixed
        self.h = 0.1 * np.exp(rng.uniform(-1, 1, self.n))
        self.gradient = rng.normal(size=(self.n, box.dim))
        self.log_ratio = rng.normal(size=self.n)
        self.quality = rng.uniform(0.3, 1, self.n)
        self.displacement = 0.01 * rng.normal(size=(self.n, box.dim))
        self.displacement[self.held] = 0
        if box.cell_dim < box.dim:
            normal = patch.fetch(self.t).points
            self.displacement -= (self.displacement * normal).sum(axis=1)[:, None] * normal

    def project(self, tolerance, max_iterations):
        """Return the solution, the correction, the next start, and the arrays of the iteration."""
        u, start = self.engine.empty((self.n, self.box.dim)), self.engine.empty(self.n, np.float32)
        names = ("h", "gradient", "log_ratio", "quality", "displacement")
        *targets, displacement = (self.engine.upload(getattr(self, name)) for name in names)
        stage, taken = VolumeProjection(self.engine), []
        reserve = stage._reserve
        stage._reserve = lambda *args: taken.append(reserve(*args)) or taken[-1]
        solution = stage.project(
            self.t,
            Targets(*targets),
            displacement,
            u,
            Penalty(EPS, QUALITY_SCALE, LOG_RATIO_SCALE, power=self.power),
            Limits(tolerance, max_iterations),
            labels=self.engine.upload(self.labels, np.int32),
            fixed=self.fixed,
            start=start,
        )
        return solution, u.get(), start.get(), taken[0]

    def operator(self):
        """J = d log_ratio / dx (n, n, d) by the diagram's faces, and eps (n,)."""
        host, dim = patch.fetch(self.t), self.box.dim
        J, worst = np.zeros((self.n, self.n, dim)), self.quality.copy()
        ways = patch.ways(host, self.box)
        for k in np.flatnonzero(host.neighbors >= 0):
            i, j, d = host.owners[k], host.neighbors[k], ways[k]
            w, m = host.face_measures[k] / np.linalg.norm(d), host.face_centroids[k]
            J[i, i] += w / host.volumes[i] * m
            worst[i] = min(worst[i], self.quality[j])
            # In a solid both cells have a face of their own: the mean of the derivatives by both.
            J[i, j] += w / host.volumes[i] * (d - m) / 2
            J[j, i] -= w / host.volumes[j] * m / 2
        J[np.arange(self.n), np.arange(self.n)] -= self.box.cell_dim * self.gradient
        if self.box.cell_dim < dim:  # on a sphere generators move in their tangent planes
            normal = host.points
            J -= np.einsum("ija,ja->ij", J, normal)[:, :, None] * normal
        J[:, self.held] = 0
        eps = np.minimum(EPS * (1 + (1 - worst) ** 2 / worst / QUALITY_SCALE**2), 3)
        return J, eps / (1 + (self.log_ratio / LOG_RATIO_SCALE) ** self.power)


@pytest.fixture(
    scope="module",
    params=[
        ("plane", "float64", None),
        ("plane", "float32", None),
        ("plane", "float64", 16),
        ("space", "float64", None),
        ("space", "float32", 16),
        ("torus", "float64", None),
        ("slab", "float64", None),
        ("sphere", "float64", None),
        ("sphere", "float32", 16),
        ("ball", "float64", None),
        ("ball", "float32", 16),
    ],
    ids=lambda p: f"{p[0]}, {p[1]}" + (", groups" if p[2] else ""),
)
def kind(ctx, request):
    name, real, group_size = request.param
    box = {"sphere": Sphere(1), "ball": BALL}.get(name) or patch.BOXES[name]
    return patch.make_engine(ctx, real, box.dim, group_size, box), box


@pytest.mark.sparse(2)
@pytest.mark.parametrize("share", [0.0, 1 / 3], ids=["", "held"])
def test_correction(kind, share, monkeypatch):
    """u = -W J^T y with (J W J^T + eps) y = r + J Ld, by dense algebra; in many launches and in one."""
    given = Given(*kind, share)
    host = patch.fetch(given.t)
    J, eps = given.operator()
    B = (J * given.h[None, :, None]).reshape(given.n, -1)
    b = given.log_ratio + np.einsum("ija,ja->i", J, given.displacement)
    y = np.linalg.solve(B @ B.T + np.diag(eps), b)
    expected = -(B.T @ y).reshape(given.n, -1) * given.h[:, None]
    tolerance = 1e-6 if given.engine.real == np.float32 else 1e-11
    for alone in (0, 1000):
        monkeypatch.setattr(projection, "one_group_limit", lambda engine, most=alone: most)
        solution, u, start, v = given.project(max_iterations=500, tolerance=tolerance)
        assert solution.converged
        # Derivatives in single precision, in a system whose condition number is a thousand.
        assert u == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())
        assert start == pytest.approx(y, abs=1e-5 * np.abs(y).max())
        assert not u[given.held].any()
        # Single precision; faces to fixed generators contribute nothing.
        assert v.inverse.get() == pytest.approx(1 / ((B**2).sum(axis=1) + eps), rel=1e-5)
        beyond = host.neighbors >= 0
        beyond[beyond] = given.held[host.neighbors[beyond]]
        assert not v.rows.get()[:, : len(beyond)][:, beyond].any()
