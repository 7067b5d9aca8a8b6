"""Standard streams that never end a run: closed streams, full disks, closed pipes, unsupported characters."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast


class Steady:
    """A text stream whose writes never fail; after an error the text is lost.

    Attributes
    ----------
    error : OSError or None
        The first error; later text is lost.
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
