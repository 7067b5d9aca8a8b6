"""Coarse graphs for multigrid by pairwise aggregation, on the device (`aggregation.cl`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import DTypeLike

from ..opencl.device_array import read_number
from ..opencl.engine import Engine
from ..opencl.kernels import Kernels
from ..opencl.primitives import NamedArrays, Scan

if TYPE_CHECKING:
    from ..tessellation.part import Ghosts

MATCHING_ROUNDS = 3
"""Rounds of matching per pass. The third still matches every fifth cell; a fourth is not worth its time."""
WORK_GROUP = 64
"""Work-items per work-group. It is constant because PoCL compiles a kernel for each size."""
_EXPONENT_RANGE = 60
"""Weights between 2^-60 and 2^60 need no scaling in single precision, and neither do their inverses."""


def round_to_work_group(size: int) -> int:
    """Return `size` rounded up to whole work-groups."""
    return max(1, -(-size // WORK_GROUP)) * WORK_GROUP


@dataclass(frozen=True)
class Graph:
    """A weighted graph on the device, one row per cell."""

    starts: cla.Array
    """(n + 1,) int32."""
    columns: cla.Array
    """(m,) int32. Entries on the diagonal are ignored. Negative columns (walls) have weight 0."""
    weights: cla.Array
    """(m,) real. Symmetric, >= 0."""
    ghosts: Ghosts | None = None
    """Owners of the cells of other parts, which have the columns from n on."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def count(self) -> int:
        """Number of cells, with those of other parts."""
        return len(self) + (0 if self.ghosts is None else len(self.ghosts.parts))

    @property
    def rows(self) -> tuple[cla.Array, cla.Array, cla.Array]:
        """Starts, columns and weights, as kernels take them."""
        return self.starts, self.columns, self.weights


@dataclass(frozen=True)
class Aggregates:
    """A partition of the cells of a graph."""

    aggregate: cla.Array
    """(n,) int32. Number of the aggregate of each cell, then of each cell of other parts."""
    starts: cla.Array
    """(aggregates + 1,) int32."""
    members: cla.Array
    """(n,) int32. Aggregate g has the cells ``members[starts[g]:starts[g + 1]]``."""
    ghosts: Ghosts | None = None
    """Owners of the aggregates of other parts."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def count(self) -> int:
        """Number of aggregates, with those of other parts."""
        return len(self) + (0 if self.ghosts is None else len(self.ghosts.parts))


@dataclass(frozen=True)
class PairInverse:
    """The smoother B^-1: inverse of the diagonal and of the 2 x 2 blocks of matched pairs, each (n,).

    u_i = own_i r_i + both_i (r_i + r_partner_i).
    """

    partner: cla.Array
    own: cla.Array
    both: cla.Array

    @property
    def blocks(self) -> tuple[cla.Array, cla.Array, cla.Array]:
        """The three arrays, as kernels take them."""
        return self.partner, self.own, self.both


class Aggregation:
    """Coarsen a graph by two passes of pairwise matching, to a fourth or a fifth of its cells.

    In a pass each unmatched cell chooses its strongest unmatched neighbor, and two cells that choose each other are
    matched. After `MATCHING_ROUNDS` rounds the remaining cells join the pair of their strongest neighbor. The strength
    of a connection is w (1/d_i + 1/d_j), d the row sums of the weights: on meshes with a density all heavy neighbors of
    a cell lie on one side, and the share of the cell's weights matters.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels_of: dict[np.dtype, Kernels] = {}
        self._kernels = self._kernels_from(engine.real)
        self._scan = Scan(engine)
        self._room = NamedArrays(engine)
        self.exponent = 0

    def _kernels_from(self, source: np.dtype) -> Kernels:
        """Return the kernels for weights in precision `source`."""
        if source not in self._kernels_of:
            self._kernels_of[source] = self.engine.kernels(
                "solvers/aggregation", {"SOURCE": self.engine.name_of(source)}
            )
        return self._kernels_of[source]

    def _run(self, kernel: cl.Kernel, size: int, *args: object) -> None:
        self.engine.run(kernel, round_to_work_group(size), *args)

    def _run_rows(self, kernel: cl.Kernel, graph: Graph, *args: object) -> None:
        """Run a kernel that takes the number of cells and the graph's rows first."""
        self._run(kernel, len(graph), np.int32(len(graph)), *graph.rows, *args)

    def scale(self, graph: Graph, level: int, *, same_exponent: bool = False) -> Graph:
        """Return `graph` with weights in this engine's precision, times a power of two.

        The power makes the largest weight at most 1, so that weights of any unit and their inverses are in range. It
        is 1 where they are in range already. With `same_exponent` it is that of the last call.
        """
        m, source = len(graph.weights), graph.weights.dtype
        kernels = self._kernels_from(source)
        if not same_exponent:
            partial = self._room("largest", source, size=self.engine.groups, dtype=source)
            self.engine.run_blocks(
                kernels.find_largest_weight, np.int32(len(graph)), graph.starts, graph.weights, partial
            )
            largest = max(float(found.max()) for found in self.engine.peers.gather(partial.get()))
            self.exponent = -math.frexp(largest)[1] if 0 < largest < math.inf else 0
            if source == self.engine.real and abs(self.exponent) <= _EXPONENT_RANGE:
                self.exponent = 0
        if source == self.engine.real and self.exponent == 0:
            return graph
        weights = self._room(level, "weights", size=m)
        exponent = np.int32(self.exponent)
        self._run(kernels.scale_weights, m, np.int32(m), exponent, graph.weights, weights)
        return replace(graph, weights=weights)

    def coarsen(self, graph: Graph, level: int) -> tuple[PairInverse, Aggregates, Graph]:
        """Return the smoother of `graph`, its aggregates, and the coarse graph.

        A coarse weight is the sum of the weights between the members of two aggregates, times the ratio of lengths
        (aggregates / cells)^(1/d), because aggregates are that much farther apart than cells.
        """
        n, dim = len(graph), self.engine.cell_dim
        with self.engine.workspace.frame():
            inverse, first = self._aggregate(graph, level)
            middle = self._coarse_graph(graph, first, 1.0)
            _, second = self._aggregate(middle)
            count, n = self.engine.peers.total([len(second), n]).tolist() if graph.ghosts else (len(second), n)
            ratio = (count / n) ** (1 / dim)
            coarse = self._coarse_graph(middle, second, ratio, level)
            assert inverse is not None
            return inverse, self._compose(first, second, level), coarse

    def clear(self) -> None:
        """Free all buffers."""
        self._room.clear()

    def match_pairs(self, graph: Graph, level: int) -> PairInverse:
        """Return the smoother of the coarsest graph."""
        n, ints = len(graph), np.int32
        with self.engine.workspace.frame():
            mate, choice = (self.engine.scratch(n, ints) for _ in range(2))
            self._match(graph, self._inverse_sums(graph), mate.fill(-1), choice)
            return self._pair_inverse(graph, mate, level)

    def update_pairs(self, graph: Graph, pairs: PairInverse) -> None:
        """Recompute the blocks of `pairs` for other weights of the same cells. The pairs stay."""
        self._run_rows(self._kernels.invert_pair_blocks, graph, pairs.partner, *pairs.blocks)

    def _inverse_sums(self, graph: Graph) -> cla.Array:
        """Return the inverse row sums of the weights (n,), in the workspace."""
        sums = self.engine.scratch(len(graph))
        self._run_rows(self._kernels.invert_row_sums, graph, sums)
        return sums

    def _choose(self, graph: Graph, matched: int, sums: cla.Array, mate: cla.Array, choice: cla.Array) -> None:
        self._run(
            self._kernels.choose_neighbor,
            len(graph),
            np.int32(len(graph)),
            np.int32(matched),
            *graph.rows,
            sums,
            mate,
            choice,
        )

    def _match(self, graph: Graph, sums: cla.Array, mate: cla.Array, choice: cla.Array) -> None:
        """Do one round of matching."""
        n = len(graph)
        self._choose(graph, 0, sums, mate, choice)
        self._run(self._kernels.match_pairs, n, np.int32(n), choice, mate)

    def _pair_inverse(self, graph: Graph, mate: cla.Array, level: int) -> PairInverse:
        n, room = len(graph), self._room
        pairs = PairInverse(
            room(level, "partner", size=n, dtype=np.int32), room(level, "own", size=n), room(level, "both", size=n)
        )
        self._run_rows(self._kernels.invert_pair_blocks, graph, mate, *pairs.blocks)
        return pairs

    def _aggregate(self, graph: Graph, level: int | None = None) -> tuple[PairInverse | None, Aggregates]:
        """Do one pass: return the smoother (if a `level` is given) and the aggregates, in the workspace."""
        run, k, n, scratch = self._run, self._kernels, len(graph), self.engine.scratch
        size, ints = np.int32(n), np.int32
        aggregate, members, starts = scratch(graph.count, ints), scratch(n, ints), scratch(n + 1, ints)
        with self.engine.workspace.frame():
            mate, choice, numbers = scratch(n, ints), scratch(graph.count, ints), scratch(n + 1, ints)
            mate.fill(-1)
            if graph.ghosts is not None:
                choice.fill(-1)
            inverse, sums = None, self._inverse_sums(graph)
            for turn in range(MATCHING_ROUNDS):
                self._match(graph, sums, mate, choice)
                if turn == 0 and level is not None:
                    inverse = self._pair_inverse(graph, mate, level)
            self._choose(graph, 1, sums, mate, choice)
            run(k.mark_roots, n, size, mate, choice, numbers)
            self._scan.exclusive(numbers, numbers, n)
            count = read_number(numbers, n)
            roots = scratch(count, ints)
            run(k.number_aggregates, n, size, mate, choice, numbers, aggregate, roots)
            lists = (graph.starts, graph.columns, mate, choice, roots, starts)
            self._list(k.list_members, count, lists, starts, members)
        ghosts = None if graph.ghosts is None else self._ghosts_of(graph.ghosts, n, count, aggregate)
        return inverse, Aggregates(aggregate, starts[: count + 1], members, ghosts)

    def _ghosts_of(self, fine: Ghosts, n: int, count: int, aggregate: cla.Array) -> Ghosts:
        """Return the ghosts of the coarse graph, the aggregates of `fine`. Number them in `aggregate`, from `count` on.

        The owners send the numbers that the aggregates have in their parts. Owner and receiver both list the aggregates
        in ascending order of these numbers, so they agree without further messages.
        """
        engine, peers = self.engine, self.engine.peers
        fine.fill(engine, n, aggregate)
        host = aggregate.get()
        parts, owned = np.asarray(fine.parts, int), host[n:].astype(int)
        names, places = np.unique(parts << 32 | owned, return_inverse=True)
        host[n:] = count + places.ravel()
        aggregate.set(host)
        assert fine.sent is not None
        ends = np.cumsum(fine.sent_counts)[:-1]
        sent = [np.unique(host[rows]) for rows in np.split(fine.sent.get(), ends)]
        return fine.of_lists(engine, peers, names >> 32, (names & 0xFFFFFFFF).astype(np.int32), sent)

    def _list(
        self, kernel: cl.Kernel, count: int, lists: tuple[cla.Array, ...], starts: cla.Array, members: cla.Array
    ) -> None:
        """List the members of `count` aggregates: count them, then write them."""
        number = np.int32(count)
        self._run(kernel, count, number, np.int32(0), *lists, members)
        self._scan.exclusive(starts, starts, count)
        self._run(kernel, count, number, np.int32(1), *lists, members)

    def _coarse_graph(self, graph: Graph, aggregates: Aggregates, factor: float, level: int | None = None) -> Graph:
        """Return the graph of `aggregates`, weights times `factor`: kept for `level`, else in the workspace."""
        run, k, count = self._run, self._kernels, len(aggregates)

        def array(name: str, size: int, dtype: DTypeLike | None = None) -> cla.Array:
            if level is None:
                return self.engine.scratch(size, dtype)
            return self._room(level, f"coarse {name}", size=size, dtype=dtype)

        lists = (aggregates.aggregate, aggregates.starts, aggregates.members)
        number, starts = np.int32(count), array("starts", count + 1, np.int32)
        run(k.count_coarse_entries, count, number, *graph.rows, *lists, starts)
        self._scan.exclusive(starts, starts, count)
        entries = read_number(starts, count)
        coarse = Graph(starts, array("columns", entries, np.int32), array("weights", entries), aggregates.ghosts)
        scale = self.engine.real.type(factor)
        run(k.sum_coarse_weights, count, number, scale, *graph.rows, *lists, *coarse.rows)
        if level is not None:
            # The graph between the two passes only serves the choice of mates, where round-off does no harm.
            run(k.symmetrize_weights, count, number, *coarse.rows)
        return coarse

    def _compose(self, inner: Aggregates, outer: Aggregates, level: int) -> Aggregates:
        """Return the aggregates of two passes, as a partition of the cells."""
        room = self._room
        n, rows, count = len(inner.members), len(inner.aggregate), len(outer)
        both = Aggregates(
            room(level, "aggregate", size=rows, dtype=np.int32),
            room(level, "starts", size=count + 1, dtype=np.int32),
            room(level, "members", size=n, dtype=np.int32),
            outer.ghosts,
        )
        self._run(
            self._kernels.compose_aggregates, rows, np.int32(rows), inner.aggregate, outer.aggregate, both.aggregate
        )
        lists = (outer.starts, outer.members, inner.starts, inner.members, both.starts)
        self._list(self._kernels.compose_members, count, lists, both.starts, both.members)
        return both
