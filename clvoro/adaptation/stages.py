"""All stages of one engine."""

from __future__ import annotations

from typing import ClassVar

from ..solvers.poisson import Poisson
from ..solvers.volume_projection import VolumeProjection
from ..tessellation.stages import TessellationStages
from .density import Density
from .insertion_deletion import PopulationControl
from .metric import Metric
from .motion import Motion
from .quality_descent import Shape
from .refinement import Refinement


class Stages(TessellationStages):
    """The stages of one engine, each compiled when first used; meshes share their buffers."""

    metric: Metric
    density: Density
    poisson: Poisson
    projection: VolumeProjection
    shape: Shape
    motion: Motion
    refinement: Refinement
    population: PopulationControl

    CLASSES: ClassVar[dict[str, type]] = {
        **TessellationStages.CLASSES, "metric": Metric, "density": Density, "poisson": Poisson,
        "projection": VolumeProjection, "shape": Shape, "motion": Motion, "refinement": Refinement,
        "population": PopulationControl,
    }  # fmt: skip
