"""Write a file completely or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import IO

from ..errors import InputError, OutputError

_KEPT = 40
"""Characters of a file's name in the name of its temporary file; each has up to four bytes of at most 255."""


def check_writable(path: str | PathLike[str]) -> None:
    """Check before a long run that a file can be written to `path`, or to a folder `path`.

    A temporary file is created there and removed.
    """
    path = Path(path)
    with writing(path):
        target = path / "any" if path.is_dir() else _target(path)
        temporary = _temporary_name(target)
        os.close(_create(temporary))
        os.unlink(temporary)


def make_folder(path: str | PathLike[str]) -> None:
    """Create the folder `path` and its parents, if they do not exist.

    Raises `InputError` if it cannot be created.
    """
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: the folder cannot be created ({error.strerror}); choose another place"
        ) from error


@contextlib.contextmanager
def atomic_file(path: str | PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a temporary file beside `path`, and rename it to `path` when the block ends without an error.

    The bytes are on the disk (fsync) before the file is renamed. If the block raises, the temporary file is removed,
    and the file at `path` is unchanged.

    Raises `OutputError` if the file cannot be written: no such folder, no permission, no space.
    """
    path = Path(path)
    with writing(path):
        target = _target(path)
        temporary = _temporary_name(target)
        file = os.fdopen(_create(temporary), "w+b")
        try:
            with file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        _sync_folder(target.parent)


@contextlib.contextmanager
def atomic_folder(path: str | PathLike[str]) -> Iterator[Path]:
    """Like `atomic_file`, for writers that take a path: yields one in a temporary folder.

    All files that the block writes to that folder are moved beside `path`, the one with the name of `path` last.
    """
    path = Path(path)
    with writing(path):
        target = _target(path)
        folder = Path(tempfile.mkdtemp(prefix=f".{target.name[:_KEPT]}.", dir=target.parent))
        try:
            yield folder / target.name
            made = sorted(folder.iterdir(), key=lambda file: file.name == target.name)
            for file in made:
                with open(file, "rb+") as handle:
                    os.fsync(handle.fileno())
            for file in made:
                os.replace(file, target.parent / file.name)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        _sync_folder(target.parent)


def _target(path: Path) -> Path:
    """Return the target of `path` through symbolic links; refuse it if it is not a regular file in a folder."""
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {target.parent}; create it first")
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        kind = "a folder" if target.is_dir() else "not a regular file"
        raise OutputError(f"cannot write {path}: it is {kind}; choose another name")
    return target


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.name[:_KEPT]}.{secrets.token_hex(4)}.tmp")


def _create(path: Path) -> int:
    """Create the new file `path` with the permissions of the user's umask."""
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert errors of the operating system into an OutputError with `path` and a remedy."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot write {path}: {error.strerror or error}; choose a place that is writable and has space"
        ) from error


def _sync_folder(folder: Path) -> None:
    """Write the new name to the disk (fsync), where the system supports that."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
