"""Numbering of the shared Voronoi vertices in 2D (`vertices.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..errors import ClvoroError
from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from .device_diagram import Tessellation

MOST_AROUND = 10_000
"""Largest number of cells at a vertex (see tessellation/vertex_walk.h)."""


@dataclass(frozen=True)
class Vertices:
    """Shared vertices, on the device."""

    count: int
    positions: cla.Array
    """(count, d) real. In normalized coordinates."""
    cell_vertices: cla.Array
    """(m,) int32. Vertex at the beginning of each face of the graph. Faces of a cell run counter-clockwise."""


class VertexNumbering:
    """Number the vertices of a tessellation."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._kernels = engine.kernels("tessellation/vertices")

    def number(self, box: ClipBox, t: Tessellation) -> Vertices:
        """Return the vertices of `t`, ordered by the least index of their corners.

        Raises `ClvoroError` if the walk around a vertex does not end.
        """
        engine, k = self.engine, self._kernels
        m = int(t.starts[t.n].get())
        owners, ids = engine.empty(m, np.int32), engine.empty(m + 1, np.int32)
        endless = engine.zeros(1, np.int32)
        engine.run_each(k.find_vertex_owners, t.n, *t.graph, owners, ids, endless)
        self._scan.exclusive(ids, ids, m)
        count, cell = int(ids[m].get()), int(endless.get()[0]) - 1
        if cell >= 0:
            raise ClvoroError(
                f"more than {MOST_AROUND} cells meet at a vertex of the cell of {t.points[cell].get()} (in the "
                "device's coordinates), or the neighbors of cells contradict each other; perturb generators that lie "
                "on a common circle"
            )
        cell_vertices, positions = engine.empty(m, np.int32), engine.empty((count, engine.dim))
        made = owners, ids, cell_vertices, positions
        engine.run_each(k.place_polygon_vertices, t.n, t.sites, *box.device_corners(engine.real), *t.graph, *made)
        return Vertices(count, positions, cell_vertices)
