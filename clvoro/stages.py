"""The stages of one engine, and the order of those that a diagram takes in a box with walls."""

from __future__ import annotations

from typing import ClassVar

import pyopencl.array as cla

from ._primitives import Gather
from ._program import Engine
from .bins import BinnedPoints, Bins
from .cells import Cells
from .density import Density
from .domain import Domain
from .folded import FoldedCells
from .metric import Metric
from .motion import Motion
from .poisson import Poisson
from .polyhedra import Polyhedra
from .population import PopulationControl
from .projection import Projection
from .refinement import Refinement
from .repair import Repair
from .seam import Seam
from .shape import Shape
from .tessellation import Tessellation
from .trim import Trim


class Stages:
    """The stages of one engine, each compiled when first used, their buffers reused by every mesh."""

    bins: Bins
    cells: Cells | Polyhedra
    repair: Repair
    seam: Seam
    folded: FoldedCells
    metric: Metric
    density: Density
    poisson: Poisson
    projection: Projection
    shape: Shape
    motion: Motion
    refinement: Refinement
    population: PopulationControl
    gather: Gather
    trim: Trim

    _CLASSES: ClassVar = {
        "bins": Bins, "cells": Cells, "repair": Repair, "metric": Metric, "density": Density, "poisson": Poisson,
        "projection": Projection, "shape": Shape, "motion": Motion, "refinement": Refinement,
        "population": PopulationControl, "gather": Gather, "trim": Trim, "seam": Seam,
        "folded": FoldedCells,
    }  # fmt: skip

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    def __getattr__(self, name: str) -> object:
        if name not in Stages._CLASSES:
            raise AttributeError(name)
        three = name == "cells" and self.engine.dim == 3
        stage = (Polyhedra if three else Stages._CLASSES[name])(self.engine)
        setattr(self, name, stage)
        return stage

    def clear(self, *names: str) -> None:
        """Let go of the buffers of those of these stages that there are; their kernels stay."""
        for name in names:
            if name in self.__dict__:
                getattr(self, name).clear()

    def release(self) -> None:
        """Let go of all stages and their buffers; those that are used again are made again."""
        for name in Stages._CLASSES:
            self.__dict__.pop(name, None)
        self.engine.workspace.clear()
        self.engine.pool.take_back()


def tessellate_box(
    stages: Stages,
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
        # What steps have worked on is of no use here, where bins need room.
        stages.engine.workspace.clear()
    if binned is None:
        binned = stages.bins.build(domain, points, n)
        stages.bins.clear_work()
    return stages.cells.tessellate(domain, points, n, binned, exact)
