"""Values on a grid of longitudes and latitudes, as xarray has them, as a raster."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..errors import InputError, InputTypeError
from ..sizing.raster import Raster, fill_missing

MOST_VALUES = 1 << 24
"""Most values of a uniform grid that stands for one of varying spacing."""
UNIFORM = 1e-3
"""Share of the spacing by which coordinates of a uniform grid may be off, besides round-off of the file."""
_NAMES = {
    "longitude": ("lon", "longitude", "long", "lons", "longitudes"),
    "latitude": ("lat", "latitude", "lats", "latitudes"),
}
_UNITS = {"longitude": "degrees_east", "latitude": "degrees_north"}
_TURN = 360.0
_ROUND_OFF = 1e-4  # degrees: 360 degrees in float32, and additions of such


def from_xarray(array: Any, *, missing: str = "error", outside: str | None = None) -> Raster:
    """Return the raster of an xarray.DataArray of longitude and latitude in degrees.

    On a `clvoro.Sphere` a raster that goes around it is periodic. xarray itself is not needed: any object with
    ``dims``, ``coords`` and ``values`` like those of a DataArray will do.

    Parameters
    ----------
    array : xarray.DataArray
        Sizes, in the sphere's unit of length. Its coordinates have the standard names or units of CF, or are named
        lon and lat or longitude and latitude. Latitudes run upwards or downwards, longitudes from 0 to 360 or from
        -180 to 180 or over any part of them. Where a spacing varies, values are interpolated linearly to the
        finest one.
    missing, outside
        As for `Raster`; the nearest value may be on the other side of the seam of a grid that goes around the sphere.

    Raises
    ------
    InputError, InputTypeError
        If there are no such coordinates, if they are in radians, two-dimensional, out of range or not in order, if
        there is a further dimension, or if the finest spacing gives more than 16 million values.

    Examples
    --------
    Cells of a tenth of the Rossby radius, from a file::

        radius = xarray.open_dataset("rossby.nc")["radius"]
        size = earth.from_xarray(0.1 * radius, missing="nearest")
        mesh = clvoro.adapt(clvoro.Sphere(), sizing.maximum(size, 20e3), n_cells=100_000)
    """
    what = _describe(array)
    lon_name, lat_name = (_coordinate(array, axis, what) for axis in _NAMES)
    lon, lat = (
        _degrees(array.coords[name], axis, what) for axis, name in zip(_NAMES, (lon_name, lat_name), strict=True)
    )
    _refuse_radians(array, lon_name, lat_name, lon, lat, what)
    values = _in_order(array, array.coords[lat_name].dims[0], array.coords[lon_name].dims[0], what)
    lon, values = _increasing(lon, values, 1)
    lat, values = _increasing(lat, values, 0)
    _check_range(lon, lat, lon_name, lat_name, what)
    around = _TURN - (lon[-1] - lon[0]) <= 1.5 * np.diff(lon).max() + _ROUND_OFF
    values = _filled(what, values, missing, lon, lat, around)
    if around and not (_uniform(lon) and _closes(lon)):
        keep = lon < lon[0] + _TURN - _ROUND_OFF
        lon = np.append(lon[keep], lon[0] + _TURN)
        values = np.concatenate([values[:, keep], values[:, :1]], axis=1)
    if not (_uniform(lon) and _uniform(lat)):
        lon, lat, values = _resampled(lon, lat, values, what)
    half = (lat[-1] - lat[0]) / (len(lat) - 1) / 2
    if lat[0] - half < -90 - _ROUND_OFF or lat[-1] + half > 90 + _ROUND_OFF:
        return Raster(values, (lon[0], lat[0]), (lon[-1], lat[-1]), "nodes", outside=outside)
    # Pixels, so that a grid that ends half a row before the poles covers them.
    wide = (lon[-1] - lon[0]) / (len(lon) - 1) / 2
    lower, upper = (lon[0] - wide, lat[0] - half), (lon[-1] + wide, lat[-1] + half)
    return Raster(values, lower, upper, "centers", outside=outside)


def _describe(array: Any) -> str:
    """Return the name of a DataArray for errors; raise if it is something else."""
    if hasattr(array, "data_vars"):
        names = ", ".join(map(str, array.data_vars))
        raise InputTypeError(f"from_xarray got a Dataset of {names:.200}, expected one of its arrays: dataset['NAME']")
    if not all(hasattr(array, name) for name in ("dims", "coords", "values")):
        raise InputTypeError(
            f"from_xarray got {type(array).__name__}, expected an xarray.DataArray; write "
            "Raster(values, lower, upper) for an array without coordinates"
        )
    name = getattr(array, "name", None)
    return f"the DataArray {str(name)!r}" if name is not None else "the DataArray"


def _attribute(array: Any, name: str) -> str:
    return str(getattr(array, "attrs", {}).get(name, "")).strip().lower()


def _coordinate(array: Any, axis: str, what: str) -> str:
    """Return the name of the coordinate `axis`: by its standard name, its unit or its own name."""
    known = list(array.coords)
    for name in known:
        found = array.coords[name]
        if _attribute(found, "standard_name") == axis or _attribute(found, "units") == _UNITS[axis]:
            return name
    for name in known:
        if str(name).lower() in _NAMES[axis]:
            return name
    names = ", ".join(map(str, known)) or "none"
    raise InputError(
        f"{what} has the coordinates {names}, expected lon and lat (or longitude and latitude) in degrees; rename "
        f"the {axis}, for instance by array.rename({{'x': 'lon', 'y': 'lat'}}) or assign_coords"
    )


def _degrees(coordinate: Any, axis: str, what: str) -> np.ndarray:
    """Return a coordinate as degrees (n,)."""
    unit = _attribute(coordinate, "units")
    given = np.asarray(coordinate.values)
    if unit.startswith("rad"):
        raise InputError(
            f"the {axis} of {what} is in radians (units {unit!r}), expected degrees; convert it by numpy.degrees"
        )
    if unit and not unit.startswith(("deg", "°")):
        raise InputError(f"the {axis} of {what} has the unit {unit!r}, expected degrees")
    if given.ndim != 1:
        raise InputError(
            f"the {axis} of {what} has shape {given.shape}, expected one dimension; interpolate to a regular grid of "
            "longitudes and latitudes first, or use sizing.Scattered"
        )
    if given.dtype.kind not in "fiu":
        raise InputTypeError(f"the {axis} of {what} is of type {given.dtype}, expected numbers")
    if len(given) < 2:
        raise InputError(f"the {axis} of {what} has {len(given)} values, expected at least 2")
    degrees = given.astype(float)
    if not np.isfinite(degrees).all():
        raise InputError(f"the {axis} of {what} has values that are not finite, expected degrees")
    return degrees


def _refuse_radians(array: Any, lon_name: str, lat_name: str, lon: np.ndarray, lat: np.ndarray, what: str) -> None:
    """Raise an error for coordinates without a unit that go around the sphere or from pole to pole in radians."""
    if _attribute(array.coords[lon_name], "units") or _attribute(array.coords[lat_name], "units"):
        return
    small = np.abs(lat).max() <= math.pi / 2 + 1e-3 and np.abs(lon).max() <= 2 * math.pi + 1e-3
    width = np.ptp(lon) * len(lon) / (len(lon) - 1)
    height = np.ptp(lat) * len(lat) / (len(lat) - 1)
    whole = (abs(np.ptp(lon) - 2 * math.pi) < 0.01 or abs(width - 2 * math.pi) < 0.01) or (
        abs(np.ptp(lat) - math.pi) < 0.01 or abs(height - math.pi) < 0.01
    )
    if small and whole:
        raise InputError(
            f"the coordinates of {what} go from {lon.min():.6g} to {lon.max():.6g} and from {lat.min():.6g} to "
            f"{lat.max():.6g}, which are radians, expected degrees; convert them by numpy.degrees, or set their "
            "units to 'degrees_east' and 'degrees_north' if they are degrees"
        )


def _in_order(array: Any, rows: str, columns: str, what: str) -> np.ndarray:
    """Return the values with latitudes along rows and longitudes along columns."""
    values = np.asanyarray(array.values)
    dims, sizes = list(array.dims), dict(zip(array.dims, values.shape, strict=True))
    for name, at in (("latitude", rows), ("longitude", columns)):
        if at not in sizes:
            raise InputError(f"{what} has the dimensions {', '.join(map(str, dims))}, expected one along its {name}")
    further = [name for name in dims if name not in (rows, columns)]
    for name in further:
        if sizes[name] != 1:
            raise InputError(
                f"{what} has {sizes[name]} values along {name!r}, expected longitude and latitude only; choose one, "
                f"as in array.isel({name}=0)"
            )
    kept = np.squeeze(values, axis=tuple(dims.index(name) for name in further))
    left = [name for name in dims if name not in further]
    return kept if left == [rows, columns] else kept.T


def _increasing(degrees: np.ndarray, values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Return coordinates in increasing order, and values to match; longitudes may jump by 360 degrees."""
    steps = np.diff(degrees)
    if axis == 1 and not ((steps > 0).all() or (steps < 0).all()):
        degrees = np.unwrap(degrees, period=_TURN)
        steps = np.diff(degrees)
    if (steps < 0).all():
        return degrees[::-1], np.flip(values, axis)
    if not (steps > 0).all():
        name, k = ("latitude", "longitude")[axis], int(np.argmax(steps <= 0))
        raise InputError(
            f"the {name} goes from {degrees[0]:.6g} over {degrees[k]:.6g} to {degrees[k + 1]:.6g}, expected values in "
            "increasing or decreasing order, each once; sort them, as by array.sortby"
        )
    return degrees, values


def _check_range(lon: np.ndarray, lat: np.ndarray, lon_name: str, lat_name: str, what: str) -> None:
    if lat[0] < -90 - _ROUND_OFF or lat[-1] > 90 + _ROUND_OFF:
        raise InputError(
            f"{lat_name} of {what} goes from {lat[0]:.6g} to {lat[-1]:.6g}, expected -90 to 90 degrees; is it the "
            "longitude, or a coordinate of a projection?"
        )
    if lon[-1] - lon[0] > _TURN + _ROUND_OFF or np.abs(lon).max() > 2 * _TURN:
        raise InputError(
            f"{lon_name} of {what} goes from {lon[0]:.6g} to {lon[-1]:.6g}, expected at most 360 degrees between -720 "
            "and 720; is it a coordinate of a projection?"
        )


def _filled(what: str, values: np.ndarray, missing: str, lon: np.ndarray, lat: np.ndarray, around: bool) -> np.ndarray:
    """Return the values without missing ones; see `fill_missing`."""
    spacing = np.array([np.ptp(lon) / (len(lon) - 1), np.ptp(lat) / (len(lat) - 1)])
    gaps = values.dtype.kind == "f" and bool(np.isnan(np.ma.getdata(values)).any())
    if not around or missing != "nearest" or not (gaps or np.ma.is_masked(values)):
        return fill_missing(f"values of {what}", values, missing, spacing)
    half = len(lon) // 2
    wide = np.ma.concatenate([values[:, -half:], values, values[:, :half]], axis=1)
    return fill_missing(f"values of {what}", wide, missing, spacing)[:, half : half + len(lon)]


def _closes(lon: np.ndarray) -> bool:
    """Return whether the step from the last longitude to the first one is that of the others, or zero."""
    step, rest = (lon[-1] - lon[0]) / (len(lon) - 1), _TURN - (lon[-1] - lon[0])
    return min(abs(rest), abs(rest - step)) <= UNIFORM * step + _ROUND_OFF


def _uniform(degrees: np.ndarray) -> bool:
    even = np.linspace(degrees[0], degrees[-1], len(degrees))
    step = (degrees[-1] - degrees[0]) / (len(degrees) - 1)
    return bool(np.abs(degrees - even).max() <= UNIFORM * step + min(_ROUND_OFF, 0.05 * step))


def _resampled(
    lon: np.ndarray, lat: np.ndarray, values: np.ndarray, what: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate linearly to a uniform grid of the finest spacing along each axis."""
    counts = []
    for degrees in (lon, lat):
        finest = (degrees[-1] - degrees[0]) / np.diff(degrees).min()
        counts.append(len(degrees) if _uniform(degrees) else math.ceil(finest - 1e-6) + 1)
    if counts[0] * counts[1] > MOST_VALUES:
        raise InputError(
            f"{what} has a spacing that varies; a uniform grid of its finest spacing, {np.diff(lon).min():.3g} by "
            f"{np.diff(lat).min():.3g} degrees, would have {counts[0]} x {counts[1]} values, expected at most "
            f"{MOST_VALUES}; interpolate it first, as by array.interp(lon=..., lat=...)"
        )
    for axis, degrees, count in ((1, lon, counts[0]), (0, lat, counts[1])):
        if _uniform(degrees):
            continue
        place = np.interp(np.linspace(degrees[0], degrees[-1], count), degrees, np.arange(len(degrees)))
        first = np.minimum(place.astype(int), len(degrees) - 2)
        weight = (place - first)[:, None] if axis == 0 else place - first
        below, above = (np.take(values, first + k, axis) for k in (0, 1))
        values = below * (1 - weight) + above * weight
    even = (np.linspace(d[0], d[-1], n) for d, n in zip((lon, lat), counts, strict=True))
    return *even, values
