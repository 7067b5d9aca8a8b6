"""What builds the cells of a diagram from its generators in bins: one interface in 2D and in 3D."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.primitives import Scan
from ..opencl.workspace import framed
from .bins import BinnedPoints
from .device_diagram import NeighborRows, Tessellation
from .part import Part
from .report import SIZE
from .weight_bounds import WeightBounds

MOMENTS = {2: 3, 3: 6}
"""Second moments of a cell, by its dimension."""
MOST_ROOM = 1.1
"""Largest room for cells over their number, in a part: it has far fewer of them when others join the run."""


class CellBuilder(ABC):
    """Build the cells of a box, or of a sphere; with an engine for power diagrams by points that end with weights.

    Buffers are reused: each call overwrites the `Tessellation` of the call before. Its graph stays valid until the new
    one is complete.
    """

    from_previous: bool
    """Whether new cells may start from the neighbors in an earlier diagram, and updates need bins."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self._scan = engine, Scan(engine)
        self._bounds = WeightBounds(engine) if engine.traits.site_values else None
        self._report = engine.empty(SIZE, np.int32)
        self.clear()

    def clear(self) -> None:
        """Free all buffers of cells and faces; kernels stay."""
        self._all_cells: dict[str, cla.Array] = {}
        self._cells: dict[str, cla.Array] = {}
        self._faces: dict[str, cla.Array] = {}
        self._n = -1

    def cells_of(self, n: int) -> dict[str, cla.Array]:
        """Return the arrays per cell of a diagram of `n` cells."""
        engine = self.engine
        room = self._all_cells["volumes"].shape[0] if self._all_cells else -1
        if not n <= room <= (MOST_ROOM * n if engine.peers.shared else room):
            self.clear()  # the old arrays are freed first
            self._all_cells = {
                "starts": engine.empty(n + 1, np.int32),
                "volumes": engine.empty(n),
                "offsets": engine.empty((n, engine.dim)),
                "covariances": engine.empty((n, MOMENTS[engine.cell_dim])),
            }
            if engine.peers.shared:
                self._all_cells["reach"] = engine.empty(n, np.float32)
        if n != self._n:
            self._cells = {name: a[: n + (name == "starts")] for name, a in self._all_cells.items()}
            self._n = n
        return self._cells

    def faces_of(self, m: int, spare: int = 0) -> dict[str, cla.Array]:
        """Return the arrays of a diagram of at most `m` half-faces; new ones have room for `spare` more."""
        engine, faces = self.engine, self._faces
        if not faces or faces["neighbors"].shape[0] < m:
            faces.clear()
            m += spare
            faces["neighbors"] = engine.empty(m, np.int32)
            faces["face_measures"] = engine.empty(m, engine.face)
            faces["face_centroids"] = engine.empty((m, engine.dim), engine.face)
        return faces

    @framed
    def tessellate(
        self,
        part: Part,
        binned: BinnedPoints,
        previous: Tessellation | NeighborRows | None = None,
        exact: bool = True,
        rows: int | None = None,
    ) -> Tessellation:
        """Build the cells of `part`.

        - `binned`: the generators and ghosts of `part`, sorted into bins.
        - `previous`: a diagram of the same generators at earlier positions: with `from_previous` clipping starts from
          its neighbors.
        - `exact`: reject generators so close together that round-off makes more than `EXACT_SHARE` of a cell uncertain;
          otherwise more than `ROUGH_SHARE`.
        - `rows`: number of first rows of `part` whose cells are built; by default all, those of ghosts, too. Faces
          between cells that are built and others are not matched.

        Raises `InputError` if two generators coincide or are too close for the precision (`CloseError`). Raises
        `MemoryLimitError` if the faces are too many for 32-bit indices. Raises `ClvoroError` if a cell has too many
        faces.
        """
        t = self._tessellate(part, binned, previous, exact, part.count if rows is None else rows)
        if part.labels is not None and self.knows_corners(t):
            self.order_rows(part, t)
        return t

    def order_rows(self, part: Part, t: Tessellation) -> None:
        """Sort the rows of `t`, the diagram of `part`, by its labels; see `Part.order_rows`."""
        part.order_rows(self.engine, t, self.defines)

    @abstractmethod
    def _tessellate(
        self, part: Part, binned: BinnedPoints, previous: Tessellation | NeighborRows | None, exact: bool, rows: int
    ) -> Tessellation:
        """Tessellate; `rows` is the number of cells to build."""

    @property
    @abstractmethod
    def defines(self) -> dict[str, object]:
        """Macros for building kernels that work on rows of faces."""

    def knows_corners(self, t: Tessellation) -> bool:
        """Return whether the corners of the cells of `t` are known, so that they can be measured in another order."""
        del t
        return True

    def measure_faces(self, box: ClipBox, t: Tessellation) -> Tessellation:
        """Return `t`, a diagram of `box`, with face measures and centroids in full precision, in new arrays."""
        del box
        return t
