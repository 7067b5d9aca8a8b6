"""Vertices in the plane, each once, however many cells meet there."""

from itertools import pairwise

import numpy as np
import pyopencl as cl
import pytest
from test_diagram import check_invariants

import clvoro
from clvoro._program import Engine
from clvoro.bins import Bins
from clvoro.cells import Cells
from clvoro.face_rows import SLOT

BOX = clvoro.Box((0, 0), (1, 1))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_many_cells_at_a_point_of_a_wall(ctx, dtype):
    """Or nearly so, as rounding has it: some touch the wall there, others do not."""
    rng, adapter = np.random.default_rng(61101), clvoro.Adapter(ctx, dtype)
    turn = np.pi * (np.arange(9) + 0.5) / 9
    for _ in range(16):
        ring = rng.uniform(0.2, 0.4) * np.column_stack([np.cos(turn), np.sin(turn)])
        points = (rng.uniform(0.45, 0.55, 2) * [1, 0] + ring)[rng.permutation(9)]
        points = points[:, ::-1] if rng.random() < 0.5 else points
        points = 1 - points if rng.random() < 0.5 else points
        check_invariants(adapter.diagram(BOX, points), float(np.finfo(dtype).eps))


# At 900 and 1030 rounding makes faces that cross, at one turn or another.
@pytest.mark.parametrize("n", [300, 900, 1030, 2000])
@pytest.mark.parametrize("turn", [0.0, 0.1, 0.3])
def test_faces_of_very_many_cells_at_a_point_do_not_cross(ctx, n, turn):
    angle = 2 * np.pi * np.arange(n) / n + turn
    circle = 0.5 + 0.4 * np.column_stack([np.cos(angle), np.sin(angle)])
    diagram = clvoro.Adapter(ctx).diagram(BOX, circle)
    assert diagram.check()
    assert "Euler's formula" in diagram.check().checked


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(request, ctx):
    return Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(request.param))


def lattice_rows(engine, across):
    """A lattice of squares, four of which meet in each point: cells, points and the rows of faces."""
    centres = (np.arange(across) + 0.5) / across
    points = engine.upload(np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2))
    n, cells = len(points), Cells(engine)
    t = cells.tessellate(BOX, points, n, Bins(engine).build(BOX, points, n))
    starts, neighbours = t.starts.get(), t.neighbours.get()
    return cells, points, [list(neighbours[a:b]) for a, b in pairwise(starts)]


def add_diagonal(rows, i, j, i_before, j_before):
    """Let i and j see each other: after the neighbour that is named, counter-clockwise."""
    for cell, other, before in ((i, j, i_before), (j, i, j_before)):
        rows[cell].insert(rows[cell].index(before) + 1, other)


def test_faces_that_cross_are_left_out(engine):
    """Both of them; one alone, from corner to corner of four cells, is a face as others are."""
    across = 8
    cells, points, before = lattice_rows(engine, across)
    rows = [list(row) for row in before]
    for column, row, crossed in (
        (1, 1, True),
        (5, 2, True),
        (3, 5, False),
        (6, 6, True),
        (1, 6, False),
    ):
        i = (
            column + across * row
        )  # lower left of the four; the others: right, above, and right above
        right, above, opposite = i + 1, i + across, i + across + 1
        add_diagonal(rows, i, opposite, right, above)
        if crossed:
            add_diagonal(rows, right, above, opposite, i)
        else:
            before[i], before[opposite] = list(rows[i]), list(rows[opposite])
    n, old = len(rows), cells.take_rows(len(rows))
    slots = np.zeros((n, SLOT), np.int32)
    for i, labels in enumerate(rows):
        slots[i, : len(labels)] = labels
    old.slots.set(slots.ravel())
    old.places.set(np.arange(n, dtype=np.int32))
    old.counts.set(np.array([-len(labels) for labels in rows], np.int32))
    old.keep.set(np.array([(1 << len(labels)) - 1 for labels in rows], np.uint32))
    old.starts.set(np.cumsum([0, *map(len, rows)]).astype(np.int32))
    graph = engine.upload(np.concatenate(rows), np.int32)
    t = cells._measure_without_loops(old, BOX, points, n, graph, exact=True)
    assert t is not None
    starts, found = t.starts.get(), t.neighbours.get()
    assert [list(found[a:b]) for a, b in pairwise(starts)] == before
