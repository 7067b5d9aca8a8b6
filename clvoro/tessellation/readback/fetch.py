"""From a tessellation on the device to a `Diagram` on the host: physical units, the caller's order."""

from __future__ import annotations

from copy import copy as shallow_copy
from functools import cached_property

import numpy as np
import pyopencl.array as cla

from ...geometry.box import Box, Domain
from ...geometry.polygon import Polygon
from ...mesh.diagram import Diagram
from ...opencl.program import Engine
from ..device_diagram import CloseError, Tessellation
from ..periodic.torus import Unfolded
from ..topology3d.loops import FaceLoops, Loops, apart
from ..vertices import VertexNumbering, Vertices

LEFT_OUT = 1e-5
"""Share of a cell: if faces that are left out, as they are no polygons, make up more, the diagram is checked."""


def fetch_diagram(
    engine: Engine,
    domain: Domain,
    t: Tessellation,
    labels: cla.Array,
    copy: bool = True,
    unfolded: Unfolded | None = None,
) -> Diagram:
    """Return `t` as a `Diagram` with rows in the order of `labels` (n,); arrays are fetched when asked for.

    Without `copy`, nobody may use the buffers of `t` any more. `unfolded` is what `t` was folded from, in a periodic
    box.

    Raises
    ------
    InputError
        If rounding has made cells of generators near each other wrong.
    ClvoroError
        If the faces of such cells do not come together.
    """
    from .fetch_polygon import _FetchedPolygon
    from .fetch_torus import _FetchedTorus

    others = ["face_vert" if engine.dim == 2 else "cell_vert"]
    if unfolded is None:
        others.append("shifts")
    if isinstance(domain, Polygon):
        fetched: _Fetched = _FetchedPolygon(engine, domain, t, labels, copy)
        others.remove("face_vert")
    elif unfolded is not None and isinstance(domain, Box):
        fetched = _FetchedTorus(engine, domain, t, labels, copy, unfolded)
    else:
        fetched = _Fetched(engine, domain, t, labels, copy)
    fetched.names = [name for name in Diagram._NAMES if not name.startswith(tuple(others))]
    diagram = fetched.diagram()
    if t.near:
        fetched.refuse_if_wrong(diagram)
    return diagram


def kept_faces(t: Tessellation, m: int, copy: bool) -> Tessellation:
    """Return `t`, which has `m` faces, or a copy; what lies behind the last face has never been written."""

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
        narrow=t.narrow,
        near=t.near,
    )


class _Fetched:
    """A tessellation, by default a copy since the stages reuse their buffers, and how to read it."""

    def __init__(
        self, engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array, copy: bool
    ) -> None:
        self.engine, self.domain, self.n = engine, domain, t.n
        self.origin, self.scale = domain.frame
        self.labels = labels.get()[: t.n]
        self.names: list[str] = []
        m = int(t.starts[t.n].get())
        self.t = self.whole = kept_faces(t, m, copy)

    @cached_property
    def places(self) -> np.ndarray:
        """Place in `whole` of each of the device's faces, (m,)."""
        return np.arange(len(self.t.neighbors))

    @cached_property
    def order(self) -> np.ndarray:
        """Device row of each row of the result, (n,)."""
        return np.argsort(self.labels, kind="stable")

    def diagram(self) -> Diagram:
        """Return the result, of which `names` say what it has."""
        return Diagram(
            self.domain, {name: (lambda name=name: getattr(self, name)()) for name in self.names}
        )

    def refuse_if_wrong(self, diagram: Diagram) -> None:
        """Check the result, and raise InputError if something is wrong."""
        if not diagram.check():
            raise CloseError(self.t.points, self.n).within(self.domain)

    @cached_property
    def kept(self) -> np.ndarray | None:
        """Which of the device's faces are in the result, (m,) bool; None if all are.

        A face in 3D that is no polygon, as narrow as its vertices round, is none.

        Raises
        ------
        InputError
            If what that leaves out makes a cell wrong.
        """
        if not self.whole.narrow:
            return None
        kept = self.polygons()
        if (self._gaps(kept) > LEFT_OUT * self.whole.volumes.get()).any():
            trial = self._with(kept=kept)
            trial.refuse_if_wrong(trial.diagram())
        return kept

    def _with(self, **made: object) -> _Fetched:
        """Return a copy for which this is `made`, which is not ours before it has proved right."""
        trial = shallow_copy(self)
        vars(trial).update(made)
        return trial

    def polygons(self) -> np.ndarray:
        """Which of the device's faces are polygons, (m,) bool."""
        return np.diff(self.loop_starts) > 0

    def _gaps(self, kept: np.ndarray) -> np.ndarray:
        """Volumes that cones of the faces make up which are not `kept`, of each cell of `whole`."""
        t, faces = self.whole, self.places[~kept]
        cell = np.searchsorted(t.starts.get(), faces, side="right") - 1
        other, points = t.neighbors.get()[faces], t.points.get().astype(float)
        inner = other >= 0  # in 3D walls are wide
        way = np.linalg.norm(points[other] - points[cell], axis=1) * inner
        return np.bincount(cell, t.face_measures.get()[faces] * way / 6, t.n)

    @cached_property
    def starts(self) -> np.ndarray:
        """Device `starts` (n + 1,), of the faces that are kept."""
        starts = self.t.starts.get()
        if self.kept is None:
            return starts
        return np.concatenate([[0], np.cumsum(self.kept)])[starts]

    @cached_property
    def owners(self) -> np.ndarray:
        """Device row that each face of the result belongs to, (m,)."""
        return np.repeat(self.order, np.diff(self.starts)[self.order])

    @cached_property
    def slots(self) -> np.ndarray:
        """Place in the device's arrays of each face of the result, (m,)."""
        m = len(self.owners)
        places = (
            self.starts[self.owners]
            + np.arange(m)
            - self.neighbor_starts()[self.ranks[self.owners]]
        )
        return places if self.kept is None else np.flatnonzero(self.kept)[places]

    @cached_property
    def ranks(self) -> np.ndarray:
        """Row of the result of each device row, (n,)."""
        inverse = np.empty(self.n, np.int32)
        inverse[self.order] = np.arange(self.n, dtype=np.int32)
        return inverse

    @cached_property
    def shared(self) -> Vertices:
        """Vertices, each once, in 2D."""
        return VertexNumbering(self.engine).number(self.domain, self.t)

    @cached_property
    def loops(self) -> Loops:
        """Vertices, each once, in 3D, and the loops of faces in the device's order.

        Raises
        ------
        ClvoroError
            If cells do not come to see the same, or only what is wrong.
        """
        loops = self._walked()
        if loops.doubtful and not self._with(loops=loops).diagram().check():
            raise apart(self.engine.real)
        return loops

    def _walked(self) -> Loops:
        return FaceLoops(self.engine).walk(self.domain, self.t)

    @cached_property
    def loop_starts(self) -> np.ndarray:
        """Device `starts` of the loops, (m + 1,)."""
        return self.loops.starts.get()

    def _read(self, array: cla.Array, rows: np.ndarray, power: int) -> np.ndarray:
        return array.get().astype(np.float64)[rows] * self.scale**power

    # One method for each of Diagram's arrays.

    def points(self) -> np.ndarray:
        positions = self._read(self.t.points, self.order, 1) + self.origin
        # A rounding may not carry a generator on a wall out of the domain.
        return np.clip(positions, self.domain.lower, self.domain.upper)

    def volumes(self) -> np.ndarray:
        return self._read(self.t.volumes, self.order, self.engine.dim)

    def centroids(self) -> np.ndarray:
        return self._read(self.t.offsets, self.order, 1) + self.points()

    def neighbor_starts(self) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(np.diff(self.starts)[self.order])]).astype(np.int32)

    def neighbors(self) -> np.ndarray:
        j = self.t.neighbors.get()[self.slots]
        return np.where(j >= 0, self.ranks[np.maximum(j, 0)], j).astype(np.int32)

    def face_measures(self) -> np.ndarray:
        return self._read(self.t.face_measures, self.slots, self.engine.dim - 1)

    def face_centroids(self) -> np.ndarray:
        own = self._read(self.t.points, self.owners, 1) + self.origin
        return self._read(self.t.face_centroids, self.slots, 1) + own

    def vertices(self) -> np.ndarray:
        shared = self.shared if self.engine.dim == 2 else self.loops
        positions = shared.positions.get().astype(np.float64) * self.scale + self.origin
        # A rounding may not carry a corner out of the domain.
        return np.clip(positions, self.domain.lower, self.domain.upper)

    def cell_vertex_starts(self) -> np.ndarray:
        return self.neighbor_starts()

    def cell_vertices(self) -> np.ndarray:
        return self.shared.cell_vertices.get()[self.slots]

    def face_vertex_starts(self) -> np.ndarray:
        lengths = np.diff(self.loop_starts)[self.slots]
        return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)

    def face_vertices(self) -> np.ndarray:
        starts = self.face_vertex_starts()
        shift = self.loop_starts[self.slots] - starts[:-1]
        places = np.arange(starts[-1]) + np.repeat(shift, np.diff(starts))
        return self.loops.vertices.get()[places]
