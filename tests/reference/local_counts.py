"""Numbers of generators in parts of a domain: the rounds of `LocalCounts.choose` with dense matrices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csgraph, csr_array

from clvoro.adaptation import tuning


@dataclass
class Cells:
    """Cells of a mesh: `pairs` (m, 2) of neighbors with l / d (m,) each, number of faces, whether at a wall, V rho."""

    pairs: np.ndarray
    conductance: np.ndarray
    faces: np.ndarray
    walled: np.ndarray
    weight: np.ndarray

    @property
    def rings(self) -> np.ndarray:
        """Number of rings between each two cells, (n, n); infinite between pieces of the domain."""
        n = len(self.weight)
        graph = csr_array((np.ones(len(self.pairs)), tuple(self.pairs.T)), shape=(n, n))
        return csgraph.shortest_path(graph, unweighted=True)

    def potential(self, source: np.ndarray) -> np.ndarray:
        """Return phi with mean 0, sum_j l / d (phi_i - phi_j) = source_i; the source is balanced in each piece."""
        n = len(source)
        laplacian = np.zeros((n, n))
        for (i, j), c in zip(self.pairs, self.conductance, strict=True):
            laplacian[i, i] += c
            laplacian[i, j] -= c
        same = np.isfinite(self.rings)
        if not same.all():
            source = source - self.weight * (same @ source) / (same @ self.weight)
        return np.linalg.pinv((laplacian + laplacian.T) / 2) @ (source - source.mean())


def changes(cells: Cells, held: np.ndarray) -> np.ndarray:
    """Return where to insert (1) and where to delete (-1), (n,) int; not at or beside generators that are `held`."""
    n, rings = len(cells.weight), cells.rings
    found, blocked = np.zeros(n, int), np.zeros(n, bool)
    closed = ((rings <= 1) & held).any(axis=1)
    phi = cells.potential(cells.weight - 1)
    need = np.log(cells.weight) + 0.2 * (cells.faces - 6)
    while True:
        offset = np.zeros(n)
        for i, piece in enumerate(np.isfinite(rings)):
            lacking = (cells.weight - 1 - found)[piece].sum()
            each = 0.25 if piece.all() else min(max(900 / piece.sum(), 0.25), 2)
            offset[i] = min(max(each * lacking, -3), 3) - phi[piece].mean()
        sign = np.where(phi + offset > 0, 1, -1)
        magnitude = np.abs(phi + offset) + sign * need - cells.walled
        near = ((rings <= tuning.BLOCKED_RINGS) & blocked).any(axis=1)
        magnitude[closed | near | (np.abs(phi + offset) <= tuning.LEAST_GAIN)] = 0
        within = np.where(rings <= tuning.SITE_RINGS, magnitude, 0).max(axis=1)
        sites = (magnitude > 0) & (magnitude == within)
        after = cells.potential(cells.weight - 1 - found - np.where(sites, sign, 0))
        shift = [phi[piece].mean() - after[piece].mean() for piece in np.isfinite(rings)]
        gain = sign * ((phi + after + shift) / 2 + offset)
        accepted = sites & (gain >= tuning.LEAST_GAIN)
        if not accepted.any():
            return found
        found, blocked, phi = found + np.where(accepted, sign, 0), blocked | sites, after
