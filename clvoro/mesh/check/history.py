"""Check of the history of a run: order of its rows, and the last row against the mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..results import Result
    from .findings import Check

LOOSE = 256 * float(np.finfo(np.float32).eps)
"""Tolerance of means in the history, in any precision: the device sums the quality in float32."""


def check_history(check: Check, result: Result, rounding: float) -> None:
    """Check numbers and order of the history, and its last row against the mesh: errors up to `rounding`."""
    rows = result.history
    if not len(rows):  # read from a .vtu file
        return
    for name in rows.dtype.names or ():
        values = rows[name]
        least = int(name == "cells")  # all others are at least 0
        check.note(
            "history",
            ~(np.isfinite(values) & (values >= least)),
            lambda r, name=name, values=values: f"{name} in row {r} of the history is {values[r]}",
        )
    # A second row may follow the last step.
    steps = rows["step"].astype(np.int64)
    rises = np.diff(steps)
    wrong = rises != 1
    wrong[-1:] &= rises[-1:] != 0
    check.note("history", wrong, lambda r: f"row {r + 1} of the history is step {steps[r + 1]}, after {steps[r]}")
    for name, sign in (("level", -1), ("progress", 1), ("seconds", 1)):
        values = rows[name].astype(float)
        check.note(
            "history",
            np.diff(values) * sign < 0,
            lambda r, name=name, values=values: (
                f"{name} in row {r + 1} of the history is {values[r + 1]}, after {values[r]}"
            ),
        )
    cells, inserted, deleted = (rows[name].astype(np.int64) for name in ("cells", "inserted", "deleted"))
    check.note(
        "history",
        np.diff(cells) != (inserted - deleted)[1:],
        lambda r: (
            f"row {r + 1} of the history has {cells[r + 1]} cells, after {cells[r]}, of {inserted[r + 1]} "
            f"inserted and {deleted[r + 1]} deleted"
        ),
    )
    check.note(
        "history",
        [rows["cells"][-1] != len(result.points)],
        lambda _: f"the history ends with {rows['cells'][-1]} cells, the mesh has {len(result.points)}",
    )
    check.note(
        "history", [rows["level"][-1] != 0], lambda _: f"the history ends on level {rows['level'][-1]}, expected 0"
    )
    error = np.abs(result.size_error)
    expected = {
        "mean_error": error.mean(),
        "max_error": error.max(),
        "mean_quality": result.quality.mean(),
        "min_quality": result.quality.min(),
    }
    for name, value in expected.items():
        last = rows[name][-1]
        check.note(
            "history",
            [not abs(last - value) <= LOOSE * abs(value) + rounding],
            lambda _, name=name, last=last, value=value: f"{name} ends with {last:.6g}, the mesh has {value:.6g}",
        )
