"""What one step does: each method computes the displacements of all generators, then moves them.

| method      | moves by                                                                       |
|-------------|--------------------------------------------------------------------------------|
| `lloyd`     | centroid - generator (the paper's 2.2)                                         |
| `poisson`   | -alpha grad phi, div grad phi = e (the paper's 3.2 to 3.5)                     |
| `coupled`   | both (the paper's Figure 1)                                                    |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from ._program import Engine
from .krylov import Solution
from .mesh import Mesh
from .motion import Motion
from .poisson import Poisson


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


class PublishedMethod:
    """The paper's method as published: Lloyd, Poisson, or both, with one alpha for all generators."""

    def __init__(self, engine: Engine, relaxation: Relaxation, *, lloyd: bool, poisson: bool) -> None:
        self.relaxation, self.use_lloyd, self.use_poisson = relaxation, lloyd, poisson
        self.motion, self.poisson = Motion(engine), Poisson(engine)

    def displace(self, mesh: Mesh) -> Solution:
        """Evaluate both displacements, also one that the method does not use: reports show both."""
        motion, t, r = self.motion, mesh.t, self.relaxation
        motion.measure_displacement(mesh.lloyd, mesh.h, mesh.lloyd_speed)
        laplacian = self.poisson.assemble(
            t.starts, t.neighbours, t.face_measures, mesh.points
        )
        self.poisson.compatible(mesh.error, t.volumes, mesh.source)
        solution = self.poisson.solve(
            laplacian, mesh.source, mesh.potential, tolerance=r.tolerance
        )
        motion.follow_potential(t, mesh.potential, mesh.h, mesh.correction, mesh.correction_speed)
        mesh.summaries.collect("correction", mesh.correction_speed, mesh.n)
        alpha = mesh.engine.dim if r.alpha is None else r.alpha
        motion.relax_globally(
            mesh.summaries, "correction", alpha, r.k, mesh.correction, mesh.correction_speed
        )
        return solution

    def move(self, mesh: Mesh) -> None:
        """Apply the displacements that the method uses."""
        self.motion.move_generators(
            mesh.domain, mesh.points, mesh.lloyd, float(self.use_lloyd), mesh.correction,
            float(self.use_poisson), mesh.h,
        )  # fmt: skip


METHODS = {
    "lloyd": {"lloyd": True, "poisson": False},
    "poisson": {"lloyd": False, "poisson": True},
    "coupled": {"lloyd": True, "poisson": True},
}


def make_method(name: str, engine: Engine, relaxation: Relaxation) -> Method:
    """Return the method called `name`."""
    return PublishedMethod(engine, relaxation, **METHODS[name])
