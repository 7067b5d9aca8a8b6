"""Lines inside a domain in 2D, on which faces of cells lie: faults, breaklines, borders of materials, rivers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import shapely

from ...arguments import format_point, warn
from ...errors import InputError, InputTypeError, MismatchWarning
from ..borders import Borders, Size
from ..curves import Curve
from ..geojson import geometries_of_geojson

if TYPE_CHECKING:
    from ...mesh.diagram import Diagram
    from ..domain import Domain
    from .pairs import LinePairs

_SNAP = 1e-7  # of the domain: an end that is so near to another line, or to a wall, lies on it
_SMALLER = 0.8  # of the size field: sizes beside lines below this count as smaller
_SAGITTA = 0.15  # of a chord: largest distance of its middle from the curve
EXPECTED = "points (k, 2), curves of clvoro.curves, lines or polygons of shapely, GeoJSON, or a list of these"


class Network(NamedTuple):
    """The lines in a domain, divided where they meet."""

    nodes: np.ndarray
    """(k, 2) float64. Ends of chains. Ends that differ by a period are one node."""
    chains: list[np.ndarray]
    """list of (m, 2) float64."""
    ends: np.ndarray
    """(c, 2) int. The nodes at both ends of each chain."""


class Lines(Borders):
    """Lines inside a domain; `Domain.with_lines` makes them. Also a shape for `clvoro.sizing.Distance`.

    - `paths` tuple of (k, 2) float64: the vertices of each line. Curves are polylines within their tolerance.
    """

    word = "lines"

    def __init__(self, source: object) -> None:
        self.paths = tuple(_without_repetitions(path) for path in paths_of("lines", source))
        if not self.paths:
            raise InputError(f"lines is empty, expected {EXPECTED}")
        for k, path in enumerate(self.paths):
            path.setflags(write=False)
            if len(path) < 2:
                raise InputError(f"lines[{k}] is a single point, {format_point(path[0])}, expected a line")

    def __repr__(self) -> str:
        return f"Lines({len(self.paths)} lines with {sum(map(len, self.paths))} vertices)"

    def __len__(self) -> int:
        return len(self.paths)

    def describe(self) -> list[list[list[float]]]:
        """Return the vertices as lists, for files."""
        return [path.tolist() for path in self.paths]

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, 2), (m, 2) and radii (m,) of all segments, for `sizing.Distance`."""
        begin = np.concatenate([path[:-1] for path in self.paths])
        return begin, np.concatenate([path[1:] for path in self.paths]), np.zeros(len(begin))

    @property
    def geometry(self) -> Any:
        """All lines as a shapely MultiLineString."""
        return shapely.MultiLineString(list(self.paths))

    def inside(self, domain: Domain) -> Any:
        """Return the part of the lines in `domain` but not on its walls, divided where lines meet, as shapely lines."""
        extent = domain.extent
        region = domain.region
        snap = _SNAP * float(extent.max())
        copies = [self.geometry]
        for axis in np.flatnonzero(domain.periodic).tolist():
            copies += [_moved(line, axis, sign * extent[axis]) for line in copies for sign in (-1, 1)]
        lines = shapely.get_parts(shapely.union_all(copies))
        ends = shapely.multipoints(np.concatenate([shapely.get_coordinates(line)[[0, -1]] for line in lines]))
        joined = shapely.unary_union(shapely.snap(shapely.multilinestrings(lines), ends, snap))
        parts = shapely.get_parts(shapely.intersection(joined, region))
        parts = parts[(shapely.get_type_id(parts) == 1) & (shapely.length(parts) > snap)]
        walls = wall_lines(domain)
        kept = [piece for part in parts for piece in _beside(part, walls, snap)]
        return shapely.line_merge(shapely.multilinestrings(kept)) if kept else shapely.MultiLineString()

    def network(self, domain: Domain) -> Network:
        """Return the part of the lines in `domain`, divided where they meet."""
        merged = self.inside(domain)
        chains = [shapely.get_coordinates(line) for line in shapely.get_parts(merged)]
        if not chains:
            return Network(np.empty((0, 2)), [], np.empty((0, 2), int))
        ends = np.concatenate([chain[[0, -1]] for chain in chains])
        step = _SNAP * float(domain.extent.max())
        # Seams: the same place at both sides.
        place = np.rint((domain.wrap(ends + step / 2) - domain.lower) / step).astype(np.int64)
        _, first, index = np.unique(place, axis=0, return_index=True, return_inverse=True)
        return Network(ends[first], chains, np.reshape(index, (-1, 2)))

    def place(self, domain: Domain, free: Domain, size: Size) -> LinePairs:
        """Return the generators beside the lines of `domain`, in its part `free` without layers.

        Raises `InputError` if holes have no room.
        Warns with `MismatchWarning` if a line is left out at a place without room, or in layers; says where.
        """
        from .pairs import place_pairs

        pairs = place_pairs(free, self.network(free), size)
        if free is not domain and self.inside(free).length < (1 - 1e-9) * self.inside(domain).length:
            warn(
                "lines end where the layers of walls begin, which have generators of their own; leave out the layers "
                "of the walls that the lines reach, if faces have to lie on them there",
                MismatchWarning,
            )
        if len(pairs.left_out):
            x = pairs.left_out[0]
            if domain.holes is not None:
                raise InputError(
                    f"outlines of holes have no room at {format_point(x)}: they are too near to each other for the "
                    f"size there, {float(np.asarray(size(x[None]))[0]):.3g}, or a corner has less than about 20 "
                    "degrees; use smaller sizes around it, move the holes apart, or make the corner blunt"
                )
            warn(
                f"lines have no room at {format_point(x)}: they are too near to each other or meet at too small an "
                f"angle for the size there, {float(np.asarray(size(x[None]))[0]):.3g}. A part of a line without faces "
                "on it begins there; use smaller sizes around it, or leave out one of the lines",
                MismatchWarning,
            )
        return pairs

    def narrow_places(self, free: Domain, size: Size) -> tuple[np.ndarray, np.ndarray]:
        """Return the chords (k, 2, 2) beside which cells are smaller than `size`, and the sizes there (k,)."""
        from .pairs import place_pairs

        pairs = place_pairs(free, self.network(free), size)
        smaller = pairs.sizes < _SMALLER * np.asarray(size(pairs.chords.mean(axis=1)), float)
        return pairs.chords[smaller], pairs.sizes[smaller]

    def region_of_cells(self, diagram: Diagram) -> np.ndarray:
        """Return the region of each cell, (n,) int32; see `regions`."""
        return self.region_of(diagram.domain, diagram.points)

    def faces_of(self, diagram: Diagram) -> np.ndarray:
        """Return the rows of the faces of a mesh that lie on the lines, (k,) int."""
        f = diagram.faces
        ends = f.points[f.corners.reshape(-1, 2)[: f.n_inner]]
        return np.flatnonzero(self.covers(diagram.domain, ends))

    def covers(self, domain: Domain, segments: np.ndarray) -> np.ndarray:
        """Return which of `segments` (n, 2, 2) lie on the lines with both ends and the chord between; (n,) bool."""
        within = 10 * _SNAP * float(domain.extent.max())  # in float32, too
        middles = segments.mean(axis=1)
        ends = segments + (domain.wrap(middles) - middles)[:, None]
        lines = self._with_images(domain)
        shapely.prepare(lines)
        on = shapely.dwithin(shapely.points(ends), lines, within).all(axis=1)
        lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
        # Between two points of a curve its chord leaves it.
        on[on] = shapely.distance(shapely.points(ends[on].mean(axis=1)), lines) < np.maximum(
            _SAGITTA * lengths[on], within
        )
        return on

    def _with_images(self, domain: Domain) -> Any:
        """Return the lines in `domain` and their images beyond the periodic sides, as shapely lines."""
        inside, axes = self.inside(domain), np.flatnonzero(domain.periodic).tolist()
        images = [_moved(inside, axis, sign * domain.extent[axis]) for axis in axes for sign in (-1, 1)]
        return shapely.union_all([inside, *images])

    def regions(self, domain: Domain) -> list[Any]:
        """Return the parts into which the lines divide `domain`, as shapely polygons, the largest first.

        Parts that are joined by a periodic seam are one multipolygon.
        """
        region = domain.region
        # Lines of an end that misses a wall by round-off reach it.
        boundary = region.boundary
        lines = shapely.snap(self.inside(domain), boundary, _SNAP * float(domain.extent.max()))
        parts = shapely.get_parts(shapely.polygonize([shapely.unary_union([lines, boundary])]))
        parts = parts[shapely.intersects(region, shapely.point_on_surface(parts))]
        joined = _joined_at_seams(list(parts), domain)
        return sorted(joined, key=lambda part: (-round(part.area / domain.measure, 9), *part.bounds))

    def region_of(self, domain: Domain, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) the number of its part in `regions`, (n,) int32."""
        parts = self.regions(domain)
        found = np.zeros(len(points), np.int32)
        places = shapely.points(domain.wrap(points))
        rows, numbers = shapely.STRtree(parts).query_nearest(places, all_matches=False)
        found[rows] = numbers
        return found


def paths_of(name: str, source: object) -> Iterator[np.ndarray]:
    """Yield the vertices (k, 2) of all lines of `source`, which `name` names in errors.

    Raises `InputError` or `InputTypeError` if it is something else, or a vertex is not finite.
    """
    if isinstance(source, Lines):
        yield from source.paths
    elif isinstance(source, Curve):
        vertices = source.vertices
        yield np.concatenate([vertices, vertices[:1]]) if source.closed else vertices
    elif isinstance(source, shapely.Geometry):
        yield from _of_shape(name, source)
    elif isinstance(source, Mapping | str | PathLike) or hasattr(source, "__geo_interface__"):
        for shape in geometries_of_geojson(source):
            yield from _of_shape(name, shape)
    else:
        yield from _of_sequence(name, source)


def _of_sequence(name: str, source: Any) -> Iterator[np.ndarray]:
    array: np.ndarray
    try:
        array = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim == 2 and array.shape[1] == 2:
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            raise InputError(f"{name} has the vertex {array[bad][0]}, expected finite numbers")
        yield array.copy()
        return
    if (
        not isinstance(source, list | tuple | np.ndarray)
        or not len(source)
        or (np.ndim(source[0]) == 0 and (isinstance(source[0], int | float)))
    ):
        raise InputTypeError(f"{name} has {source!r:.60}, expected {EXPECTED}")
    for item in source:
        yield from paths_of(name, item)


def _of_shape(name: str, shape: Any) -> Iterator[np.ndarray]:
    for part in shapely.get_parts(shape):
        if part.geom_type in ("Polygon", "MultiPolygon"):
            part = part.boundary
        if part.geom_type in ("MultiLineString", "GeometryCollection"):
            yield from _of_shape(name, part)
        elif part.geom_type in ("LineString", "LinearRing") and not part.is_empty:
            yield shapely.get_coordinates(part)
        else:
            raise InputTypeError(f"{name} has a {part.geom_type}, expected {EXPECTED}")


def _without_repetitions(path: np.ndarray) -> np.ndarray:
    """Return the vertices without those equal to the one before."""
    path = np.asarray(path, float)
    return path[np.concatenate([[True], (np.diff(path, axis=0) != 0).any(axis=1)])]


def _moved(shape: Any, axis: int, distance: float) -> Any:
    """Return a shape of shapely, moved along an axis."""
    way = np.where(np.arange(2) == axis, distance, 0.0)
    return shapely.transform(shape, lambda x: x + way)


def wall_lines(domain: Domain) -> Any:
    """Return the walls of a domain in 2D as shapely lines."""
    if all(domain.periodic):
        return shapely.MultiLineString()
    boundary: Any = domain.boundary()
    begin, end, _ = boundary.items()
    return shapely.multilinestrings(np.stack([begin, end], axis=1))


def _beside(line: Any, walls: Any, within: float) -> list[Any]:
    """Return the segments of a line that do not run along the walls, as lines."""
    if walls.is_empty:
        return [line]
    points = shapely.get_coordinates(line)
    middle = shapely.points((points[1:] + points[:-1]) / 2)
    on = shapely.distance(shapely.points(points), walls) < within
    along = on[1:] & on[:-1] & (shapely.distance(middle, walls) < within)
    if not along.any():
        return [line]
    rest: Any = shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)[~along])
    return list(rest)


def _joined_at_seams(parts: list[Any], domain: Domain) -> list[Any]:
    """Join parts that share a piece of a periodic seam."""
    for axis in np.flatnonzero(domain.periodic).tolist():
        k = 0
        while k < len(parts):
            moved = _moved(parts[k], axis, float(domain.extent[axis]))
            shared = shapely.length(shapely.intersection(moved, np.array(parts, object)))
            mates = [j for j in np.flatnonzero(shared > _SNAP * float(domain.extent.max())).tolist() if j != k]
            if mates:
                j = mates[0]
                both = shapely.multipolygons([*shapely.get_parts(parts[k]), *shapely.get_parts(parts[j])])
                parts = [part for m, part in enumerate(parts) if m not in (j, k)] + [both]
                k = 0
            else:
                k += 1
    return parts
