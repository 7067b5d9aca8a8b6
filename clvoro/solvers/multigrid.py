"""Multigrid preconditioner for the Laplacian of a graph, without anything but the graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..opencl.primitives import Room
from ..opencl.program import Engine
from .aggregation import Coarsening, Graph, Groups, PairInverse
from .cycle import Cycle, Level

_COARSEST = 64
_MOST_LEVELS = 30


class _SavedLevel:
    """Level `depth` of what `Multigrid.save` has returned, found sound: nothing in it leads outside of its arrays."""

    def __init__(self, arrays: Mapping[str, np.ndarray], depth: int, n: int) -> None:
        self.n, self.coarse = n, 0
        self.partner = arrays[f"{depth}.partner"]
        _demand(_within(self.partner, n, n))
        self.graph: tuple[np.ndarray, ...] = ()
        self.groups: tuple[np.ndarray, ...] | None = None
        if depth > 0:
            starts, columns, weights = self.graph = tuple(
                arrays[f"{depth}.graph.{name}"] for name in ("starts", "columns", "weights")
            )
            _demand(_cuts(starts, n, len(columns)) and _within(columns, len(columns), n))
            _demand(weights.shape == columns.shape and weights.dtype == np.float32)
            _demand(bool((weights >= 0).all() and np.isfinite(weights).all()))
        if f"{depth}.group" in arrays:
            group, starts, members = self.groups = tuple(
                arrays[f"{depth}.{name}"] for name in ("group", "starts", "members")
            )
            self.coarse = len(starts) - 1
            _demand(0 < self.coarse < n and depth < _MOST_LEVELS)
            _demand(_cuts(starts, self.coarse, n) and _within(group, n, self.coarse))
            _demand(_within(members, n, n))


def _factor_size(n: int) -> int:
    """Entries of the coarsest level's elimination."""
    return (2 * n + 2) * n


def _demand(holds: bool) -> None:
    if not holds:
        raise ValueError("multigrid")


def _within(array: np.ndarray, length: int, end: int) -> bool:
    """Tell whether `array` holds `length` integers from 0 to below `end`."""
    fits = array.shape == (length,) and array.dtype == np.int32
    return fits and (length == 0 or (array.min() >= 0 and array.max() < end))


def _cuts(starts: np.ndarray, rows: int, length: int) -> bool:
    """Tell whether `starts` cuts `length` entries into `rows` rows."""
    fits = starts.shape == (rows + 1,) and starts.dtype == np.int32
    return fits and starts[0] == 0 and starts[-1] == length and bool((np.diff(starts) >= 0).all())


class Multigrid:
    """Aggregation multigrid cycle as a preconditioner: symmetric positive definite, deterministic.

    Groups of four to five cells that are tied together (see `Coarsening`), constant interpolation,
    coarse weights scaled by the ratio of lengths, pairwise-Jacobi Chebyshev smoothing of degree 2,
    elimination on the coarsest level of at most 64 groups. It works in float32, whatever the
    engine's precision: half the memory to read, and the outer iteration sets the accuracy. If that
    one's vectors are in float32, too, the finest level works on them in place.

    With S the smoother's polynomial and C a level's coarse correction, a cycle is
    M^-1 = 2 S - S A S + (1 - S A) C (1 - A S), positive definite for whatever weights: S A has its
    eigenvalues within [0, 1], and it does not matter by how much C, positive semidefinite itself,
    overshoots. This does not hold for a level visited twice, 2 C - C A C: coarse weights scaled
    down make C A exceed 2 where weights vary much. Hence the V-cycle.

    Parameters
    ----------
    engine : Engine
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._single = engine.single()
        self._kernels = self._single.kernels("solvers/multigrid", {"SOURCE": "float"})
        self._coarsening = Coarsening(self._single)
        self._cycle = Cycle(self._single)
        self._room = Room(self._single)
        self._levels: list[Level] = []
        self._factor: cla.Array | None = None

    def clear(self) -> None:
        """Let go of all levels."""
        self._levels, self._factor = [], None
        self._cycle.clear()
        self._coarsening.clear()
        self._room.clear()

    @property
    def sizes(self) -> list[int]:
        """Cells or groups on each level, the finest first."""
        return [len(level.graph) for level in self._levels]

    def set_up(self, starts: cla.Array, columns: cla.Array, weights: cla.Array) -> None:
        """Make the levels for the operator (A x)_i = sum_k w_k (x_i - x_columns[k]).

        Parameters
        ----------
        starts : (n + 1,) int32
        columns : (m,) int32
        weights : (m,) real
            Symmetric, >= 0. The arrays must not change until the last use.
        """
        graph = self._coarsening.convert(Graph(starts, columns, weights), 0)
        self._levels, self._factor = [], None
        while True:
            depth, n = len(self._levels), len(graph)
            if n <= _COARSEST:
                pairs = self._coarsening.pairs(graph, depth)
                self._levels.append(Level(graph, pairs, None))
                self._eliminate(graph)
                break
            pairs, groups, coarse = self._coarsening.coarsen(graph, depth)
            if len(groups) > 0.8 * n or depth == _MOST_LEVELS:
                # Hardly a neighbor left: smoothing is all there is to do.
                self._levels.append(Level(graph, pairs, None))
                break
            self._levels.append(Level(graph, pairs, groups))
            graph = coarse
        self._cycle.take(self._levels, self._factor)

    def renew(self, starts: cla.Array, columns: cla.Array, weights: cla.Array) -> None:
        """Take a similar operator on the same cells: only the smoother of the finest level follows.

        Any coarse correction will do for a positive definite cycle, and that of a graph that has
        changed a little does nearly as well: groups hold together, and flows between them change
        less than those between cells.

        Parameters
        ----------
        starts, columns, weights
            As for `set_up`, which has been called for as many cells.
        """
        graph = self._coarsening.convert(Graph(starts, columns, weights), 0, anew=False)
        finest = self._levels[0]
        self._coarsening.renew_pairs(graph, finest.pairs)
        self._levels[0] = replace(finest, graph=graph)
        self._cycle.take(self._levels, self._factor)

    def save(self) -> dict[str, np.ndarray]:
        """Return what `renew` builds on: pairs, groups and coarse graphs, fetched from the device."""
        arrays = {"exponent": np.array(self._coarsening.exponent)}
        if self._factor is not None:
            arrays["factor"] = self._factor.get()
        for depth, level in enumerate(self._levels):
            arrays[f"{depth}.partner"] = level.pairs.partner.get()
            if level.groups is not None:
                for name in ("group", "starts", "members"):
                    arrays[f"{depth}.{name}"] = getattr(level.groups, name).get()
            if depth > 0:
                for name in ("starts", "columns", "weights"):
                    arrays[f"{depth}.graph.{name}"] = getattr(level.graph, name).get()
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray], n: int) -> None:
        """Set the levels to those that `save` has returned, for `n` cells; `renew` comes next.

        Raises
        ------
        KeyError, ValueError
            If they are no such levels, before anything is changed.
        """
        hosts, depth = [], 0
        while not hosts or hosts[-1].groups is not None:
            hosts.append(_SavedLevel(arrays, depth, n))
            n, depth = hosts[-1].coarse, depth + 1
        n = hosts[-1].n
        factor = arrays.get("factor")
        _demand((factor is not None) == (n <= _COARSEST))
        _demand(factor is None or factor.shape == (_factor_size(n),))
        single, self._factor = self._single, None
        self._coarsening.exponent = int(arrays["exponent"])
        self._levels = []
        for depth, host in enumerate(hosts):
            n = host.n
            # The finest level's graph comes with `renew`, as do the blocks of its pairs.
            graph = Graph(
                *(single.upload(a, d) for a, d in zip(host.graph, "iif", strict=True))
                if host.graph
                else (single.empty(n + 1, np.int32), single.empty(1, np.int32), single.empty(1))
            )
            partner = single.upload(host.partner, np.int32)
            pairs = PairInverse(partner, single.empty(n), single.empty(n))
            if depth > 0:
                self._coarsening.renew_pairs(graph, pairs)
            groups = host.groups and Groups(*(single.upload(a, np.int32) for a in host.groups))
            self._levels.append(Level(graph, pairs, groups))
        if "factor" in arrays:
            self._factor = single.upload(arrays["factor"], np.float32)
        self._cycle.take(self._levels, self._factor)

    def _eliminate(self, graph: Graph) -> None:
        n = len(graph)
        self._factor = self._room("factor", size=_factor_size(n))
        kernel = self._kernels.eliminate
        group = self._single.group_size
        self._single.run(
            kernel, group, np.int32(n), graph.starts, graph.columns, graph.weights, self._factor,
            group=group,
        )  # fmt: skip

    def apply(self, r: cla.Array, u: cla.Array, spare: cla.Array | None = None) -> None:
        """Enqueue u = M^-1 r: one cycle.

        Parameters
        ----------
        r, u : (n,) real or float32
        spare : (n,) of the same, optional
            What is in it is lost.
        """
        self._cycle.enqueue(r, u, spare)
