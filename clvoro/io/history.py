"""The history of a run as a table for spreadsheets."""

from __future__ import annotations

import csv
import io
from os import PathLike

from ..mesh.results import Result
from .atomic import atomic_file


def write_history(result: Result, path: str | PathLike[str]) -> None:
    """Write `result.history` as CSV: a line of names, then one line per step.

    Floats have as many digits as are needed to read them back exactly.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with atomic_file(path) as file:
        text = io.TextIOWrapper(file, encoding="ascii", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(result.history.dtype.names or ())
        writer.writerows(result.history.tolist())
        text.flush()
        text.detach()
