"""Motion of generators: the gradient of the potential, relaxation, and the move itself (`motion.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..tessellation.device_diagram import Tessellation


@dataclass(frozen=True)
class Moving:
    """Generators that a stage moves.

    Attributes
    ----------
    points, velocity : (n, d) real
        Both change by the same displacement.
    labels, fixed : (n,) int32, int
        Generators with labels below `fixed` do not move.
    """

    points: cla.Array
    velocity: cla.Array
    labels: cla.Array
    fixed: int


class Motion:
    """The kernels of `motion.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/motion")

    def compute_potential_gradient(self, t: Tessellation, psi: cla.Array, u: cla.Array) -> None:
        """Write u = grad psi = -grad phi, the paper's (3.3), to `u` (n, d)."""
        self.engine.run_each(
            self._kernels.compute_potential_gradient,
            t.n,
            t.starts,
            t.neighbors,
            t.face_measures,
            t.face_centroids,
            t.volumes,
            t.points,
            psi,
            u,
            *self.engine.period_args,
        )

    def relax_correction(self, summaries: Summaries, name: str, limit: float, k: float, u: cla.Array) -> None:
        """Scale `u` (n, d) by alpha = min(limit, k / max(|u| / h)), the paper's (3.5).

        The summary `name` of |u| / h must have been collected.
        """
        real = self.engine.real.type
        self.engine.run_each(
            self._kernels.relax_correction, len(u), summaries.values, summaries.slots[name], real(limit), real(k), u
        )

    def move_generators(
        self,
        domain: Domain,
        points: cla.Array,
        lloyd: cla.Array,
        a: float,
        correction: cla.Array,
        b: float,
        h: cla.Array,
        velocity: cla.Array,
        clip: float = 0.0,
    ) -> None:
        """Move `points` (n, d) by a lloyd + b correction, at most by clip h (0: no bound), inside `domain`.

        `velocity` (n, d) becomes the displacement.
        """
        real = self.engine.real.type
        self.engine.run_each(
            self._kernels.move_generators,
            h.shape[0],
            lloyd,
            real(a),
            correction,
            real(b),
            h,
            real(clip),
            *domain.device_args(self.engine),
            points,
            velocity,
        )

    def zero_fixed_displacements(self, labels: cla.Array, fixed: int, displacement: cla.Array) -> None:
        """Set `displacement` (n, d) to 0 for generators whose label is below `fixed`."""
        self.engine.run_each(self._kernels.zero_fixed_displacements, len(labels), labels, np.int32(fixed), displacement)

    def add_momentum(self, factor: float, lloyd: cla.Array, velocity: cla.Array, share: float) -> None:
        """Set `lloyd` (n, d) to ``factor * lloyd + share * velocity``."""
        real = self.engine.real.type
        self.engine.run_each(self._kernels.add_momentum, lloyd.shape[0], real(factor), velocity, real(share), lloyd)
