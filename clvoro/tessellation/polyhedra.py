"""Cells in 3D: each clipped by its neighbors and walls; faces and moments (`polyhedra.cl`; `walks.cl` on CPUs)."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import ClvoroError, MemoryLimitError
from ..geometry.domain import ClipBox
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine
from ..opencl.kernels import Kernels
from .back_ends import LANES_FROM, TEAM, TeamKernel, has_lanes, has_teams, has_warps, team_defines
from .bins import MAX_LEVELS, BinnedPoints
from .builder import CellBuilder
from .cut_cells import (
    FACE_CAPACITY,
    GROWTH,
    KNOWN_CORNERS,
    MOST_FACES,
    MOST_NUMBERED,
    UNSURE_CORNERS,
    CutCells,
    Matching,
    capacity_defines,
    cell_bytes,
    clip_each,
)
from .device_diagram import EXACT_SHARE, ROUGH_SHARE, CloseError, NeighborRows, Tessellation
from .part import Part
from .periodic.halo import halo_defines
from .report import FACES, FULL, HARMLESS, KEPT, SIZE, UNKNOWN

FACES_PER_CELL = 16.5
"""First guess of the half-faces per cell. Random cells have 15.54 on average; walls add some."""
MOST_HALF_FACES = 2**31 // 3
"""The limit of 32-bit indices: a half-face has a centroid of three numbers."""
STRETCH = 128
"""Number of generators whose cells one work-item of a CPU builds, eight at a time (`walks.cl`)."""
CUBE = 8
"""Number of bins along each axis of the cubes that order these generators."""
FIRST_REACH = 2.0
"""First search radius of `walks.cl`, in units of the local spacing of the bins."""


def _larger(capacity: int) -> int:
    """Return the capacity for cells with more faces than `capacity`."""
    if GROWTH * capacity > MOST_FACES:
        raise ClvoroError(
            f"a cell has more than {MOST_FACES} faces, expected fewer; remove or perturb generators "
            "that lie on a common sphere"
        )
    return GROWTH * capacity


class Polyhedra(CellBuilder):
    """Tessellate a box in 3D. A cell may have `MOST_FACES` faces."""

    from_previous = True

    def __init__(self, engine: Engine) -> None:
        super().__init__(engine)
        self._programs: dict[int, SimpleNamespace] = {}
        self._kernels(FACE_CAPACITY)
        self._team: TeamKernel | None = None
        if has_teams(engine):
            by_teams = engine.kernels(
                "tessellation/polyhedra_by_teams", team_defines(has_warps(engine.queue.device)), group_size=TEAM
            )
            self._team = TeamKernel(engine.queue.device, by_teams, "clip_polyhedra_by_teams")
        self._walks: Kernels | None = None
        if has_lanes(engine):
            defines = {"STRETCH": STRETCH, "CUBE": CUBE, "MAX_DEPTH": MAX_LEVELS, **halo_defines(engine)}
            self._walks = engine.kernels("simd/walks", defines)
        self._room, self._rows, self._has_many = 0, 0, False
        self._of_vertices: tuple[cla.Array, cla.Array] | None = None

    def _kernels(self, capacity: int) -> SimpleNamespace:
        if capacity not in self._programs:
            defines = {"MAX_DEPTH": MAX_LEVELS, **capacity_defines(self.engine, capacity), **halo_defines(self.engine)}
            self._programs[capacity] = self.engine.kernels("tessellation/polyhedra", defines)
        return self._programs[capacity]

    def _take_faces(self, m: int) -> tuple[cla.Array, cla.Array, cla.Array]:
        """Return arrays for labels, measures and centroids of `m` half-faces, in any order."""
        if m >= MOST_HALF_FACES:
            raise MemoryLimitError(
                f"the cells have {m:.3g} faces, expected fewer than {MOST_HALF_FACES:.3g}, the limit of 32-bit "
                "indices; use fewer cells, or perturb generators that lie on a common sphere"
            )
        engine, self._room = self.engine, m
        return engine.scratch(m, np.int32), engine.scratch(m), engine.scratch((m, 3))

    def _vertices(self, m: int) -> tuple[cla.Array, cla.Array]:
        """Return arrays for the vertices of a diagram with `m` half-faces; see `Tessellation.vertices`."""
        if self._of_vertices is None or len(self._of_vertices[1]) < m:
            self._of_vertices = None
            self._of_vertices = (self.engine.empty(2 * m, np.uint32), self.engine.empty(m, np.uint32))
        return self._of_vertices

    @property
    def defines(self) -> dict[str, object]:
        """No macros."""
        return {}

    def order_rows(self, part: Part, t: Tessellation) -> None:
        """Sort the faces of each cell of `t` by the labels of `part`; those of cells with many in global memory."""
        super().order_rows(part, t)
        if self._has_many:
            engine, space = self.engine, {"CELL_BYTES": cell_bytes(MOST_NUMBERED, self.engine.real)}
            defines = {**space, "MOST_FACES": MOST_NUMBERED, "LEAST_FACES": FACE_CAPACITY + 1}
            part.order_rows(
                engine, t, defines, lambda kernel, size, *args: clip_each(engine, kernel, MOST_NUMBERED, size, args)
            )

    def knows_corners(self, t: Tessellation) -> bool:
        """Return whether `t` has vertices: not with weights."""
        return bool(t.vertices)

    def _tessellate(
        self, part: Part, binned: BinnedPoints, previous: Tessellation | NeighborRows | None, exact: bool, rows: int
    ) -> Tessellation:
        engine, n = self.engine, part.count
        self.cells_of(rows)
        share = engine.real.type(EXACT_SHARE if exact else ROUGH_SHARE)
        first = engine.scratch(n, np.float32)
        cl.enqueue_copy(engine.queue, buffer_of(first), buffer_of(binned.reach), byte_count=4 * n)
        with engine.workspace.frame():
            # Updates, and the descent of the surface, need the vertices.
            keep = part.labels is not None or (not exact and (rows < n or not part.halo_args))
            keep, more_args = keep and self._bounds is None, part.halo_args
            if self._bounds is not None:
                more_args = (*more_args, *self._bounds.build(part.box, part.points, n))
            cut = self._cut(part, binned, first, previous, rows, share, more_args, keep)
            if cut is not None:
                matching = self.match(cut, self._report, part.points, share, cut.m)
                flags = int(self._report.get()[0])
                if not flags & ~HARMLESS:
                    return matching.tessellation(flags)
        raise CloseError(part.points, n)

    def _begin_anew(self, binned: BinnedPoints, first: cla.Array, n: int) -> None:
        """Restore the search radii, so that the last bits of the result do not depend on earlier attempts."""
        cl.enqueue_copy(self.engine.queue, buffer_of(binned.reach), buffer_of(first), byte_count=4 * n)

    def _cut(
        self,
        part: Part,
        binned: BinnedPoints,
        first: cla.Array,
        previous: Tessellation | NeighborRows | None,
        rows: int,
        share: np.floating,
        more_args: tuple[object, ...],
        keep: bool,
    ) -> CutCells | None:
        """Clip the first `rows` cells; repeat with larger capacities if needed. None if a cell collapses.

        `first` (n,) float32 is a copy of the original `binned.reach`. `more_args` are HALO_ARGS and BOUND_ARGS. `keep`
        the vertices.
        """
        engine = self.engine
        most = round(FACES_PER_CELL * rows + 6 * rows ** (2 / 3)) + 64
        faces = self._take_faces(most if rows != self._rows else max(most, self._room))
        self._rows = rows
        places, counts = engine.scratch(rows, np.int32), engine.scratch(rows, np.int32)
        cells = self.cells_of(rows)
        warm = previous is not None and previous.n == rows
        old = previous.graph if previous is not None and warm else (counts, counts)
        capacity, again = FACE_CAPACITY, False
        in_lanes = self._walks is not None and rows >= LANES_FROM[3]
        corners = engine.scratch(2 * self._room, np.uint32) if keep else None
        self._begin_report()
        while True:
            state = KNOWN_CORNERS if part.labels is None else UNSURE_CORNERS
            cut = CutCells(places, counts, *faces, cells, self._room, corners, faces[0], state)
            if in_lanes and not again:
                self._walk(part.box, binned, cut, more_args)
            some = again or in_lanes
            self._clip(part, binned, cut, (warm, *old), some, capacity, share, more_args)
            flags, m = (int(v) for v in self._report.get()[:2])
            if flags & ~(FULL | UNKNOWN | HARMLESS):
                return None
            if m > self._room:
                # Repeat all: faces beyond the capacity were lost.
                self._begin_anew(binned, first, part.count)
                faces = self._take_faces(m + m // 32 + 64)
                corners = engine.scratch(2 * self._room, np.uint32) if keep else None
                capacity, again = FACE_CAPACITY, False
                self._begin_report()
                continue
            if flags & UNKNOWN:
                part.box.look_farther(part.points)
            elif flags & FULL:
                capacity = _larger(capacity)
            else:
                self._has_many = capacity > FACE_CAPACITY
                return replace(cut, m=m)
            # Clip only the cells that are not finished.
            again = True
            self._begin_report(flags & HARMLESS, m)

    def _walk(self, box: ClipBox, binned: BinnedPoints, cut: CutCells, halo_args: tuple[object, ...]) -> None:
        """Build cells in lanes; those that remain to be clipped are unfinished."""
        engine, rows = self.engine, len(cut.counts)
        assert self._walks is not None
        with engine.workspace.frame():
            bins = binned.points, binned.items, binned.spacing, *binned.search
            items, reach = -(-rows // STRETCH), engine.real.type(FIRST_REACH)
            made = np.int32(len(cut.labels)), *cut.output(self._report), *halo_args
            walk = self._walks.walk_all_cells
            given = self._ordered(binned, rows), *bins, *box.clip_args(engine), reach
            engine.run_each(walk, items, np.int32(rows), *given, *made, group=1)

    def _clip(
        self,
        part: Part,
        binned: BinnedPoints,
        cut: CutCells,
        start: tuple[bool, cla.Array, cla.Array],
        some: bool,
        capacity: int,
        share: np.floating,
        more_args: tuple[object, ...],
        report: cla.Array | None = None,
    ) -> None:
        """Clip all cells, or with `some` the unfinished ones, by the generators and ghosts of `part`.

        By teams if the engine has these, else one work-item for each. `start`: whether cells start from the neighbors
        of an earlier diagram, and its graph.
        """
        engine, size = self.engine, part.count
        bins = binned.points, binned.items, *binned.search, part.points, *part.box.clip_args(engine)
        chosen = np.int32(start[0]), *start[1:], np.int32(some), np.int32(len(cut.labels)), share
        args = np.int32(len(cut.counts)), *bins, *chosen, *cut.output(self._report if report is None else report)
        by_team = None if some or self._team is None else self._team.get()
        if by_team is not None:
            engine.run(by_team, TEAM * size, np.int32(size), *args, group=TEAM)
        else:
            clip_each(engine, self._kernels(capacity).clip_polyhedra, capacity, size, args, more_args)

    def _begin_report(self, flags: int = 0, used: int = 0) -> None:
        """Set the report to `flags` and the number of `used` faces."""
        report = np.zeros(SIZE, np.int32)
        report[0], report[FACES] = flags, used
        self._report.set(report)

    def take_cells(self, n: int, m: int) -> CutCells:
        """Return arrays for `n` cells with `m` half-faces in any order, to be matched."""
        cells = self.cells_of(n)
        scratch = self.engine.scratch
        places, counts, labels = (scratch(size, np.int32) for size in (n, n, m))
        corners, keys = scratch(2 * m, np.uint32), scratch(m, np.uint32)
        return CutCells(places, counts, labels, scratch(m), scratch((m, 3)), cells, m, corners, keys)

    def clip_rest(
        self, cut: CutCells, report: cla.Array, part: Part, binned: BinnedPoints, previous: Tessellation | NeighborRows
    ) -> None:
        """Clip the unfinished cells of `cut` by all generators and ghosts of `part` near them."""
        start, share = (True, *previous.graph), self.engine.real.type(ROUGH_SHARE)
        if part.labels is not None:
            cut = replace(cut, state=UNSURE_CORNERS)
        self._clip(part, binned, cut, start, True, FACE_CAPACITY, share, part.halo_args, report)

    def match(
        self, cut: CutCells, report: cla.Array, points: cla.Array, share: np.floating, m: int, folded: bool = False
    ) -> Matching:
        """Keep the faces that both cells have, and sort them by rows, if there are at most `m` or room for them.

        In a `folded` diagram neighbors are nearest images.

        Nothing is done if `report` says that cells are missing or wrong.
        """
        engine, k = self.engine, self._kernels(FACE_CAPACITY)
        rows = len(cut.counts)
        # The previous graph stays valid until the end.
        starts, kept = engine.scratch(rows + 1, np.int32), engine.scratch(cut.m, np.uint8)
        args = engine.period_args
        faces = cut.places, cut.counts, cut.labels, cut.measures, cut.cells["volumes"]
        engine.run_each(
            k.match_polyhedron_faces,
            rows,
            *faces,
            points,
            share,
            kept,
            starts,
            report,
            *(args if folded else tuple(0 * arg for arg in args)),
        )
        self._scan.exclusive(starts, starts, rows, total=(report, KEPT))
        matching = Matching(cut, points, kept, starts, report)
        self.place(matching, m)
        return matching

    def place(self, matching: Matching, m: int) -> None:
        """Write the faces of `matching` to the arrays of the diagram, which get room for `m`."""
        engine, k, cut = self.engine, self._kernels(FACE_CAPACITY), matching.cut
        rows, report, starts = len(cut.counts), matching.report, matching.starts
        # The number of faces changes a little between steps.
        faces, of_rows = self.faces_of(m, m // 32), self.cells_of(rows)["starts"]
        room = np.int32(len(faces["neighbors"]))
        with_corners = cut.corners is not None
        vertices = self._vertices(int(room)) if with_corners else ()
        with engine.workspace.frame():
            neighbors = engine.scratch(min(cut.m, int(room)), np.int32)
            rows_of_faces = cut.places, cut.counts, cut.labels, cut.measures, cut.centroids, matching.kept
            made = neighbors, faces["face_measures"], faces["face_centroids"]
            engine.run_each(k.place_faces, rows, *rows_of_faces, report, room, starts, *made)
            corners = (cut.corners, cut.keys) if with_corners else (report, report)
            made = of_rows, faces["neighbors"], *(vertices or (report, report))
            given = cut.places, cut.counts, report, room, starts, neighbors, np.int32(with_corners), *corners
            engine.run_each(k.put_rows, rows, *given, *made)
        matching.arrays = {"starts": of_rows, **faces, "vertices": vertices}

    def _ordered(self, binned: BinnedPoints, rows: int) -> cla.Array:
        """Return the items of the first `rows` generators in an order that keeps neighbors close."""
        engine, k = self.engine, self._walks
        assert k is not None
        cubes = math.prod(-(-side // CUBE) for side in binned.sides)
        starts, order = engine.scratch(cubes + 1, np.int32), engine.scratch(rows, np.int32)
        bins = np.int32(rows), binned.items, binned.bins, binned.grid_shapes
        engine.run_each(k.count_cubes, cubes, *bins, starts, group=1)
        self._scan.exclusive(starts, starts, cubes)
        engine.run_each(k.order_places, cubes, *bins, starts, order, group=1)
        return order
