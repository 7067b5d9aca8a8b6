"""The format that loses nothing: NumPy arrays in a zip file, read back without trusting it.

Members, each one array (`.npy`): `format`, `version`, `about` (JSON: domain, settings, and what of
a `Result` is a single value), the arrays of a `Result` under their names, `diagram.<name>` for
those of its `Diagram`, and `initial.<name>`, `final.<name>` for `Displacements`. `numpy.load` reads
it, too.
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..domain import Box
from ..errors import InputError
from ..results import HISTORY_DTYPE, Diagram, Displacements, Result
from .atomic import atomic_file

FORMAT, VERSION = "clvoro-result", 1

_DOMAINS = {"Box": Box}
_NEEDED = ("about", "points", "size", "error", "quality", "history", "diagram.points")
_FIELDS = tuple(field.name for field in dataclasses.fields(Result))
_PARTS = {
    "diagram": Diagram._NAMES,
    "initial": tuple(field.name for field in dataclasses.fields(Displacements)),
    "final": tuple(field.name for field in dataclasses.fields(Displacements)),
}

# What each array must look like: sizes named by a letter are the same everywhere (d: dimension).
_SHAPES = {
    "points": "nd", "size": "n", "error": "n", "quality": "n", "history": "h",
    "diagram.points": "nd", "diagram.volumes": "n", "diagram.centroids": "nd",
    "diagram.neighbour_starts": "N", "diagram.neighbours": "m", "diagram.face_measures": "m",
    "diagram.face_centroids": "md", "diagram.vertices": "vd", "diagram.cell_vertex_starts": "N",
    "diagram.cell_vertices": "c", "diagram.face_vertex_starts": "M", "diagram.face_vertices": "f",
    "initial.points": "nd", "initial.lloyd": "nd", "initial.poisson": "nd",
    "final.points": "nd", "final.lloyd": "nd", "final.poisson": "nd",
}  # fmt: skip


def write_npz(result: Result, path: Path) -> None:
    """Write all of `result` to `path`; the same result gives the same bytes."""
    diagram = result.diagram
    kind = type(diagram.domain).__name__
    about: dict[str, Any] = {
        "domain": {"kind": kind, **dataclasses.asdict(diagram.domain)},
        "settings": result.settings,
        "values": {},
    }
    arrays: dict[str, object] = {}
    for name in _FIELDS:
        value = getattr(result, name)
        if name in _PARTS:
            # A diagram knows which of its arrays it has; they are fetched here.
            names = getattr(value, "_arrays", _PARTS[name]) if value is not None else ()
            arrays |= {f"{name}.{k}": getattr(value, k) for k in _PARTS[name] if k in names}
        elif isinstance(value, np.ndarray):
            arrays[name] = value
        elif name != "settings":
            about["values"][name] = value
    arrays |= {"format": FORMAT, "version": VERSION, "about": json.dumps(about, default=_plain)}
    with (
        atomic_file(path) as file,
        # Coordinates hardly compress; the graphs do, at any level.
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            # ZipInfo's own date is fixed, unlike the clock's.
            member = zipfile.ZipInfo(f"{name}.npy")
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def load(path: str | PathLike[str]) -> Result:
    """Read a result that `Result.save` wrote to a ``.npz`` file.

    The file is not trusted: nothing in it is executed, sizes are compared with the bytes that are
    there before memory is asked for, and the arrays must fit each other.

    Raises
    ------
    InputError
        If the file is missing, damaged, cut off, of another format or of a newer version; names the
        file and what is wrong.
    """
    name = fspath(path)
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = _read_all(archive)
        _check(arrays)
        return _assemble(arrays)
    except _FileError as problem:
        raise InputError(f"cannot load {name}: {problem}") from problem
    except zipfile.BadZipFile as error:
        raise InputError(
            f"cannot load {name}: it is no .npz file, or damaged or cut off ({error}); expected a "
            "file written by Result.save"
        ) from error
    except (zlib.error, struct.error, EOFError, RuntimeError, ValueError, OverflowError) as error:
        raise InputError(f"cannot load {name}: it is damaged or foreign ({error})") from error
    except OSError as error:
        raise InputError(f"cannot load {name}: {error.strerror or error}") from error


class _FileError(Exception):
    """What is wrong with a file; `load` adds which one."""


def _read_all(archive: zipfile.ZipFile) -> dict[str, np.ndarray]:
    """Return the arrays of the file, after a look at what kind of file it is."""
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if "format" not in members or "version" not in members:
        raise _FileError(
            f"it holds no {FORMAT} (members: {', '.join(sorted(members)[:6])}); expected a file "
            "written by Result.save"
        )
    found = _read(archive, members["format"])
    if found.dtype.kind != "U" or found.shape != () or found.item() != FORMAT:
        raise _FileError(f"its format is {found!r:.60}, expected {FORMAT!r}")
    version = _read(archive, members["version"])
    if version.dtype.kind not in "iu" or version.shape != ():
        raise _FileError(f"its version is {version!r:.60}, expected an integer")
    if not 1 <= version.item() <= VERSION:
        raise _FileError(
            f"its version is {version.item()}, expected at most {VERSION}; install a newer clvoro"
        )
    missing = [name for name in _NEEDED if name not in members]
    if missing:
        raise _FileError(f"it lacks {', '.join(missing)}")
    parts = (f"{part}.{name}" for part, names in _PARTS.items() for name in names)
    known = ("about", *_FIELDS, *parts)
    return {name: _read(archive, members[name]) for name in known if name in members}


def _read(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    """Read one array; the sizes are checked against the member's before memory is asked for."""
    with archive.open(info) as stream:
        try:
            shape, fortran, dtype = _read_header(stream)
        except (ValueError, SyntaxError, TypeError, KeyError) as error:
            raise _FileError(f"{info.filename} is no array ({error})") from error
        if dtype.hasobject:
            raise _FileError(
                f"{info.filename} holds pickled Python objects, which could run any program; they "
                "are never loaded"
            )
        count = 1
        for extent in shape:  # Python's integers do not overflow
            count *= extent
        length = count * dtype.itemsize
        if (
            min(shape, default=1) < 0
            or length != info.file_size - stream.tell()
            or not dtype.itemsize
        ):
            raise _FileError(f"{info.filename} has not the length that its shape {shape} asks for")
        data = stream.read()  # checks the checksum
    array = np.frombuffer(data, dtype, count) if count else np.empty(0, dtype)
    return array.reshape(shape, order="F" if fortran else "C").copy()


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"its header's version is {version}")


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    """Check that the arrays fit each other, so that nobody indexes out of bounds later."""
    sizes: dict[str, int] = {}
    for name, axes in _SHAPES.items():
        if name not in arrays:
            continue
        array = arrays[name]
        if name == "history":
            if array.ndim != 1 or array.dtype.names is None:
                raise _FileError(f"history has shape {array.shape} and dtype {array.dtype}")
            continue
        integer = axes in ("N", "m", "c", "M", "f") and name != "diagram.face_measures"
        if array.dtype.kind not in ("iu" if integer else "f"):
            raise _FileError(f"{name} has dtype {array.dtype}")
        expected = tuple(sizes.setdefault(a, s) for a, s in zip(axes, array.shape, strict=False))
        if array.ndim != len(axes) or array.shape != expected:
            raise _FileError(f"{name} has shape {array.shape}, which does not fit the other arrays")
    for starts, items, rows, bound in (
        ("diagram.neighbour_starts", "diagram.neighbours", ("cell", "n"), sizes["n"]),
        ("diagram.cell_vertex_starts", "diagram.cell_vertices", ("cell", "n"), sizes.get("v", 0)),
        ("diagram.face_vertex_starts", "diagram.face_vertices", ("face", "m"), sizes.get("v", 0)),
    ):
        if (starts in arrays) != (items in arrays):
            raise _FileError(f"it lacks {starts if items in arrays else items}")
        if starts not in arrays:
            continue
        s, j = arrays[starts], arrays[items]
        piece, count = rows[0], sizes.get(rows[1], 0)
        if len(s) != count + 1 or s[0] != 0 or s[-1] != len(j) or (np.diff(s) < 0).any():
            raise _FileError(f"{starts} does not cut {items} into one piece per {piece}")
        lowest = 0 if items.endswith("vertices") else np.iinfo(j.dtype).min
        if j.size and not (lowest <= j.min() and j.max() < bound):
            raise _FileError(f"{items} points to what does not exist")


def _assemble(arrays: dict[str, np.ndarray]) -> Result:
    about = arrays["about"]
    try:
        if about.dtype.kind != "U" or about.shape != ():
            raise TypeError("about is no text")
        facts = json.loads(about.item())
        description = dict(facts["domain"])
        kind = description.pop("kind")
        if kind not in _DOMAINS:
            raise _FileError(f"its domain is a {kind!r:.40}, which this version of clvoro lacks")
        domain = _DOMAINS[kind](**description)
        settings = dict(facts["settings"])
        values = {name: value for name, value in facts["values"].items() if name in _FIELDS}
        if {"converged", "stop_reason"} - set(values) or set(values) & (set(arrays) | set(_PARTS)):
            raise KeyError("values")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise _FileError(f"its description is damaged ({error})") from error
    if arrays["points"].shape[1] != domain.dim:
        raise _FileError(f"its points have {arrays['points'].shape[1]} coordinates in {domain}")
    stored = arrays["history"]
    history = np.zeros(len(stored), HISTORY_DTYPE)
    for column in set(stored.dtype.names or ()) & set(HISTORY_DTYPE.names or ()):
        history[column] = stored[column]
    stored_fields: dict[str, Any] = {
        name: arrays[name] for name in _FIELDS if name in arrays and name != "history"
    }
    return Result(
        **values,
        **stored_fields,
        diagram=Diagram(domain, _part(arrays, "diagram")),
        history=history,
        initial=_displacements(arrays, "initial"),
        final=_displacements(arrays, "final"),
        settings=settings,
    )


def _part(arrays: Mapping[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    prefix = f"{part}."
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _displacements(arrays: Mapping[str, np.ndarray], part: str) -> Displacements | None:
    found = _part(arrays, part)
    return Displacements(**found) if len(found) == len(_PARTS[part]) else None


def _plain(value: Any) -> object:
    """Turn what JSON does not know into what it does; a function into how it prints."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    return repr(value)
