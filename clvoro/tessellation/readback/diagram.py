"""Read a tessellation from the device into a `Diagram`: physical units, the caller's order of rows."""

from __future__ import annotations

from copy import copy as shallow_copy
from functools import cached_property

import numpy as np
import pyopencl.array as cla

from ...geometry.box import Box
from ...geometry.domain import ClipBox, Domain
from ...geometry.polygon import Polygon
from ...mesh.diagram import Diagram
from ...opencl.engine import Engine
from ...opencl.primitives import Gather, Lists
from ..device_diagram import UNEVEN, CloseError, Tessellation
from ..periodic.periodic_tessellator import ExtendedDiagram
from ..topology3d.consistency import SharedFaces, share_faces
from ..vertices import VertexNumbering, Vertices

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
    extended: ExtendedDiagram | None = None,
) -> Diagram:
    """Return `t` as a `Diagram` with rows in the order of `labels` (n,); arrays are read when first used.

    Parameters
    ----------
    copy : bool
        Copy the arrays of `t`. Without a copy the caller must not reuse these buffers.
    extended : ExtendedDiagram, optional
        In a periodic box, the diagram that `t` was folded from.

    Raises
    ------
    InputError
        If round-off has made cells wrong.
    """
    from .periodic import _PeriodicReader
    from .polygon import _PolygonReader

    others = ["face_vert" if engine.cell_dim == 2 else "cell_vert"]
    if extended is None:
        others.append("shifts")
    if t.weighted is None:
        others.append("weights")
    if isinstance(domain, Polygon):
        reader: _DiagramReader = _PolygonReader(engine, domain, t, labels, copy)
        others.remove("face_vert")
    elif extended is not None and isinstance(domain, Box):
        reader = _PeriodicReader(engine, domain, t, labels, copy, extended)
    else:
        reader = _DiagramReader(engine, domain, t, labels, copy)
    reader.names = [name for name in Diagram._NAMES if not name.startswith(tuple(others))]
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


def starts_of(counts: np.ndarray) -> np.ndarray:
    """Return where lists of `counts` (n,) items begin, and the end of the last, (n + 1,) int32."""
    found = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=found[1:])
    return found


def used_indices(indices: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers below `count` that occur among `indices`, sorted, and the place of each index among them."""
    used = np.zeros(count, bool)
    used[indices] = True
    return np.flatnonzero(used), np.take(np.cumsum(used, dtype=np.int32) - 1, indices)


def kept_faces(t: Tessellation, m: int, copy: bool) -> Tessellation:
    """Return `t`, or a copy of it, with arrays cut to its `m` faces."""

    def kept(array: cla.Array) -> cla.Array:
        return array.copy() if copy else array

    return Tessellation(
        n=t.n,
        points=kept(t.points[: t.n]),
        starts=kept(t.starts),
        neighbors=kept(t.neighbors[:m]),
        face_measures=kept(t.face_measures[:m]),
        face_centroids=kept(t.face_centroids[:m]),
        volumes=kept(t.volumes),
        offsets=kept(t.offsets),
        covariances=t.covariances,
        round_off=t.round_off,
        weighted=None if t.weighted is None else kept(t.weighted[: t.n]),
    )


class _DiagramReader:
    """Read the arrays of a `Diagram` from a tessellation, each when first used.

    With `copy` the reader owns its arrays, since the stages reuse theirs.
    """

    def __init__(self, engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array, copy: bool) -> None:
        self.engine, self.domain, self.n = engine, domain, t.n
        self.box: ClipBox = domain
        self.origin, self.scale = domain.frame
        self.labels = labels.get()[: t.n]
        self.names: list[str] = []
        m = int(t.starts[t.n].get())
        self.t = self.whole = kept_faces(t, m, copy)

    @cached_property
    def places(self) -> np.ndarray:
        """Index in `whole` of each face on the device, (m,)."""
        return np.arange(len(self.t.neighbors))

    @cached_property
    def order(self) -> np.ndarray:
        """Row on the device of each row of the result, (n,)."""
        return order_of(self.labels)

    def diagram(self) -> Diagram:
        """Return the result, with the arrays that `names` lists."""
        return Diagram(self.domain, {name: (lambda name=name: getattr(self, name)()) for name in self.names})

    @cached_property
    def faces(self) -> SharedFaces:
        """Vertices, each once, in 3D, and the loops of faces in the order of `whole`.

        Raises
        ------
        InputError
            If round-off has made cells wrong.
        """
        try:
            faces = share_faces(self.engine, self.box, self.whole)
            trial = shallow_copy(self)
            trial.faces = faces
            if trial.needs_check() and not trial.diagram().check():
                raise CloseError(self.t.points, self.n)
        except CloseError as error:
            raise error.within(self.domain) from None
        return faces

    def needs_check(self) -> bool:
        """Return whether round-off may have spoiled the result."""
        if self.faces.needs_check or self.whole.round_off & UNEVEN:
            return True
        lost = 0 if self.kept is None else self._gaps(self.kept)
        return bool((lost > LEFT_OUT * self.whole.volumes.get()).any())

    @cached_property
    def kept(self) -> np.ndarray | None:
        """Mask (m,) of the faces on the device that are in the result; None if all are.

        In 3D faces no wider than round-off are left out.
        """
        return self.polygons() if self.whole.round_off else None

    def polygons(self) -> np.ndarray:
        """Return the mask (m,) of the faces on the device that have a loop of vertices."""
        return np.diff(self.loop_starts) > 0

    def _gaps(self, kept: np.ndarray) -> np.ndarray:
        """Return, for each cell of `whole`, the volume of the cones over faces that are not `kept`."""
        t, faces = self.whole, self.places[~kept]
        cell = np.searchsorted(t.starts.get(), faces, side="right") - 1
        other, points = t.neighbors.get()[faces], t.points.get().astype(float)
        inner = other >= 0  # faces on walls are never below round-off
        way = np.linalg.norm(points[other] - points[cell], axis=1) * inner
        return np.bincount(cell, t.face_measures.get()[faces] * way / 6, t.n)

    @cached_property
    def starts(self) -> np.ndarray:
        """`starts` on the device (n + 1,), counting kept faces only."""
        starts = self.t.starts.get()
        if self.kept is None:
            return starts
        return np.concatenate([[0], np.cumsum(self.kept)])[starts]

    @cached_property
    def counts(self) -> np.ndarray:
        """Number of faces of each row of the result, (n,)."""
        return np.diff(self.starts)[self.order]

    @cached_property
    def slots(self) -> np.ndarray:
        """Index on the device of each face of the result, (m,)."""
        shift = self.starts[self.order] - self.neighbor_starts()[:-1]
        places = np.repeat(shift, self.counts)
        places += np.arange(len(places), dtype=places.dtype)
        return places if self.kept is None else np.flatnonzero(self.kept)[places]

    @cached_property
    def lists(self) -> Lists | None:
        """How the device brings the faces into the order of the result; None if the result leaves faces out."""
        if self.kept is not None:
            return None
        upload = self.engine.upload
        return Lists(upload(self.order, np.int32), self.t.starts, upload(self.neighbor_starts(), np.int32))

    @cached_property
    def ranks(self) -> np.ndarray:
        """Row of the result of each row on the device, (n,)."""
        inverse = np.empty(self.n, np.int32)
        inverse[self.order] = np.arange(self.n, dtype=np.int32)
        return inverse

    @cached_property
    def shared(self) -> Vertices:
        """Shared vertices in 2D."""
        return VertexNumbering(self.engine).number(self.domain, self.t)

    @cached_property
    def loop_starts(self) -> np.ndarray:
        """`starts` of the vertex loops of faces on the device, (m + 1,)."""
        return self.faces.starts.get()

    def _read(self, array: cla.Array, power: int) -> np.ndarray:
        """Return an array of cells in physical units."""
        return self._physical(np.take(array.get(), self.order, axis=0), power)

    def _read_faces(self, array: cla.Array) -> np.ndarray:
        """Return an array of faces."""
        if self.lists is None:
            return np.take(array.get(), self.slots, axis=0)
        return Gather(self.engine).lists(self.lists, array).get()

    def _physical(self, numbers: np.ndarray, power: int = 1) -> np.ndarray:
        """Return `numbers` in physical units. The array may be used for that."""
        if numbers.dtype != np.float64:
            return np.multiply(numbers, self.scale**power, dtype=np.float64)
        numbers *= self.scale**power
        return numbers

    def _placed(self, numbers: np.ndarray) -> np.ndarray:
        """Return positions in physical units, within the domain. The array may be used for that."""
        x = self._physical(numbers)
        # Round-off must not move a point on a wall out of the domain. Axis by axis is faster.
        for a in range(x.shape[1]):
            x[:, a] += self.origin[a]
            np.clip(x[:, a], self.domain.lower[a], self.domain.upper[a], out=x[:, a])
        return x

    # One method per array of `Diagram`.

    def points(self) -> np.ndarray:
        return self._placed(np.take(self.t.points.get(), self.order, axis=0))

    def weights(self) -> np.ndarray:
        assert self.t.weighted is not None
        rows = self.t.weighted.get()[self.order, self.engine.dim]
        return rows.astype(np.float64) * self.scale**2

    def volumes(self) -> np.ndarray:
        return self._read(self.t.volumes, self.engine.cell_dim)

    def centroids(self) -> np.ndarray:
        found = self._read(self.t.offsets, 1)
        found += self.points()
        return found

    def neighbor_starts(self) -> np.ndarray:
        return starts_of(self.counts)

    def neighbors(self) -> np.ndarray:
        if self.lists is None:
            j = self._read_faces(self.t.neighbors)
            return np.where(j >= 0, self.ranks[np.maximum(j, 0)], j)
        ranks = self.engine.upload(self.ranks, np.int32)
        return Gather(self.engine).lists(self.lists, self.t.neighbors, ranks).get()

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
        shared = self.shared if self.engine.cell_dim == 2 else self.faces
        return self._placed(shared.positions.get())

    def cell_vertex_starts(self) -> np.ndarray:
        return self.neighbor_starts()

    def cell_vertices(self) -> np.ndarray:
        return self._read_faces(self.shared.cell_vertices)

    def face_vertex_starts(self) -> np.ndarray:
        return starts_of(np.take(np.diff(self.loop_starts), self.slots))

    def face_vertices(self) -> np.ndarray:
        if self.lists is not None:
            # The loops of a cell's faces follow one another on the device, too.
            begins = self.loop_starts[self.starts]
            to = starts_of(np.diff(begins)[self.order])
            upload = self.engine.upload
            loops = Lists(self.lists.order, upload(begins, np.int32), upload(to, np.int32))
            return Gather(self.engine).lists(loops, self.faces.vertices[: int(to[-1])]).get()
        starts = self.face_vertex_starts()
        shift = self.loop_starts[self.slots] - starts[:-1]
        places = np.arange(starts[-1]) + np.repeat(shift, np.diff(starts))
        return self.faces.vertices.get()[places]
