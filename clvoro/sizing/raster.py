"""A size field given by values on a regular grid."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, InputTypeError
from .field import Field

if TYPE_CHECKING:
    from ..domain import Box
    from .bind import Binder


class Raster(Field):
    """Bilinear (in 3D trilinear) interpolation of an array: an image, a solution field, ...

    Parameters
    ----------
    values : (ny, nx) or (nz, ny, nx) array of real numbers
        Sizes, in the unit of the coordinates. Rows run along y *upwards*, columns along x:
        ``values[j, i]`` belongs to x_i, y_j. (An image whose first row is its top is passed as
        ``image[::-1]``; an array indexed [x, y] as its transpose.)
    lower, upper : sequences of 2 or 3 floats
        The box that the array covers.
    at : "nodes" or "centres"
        With "nodes" the first and last values of a row lie on the box's sides, as in
        ``linspace(lower, upper, nx)``; with "centres" each value is the centre of one of nx equal
        pixels.

    Outside the box, and with "centres" within half a pixel of its sides, the value of the nearest
    edge holds on.

    Raises
    ------
    InputError
        If shape and corners do not fit, or a value is not finite. (Values that are not positive are
        refused only where the finished field is: a `maximum` may cover them.)
    """

    def __init__(
        self,
        values: object,
        lower: Sequence[float],
        upper: Sequence[float],
        at: str = "nodes",
    ):
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise InputTypeError(f"Raster values are of type {array.dtype}, expected real numbers")
        if array.ndim not in (2, 3) or array.size == 0:
            raise InputError(
                f"Raster values have shape {array.shape}, expected (ny, nx) or (nz, ny, nx), "
                "not empty"
            )
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            index = tuple(bad[0].tolist())
            raise InputError(
                f"Raster values{list(index)} is {array[index]}, expected finite numbers; "
                "fill the gaps first"
            )
        low, high = (np.asarray(c, dtype=float) for c in (lower, upper))
        if low.shape != (array.ndim,) or high.shape != (array.ndim,):
            raise InputError(
                f"Raster got corners of shape {low.shape} and {high.shape} for values of "
                f"{array.ndim} dimensions, expected {array.ndim} coordinates each"
            )
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise InputError(
                f"Raster got lower {lower} and upper {upper}, expected finite numbers with "
                "lower < upper"
            )
        if at not in ("nodes", "centres"):
            raise InputError(f"Raster got at={at!r}, expected 'nodes' or 'centres'")
        self.values = array.astype(float)
        self.lower, self.upper, self.at = low, high, at
        self.dim = array.ndim

    @property
    def _counts(self) -> np.ndarray:
        """Number of values along x, y (, z)."""
        return np.array(self.values.shape[::-1])

    def _index_map(self) -> tuple[np.ndarray, np.ndarray]:
        """Return gain and origin of the index coordinate, t = gain * (x - origin)."""
        if self.at == "nodes":
            return (self._counts - 1) / (self.upper - self.lower), self.lower
        pixel = (self.upper - self.lower) / self._counts
        return 1.0 / pixel, self.lower + 0.5 * pixel

    def landmarks(self, domain: Box) -> np.ndarray:
        """Return the places of the least value in each of at most 64 tiles per axis."""
        low, where = self.values, np.arange(self.values.size).reshape(self.values.shape)
        for axis, count in enumerate(low.shape):
            # Take the least along one axis after the other, and carry along where it was.
            tile = -(-count // 64)
            pad = [(0, 0)] * low.ndim
            pad[axis] = (0, -count % tile)
            low, where = (np.pad(a, pad, mode="edge") for a in (low, where))
            shape = (*low.shape[:axis], -1, tile, *low.shape[axis + 1 :])
            low, where = low.reshape(shape), where.reshape(shape)
            least = np.expand_dims(low.argmin(axis=axis + 1), axis + 1)
            low, where = (
                np.take_along_axis(a, least, axis + 1).squeeze(axis + 1) for a in (low, where)
            )
        gain, origin = self._index_map()
        index = np.stack(np.unravel_index(where.ravel(), self.values.shape)[::-1], axis=1)
        points = origin + np.divide(index, gain, out=np.zeros(index.shape), where=gain > 0)
        return np.clip(points, self.lower, self.upper)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        gain, origin = self._index_map()
        t = np.clip((points - origin) * gain, 0, self._counts - 1)
        first = np.minimum(t.astype(int), np.maximum(self._counts - 2, 0))
        weight = t - first
        total = np.zeros(len(points))
        for corner in product((0, 1), repeat=self.dim):
            index = np.minimum(first + corner, self._counts - 1)
            w = np.prod(np.where(corner, weight, 1 - weight), axis=1)
            total += w * self.values[tuple(index.T[::-1])]
        return total

    def _emit(self, binder: Binder) -> str:
        gain, origin = self._index_map()
        shift = -binder.normalise(origin) * (gain * binder.scale)
        at = binder.store(gain * binder.scale, shift, self.values / binder.scale)
        counts = ", ".join(map(str, [*self._counts.tolist(), 1][:3]))
        return binder.variable(f"size_raster(x, data + {at}, {counts})")

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.values.shape))
        return f"Raster({shape}, {self.lower.tolist()}, {self.upper.tolist()})"
