"""The progress of a run: one line that changes in place, or a new line from time to time. Names of other long work."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TextIO, TypeVar, cast

import numpy as np

EVERY = 5.0
"""Seconds between new lines in a file or a pipe."""
REFRESH = 0.1
"""Seconds between changes of the line on a terminal."""
LONG = 2.0
"""Seconds after which work outside of a run is named."""
PACED = 4
"""Steps before the remaining time is shown: the first ones build kernels."""

T = TypeVar("T")


def during(text: str, quiet: bool, task: Callable[[], T]) -> T:
    """Return what `task` returns; print `text` on the standard error if it takes long, unless `quiet`."""
    timer = threading.Timer(LONG, lambda: print(text, file=sys.stderr, flush=True))
    timer.daemon = True
    if not quiet:
        timer.start()
    try:
        return task()
    finally:
        timer.cancel()


class ProgressDisplay:
    """Shows the rows of the history of a run; call it with each row.

    - `title`: the case and its method.
    - `max_steps`: largest number of steps, if known. A run may stop earlier, so the remaining time is a bound.
    - `stream`: usually the standard error.
    """

    def __init__(self, title: str, max_steps: int | None, stream: TextIO | None = None) -> None:
        self.title, self.max_steps = title, max_steps
        self.stream = sys.stderr if stream is None else stream
        self.steps, self._cells = -1, 0
        # For each step of the latter half of the time: seconds, completed share, and number of cells moved so far.
        self._past: deque[tuple[float, float, int]] = deque()
        self._shown, self._began = 0.0, time.monotonic()
        self.live = self.stream.isatty()

    def __enter__(self) -> ProgressDisplay:
        self._change(f"{self.title}: preparing")
        if self.live:
            self._shown = time.monotonic() - REFRESH
        return self

    def __exit__(self, *_: object) -> None:
        if self.live and self._shown:
            self.stream.write("\r\x1b[K")
            self.stream.flush()

    def __call__(self, row: np.void) -> None:
        """Show `row`, a row of `HISTORY_DTYPE`, but not too often."""
        self.steps += 1
        if self.steps > 0:
            self._cells += int(row["cells"])
            self._past.append((float(row["seconds"]), self._done(row), self._cells))
            while len(self._past) > PACED + 1 and self._past[1][0] <= row["seconds"] / 2:
                self._past.popleft()
        now = time.monotonic()
        if now - self._shown < (REFRESH if self.live else EVERY):
            return
        if not self.live and now - self._began < EVERY:
            return  # no progress lines in a log for short runs
        self._shown = now
        text = self.line(row)
        self._change(text)
        if not self.live:
            self.stream.write(text + "\n")
            self.stream.flush()

    def show_builds(self, built: int, total: int) -> None:
        """Show how many of the kernels of a first run are built."""
        self._change(f"{self.title}: building kernels, once for this device: {built} of {total}")

    def show_work(self, part: str) -> None:
        """Show a part of the work after the last step."""
        text = f"{self.title}: {part}"
        self._change(text)
        now = time.monotonic()
        if not self.live and min(now - self._shown, now - self._began) >= EVERY:
            self._shown = now
            self.tell(text)

    def tell(self, text: str) -> None:
        """Write a permanent line above the changing one."""
        self.stream.write(f"\r{text}\x1b[K\n" if self.live else f"{text}\n")
        self.stream.flush()

    def _change(self, text: str) -> None:
        """Replace the text of the changing line, if there is one."""
        if self.live:
            columns = shutil.get_terminal_size().columns
            self.stream.write(f"\r{text[: columns - 1]}\x1b[K")
            self.stream.flush()

    def line(self, row: np.void) -> str:
        """Return the text for `row`: step, errors, quality, cells per second, time left."""
        level = f" level {row['level']}" if row["level"] else ""
        of = f" ({row['progress']:.0%})" if self.max_steps is None else f"/{self.max_steps}"
        # Short enough for 80 columns with a title of some 15.
        parts = [
            f"{self.title}{level} {self.steps}{of}",
            f"|e| {row['mean_error']:.4f} max {row['max_error']:.2g}",
            f"Q {row['mean_quality']:.3f} min {row['min_quality']:.2f}",
        ]
        if len(self._past) > 1:
            # The speed of the latter half: the first steps include builds of kernels.
            began, done_then, cells = self._past[0]
            seconds, done = float(row["seconds"]) - began, self._done(row) - done_then
            if seconds > 0:
                parts.append(f"{_short((self._cells - cells) / seconds)} cells/s")
            if seconds > 0 and done > 0 and len(self._past) > PACED:
                parts.append(f"{_duration(seconds * (1 - done - done_then) / done)} left")
        return "  ".join(parts)

    def _done(self, row: np.void) -> float:
        """Lower bound of the completed share of the work."""
        return max(float(row["progress"]), self.steps / self.max_steps if self.max_steps else 0.0)


def _short(number: float) -> str:
    """Format a number with three significant digits and k or M."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if number >= size:
            return f"{number / size:.3g}{unit}"
    return f"{number:.3g}"


def _duration(seconds: float) -> str:
    """Format a time in seconds, minutes or hours."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes / 60:.1f} h"


class Steady:
    """A text stream whose writes never fail; after an error the text is lost.

    - `error`: the first error; later text is lost.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.error = stream, None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write `text`, with escapes for unsupported characters."""
        known = getattr(self.stream, "encoding", None) or "utf-8"
        with self._going_on():
            self.stream.write(text.encode(known, "backslashreplace").decode(known))
        return len(text)

    def flush(self) -> None:
        """Flush the stream."""
        with self._going_on():
            self.stream.flush()

    @contextlib.contextmanager
    def _going_on(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
            # Its buffer would fail again when the process ends.
            with contextlib.suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.stream.fileno())
        except RuntimeError:  # called by a signal handler during another write
            pass


@contextlib.contextmanager
def steady_streams() -> Iterator[Steady]:
    """Replace `sys.stdout` and `sys.stderr` by `Steady` streams; yield the former.

    A stream that was closed when the process began discards its text.
    """
    with contextlib.ExitStack() as stack:
        kept, steady = (sys.stdout, sys.stderr), []
        for stream in kept:
            if stream is None:
                stream = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
            steady.append(Steady(stream))
        sys.stdout, sys.stderr = cast("list[TextIO]", steady)
        try:
            yield steady[0]
        finally:
            for stream in steady:
                stream.flush()
            sys.stdout, sys.stderr = kept
