"""Domains bounded by straight edges, with holes, of one or several pieces."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from os import PathLike
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from ..errors import InputError, InputTypeError
from .edge_grid import bin_edges
from .geojson import pieces_of_geojson, pieces_of_shape, pieces_of_wkt
from .region import Region
from .rings import make_rings, signed_area

if TYPE_CHECKING:
    from ..opencl.program import Engine
    from ..opencl.workspace import Workspace

_MARGIN = 1 / 64  # of the clip box around the domain, of the bounding box's longest edge
_BEHIND = 16
"""Roundings on the device by which generators that were put on an edge may be beyond it."""

BOUNDARY_SHIFTS = (8, 16, 32, 64, 64, 64, 64, 64)
"""Shifts of the boundary, in units of round-off, each in another direction, that are tried where it cannot be traced
through the diagram. They are within the tolerance of vertices, so that meshes stay as exact as without a shift."""


class Polygon(Region):
    """Polygonal domain in 2D.

    Parameters
    ----------
    outer : array_like (k, 2)
        Vertices of the outer ring in either order; the first may be repeated at the end.
    holes : sequence of array_like (k, 2)
        Rings that are left out; they may touch each other and the outer ring in single points.

    Attributes
    ----------
    vertices : (k, 2) float64
        Of all rings, one after the other, each once. Outer rings run counter-clockwise, holes clockwise:
        the interior is on the left of every edge. Vertices on a straight line are kept, as they number
        edges; repeated ones are dropped.
    ring_starts : (r + 1,) int32
        Ring i is ``vertices[ring_starts[i] : ring_starts[i + 1]]``. Each piece's outer ring comes before
        its holes.
    next_vertex : (k,) int32
        Edge e goes from vertex e to vertex ``next_vertex[e]``. Faces of cells on it have the neighbor
        ``-1 - e``.
    piece_of_ring : (r,) int32
        Which piece each ring bounds; pieces may touch in single points.
    edge_numbers : (k,) int32
        The number that edge e has in the rings as they were given: ring by ring, in their order, the edge
        from a ring's vertex i to the next is number i after those of the rings before. It differs from
        e where a ring was reversed (then from the first edge on) or a repeated vertex dropped (from there
        on), and ``numpy.flatnonzero(numpy.isin(polygon.edge_numbers, mine))`` finds edges by their numbers.
    lower, upper : (2,) tuples of float
        The bounding box.

    Raises
    ------
    InputError, InputTypeError
        Naming the ring and the place: if numbers are not finite, a ring has fewer than 3 distinct vertices,
        no area, crosses or touches itself (slits of no width, too), holes lie outside or overlap or cut
        the domain apart, pieces overlap, an edge is shorter than 1e-12 of the domain, or the whole is
        too large, small or far from the origin for float64.

    Examples
    --------
    >>> square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    >>> pond = clvoro.Polygon(square, [[(0.4, 0.4), (0.6, 0.4), (0.5, 0.6)]])
    >>> round(pond.measure, 12), pond.n_pieces, pond.edge_numbers[pond.ring_starts[1]:].tolist()
    (0.98, 1, [5, 4, 6])
    """

    framed_by: Polygon | None = None
    """The polygon whose frame this one, a part of it, is to have on the device."""

    def __init__(self, outer: object, holes: Sequence[object] = ()):
        try:
            rings = [outer, *holes]
        except TypeError:
            raise InputTypeError(
                f"holes is a {type(holes).__name__}, expected a list of rings"
            ) from None
        self._build([rings])

    @classmethod
    def from_pieces(cls, pieces: Sequence[Sequence[object]]) -> Polygon:
        """Make a domain of several pieces, each a list of its outer ring and its holes.

        Examples
        --------
        >>> clvoro.Polygon.from_pieces([[[(0, 0), (1, 0), (1, 1)]], [[(2, 0), (3, 0), (3, 1)]]]).n_pieces
        2
        """
        made = cls.__new__(cls)
        made._build(pieces)
        return made

    @classmethod
    def from_shapely(cls, geometry: Any) -> Polygon:
        """Make a domain of a shapely Polygon or MultiPolygon; heights are left out."""
        return cls.from_pieces(pieces_of_shape(geometry))

    @classmethod
    def from_wkt(cls, text: str) -> Polygon:
        """Make a domain of a POLYGON or MULTIPOLYGON in well-known text.

        Examples
        --------
        >>> clvoro.Polygon.from_wkt("POLYGON ((0 0, 2 0, 2 1, 0 1, 0 0))").measure
        2.0
        """
        return cls.from_pieces(pieces_of_wkt(text))

    @classmethod
    def from_geojson(cls, source: str | PathLike[str] | Mapping[str, Any]) -> Polygon:
        """Make a domain of the polygons in GeoJSON.

        Parameters
        ----------
        source : path, str or dict
            A file, a text that begins with ``{``, or what `json.loads` makes of it: a Polygon, MultiPolygon,
            Feature or collection of these. Coordinates are taken as they are, in the plane: project
            longitudes and latitudes before.

        Raises
        ------
        InputError
            If there is no such file, it is no GeoJSON, holds something else than polygons, or these make no domain.

        Examples
        --------
        >>> ring = [[0, 0], [2, 0], [2, 1], [0, 0]]
        >>> clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": [ring]}).measure
        1.0
        """
        pieces = pieces_of_geojson(source)
        try:
            return cls.from_pieces(pieces)
        except InputError as error:
            if isinstance(source, Mapping) or str(source).lstrip().startswith("{"):
                raise
            raise InputError(f"{source}: {error}") from error

    def _build(self, pieces: Sequence[Sequence[object]]) -> None:
        made = make_rings(pieces)
        rings = [ring for piece in made for ring in piece]
        counts = [len(ring.vertices) for ring in rings]
        starts = np.concatenate([[0], np.cumsum(counts)])
        given = np.concatenate([[0], np.cumsum([ring.n_given for ring in rings])])
        following = np.arange(1, starts[-1] + 1)
        following[starts[1:] - 1] = starts[:-1]
        self.vertices = np.concatenate([ring.vertices for ring in rings])
        self.ring_starts = starts.astype(np.int32)
        self.next_vertex = following.astype(np.int32)
        self.piece_of_ring = np.repeat(
            np.arange(len(made), dtype=np.int32), [len(piece) for piece in made]
        )
        self.edge_numbers = np.concatenate(
            [first + ring.numbers for first, ring in zip(given[:-1], rings, strict=True)]
        ).astype(np.int32)
        for array in self._arrays():
            array.setflags(write=False)
        self.lower = tuple(self.vertices.min(axis=0).tolist())
        self.upper = tuple(self.vertices.max(axis=0).tolist())
        self._measure = math.fsum(signed_area(ring.vertices) for ring in rings)

    def _arrays(self) -> tuple[np.ndarray, ...]:
        return (
            self.vertices, self.ring_starts, self.next_vertex, self.piece_of_ring, self.edge_numbers
        )  # fmt: skip

    # What is equal: the same rings in the same order, numbered alike.

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Polygon):
            return NotImplemented
        return self is other or self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of vertices, rings, pieces and numbers: equal domains have the same."""
        return hashlib.sha256(b"".join(array.tobytes() for array in self._arrays())).hexdigest()

    def __repr__(self) -> str:
        pieces, holes = self.n_pieces, len(self.piece_of_ring) - self.n_pieces
        parts = [f"{len(self.vertices)} edges"]
        if pieces > 1:
            parts.append(f"{pieces} pieces")
        if holes:
            parts.append(f"{holes} hole{'s' if holes > 1 else ''}")
        corners = [", ".join(f"{c:.6g}" for c in corner) for corner in (self.lower, self.upper)]
        return f"Polygon({', '.join(parts)} within ({corners[0]}) and ({corners[1]}))"

    def __reduce__(self) -> tuple[Any, ...]:
        return _described, (self.describe(),)

    def describe(self) -> dict[str, Any]:
        """Return plain values (lists, numbers) of which `described` makes an equal domain."""
        return {
            "vertices": self.vertices.tolist(),
            "ring_starts": self.ring_starts.tolist(),
            "piece_of_ring": self.piece_of_ring.tolist(),
            "edge_numbers": self.edge_numbers.tolist(),
        }

    @classmethod
    def described(cls, **values: Any) -> Polygon:
        """Make the domain that `describe` described; damaged values are refused by an InputError."""
        try:
            starts = np.array(values["ring_starts"], np.int32)
            numbers = np.array(values["edge_numbers"], np.int32)
            pieces = np.array(values["piece_of_ring"], np.int32)
            vertices = np.array(values["vertices"], float)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(f"the description of a Polygon is damaged ({error})") from error
        steps = np.diff(pieces, prepend=-1)
        if not (
            starts.shape == (len(pieces) + 1,)
            and pieces.size
            and (np.diff(starts, prepend=0) >= 0).all()
            and (steps * (steps - 1) == 0).all()
            and pieces[0] == 0
            and numbers.shape == vertices.shape[:1] == (starts[-1],)
        ):
            raise InputError("the description of a Polygon is damaged: its arrays do not fit")
        rings = [vertices[a:b] for a, b in pairwise(starts)]
        firsts = [*np.flatnonzero(steps), len(rings)]
        made = cls.from_pieces([rings[a:b] for a, b in pairwise(firsts)])
        if not np.array_equal(made.vertices, vertices):
            raise InputError("the description of a Polygon is damaged: its rings are not oriented")
        numbers.setflags(write=False)
        made.edge_numbers = numbers
        return made

    @property
    def measure(self) -> float:
        """Area; rounded once per ring, and as a sum."""
        return self._measure

    def boundary(self, edges: object = None) -> Any:
        """Return edges as a shape for `clvoro.sizing.Distance`.

        Parameters
        ----------
        edges : int, sequence of int or bool, optional
            Numbers of edges as in `next_vertex`, or which ones; by default all. Numbers of the rings as they
            were given are found in `edge_numbers`.
        """
        from .shapes import Edges

        rows = every = np.arange(len(self.vertices))
        if edges is not None:
            try:
                rows = np.atleast_1d(every[edges])  # type: ignore[call-overload]
            except IndexError as error:
                raise InputError(
                    f"edges is {edges!r:.60} ({error}), expected numbers below {len(every)}"
                ) from error
            if not rows.size:
                raise InputError(
                    f"edges is {edges!r:.60}, expected at least one number below {len(every)}"
                )
        return Edges(self.vertices[rows], self.vertices[self.next_vertex[rows]])

    # The device's view: the polygon never touches the box that cells are clipped by.

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the bounding box enlarged by 1/64 of its longest edge on every side."""
        if self.framed_by is not None:
            return self.framed_by.clip_box
        margin = _MARGIN * self.extent.max()
        return self.lower - np.full(2, margin), self.upper + np.full(2, margin)

    @property
    def frame(self) -> tuple[np.ndarray, float]:
        """Origin and scale of the device's coordinates, x' = (x - origin) / scale in [0, 1]."""
        lower, upper = self.clip_box
        return lower, 2.0 ** math.ceil(math.log2((upper - lower).max()))

    def defines(self, real: np.dtype) -> tuple[tuple[str, object], ...]:
        """Kernels for polygons know of edges."""
        del real
        return (("POLYGON", 1),)

    def device_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the corners of the clip box, and the edges in bins; see geometry/edges.h."""
        there = self._on_device.setdefault(engine.workspace, {})
        if engine.real not in there:
            origin, scale = self.frame
            begins = (self.vertices - origin) / scale
            ends = begins[self.next_vertex]
            frame, shape, starts, listed = bin_edges(begins, ends)
            # Where what is put on an edge may be: by the rounding of device and domain.
            frame[3] = _BEHIND * float(np.finfo(engine.real).eps) + self._rounding / scale
            there[engine.real] = (
                frame.astype(engine.real), shape, engine.upload(starts, np.int32),
                engine.upload(np.concatenate([begins, ends], axis=1)[listed].ravel()),
            )  # fmt: skip
        return *self.device_corners(engine.real), *there[engine.real]

    @cached_property
    def _on_device(self) -> WeakKeyDictionary[Workspace, dict[np.dtype, tuple[object, ...]]]:
        """What `device_args` has made, by the workspace of the engine, with which it goes, and precision."""
        return WeakKeyDictionary()


def _described(values: dict[str, Any]) -> Polygon:
    return Polygon.described(**values)
