"""The marks that an incremental update withdraws, on constructed rows."""

import numpy as np
import pytest

from clvoro.tessellation import report
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.cells import SLOT, Cells
from clvoro.tessellation.incremental import IncrementalUpdate
from clvoro.tessellation.part import Part
from tests.reference import patch


@pytest.mark.parametrize("again", [False, True], ids=["at first", "again"])
def test_a_former_neighbor_of_a_clipped_cell_loses_its_mark(ctx, again):
    """A row lists a generator that is no neighbor, and that may count as correct by the old row.

    After all cells of a round are clipped, former neighbors in old rows lose their marks.
    """
    engine, n, i = patch.make_engine(ctx), 40, 17
    points = patch.relaxed_points(n, 2501)
    x, cells, incremental = engine.upload(points), Cells(engine), IncrementalUpdate(engine)
    t = cells.tessellate(Part.alone(x, patch.BOX), Bins(engine).build(patch.BOX, x, n), exact=False)
    incremental.update(cells, patch.BOX, x, t)  # has the kernels made
    (kernels,) = incremental._kernels.values()
    host = patch.fetch(t)
    rows = np.split(host.neighbors, host.starts[1:-1])
    # All inside, so that none is a wall; the surplus one is the farthest.
    stranger = int(np.linalg.norm(points - points[i], axis=1).argmax())
    assert stranger not in rows[i]
    wrong = np.append(rows[i], stranger).astype(np.int32)
    places, slots = np.full(n, -1, np.int32), np.zeros(2 * SLOT, np.int32)
    if again:
        places[i], slots[: len(wrong)] = 0, wrong
        old = t.starts, t.neighbors
    else:
        lengths = np.diff(host.starts) + (np.arange(n) == i)
        starts = np.concatenate([[0], np.cumsum(lengths)])
        listed = np.concatenate([wrong if k == i else row for k, row in enumerate(rows)])
        old = engine.upload(starts, np.int32), engine.upload(listed, np.int32)
    fits = engine.upload(np.ones(n), np.int32)
    slots = engine.upload(slots, np.int32)
    counts = engine.upload([len(wrong), 0], np.int32)
    # In the second round, after one clipped cell.
    given = np.zeros(report.SIZE)
    given[[3, report.LISTED + 1, report.LISTED + 2]], given[[report.SPARE, report.SLOTS]] = (1, 1, 2), 2
    engine.run_each(
        kernels.clip_marked,
        1,
        engine.upload([i], np.int32),
        np.int32(1),
        np.int32(n),
        engine.upload(places, np.int32),
        slots,
        counts,
        *old,
        x,
        *patch.BOX.device_corners(engine.real),
        fits,
        engine.upload(given, np.int32),
    )
    assert np.array_equal(slots.get()[SLOT:][: len(rows[i])], rows[i])
    assert counts.get()[1] == len(rows[i])
    expected = np.ones(n)
    if again:
        expected[stranger] = 0
    assert np.array_equal(fits.get(), expected)
