"""Values on grids of longitude and latitude from files: netCDF, and NumPy's .npz."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ...earth.netcdf_read import NETCDF_SUFFIXES
from ...errors import InputError
from ...files import open_plain
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

    Parameters
    ----------
    variable : str or None
        Its name; by default the only one of two dimensions, besides those of length 1.

    Raises
    ------
    InputError
        If the file cannot be read, or has no such variable or several.
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


def _from_netcdf(path: Path, variable: str | None) -> Any:
    with explained(path, "a netCDF file"), open_plain(path) as file:
        start = file.read(4)
        if start[:3] == b"CDF":
            file.seek(0)
            return _from_classic(file, path, variable)
        if start != b"\x89HDF":
            raise FileError("it is another kind of file, expected a netCDF file")
    return _by_xarray(path, variable)


def _from_classic(file: Any, path: Path, variable: str | None) -> Labeled:
    """Read netCDF-3."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with scipy.io.netcdf_file(file, "r", mmap=False, maskandscale=True) as held:
            known = held.variables

            def lengths(item: Any) -> list[int]:
                return [n for n, dim in zip(item.shape, item.dimensions, strict=True) if dim in known]

            name = _choose(variable, _data_variables(held), lengths)
            own = held.variables[name]
            along = set(own.dimensions)
            wanted = [key for key, v in held.variables.items() if set(v.dimensions) <= along]
            parts = {key: _labeled(key, held.variables[key]) for key in {*wanted, name}}
    found = parts.pop(name)
    return Labeled(name, found.values, found.dims, found.attrs, parts)


def _data_variables(held: Any) -> dict[str, Any]:
    """Return the variables that are no coordinates."""
    return {name: v for name, v in held.variables.items() if name not in held.dimensions}


def _labeled(name: str, found: Any) -> Labeled:
    attrs = {
        key: value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        for key, value in found._attributes.items()
    }
    values = found[...]
    native = values.astype(values.dtype.newbyteorder("="))
    return Labeled(name, native, tuple(found.dimensions), attrs)


def _by_xarray(path: Path, variable: str | None) -> Any:
    """Read netCDF-4, which is HDF5."""
    remedy = "pip install xarray netCDF4, or convert the file to netCDF-3, as by nccopy -k nc6 IN OUT"
    try:
        import xarray  # type: ignore[import-not-found]
    except ModuleNotFoundError as error:
        raise InputError(
            f"{path} is a netCDF-4 file, which needs xarray, and that is not installed; {remedy}"
        ) from error
    try:
        with xarray.open_dataset(path) as held:
            return held[_choose(variable, held.data_vars, _gridded)].load()
    except FileError as problem:
        raise InputError(f"cannot load {path}: {problem}") from problem
    except Exception as error:  # of any of the libraries that xarray reads files with
        raise InputError(f"cannot load {path}: xarray says {error!s:.300}; is it damaged? Else {remedy}") from error


def _gridded(array: Any) -> list[int]:
    """Return the lengths of the dimensions of a DataArray that have coordinates."""
    return [array.sizes[name] for name in array.dims if name in array.coords]
