"""The stages that make a diagram, and their order in a box with walls."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property
from typing import TypeVar

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

Stage = TypeVar("Stage")


def made_by(kind: Callable[[Engine], Stage]) -> cached_property[Stage]:
    """Return an attribute that ``kind(engine)`` makes when it is first used."""
    return cached_property(lambda stages: kind(stages.engine))


class TessellationStages:
    """The stages of one engine that make diagrams, each compiled when first used; meshes share their buffers."""

    bins = made_by(Bins)
    incremental = made_by(IncrementalUpdate)
    polyhedra_update = made_by(PolyhedraUpdate)
    ghost_images = made_by(GhostImages)
    trim = made_by(Trim)
    gather = made_by(Gather)

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    @cached_property
    def cells(self) -> Cells | Polyhedra:
        """What builds cells of this dimension, with weights if the engine has them."""
        if self.engine.cell_dim == 3:
            return Polyhedra(self.engine)
        return (PowerCells if self.engine.traits.site_values else Cells)(self.engine)

    @cached_property
    def folded_cells(self) -> FoldedCells:
        """What builds the cells of a periodic box in 2D without its images."""
        return (FoldedPowerCells if self.engine.traits.site_values else FoldedCells)(self.engine)

    @cached_property
    def weighted(self) -> TessellationStages:
        """The stages for power diagrams; they share workspace and kernels with these."""
        traits = self.engine.traits
        traits = traits._replace(macros=(*traits.macros, "WEIGHTED"), site_values=1)
        return TessellationStages(self.engine.replaced(traits=traits))

    def clear_folded_cells(self) -> None:
        """Free the buffers of `folded_cells`, if it exists; its kernels stay."""
        if "folded_cells" in vars(self):
            self.folded_cells.clear()

    def release(self) -> None:
        """Free all stages and their buffers; a stage that is used again is created anew."""
        for name in set(vars(self)) - {"engine"}:
            delattr(self, name)
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
