"""Domains of several pieces: the graph of neighbors falls apart, and so does the Poisson equation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..geometry.polygon import Polygon

if TYPE_CHECKING:
    import pyopencl.array as cla

    from ..adaptation.state import Mesh
    from ..tessellation.device_diagram import Tessellation


def balance_pieces(mesh: Mesh, weights: cla.Array) -> None:
    """Take each part's mean from the right side `mesh.source` = weight * (s - mean s), so that it sums up to 0 there.

    No cells can be given from part to part, and the operator's null space has a constant for each. It is done on the
    host, and costs the time of bringing neighbors and sources there and back; in one piece nothing is done.
    """
    domain = mesh.domain
    if not isinstance(domain, Polygon) or domain.n_pieces == 1:
        return
    n = mesh.n
    part = connected_parts(mesh.t)
    source, weight = mesh.source[:n].get(), weights[:n].get().astype(float)
    sums, total = (np.bincount(part, v) for v in (source, weight))
    balanced = source - weight * np.divide(sums, total, out=sums, where=total > 0)[part]
    # With no cell beside it nothing can take up what would round.
    balanced[np.bincount(part)[part] == 1] = 0
    mesh.source[:n].set(balanced.astype(source.dtype))


def connected_parts(t: Tessellation) -> np.ndarray:
    """Return for each cell the number of the part of the graph of neighbors that it is in, (n,) int.

    By the graph, as the place of a generator does not tell: one in a corner that pieces share is in all of them, its
    cell in one; a piece without a generator is made of parts of cells, and joins them.
    """
    # It takes a fifth of a second to import; most runs do without.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    starts = t.starts.get()
    other = t.neighbors[: starts[-1]].get()
    walls = other < 0
    other[walls] = np.repeat(np.arange(t.n, dtype=other.dtype), np.diff(starts))[walls]
    graph = csr_array((np.ones(len(other), np.int8), other, starts), shape=(t.n, t.n))
    return connected_components(graph, directed=False)[1]
