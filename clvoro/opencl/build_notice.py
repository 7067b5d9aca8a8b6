"""A line on the terminal while a first run builds kernels."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .prebuild import build_ahead

if TYPE_CHECKING:
    from .engine import Engine

PATIENCE = 0.5
"""Seconds that kernels are built before a line on the terminal says so."""


class BuildNotice:
    """A line on the terminal while kernels are built; it is cleared before anything else is printed.

    - `total`: kernels that the run will need.
    """

    def __init__(self, total: int) -> None:
        self._total = total
        self._shown = False
        self._began = time.monotonic()

    def show(self, built: int) -> None:
        """Show the number of kernels that are `built`."""
        if time.monotonic() - self._began < PATIENCE:
            return
        text = f"clvoro builds kernels, once for this device: {built} of {self._total}"
        columns = shutil.get_terminal_size().columns
        self._write(f"\r{text[: columns - 1]}\x1b[K")
        self._shown = True
        if built >= self._total:
            self.clear()

    def clear(self, row: object = None) -> None:
        """Clear the line. `row`, a row of the history, is ignored."""
        if self._shown:
            self._write("\r\x1b[K")
            self._shown = False

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


@contextmanager
def report_builds(
    engine: Engine, on_build: Callable[[int, int], object] | None, job: str = ""
) -> Iterator[BuildNotice | None]:
    """Let workers build kernels of a first run, and report the progress inside the ``with`` block.

    - `on_build`: called with the number of kernels built and of all. With None, the standard error shows a line if it
      is a terminal.
    - `job`: what is done in place of a run: "transport".

    Return the line, if there is one.
    """
    total, notice = build_ahead(engine, job), None
    if total and on_build is None and sys.stderr is not None and sys.stderr.isatty():
        notice = BuildNotice(total)
        on_build = lambda built, _: notice.show(built)  # noqa: E731
    if total and on_build is not None:
        report = on_build
        engine.pool.on_kernel = lambda built: report(min(built, total), total)
    try:
        yield notice
    finally:
        engine.pool.on_kernel = None
        if notice is not None:
            notice.clear()
