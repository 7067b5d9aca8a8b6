"""The mesh files that `clvoro run --format` writes beside mesh.vtu and mesh.npz."""

from __future__ import annotations

MESH_FILES = {
    "foam": ("mesh.foam", None),
    "nc": ("mesh.nc", "ugrid"),
    "mpas": ("mesh-mpas.nc", "mpas"),
    "scrip": ("mesh-scrip.nc", "scrip"),
    "vtk": ("mesh.vtk", None),
    "ply": ("mesh.ply", None),
    "obj": ("mesh.obj", None),
    "metis": ("graph.info", None),
}
"""By the name of the format: the file, and its convention, which `clvoro.io.write` takes."""
PLANE = ("nc", "mpas", "vtk", "ply", "obj")
"""Formats that hold polygons only."""
