"""Fluxes through the faces of a mesh, projected so that they are free of divergence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from ..errors import InputError
from ..sizing.graded import default_engine
from ..solvers.poisson import Laplacian, Poisson
from .mesh import FoamMesh

MOST_DIVERGENCE = 1e-10
"""Largest sum of the fluxes out of a cell, over the mean flux through a face."""
_DIRECT = 20_000  # cells up to which a factorization costs less than iterations
_TOLERANCE = 1e-12
_UNBALANCED = 0.1
"""Difference of what enters and leaves, over the larger one, that is no matter of how a mesh resolves the boundary."""
_NOTHING = 1e-6  # share of the largest velocity times the boundary


def project_fluxes(mesh: FoamMesh, velocity: np.ndarray, at_boundary: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """Return fluxes near those of a velocity whose sum out of each cell is zero.

    The velocity is interpolated to the faces, and the gradient of a potential q is subtracted from it, which solves
    ``sum over faces of (A / d) (q_j - q_i) = sum of the fluxes out of cell i``, with q = 0 beyond open faces.

    - `velocity` (n, 3) float64: in the cells.
    - `at_boundary` (b,) float64: fluxes through the faces of the boundary, out of the domain. If none of them is open,
      those that leave the domain are scaled to the sum of those that enter.
    - `is_open` (b,) bool: faces whose flux is free.

    The result is (f,) float64.

    Raises `InputError` if none of them is open, and what enters does not leave.
    """
    check_balance(mesh, velocity, at_boundary, is_open)
    centers, areas = mesh.faces
    n, inner = mesh.n_cells, len(mesh.neighbor)
    owner, neighbor = mesh.owner[:inner], mesh.neighbor
    behind, ahead = (np.linalg.norm(centers[:inner] - mesh.centroids[cells], axis=1) for cells in (owner, neighbor))
    share = (ahead / (behind + ahead))[:, None]
    between = share * velocity[owner] + (1 - share) * velocity[neighbor]
    flux = np.concatenate([(between * areas[:inner]).sum(axis=1), at_boundary])
    outer = mesh.owner[inner:]
    flux[inner:][is_open] = (velocity[outer] * areas[inner:]).sum(axis=1)[is_open]
    if not is_open.any():
        leaving = np.maximum(flux[inner:], 0).sum()
        entering = -np.minimum(flux[inner:], 0).sum()
        if leaving > 0:
            flux[inner:] = np.where(flux[inner:] > 0, flux[inner:] * entering / leaving, flux[inner:])
    size = np.linalg.norm(areas, axis=1)
    to = np.linalg.norm(mesh.centroids[neighbor] - mesh.centroids[owner], axis=1)
    conductance = size[:inner] / to
    to_wall = np.linalg.norm(centers[inner:] - mesh.centroids[outer], axis=1)
    beyond = np.where(is_open, size[inner:] / to_wall, 0.0)
    solve = _solver(owner, neighbor, outer, conductance, beyond, n)
    for _ in range(3):  # the second time corrects the round-off of the first
        q = solve(_sum_out(mesh, flux))
        flux[:inner] -= conductance * (q[owner] - q[neighbor])
        flux[inner:] -= beyond * q[outer]
        if divergence(mesh, flux) < 0.01 * MOST_DIVERGENCE:
            break
    return flux


def check_balance(mesh: FoamMesh, velocity: np.ndarray, at_boundary: np.ndarray, is_open: np.ndarray) -> None:
    """Raise InputError if no face of the boundary is open, and what enters does not leave; see `project_fluxes`."""
    entering, leaving = -np.minimum(at_boundary, 0).sum(), np.maximum(at_boundary, 0).sum()
    most = max(entering, leaving)
    scale = np.abs(velocity).max() * np.linalg.norm(mesh.faces[1][len(mesh.neighbor) :], axis=1).sum()
    if not is_open.any() and most > _NOTHING * scale and abs(entering - leaving) > _UNBALANCED * most:
        raise InputError(
            f"U enters the domain with {entering:.4g} and leaves it with {leaving:.4g}, expected as much, since its "
            "values are given at all patches; give one of them a type such as zeroGradient or inletOutlet"
        )


def divergence(mesh: FoamMesh, flux: np.ndarray) -> float:
    """Return the largest sum of fluxes out of a cell, over the mean flux through a face."""
    mean = float(np.abs(flux).mean())
    return float(np.abs(_sum_out(mesh, flux)).max()) / mean if mean else 0.0


def _sum_out(mesh: FoamMesh, flux: np.ndarray) -> np.ndarray:
    inner = flux[: len(mesh.neighbor)]
    return np.bincount(mesh.owner[: len(flux)], flux, mesh.n_cells) - np.bincount(mesh.neighbor, inner, mesh.n_cells)


def _solver(
    owner: np.ndarray, neighbor: np.ndarray, outer: np.ndarray, conductance: np.ndarray, beyond: np.ndarray, n: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that solves for the potential, by multigrid if there are many cells.

    All open faces lead to one more node n, where the potential is 0. Without open faces it is that of cell 0.
    """
    is_open = beyond > 0
    a = np.concatenate([owner, outer[is_open]])
    b = np.concatenate([neighbor, np.full(is_open.sum(), n)])
    weights = np.concatenate([conductance, beyond[is_open]])
    ground = n if is_open.any() else 0
    m = n + is_open.any()
    graph = scipy.sparse.coo_array(
        (np.tile(weights, 2), (np.concatenate([a, b]), np.concatenate([b, a]))), shape=(m, m)
    ).tocsr()
    if m > _DIRECT and (engine := default_engine(3)).real == np.float64:
        return _multigrid_solver(Poisson(engine), graph, ground, n)
    kept = np.flatnonzero(np.arange(m) != ground)
    matrix = scipy.sparse.diags_array(graph.sum(axis=1) + 1e-300) - graph
    factors = scipy.sparse.linalg.splu(
        matrix[kept][:, kept].tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
    )

    def solve(sources: np.ndarray) -> np.ndarray:
        q = np.zeros(m)
        q[kept] = factors.solve(np.append(sources, 0)[:m][kept])
        return q[:n]

    return solve


def _multigrid_solver(
    poisson: Poisson, graph: scipy.sparse.csr_array, ground: int, n: int
) -> Callable[[np.ndarray], np.ndarray]:
    engine = poisson.engine
    laplacian = Laplacian(
        engine.upload(graph.indptr, np.int32), engine.upload(graph.indices, np.int32), engine.upload(graph.data)
    )

    def solve(sources: np.ndarray) -> np.ndarray:
        every = np.append(sources, -sources.sum())[: graph.shape[0]]
        potential = engine.zeros(len(every))
        poisson.solve(laplacian, engine.upload(every), potential, tolerance=_TOLERANCE, preconditioner="multigrid")
        q = potential.get()
        return q[:n] - q[ground]

    return solve
