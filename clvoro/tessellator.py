"""From generators to the diagram of a domain: which stages, in which order."""

from __future__ import annotations

from typing import Protocol

import pyopencl.array as cla

from ._program import Engine
from .bins import Bins
from .cells import Cells, Tessellation
from .domain import Domain
from .polyhedra import Polyhedra
from .repair import Repair
from .seam import Seam
from .torus import Torus, Unfolded


class DiagramStages(Protocol):
    """The stages that a diagram takes."""

    engine: Engine
    bins: Bins
    cells: Cells | Polyhedra
    repair: Repair
    seam: Seam


class Tessellator:
    """Tessellate one domain again and again.

    Buffers are the stages': the call after next overwrites the graph of a `Tessellation`, the next one its measures.
    """

    def __init__(self, stages: DiagramStages, domain: Domain) -> None:
        self.stages, self.domain = stages, domain
        self.torus = Torus(stages, domain) if any(domain.periodic) else None

    @property
    def unfolded(self) -> Unfolded | None:
        """What the latest diagram was folded from, in a periodic box."""
        return None if self.torus is None else self.torus.latest

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points` (n, d), in the coordinates of the domain's frame.

        Parameters
        ----------
        previous : Tessellation, optional
            The latest diagram, of the same generators at earlier positions: what has stayed of it is kept.
        exact : bool
            Refuse generators so close together that rounding makes a share of a cell uncertain; see `Cells.tessellate`.

        Raises
        ------
        InputError
            If generators are too close to each other to be told apart.
        """
        stages, domain = self.stages, self.domain
        if self.torus is not None:
            return self.torus.tessellate(points, n, previous, exact, nearest=not exact)
        if isinstance(stages.cells, Polyhedra):
            binned = stages.bins.build(domain, points, n)
            return stages.cells.tessellate(domain, points, n, binned, previous, exact)
        if previous is not None and not exact:
            t = stages.repair.follow(stages.cells, domain, points, previous)
            if t is not None:
                return t
        return stages.cells.tessellate(
            domain, points, n, stages.bins.build(domain, points, n), exact
        )
