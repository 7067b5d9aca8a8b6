"""The last row of the history describes the returned mesh, for any kind of run and any end."""

import contextlib
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

import clvoro
from clvoro import sizing

FLAT, SOLID = clvoro.Box((0, 0), (1.5, 1)), clvoro.Box((0, 0, 0), (1, 1, 1))
TORUS = clvoro.Box((0, 0), (1.5, 1), periodic=True)
HOUSE = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1.8), (0, 1)])
SIZE = sizing.Expression("0.08 + 0.05 * x")
DOMAINS = {"flat": FLAT, "solid": SOLID, "torus": TORUS, "house": HOUSE}


@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_diagram_is_computed_again_at_the_end(ctx, dtype):
    """In a periodic box: four cells meet at each corner but for rounding, and which two of them share a face is one of
    the things that the last step and the end decide each for itself. Quality counts the sides."""
    eps = float(np.finfo(dtype).eps)
    adapter = clvoro.Adapter(ctx, dtype)
    middles = (np.stack(np.meshgrid(np.arange(12), np.arange(12)), -1).reshape(-1, 2) + 0.5) / 12
    others = 0
    for seed in range(4):
        rows = []
        points = middles + 3 * eps * np.random.default_rng(seed).standard_normal((144, 2))
        result = adapter.run(
            clvoro.Box((0, 0), (1, 1), periodic=True),
            1 / 12,
            points=points,
            method="lloyd",
            max_steps=3,
            options=clvoro.PaperOptions(tol=0),
            callback=lambda row, rows=rows: rows.append(row),
        )
        result.check().demand()
        assert len(result.history) == len(rows) == 4
        others += abs(rows[-1]["mean_quality"] - result.quality.mean()) > 1e-4
    assert others > 0, "the last step and the end have decided alike: nothing is tried here"


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("kind", "levels", "stopped"), [(kind, 0, 0) for kind in DOMAINS] + [("flat", 0, 1), ("flat", 1, 0), ("flat", 1, 1)]
)
def test_sizes_are_scaled_after_the_last_row(adapter, kind, levels, stopped):
    """Before the first step, and on coarser levels, sizes are not scaled yet."""
    count = 600 if kind == "solid" else 300
    by_callback = {"callback": lambda row: row["step"] == stopped}
    for options in ({"max_steps": stopped}, by_callback):
        result = adapter.run(
            DOMAINS[kind],
            SIZE,
            n_cells=count,
            options=clvoro.MultilevelOptions(levels=levels),
            effort="fast",
            seed=3,
            **options,
        )
        result.check().demand()
        assert len(result.points) == count
        h = result.history
        one_more = [stopped] if levels or not stopped else []
        assert h["step"].tolist() == [*range(stopped + 1), *one_more]
        if not (levels or stopped):
            assert h["mean_error"][0] != h["mean_error"][1]


def test_insertions_and_deletions_match_the_labels(adapter):
    """Insertions and deletions explain the numbers of cells of all rows, and the generators at the end."""
    result = adapter.run(FLAT, SIZE, options=clvoro.MultilevelOptions(levels=1), seed=5)
    h, origin = result.history, result.origin
    assert h["inserted"].sum() > 0
    assert h["deleted"].sum() > 0
    assert h["cells"][0] + h["inserted"].sum() - h["deleted"].sum() == len(result.points)
    assert (origin < 0).sum() <= h["inserted"].sum()
    result.check().demand()
    changed = h.copy()
    changed["deleted"][np.argmax(h["deleted"])] += 1
    assert "deleted" in str(dataclasses.replace(result, history=changed).check())


# Interruptions at any line.


OWN = ("run.py", "state.py", "images.py", "methods.py", "tessellator.py")


class Pressed:
    """Raise Ctrl-C at the nth executed line of clvoro's modules `OWN`, and count all executed lines."""

    def __init__(self, nth=None):
        self.nth, self.lines = nth, 0

    def __enter__(self):
        self.before = sys.gettrace()
        sys.settrace(self.called)
        return self

    def __exit__(self, *error):
        sys.settrace(self.before)

    def called(self, frame, event, argument):
        path = Path(frame.f_code.co_filename)
        return self.went if path.name in OWN and "clvoro" in path.parts else None

    def went(self, frame, event, argument):
        if event == "line":
            self.lines += 1
            if self.lines == self.nth:
                raise KeyboardInterrupt
        return self.went


RUNS = {
    "counted": (FLAT, {"n_cells": 260, "options": clvoro.MultilevelOptions(levels=1)}),
    "exact": (FLAT, {"method": "exact", "options": clvoro.MultilevelOptions(levels=0), "max_steps": 20}),
    "coupled": (HOUSE, {"method": "coupled", "max_steps": 6}),
    "torus": (TORUS, {"options": clvoro.MultilevelOptions(levels=0), "n_cells": 260, "max_steps": 15}),
    "solid": (SOLID, {"options": clvoro.MultilevelOptions(levels=1), "max_steps": 42}),
    "layers": (FLAT, {"layers": clvoro.Layers(0.03, count=2), "options": clvoro.MultilevelOptions(levels=1)}),
}


def test_the_last_row_is_that_of_the_mesh_with_layers_and_a_number_of_cells(adapter):
    result = adapter.run(FLAT, SIZE, "fast", n_cells=400, **RUNS["layers"][1])
    assert len(result.points) == 400
    assert result.check(), result.check()


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(RUNS))
def test_interruption_at_any_line(adapter, kind):
    """During a step, a refinement or a correction of the count: the mesh is valid, and its history ends with it."""
    (domain, options), times = RUNS[kind], 40
    options = {"effort": "fast", "seed": 9, **options}
    with Pressed() as counted:
        adapter.run(domain, SIZE, **options)
    came = 0
    # A few come before the run has begun or after it has ended: the caller gets those unchanged.
    for nth in np.random.default_rng(31).integers(counted.lines, size=times):
        with contextlib.suppress(KeyboardInterrupt), Pressed(int(nth) + 1):
            try:
                result = adapter.run(domain, SIZE, **options)
            except clvoro.Interrupted as stopped:
                result = stopped.result
            came += 1
            assert result.stop_reason == "interrupted"
            assert result.check(), f"{nth}: {result.check()}"
            assert len(result.points) == options.get("n_cells", len(result.points))
    assert came >= times // 2
