"""Write formats of other programs with meshio."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

from ..errors import ClvoroError, InputError
from .atomic import atomic_folder
from .contents import Contents
from .convert import to_meshio

# Formats in which meshio writes polygons with any number of sides. In others it drops them with a warning only. The
# value says whether it writes cell data, too.
_POLYGONS = {".vtk": True, ".ply": False, ".obj": False}

_SAFE = (
    ".npz (everything), .vtu (ParaView), .foam (OpenFOAM), .nc (QGIS, UGRID, MPAS), .info (METIS), .vtk, .ply or .obj"
)

_PICTURE = "it is no mesh file; write mesh.plot().savefig(path)"
_LAYER = (
    "save as .nc, which QGIS opens as a mesh, or write geopandas.GeoDataFrame(geometry=mesh.to_shapely(), "
    "crs=...).to_file(path)"
)
_INSTEAD = {**dict.fromkeys((".png", ".pdf", ".svg"), _PICTURE), **dict.fromkeys((".shp", ".geojson", ".gpkg"), _LAYER)}


def write_foreign(contents: Contents, path: Path) -> None:
    """Write the cells in the format that the suffix of `path` names."""
    suffix = path.suffix.lower()
    if suffix not in _POLYGONS:
        why = f"{suffix} is unknown or cannot hold polygons" if suffix else "it has no suffix"
        why = _INSTEAD.get(suffix, f"{why}; use {_SAFE}")
        raise InputError(f"cannot write {path}: {why}")
    check_polygons(contents, path)
    with_data = _POLYGONS[suffix]
    if contents.extra and not with_data:
        raise InputError(
            f"cannot write cell_data to {path}: {suffix} holds no data of cells; save as .vtu or .vtk, or leave it out"
        )
    try:
        mesh = to_meshio(contents, with_data)
    except ClvoroError as error:
        raise InputError(
            f'cannot write {path}: {suffix} needs meshio; run `pip install "clvoro[formats]"`, or save as .vtu or .npz'
        ) from error
    # meshio prints warnings to the terminal. Errors are exceptions.
    with atomic_folder(path) as temporary, contextlib.redirect_stdout(io.StringIO()):
        mesh.write(temporary)


def check_polygons(contents: Contents, path: Path) -> None:
    """Refuse a mesh whose cells are no polygons."""
    if contents.diagram.domain.cell_dim != 2:
        raise InputError(
            f"cannot write {path}: the mesh has 3 dimensions, and {path.suffix.lower()} is for polygons in the plane "
            "or on a sphere; save it as .vtu, .foam or .npz"
        )
