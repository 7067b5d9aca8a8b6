"""Gradation: limit the growth of sizes on a regular grid (`gradation.cl`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pyopencl.array as cla

    from ..opencl.engine import Engine

_TILE = {2: 16, 3: 8}  # nodes along a side
_PASSES = 16  # between two reads of the active tiles by the host


def globe_columns(least: float) -> int:
    """Return a number of columns, at least `least`, for a grid around a sphere: an odd number of pairs of tiles."""
    pair = 2 * _TILE[2]
    return pair * (2 * math.ceil(max(least / pair - 1, 0) / 2) + 1)


class Gradation:
    """Lower the values on a grid until their gradient is bounded.

    - `engine`: of the dimension of the grid.
    - `globe`: whether the grid is one of longitude and latitude around a sphere, with nodes at the centers of pixels.
      Then it has `globe_columns` values along a row, and the spacing along x is that at the equator.
    """

    def __init__(self, engine: Engine, globe: bool = False):
        self.engine = engine
        self._tile = _TILE[engine.dim]
        defines: dict[str, object] = {"TILE": self._tile, **({"GLOBE": 1} if globe else {})}
        self._kernels = engine.kernels("sizing/gradation", defines=defines)

    def sweep_tiles(self, values: cla.Array, counts: Sequence[int], spacing: Sequence[float], slope: float) -> int:
        """Replace `values` by the largest values below them with |grad| <= `slope`, to first order.

        Fast sweeping within tiles, which become active in the order of their values.

        - `values` device array of real, (prod(counts),): positive; x runs fastest.
        - `counts`: number of nodes along x, y (, z).
        - `spacing`: distance of the nodes along each axis, in the unit of the values.
        - `slope`: not negative.

        Return the number of passes over the tiles.
        """
        engine, kernels = self.engine, self._kernels
        tiles = tuple(-(-n // self._tile) for n in counts)
        n = math.prod(tiles)
        active, next_active = engine.empty(n, np.int32), engine.empty(n, np.int32)
        active.fill(np.int32(1))
        next_active.fill(np.int32(0))
        lowest = engine.empty(n)
        nodes = [np.int32(c) for c in [*counts, 1][:3]]
        steps = [engine.real.type(s) for s in [*spacing, 1.0][:3]]
        engine.run_each(kernels.tile_minima, n, *nodes, values, lowest)
        # Increase of u across a tile: the front moves by one tile per pass of both colors.
        rise = slope * self._tile * max(spacing)
        passes = 0
        while True:
            begin = self._least_active(active.get(), lowest.get(), tiles)
            if begin is None:
                return passes
            # A threshold out of range of the precision is infinite.
            with np.errstate(over="ignore"):
                growth = engine.real.type(slope)
                front = [engine.real.type(begin + (1 + k // 2) * rise) for k in range(_PASSES)]
            for k in range(_PASSES):
                given = *nodes, *steps, np.int32(k % 2), growth, front[k]
                engine.run_each(kernels.sweep_tiles, n, *given, active, next_active, lowest, values)
                active.fill(np.int32(0))
                active, next_active = next_active, active
            passes += _PASSES

    @staticmethod
    def _least_active(active: np.ndarray, lowest: np.ndarray, tiles: tuple[int, ...]) -> float | None:
        """Return the smallest value in active tiles and their neighbors; None if no tile is active."""
        if not active.any():
            return None
        around = lowest = lowest.reshape(tiles, order="F")
        for axis in range(lowest.ndim):
            pad = [(int(a == axis),) * 2 for a in range(lowest.ndim)]
            wide = np.pad(lowest, pad, mode="edge")
            for first in (0, 2):
                beside = np.take(wide, range(first, first + tiles[axis]), axis)
                around = np.minimum(around, beside)
        return float(around.ravel(order="F")[active > 0].min())
