"""Values of cells carried from one diagram to another by the parts that cells have in common (`transfer.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..errors import ClvoroError, InputError
from ..geometry.box import ClipBox
from ..opencl.engine import Engine
from ..tessellation.bins import BinnedPoints

FACES = {2: 32, 3: 64}
"""Faces that a piece may have at first, by dimension; more are tried where that is not enough."""
MOST_FACES = {2: 4096, 3: 512}
VISITED = {2: 32, 3: 64}
"""Old cells that a new one may meet at first, by dimension."""
SCRATCH = 1 << 23
"""Integers in the lists of old cells that are worked on at a time."""
BINNED = {2: {8: 75, 4: 55}, 3: {8: 80, 4: 60}}
"""Bytes per generator that bins take, by dimension and size of a real."""
GROWTH = 8
"""Factor by which these lists grow."""
DONE, LIST_FULL, PIECE_LARGE, FAILED = range(4)


@dataclass(frozen=True)
class Graph:
    """A diagram on the device, as far as a transfer needs it.

    Attributes
    ----------
    n : int
    points : (n, d) real
        Generators, normalized coordinates.
    starts, neighbors : (n + 1,), (m,) int32
        Rows of the neighbor graph; -1 - wall for walls.
    """

    n: int
    points: cla.Array
    starts: cla.Array
    neighbors: cla.Array


@dataclass(frozen=True)
class Content:
    """What is in the old cells.

    Attributes
    ----------
    values : (n, width) real
        Means over the cells.
    least, most : (n, width) real
        Bounds of what is in a cell.
    centroids : (n, d) real
        Relative to the generators.
    slopes : (n, width, d) real or None
    """

    values: cla.Array
    least: cla.Array
    most: cla.Array
    centroids: cla.Array
    slopes: cla.Array | None = None


@dataclass(frozen=True)
class Transferred:
    """What has come into the new cells, on the host.

    Attributes
    ----------
    means, low, high : (n, width) real
        Means, and the bounds of what they are means of.
    volumes, found : (n,) real
        Normalized volume of a cell, and that of its parts together.
    """

    means: np.ndarray
    low: np.ndarray
    high: np.ndarray
    volumes: np.ndarray
    found: np.ndarray


def transfer_needed(
    engine: Engine, old: tuple[int, int], new: tuple[int, int], width: int, order: int
) -> float:
    """Return the bytes that a transfer of `width` columns takes on the device.

    As if all new cells met about as many old ones; the lists of these never take more than 12 `SCRATCH` bytes.

    Parameters
    ----------
    old, new : (n, m)
        Cells and faces of the meshes.
    order : 1 or 2
        With 2 there are slopes.
    """
    d, real = engine.dim, engine.real.itemsize
    graphs = sum(n * (d * real + 4) + 4 * m for n, m in (old, new))
    bins = BINNED[d][real] * max(old[0], new[0])
    content = (width + d + (order - 1) * width * (2 + d)) * real * old[0]
    found = (3 * width + 2) * real * new[0]
    marks = 8 * new[0] + 4 * (order - 1) * old[0]
    met, room = ((old[0] / new[0]) ** (1 / d) + 2) ** d, VISITED[d]
    while room < met:
        room *= GROWTH
    lists = 12 * min(room * new[0], SCRATCH)
    return graphs + bins + content + found + marks + lists


class Transfer:
    """Intersect the cells of two diagrams of one box, and average what lies in one over those of the other."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._faces = FACES[engine.dim]
        self._build()

    def _build(self) -> None:
        name = "CELL_CAPACITY" if self.engine.dim == 2 else "FACE_CAPACITY"
        self._kernels = self.engine.kernels("remapping/transfer", {name: self._faces})
        # Private arrays of a whole group lie on the stack of a CPU's thread.
        self._group = None if self._faces == FACES[self.engine.dim] else 1

    def _enlarge(self, cell: int) -> None:
        """Give pieces room for twice as many faces."""
        if 2 * self._faces > MOST_FACES[self.engine.dim]:
            raise ClvoroError(
                f"cell {cell}, or a part of it, has more than {self._faces} faces; such a mesh is not supported: "
                "perturb its generators"
            )
        self._faces *= 2
        self._build()

    def fit_slopes(
        self, box: ClipBox, graph: Graph, values: cla.Array, centroids: cla.Array, limited: bool
    ) -> Content:
        """Return the content of cells in which `values` (n, width) are the means of linear functions.

        `limited`: so that they keep within the values of a cell and its neighbors.

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
                self._kernels.fit_slopes, n, np.int32(width), graph.points, graph.starts,
                graph.neighbors, *box.device_corners(engine.real), centroids, values,
                np.int32(limited), slopes, least, most, status, group=self._group,
            )  # fmt: skip
            large = self._judge(status.get(), "the diagram that the values belong to")
            if not large.size:
                return Content(values, least, most, centroids, slopes)
            self._enlarge(int(large[0]))

    def transfer(
        self,
        box: ClipBox,
        old: Graph,
        binned: BinnedPoints,
        content: Content,
        new: Graph,
        order: cla.Array,
    ) -> Transferred:
        """Return the means of `content` of the cells of `old` over those of `new`.

        Parameters
        ----------
        binned : BinnedPoints
            The generators of `old`.
        order : (>= n,) int32
            In which the new cells are worked on; what is near in space should be near in it.

        Raises
        ------
        InputError
            If a graph is not that of a Voronoi diagram.
        """
        engine, n, width = self.engine, new.n, content.values.shape[1]
        means, low, high = (engine.empty((n, width)) for _ in range(3))
        volumes, found = engine.empty(n), engine.empty(n)
        status = engine.empty(n, np.int32)
        lower, upper = box.device_corners(engine.real)
        slopes = content.values if content.slopes is None else content.slopes
        todo, count = order, n
        room = VISITED[engine.dim]
        while True:
            chunk = int(min(count, max(1, SCRATCH // room)))
            queues = tables = None  # before there are longer ones
            queues = engine.empty(chunk * room, np.int32)
            tables = engine.empty(chunk * 2 * room, np.int32)
            for first in range(0, count, chunk):
                engine.run_each(
                    self._kernels.transfer, min(chunk, count - first), np.int32(first), todo,
                    np.int32(room), queues, tables, new.points, new.starts, new.neighbors,
                    np.int32(old.n), old.points, old.starts, old.neighbors, binned.items,
                    binned.bins, binned.grid_frames, binned.grid_shapes, lower, upper,
                    np.int32(width), content.values, content.least, content.most,
                    np.int32(content.slopes is not None), slopes, content.centroids, means, low,
                    high, volumes, found, status, group=self._group,
                )  # fmt: skip
            outcome = status.get()
            large = self._judge(outcome, "one of the diagrams")
            full = np.flatnonzero(outcome == LIST_FULL)
            if large.size:
                self._enlarge(int(large[0]))
            if full.size:
                # A power of two that holds all, in the end: nobody meets more cells than there are.
                room = min(GROWTH * room, 1 << int(old.n).bit_length())
            left = np.sort(np.concatenate([full, large]))
            if not left.size:
                break
            todo, count = engine.upload(left, np.int32), len(left)
        return Transferred(means.get(), low.get(), high.get(), volumes.get(), found.get())

    @staticmethod
    def _judge(status: np.ndarray, what: str) -> np.ndarray:
        """Return the cells that need more room for faces; refuse what cannot be intersected."""
        failed = np.flatnonzero(status == FAILED)
        if failed.size:
            raise InputError(
                f"cell {failed[0]} ({failed.size} in all) cannot be made from its neighbors, expected Voronoi "
                f"diagrams of distinct generators; ask {what} for diagram.check()"
            )
        return np.flatnonzero(status == PIECE_LARGE)
