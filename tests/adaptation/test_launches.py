"""How many commands a step takes, and how often the host waits for it: bounds for every kind of step."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation.plan.actions import Step
from clvoro.adaptation.plan.schedule import adaptive_schedule
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.opencl.hooks import watching
from clvoro.sizing import Sizing
from tests.reference import patch
from tests.robustness.gpu_like import groups
from tests.tally import Tally

WARM_UP, STEPS = 4, 2
FEW = 4000
"""Cells of the fast tests: more than one work-group iterates for."""
LAUNCHES, MORE = 60, 16
"""Most launches of a step; of an exact one, without its iterations. And those of each further read: a round of an
update, with all that is evaluated again."""
ITERATION = 2
"""Launches of an iteration of an exact step."""
SOLVERS = ("multigrid", "conjugate_gradient", "volume_projection", "poisson", "aggregation")


def is_exact(method):
    return getattr(method, "gradient_from_field", False)


def methods(dim):
    """Return the methods of the steps of a default run on its finest level."""
    steps = [
        a.method
        for exact in (False, True)
        for a in adaptive_schedule(dim, "default", 1, exact=exact)
        if isinstance(a, Step)
    ]
    found = {(type(m), getattr(m, "descent", getattr(m, "lloyd", None)), is_exact(m)): m for m in steps}
    return [replace(method) for method in found.values()]


def near_lattice(dim, n):
    """Return `n` points, roughly, of a cubic lattice, and the spacing; far enough from it to have one diagram."""
    side = round(n ** (1 / dim))
    corners = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), -1).reshape(-1, dim)
    noise = np.random.default_rng(6113).uniform(0.2, 0.8, corners.shape)
    return (corners + noise) / side, 1 / side


@pytest.mark.parametrize(
    ("dim", "n", "group"),
    [
        pytest.param(2, FEW, None, id="2D"),
        pytest.param(3, FEW, None, id="3D"),
        *(
            pytest.param(dim, n, 128, id=f"{dim}D, {n:,}, as a GPU", marks=pytest.mark.slow)
            for dim, n in ((2, 10**4), (3, 10**4), (2, 10**6), (3, 10**5))
        ),
    ],
)
def test_a_step_takes_few_commands_and_reads(adapter, dim, n, group):
    """A read by the host takes as long as several launches. It reads scalars, and one for each iteration of solvers."""
    with groups(group, 512) if group else nullcontext():
        check_steps(adapter, dim, n, group)


def check_steps(adapter, dim, n, group):
    points, spacing = near_lattice(dim, n)
    box = clvoro.Box((0,) * dim, (1,) * dim)
    engine = Engine(adapter.ctx, cl.CommandQueue(adapter.ctx), dim, adapter.dtype)
    # How often launches are divided depends on their times.
    engine._divides = False
    for method in methods(dim):
        tally, reads, iterations = Tally(), [], 0
        mesh = patch.make_mesh(Stages(engine), box, Sizing(engine, box, spacing), engine.upload(points))
        for k in range(WARM_UP + STEPS):
            with watching(engine.queue, tally) if k >= WARM_UP else watching(engine.queue, Tally()):
                before = tally.reads
                with engine.workspace.frame():
                    displacement = method.step(mesh)
                    mesh.move(displacement)
                mesh.update()
                if k >= WARM_UP:
                    reads.append(tally.reads - before)
                    iterations += displacement.solution.iterations
        solving = sum(c for (stage, _), c in tally.calls.items() if stage.split("/")[-1] in SOLVERS)
        kind = f"{type(method).__name__} {is_exact(method)} {getattr(method, 'descent', '')}"
        name = f"{kind} {reads} {iterations} {tally.launches} {solving}"
        # Of the solver, and of the diagram with the summaries. More cells than in the last step may need one more round
        # of an update, and a solve more iterations.
        assert min(reads) <= 2, name
        assert max(reads) <= 4, name
        assert (tally.launches - solving) / STEPS <= (35 if max(reads) == 2 else 45), name
        if group:
            spent = tally.launches - is_exact(method) * ITERATION * iterations
            assert spent <= LAUNCHES * STEPS + MORE * (sum(reads) - 2 * STEPS), name
        assert tally.writes == 0, name
        assert tally.bytes_read / STEPS < 4000, name
