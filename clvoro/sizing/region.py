"""A size within a region, from which sizes grow."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from ..errors import InputError, InputTypeError
from ..geometry import curves
from ..geometry.bvh import Tree
from ..geometry.domain import Domain
from ..geometry.shapes import Circle, ClosedPolyline
from ..geometry.surface import Surface
from .distance import Distance

if TYPE_CHECKING:
    from .codegen import CodeWriter

_SIDES = 720
"""Sides of the polygon that stands for a circle where points are inside or outside; distances are to the circle."""
_SAMPLE = 24
"""Points along each axis at which a region is known to sampling."""


class Region(Distance):
    r"""One size within a region; outside, sizes that grow with the distance to it.

    ``h = h_inside`` in the region, and ``h = min(h_inside + slope * distance, h_max)`` outside.

    Parameters
    ----------
    shapes : shape or iterable of shapes
        In 2D a `clvoro.Polygon` or `clvoro.Box`, a `Circle`, a `ClosedPolyline`, a closed curve of `clvoro.curves`, a
        polygon of shapely, or polygons in GeoJSON; in 3D a `clvoro.Box`, a `clvoro.Solid`, a `Ball`, or a closed
        `Surface`. On a sphere those of 2D in longitudes and latitudes in degrees. Several shapes are one region.
    h : float
        Size in the region.
    growth, slope, h_max : float
        As for `Distance`.

    Raises
    ------
    InputError, InputTypeError
        If a shape is not closed, or a number is missing or out of range.

    Examples
    --------
    >>> wake = sizing.Region(clvoro.Box((1, 0.3), (3, 0.7)), h=0.02, growth=1.2, h_max=0.1)
    >>> wake(np.array([(2, 0.5), (1, 0.5), (0.9, 0.5), (0, 0)])).round(4).tolist()
    [0.02, 0.02, 0.0382, 0.1]
    """

    def __init__(
        self, shapes: Any, h: float, growth: float | None = None, h_max: float = math.inf, slope: float | None = None
    ):
        super().__init__(shapes, h, growth, h_max, slope)
        self.shapes = tuple(self.given)
        dim = int(self.dim or 0)
        made: list[Any] = [{2: _area_of, 3: _solid_of}[dim](shape) for shape in self.given]
        self.areas, self.solids = {2: (made, []), 3: ([], made)}[dim]

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return whether each of `points` (n, d) is in the region, (n,) bool."""
        inside = np.zeros(len(points), bool)
        for area in self.areas:
            inside |= shapely.intersects_xy(area, *points.T)
        for solid in self.solids:
            ball = isinstance(solid, Circle)
            inside |= np.linalg.norm(points - solid.center, axis=1) <= solid.radius if ball else solid.contains(points)
        return inside

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, d) to the region, (n,) float64; 0 in it."""
        return np.where(self.contains(points), 0.0, super().distance(points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return points on the outline and in the region."""
        outline = super().landmarks(domain)
        low, high = outline.min(axis=0), outline.max(axis=0)
        axes = np.meshgrid(*([np.linspace(0, 1, _SAMPLE)] * len(low)))
        grid = low + np.stack([axis.ravel() for axis in axes], axis=1) * (high - low)
        return np.concatenate([outline, grid[Region.contains(self, grid)]])

    def _finish(self, writer: CodeWriter, best2: str, law: int) -> str:
        inside = [inside_code(writer, items, "x") for items in self._boundaries(writer)]
        for ball in (solid for solid in self.solids if isinstance(solid, Circle)):
            at = writer.store(writer.normalize(ball.center), (ball.radius / writer.scale) ** 2)
            away = " + ".join(f"(x[{a}] - data[{at + a}]) * (x[{a}] - data[{at + a}])" for a in range(3))
            inside.append(f"{away} <= data[{at + 3}]")
        return super()._finish(writer, writer.variable(f"({' || '.join(inside)}) ? 0 : {best2}"), law)

    def _boundaries(self, writer: CodeWriter) -> list[np.ndarray]:
        """Return the closed boundaries as items (m, d, d) in the device's coordinates."""
        found = [ring_edges(shapely.union_all(self.areas))] if self.areas else []
        found += [solid.corners for solid in self.solids if isinstance(solid, Surface)]
        return [writer.normalize(items) for items in found]

    def __repr__(self) -> str:
        return f"Region({len(self.shapes)} shapes, h={self.h_min:g}, slope={self.slope:g}, h_max={self.h_max:g})"


def inside_code(writer: CodeWriter, items: np.ndarray, x: str) -> str:
    """Store closed boundaries (m, d, d), and return the text that is true inside of them."""
    packed = items.astype(writer.real)
    tree = Tree(packed.min(axis=1), packed.max(axis=1))
    at = writer.store(tree.boxes, packed[tree.order])
    return f"size_inside({x}, data + {at}, {tree.n}, {tree.levels})"


def ring_edges(area: shapely.Geometry) -> np.ndarray:
    """Return the edges of all rings of polygons in the plane, (m, 2, 2)."""
    rings = shapely.get_rings(shapely.get_parts(area))
    coordinates = [shapely.get_coordinates(ring) for ring in rings]
    return np.concatenate([np.stack([x[:-1], x[1:]], axis=1) for x in coordinates])


def _area_of(shape: Any) -> shapely.Geometry:
    """Return a closed shape in 2D as a polygon of shapely."""
    area: Any
    if isinstance(shape, Domain) and shape.region is not None:
        area = shape.region
    elif isinstance(shape, Circle) and shape.radius > 0:
        turn = 2 * np.pi * np.arange(_SIDES) / _SIDES
        area = shapely.Polygon(shape.center + shape.radius * np.column_stack([np.cos(turn), np.sin(turn)]))
    elif isinstance(shape, ClosedPolyline):
        area = shapely.Polygon(shape.points)
    elif isinstance(shape, curves.Curve) and shape.closed:
        area = shapely.Polygon(shape.vertices)
    elif getattr(shape, "geom_type", "") in ("Polygon", "MultiPolygon"):
        area = shape
    else:
        raise _not_closed(shape)
    if not area.is_valid:
        raise InputError(f"Region got {shape!r:.60}, which crosses itself: {shapely.is_valid_reason(area)}; correct it")
    return area


def _solid_of(shape: Any) -> Circle | Surface:
    """Return a closed shape in 3D as a ball or a closed surface."""
    if isinstance(shape, Circle) and shape.radius > 0:
        return shape
    if isinstance(shape, Surface):
        shape.require_closed()
        return shape
    if isinstance(shape, Domain) and shape.region is not None:
        return shape.region
    raise _not_closed(shape)


def _not_closed(shape: Any) -> InputTypeError:
    return InputTypeError(
        f"Region got {shape!r:.60} of type {type(shape).__name__}, which has no inside; expected a Polygon, Box, "
        "Solid, Circle, Ball, closed curve, ClosedPolyline, closed Surface, shapely Polygon; for a line write Distance"
    )
