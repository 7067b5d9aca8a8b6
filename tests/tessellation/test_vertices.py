"""Numbering of shared vertices in 2D, for any number of cells at a vertex."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.device_diagram import Tessellation
from clvoro.tessellation.vertices import MOST_AROUND, VertexNumbering
from tests.reference.diagrams import faults

BOX = clvoro.Box((0, 0), (1, 1))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_many_cells_at_one_point_of_a_wall(ctx, dtype):
    """Up to round-off: some cells touch the wall there, others do not."""
    rng, adapter = np.random.default_rng(61101), clvoro.Adapter(ctx, dtype)
    turn = np.pi * (np.arange(9) + 0.5) / 9
    for _ in range(16):
        ring = rng.uniform(0.2, 0.4) * np.column_stack([np.cos(turn), np.sin(turn)])
        points = (rng.uniform(0.45, 0.55, 2) * [1, 0] + ring)[rng.permutation(9)]
        points = points[:, ::-1] if rng.random() < 0.5 else points
        points = 1 - points if rng.random() < 0.5 else points
        assert not faults(adapter.diagram(BOX, points))


@pytest.mark.sparse(1)
# At 900 and 1030 round-off makes faces that cross, for some turns.
@pytest.mark.parametrize("n", [300, 900, 1030, 2000])
@pytest.mark.parametrize("turn", [0.0, 0.1, 0.3])
def test_faces_of_very_many_cells_at_one_vertex_do_not_cross(ctx, n, turn):
    angle = 2 * np.pi * np.arange(n) / n + turn
    circle = 0.5 + 0.4 * np.column_stack([np.cos(angle), np.sin(angle)])
    diagram = clvoro.Adapter(ctx).diagram(BOX, circle)
    assert diagram.check()
    assert "Euler's formula" in diagram.check().checked


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_crossing_faces_are_dropped(ctx, dtype):
    from tests.robustness.oclgrind_work import drop_loops

    drop_loops(clvoro.Adapter(ctx, dtype))


def wheel_of(n, twice):
    """Return a graph of n cells around a vertex, of two corners each: starts and neighbors.

    With `twice`, the first cell lists the second again, and a walk returns to the wrong corner of it.
    """
    cells = np.arange(n)
    rows = [list(row) for row in zip((cells + 1) % n, (cells - 1) % n, strict=True)]
    rows[0] += [1] * twice
    starts = np.cumsum([0, *map(len, rows)])
    return starts.astype(np.int32), np.concatenate(rows).astype(np.int32)


@pytest.mark.sparse(1)
@pytest.mark.parametrize(
    ("n", "twice", "ends"), [(50, False, True), (MOST_AROUND + 2, False, False), (50, True, False)]
)
def test_walks_around_a_vertex_end(ctx, n, twice, ends):
    """A graph that leads around forever, or around too many cells, is an error and does not hang."""
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(float))
    starts, neighbors = (engine.upload(a, np.int32) for a in wheel_of(n, twice))
    points = engine.upload(np.random.default_rng(1).random((n, 2)))
    t = Tessellation(n, points, starts, neighbors, *[points] * 5)
    if ends:
        VertexNumbering(engine).number(BOX, t)
        return
    with pytest.raises(clvoro.ClvoroError, match="10000 cells meet at a vertex of the cell of"):
        VertexNumbering(engine).number(BOX, t)
