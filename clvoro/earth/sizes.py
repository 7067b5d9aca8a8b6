"""Size fields on a sphere, as functions of longitude and latitude, with growth along great circles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import shapely
from numpy.typing import ArrayLike

from ..arguments import check_number, warn
from ..connectivity import rows_and_places
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.box import Box
from ..geometry.domain import Domain
from ..geometry.shapes import Circle
from ..geometry.sphere import DEGREES, Sphere, directions
from ..sizing.arguments import check_positive, check_slope
from ..sizing.codegen import CodeWriter
from ..sizing.distance import Distance
from ..sizing.field import Combined, Field, Scaled, as_field, on_domain
from ..sizing.graded import Graded
from ..sizing.raster import Raster
from ..sizing.region import Region, inside_code, ring_edges
from .shapes import area_of, check_lonlat, warn_of_radians


class ArcGraded(Field):
    """A `Graded` field on a sphere: ``h(x) = min over y of field(y) + slope (arc from x to y)``.

    - `field`: the field of `given`, for positions on the sphere.

    Raises `InputError` if `given` has a box that is not this sphere, or several numbers as its resolution.
    """

    dim, on_sphere = 3, True

    def __init__(self, given: Graded, field: Field, sphere: Sphere) -> None:
        if given.box is not None and given.box != sphere:
            raise InputError(
                f"{given!r} has the box {given.box!r}, and on a sphere growth is limited everywhere; leave out box"
            )
        if isinstance(given.resolution, tuple):
            raise InputError(
                f"Graded resolution is {given.resolution}, expected one number on a sphere: the nodes along the equator"
            )
        self.given, self.field, self.sphere = given, field, sphere
        self.parts = given.parts

    def lonlat(self, writer: CodeWriter | None = None) -> LonLat:
        """Return the field as a raster in longitude and latitude. It is computed once for each precision."""
        # A region of the sphere has the grid of the whole sphere.
        whole = Sphere(self.sphere.radius)
        return LonLat(self.given.raster(whole) if writer is None else self.given.raster_for(writer, whole))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the landmarks of the raster as positions on the sphere."""
        return self.lonlat().landmarks(domain)

    def warnings(self, domain: Domain) -> list[str]:
        """Return the warnings of the field whose growth is limited."""
        return self.field.warnings(domain)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.lonlat()._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        return self.lonlat(writer)._emit(writer)

    def __repr__(self) -> str:
        return repr(self.given)


@on_domain.register
def on_sphere(domain: Sphere, field: Field) -> Field:
    """Return `field` for a sphere: fields of two dimensions are functions of longitude and latitude."""
    if isinstance(field, (Scaled, Combined)):
        return field.map_parts(lambda part: on_sphere(domain, part))
    if isinstance(field, Graded):
        return ArcGraded(field, on_sphere(domain, field.field), domain)
    if field.dim != 2 or isinstance(field, (LonLat, ArcDistance)):
        return field
    if isinstance(field, Region):
        return ArcRegion(field, domain)
    return ArcDistance(field, domain) if isinstance(field, Distance) else LonLat(field)


SAGITTA = 1e-3
"""Largest distance over h_min of an arc from the chords that stand for it."""
MOST_CHORDS, LONGEST_CHORD = 1 << 18, np.radians(1)
_DEGREES = 180 / math.pi
_SLACK = 1e-3  # degrees by which a raster may reach beyond a pole, as corners in float32 do
_SEAM = 1e-3  # difference of two columns at one longitude, over their values
_GLOBAL = 359.0  # degrees of longitude from which on a raster goes around the sphere


class LonLat(Field):
    """A field of longitude and latitude, in degrees, on a sphere.

    A `Raster`, or an `Expression` with the variables ``lon`` and ``lat``, becomes one on its own where the domain is a
    `clvoro.Sphere`. A callable has to be wrapped.

    Parameters
    ----------
    field : field or callable
        h of points (n, 2): longitudes from -180 to 180 and latitudes. The longitudes of a `Raster` may be any others. A
        raster that goes around the sphere is periodic; beside another one the value of the nearer side is used.

    Raises
    ------
    InputError, InputTypeError
        If `field` is not a size field of two dimensions.

    Examples
    --------
    >>> size = earth.LonLat(lambda p: 200e3 + 2e3 * abs(p[:, 1]))
    >>> size(clvoro.Sphere().positions([(0, 0), (0, 90)])).tolist()
    [200000.0, 380000.0]
    """

    dim, on_sphere = 3, True

    def __init__(self, field: Field | Callable[[np.ndarray], object]) -> None:
        inner = as_field(field)
        inner.check_dim(2)
        self.given = inner
        self.west = -180.0
        if isinstance(inner, Raster):
            inner, self.west = _on_sphere(inner)
        self.field, self.on_device, self.parts = inner, inner.on_device, inner.parts + 1

    def _lonlat(self, points: np.ndarray) -> np.ndarray:
        lon, lat = directions(points).T
        lon = np.where(lon < self.west, lon + 360, lon)
        lon = np.where(lon > self.west + 360, lon - 360, lon)
        return np.column_stack([lon, lat])

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.field._evaluate(self._lonlat(points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the landmarks of the field as positions on the sphere."""
        assert domain.globe
        found = self.field.landmarks(DEGREES)
        return domain.globe.positions(np.clip(found, (-720, -90), (720, 90)))

    def warnings(self, domain: Domain) -> list[str]:
        """Return the warnings of the field."""
        east = self.west + 360
        return self.field.warnings(Box((self.west, -90), (east, 90)))

    def _emit(self, writer: CodeWriter) -> str:
        inner = writer.in_plane(Box((self.west, -90), (self.west + 360, 90)))
        result = self.field._emit(inner)
        name = writer.function(inner.statements, result)
        way = degrees_code(writer, self.west)
        return writer.variable(f"{name}({way}, data) * data[{writer.store(1 / writer.scale)}]")

    def __repr__(self) -> str:
        return f"LonLat({self.given!r})"


def _on_sphere(raster: Raster) -> tuple[Raster, float]:
    """Return `raster` for one turn of longitudes, and where that turn begins, -180 to 180.

    A raster that goes around the sphere has one more column at both sides.
    """
    low, high, count = raster.lower, raster.upper, raster.values.shape[1]
    if low[1] < -90 - _SLACK or high[1] > 90 + _SLACK:
        raise InputError(
            f"{raster!r} goes from {low[1]:g} to {high[1]:g} along its rows, expected latitudes from -90 to 90; "
            "are longitude and latitude swapped? Values have shape (latitudes, longitudes)"
        )
    if np.abs(high - low - (2 * np.pi, np.pi)).max() < 0.1:
        raise InputError(
            f"{raster!r} goes once around the sphere in radians, expected degrees: use numpy.degrees for its corners"
        )
    spacing = raster.spacing[0]
    nodes = low[0] + spacing * (np.arange(count) + 0.5 * (raster.at == "centers"))
    around = nodes[-1] - nodes[0] + spacing >= _GLOBAL
    west = low[0] if around else (low[0] + high[0]) / 2 - 180
    turn = 360 * math.floor((west + 180) / 360)
    if around:
        return _closed(raster, nodes - turn, spacing), float(west - turn)
    if turn:
        corners = (low - (turn, 0), high - (turn, 0))
        raster = Raster(raster.values, *corners, raster.at, outside=raster.outside)
    return raster, float(west - turn)


def _closed(raster: Raster, nodes: np.ndarray, spacing: float) -> Raster:
    """Return a raster that goes around the sphere, its columns at `nodes`, with one more column at both sides."""
    values = raster.values
    if nodes[-1] - nodes[0] > _GLOBAL:  # the last column repeats the first one
        _warn_of_seam(raster, values)
        values, nodes = values[:, :-1], nodes[:-1]
    values = np.concatenate([values[:, -1:], values, values[:, :1]], axis=1)
    south, north = raster.lower[1], raster.upper[1]
    if raster.at == "centers":  # and one more row, as the nearest value is used up to the sides
        half = (north - south) / len(values) / 2
        values = np.pad(values, ((1, 1), (0, 0)), mode="edge")
        south, north = south - half, north + half
    return Raster(values, (nodes[0] - spacing, south), (nodes[0] + 360, north), outside=raster.outside)


def _warn_of_seam(raster: Raster, values: np.ndarray) -> None:
    """Warn if the first and last columns, which are at one longitude, have different values."""
    first, last = values[:, 0], values[:, -1]
    off = np.abs(last - first) / np.maximum(np.abs(first), np.abs(last))
    row = int(off.argmax())
    if off[row] > _SEAM:
        lat = raster.lower[1] + row * (raster.upper[1] - raster.lower[1]) / max(len(values) - 1, 1)
        warn(
            f"{raster!r} has different values at longitudes {raster.lower[0]:g} and {raster.upper[0]:g}, which are the "
            f"same place: at latitude {lat:.3g} {first[row]:.6g} and {last[row]:.6g}. The last column is left out; "
            "make the first and the last one equal",
            MismatchWarning,
        )


class ArcDistance(Distance):
    """A `Distance` from shapes in longitude and latitude, along great circles.

    Lines are straight in longitude and latitude (RFC 7946), and become chords on the sphere that are as short as h_min
    requires.
    """

    def __init__(self, given: Distance, sphere: Sphere) -> None:
        vars(self).update(vars(given))
        self.dim, self.given, self.sphere, self.on_sphere = 3, given, sphere, True
        longest = min(np.sqrt(8 * SAGITTA * self.h_min / sphere.radius), LONGEST_CHORD)
        ends = np.concatenate([given._begin, given._end])
        check_lonlat("a shape of a Distance", ends)
        warn_of_radians("Distance", ends)
        begin, end = _degree_lines(given._begin, given._end, given._radius)
        length = np.radians(np.hypot(*(end - begin).T))
        longest = max(longest, length.sum() / MOST_CHORDS)
        counts = np.maximum(np.ceil(length / longest), 1).astype(int)
        rows, place = rows_and_places(counts)
        step = ((end - begin) / counts[:, None])[rows]
        ends = begin[rows] + place[:, None] * step
        self._begin, self._end = sphere.positions(ends), sphere.positions(ends + step)
        self._radius = np.zeros(len(rows))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, 3) to the nearest shape along a great circle, (n,) float64."""
        return self.sphere.lengths(super().distance(points))

    def _finish(self, writer: CodeWriter, best2: str, law: int) -> str:
        arc = writer.variable(f"2 * asin(fmin(sqrt({best2}) / 2, (REAL)1))")
        return super()._finish(writer, writer.variable(f"{arc} * {arc}"), law)


class ArcRegion(ArcDistance):
    """A `Region` of shapes in longitude and latitude; distances are along great circles."""

    def __init__(self, given: Region, sphere: Sphere) -> None:
        super().__init__(given, sphere)
        pairs = list(zip(given.shapes, given.areas, strict=True))
        self.parts_in_degrees = [area_of("a shape of a Region", area) for s, area in pairs if not isinstance(s, Circle)]
        caps = [(*sphere.positions([s.center])[0], s.radius) for s, _ in pairs if isinstance(s, Circle)]
        self.caps = np.array(caps).reshape(-1, 4) / (sphere.radius, sphere.radius, sphere.radius, _DEGREES)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return whether each of `points` (n, 3) is in the region, (n,) bool."""
        lonlat, unit = directions(points), points / np.linalg.norm(points, axis=1)[:, None]
        inside = (unit @ self.caps[:, :3].T >= np.cos(self.caps[:, 3])).any(axis=1)
        for part in self.parts_in_degrees:
            inside |= part.contains(lonlat)
        return inside

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, 3) to the region along a great circle, (n,) float64; 0 in it."""
        return np.where(self.contains(points), 0.0, super().distance(points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return positions on the outline and in the region."""
        grid = self.given.landmarks(DEGREES)
        fits = np.abs(grid[:, 1]) <= 90
        return np.concatenate([super().landmarks(domain), self.sphere.positions(grid[fits])])

    def _finish(self, writer: CodeWriter, best2: str, law: int) -> str:
        inside = []
        for *center, radius in self.caps:
            at = writer.store(center, math.cos(radius))
            inside.append(f"x[0] * data[{at}] + x[1] * data[{at + 1}] + x[2] * data[{at + 2}] >= data[{at + 3}]")
        if self.parts_in_degrees:
            inside.append(self._in_degrees(writer))
        near = writer.variable(f"({' || '.join(inside)}) ? 0 : {best2}")
        return super()._finish(writer, near, law)

    def _in_degrees(self, writer: CodeWriter) -> str:
        """Return the kernel's expression that is true inside one of the polygons."""
        inner = writer.in_plane(DEGREES)
        edges = ring_edges(shapely.union_all([part.whole() for part in self.parts_in_degrees]))
        name = writer.function([], f"{inside_code(inner, edges, 'x')} ? 1 : 0")
        way = degrees_code(writer, -180.0)
        return f"{name}({way}, data) > 0"


def degrees_code(writer: CodeWriter, west: float) -> str:
    """Add code for the longitude (from `west` on) and latitude of x in degrees; return the name of its variable."""
    way = writer.name()
    writer.statements += [
        f"REAL {way}[2] = {{atan2(x[1], x[0]), atan2(x[2], hypot(x[0], x[1]))}};",
        f"{way}[0] *= (REAL)({_DEGREES!r});",
        f"{way}[1] *= (REAL)({_DEGREES!r});",
        f"{way}[0] += {way}[0] < (REAL)({west!r}) ? 360 : 0;",
        f"{way}[0] -= {way}[0] > (REAL)({west + 360!r}) ? 360 : 0;",
    ]
    return way


def _degree_lines(begin: np.ndarray, end: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return segments (m, 2) each in degrees; a circle of `radius` degrees becomes a closed polyline."""
    found = [(begin[radius == 0], end[radius == 0])]
    turn = np.linspace(0, 2 * np.pi, 721)
    for center, r in zip(begin[radius != 0], np.abs(radius[radius != 0]), strict=True):
        ring = cap_outline(center, float(r), turn)
        found.append((ring[:-1], ring[1:]))
    one, other = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return one, other


def cap_outline(center: np.ndarray, radius: float, turn: np.ndarray) -> np.ndarray:
    """Return the outline of a cap of `radius` at the bearings `turn` (k,), as degrees without jumps, (k, 2)."""
    lon, lat = np.radians(center)
    r = np.radians(radius)
    sine = np.clip(np.sin(lat) * np.cos(r) + np.cos(lat) * np.sin(r) * np.cos(turn), -1, 1)
    east = np.arctan2(np.sin(turn) * np.sin(r) * np.cos(lat), np.cos(r) - np.sin(lat) * sine)
    return np.degrees(np.column_stack([np.unwrap(lon + east), np.arcsin(sine)]))


class Caps(Field):
    """Round regions of fine cells on a sphere, nested or not, between which sizes grow at a bounded rate.

    The size is ``h = min(h_max, h_k + slope * (distance to region k))``, the least over all regions, with the distance
    along a great circle; inside of a region it is 0.

    Parameters
    ----------
    regions : sequence of (center, radius, h)
        Center as longitude and latitude in degrees; radius of the region along a great circle, and size of its cells,
        in the sphere's unit of length.
    h_max : float
        Size far from all regions.
    growth, slope : float
        Growth rate per cell, or dh/dx, as for `Distance`.
    sphere : clvoro.Sphere, optional
        By default the Earth in meters.

    Raises
    ------
    InputError, InputTypeError
        If a region is not as expected, or a number is out of range.

    Warns
    -----
    MismatchWarning
        If the centers look like radians.

    Examples
    --------
    27 km everywhere, 9 km and 3 km in the North Atlantic:

    >>> size = earth.Caps([((-45, 45), 3e6, 9e3), ((-45, 45), 1e6, 3e3)], h_max=27e3, growth=1.1)
    >>> size(clvoro.Sphere().positions([(-45, 45), (-45, 30), (135, -45)])).round().tolist()
    [3000.0, 9000.0, 27000.0]
    """

    dim, on_sphere = 3, True

    def __init__(
        self,
        regions: Sequence[tuple[ArrayLike, float, float]],
        h_max: float,
        growth: float | None = None,
        *,
        slope: float | None = None,
        sphere: Sphere | None = None,
    ) -> None:
        self.sphere = Sphere() if sphere is None else sphere
        if not isinstance(self.sphere, Sphere):
            raise InputTypeError(f"Caps sphere is {type(sphere).__name__}, expected a clvoro.Sphere")
        self.slope = check_slope("Caps", growth, slope)
        self.h_max = check_positive("Caps h_max", h_max)
        rows = []
        for k, region in enumerate(regions):
            if not isinstance(region, (tuple, list)) or len(region) != 3:
                raise InputTypeError(f"Caps regions[{k}] is {region!r}, expected ((longitude, latitude), radius, size)")
            center = self.sphere.positions([region[0]])[0] / self.sphere.radius  # type: ignore[list-item]
            radius = check_number(f"Caps regions[{k}] radius", region[1], least=0)
            rows.append([*center, radius, check_positive(f"Caps regions[{k}] size", region[2])])
        if not rows:
            raise InputError("Caps got no regions, expected at least one")
        warn_of_radians("Caps", np.array([np.asarray(region[0], float) for region in regions]))
        self.regions = np.array(rows)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        x = points / np.linalg.norm(points, axis=1)[:, None]
        h = np.full(len(points), self.h_max)
        for *center, radius, size in self.regions:
            chord = np.linalg.norm(x - center, axis=1)
            away = 2 * self.sphere.radius * np.arcsin(np.minimum(chord / 2, 1))
            h = np.minimum(h, size + self.slope * np.maximum(away - radius, 0))
        return h

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the centers of the regions."""
        return self.regions[:, :3] * float(domain.extent[0] / 2)

    def _emit(self, writer: CodeWriter) -> str:
        rows = self.regions / np.array([1, 1, 1, writer.scale, writer.scale])
        at = writer.store(self.h_max / writer.scale, self.slope, rows)
        return writer.variable(f"size_of_caps(x, data + {at}, {len(rows)})")

    def __repr__(self) -> str:
        return f"Caps({len(self.regions)} regions, h_max={self.h_max:g}, slope={self.slope:g})"
