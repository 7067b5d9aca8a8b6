"""Pictures of meshes and runs, and a page that shows them (needs Matplotlib, extra `plot`)."""

from .cells import plot_cells, plot_size
from .curves import plot_displacements, plot_history
from .page import write_report

__all__ = [
    "plot_cells",
    "plot_displacements",
    "plot_history",
    "plot_size",
    "write_report",
]
