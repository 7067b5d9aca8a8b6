"""Domains of several pieces: the graph of neighbours falls apart, and so does the Poisson equation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .polygon import Polygon

if TYPE_CHECKING:
    import pyopencl.array as cla

    from .mesh import Mesh


def balance_pieces(mesh: Mesh, weights: cla.Array) -> None:
    """Take each piece's mean from the right side `mesh.source` = weight * (s - mean s), so that it sums up to 0 there.

    No cells can be given from piece to piece, and the operator's null space has a constant for each. It is done on the
    host, and costs the time of bringing points and sources there and back; in one piece nothing is done.
    """
    domain = mesh.domain
    if not isinstance(domain, Polygon) or domain.n_pieces == 1:
        return
    n = mesh.n
    origin, scale = domain.frame
    piece = domain.nearest_piece(mesh.points[:n].get().astype(float) * scale + origin)
    source, weight = mesh.source[:n].get(), weights[:n].get().astype(float)
    sums, total = (np.bincount(piece, v, domain.n_pieces) for v in (source, weight))
    mean = np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)
    balanced = source - weight * mean[piece]
    # With no cell beside it nothing can take up what would round.
    balanced[np.bincount(piece, minlength=domain.n_pieces)[piece] == 1] = 0
    mesh.source[:n].set(balanced.astype(source.dtype))
