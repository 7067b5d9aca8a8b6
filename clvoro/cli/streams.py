"""Standard streams that end no run: missing or closed ones, full disks, readers that went away, characters unknown."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast


class Steady:
    """A text stream to which everything can be written, though it may be lost.

    Attributes
    ----------
    error : OSError or None
        Why what was written since is lost.
    """

    def __init__(self, stream: TextIO) -> None:
        self.stream, self.error = stream, None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        """Write `text`, with escapes for what the stream has no characters for."""
        known = getattr(self.stream, "encoding", None) or "utf-8"
        with self._going_on():
            self.stream.write(text.encode(known, "backslashreplace").decode(known))
        return len(text)

    def flush(self) -> None:
        """Hand on what has been written."""
        with self._going_on():
            self.stream.flush()

    @contextlib.contextmanager
    def _going_on(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
            # What is in its buffer would fail once more when the process ends.
            with contextlib.suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), self.stream.fileno())
        except RuntimeError:  # by a signal's handler, in the middle of another message
            pass


@contextlib.contextmanager
def steady_streams() -> Iterator[Steady]:
    """Have `sys.stdout` and `sys.stderr` be `Steady`; yields the former.

    A stream that is missing, as it was closed when the process began, is one that leads nowhere.
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
