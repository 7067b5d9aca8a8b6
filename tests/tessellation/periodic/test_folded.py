"""Incremental updates of folded diagrams: vector lanes against single cells; cells that cover the box twice."""

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.tessellation import incremental as repair
from clvoro.tessellation.device_diagram import read_report
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch

UNIT = clvoro.Box((0, 0), (1, 1), periodic=True)
CHANNEL = clvoro.Box((3, -2), (5.5, -0.5), periodic=(True, False))


def make_stages(ctx, box, real="float64", one_by_one=False):
    made = patch.make_engine(ctx, real)
    engine = Engine(ctx, made.queue, 2, made.real, box.traits(made.real))
    if one_by_one:
        object.__setattr__(engine, "group_size", 128)  # as on a GPU
    return Stages(engine)


class Carried:
    """A folded diagram that is updated incrementally, and the same diagram made anew."""

    def __init__(self, stages, box, points):
        self.stages, self.box, self.n = stages, box, len(points)
        self.periodic, self.fresh = (Tessellator(stages, box), Tessellator(stages, box))
        self.t = self.periodic.tessellate(self.place(points), self.n)

    def place(self, points):
        return self.stages.engine.upload(self.box.place(points, self.stages.engine.real))

    def move(self, points):
        """Update the diagram to `points`; return it as NumPy arrays, or None if it was made anew."""
        x = self.place(points)
        t = self.periodic.steps.update(x, self.n, self.t, None, read_report)
        self.t = self.periodic.tessellate(x, self.n) if t is None else t
        return None if t is None else patch.fetch(t)

    def reference(self, points):
        return patch.fetch(self.fresh.tessellate(self.place(points), self.n))


def some_points(box, n, seed):
    rng = np.random.default_rng(seed)
    return rng.random((n, 2)) * box.extent + box.lower


def moved(points, box, by, rng):
    """Move every generator by up to `by` spacings, within walls."""
    step = by * (box.measure / len(points)) ** 0.5 * (2 * rng.random(points.shape) - 1)
    held = ~np.array(box.periodic)
    return np.where(held, np.clip(points + step, box.lower, box.upper), points + step)


@pytest.mark.slow
@pytest.mark.parametrize("box", [pytest.param(UNIT, id="unit"), pytest.param(CHANNEL, id="channel")])
def test_lanes_have_the_bits_of_single_cells(ctx, box, monkeypatch):
    """On CPUs, vector lanes check, clip and measure eight rows at a time."""
    monkeypatch.setattr(repair, "FEW", 1)
    both = [make_stages(ctx, box, one_by_one=alone) for alone in (False, True)]
    if both[0].engine.group_size > 1:
        pytest.skip("lanes are for CPUs")
    assert [stages.folded_cells.lanes for stages in both] == [8, 1]
    rng, points = np.random.default_rng(50101), some_points(box, 500, 50102)
    runs = [Carried(stages, box, points) for stages in both]
    changed = 0
    for _ in range(5):
        before = runs[0].t.neighbors.get()
        points = moved(points, box, 0.03, rng)
        a, b = (run.move(points) for run in runs)
        changed += not np.array_equal(before[: len(a.neighbors)], a.neighbors)
        for name, array in vars(a).items():
            assert np.array_equal(array, getattr(b, name)), name
        inner = a.neighbors >= 0
        across = np.abs(a.points[a.owners[inner]] - a.points[a.neighbors[inner]])
        assert (across.max(axis=0) > 0.25).tolist() == list(box.periodic)
    assert changed == 5


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_cells_that_cover_the_box_twice(ctx, real):
    """A motion twice around in one step leaves all rows consistent, in two sheets that do not know each other."""
    m, stages = 8, make_stages(ctx, UNIT, real)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(2 * m), np.arange(m)))
    points = np.column_stack([(i + j % 2 / 2) / (2 * m), j / m])
    # The two sheets must not coincide.
    apart = 0.25 / m * np.exp(2j * np.pi * points[:, 0])
    run = Carried(stages, UNIT, points + 0.001)
    twice = points * [2, 1] + np.column_stack([apart.imag, apart.real])
    covered = stages.update.update(stages.folded_cells, run.periodic.steps.box, run.place(twice), run.t)
    assert patch.fetch(covered).volumes.sum() == pytest.approx(2, rel=1e-5)
    run = Carried(stages, UNIT, points + 0.001)
    assert run.move(twice) is None
