"""What one step does: each method computes the displacements of all generators, then moves them.

| method           | moves by                                                                            |
|------------------|-------------------------------------------------------------------------------------|
| `lloyd`          | centroid - generator (the paper's 2.2)                                              |
| `poisson`        | -alpha grad phi, div grad phi = e (the paper's 3.2 to 3.5)                          |
| `coupled`        | both (the paper's Figure 1)                                                         |
| `weighted-lloyd` | density-weighted centroid - generator (the paper's 2.4)                             |
| `weighted`       | the same, and -grad phi, div (rho grad phi) = rho d log(L / h), each clipped to k h |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..solvers.components import balance_components
from ..solvers.conjugate_gradient import Limits, Solution
from ..solvers.volume_projection import Penalty, Targets
from .state import Mesh


class Method(Protocol):
    """A way to move generators."""

    def displace(self, mesh: Mesh) -> Solution | None:
        """Compute `mesh.lloyd` and `mesh.correction` (and their lengths over h) where the mesh is now.

        They are valid to the end of the workspace's frame.
        """
        ...

    def move(self, mesh: Mesh) -> None:
        """Move the generators by what `displace` found; the diagram is then out of date."""
        ...


@dataclass(frozen=True)
class Relaxation:
    """The paper's (3.4) and (3.5): alpha limits the step, k the displacement over h of the fastest generator.

    Attributes
    ----------
    alpha : float or None
        Largest alpha; None for d, the step that cancels a small error at once
        (a relative error e of lengths is a relative error d e of volumes).
    k : float
    tolerance : float
        Relative residual of the Poisson solve. The potential need not be better than the step that follows it.
    """

    alpha: float | None = None
    k: float = 0.5
    tolerance: float = 1e-4


@dataclass(frozen=True)
class PublishedMethod:
    """The paper's method as published: Lloyd, Poisson, or both, with one alpha for all generators."""

    relaxation: Relaxation
    lloyd: bool
    poisson: bool

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate both displacements, also one that the method does not use: reports show both."""
        stages, t, r = mesh.stages, mesh.t, self.relaxation
        motion, poisson = stages.motion, stages.poisson
        mesh.begin_step()
        mesh.lloyd = t.offsets
        mesh.take_source()
        poisson.subtract_mean_source(mesh.error, t.volumes, mesh.source)
        balance_components(mesh.domain, t, mesh.source, t.volumes)
        with mesh.engine.workspace.frame():
            laplacian = poisson.assemble(
                t.starts, t.neighbors, t.face_measures, mesh.points, tolerance=r.tolerance
            )
            solution = poisson.solve(
                laplacian, mesh.source, mesh.potential, tolerance=r.tolerance, ordering=mesh.labels
            )
        motion.follow_potential(t, mesh.potential, mesh.correction)
        mesh.measure_speeds()
        mesh.hold(mesh.correction)
        mesh.summaries.collect("correction", mesh.correction_speed, mesh.n)
        alpha = mesh.engine.dim if r.alpha is None else r.alpha
        motion.relax_globally(
            mesh.summaries, "correction", alpha, r.k, mesh.correction, mesh.correction_speed
        )
        mesh.note_speeds()
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply the displacements that the method uses."""
        mesh.hold(mesh.lloyd)
        mesh.stages.motion.move_generators(
            mesh.free, mesh.points, mesh.lloyd, float(self.lloyd), mesh.correction,
            float(self.poisson), mesh.h, mesh.velocity,
        )  # fmt: skip


@dataclass(frozen=True)
class WeightedMethod:
    """Density-weighted centroids and the density-weighted Poisson equation, each generator clipped on its own.

    div(rho grad phi) = rho (r - mean r), r = d log(L / h), is the linearization of the volumes' error for a target
    that is fixed in space; the plain Laplacian drops the gradient of h.
    """

    k: float = 0.5
    poisson: bool = True
    tolerance: float = 1e-2
    cautious: bool = False
    """Clip to k min(L, h): where a coarse target has only just come upon small cells, h is too far to go."""

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate the weighted Lloyd displacement and the correction."""
        stages, t = mesh.stages, mesh.t
        motion, poisson = stages.motion, stages.poisson
        mesh.begin_step()
        mesh.take_source()
        # Nobody asks for the gradient afterwards.
        w = mesh.weigh(gradient=mesh.correction)
        mesh.hold(mesh.lloyd)
        poisson.subtract_mean_source(w.excess, w.weight, mesh.source)
        balance_components(mesh.domain, t, mesh.source, w.weight)
        with mesh.engine.workspace.frame():
            laplacian = poisson.assemble(
                t.starts, t.neighbors, t.face_measures, mesh.points, w.density,
                tolerance=self.tolerance,
            )  # fmt: skip
            # Generators get new labels, in an array of their own, whenever their order changes.
            solution = poisson.solve(
                laplacian, mesh.source, mesh.potential, tolerance=self.tolerance,
                ordering=mesh.labels, from_zero=True,
            )  # fmt: skip
        motion.follow_potential(t, mesh.potential, mesh.correction)
        mesh.measure_speeds()
        mesh.hold(mesh.correction)
        mesh.note_speeds()
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply both, at most k h."""
        mesh.stages.motion.move_generators(
            mesh.free, mesh.points, mesh.lloyd, 1.0, mesh.correction, float(self.poisson),
            mesh.reach if self.cautious else mesh.h, mesh.velocity, clip=self.k,
        )  # fmt: skip


@dataclass
class ProjectedMethod:
    """Lloyd or shape descent with momentum, projected so that every cell keeps or takes its size.

    Attributes
    ----------
    descent : "lloyd" or "shape"
        Weighted centroids, while defects are still to move (they glide and annihilate), or the gradient of quality
        itself, which polishes but pins them.
    relaxation : float
        Factor on the descent.
    momentum : float
        Share of the last displacement that is added.
    eps : float
        Penalty of the projection: the smaller, the more exact the sizes.
    lenience, bound : float
        Bad cells are let off, cells far off are not; see `Projection`.
    iterations, tolerance : int, float
        Of CG in each projection, at most, and its relative residual: the next step sees what is left. Each begins
        with the last one's solution, which is near where steps have become alike.
    k : float
        Bound of the displacement over h.
    emphasis, rate : float
        Weight of bad cells in the shape descent, and its step; see `Shape`.
    aim : float
        Mean |log(L / h)| that `eps` is steered to, after the first three steps; 0 leaves it.
    keep_mean : bool
        Also correct the mean of the excess, by moving generators to where h is larger or smaller. Only for a mean
        that is small: the count is what should correct it.
    sampled_gradient : bool
        Take grad log h from the field itself, by differences over a fifth of a cell, not from the neighbors' h: at a
        kink of h the neighbors' fit can keep the exact projection from converging.
    """

    descent: str = "lloyd"
    relaxation: float = 1.0
    momentum: float = 0.7
    eps: float = 0.1
    lenience: float = 0.0
    bound: float = 0.0
    iterations: int = 30
    tolerance: float = 1e-2
    k: float = 0.4
    emphasis: float = 20.0
    rate: float = 0.1
    aim: float = 0.0
    sampled_gradient: bool = False
    keep_mean: bool = False
    steps: int = 0

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate the descent, with momentum, and its projection."""
        stages, t = mesh.stages, mesh.t
        mesh.begin_step()
        gradient, excess = mesh.engine.scratch(mesh.points.shape), mesh.engine.scratch(mesh.n)
        with mesh.engine.workspace.frame():
            w = mesh.weigh(gradient, excess)
            if self.aim and self.steps > 2:
                off = mesh.mean_log_error(w)
                change = self.aim / max(off, 1e-9)  # every cell may be exactly right
                self.eps = min(3.0, max(1e-3, self.eps * min(1.33, max(0.75, change))))
            self.steps += 1
            if self.sampled_gradient:
                sizes = mesh.engine.scratch(mesh.n)
                mesh.sizing.evaluate_with_gradient(mesh.points, mesh.n, sizes, gradient)
            if self.descent == "shape":
                stages.shape.descend(
                    t, mesh.reach, mesh.quality, mesh.lloyd, emphasis=self.emphasis, rate=self.rate
                )
            stages.motion.add_momentum(self.relaxation, mesh.lloyd, mesh.velocity, self.momentum)
            mesh.hold(mesh.lloyd)
            if not self.keep_mean:
                stages.density.remove_mean(w)
        warm = mesh.multipliers is not None
        if mesh.multipliers is None:
            mesh.multipliers = mesh.engine.zeros(mesh.n, np.float32)
        solution = stages.projection.project(
            t, Targets(mesh.reach, gradient, excess, mesh.quality), mesh.lloyd, mesh.correction,
            Penalty(self.eps, self.lenience, self.bound), Limits(self.tolerance, self.iterations),
            labels=mesh.labels, fixed=mesh.fixed, start=mesh.multipliers, warm=warm,
        )  # fmt: skip
        mesh.measure_speeds()
        mesh.note_speeds()
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply both, at most k h."""
        mesh.stages.motion.move_generators(
            mesh.free, mesh.points, mesh.lloyd, 1.0, mesh.correction, 1.0, mesh.reach,
            mesh.velocity, clip=self.k,
        )  # fmt: skip


PUBLISHED = ("lloyd", "poisson", "coupled", "weighted-lloyd", "weighted")
"""Methods that repeat one kind of step; see `clvoro.adaptation.schedule` for those that take several."""


def make_method(name: str, relaxation: Relaxation) -> Method:
    """Return the method called `name`, one of `PUBLISHED`."""
    if name.startswith("weighted"):
        return WeightedMethod(k=relaxation.k, poisson=name == "weighted")
    return PublishedMethod(relaxation, lloyd=name != "poisson", poisson=name != "lloyd")
