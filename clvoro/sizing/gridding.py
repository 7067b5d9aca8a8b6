"""Rasters from incomplete data: fill missing values, and interpolate scattered points to a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from ..errors import InputError, InputTypeError
from ..geometry.shapes import coordinates

_MAX_NODES = 1 << 22  # of a raster, by default


def fill_missing(what: str, values: Any, missing: str, spacing: np.ndarray) -> np.ndarray:
    """Return `values` as floats without missing ones.

    Parameters
    ----------
    what : str
        Name of the values in errors.
    values : array of real numbers, (ny, nx) or (nz, ny, nx)
        NaN and masked values are missing.
    missing : "error" or "nearest"
        Whether missing values are rejected or filled with the nearest value.
    spacing : (d,) float
        Spacing of the values along x, y (, z), for the nearest value.

    Raises
    ------
    InputError
        If a value is infinite, all are missing, or some are and `missing` is "error".
    """
    if missing not in ("error", "nearest"):
        raise InputError(f"{what} got missing={missing!r}, expected 'error' or 'nearest'")
    mask = np.ma.getmaskarray(values)
    array = np.asarray(np.ma.getdata(values))
    if array.dtype.kind not in "fiu":
        raise InputTypeError(f"{what} are of type {array.dtype}, expected real numbers")
    if array.ndim not in (2, 3) or array.size == 0:
        raise InputError(f"{what} have shape {array.shape}, expected (ny, nx) or (nz, ny, nx), not empty")
    array = array.astype(float)
    gaps = np.isnan(array) | mask
    infinite = np.argwhere(np.isinf(array) & ~mask)
    if len(infinite):
        index = tuple(infinite[0].tolist())
        raise InputError(f"{what}{list(index)} is {array[index]}, expected finite numbers")
    if not gaps.any():
        return array
    count, first = int(gaps.sum()), np.argwhere(gaps)[0].tolist()
    if missing == "error":
        raise InputError(
            f"{what}{first} is nan, expected finite numbers ({count} of {gaps.size} are missing); "
            "fill the gaps first, or pass missing='nearest' to fill them with the nearest value"
        )
    if gaps.all():
        raise InputError(f"{what} are all missing, {gaps.size} of them; expected some numbers")

    found: Any = scipy.ndimage.distance_transform_edt(
        gaps, sampling=spacing[::-1], return_distances=False, return_indices=True
    )
    return array[tuple(found)]


def grid_scattered(
    points: object,
    values: object,
    lower: Sequence[float] | None,
    upper: Sequence[float] | None,
    resolution: int | Sequence[int] | None,
    method: str,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the values on a raster's nodes and its corners; see `Scattered`."""
    x = coordinates("Scattered points", points, 2)
    given = np.asarray(values)
    if given.dtype.kind not in "fiu":
        raise InputTypeError(f"Scattered values are of type {given.dtype}, expected real numbers")
    if given.shape != (len(x),):
        raise InputError(f"Scattered values have shape {given.shape} for {len(x)} points, expected ({len(x)},)")
    if not len(x):
        raise InputError("Scattered got no points, expected at least one")
    bad = np.flatnonzero(~np.isfinite(given))
    if bad.size:
        raise InputError(
            f"Scattered values[{bad[0]}] is {given[bad[0]]}, expected finite numbers ({bad.size} "
            f"of {len(x)} are not); leave these points out"
        )
    if method not in ("linear", "nearest"):
        raise InputError(f"Scattered got method={method!r}, expected 'linear' or 'nearest'")
    low, high = (
        np.asarray(end if corner is None else corner, dtype=float)
        for corner, end in ((lower, x.min(axis=0)), (upper, x.max(axis=0)))
    )
    d = x.shape[1]
    if low.shape != (d,) or high.shape != (d,) or not (low < high).all():
        raise InputError(
            f"Scattered covers {low.tolist()} to {high.tolist()}, expected {d} coordinates each "
            "with lower < upper; pass lower and upper"
        )
    if ((x.max(axis=0) < low) | (x.min(axis=0) > high)).any():
        raise InputError(
            f"Scattered got points from {x.min(axis=0).tolist()} to {x.max(axis=0).tolist()}, all outside of the box "
            f"from {low.tolist()} to {high.tolist()}; do units and the order of the coordinates (x, y) agree?"
        )
    extent = high - low
    if resolution is None:
        spacing = max(0.5 * (np.prod(extent) / len(x)) ** (1 / d), 1.05 * (np.prod(extent) / _MAX_NODES) ** (1 / d))
        counts = np.maximum(np.ceil(extent / spacing).astype(int), 1) + 1
    else:
        asked = np.asarray(resolution)
        if asked.dtype.kind not in "iu" or asked.shape not in ((), (d,)) or asked.min() < 2:
            raise InputError(
                f"Scattered resolution is {resolution!r}, expected a number of nodes along the "
                "longest side or one per axis, at least 2"
            )
        along = np.ceil(extent / extent.max() * (asked.max() - 1) * (1 - 1e-12)).astype(int)
        counts = asked if asked.ndim else np.maximum(along, 1) + 1
    axes = [np.linspace(0, e, n) for e, n in zip(extent, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    found = _interpolate(x - low, given.astype(float), nodes, method)
    return found.reshape(counts).T, low, high


def _interpolate(x: np.ndarray, values: np.ndarray, nodes: np.ndarray, method: str) -> np.ndarray:

    found = np.full(len(nodes), np.nan)
    if method == "linear":
        _check_duplicates(x, values)
        try:
            found = scipy.interpolate.LinearNDInterpolator(x, values)(nodes)
        except scipy.spatial.QhullError as error:
            raise InputError(
                f"Scattered cannot triangulate its {len(x)} points: they are too few or lie on a "
                "line or plane; pass method='nearest'"
            ) from error
    outside = np.isnan(found)
    if outside.any():
        found[outside] = values[scipy.spatial.KDTree(x).query(nodes[outside])[1]]
    return found


def _check_duplicates(x: np.ndarray, values: np.ndarray) -> None:
    order = np.lexsort(x.T)
    same = (np.diff(x[order], axis=0) == 0).all(axis=1) & (np.diff(values[order]) != 0)
    first = np.flatnonzero(same)
    if first.size:
        i, j = sorted(order[first[0] : first[0] + 2].tolist())
        raise InputError(
            f"Scattered points[{i}] and points[{j}] are at the same place with the values "
            f"{values[i]:g} and {values[j]:g}; keep one of them, or pass method='nearest'"
        )
