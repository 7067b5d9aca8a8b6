"""Optimally transported generators: x = xi + grad phi, with phi from the Monge-Ampere equation on a lattice.

    rho(x) det(I + H) = const,   rho = h^-d,   H = the second derivatives of phi,   no displacement through walls

The unknown is phi at the points xi of the lattice. Its derivatives are those of the quadratic that fits the neighbors
and their mirror images by least squares. One step is one step of Newton's method for the logarithm of the equation
(Loeper and Rapetti, C. R. Acad. Sci. Paris 340, 2005), shortened so that I + H stays positive definite: then the map is
the gradient of a convex function, the optimal transport of the density (Budd, Huang, Russell, Acta Numerica 18, 2009;
McRae, Cotter, Budd, SIAM J. Sci. Comput. 40, 2018). It is solved on the host, in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy

from ...arguments import warn
from ...connectivity import rows_and_places
from ...errors import TangledMeshWarning
from ...geometry.domain import Domain
from ...solvers.linear_system import Solution
from ..motion import Displacement, Method
from ..state import MeshState
from .lattice import mirrored

REACH = 1.5
"""Distance of neighbors over the spacing of the lattice: 6 in a hexagonal one, 14 in a body-centered cubic one, and
mirror images of the neighbors along a wall."""
SHORTEST = 2.0**-10
"""Shortest share of Newton's step."""
LEAST_STRETCH = 0.3
"""Smallest eigenvalue of I + H after a step, over that before."""
CONVERGED = {np.dtype(np.float64): 1e-6, np.dtype(np.float32): 1e-3}
"""Standard deviation of the logarithm of rho det(I + H) that is not reduced any more."""
TOLERANCE, MOST_ITERATIONS = 1e-2, 2000
"""Limits of the linear solves."""
ANCHOR = 1e-6
"""Share of the mean diagonal that is added, because constants are in the null space: the solution is then exact up to a
constant on the right side, and one in phi."""


class LatticeMap:
    """Maps x = xi + grad phi of a lattice (n, d) in a box.

    - `gradient`: list of d sparse arrays (n, n)
    - `hessian` dict of sparse arrays (n, n): by their two axes, the first one not larger.
    """

    def __init__(self, domain: Domain, points: np.ndarray) -> None:
        self.domain, self.points = domain, points
        self.lower, self.upper = np.array(domain.lower), np.array(domain.upper)
        n, d = points.shape
        spacing = (domain.measure / n) ** (1 / d)
        images = mirrored(points, self.lower, self.upper, REACH * spacing)
        lists = scipy.spatial.KDTree(points).query_ball_tree(scipy.spatial.KDTree(images.points), REACH * spacing)
        counts = np.array([len(found) for found in lists])
        near = np.concatenate(lists).astype(int)
        # Each point is in its own list. Its entry is zero.
        rows, places = rows_and_places(counts)
        away = (images.points[near] - points[rows]) / spacing
        pairs = [(a, b) for a in range(d) for b in range(a, d)]
        terms = [away, *(away[:, [a]] * away[:, [b]] * (0.5 if a == b else 1.0) for a, b in pairs)]
        weights = 1 / np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        systems = np.zeros((n, counts.max(), d + len(pairs)))
        systems[rows, places] = np.concatenate(terms, axis=1) * weights[:, None]
        fits = np.linalg.pinv(systems, rcond=1e-6).swapaxes(1, 2)[rows, places] * weights[:, None]
        columns = images.owners[near]

        def operator(values: np.ndarray) -> scipy.sparse.csr_array:
            matrix = scipy.sparse.coo_array((values, (rows, columns)), shape=(n, n)).tocsr()
            return matrix - scipy.sparse.diags_array(matrix.sum(axis=1))

        self.gradient = [operator(fits[:, a] / spacing) for a in range(d)]
        self.hessian = {pair: operator(fits[:, d + k] / spacing**2) for k, pair in enumerate(pairs)}

    def place(self, phi: np.ndarray) -> np.ndarray:
        """Return x (n, d), mirrored into the box."""
        x = self.points + np.column_stack([g @ phi for g in self.gradient])
        x = np.where(x < self.lower, 2 * self.lower - x, x)
        x = np.where(x > self.upper, 2 * self.upper - x, x)
        return np.clip(x, self.lower, self.upper)

    def jacobian(self, phi: np.ndarray) -> np.ndarray:
        """Return I + H, (n, d, d)."""
        d = self.domain.dim
        found = np.zeros((len(phi), d, d))
        for (a, b), operator in self.hessian.items():
            found[:, a, b] = found[:, b, a] = operator @ phi
        return found + np.eye(d)

    def newton(self, jacobian: np.ndarray, slope: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the change of phi that cancels `residual` (n,) up to a constant, and the iterations of the solver.

        The derivative of log(rho det(I + H)) is (I + H)^-1 : H' + grad log rho . grad phi'. `slope` (n, d) is
        grad log rho at x.
        """
        inverse = np.linalg.inv(jacobian)
        matrix = sum(
            scipy.sparse.diags_array((1 if a == b else 2) * inverse[:, a, b]) @ operator
            for (a, b), operator in self.hessian.items()
        ) + sum(scipy.sparse.diags_array(slope[:, a]) @ g for a, g in enumerate(self.gradient))
        matrix = scipy.sparse.csr_array(-matrix)
        anchor = ANCHOR * np.abs(matrix.diagonal()).mean()
        matrix = matrix + scipy.sparse.diags_array(np.full(len(residual), anchor))
        change, iterations = _solve(scipy.sparse.csr_array(matrix), residual)
        return change - change.mean(), iterations


def _solve(matrix: scipy.sparse.csr_array, side: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the solution by BiCGStab with Jacobi's preconditioner, and the number of iterations.

    SciPy's takes scalar products by threads: their last bits would depend on the number of cores.
    """

    def dot(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.add.reduce(a * b))

    inverse, x, residual = 1 / matrix.diagonal(), np.zeros(len(side)), side.copy()
    v, p = np.zeros(len(side)), np.zeros(len(side))
    rho = alpha = omega = 1.0
    for iteration in range(MOST_ITERATIONS):
        if dot(residual, residual) <= TOLERANCE**2 * dot(side, side):
            return x, iteration
        before, rho = rho, dot(side, residual)
        p = residual + rho / before * (alpha / omega) * (p - omega * v)
        y = inverse * p
        v = matrix @ y
        along = dot(side, v)
        if along == 0 or rho == 0:
            return x, iteration
        alpha = rho / along
        middle = residual - alpha * v
        z = inverse * middle
        t = matrix @ z
        omega = dot(t, middle) / max(dot(t, t), 1e-300)
        if omega == 0:
            return x + alpha * y, iteration
        x = x + alpha * y + omega * z
        residual = middle - omega * t
    return x, MOST_ITERATIONS


@dataclass
class MongeAmpereMethod(Method):
    """One step of Newton's method for the Monge-Ampere equation. `mesh.potential` is phi."""

    lattice: np.ndarray = field(repr=False)
    """(n, d) float64. The generators at the start, in the order of their labels."""
    tolerance: float = 1e-3
    """Standard deviation of the logarithm of rho det(I + H) below which the method is finished."""
    share: float = 1.0
    """Share of Newton's step that the last step has taken."""
    warned: int = 0
    """1 after a warning. Then the map stays."""
    finished: bool | None = False
    """Whether the equation is solved to the tolerance."""
    map: LatticeMap | None = field(default=None, repr=False)

    def step(self, mesh: MeshState) -> Displacement:
        """Evaluate the displacement as the correction; `lloyd` is zero."""
        if self.map is None:
            self.map = LatticeMap(mesh.domain, self.lattice)
        labels, (_, scale) = mesh.labels.get(), mesh.domain.frame
        phi = np.empty(mesh.n)
        phi[labels] = mesh.potential.get().astype(float) * scale**2
        change, solution = self._step(mesh, phi)
        mesh.potential.set((change[labels] / scale**2).astype(mesh.engine.real))
        x = mesh.domain.place(self.map.place(change), np.dtype(np.float64))[labels]
        lloyd, correction = mesh.engine.scratch(x.shape), mesh.engine.scratch(x.shape)
        lloyd.fill(0)
        correction.set((x - mesh.points.get()).astype(mesh.engine.real))
        mesh.summarize_displacements(lloyd, correction)
        return Displacement(lloyd, correction, mesh.h, solution=solution)

    def _step(self, mesh: MeshState, phi: np.ndarray) -> tuple[np.ndarray, Solution]:
        """Return phi after one step."""
        assert self.map is not None
        if self.warned:
            return phi, Solution.zero()
        d, jacobian = mesh.domain.dim, self.map.jacobian(phi)
        x = self.map.place(phi)

        def residual(x: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
            log = np.log(np.linalg.det(jacobian)) - d * np.log(np.asarray(mesh.sizing(x)))
            return log - log.mean()

        stretch = np.linalg.eigvalsh(jacobian)[:, 0]
        before = residual(x, jacobian)
        self.finished = bool(before.std() < self.tolerance)
        if before.std() < CONVERGED[mesh.engine.real]:
            return phi, Solution.zero()
        change, iterations = self.map.newton(jacobian, -d * _slope(mesh, x), before)
        share, bad = min(1.0, 4 * self.share), np.zeros(mesh.n, bool)
        while share >= SHORTEST:
            new = phi + share * change
            jacobian = self.map.jacobian(new)
            bad = np.linalg.eigvalsh(jacobian)[:, 0] < LEAST_STRETCH * stretch
            if not bad.any():
                after = residual(self.map.place(new), jacobian)
                if after.std() < (1 - 0.1 * share) * before.std():
                    break
            share /= 2
        else:
            self._warn(int(bad.sum()), mesh.n, float(before.std()))
            return phi, Solution(iterations, float(before.std()), np.zeros(1), False, "stagnated")
        self.share = share
        return new, Solution(iterations, float(after.std()), np.zeros(1), True, "converged")

    def _warn(self, folded: int, n: int, residual: float) -> None:
        if not self.warned:
            self.warned = 1
            reason = (
                f"the map would fold at {folded} of {n} generators"
                if folded
                else "no step of Newton's method improves the map"
            )
            warn(
                f"monge-ampere: {reason}. It stops with volumes that are off by a factor of {np.exp(residual):.3g}, "
                "because the size field changes too much over a cell; use method='adaptive', or limit the growth of "
                "the sizes (clvoro.sizing.Graded)",
                TangledMeshWarning,
            )


def _slope(mesh: MeshState, x: np.ndarray) -> np.ndarray:
    """Return grad log h at x (n, d)."""
    engine, scale = mesh.engine, mesh.domain.frame[1]
    points = engine.upload(mesh.domain.place(x, engine.real))
    sizes, gradient = engine.empty(len(x)), engine.empty(x.shape)
    mesh.sizing.evaluate_with_gradient(points, len(x), sizes, gradient)
    return gradient.get().astype(float) / scale
