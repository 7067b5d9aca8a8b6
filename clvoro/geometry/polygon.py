"""Polygonal domains in 2D, with holes, of one or several pieces."""

from __future__ import annotations

import hashlib
import json
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from os import PathLike
from typing import Any

import numpy as np
import shapely

from ..arguments import check_rows, counted, format_point, warn
from ..connectivity import rows_and_places
from ..errors import InputError, InputTypeError, MismatchWarning
from ..opencl.engine import Engine, Traits
from .boundary_names import BoundaryNames, Walls
from .curves import Curve
from .domain import Domain
from .edge_bins import EdgeBins
from .fixed_generators import FixedGenerators, place_around_corners
from .gaps import NarrowPart, find_narrow_parts
from .geojson import may_be_degrees, pieces_of_description, pieces_of_geojson, pieces_of_shape, pieces_of_wkt, squeezed
from .rings import REPAIRED, CurvedEdges, OrientedRings, make_rings, project, repaired, signed_area
from .shapes import Edges
from .simplification import pieces_of, simplify

_MARGIN = 1 / 64
"""Distance from the domain to the box that clips cells, as a share of the bounding box's longest edge."""
_ROUNDINGS = 8
"""Tolerance for points on the boundary, in units of round-off of the largest coordinate."""

FEW_CELLS = 30
"""Pieces that fewer cells would fill do not meet their sizes."""
_LINES = threading.Lock()
"""Held while lines are compared with prepared shapes, which threads must not do at the same time."""
BOUNDARY_SHIFTS = (8, 16, 32, 64, 64, 64, 64, 64)
"""Shifts of the boundary in units of round-off, each in another direction. They are tried one after the other if the
boundary cannot be traced through the diagram. They are within the tolerance of vertices."""


class Polygon(Domain):
    """Polygonal domain in 2D.

    Parameters
    ----------
    outer : array_like (k, 2), curve, or list of points and curves
        The outer ring in either orientation: its vertices, of which the first may be repeated at the end; a closed
        curve of `clvoro.curves`; or a list of points and open curves, joined by straight edges.
    holes : sequence of rings
        Holes, each like `outer`; they may touch each other and the outer ring in single points.
    names : mapping, optional
        Names of boundaries, each with its edges: numbers, default names, or a sequence of them. By default a boundary
        is a ring: ``outer``, ``hole-1``, ``hole-2``, ..., or ``outer-1``, ``outer-2``, ... with several pieces, or a
        curve with a name. Edges that are not mentioned keep the name of their curve or ring.
    repair : bool
        Accept rings that cross themselves or each other, holes that overlap, and repeated vertices. Such holes become
        one, loops become rings of their own, and a domain that is cut in two has several pieces. A warning says by how
        much the area changes. Each new edge has the name of the nearest given one; `names` may have only numbers of
        edges. Curves become polylines.

    Attributes
    ----------
    vertices : (k, 2) float64
        The vertices of all rings as the caller gave them, one ring after the other, without closing vertices. Edge k
        goes from vertex k to the next one of its ring; a face on it has the neighbor ``-1 - k``.
    ring_starts : (r + 1,) int32
        Ring i is ``vertices[ring_starts[i] : ring_starts[i + 1]]``. Each piece's outer ring comes before
        its holes.
    piece_of_ring : (r,) int32
        Number of the piece that each ring bounds; pieces may touch in single points.
    curves : tuple of clvoro.curves.Curve
        The curves of the boundary, in the order of their edges. Their vertices lie on them, and straight edges within
        the curve's tolerance stand for them; `on_curve` returns points on the curves themselves.
    oriented : OrientedRings
        The same edges with the domain on their left, for algorithms.
    lower, upper : (2,) tuples of float
        The bounding box.

    Raises
    ------
    InputError, InputTypeError
        With the ring and the place: if a vertex is not finite; a ring has fewer than 3 distinct vertices or no area,
        or crosses or touches itself; a hole is outside, overlaps another one or divides the domain; pieces overlap; an
        edge is shorter than 1e-12 of the domain; or the domain is too large, too small or too far from the origin for
        float64. Also if a ring is an open curve, or a curve ends near the next point of its ring, but not in it. Also
        if a name is not a word, clashes with another one, or stands for an edge that does not exist or has a name
        already.

    Examples
    --------
    >>> square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    >>> island = [(0.4, 0.4), (0.6, 0.4), (0.5, 0.6)]
    >>> pond = clvoro.Polygon(square, [island], names={"island": range(4, 7), "inlet": 3})
    >>> round(pond.measure, 12), pond.boundary_names
    (0.98, ('island', 'inlet', 'outer'))

    A step with a rounded edge:

    >>> edge = clvoro.curves.arc((0.9, 0.4), 0.1, 90, 0, name="edge")
    >>> clvoro.Polygon([(0, 0.5), edge, (1, 0), (3, 0), (3, 1), (0, 1)]).boundary_names
    ('outer', 'edge')
    """

    def __init__(
        self,
        outer: object,
        holes: Sequence[object] = (),
        names: Mapping[str, Walls] | None = None,
        repair: bool = False,
    ):
        try:
            rings = [outer, *holes]
        except TypeError:
            raise InputTypeError(f"holes is a {type(holes).__name__}, expected a list of rings") from None
        self._build([rings], names, repair=repair)

    @classmethod
    def from_pieces(
        cls, pieces: Sequence[Sequence[object]], names: Mapping[str, Walls] | None = None, repair: bool = False
    ) -> Polygon:
        """Make a domain of several pieces, each a list of its outer ring and its holes.

        Edges are numbered through the rings of the first piece, then of the second one, and so on.

        Examples
        --------
        >>> clvoro.Polygon.from_pieces([[[(0, 0), (1, 0), (1, 1)]], [[(2, 0), (3, 0), (3, 1)]]]).n_pieces
        2
        """
        made = cls.__new__(cls)
        made._build(pieces, names, repair=repair)
        return made

    @classmethod
    def from_shapely(cls, geometry: Any, names: Mapping[str, Walls] | None = None, repair: bool = False) -> Polygon:
        """Make a domain of a shapely Polygon or MultiPolygon; z coordinates are dropped.

        Of a GeometryCollection, as `shapely.make_valid` returns it, the polygons count.
        """
        return cls.from_pieces(pieces_of_shape(geometry), names, repair)

    @classmethod
    def from_wkt(cls, text: str, names: Mapping[str, Walls] | None = None, repair: bool = False) -> Polygon:
        """Make a domain of a POLYGON or MULTIPOLYGON in well-known text.

        Examples
        --------
        >>> clvoro.Polygon.from_wkt("POLYGON ((0 0, 2 0, 2 1, 0 1, 0 0))").measure
        2.0
        """
        return cls.from_pieces(pieces_of_wkt(text), names, repair)

    @classmethod
    def from_geojson(
        cls,
        source: str | PathLike[str] | Mapping[str, Any],
        names: Mapping[str, Walls] | None = None,
        repair: bool = False,
    ) -> Polygon:
        """Make a domain of the polygons in GeoJSON.

        Parameters
        ----------
        source : path, str or dict
            A file, a text that begins with ``{``, or the object that `json.loads` returns: a Polygon, MultiPolygon,
            Feature or collection of these. Coordinates are used as plane coordinates: project longitudes and latitudes
            before. A Feature may name its boundaries in its properties, by the numbers of the Feature's edges:
            ``"boundaries": {"island": [4, 5, 6]}``.
        names : mapping, optional
            Names of boundaries, in place of those in `source`.
        repair : bool
            See `Polygon`.

        Raises
        ------
        InputError
            If the file cannot be read, is not GeoJSON or holds other geometries than polygons, or these are not a valid
            domain.

        Examples
        --------
        >>> ring = [[0, 0], [2, 0], [2, 1], [0, 0]]
        >>> clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": [ring]}).measure
        1.0
        """
        pieces, own_names = pieces_of_geojson(source)
        try:
            made = cls.from_pieces(pieces, own_names if names is None else names, repair)
            made.projected = True
            return made
        except InputError as error:
            if isinstance(source, Mapping) or str(source).lstrip().startswith("{"):
                raise
            raise InputError(f"{source}: {error}") from error

    def _build(
        self,
        pieces: Sequence[Sequence[object]],
        names: Mapping[str, Walls] | None,
        curves: object = None,
        repair: bool = False,
    ) -> None:
        if repair:
            pieces, names, change = repaired(pieces, names)
            if change > REPAIRED:
                warn(
                    f"the rings of the domain were repaired: its area changes by {100 * change:.2g} %", MismatchWarning
                )
        made = make_rings(pieces)
        rings = [ring for piece in made for ring in piece]
        self.vertices = np.concatenate([ring.given for ring in rings])
        self.ring_starts = np.cumsum([0, *(len(ring.given) for ring in rings)]).astype(np.int32)
        self.piece_of_ring = np.repeat(np.arange(len(made), dtype=np.int32), [len(piece) for piece in made])
        for array in self._arrays():
            array.setflags(write=False)
        self.curved_edges = CurvedEdges.join([ring.curved for ring in rings])
        if curves:
            ends = self.vertices[self._next_given]
            self.curved_edges = CurvedEdges.described(curves, self.vertices, ends)
        self.oriented = OrientedRings.of(rings)
        self.lower = tuple(self.vertices.min(axis=0).tolist())
        self.upper = tuple(self.vertices.max(axis=0).tolist())
        self._measure = math.fsum(signed_area(ring.vertices) for ring in rings)
        self.names = names
        self.names = self._checked_names()

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.vertices, self.ring_starts, self.piece_of_ring

    cuts_cells, leaves_out = True, "area"
    projected = False
    """Whether it is known that the coordinates are no degrees, or said that they are."""

    def warnings(self) -> list[str]:
        """Return a warning if the coordinates look like longitudes and latitudes."""
        text = "" if self.projected else squeezed(self.vertices, "the domain")
        return [text] if text else []

    @property
    def outline(self) -> Polygon:
        """The polygon itself."""
        return self

    @property
    def curves(self) -> tuple[Curve, ...]:
        """The curves of the boundary."""
        return self.curved_edges.curves

    def on_curve(self, points: np.ndarray, edges: np.ndarray) -> np.ndarray:
        """Return the nearest points on the boundary's curves, exact to round-off.

        Parameters
        ----------
        points : (n, 2) array of float
            Points on or near the boundary, nearer than the radius of curvature.
        edges : (n,) array of int
            The number of the edge that each point belongs to.

        Returns
        -------
        (n, 2) float64
            On the part of a curve that the edge stands for, the nearest point. Corners of curves and vertices of the
            polygon stay where they are. Points of straight edges are returned as they are.

        Raises
        ------
        InputError, InputTypeError
            If an edge does not exist or the shapes differ.

        Examples
        --------
        >>> disc = clvoro.Polygon(clvoro.curves.circle((0, 0), 1))
        >>> middles = (disc.vertices + np.roll(disc.vertices, -1, axis=0)) / 2
        >>> bool(abs(np.hypot(*disc.on_curve(middles, np.arange(len(middles))).T) - 1).max() < 1e-15)
        True
        """
        points, edges = check_rows("points", points, 2), np.asarray(edges)
        if edges.shape != points.shape[:1] or edges.dtype.kind not in "iu":
            raise InputError(
                f"edges has dtype {edges.dtype} and shape {edges.shape}, expected integers of shape {points.shape[:1]}"
            )
        if edges.size and not (edges.min() >= 0 and edges.max() < len(self.vertices)):
            raise InputError(f"edges has {edges.min()} to {edges.max()}, expected 0 to {len(self.vertices) - 1}")
        after = self._next_given[edges]
        return self.curved_edges.nearest(points, edges, self.vertices[edges], self.vertices[after])

    def simplified(self, size: object, tolerance: float = 0.1) -> Polygon:
        """Return the domain without what is smaller than a cell.

        - Bays, channels and straits that are narrower than the size are filled. Pieces of fewer than four cells are
          dropped.
        - Islands and capes that are smaller than the size in all directions are dropped. Thin walls that are longer
          than that stay, and so does land between two bays.
        - Of corners of less than 70 degrees, of water and of land, the tip is cut off.
        - Vertices are dropped where the boundary then moves by less than `tolerance` times the size.

        A coast that is finer than the cells gives better cells then; see :doc:`/guide/domains`.

        Parameters
        ----------
        size : float or callable
            The size of the cells: a number or a size field. A callable gets points (n, 2) and returns sizes (n,).
        tolerance : float
            From 0, which keeps all vertices, to 0.5.

        Returns
        -------
        Polygon
            A domain of straight edges, of one or several pieces. Edges have the name of the nearest edge of this one;
            rings are numbered anew. Curves become polylines.

        Raises
        ------
        InputError, InputTypeError
            If a number is out of range, or nothing is left of the domain.

        Examples
        --------
        A creek of width 0.1 is filled, and a rock is dropped:

        >>> square = [(0, 0), (1, 0), (1, 0.4), (1.5, 0.45), (1, 0.5), (1, 1), (0, 1)]
        >>> lake = clvoro.Polygon(square, [[(0.4, 0.4), (0.45, 0.4), (0.4, 0.45)]])
        >>> lake.simplified(0.2)
        Polygon(4 edges within (0, 0) and (1, 1))
        """
        pieces, names = simplify(self, size, tolerance)
        return Polygon.from_pieces(pieces, names or None)

    def split(self) -> list[Polygon]:
        """Return each piece of the domain as a polygon, the largest first.

        Edges keep the names that you gave. Curves become polylines.
        """
        made = [Polygon.from_pieces([rings], names or None) for rings, names in pieces_of(self)]
        return sorted(made, key=lambda piece: -piece.measure)

    @cached_property
    def _next_given(self) -> np.ndarray:
        """The vertex at the end of each of the caller's edges, (k,)."""
        after = np.arange(1, len(self.vertices) + 1)
        after[self.ring_starts[1:] - 1] = self.ring_starts[:-1]
        return after

    def same_region(self, other: Domain) -> bool:
        """Return whether `other` has the same rings in the same order, with equal numbers of edges."""
        return self is other or (isinstance(other, Polygon) and self.digest == other.digest)

    def __hash__(self) -> int:
        return hash(self.digest)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of vertices, rings, pieces and curves: the same for equal domains."""
        content = b"".join(array.tobytes() for array in self._arrays())
        if self.curves:
            content += json.dumps(self.curved_edges.describe(), sort_keys=True).encode()
        return hashlib.sha256(content).hexdigest()

    def __repr__(self) -> str:
        pieces, holes = self.n_pieces, len(self.piece_of_ring) - self.n_pieces
        parts = [f"{len(self.oriented.vertices)} edges"]
        if pieces > 1:
            parts.append(f"{pieces} pieces")
        if holes:
            parts.append(counted(holes, "hole"))
        if self.curves:
            parts.append(counted(len(self.curves), "curve"))
        corners = format_point(self.lower), format_point(self.upper)
        return f"Polygon({', '.join(parts)} within {corners[0]} and {corners[1]})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _described, (self.describe(),), {"borders": self.borders}

    def describe(self) -> dict[str, Any]:
        """Return lists and numbers from which `described` makes an equal domain."""
        return {
            "vertices": self.vertices.tolist(),
            "ring_starts": self.ring_starts.tolist(),
            "piece_of_ring": self.piece_of_ring.tolist(),
            **({"curves": self.curved_edges.describe()} if self.curves else {}),
            **({"names": dict(self.names)} if self.names else {}),
        }

    @classmethod
    def described(cls, **values: Any) -> Polygon:
        """Return the domain from the values that `describe` returns.

        Raises `InputError` or `InputTypeError` if the values do not describe a domain.
        """
        made = cls.__new__(cls)
        made._build(pieces_of_description(values), values.get("names"), values.get("curves"))
        return made

    @property
    def measure(self) -> float:
        """Area, with one rounding per ring and one for the sum."""
        return self._measure

    def default_names(self) -> BoundaryNames:
        """Return the parts of the boundary with their default names."""
        first = np.diff(self.piece_of_ring, prepend=-1) > 0
        names = [
            (f"outer-{o}" if self.n_pieces > 1 else "outer") if is_outer else f"hole-{h}"
            for is_outer, o, h in zip(first, np.cumsum(first), np.cumsum(~first), strict=True)
        ]
        index = np.repeat(np.arange(len(names), dtype=np.int32), np.diff(self.ring_starts))
        ring = index.copy()
        for c, curve in enumerate(self.curves):
            if curve.name is not None:
                names += [] if curve.name in names else [curve.name]
                index[self.curved_edges.curve == c] = names.index(curve.name)
        for c, curve in enumerate(self.curves):
            edges = self.curved_edges.curve == c
            part = index[edges][0]
            clash = (ring == part) & (index == part)
            if clash.any() and ring[edges][0] != part:
                raise InputError(
                    f"Polygon has the curve {curve}, but edge {np.argmax(clash)} of another ring has the name "
                    f"{curve.name!r}, too; choose another name for the curve"
                )
        used, first = np.unique(index, return_index=True)
        used = used[np.argsort(first)]  # in the order of their first edges
        place = np.empty(len(names), np.int32)
        place[used] = np.arange(len(used))
        return BoundaryNames(tuple(names[k] for k in used), place[index], "edge")

    def find_edges(self, what: str, walls: Walls | None) -> np.ndarray:
        """Return the places in `oriented` of the selected edges, (m,) int64, ascending.

        - `what`: name of the selection in error messages.
        - `walls` int, str, sequence of both, (k,) bool or None: numbers or names of edges; None selects all.

        Raises `InputError` or `InputTypeError` if an edge or name does not exist, or none of the edges has a length.
        """
        places = np.sort(self.oriented.places[self.boundaries.select(what, walls)])
        if places[-1] < 0:
            raise InputError(f"{what} has only edges without length, expected at least one with a length")
        return places[places >= 0].astype(np.int64)

    def edge_ends(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the begins and ends, (m, 2) each, of edges by their `numbers` (m,), the domain on their left."""
        places = self.oriented.places[numbers]
        return self.oriented.vertices[places], self.oriented.ends[places]

    @property
    def boundary_measure(self) -> float:
        """Length of all edges."""
        return float(self.oriented.lengths.sum())

    def wall_planes(self, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return outward unit normals of edges (k,) int, and the begin of each, (k, 2) each."""
        begin, end = self.edge_ends(walls)
        along = (end - begin) / np.hypot(*(end - begin).T)[:, None]
        return np.stack([along[:, 1], -along[:, 0]], axis=1), begin

    def wall_distance(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (k, 2) to its edge of `walls` (k,)."""
        return np.hypot(*(project(points, *self.edge_ends(walls)) - points).T)

    def boundary(self, walls: Walls | None = None) -> Edges:
        """Return edges as a shape for `clvoro.sizing.Distance`.

        Parameters
        ----------
        walls : int, str, sequence of them or (k,) bool, optional
            Numbers or names of edges; by default all.

        Raises
        ------
        InputError, InputTypeError
            If an edge or name does not exist, or none of the edges has a length.

        Examples
        --------
        >>> square = clvoro.Polygon([(0, 0), (0, 1), (1, 1), (1, 0)], names={"inlet": 0})
        >>> square.boundary("inlet").begin.tolist(), square.boundary("inlet").end.tolist()
        ([[0.0, 1.0]], [[0.0, 0.0]])
        """
        rows = self.find_edges("boundary", walls)
        return Edges(self.oriented.vertices[rows], self.oriented.ends[rows])

    # Points.

    @property
    def n_pieces(self) -> int:
        """Number of pieces, each with one outer ring."""
        return int(self.piece_of_ring[-1]) + 1

    @property
    def rings(self) -> list[np.ndarray]:
        """Vertices (k, 2) of each ring, as the caller gave them."""
        return [self.vertices[a:b] for a, b in pairwise(self.ring_starts)]

    @cached_property
    def pieces(self) -> list[Any]:
        """Each piece as a shapely Polygon."""
        found = []
        for p in range(self.n_pieces):
            mine = [r for r, piece in zip(self.oriented.rings, self.piece_of_ring, strict=True) if piece == p]
            found.append(shapely.Polygon(mine[0], mine[1:]))
        return found

    @cached_property
    def geometry(self) -> Any:
        """The domain as a shapely Polygon or MultiPolygon, prepared."""
        whole = self.pieces[0] if self.n_pieces == 1 else shapely.MultiPolygon(self.pieces)
        shapely.prepare(whole)
        # The second question makes an index, which threads must not do at the same time.
        shapely.intersects_xy(whole, *self.vertices[:3].T)
        return whole

    @property
    def region(self) -> Any:  # type: ignore[override]
        """The domain as a shape of shapely."""
        return self.geometry

    @property
    def _rounding(self) -> float:
        far = max(map(abs, (*self.lower, *self.upper)))
        return _ROUNDINGS * float(np.finfo(float).eps) * far

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it lies in the domain; (n,) bool.

        The boundary is included, with a tolerance of eight units of round-off of the largest coordinate: points on
        slanted edges cannot be represented exactly.
        """
        points = check_rows("points", points, 2)
        inside = self.covers(points)
        near = self.lower - np.full(2, self._rounding), self.upper + np.full(2, self._rounding)
        rest = np.flatnonzero(~inside & ((points >= near[0]) & (points <= near[1])).all(axis=1))
        if rest.size:
            rows, _ = self.oriented.tree.query(
                shapely.points(points[rest]), predicate="dwithin", distance=self._rounding
            )
            inside[rest[rows]] = True
        return inside

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it lies in the domain, without tolerance; (n,) bool."""
        return np.array(shapely.intersects_xy(self.geometry, points[:, 0], points[:, 1]))

    def contains_well(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return for each of `points` (n, 2) whether it is inside and over `margin` from the boundary; (n,) bool."""
        inside = self.covers(points)
        rows = np.flatnonzero(inside)
        near, _ = self.oriented.tree.query(shapely.points(points[rows]), predicate="dwithin", distance=margin)
        inside[rows[near]] = False
        return inside

    def piece_of(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) in the domain the piece that holds it, (n,) int; -1 elsewhere."""
        found = np.full(len(points), -1)
        rows, pieces = shapely.STRtree(self.pieces).query(shapely.points(points), predicate="intersects")
        found[rows] = pieces
        return found

    def share_within(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the share of the area in the box with the corners `lower` and `upper`, (2,)."""
        return float(shapely.intersection(self.geometry, shapely.box(*lower, *upper)).area / self.measure)

    def inner_points(self) -> np.ndarray:
        """Return a point inside of each piece, (n_pieces, 2), not on its boundary."""
        return np.array(shapely.get_coordinates(shapely.point_on_surface(self.pieces)))

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) the number of the closest edge, (n,) int."""
        return self.nearest_edge(points)[0]

    def nearest_edge(self, points: np.ndarray, within: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of the nearest edge to each of `points` (n, 2), and the nearest point on it.

        A search radius `within` makes it faster; the number is -1 for points without an edge in that radius.

        Returns
        -------
        edges : (n,) int
        nearest : (n, 2) float64
        """
        oriented = self.oriented
        points = np.asarray(points, dtype=float)
        edge = np.full(len(points), -1)
        rows, edges = self.oriented.tree.query_nearest(shapely.points(points), max_distance=within, all_matches=False)
        edge[rows] = edges
        nearest = project(points, oriented.vertices[edge], oriented.ends[edge])
        return np.where(edge >= 0, oriented.edge_numbers[edge], -1), nearest

    def edges_within(self, points: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of rows of `points` (n, 2) and of oriented edges that are nearer than `distance` (n,)."""
        found = self.oriented.tree.query(shapely.points(points), predicate="dwithin", distance=distance)
        return found[0], found[1]

    def crossings(self, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Find where segments from `begin` (n, 2) to `end` (n, 2) cross the boundary.

        Results:
        - `rows`, `edges` (k,) int: segment, and oriented edge.
        - `t`, `u` (k,) float64: place along the segment and along the edge, from 0 to 1.
        """
        segments = shapely.linestrings(np.stack([begin, end], axis=1))
        rows, edges = self.oriented.tree.query(segments, predicate="intersects")
        along, way = self.oriented.along[edges], (end - begin)[rows]
        turn = way[:, 0] * along[:, 1] - way[:, 1] * along[:, 0]
        rows, edges, along, way, turn = (a[turn != 0] for a in (rows, edges, along, way, turn))
        apart = self.oriented.vertices[edges] - begin[rows]
        t = (apart[:, 0] * along[:, 1] - apart[:, 1] * along[:, 0]) / turn
        u = (apart[:, 0] * way[:, 1] - apart[:, 1] * way[:, 0]) / turn
        return rows, edges, np.clip(t, 0, 1), np.clip(u, 0, 1)

    def is_slit(self, points: np.ndarray, within: float) -> np.ndarray:
        """Return for each of `points` (n, 2) whether separate parts of the boundary are within `within`; (n,) bool."""
        rows, edges = self.oriented.tree.query(shapely.points(points), predicate="dwithin", distance=within)
        following = self.oriented.next_vertex
        after, count = following[edges], len(following)
        on = np.hypot(*(self.oriented.vertices[after] - points[rows]).T) <= within
        on &= np.isin(rows * count + after, rows * count + edges)
        return np.bincount(rows, minlength=len(points)) > 1 + np.bincount(rows[on], minlength=len(points))

    def narrow_parts(self, size: Callable[[np.ndarray], np.ndarray]) -> tuple[NarrowPart | None, NarrowPart | None]:
        """Return where the polygon is narrower than half a cell, and a dead end; see `find_narrow_parts`."""
        return find_narrow_parts(self, size)

    remedy_for_narrow_parts = (
        "Use smaller sizes there, as sizing.FeatureSize does, or fill it: domain.simplified(size) does, and simplified "
        "= SIZE in a case"
    )

    def why_sizes_are_missed(self, x: np.ndarray, h: float, cells: int) -> str:
        """Return why the cell at `x` (2,) of a mesh of `cells` has not the size `h`, where sizes vary little."""
        if cells <= FEW_CELLS:
            return super().why_sizes_are_missed(x, h, cells)
        point = shapely.Point(x)
        piece = min(self.pieces, key=lambda shape: shape.distance(point))
        if self.n_pieces > 1 and piece.area < FEW_CELLS * h**2:
            return (
                f"it is in a piece of the domain that {piece.area / h**2:.2g} cells would fill: use smaller sizes "
                "there, or keep the largest piece, domain.split()[0]"
            )
        return (
            "narrow parts of the domain do not hold a whole number of cells of this size: use smaller sizes there, as "
            "sizing.FeatureSize does, or fill them: domain.simplified(size) does, and simplified = SIZE in a case"
        )

    @property
    def cutting_edges(self) -> int:  # type: ignore[override]
        """Number of edges."""
        return len(self.oriented.vertices)

    def along_cutting_edges(self, function: Callable[[np.ndarray], np.ndarray], samples: int) -> float:
        """Return the integral of `function` of places (k, 2) along the boundary, from about `samples` places."""
        edges = self.oriented
        parts = np.maximum(1, np.ceil(samples * edges.lengths / edges.lengths.sum())).astype(int)
        edge, part = rows_and_places(parts)
        places = edges.vertices[edge] + ((part + 0.5) / parts[edge])[:, None] * edges.along[edge]
        return float((edges.lengths[edge] / parts[edge] * function(places)).sum())

    @property
    def unit_hint(self) -> str:  # type: ignore[override]
        """What to do with longitudes and latitudes, if coordinates may be that."""
        if not may_be_degrees(self.lower, self.upper):
            return ""
        return " (Coordinates that are longitudes and latitudes must be projected first.)"

    def sees(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return which segments from `a` (k, 1, 2) to `b` (k, m, 2) lie in the polygon, (k, m)."""
        ends = np.stack(np.broadcast_arrays(a, b), axis=2)
        with _LINES:
            return np.asarray(shapely.covers(self.geometry, shapely.linestrings(ends)))

    def stations(self, size: Callable[[np.ndarray], np.ndarray], free: Domain, fixed: np.ndarray) -> FixedGenerators:
        """Return generators around re-entrant corners; see `place_around_corners`."""
        return place_around_corners(self, size, free, fixed)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the domain to each of `points` (n, 2): the point itself if it is inside."""
        found = np.array(points, dtype=float)
        outside = np.flatnonzero(~self.contains(found))
        if outside.size:
            found[outside] = self.nearest_edge(found[outside])[1]
        return found

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (n, 2) to the boundary, inside and outside; (n,)."""
        return np.hypot(*(self.nearest_edge(points)[1] - points).T)

    # The device's view. The polygon does not touch the box that clips cells.

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the bounding box enlarged by 1/64 of its longest edge on every side."""
        if self.framed_by is not None:
            return self.framed_by.clip_box
        margin = _MARGIN * self.extent.max()
        return self.lower - np.full(2, margin), self.upper + np.full(2, margin)

    def traits(self, real: np.dtype) -> Traits:
        """Return for what kernels are built."""
        del real
        return Traits(("POLYGON",), cut=True)

    @cached_property
    def _bins(self) -> EdgeBins:
        origin, scale = self.frame
        begins, ends = ((x - origin) / scale for x in (self.oriented.vertices, self.oriented.ends))
        return EdgeBins(begins, ends, self._rounding / scale)

    def device_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the corners of the clip box and the edges in bins; see geometry/edges.h."""
        return *self.device_corners(engine.real), *self._bins.arguments(engine)


def _described(values: dict[str, Any]) -> Polygon:
    return Polygon.described(**values)
