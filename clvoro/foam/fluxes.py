"""Fluxes through the faces of a mesh, projected so that they are free of divergence."""

from __future__ import annotations

import numpy as np
import scipy

from .mesh import FoamMesh

MOST_DIVERGENCE = 1e-10
"""Largest sum of the fluxes out of a cell, over the mean flux through a face."""
_DIRECT = 100_000  # cells up to which a factorization costs less than iterations


def project_fluxes(mesh: FoamMesh, velocity: np.ndarray, at_boundary: np.ndarray, is_open: np.ndarray) -> np.ndarray:
    """Return fluxes near those of a velocity whose sum out of each cell is zero.

    The velocity is interpolated to the faces, and the gradient of a potential q is subtracted from it, which solves
    ``sum over faces of (A / d) (q_j - q_i) = sum of the fluxes out of cell i``, with q = 0 beyond open faces.

    Parameters
    ----------
    mesh : FoamMesh
    velocity : (n, 3) float64
        In the cells.
    at_boundary : (b,) float64
        Fluxes through the faces of the boundary, out of the domain. If none of them is open, those that leave
        the domain are scaled to the sum of those that enter.
    is_open : (b,) bool
        Faces whose flux is free.

    Returns
    -------
    (f,) float64
    """
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
    diagonal = (
        np.bincount(owner, conductance, n) + np.bincount(neighbor, conductance, n) + np.bincount(outer, beyond, n)
    )
    if not is_open.any():
        diagonal[0] = 2 * diagonal[0] or 1.0  # the potential is known up to a constant
    rows, columns = np.concatenate([owner, neighbor, np.arange(n)]), np.concatenate([neighbor, owner, np.arange(n)])
    entries = np.concatenate([-conductance, -conductance, diagonal])
    matrix = scipy.sparse.csc_array((entries, (rows, columns)), shape=(n, n))
    solve = _solver(matrix)
    for _ in range(3):  # the second time corrects the round-off of the first
        q = solve(_sum_out(mesh, flux))
        flux[:inner] -= conductance * (q[owner] - q[neighbor])
        flux[inner:] -= beyond * q[outer]
        if divergence(mesh, flux) < 0.01 * MOST_DIVERGENCE:
            break
    return flux


def divergence(mesh: FoamMesh, flux: np.ndarray) -> float:
    """Return the largest sum of fluxes out of a cell, over the mean flux through a face."""
    mean = float(np.abs(flux).mean())
    return float(np.abs(_sum_out(mesh, flux)).max()) / mean if mean else 0.0


def _sum_out(mesh: FoamMesh, flux: np.ndarray) -> np.ndarray:
    inner = flux[: len(mesh.neighbor)]
    return np.bincount(mesh.owner[: len(flux)], flux, mesh.n_cells) - np.bincount(mesh.neighbor, inner, mesh.n_cells)


def _solver(matrix: scipy.sparse.csc_array):
    """Return a function that solves a symmetric system for a right-hand side."""
    if matrix.shape[0] <= _DIRECT:
        return scipy.sparse.linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
    part = scipy.sparse.linalg.spilu(matrix, drop_tol=1e-4, fill_factor=10)
    near = scipy.sparse.linalg.LinearOperator(matrix.shape, part.solve)
    return lambda b: scipy.sparse.linalg.cg(matrix, b, rtol=1e-12, maxiter=2000, M=near)[0]
