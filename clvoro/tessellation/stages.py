"""The stages that make a diagram."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine
from ..opencl.primitives import Gather
from .bins import Bins
from .cells import Cells
from .clipped.trim import Trim
from .device_diagram import Follow, Tessellation, read_report
from .incremental import IncrementalUpdate
from .periodic.ghost_images import GhostImages
from .polyhedra import Polyhedra
from .polyhedra_update import PolyhedraUpdate

Stage = TypeVar("Stage")
CELLS = {2: Cells, 3: Polyhedra}
"""What builds cells, by their dimension."""
UPDATES = {2: IncrementalUpdate, 3: PolyhedraUpdate}
"""What updates diagrams, by the dimension of cells."""


def made_by(kind: Callable[[Engine], Stage]) -> cached_property[Stage]:
    """Return an attribute that ``kind(engine)`` makes when it is first used."""
    return cached_property(lambda stages: kind(stages.engine))


class Update(Protocol):
    """What updates a diagram incrementally."""

    def update(
        self,
        cells: Any,
        box: ClipBox,
        points: cla.Array,
        previous: Tessellation,
        clip: Any,
        follow: Follow = read_report,
    ) -> Tessellation | None:
        """Tessellate `box` by `points`, the new positions of the generators of `previous`; None if made anew."""
        ...


class TessellationStages:
    """The stages of one engine that make diagrams, each compiled when first used; meshes share their buffers."""

    bins = made_by(Bins)
    ghost_images = made_by(GhostImages)
    trim = made_by(Trim)
    gather = made_by(Gather)

    def __init__(self, engine: Engine) -> None:
        self.engine = engine

    @cached_property
    def cells(self) -> Cells | Polyhedra:
        """What builds cells of this dimension, with weights if the engine has them."""
        return CELLS[self.engine.cell_dim](self.engine)

    @cached_property
    def folded_cells(self) -> Cells | Polyhedra:
        """What builds the cells of a periodic box without its images; in 3D `cells` does this as well."""
        return Cells(self.engine, folded=True) if isinstance(self.cells, Cells) else self.cells

    @property
    def ring_cells(self) -> Cells | None:
        """What builds cells with weights from the neighbors in an earlier diagram: in 2D and float64."""
        cells = self.folded_cells if self.engine.traits.periods else self.cells
        return cells if isinstance(cells, Cells) and self.engine.real == np.float64 else None

    @cached_property
    def update(self) -> Update:
        """What updates diagrams of such cells."""
        return UPDATES[self.engine.cell_dim](self.engine)

    @cached_property
    def weighted(self) -> TessellationStages:
        """The stages for power diagrams; they share workspace and kernels with these."""
        traits = self.engine.traits
        traits = traits._replace(macros=(*traits.macros, "WEIGHTED"), site_values=1)
        return TessellationStages(self.engine.replaced(traits=traits))

    @cached_property
    def unfolded(self) -> TessellationStages:
        """The stages for parts, which take images as ghosts; they share workspace and kernels with these."""
        traits = self.engine.traits
        if not traits.periods:
            return self
        macros = tuple(name for name in traits.macros if name != "PERIODIC")
        return TessellationStages(self.engine.replaced(traits=traits._replace(macros=macros, periods=())))

    def clear_folded_cells(self) -> None:
        """Free the buffers of `folded_cells`, if it exists; its kernels stay."""
        cells = vars(self).get("folded_cells")
        if isinstance(cells, Cells):
            cells.clear()

    def release(self) -> None:
        """Free all stages and their buffers; a stage that is used again is created anew."""
        for name in set(vars(self)) - {"engine"}:
            delattr(self, name)
        self.engine.workspace.clear()
        self.engine.pool.release()
