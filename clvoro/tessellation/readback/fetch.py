"""From a tessellation on the device to a `Diagram` on the host: physical units, the caller's order."""

from __future__ import annotations

from copy import copy as shallow_copy
from functools import cached_property

import numpy as np
import pyopencl.array as cla

from ...geometry.box import Box, ClipBox, Domain
from ...geometry.polygon import Polygon
from ...mesh.diagram import Diagram
from ...opencl.engine import Engine
from ..device_diagram import UNEVEN, CloseError, Tessellation
from ..periodic.torus import Unfolded
from ..topology3d.consistency import SharedFaces, share_faces
from ..vertices import VertexNumbering, Vertices

LEFT_OUT = 1e-5
"""Share of a cell: if faces that are left out, as they are no wider than round-off, make up more, the diagram is
checked."""


def fetch_diagram(
    engine: Engine,
    domain: Domain,
    t: Tessellation,
    labels: cla.Array,
    copy: bool = True,
    unfolded: Unfolded | None = None,
) -> Diagram:
    """Return `t` as a `Diagram` with rows in the order of `labels` (n,); arrays are read when first used.

    Without `copy`, nobody may use the buffers of `t` any more. `unfolded` is what `t` was folded from, in a periodic
    box.

    Raises
    ------
    InputError
        If round-off has made cells wrong.
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
    if fetched.whole.round_off & UNEVEN:
        assert fetched.faces
    return fetched.diagram()


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
        round_off=t.round_off,
    )


class _Fetched:
    """A tessellation, by default a copy since the stages reuse their buffers, and how to read it."""

    def __init__(
        self, engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array, copy: bool
    ) -> None:
        self.engine, self.domain, self.n = engine, domain, t.n
        self.box: ClipBox = domain
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
            vars(trial)["faces"] = faces
            if trial.needs_check() and not trial.diagram().check():
                raise CloseError(self.t.points, self.n)
        except CloseError as error:
            raise error.within(self.domain) from None
        return faces

    def needs_check(self) -> bool:
        """Tell whether round-off may have spoiled the result."""
        if self.faces.needs_check or self.whole.round_off & UNEVEN:
            return True
        lost = 0 if self.kept is None else self._gaps(self.kept)
        return bool((lost > LEFT_OUT * self.whole.volumes.get()).any())

    @cached_property
    def kept(self) -> np.ndarray | None:
        """Which of the device's faces are in the result, (m,) bool; None if all are.

        In 3D faces no wider than round-off are left out.
        """
        return self.polygons() if self.whole.round_off else None

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
    def loop_starts(self) -> np.ndarray:
        """Device `starts` of the loops, (m + 1,)."""
        return self.faces.starts.get()

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
        shared = self.shared if self.engine.dim == 2 else self.faces
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
        return self.faces.vertices.get()[places]
