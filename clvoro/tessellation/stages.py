"""The stages that make a diagram, and their order in a box with walls."""

from __future__ import annotations

from functools import cache
from typing import ClassVar

import pyopencl.array as cla

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.primitives import Gather
from .bins import BinnedPoints, Bins
from .cells import Cells
from .clipped.trim import Trim
from .device_diagram import Follow, Tessellation, read_report
from .incremental import IncrementalUpdate
from .periodic.folded import FoldedCells, FoldedPowerCells
from .periodic.ghost_images import GhostImages
from .polyhedra import Polyhedra
from .polyhedra_update import PolyhedraUpdate
from .power_cells import PowerCells


class TessellationStages:
    """The stages of one engine that make diagrams, each compiled when first used; meshes share their buffers."""

    bins: Bins
    cells: Cells | Polyhedra
    incremental: IncrementalUpdate
    polyhedra_update: PolyhedraUpdate
    ghost_images: GhostImages
    folded_cells: FoldedCells
    trim: Trim
    gather: Gather

    CLASSES: ClassVar[dict[str, type]] = {
        "bins": Bins,
        "cells": Cells,
        "incremental": IncrementalUpdate,
        "polyhedra_update": PolyhedraUpdate,
        "ghost_images": GhostImages,
        "folded_cells": FoldedCells,
        "trim": Trim,
        "gather": Gather,
    }

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def __getattr__(self, name: str) -> object:
        if name not in self.CLASSES:
            raise AttributeError(name)
        kind = self.CLASSES[name]
        if name == "cells" and self.engine.cell_dim == 3:
            kind = Polyhedra
        elif name == "cells" and self.engine.domain_kind.weighted:
            kind = PowerCells
        elif name == "folded_cells" and self.engine.domain_kind.weighted:
            kind = FoldedPowerCells
        stage = kind(self.engine)
        setattr(self, name, stage)
        return stage

    @property
    def weighted(self) -> TessellationStages:
        """The stages for power diagrams; they share workspace and kernels with these."""
        if "_weighted" not in self.__dict__:
            self._weighted = TessellationStages(self.engine.weighted())
        return self._weighted

    def clear(self, *names: str) -> None:
        """Free the buffers of these stages, where they exist; their kernels stay."""
        for name in names:
            if name in self.__dict__:
                getattr(self, name).clear()

    def release(self) -> None:
        """Free all stages and their buffers; a stage that is used again is created anew."""
        for name in (*self.CLASSES, "_weighted"):
            self.__dict__.pop(name, None)
        self.engine.workspace.clear()
        self.engine.pool.release()


def tessellate_box(
    stages: TessellationStages,
    domain: Domain,
    points: cla.Array,
    n: int,
    previous: Tessellation | None,
    exact: bool,
    binned: BinnedPoints | None = None,
    follow: Follow = read_report,
) -> Tessellation:
    """Tessellate the clip box of `domain`; see `Tessellator.tessellate`."""
    cells = stages.cells
    if isinstance(cells, Polyhedra):
        bins = cache(lambda: stages.bins.build(domain, points, n) if binned is None else binned)
        if previous is not None and not exact:
            t = stages.polyhedra_update.update(
                cells,
                domain,
                points,
                previous,
                lambda cut, report, _: cells.clip_rest(cut, report, domain, points, bins(), previous),
                follow,
            )
            if t is not None:
                return t
        t = cells.tessellate(domain, points, n, bins(), previous, exact)
        follow(t, None)
        return t
    if previous is not None and not exact:
        t = stages.incremental.update(cells, domain, points, previous, follow)
        if t is not None:
            return t
        # Free the work arrays of the steps, because the bins need memory.
        stages.engine.workspace.clear()
    if binned is None:
        binned = stages.bins.build(domain, points, n)
        stages.bins.clear_work()
    t = cells.tessellate(domain, points, n, binned, exact)
    follow(t, None)
    return t
