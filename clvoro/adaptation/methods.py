"""Methods: what one step does. Each method computes the displacements of all generators, then moves them.

| method           | moves by                                                                            |
|------------------|-------------------------------------------------------------------------------------|
| `lloyd`          | centroid - generator (the paper's 2.2)                                              |
| `poisson`        | -alpha grad phi, div grad phi = e (the paper's 3.2 to 3.5)                          |
| `coupled`        | both (the paper's Figure 1)                                                         |
| `weighted-lloyd` | density-weighted centroid - generator (the paper's 2.4)                             |
| `weighted`       | the same, and -grad phi, div (rho grad phi) = rho d log(L / h), clipped to k h      |
| `mmpde`          | descent of Huang's functional on the triangulation of a lattice (the paper's 2.3.4) |
| `monge-ampere`   | the optimal transport of a lattice, det(I + grad grad phi) = const h^d              |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..opencl.device_array import buffer_of
from ..solvers.components import balance_components
from ..solvers.linear_system import Limits
from ..solvers.volume_projection import Penalty, Targets
from . import tuning
from .density import CellWeights
from .motion import Displacement, Method
from .moving.mmpde import MmpdeMethod
from .moving.monge_ampere import MongeAmpereMethod
from .state import MeshState


@dataclass(frozen=True)
class Relaxation:
    """Relaxation of the paper's (3.4) and (3.5)."""

    alpha: float | None = None
    """float or None. Largest relaxation coefficient. None means d, which cancels a small error in one step (a relative
    error e of lengths is a relative error d e of volumes)."""
    k: float = 0.5
    """Largest displacement over h."""
    tolerance: float = 1e-4
    """Relative residual of the Poisson solve."""


@dataclass(frozen=True)
class PublishedMethod(Method):
    """The paper's method: Lloyd, Poisson, or both, with one alpha for all generators."""

    relaxation: Relaxation
    lloyd: bool
    poisson: bool

    def step(self, mesh: MeshState) -> Displacement:
        """Evaluate both displacements, even if the method uses one: the history has both."""
        stages, t, r, engine = mesh.stages, mesh.t, self.relaxation, mesh.engine
        motion, poisson, lloyd = stages.motion, stages.poisson, t.offsets
        correction, source = engine.scratch(mesh.points.shape), engine.scratch(mesh.n)
        poisson.subtract_mean_source(mesh.error, t.volumes, source)
        balance_components(mesh.engine, mesh.domain, t, source, t.volumes)
        with engine.workspace.frame():
            laplacian = poisson.assemble(*t.graph, t.face_measures, t.points, tolerance=r.tolerance, part=t.part)
            solution = poisson.solve(laplacian, source, mesh.potential, tolerance=r.tolerance, ordering=mesh.labels)
        motion.compute_potential_gradient(t, mesh.potential, correction)
        mesh.summarize_displacements(lloyd, correction)
        alpha = engine.cell_dim if r.alpha is None else r.alpha
        motion.relax_correction(mesh.summaries, "correction", alpha, r.k, correction)
        mesh.summarize_displacements(lloyd, correction)
        if mesh.fixed:
            lloyd = engine.scratch(lloyd.shape)
            cl.enqueue_copy(engine.queue, buffer_of(lloyd), buffer_of(t.offsets), byte_count=lloyd.nbytes)
            mesh.zero_fixed(lloyd)
        mesh.zero_fixed(correction)
        return Displacement(lloyd, correction, mesh.h, float(self.lloyd), float(self.poisson), solution=solution)


@dataclass(frozen=True)
class WeightedMethod(Method):
    """Density-weighted centroids and the density-weighted Poisson equation, clipped per generator.

    div(rho grad phi) = rho (r - mean r), r = d log(L / h), is the linearized error of the volumes for a size field that
    is fixed in space. The Laplacian without weights neglects the gradient of h.
    """

    k: float = 0.5
    poisson: bool = True
    tolerance: float = 1e-2
    cautious: bool = False
    """Clip to k min(L, h), because cells can still be much smaller than a new, coarse target size."""
    lloyd: bool = True
    """Move to the centroids, too. Else the Poisson displacement alone corrects the sizes."""
    max_cycles: int | None = None
    """Most cycles of multigrid; see `Poisson.solve`."""

    def step(self, mesh: MeshState) -> Displacement:
        """Evaluate the weighted Lloyd displacement and the correction."""
        stages, t, engine = mesh.stages, mesh.t, mesh.engine
        motion, poisson = stages.motion, stages.poisson
        lloyd, correction = engine.scratch(mesh.points.shape), engine.scratch(mesh.points.shape)
        source = engine.scratch(mesh.n)
        # The gradient is not needed afterwards, so it shares its memory with the correction.
        w = stages.density.lloyd_weights(t, mesh.h, lloyd, correction)
        mesh.zero_fixed(lloyd)
        poisson.subtract_mean_source(w.log_ratio, w.weight, source)
        balance_components(mesh.engine, mesh.domain, t, source, w.weight)
        with engine.workspace.frame():
            laplacian = poisson.assemble(
                *t.graph,
                t.face_measures,
                t.points,
                *t.with_ghosts(engine, w.density),
                tolerance=self.tolerance,
                part=t.part,
            )
            # The labels are a new array whenever the order changes.
            solution = poisson.solve(
                laplacian,
                source,
                mesh.potential,
                tolerance=self.tolerance,
                ordering=mesh.labels,
                from_zero=True,
                max_cycles=self.max_cycles,
            )
        motion.compute_potential_gradient(t, mesh.potential, correction)
        mesh.summarize_displacements(lloyd, correction)
        mesh.zero_fixed(correction)
        unit = mesh.local_length if self.cautious else mesh.h
        return Displacement(lloyd, correction, unit, float(self.lloyd), float(self.poisson), self.k, solution)


@dataclass
class ProjectedMethod(Method):
    """Lloyd or quality descent with momentum, projected so that every cell keeps or gets its volume."""

    descent: Literal["lloyd", "quality", "edges", "surface"] = "lloyd"
    """Displacement to the weighted centroid, with which lattice defects glide and annihilate; in 2D descent of the cell
    quality, which improves cells and pins defects, and of an energy against short edges; or descent of this energy
    alone; in 3D "surface", descent of the cell quality."""
    relaxation: float = 1.0
    """Factor on the descent."""
    momentum: float = 0.7
    """Share of the previous displacement that is added to the present one."""
    penalty: float = 0.1
    """Penalty eps of the projection: the smaller, the more accurate the sizes."""
    quality_scale: float = 0.0
    log_ratio_scale: float = 0.0
    power: int = 2
    """`quality_scale`, `log_ratio_scale`, `power`: float, float, int. Scales and power of the penalty; see
    `Penalty`."""
    scale_per_error: float = 0.0
    """The scale of log(L / h) is the larger one of `log_ratio_scale` and of this times the mean |log(L / h)|, less 3
    `log_ratio_scale`. A small scale forces sizes on cells that cannot have them, as in thin parts, and spoils the
    shapes beside them."""
    iterations: int = 30
    tolerance: float = 1e-2
    """`iterations`, `tolerance`: int, float. Limits of each projection. Each one starts from the last solution, and
    leaves a residual to the next step."""
    k: float = 0.4
    """Largest displacement over h."""
    bad_cell_weight: float = 20.0
    rate: float = 0.1
    """`bad_cell_weight`, `rate`: weight of bad cells in the quality descent, and its step length; see `QualityDescent`
    and `SurfaceDescent`."""
    error_target: float = 0.0
    """Mean |log(L / h)| to which the penalty is controlled after three steps; 0 keeps the penalty."""
    gradient_from_field: bool = False
    """Take grad log h from the field, by differences over a fifth of a cell, not from h at the neighbors. At kinks of h
    the fit to the neighbors can prevent the exact projection from converging."""
    correct_mean: bool = False
    """Also correct the mean log ratio by moving generators to where h is larger or smaller. For small means only: a
    wrong number of generators is corrected by insertion and deletion."""
    calm_relaxation: float = 1.3
    """Largest factor at thin walls."""
    careful: bool = False
    """Where walls shape cells, keep the penalty above `EXACT_PENALTY_PER_ERROR` times what the mean |log(L / h)| is
    beyond `MET_ERROR`: sizes that no mesh has spoil the shapes."""
    steps: int = 0
    """Steps done."""

    def step(self, mesh: MeshState) -> Displacement:
        """Evaluate the descent, with momentum, and its projection."""
        stages, t, engine = mesh.stages, mesh.t, mesh.engine
        relaxation, momentum, bad_cell_weight = self.relaxation, self.momentum, self.bad_cell_weight
        if mesh.has_thin_walls:
            relaxation, momentum = (min(relaxation, self.calm_relaxation), min(momentum, tuning.CALM_MOMENTUM))
            bad_cell_weight = min(bad_cell_weight, tuning.CALM_BAD_CELL_WEIGHT)
        lloyd, correction = engine.scratch(mesh.points.shape), engine.scratch(mesh.points.shape)
        gradient, log_ratio = engine.scratch(mesh.points.shape), engine.scratch(mesh.n)
        with engine.workspace.frame():
            still = relaxation == momentum == 0
            if self.gradient_from_field and (still or self.descent in ("quality", "edges")):
                # Weighted centroids are not needed, either.
                w: CellWeights = stages.density.cell_weights(t, mesh.h, log_ratio)
            else:
                w = stages.density.lloyd_weights(t, mesh.h, lloyd, gradient, log_ratio)
            mesh.follows_log_ratio = max(self.error_target, self.scale_per_error, self.careful) > 0
            if self.error_target and self.steps > 2:
                self._control_penalty(mesh.mean_log_ratio_error(w))
            self.steps += 1
            penalty = self._penalty_for(mesh, w)
            if self.gradient_from_field:
                sizes = engine.scratch(mesh.n)
                mesh.sizing.evaluate_with_gradient(mesh.points, mesh.n, sizes, gradient)
            self._descend(mesh, lloyd, bad_cell_weight)
            if still:
                lloyd.fill(0)
            else:
                stages.motion.add_momentum(relaxation, lloyd, mesh.velocity, momentum)
            mesh.zero_fixed(lloyd)
            sums = None if self.correct_mean else stages.density.sum_log_ratio(w)
        warm = mesh.multipliers is not None
        if not warm:
            mesh.multipliers = engine.zeros(mesh.n, np.float32)
        solution = stages.volume_projection.project(
            t,
            Targets(mesh.local_length, gradient, log_ratio, mesh.quality, sums),
            lloyd,
            correction,
            penalty,
            Limits(self.tolerance, self.iterations),
            labels=mesh.labels,
            fixed=mesh.fixed,
            start=mesh.multipliers,
            warm=warm,
        )
        mesh.summarize_displacements(lloyd, correction)
        return Displacement(lloyd, correction, mesh.local_length, bound=self.k, solution=solution)

    def _penalty_for(self, mesh: MeshState, w: CellWeights) -> Penalty:
        """Return the penalty for the present errors of the sizes."""
        penalty, scale = self.penalty, self.log_ratio_scale
        if self.careful and mesh.domain.shapes_cells:
            beyond = mesh.mean_log_ratio_error(w) - tuning.MET_ERROR
            penalty = max(penalty, tuning.EXACT_PENALTY_PER_ERROR * beyond)
        if self.scale_per_error:
            scale = max(scale, self.scale_per_error * mesh.mean_log_ratio_error(w) - 3 * scale)
        at_walls, most = (
            (tuning.AT_WALLS, tuning.MOST_AT_WALLS) if mesh.domain.cuts_cells else (tuning.AT_WALLS_OF_BOXES, math.inf)
        )
        return Penalty(penalty, self.quality_scale, scale, at_walls, self.power, most)

    def _descend(self, mesh: MeshState, lloyd: cla.Array, bad_cell_weight: float) -> None:
        """Write the descent of the cells' quality or of short edges to `lloyd`, if it is not Lloyd's."""
        stages, t, cells = mesh.stages, mesh.t, (mesh.local_length, mesh.quality)
        if self.descent == "surface" and t.vertices:
            stages.surface_descent.descend(t, *cells, lloyd, bad_cell_weight=self.bad_cell_weight, rate=self.rate)
        elif self.descent in ("quality", "edges"):
            weights = {"quality_weight": float(self.descent == "quality"), "bad_cell_weight": bad_cell_weight}
            stages.quality_descent.descend(t, *cells, lloyd, **weights, rate=self.rate)

    def _control_penalty(self, error: float) -> None:
        """Change the penalty towards the one that gives the error target."""
        change = self.error_target / max(error, 1e-9)  # the error may be 0
        largest = max(3.0, tuning.PENALTY_PER_ERROR * self.error_target)
        least = min(1e-3, self.error_target)
        self.penalty = min(largest, max(least, self.penalty * min(1.33, max(0.75, change))))


PUBLISHED = ("lloyd", "poisson", "coupled", "weighted-lloyd", "weighted")
"""Methods that repeat one kind of step. `clvoro.adaptation.plan.schedule` has those of several kinds."""
MOVING = ("mmpde", "monge-ampere")
"""Methods that repeat one kind of step and map a lattice: they start from it, in a box with walls."""


def make_method(
    name: str, relaxation: Relaxation, lattice: np.ndarray | None = None, tolerance: float = 1e-3
) -> Method:
    """Return the method called `name`, one of `PUBLISHED` or `MOVING`; these need the `lattice` (n, d) at the start."""
    if name in MOVING:
        assert lattice is not None
        kind = MmpdeMethod if name == "mmpde" else MongeAmpereMethod
        return kind(lattice, tolerance)
    if name.startswith("weighted"):
        return WeightedMethod(k=relaxation.k, poisson=name == "weighted")
    return PublishedMethod(relaxation, lloyd=name != "poisson", poisson=name != "lloyd")
