"""Voronoi meshes that meet a size field, adapted with OpenCL."""

from . import profile, sizing
from .adapter import Adapter
from .device import create_context, list_devices
from .domain import Box
from .errors import ClvoroError
from .io import load
from .layers import Layers
from .polygon import Polygon
from .results import Diagram, Displacements, Result

__version__ = "0.1.0"

__all__ = [
    "Adapter",
    "Box",
    "ClvoroError",
    "Diagram",
    "Displacements",
    "Layers",
    "Polygon",
    "Result",
    "create_context",
    "list_devices",
    "load",
    "profile",
    "sizing",
]
