"""What a run does, one action after the other: steps, and changes of the number of cells between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..estimates import MOST_SURPLUS
from ..motion import Displacement, Method
from ..tuning import CLIMB_STRAIN, LEAST_PROGRESS, MAX_BALANCES, MAX_OSCILLATIONS, SAMPLING_GAIN

if TYPE_CHECKING:
    from ..run import Run


class Action(Protocol):
    """A part of a schedule."""

    def apply(self, run: Run) -> None:
        """Do it."""


@dataclass(frozen=True)
class Step:
    """Displace and move all generators, and tessellate them; then open obtuse triangles, at most `openings` times.

    With `recent`, only if the number of cells has changed in the last `recent` steps.
    """

    method: Method
    openings: int = 0
    recent: int = 0

    def apply(self, run: Run) -> None:
        """Take the step, and record it."""
        if self.recent and not count_changed(run, self.recent):
            return
        run.begun = run.steps + 1
        with run.state.engine.workspace.frame():
            displacement = self.method.step(run.state)
            run.note(displacement)
            run.state.move(displacement)
            run.state.pair_generators()
        run.state.update()
        for _ in range(self.openings):
            run.obtuse, opened = run.state.open_triangles()
            if not opened:
                break
        if run.fixed_count is not None:
            run.state.normalize_sizes()
        run.last = self.method
        run.steps += 1
        run.record()


@dataclass(frozen=True)
class CountOfMesh:
    """Correct the number of generators for the cells of the resulting mesh.

    At curved walls the cells on the device are cut by planes, while those of the mesh end at the surface. Generators
    that have no cell there, in parts thinner than a cell, are deleted. With a fixed number of cells nothing is done.
    """

    def apply(self, run: Run) -> None:
        """Make a mesh, and insert and delete."""
        mesh = run.state
        factors = mesh.sizes_over_mesh() if run.fixed_count is None else None
        if factors is None:
            return
        h = mesh.h.get()
        mesh.h.set(h * factors)
        lack, lost = round(mesh.missing_cells()), np.isinf(factors)
        mesh.h.set(h)
        if lack or lost.any():
            mesh.stages.clear_poisson()
            lack += mesh.delete_lost(lost)
            mesh.insert_delete(0, mesh.total + lack, climb=False, most=max_cells(run))


@dataclass(frozen=True)
class InsertDelete:
    """Insert and delete generators.

    `nuclei` is the share of the cells where dislocations may be nucleated, `climb_strain` the strain above which they
    climb, `least` the smallest share of missing cells for which anything is done.
    """

    nuclei: float = 0.0
    climb_strain: float = CLIMB_STRAIN
    least: float = 0.0

    def apply(self, run: Run) -> None:
        """Insert and delete."""
        mesh = run.state
        if self.least and abs(missing(run)) <= self.least * mesh.total:
            return
        # The solver cannot reuse its large buffers for other generators.
        mesh.stages.clear_poisson()
        most = math.inf if run.fixed_count is not None else max_cells(run)
        mesh.insert_delete(round(self.nuclei * mesh.total), run.fixed_count, climb_strain=self.climb_strain, most=most)


@dataclass(frozen=True)
class RepairCells:
    """Delete or split the worst cells, with 1 - Q above `deficit`; see `InsertionDeletion.repair_cells`."""

    deficit: float
    split: bool = False

    def apply(self, run: Run) -> None:
        """Delete or split them."""
        run.state.stages.clear_poisson()
        run.state.repair_cells(self.deficit, self.split)


@dataclass(frozen=True)
class Refine:
    """Refine to the next finer level."""

    def apply(self, run: Run) -> None:
        """Replace the mesh by the finer one."""
        # The finer level needs another solver and more memory.
        run.state.stages.clear_poisson()
        run.state.engine.workspace.shrink()
        finer = run.state.refine(finest=run.level == 1, begin=run.call_parts)
        # One assignment, because an interruption between two would leave a mesh that does not belong to its level.
        run.state, run.level = finer, run.level - 1


@dataclass(frozen=True)
class ResetMomentum:
    """Set the velocities to zero."""

    def apply(self, run: Run) -> None:
        """Set them."""
        run.state.velocity.fill(0)


@dataclass(frozen=True)
class CorrectCount:
    """Correct the number of cells to the fixed one.

    With `share`, correct it to within that share of the number that the size field requires; with `ahead`, to the
    number from which refinement gives that of the next level, which until then grows by this factor.
    """

    share: float = 0.0
    ahead: float = 0.0

    def apply(self, run: Run) -> None:
        """Insert or delete until the number is right, or oscillates."""
        mesh, least, before, oscillations = run.state, math.inf, 0.0, 0
        mesh.delete_squeezed()
        while self.share or run.fixed_count is not None:
            lack = missing_for_next_level(run, self.ahead) if self.ahead else missing(run)
            if abs(lack) <= self.share * mesh.total:
                break
            # At jumps of h each new cell changes the required number, so that it can oscillate without end. Changes
            # of one sign end by themselves.
            if abs(lack) < LEAST_PROGRESS * least:
                least, oscillations = abs(lack), 0
            elif lack * before < 0:
                oscillations += 1
            before = lack
            if oscillations == MAX_OSCILLATIONS:
                break
            target = mesh.total + round(lack) if self.ahead else run.fixed_count
            most = math.inf if target is not None else max_cells(run)
            inserted, deleted = mesh.insert_delete(0, target, climb=False, most=most)
            if inserted == deleted:
                break
        if run.fixed_count is not None:
            mesh.normalize_sizes()


@dataclass(frozen=True)
class BalanceCounts:
    """Insert and delete cells where parts of the domain have too few or too many; see `LocalCounts`."""

    def apply(self, run: Run) -> None:
        """Insert and delete them."""
        run.state.balance_counts()


@dataclass(frozen=True)
class BalanceRegions:
    """Insert and delete cells until each region that fixed generators cut off has its number of them."""

    def apply(self, run: Run) -> None:
        """Insert and delete them."""
        for turn in range(MAX_BALANCES if run.state.fixed else 0):
            if run.state.balance_regions(missing(run), begun=turn > 0) == (0, 0):
                break


@dataclass(frozen=True)
class Prescribe:
    """Give the cells of a power diagram their target volumes; with `move`, first move generators to the centroids.

    The volumes are h^d times the factor that makes their sum that of the domain. With fixed volumes this descends the
    transport cost, the sum of the integrals of |y - x_i|^2 (de Goes et al. 2012, ACM Trans. Graph. 31, 171).
    """

    move: bool = False

    def apply(self, run: Run) -> None:
        """Move, find the weights, and record them."""
        mesh = run.state
        if not self.move:
            mesh.stages.clear_poisson()
        run.begun = run.steps + 1
        with mesh.engine.workspace.frame():
            if self.move:
                correction = mesh.engine.scratch(mesh.points.shape)
                correction.fill(0)
                mesh.summarize_displacements(mesh.t.offsets, correction)
                displacement = Displacement(mesh.t.offsets, correction, mesh.h)
                run.final = mesh.displacements(displacement)
                mesh.move(displacement)
            run.solution = mesh.prescribe_volumes()
        run.steps += 1
        run.record()


def count_changed(run: Run, steps: int) -> bool:
    """Return whether the number of cells of this level has changed since the last `steps` steps."""
    rows = [row[0] for row in run.rows[-steps:]]
    return any(row["level"] == run.level and row["cells"] != run.state.total for row in rows)


def missing(run: Run) -> float:
    """Return the number of missing cells, by the fixed number or by the size field."""
    if run.fixed_count is not None:
        return float(run.fixed_count - run.state.total)
    return min(run.state.missing_cells(), max_cells(run) - run.state.total)


def max_cells(run: Run) -> float:
    """Return the largest number of cells of this level, if there is no fixed number.

    Sizes are evaluated at the generators. A small cell beside a jump of h covers a part of the coarse side and
    requires more cells there, which require more in turn. Where h is smooth the number is close to the integral.
    """
    factor = 2.0 ** (run.state.engine.cell_dim * run.level)
    rows = run.state.fixed - run.state.setup.first_row
    return rows + (1 + MOST_SURPLUS) * run.target / factor


def missing_for_next_level(run: Run, growth: float) -> float:
    """Return how many cells are missing so that refinement gives the number of the next finer level.

    Its number is `growth` times that by refinement now.

    The sum of V rho differs from the integral, because h is sampled at the generators; on the next level the
    difference is smaller by `SAMPLING_GAIN`. Refinement gives less than 2^d times as many cells, because cells at
    walls have fewer neighbors; their share halves with each level.
    """
    mesh = run.state
    factor = 2.0**mesh.engine.cell_dim
    # The number of cells on this level according to the integral.
    exact = run.target / factor**run.level
    bias = min((mesh.total + mesh.missing_cells()) / exact - 1, MOST_SURPLUS)
    lack = factor * mesh.total / (growth * mesh.refined_count()) - 1
    wanted = exact * (1 + SAMPLING_GAIN * bias)
    for level in range(run.level):
        wanted *= 1 + lack / 2**level
    return wanted - mesh.total
