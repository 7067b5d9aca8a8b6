"""Conservative transfer of cell data by the intersections of old and new cells, on the device (`transfer.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..errors import ClvoroError, InputError
from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..tessellation.bins import BinnedPoints

FACES = {2: 32, 3: 32}
"""Initial face capacity of a piece by dimension; doubled when a piece needs more."""
MOST_FACES = {2: 4096, 3: 512}
"""Largest face capacity by dimension."""
OVERLAPS = {2: 32, 3: 64}
"""Initial capacity, by dimension, of the list of old cells that one new cell overlaps."""
LIST_BUDGET = 1 << 23
"""Entries of the lists of old cells that exist at a time."""
BIN_BYTES = {2: {8: 75, 4: 55}, 3: {8: 80, 4: 60}}
"""Bytes per generator that the bins take, by dimension and size of a real."""
GROWTH = 8
"""Factor by which the lists grow."""
DONE, LIST_FULL, PIECE_LARGE, FAILED = range(4)
"""Outcomes of a cell; see `transfer.cl`."""


@dataclass(frozen=True)
class CellGraph:
    """The part of a diagram that a transfer reads, on the device.

    Attributes
    ----------
    n : int
    points : (k, d) real
        Generators, in normalized coordinates; the first n have cells.
    starts, neighbors : (n + 1,), (m,) int32
        Rows of the neighbor graph; -1 - wall for the sides of the box.
    """

    n: int
    points: cla.Array
    starts: cla.Array
    neighbors: cla.Array


@dataclass(frozen=True)
class CellData:
    """Data of the old cells, on the device.

    Attributes
    ----------
    values : (n, width) real
        Means over the cells.
    least, most : (n, width) real
        Bounds of the data inside a cell.
    centroids : (n, d) real
        Relative to the generators.
    slopes : (n, width, d) real or None
    """

    values: cla.Array
    least: cla.Array
    most: cla.Array
    centroids: cla.Array
    slopes: cla.Array | None = None

    @property
    def kernel_args(self) -> tuple[object, ...]:
        """CELL_DATA_ARGS of `transfer.cl`."""
        slopes = self.values if self.slopes is None else self.slopes
        return (
            np.int32(self.values.shape[1]),
            self.values,
            self.least,
            self.most,
            self.centroids,
            np.int32(self.slopes is not None),
            slopes,
        )


@dataclass(frozen=True)
class TransferredData:
    """Data of the new cells, on the host.

    Attributes
    ----------
    means, low, high : (n, width) real
        Means over the cells, and bounds of the old data in them.
    volumes, covered : (n,) real
        Volume of a cell, and the sum of the volumes of its intersections with old cells; normalized.
    """

    means: np.ndarray
    low: np.ndarray
    high: np.ndarray
    volumes: np.ndarray
    covered: np.ndarray


def joined(parts: list[TransferredData]) -> TransferredData:
    """Return the data of new cells from several sets of old cells, which overlap them one beside another."""
    if len(parts) == 1:
        return parts[0]
    covered = np.sum([part.covered for part in parts], axis=0)
    mass = sum(part.means * part.covered[:, None] for part in parts)
    low, high = np.min([part.low for part in parts], axis=0), np.max([part.high for part in parts], axis=0)
    return TransferredData(mass / np.where(covered > 0, covered, 1)[:, None], low, high, parts[0].volumes, covered)


def transfer_bytes(engine: Engine, old: tuple[int, int], new: tuple[int, int], width: int, order: int) -> float:
    """Estimate the device memory in bytes that a transfer of `width` columns needs.

    The estimate assumes that each new cell overlaps about the same number of old cells. The lists of old cells never
    take more than 12 `LIST_BUDGET` bytes.

    Parameters
    ----------
    old, new : (n, m)
        Numbers of cells and of half-faces of the meshes.
    order : 1 or 2
        Slopes exist for order 2 only.
    """
    d, real = engine.dim, engine.real.itemsize
    graphs = sum(n * (d * real + 4) + 4 * m for n, m in (old, new))
    bins = BIN_BYTES[d][real] * max(old[0], new[0])
    data = (width + d + (order - 1) * width * (2 + d)) * real * old[0]
    results = (3 * width + 2) * real * new[0]
    status = 8 * new[0] + 4 * (order - 1) * old[0]
    overlaps, capacity = ((old[0] / new[0]) ** (1 / d) + 2) ** d, OVERLAPS[d]
    while capacity < overlaps:
        capacity *= GROWTH
    lists = 12 * min(capacity * new[0], LIST_BUDGET)
    return graphs + bins + data + results + status + lists


class ConservativeTransfer:
    """Average data over the intersections of the cells of two diagrams in one box."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._build(FACES[engine.dim])

    def _build(self, faces: int) -> None:
        """Build the kernels for pieces of up to `faces` faces."""
        self._faces = faces
        name = {2: "CELL_CAPACITY", 3: "FACE_CAPACITY"}[self.engine.dim]
        self._kernels = self.engine.kernels("remapping/transfer", {name: faces})
        # On a CPU the private arrays of a whole work-group lie on one thread's stack: large ones need groups of one.
        self._group = None if faces == FACES[self.engine.dim] else 1

    def _enlarge(self, cell: int) -> None:
        """Double the face capacity, which `cell` exceeds."""
        if 2 * self._faces > MOST_FACES[self.engine.dim]:
            raise ClvoroError(
                f"cell {cell}, or its intersection with an old cell, has more than {self._faces} faces, expected "
                f"at most {MOST_FACES[self.engine.dim]}: perturb the generators of the mesh"
            )
        self._build(2 * self._faces)

    def fit_slopes(
        self, box: ClipBox, graph: CellGraph, values: cla.Array, centroids: cla.Array, limited: bool
    ) -> CellData:
        """Fit a linear function in each cell to the means `values` (n, width) of the cell and its neighbors.

        Parameters
        ----------
        limited : bool
            Limit the slopes, so that the function stays within the values of the cell and its neighbors.

        Raises
        ------
        InputError
            If the graph is not that of a Voronoi diagram.
        """
        engine, n, width = self.engine, graph.n, values.shape[1]
        slopes = engine.empty((n, width, engine.dim))
        least, most = engine.empty((n, width)), engine.empty((n, width))
        status = engine.empty(n, np.int32)
        while True:
            engine.run_each(
                self._kernels.fit_slopes,
                n,
                np.int32(width),
                graph.points,
                graph.starts,
                graph.neighbors,
                *box.device_corners(engine.real),
                centroids,
                values,
                np.int32(limited),
                slopes,
                least,
                most,
                status,
                group=self._group,
            )
            large = self._cells_to_enlarge(status.get(), "the diagram of the values")
            if not large.size:
                return CellData(values, least, most, centroids, slopes)
            self._enlarge(int(large[0]))

    def transfer(
        self,
        box: ClipBox,
        old: CellGraph,
        binned: BinnedPoints,
        data: CellData,
        new: CellGraph,
        order: cla.Array,
        partial: bool = False,
    ) -> TransferredData:
        """Return the means of `data` of the old cells over the new cells.

        Parameters
        ----------
        box : ClipBox
            A box that holds all new cells.
        binned : BinnedPoints
            The generators of `old`.
        order : (>= n,) int32
            Order in which work-items take the new cells; consecutive cells should be near each other.
        partial : bool
            Whether parts of new cells, or all of one, may be outside of the old cells.

        Raises
        ------
        InputError
            If a graph is not that of a Voronoi diagram.
        """
        engine, n, width = self.engine, new.n, data.values.shape[1]
        means, low, high = (engine.empty((n, width)) for _ in range(3))
        volumes, covered = engine.empty(n), engine.empty(n)
        status = engine.empty(n, np.int32)
        todo, count = order, n
        capacity = OVERLAPS[engine.dim]
        while True:
            chunk = int(min(count, max(1, LIST_BUDGET // capacity)))
            queues = tables = None  # free the shorter lists first
            queues = engine.empty(chunk * capacity, np.int32)
            tables = engine.empty(chunk * 2 * capacity, np.int32)
            for first in range(0, count, chunk):
                engine.run_each(
                    self._kernels.transfer_cell_data,
                    min(chunk, count - first),
                    np.int32(first),
                    todo,
                    np.int32(capacity),
                    queues,
                    tables,
                    new.points,
                    new.starts,
                    new.neighbors,
                    np.int32(old.n),
                    old.points,
                    old.starts,
                    old.neighbors,
                    binned.items,
                    binned.bins,
                    binned.grid_frames,
                    binned.grid_shapes,
                    *box.device_corners(engine.real),
                    np.int32(partial),
                    *data.kernel_args,
                    means,
                    low,
                    high,
                    volumes,
                    covered,
                    status,
                    group=self._group,
                )
            outcome = status.get()
            large = self._cells_to_enlarge(outcome, "one of the diagrams")
            full = np.flatnonzero(outcome == LIST_FULL)
            if large.size:
                self._enlarge(int(large[0]))
            if full.size:
                # The capacity is a power of two. No cell overlaps more old cells than there are.
                capacity = min(GROWTH * capacity, 1 << int(old.n).bit_length())
            left = np.sort(np.concatenate([full, large]))
            if not left.size:
                break
            todo, count = engine.upload(left, np.int32), len(left)
        return TransferredData(means.get(), low.get(), high.get(), volumes.get(), covered.get())

    @staticmethod
    def _cells_to_enlarge(status: np.ndarray, what: str) -> np.ndarray:
        """Return the cells that exceed the face capacity; raise InputError if any cell failed."""
        failed = np.flatnonzero(status == FAILED)
        if failed.size:
            raise InputError(
                f"cell {failed[0]} ({failed.size} in all) cannot be rebuilt from its neighbors, expected Voronoi "
                f"diagrams of distinct generators: call diagram.check() on {what}"
            )
        return np.flatnonzero(status == PIECE_LARGE)
