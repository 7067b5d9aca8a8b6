"""The stages of an engine: tessellation, solvers and the stages of this package."""

from __future__ import annotations

from typing import ClassVar

from ..solvers.poisson import Poisson
from ..solvers.transport import Transport
from ..solvers.volume_projection import VolumeProjection
from ..tessellation.stages import TessellationStages
from .corners import Corners
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

    metric: Metric
    density: Density
    poisson: Poisson
    transport: Transport
    volume_projection: VolumeProjection
    quality_descent: QualityDescent
    motion: Motion
    mmpde: Mmpde
    corners: Corners
    thin_walls: ThinWalls
    refinement: Refinement
    surface_descent: SurfaceDescent
    insertion_deletion: InsertionDeletion
    local_counts: LocalCounts

    CLASSES: ClassVar[dict[str, type]] = {
        **TessellationStages.CLASSES,
        "metric": Metric,
        "density": Density,
        "poisson": Poisson,
        "transport": Transport,
        "volume_projection": VolumeProjection,
        "quality_descent": QualityDescent,
        "motion": Motion,
        "mmpde": Mmpde,
        "corners": Corners,
        "thin_walls": ThinWalls,
        "refinement": Refinement,
        "insertion_deletion": InsertionDeletion,
        "surface_descent": SurfaceDescent,
        "local_counts": LocalCounts,
    }
