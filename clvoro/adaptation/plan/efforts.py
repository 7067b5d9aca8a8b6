"""Efforts: the amount of work of a run, and the quality of meshes that have had it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..tuning import DEFICIT_3D, NEAR_COUNT, NEAR_ERROR, SINGLE_LEVEL_ERROR_TARGET, STEEP, STEEPEST, WALL_DEFICIT
from .actions import RepairCells


@dataclass(frozen=True)
class LoosePolish:
    """The last steps if the error target is large: more of them, since the penalty has to grow to meet the target."""

    above: float
    """Error target above which these steps are taken."""
    steps: int
    momentum: float


@dataclass(frozen=True)
class Effort:
    """Amount of work of a run.

    - `start`, `couple`, `couple_finest`: coupled steps on the coarsest level, on the levels between, and on the finest.
    - `sweeps`: sweeps (insert/delete, then glide) on the finest level, on the next coarser one, and so on. The last
      number holds for all coarser levels.
    - `alone`: sweeps if there are no coarser levels; in 3D, steps of gliding before the last ones.
    - `start_alone`: the most of the steps `start` if there are no coarser levels, in 2D.
    - `glide`: steps of a sweep.
    - `polish`: steps of polishing.
    - `error_target`: mean |log(L / h)| that polishing aims at.
    - `steep_error_target`: the same where sizes are steepest (see `choose_error_target`), in 2D. The mean |e| is then
      at most 0.015.
    - `relaxation`, `momentum`: parameters of gliding. A heavy ball with momentum m is stable up to a relaxation of 2 (1
      + m), as a perfect lattice relaxes by at most the whole displacement per step of Lloyd's.
    - `calm_relaxation`: relaxation of gliding at thin walls; see `CALM_MOMENTUM`.
    - `polish_momentum`: momentum of polishing.
    - `penalty`: initial penalty of polishing.
    - `nuclei`: share of the cells where dislocations may be nucleated, in every third sweep.
    - `first`: largest number of sweeps on the coarsest of several levels.
    - `bad_cell_weight`, `quality_scale`, `log_ratio_scale`: parameters of polishing: see `ProjectedMethod`. The last
      one is relative to the error target.
    - `loose_bad_cells`: largest factor on the weight of bad cells with an error target above the effort's own; up to it
      the factor is the ratio of the two.
    - `largest_log_ratio_scale`: largest scale of log(L / h) in the penalty, with an error target above the effort's
      own. It bounds the largest error. The power is 4 then. On the way there the scale grows like the power 1.5 of the
      target.
    - `repairs` tuple of (int, RepairCells): repairs of the worst cells, each before this step of polishing. Some steps
      follow the last one.
    - `deficit`: 1 - mean Q of meshes of this effort in 2D, without walls.
    - `coarse_glide`, `coarse_polish`: in 3D, steps of gliding and of polishing at the end of each coarser level.
    - `recouple`: in 3D, coupled steps after each correction of the number of cells on a coarser level.
    - `loose`: in 2D.
    - `separate`: steps of separating, in 2D.
    """

    start: int
    couple: int
    couple_finest: int
    sweeps: tuple[int, ...]
    glide: int
    polish: int
    error_target: float
    steep_error_target: float = 0.0
    relaxation: float = 1.3
    momentum: float = 0.7
    calm_relaxation: float = 1.3
    polish_momentum: float = 0.7
    penalty: float = 0.3
    nuclei: float = 0.0
    first: int = 99
    alone: int = 0
    start_alone: int = 99
    bad_cell_weight: float = 20.0
    quality_scale: float = 0.03
    log_ratio_scale: float = 12.0
    loose_bad_cells: float = 2.0
    largest_log_ratio_scale: float = 0.28
    repairs: tuple[tuple[int, RepairCells], ...] = ()
    deficit: float = 0.012
    coarse_glide: int = 0
    coarse_polish: int = 0
    recouple: int = 0
    separate: int = 2
    loose: LoosePolish | None = None


EFFORTS = {
    "fast": Effort(
        8,
        2,
        3,
        (0, 1, 4, 8),
        alone=8,
        glide=6,
        first=4,
        polish=5,
        error_target=0.0035,
        steep_error_target=0.007,
        relaxation=3.0,
        calm_relaxation=1.0,
        loose_bad_cells=1.0,
        largest_log_ratio_scale=0.25,
        deficit=0.022,
        separate=1,
        loose=LoosePolish(0.01, 15, 0.8),
    ),
    "default": Effort(
        30,
        5,
        3,
        (4, 20, 6, 3),
        alone=12,
        start_alone=12,
        glide=7,
        polish=21,
        error_target=0.0025,
        steep_error_target=0.0155,
        relaxation=3.2,
        momentum=0.8,
        bad_cell_weight=40.0,
        quality_scale=0.02,
        log_ratio_scale=11.0,
        repairs=((5, RepairCells(0.06)), (9, RepairCells(0.06)), (13, RepairCells(0.07))),
        loose=LoosePolish(0.02, 40, 0.9),
    ),
    "best": Effort(
        60,
        5,
        10,
        (26, 16, 16, 16),
        alone=26,
        glide=6,
        polish=60,
        error_target=0.0039,
        steep_error_target=0.01,
        relaxation=3.2,
        momentum=0.85,
        polish_momentum=0.8,
        penalty=0.7,
        nuclei=0.0015,
        bad_cell_weight=120.0,
        quality_scale=0.02,
        log_ratio_scale=24.0,
        repairs=((12, RepairCells(0.035)), (24, RepairCells(0.035, split=True)), (36, RepairCells(0.035))),
        deficit=0.006,
    ),
}

EFFORTS_3D = {
    "fast": Effort(
        12,
        2,
        3,
        (),
        glide=0,
        polish=4,
        error_target=0.004,
        relaxation=1.5,
        momentum=0.8,
        penalty=0.15,
        log_ratio_scale=8.0,
        alone=5,
        coarse_glide=5,
        coarse_polish=10,
        recouple=1,
    ),
    "default": Effort(
        16,
        3,
        2,
        (),
        glide=0,
        polish=8,
        error_target=0.0025,
        relaxation=2.5,
        momentum=0.9,
        penalty=0.15,
        log_ratio_scale=8.0,
        alone=16,
        coarse_glide=12,
        coarse_polish=8,
        recouple=1,
    ),
    "best": Effort(
        80,
        8,
        3,
        (),
        glide=85,
        polish=10,
        error_target=0.003,
        relaxation=1.5,
        momentum=0.9,
        penalty=0.3,
        log_ratio_scale=8.0,
        alone=100,
        coarse_glide=100,
        coarse_polish=40,
        recouple=4,
    ),
}
"""The same in 3D. On a coarser level `couple` steps come before the first correction of the number of cells, and
`recouple` after each of two. On the finest level there are `couple_finest`, and as many again after a correction."""
EFFORTS_OF = {2: EFFORTS, 3: EFFORTS_3D}
"""By the dimension of cells."""


def is_near(dim: int, effort: str, n: int, missing: float, mean_error: float, mean_quality: float) -> bool:
    """Return whether a given mesh of `n` cells only needs a correction to reach the quality of `effort`.

    - `missing`: number of missing cells; negative if there are too many.
    - `mean_error`: mean of |e|.
    - `mean_quality`: mean of Q.
    """
    deficit = {2: EFFORTS[effort].deficit + WALL_DEFICIT / math.sqrt(n), 3: DEFICIT_3D}[dim]
    return mean_error <= NEAR_ERROR and abs(missing) <= NEAR_COUNT * n and 1 - mean_quality <= deficit


def steep_share(slopes: np.ndarray, cells: np.ndarray) -> float:
    """Return the share of the cells where sizes are steep: 0 up to a slope of `STEEP`, 1 from `STEEPEST` on.

    - `slopes`, `cells` (m,) float: |grad h| and the number of cells in each part of the domain.
    """
    steepness = np.clip((slopes - STEEP) / (STEEPEST - STEEP), 0, 1)
    return float(steepness @ cells / cells.sum())


def choose_error_target(dim: int, effort: str, levels: int, near: bool = False, steep: float = 0.0) -> float:
    """Return the error target of a run for which the caller has given none.

    - `levels`: number of coarser levels.
    - `near`: the run only corrects a given mesh (see `is_near`).
    - `steep`: share of the cells where sizes are steep.
    """
    if dim == 3:
        return EFFORTS_3D[effort].error_target
    smooth, loose = EFFORTS[effort].error_target, EFFORTS[effort].steep_error_target
    if levels == 0 and not near:
        smooth = min(smooth, SINGLE_LEVEL_ERROR_TARGET)
    return smooth + steep * (loose - smooth)
