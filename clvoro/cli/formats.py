"""The mesh files that `clvoro run --format` writes beside mesh.vtu and mesh.npz."""

from __future__ import annotations

MESH_FILES = {
    "openfoam": ("mesh.foam", None),
    "nc": ("mesh.nc", "ugrid"),
    "mpas": ("mesh-mpas.nc", "mpas"),
    "scrip": ("mesh-scrip.nc", "scrip"),
    "vtk": ("mesh.vtk", None),
    "ply": ("mesh.ply", None),
    "obj": ("mesh.obj", None),
    "metis": ("graph.info", None),
}
"""By the name of the format: the file, and its convention, which `clvoro.io.write` takes."""
NAMES = {"foam": "openfoam", "ugrid": "nc", "info": "metis"}
"""Formats that are also known by a suffix or a convention."""
PLANE = ("nc", "mpas", "vtk", "ply", "obj")
"""Formats that hold polygons only."""
