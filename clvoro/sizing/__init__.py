"""Size fields h(x), the wanted edge length of a cell, and the stage that evaluates them."""

from .bind import bind
from .distance import Distance
from .expression import Expression
from .field import Constant, Field, Function, as_field, maximum, minimum
from .graded import Graded
from .raster import Raster
from .shapes import Circle, Polygon, Polyline, Segment, Sphere
from .stage import Sizing
from .surface import Surface

__all__ = [
    "Circle",
    "Constant",
    "Distance",
    "Expression",
    "Field",
    "Function",
    "Graded",
    "Polygon",
    "Polyline",
    "Raster",
    "Segment",
    "Sizing",
    "Sphere",
    "Surface",
    "as_field",
    "bind",
    "maximum",
    "minimum",
]
