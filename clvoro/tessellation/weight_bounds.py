"""Upper bounds of weights near each position, for the search in power diagrams (`weight_bounds.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine

OCCUPANCY = 8
"""Generators per tile on the finest level, at least, if they are uniform."""
_NONE = np.iinfo(np.int32).min


class WeightBounds:
    """A pyramid of tiles with the largest weight in and around each of them; see `tessellation/weight_bounds.h`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("tessellation/weight_bounds")

    def build(self, box: ClipBox, points: cla.Array, n: int) -> tuple[object, ...]:
        """Return the BOUND_ARGS of kernels for the first `n` of `points` (n, d + 1) in `box`.

        The arrays are in the workspace.
        """
        engine, k, d = self.engine, self._kernels, self.engine.dim
        lower, upper = box.device_corners(engine.real)
        edge = float((upper - lower)[:d].max())
        levels = max(0, int(np.log2(max(n / OCCUPANCY, 1)) / d))
        side = 1 << levels
        tiles_from = lower.copy()
        tiles_from[3] = side / edge
        counts = [(side >> level) ** d for level in range(levels + 1)]
        total = sum(counts)
        keys, bounds = engine.scratch(total, np.int32), engine.scratch(total, np.float32)
        keys.fill(_NONE)
        engine.run_each(k.collect_weights, n, points, tiles_from, np.int32(side), keys)
        first = 0
        for level, count in enumerate(counts):
            here = np.int32(side >> level), np.int32(first)
            if level:
                engine.run_each(k.coarsen_weights, count, *here, keys)
            engine.run_each(k.spread_weights, count, *here, keys, bounds)
            first += count
        return bounds, tiles_from, np.int32(side)
