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

from .krylov import Solution
from .mesh import Mesh


class Method(Protocol):
    """A way to move generators."""

    def displace(self, mesh: Mesh) -> Solution | None:
        """Compute `mesh.lloyd` and `mesh.correction` (and their lengths over h) where the mesh is now."""
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
        mesh.lloyd = t.offsets
        motion.measure_displacement(mesh.lloyd, mesh.h, mesh.lloyd_speed)
        laplacian = poisson.assemble(t.starts, t.neighbours, t.face_measures, mesh.points)
        poisson.compatible(mesh.error, t.volumes, mesh.source)
        solution = poisson.solve(laplacian, mesh.source, mesh.potential, tolerance=r.tolerance)
        motion.follow_potential(t, mesh.potential, mesh.h, mesh.correction, mesh.correction_speed)
        mesh.summaries.collect("correction", mesh.correction_speed, mesh.n)
        alpha = mesh.engine.dim if r.alpha is None else r.alpha
        motion.relax_globally(
            mesh.summaries, "correction", alpha, r.k, mesh.correction, mesh.correction_speed
        )
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply the displacements that the method uses."""
        mesh.stages.motion.move_generators(
            mesh.domain, mesh.points, mesh.lloyd, float(self.lloyd), mesh.correction,
            float(self.poisson), mesh.h, mesh.velocity,
        )  # fmt: skip


@dataclass(frozen=True)
class WeightedMethod:
    """Density-weighted centroids and the density-weighted Poisson equation, each generator clipped on its own.

    div(rho grad phi) = rho (r - mean r), r = d log(L / h), is the linearisation of the volumes' error for a target
    that is fixed in space; the plain Laplacian drops the gradient of h.
    """

    k: float = 0.5
    poisson: bool = True
    tolerance: float = 1e-2

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate the weighted Lloyd displacement and the correction."""
        stages, t = mesh.stages, mesh.t
        motion, poisson = stages.motion, stages.poisson
        w = stages.density.evaluate(t, mesh.h)
        mesh.lloyd = w.lloyd
        motion.measure_displacement(mesh.lloyd, mesh.h, mesh.lloyd_speed)
        laplacian = poisson.assemble(
            t.starts, t.neighbours, t.face_measures, mesh.points, w.density
        )
        poisson.compatible(w.excess, w.weight, mesh.source)
        mesh.potential.fill(0)
        solution = poisson.solve(laplacian, mesh.source, mesh.potential, tolerance=self.tolerance)
        motion.follow_potential(t, mesh.potential, mesh.h, mesh.correction, mesh.correction_speed)
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply both, at most k h."""
        mesh.stages.motion.move_generators(
            mesh.domain, mesh.points, mesh.lloyd, 1.0, mesh.correction, float(self.poisson), mesh.h,
            mesh.velocity, clip=self.k,
        )  # fmt: skip


@dataclass(frozen=True)
class ProjectedMethod:
    """Lloyd or shape descent with momentum, projected so that every cell keeps or takes its size.

    Attributes
    ----------
    descent : "lloyd" or "shape"
        Weighted centroids, while generators are still to find their neighbours, or the gradient of quality itself.
    momentum : float
        Share of the last displacement that is added.
    eps : float
        Penalty of the projection: the smaller, the more exact the sizes.
    mean : bool
        Take the mean of the excess away first, if the count is not to be corrected by strain.
    """

    descent: str = "lloyd"
    momentum: float = 0.6
    eps: float = 0.1
    iterations: int = 30
    k: float = 0.4
    emphasis: float = 5.0

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate the descent, with momentum, and its projection."""
        stages, t = mesh.stages, mesh.t
        w = stages.density.evaluate(t, mesh.h)
        mesh.lloyd = w.lloyd
        if self.descent == "shape":
            stages.shape.descend(t, mesh.h, mesh.quality, mesh.lloyd, emphasis=self.emphasis)
        stages.motion.add_momentum(mesh.velocity, self.momentum, mesh.lloyd)
        stages.motion.measure_displacement(mesh.lloyd, mesh.h, mesh.lloyd_speed)
        stages.density.remove_mean(w)
        solution = stages.projection.project(
            t, mesh.h, w.gradient, w.excess, mesh.lloyd, mesh.correction, eps=self.eps,
            max_iterations=self.iterations,
        )  # fmt: skip
        stages.motion.measure_displacement(mesh.correction, mesh.h, mesh.correction_speed)
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply both, at most k h."""
        mesh.stages.motion.move_generators(
            mesh.domain, mesh.points, mesh.lloyd, 1.0, mesh.correction, 1.0, mesh.h, mesh.velocity,
            clip=self.k,
        )  # fmt: skip


METHODS = ("lloyd", "poisson", "coupled", "weighted-lloyd", "weighted")


def make_method(name: str, relaxation: Relaxation) -> Method:
    """Return the method called `name`."""
    if name.startswith("weighted"):
        return WeightedMethod(k=relaxation.k, poisson=name == "weighted")
    return PublishedMethod(relaxation, lloyd=name != "poisson", poisson=name != "lloyd")
