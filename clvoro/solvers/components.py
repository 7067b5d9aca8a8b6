"""Connected components of the neighbor graph: a domain of several pieces has one Poisson equation per component."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..connectivity import components, rows_of
from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class Components:
    """The components of the diagram `t`, which may be a part of the whole. The work is done on the host.

    The face between two cells that are both `held` (n,) bool, with the ghosts after them, does not connect them.

    - `of_cell` (n,) int: number of the component of each cell, the same in all parts.
    """

    def __init__(self, engine: Engine, t: Tessellation, held: np.ndarray | None = None) -> None:
        self._engine, peers = engine, engine.peers
        starts, neighbors = t.starts.get(), t.neighbors.get()
        if held is not None:
            inner = np.flatnonzero(neighbors[: starts[-1]] >= 0)
            neighbors[inner[held[neighbors[inner]] & held[rows_of(starts)[inner]]]] = -1
        self.of_cell = connected_components(starts, neighbors)
        self._count = int(self.of_cell.max(initial=-1)) + 1
        if t.part is None or t.part.peers is None:
            return
        self.of_cell += int(peers.before(self._count))
        self._count = int(peers.total(self._count))
        (found,) = t.with_ghosts(engine, engine.upload(self.of_cell, np.int32))
        names, other = found.get(), neighbors[: starts[-1]]
        beside = other >= t.n
        pairs = np.column_stack([np.repeat(self.of_cell, np.diff(starts))[beside], names[other[beside]]])
        pairs = np.concatenate(peers.exchange([np.unique(pairs, axis=0)] * peers.count))
        self._count, joined = components(self._count, *pairs.T)
        self.of_cell = joined[self.of_cell]

    def sums(self, *values: np.ndarray | cla.Array | None) -> np.ndarray:
        """Return the sums of each of `values` (n,) over the components, (k, c); of None the numbers of cells."""
        return self._engine.peers.total(
            np.array([np.bincount(self.of_cell, on_host(v), minlength=self._count).astype(float) for v in values])
        )


def on_host(values: np.ndarray | cla.Array | None) -> np.ndarray | None:
    """Return `values` as an array of float64, unless they are None."""
    return None if values is None else np.asarray(values if isinstance(values, np.ndarray) else values.get(), float)


def balance_components(engine: Engine, domain: Domain, t: Tessellation, source: cla.Array, weights: cla.Array) -> None:
    """Subtract from `source` its mean in each connected component, so that it sums up to 0 there.

    The right side is source_i = weight_i (s_i - mean s). The null space of the operator has one constant per component.
    Nothing is done if the domain has one piece.

    - `source` (n,) real, device: right side, changed in place. It may be longer than n.
    - `weights`: (n,) real, device
    """
    if domain.n_pieces == 1:
        return
    components, values = Components(engine, t), source[: t.n].get()
    weight = weights[: t.n].get().astype(float)
    sums, total, cells = components.sums(values, weight, None)
    means = np.divide(sums, total, out=sums, where=total > 0)
    balanced = values - weight * means[components.of_cell]
    # A component of one cell has no neighbor that could absorb its round-off.
    balanced[cells[components.of_cell] == 1] = 0
    source[: t.n].set(balanced.astype(values.dtype))


def fit_components(engine: Engine, domain: Domain, t: Tessellation, prescribed: cla.Array) -> bool:
    """Scale the volumes `prescribed` (n,) in each connected component, so that their sum is that of its cells in `t`.

    Return False, and do nothing, if the domain has one piece.
    """
    if domain.n_pieces == 1:
        return False
    components, wanted = Components(engine, t), prescribed.get().astype(float)
    volumes, sums = components.sums(t.volumes, wanted)
    prescribed.set((wanted * (volumes / sums)[components.of_cell]).astype(prescribed.dtype))
    return True


def connected_components(starts: np.ndarray, neighbors: np.ndarray) -> np.ndarray:
    """Return the number of each cell's connected component in the neighbor graph, (n,) int.

    The positions of the generators are not sufficient for that: a generator in a corner that several pieces share lies
    in all of them, and a piece without a generator consists of parts of cells and connects them.

    - `starts`: (n + 1,) int32
    - `neighbors` (m,) int32: of cell i from ``starts[i]`` on; negative for walls, n or more for ghosts. The array may
      be longer.
    """
    n, other = len(starts) - 1, neighbors[: starts[-1]]
    own = (other >= 0) & (other < n)
    return components(n, rows_of(starts)[own], other[own])[1]
