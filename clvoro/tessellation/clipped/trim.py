"""The diagram of a polygonal domain: the convex diagram of its generators, cut out by the boundary (`trim.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...geometry.polygon import Polygon
from ...opencl.engine import Engine
from ...opencl.primitives import NamedArrays, Scan
from ..device_diagram import Tessellation
from .boundary_crossings import LOST, BoundaryError, Chords

ORPHANS = 4  # of the bits in trim.cl
ROUNDS = 6
"""How many cells away the one may be that takes a piece without a generator."""


@dataclass(frozen=True)
class Trimmed:
    """The data that `Trim.trim` made a diagram from, on the device. The numbering of its vertices uses them.

    Attributes
    ----------
    convex : Tessellation
    chords : Chords
    segments : tuple of arrays
        The arguments SEGMENT_ARGS of kernels.
    face_segments : (m,) int32
        Segment of each face of cells that the boundary passes through.
    segment_count : int
    """

    convex: Tessellation
    chords: Chords
    segments: tuple[cla.Array, ...]
    face_segments: cla.Array
    segment_count: int


class Trim:
    """Trim convex diagrams by a boundary. Buffers are reused from call to call."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        # Counts change a little from step to step.
        self._scan, self._room = Scan(engine), NamedArrays(engine, spare=1 / 16)
        self._kernels = engine.kernels("tessellation/clipped/trim")
        self._flags = engine.empty(1, np.int32)

    def trim(
        self, domain: Polygon, points: cla.Array, convex: Tessellation, chords: Chords, n: int
    ) -> Tessellation:
        """Return the diagram of `domain` by `points` (n, 2), the first generators of `convex`, from the `chords`.

        A cell is the piece of its Voronoi region within the domain that holds the generator. Pieces that the boundary
        cuts off from it go to the cell beside them with which they share the longest face.

        Raises
        ------
        BoundaryError
            If rounding leaves loops of faces open.
        """
        engine, k, room = self.engine, self._kernels, self._room
        u, places = chords.touched_count, chords.count + chords.touched_count
        cells = (
            convex.starts, convex.neighbors, convex.points, *domain.device_corners(engine.real),
            chords.touched, chords.list_starts, chords.listed, *chords.arrays,
        )  # fmt: skip
        self._flags.fill(0)
        loops = room("loops", size=places, dtype=np.int32)
        pieces = room("pieces", size=places, dtype=np.int32)
        roots = room("roots", size=places, dtype=np.int32)
        starts = room("segment_starts", size=u + 1, dtype=np.int32)
        engine.run_each(
            k.find_loops, u, *cells, room("chord_loops", size=chords.count, dtype=np.int32), loops,
            pieces, roots, starts, self._flags,
        )  # fmt: skip
        self._scan.exclusive(starts, starts, u)
        count = int(starts[u].get())
        flags = self._demand(int(self._flags.get()[0]))
        names = ("labels", "from", "to", "places")
        parts = [room(name, size=count, dtype=np.int32) for name in names]
        parts += [room(name, size=2 * count) for name in ("p", "q")]
        engine.run_each(k.write_segments, u, *cells, loops, pieces, starts, *parts)
        segments = (starts, *parts)
        engine.run_each(
            k.check_segments, u, np.int32(n), *segments, chords.touched, chords.slots, roots,
            convex.starts, convex.neighbors, self._flags,
        )  # fmt: skip
        self._demand(int(self._flags.get()[0]))
        marks = room.zeros("marks", size=n, dtype=np.int32)
        orphans, orphan_count = self._adopt(
            chords, segments, pieces, roots, marks, bool(flags & ORPHANS), places
        )
        return self._write(
            points, convex, chords, segments, count, roots, orphans, orphan_count, marks, n
        )

    @staticmethod
    def _demand(flags: int) -> int:
        if flags & LOST:
            raise BoundaryError
        return flags

    def _adopt(
        self,
        chords: Chords,
        segments: tuple[cla.Array, ...],
        pieces: cla.Array,
        roots: cla.Array,
        marks: cla.Array,
        some: bool,
        places: int,
    ) -> tuple[cla.Array, int]:
        """Find out which cell each piece goes to; return the places of those that change cells, and their number."""
        engine, k, room, u = self.engine, self._kernels, self._room, chords.touched_count
        orphans = room("orphans", size=places + 1, dtype=np.int32)
        if not some:
            return orphans, 0
        other = room("other_roots", size=places, dtype=np.int32)
        ranks = room("orphan_ranks", size=places + 1, dtype=np.int32)
        for _ in range(ROUNDS // 2):
            for before, after in ((roots, other), (other, roots)):
                engine.run_each(
                    k.adopt_pieces, u, *segments, chords.touched, chords.slots, chords.list_starts,
                    pieces, before, after,
                )  # fmt: skip
        engine.run_each(
            k.settle_pieces, u, *segments, chords.touched, chords.slots, chords.list_starts, pieces,
            roots, ranks, marks,
        )  # fmt: skip
        self._scan.exclusive(ranks, ranks, places)
        engine.run_each(k.list_orphans, places, ranks, orphans)
        return orphans, int(ranks[places].get())

    def _write(
        self,
        points: cla.Array,
        convex: Tessellation,
        chords: Chords,
        segments: tuple[cla.Array, ...],
        segment_count: int,
        roots: cla.Array,
        orphans: cla.Array,
        orphan_count: int,
        marks: cla.Array,
        n: int,
    ) -> Tessellation:
        """Write rows and measures of the diagram."""
        engine, k, room, u = self.engine, self._kernels, self._room, chords.touched_count
        starts = room("starts", size=n + 1, dtype=np.int32)
        owners = chords.touched, chords.slots, roots
        engine.run_each(k.count_whole, n, convex.starts, chords.slots, starts)
        engine.run_each(k.count_trimmed, u, *segments, *owners, starts)
        self._scan.exclusive(starts, starts, n)
        # Every face of the diagram is one of a convex cell or a segment.
        m = 7 * n + 8 + segment_count
        neighbors = room("neighbors", size=m, dtype=np.int32)
        measures, centroids = room("measures", size=m), room("centroids", size=2 * m)
        face_segments = room("face_segments", size=m, dtype=np.int32)
        outlines = room("outlines", size=2 * n)
        engine.run_each(
            k.copy_whole, n, convex.starts, convex.neighbors, convex.face_measures,
            convex.face_centroids, *segments, chords.slots, roots, marks, starts, neighbors, measures,
            centroids, convex.volumes, outlines,
        )  # fmt: skip
        place_cells = room("place_cells", size=chords.count + u, dtype=np.int32)
        chord_owners = room("chord_owners", size=chords.count, dtype=np.int32)
        engine.run_each(
            k.name_owners, u, *segments, chords.list_starts, chords.listed, roots, place_cells,
            chord_owners,
        )  # fmt: skip
        engine.run_each(
            k.write_trimmed, u, *segments, *chords.arrays, chord_owners, *chords.turns,
            convex.points, *owners, orphans, np.int32(orphan_count), place_cells, starts, neighbors,
            measures, centroids, face_segments, convex.volumes, convex.offsets, convex.covariances,
            outlines,
        )  # fmt: skip
        return Tessellation(
            n=n,
            points=points,
            starts=starts[: n + 1],
            neighbors=neighbors[:m],
            face_measures=measures[:m],
            face_centroids=centroids[: 2 * m].reshape(m, 2),
            volumes=convex.volumes[:n],
            offsets=convex.offsets[:n],
            covariances=convex.covariances[:n],
            outlines=(outlines, chords.tangents),
            trimmed=Trimmed(convex, chords, segments, face_segments, segment_count),
        )
