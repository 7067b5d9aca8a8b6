"""Voronoi meshes that meet a size field, adapted with OpenCL.

You give a domain and the size h(x) that its cells are to have (edge lengths, in the domain's unit); the generators of a
Voronoi diagram are moved, inserted and deleted until its cells have that size and are nearly regular.

>>> import clvoro
>>> from clvoro import sizing
>>> domain = clvoro.Box((0, 0), (2, 1))
>>> size = sizing.Distance(sizing.Circle((0.7, 0.5), radius=0.2), h_min=0.05, slope=0.3)
>>> adapter = clvoro.Adapter(clvoro.create_context())  # the best device that works
>>> result = adapter.run(domain, size, effort="fast", seed=7)
>>> bool(abs(result.diagram.volumes.sum() - domain.measure) < 1e-12)
True

Domains: `Box` (2D, 3D, periodic), `Polygon` (holes, pieces; GeoJSON, WKT, shapely), with `Layers` along walls. Sizes:
numbers, functions of NumPy arrays, and the fields of `clvoro.sizing`. `Adapter.run` gives a `Result` (and
`Adapter.diagram` a `Diagram` alone): arrays, `save`, `plot`, `check`, `transfer`; `load` reads it again. Errors and
warnings are in `clvoro.errors`, pictures in `clvoro.plotting`, times of kernels in `clvoro.profile`. The command is
``clvoro``; begin with ``clvoro --help``.
"""

from . import sizing
from .adapter import Adapter
from .errors import ClvoroError
from .geometry.boundary_layers import Layers
from .geometry.box import Box
from .geometry.polygon import Polygon
from .io import load
from .mesh.results import Diagram, Displacements, Result
from .opencl import profile
from .opencl.devices import create_context, list_devices

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
