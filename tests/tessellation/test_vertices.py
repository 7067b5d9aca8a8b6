"""Numbering of shared vertices in 2D, for any number of cells at a vertex."""

import numpy as np
import pytest

import clvoro
from tests.tessellation.test_diagram import check_invariants

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
        check_invariants(adapter.diagram(BOX, points), float(np.finfo(dtype).eps))


@pytest.mark.sparse
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
