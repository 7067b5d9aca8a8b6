"""Gradation: limit the growth of sizes on a regular grid (`gradation.cl`)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Literal

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..geometry.sphere import Sphere
from ..opencl.engine import Engine

_TILE = {2: 16, 3: 8}  # nodes along a side
_PASSES = 16  # between two reads of the active tiles by the host


def globe_columns(least: float) -> int:
    """Return a number of columns, at least `least`, for a grid around a sphere: an odd number of pairs of tiles."""
    pair = 2 * _TILE[2]
    return pair * (2 * math.ceil(max(least / pair - 1, 0) / 2) + 1)


class Grid:
    """The nodes of a grid over the bounding box of a domain. Values (n,) are in an order in which x runs fastest.

    - `counts` (d,) int: number of nodes along each axis.
    - `spacing` list of float: distance of the nodes along each axis, in the unit of the device.
    - `corners`, `at`: as `Raster` takes them.
    """

    globe = False
    at: Literal["nodes", "centers"] = "nodes"

    def __init__(self, box: Domain, counts: np.ndarray) -> None:
        self.counts, self.corners = counts, (box.lower, box.upper)
        self.axes = [np.linspace(low, up, n) for low, up, n in zip(*self.corners, counts.tolist(), strict=True)]
        self.spacing = (box.extent / (counts - 1) / box.frame[1]).tolist()

    def __len__(self) -> int:
        return math.prod(self.counts.tolist())

    def nodes(self, rows: np.ndarray) -> np.ndarray:
        """Return the positions (k, d) of the nodes with the numbers (k,)."""
        places = np.unravel_index(rows, self.counts, order="F")
        return np.column_stack([axis[i] for axis, i in zip(self.axes, places, strict=True)])

    def around(self, marks: np.ndarray) -> Iterator[np.ndarray]:
        """Yield, for one corner after the other, the nodes (k,) int there of the boxes around `marks` (k, d)."""
        first = [
            np.clip(np.searchsorted(axis, x, side="right") - 1, 0, len(axis) - 2)
            for axis, x in zip(self.axes, marks.T, strict=True)
        ]
        for corner in product((0, 1), repeat=len(first)):
            place = [i + c for i, c in zip(first, corner, strict=True)]
            yield np.ravel_multi_index(place, tuple(self.counts), order="F")


class GlobeGrid(Grid):
    """A grid of longitude and latitude around a sphere: nodes are the centers of pixels, `columns` along the equator.

    It is closed across the date line and across the poles. The spacing along x is that at the equator.
    """

    globe = True
    at = "centers"

    def __init__(self, sphere: Sphere, columns: int) -> None:
        self.sphere, self.counts, self.corners = sphere, np.array([columns, columns // 2]), ((-180, -90), (180, 90))
        self.spacing = [2 * math.pi / columns, math.pi / (columns // 2)]

    def nodes(self, rows: np.ndarray) -> np.ndarray:
        """Return the positions of nodes (k,) int, (k, 3)."""
        columns = self.counts[0]
        places = np.column_stack([rows % columns + 0.5, rows // columns + 0.5])
        return self.sphere.positions(places * (360 / columns) - (180, 90))

    def around(self, marks: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the nodes around positions `marks` (k, 3), as `Grid.around`."""
        (nx, ny), (lon, lat) = self.counts, self.sphere.lonlat(marks).T
        column, row = (np.floor(x / (360 / nx) - 0.5).astype(int) for x in (lon + 180, lat + 90))
        for right, up in product((0, 1), repeat=2):
            yield (column + right) % nx + nx * np.clip(row + up, 0, ny - 1)


class Gradation:
    """Lower the values on a grid until their gradient is bounded.

    - `engine`: of the dimension of the grid.
    - `globe`: whether grids are those of `GlobeGrid`, with `globe_columns` columns.
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
