"""Multigrid preconditioner for the Laplacian of a graph. It needs the graph only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..opencl.primitives import NamedArrays
from .aggregation import Aggregation, Graph
from .cycle import Cycle, Level

_COARSEST = 64
"""Cells of the coarsest level, at most, if it is solved exactly."""
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

    Parameters
    ----------
    engine : Engine
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

    def clear(self) -> None:
        """Free all levels."""
        self._levels, self._factor = [], None
        self._cycle.clear()
        self._aggregation.clear()
        self._room.clear()

    @property
    def sizes(self) -> list[int]:
        """Cells of each level, the finest first."""
        return [len(level) for level in self._levels]

    def set_up(self, starts: cla.Array, columns: cla.Array, weights: cla.Array) -> None:
        """Build the levels for the operator (A x)_i = sum_k w_k (x_i - x_columns[k]).

        Parameters
        ----------
        starts : (n + 1,) int32
        columns : (m,) int32
        weights : (m,) real
            Symmetric, >= 0. The arrays must not change while the levels are used.
        """
        graph = self._aggregation.scale(Graph(starts, columns, weights), 0)
        self._levels, self._factor = [], None
        while True:
            depth, n = len(self._levels), len(graph)
            if n <= _COARSEST:
                pairs = self._aggregation.match_pairs(graph, depth)
                self._levels.append(Level(graph, pairs, None))
                self._factorize(graph)
                break
            pairs, aggregates, coarse = self._aggregation.coarsen(graph, depth)
            if len(aggregates) > _LEAST_COARSENING * n or depth == _MAX_LEVELS:
                # Few cells have neighbors; smoothing is enough.
                self._levels.append(Level(graph, pairs, None))
                break
            self._levels.append(Level(graph, pairs, aggregates))
            graph = coarse
        self._cycle.set_levels(self._levels, self._factor)

    def update_finest(self, starts: cla.Array, columns: cla.Array, weights: cla.Array) -> None:
        """Replace the operator by a similar one on the same cells: recompute only the smoother of the finest level.

        The cycle stays positive definite with any coarse correction. That of a slightly different graph is nearly as
        good: aggregates stay together, and weights between them change less than those between cells.

        Parameters
        ----------
        starts, columns, weights
            As for `set_up`, which has been called for as many cells.
        """
        graph = Graph(starts, columns, weights)
        graph = self._aggregation.scale(graph, 0, same_exponent=True)
        finest = self._levels[0]
        self._aggregation.update_pairs(graph, finest.pairs)
        self._levels[0] = replace(finest, graph=graph)
        self._cycle.set_levels(self._levels, self._factor)

    def _factorize(self, graph: Graph) -> None:
        """Factorize the coarsest level."""
        n = len(graph)
        self._factor = self._room("factor", size=_factor_size(n))
        kernel = self._kernels.factorize_coarsest
        self._single.run_groups(kernel, 1, np.int32(n), *graph.rows, self._factor)

    def apply(self, r: cla.Array, u: cla.Array, work: cla.Array | None = None) -> None:
        """Enqueue u = M^-1 r: one cycle.

        Parameters
        ----------
        r, u : (n,) real or float32
        work : (n,) of the same, optional
            Overwritten.
        """
        self._cycle.enqueue(r, u, work)
