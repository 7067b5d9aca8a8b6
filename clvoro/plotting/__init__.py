"""Pictures of meshes and runs, and a page that shows them (needs Matplotlib, extra `plot`).

Pictures in 3D also need PyVista (extra `pyvista`), those of spheres Cartopy (extra `maps`).
"""

from ..errors import ClvoroError

try:
    import matplotlib  # noqa: F401
except ModuleNotFoundError as error:
    raise ClvoroError("pictures need Matplotlib, which is not installed; pip install 'clvoro[plot]'") from error

from .boundaries import plot_boundaries
from .cells import plot_cells, plot_size
from .curves import plot_distributions, plot_history
from .globe import map_projection, plot_globe
from .page import write_report
from .pictures import plot_mesh
from .solids import plot_cutaway, plot_slice, plot_slices

__all__ = [
    "map_projection",
    "plot_boundaries",
    "plot_cells",
    "plot_cutaway",
    "plot_distributions",
    "plot_globe",
    "plot_history",
    "plot_mesh",
    "plot_size",
    "plot_slice",
    "plot_slices",
    "write_report",
]
