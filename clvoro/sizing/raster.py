"""Sizes on grids, also from incomplete data: fill missing values, and interpolate scattered points to a grid."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ..arguments import format_point
from ..errors import InputError, InputTypeError
from ..geometry.shapes import coordinates
from .arguments import coverage_warnings
from .field import Field

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..geometry.domain import Domain
    from .codegen import CodeWriter

_MAX_NODES = 1 << 22  # of a raster, by default


def fill_missing(what: str, values: Any, missing: str, spacing: np.ndarray) -> np.ndarray:
    """Return `values` as floats without missing ones.

    - `what`: name of the values in errors.
    - `values` array of real numbers, (ny, nx) or (nz, ny, nx): NaN and masked values are missing.
    - `missing` "error" or "nearest": whether missing values are rejected or filled with the nearest value.
    - `spacing` (d,) float: spacing of the values along x, y (, z), for the nearest value.

    Raises `InputError` if a value is infinite, all are missing, or some are and `missing` is "error".
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
    x, given, low, high = _checked_points(points, values, lower, upper)
    if method not in ("linear", "nearest"):
        raise InputError(f"Scattered got method={method!r}, expected 'linear' or 'nearest'")
    d = x.shape[1]
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
    found = _interpolate(x - low, given, nodes, method)
    return found.reshape(counts).T, low, high


def _checked_points(
    points: object, values: object, lower: Sequence[float] | None, upper: Sequence[float] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the points (n, d) and values (n,) of `Scattered`, and the corners (d,) of its raster.

    Raises `InputError` or `InputTypeError` if they are not finite, do not match, or no point is in the raster.
    """
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
    return x, given.astype(float), low, high


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


_MANY, _WITHIN = 8, 0.1
# Warn if a raster of at least _MANY values along each axis has a spacing of more than 1 / _WITHIN domains.
_ENOUGH = 16  # least number of scattered points whose bounding box shows where values are known
_ROUNDINGS = 16  # ulps by which a point may lie outside of a raster


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
    at : "nodes" or "centers"
        With "nodes" the first and last values of a row lie on the box's sides, as in
        ``linspace(lower, upper, nx)``; with "centers" each value is the center of one of nx equal
        pixels.
    missing : "error" or "nearest"
        Whether missing values (NaN, or masked by NumPy) are rejected or filled with the nearest value.
    outside : "nearest", "error" or "ignore", optional
        Whether points outside of the box get the nearest value of the array, raise an error, or have no size: with
        "ignore" h is infinite there, so that `minimum` takes another field, as for a fine tile in a coarse one. (With
        "centers" the nearest value is used within half a pixel of the sides in any case.) By default "nearest", and a
        run warns (`MismatchWarning`) if less than half of the domain is covered.

    Raises
    ------
    InputError
        If shape and corners do not match, or a value is missing or infinite. (Values that are not positive are an error
        only if the final field is not positive, because `maximum` may replace them.)

    Examples
    --------
    Cells of the size of the waves in a sea of this depth (m, rows from south to north; NaN on land), growing by a tenth
    per cell at most:

    >>> depth = np.array([[10.0, 40.0, np.nan], [10.0, 90.0, 160.0]])
    >>> size = sizing.Raster(20 * np.sqrt(depth), (0, 0), (2000, 1000), missing="nearest")
    >>> size(np.array([(0.0, 0.0), (1000.0, 1000.0)])).round(1).tolist()
    [63.2, 189.7]
    >>> graded = sizing.Graded(size, growth=1.1)
    """

    def __init__(
        self,
        values: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        at: str = "nodes",
        missing: str = "error",
        outside: str | None = None,
    ):
        if outside not in (None, "nearest", "error", "ignore"):
            raise InputError(f"Raster got outside={outside!r}, expected 'nearest', 'error' or 'ignore'")
        self.outside = outside
        low, high = check_box("Raster", np.shape(values), lower, upper, at)
        counts = np.array(np.shape(values)[::-1])
        self.spacing = (high - low) / np.maximum(counts - (at == "nodes"), 1)
        self.values = fill_missing("Raster values", values, missing, self.spacing)
        self.lower, self.upper, self.at = low, high, at
        self.dim = self.values.ndim

    def with_values(self, values: np.ndarray) -> Raster:
        """Return the raster of other values at the same places."""
        return Raster(values, self.lower, self.upper, self.at, outside=self.outside)

    @property
    def _counts(self) -> np.ndarray:
        """Numbers of values along x, y (, z)."""
        return np.array(self.values.shape[::-1])

    def _index_map(self) -> tuple[np.ndarray, np.ndarray]:
        """Return gain and origin of the index coordinate, t = gain * (x - origin)."""
        if self.at == "nodes":
            return (self._counts - 1) / (self.upper - self.lower), self.lower
        pixel = (self.upper - self.lower) / self._counts
        return 1.0 / pixel, self.lower + 0.5 * pixel

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the points of the smallest value in each of at most 64 tiles per axis."""
        low, where = self.values, np.arange(self.values.size).reshape(self.values.shape)
        for axis, count in enumerate(low.shape):
            # Minimum along one axis after the other, together with its index.
            tile = -(-count // 64)
            pad = [(0, 0)] * low.ndim
            pad[axis] = (0, -count % tile)
            low, where = (np.pad(a, pad, mode="edge") for a in (low, where))
            shape = (*low.shape[:axis], -1, tile, *low.shape[axis + 1 :])
            low, where = low.reshape(shape), where.reshape(shape)
            least = np.expand_dims(low.argmin(axis=axis + 1), axis + 1)
            low, where = (np.take_along_axis(a, least, axis + 1).squeeze(axis + 1) for a in (low, where))
        gain, origin = self._index_map()
        index = np.stack(np.unravel_index(where.ravel(), self.values.shape)[::-1], axis=1)
        points = origin + np.divide(index, gain, out=np.zeros(index.shape), where=gain > 0)
        return np.clip(points, self.lower, self.upper)

    def warnings(self, domain: Domain) -> list[str]:
        """Return a warning if the array covers little of `domain`, or the domain lies between two of its values."""
        if self.outside is not None:
            return []
        many = self._counts >= _MANY
        if many.all() and (domain.extent < _WITHIN * self.spacing).all():
            return [
                f"the domain, {domain.extent.tolist()} across, lies between two values of {self!r}, which are "
                f"{self.spacing.tolist()} apart, so that sizes barely vary; do raster and domain have the same unit?"
            ]
        return self._coverage_warnings(domain)

    def _coverage_warnings(self, domain: Domain) -> list[str]:
        remedy = "give a larger raster, outside='nearest' to confirm, or outside='ignore' for a tile in minimum(...)"
        return coverage_warnings(repr(self), domain, self.lower, self.upper, remedy)

    def _check_outside(self, points: np.ndarray) -> None:
        """Raise if one of `points` (n, d) lies outside of the box by more than round-off and `outside` is "error"."""
        if self.outside != "error":
            return
        far = max(np.abs(self.lower).max(), np.abs(self.upper).max())
        slack = _ROUNDINGS * float(np.finfo(float).eps) * far
        out = ((points < self.lower - slack) | (points > self.upper + slack)).any(axis=1)
        if out.any():
            where = format_point(points[np.argmax(out)])
            raise InputError(
                f"{self!r} does not cover the domain: it has no value at {where}; give a larger raster, a "
                "smaller domain, or outside='nearest'"
            )

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        self._check_outside(points)
        gain, origin = self._index_map()
        t = np.clip((points - origin) * gain, 0, self._counts - 1)
        first = np.minimum(t.astype(int), np.maximum(self._counts - 2, 0))
        weight = t - first
        total = np.zeros(len(points))
        for corner in product((0, 1), repeat=self.values.ndim):
            index = np.minimum(first + corner, self._counts - 1)
            w = np.prod(np.where(corner, weight, 1 - weight), axis=1)
            total += w * self.values[tuple(index.T[::-1])]
        if self.outside == "ignore":
            total[((points < self.lower) | (points > self.upper)).any(axis=1)] = np.inf
        return total

    def _emit(self, writer: CodeWriter) -> str:
        # A box contains a domain if it contains its corners.
        domain = writer.domain
        self._check_outside(np.array([domain.lower, domain.upper]))
        beside = (self.upper < domain.lower).any() or (self.lower > domain.upper).any()
        if beside and self.outside != "ignore":
            raise InputError(
                f"{self!r} lies beside the domain, from {list(domain.lower)} to {list(domain.upper)}, expected an "
                "overlap; do units and the order of the coordinates (x, y) agree?"
            )
        gain, origin = self._index_map()
        shift = -writer.normalize(origin) * (gain * writer.scale)
        at = writer.store(gain * writer.scale, shift, self.values / writer.scale)
        counts = ", ".join(map(str, [*self._counts.tolist(), 1][:3]))
        value = f"size_raster(x, data + {at}, {counts})"
        if self.outside == "ignore":
            box = writer.store(writer.normalize(self.lower), writer.normalize(self.upper))
            value = f"size_box_distance2(x, data + {box}) > 0 ? SIZE_LARGEST : {value}"
        return writer.variable(value)

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.values.shape))
        return f"{type(self).__name__}({shape}, {self.lower.tolist()}, {self.upper.tolist()})"


class Scattered(Raster):
    """Values at scattered points, interpolated to a raster: measurements, or the cells of another mesh.

    Parameters
    ----------
    points : (n, d) float
        d = 2 or 3; for cell data of a mesh the centroids.
    values : (n,) float
    lower, upper : sequences of d floats, optional
        The box of the raster; by default the bounding box of the points.
    resolution : int or sequence of d ints, optional
        Number of nodes along the longest side, or along each axis. By default two per mean distance of the points,
        (volume / n)^(1/d), and at most 2^22 in total. Points with dense clusters need more.
    method : "linear" or "nearest"
        Linear interpolation in the Delaunay triangulation of the points, and the nearest value outside of their hull;
        or the nearest value everywhere.

    Raises
    ------
    InputError, InputTypeError
        If shapes do not match, a number is not finite, all points lie outside of the box, or (linear) the points cannot
        be triangulated or two points at the same place have different values.

    Examples
    --------
    Half the sizes of another mesh::

        size = 0.5 * Scattered(result.diagram.centroids, result.target_size, box.lower, box.upper)
    """

    def __init__(
        self,
        points: object,
        values: object,
        lower: Sequence[float] | None = None,
        upper: Sequence[float] | None = None,
        resolution: int | Sequence[int] | None = None,
        method: str = "linear",
    ):
        found, low, high = grid_scattered(points, values, lower, upper, resolution, method)
        super().__init__(found, low, high)
        x = np.asarray(points, float)
        self._known = x.min(axis=0), x.max(axis=0), len(x)

    def _coverage_warnings(self, domain: Domain) -> list[str]:
        low, high, count = self._known
        if count < _ENOUGH:
            return []
        remedy = "give points all over the domain"
        return coverage_warnings(f"Scattered of {count} points", domain, low, high, remedy)


def check_box(
    what: str, shape: tuple[int, ...], lower: ArrayLike, upper: ArrayLike, at: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a raster of `shape` as arrays (d,).

    Raises `InputError` if they do not match the shape, or are not in order.
    """
    if len(shape) not in (2, 3) or 0 in shape:
        hint = "" if shape else "; a file is read first, as by rasterio.open(path).read(1)[::-1]"
        raise InputError(f"{what} values have shape {shape}, expected (ny, nx) or (nz, ny, nx), not empty{hint}")
    low, high = (np.asarray(c, dtype=float) for c in (lower, upper))
    d = len(shape)
    if low.shape != (d,) or high.shape != (d,):
        raise InputError(
            f"{what} got corners of shape {low.shape} and {high.shape} for values of {d} "
            f"dimensions, expected {d} coordinates each"
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
        raise InputError(
            f"{what} got lower {lower} and upper {upper}, expected finite numbers with lower < upper; "
            "reverse the values of an axis that runs downwards, as in values[::-1]"
        )
    if at not in ("nodes", "centers"):
        raise InputError(f"{what} got at={at!r}, expected 'nodes' or 'centers'")
    return low, high
