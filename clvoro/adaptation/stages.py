"""The stages of an engine: tessellation, solvers and the stages of this package."""

from __future__ import annotations

from ..solvers.poisson import Poisson
from ..solvers.transport import Transport
from ..solvers.volume_projection import VolumeProjection
from ..tessellation.stages import TessellationStages, made_by
from .density import Density
from .descent.quality_descent import QualityDescent
from .descent.surface_descent import SurfaceDescent
from .insertion_deletion import InsertionDeletion
from .local_counts import LocalCounts
from .metric import Metric
from .motion import Motion
from .moving.mmpde import Mmpde
from .refinement import Refinement
from .thin_walls import ThinWalls


class Stages(TessellationStages):
    """The stages of one engine, each compiled when first used. Meshes share their buffers."""

    metric = made_by(Metric)
    density = made_by(Density)
    poisson = made_by(Poisson)
    transport = made_by(Transport)
    volume_projection = made_by(VolumeProjection)
    quality_descent = made_by(QualityDescent)
    motion = made_by(Motion)
    mmpde = made_by(Mmpde)
    thin_walls = made_by(ThinWalls)
    refinement = made_by(Refinement)
    surface_descent = made_by(SurfaceDescent)
    insertion_deletion = made_by(InsertionDeletion)
    local_counts = made_by(LocalCounts)

    def clear_poisson(self) -> None:
        """Free the buffers of `poisson`, if it exists; its kernels stay."""
        if "poisson" in vars(self):
            self.poisson.clear()

    def drop_poisson(self) -> None:
        """Free `poisson`, since over another number of parts it has other kernels."""
        vars(self).pop("poisson", None)
