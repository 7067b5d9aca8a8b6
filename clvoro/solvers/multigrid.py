"""Multigrid preconditioner for the Laplacian of a graph. It needs the graph only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..opencl.primitives import NamedArrays
from .aggregation import Aggregation, Graph
from .cycle import Cycle, Level

if TYPE_CHECKING:
    from ..tessellation.part import Ghosts

_COARSEST = 64
"""Cells of the coarsest level, at most, if it is solved exactly."""
GATHERED = 5_000
"""Largest number of cells, over all parts, of a level that each part holds whole: all parts then do the same work."""
_MAX_LEVELS = 30
_LEAST_COARSENING = 0.8
"""Ratio of the cells of two levels above which coarsening ends."""


def _factor_size(n: int) -> int:
    """Return the number of entries of the factorized coarsest level."""
    return (2 * n + 2) * n


class Multigrid:
    """Aggregation multigrid V-cycle as a preconditioner: symmetric positive definite, deterministic.

    Aggregates of four to five strongly connected cells (see `Aggregation`), constant interpolation, coarse weights
    scaled by the ratio of lengths, a pairwise-Jacobi Chebyshev smoother of degree 2, and a factorized coarsest level of
    at most 64 cells. It works in float32 whatever the engine's precision, which halves the memory traffic; the
    outer iteration sets the accuracy. If the vectors of that iteration are in float32, too, the finest level works on
    them in place.

    With S the polynomial of the smoother and C the coarse correction of a level, a cycle is
    M^-1 = 2 S - S A S + (1 - S A) C (1 - A S). It is positive definite for all weights: the eigenvalues of S A are
    within [0, 1], and C is positive semidefinite, however much it overshoots. A level visited twice, 2 C - C A C, is
    not: with scaled weights C A can exceed 2 where weights vary strongly. Hence the V-cycle.

    Over several parts each aggregate has cells of one part, and smoothing needs values of the others; see `Cycle`. From
    the first level of at most `GATHERED` cells on, each part has the whole levels and does the same work there. With
    k coarser levels in parts, an iteration takes 5 + 2 k exchanges.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._single = engine.replaced(real=np.dtype(np.float32))
        self._kernels = self._single.kernels("solvers/multigrid", {"SOURCE": "float"})
        self._aggregation = Aggregation(self._single)
        self._cycle = Cycle(self._single)
        self._room = NamedArrays(self._single)
        self._levels: list[Level] = []
        self._factor: cla.Array | None = None
        self._whole: Multigrid | None = None
        self._rest: Callable[[cla.Array, cla.Array], None] | None = None

    def clear(self) -> None:
        """Free all levels."""
        self._levels, self._factor = [], None
        self._cycle.clear()
        self._aggregation.clear()
        self._room.clear()
        self._whole = None

    @property
    def sizes(self) -> list[int]:
        """Cells of each level, the finest first."""
        return [len(level) for level in self._levels]

    def set_up(self, starts: cla.Array, columns: cla.Array, weights: cla.Array, ghosts: Ghosts | None = None) -> None:
        """Build the levels for the operator (A x)_i = sum_k w_k (x_i - x_columns[k]).

        - `starts`: (n + 1,) int32
        - `columns`: (m,) int32
        - `weights` (m,) real: symmetric, >= 0. The arrays must not change while the levels are used.
        - `ghosts`: owners of the columns from n on. All parts call this and `apply` together.
        """
        graph, peers = self._aggregation.scale(Graph(starts, columns, weights, ghosts), 0), self.engine.peers
        self._levels, self._factor, rest = [], None, None
        while True:
            depth, n = len(self._levels), len(graph)
            if ghosts is not None:
                sizes = np.array(peers.gather(np.array(n)))
                if sizes.sum() <= GATHERED or depth == _MAX_LEVELS:
                    rest = self._gather(graph, sizes)
                    break
            elif n <= _COARSEST:
                pairs = self._aggregation.match_pairs(graph, depth)
                self._levels.append(Level(graph, pairs, None))
                self._factorize(graph)
                break
            pairs, aggregates, coarse = self._aggregation.coarsen(graph, depth)
            if ghosts is None and (len(aggregates) > _LEAST_COARSENING * n or depth == _MAX_LEVELS):
                # Few cells have neighbors; smoothing is enough.
                self._levels.append(Level(graph, pairs, None))
                break
            self._levels.append(Level(graph, pairs, aggregates))
            graph = coarse
        self._rest = rest
        self._cycle.set_levels(self._levels, self._factor, rest)

    def _gather(self, graph: Graph, sizes: np.ndarray) -> Callable[[cla.Array, cla.Array], None]:
        """Set up the levels from `graph` on with the cells of all parts, `sizes` (p,). Return what sets x = M^-1 b."""
        peers, n, firsts = self.engine.peers, len(graph), np.cumsum(sizes) - sizes
        assert graph.ghosts is not None
        starts, first = graph.starts.get(), int(firsts[peers.number])
        rows = np.concatenate([first + np.arange(n), firsts[graph.ghosts.parts] + graph.ghosts.rows.get()])
        columns, weights = (array.get()[: starts[-1]] for array in (graph.columns, graph.weights))
        columns = np.where(columns < 0, columns, rows[np.maximum(columns, 0)]).astype(np.int32)
        given = np.diff(starts), columns, weights
        counts, columns, weights = (np.concatenate(peers.exchange([array] * peers.count)) for array in given)
        if self._whole is None:
            self._whole = Multigrid(self.engine.alone())
        whole, engine = self._whole, self._single
        whole.set_up(
            engine.upload(np.append(0, np.cumsum(counts)), np.int32),
            engine.upload(columns, np.int32),
            engine.upload(weights, np.float32),
        )
        b_of_all, x_of_all, work = (self._room("whole", name, size=int(sizes.sum())) for name in "bxt")

        def solve(b: cla.Array, x: cla.Array) -> None:
            own = b.get()[:n].astype(np.float32)
            b_of_all.set(np.concatenate(peers.exchange([own] * peers.count, sizes)))
            whole.apply(b_of_all, x_of_all, work)
            x.set(x_of_all.get()[rows[: len(x)]])

        return solve

    def update_finest(
        self, starts: cla.Array, columns: cla.Array, weights: cla.Array, ghosts: Ghosts | None = None
    ) -> None:
        """Replace the operator by a similar one on the same cells: recompute only the smoother of the finest level.

        The cycle stays positive definite with any coarse correction. That of a slightly different graph is nearly as
        good: aggregates stay together, and weights between them change less than those between cells.

        - `starts`, `columns`, `weights`, `ghosts`: as for `set_up`, which has been called for as many cells. With other
          ghosts all is set up again.
        """
        if (
            not self._levels or ghosts is not self._levels[0].graph.ghosts
        ):  # all are gathered, or aggregates lack ghosts
            self.set_up(starts, columns, weights, ghosts)
            return
        graph = Graph(starts, columns, weights, ghosts)
        graph = self._aggregation.scale(graph, 0, same_exponent=True)
        finest = self._levels[0]
        self._aggregation.update_pairs(graph, finest.pairs)
        self._levels[0] = replace(finest, graph=graph)
        self._cycle.set_levels(self._levels, self._factor, self._rest)

    def _factorize(self, graph: Graph) -> None:
        """Factorize the coarsest level."""
        n = len(graph)
        self._factor = self._room("factor", size=_factor_size(n))
        kernel = self._kernels.factorize_coarsest
        self._single.run_groups(kernel, 1, np.int32(n), *graph.rows, self._factor)

    def apply(self, r: cla.Array, u: cla.Array, work: cla.Array | None = None) -> None:
        """Enqueue u = M^-1 r: one cycle.

        - `r`, `u`: (n,) real or float32
        - `work` (n,) of the same: overwritten.
        """
        if self._rest is not None and not self._levels:
            x = self._room("x", size=len(r))
            self._rest(r, x)
            u.set(x.get().astype(u.dtype))
            return
        self._cycle.enqueue(r, u, work)
