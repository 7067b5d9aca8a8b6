"""One multigrid cycle, as a list of launches whose arguments are set (`multigrid.cl`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..opencl.launch import most_alone
from ..opencl.primitives import Room
from ..opencl.program import Engine, bind, key_of
from .aggregation import GROUP, Graph, Groups, PairInverse, whole_groups

# Chebyshev's polynomial of degree 2 on [_LOWEST, 2], as damping factors of two steps. What lies
# below is left to the coarse levels.
_LOWEST = 0.35
_CENTER, _RADIUS = (2 + _LOWEST) / 2, (2 - _LOWEST) / 2
_EARLY = np.float32(1 / (_CENTER - _RADIUS * math.sqrt(0.5)))
_LATE = np.float32(1 / (_CENTER + _RADIUS * math.sqrt(0.5)))
_NONE = np.float32(0)


@dataclass(frozen=True)
class Level:
    """A graph, its smoother's blocks, and the groups that are the next level's cells; None on the coarsest."""

    graph: Graph
    pairs: PairInverse
    groups: Groups | None

    def __len__(self) -> int:
        return len(self.graph)

    @property
    def rows(self) -> tuple[cla.Array, ...]:
        """The graph, as kernels take it."""
        return self.graph.starts, self.graph.columns, self.graph.weights

    @property
    def blocks(self) -> tuple[cla.Array, ...]:
        """The smoother's blocks, as kernels take them."""
        return self.pairs.partner, self.pairs.own, self.pairs.both


class Cycle:
    """Enqueues cycles: down to the coarsest level, and up again.

    Levels of few cells, below the finest, are each gone through by one work-group in one launch, with the same bits.

    Parameters
    ----------
    engine : Engine
        Of the multigrid's precision.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._most_alone = most_alone(engine)
        self._room = Room(engine)
        self._kernels: dict[tuple[object, ...], cl.Kernel] = {}
        self.clear()

    def clear(self) -> None:
        """Let go of all buffers."""
        self._room.clear()
        self.take([], None)

    def take(self, levels: Sequence[Level], factor: cla.Array | None) -> None:
        """Work on these levels from now on, the finest first; `factor` eliminates on the coarsest, if there is any."""
        self._levels, self._factor = levels, factor
        self._vectors_of: list[object] | None = None

    def enqueue(self, r: cla.Array, u: cla.Array, spare: cla.Array | None) -> None:
        """Enqueue u = M^-1 r; what is in `spare`, if there is one, is lost."""
        vectors = key_of([a for a in (r, u, spare) if a is not None])
        if self._vectors_of != vectors:
            self._vectors_of, self._launches = None, []
            self._plan(r, u, spare)
            self._vectors_of = vectors
        for kernel, size, group in self._launches:
            cl.enqueue_nd_range_kernel(self.engine.queue, kernel, size, group)

    def _plan(self, r: cla.Array, u: cla.Array, spare: cla.Array | None) -> None:
        levels = self._levels
        self._source = r.dtype
        # In their place on the finest level where the precision is the same.
        inside = spare is not None and r.dtype == np.float32
        finest = [r, u, spare] if inside else self._make_vectors(0)
        self._vectors = [finest, *(self._make_vectors(depth) for depth in range(1, len(levels)))]
        smoothed = len(levels) - (self._factor is not None)
        for depth in range(smoothed):
            self._descend(depth, None if depth or inside else r)
        if self._factor is not None:
            self._solve(smoothed, *(None, None) if smoothed or inside else (r, u))
        for depth in reversed(range(smoothed)):
            self._ascend(depth, None if depth or inside else u)

    def _make_vectors(self, depth: int) -> list[cla.Array]:
        """Right side, solution and defect of a level."""
        return [self._room(depth, name, size=len(self._levels[depth])) for name in "bxt"]

    def _add(self, depth: int, name: str, size: int, *args: object, turn: int = 0) -> None:
        """Add a launch; of a kernel there is one for each level and `turn`, as it has one set of arguments."""
        key = (depth, name, turn, self._source)
        if key not in self._kernels:
            defines = {"SOURCE": self.engine.name_of(self._source)}
            self._kernels[key] = getattr(self.engine.kernels("solvers/multigrid", defines), name)
        kernel, one = self._kernels[key], self.engine.group_size
        bind(kernel, (np.int32(size), *args))
        alone = name in ("descend_alone", "ascend_alone", "solve")
        whole, group = (one, one) if alone else (whole_groups(size), GROUP)
        self._launches.append((kernel, (whole,), (group,)))

    def _is_few(self, depth: int) -> bool:
        level = self._levels[depth]
        return depth > 0 and level.groups is not None and len(level) <= self._most_alone

    def _descend(self, depth: int, r: cla.Array | None) -> None:
        """Smooth from zero, and hand the defect down; the right side is rounded from `r`, if there is one."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        lists: tuple[object, ...] = ()
        count = 0
        if level.groups is not None:
            lists = level.groups.starts, level.groups.members, self._vectors[depth + 1][0]
            count = len(level.groups)
        if self._is_few(depth):
            given = (_LATE, _EARLY, *level.rows, *level.blocks, b, x, t, np.int32(count), *lists)
            self._add(depth, "descend_alone", n, *given)
            return
        if r is None:
            self._add(depth, "first", n, _LATE, *level.blocks, b, x)
        else:
            self._add(depth, "first_rounded", n, _LATE, *level.blocks, r, b, x)
        self._relax(depth, _EARLY)
        if lists:
            self._add(depth, "defect", n, *level.rows, b, x, t)
            self._add(depth, "restrict_defect", count, t, *lists)

    def _solve(self, depth: int, r: cla.Array | None, u: cla.Array | None) -> None:
        """Solve on the coarsest level; from `r` and into `u`, if there are any."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        if r is not None:
            self._add(depth, "first_rounded", n, _NONE, *level.blocks, r, b, x)
        self._add(depth, "solve", n, self._factor, b, t, x)
        if u is not None:
            self._add(depth, "correct_out", n, _NONE, *level.blocks, b, x, u)

    def _ascend(self, depth: int, u: cla.Array | None) -> None:
        """Take the coarser level's correction, and smooth; the last step leads to `u`, if there is any."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        if level.groups is not None:
            taken = level.groups.group, self._vectors[depth + 1][1]
            if self._is_few(depth):
                given = (_LATE, _EARLY, *level.rows, *level.blocks, b, x, t, *taken)
                self._add(depth, "ascend_alone", n, *given)
                return
            self._add(depth, "prolong", n, *taken, x)
        self._relax(depth, _EARLY)
        self._relax(depth, _LATE, u)

    def _relax(self, depth: int, damping: np.float32, u: cla.Array | None = None) -> None:
        """Take one step of smoothing from the x that there is; into `u`, if that is given."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        self._add(depth, "defect", n, *level.rows, b, x, t)
        if u is None:
            turn = int(damping is _LATE)
            self._add(depth, "correct", n, damping, *level.blocks, t, x, turn=turn)
        else:
            self._add(depth, "correct_out", n, damping, *level.blocks, t, x, u)
