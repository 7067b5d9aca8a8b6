"""Plans: in which order a run takes its steps, from the coarsest level to the finest.

    density start ─► couple ─► [ reorganize ─► glide ] x sweeps
        ─► refine ─► couple ─► [...] ... ─► settle ─► polish (─► project)

*couple*      weighted Lloyd and Poisson: from any start to nearly the right sizes
*reorganize*  insert and delete generators: dislocations climb, the count meets the field
*glide*       weighted Lloyd with momentum, softly projected: defects move and annihilate
*settle*      where a count was asked for: exactly that many
*polish*      descent of cell quality, projected; the penalty is steered to the error that is aimed at; now and then the
              worst cells are deleted or split, where the descent has nowhere to go
*project*     the same with next to no penalty: every cell the size that was asked for

In 3D there is no lattice whose defects could climb, and a mesh that has been coupled long enough loses next to no
quality in the projection:

    density start ─► [ couple ─► settle ahead ] x 2 ─► refine ─► ... ─► couple ─► settle ─► couple ─► glide (─► project)

*settle ahead*  the count at which refinement makes the one that the next level wants

From a mesh that is near its size field already, as after the field has moved by a few cells:

    stride ─► settle ─► stride ─► correct ─► settle ─► polish (in 3D: glide) (─► project)

*stride*   weighted Lloyd and Poisson, by as much as two cells at once: the potential's displacement is smooth
*correct*  one step of the projection alone
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from .insertion_deletion import THETA
from .methods import Method, ProjectedMethod, WeightedMethod

COARSEST = {2: 1400, 3: 1500}
"""Cells of the coarsest level, roughly, by dimension.

A step on fewer costs hardly less (see `STEP_CELLS`). Measured on F2 (see bench/convergence.py) from 23,000 to 100,000
cells, half as many, and a level more, make a mesh no better.
"""
STEP_CELLS = 3000
"""Cells on which a step works as long as its launches take the host."""


@dataclass(frozen=True)
class Mend:
    """Delete or split the worst cells: those with 1 - Q above `flaw`; see `PopulationControl.mend`."""

    flaw: float
    split: bool = False


@dataclass(frozen=True)
class Effort:
    """How much work a run takes.

    Attributes
    ----------
    start, couple, couple_finest : int
        Coupled steps on the coarsest level, on those between, and on the finest.
    sweeps : tuple of int
        Sweeps (reorganize, then glide) on the finest level, on the next coarser one, ...; the last holds for all above.
    glide : int
        Steps in a sweep.
    first : int
        Sweeps on the coarsest level, at most, where there are others.
    polish : int
        Steps of polishing, at the end.
    aim : float
        Mean |log(L / h)| that polishing aims at.
    relaxation, momentum : float
        Of the gliding.
    eps : float
        Penalty with which polishing begins.
    nuclei : float
        Share of the cells where pairs may be made, every third sweep.
    emphasis, lenience, bound : float
        Of the polishing: weight of bad cells; -log Q from which on a cell may be off its size for its shape; and
        excess, over the mean that is aimed at, from which on it may not.
    mends : tuple of (int, Mend)
        Of the worst cells, each before that step of polishing; the last ones leave steps to get into shape.
    flaw : float
        1 - mean Q up to which a mesh is as good as this effort makes it, in 2D, walls apart.
    """

    start: int
    couple: int
    couple_finest: int
    sweeps: tuple[int, ...]
    glide: int
    polish: int
    aim: float
    relaxation: float = 1.3
    momentum: float = 0.7
    eps: float = 0.3
    nuclei: float = 0.0
    first: int = 99
    emphasis: float = 20.0
    lenience: float = 0.03
    bound: float = 12.0
    mends: tuple[tuple[int, Mend], ...] = ()
    flaw: float = 0.012


EFFORTS = {
    "fast": Effort(8, 2, 3, (0, 1, 4, 8), glide=6, first=4, polish=5, aim=0.0035, relaxation=1.0, flaw=0.022),
    "default": Effort(
        30, 5, 3, (4, 18, 20, 20), glide=7, polish=21, aim=0.0025, lenience=0.02,
        bound=11.0, mends=((5, Mend(0.06)), (9, Mend(0.06)), (13, Mend(0.07))),
    ),
    "best": Effort(
        60, 5, 10, (100, 40, 30, 30), glide=7, polish=90, aim=0.0039, relaxation=1.5, momentum=0.8,
        eps=0.7, nuclei=0.0018, emphasis=80.0, lenience=0.02, bound=16.0,
        mends=((30, Mend(0.037)), (50, Mend(0.037, split=True)), (70, Mend(0.037)), (80, Mend(0.037))),
        flaw=0.006,
    ),
}  # fmt: skip

EFFORTS_3D = {
    "fast": Effort(30, 4, 2, (), glide=4, polish=0, aim=0.004, relaxation=1.5, momentum=0.7),
    "default": Effort(40, 8, 2, (), glide=8, polish=0, aim=0.0025, relaxation=1.5, momentum=0.8),
    "best": Effort(80, 30, 3, (), glide=60, polish=0, aim=0.003, relaxation=1.5, momentum=0.8),
}
"""The same in 3D. `couple` steps follow each of three counts on a coarser level, `couple_finest` each of two."""

SINGLE_AIM = 0.0017
"""Mean |log(L / h)| that polishing aims at most at, where there is one level only."""
SINGLE_LENIENCE = 0.15
"""-log Q from which on a cell may be off its size for its shape, there, at least. Measured on F1 (600 cells), thirty
starts: the largest error is 0.010 (median; of twenty others in three more than 0.02, 0.030 at most) in the place of
0.013 (0.031), for 0.01 of the least Q."""
MOST_SURPLUS = 0.4
"""Cells that a run takes at most, over the integral of h^-d, as a share of that. Steep slopes ask for up to 0.35 more
for a while, and for 0.15 in the end; jumps for any number, and meshes are no better for it."""
COUNT_SHARE = 0.03
"""Share of the generators by which the count may be off before the climb takes care of it."""
COUNT_LEAST = 1e-3
"""The same while polishing: a cell that comes late has few steps left to get its shape."""
COUNT_EXACTLY = 1e-6
"""Share by which the count may be off after cells have been mended, where sizes are to be exact: more are deleted than
split, and measured on F2 two generators too few cost a mean error of 3e-5. Others keep their better shapes."""
COUNT_THETA = 0.3
"""Strain for pairs to climb while polishing: only the count makes them."""
START_TOLERANCE, COUPLE_TOLERANCE = 3e-2, 0.2
"""Relative residuals of Poisson solves in 2D where there are coarser levels: on the coarsest, and after refinement. The
next step sees the rest: measured on F2 and F3, three starts each, with 11,000 to 300,000 cells, a tenth of the one and
half of the other change neither sizes nor shapes (0.4 in the place of 0.2 does)."""
GLIDE_TOLERANCE, POLISH_TOLERANCE = 0.3, 1e-2
"""The same of projections while defects glide and while cells are polished; each begins with the last one's solution.
Measured on F2 and F3, six starts each: sizes and shapes are those of a tenth of these, for half the iterations (from
0.6 on, and 0.3 in polishing, the largest errors grow; of a million cells, from 0.03 in polishing)."""
EXACT_STEPS, EXACT_ITERATIONS = 8, 45
EXACT_STEPS_3D = 3

NEAR_ERROR, NEAR_COUNT = 0.15, 0.02
"""Mean |e|, and share by which the count is off, up to which a given mesh is only corrected. Measured on F2 (see
bench/restart.py): beyond them its cells lose shape that only reorganizing brings back."""
FLAW_3D = 0.36
"""1 - mean Q in 3D up to which a mesh has been smoothed: a random one has 0.47, one of any effort 0.33 or less."""
WALL_FLAW = 0.45
"""Over the square root of the number of cells: 1 - mean Q that walls cost, and strain with no room to be relieved."""
STRIDE = 2.0
"""Bound of the displacement over h."""
NEAR_EPS = 0.03
"""Penalty with which the polishing of a corrected mesh begins: more would let go of the sizes first."""


@dataclass(frozen=True)
class Step:
    """Displace and move all generators, and tessellate anew."""

    method: Method


@dataclass(frozen=True)
class Reorganize:
    """Insert and delete generators.

    `nuclei` is the share of the cells where pairs may be made, `theta` the strain from which on pairs climb, `least`
    the share by which the count must be off for anything to be done.
    """

    nuclei: float = 0.0
    theta: float = THETA
    least: float = 0.0


@dataclass(frozen=True)
class Refine:
    """Go to the next finer level."""


@dataclass(frozen=True)
class Rest:
    """Take the momentum away."""


@dataclass(frozen=True)
class Settle:
    """Bring the count to the one that is held.

    With `share`, to within that share of what the size field asks for; `ahead`: to what makes the next level's count.
    """

    share: float = 0.0
    ahead: bool = False


Action = Step | Reorganize | Mend | Refine | Rest | Settle


def auto_levels(n: float, dim: int) -> int:
    """Return the number of coarser levels for a mesh of `n` cells."""
    return max(0, round(math.log(max(n, 1) / COARSEST[dim], 2**dim)))


def is_near(
    dim: int, effort: str, n: int, missing: float, mean_error: float, mean_quality: float
) -> bool:
    """Tell whether a given mesh of `n` cells needs no more than correction to be as `effort` makes it.

    Parameters
    ----------
    missing : float
        Cells that are missing; negative: that are too many.
    mean_error : float
        Mean of |e|.
    mean_quality : float
    """
    flaw = EFFORTS[effort].flaw + WALL_FLAW / math.sqrt(n) if dim == 2 else FLAW_3D
    return mean_error <= NEAR_ERROR and abs(missing) <= NEAR_COUNT * n and 1 - mean_quality <= flaw


def plan_steps(method: Method, steps: int) -> list[Action]:
    """Return the plan of a method that repeats one kind of step."""
    return [Step(method)] * steps


def plan_adaptive(
    dim: int,
    effort: str,
    levels: int,
    exact: bool,
    aim: float | None = None,
    warm: bool = False,
    near: bool = False,
) -> list[Action]:
    """Return the plan that reaches the size field and good cells, over `levels` coarser levels.

    Parameters
    ----------
    effort : str
        Of `EFFORTS`.
    exact : bool
        End with the exact projection.
    aim : float, optional
        In the place of the effort's own.
    warm : bool
        The start is a mesh already, not a random sample.
    near : bool
        It is near the size field (see `is_near`), and there are no coarser levels.
    """
    plan = (EFFORTS if dim == 2 else EFFORTS_3D)[effort]
    if near:
        return list(_correction(dim, plan, exact, plan.aim if aim is None else aim))
    if dim == 3:
        return list(_adaptive_3d(plan, levels, exact, plan.aim if aim is None else aim, warm))
    if aim is None:
        # A mesh that is small enough for one level can be had nearer to its size.
        aim = plan.aim if levels else min(plan.aim, SINGLE_AIM)
    return list(_adaptive_2d(plan, levels, exact, aim, warm))


def _adaptive_2d(
    effort: Effort, levels: int, exact: bool, aim: float, warm: bool
) -> Iterator[Action]:
    glide = ProjectedMethod(
        "lloyd", effort.relaxation, effort.momentum, eps=0.1,
        tolerance=GLIDE_TOLERANCE if levels else POLISH_TOLERANCE,
    )  # fmt: skip
    if warm:
        yield Settle(COUNT_SHARE)
    for level in range(levels, -1, -1):
        if level < levels:
            yield Refine()
            couple = effort.couple if level else effort.couple_finest
        elif warm:
            couple = effort.couple_finest
        else:
            couple = effort.start
        tolerance = COUPLE_TOLERANCE if level < levels else START_TOLERANCE
        if levels == 0:
            tolerance = WeightedMethod.tolerance
        yield from [Step(WeightedMethod(cautious=True, tolerance=tolerance))] * couple
        yield Settle(COUNT_SHARE)
        sweeps = effort.sweeps[min(level, len(effort.sweeps) - 1)]
        if levels == 0:
            # The only level has no coarser one to have done the work.
            sweeps = max(sweeps, effort.sweeps[-1])
        elif level == levels:
            sweeps = min(sweeps, effort.first)
        for sweep in range(sweeps):
            quiet = sweep % 3 or sweep >= sweeps - 8
            yield Reorganize(0.0 if quiet else effort.nuclei)
            yield from [Step(glide)] * effort.glide
        if level == 0 and sweeps < 3:
            yield Reorganize()
    yield Settle()
    yield Rest()
    if levels == 0:
        effort = replace(effort, lenience=max(effort.lenience, SINGLE_LENIENCE))
    yield from _finish_2d(effort, exact, aim, effort.eps)


def _correction(dim: int, effort: Effort, exact: bool, aim: float) -> Iterator[Action]:
    stride = Step(WeightedMethod(STRIDE, cautious=True))
    yield from [stride] * 2
    yield Settle(COUNT_LEAST)
    yield stride
    correct = ProjectedMethod(
        "lloyd", 0.0, 0.0, eps=1e-2, k=1.0, iterations=60, tolerance=1e-3, sampled_gradient=True
    )
    yield Step(correct)
    yield Settle()
    yield Rest()
    # What is there stays where it can: the worst cells are as good as they were.
    effort = replace(effort, mends=())
    yield from (_finish_2d if dim == 2 else _finish_3d)(effort, exact, aim, NEAR_EPS)


def _finish_2d(effort: Effort, exact: bool, aim: float, eps: float) -> Iterator[Action]:
    """Polish, and project."""
    polish = ProjectedMethod(
        "shape", eps=eps, lenience=effort.lenience, bound=effort.bound * aim, k=0.3, aim=aim,
        emphasis=effort.emphasis, tolerance=POLISH_TOLERANCE,
    )  # fmt: skip
    mends = dict(effort.mends)
    for step in range(effort.polish):
        if step == 3:
            yield Reorganize(theta=COUNT_THETA, least=COUNT_LEAST)
            yield Settle()
        if step in mends:
            yield mends[step]
            yield Settle(COUNT_EXACTLY if exact else 0.0)
        yield Step(polish)
    if exact:
        project = ProjectedMethod(
            "shape", eps=1e-3, iterations=EXACT_ITERATIONS, tolerance=1e-3, k=0.3, sampled_gradient=True,
            keep_mean=True,
        )  # fmt: skip
        # The last two only project: Newton's steps on the sizes.
        newton = replace(project, relaxation=0.0, momentum=0.0)
        yield from [Step(project)] * (EXACT_STEPS - 2)
        yield from [Step(newton)] * 2


def _adaptive_3d(
    effort: Effort, levels: int, exact: bool, aim: float, warm: bool
) -> Iterator[Action]:
    couple = [Step(WeightedMethod(cautious=True))]
    if warm:
        yield Settle(COUNT_SHARE)
    for level in range(levels, -1, -1):
        if level < levels:
            yield Refine()
        elif not warm:
            yield from couple * effort.start
        if level:
            for _ in range(2):
                yield from couple * effort.couple
                yield Settle(COUNT_LEAST, ahead=True)
            yield from couple * effort.couple
    yield from couple * effort.couple_finest
    yield Settle(COUNT_LEAST)
    yield from couple * effort.couple_finest
    yield Settle()
    yield from _finish_3d(effort, exact, aim, effort.eps)


def _finish_3d(effort: Effort, exact: bool, aim: float, eps: float) -> Iterator[Action]:
    """Glide, and project."""
    glide = ProjectedMethod(
        "lloyd", effort.relaxation, effort.momentum, eps=eps, aim=aim, tolerance=POLISH_TOLERANCE
    )
    yield from [Step(glide)] * effort.glide
    if exact:
        project = ProjectedMethod(
            "lloyd", 0.5, 0.0, eps=1e-3, iterations=EXACT_ITERATIONS, sampled_gradient=True,
            keep_mean=True,
        )  # fmt: skip
        newton = replace(project, relaxation=0.0)
        yield from [Step(project)] * (EXACT_STEPS_3D - 2)
        yield from [Step(newton)] * 2


def work_of(plan: list[Action], levels: int, dim: int, cells: float) -> list[float]:
    """Return the work done before each action, as a share of the whole, for `cells` on the finest level.

    A step costs as its level has cells, and `STEP_CELLS` more.
    """
    done, total, level = [], 0.0, levels
    for action in plan:
        done.append(total)
        if isinstance(action, Refine):
            level -= 1
        elif isinstance(action, Step):
            total += cells * 2.0 ** (-dim * level) + STEP_CELLS
    return [w / max(total, 1e-300) for w in done]
