"""Periodic boxes: generators with their images beyond the seams, and the diagram folded back (`seam.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...geometry.box import Box
from ...opencl.engine import Engine
from ...opencl.primitives import NamedArrays, Scan
from ..bins import BinnedPoints
from ..device_diagram import Tessellation
from .halo import Margins, block_count, block_counts, seam_defines

DROPPED, FAR, COLLAPSED = 1, 2, 4
"""Bits of a report: see `seam.cl`."""
SIDEWAYS, OUTWARDS = 0.7, 0.2
"""What the next margins have room for, in ways between the generators about a vertex: that the ball around it moves
along the seam, or outwards until the generator on it is at the seam; and what it grows beyond that. With less, diagrams
have to be made again more often."""
KEPT, KEPT_GUESS = {2: 0.9, 3: 0.97}, {2: 0.9, 3: 0.7}
"""Share that margins keep, from diagram to diagram, of what they were, and of what was a guess, by dimension. In 3D,
where nothing is repaired, diagrams follow each other closely; the more is kept, the fewer balls have a wish."""
OTHER_CELLS = 0.1
"""Share by which the spacing of generators changes where cells are others than before."""


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
    kept : float32
        Share that they keep at least, whatever the cells need.
    seams : tuple
        The SEAM_ARGS of kernels that test the balls around vertices (tessellation/periodic/halo.h).
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
    kept: np.float32
    seams: tuple[object, ...]
    points: cla.Array
    firsts: cla.Array
    owners: cla.Array
    codes: cla.Array


@dataclass(frozen=True)
class Rows:
    """Rows of neighbors of `n` generators on the device, to begin their cells with; -1 for none.

    Attributes
    ----------
    starts : (n + 1,) int32
    neighbors : (m,) int32
    """

    n: int
    starts: cla.Array
    neighbors: cla.Array


@dataclass(frozen=True)
class Folded:
    """The rows of a diagram of generators and images that belong to generators, images replaced by their owners.

    Attributes
    ----------
    tessellation : Tessellation
        Of the n generators. The face's neighbor lies at that generator's place, or at an image of it.
    codes : (>= m,) int32
        Of each face's neighbor, as those of `Images`.
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
        self._room = NamedArrays(engine, spare=1 / 16)  # sizes change a little from step to step
        self._kernels = engine.kernels("tessellation/periodic/ghost_images", seam_defines(engine))
        self._report = engine.empty(3, np.int32)
        self._turn = 0

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
        counts = block_counts(corners[1, :d] - corners[0, :d], n)
        was = block_counts(corners[1, :d] - corners[0, :d], margins.cells)
        lengths = np.maximum((corners[1] - corners[0]) / counts, 1e-30).astype(engine.real)
        blocks = corners[0], lengths, counts
        others = abs(factor - 1) > OTHER_CELLS or bool((was != counts).any())
        kept = np.float32((KEPT_GUESS if others or margins.guessed else KEPT)[d])
        margins.extremes.fill(0)
        engine.run_each(
            k.next_margins, block_count(d), margins.needed, was, np.float32(factor),
            np.int32(others), np.int32(grow), *blocks, margins.widths, margins.extremes, margins.wishes,
            *engine.period_args,
        )  # fmt: skip
        self._report.set(np.array([0, 0, 2**31 - 1], np.int32))
        firsts = self._room("firsts", size=n + 1, dtype=np.int32)
        engine.run_each(
            k.count_images, n, points, margins.widths, margins.extremes, *blocks, firsts,
            *engine.period_args,
        )  # fmt: skip
        self._scan.exclusive(firsts, firsts, n)
        ghosts = int(firsts[n].get())
        count = n + ghosts
        extended = self._room("points", size=d * count).reshape(-1, d)
        owners = self._room("owners", size=ghosts, dtype=np.int32)
        codes = self._room("image codes", size=ghosts, dtype=np.int32)
        engine.run_each(
            k.place_images, n, points, margins.widths, margins.extremes, *blocks, firsts, extended,
            owners, codes, *engine.period_args,
        )  # fmt: skip
        lower, upper = (corner[:d].astype(np.float64) for corner in corners)
        # On a coarse grid, so that the corners of the extended box are exact.
        widest = np.ceil(margins.extremes.get().view(np.float32)[:d] * 2.0**20) / 2.0**20
        wide = np.minimum(periods, widest).astype(engine.real)
        box = ExtendedBox(lower - wide, upper + wide)
        seams = (
            np.int32(n), np.append(periods, np.zeros(4 - d)).astype(engine.real), *blocks,
            engine.real.type(SIDEWAYS), engine.real.type(OUTWARDS), kept,
            margins.widths, margins.extremes, margins.wishes, self._report,
        )  # fmt: skip
        return Images(n, count, box, margins, kept, seams, extended, firsts, owners, codes)

    def unfold(self, images: Images, previous: Tessellation) -> Rows:
        """Return rows of the extended graph for the generators, from `previous`: the same ones at earlier positions."""
        m = int(previous.starts[images.n].get())
        neighbors = self._room("unfolded", size=m, dtype=np.int32)
        self.engine.run_each(
            self._kernels.unfold_rows, images.n, previous.starts, previous.neighbors,
            images.points, images.firsts, images.codes, neighbors, *self.engine.period_args,
        )  # fmt: skip
        return Rows(images.n, previous.starts, neighbors)

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
            Whether to look for faces whose neighbor is not the nearest image of its generator.

        Returns
        -------
        folded : Folded
        enough : bool
            Whether the margins were wide enough for all cells: else the diagram is not right. What they need is noted.
        flags, generator : int
            `FAR` and `COLLAPSED` where that is so, and the first generator concerned.
        """
        engine, k, n = self.engine, self._kernels, images.n
        margins = images.margins
        if engine.dim == 2:  # in 3D cells are looked at where they are made
            engine.run_each(
                k.measure_margins, images.count, binned.items, binned.reach, images.points, t.starts,
                t.neighbors, *images.box.device_corners(engine.real), *images.seams,
            )  # fmt: skip
        engine.run_each(
            k.note_margins, block_count(engine.dim), margins.widths, images.kept, margins.wishes,
            margins.needed, *engine.period_args,
        )  # fmt: skip
        margins.cells, margins.guessed = n, False
        m = int(t.starts[n].get())
        self._turn = 1 - self._turn
        graph = [
            self._room(name, self._turn, size=m, dtype=np.int32) for name in ("neighbors", "codes")
        ]
        kept = self._room("kept", size=m, dtype=np.uint8)
        starts = self._room("starts", self._turn, size=n + 1, dtype=np.int32)
        engine.run_each(
            k.fold_rows, n, t.starts, t.neighbors, t.face_measures, t.volumes, t.points,
            images.firsts, images.owners, images.codes, engine.real.type(share), np.int32(nearest),
            *graph, kept, starts, self._report, *engine.period_args,
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
        )  # fmt: skip
        enough = not words[0]
        if not enough:
            # The next attempt takes the place of this one: the graph from before is where that begins, too.
            self._turn = 1 - self._turn
        return Folded(folded, graph[1], places), enough, flags & ~DROPPED, int(words[2])
