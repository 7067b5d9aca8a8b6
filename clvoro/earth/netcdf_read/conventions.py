"""The variables of netCDF files by MPAS, UGRID and SCRIP, as `MeshInFile`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from ...geometry.sphere import EARTH_RADIUS, Sphere
from ...io.arrays import FileError
from ...mesh.connectivity import following
from .cells import MeshInFile

_PLANE = "it is a mesh in the plane, expected one on a sphere; load a .npz or .vtu file instead"


class Variables:
    """The variables and attributes of an open file."""

    def __init__(self, file: scipy.io.netcdf_file) -> None:
        self._file = file

    def __contains__(self, name: str) -> bool:
        return name in self._file.variables

    def names(self) -> list[str]:
        """Return the names of all variables."""
        return list(self._file.variables)

    def about(self, name: str, key: str) -> Any:
        """Return an attribute of a variable, texts as str; None without it."""
        return _plain(getattr(self._file.variables[name], key, None))

    def attribute(self, key: str) -> Any:
        """Return an attribute of the file; None without it."""
        return _plain(getattr(self._file, key, None))

    def real(self, *names: str) -> np.ndarray:
        """Return the columns of the variables `names` as float64, (n, k), or (n, m, k) of tables."""
        return np.stack([self._array(name, "f").astype(float) for name in names], axis=-1)

    def integer(self, name: str) -> np.ndarray:
        """Return a variable as int64."""
        return self._array(name, "iu").astype(np.int64)

    def _array(self, name: str, kinds: str) -> np.ndarray:
        if name not in self:
            raise FileError(f"it lacks the variable {name}")
        found = np.array(self._file.variables[name].data)
        if found.dtype.kind not in kinds:
            raise FileError(f"its variable {name} has the type {found.dtype}")
        if kinds == "f" and not np.isfinite(found).all():
            raise FileError(f"its variable {name} has values that are not finite")
        return found


def read_mpas(file: Variables) -> MeshInFile | None:
    """Return the cells of a file by the MPAS mesh specification; None for other files."""
    if "verticesOnCell" not in file:
        return None
    if str(file.attribute("on_a_sphere")).strip().upper() != "YES":
        raise FileError(_PLANE)
    radius = float(np.ravel(file.attribute("sphere_radius"))[0])
    points, vertices, edges = (file.real(*(f"{axis}{what}" for axis in "xyz")) for what in ("Cell", "Vertex", "Edge"))
    counts, table = file.integer("nEdgesOnCell"), file.integer("verticesOnCell")
    ends = _ragged(table, counts, len(vertices), 1, "verticesOnCell")
    of_faces = _ragged(file.integer("edgesOnCell"), counts, len(edges), 1, "edgesOnCell")
    # Vertex k of a cell lies between its edges k and k + 1, so that it ends edge k.
    corners = np.empty_like(ends)
    corners[following(np.concatenate([[0], np.cumsum(counts)]))] = ends
    return MeshInFile(radius, points, vertices, counts, corners, edges[of_faces])


def read_ugrid(file: Variables) -> MeshInFile | None:
    """Return the cells of a file by UGRID with longitudes and latitudes; None for other files.

    The coordinates of faces are taken as the generators.
    """
    meshes = [k for k in file.names() if file.about(k, "cf_role") == "mesh_topology"]
    if not meshes:
        return None
    mesh = meshes[0]
    nodes, faces = (_lonlat_names(file, file.about(mesh, f"{what}_coordinates")) for what in ("node", "face"))
    if nodes is None:
        raise FileError(_PLANE)
    if faces is None:
        raise FileError(
            "its faces have no longitudes and latitudes, which are the generators; pass generators to clvoro.voronoi"
        )
    radius = _radius(file)
    sphere = Sphere(radius)
    name = str(file.about(mesh, "face_node_connectivity"))
    table = file.integer(name)
    first = int(np.ravel(file.about(name, "start_index") or 0)[0])
    fill = file.about(name, "_FillValue")
    there = table >= first if fill is None else (table != np.ravel(fill)[0])
    vertices = sphere.positions(file.real(*nodes))
    counts = there.sum(axis=1)
    corners = _ragged(table, counts, len(vertices), first, name)
    of_run = [f for f in ("size", "error", "quality") if f in file]
    of_cells = tuple(file.real(f)[:, 0] for f in of_run) if len(of_run) == 3 else None
    points = sphere.positions(file.real(*faces))
    return MeshInFile(radius, points, vertices, counts, corners, of_run=of_cells)  # type: ignore[arg-type]


def read_scrip(file: Variables) -> MeshInFile | None:
    """Return the cells of a file by SCRIP of clvoro; None for other files.

    SCRIP has the corners of each cell on their own. Those at the same place are one.
    """
    if "grid_corner_lon" not in file:
        return None
    if "generator_lon" not in file:
        raise FileError(
            "it has centers and corners, and SCRIP has no generators; pass the centers to clvoro.voronoi for the mesh "
            "around them"
        )
    radius = _radius(file)
    sphere = Sphere(radius)
    around = file.real("grid_corner_lon", "grid_corner_lat")
    n, most = around.shape[:2]
    around = around.reshape(-1, 2)
    around[:, 0] = np.where(np.abs(around[:, 1]) == 90, 0, np.mod(around[:, 0], 360))
    lonlat, place = np.unique(around, axis=0, return_inverse=True)
    table = place.reshape(n, most)
    # Cells of fewer corners repeat the last one.
    counts = 1 + (table != table[:, -1:]).sum(axis=1)
    corners = table[np.arange(most) < counts[:, None]]
    points = sphere.positions(file.real("generator_lon", "generator_lat"))
    return MeshInFile(radius, points, sphere.positions(lonlat), counts, corners)


READERS: tuple[Callable[[Variables], MeshInFile | None], ...] = (read_mpas, read_ugrid, read_scrip)


def _ragged(table: np.ndarray, counts: np.ndarray, bound: int, first: int, name: str) -> np.ndarray:
    """Return the first `counts[i]` items of each row, numbered from 0."""
    if table.ndim != 2 or counts.shape != table.shape[:1] or (counts > table.shape[1]).any():
        raise FileError(f"{name} has shape {table.shape}, which differs from the numbers of edges")
    found = table[np.arange(table.shape[1]) < counts[:, None]] - first
    if len(found) and not (found.min() >= 0 and found.max() < bound):
        raise FileError(f"{name} has an index out of range")
    return found


def _lonlat_names(file: Variables, coordinates: object) -> tuple[str, str] | None:
    """Return the longitude and the latitude among the names in `coordinates`; None without them."""
    found = {}
    for name in str(coordinates or "").split():
        if name in file:
            units = str(file.about(name, "units") or "").lower()
            for axis, direction in (("lon", "east"), ("lat", "north")):
                standard = str(file.about(name, "standard_name") or "")
                if units.startswith("degree") and (direction in units or standard.startswith(axis)):
                    found[axis] = name
    return (found["lon"], found["lat"]) if len(found) == 2 else None


def _radius(file: Variables) -> float:
    """Return the radius of the sphere; that of the Earth in meters if the file has none."""
    own = file.attribute("sphere_radius")
    if own is None:
        for name in file.names():
            own = file.about(name, "earth_radius") if own is None else own
    return EARTH_RADIUS if own is None else float(np.ravel(own)[0])


def _plain(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value
