"""Size fields h(x), the wanted edge length of a cell, and the stage that evaluates them."""

from ..geometry.shapes import Circle, Edges, Polygon, Polyline, Segment, Sphere
from ..geometry.surface import Surface
from .bind import bind
from .distance import Distance
from .expression import Expression
from .feature import FeatureSize
from .field import Constant, Field, Function, as_field, maximum, minimum
from .graded import Graded
from .raster import Raster, Scattered
from .solution import gradient_size, hessian_size
from .stage import Sizing

__all__ = [
    "Circle",
    "Constant",
    "Distance",
    "Edges",
    "Expression",
    "FeatureSize",
    "Field",
    "Function",
    "Graded",
    "Polygon",
    "Polyline",
    "Raster",
    "Scattered",
    "Segment",
    "Sizing",
    "Sphere",
    "Surface",
    "as_field",
    "bind",
    "gradient_size",
    "hessian_size",
    "maximum",
    "minimum",
]
