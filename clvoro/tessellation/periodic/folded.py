"""Cells of a folded diagram in 2D, in which each neighbor is the nearest image of its generator.

The periods are built into the kernels, which compute corners from differences of positions.
"""

from __future__ import annotations

from ...opencl.engine import Engine
from ..cells import Cells
from ..power_cells import PowerCells


class FoldedCells(Cells):
    """Rows and measures of folded cells, on which `IncrementalUpdate` works in a periodic box."""

    searches = False

    def __init__(self, engine: Engine) -> None:
        self._folds = {f"FOLD_{a}": engine.traits.periods[a].hex() for a in range(2)}
        super().__init__(engine)

    @property
    def defines(self) -> dict[str, object]:
        """The capacities and the periods: defines of all kernels that read the rows."""
        return {**super().defines, **self._folds}

    def clear(self) -> None:
        """Free all buffers of cells and faces."""
        self._of_cells, self._of_faces, self._views = {}, {}, {}
        self._capacity, self._room, self._n = 0, 0, -1


class FoldedPowerCells(FoldedCells, PowerCells):
    """The same for power diagrams: cells start from the neighbors in an earlier folded graph."""
