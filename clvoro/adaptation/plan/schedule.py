"""Schedules: the order of the steps of a run, from the coarsest level to the finest.

    density start ─► couple ─► [ insert/delete ─► glide ] x sweeps
        (─► balance counts) ─► refine ─► couple ─► [...] ...
        (─► balance counts) ─► correct count ─► polish ─► separate (or project)

*couple*         weighted Lloyd and Poisson: from any start to approximately the target sizes
*insert/delete*  dislocations climb, and the number of cells follows the field
*glide*          weighted Lloyd with momentum and a soft projection: lattice defects move and annihilate
*balance counts* in polygons: cells are inserted and deleted where parts of the domain have too few or too many
*correct count*  to a fixed number of cells, if there is one
*polish*         projected descent of the cell quality and of short edges; the penalty is controlled to reach the error
                 target; some of the worst cells are deleted or split
*separate*       short edges are pushed apart, without descent of the quality
*project*        the same as polish with a small penalty; in boxes then a Poisson correction; then Newton's steps with a
                 smaller penalty: all cells get their target size
*prescribe*      after *project* in the method "transport": weights give the cells of a power diagram their volumes

In 3D there is no lattice with dislocations. Each level glides, then polishes:

    density start ─► [ couple ─► correct count ahead ] x 2 ─► couple ─► glide ─► polish ─► correct count ahead
        ─► refine ─► ...
        ─► balance regions ─► couple ─► correct count ─► balance regions (─► couple) ─► glide ─► polish (─► project)

*correct count ahead*  to the number from which refinement gives that of the next level, where it seldom has to change
*balance regions*      each region that fixed generators cut off gets its number of cells

Where at least half of the cells have the same size, generators of a body-centered cubic lattice are there at the start,
and random ones elsewhere, on the finest level:

    lattice ─► correct count ─► balance regions ─► glide ─► couple ─► correct count ─► balance regions ─► couple
        ─► correct count ─► polish (─► project)

Where the number of given points is far from that of the sizes, points of a density start replace them, and the run
begins on the finest level.

From a mesh that is close to its size field, for instance after the field has moved by a few cells:

    stride ─► correct count ─► stride ─► correct ─► correct count ─► polish (─► project)

*stride*   weighted Lloyd and Poisson, by up to two cells at once, because the potential's displacement is smooth
*correct*  one step of the projection alone
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

from .. import tuning
from ..methods import ProjectedMethod, WeightedMethod
from ..motion import Method
from .actions import (
    Action,
    BalanceCounts,
    BalanceRegions,
    CorrectCount,
    CountOfMesh,
    InsertDelete,
    Refine,
    RepairCells,
    ResetMomentum,
    Step,
)
from .efforts import EFFORTS_OF, Effort, choose_error_target

Begins = Literal["random", "lattice", "mesh", "partly random", "near"]
"""What a run begins with: random points, a lattice, a mesh, a mesh with some random points, or one near its sizes."""
COUPLE = WeightedMethod(cautious=True, tolerance=0.2, max_cycles=1)
"""Weighted steps after refinement, and all in 3D: one cycle of multigrid; the next steps reduce what remains."""


def auto_levels(n: float, dim: int) -> int:
    """Return the number of coarser levels for a mesh of `n` cells."""
    return max(0, round(math.log(max(n, 1) / tuning.COARSEST[dim], 2**dim)))


def repeated_schedule(method: Method, steps: int) -> list[Action]:
    """Return the schedule of a method that repeats one kind of step."""
    return [Step(method)] * steps


def adaptive_schedule(
    dim: int,
    effort: str,
    levels: int,
    exact: bool,
    error_target: float | None = None,
    begins: Begins = "random",
    openings: int = 0,
    narrow_parts: bool = False,
    most: int | None = None,
    cells: float = math.inf,
) -> list[Action]:
    """Return the schedule of the methods "adaptive" and "exact", with `levels` coarser levels.

    - `effort`: one of `EFFORTS`.
    - `exact`: end with the exact projection.
    - `error_target`: by default that of `choose_error_target` for smooth sizes.
    - `begins` "random", "lattice", "mesh", "partly random" or "near": what the run begins with: random points, a
      lattice, a mesh, a mesh in which random points replace some, or a mesh that only needs a correction (see
      `is_near`). A lattice and such a mesh have no coarser levels.
    - `openings`: how often the last steps open obtuse triangles, at most. Some steps before them cells of four sides
      are deleted, and those of eight split: a cell of four sides has an obtuse triangle.
    - `narrow_parts`: the domain, in 2D, may have parts that few cells join. The number of cells in each part is then
      balanced before each refinement, which multiplies what a part lacks, before polishing, and after each repair. The
      penalty of exact projections falls step by step (see `GRADUAL_PENALTIES`).
    - `most`: largest number of steps from a mesh without coarser levels. Sweeps, and in 3D steps of the first
      polishing, are left out to meet it. The last steps, which polish, are kept, even if they are more.
    - `cells`: number of cells. Few cells, most of which are near walls, glide longer from a lattice.
    """
    if error_target is None:
        error_target = choose_error_target(dim, effort, levels, begins == "near")

    def planned(effort: Effort) -> list[Action]:
        if begins == "near":
            return list(_correction(dim, effort, exact, error_target))
        return list({2: _adaptive_2d, 3: _adaptive_3d}[dim](effort, levels, exact, error_target, begins))

    settings = EFFORTS_OF[dim][effort]
    if begins == "lattice":
        share = tuning.LATTICE_GLIDE * min(1 + (tuning.LATTICE_CELLS / cells) ** 2, tuning.MOST_GLIDE)
        settings = replace(settings, alone=max(int(share * settings.alone) - settings.glide, 0), coarse_polish=0)
    schedule = planned(settings)
    while most is not None and begins != "random" and levels == 0 and n_steps(schedule) > most:
        name = "alone" if settings.alone else "coarse_polish"
        if not getattr(settings, name):
            break
        settings = replace(settings, **{name: getattr(settings, name) - 1})
        schedule = planned(settings)
    projections = tuning.EXACT_STEPS if exact else 0
    if narrow_parts:
        polish = schedule.index(ResetMomentum()) - 1
        for k in reversed(range(len(schedule))):
            if k == polish or schedule[k] == Refine() or isinstance(schedule[k - 1], RepairCells):
                schedule.insert(k, BalanceCounts())
        if exact:
            last = schedule[-1]
            assert isinstance(last, Step)
            assert isinstance(last.method, ProjectedMethod)
            schedule[-projections:] = _gradual(last.method)
            projections = len(tuning.GRADUAL_PENALTIES) + tuning.GRADUAL_NEWTON_STEPS
    return _opened(schedule, projections, openings) if openings else schedule


def _gradual(newton: ProjectedMethod) -> list[Action]:
    """Return the exact projections in polygons, given Newton's step of those in boxes."""
    base = replace(newton, tolerance=tuning.GRADUAL_TOLERANCE, iterations=tuning.GRADUAL_ITERATIONS, careful=True)
    first = replace(base, descent="quality", relaxation=1.0, momentum=0.7)
    last = replace(base, descent="edges", relaxation=1.0, quality_scale=tuning.NEWTON_QUALITY_SCALE)
    methods = [replace(first, penalty=p, quality_scale=scale) for p, scale in tuning.GRADUAL_PENALTIES]
    return [Step(method) for method in [*methods, *[last] * tuning.GRADUAL_NEWTON_STEPS]]


def _opened(schedule: list[Action], exact: int, openings: int) -> list[Action]:
    """Return the schedule with the deletion of cells of four sides, and with the opening of obtuse triangles.

    `exact` is the number of exact projections.
    """
    steps = [k for k, action in enumerate(schedule) if isinstance(action, Step)]
    # Exact projections close some triangles again, and correct the sizes of opened ones.
    opening = steps[-tuning.OPENING_PROJECTIONS if exact else -1 :]
    for k in opening:
        step = schedule[k]
        assert isinstance(step, Step)
        schedule[k] = replace(step, openings=openings)
    before = steps[-min(len(steps), tuning.SETTLING_STEPS + exact)]
    repair = [RepairCells(math.inf), CorrectCount(tuning.COUNT_EXACTLY if exact else 0.0)]
    return [*schedule[:before], *repair, *schedule[before:]]


def n_steps(schedule: list[Action]) -> int:
    """Return the number of steps in a schedule."""
    return sum(isinstance(action, Step) for action in schedule)


def _adaptive_2d(effort: Effort, levels: int, exact: bool, error_target: float, begins: Begins) -> Iterator[Action]:
    warm = begins != "random"
    glide = ProjectedMethod(
        "lloyd",
        effort.relaxation,
        effort.momentum,
        penalty=0.1,
        calm_relaxation=effort.calm_relaxation,
        tolerance=tuning.GLIDE_TOLERANCE if levels else tuning.POLISH_TOLERANCE,
    )
    tolerance = tuning.START_TOLERANCE if levels else WeightedMethod.tolerance
    start = WeightedMethod(cautious=True, tolerance=tolerance)
    if warm:
        yield CorrectCount(tuning.COUNT_SHARE)
    for level in range(levels, -1, -1):
        if level < levels:
            yield Refine()
            couple = effort.couple if level else effort.couple_finest
        elif warm:
            couple = effort.couple_finest
        else:
            couple = effort.start if levels else min(effort.start, effort.start_alone)
        yield from [Step(COUPLE if level < levels else start)] * couple
        yield CorrectCount(tuning.COUNT_SHARE)
        sweeps = effort.sweeps[min(level, len(effort.sweeps) - 1)]
        if levels == 0:
            sweeps = effort.alone
        elif level == levels:
            sweeps = min(sweeps, effort.first)
        for sweep in range(sweeps):
            quiet = sweep % 3 or sweep >= sweeps - 8
            yield InsertDelete(0.0 if quiet else effort.nuclei)
            yield from [Step(glide)] * effort.glide
        if level == 0 and sweeps < 3:
            yield InsertDelete()
    yield CorrectCount()
    yield ResetMomentum()
    if levels == 0:
        effort = replace(effort, quality_scale=max(effort.quality_scale, tuning.SINGLE_LEVEL_QUALITY_SCALE))
    yield from _finish_2d(effort, exact, error_target, effort.penalty)


def _correction(dim: int, effort: Effort, exact: bool, error_target: float) -> Iterator[Action]:
    stride = Step(WeightedMethod(tuning.STRIDE, cautious=True))
    yield from [stride] * 2
    yield CorrectCount(tuning.COUNT_LEAST)
    yield stride
    correct = ProjectedMethod(
        "lloyd", 0.0, 0.0, penalty=1e-2, k=1.0, iterations=60, tolerance=1e-3, gradient_from_field=True
    )
    yield Step(correct)
    yield CorrectCount()
    yield ResetMomentum()
    # The worst cells are as good as before, so there are no repairs.
    effort = replace(effort, repairs=())
    yield from {2: _finish_2d, 3: _finish_3d}[dim](effort, exact, error_target, tuning.NEAR_PENALTY)


def _finish_2d(effort: Effort, exact: bool, error_target: float, penalty: float) -> Iterator[Action]:
    """Polish, and project."""
    looser = error_target / effort.error_target
    tight = looser < tuning.TIGHT
    scale, power, bad_cell_weight = effort.log_ratio_scale * error_target, 2, effort.bad_cell_weight
    if looser > 1:
        bad_cell_weight *= min(looser, effort.loose_bad_cells)
        scale, power = min(scale * looser**0.5, effort.largest_log_ratio_scale), 4
    if looser > 1 or tight:
        penalty *= looser
    if effort.loose and error_target > effort.loose.above:
        effort = replace(effort, polish=effort.loose.steps, polish_momentum=effort.loose.momentum)
    polish = ProjectedMethod(
        "quality",
        momentum=effort.polish_momentum,
        penalty=penalty,
        quality_scale=effort.quality_scale,
        log_ratio_scale=scale,
        k=0.3,
        error_target=error_target,
        bad_cell_weight=bad_cell_weight,
        tolerance=tuning.POLISH_TOLERANCE,
        power=power,
        gradient_from_field=tight,
    )
    repairs = dict(effort.repairs)
    for step in range(effort.polish):
        if step == 3:
            yield InsertDelete(climb_strain=tuning.COUNT_CLIMB_STRAIN, least=tuning.COUNT_LEAST)
            yield CorrectCount()
        if step in repairs:
            yield repairs[step]
            yield CorrectCount(tuning.COUNT_EXACTLY if exact or tight else 0.0)
        yield Step(polish)
    if exact:
        project = ProjectedMethod(
            "quality",
            penalty=tuning.EXACT_PENALTY,
            iterations=tuning.EXACT_ITERATIONS,
            tolerance=tuning.EXACT_TOLERANCE,
            k=0.3,
            gradient_from_field=True,
            correct_mean=True,
        )
        newton = replace(project, descent="lloyd", relaxation=0.0, momentum=0.0, penalty=tuning.NEWTON_PENALTY)
        yield from [Step(project)] * tuning.PROJECT_STEPS
        yield Step(replace(COUPLE, cautious=False, lloyd=False))
        yield Step(replace(newton, descent="edges", relaxation=1.0))
        yield from [Step(newton)] * (tuning.NEWTON_STEPS - 1)
    else:
        separate = replace(
            polish, descent="edges", momentum=0.0, penalty=tuning.SEPARATE_PENALTY, quality_scale=0.0, error_target=0.0
        )
        yield from [Step(separate)] * effort.separate


def _adaptive_3d(effort: Effort, levels: int, exact: bool, error_target: float, begins: Begins) -> Iterator[Action]:
    warm = begins != "random"
    couple = [Step(COUPLE)]
    coarse_glide = _glide_3d(effort, tuning.COARSE_PENALTY, tuning.COARSE_TOLERANCE)
    coarse_polish = _polish_3d(effort, tuning.COARSE_PENALTY, tuning.COARSE_TOLERANCE)
    if warm:
        yield CorrectCount(tuning.COUNT_SHARE)
    for level in range(levels, -1, -1):
        if level < levels:
            yield Refine()
        elif not warm:
            yield from couple * effort.start
        if not level:
            yield BalanceRegions()
        if level:
            for steps in (effort.couple, effort.recouple):
                yield from couple * steps
                yield CorrectCount(tuning.COUNT_LEAST, tuning.POLISH_GROWTH_3D)
            yield from couple * effort.recouple
        if level or (not levels and begins != "mesh"):
            yield from [Step(coarse_glide)] * (effort.coarse_glide if levels else effort.alone)
            yield from [Step(coarse_polish)] * effort.coarse_polish
            yield ResetMomentum()
        if level:
            yield CorrectCount(tuning.COUNT_LEAST, ahead=1.0)
    yield from couple * effort.couple_finest
    yield CorrectCount(tuning.COUNT_FINEST_3D[exact] if levels else tuning.COUNT_LEAST)
    yield BalanceRegions()
    for k in range(effort.couple_finest):
        yield replace(couple[0], recent=k + 1 if levels else 0)
    yield CorrectCount()
    yield from _finish_3d(effort, exact, error_target, effort.penalty)


def _glide_3d(effort: Effort, penalty: float, tolerance: float, error_target: float = 0.0) -> ProjectedMethod:
    return ProjectedMethod(
        "lloyd", effort.relaxation, effort.momentum, penalty=penalty, tolerance=tolerance, error_target=error_target
    )


def _polish_3d(effort: Effort, penalty: float, tolerance: float, error_target: float = 0.0) -> ProjectedMethod:
    return ProjectedMethod(
        "surface",
        momentum=tuning.POLISH_MOMENTUM_3D,
        penalty=penalty,
        tolerance=tolerance,
        rate=tuning.POLISH_RATE_3D,
        bad_cell_weight=effort.bad_cell_weight,
        error_target=tuning.LOOSE_POLISH_3D * error_target,
        log_ratio_scale=effort.log_ratio_scale * error_target,
        scale_per_error=tuning.SCALE_PER_ERROR_3D,
    )


def _finish_3d(effort: Effort, exact: bool, error_target: float, penalty: float) -> Iterator[Action]:
    """Glide, polish, and project."""
    glide = _glide_3d(effort, penalty, tuning.POLISH_TOLERANCE, error_target)
    yield from [Step(glide)] * effort.glide
    polish = _polish_3d(effort, penalty, tuning.POLISH_TOLERANCE, error_target)
    settle = replace(
        polish, descent="lloyd", relaxation=0.0, momentum=0.0, penalty=tuning.SETTLE_PENALTY_3D, error_target=0.0
    )
    yield from [Step(polish)] * (effort.polish // 2)
    # Where h is steep, cells of other shapes have their generators at other places, with other sizes.
    yield CorrectCount(tuning.POLISH_COUNT_3D)
    if exact:
        yield CountOfMesh()
    yield from [Step(polish)] * (effort.polish - 1 - effort.polish // 2)
    yield Step(settle)
    if exact:
        newton = replace(
            settle,
            penalty=tuning.NEWTON_PENALTY,
            log_ratio_scale=0.0,
            scale_per_error=0.0,
            iterations=tuning.NEWTON_ITERATIONS_3D,
            gradient_from_field=True,
            correct_mean=True,
            careful=True,
        )
        yield from [Step(replace(newton, tolerance=tolerance)) for tolerance in tuning.NEWTON_TOLERANCES_3D]


def work_of(schedule: list[Action], levels: int, dim: int, cells: float) -> list[float]:
    """Return the work before each action as a share of the whole, for `cells` cells on the finest level.

    The work of a step is the number of cells of its level plus `STEP_CELLS`.
    """
    done, total, level = [], 0.0, levels
    for action in schedule:
        done.append(total)
        if isinstance(action, Refine):
            level -= 1
        elif isinstance(action, Step):
            total += cells * 2.0 ** (-dim * level) + tuning.STEP_CELLS
    return [w / max(total, 1e-300) for w in done]
