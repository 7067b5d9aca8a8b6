"""Coarse graphs for multigrid: cells joined by heavy weights become one, on the device."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ._primitives import Room, Scan
from ._program import Engine

ROUNDS = 3
"""Rounds of matching; the third still pairs off every fifth cell, a fourth would not pay."""


GROUP = 64
"""Work-items per work-group, always the same: PoCL compiles a kernel for every size it meets."""


def whole_groups(size: int) -> int:
    """Return `size` rounded up to whole work-groups."""
    return max(1, -(-size // GROUP)) * GROUP


_WHILE_MADE = (
    "mate", "choice", "root", "numbers", "standing", "bounds", "loose columns", "loose", "inverse sums",
)  # fmt: skip
"""Arrays that are of no use once a level is made, beside those of the graph between its two passes."""


@dataclass(frozen=True)
class Graph:
    """A weighted graph on the device, one row per cell.

    Attributes
    ----------
    starts : (n + 1,) int32
    columns : (m,) int32
        An entry that names its own row counts for nothing.
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

    In a pass each cell looks at the free neighbour it is tied to most, and two that look at each
    other are joined; after `ROUNDS` rounds the rest joins the pair it is tied to most. A tie is
    w (1/d_i + 1/d_j), d the sums of weights: what counts is the share of a cell's weights, as on
    meshes with a density all heavy neighbours lie one way. Two passes make groups of four to five.

    Parameters
    ----------
    engine : Engine
        Of the multigrid's precision.
    """

    def __init__(self, engine: Engine, source: str) -> None:
        self.engine = engine
        self._kernels = engine.kernels("coarsening", {"SOURCE": source})
        self._scan = Scan(engine)
        self._room = Room(engine)
        self.exponent = 0

    def _run(self, kernel: cl.Kernel, size: int, *args: object) -> None:
        self.engine.run(kernel, whole_groups(size), *args)

    def convert(self, graph: Graph, level: int, *, anew: bool = True) -> Graph:
        """Return `graph` with its weights in this engine's precision, times a power of two.

        The largest becomes 1 at most, so that weights of any unit and their inverses are in range.
        Without `anew` the power is the last call's.
        """
        m = len(graph.weights)
        size, weights = np.int32(m), self._room(level, "weights", size=m)
        if anew:
            items = self.engine.groups * self.engine.group_size
            partial = self._room("largest", size=items, dtype=graph.weights.dtype)
            rows = (np.int32(len(graph)), graph.starts)
            self.engine.run_blocks(self._kernels.largest, *rows, graph.weights, partial)
            most = float(partial.get().max())
            self.exponent = -math.frexp(most)[1] if 0 < most < math.inf else 0
        exponent = np.int32(self.exponent)
        self._run(self._kernels.convert, m, size, exponent, graph.weights, weights)
        return Graph(graph.starts, graph.columns, weights)

    def coarsen(self, graph: Graph, level: int) -> tuple[PairInverse, Groups, Graph]:
        """Return the smoother's blocks of `graph`, its groups, and the graph of the groups.

        Weights between groups are the sums of those between their members, times the ratio of
        lengths (groups / cells)^(1/d): groups are that much farther apart than cells.
        """
        n, dim = len(graph), self.engine.dim
        inverse, first, middle = self._match(graph, (level, 0), 1.0, pairs=True)
        _, second, coarse = self._match(
            middle, (level, 1), lambda groups: (groups / n) ** (1 / dim), pairs=False
        )
        return inverse, self._compose(first, second, level), coarse

    def clear(self, levels: int) -> None:
        """Let go of what is needed only while `levels` levels are made."""
        self._room.clear(*_WHILE_MADE, *((level, 0) for level in range(levels)))

    def pairs(self, graph: Graph, level: int) -> PairInverse:
        """Return the smoother's blocks alone, for the coarsest graph."""
        n, room = len(graph), self._room
        mate = room("mate", size=n, dtype=np.int32).fill(-1)
        self._round(graph, self._sums(graph), mate, room("choice", size=n, dtype=np.int32))
        return self._pair_inverse(graph, mate, level)

    def renew_pairs(self, graph: Graph, pairs: PairInverse) -> None:
        """Set the blocks of `pairs` for other weights of the same cells; the pairs stay."""
        n = len(graph)
        self._run(
            self._kernels.pair_inverse, n, np.int32(n), graph.starts, graph.columns, graph.weights,
            pairs.partner, pairs.partner, pairs.own, pairs.both,
        )  # fmt: skip

    def _sums(self, graph: Graph) -> cla.Array:
        """Inverse sums of the rows' weights."""
        n = len(graph)
        sums = self._room("inverse sums", size=n)
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

    def _match(self, graph: Graph, name: tuple, factor, *, pairs: bool):
        """One pass: mates, groups, and the graph of the groups with its weights times `factor`."""
        run, k, n, m = self._run, self._kernels, len(graph), len(graph.columns)
        size, zero, one = np.int32(n), np.int32(0), np.int32(1)

        def ints(*key: object, count: int) -> cla.Array:
            return self._room(*key, size=count, dtype=np.int32)

        mate, choice = ints("mate", count=n), ints("choice", count=n)
        mate.fill(-1)
        inverse, sums = None, self._sums(graph)
        for turn in range(ROUNDS):
            self._round(graph, sums, mate, choice)
            if turn == 0 and pairs:
                inverse = self._pair_inverse(graph, mate, name[0])
        rows = (graph.starts, graph.columns, graph.weights)
        run(k.propose, n, size, one, *rows, sums, mate, choice)

        root, numbers = ints("root", count=n), ints("numbers", count=n + 1)
        run(k.join, n, size, mate, choice, root, numbers)
        self._scan.exclusive(numbers, numbers, n)
        count = int(numbers[n : n + 1].get()[0])
        groups = Groups(
            ints(name, "group", count=n), ints(name, "starts", count=count + 1),
            ints(name, "members", count=n),
        )  # fmt: skip
        standing, bounds = ints("standing", count=count), ints("bounds", count=count + 1)
        number = np.int32(count)
        run(k.number_groups, n, size, root, numbers, groups.group, standing)
        listing = (graph.starts, graph.columns, mate, choice, standing, groups.starts, bounds)
        run(k.list_members, count, number, zero, *listing, groups.members)
        self._scan.exclusive(groups.starts, groups.starts, count)
        self._scan.exclusive(bounds, bounds, count)
        run(k.list_members, count, number, one, *listing, groups.members)

        loose_columns, loose_weights = ints("loose columns", count=m), self._room("loose", size=m)
        starts = ints(name, "row starts", count=count + 1)
        run(
            k.merge_rows, count, number, *rows, groups.group, groups.starts, groups.members, bounds,
            starts, loose_columns, loose_weights,
        )  # fmt: skip
        self._scan.exclusive(starts, starts, count)
        entries = int(starts[count : count + 1].get()[0])
        columns = ints(name, "columns", count=entries)
        weights = self._room(name, "row weights", size=entries)
        scale = self.engine.real.type(factor(count) if callable(factor) else factor)
        run(
            k.pack_rows, count, number, scale, bounds, starts, loose_columns, loose_weights,
            columns, weights,
        )  # fmt: skip
        return inverse, groups, Graph(starts, columns, weights)

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
