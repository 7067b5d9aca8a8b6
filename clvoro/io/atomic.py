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
"""Characters, of up to four bytes, that temporary names have of the file's: with more they may become too long."""


def check_writable(path: str | PathLike[str]) -> None:
    """Check, by trying, that a file can be written to `path`; for before a long run.

    A folder is checked for whether files can be made in it. Nothing is left behind.

    Raises
    ------
    OutputError
        If it cannot; says why.
    """
    path = Path(path)
    with writing(path):
        target = path / "any" if path.is_dir() else _target(path)
        temporary = _temporary_name(target)
        os.close(_create(temporary))
        os.unlink(temporary)


def make_folder(path: str | PathLike[str]) -> None:
    """Make the folder `path`, and those that it lies in, where there are none.

    Raises
    ------
    InputError
        If it cannot be made: the name is the caller's to choose.
    """
    try:
        os.makedirs(path, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot write {path}: no folder can be made there ({error.strerror}); choose another place"
        ) from error


@contextlib.contextmanager
def atomic_file(path: str | PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a temporary file beside `path`; put it in place when the block ends well.

    The bytes are on the disk (fsync) before the name points to them. If the block raises, the
    temporary file is removed and what was at `path` stays.

    Raises
    ------
    OutputError
        If the file cannot be written: no such folder, no right, no space.
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
    """Like `atomic_file`, for writers that want a name: yields a path in a folder of its own.

    What the block leaves in that folder is put beside `path`, the file of that name last.
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
    """Return where `path` leads, through symbolic links; refuse all but plain files in folders."""
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise OutputError(
            f"cannot write {path}: there is no folder {target.parent}; create it first"
        )
    if target.exists() and not stat.S_ISREG(target.stat().st_mode):
        kind = "a folder" if target.is_dir() else "no plain file"
        raise OutputError(f"cannot write {path}: it is {kind}; choose another name")
    return target


def _temporary_name(target: Path) -> Path:
    return target.with_name(f".{target.name[:_KEPT]}.{secrets.token_hex(4)}.tmp")


def _create(path: Path) -> int:
    """Create `path`, which must be new, with the rights that the user's umask leaves."""
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an operating system's error into one that names `path` and the remedy."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"cannot write {path}: {error.strerror or error}; choose a place that can be written "
            "and has space"
        ) from error


def _sync_folder(folder: Path) -> None:
    """Put the new name on the disk too, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
