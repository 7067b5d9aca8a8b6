"""What a run does, one action after the other: steps, and changes of the number of cells between them."""

from __future__ import annotations

from dataclasses import dataclass

from ..insertion_deletion import CLIMB_STRAIN
from ..methods import Method


@dataclass(frozen=True)
class Step:
    """Displace and move all generators, and tessellate them; then open obtuse triangles, at most `openings` times.

    With `recent`, only if the number of cells has changed since so many steps.
    """

    method: Method
    openings: int = 0
    recent: int = 0


@dataclass(frozen=True)
class InsertDelete:
    """Insert and delete generators.

    `nuclei` is the share of the cells where dislocations may be nucleated, `climb_strain` the strain above which they
    climb, `least` the smallest share of missing cells for which anything is done.
    """

    nuclei: float = 0.0
    climb_strain: float = CLIMB_STRAIN
    least: float = 0.0


@dataclass(frozen=True)
class RepairCells:
    """Delete or split the worst cells, with 1 - Q above `deficit`; see `InsertionDeletion.repair_cells`."""

    deficit: float
    split: bool = False


@dataclass(frozen=True)
class Refine:
    """Refine to the next finer level."""


@dataclass(frozen=True)
class ResetMomentum:
    """Set the velocities to zero."""


@dataclass(frozen=True)
class CorrectCount:
    """Correct the number of cells to the fixed one.

    With `share`, correct it to within that share of the number that the size field requires; with `ahead`, to the
    number from which refinement gives that of the next level, which until then grows by this factor.
    """

    share: float = 0.0
    ahead: float = 0.0


@dataclass(frozen=True)
class BalanceCounts:
    """Insert and delete cells where parts of the domain have too few or too many; see `LocalCounts`."""


@dataclass(frozen=True)
class Prescribe:
    """Give the cells their target volumes in a power diagram, again after each of `moves` moves to the centroids."""

    moves: int = 0


Action = Step | InsertDelete | RepairCells | Refine | CorrectCount | BalanceCounts | ResetMomentum | Prescribe
