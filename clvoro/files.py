"""Open files that others wrote: plain files only, which neither wait for somebody nor go on for ever."""

from __future__ import annotations

import errno
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from os import PathLike

LONGEST_GEOMETRY = 1 << 28
"""Bytes of a polygon's file: the coasts of the whole Earth, at some hundred meters, take fewer."""
_PIECE = 1 << 20
# A pipe is opened without waiting for whoever writes into it; plain files take no notice.
_NOWAIT = getattr(os, "O_NONBLOCK", 0)


def open_plain(path: str | PathLike[str]) -> BufferedReader:
    """Open a plain file for reading, through symbolic links; every reader of the package does so.

    Raises
    ------
    OSError
        If it cannot be opened, or is a folder, pipe, socket or device: these block, or have no end.
    """
    if "\0" in os.fsdecode(path):
        raise OSError(errno.EINVAL, "its name has zero bytes", os.fsdecode(path))
    _check_plain(path, os.stat(path))  # before it is opened, which does something to some devices
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NOWAIT))
    try:
        _check_plain(path, os.fstat(file.fileno()))  # it may be another one by now
    except OSError:
        file.close()
        raise
    return file


@contextmanager
def unlogged(library: str) -> Iterator[None]:
    """Keep what a library logs from being printed: how its reader got into trouble, beside what we say of it.

    Who has a handler of his own on its log goes on to see it.
    """
    log, nowhere = logging.getLogger(library), logging.NullHandler()
    was, log.propagate = log.propagate, False
    log.addHandler(nowhere)
    try:
        yield
    finally:
        log.removeHandler(nowhere)
        log.propagate = was


def read_text(path: str | PathLike[str], longest: int) -> str:
    """Return the text of a plain file in UTF-8, with or without a byte order mark.

    Raises
    ------
    OSError
        As `open_plain`, or if the file holds more than `longest` bytes.
    UnicodeDecodeError
        If it is no text.
    """
    found = bytearray()
    with open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        while size <= longest and (piece := file.read(_PIECE)):
            found += piece
            size = max(size, len(found))  # some systems' own files say that they are empty
    if size > longest:
        raise OSError(errno.EFBIG, f"it is longer than {longest} bytes", os.fsdecode(path))
    return found.decode("utf-8-sig")


def _check_plain(path: str | PathLike[str], found: os.stat_result) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fsdecode(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(
            errno.EINVAL, "it is a pipe, socket or device, no plain file", os.fsdecode(path)
        )
