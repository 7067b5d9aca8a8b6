"""The stages that a diagram takes, and their order in a box with walls."""

from __future__ import annotations

from typing import Protocol

import pyopencl.array as cla

from ._primitives import Gather
from ._program import Engine
from .bins import BinnedPoints, Bins
from .cells import Cells, Tessellation
from .domain import Domain
from .folded import FoldedCells
from .polyhedra import Polyhedra
from .repair import Repair
from .seam import Seam
from .trim import Trim


class DiagramStages(Protocol):
    """The stages that a diagram takes."""

    engine: Engine
    bins: Bins
    cells: Cells | Polyhedra
    repair: Repair
    seam: Seam
    folded: FoldedCells
    trim: Trim
    gather: Gather


def tessellate_box(
    stages: DiagramStages,
    domain: Domain,
    points: cla.Array,
    n: int,
    previous: Tessellation | None,
    exact: bool,
    binned: BinnedPoints | None = None,
) -> Tessellation:
    """Tessellate the box that cells of `domain` are clipped by; see `Tessellator.tessellate`."""
    if isinstance(stages.cells, Polyhedra):
        binned = stages.bins.build(domain, points, n) if binned is None else binned
        return stages.cells.tessellate(domain, points, n, binned, previous, exact)
    if previous is not None and not exact:
        t = stages.repair.follow(stages.cells, domain, points, previous)
        if t is not None:
            return t
    binned = stages.bins.build(domain, points, n) if binned is None else binned
    return stages.cells.tessellate(domain, points, n, binned, exact)
