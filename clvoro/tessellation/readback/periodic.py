"""Read the tessellation of a periodic box into a `Diagram`."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pyopencl.array as cla

from ...geometry.box import Box
from ...opencl.engine import Engine
from ..device_diagram import Tessellation
from ..periodic.periodic_tessellator import ExtendedDiagram
from ..vertices import VertexNumbering, Vertices
from .diagram import _DiagramReader, kept_faces, starts_of, used_indices


class _PeriodicReader(_DiagramReader):
    """Read a folded tessellation.

    Vertices come from the extended diagram, where cells beyond the periodic boundaries are ordinary cells. The corners
    of a cell therefore surround its generator. A vertex near a periodic boundary appears once for each of its images
    that is a corner of a cell in the box.
    """

    def __init__(
        self, engine: Engine, domain: Box, t: Tessellation, labels: cla.Array, copy: bool, extended: ExtendedDiagram
    ) -> None:
        super().__init__(engine, domain, t, labels, copy)
        m = len(self.t.neighbors)
        whole, places = extended.tessellation, extended.folded.places
        self.box = extended.images.box
        self.codes = extended.folded.codes[:m].get()
        self.places = np.arange(m) if places is None else places.get()
        self.whole = kept_faces(whole, int(whole.starts[whole.n].get()), copy)

    @cached_property
    def shared(self) -> Vertices:
        """Vertices of the extended diagram in 2D."""
        return VertexNumbering(self.engine).number(self.box, self.whole)

    def polygons(self) -> np.ndarray:
        """Which of the folded faces are polygons, (m,) bool."""
        # The two half-faces at a periodic boundary have separate loops.
        seen = np.diff(self.loop_starts)[self.places] > 0
        i, j = np.repeat(np.arange(self.n), np.diff(self.t.starts.get())), self.t.neighbors.get()
        inner, last = np.flatnonzero(j >= 0), 3**self.engine.dim - 1
        i, j, code = i[inner].astype(np.int64), j[inner].astype(np.int64), self.codes[inner]
        here = inner[np.lexsort((code, j, i))]
        there = inner[np.lexsort((last - code, i, j))]
        seen[here] &= seen[there].copy()
        return seen

    @cached_property
    def merged(self) -> np.ndarray:
        """Representative of each vertex of the extended diagram, in 2D.

        The two ends of a dropped face become one vertex.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count, starts = self.shared.count, self.whole.starts.get()[: self.n + 1]
        if len(self.places) == starts[-1]:
            return np.arange(count)
        dropped = np.setdiff1d(np.arange(starts[-1]), self.places)
        ends = np.arange(1, starts[-1] + 1)
        filled = np.diff(starts) > 0  # cells of power diagrams may be empty
        ends[starts[1:][filled] - 1] = starts[:-1][filled]
        vertices = self.shared.cell_vertices.get()
        pairs = vertices[dropped], vertices[ends[dropped]]
        graph = coo_array((np.ones(len(dropped), np.int8), pairs), (count, count))
        parts = connected_components(graph, directed=False)[1]
        return np.unique(parts, return_index=True)[1][parts]

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices of the extended diagram that are corners of cells in the box, and the index of each corner."""
        shared = self.shared if self.engine.dim == 2 else self.faces
        return used_indices(self.extended_corners(), len(shared.positions))

    @cached_property
    def extended_places(self) -> np.ndarray:
        """Index in the extended diagram of each face of the result, (m,)."""
        return self.places[self.slots]

    def extended_corners(self) -> np.ndarray:
        """Return the corners of the result as vertices of the extended diagram."""
        if self.engine.dim == 2:
            return self.merged[self.shared.cell_vertices.get()[self.extended_places]]
        starts = self.face_vertex_starts()
        shift = self.loop_starts[self.extended_places] - starts[:-1]
        places = np.arange(starts[-1]) + np.repeat(shift, np.diff(starts))
        return self.faces.vertices.get()[places]

    def points(self) -> np.ndarray:
        positions = self._read(self.t.points, 1) + self.origin
        lower, upper = np.array(self.domain.lower), np.array(self.domain.upper)
        last = np.where(self.domain.periodic, np.nextafter(upper, lower), upper)
        return np.clip(positions, lower, last)

    def shifts(self) -> np.ndarray:
        codes = self.codes[self.slots]
        steps = [codes // 3**a % 3 - 1 for a in range(self.engine.dim)]
        return np.stack(steps, axis=1).astype(np.int8)

    def vertices(self) -> np.ndarray:
        shared = self.shared if self.engine.dim == 2 else self.faces
        used = shared.positions.get()[self.corners[0]].astype(np.float64)
        positions = used * self.scale + self.origin
        inside = np.clip(positions, self.domain.lower, self.domain.upper)
        return np.where(self.domain.periodic, positions, inside)

    def cell_vertices(self) -> np.ndarray:
        return self.corners[1]

    def face_vertex_starts(self) -> np.ndarray:
        return starts_of(np.take(np.diff(self.loop_starts), self.extended_places))

    def face_vertices(self) -> np.ndarray:
        return self.corners[1]
