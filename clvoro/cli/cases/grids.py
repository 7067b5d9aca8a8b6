"""Values on grids of longitude and latitude from files: netCDF, and NumPy's .npz."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...earth.netcdf_read import NETCDF_SUFFIXES, Variables, open_netcdf
from ...errors import InputError
from ...io.arrays import FileError, array_names, explained, read_array

_LONGITUDES, _LATITUDES = ("lon", "longitude"), ("lat", "latitude")


@dataclass(frozen=True)
class Labeled:
    """Values with named dimensions and coordinates, as xarray.DataArray has them."""

    name: str
    values: np.ndarray
    dims: tuple[str, ...]
    attrs: Mapping[str, object] = field(default_factory=dict)
    coords: Mapping[str, Labeled] = field(default_factory=dict)


def read_grid(path: Path, variable: str | None) -> Any:
    """Return a variable of a file with its coordinates, for `earth.from_xarray`; None for an array without them.

    - `variable`: its name; by default the only one of two dimensions, besides those of length 1.
    """
    if path.suffix.lower() == ".npz":
        return _from_npz(path, variable)
    if path.suffix.lower() in NETCDF_SUFFIXES:
        return _from_netcdf(path, variable)
    return None


def _choose(variable: str | None, found: Mapping[Any, Any], shape: Callable[[Any], Iterable[int]]) -> str:
    """Return the name of the variable: the given one, or the only one with two dimensions.

    `shape` returns the lengths of the dimensions that have coordinates.
    """
    plane = [name for name, item in found.items() if sum(n > 1 for n in shape(item)) == 2]
    if variable is None and len(plane) == 1:
        return plane[0]
    if variable in found:
        return str(variable)
    names = ", ".join(found) or "none"
    said = f"names {variable!r}" if variable else f"names none of the {len(plane)} on grids"
    raise FileError(f"it has the variables {names:.300}, and the case {said}; expected variable = one of them")


def _from_npz(path: Path, variable: str | None) -> Labeled | None:
    with explained(path, "a .npz file"):
        names = array_names(path)
    lon, lat = (next((n for n in names if n.lower() in known), None) for known in (_LONGITUDES, _LATITUDES))
    if lon is None or lat is None:
        if variable is None:
            return None
        raise InputError(f"{path} has the arrays {', '.join(names):.300}, expected lon and lat, too")
    arrays = {n: read_array(path, n) for n in names if n not in (lon, lat)}
    with explained(path, "a .npz file"):
        name = _choose(variable, arrays, np.shape)
    along = {key: read_array(path, key) for key in (lon, lat)}
    coords = {key: Labeled(key, values, (key,)) for key, values in along.items()}
    shape, counts = arrays[name].shape, tuple(len(np.atleast_1d(along[key])) for key in (lat, lon))
    if shape != counts:
        raise InputError(f"{path}: {name} has shape {shape}, expected (latitudes, longitudes) = {counts}")
    return Labeled(name, arrays[name], (lat, lon), coords=coords)


def _from_netcdf(path: Path, variable: str | None) -> Labeled:
    with explained(path, "a netCDF file"), open_netcdf(path) as file:
        known = {key: file.dimensions(key) for key in file.names() if file.kind(key) in "iuf"}

        def lengths(name: str) -> list[int]:
            return [n for n, dim in zip(file.shape(name), known[name], strict=True) if dim in known]

        name = _choose(variable, {key: key for key, dims in known.items() if dims != (key,)}, lengths)
        along = set(known[name])
        parts = {key: _labeled(file, key) for key, dims in known.items() if set(dims) <= along or key == name}
    found = parts.pop(name)
    return Labeled(name, found.values, found.dims, found.attrs, parts)


def _labeled(file: Variables, name: str) -> Labeled:
    attrs = {key: file.about(name, key) or "" for key in ("standard_name", "units")}
    return Labeled(name, file.data(name), file.dimensions(name), attrs)
