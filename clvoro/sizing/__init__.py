"""Size fields h(x), the target width of a cell (root of its area or volume), and their evaluation.

`Sizing.evaluate` (evaluation.py, kernel `evaluate_size` in size_field.cl) evaluates h on the device.

How to add a size field:

1. Derive a class from `Field` and implement ``_evaluate(points)`` in NumPy.
2. Implement ``_emit(writer)`` with the same formula in OpenCL, or set ``on_device = False``. `Distance` is an example.
3. Export the class below and test both forms against each other, as in tests/sizing/test_sizing.py.
"""

from ..geometry.shapes import Ball, Circle, ClosedPolyline, Edges, Polyline, Segment
from ..geometry.surface import Surface
from .cells import OnCells
from .codegen import generate_code
from .derivatives import derivatives
from .distance import Distance
from .estimates import (
    Estimate,
    combine,
    force_weight,
    interface_distance,
    normalize,
    q_criterion,
    sensor_size,
    shock_sensor,
    steepness,
    vorticity,
)
from .evaluation import Sizing
from .expression import Expression
from .feature import FeatureSize, curvature_size, gap_size
from .field import Constant, Field, Function, as_field, maximum, minimum
from .graded import Graded
from .raster import Raster, Scattered
from .region import Region
from .solution import gradient_size, hessian_size

__all__ = [
    "Ball",
    "Circle",
    "ClosedPolyline",
    "Constant",
    "Distance",
    "Edges",
    "Estimate",
    "Expression",
    "FeatureSize",
    "Field",
    "Function",
    "Graded",
    "OnCells",
    "Polyline",
    "Raster",
    "Region",
    "Scattered",
    "Segment",
    "Sizing",
    "Surface",
    "as_field",
    "combine",
    "curvature_size",
    "derivatives",
    "force_weight",
    "gap_size",
    "generate_code",
    "gradient_size",
    "hessian_size",
    "interface_distance",
    "maximum",
    "minimum",
    "normalize",
    "q_criterion",
    "sensor_size",
    "shock_sensor",
    "steepness",
    "vorticity",
]
