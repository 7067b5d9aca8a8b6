"""Ghost images of generators beyond periodic boundaries, and the diagram folded back (`ghost_images.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...geometry.domain import ClipBox, Domain
from ...opencl.engine import Engine
from ...opencl.primitives import NamedArrays, Scan
from ..cut_cells import CutCells
from ..device_diagram import NeighborRows, Tessellation
from ..part import Ghosts, Part
from .halo import Halo, block_count, block_counts, halo_defines

DROPPED, FAR, COLLAPSED = 1, 2, 4
"""Bits of the report of `ghost_images.cl`."""
SIDEWAYS, OUTWARDS = 0.7, 0.2
"""Room of the next halo, as shares of the shortest distance between the generators about a vertex: for motion of the
ball around the vertex along the boundary or outwards, and for its growth. With less room more diagrams
are made twice."""
KEPT, KEPT_ESTIMATE = {2: 0.9, 3: 0.97}, {2: 0.9, 3: 0.7}
"""Share of its depth, or of an estimated depth, that a halo keeps from one diagram to the next, by dimension. In 3D
diagrams change little from one to the next, and a larger share leaves fewer balls to test."""
OTHER_CELLS = 0.1
"""Relative change of the spacing of generators from which on the depths of near blocks are taken into account."""


@dataclass(frozen=True)
class ExtendedBox(ClipBox):
    """A periodic box with its halo, in the device's coordinates."""

    lower: np.ndarray
    upper: np.ndarray
    """`lower`, `upper`: (d,) float."""

    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners, padded to four numbers."""
        corners = np.zeros((2, 4), real)
        corners[:, : len(self.lower)] = self.lower, self.upper
        return corners[0], corners[1]


@dataclass(frozen=True)
class Folded:
    """How a diagram was folded: the rows of the generators of a part, with images replaced by their owners.

    The neighbor across a face is a generator or an image of it.
    """

    part: Part
    """Generators and images."""
    codes: cla.Array
    """(>= m,) int32. Code of the image across each face, as in `Ghosts`."""
    places: cla.Array | None
    """(m,) int32 or None. Index of each face in the diagram of the part; None if it is the same."""
    whole: Tessellation | None
    """The diagram of the part, if it has the cells of images as well."""


class GhostImages:
    """Make ghost images and fold diagrams. Buffers are reused: those of a folded graph in every second call."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._room = NamedArrays(engine, spare=1 / 16)  # sizes change a little from step to step
        self._kernels = engine.kernels("tessellation/periodic/ghost_images", halo_defines(engine))
        self._report = engine.empty(3, np.int32)
        self._turn = 0

    def extend(
        self, domain: Domain, points: cla.Array, n: int, halo: Halo, factor: float, grow: bool, room: float = 1.0
    ) -> Part:
        """Return the first `n` of `points` (n, d) with their images in the halo.

        In a power diagram rows of `points` end with weights.

        - `halo`: its depths are set to those required, times `factor`.
        - `grow`: let no depth become smaller.
        - `room`: share of `SIDEWAYS` and `OUTWARDS`: 0 in the last diagram of a run.
        """
        engine, k, d = self.engine, self._kernels, self.engine.dim
        periods = domain.periods(engine.real)
        corners = np.array(domain.device_corners(engine.real))
        counts = block_counts(corners[1, :d] - corners[0, :d], n)
        was = block_counts(corners[1, :d] - corners[0, :d], halo.cells)
        lengths = np.maximum((corners[1] - corners[0]) / counts, 1e-30).astype(engine.real)
        blocks = corners[0], lengths, counts
        others = abs(factor - 1) > OTHER_CELLS or bool((was != counts).any())
        halo.kept = np.float32(0 if halo.is_bound else (KEPT_ESTIMATE if others or halo.estimated else KEPT)[d])
        halo.is_bound = False
        halo.extremes.fill(0)
        changes = halo.required, was, np.float32(factor), np.int32(others), np.int32(grow)
        depths = halo.depths, halo.extremes, halo.requests
        engine.run_each(k.predict_halo_depths, block_count(d), *changes, *blocks, *depths, *engine.period_args)
        self._report.set(np.array([0, 0, 2**31 - 1], np.int32))
        firsts = self._room("firsts", size=n + 1, dtype=np.int32)
        engine.run_each(k.count_images, n, points, halo.depths, halo.extremes, *blocks, firsts, *engine.period_args)
        self._scan.exclusive(firsts, firsts, n)
        ghosts = int(firsts[n].get())
        count = n + ghosts
        extended = self._room("points", size=engine.site_size * count).reshape(-1, engine.site_size)
        owners = self._room("owners", size=ghosts, dtype=np.int32)
        codes = self._room("image codes", size=ghosts, dtype=np.int32)
        depths = halo.depths, halo.extremes
        images = extended, owners, codes
        engine.run_each(k.place_images, n, points, *depths, *blocks, firsts, *images, *engine.period_args)
        lower, upper = (corner[:d].astype(np.float64) for corner in corners)
        # Round up to a coarse grid, so that the corners of the extended box are exact.
        widest = np.ceil(halo.extremes.get().view(np.float32)[:d] * 2.0**20) / 2.0**20
        wide = np.minimum(periods, widest).astype(engine.real)
        box = ExtendedBox(lower - wide, upper + wide)
        given = np.int32(n), np.append(periods, np.zeros(4 - d)).astype(engine.real), *blocks
        rooms = engine.real.type(room * SIDEWAYS), engine.real.type(room * OUTWARDS), halo.kept
        halo_args = *given, *rooms, *depths, halo.requests, self._report, halo.most
        return Part(n, count, extended, box, Ghosts(owners, codes, firsts), halo_args)

    def scale_far_measures(self, t: Tessellation, codes: cla.Array) -> cla.Array:
        """Return the face measures of the folded diagram `t`, scaled for a Poisson matrix.

        The matrix divides them by the distance to the nearest image of the neighbor; the face may be that of another
        image. `codes` are those of its faces (see `Folded`). The array is in the workspace.
        """
        engine, scaled = self.engine, self.engine.scratch(len(t.neighbors), self.engine.face)
        faces = *t.graph, codes, t.face_measures, t.sites
        engine.run_each(self._kernels.scale_far_measures, t.n, *faces, scaled, *engine.period_args)
        return scaled

    def unfold(self, part: Part, previous: Tessellation | NeighborRows) -> NeighborRows:
        """Return rows of the extended graph from `previous`, the diagram of the generators at earlier positions."""
        n, ghosts = part.n_own, _ghosts(part)
        m = int(previous.starts[n].get())
        neighbors = self._room("unfolded", size=m, dtype=np.int32)
        rows = *previous.graph, part.points, ghosts.firsts, ghosts.codes
        self.engine.run_each(self._kernels.unfold_rows, n, *rows, neighbors, *self.engine.period_args)
        return NeighborRows(n, previous.starts, neighbors)

    def fold_clipped(self, part: Part, cut: CutCells, report: cla.Array, used: int) -> None:
        """Replace images by their owners in cells that were clipped in an update, in 3D: those behind `used` faces."""
        cells = cut.places, cut.counts, part.points, _ghosts(part).rows
        self.engine.run_each(
            self._kernels.fold_clipped_cells,
            part.n_own,
            np.int32(used),
            np.int32(cut.m),
            *cells,
            self._report,
            cut.labels,
            report,
            *self.engine.period_args,
        )

    def reaches(self, part: Part, halo: Halo) -> bool:
        """Return whether the halo was deep enough for the cells just built; store the depths they require."""
        self._store_depths(part, halo)
        return not self._report.get()[0]

    def fold(
        self, part: Part, halo: Halo, t: Tessellation, points: cla.Array, share: float, nearest: bool
    ) -> tuple[Tessellation, bool, int, int]:
        """Fold `t`, the diagram of `part`, whose ghosts are images in `halo`.

        - `points` (n, d) real: the generators.
        - `share`: largest share of a cell behind a face that only one of its two cells has. Such faces are dropped.
        - `nearest`: report faces whose neighbor is not the nearest image of its generator (`FAR`).

        Results:
        - `folded`: Tessellation
        - `enough`: whether the halo was deep enough for all cells. If not, the diagram is wrong, and the halo's
          required depths are up to date.
        - `flags`, `generator`: `FAR`, `COLLAPSED` or both, and the first generator with such a face.
        """
        n = part.n_own
        self._store_depths(part, halo)
        m = int(t.starts[n].get())
        self._turn = 1 - self._turn
        neighbors, codes, kept, starts = self._fold_rows(part, t, m, share, nearest)
        words = self._report.get()
        self._scan.exclusive(starts, starts, n)
        faces = neighbors, codes, t.face_measures[:m], t.face_centroids[:m]
        vertices = tuple(array[: m * len(array) // len(t.neighbors)] for array in t.vertices)
        places = None
        if words[1] & DROPPED:
            *faces, places = self._close(n, t, kept, starts, faces)
            vertices = ()
        folded = Tessellation(
            n,
            points,
            starts,
            faces[0],
            faces[2],
            faces[3],
            t.volumes[:n],
            t.offsets[:n],
            t.covariances[:n],
            vertices=vertices,
            folded=Folded(part, faces[1], places, t if t.n == part.count else None),
        )
        enough = not words[0]
        if not enough:
            # The next attempt writes to the same buffers, since it starts from the previous graph as well.
            self._turn = 1 - self._turn
        return folded, enough, int(words[1]) & ~DROPPED, int(words[2])

    def _fold_rows(
        self, part: Part, t: Tessellation, m: int, share: float, nearest: bool
    ) -> tuple[cla.Array, cla.Array, cla.Array, cla.Array]:
        """Return for the `m` faces of generators their neighbors, codes and whether to keep them; numbers kept by cell.

        The report gets what is wrong.
        """
        engine, room, n, ghosts = self.engine, self._room, part.n_own, _ghosts(part)
        neighbors, codes = (room(name, self._turn, size=m, dtype=np.int32) for name in ("neighbors", "codes"))
        kept = room("kept", size=m, dtype=np.uint8)
        counts = room("starts", self._turn, size=n + 1, dtype=np.int32)
        faces = *t.graph, t.face_measures, t.volumes, t.points
        images = ghosts.firsts, ghosts.rows, ghosts.codes
        folded = neighbors, codes, kept, counts, self._report
        engine.run_each(
            self._kernels.fold_rows,
            n,
            *faces,
            *images,
            engine.real.type(share),
            np.int32(nearest),
            *folded,
            *engine.period_args,
        )
        return neighbors, codes, kept, counts

    def _store_depths(self, part: Part, halo: Halo) -> None:
        """Set the required depths of `halo` to those that the cells just built have requested."""
        stored = halo.depths, halo.kept, halo.requests, halo.required
        blocks = block_count(self.engine.dim)
        self.engine.run_each(self._kernels.store_required_depths, blocks, *stored, *self.engine.period_args)
        halo.cells, halo.estimated = part.n_own, False

    def _close(
        self, n: int, t: Tessellation, kept: cla.Array, starts: cla.Array, faces: tuple[cla.Array, ...]
    ) -> list[cla.Array]:
        """Return `faces` without those that are not `kept`, and their places in `t`. `starts` begin the new rows."""
        engine = self.engine
        left = int(starts[n].get())
        closed = [engine.empty(left, dtype) for dtype in (np.int32, np.int32, engine.face)]
        closed += [engine.empty((left, engine.dim), engine.face), engine.empty(left, np.int32)]
        engine.run_each(self._kernels.close_rows, n, t.starts, kept, starts, *faces, *closed)
        return closed


def _ghosts(part: Part) -> Ghosts:
    assert part.ghosts is not None
    return part.ghosts
