"""Distances to shapes, and sizes that grow with them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cached_property
from numbers import Real
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from ..connectivity import rows_and_places
from ..errors import InputError, InputTypeError
from ..geometry import curves
from ..geometry.bvh import Tree
from ..geometry.domain import LARGEST_EDGE, Domain
from ..geometry.geojson import geometries_of_geojson
from ..geometry.lines.lines import Lines
from ..geometry.shapes import Circle, Edges, Polyline, Segment, shapes_of
from ..geometry.surface import Surface
from ..geometry.triangles import segment_distance2
from .arguments import check_positive, check_slope
from .field import Field

if TYPE_CHECKING:
    from .codegen import CodeWriter

_FEW = 8  # items up to which a tree does not pay
_LANDMARKS = 1 << 14  # landmarks, roughly, besides one per item
_FAR = 100  # diagonals of the domain beyond which a shape is probably in another unit
# Kinds of items on the device: see size_item_distance2.
_STRAIGHT, _ROUND, _TRIANGLE = 0, 1, 2

Curve = Circle | Segment | Polyline | Edges | curves.Curve | Lines
Shape = Curve | Surface | Domain
GeoJSON = str | PathLike | Mapping


class Distance(Field):
    r"""Size that grows with the distance to shapes: ``h = min(h_min + slope * distance, h_max)``.

    Parameters
    ----------
    shapes : shape or iterable of shapes
        `Circle`, `Segment`, `Polyline`, `ClosedPolyline`; in 3D `Ball`, `Segment`, `Polyline`, `ClosedPolyline`,
        `Surface`; a `clvoro.Box`, `clvoro.Polygon` or `clvoro.Solid`, which stands for its walls
        (``domain.boundary("island")`` for some of them); in 2D a curve of `clvoro.curves`, or a geometry of shapely,
        which stands for its points, lines and rings, or GeoJSON with such geometries: a path, a text or a dict. The
        distance is to the curve or surface, from both sides.
    h_min : float
        Size on the shapes.
    growth : float, optional
        Geometric growth rate g >= 1, the ratio of the sizes of neighboring cells (the paper's
        section 4: 1.3). In a row of cells of sizes h_min, h_min g, h_min g^2, ... log h grows by ln g over each h, so
        the slope is dh/dx = ln(growth).
    h_max : float, optional
        Upper bound of h.
    slope : float, optional
        dh/dx, in place of `growth`; 0.3 means h = h_min + 0.3 * distance.

    Raises
    ------
    InputError, InputTypeError
        If a shape or number is missing, of the wrong kind, or out of range.

    Examples
    --------
    Fine cells along the walls of the domain, growing by a fifth per cell inwards::

        domain = clvoro.Box((0, 0), (2, 1))
        size = clvoro.sizing.Distance(domain, h_min=0.01, growth=1.2, h_max=0.1)
        clvoro.Adapter().run(domain, size).plot("size")
    """

    def __init__(
        self,
        shapes: Shape | shapely.Geometry | GeoJSON | Iterable[Shape | shapely.Geometry | GeoJSON],
        h_min: float,
        growth: float | None = None,
        h_max: float = math.inf,
        slope: float | None = None,
    ):
        name = type(self).__name__
        if not isinstance(shapes, (Shape, shapely.Geometry, Iterable)):
            raise InputTypeError(
                f"{name} got shapes {shapes!r} of type {type(shapes).__name__}, expected a shape or a list of them, "
                f"such as {name}(Circle((0.5, 0.5), 0.1), 0.01, growth=1.2)"
            )
        given: Any = [shapes] if isinstance(shapes, (Shape, shapely.Geometry, GeoJSON)) else shapes
        parts = [geometries_of_geojson(s) if isinstance(s, GeoJSON) else [s] for s in given]
        self.given: list[Any] = [shape for part in parts for shape in part]
        parts = [shapes_of(s) if isinstance(s, shapely.Geometry) else [s] for s in self.given]
        self.shapes: tuple[Any, ...] = tuple(shape for part in parts for shape in part)
        for shape in self.shapes:
            if not isinstance(shape, Shape):
                bare = isinstance(shape, list | tuple | np.ndarray | Real)
                hint = "; write Circle(p, radius=0) for a point p, Polyline(points) for a line"
                raise InputTypeError(
                    f"{name} got a shape of type {type(shape).__name__}, expected Circle, "
                    "Ball, Segment, Polyline, ClosedPolyline, Edges, Surface, Box, clvoro.Polygon, clvoro.Solid, a "
                    f"curve of clvoro.curves or a geometry of shapely{hint if bare else ''}"
                )
        if not self.shapes:
            raise InputError(f"{name} got no shapes, expected at least one")
        self.slope = check_slope("Distance", growth, slope)
        self.h_min = check_positive("Distance h_min", h_min)
        if not (isinstance(h_max, Real) and h_max >= self.h_min):
            raise InputError(f"Distance h_max is {h_max!r}, expected at least h_min = {self.h_min}")
        self.h_max = float(h_max)

        plain = [shape.boundary() if isinstance(shape, Domain) else shape for shape in self.shapes]
        self.surfaces = tuple(s for s in plain if isinstance(s, Surface))
        parts = [s.items() for s in plain if not isinstance(s, Surface)]
        dims = {begin.shape[1] for begin, _, _ in parts} | ({3} if self.surfaces else set())
        if len(dims) > 1:
            raise InputError(f"{name} got shapes of 2 and of 3 coordinates, expected one kind")
        self.dim = dims.pop()
        parts = parts or [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))]
        self._begin, self._end, self._radius = (np.concatenate(p) for p in zip(*parts, strict=True))
        far = max(float(np.abs(x).max(initial=0)) for x in (self._begin, self._end, self._radius))
        if far > LARGEST_EDGE:
            raise InputError(
                f"{name} got a shape with the length {far:g}, expected at most {LARGEST_EDGE:g}; correct it"
            )

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return points on the shapes, about 1/64 of the domain's shorter side apart."""
        spacing = domain.extent.min() / 64
        found = [s.landmarks(spacing, _LANDMARKS) for s in self.surfaces]
        if len(self._begin):
            found.append(self._landmarks_of_curves(spacing))
        return np.concatenate(found)

    def _landmarks_of_curves(self, spacing: float) -> np.ndarray:
        length = np.linalg.norm(self._end - self._begin, axis=1)
        radius = np.maximum(self._radius, 0)
        around = 2 * np.pi * radius
        counts = np.maximum(np.maximum(length, around) / spacing, 1)
        counts = np.maximum(counts, {2: 0.0, 3: 4 * np.pi * (radius / spacing) ** 2}[self._begin.shape[1]])
        counts *= min(1.0, _LANDMARKS / counts.sum())
        counts = np.ceil(counts).astype(int)
        item, t = rows_and_places(counts)
        t = t / counts[item]
        points = self._begin[item] + t[:, None] * (self._end - self._begin)[item]
        offset = {2: _on_circles, 3: _on_spheres}[self._begin.shape[1]](t, counts[item])
        return np.concatenate([points + radius[item, None] * offset, self._end])

    def warnings(self, domain: Domain) -> list[str]:
        """Return warnings for shapes without effect on `domain` and for surfaces smaller than a cell."""
        found, same = [], "do shapes and domain have the same unit and origin?"
        away, diagonal = self._away(domain), float(np.linalg.norm(domain.extent))
        reach = (self.h_max - self.h_min) / self.slope if self.slope > 0 else math.inf
        if 0 < reach <= away:
            found.append(
                f"the shapes of {self!r} are at least {away:.3g} away from the domain and change nothing, because h is "
                f"h_max from {reach:.3g} on; {same}"
            )
        elif away > _FAR * diagonal:
            found.append(
                f"the shapes of {self!r} are at least {away:.3g} away from the domain, {away / diagonal:.3g} times its "
                f"diagonal; {same}"
            )
        for surface in self.surfaces:
            across = float(np.ptp(surface.vertices, axis=0).max())
            if across < self.h_min and self.slope > 0:
                found.append(
                    f"{surface.name} is {across:.3g} across, less than a cell of h_min = {self.h_min:.6g}; {same}"
                )
        return found

    def _away(self, domain: Domain) -> float:
        """Return a lower bound of the distance from the domain to the shapes, by their bounding boxes."""
        low, high = np.array(domain.lower), np.array(domain.upper)

        def gap(begin: np.ndarray, end: np.ndarray) -> np.ndarray:
            return np.linalg.norm(np.maximum(np.maximum(low - end, begin - high), 0), axis=1)

        least = [gap(s.corners.min(axis=1), s.corners.max(axis=1)).min() for s in self.surfaces]
        if len(self._begin):
            begin, end, radius = self._begin, self._end, self._radius
            outside = gap(np.minimum(begin, end), np.maximum(begin, end)) - radius
            # A circle may also enclose the domain.
            farthest = np.linalg.norm(np.maximum(high - begin, begin - low), axis=1)
            inside = np.where((begin == end).all(axis=1), radius - farthest, 0)
            least.append(np.maximum(outside, inside).min())
        return max(0.0, float(min(least)))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, d) to the nearest shape, (n,) float64."""
        best2 = np.full(len(points), math.inf)
        for surface in self.surfaces:
            best2 = np.minimum(best2, surface.distance2(points))
        if not len(self._begin):
            return np.sqrt(best2)

        def away2(x: np.ndarray, item: np.ndarray) -> np.ndarray:
            begin = self._begin[item]
            d2 = segment_distance2(x, begin, self._end[item] - begin)
            radius = self._radius[item]
            return np.where(radius != 0, (np.sqrt(d2) - radius) ** 2, d2)

        # A few items give a first bound.
        for item in np.unique(np.linspace(0, len(self._begin) - 1, 16).astype(int)):
            best2 = np.minimum(best2, away2(points, np.full(len(points), item)))
        return np.sqrt(self._tree.nearest2(points, best2, away2, in_boxes=bool((self._radius >= 0).all())))

    @cached_property
    def _tree(self) -> Tree:
        return Tree(*_item_boxes(self._begin, self._end, self._radius))

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return np.minimum(self.h_min + self.slope * self.distance(points), self.h_max)

    def _emit(self, writer: CodeWriter) -> str:
        h_min, h_max = self.h_min / writer.scale, self.h_max / writer.scale
        # Beyond this distance h is h_max. The margin covers round-off.
        reach = 1.01 * (h_max - h_min) / self.slope if self.slope > 0 else math.inf
        law = writer.store(h_min, self.slope, h_max, reach * reach)
        best2 = f"data[{law + 3}]"
        groups = [(_TRIANGLE, *s.packed(writer.origin, writer.scale, writer.real)) for s in self.surfaces]
        if len(self._begin):
            groups.insert(0, self._packed_curves(writer))
        for kind, items, tree in groups:
            if tree.n <= _FEW:
                at = writer.store(items)
                call = f"size_nearest_few(x, data + {at}, {tree.n}, {kind}, {best2})"
            else:
                at = writer.store(tree.boxes, items)
                call = f"size_nearest_tree(x, data + {at}, {tree.n}, {tree.levels}, {kind}, {best2})"
            best2 = writer.variable(call)
        return self._finish(writer, best2, law)

    def _finish(self, writer: CodeWriter, best2: str, law: int) -> str:
        """Add the size at the squared distance `best2`; return the name of its variable."""
        return writer.variable(f"size_of_distance({best2}, data + {law})")

    def _packed_curves(self, writer: CodeWriter) -> tuple[int, np.ndarray, Tree]:
        """Return the kind, the items (m, 2 d + 2) in the order of the tree, and the tree.

        An item has begin, vector, 1 / length^2 (0 for a point) and radius.
        """
        begin, end = (writer.normalize(p).astype(writer.real) for p in (self._begin, self._end))
        radius = (self._radius / writer.scale).astype(writer.real)
        tree = Tree(*_item_boxes(begin, end, radius))
        begin, end, radius = begin[tree.order], end[tree.order], radius[tree.order]
        vector = end - begin
        length2 = (vector**2).sum(axis=1)
        tiny = np.finfo(length2.dtype).tiny
        inverse = np.divide(1.0, length2, out=np.zeros_like(length2), where=length2 > 4 * tiny)
        kind = _ROUND if radius.any() else _STRAIGHT
        return kind, np.column_stack([begin, vector, inverse, radius]), tree

    def __repr__(self) -> str:
        return f"Distance({len(self.shapes)} shapes, h_min={self.h_min:g}, slope={self.slope:g}, h_max={self.h_max:g})"


def _on_circles(t: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return points on the unit circle, `t` from 0 to 1 around it."""
    del counts
    return np.column_stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t)])


def _on_spheres(t: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return points on the unit sphere, on a spiral of `counts` points in golden angles: `t` from 0 to 1 along it."""
    z = 1 - 2 * (t + 0.5 / counts)
    turn = np.pi * (3 - math.sqrt(5)) * t * counts
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _item_boxes(begin: np.ndarray, end: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Negative radii are left out: distances to boxes stay lower bounds. Round-off of center -+ radius can shorten the
    # box of a circle by an ulp, so boxes are widened.
    wide = (np.maximum(radius, 0) * (1 + 4 * np.finfo(radius.dtype).eps))[:, None]
    return np.minimum(begin, end) - wide, np.maximum(begin, end) + wide
