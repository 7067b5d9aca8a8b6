"""Rows longer than a slot: the diagram does not depend on the room, and only these rows take more room."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation import cells as cells_module
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.cells import SLOT, Cells, spare_slots
from clvoro.tessellation.incremental import IncrementalUpdate
from clvoro.tessellation.part import Part
from tests.reference import diagrams as reference
from tests.reference import patch

BOX = clvoro.Box((0, 0), (1, 1))
SPOKES = 45
"""Neighbors of the cell in the middle of each ring: three slots, and two enlargements of the capacity."""


def wheels(rings=2, others=400):
    """Return a point in the middle of each ring, and many others between the rings."""
    rng = np.random.default_rng(5)
    middles = (np.stack(np.meshgrid(*[np.arange(rings)] * 2), axis=-1).reshape(-1, 2) + 0.5) / rings
    turn = 2 * np.pi * (np.arange(SPOKES) + 0.1 * rng.random((len(middles), SPOKES))) / SPOKES
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * 0.4 / rings
    around = rng.random((others, 2))
    apart = np.linalg.norm(around[:, None] - middles, axis=-1).min(axis=1) > 0.42 / rings
    return np.concatenate([middles, (middles[:, None] + ring).reshape(-1, 2), around[apart]])


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(request, ctx):
    return Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(request.param))


def make(engine, points):
    x, n = engine.upload(points), len(points)
    cells = Cells(engine)
    binned = Bins(engine).build(BOX, x, n)
    return cells, x, cells.tessellate(Part.alone(x, BOX), binned)


def compare(a, b):
    a, b = vars(patch.fetch(a)), vars(patch.fetch(b))
    for name in a:
        assert np.array_equal(a[name], b[name]), name


@pytest.mark.sparse(1)
def test_cells_in_rings_are_correct(engine):
    points = wheels().astype(engine.real)
    diagram = clvoro.Adapter(engine.ctx, engine.real).diagram(BOX, points)
    sides = np.diff(diagram.neighbor_starts)
    assert (sides[:4] == SPOKES).all()
    assert (sides[4:] <= SLOT).all()
    expected = reference.box_voronoi(BOX.lower, BOX.upper, np.asarray(points, float))
    areas = np.array([cell.area for cell in expected])
    # Corners have the round-off of positions; a cell has about ten, and is 0.03 wide.
    assert diagram.volumes == pytest.approx(areas, abs=0.3 * float(np.finfo(engine.real).eps))


def test_without_spare_slots_the_diagram_is_made_again(engine, monkeypatch):
    points = wheels()
    _, _, there = make(engine, points)
    monkeypatch.setattr(cells_module, "spare_slots", lambda _: 1)
    _, _, again = make(engine, points)
    compare(there, again)


def test_only_long_rows_take_more_room(engine):
    """Scratch memory holds one slot per cell and the spare slots."""
    points = wheels()
    n = len(points)
    engine.workspace.clear()
    make(engine, points)
    # Of a slot also its count and bits; of a cell its place, where its row starts, and its faces, if any is doubtful.
    expected = 4 * ((n + spare_slots(n)) * (SLOT + 2) + 2 * n + 6 * n)
    assert engine.workspace._most <= expected
    engine.workspace.clear()


@pytest.mark.slow
def test_incremental_update_has_room_for_long_rows(engine, monkeypatch):
    """Without room the update returns None."""
    points = wheels()
    cells, _, t = make(engine, points)
    moved = engine.upload(points + np.random.default_rng(6).uniform(-1, 1, points.shape) * 1e-5)
    repaired = IncrementalUpdate(engine).update(cells, BOX, moved, t)
    assert repaired is not None
    repaired = patch.fetch(repaired)
    n = len(points)
    anew = patch.fetch(Cells(engine).tessellate(Part.alone(moved, BOX), Bins(engine).build(BOX, moved, n)))
    assert np.array_equal(np.diff(repaired.starts)[:4], [SPOKES] * 4)
    assert np.array_equal(repaired.starts, anew.starts)
    assert np.array_equal(repaired.neighbors, anew.neighbors)
    assert np.array_equal(repaired.volumes, anew.volumes)
    monkeypatch.setattr("clvoro.tessellation.incremental.spare_slots", lambda _: 1)
    cells, _, t = make(engine, points)
    assert IncrementalUpdate(engine).update(cells, BOX, moved, t) is None
