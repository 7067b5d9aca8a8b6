"""Open the files that a caller names, if they are regular: pipes may block, devices may have no end. Arrays as text."""

from __future__ import annotations

import base64
import errno
import logging
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from os import PathLike

import numpy as np

LONGEST_GEOMETRY = 1 << 28
"""Largest size of a polygon's file in bytes: enough for the coasts of the Earth at a resolution of 100 meters."""
_PIECE = 1 << 20
# Opens a pipe without waiting for its writer; without effect on regular files.
_NOWAIT = getattr(os, "O_NONBLOCK", 0)


def open_plain(path: str | PathLike[str]) -> BufferedReader:
    """Open a regular file for reading, through symbolic links. All readers of the package use it.

    Raises `OSError` if the file cannot be opened, or is a folder, pipe, socket or device: these block or are endless.
    """
    if "\0" in os.fsdecode(path):
        raise OSError(errno.EINVAL, "its name has zero bytes", os.fsdecode(path))
    _check_plain(path, os.stat(path))  # first, because some devices react to being opened
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | _NOWAIT))
    try:
        _check_plain(path, os.fstat(file.fileno()))  # again, because the file may have been replaced
    except OSError:
        file.close()
        raise
    return file


@contextmanager
def unlogged(library: str) -> Iterator[None]:
    """Keep the log messages of a library off the terminal. Handlers of the user still receive them."""
    log, nowhere = logging.getLogger(library), logging.NullHandler()
    was, log.propagate = log.propagate, False
    log.addHandler(nowhere)
    try:
        yield
    finally:
        log.removeHandler(nowhere)
        log.propagate = was


def read_text(path: str | PathLike[str], longest: int) -> str:
    """Return the text of a regular file in UTF-8, with or without a byte order mark.

    Raises `OSError`, as `open_plain`, or if the file has more than `longest` bytes. Raises `UnicodeDecodeError` if the
    file is not in UTF-8.
    """
    found = bytearray()
    with open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        while size <= longest and (piece := file.read(_PIECE)):
            found += piece
            size = max(size, len(found))  # files of some systems have a size of 0
    if size > longest:
        raise OSError(errno.EFBIG, f"it is longer than {longest} bytes", os.fsdecode(path))
    return found.decode("utf-8-sig")


def _check_plain(path: str | PathLike[str], found: os.stat_result) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fsdecode(path))
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is a pipe, socket or device, not a regular file", os.fsdecode(path))


def pack_array(array: np.ndarray, dtype: str) -> str:
    """Return an array as compressed text."""
    return base64.b64encode(zlib.compress(np.ascontiguousarray(array, dtype).tobytes(), 6)).decode("ascii")


def unpack_array(text: str, dtype: str) -> np.ndarray:
    """Return the array (n,) of a text of `pack_array`."""
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).copy()
