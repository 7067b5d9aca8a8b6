"""Coarse graphs for multigrid: cells joined by heavy weights become one, on the device."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import DTypeLike

from ..opencl.device_array import read_number
from ..opencl.primitives import Room, Scan
from ..opencl.program import Engine, Kernels

ROUNDS = 3
"""Rounds of matching; the third still pairs off every fifth cell, a fourth would not pay."""


GROUP = 64
"""Work-items per work-group, always the same: PoCL compiles a kernel for every size it meets."""


def whole_groups(size: int) -> int:
    """Return `size` rounded up to whole work-groups."""
    return max(1, -(-size // GROUP)) * GROUP


_IN_RANGE = 60
"""Weights up to 2^60 and down to 2^-60 are in single precision as they are: so are their inverses."""


@dataclass(frozen=True)
class Graph:
    """A weighted graph on the device, one row per cell.

    Attributes
    ----------
    starts : (n + 1,) int32
    columns : (m,) int32
        An entry that names its own row counts for nothing, nor does one of weight 0; a negative one has weight 0.
    weights : (m,) real
        Symmetric, >= 0.
    """

    starts: cla.Array
    columns: cla.Array
    weights: cla.Array

    def __len__(self) -> int:
        return len(self.starts) - 1


@dataclass(frozen=True)
class Groups:
    """A partition of a graph's cells.

    Attributes
    ----------
    group : (n,) int32
        Number of each cell's group.
    starts : (groups + 1,) int32
    members : (n,) int32
        Group g has the cells ``members[starts[g]:starts[g + 1]]``.
    """

    group: cla.Array
    starts: cla.Array
    members: cla.Array

    def __len__(self) -> int:
        return len(self.starts) - 1


@dataclass(frozen=True)
class PairInverse:
    """Inverse of diagonal and 2 x 2 blocks, each (n,).

    u_i = own_i r_i + both_i (r_i + r_partner_i).
    """

    partner: cla.Array
    own: cla.Array
    both: cla.Array


class Coarsening:
    """Makes a graph a few times smaller by two passes of matching.

    In a pass each cell looks at the free neighbor it is tied to most, and two that look at each
    other are joined; after `ROUNDS` rounds the rest joins the pair it is tied to most. A tie is
    w (1/d_i + 1/d_j), d the sums of weights: what counts is the share of a cell's weights, as on
    meshes with a density all heavy neighbors lie one way. Two passes make groups of four to five.

    Parameters
    ----------
    engine : Engine
        Of the multigrid's precision.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._converters: dict[np.dtype, Kernels] = {}
        self._kernels = self._kernels_from(engine.real)
        self._scan = Scan(engine)
        self._room = Room(engine)
        self.exponent = 0

    def _kernels_from(self, source: np.dtype) -> Kernels:
        """Kernels that convert from another precision."""
        if source not in self._converters:
            self._converters[source] = self.engine.kernels(
                "solvers/aggregation", {"SOURCE": self.engine.name_of(source)}
            )
        return self._converters[source]

    def _run(self, kernel: cl.Kernel, size: int, *args: object) -> None:
        self.engine.run(kernel, whole_groups(size), *args)

    def convert(self, graph: Graph, level: int, *, anew: bool = True) -> Graph:
        """Return `graph` with its weights in this engine's precision, times a power of two.

        The largest becomes 1 at most, so that weights of any unit and their inverses are in range;
        where they are so already they stay as they are. Without `anew` the power is the last call's.
        """
        m, source = len(graph.weights), graph.weights.dtype
        kernels = self._kernels_from(source)
        if anew:
            items = self.engine.groups * self.engine.group_size
            partial = self._room("largest", source, size=items, dtype=source)
            rows = (np.int32(len(graph)), graph.starts)
            self.engine.run_blocks(kernels.largest, *rows, graph.weights, partial)
            most = float(partial.get().max())
            self.exponent = -math.frexp(most)[1] if 0 < most < math.inf else 0
            if source == self.engine.real and abs(self.exponent) <= _IN_RANGE:
                self.exponent = 0
        if source == self.engine.real and self.exponent == 0:
            return graph
        weights = self._room(level, "weights", size=m)
        self._run(kernels.convert, m, np.int32(m), np.int32(self.exponent), graph.weights, weights)
        return Graph(graph.starts, graph.columns, weights)

    def coarsen(self, graph: Graph, level: int) -> tuple[PairInverse, Groups, Graph]:
        """Return the smoother's blocks of `graph`, its groups, and the graph of the groups.

        Weights between groups are the sums of those between their members, times the ratio of
        lengths (groups / cells)^(1/d): groups are that much farther apart than cells.
        """
        n, dim = len(graph), self.engine.dim
        with self.engine.workspace.frame():
            inverse, first = self._group(graph, level)
            middle = self._graph_of(graph, first, 1.0)
            _, second = self._group(middle)
            ratio = (len(second) / n) ** (1 / dim)
            coarse = self._graph_of(middle, second, ratio, level)
            assert inverse is not None
            return inverse, self._compose(first, second, level), coarse

    def clear(self) -> None:
        """Let go of all buffers."""
        self._room.clear()

    def pairs(self, graph: Graph, level: int) -> PairInverse:
        """Return the smoother's blocks alone, for the coarsest graph."""
        n, ints = len(graph), np.int32
        with self.engine.workspace.frame():
            mate, choice = (self.engine.scratch(n, ints) for _ in range(2))
            self._round(graph, self._sums(graph), mate.fill(-1), choice)
            return self._pair_inverse(graph, mate, level)

    def renew_pairs(self, graph: Graph, pairs: PairInverse) -> None:
        """Set the blocks of `pairs` for other weights of the same cells; the pairs stay."""
        n = len(graph)
        self._run(
            self._kernels.pair_inverse, n, np.int32(n), graph.starts, graph.columns, graph.weights,
            pairs.partner, pairs.partner, pairs.own, pairs.both,
        )  # fmt: skip

    def _sums(self, graph: Graph) -> cla.Array:
        """Inverse sums of the rows' weights, in the workspace."""
        n = len(graph)
        sums = self.engine.scratch(n)
        self._run(
            self._kernels.inverse_sums, n, np.int32(n), graph.starts, graph.columns, graph.weights,
            sums,
        )  # fmt: skip
        return sums

    def _round(self, graph: Graph, sums: cla.Array, mate: cla.Array, choice: cla.Array) -> None:
        run, k, n = self._run, self._kernels, len(graph)
        size = np.int32(n)
        run(
            k.propose, n, size, np.int32(0), graph.starts, graph.columns, graph.weights, sums, mate,
            choice,
        )  # fmt: skip
        run(k.marry, n, size, choice, mate)

    def _pair_inverse(self, graph: Graph, mate: cla.Array, level: int) -> PairInverse:
        n, room = len(graph), self._room
        pairs = PairInverse(
            room(level, "partner", size=n, dtype=np.int32),
            room(level, "own", size=n),
            room(level, "both", size=n),
        )
        self._run(
            self._kernels.pair_inverse, n, np.int32(n), graph.starts, graph.columns, graph.weights,
            mate, pairs.partner, pairs.own, pairs.both,
        )  # fmt: skip
        return pairs

    def _group(self, graph: Graph, level: int | None = None) -> tuple[PairInverse | None, Groups]:
        """One pass: groups of mates and who has joined them, in the workspace; the smoother's blocks of `level`."""
        run, k, n, scratch = self._run, self._kernels, len(graph), self.engine.scratch
        size, zero, one, ints = np.int32(n), np.int32(0), np.int32(1), np.int32
        group, members, starts = scratch(n, ints), scratch(n, ints), scratch(n + 1, ints)
        with self.engine.workspace.frame():
            mate, choice, numbers = scratch(n, ints), scratch(n, ints), scratch(n + 1, ints)
            mate.fill(-1)
            inverse, sums = None, self._sums(graph)
            for turn in range(ROUNDS):
                self._round(graph, sums, mate, choice)
                if turn == 0 and level is not None:
                    inverse = self._pair_inverse(graph, mate, level)
            rows = (graph.starts, graph.columns, graph.weights)
            run(k.propose, n, size, one, *rows, sums, mate, choice)
            run(k.join, n, size, mate, choice, numbers)
            self._scan.exclusive(numbers, numbers, n)
            count = read_number(numbers, n)
            standing, number = scratch(count, ints), np.int32(count)
            run(k.number_groups, n, size, mate, choice, numbers, group, standing)
            listing = (graph.starts, graph.columns, mate, choice, standing, starts)
            run(k.list_members, count, number, zero, *listing, members)
            self._scan.exclusive(starts, starts, count)
            run(k.list_members, count, number, one, *listing, members)
        return inverse, Groups(group, starts[: count + 1], members)

    def _graph_of(
        self, graph: Graph, groups: Groups, factor: float, level: int | None = None
    ) -> Graph:
        """Return the graph of `groups`, weights times `factor`: kept for `level`, else in the workspace."""
        run, k, count = self._run, self._kernels, len(groups)

        def array(name: str, size: int, dtype: DTypeLike | None = None) -> cla.Array:
            if level is None:
                return self.engine.scratch(size, dtype)
            return self._room(level, f"coarse {name}", size=size, dtype=dtype)

        lists = (groups.group, groups.starts, groups.members)
        rows = (graph.starts, graph.columns, graph.weights, *lists)
        number, starts = np.int32(count), array("starts", count + 1, np.int32)
        run(k.count_rows, count, number, *rows, starts)
        self._scan.exclusive(starts, starts, count)
        entries = read_number(starts, count)
        columns, weights = array("columns", entries, np.int32), array("weights", entries)
        scale = self.engine.real.type(factor)
        run(k.merge_rows, count, number, scale, *rows, starts, columns, weights)
        if level is not None:
            # What lies between two passes is for the choice of mates only, where roundings do no harm.
            run(k.share_weights, count, number, starts, columns, weights)
        return Graph(starts, columns, weights)

    def _compose(self, inner: Groups, outer: Groups, level: int) -> Groups:
        run, k, room = self._run, self._kernels, self._room
        n, count = len(inner.group), len(outer)
        groups = Groups(
            room(level, "group", size=n, dtype=np.int32),
            room(level, "starts", size=count + 1, dtype=np.int32),
            room(level, "members", size=n, dtype=np.int32),
        )
        run(k.compose_groups, n, np.int32(n), inner.group, outer.group, groups.group)
        lists = (outer.starts, outer.members, inner.starts, inner.members, groups.starts)
        number = np.int32(count)
        run(k.compose_members, count, number, np.int32(0), *lists, groups.members)
        self._scan.exclusive(groups.starts, groups.starts, count)
        run(k.compose_members, count, number, np.int32(1), *lists, groups.members)
        return groups
