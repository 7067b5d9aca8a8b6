"""Short runs in every kind of domain, for Oclgrind: one plan that has every kind of action, few cells, few steps."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partialmethod
from unittest import mock

import numpy as np

import clvoro
from clvoro.adaptation import preparation, tuning
from clvoro.adaptation.insertion_deletion import InsertionDeletion
from clvoro.adaptation.methods import ProjectedMethod, PublishedMethod, Relaxation, WeightedMethod
from clvoro.adaptation.plan.actions import (
    Action,
    BalanceCounts,
    CorrectCount,
    InsertDelete,
    Prescribe,
    Refine,
    RepairCells,
    ResetMomentum,
    Step,
)
from clvoro.geometry.domain import Domain
from clvoro.sizing import Expression
from clvoro.tessellation import incremental as repair
from clvoro.tessellation import power as power_stages

Work = Callable[[clvoro.Adapter], None]

SHARE = 0.1
"""Share of the cells that may be repaired or nucleate dislocations. Default shares of few cells are less than one."""
LEAST_GAIN = 0.01
"""Gain for which a generator is inserted or deleted. Few cells seldom gain as much as by default."""


@contextmanager
def as_for_many() -> Iterator[None]:
    """Use the kernels of large meshes: launches for iterations, lanes to find cells to clip, and rings around cells."""
    with ExitStack() as patches:
        for name, module in list(sys.modules.items()):
            if name.startswith("clvoro.") and hasattr(module, "one_group_limit"):
                patches.enter_context(mock.patch.object(module, "one_group_limit", return_value=0))
        patches.enter_context(mock.patch.object(repair, "FEW", 8))
        patches.enter_context(mock.patch.object(power_stages, "RINGS_FROM", 0))
        yield


def large(work: Work) -> Work:
    """Return `work` with the kernels that large meshes use."""

    def as_large(adapter: clvoro.Adapter) -> None:
        with as_for_many():
            work(adapter)

    return as_large


def polishing(domain: Domain) -> list[Action]:
    """Return the steps that end a run: descent with a penalty, then sizes alone."""
    descent = "quality" if domain.cell_dim == 2 else "surface"
    exact = ProjectedMethod(descent, penalty=1e-3, k=0.3, gradient_from_field=True, correct_mean=True)
    return [
        Step(ProjectedMethod(descent, quality_scale=0.02, log_ratio_scale=0.03, k=0.3)),
        Step(exact, openings=2 if isinstance(domain, clvoro.Sphere) else 0),
    ]


def every_action(domain: Domain, levels: int) -> list[Action]:
    """Return a schedule with one coarser level, or none."""
    dim = domain.cell_dim
    plan: list[Action] = [
        Step(PublishedMethod(Relaxation(), lloyd=True, poisson=True)),
        Step(WeightedMethod(cautious=True)),
    ]
    if levels:
        plan += [CorrectCount(0.01, ahead=True), Refine(), CorrectCount()]
    if dim == 2:
        plan += [InsertDelete(nuclei=SHARE), Step(ProjectedMethod())]
        plan += [
            RepairCells(0.05),
            CorrectCount(),
            Step(ProjectedMethod()),
            RepairCells(0.05, split=True),
            CorrectCount(),
        ]
    else:
        plan.append(Step(ProjectedMethod()))
    if isinstance(domain, clvoro.Polygon):
        plan += [BalanceCounts(), CorrectCount()]
    return [*plan, ResetMomentum(), *polishing(domain)]


def every_step(domain: Domain, size: str, n_cells: int, levels: int = 1, **options: object) -> Work:
    """Return work that carries out the plan in `domain`, and its last steps once more as for a large mesh."""

    def work(adapter: clvoro.Adapter) -> None:
        def run(plan: list[Action], levels: int, points: np.ndarray | None) -> clvoro.Result:
            repair_cells = partialmethod(InsertionDeletion.repair_cells, share=SHARE)
            with (
                mock.patch.object(preparation, "adaptive_schedule", return_value=plan),
                mock.patch.object(InsertionDeletion, "repair_cells", repair_cells),
                mock.patch.object(tuning, "LEAST_GAIN", LEAST_GAIN),
            ):
                result = adapter.run(
                    domain,
                    Expression(size),
                    points=points,
                    options=clvoro.MultilevelOptions(levels=levels),
                    n_cells=n_cells,
                    seed=911,
                    **options,
                )
            assert len(result.points) == n_cells
            assert np.isfinite(result.size_error).all()
            return result

        first = run(every_action(domain, levels), levels, None)
        with as_for_many():
            last = run(polishing(domain), 0, first.points)
        assert abs(last.diagram.volumes.sum() - domain.measure) < 1e-3 * domain.measure
        last.diagram.vertices  # noqa: B018

    return work


def transport(adapter: clvoro.Adapter, domain: Domain, x: np.ndarray, max_steps: int | None = None) -> None:
    """Give the cells of `x` (n, d) equal volumes; after `max_steps`, others."""
    options = {} if max_steps is None else {"max_steps": max_steps}
    found = adapter.transport(domain, x, np.full(len(x), domain.measure / len(x)), **options)
    assert found.converged or max_steps is not None
    assert abs(found.diagram.volumes.sum() - domain.measure) < 1e-3 * domain.measure
    found.diagram.vertices  # noqa: B018


def power(domain: clvoro.Box | clvoro.Polygon, n: int) -> Work:
    """Return work that makes power diagrams: with volumes that are given, and with those of a size field in a run."""

    def work(adapter: clvoro.Adapter) -> None:
        x = np.random.default_rng(37).uniform(domain.lower, domain.upper, (4 * n, domain.dim))
        x = x[np.asarray(domain.contains(x))][:n]
        transport(adapter, domain, x)
        plan: list[Action] = [Step(WeightedMethod()), Prescribe(), Prescribe(move=True)]
        with mock.patch.object(preparation, "adaptive_schedule", return_value=plan):
            result = adapter.run(domain, Expression("1 + x"), points=x, n_cells=n)
        assert abs(result.diagram.volumes.sum() - domain.measure) < 1e-3 * domain.measure

    return work


def special_power(adapter: clvoro.Adapter) -> None:
    """Power diagrams with vertices of many cells, with generators in bins of bins, and with cells in several parts."""
    for domain, side in ((FLAT, 6), (FRAME, 6), (CUBE, 3)):
        dim, line = domain.dim, (np.arange(side) + 0.5) / side
        lattice = np.stack(np.meshgrid(*[line] * dim), axis=-1).reshape(-1, dim)
        transport(adapter, domain, lattice)
        cluster = 0.3 + 1e-2 * np.random.default_rng(11).random((90, dim))
        transport(adapter, domain, np.concatenate([lattice, cluster]), max_steps=0)
    x = np.random.default_rng(3).random((12, 2)) * (4, 0.3)
    transport(adapter, COMB, COMB.nearest(x))


def periodic_power(adapter: clvoro.Adapter) -> None:
    """Power cells of equal volumes in a periodic box in 3D. Too few for a run."""
    box = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)
    transport(adapter, box, np.random.default_rng(37).random((20, 3)))
    ball = clvoro.Sphere(1.0)
    transport(adapter, ball, ball.even_points(30))


FLAT, CUBE = clvoro.Box((0, 0), (1, 1)), clvoro.Box((0, 0, 0), (1, 1, 1))
FRAME = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
SQUARE = clvoro.Box((0, 0), (1, 1), periodic=True)
ROD = clvoro.Box((0, 0, 0), (1, 0.2, 0.2), periodic=(True, False, False))
SLIT = [(0.499, 0), (0.499, 0.7), (0.501, 0.7), (0.501, 0)]
NOTCHED = clvoro.Polygon([(0, 0), *SLIT, (2, 0), (2, 1.5), (1.2, 0.9), (1, 1.5), (0, 1.5)])
TEETH = [(k + side, 1 - 0.8 * (side in (0.4, 0.6))) for k in range(4) for side in (0.1, 0.4, 0.6, 0.9)]
COMB = clvoro.Polygon([(-1, 0), (4.5, 0), *TEETH[::-1]])
LAYERS = clvoro.Layers(0.05, count=2, spacing=0.2, edges=[2])
RUNS: dict[str, Work] = {
    "torus-run": every_step(SQUARE, "0.1 + 0.05*cos(6.2831853*x)", 104),
    "rod-run": every_step(ROD, "0.1 + 0.02*y", 69),
    "solid-run": every_step(CUBE, "0.2 + 0.1*x", 55),
    "sphere-run": every_step(clvoro.Sphere(1.0), "0.4 + 0.1*sin(lat)", 80),
    "polygon-run": every_step(NOTCHED, "0.1 + 0.05*x", 110),
    "layered-run": every_step(clvoro.Box((0, 0), (2.5, 1.5)), "0.2 + 0.05*x", 60, 0, layers=LAYERS),
    "special-power": special_power,
    "power": power(clvoro.Box((0, 0), (2.5, 1.5)), 60),
    "polygon-power": power(NOTCHED, 40),
    "solid-power": power(CUBE, 40),
    "periodic-power": large(power(SQUARE, 60)),
    "solid-periodic-power": periodic_power,
}
"""The numbers are chosen so that cells are inserted, or deleted, after refinement."""
