"""Connected components of the neighbor graph: a domain of several pieces has one Poisson equation per component."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    import pyopencl.array as cla

    from ..geometry.domain import Domain
    from ..tessellation.device_diagram import Tessellation


def balance_components(domain: Domain, t: Tessellation, source: cla.Array, weights: cla.Array) -> None:
    """Subtract from `source` its mean in each connected component, so that it sums up to 0 there.

    The right side is source_i = weight_i (s_i - mean s). The null space of the operator has one constant per component.
    The work is done on the host. Nothing is done if the domain has one piece.

    Parameters
    ----------
    source : (n,) real, device
        Right side, changed in place. It may be longer than n.
    weights : (n,) real, device
    """
    if domain.n_pieces == 1:
        return
    component = connected_components(t.starts.get(), t.neighbors.get())
    values, weight = source[: t.n].get(), weights[: t.n].get().astype(float)
    sums, total = (np.bincount(component, v) for v in (values, weight))
    means = np.divide(sums, total, out=sums, where=total > 0)
    balanced = values - weight * means[component]
    # A component of one cell has no neighbor that could absorb its round-off.
    balanced[np.bincount(component)[component] == 1] = 0
    source[: t.n].set(balanced.astype(values.dtype))


def fit_components(domain: Domain, t: Tessellation, prescribed: cla.Array) -> bool:
    """Scale the volumes `prescribed` (n,) in each connected component, so that their sum is that of its cells in `t`.

    Return False, and do nothing, if the domain has one piece.
    """
    if domain.n_pieces == 1:
        return False
    component = connected_components(t.starts.get(), t.neighbors.get())
    volumes, wanted = t.volumes.get().astype(float), prescribed.get().astype(float)
    factors = np.bincount(component, volumes) / np.bincount(component, wanted)
    prescribed.set((wanted * factors[component]).astype(prescribed.dtype))
    return True


def connected_components(starts: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Return the number of each cell's connected component in the neighbor graph, (n,) int.

    The positions of the generators are not sufficient for that: a generator in a corner that several pieces share lies
    in all of them, and a piece without a generator consists of parts of cells and connects them.

    Parameters
    ----------
    starts : (n + 1,) int32
    neighbors : (m,) int32
        Of cell i from ``starts[i]`` on; negative for walls. The array may be longer.
    """
    n, other = len(starts) - 1, neighbors[: starts[-1]]
    other = np.where(other < 0, np.repeat(np.arange(n, dtype=other.dtype), np.diff(starts)), other)
    graph = scipy.sparse.csr_array((np.ones(len(other), np.int8), other, starts), shape=(n, n))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
