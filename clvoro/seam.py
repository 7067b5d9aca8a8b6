"""Periodic boxes: generators with their images beyond the seams, and the diagram folded back (`seam.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ._primitives import Room, Scan
from ._program import Engine, Kernels
from .bins import BinnedPoints
from .domain import Box
from .tessellation import Tessellation

DROPPED, FAR, COLLAPSED, FULL = 1, 2, 4, 8
"""Bits of a report: see `seam.cl`."""
BLOCKS = {2: 128, 3: 32}
"""Blocks per axis along a seam by dimension."""

SIDEWAYS, OUTWARDS = 0.7, 0.2
"""What the next margins have room for, in ways between the generators about a vertex: that the ball around it moves
along the seam, or outwards until the generator on it is at the seam; and what it grows beyond that. With less, diagrams
have to be made again more often."""
KEPT = 0.9
"""Share that margins keep, from diagram to diagram, of what they were."""
OTHER_CELLS = 0.1
"""Share by which the spacing of generators changes where cells are others than before."""
FACE_CAPACITY, MOST_FACES = 64, 512
"""Faces that a cell in 3D may have while it is looked at: doubled for those that have more, but no further."""


def block_count(dim: int) -> int:
    """Return the number of blocks of all seams, those across axes with walls included."""
    return 2 * dim * BLOCKS[dim] ** (dim - 1)


class Margins:
    """How far beyond the seams of a periodic box images are taken, block by block; see `seam.cl`.

    Blocks are in the order of axes, ends (lower, upper) and places along the seam.

    Attributes
    ----------
    needed : (blocks,) float32, device
        How deep balls around the vertices of the latest diagram go that are a little wider than they need be.
    cells : int
        Generators of that diagram; 0 before the first one.
    widths : (blocks,) float32, device
        Within which its images were taken, if it had any.
    """

    def __init__(self, engine: Engine) -> None:
        count = block_count(engine.dim)
        self.needed = engine.zeros(count, np.float32)
        self.cells = 0
        self.widths = engine.zeros(count, np.float32)
        self.wishes = engine.zeros(count, np.int32)
        self.widest = engine.empty(4, np.int32)

    def fill(self, margin: float, cells: int) -> None:
        """Have `margin` needed everywhere by the diagram of `cells` generators."""
        self.needed.fill(margin)
        self.cells = cells


@dataclass(frozen=True)
class ExtendedBox:
    """A periodic box in the device's coordinates, with margins beyond its seams.

    Attributes
    ----------
    lower, upper : (d,) float
        In the device's coordinates.
    """

    lower: np.ndarray
    upper: np.ndarray

    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Corners, padded to four numbers."""
        corners = np.zeros((2, 4), real)
        corners[:, : len(self.lower)] = self.lower, self.upper
        return corners[0], corners[1]


@dataclass(frozen=True)
class Images:
    """Generators of a periodic box and their images in an extended one, on the device.

    Attributes
    ----------
    n, count : int
        Generators; generators and images.
    box : ExtendedBox
    margins : Margins
        Within which images were taken.
    blocks : (2, 4) real, host
        Where blocks of the seams begin along each axis, and how long they are there.
    points : (>= count, d) real
        Generators first, then images in the order of owners and codes.
    firsts : (n + 1,) int32
        Images of generator i are those from ``firsts[i]`` on.
    owners, codes : (>= count - n,) int32
        Of each image: its generator, and which image of it, sum over the axes of (c + 1) 3^a where it lies c periods
        away, c = -1, 0 or 1.
    """

    n: int
    count: int
    box: ExtendedBox
    margins: Margins
    blocks: np.ndarray
    points: cla.Array
    firsts: cla.Array
    owners: cla.Array
    codes: cla.Array


@dataclass(frozen=True)
class Rows:
    """Rows of neighbours of `n` generators on the device, to begin their cells with; -1 for none.

    Attributes
    ----------
    starts : (n + 1,) int32
    neighbours : (m,) int32
    """

    n: int
    starts: cla.Array
    neighbours: cla.Array


@dataclass(frozen=True)
class Folded:
    """The rows of a diagram of generators and images that belong to generators, images replaced by their owners.

    Attributes
    ----------
    tessellation : Tessellation
        Of the n generators. The face's neighbour lies at that generator's place, or at an image of it.
    codes : (>= m,) int32
        Of each face's neighbour, as those of `Images`.
    places : (m,) int32 or None
        Where each face stands in the extended diagram; None: where it stands here.
    """

    tessellation: Tessellation
    codes: cla.Array
    places: cla.Array | None


class Seam:
    """The kernels of `seam.cl`. Buffers are kept from call to call, those of a folded graph for two calls."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._room = Room(engine, spare=1 / 16)  # sizes change a little from step to step
        self._built: dict[int, Kernels] = {}
        self._kernels = self._kernels_for(FACE_CAPACITY)
        self._report = engine.empty(3, np.int32)
        self._turn = 0

    def _kernels_for(self, capacity: int) -> Kernels:
        """Return the kernels for cells, in 3D, of up to so many faces."""
        if capacity not in self._built:
            defines: dict[str, object] = {"BLOCKS": BLOCKS[self.engine.dim]}
            if self.engine.dim == 3:
                defines["FACE_CAPACITY"] = capacity
            self._built[capacity] = self.engine.kernels("seam", defines)
        return self._built[capacity]

    def extend(
        self, domain: Box, points: cla.Array, n: int, margins: Margins, factor: float, grow: bool
    ) -> Images:
        """Return the first `n` of `points` (n, d) with their images beyond the seams.

        Parameters
        ----------
        margins : Margins
            They become what was needed, times `factor`.
        grow : bool
            But nowhere less than they were.
        """
        engine, k, d = self.engine, self._kernels, self.engine.dim
        periods = domain.periods(engine.real)
        corners = np.array(domain.device_corners(engine.real))
        blocks = np.stack([corners[0], np.maximum((corners[1] - corners[0]) / BLOCKS[d], 1e-30)])
        blocks = blocks.astype(engine.real)
        margins.widest.fill(0)
        engine.run_each(
            k.next_margins, block_count(d), margins.needed, np.float32(factor),
            np.int32(abs(factor - 1) > OTHER_CELLS), np.int32(grow), blocks[1], margins.widths,
            margins.widest,
        )  # fmt: skip
        firsts = self._room("firsts", size=n + 1, dtype=np.int32)
        engine.run_each(k.count_images, n, points, margins.widths, margins.widest, *blocks, firsts)
        self._scan.exclusive(firsts, firsts, n)
        ghosts = int(firsts[n].get())
        count = n + ghosts
        extended = self._room("points", size=d * count).reshape(-1, d)
        owners = self._room("owners", size=ghosts, dtype=np.int32)
        codes = self._room("image codes", size=ghosts, dtype=np.int32)
        engine.run_each(
            k.place_images, n, points, margins.widths, margins.widest, *blocks, firsts, extended,
            owners, codes,
        )  # fmt: skip
        lower, upper = (corner[:d].astype(np.float64) for corner in corners)
        # On a coarse grid, so that the corners of the extended box are exact.
        widest = np.ceil(margins.widest.get().view(np.float32)[:d] * 2.0**20) / 2.0**20
        wide = np.minimum(periods, widest).astype(engine.real)
        box = ExtendedBox(lower - wide, upper + wide)
        return Images(n, count, box, margins, blocks, extended, firsts, owners, codes)

    def unfold(self, images: Images, previous: Tessellation) -> Rows:
        """Return rows of the extended graph for the generators, from `previous`: the same ones at earlier positions."""
        m = int(previous.starts[images.n].get())
        neighbours = self._room("unfolded", size=m, dtype=np.int32)
        self.engine.run_each(
            self._kernels.unfold_rows, images.n, previous.starts, previous.neighbours,
            images.points, images.margins.widths, images.margins.widest, *images.blocks, images.firsts, neighbours,
        )  # fmt: skip
        return Rows(images.n, previous.starts, neighbours)

    def _measure(self, images: Images, binned: BinnedPoints, t: Tessellation) -> None:
        """Note what the cells of `t` need, and what they may."""
        engine, margins = self.engine, images.margins
        capacity, tried = FACE_CAPACITY, 0
        while True:
            # Private arrays of a whole group lie on the stack of a CPU's thread.
            group = None if capacity == FACE_CAPACITY else 1
            engine.run_each(
                self._kernels_for(capacity).measure_margins, images.count, binned.items, binned.reach,
                images.points, np.int32(images.n), t.starts, t.neighbours,
                *images.box.device_corners(engine.real), *images.blocks, engine.real.type(SIDEWAYS),
                engine.real.type(OUTWARDS), np.float32(KEPT), np.int32(tried),
                np.int32(capacity >= MOST_FACES), margins.widths, margins.wishes, self._report,
                group=group,
            )  # fmt: skip
            if engine.dim == 2 or not int(self._report.get()[1]) & FULL:
                return
            self._report[1:2].fill(0)
            capacity, tried = 2 * capacity, capacity

    def fold(
        self,
        images: Images,
        binned: BinnedPoints,
        t: Tessellation,
        points: cla.Array,
        share: float,
        nearest: bool,
    ) -> tuple[Folded, bool, int, int]:
        """Fold `t`, the diagram of `images`, which lie in `binned`.

        Parameters
        ----------
        points : (n, d) real
            The generators.
        share : float
            Of a cell, that a face may make which only one of its cells sees.
        nearest : bool
            Whether to look for faces whose neighbour is not the nearest image of its generator.

        Returns
        -------
        folded : Folded
        enough : bool
            Whether the margins were wide enough for all cells: else the diagram is not right. What they need is noted.
        flags, generator : int
            `FAR` and `COLLAPSED` where that is so, and the first generator concerned.
        """
        engine, k, n = self.engine, self._kernels, images.n
        self._report.set(np.array([0, 0, 2**31 - 1], np.int32))
        margins = images.margins
        self._measure(images, binned, t)
        engine.run_each(
            k.note_margins, block_count(engine.dim), margins.widths, np.float32(KEPT),
            margins.wishes, margins.needed,
        )  # fmt: skip
        margins.cells = n
        m = int(t.starts[n].get())
        self._turn = 1 - self._turn
        graph = [
            self._room(name, self._turn, size=m, dtype=np.int32) for name in ("neighbours", "codes")
        ]
        kept = self._room("kept", size=m, dtype=np.uint8)
        starts = self._room("starts", self._turn, size=n + 1, dtype=np.int32)
        engine.run_each(
            k.fold_rows, n, t.starts, t.neighbours, t.face_measures, t.volumes, t.points,
            images.owners, images.codes, engine.real.type(share), np.int32(nearest), *graph, kept,
            starts, self._report,
        )  # fmt: skip
        words = self._report.get()
        flags, places = int(words[1]), None
        measures = t.face_measures[:m], t.face_centroids[:m]
        self._scan.exclusive(starts, starts, n)
        if flags & DROPPED:
            left = int(starts[n].get())
            places = engine.empty(left, np.int32)
            closed = (
                engine.empty(left, np.int32), engine.empty(left, np.int32),
                engine.empty(left, engine.face), engine.empty((left, engine.dim), engine.face),
            )  # fmt: skip
            engine.run_each(
                k.close_rows, n, t.starts, kept, starts, *graph, *measures, *closed, places
            )
            graph, measures = list(closed[:2]), closed[2:]
        folded = Tessellation(
            n, points, starts, graph[0], *measures, t.volumes[:n], t.offsets[:n], t.covariances[:n]
        )
        return Folded(folded, graph[1], places), not words[0], flags & ~DROPPED, int(words[2])
