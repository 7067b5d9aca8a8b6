"""Short runs in every kind of domain, for Oclgrind: one plan that has every kind of action, few cells, few steps."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partialmethod
from unittest import mock

import numpy as np

import clvoro
from clvoro.adaptation import preparation
from clvoro.adaptation.efforts import RepairCells
from clvoro.adaptation.insertion_deletion import InsertionDeletion
from clvoro.adaptation.methods import ProjectedMethod, PublishedMethod, Relaxation, WeightedMethod
from clvoro.adaptation.schedule import (
    Action,
    CorrectCount,
    InsertDelete,
    Refine,
    ResetMomentum,
    Step,
)
from clvoro.sizing import Expression
from clvoro.tessellation import incremental as repair

Work = Callable[[clvoro.Adapter], None]

SHARE = 0.1
"""Share of the cells that may be repaired or nucleate dislocations. Default shares of few cells are less than one."""


@contextmanager
def as_for_many() -> Iterator[None]:
    """Use the kernels of large meshes: launches for iterations, and lanes to find cells to clip."""
    with ExitStack() as patches:
        for name, module in list(sys.modules.items()):
            if name.startswith("clvoro.") and hasattr(module, "one_group_limit"):
                patches.enter_context(mock.patch.object(module, "one_group_limit", return_value=0))
        patches.enter_context(mock.patch.object(repair, "FEW", 8))
        yield


def large(work: Work) -> Work:
    """Return `work` with the kernels that large meshes use."""

    def as_large(adapter: clvoro.Adapter) -> None:
        with as_for_many():
            work(adapter)

    return as_large


def polishing(dim: int) -> list[Action]:
    """Return the steps that end a run: descent with a penalty, then sizes alone."""
    descent = "quality" if dim == 2 else "lloyd"
    exact = ProjectedMethod(
        descent, penalty=1e-3, k=0.3, gradient_from_field=True, correct_mean=True
    )
    return [
        Step(ProjectedMethod(descent, quality_scale=0.02, log_ratio_scale=0.03, k=0.3)),
        Step(exact),
    ]


def every_action(dim: int, levels: int) -> list[Action]:
    """Return a schedule with one coarser level, or none."""
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
    return [*plan, ResetMomentum(), *polishing(dim)]


def every_step(
    domain: clvoro.Box | clvoro.Polygon,
    size: str,
    n_cells: int,
    levels: int = 1,
    **options: object,
) -> Work:
    """Return work that carries out the plan in `domain`, and its last steps once more as for a large mesh."""

    def work(adapter: clvoro.Adapter) -> None:
        def run(plan: list[Action], levels: int, points: np.ndarray | None) -> clvoro.Result:
            repair_cells = partialmethod(InsertionDeletion.repair_cells, share=SHARE)
            with (
                mock.patch.object(preparation, "adaptive_schedule", return_value=plan),
                mock.patch.object(InsertionDeletion, "repair_cells", repair_cells),
            ):
                result = adapter.run(
                    domain,
                    Expression(size),
                    points,
                    options=clvoro.MultilevelOptions(levels=levels),
                    n_cells=n_cells,
                    seed=911,
                    **options,
                )
            assert len(result.points) == n_cells
            assert np.isfinite(result.size_error).all()
            return result

        first = run(every_action(domain.dim, levels), levels, None)
        with as_for_many():
            last = run(polishing(domain.dim), 0, first.points)
        assert abs(last.diagram.volumes.sum() - domain.measure) < 1e-3 * domain.measure
        last.diagram.vertices  # noqa: B018

    return work


SQUARE = clvoro.Box((0, 0), (1, 1), periodic=True)
ROD = clvoro.Box((0, 0, 0), (1, 0.2, 0.2), periodic=(True, False, False))
NOTCHED = clvoro.Polygon([(0, 0), (2, 0), (2, 1.5), (1.2, 0.9), (1, 1.5), (0, 1.5)])
LAYERS = clvoro.Layers(0.05, count=2, spacing=0.2, edges=[2])
RUNS: dict[str, Work] = {
    "torus-run": every_step(SQUARE, "0.1 + 0.05*cos(6.2831853*x)", 104),
    "rod-run": every_step(ROD, "0.1 + 0.02*y", 69),
    "solid-run": every_step(clvoro.Box((0, 0, 0), (1, 1, 1)), "0.2 + 0.1*x", 55),
    "polygon-run": every_step(NOTCHED, "0.1 + 0.05*x", 110),
    "layered-run": every_step(clvoro.Box((0, 0), (2.5, 1.5)), "0.2 + 0.05*x", 60, 0, layers=LAYERS),
}
"""The numbers are chosen so that cells are inserted, or deleted, after refinement."""
