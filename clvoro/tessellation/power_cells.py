"""Cells of a power diagram in 2D (`cells.cl`, built with WEIGHTED)."""

from __future__ import annotations

import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.workspace import framed
from .bins import MAX_LEVELS
from .cells import Cells
from .device_diagram import DOUBT, NeighborRows, Tessellation
from .face_rows import spare_slots
from .weight_bounds import WeightBounds


class PowerCells(Cells):
    """Tessellate a box in 2D by points with weights (n, 3), one cell per work-item."""

    def __init__(self, engine: Engine) -> None:
        self._bounds = WeightBounds(engine)
        super().__init__(engine)

    def _build(self, cell_capacity: int, row_capacity: int) -> None:
        self.cell_capacity, self.row_capacity = cell_capacity, row_capacity
        defines = {**self.defines, "MAX_DEPTH": MAX_LEVELS, "IN_LANES": 0}
        self._kernels = self.engine.kernels("tessellation/cells", defines)
        self._hulls = None

    def _search_bounds(self, box: ClipBox, points: cla.Array, total: int) -> tuple[object, ...]:
        return self._bounds.build(box, points, total)

    @framed
    def clip_by_rings(
        self, box: ClipBox, points: cla.Array, previous: NeighborRows, exact: bool
    ) -> Tessellation | None:
        """Tessellate by `points` with weights (n, 3), starting from the neighbors in `previous`.

        The result is right if the sum of its volumes is that of the domain. None if a cell has too many faces, or
        is open in a folded graph.
        """
        n, old = previous.n, (previous.starts, previous.neighbors)
        self.reserve(n)
        rows = self.take_rows(n, spare=spare_slots(n))
        self.engine.run_each(
            self._kernels.clip_by_rings,
            n,
            points,
            *box.device_corners(self.engine.real),
            *old,
            rows.slots,
            rows.counts,
            rows.places,
            rows.flags,
        )
        same = rows.places, rows.places
        flags, m = self._match(rows, box, points, n, *same, exact)
        if flags & ~DOUBT:
            return None
        return self.measure(rows, box, points, n, *same, m, flags, exact)
