"""The diagram of a polygonal domain: the convex diagram of its generators, trimmed by the boundary (`trim.cl`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pyopencl.array as cla

from ...geometry.polygon import Polygon
from ...mesh.straightening import FILLED, LEAST_AREA, LEAST_BULGE
from ...opencl.device_array import read_number
from ...opencl.engine import Engine
from ...opencl.primitives import NamedArrays, Scan
from ..device_diagram import Tessellation
from .boundary_crossings import LOST, BoundaryError, Chords, order_defines

ORPHANS = 4
"""Flag of `trim.cl`: a cell has more than one piece."""
ROUNDS = 6
"""Largest distance, in cells, between a piece without generator and the cell that takes it."""


@dataclass(frozen=True)
class Trimmed:
    """The convex diagram and the segments that a trimmed diagram was made from, on the device.

    Vertices are numbered by these.
    """

    convex: Tessellation
    chords: Chords
    segments: tuple[cla.Array, ...]
    """SEGMENT_ARGS of kernels (tessellation/clipped/segments.h)."""
    face_segments: cla.Array
    """(m,) int32. Segment of each face, for cells that the boundary crosses."""
    segment_count: int


@dataclass(frozen=True)
class _Pieces:
    """The pieces into which the boundary cuts convex cells, on the device."""

    convex: Tessellation
    chords: Chords
    segments: tuple[cla.Array, ...]
    """SEGMENT_ARGS of kernels."""
    segment_count: int
    loop_pieces: cla.Array
    """(p,) int32. Piece of each loop."""
    roots: cla.Array
    """(p,) int32. Generator that owns each piece."""
    marks: cla.Array
    """(n,) int32. 1 for uncrossed cells beside a piece that changes cells: they get another neighbor."""
    orphans: tuple[cla.Array, int]
    """The pieces that change cells, (>= count,) int32, and their count."""


class Trim:
    """Trim convex diagrams by a boundary. Buffers are reused from call to call."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        # Sizes change little from step to step.
        self._scan, self._room = Scan(engine), NamedArrays(engine, spare=1 / 16)
        limits = {"LEAST_BULGE": LEAST_BULGE, "FILLED": FILLED, "LEAST_AREA": LEAST_AREA}
        self._kernels = engine.kernels("tessellation/clipped/trim", {**limits, **order_defines(engine)})
        # Flags of kernels, and the number of segments: the host reads both at once.
        self._flags = engine.empty(2, np.int32)

    def trim(
        self, domain: Polygon, points: cla.Array, convex: Tessellation, chords: Chords, n: int, straight: bool = False
    ) -> Tessellation:
        """Return the diagram of `domain` for `points` (n, 2), the first `n` generators of `convex`.

        A cell is the piece of its convex cell within the domain that contains the generator. Any other piece goes to
        the neighboring cell with which it shares the longest face. In a power diagram a
        cell has all its pieces. With `straight` volumes, offsets and covariances are those of cells with straight sides
        along the boundary, as the mesh for solvers has them.

        Raises `BoundaryError` if loops of faces are not closed due to round-off.
        """
        engine, k, room = self.engine, self._kernels, self._room
        u, places = chords.touched_count, chords.count + chords.touched_count
        lists = chords.touched, chords.list_starts, chords.listed, *chords.arrays
        cells = *convex.graph, convex.sites, *domain.device_corners(engine.real), *lists
        self._flags.fill(0)
        if engine.traits.site_values:
            edges = *chords.arrays[:2], np.int32(len(chords.tangents)), chords.slots
            engine.run_each(k.find_outside, n, *convex.graph, convex.sites, *edges, convex.volumes, convex.offsets)
        loops = room("loops", size=places, dtype=np.int32)
        pieces = room("pieces", size=places, dtype=np.int32)
        roots = room("roots", size=places, dtype=np.int32)
        starts = room("segment_starts", size=u + 1, dtype=np.int32)
        chord_loops = room("chord_loops", size=chords.count, dtype=np.int32)
        walked = loops, pieces, roots, starts, self._flags
        engine.run_each(k.find_loops, u, *cells, chord_loops, *walked)
        self._scan.exclusive(starts, starts, u, total=(self._flags, 1))
        flags, count = self._flags.get().tolist()
        self._demand(flags)
        parts = [room(name, size=count, dtype=np.int32) for name in ("labels", "from", "to", "places")]
        parts += [room(name, size=2 * count) for name in ("p", "q")]
        engine.run_each(k.write_segments, u, *cells, loops, pieces, starts, *parts)
        segments = (starts, *parts)
        owners = chords.touched, chords.slots, roots
        engine.run_each(k.check_segments, u, np.int32(n), *segments, *owners, *convex.graph, self._flags)
        self._demand(int(read_number(self._flags, 0)))
        marks = room.zeros("marks", size=n, dtype=np.int32)
        found = _Pieces(convex, chords, segments, count, pieces, roots, marks, (pieces, 0))
        if flags & ORPHANS:
            found = replace(found, orphans=self._adopt(found))
        return self._write(found, points, straight)

    @staticmethod
    def _demand(flags: int) -> None:
        """Raise BoundaryError if a walk or a loop was lost."""
        if flags & LOST:
            raise BoundaryError

    def _adopt(self, found: _Pieces) -> tuple[cla.Array, int]:
        """Find the owner of each piece without generator; return the pieces that change cells, and their number."""
        engine, k, room, chords = self.engine, self._kernels, self._room, found.chords
        pieces, roots, u = found.loop_pieces, found.roots, chords.touched_count
        places = chords.count + u
        orphans = room("orphans", size=places + 1, dtype=np.int32)
        other = room("other_roots", size=places, dtype=np.int32)
        ranks = room("orphan_ranks", size=places + 1, dtype=np.int32)
        cells = *found.segments, chords.touched, chords.slots, chords.list_starts, pieces
        for _ in range(ROUNDS // 2):
            for before, after in ((roots, other), (other, roots)):
                engine.run_each(k.adopt_pieces, u, *cells, before, after)
        engine.run_each(k.settle_pieces, u, *cells, roots, ranks, found.marks)
        self._scan.exclusive(ranks, ranks, places)
        engine.run_each(k.list_orphans, places, ranks, orphans)
        return orphans, int(read_number(ranks, places))

    def _write(self, found: _Pieces, points: cla.Array, straight: bool) -> Tessellation:
        """Write the rows and measures of the diagram: copy the cells that the boundary does not cross."""
        room, n, convex, chords = self._room, len(found.marks), found.convex, found.chords
        # Every face of the diagram is a face of a convex cell or a segment.
        m = 7 * n + 8 + found.segment_count
        starts = self._count(found)
        neighbors = room("neighbors", size=m, dtype=np.int32)
        measures, centroids = room("measures", size=m), room("centroids", size=2 * m)
        face_segments = room("face_segments", size=m, dtype=np.int32)
        outlines = room("outlines", size=2 * n)
        rows = starts, neighbors, measures, centroids
        faces = *convex.graph, convex.face_measures, convex.face_centroids
        owners, written = (chords.slots, found.roots, found.marks), (*rows, convex.volumes, outlines)
        self.engine.run_each(self._kernels.copy_whole, n, *faces, *found.segments, *owners, *written)
        self._write_trimmed(found, points, (*rows, face_segments), outlines, straight)
        if convex.reach is not None:
            limit = self._kernels.limit_reach
            self.engine.run_each(limit, chords.touched_count, *found.segments, chords.touched, convex.reach)
        return Tessellation(
            n=n,
            points=points,
            starts=starts,
            neighbors=neighbors,
            face_measures=measures,
            face_centroids=centroids.reshape(m, 2),
            volumes=convex.volumes[:n],
            offsets=convex.offsets[:n],
            covariances=convex.covariances[:n],
            reach=None if convex.reach is None else convex.reach[:n],
            outlines=(outlines, chords.tangents),
            trimmed=Trimmed(convex, chords, found.segments, face_segments, found.segment_count),
        )

    def _count(self, found: _Pieces) -> cla.Array:
        """Return where the row of each cell starts."""
        engine, k, n, chords = self.engine, self._kernels, len(found.marks), found.chords
        starts = self._room("starts", size=n + 1, dtype=np.int32)
        engine.run_each(k.count_whole, n, found.convex.starts, chords.slots, starts)
        owners = chords.touched, chords.slots, found.roots
        engine.run_each(k.count_trimmed, chords.touched_count, *found.segments, *owners, starts)
        self._scan.exclusive(starts, starts, n)
        return starts

    def _write_trimmed(
        self, found: _Pieces, points: cla.Array, rows: tuple[cla.Array, ...], outlines: cla.Array, straight: bool
    ) -> None:
        """Write the cells that the boundary crosses."""
        engine, k, room, convex, chords = self.engine, self._kernels, self._room, found.convex, found.chords
        u = chords.touched_count
        place_cells = room("place_cells", size=chords.count + u, dtype=np.int32)
        chord_owners = room("chord_owners", size=chords.count, dtype=np.int32)
        lists = chords.list_starts, chords.listed, found.roots
        engine.run_each(k.name_chord_owners, u, *found.segments, *lists, place_cells, chord_owners)
        orphans, orphan_count = found.orphans
        boundary = *found.segments, *chords.arrays, chord_owners, *chords.turns
        places = points, chords.touched, chords.slots, found.roots, orphans, np.int32(orphan_count), place_cells
        moments = convex.volumes, convex.offsets, convex.covariances
        engine.run_each(k.write_trimmed, u, int(straight), *boundary, *places, *rows, *moments, outlines)
