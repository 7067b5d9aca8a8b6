"""Voronoi meshes that meet a size field, adapted with OpenCL.

You give a domain and the size h(x) of its cells: the square root of their areas, in space the cube root of their
volumes. The generators of a Voronoi diagram are moved, inserted and deleted until its cells have that size and are
nearly regular.

>>> import clvoro
>>> from clvoro import sizing
>>> domain = clvoro.Box((0, 0), (2, 1))
>>> size = sizing.Distance(sizing.Circle((0.7, 0.5), radius=0.2), h_min=0.05, slope=0.3)
>>> mesh = clvoro.adapt(domain, size, "fast")
>>> bool(abs(mesh.diagram.volumes.sum() - domain.measure) < 1e-12)
True

Domains: `Box` (2D, 3D, periodic), `Polygon` (holes, pieces; GeoJSON, WKT, shapely), with `Layers` along walls, and
`Sphere`, for global models, and `Solid`, the inside of a triangulated surface; `earth` has sizes by longitude and
latitude, and finds the cells of oceans and limited areas. `curves` has circles, ellipses, wing sections and splines
for boundaries. Sizes: numbers, functions of NumPy arrays, and the fields of `clvoro.sizing`.
`adapt` returns a `Result`, `voronoi` a `Diagram` of given generators; both have arrays, `save`, `plot`, `check` and
`transfer`, and `load` reads a saved result; `read_fields` reads fields from files of any program. `power_diagram` takes
generators with weights; `transport` finds those with which cells have given volumes (`Transported`). `Adapter` is the
full interface, on a device of your choice, with `MultilevelOptions`, `PaperOptions` and `Checkpoint`. Its `start`
begins a `Run` that goes on step by step and follows other sizes. Ctrl-C raises `Interrupted`, which carries the mesh so
far. Errors and warnings are in `clvoro.errors`, pictures in `clvoro.plotting`, times of kernels in `clvoro.profile`.
The command is ``clvoro``; begin with ``clvoro --help``.
"""

from . import curves, earth, foam, sizing
from .adaptation.options import Checkpoint, MultilevelOptions, PaperOptions
from .adaptation.run import Run
from .adapter import Adapter
from .errors import ClvoroError, Interrupted
from .fields import read_fields
from .geometry.boundary_layers import Layers
from .geometry.box import Box
from .geometry.polygon import Polygon
from .geometry.solid.solid import Solid
from .geometry.sphere import Sphere
from .io import load
from .mesh.diagram import Diagram
from .mesh.results import Displacements, Result, Transported
from .opencl import profile
from .opencl.devices import create_context, list_devices
from .shared import adapt, power_diagram, transport, voronoi
from .version import __version__ as __version__

__all__ = [
    "Adapter",
    "Box",
    "Checkpoint",
    "ClvoroError",
    "Diagram",
    "Displacements",
    "Interrupted",
    "Layers",
    "MultilevelOptions",
    "PaperOptions",
    "Polygon",
    "Result",
    "Run",
    "Solid",
    "Sphere",
    "Transported",
    "adapt",
    "create_context",
    "curves",
    "earth",
    "foam",
    "list_devices",
    "load",
    "power_diagram",
    "profile",
    "read_fields",
    "sizing",
    "transport",
    "voronoi",
]
