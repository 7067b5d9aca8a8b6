"""One multigrid V-cycle as a list of launches with their arguments set (`multigrid.cl`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..opencl.kernels import bind, comparison_key, fit_group
from ..opencl.launch import one_group_limit
from ..opencl.primitives import NamedArrays
from .aggregation import WORK_GROUP, Aggregates, Graph, PairInverse, round_to_work_group

# Chebyshev's polynomial of degree 2 on [_LOWEST, 2], as the damping factors of two steps. Smaller eigenvalues are left
# to the coarse levels.
_LOWEST = 0.35
_CENTER, _RADIUS = (2 + _LOWEST) / 2, (2 - _LOWEST) / 2
_EARLY = np.float32(1 / (_CENTER - _RADIUS * math.sqrt(0.5)))
_LATE = np.float32(1 / (_CENTER + _RADIUS * math.sqrt(0.5)))
_NO_DAMPING = np.float32(0)
_ONE_GROUP = ("descend_by_group", "ascend_by_group", "solve_coarsest")
"""Kernels of one work-group."""


@dataclass(frozen=True)
class Level:
    """A graph, its smoother, and the aggregates that are the cells of the next level (None on the coarsest)."""

    graph: Graph
    pairs: PairInverse
    aggregates: Aggregates | None

    def __len__(self) -> int:
        return len(self.graph)


class Cycle:
    """Enqueues cycles: from the finest level down to the coarsest, and up again.

    Coarse levels of few cells take one launch of one work-group each, with the same bits.

    Parameters
    ----------
    engine : Engine
        In the precision of the multigrid.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._one_group_limit = one_group_limit(engine)
        self._room = NamedArrays(engine)
        self._kernels: dict[tuple[object, ...], cl.Kernel] = {}
        self.clear()

    def clear(self) -> None:
        """Free all buffers."""
        self._room.clear()
        self.set_levels([], None)

    def set_levels(self, levels: Sequence[Level], factor: cla.Array | None) -> None:
        """Use these levels, the finest first. `factor` is the factorized coarsest level, if it is solved exactly."""
        self._levels, self._factor = levels, factor
        self._key: list[object] | None = None

    def enqueue(self, r: cla.Array, u: cla.Array, work: cla.Array | None) -> None:
        """Enqueue u = M^-1 r. The content of `work`, if given, is overwritten."""
        key = comparison_key([a for a in (r, u, work) if a is not None])
        if self._key != key:
            self._key, self._launches = None, []
            self._set_launches(r, u, work)
            self._key = key
        for launch in self._launches:
            self.engine.enqueue(*launch)

    def _set_launches(self, r: cla.Array, u: cla.Array, work: cla.Array | None) -> None:
        levels = self._levels
        self._source = r.dtype
        # The finest level uses the caller's vectors if they have the same precision.
        in_place = work is not None and r.dtype == np.float32
        finest = [r, u, work] if in_place else self._make_vectors(0)
        self._vectors = [finest, *(self._make_vectors(depth) for depth in range(1, len(levels)))]
        smoothed = len(levels) - (self._factor is not None)
        for depth in range(smoothed):
            self._descend(depth, None if depth or in_place else r)
        if self._factor is not None:
            self._solve_coarsest(smoothed, *(None, None) if smoothed or in_place else (r, u))
        for depth in reversed(range(smoothed)):
            self._ascend(depth, None if depth or in_place else u)

    def _make_vectors(self, depth: int) -> list[cla.Array]:
        """Return the right side, solution and defect of a level."""
        return [self._room(depth, name, size=len(self._levels[depth])) for name in "bxt"]

    def _add(self, depth: int, name: str, size: int, *args: object, turn: int = 0) -> None:
        """Add a launch. Each level and `turn` has a separate kernel object, because an object keeps its arguments."""
        key = (depth, name, turn, self._source)
        if key not in self._kernels:
            defines = {"SOURCE": self.engine.name_of(self._source)}
            self._kernels[key] = getattr(self.engine.kernels("solvers/multigrid", defines), name)
        kernel = self._kernels[key]
        bind(kernel, (np.int32(size), *args))
        if name in _ONE_GROUP:
            whole = group = self.engine.block_of(kernel)
        else:
            whole, group = round_to_work_group(size), fit_group(kernel, WORK_GROUP)
        self._launches.append((kernel, whole, group))

    def _is_small(self, depth: int) -> bool:
        """Return whether one work-group does all steps of a level."""
        level = self._levels[depth]
        return depth > 0 and level.aggregates is not None and len(level) <= self._one_group_limit

    def _descend(self, depth: int, r: cla.Array | None) -> None:
        """Smooth from zero and restrict the defect. The right side is rounded from `r`, if given."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        blocks, lists, count = level.pairs.blocks, (), 0
        if level.aggregates is not None:
            coarse_b = self._vectors[depth + 1][0]
            lists = (level.aggregates.starts, level.aggregates.members, coarse_b)
            count = len(level.aggregates)
        if self._is_small(depth):
            given = (_LATE, _EARLY, *level.graph.rows, *blocks, b, x, t, np.int32(count), *lists)
            self._add(depth, "descend_by_group", n, *given)
            return
        if r is None:
            self._add(depth, "smooth_from_zero", n, _LATE, *blocks, b, x)
        else:
            self._add(depth, "smooth_from_zero_rounded", n, _LATE, *blocks, r, b, x)
        self._smooth(depth, _EARLY)
        if lists:
            self._add(depth, "compute_defect", n, *level.graph.rows, b, x, t)
            self._add(depth, "restrict_defect", count, t, *lists)

    def _solve_coarsest(self, depth: int, r: cla.Array | None, u: cla.Array | None) -> None:
        """Solve on the coarsest level, from `r` and into `u`, if given."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        blocks = level.pairs.blocks
        if r is not None:
            self._add(depth, "smooth_from_zero_rounded", n, _NO_DAMPING, *blocks, r, b, x)
        self._add(depth, "solve_coarsest", n, self._factor, b, t, x)
        if u is not None:
            self._add(depth, "smooth_into", n, _NO_DAMPING, *blocks, b, x, u)

    def _ascend(self, depth: int, u: cla.Array | None) -> None:
        """Add the correction of the coarser level and smooth. The last step writes to `u`, if given."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        if level.aggregates is not None:
            correction = level.aggregates.aggregate, self._vectors[depth + 1][1]
            if self._is_small(depth):
                rows, blocks = level.graph.rows, level.pairs.blocks
                given = (_LATE, _EARLY, *rows, *blocks, b, x, t, *correction)
                self._add(depth, "ascend_by_group", n, *given)
                return
            self._add(depth, "prolong", n, *correction, x)
        self._smooth(depth, _EARLY)
        self._smooth(depth, _LATE, u)

    def _smooth(self, depth: int, damping: np.float32, u: cla.Array | None = None) -> None:
        """Do one step of smoothing in place, or into `u`."""
        level, (b, x, t), n = self._levels[depth], self._vectors[depth], len(self._levels[depth])
        self._add(depth, "compute_defect", n, *level.graph.rows, b, x, t)
        if u is None:
            turn = int(damping is _LATE)
            self._add(depth, "smooth", n, damping, *level.pairs.blocks, t, x, turn=turn)
        else:
            self._add(depth, "smooth_into", n, damping, *level.pairs.blocks, t, x, u)
