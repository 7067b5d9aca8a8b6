"""Read a tessellation from the device into a `Diagram`: physical units, the caller's order of rows."""

from __future__ import annotations

from copy import copy as shallow_copy
from dataclasses import replace
from functools import cached_property
from typing import cast

import numpy as np
import pyopencl.array as cla

from ...connectivity import first_nodes, rows_of, starts_of, used_indices
from ...errors import InputError
from ...finite_volumes.borders import on_surfaces
from ...finite_volumes.solid_walls.settling import CellTargets
from ...geometry.domain import ClipBox, Domain
from ...geometry.solid.solid import Solid
from ...mesh.diagram import Diagram
from ...opencl.engine import Engine
from ...opencl.primitives import Gather, Lists
from ..device_diagram import CloseError, Tessellation
from ..part import Part
from ..report import UNEVEN
from ..stages import TessellationStages
from ..tessellator import Tessellator
from ..topology3d.consistency import SharedFaces, share_faces
from ..vertices import VertexNumbering, Vertices
from .cut_faces import CutFaces, chain_faces, join_loops

SMALL_FACE = 1e-3
"""Share of the mean face: areas of smaller ones are compared with those of their vertices, where these were merged."""
LEFT_OUT = 1e-5
"""Largest share of a cell behind faces below round-off that may be left out without a check of the diagram."""


def fetch_diagram(
    engine: Engine,
    domain: Domain,
    t: Tessellation,
    labels: cla.Array,
    copy: bool = True,
    held: int | None = None,
    targets: CellTargets | None = None,
) -> Diagram:
    """Return `t` as a `Diagram` with rows in the order of `labels` (n,); arrays are read when first used.

    - `copy`: copy the arrays of `t`. Without a copy the caller must not reuse these buffers.
    - `held`: how many of the first generators of a run are not moved. Given generators are moved only where OpenFOAM
      would reject cells.
    - `targets`: volumes that the cells of a run are to have; generators near curved walls move to them, see `settled`.
    """
    sheets = domain.sheets
    if domain.curved_walls:
        from .solid import make_mesh, read_generators

        solid = cast("Solid", domain)
        points, sizes = read_generators(domain, t, labels)
        del t, labels  # memory for another diagram
        diagram = make_mesh(engine, solid, points, sizes, held=held, targets=targets)

        def again(points: np.ndarray) -> Diagram:
            return make_mesh(engine, solid, points, sizes, warns=False, spread=False, held=held)

    else:
        diagram = _read(engine, domain, t, labels, copy)
        if sheets is None:
            return diagram
        points, sizes = diagram.points, np.cbrt(diagram.volumes)

        def again(points: np.ndarray) -> Diagram:
            stages = TessellationStages(engine)
            made = _read(engine, domain, *_tessellate(stages, domain, points))
            stages.release()
            return made

    return diagram if sheets is None else on_surfaces(diagram, sheets, points, sizes, again, held or 0)


def make_diagram(
    stages: TessellationStages, domain: Domain, points: np.ndarray, ghosts: np.ndarray | None = None
) -> Diagram:
    """Return the diagram of `points` (n, d), which are in `domain`, made on the device.

    `ghosts` (g, 3) are further generators in a box. They shape cells, but have none: faces towards them are on wall 0.
    Where round-off may have spoiled the diagram, they have cells, too, which follow those of the points.
    """
    engine = stages.engine
    if ghosts is not None and len(ghosts):
        reader = _DiagramReader(engine, domain, *_tessellate(stages, domain, points, ghosts), copy=False)
        try:
            if not reader.needs_check():
                return reader.diagram()
        except InputError:
            pass
        del reader
        points = np.concatenate([points, ghosts])
    return fetch_diagram(engine, domain, *_tessellate(stages, domain, points))


def _tessellate(
    stages: TessellationStages, domain: Domain, points: np.ndarray, ghosts: np.ndarray | None = None
) -> tuple[Tessellation, cla.Array]:
    """Return the tessellation of `points` (n, d) on the device, and its labels (n,): the rows of the points.

    `ghosts` (g, d) have no cells.
    """
    engine, n = stages.engine, len(points)
    binned = stages.bins.build(domain, engine.upload(domain.place(points, engine.real)), n)
    labels, sorted_points = binned.items[:n].copy(), binned.points[:n].copy()
    tessellator = Tessellator(stages, domain)
    if ghosts is not None:
        every = np.concatenate([sorted_points.get(), domain.place(ghosts, engine.real)])
        part = Part(n, len(every), engine.upload(every), domain)
        return tessellator.tessellate_part(part, exact=True), labels
    stages.bins.renumber(binned, n)
    t = tessellator.final(tessellator.tessellate(sorted_points, n, exact=True, binned=binned, complete=True))
    return t, labels


def _read(engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array, copy: bool = True) -> Diagram:
    """Return the cells of `t`, see `fetch_diagram`."""
    reader = _DiagramReader(engine, domain, t, labels, copy)
    if reader.whole.round_off & UNEVEN:
        assert reader.faces
    return reader.diagram()


def order_of(labels: np.ndarray) -> np.ndarray:
    """Return the places of `labels` (n,) in ascending order. They are distinct and not negative."""
    largest = int(labels.max(initial=-1))
    if largest >= 4 * len(labels):
        return np.argsort(labels, kind="stable")
    places = np.full(largest + 1, -1, np.int32)
    places[labels] = np.arange(len(labels), dtype=np.int32)
    return places[places >= 0].astype(np.intp)


def kept_faces(t: Tessellation, m: int, copy: bool) -> Tessellation:
    """Return `t`, or a copy of it, with arrays cut to its `m` faces."""

    def kept(array: cla.Array) -> cla.Array:
        return array.copy() if copy else array

    points = kept(t.points[: t.n])
    return Tessellation(
        n=t.n,
        points=points,
        sites=kept(t.sites[: t.rows]) if t.is_power or t.rows > t.n else points,
        part=t.part,
        starts=kept(t.starts),
        neighbors=kept(t.neighbors[:m]),
        face_measures=kept(t.face_measures[:m]),
        face_centroids=kept(t.face_centroids[:m]),
        volumes=kept(t.volumes),
        offsets=kept(t.offsets),
        covariances=t.covariances,
        round_off=t.round_off,
    )


def on_host(array: cla.Array | np.ndarray) -> np.ndarray:
    """Return an array that may be on the device."""
    return array if isinstance(array, np.ndarray) else array.get()


def faces_on_host(t: Tessellation) -> Tessellation:
    """Return `t` with measures and centroids of faces as NumPy arrays."""
    return replace(t, **{name: on_host(getattr(t, name)) for name in ("face_measures", "face_centroids")})


def merge_ends(corners: np.ndarray, starts: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """Return `corners` of cells in 2D, (m,), where both ends of a dropped face are the same vertex.

    - `corners` (m or more,) int: first vertex of each face.
    - `starts` (n + 1,) int32: rows of the faces.
    - `dropped` (k,) int: faces that are left out.
    """
    count = int(corners.max(initial=-1)) + 1
    ends = np.arange(1, starts[-1] + 1)
    filled = np.diff(starts) > 0  # cells of power diagrams may be empty
    ends[starts[1:][filled] - 1] = starts[:-1][filled]
    return first_nodes(count, corners[dropped], corners[ends[dropped]])[corners]


class _DiagramReader:
    """Read the arrays of a `Diagram` from a tessellation, each when first used.

    Vertices are those of one diagram of convex cells, `whole`: of the tessellation itself, of the extended diagram of a
    periodic box, where cells beyond the periodic boundaries are ordinary cells, or of the diagram that a boundary cuts.
    In a periodic box the corners of a cell therefore surround its generator, and a vertex near a periodic boundary
    appears once for each of its images that is a corner of a cell in the box. A boundary adds vertices, `cut`. Then
    both ends of each face are stored, as several loops may bound a cell.

    With `copy` the reader owns its arrays, since the stages reuse theirs.

    - `whole`: Tessellation
    - `box`: the box that clips its cells.
    - `places` (m,) int, or None: index in `whole` of each face on the device; None if it is the same.
    - `codes` (m,) int32, or None: codes of the images across the faces, in a periodic box.
    - `cut`: CutFaces, or None
    """

    def __init__(self, engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array, copy: bool) -> None:
        self.engine, self.domain, self.n = engine, domain, t.n
        self.origin, self.scale = domain.frame
        self.labels = labels.get()[: t.n]
        self.m = int(t.starts[t.n].get())
        self.t = self.whole = kept_faces(t, self.m, copy)
        self.box: ClipBox = domain if t.part is None else t.part.box
        self.places: np.ndarray | None = None
        self.codes: np.ndarray | None = None
        self.cut: CutFaces | None = None
        whole = None
        if t.folded is not None:
            whole, places = t.folded.whole, t.folded.places
            self.box = t.folded.part.box
            self.codes = t.folded.codes[: self.m].get()
            self.places = None if places is None else places.get()
        elif t.trimmed is not None:
            whole = t.trimmed.convex
            self.cut = CutFaces(t.trimmed, self.n, self.m, self.scale)
        if whole is not None:
            self.whole = kept_faces(whole, int(whole.starts[whole.n].get()), copy)

    def diagram(self) -> Diagram:
        """Return the result, with the arrays that such a diagram has."""
        missing = ["cell_vert"] if self.engine.cell_dim == 3 else ["face_vert"] if self.cut is None else []
        missing.append("layer")
        if self.codes is None:
            missing.append("shifts")
        if not self.t.is_power:
            missing.append("weights")
        names = [name for name in Diagram._NAMES if not name.startswith(tuple(missing))]
        return Diagram(self.domain, {name: (lambda name=name: getattr(self, name)()) for name in names})

    # The order of rows and faces.

    @cached_property
    def order(self) -> np.ndarray:
        """Row on the device of each row of the result, (n,)."""
        return order_of(self.labels)

    @cached_property
    def ranks(self) -> np.ndarray:
        """Row of the result of each row on the device, (n,)."""
        inverse = np.empty(self.n, np.int32)
        inverse[self.order] = np.arange(self.n, dtype=np.int32)
        return inverse

    @cached_property
    def kept(self) -> np.ndarray | None:
        """Mask (m,) of the faces on the device that are in the result; None if all are.

        In 3D faces no wider than round-off are left out: those without a loop of vertices.
        """
        if not self.whole.round_off:
            return None
        seen = np.diff(self.loop_starts) > 0
        if self.places is not None:
            seen = seen[self.places]
        if self.codes is not None:
            # The two half-faces at a periodic boundary have separate loops.
            seen = seen[: self.m]
            i, j = rows_of(self.t.starts.get()), self.t.neighbors.get()
            inner, last = np.flatnonzero(j >= 0), 3**self.engine.dim - 1
            i, j, code = i[inner].astype(np.int64), j[inner].astype(np.int64), self.codes[inner]
            here = inner[np.lexsort((code, j, i))]
            there = inner[np.lexsort((last - code, i, j))]
            seen[here] &= seen[there].copy()
        return seen

    @cached_property
    def starts(self) -> np.ndarray:
        """`starts` on the device (n + 1,), counting kept faces only."""
        starts = self.t.starts.get()
        if self.kept is None:
            return starts
        return starts_of(self.kept)[starts]

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of faces of each row of the result, (n,)."""
        return np.diff(self.starts)[self.order]

    @cached_property
    def slots(self) -> np.ndarray:
        """Index on the device of each face of the result, (m,); ordered along the loops of cells with several."""
        return self.row_slots if self.cut is None else self.chained[0]

    @cached_property
    def row_slots(self) -> np.ndarray:
        """Index on the device of each face of the result, (m,), in the order of the device within rows."""
        shift = self.starts[self.order] - self.neighbor_starts()[:-1]
        places = np.repeat(shift, self.counts)
        places += np.arange(len(places), dtype=places.dtype)
        return places if self.kept is None else np.flatnonzero(self.kept)[places]

    @cached_property
    def lists(self) -> Lists | None:
        """How the device brings the faces into the order of the result; None if faces within rows differ."""
        if self.kept is not None or self.cut is not None:
            return None
        upload = self.engine.upload
        return Lists(upload(self.order, np.int32), self.t.starts, upload(self.neighbor_starts(), np.int32))

    # Vertices.

    @cached_property
    def shared(self) -> Vertices:
        """Vertices of `whole` in 2D."""
        return VertexNumbering(self.engine).number(self.box, self.whole)

    @cached_property
    def faces(self) -> SharedFaces:
        """Vertices, each once, in 3D, and the loops of faces in the order of `whole`.

        Raises `InputError` if round-off has made cells wrong.
        """
        # The device needs their memory.
        whole, self.t = self.whole, faces_on_host(self.t)
        self.whole = self.t if self.codes is None else faces_on_host(whole)
        del whole
        try:
            faces = share_faces(self.engine, self.box, self.whole)
            trial = shallow_copy(self)
            trial.faces = faces
            if trial.needs_check() and not trial.diagram().check():
                raise CloseError(self.t.points, self.n)
        except CloseError as error:
            raise error.within(self.domain) from None
        return faces

    @cached_property
    def loop_starts(self) -> np.ndarray:
        """`starts` of the vertex loops of faces of `whole`, (m + 1,)."""
        return self.faces.starts.get()

    def needs_check(self) -> bool:
        """Return whether round-off may have spoiled the result."""
        if self.faces.needs_check or self.whole.round_off & UNEVEN:
            return True
        lost = 0 if self.kept is None else self._gaps(self.kept)
        return bool((lost > LEFT_OUT * self.whole.volumes.get()).any())

    def _gaps(self, kept: np.ndarray) -> np.ndarray:
        """Return, for each cell of `whole`, the volume of the cones over faces that are not `kept`."""
        t, faces = self.whole, self._in_whole(np.flatnonzero(~kept))
        cell = np.searchsorted(t.starts.get(), faces, side="right") - 1
        other, points = t.neighbors.get()[faces], t.sites.get()[:, : self.engine.dim].astype(float)
        inner = other >= 0  # faces on walls are never below round-off
        way = np.linalg.norm(points[other] - points[cell], axis=1) * inner
        return np.bincount(cell, on_host(t.face_measures)[faces] * way / 6, t.n)

    def _in_whole(self, faces: np.ndarray) -> np.ndarray:
        """Return the indices in `whole` of faces on the device."""
        return faces if self.places is None else self.places[faces]

    @cached_property
    def ends(self) -> np.ndarray:
        """First and last vertex of each face on the device, (m, 2), where a boundary cuts cells."""
        assert self.cut is not None
        return self.cut.ends(self.whole.starts.get(), self.shared, self.starts)

    @cached_property
    def chained(self) -> tuple[np.ndarray, dict[int, list[int]]]:
        """`slots` along the loops of cells, and the lengths of the loops of those rows that have several."""
        return chain_faces(self.row_slots, self.ends, self.neighbor_starts())

    @cached_property
    def corners(self) -> tuple[np.ndarray | None, np.ndarray]:
        """The vertices that are corners of the result, None for all, and the place among them of each corner."""
        if self.cut is not None:
            return used_indices(self.ends[self.slots].ravel(), self.shared.count + len(self.cut.positions))
        found = self._corners_in_2d() if self.engine.cell_dim == 2 else self._corners_in_3d()
        return (None, found) if self.whole is self.t else used_indices(found, len(self._positions))

    @property
    def _positions(self) -> cla.Array:
        return (self.shared if self.engine.cell_dim == 2 else self.faces).positions

    def _corners_in_2d(self) -> np.ndarray:
        if self.whole is self.t:
            return self._read_faces(self.shared.cell_vertices)
        corners = self.shared.cell_vertices.get()
        if self.places is not None:
            starts = self.whole.starts.get()[: self.n + 1]
            corners = merge_ends(corners, starts, np.setdiff1d(np.arange(starts[-1]), self.places))
        return corners[self._in_whole(self.slots)]

    def _corners_in_3d(self) -> np.ndarray:
        starts = self.face_vertex_starts()
        if self.lists is not None and self.whole is self.t:
            # The loops of a cell's faces follow one another on the device, too.
            begins = self.loop_starts[self.starts]
            to = starts_of(np.diff(begins)[self.order], np.int32)
            upload = self.engine.upload
            loops = Lists(self.lists.order, upload(begins, np.int32), upload(to, np.int32))
            return Gather(self.engine).lists(loops, self.faces.vertices[: int(to[-1])]).get()
        shift = self.loop_starts[self._in_whole(self.slots)] - starts[:-1]
        places = np.arange(starts[-1]) + np.repeat(shift, np.diff(starts))
        return self.faces.vertices.get()[places]

    # Units.

    def _read(self, array: cla.Array, power: int) -> np.ndarray:
        """Return an array of cells in physical units."""
        return self._physical(np.take(array.get(), self.order, axis=0), power)

    def _read_faces(self, array: cla.Array | np.ndarray) -> np.ndarray:
        """Return an array of faces."""
        if self.lists is None or isinstance(array, np.ndarray):
            return np.take(on_host(array), self.slots, axis=0)
        return Gather(self.engine).lists(self.lists, array).get()

    def _physical(self, numbers: np.ndarray, power: int = 1) -> np.ndarray:
        """Return `numbers` in physical units. The array may be used for that."""
        if numbers.dtype != np.float64:
            return np.multiply(numbers, self.scale**power, dtype=np.float64)
        numbers *= self.scale**power
        return numbers

    def _placed(self, numbers: np.ndarray, within_seams: bool) -> np.ndarray:
        """Return positions in physical units, within the walls. The array may be used for that.

        With `within_seams` they are also in [lower, upper) along periodic directions.
        """
        x, periodic = self._physical(numbers), self.domain.periodic
        # Round-off must not move a point on a wall out of the domain. Axis by axis is faster.
        for a in range(x.shape[1]):
            x[:, a] += self.origin[a]
            lower, upper = self.domain.lower[a], self.domain.upper[a]
            if periodic[a]:
                if not within_seams:
                    continue
                upper = np.nextafter(upper, lower)
            np.clip(x[:, a], lower, upper, out=x[:, a])
        return x

    # One method per array of `Diagram`.

    def points(self) -> np.ndarray:
        x = self._placed(np.take(self.t.points.get(), self.order, axis=0), within_seams=True)
        if self.cut is not None:
            # Round-off must not move a generator on the boundary out of the domain.
            near = slice(None) if self.cut.shifted else self.ranks[self.cut.touched[self.cut.touched < self.n]]
            x[near] = self.domain.nearest(x[near])
        return x

    def weights(self) -> np.ndarray:
        rows = self.t.sites.get()[self.order, self.engine.dim]
        return self.domain.given_weights(rows.astype(np.float64)) * self.scale**2

    def volumes(self) -> np.ndarray:
        return self._read(self.t.volumes, self.engine.cell_dim)

    def centroids(self) -> np.ndarray:
        found = self._read(self.t.offsets, 1)
        found += self.points()
        return found

    def neighbor_starts(self) -> np.ndarray:
        return starts_of(self.counts, np.int32)

    def neighbors(self) -> np.ndarray:
        ranks = np.append(self.ranks, np.full(self.t.rows - self.n, -1, np.int32))
        if self.lists is not None:
            return Gather(self.engine).lists(self.lists, self.t.neighbors, self.engine.upload(ranks, np.int32)).get()
        j = self._read_faces(self.t.neighbors)
        walls = np.minimum(j, -1)
        if self.cut is not None:
            walls = -1 - self.cut.edge_numbers[-1 - walls]
        return np.where(j >= 0, ranks[np.maximum(j, 0)], walls)

    def shifts(self) -> np.ndarray:
        assert self.codes is not None
        codes = self.codes[self.slots]
        steps = [codes // 3**a % 3 - 1 for a in range(self.engine.dim)]
        return np.stack(steps, axis=1).astype(np.int8)

    def face_measures(self) -> np.ndarray:
        measures = self._physical(self._read_faces(self.t.face_measures), self.engine.cell_dim - 1)
        if self.kept is not None and self.faces.merged:
            # Of a small face the vertices may have been merged along a line.
            small = measures < SMALL_FACE * measures.mean()
            areas = self._loop_areas(small) if small.any() else 0
            measures[small] = np.where(areas < measures[small] / 2, areas, measures[small])
        return measures

    def _loop_areas(self, chosen: np.ndarray) -> np.ndarray:
        """Return the areas of `chosen` faces (m,) bool in 3D by their vertices."""
        lengths = np.diff(self.face_vertex_starts())
        x = self.vertices()[self.face_vertices()[np.repeat(chosen, lengths)]]
        lengths = lengths[chosen]
        starts = np.cumsum(lengths) - lengths
        x -= np.repeat(x[starts], lengths, axis=0)
        triangles = np.append(np.cross(x[:-1], x[1:]), np.zeros((1, 3)), axis=0)
        return np.linalg.norm(np.add.reduceat(triangles, starts), axis=1) / 2

    def face_centroids(self) -> np.ndarray:
        own = self._read(self.t.points, 1) + self.origin
        found = self._physical(self._read_faces(self.t.face_centroids))
        found += np.repeat(own, self.counts, axis=0)
        return found

    def vertices(self) -> np.ndarray:
        used, x = self.corners[0], self._positions.get()
        if self.cut is not None:
            x = np.concatenate([self._physical(x) + self.origin, self.cut.positions])
            return x[used]
        return self._placed(x if used is None else x[used], within_seams=False)

    def cell_vertex_starts(self) -> np.ndarray:
        return self.neighbor_starts() if self.cut is None else self._outlines[0]

    def cell_vertices(self) -> np.ndarray:
        return self.corners[1] if self.cut is None else self._outlines[1]

    @cached_property
    def _outlines(self) -> tuple[np.ndarray, np.ndarray]:
        return join_loops(self.corners[1][::2], self.neighbor_starts(), self.chained[1])

    def face_vertex_starts(self) -> np.ndarray:
        if self.cut is not None:
            return (2 * np.arange(self.m + 1)).astype(np.int32)
        return starts_of(np.take(np.diff(self.loop_starts), self._in_whole(self.slots)), np.int32)

    def face_vertices(self) -> np.ndarray:
        return self.corners[1]
