"""The complete format: NumPy arrays in a zip file. The reader does not trust the file. `numpy.load` reads it, too.

Each member is one array (`.npy`): `format`; `version`; `about`, JSON with the domain, the settings and the scalars of a
`Result`; the arrays of a `Result` by name; `diagram.<name>` of its `Diagram`; `initial.<name>` and `final.<name>` of
`Displacements`; and `cell_data.<name>`, data of the caller, which `load` skips. The file of a diagram has no arrays of
a `Result`.
"""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ..files import open_plain
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import HISTORY_DTYPE, Displacements, Result
from .arrays import FileError, explained, list_members, read_member, write_arrays
from .contents import Contents, describe, described

FORMAT, VERSION = "clvoro-result", 2

_NEEDED = ("about", "points", "target_size", "size_error", "quality", "history", "diagram.points")
_FIELDS = tuple(field.name for field in dataclasses.fields(Result))
_FORMER = {"size": "target_size", "error": "size_error"}
"""Names of arrays in files of version 1."""
_PARTS = {
    "diagram": Diagram._NAMES,
    "initial": tuple(field.name for field in dataclasses.fields(Displacements)),
    "final": tuple(field.name for field in dataclasses.fields(Displacements)),
}

# Shape of each array: a letter stands for the same size everywhere (d: dimension).
_SHAPES = {
    "points": "nd",
    "target_size": "n",
    "size_error": "n",
    "quality": "n",
    "history": "h",
    "diagram.points": "nd",
    "diagram.volumes": "n",
    "diagram.centroids": "nd",
    "diagram.neighbor_starts": "N",
    "diagram.neighbors": "m",
    "diagram.shifts": "md",
    "diagram.face_measures": "m",
    "diagram.face_centroids": "md",
    "diagram.vertices": "vd",
    "diagram.cell_vertex_starts": "N",
    "diagram.cell_vertices": "c",
    "diagram.face_vertex_starts": "M",
    "diagram.face_vertices": "f",
    "diagram.weights": "n",
    "diagram.layer": "n",
    "initial.points": "ad",
    "initial.lloyd": "ad",
    "initial.poisson": "ad",  # before any were inserted
    "final.points": "bd",  # generators of a solid may have no cell, or several
    "final.lloyd": "bd",
    "final.poisson": "bd",
}

_INTEGERS = {
    "diagram.neighbor_starts",
    "diagram.neighbors",
    "diagram.shifts",
    "diagram.cell_vertex_starts",
    "diagram.cell_vertices",
    "diagram.face_vertex_starts",
    "diagram.face_vertices",
    "diagram.layer",
}


def write_npz(contents: Contents, path: Path) -> None:
    """Write all of `contents` to `path`. Equal contents give equal bytes."""
    diagram, result = contents.diagram, contents.result
    domain = diagram.domain
    about: dict[str, Any] = {"domain": describe(domain), "settings": contents.settings, "values": {}}
    arrays: dict[str, object] = {}
    for name in _FIELDS if result is not None else ("diagram",):
        value = getattr(contents if result is None else result, name)
        if name in _PARTS:
            # Arrays of a diagram that are still on the device are fetched here.
            names = getattr(value, "_arrays", _PARTS[name]) if value is not None else ()
            arrays |= {f"{name}.{k}": getattr(value, k) for k in _PARTS[name] if k in names}
        elif isinstance(value, np.ndarray):
            arrays[name] = value
        elif name != "settings":
            about["values"][name] = value
    arrays |= {f"cell_data.{name}": values for name, values in contents.extra.items()}
    arrays["about"] = json.dumps(about, default=_plain)
    write_arrays(path, FORMAT, VERSION, arrays)


def load(path: str | PathLike[str]) -> Result | Diagram:
    """Read a ``.npz`` file of `Result.save` or `Diagram.save`.

    The file is not trusted: nothing in it is executed, sizes are compared with the bytes in the file before memory is
    allocated, and arrays must be consistent.

    Raises
    ------
    InputError
        If the file is missing, damaged, truncated, of another format or of a newer version; names the file and the
        fault.
    """
    with explained(path, "a .npz, .vtu or (on a sphere) .nc file that save wrote"):
        with open_plain(path) as file, zipfile.ZipFile(file) as archive:
            members = list_members(archive, FORMAT, VERSION)
            if "target_size" not in members:
                members = {_FORMER.get(name, name): info for name, info in members.items()}
            alone = not any(name in members for name in _NEEDED[1:-1])
            needed = ("about", "diagram.points") if alone else _NEEDED
            missing = [name for name in needed if name not in members]
            if missing:
                raise FileError(f"it lacks {', '.join(missing)}")
            parts = (f"{part}.{name}" for part, names in _PARTS.items() for name in names)
            known = ("about", *_FIELDS, *parts)
            arrays = {name: read_member(archive, members[name]) for name in known if name in members}
        _check(arrays)
        return _assemble(arrays)


def _check(arrays: Mapping[str, np.ndarray]) -> None:
    """Check that the arrays are consistent, so that no index is out of bounds later."""
    sizes: dict[str, int] = {}
    for name, axes in _SHAPES.items():
        if name not in arrays:
            continue
        array = arrays[name]
        if name == "history":
            if array.ndim != 1 or array.dtype.names is None:
                raise FileError(f"history has shape {array.shape} and dtype {array.dtype}")
            continue
        integer = name in _INTEGERS
        if array.dtype.kind not in ("iu" if integer else "f"):
            raise FileError(f"{name} has dtype {array.dtype}")
        expected = tuple(sizes.setdefault(a, s) for a, s in zip(axes, array.shape, strict=False))
        if array.ndim != len(axes) or array.shape != expected:
            raise FileError(f"{name} has shape {array.shape}, which differs from the other arrays")
    for starts, items, rows, bound in (
        ("diagram.neighbor_starts", "diagram.neighbors", ("cell", "n"), sizes["n"]),
        ("diagram.cell_vertex_starts", "diagram.cell_vertices", ("cell", "n"), sizes.get("v", 0)),
        ("diagram.face_vertex_starts", "diagram.face_vertices", ("face", "m"), sizes.get("v", 0)),
    ):
        if (starts in arrays) != (items in arrays):
            raise FileError(f"it lacks {starts if items in arrays else items}")
        if starts not in arrays:
            continue
        s, j = arrays[starts], arrays[items]
        piece, count = rows[0], sizes.get(rows[1], 0)
        if len(s) != count + 1 or s[0] != 0 or s[-1] != len(j) or (np.diff(s) < 0).any():
            raise FileError(f"{starts} does not divide {items} into one row per {piece}")
        lowest = 0 if items.endswith("vertices") else np.iinfo(j.dtype).min
        if j.size and not (lowest <= j.min() and j.max() < bound):
            raise FileError(f"{items} has an index out of range")


def _assemble(arrays: dict[str, np.ndarray]) -> Result | Diagram:
    about, alone = arrays["about"], "points" not in arrays
    try:
        if about.dtype.kind != "U" or about.shape != ():
            raise TypeError("about is not text")
        facts = json.loads(about.item())
        domain = described(facts["domain"])
        settings = dict(facts["settings"])
        values = {name: value for name, value in facts["values"].items() if name in _FIELDS}
        needed = set() if alone else {"converged", "stop_reason"}
        if needed - set(values) or set(values) & (set(arrays) | set(_PARTS)):
            raise KeyError("values")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileError(f"its description is damaged ({error})") from error
    points = arrays["diagram.points"]
    if points.shape[1:] != np.shape(domain.lower):
        raise FileError(f"its points have {points.shape[1]} coordinates in {domain}")
    for name in Diagram._NAMES:
        if not name.startswith(_not_in(domain)) and f"diagram.{name}" not in arrays:
            raise FileError(f"it has no diagram.{name}")
    _check_domain(arrays, domain)
    if alone:
        return Diagram(domain, _part(arrays, "diagram"))
    stored = arrays["history"]
    history = np.zeros(len(stored), HISTORY_DTYPE)
    for column in set(stored.dtype.names or ()) & set(HISTORY_DTYPE.names or ()):
        history[column] = stored[column]
    stored_fields: dict[str, Any] = {name: arrays[name] for name in _FIELDS if name in arrays and name != "history"}
    return Result(
        **values,
        **stored_fields,
        diagram=Diagram(domain, _part(arrays, "diagram")),
        history=history,
        initial=_displacements(arrays, "initial"),
        final=_displacements(arrays, "final"),
        settings=settings,
    )


def _not_in(domain: Domain) -> tuple[str, ...]:
    """Return prefixes of the arrays that a diagram of `domain` does not have."""
    others = ["weights", "layer"] if any(domain.periodic) else ["weights", "layer", "shifts"]
    if domain.cell_dim == 3:
        others.append("cell_vert")
    elif not domain.cuts_cells:
        others.append("face_vert")
    return tuple(others)


def _check_domain(arrays: Mapping[str, np.ndarray], domain: Domain) -> None:
    """Check the arrays against the domain, so that no index is out of bounds later."""
    neighbors = arrays["diagram.neighbors"]
    if neighbors.size and neighbors.min() < -len(domain.boundary_index):
        raise FileError("diagram.neighbors has an index out of range")
    shifts = arrays.get("diagram.shifts")
    if shifts is not None and shifts.size and not (shifts.min() >= -1 and shifts.max() <= 1):
        raise FileError("diagram.shifts has values other than -1, 0 and 1")
    if domain.cuts_cells:
        starts = arrays["diagram.face_vertex_starts"]
        if not np.array_equal(starts, 2 * np.arange(len(neighbors) + 1)):
            raise FileError("diagram.face_vertices does not have two ends for each face")
    else:
        same = arrays.get("diagram.cell_vertex_starts", arrays["diagram.neighbor_starts"])
        if not np.array_equal(same, arrays["diagram.neighbor_starts"]):
            raise FileError("diagram.cell_vertices does not have as many corners as faces")


def _part(arrays: Mapping[str, np.ndarray], part: str) -> dict[str, np.ndarray]:
    prefix = f"{part}."
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _displacements(arrays: Mapping[str, np.ndarray], part: str) -> Displacements | None:
    found = _part(arrays, part)
    return Displacements(**found) if len(found) == len(_PARTS[part]) else None


def _plain(value: Any) -> object:
    """Convert values for JSON: arrays to lists, other objects to their representation."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    return repr(value)
