"""Neighbor search: generators sorted into hierarchical bins (`bins.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import DTypeLike

from ..geometry.domain import ClipBox
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine
from ..opencl.primitives import Gather, Scan

OCCUPANCY = 2
"""Mean number of generators per bin: a compromise between bins to open and generators to test."""
SPLIT_COUNT = {2: 10, 3: 18}
"""A bin with more generators is divided by a finer grid. Uniform random sets (Poisson, mean 2) stay on one level."""
SPACING_COUNT = 8
"""Least number of generators from which the spacing around a leaf is estimated."""
BOUNDS = 256
"""Number of shares of the points of a part. The device finds the box around each share, the host the one around all."""
_ZERO = np.zeros(1, np.int32)
_WORK = ("_keys", "_counts", "_grid_of", "_grid_items", "_starts", "_flags", "_sizes")
"""Buffers that only `build` uses."""
KEPT_FOR = 1 << 16
"""Number of generators up to which buffers are kept."""
MAX_CHILD_SIDE = 64
"""Most bins per axis of a grid below the first."""
MAX_LEVELS = 8
"""Enough to separate 1e5 generators in a cluster of 1e-12 of the domain."""


def root_edge(extent: np.ndarray, n: int) -> float:
    """Return the edge of bins that cover a box and hold `OCCUPANCY` of `n` uniform generators each.

    An axis shorter than the edge has one bin. The edge then follows from the other axes, so that a thin box does not
    get more bins than generators.

    - `extent`: (d,) float
    """
    wide = np.sort(extent)[::-1]
    for axes in range(len(wide), 1, -1):
        edge = float(np.prod(wide[:axes]) * OCCUPANCY / n) ** (1 / axes)
        if edge <= wide[axes - 1]:
            return edge
    return float(wide[0] * OCCUPANCY / n)


@dataclass(frozen=True)
class BinnedPoints:
    """Generators in bins, on the device; see `tessellation/bins.h` for the layout."""

    items: cla.Array
    """(>= n,) int32. Generator indices in bin order, ascending within a bin."""
    points: cla.Array
    """(>= n, d) real. Positions in the same order."""
    reach: cla.Array
    """(>= n,) float32. Edge of the leaf that holds the generator, in the same order."""
    spacing: cla.Array
    """(>= n,) float32. Estimated edge of a bin with `OCCUPANCY` generators, from the bins around the leaf."""
    bins: cla.Array
    """(b, 2) int32."""
    grid_frames: cla.Array
    """(g, 4) real."""
    grid_shapes: cla.Array
    """(g, 4) int32."""
    sides: tuple[int, ...]
    """d integers, on the host. Bins of the first grid along each axis."""

    @property
    def search(self) -> tuple[cla.Array, ...]:
        """The search radii, and the BIN_ARGS of kernels (tessellation/bins.h)."""
        return self.reach, self.bins, self.grid_frames, self.grid_shapes


class Bins:
    """Sort generators into bins. Buffers stay between calls and grow when needed."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan, self._gather = Scan(engine), Gather(engine)
        self._kernels = engine.kernels(
            "tessellation/bins",
            {
                "SPLIT_COUNT": SPLIT_COUNT[engine.dim],
                "MAX_CHILD_SIDE": MAX_CHILD_SIDE,
                "OCCUPANCY": OCCUPANCY,
                "SPACING_COUNT": SPACING_COUNT,
            },
        )
        self._capacity: tuple[int, int] = (0, 0)

    def _reserve(self, n: int, bins: int) -> None:
        """Make room for `n` generators and `bins` bins; the contents of the bins stay."""
        engine, d = self.engine, self.engine.site_size
        if n > self._capacity[0]:
            self._found = engine.empty(2, np.int32)
            self._keys = engine.empty(n, np.int32)
            self._ranks = engine.empty(n, np.int32)
            self._items = engine.empty(n, np.int32)
            self._points = engine.empty((n, d))
            self._reach = engine.empty(n, np.float32)
        if bins > self._capacity[1]:
            self._counts = self._grown("_counts", bins, np.int32)
            self._bins = self._grown("_bins", bins * 2, np.int32)
            self._grid_of = self._grown("_grid_of", bins, np.int32)
            # A divided bin holds more than SPLIT_COUNT generators, so grids are far fewer than bins.
            self._frames = self._grown("_frames", (bins // 4 + 1) * 4, engine.real)
            self._shapes = self._grown("_shapes", (bins // 4 + 1) * 4, np.int32)
            self._grid_items = self._grown("_grid_items", bins // 4 + 1, np.int32)
            self._starts = engine.empty(bins + 1, np.int32)
            self._flags = engine.empty(bins + 1, np.int32)
            self._sizes = engine.empty(bins + 1, np.int32)
        self._capacity = (max(n, self._capacity[0]), max(bins, self._capacity[1]))

    def _grown(self, name: str, size: int, dtype: DTypeLike) -> cla.Array:
        grown = self.engine.zeros(size, dtype)
        old = getattr(self, name, None)
        if old is not None:
            cl.enqueue_copy(self.engine.queue, buffer_of(grown), buffer_of(old), byte_count=old.nbytes)
        return grown

    def _clear(self, array: cla.Array, first: int, count: int) -> None:
        """Write zeros by a fill command, which is several times as fast as a kernel."""
        size = array.dtype.itemsize
        cl.enqueue_fill(self.engine.queue, buffer_of(array), _ZERO, count * size, offset=first * size)

    def clear(self) -> None:
        """Free all buffers, if they are not small."""
        if self._capacity[0] > KEPT_FOR:
            self._free(self._names())

    def clear_work(self) -> None:
        """Free the buffers that only `build` uses, if they are not small; the next `build` allocates them again."""
        if self._capacity[0] > KEPT_FOR:
            self._free([name for name in _WORK if hasattr(self, name)])

    def _names(self) -> list[str]:
        return [name for name in vars(self) if isinstance(getattr(self, name), cla.Array)]

    def _free(self, names: list[str]) -> None:
        for name in names:
            delattr(self, name)
        self._capacity = (0, 0)

    def build(self, box: ClipBox, points: cla.Array, n: int) -> BinnedPoints:
        """Sort the first `n` of `points` (n, d; normalized coordinates, within `box`) into bins.

        In a power diagram rows of `points` end with weights. The host reads two integers per level, at once; uniform
        sets have one level. On ranks it reads the extent of the points of its part as well.
        """
        engine, k, d = self.engine, self._kernels, self.engine.dim
        lower, upper = (corner.astype(np.float64)[:d] for corner in box.device_corners(engine.real))
        if n and engine.peers.count > 1:
            # A part of a domain fills a part of the box.
            bounds = engine.scratch((BOUNDS, 2, d))
            engine.run_each(engine.kernels("tessellation/part", shared=True).bound_points, BOUNDS, n, points, bounds)
            of_shares = bounds.get().astype(np.float64)
            lower, upper = of_shares[:, 0].min(axis=0), of_shares[:, 1].max(axis=0)
        edge = root_edge(upper - lower, n)
        sides = np.maximum(1, np.ceil((upper - lower) / edge).astype(int))
        root_bins = int(np.prod(sides)) + 1
        if not self._capacity[0]:
            self._free(self._names())
        self._reserve(n, root_bins + n // 2)
        self._clear(self._counts, 0, root_bins)
        frame, shape = np.zeros(4, engine.real), np.ones(4, np.int32)
        frame[:d], frame[3], shape[0], shape[1 : d + 1] = lower, 1 / edge, 0, sides
        self._frames[:4] = frame
        self._shapes[:4] = shape
        self._clear(self._grid_of, 0, root_bins)
        engine.run_each(k.count_root, n, points, frame, shape, self._keys, self._ranks, self._counts)
        begin, size, grids = 0, root_bins, 1
        for level in range(MAX_LEVELS):
            new_grids, new_bins, firsts = self._place_level(begin, size, grids, level < MAX_LEVELS - 1)
            if new_grids == 0:
                break
            self._reserve(n, begin + size + new_bins)
            self._divide(points, n, begin, size, firsts, new_bins)
            begin, size, grids = begin + size, new_bins, grids + new_grids
        total = begin + size
        engine.run_each(k.place_items, n, self._keys, self._ranks, self._bins, self._items)
        spacing = self._ranks.view(np.float32)  # the ranks are no longer needed
        engine.run_each(
            k.sort_bins, total, self._bins, self._grid_of, self._frames, self._shapes, self._items, self._reach, spacing
        )
        self._gather.rows(self._items[:n], points, self._points)
        return BinnedPoints(
            self._items,
            self._points,
            self._reach,
            spacing,
            self._bins,
            self._frames,
            self._shapes,
            tuple(int(side) for side in sides),
        )

    def _place_level(self, begin: int, size: int, grids: int, may_divide: bool) -> tuple[int, int, cla.Array]:
        """Place the items of the `size` bins from `begin` on, and plan the division of the fullest.

        Returns the numbers of new grids and new bins, and where the new bins of each divided one begin.
        """
        engine, k, first = self.engine, self._kernels, np.int32(begin)
        engine.run_each(k.plan_children, size, self._counts, first, np.int32(may_divide), self._flags, self._sizes)
        for place, values in enumerate((self._flags, self._sizes)):
            self._scan.exclusive(values, values, size, total=(self._found, place))
        self._scan.exclusive(self._counts, self._starts, size, first=begin)
        grid = self._grid_of, self._shapes, self._grid_items
        engine.run_each(k.place_bins, size, self._starts, first, *grid, np.int32(grids), self._flags, self._bins)
        new_grids, new_bins = map(int, self._found.get())
        return new_grids, new_bins, self._sizes

    def _divide(self, points: cla.Array, n: int, begin: int, size: int, firsts: cla.Array, new_bins: int) -> None:
        """Make the planned grids of `new_bins` bins, and count their generators."""
        engine, k, end = self.engine, self._kernels, begin + size
        self._clear(self._counts, end, new_bins)
        grids = self._frames, self._shapes
        bins = self._bins, self._counts, np.int32(begin), np.int32(end), firsts, self._grid_of
        engine.run_each(k.make_grids, size, *bins, *grids, self._grid_items)
        engine.run_each(k.count_in_child_bins, n, points, self._bins, *grids, self._keys, self._ranks, self._counts)

    def renumber(self, binned: BinnedPoints, n: int) -> None:
        """Update `binned` after its `n` generators have been sorted into its order: item p is now generator p.

        The result has the same bits as a new `build`.
        """
        self.engine.run_each(self._kernels.number_items, n, binned.items)
