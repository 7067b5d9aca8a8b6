"""Motion of generators: the gradient of the potential, relaxation, and the move itself (`motion.cl`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..solvers.linear_system import Solution
from ..tessellation.device_diagram import Tessellation
from .tuning import BALL_PASSES

if TYPE_CHECKING:
    from .state import MeshState


@dataclass(frozen=True)
class Moving:
    """Generators that a stage moves."""

    points: cla.Array
    velocity: cla.Array
    """`points`, `velocity`: (n, d) real. Both change by the same displacement."""
    labels: cla.Array
    fixed: int
    """`labels`, `fixed`: (n,) int32, int. Generators with labels below `fixed` do not move."""


@dataclass(frozen=True)
class Displacement:
    """What a step moves the generators by: ``lloyd_share * lloyd + correction_share * correction``, bounded.

    - `lloyd`, `correction` (n, d) real: its two parts, valid to the end of the workspace's frame.
    - `unit` (n,) real: unit of the bound, a length for each generator.
    - `lloyd_share`, `correction_share`: float
    - `bound`: largest displacement over `unit`; 0 for no bound.
    - `solution`: of the linear system of the step.
    """

    lloyd: cla.Array
    correction: cla.Array
    unit: cla.Array
    lloyd_share: float = 1.0
    correction_share: float = 1.0
    bound: float = 0.0
    solution: Solution = field(default_factory=Solution.zero)


class Method(ABC):
    """A way to move generators.

    - `finished`: whether the method has met a tolerance of its own; None if it has none, and error and quality decide.
    """

    finished: bool | None = None

    @abstractmethod
    def step(self, mesh: MeshState) -> Displacement:
        """Return the displacement of one step, to the end of the workspace's frame, and summarize its lengths."""


@dataclass(frozen=True)
class Balls:
    """Balls around fixed generators, in the device's coordinates, that other generators do not enter."""

    first: int
    count: int
    """`first`, `count`: labels of these generators: `first`, `first` + 1, ..."""
    starts: cla.Array
    """(count + 1,) int32. Balls of each of them."""
    spheres: cla.Array
    """(k, d + 1) real. Centers and radii."""


class Motion:
    """The kernels of `motion.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/motion")

    def compute_potential_gradient(self, t: Tessellation, psi: cla.Array, u: cla.Array) -> None:
        """Write u = grad psi = -grad phi, the paper's (3.3), to `u` (n, d); `psi` (n,) real is the potential psi."""
        with self.engine.workspace.frame():
            cells = *t.graph, t.face_measures, t.face_centroids, t.volumes, t.points
            given = *cells, *t.with_ghosts(self.engine, psi), u, *self.engine.period_args
            self.engine.run_each(self._kernels.compute_potential_gradient, t.n, *given)

    def relax_correction(self, summaries: Summaries, name: str, limit: float, k: float, u: cla.Array) -> None:
        """Scale `u` (n, d) by alpha = min(limit, k / max(|u| / h)), the paper's (3.5).

        The summary `name` of |u| / h must have been collected.
        """
        real = self.engine.real.type
        self.engine.run_each(
            self._kernels.relax_correction, len(u), summaries.values, summaries.slots[name], real(limit), real(k), u
        )

    def move_generators(self, domain: Domain, points: cla.Array, d: Displacement, velocity: cla.Array) -> None:
        """Move `points` (n, d) by `d` inside `domain`. `velocity` (n, d) becomes what they have moved by."""
        real = self.engine.real.type
        parts = d.lloyd, real(d.lloyd_share), d.correction, real(d.correction_share), d.unit, real(d.bound)
        self.engine.run_each(
            self._kernels.move_generators, d.unit.shape[0], *parts, *domain.device_args(self.engine), points, velocity
        )

    def leave_balls(self, domain: Domain, t: Tessellation, balls: Balls, moving: Moving) -> None:
        """Move generators out of `balls`; `t` is a diagram of nearly the same generators."""
        around = np.int32(balls.first), np.int32(balls.count), balls.starts, balls.spheres, np.int32(BALL_PASSES)
        fixed = t.fixed_args(self.engine, moving.labels, moving.fixed)
        moved = *domain.device_args(self.engine), moving.points, moving.velocity
        self.engine.run_each(self._kernels.leave_balls, t.n, *t.graph, *fixed, *around, *moved)

    def zero_fixed_displacements(self, labels: cla.Array, fixed: int, displacement: cla.Array) -> None:
        """Set `displacement` (n, d) to 0 for generators whose label is below `fixed`."""
        self.engine.run_each(self._kernels.zero_fixed_displacements, len(labels), labels, np.int32(fixed), displacement)

    def add_momentum(self, factor: float, lloyd: cla.Array, velocity: cla.Array, share: float) -> None:
        """Set `lloyd` (n, d) to ``factor * lloyd + share * velocity``."""
        real = self.engine.real.type
        self.engine.run_each(self._kernels.add_momentum, lloyd.shape[0], real(factor), velocity, real(share), lloyd)
