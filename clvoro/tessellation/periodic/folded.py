"""Cells of a folded diagram (see `seam.py`) in 2D, whose neighbors are the nearest images of their generators.

Their kernels have the periods built in: all that is said of corners takes differences of positions.
"""

from __future__ import annotations

from ...opencl.engine import Engine
from ..cells import Cells


class FoldedCells(Cells):
    """The rows and measures of such cells: what `IncrementalUpdate` works on in a periodic box."""

    searches = False

    def __init__(self, engine: Engine) -> None:
        self._folds = {f"FOLD_{a}": engine.domain_kind.periods[a].hex() for a in range(2)}
        super().__init__(engine)

    @property
    def defines(self) -> dict[str, object]:
        """The capacities and the periods, as kernels that work on the rows must be built with."""
        return {**super().defines, **self._folds}

    def reserve(self, n: int) -> None:
        """Make room for `n` cells."""
        self._reserve(n)

    def clear(self) -> None:
        """Let go of all buffers of cells and faces."""
        self._of_cells, self._of_faces, self._views = {}, {}, {}
        self._capacity, self._room, self._n = 0, 0, -1
