"""Read and write NumPy arrays in zip files, without trusting the files; for `npz.py` and checkpoints."""

from __future__ import annotations

import threading
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedIOBase
from os import PathLike, fspath, fstat
from pathlib import Path
from typing import cast

import numpy as np

from ..errors import ClvoroError, InputError
from ..files import open_plain
from .atomic import atomic_file

EXPANSION, LEAST = 16, 1 << 22
"""Largest ratio of the expanded to the compressed size of a file, and a number of bytes that is always allowed. Meshes
compress by a factor of two or three, lattices by nine."""
_FLATTEST, _SMALL = 256, 1 << 24  # the same for one array, which may be nearly constant
_PIECE = 1 << 22  # bytes per read
_parsing = threading.Lock()  # Python 3.11 may fail where two threads make syntax trees, as NumPy does of headers


class FileError(Exception):
    """The fault of a file. `explained` and the readers of formats add the file's name."""


@contextmanager
def explained(path: str | PathLike[str], expected: str) -> Iterator[None]:
    """Convert errors while reading `path` into an InputError with the file's name and the expected content."""
    name = fspath(path)
    try:
        yield
    except ClvoroError as error:
        if name in str(error):
            raise
        raise InputError(f"cannot load {name}: {error}") from error
    except FileError as problem:
        raise InputError(f"cannot load {name}: {problem}") from problem
    except zipfile.BadZipFile as error:
        raise InputError(
            f"cannot load {name}: it is another kind of file, damaged or truncated ({error}), expected {expected}"
        ) from error
    except OSError as error:
        raise InputError(f"cannot load {name}: {error.strerror or error}") from error
    except Exception as error:  # readers of damaged files raise many kinds
        raise InputError(f"cannot load {name}: it is damaged or not {expected} ({error!r:.200})") from error


def write_arrays(
    path: str | PathLike[str], kind: str, version: int, arrays: Mapping[str, object], compress: bool = True
) -> None:
    """Write `arrays` by name, completely or not at all. Equal arrays give equal bytes."""
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with (
        atomic_file(path) as file,
        # Coordinates barely compress. Graphs do, at any level.
        zipfile.ZipFile(file, "w", method, compresslevel=1) as archive,
    ):
        for name, array in {"format": kind, "version": version, **arrays}.items():
            # ZipInfo has a fixed date, so the bytes do not depend on the clock.
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = method
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def read_arrays(path: str | PathLike[str], kind: str, version: int) -> dict[str, np.ndarray]:
    """Read all arrays that `write_arrays` wrote. Checksums cover every byte."""
    with explained(path, f"a {kind}"), open_plain(path) as file, zipfile.ZipFile(file) as archive:
        members = list_members(archive, kind, version)
        return {name: read_member(archive, info) for name, info in members.items()}


def is_kind(path: str | PathLike[str], kind: str) -> bool:
    """Return whether `path` is a file of this kind from `write_arrays`, of any version."""
    try:
        with explained(path, f"a {kind}"), open_plain(path) as file, zipfile.ZipFile(file) as archive:
            found = read_member(archive, archive.getinfo("format.npy"))
            return bool(found.shape == () and found.item() == kind)
    except InputError:
        return False


def list_members(archive: zipfile.ZipFile, kind: str, version: int) -> dict[str, zipfile.ZipInfo]:
    """Return the members by name, after checks of the kind, the version and the expanded size of the file."""
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    check_expansion(archive, archive.infolist(), EXPANSION, LEAST)
    if "format" not in members or "version" not in members:
        raise FileError(f"it is not a {kind} (members: {', '.join(sorted(members)[:6]):.200})")
    found = read_member(archive, members["format"])
    if found.dtype.kind != "U" or found.shape != () or found.item() != kind:
        raise FileError(f"its format is {found!r:.60}, expected {kind!r}")
    number = read_member(archive, members["version"])
    if number.dtype.kind not in "iu" or number.shape != ():
        raise FileError(f"its version is {number!r:.60}, expected an integer")
    if number.item() < 1:
        raise FileError(f"its version is {number.item()}, expected 1 to {version}")
    if number.item() > version:
        raise FileError(f"its version is {number.item()}, expected at most {version}; install a newer clvoro")
    return members


def check_expansion(archive: zipfile.ZipFile, members: Iterable[zipfile.ZipInfo], most: int, least: int) -> None:
    """Refuse members whose expanded size is far larger than the file."""
    held = sum(info.file_size for info in members)
    # The compressed sizes in the archive's directory are not trusted.
    there = fstat(archive.fp.fileno()).st_size if archive.fp else 0
    if held > max(least, most * there):
        raise FileError(f"its {there} bytes expand to {held}, more than {most} times as many")


def read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one array. Its size is checked against that of the member before memory is allocated."""
    with archive.open(info) as stream:
        return _read(cast(BufferedIOBase, stream), info.filename, info.file_size)


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays in a `.npz` file."""
    with open_plain(path) as file, zipfile.ZipFile(file) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read_array(path: Path, member: str = "points") -> np.ndarray:
    """Read an array from a `.npy` file, or the array `member` from a `.npz` file.

    Raises `InputError` if there is no such file, it does not have the array, or the array holds Python objects.
    """
    with explained(path, "a .npy file"), open_plain(path) as file:
        if file.read(4) == b"PK\x03\x04":
            with zipfile.ZipFile(file) as archive:
                if f"{member}.npy" not in archive.namelist():
                    raise FileError(f"it has no array {member!r}")
                info = archive.getinfo(f"{member}.npy")
                check_expansion(archive, [info], _FLATTEST, _SMALL)
                return read_member(archive, info)
        file.seek(0)
        return _read(file, Path(path).name, fstat(file.fileno()).st_size)


def _read(stream: BufferedIOBase, name: str, size: int) -> np.ndarray:
    try:
        shape, fortran, dtype = _read_header(stream)
    except Exception as error:  # NumPy parses the header as Python source, which raises many errors
        raise FileError(f"{name} is not an array ({error!s:.200})") from error
    if dtype.hasobject:
        raise FileError(f"{name} has pickled Python objects, which can run any program; they are never loaded")
    count = 1
    for extent in shape:  # Python's integers do not overflow
        count *= extent
    length = count * dtype.itemsize
    if min(shape, default=1) < 0 or length != size - stream.tell() or not dtype.itemsize:
        raise FileError(f"{name} does not have the length of its shape {shape!s:.60}")
    data = np.empty(length, np.uint8)  # read in place, without a copy as bytes
    whole = data.data
    done = 0
    while done < length and (more := stream.readinto(whole[done : done + _PIECE])):
        done += more
    if done < length or stream.read(1):  # the read at the end also checks the checksum
        raise FileError(f"{name} is truncated")
    array = data.view(dtype).reshape(shape, order="F" if fortran else "C")
    return np.asarray(array, order="C")


def _read_header(stream: BufferedIOBase) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    with _parsing:
        if version == (1, 0):
            return np.lib.format.read_array_header_1_0(stream)
        if version == (2, 0):
            return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"its header's version is {version}")
