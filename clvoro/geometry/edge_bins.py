"""The edges of a polygon in uniform bins on the device; see geometry/edges.h."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from ..connectivity import ranges
from ..opencl.engine import Engine
from ..opencl.workspace import Workspace

BINS_PER_EDGE = 4
LEAST_SIDE, LARGEST_SIDE = 32, 1024
"""Bins along the longer side. Small bins are fast to search; empty ones cost only memory."""

_BEHIND = 16
"""Tolerance for generators on an edge, in units of round-off on the device."""


class EdgeBins:
    """Edges as arguments of kernels: EDGE_ARGS. They are freed with the workspace of the engine.

    - `begins`, `ends` (k, 2) float64: in the device's coordinates.
    - `rounding`: round-off of a generator on an edge.
    """

    def __init__(self, begins: np.ndarray, ends: np.ndarray, rounding: float) -> None:
        self._edges, self._rounding = (begins, ends), rounding
        self._known: WeakKeyDictionary[Workspace, dict[np.dtype, tuple[object, ...]]] = WeakKeyDictionary()

    def arguments(self, engine: Engine) -> tuple[object, ...]:
        """Return the frame and shape of the bins, their starts, and the edges in them; see geometry/edges.h."""
        there = self._known.setdefault(engine.workspace, {})
        if engine.real not in there:
            frame, shape, starts, listed = bin_edges(*self._edges)
            # The round-off of a generator on an edge: that of the device and that of the domain.
            frame[3] = _BEHIND * float(np.finfo(engine.real).eps) + self._rounding
            there[engine.real] = (
                frame.astype(engine.real),
                shape,
                engine.upload(starts, np.int32),
                engine.upload(np.concatenate(self._edges, axis=1)[listed].ravel()),
            )
        return there[engine.real]


def bin_edges(begins: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sort edges from `begins` to `ends`, (k, 2) each, into bins.

    Results:
    - `frame` (4,) float: origin (2), 1 / width of a bin, and 0, which the caller replaces.
    - `shape` (4,) int32: number of bins along x and y, 0, 0.
    - `starts` (bins + 1,) int32: place in `listed` of the first edge of each bin, row by row.
    - `listed`: the edges that pass through each bin, or so near to it that round-off matters.
    """
    lower = np.minimum(begins, ends).min(axis=0)
    upper = np.maximum(begins, ends).max(axis=0)
    extent = upper - lower
    side = np.clip(np.sqrt(BINS_PER_EDGE * len(begins)), LEAST_SIDE, LARGEST_SIDE)
    # Slightly more than the extent, so that no point lies beyond the last bin.
    edge = extent.max() * (1 + 1e-6) / side
    counts = np.maximum(np.ceil(extent / edge).astype(int), 1)
    slack = 1e-3  # of a bin, more than round-off in single precision
    a, b = (begins - lower) / edge, (ends - lower) / edge
    # Each edge crosses a range of rows, and in each row a range of bins.
    first = np.clip(np.floor(np.minimum(a, b)[:, 1] - slack), 0, counts[1] - 1).astype(int)
    last = np.clip(np.floor(np.maximum(a, b)[:, 1] + slack), 0, counts[1] - 1).astype(int)
    number, row = ranges(first, last)
    along = b[number] - a[number]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.stack([row - slack, row + 1 + slack]) - a[number, 1]) / along[:, 1]
    # A horizontal edge has its whole length in one row.
    t = np.where(np.isfinite(t), np.clip(t, 0, 1), [[0.0], [1.0]])
    x = a[number, 0] + t * along[:, 0]
    left = np.clip(np.floor(x.min(axis=0) - slack), 0, counts[0] - 1).astype(int)
    right = np.clip(np.floor(x.max(axis=0) + slack), 0, counts[0] - 1).astype(int)
    entry, column = ranges(left, right)
    bins = row[entry] * counts[0] + column
    order = np.argsort(bins, kind="stable")
    starts = np.searchsorted(bins[order], np.arange(counts.prod() + 1))
    frame = np.array([*lower, 1 / edge, 0.0])
    return frame, np.array([*counts, 0, 0], np.int32), starts.astype(np.int32), number[entry][order]
