"""The result of a run over several parts: each has its own cells, and part 0 can gather the whole mesh."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.domain import Domain
from ..mesh.results import Result
from ..opencl.engine import Engine
from ..tessellation.readback.parts import CellRows
from .estimates import holder_of_all
from .fixed_points import put_back

_OF_CELLS = ("target_size", "size_error", "quality", "origin")
"""Arrays of a result with one row per cell."""


@dataclass(frozen=True)
class ResultParts:
    """What the mesh of one part needs to join those of the others."""

    engine: Engine
    domain: Domain
    rows: Callable[[], CellRows]
    labels: np.ndarray
    """(n,) int32. Permanent numbers of the cells of this part, ascending, as in the whole mesh."""
    fixed: np.ndarray
    """(k, d) float64. Positions of the first cells of the whole mesh."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(None), ()  # without MPI the cells of a rank are a mesh of their own

    @property
    def number(self) -> int:
        """Number of this part."""
        return self.engine.peers.number

    @property
    def count(self) -> int:
        """Number of parts."""
        return self.engine.peers.count

    def together(self, work: Callable[[], None]) -> None:
        """Call `work` in all parts. An error in one of them is raised in all."""
        self.engine.peers.agree(work)

    def owners(self) -> np.ndarray:
        """Return the number of the part that owns each cell of the whole mesh, (n,) int: on part 0; elsewhere empty."""
        labels = self.engine.peers.collect(self.labels)
        parts = np.repeat(np.arange(len(labels)), [len(own) for own in labels])
        return parts[np.argsort(np.concatenate([np.empty(0, np.int32), *labels]), kind="stable")]

    def gather(self, result: Result) -> Result | None:
        """Return the whole mesh on part 0, and None on the others.

        Raises `MemoryLimitError` on part 0, if neither its device nor a CPU has enough memory.
        """
        peers = self.engine.peers
        rows, labels = self.rows().gather(peers), peers.collect(self.labels)
        found = {name: peers.collect(getattr(result, name)) for name in _OF_CELLS}
        if rows is None:
            return None
        order = np.argsort(np.concatenate(labels), kind="stable")
        engine = holder_of_all(self.engine, len(order), self.domain)
        diagram = rows.diagram(engine, self.domain)
        put_back(diagram, self.domain, self.fixed)
        arrays = {name: np.concatenate(values)[order] for name, values in found.items()}
        return dataclasses.replace(result, points=diagram.points, diagram=diagram, parts=None, **arrays)
