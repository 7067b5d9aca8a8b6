"""Cells in 3D: each clipped by its neighbors and walls; faces and moments (`polyhedra.cl`; `walks.cl` on CPUs)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import ClvoroError, MemoryLimitError
from ..geometry.box import ClipBox
from ..opencl.device_array import buffer_of, read_number
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from ..opencl.workspace import framed
from .bins import MAX_LEVELS, BinnedPoints
from .device_diagram import (
    DOUBT,
    EXACT_SHARE,
    FULL,
    NARROW,
    ROUGH_SHARE,
    UNEVEN,
    CloseError,
    NeighborRows,
    Tessellation,
    restored,
)
from .periodic.halo import halo_defines
from .weight_bounds import WeightBounds

HARMLESS = DOUBT | NARROW | UNEVEN
"""Flags of a diagram that is not rejected."""
FACE_CAPACITY = 32
"""Most faces of a cell while it is clipped in private memory."""
GROWTH, MOST_FACES = 4, 512
"""Factor to the next capacity for cells with more, and the largest one."""
LEAST_SPACE, SPACE_PER_CELL, MOST_SPACE = 2**20, 64, 2**26
"""Bytes of global memory for cells with more than `FACE_CAPACITY` faces while they are clipped, a few at a time."""
FACES_PER_CELL = 16.5
"""First guess of the half-faces per cell. Random cells have 15.54 on average; walls add some."""
STRETCH = 128
"""Number of generators whose cells one work-item of a CPU builds, eight at a time (`walks.cl`)."""
CUBE = 8
"""Number of bins along each axis of the cubes that order these generators."""
FIRST_REACH = 2.0
"""First search radius of `walks.cl`, in units of the local spacing of the bins."""


def clipping_space(n: float) -> float:
    """Return the most bytes that cells with many faces take in global memory while `n` cells are clipped."""
    return min(max(LEAST_SPACE, SPACE_PER_CELL * n), MOST_SPACE)


def cell_bytes(capacity: int, real: np.dtype) -> int:
    """Return an upper bound of the size of `cell_t` (polyhedron.h), which the kernels check."""
    index = 1 if 3 * capacity <= 256 else 2
    return capacity * (16 * real.itemsize + 29 * index + 5) + 320


def capacity_defines(engine: Engine, capacity: int) -> dict[str, object]:
    """Return the defines of kernels that clip cells of up to `capacity` faces."""
    defines: dict[str, object] = {"FACE_CAPACITY": capacity}
    if capacity > FACE_CAPACITY:
        defines["CELL_BYTES"] = cell_bytes(capacity, engine.real)
    return defines


def clip_each(
    engine: Engine,
    kernel: cl.Kernel,
    capacity: int,
    size: int,
    args: tuple[object, ...],
    more_args: tuple[object, ...] = (),
) -> None:
    """Enqueue `kernel`, which clips `size` cells of up to `capacity` faces.

    Its arguments are `size`, `args` and `more_args`. Cells with more than `FACE_CAPACITY` faces are clipped in global
    memory, which it takes after `args`, by one work-item for each cell that fits there.
    """
    if capacity <= FACE_CAPACITY:
        engine.run_each(kernel, size, *args, *more_args)
        return
    bytes_ = cell_bytes(capacity, engine.real)
    count = min(size, int(clipping_space(size)) // bytes_)
    with engine.workspace.frame():
        memory = engine.scratch(count * bytes_, np.uint8)
        more_args = (memory, np.int32(count), *more_args)
        engine.run(kernel, count, np.int32(size), *args, *more_args, group=1)


@dataclass(frozen=True)
class CutCells:
    """Cells clipped independently of each other, on the device; see `clip_polyhedra` in `polyhedra.cl`.

    Attributes
    ----------
    places, counts : (n,) int32
        First entry of each cell in the arrays of faces, and number of its faces.
    labels, measures, centroids
        Arrays of `m` half-faces.
    cells : dict
        Volumes, offsets and covariances.
    doubtful : bool
        With round-off two cells might disagree about a face.
    corners, keys : arrays, optional
        Triples of faces and keys; see `Tessellation.vertices`.
    """

    places: cla.Array
    counts: cla.Array
    labels: cla.Array
    measures: cla.Array
    centroids: cla.Array
    cells: dict[str, cla.Array]
    m: int
    doubtful: bool
    corners: cla.Array | None = None
    keys: cla.Array | None = None

    def output(self, report: cla.Array) -> tuple[object, ...]:
        """Return the CELL_OUTPUT_ARGS of kernels (tessellation/row_counts.h)."""
        cells = self.cells["volumes"], self.cells["offsets"], self.cells["covariances"]
        keep, corners = self.corners is not None, report if self.corners is None else self.corners
        return (
            self.places, self.counts, self.labels, self.measures, self.centroids, *cells, report,
            np.int32(keep), corners,
        )  # fmt: skip


class Polyhedra:
    """Tessellate a box in 3D; with an engine for power diagrams by points with weights (n, 4).

    Buffers are reused: each call overwrites the `Tessellation` of the call before. Its graph stays valid until the new
    one is complete.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._programs: dict[int, SimpleNamespace] = {}
        self._kernels(FACE_CAPACITY)
        self._wrap = None
        self._bounds = WeightBounds(engine) if engine.domain_kind.weighted else None
        if self._bounds is None and engine.group_size == 1 and engine.real == np.float64:
            defines = {
                "STRETCH": STRETCH, "CUBE": CUBE, "MAX_DEPTH": MAX_LEVELS, **halo_defines(engine),
            }  # fmt: skip
            self._walks = engine.kernels("simd/walks", defines)
            self._wrap = self._walks.walk_all_cells
        self._report = engine.empty(2, np.int32)
        self._capacity = self._room = self._n = 0
        self._of_vertices: tuple[cla.Array, cla.Array] | None = None

    def _kernels(self, capacity: int) -> SimpleNamespace:
        if capacity not in self._programs:
            defines = {
                "MAX_DEPTH": MAX_LEVELS, **capacity_defines(self.engine, capacity), **halo_defines(self.engine),
            }  # fmt: skip
            self._programs[capacity] = self.engine.kernels("tessellation/polyhedra", defines)
        return self._programs[capacity]

    def _reserve_cells(self, n: int) -> None:
        """Allocate the arrays per cell for `n` cells."""
        if n <= self._capacity:
            return
        engine = self.engine
        self._of_cells = {
            "starts": engine.empty(n + 1, np.int32),
            "volumes": engine.empty(n),
            "offsets": engine.empty((n, 3)),
            "covariances": engine.empty((n, 6)),
        }
        self._of_faces: dict[str, cla.Array] = {}
        self._capacity = n

    def _take_faces(self, m: int) -> tuple[cla.Array, cla.Array, cla.Array]:
        """Return arrays for labels, measures and centroids of `m` half-faces, in any order."""
        if m >= 2**31 // 3:
            raise MemoryLimitError(
                f"the cells have {m:.3g} faces, expected fewer than {2**31 // 3:.3g}, the limit "
                "of 32-bit indices; use fewer cells, or perturb generators that lie on a "
                "common sphere"
            )
        engine, self._room = self.engine, m
        return engine.scratch(m, np.int32), engine.scratch(m), engine.scratch((m, 3))

    def _faces(self, m: int) -> dict[str, cla.Array]:
        """Return arrays for the `m` half-faces of a diagram."""
        engine, faces = self.engine, self._of_faces
        if not faces or len(faces["neighbors"]) < m:
            faces.clear()
            m += m // 32  # their number changes a little between steps
            faces["neighbors"] = engine.empty(m, np.int32)
            faces["face_measures"] = engine.empty(m)
            faces["face_centroids"] = engine.empty((m, 3))
        return faces

    def _vertices(self, m: int) -> tuple[cla.Array, cla.Array]:
        """Return arrays for the vertices of a diagram with `m` half-faces; see `Tessellation.vertices`."""
        if self._of_vertices is None or len(self._of_vertices[1]) < m:
            self._of_vertices = None
            self._of_vertices = (
                self.engine.empty(2 * m, np.uint32), self.engine.empty(m, np.uint32),
            )  # fmt: skip
        return self._of_vertices

    def restore(
        self,
        points: cla.Array,
        saved: Mapping[str, np.ndarray],
        spare: int,
        vertices: Sequence[np.ndarray] = (),
    ) -> Tessellation:
        """Return the `saved` diagram of `points` (n, 3), with room for `spare` more half-faces."""
        n, m = len(points), len(saved["neighbors"]) + spare
        self._reserve_cells(n)
        cells = {
            name: a[: n + 1] if name == "starts" else a[:n] for name, a in self._of_cells.items()
        }
        faces = {name: array[:m] for name, array in self._faces(m).items()}
        t = restored(points, {**cells, **faces}, saved)
        if vertices:
            t = replace(t, vertices=self._vertices(m))
            for array, values in zip(t.vertices, vertices, strict=True):
                array[: len(values)].set(values)
        return t

    @framed
    def tessellate(
        self,
        box: ClipBox,
        points: cla.Array,
        n: int,
        binned: BinnedPoints,
        previous: Tessellation | NeighborRows | None = None,
        exact: bool = True,
        rows: int | None = None,
        halo_args: tuple[object, ...] = (),
    ) -> Tessellation:
        """Tessellate `box` by the first `n` of `points` (n, 3), which lie in `binned`.

        Parameters
        ----------
        previous : Tessellation or NeighborRows, optional
            A diagram of the same generators at earlier positions: clipping starts from its neighbors.
        exact : bool
            Reject generators so close together that two cells differ about their common face by more than `EXACT_SHARE`
            of a cell; otherwise by more than `ROUGH_SHARE`.
        rows : int, optional
            Number of cells to build, those of the first generators. Their faces with other cells are not matched.
        halo_args : tuple, optional
            In a periodic box the HALO_ARGS of kernels, which test the balls around vertices
            (tessellation/periodic/halo.h).

        Raises
        ------
        InputError
            If two generators coincide or are too close for the precision (`CloseError`).
        MemoryLimitError
            If the faces are too many for 32-bit indices.
        ClvoroError
            If a cell has more than `MOST_FACES` faces.
        """
        engine, rows = self.engine, n if rows is None else rows
        self._reserve_cells(rows)
        share = engine.real.type(EXACT_SHARE if exact else ROUGH_SHARE)
        first = engine.scratch(n, np.float32)
        cl.enqueue_copy(engine.queue, buffer_of(first), buffer_of(binned.reach), byte_count=4 * n)
        with engine.workspace.frame():
            # Diagrams that will be updated need their vertices.
            keep = not exact and not halo_args and rows == n and self._bounds is None
            if self._bounds is not None:
                halo_args = (*halo_args, *self._bounds.build(box, points, n))
            cut = self._cut(box, points, n, binned, first, previous, rows, share, halo_args, keep)
            t = None if cut is None else self.match(cut, self._report, points, share)
        if t is None:
            raise CloseError(points, n)
        return t

    def _begin_anew(self, binned: BinnedPoints, first: cla.Array, n: int) -> None:
        """Restore the search radii, so that the last bits of the result do not depend on earlier attempts."""
        cl.enqueue_copy(
            self.engine.queue, buffer_of(binned.reach), buffer_of(first), byte_count=4 * n
        )

    def _cut(
        self,
        box: ClipBox,
        points: cla.Array,
        n: int,
        binned: BinnedPoints,
        first: cla.Array,
        previous: Tessellation | NeighborRows | None,
        rows: int,
        share: np.floating,
        halo_args: tuple[object, ...],
        keep: bool,
    ) -> CutCells | None:
        """Clip the first `rows` cells; repeat with larger capacities if needed. None if a cell collapses.

        `first` (n,) float32 is a copy of the original `binned.reach`. `keep` the vertices.
        """
        engine = self.engine
        most = round(FACES_PER_CELL * rows + 6 * rows ** (2 / 3)) + 64
        faces = self._take_faces(most if rows != self._n else max(most, self._room))
        self._n = rows
        places, counts = engine.scratch(rows, np.int32), engine.scratch(rows, np.int32)
        lower, upper = box.device_corners(engine.real)
        cells = {name: a[:rows] for name, a in self._of_cells.items() if name != "starts"}
        warm = previous is not None and previous.n == rows
        old = (
            (previous.starts, previous.neighbors)
            if previous is not None and warm
            else (counts, counts)
        )
        capacity, again, walk = FACE_CAPACITY, False, self._wrap
        first_reach = engine.real.type(FIRST_REACH)
        self._report.set(np.zeros(2, np.int32))
        search = binned.reach, binned.bins, binned.grid_frames, binned.grid_shapes
        while True:
            corners = engine.scratch(2 * self._room, np.uint32) if keep else None
            cut = CutCells(places, counts, *faces, cells, self._room, False, corners, faces[0])
            room, written = np.int32(self._room), cut.output(self._report)
            if walk is not None and not again:
                with engine.workspace.frame():
                    order = self._ordered(binned, rows)
                    engine.run_each(
                        walk, -(-rows // STRETCH), np.int32(rows), order, binned.points,
                        binned.items, binned.spacing, *search, lower, upper, first_reach, room,
                        *written, *halo_args, group=1,
                    )  # fmt: skip
            some = np.int32(again or walk is not None)
            cell_args = (
                np.int32(rows), binned.points, binned.items, *search, points, lower, upper,
                np.int32(warm), *old, some, room, share, *written,
            )  # fmt: skip
            clip_each(
                engine, self._kernels(capacity).clip_polyhedra, capacity, n, cell_args, halo_args
            )
            flags, m = (int(v) for v in self._report.get())
            if flags & ~(FULL | HARMLESS):
                return None
            if m > self._room:
                # Repeat all: faces beyond the capacity were lost.
                self._begin_anew(binned, first, n)
                faces = self._take_faces(m + m // 32 + 64)
                capacity, again = FACE_CAPACITY, False
                self._report.set(np.zeros(2, np.int32))
            elif flags & FULL:
                # Clip only the cells with too many faces, with a larger capacity.
                capacity, again = GROWTH * capacity, True
                if capacity > MOST_FACES:
                    raise ClvoroError(
                        f"a cell has more than {MOST_FACES} faces, expected fewer; remove or perturb generators "
                        "that lie on a common sphere"
                    )
                self._report.set(np.array([flags & HARMLESS, m], np.int32))
            else:
                return replace(cut, m=m, doubtful=bool(flags & DOUBT))

    def take_cells(self, n: int, m: int) -> CutCells:
        """Return arrays for `n` cells with `m` half-faces in any order, to be matched."""
        self._reserve_cells(n)
        cells = {name: a[:n] for name, a in self._of_cells.items() if name != "starts"}
        scratch = self.engine.scratch
        places, counts, labels = (scratch(size, np.int32) for size in (n, n, m))
        corners, keys = scratch(2 * m, np.uint32), scratch(m, np.uint32)
        return CutCells(
            places, counts, labels, scratch(m), scratch((m, 3)), cells, m, False, corners, keys
        )

    def clip_rest(
        self,
        cut: CutCells,
        report: cla.Array,
        box: ClipBox,
        points: cla.Array,
        binned: BinnedPoints,
        previous: Tessellation,
    ) -> bool:
        """Clip the unfinished cells of `cut` by all generators near them. False if that fails."""
        engine, rows = self.engine, len(cut.counts)
        search = binned.reach, binned.bins, binned.grid_frames, binned.grid_shapes
        share, old = engine.real.type(ROUGH_SHARE), (previous.starts, previous.neighbors)
        engine.run_each(
            self._kernels(FACE_CAPACITY).clip_polyhedra, rows, np.int32(rows), binned.points, binned.items, *search,
            points, *box.device_corners(engine.real), np.int32(1), *old, np.int32(1), np.int32(len(cut.labels)), share,
            *cut.output(report),
        )  # fmt: skip
        flags, m = (int(v) for v in report.get()[:2])
        return m <= len(cut.labels) and not flags & ~HARMLESS

    def match(
        self,
        cut: CutCells,
        report: cla.Array,
        points: cla.Array,
        share: np.floating,
        sparse: bool = False,
    ) -> Tessellation | None:
        """Keep the faces that both cells have, and sort them by rows. None if cells differ by too much.

        With `sparse`, the arrays of faces have gaps, and the rows are counted.
        """
        engine, k, m = self.engine, self._kernels(FACE_CAPACITY), cut.m
        rows, cells, doubt = len(cut.counts), cut.cells, np.int32(cut.doubtful)
        # The previous graph stays valid until the end.
        starts, neighbors = engine.scratch(rows + 1, np.int32), engine.scratch(m, np.int32)
        kept = engine.scratch(m, np.uint8)
        engine.run_each(
            k.match_polyhedron_faces, rows, cut.places, cut.counts, cut.labels, cut.measures, cells["volumes"],
            points, share, doubt, kept, starts, report,
        )  # fmt: skip
        flags = int(report.get()[0])
        if flags & ~HARMLESS:
            return None
        self._scan.exclusive(starts, starts, rows)
        if sparse:
            m = read_number(starts, rows)
        faces, of_rows = self._faces(m), self._of_cells["starts"][: rows + 1]
        engine.run_each(
            k.place_faces, rows, cut.places, cut.counts, cut.labels, cut.measures, cut.centroids,
            kept, doubt, starts, neighbors, faces["face_measures"], faces["face_centroids"],
        )  # fmt: skip
        engine.run_each(k.put_graph, rows, starts, neighbors, of_rows, faces["neighbors"])
        vertices: tuple[cla.Array, ...] = ()
        if cut.corners is not None:
            vertices = self._vertices(len(faces["neighbors"]))
            engine.run_each(
                k.place_cell_corners,
                rows,
                cut.places,
                cut.counts,
                cut.corners,
                cut.keys,
                of_rows,
                *vertices,
            )
        return Tessellation(
            n=rows, points=points, starts=of_rows, neighbors=faces["neighbors"],
            face_measures=faces["face_measures"], face_centroids=faces["face_centroids"], volumes=cells["volumes"],
            offsets=cells["offsets"], covariances=cells["covariances"], vertices=vertices,
            round_off=flags & (NARROW | UNEVEN),
        )  # fmt: skip

    def _ordered(self, binned: BinnedPoints, rows: int) -> cla.Array:
        """Return the items of the first `rows` generators in an order that keeps neighbors close."""
        engine, k = self.engine, self._walks
        cubes = math.prod(-(-side // CUBE) for side in binned.sides)
        starts, order = engine.scratch(cubes + 1, np.int32), engine.scratch(rows, np.int32)
        bins = np.int32(rows), binned.items, binned.bins, binned.grid_shapes
        engine.run_each(k.count_cubes, cubes, *bins, starts, group=1)
        self._scan.exclusive(starts, starts, cubes)
        engine.run_each(k.order_places, cubes, *bins, starts, order, group=1)
        return order
