"""Rings of a polygonal domain: clean, check and orient them. Errors name the ring and the place."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ..arguments import check_rows, format_point
from ..errors import InputError, InputTypeError
from .curves import CLOSE, Curve, angles
from .domain import LARGEST_EDGE

SHORTEST_EDGE = 1e-12
"""Shortest edge, as a share of the bounding box's longest edge."""
REPAIRED = 1e-10
"""Least length of the edges of repaired rings over the extent of the domain; least area of a ring over its square."""
_RESOLUTION = 2.0**-40
"""Smallest extent, as a share of the largest coordinate: 12 bits are left of float64's 52."""
WALL_CORNER = np.pi / 6
"""Turn of a boundary, 30 degrees, beyond which it has a corner."""
_SPLIT = 2.0**27 + 1
_NAMED = 4  # rings at one place that an error lists


@dataclass(frozen=True)
class Ring:
    """One closed chain of edges."""

    given: np.ndarray
    """(g, 2) float64. The caller's vertices, without a closing vertex."""
    vertices: np.ndarray
    """(k, 2) float64. Those that differ from the next one, in the caller's order or in reverse."""
    numbers: np.ndarray
    """(k,) int64. Number of each edge in `given`: edge i goes from vertex i to the next."""
    name: str
    """Name in errors: "outer ring", "hole-2"; with several pieces "outer-1" and so on, as its boundary is named."""
    curved: CurvedEdges
    """The curves that edges of `given` stand for."""


@dataclass(frozen=True)
class OrientedRings:
    """The boundary of a polygon with the domain on the left of every edge, for algorithms.

    Outer rings run counter-clockwise, holes clockwise. Vertices on a straight line are kept, repeated ones are dropped.
    The place of an edge in these arrays is not its number: `edge_numbers` and `places` translate.
    """

    vertices: np.ndarray
    """(k, 2) float64."""
    ring_starts: np.ndarray
    """(r + 1,) int32. Ring i is ``vertices[ring_starts[i] : ring_starts[i + 1]]``."""
    next_vertex: np.ndarray
    """(k,) int32. Edge e goes from vertex e to vertex ``next_vertex[e]``."""
    edge_numbers: np.ndarray
    """(k,) int32. The caller's number of each edge."""
    places: np.ndarray
    """(n,) int32. The place of each edge by the caller's number; -1 for an edge without length."""

    @classmethod
    def of(cls, rings: Sequence[Ring]) -> OrientedRings:
        """Join `rings` one after the other."""
        starts = np.cumsum([0, *(len(ring.vertices) for ring in rings)])
        given = np.cumsum([0, *(len(ring.given) for ring in rings)])
        following = np.arange(1, starts[-1] + 1)
        following[starts[1:] - 1] = starts[:-1]
        numbers = [first + ring.numbers for first, ring in zip(given[:-1], rings, strict=True)]
        numbers = np.concatenate(numbers)
        places = np.full(given[-1], -1, np.int32)
        places[numbers] = np.arange(len(numbers))
        vertices = np.concatenate([ring.vertices for ring in rings])
        starts, following, numbers = (a.astype(np.int32) for a in (starts, following, numbers))
        for array in (vertices, starts, following, numbers, places):
            array.setflags(write=False)
        return cls(vertices, starts, following, numbers, places)

    @property
    def rings(self) -> list[np.ndarray]:
        """Vertices (k, 2) of each ring."""
        return [self.vertices[a:b] for a, b in pairwise(self.ring_starts)]

    @cached_property
    def ends(self) -> np.ndarray:
        """The end of each edge, (k, 2)."""
        return self.vertices[self.next_vertex]

    @cached_property
    def along(self) -> np.ndarray:
        """The vector from the begin to the end of each edge, (k, 2)."""
        return self.ends - self.vertices

    @cached_property
    def lengths(self) -> np.ndarray:
        """The length of each edge, (k,)."""
        return np.hypot(*self.along.T)

    @cached_property
    def before(self) -> np.ndarray:
        """The edge that ends in each vertex, (k,) int."""
        found = np.empty(len(self.next_vertex), int)
        found[self.next_vertex] = np.arange(len(found))
        return found

    @cached_property
    def tree(self) -> Any:
        """Tree of the edges."""
        return shapely.STRtree(np.asarray(shapely.linestrings(np.stack([self.vertices, self.ends], axis=1))))

    @cached_property
    def turns(self) -> np.ndarray:
        """Angle by which the boundary turns to the left in each vertex, -pi to pi, (k,)."""
        ahead = self.along / self.lengths[:, None]
        after = ahead[self.next_vertex]
        found = np.empty(len(ahead))
        found[self.next_vertex] = angles(ahead, after)
        return found

    @cached_property
    def sharpest(self) -> np.ndarray:
        """The vertex of each ring with the largest turn, the first of those equal up to round-off, (r,) int."""
        found = []
        for a, b in pairwise(self.ring_starts.tolist()):
            by = np.abs(self.turns[a:b])
            found.append(a + int(np.argmax(by >= (1 - 1e-9) * by.max())))
        return np.array(found)


def make_rings(pieces: Sequence[Sequence[object]]) -> list[list[Ring]]:
    """Return the rings of each piece, its outer ring first.

    Repeated vertices are dropped. Clockwise outer rings and counter-clockwise holes are reversed.

    - `pieces` sequence of sequences of array_like (k, 2): for each piece its outer ring and its holes, closed by a
      repeated first vertex or not.

    Raises `InputError` or `InputTypeError` if the rings are not those of a valid polygon; names the ring and the place.
    """
    for p, piece in enumerate(pieces):
        if not hasattr(piece, "__len__"):
            raise InputTypeError(
                f"piece {p + 1} is a {type(piece).__name__}, expected a list of its outer ring and its holes"
            )
    if not len(pieces):
        raise InputError("Polygon got no rings, expected an outer ring of at least 3 vertices")
    several = len(pieces) > 1
    rings: list[list[Ring]] = []
    holes = 0
    known: dict[tuple[bool, bytes], str] = {}
    for p, piece in enumerate(pieces):
        if not len(piece):
            raise InputError(f"Polygon got no rings for piece {p + 1}, expected an outer ring")
        first = f"outer-{p + 1}" if several else "outer ring"
        names = [first, *(f"hole-{holes + h}" for h in range(1, len(piece)))]
        holes += len(piece) - 1
        rings.append([])
        for k, (ring, name) in enumerate(zip(piece, names, strict=True)):
            rings[-1].append(_cleaned(ring, name))
            # Checked first: shapely would find an intersection at every edge.
            other = known.setdefault((k > 0, _shape_key(rings[-1][-1].vertices)), name)
            if other != name:
                raise InputError(f"Polygon's {name} repeats {_called(other)}; leave one of them out")
    flat = [ring for piece in rings for ring in piece]
    for ring in flat:
        _check_area(ring)
    _check_lengths(flat)
    shapes = [_shape(piece) for piece in rings]
    for piece, shape in zip(rings, shapes, strict=True):
        _check_valid(shape, piece)
    if several:
        _check_valid(shapely.multipolygons(shapes), flat)
    return [[_oriented(ring, clockwise=i > 0) for i, ring in enumerate(piece)] for piece in rings]


def repaired(
    pieces: Sequence[Sequence[object]], names: Mapping[str, Any] | None
) -> tuple[list[list[np.ndarray]], dict[str, list[int]] | None, float]:
    """Return pieces whose rings do not cross, as `make_rings` takes them, of any rings; see `Polygon`.

    Results:
    - `pieces`: list of lists of (k, 2) float64
    - `names`: edges of the new rings for each of `names`: those nearest to an edge with the name.
    - `change`: by how much the area differs from the sum of the outer rings without their holes, over the new area.
    """
    flat = [_cleaned(ring, f"ring {k}") for k, ring in enumerate(ring for piece in pieces for ring in piece)]
    rings, shapes, before = iter(flat), [], 0.0
    for piece in pieces:
        outer, *holes = (shapely.Polygon(next(rings).vertices) for _ in piece)
        before += outer.area - sum(hole.area for hole in holes)
        shapes.append(_valid(outer).difference(shapely.union_all([_valid(hole) for hole in holes])))
    whole = shapely.union_all(shapes)
    extent = float(np.ptp(np.concatenate([ring.vertices for ring in flat]), axis=0).max())
    whole = _valid(shapely.remove_repeated_points(whole, REPAIRED * extent))
    least = REPAIRED * extent**2
    parts = [part for part in shapely.get_parts(whole) if part.area > least]
    if not parts:
        raise InputError("Polygon has no area that is left when its rings are repaired, expected one with an area")
    made = [
        [shapely.get_coordinates(part.exterior)[:-1]]
        + [shapely.get_coordinates(hole)[:-1] for hole in part.interiors if shapely.Polygon(hole).area > least]
        for part in parts
    ]
    area = sum(part.area for part in parts)
    change = abs(area - before) / area
    if names is None:
        return made, None, change
    given = np.concatenate([ring.given for ring in flat])
    after = np.concatenate([np.roll(ring.given, -1, axis=0) for ring in flat])
    middles = [(ring + np.roll(ring, -1, axis=0)) / 2 for piece in made for ring in piece]
    tree = shapely.STRtree(np.asarray(shapely.linestrings(np.stack([given, after], axis=1))))
    nearest = tree.nearest(shapely.points(np.concatenate(middles)))
    found: dict[str, list[int]] = {}
    for name, edges in names.items():
        rows = np.atleast_1d(np.asarray(edges))
        if rows.dtype.kind not in "iu" or (rows.size and not 0 <= rows.min() <= rows.max() < len(given)):
            raise InputError(
                f"names[{name!r}] is {edges!r:.60}, expected numbers of edges from 0 to {len(given) - 1} where rings "
                "are repaired"
            )
        found[name] = np.flatnonzero(np.isin(nearest, rows)).tolist()
    return made, {name: edges for name, edges in found.items() if edges} or None, change


def _valid(shape: Any) -> Any:
    """Return a shape whose rings do not cross, without lines and points."""
    return shape if shape.is_valid else shapely.make_valid(shape, method="structure", keep_collapsed=False)


def signed_area(vertices: np.ndarray) -> float:
    """Return the area inside a ring (k, 2), positive if it runs counter-clockwise; correctly rounded."""
    x, y = vertices.T
    x_next, y_next = np.roll(vertices, -1, axis=0).T
    terms = [*_product(x, y_next), *_product(-x_next, y)]
    return 0.5 * math.fsum(np.concatenate(terms).tolist())


def _product(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a * b exactly as a sum of two numbers (Dekker, Numer. Math. 18 (1971) 224)."""
    p = a * b
    (a_high, a_low), (b_high, b_low) = _halves(a), _halves(b)
    return p, a_low * b_low - (((p - a_high * b_high) - a_low * b_high) - a_high * b_low)


def _halves(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    t = _SPLIT * a
    high = t - (t - a)
    return high, a - high


def _cleaned(given: object, name: str) -> Ring:
    """Check one ring, and drop vertices that are equal to the next one."""
    curved = None
    if has_curves(given):
        given, curved = unroll(given, name)
    hint = _other_maker(given)
    if hint:
        raise InputTypeError(f"Polygon's {name} is a {type(given).__name__}, expected its vertices (k, 2); {hint}")
    is_point = isinstance(given, list | tuple | np.ndarray) and len(given) == 2 and isinstance(given[0], Real)
    if is_point and not name.startswith("outer"):
        raise InputError(f"Polygon's {name} is a point, expected a ring (k, 2); write [ring] for a single hole")
    try:
        array = check_rows(f"Polygon's {name}", given, 2)
    except (InputError, InputTypeError) as error:
        hint = _other_nesting(given, name)
        raise type(error)(f"{error}{hint}") from error
    array = array + 0.0  # turns -0.0 into 0.0, so that equal polygons have equal bytes
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise InputError(
            f"Polygon's {name} has vertex {bad[0]} at {format_point(array[bad[0]])}, expected finite numbers"
        )
    if curved is None:
        if len(array) > 1 and (array[0] == array[-1]).all():
            array = array[:-1]
        curved = CurvedEdges.straight(len(array))
    long = (array != np.roll(array, -1, axis=0)).any(axis=1)
    vertices = array[long]
    if len(vertices) < 3:
        raise InputError(f"Polygon's {name} has {len(vertices)} distinct vertices, expected at least 3")
    return Ring(array, vertices, np.flatnonzero(long), name, curved)


def _shape_key(vertices: np.ndarray) -> bytes:
    """Return a key that does not depend on the first vertex or the direction of a ring."""
    first = np.lexsort(vertices.T)[0]
    forth = np.roll(vertices, -first, axis=0)
    back = np.roll(forth[::-1], 1, axis=0)
    return min(forth.tobytes(), back.tobytes())


def _other_maker(given: object) -> str:
    """Return a hint for objects from which another method makes a Polygon; empty for others."""
    if isinstance(given, str | PathLike):
        geojson = str(given).lstrip().startswith("{") or Path(given).suffix.endswith("json")
        return f"write clvoro.Polygon.{'from_geojson' if geojson else 'from_wkt'}(...)"
    if type(given).__module__.startswith("shapely"):
        return "write clvoro.Polygon.from_shapely(...)"
    if isinstance(given, Mapping) or hasattr(given, "__geo_interface__"):
        return "write clvoro.Polygon.from_geojson(...)"
    return ""


def _other_nesting(given: object, name: str) -> str:
    """Return what to write if `given` holds several rings where one ring is expected, else an empty text."""
    if not isinstance(given, list | tuple | np.ndarray) or not len(given):
        return ""
    first = given[0]
    nested = isinstance(first, list | tuple | np.ndarray) and len(first) and np.ndim(first[0]) == 1
    return " (for several rings write clvoro.Polygon(rings[0], rings[1:]))" if nested else ""


def _check_lengths(rings: Sequence[Ring]) -> None:
    """Refuse domains that are too large, too small or too far from the origin for float64, and edges too short."""
    every = np.concatenate([ring.vertices for ring in rings])
    with np.errstate(over="ignore"):
        extent = every.max(axis=0) - every.min(axis=0)
    if not (extent.min() >= 1 / LARGEST_EDGE and extent.max() <= LARGEST_EDGE):
        raise InputError(
            f"Polygon has a bounding box of edges {extent.tolist()}, expected {1 / LARGEST_EDGE:g} to "
            f"{LARGEST_EDGE:g}, so that areas and moments of cells do not overflow; choose another unit of length"
        )
    if extent.max() < _RESOLUTION * np.abs(every).max():
        raise InputError(
            f"Polygon has a vertex at {format_point(every[0])} and an extent of {extent.max():g}, expected a larger "
            "extent: too few digits of float64 are left; move it to the origin"
        )
    for ring in rings:
        step = np.roll(ring.vertices, -1, axis=0) - ring.vertices
        length = np.hypot(*step.T)
        e = int(np.argmin(length))
        if length[e] < SHORTEST_EDGE * extent.max():
            raise InputError(
                f"Polygon's {ring.name} has an edge of length {length[e]:.3g} at vertex {ring.numbers[e]}"
                f"{ring.curved.label(ring.numbers[e])}, {format_point(ring.vertices[e])}, expected at least "
                f"{SHORTEST_EDGE:g} of the domain's size; "
                "merge its ends, as Polygon(..., repair=True) does"
            )


def _check_area(ring: Ring) -> None:
    # Relative to a vertex, so that round-off does not depend on the distance from the origin.
    with np.errstate(over="ignore", invalid="ignore"):
        offset = ring.vertices - ring.vertices[0]
        far = offset[np.argmax(np.hypot(*offset.T))]
        across = np.abs(offset @ np.array([-far[1], far[0]])) / np.hypot(*far)
    if across.max() < SHORTEST_EDGE * np.hypot(*far):
        raise InputError(
            f"Polygon's {ring.name} has all its vertices on the line from {format_point(ring.vertices[0])} to "
            f"{format_point(ring.vertices[0] + far)}, expected a ring with an area"
        )


def _shape(piece: Sequence[Ring]) -> Any:
    return shapely.Polygon(piece[0].vertices, [hole.vertices for hole in piece[1:]])


_UNITE = "unite the pieces, as Polygon.from_pieces(pieces, repair=True) does"
_REMEDIES = {
    "Hole lies outside shell": "leave the hole out, or make it a separate piece",
    "Holes are nested": "unite the holes, or make the inner one a separate piece",
    "Nested shells": _UNITE,
    "Interior is disconnected": "pass the parts as separate pieces",
}


def _check_valid(shape: Any, rings: Sequence[Ring]) -> None:
    """Refuse an invalid polygon, with the reason that shapely finds and the rings at the place."""
    reason = shapely.is_valid_reason(shape)
    if reason == "Valid Geometry":
        return
    found = re.fullmatch(r"(.*)\[(\S+) (\S+)\]", reason)
    if found is None:
        raise InputError(f"Polygon is not valid: {reason}")
    reason, place = found[1], np.array([float(found[2]), float(found[3])])
    away = []
    for ring in rings:
        distance = distance_to_edges(place, ring.vertices)
        away.append((float(distance.min()), int(ring.numbers[np.argmin(distance)])))
    close = min(d for d, _ in away) + 1e-9 * float(np.ptp(rings[0].vertices, axis=0).max())
    there = [  # edges are numbered within their rings
        f"edge {e} of {_called(ring.name)}{ring.curved.label(e)}"
        for ring, (d, e) in zip(rings, away, strict=True)
        if d <= close
    ]
    more = len(there) - _NAMED
    where = " and ".join([*there[:_NAMED], *([f"edges of {more} more rings"] if more > 0 else [])])
    remedy = "correct it, as Polygon(..., repair=True) does, from_shapely and the like, or repair = true in a case"
    if shape.geom_type == "MultiPolygon":  # each piece is valid
        remedy = _UNITE
    remedy = _REMEDIES.get(reason, remedy)
    raise InputError(f"Polygon is not valid: {reason} at {format_point(place)}, {where}; {remedy}")


def _called(name: str) -> str:
    return f"the {name}" if name == "outer ring" else name


def distance_to_edges(point: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the distances (k,) of one point (2,) to the edges of one ring (k, 2)."""
    nearest = project(point, vertices, np.roll(vertices, -1, axis=0))
    return np.hypot(*(nearest - point).T)


def project(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the nearest points (n, 2) to `points` on the segments from `start` to `end`, row by row."""
    along = end - start
    t = ((points - start) * along).sum(axis=-1) / (along * along).sum(axis=-1)
    t = np.clip(t, 0.0, 1.0)[..., None]
    # Computed from the nearer end, so that both ends are exact.
    return np.where(t <= 0.5, start + t * along, end - (1.0 - t) * along)


def _oriented(ring: Ring, clockwise: bool) -> Ring:
    if (signed_area(ring.vertices) < 0) == clockwise:
        return ring
    # Edge j of the reversed ring is edge k - 2 - j of the other: it begins where that ends.
    numbers = np.roll(ring.numbers[::-1], -1)
    return replace(ring, vertices=np.ascontiguousarray(ring.vertices[::-1]), numbers=numbers)


_GAP = 1e-6  # of a ring's extent: a smaller gap between a curve and the next item is a mistake
_OFF = 1e-6  # of a curve's extent: its largest distance from its vertices in a file


@dataclass(frozen=True)
class CurvedEdges:
    """Curves of a polygon, or of one ring, and the part of a curve that each edge stands for.

    - `curves`: tuple of Curve
    - `curve` (k,) int32: number in `curves` for each edge; -1 for an edge that belongs to no curve.
    - `span` (k,) int32: number of the smooth part of the curve; -1 for a straight edge.
    - `ends` (k, 2) float64: parameters of the curve at the begin and the end of each edge.
    """

    curves: tuple[Curve, ...]
    curve: np.ndarray
    span: np.ndarray
    ends: np.ndarray

    @classmethod
    def straight(cls, count: int) -> CurvedEdges:
        """Return `count` straight edges."""
        return cls((), np.full(count, -1, np.int32), np.full(count, -1, np.int32), np.zeros((count, 2)))

    @classmethod
    def join(cls, parts: Sequence[CurvedEdges]) -> CurvedEdges:
        """Join the edges of rings, one after the other."""
        first, curve = 0, []
        for part in parts:
            curve.append(np.where(part.curve >= 0, part.curve + first, -1).astype(np.int32))
            first += len(part.curves)
        return cls(
            tuple(c for part in parts for c in part.curves),
            np.concatenate(curve),
            np.concatenate([part.span for part in parts]),
            np.concatenate([part.ends for part in parts]),
        )

    def nearest(self, points: np.ndarray, edges: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return the nearest points (n, 2) to `points` on the parts of curves that `edges` (n,) stand for.

        Points of straight edges are returned as they are. `begins` and `ends`, (n, 2) each, are the vertices of the
        edges; a point that is nearest to one of them is moved there exactly.
        """
        found = np.array(points, dtype=float)
        key = np.where(self.span[edges] >= 0, self.curve[edges], -1)
        for c in np.unique(key[key >= 0]):
            for s, span in enumerate(self.curves[c].spans):
                rows = np.flatnonzero((key == c) & (self.span[edges] == s))
                if not rows.size:
                    continue
                low, high = self.ends[edges[rows]].T
                t = span.nearest(found[rows], low, high)
                at = span.at(t)[0]
                at = np.where((t == low)[:, None], begins[rows], at)
                found[rows] = np.where((t == high)[:, None], ends[rows], at)
        return found

    def label(self, edge: int) -> str:
        """Return the curve of an edge for error messages; empty for other edges."""
        return f" on {self.curves[self.curve[edge]]!r}" if self.curve[edge] >= 0 else ""

    def describe(self) -> list[dict[str, Any]]:
        """Return plain values for files: each curve, its first edge and number of edges, and parameters of vertices."""
        found = []
        for c, curve in enumerate(self.curves):
            edges = np.flatnonzero(self.curve == c)
            spans = [edges[self.span[edges] == s] for s in range(len(curve.spans))]
            found.append(
                {
                    "curve": curve.describe(),
                    "edges": [int(edges[0]), len(edges)],
                    "parameters": [[*self.ends[e, 0].tolist(), float(self.ends[e[-1], 1])] for e in spans],
                }
            )
        return found

    @classmethod
    def described(cls, values: object, begins: np.ndarray, ends: np.ndarray) -> CurvedEdges:
        """Return the edges from the values that `describe` returns; `begins`, `ends`: vertices of all edges, (k, 2).

        Raises `InputError` or `InputTypeError` if the values do not describe curves through the vertices.
        """
        made = cls.straight(len(begins))
        curves = []
        try:
            for c, item in enumerate(values):  # type: ignore[arg-type]
                curve = Curve.described(item["curve"])
                first, count = item["edges"]
                edges = np.arange(len(begins))[first : first + count]
                if first < 0 or not 0 < count == len(edges) or (made.curve[edges] >= 0).any():
                    raise ValueError("edges")
                made.curve[edges] = c
                for s, (span, given) in enumerate(zip(curve.spans, item["parameters"], strict=True)):
                    t = np.array(given, float)
                    mine, edges = edges[: len(t) - 1], edges[len(t) - 1 :]
                    if not (t.ndim == 1 and 2 <= len(t) == len(mine) + 1 and (np.diff(t) > 0).all()):
                        raise ValueError("parameters")
                    if not (t[0] == span.begin and t[-1] == span.end):
                        raise ValueError("parameters")
                    made.span[mine], made.ends[mine] = s, np.column_stack([t[:-1], t[1:]])
                    off = span.at(t)[0] - np.concatenate([begins[mine], ends[mine[-1:]]])
                    if not (np.abs(off) <= _OFF * curve.extent).all():
                        raise ValueError("a curve does not pass through its vertices")
                curves.append(curve)
        except (InputError, InputTypeError):
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"the description of a Polygon's curves is damaged ({error})") from error
        return cls(tuple(curves), made.curve, made.span, made.ends)


def has_curves(ring: object) -> bool:
    """Return whether `ring` is a curve or a list with curves in it."""
    return isinstance(ring, Curve) or (isinstance(ring, list | tuple) and any(isinstance(item, Curve) for item in ring))


def unroll(ring: Any, name: str) -> tuple[np.ndarray, CurvedEdges]:
    """Return the vertices (k, 2) of a ring that has curves in it, without a closing vertex, and its edges.

    Where a curve ends in a point of the ring, the point is the vertex. Straight edges join all other ends.

    - `name`: name of the ring in errors.

    Raises `InputError` or `InputTypeError` if the ring is one open curve, has a closed one beside other items, or a gap
    that is larger than round-off and smaller than 1e-6 of the ring; names the place.
    """
    items = [ring] if isinstance(ring, Curve) else list(ring)
    if isinstance(ring, Curve) and not ring.closed:
        raise InputError(
            f"Polygon's {name} is open: {ring!r} does not return to its start; write [curve] to close it by a straight "
            "edge, or a list of curves and points"
        )
    whole = len(items) == 1 and items[0].closed
    ends_of_ring = [item for item in (items[0], items[-1]) if not isinstance(item, Curve)]
    if len(ends_of_ring) == 2 and np.array_equal(*ends_of_ring):
        items = items[:-1]
    vertices, curve, span, ends, is_curve = [], [], [], [], []
    curves: list[Curve] = []
    for i, item in enumerate(items):
        if not isinstance(item, Curve):
            try:
                vertices.append(check_rows(f"item {i}", [item], 2))
            except (InputError, InputTypeError) as error:
                raise type(error)(
                    f"Polygon's {name} has item {i}, expected a point (x, y) or a curve: {error}"
                ) from error
            parts = CurvedEdges.straight(1)
        elif item.closed and not whole:
            raise InputError(
                f"Polygon's {name} has the closed curve {item!r} beside other items, expected open curves; make it a "
                "ring of its own"
            )
        else:
            parts = _edges_of(item)
            vertices.append(item.vertices)
        curve.append(np.where(parts.curve >= 0, len(curves), -1))
        span.append(parts.span)
        ends.append(parts.ends)
        is_curve.append(np.full(len(parts.span), isinstance(item, Curve)))
        curves += parts.curves
    number = np.repeat(np.arange(len(items)), [len(v) for v in vertices])
    every, on_curve = np.concatenate(vertices), np.concatenate(is_curve)
    made = CurvedEdges(
        tuple(curves),
        np.concatenate(curve).astype(np.int32),
        np.concatenate(span).astype(np.int32),
        np.concatenate(ends),
    )
    if whole:
        return every, made
    return _merge_ends(every, made, number, on_curve, name)


def _edges_of(curve: Curve) -> CurvedEdges:
    """Return one edge for each vertex of `curve`; the one behind the last vertex is straight if it is not the curve's.

    The straight edge that closes a closed curve belongs to the curve.
    """
    t, spans = curve.nodes
    extra = len(curve.vertices) - len(t)
    numbers = np.zeros(len(t) + extra, np.int32)
    if extra and not curve.closed:
        numbers[-1] = -1
    return CurvedEdges(
        (curve,), numbers, np.append(spans, [-1] * extra).astype(np.int32), np.concatenate([t, np.zeros((extra, 2))])
    )


def _merge_ends(
    every: np.ndarray, made: CurvedEdges, item: np.ndarray, on_curve: np.ndarray, name: str
) -> tuple[np.ndarray, CurvedEdges]:
    """Merge the last vertex of each item with the first one of the next where a curve ends in it."""
    after = np.roll(np.arange(len(every)), -1)
    last = np.flatnonzero((item != item[after]) & (on_curve | on_curve[after]))
    if item[0] == item[-1] and on_curve[0]:  # one open curve alone
        last = np.array([len(every) - 1])
    first = after[last]
    extent = np.ptp(every, axis=0).max()
    away = np.hypot(*(every[last] - every[first]).T)
    bad = np.flatnonzero((away > CLOSE * extent) & (away < _GAP * extent))
    if bad.size:
        k = bad[0]
        x, y = every[last[k]]
        raise InputError(
            f"Polygon's {name} is open at ({x:.12g}, {y:.12g}): items {item[last[k]]} and {item[first[k]]} are "
            f"{away[k]:.3g} apart, expected a common point or a longer straight edge; give both with more digits"
        )
    near = away <= CLOSE * extent
    kept = np.ones(len(every), bool)
    for a, b in zip(last[near].tolist(), first[near].tolist(), strict=True):
        kept[a] = False
        if not on_curve[a]:
            every[b] = every[a]
    return every[kept], CurvedEdges(made.curves, made.curve[kept], made.span[kept], made.ends[kept])
