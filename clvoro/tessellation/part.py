"""A part of the generators of a domain: those with cells, and the ghosts that shape these cells.

Ghosts are images of generators beyond periodic boundaries, generators of another part, whose halo they form, or
auxiliary generators outside of a polygon or a solid. Rows of a part are numbered by its own generators, then by its
ghosts, and the diagram of a part names neighbors by these rows. A stage that reads ``values[neighbors[k]]`` takes the
diagram of a part as it is, with arrays of all rows whose ghosts `Part.forward` has filled.

The diagram of a periodic box is folded as the last step (`GhostImages.fold`): neighbors name the owners of images.
Values then need no ghosts, steps need no launch to fill them, and an update needs no images. Kernels that compute the
position of a neighbor take its nearest image (the PERIODIC macros).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine, PartialSums
from ..opencl.peers import Peers, Swap
from .back_ends import LANES, has_lanes
from .device_diagram import Tessellation

SUMS = 256
"""Number of partial sums over the cells of a part."""


@dataclass(frozen=True)
class Ghosts:
    """Who owns the g ghosts of a part: what fills their values.

    - `rows` (>= g,) int32, device: row of the owner in its part; -1 for a ghost without owner.
    - `codes` (>= g,) int32, device: codes of periodic images: the sum over the axes a of (c + 1) 3^a, where the image
      is shifted by c periods, c = -1, 0 or 1.
    - `firsts` (n_own + 1,) int32, device: the images of generator i begin at ``firsts[i]``.
    - `peers`: if owners are in other parts. Ghosts are then in the order of these.
    - `parts` (g,) int: with `peers`, the part of each owner, on the host.
    - `sent` (s,) int32, device: rows of this part whose values others need, part by part.
    - `sent_counts`, `counts` (p,) int: how many rows each part needs, and how many ghosts it owns.
    """

    rows: cla.Array
    codes: cla.Array | None = None
    firsts: cla.Array | None = None
    peers: Peers | None = None
    parts: np.ndarray | tuple[int, ...] = ()
    sent: cla.Array | None = None
    sent_counts: np.ndarray | tuple[int, ...] = ()
    counts: np.ndarray | tuple[int, ...] = ()

    @classmethod
    def of_lists(
        cls, engine: Engine, peers: Peers, parts: np.ndarray, rows: np.ndarray, sent: Sequence[np.ndarray]
    ) -> Ghosts:
        """Return ghosts whose owners are the `rows` (g,) of `parts` (g,), in ascending order of parts.

        Of the rows of this part, each part needs those in its item of `sent`.
        """
        sizes, counts = np.array([len(needed) for needed in sent]), np.bincount(parts, minlength=peers.count)
        needed = engine.upload(np.concatenate(sent), np.int32)
        return cls(engine.upload(rows, np.int32), None, None, peers, parts, needed, sizes, counts)

    def fill(self, engine: Engine, n_own: int, *values: cla.Array, sums: PartialSums | None = None) -> np.ndarray:
        """Fill the rows of each of `values` from `n_own` on with the values of the owners; see `Part.forward`."""
        kernels = engine.kernels("tessellation/part", shared=True)
        words = [math.prod(array.shape[1:]) * array.dtype.itemsize // 4 for array in values]
        if self.peers is None:
            for array, width in zip(values, words, strict=True):
                size = array.shape[0] - n_own
                engine.run_each(kernels.forward_values, size, np.int32(n_own), self.rows, np.int32(width), array)
            return np.empty(0)
        assert self.sent is not None
        row, s, g = sum(words), len(self.sent), len(self.parts)
        columns = [(np.int32(width), np.int32(row), np.int32(sum(words[:k]))) for k, width in enumerate(words)]
        with engine.workspace.frame():
            packed, given, copy = np.empty((s, row), np.uint32), engine.scratch(s * row, np.uint32), None
            if s:
                for array, which in zip(values, columns, strict=True):
                    engine.run_each(kernels.pack_rows, s, self.sent, array, *which, given)
                # If sums are read next, this copy is complete then.
                copy = cl.enqueue_copy(engine.queue, packed, buffer_of(given), is_blocking=sums is None)
            received, totals = np.empty((g, row), np.uint32), np.empty(0)
            rows = Swap(packed, np.asarray(self.sent_counts), received, np.asarray(self.counts))
            if sums is None:
                self.peers.swap(rows)
            else:
                totals = engine.sum_over_parts(sums, partial(self.peers.swap, rows))
            del copy
            if g and len(values) == 1:
                engine.send(received, values[0], n_own * 4 * row)
            elif g:
                taken = engine.scratch(g * row, np.uint32)
                engine.send(received, taken)
                for array, which in zip(values, columns, strict=True):
                    engine.run_each(kernels.unpack_rows, g, np.int32(n_own), taken, *which, array)
        return totals

    def rows_of_all(self, sizes: np.ndarray) -> np.ndarray:
        """Return where own generators, and then ghosts, are among the generators of all parts, (n_own + g,) int.

        `sizes` (p,) are the numbers of own generators of the parts.
        """
        assert self.peers is not None
        firsts = np.cumsum(sizes) - sizes
        own = firsts[self.peers.number] + np.arange(sizes[self.peers.number])
        return np.concatenate([own, firsts[self.parts] + self.rows.get()])

    def shift(self, engine: Engine, n_own: int, periods: np.ndarray, points: cla.Array) -> None:
        """Move the ghosts in `points`, rows from `n_own` on, by the periods of their codes; `periods` (4,) real."""
        shift = engine.kernels("tessellation/part", shared=True).shift_ghosts
        engine.run_each(shift, len(self.parts), np.int32(n_own), self.codes, periods, points)


def follow_images(
    engine: Engine, n: int, sites: cla.Array, periods: np.ndarray, own: cla.Array, points: cla.Array
) -> None:
    """Set the first `n` of `points`, and of `own`, to the images of `sites` that are nearest to `own`."""
    engine.run_each(engine.kernels("tessellation/part", shared=True).follow_images, n, sites, periods, own, points)


@dataclass(frozen=True)
class Part:
    """Generators with cells and unknowns, and ghosts that only shape cells, on the device.

    - `n_own`, `count`: number of generators with cells; number of generators and ghosts.
    - `points` (>= count, d) real: in the device's coordinates, ghosts last. In a power diagram rows end with weights.
    - `box`: contains all of them, and clips cells.
    - `ghosts`: None if the ghosts have no values, or there are none.
    - `halo_args`: what kernels need to test whether the ghosts are enough: HALO_ARGS in a periodic box
      (periodic/halo.h).
    - `labels` (count,) int32: permanent names of the generators. The faces of a cell are then in the order of labels,
      and its measures are summed in this order: they have the same bits in all parts that have the cell. A periodic
      image has the label of its owner, so that no cell may be a neighbor of two images of one generator.
    """

    n_own: int
    count: int
    points: cla.Array
    box: ClipBox
    ghosts: Ghosts | None = None
    halo_args: tuple[object, ...] = ()
    labels: cla.Array | None = None

    @classmethod
    def alone(cls, points: cla.Array, box: ClipBox, n: int | None = None) -> Part:
        """Return the part of the first `n` of `points`, by default all, without ghosts."""
        n = len(points) if n is None else n
        return cls(n, n, points, box)

    def in_order(self, engine: Engine, rows: np.ndarray) -> Part:
        """Return the part with its `rows` (count,) in this order."""
        assert self.labels is not None
        points, labels = (engine.upload(array.get()[rows], array.dtype) for array in (self.points, self.labels))
        return replace(self, points=points, labels=labels)

    @property
    def peers(self) -> Peers | None:
        """The other parts of the domain, if there are any."""
        return None if self.ghosts is None else self.ghosts.peers

    def order_rows(
        self, engine: Engine, t: Tessellation, defines: dict[str, object], enqueue: Callable[..., object] | None = None
    ) -> None:
        """Sort the rows of `t`, a diagram of this part, by the labels, and measure its cells and their reach again.

        `defines` are those of the builder of its cells. `enqueue` stands for `Engine.run_each`.
        """
        given = (*t.graph, self.labels, t.sites, *self.box.clip_args(engine), *t.vertices)
        reach = engine.scratch(t.n, np.float32) if t.reach is None else t.reach
        measures = t.face_measures, t.face_centroids, t.volumes, t.offsets, t.covariances, reach
        lanes = 1 if t.vertices or not has_lanes(engine) else LANES
        defines = {**defines, "BY_PLACE": 1, "IN_LANES": int(lanes > 1)}
        order = engine.kernels("tessellation/row_order", defines, shared=True).order_rows
        args = *given, *measures, *(engine.period_args if t.vertices else ())
        if enqueue is None:
            engine.run(order, -(-t.n // lanes), np.int32(t.n), *args)
        else:
            enqueue(order, t.n, *args)

    def measure_faces(self, engine: Engine, t: Tessellation, defines: dict[str, object]) -> Tessellation:
        """Return `t`, a diagram of this part, with face measures and centroids in full precision, in new arrays."""
        m = len(t.neighbors)
        t = replace(t, face_measures=engine.empty(m), face_centroids=engine.empty((m, engine.dim)))
        self.order_rows(engine, t, {**defines, "FACE": engine.name_of(engine.real)})
        return t

    def place_unfolded(self, engine: Engine, periods: np.ndarray, placed: cla.Array) -> None:
        """Set `placed` (count, d) to the images in the domain of the points of this part; `periods` (4,) real."""
        place = engine.kernels("tessellation/part", shared=True).place_unfolded
        engine.run_each(place, self.count, self.points, periods, placed)

    def sums(
        self,
        engine: Engine,
        t: Tessellation,
        at: cla.Array,
        limits: cla.Array,
        factor: float,
        with_ghosts: bool,
        needed: cla.Array,
        periods: np.ndarray,
    ) -> np.ndarray:
        """Return sums over own cells that prove, with those of all parts, that `t` is a part of the whole diagram.

        - `at`, `limits` (n_own, d) real, (n_own, 2) float32: of each generator an earlier position, the radius around
          it within which all generators are known, and how far the generator may move from it.
        - `factor`: radius of the ball in which all generators must be known, over the reach of a cell.
        - `with_ghosts`: whether the cells of ghosts beside own cells must be final, too.
        - `needed` (n_own, 2) float32: receives the radii of the balls around own generators in which all generators
          must be known, and how far these have moved.
        - `periods` (4,) real: lengths of the periods; 0 between walls.

        The result is (6,) ndarray: the volume of own cells; the signed sum of the measures of their faces with ghosts;
        the sum without signs; the numbers of generators whose ball is too small, of those that have moved too far, and
        of neighbors half a period away or farther. The signed sums of all parts add up to zero if each face between two
        parts has both sides.
        """
        sums = engine.scratch((SUMS, 6))
        given = *t.graph, self.labels, t.face_measures, t.volumes
        limited = np.int32(with_ghosts), engine.real.type(factor), t.reach, self.points, at, limits, needed, periods
        kernel = engine.kernels("tessellation/part", shared=True).sum_cells
        convex = t if t.trimmed is None else t.trimmed.convex
        rows = np.int32(self.n_own), np.int32(self.count), *convex.graph
        engine.run_each(kernel, SUMS, *rows, *given, *limited, sums)
        return sums.get().sum(axis=0, dtype=float)

    def forward(self, engine: Engine, *values: cla.Array, sums: PartialSums | None = None) -> np.ndarray:
        """Fill the rows of ghosts in each of `values` (count, ...) with the values of their owners.

        Values are whole 32-bit words of any type. Rows of ghosts without owner stay as they are. Other parts get all
        `values` in one message. With `sums` the method does the work of `Engine.sum_over_parts`, too, while the parts
        wait only once.
        """
        return np.empty(0) if self.ghosts is None else self.ghosts.fill(engine, self.n_own, *values, sums=sums)

    def with_ghosts(self, engine: Engine, *values: cla.Array, sums: PartialSums | None = None) -> list[cla.Array]:
        """Return each of `values` (n_own, ...) with those of ghosts behind them, in the workspace; see `forward`."""
        if self.ghosts is None:
            return list(values)
        all_of = [engine.scratch((self.count, *array.shape[1:]), array.dtype) for array in values]
        for extended, array in zip(all_of, values, strict=True):
            cl.enqueue_copy(engine.queue, buffer_of(extended), buffer_of(array), byte_count=array.nbytes)
        self.forward(engine, *all_of, sums=sums)
        return all_of
