"""Borders inside a domain, on which faces of cells lie: lines in the plane, surfaces in space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .fixed_generators import FixedGenerators

if TYPE_CHECKING:
    from ..mesh.diagram import Diagram
    from .domain import Domain

Size = Callable[[np.ndarray], np.ndarray]


class Borders(ABC):
    """Borders inside a domain; they divide it into regions."""

    word: ClassVar[str]
    """What they are, in messages and files; the domain's method ``with_<word>`` adds them."""

    sheets: Any = None
    """Their `Sheets`, onto which vertices of meshes are moved; faces on lines are where they must be."""

    @abstractmethod
    def describe(self) -> Any:
        """Return what the domain's method takes, as numbers, strings and lists, for files."""

    @abstractmethod
    def place(self, domain: Domain, free: Domain, size: Size) -> FixedGenerators:
        """Return the generators beside the borders of `domain`, in its part `free` without layers.

        `size` returns sizes (n,) at points (n, d).
        """

    def narrow_places(self, free: Domain, size: Size) -> tuple[np.ndarray, np.ndarray]:
        """Return segments (k, 2, d) at which cells are smaller than `size`, as borders are near, and sizes (k,)."""
        del free, size
        return np.empty((0, 2, 2)), np.empty(0)

    @abstractmethod
    def region_of_cells(self, diagram: Diagram) -> np.ndarray:
        """Return the region of each cell, (n,) int32; 0 is the largest."""

    def region_names(self, diagram: Diagram) -> list[str]:
        """Return the names of the regions."""
        return [f"region-{k}" for k in range(int(diagram.cell_region.max(initial=-1)) + 1)]

    @abstractmethod
    def faces_of(self, diagram: Diagram) -> np.ndarray:
        """Return the rows of the faces of a mesh that lie on the borders, (k,) int."""

    def face_sets(self, diagram: Diagram) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the faces on borders by name: rows (k,) int, and whether their normals point the other way, (k,)."""
        rows = diagram.border_faces
        return {self.word: (rows, np.zeros(len(rows), bool))} if len(rows) else {}
