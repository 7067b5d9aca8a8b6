"""Meshes on spheres from netCDF files by MPAS and UGRID."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import scipy

from ..connectivity import components, following, starts_of
from ..files import open_plain
from ..geometry.sphere import EARTH_RADIUS, Sphere, triangle_areas
from ..geometry.subdomain import SphereRegion
from ..io.arrays import FileError, explained
from ..mesh.check.rebuilt import rebuild_on_sphere
from ..mesh.diagram import Diagram
from ..mesh.results import Result, result_of_file

NETCDF_SUFFIXES = (".nc", ".nc4", ".cdf", ".netcdf")
OFF_SPHERE = 1e-5
"""Largest distance of a position from its sphere in units of the radius: round-off of float32, and more."""
_SAME = 0.05
"""Positions of removed generators are the same if they are nearer to each other than this share of the least distance
from their cells."""


@dataclass
class MeshInFile:
    """The cells of a mesh on a sphere, as a file has them."""

    radius: float
    points: np.ndarray
    vertices: np.ndarray
    """`points`, `vertices`: (n, 3), (v, 3) float64. Generators and corners on the sphere."""
    counts: np.ndarray
    """(n,) int. Numbers of corners of the cells."""
    corners: np.ndarray
    """(m,) int. Corners of the cells, one cell after the other, counter-clockwise."""
    middles: np.ndarray | None = None
    """(m, 3) float64, optional. Middle of the arc between both generators of the face from each corner to the next."""
    of_run: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """Size, error and quality of the cells, each (n,) float64; None if the file is not of a run."""


def make_diagram(cells: MeshInFile) -> Diagram:
    """Return the diagram of `cells`. If they do not cover the whole sphere, its domain is a `SphereRegion`.

    Raises `FileError` if positions are not on the sphere, a cell has fewer than two corners or is not
    counter-clockwise, or a face is in more than two cells.
    """
    n, radius = len(cells.points), cells.radius
    if not n or not np.isfinite(radius) or radius <= 0:
        raise FileError(f"it has {n} cells on a sphere of radius {radius:g}")
    for name, places in (("generators", cells.points), ("corners", cells.vertices)):
        off = np.abs(np.linalg.norm(places, axis=1) / radius - 1)
        if not (off < OFF_SPHERE).all():
            k = int(np.argmax(~(off < OFF_SPHERE)))
            raise FileError(f"{name}[{k}] is {places[k]}, not on the sphere of radius {radius:g}")
    if cells.counts.min() < 2:
        raise FileError(f"cell {cells.counts.argmin()} has {cells.counts.min()} corners")
    starts = starts_of(cells.counts)
    owner = np.repeat(np.arange(n), cells.counts)
    ends = np.stack([cells.corners, cells.corners[following(starts)]], axis=1)
    x, v = cells.points / radius, cells.vertices / radius
    areas = np.bincount(owner, triangle_areas(x[owner], v[ends[:, 0]], v[ends[:, 1]]), n)
    if not (areas > 0).all():
        k = int(np.argmax(~(areas > 0)))
        raise FileError(f"cell {k} does not surround its generator counter-clockwise")
    volumes = areas * radius**2
    neighbors = _neighbors(owner, ends, len(v))
    alone = np.flatnonzero(neighbors < 0)
    sphere = Sphere(radius)
    if len(alone):
        beyond = _removed(cells, owner[alone], ends[alone], alone)
        neighbors[alone] = -1 - np.arange(len(alone))
        sphere = SphereRegion(sphere, cells.points[owner[alone]], beyond, float(volumes.sum()))
    known = {
        "points": cells.points,
        "volumes": volumes,
        "neighbor_starts": starts.astype(np.int32),
        "neighbors": neighbors.astype(np.int32),
        "vertices": cells.vertices,
        "cell_vertex_starts": starts.astype(np.int32),
        "cell_vertices": cells.corners.astype(np.int32),
    }
    return Diagram(sphere, {**known, **rebuild_on_sphere(Diagram(sphere, known))})


def _neighbors(owner: np.ndarray, ends: np.ndarray, v: int) -> np.ndarray:
    """Return the cell with the opposite of each face (m, 2); -1 without one."""
    here, there = ends[:, 0] * v + ends[:, 1], ends[:, 1] * v + ends[:, 0]
    order = np.argsort(here)
    ranked = here[order]
    same = np.flatnonzero(ranked[1:] == ranked[:-1])
    if len(same):
        a, b = owner[order[same[0]]], owner[order[same[0] + 1]]
        raise FileError(f"cells {a} and {b} are on the same side of a face")
    place = np.minimum(np.searchsorted(ranked, there), len(ranked) - 1)
    return np.where(ranked[place] == there, owner[order[place]], -1)


def _removed(cells: MeshInFile, owner: np.ndarray, ends: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the generator of the removed cell behind each boundary face, (k, 3).

    A face is on the bisector of both generators. So the other one is the reflection of that of the cell, through the
    middle of the arc between them, or else at the plane of the face.
    """
    radius = cells.radius
    own = cells.points[owner] / radius
    v, w = (cells.vertices[ends[:, k]] / radius for k in (0, 1))
    lengths = np.linalg.norm(w - v, axis=1)
    if cells.middles is not None:
        middle = cells.middles[faces] / np.linalg.norm(cells.middles[faces], axis=1)[:, None]
        other = 2 * (own * middle).sum(axis=1)[:, None] * middle - own
    else:
        normal = np.cross(v, w - v)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal /= np.linalg.norm(normal, axis=1)[:, None]
        other = own - 2 * (own * normal).sum(axis=1)[:, None] * normal
    usable = np.isfinite(other).all(axis=1)
    if not usable.any():
        raise FileError("its boundary has no face with a length")
    tree = scipy.spatial.KDTree(other[usable])
    other[~usable] = other[usable][tree.query(v[~usable])[1]]
    away = np.linalg.norm(other - own, axis=1)
    near = scipy.spatial.KDTree(other).query_pairs(_SAME * float(away.min()), output_type="ndarray")
    label = components(len(own), *near.T)[1]
    # The longest face of each removed cell places its generator best.
    rank = np.lexsort((-lengths, ~usable, label))
    best = rank[np.flatnonzero(np.diff(label[rank], prepend=-1))]
    return radius * other[best[label]]


_PLANE = "it is a mesh in the plane, expected one on a sphere; load a .npz or .vtu file instead"


def _netcdf4(name: str) -> Any:
    """Open a netCDF-4 file, without masks and scales."""
    try:
        import netCDF4
    except ModuleNotFoundError as error:
        raise FileError(
            "it is netCDF-4, for which the package netCDF4 is missing: run `pip install netCDF4`, or convert the file "
            "to netCDF-3 by `nccopy -k nc6 FILE NEW`"
        ) from error
    file = netCDF4.Dataset(name)
    file.set_auto_maskandscale(False)
    return file


class Variables:
    """The variables and attributes of an open file."""

    def __init__(self, file: scipy.io.netcdf_file) -> None:
        self._file = file

    def __contains__(self, name: str) -> bool:
        return name in self._file.variables

    def names(self) -> list[str]:
        """Return the names of all variables of the file."""
        return list(self._file.variables)

    def about(self, name: str, key: str) -> Any:
        """Return an attribute of a variable, texts as str; None without it."""
        return _plain(getattr(self._file.variables[name], key, None))

    def dimensions(self, name: str) -> tuple[str, ...]:
        """Return the names of the dimensions of a variable."""
        return tuple(self._file.variables[name].dimensions)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the lengths of the dimensions of a variable."""
        return tuple(self._file.variables[name].shape)

    def kind(self, name: str) -> str:
        """Return the kind of a variable's type, as of `numpy.dtype`."""
        found = self._file.variables[name]
        return np.dtype(found.dtype if hasattr(found, "dtype") else found.data.dtype).kind

    def data(self, name: str) -> np.ndarray:
        """Return a variable as float64, scaled, with NaN where it has no value."""
        found = np.array(self._file.variables[name][...]).astype(float)
        for key in ("_FillValue", "missing_value"):
            empty = self.about(name, key)
            if empty is not None:
                found[found == float(np.ravel(empty)[0])] = np.nan
        factor, offset = (self.about(name, key) for key in ("scale_factor", "add_offset"))
        return found * float(1 if factor is None else factor) + float(0 if offset is None else offset)

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
        found = np.array(self._file.variables[name][...])
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
    corners[following(starts_of(counts))] = ends
    return MeshInFile(radius, points, vertices, counts, corners, edges[of_faces])


def read_ugrid(file: Variables) -> MeshInFile | None:
    """Return the cells of a file by UGRID with longitudes and latitudes; None for other files.

    The coordinates of faces are taken as the generators.
    """
    meshes = [k for k in file.names() if file.about(k, "cf_role") == "mesh_topology"]
    if not meshes:
        return None
    mesh = meshes[0]
    nodes, faces = (lonlat_names(file, file.about(mesh, f"{what}_coordinates")) for what in ("node", "face"))
    if nodes is None:
        raise FileError(_PLANE)
    if faces is None:
        raise FileError(
            f"its faces have no longitudes and latitudes, which are the generators: {_why_none(file, mesh)}"
        )
    radius = _radius(file)
    sphere = Sphere(radius)
    name = str(file.about(mesh, "face_node_connectivity"))
    if name not in file:
        raise FileError(f"it lacks the variable {name}")
    first = int(np.ravel(file.about(name, "start_index") or 0)[0])
    table = file.data(name)  # xarray stores indices as real numbers, with NaN
    there = table >= first if file.about(name, "_FillValue") is None else ~np.isnan(table)
    table = np.where(there, table, first).astype(np.int64)
    vertices = sphere.positions(file.real(*nodes))
    counts = there.sum(axis=1)
    corners = _ragged(table, counts, len(vertices), first, name)
    of_run = [f for f in ("size", "error", "quality") if f in file]
    of_cells = tuple(file.real(f)[:, 0] for f in of_run) if len(of_run) == 3 else None
    points = sphere.positions(file.real(*faces))
    return MeshInFile(radius, points, vertices, counts, corners, of_run=of_cells)  # type: ignore[arg-type]


READERS: tuple[Callable[[Variables], MeshInFile | None], ...] = (read_mpas, read_ugrid)


def _ragged(table: np.ndarray, counts: np.ndarray, bound: int, first: int, name: str) -> np.ndarray:
    """Return the first `counts[i]` items of each row, numbered from 0."""
    if table.ndim != 2 or counts.shape != table.shape[:1] or (counts > table.shape[1]).any():
        raise FileError(f"{name} has shape {table.shape}, which differs from the numbers of edges")
    found = table[np.arange(table.shape[1]) < counts[:, None]] - first
    if len(found) and not (found.min() >= 0 and found.max() < bound):
        raise FileError(f"{name} has an index out of range")
    return found


def lonlat_names(file: Variables, coordinates: object) -> tuple[str, str] | None:
    """Return the longitude and the latitude among the names in `coordinates`; None without them."""
    found = {}
    for name in str(coordinates or "").split():
        if name in file:
            units = str(file.about(name, "units") or "").lower()
            for axis, direction in (("lon", "east"), ("lat", "north")):
                standard = str(file.about(name, "standard_name") or "")
                named = not units and not standard and axis in name.lower()  # some programs give names only
                if named or (units.startswith("degree") and (direction in units or standard.startswith(axis))):
                    found[axis] = name
    return (found["lon"], found["lat"]) if len(found) == 2 else None


def _why_none(file: Variables, mesh: str) -> str:
    """Say why the coordinates of faces are none."""
    names = str(file.about(mesh, "face_coordinates") or "").split()
    if not names:
        return f"{mesh} has no attribute face_coordinates; pass generators to clvoro.voronoi"
    lacking = [name for name in names if name not in file]
    if lacking:
        return f"face_coordinates of {mesh} names {lacking[0]}, which is no variable"
    units = ", ".join(f"{name} has units {file.about(name, 'units')!r}" for name in names)
    return f"{units}, expected 'degrees_east' and 'degrees_north'; set the attribute units"


def _radius(file: Variables) -> float:
    """Return the radius of the sphere; that of the Earth in meters if the file has none."""
    own = file.attribute("sphere_radius")
    if own is None:
        for name in file.names():
            own = file.about(name, "earth_radius") if own is None else own
    return EARTH_RADIUS if own is None else float(np.ravel(own)[0])


def _plain(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


_HDF5 = b"\x89HDF"


@contextmanager
def open_netcdf(path: str | PathLike[str]) -> Iterator[Variables]:
    """Open a netCDF file of either version: the one way to read them, for meshes, fields and grids."""
    with open_plain(path) as file:
        head = file.read(4)
        file.seek(0)
        if not head.startswith((b"CDF", _HDF5)):
            raise FileError("it is another kind of file, expected a netCDF file")
        with _netcdf4(os.fspath(path)) if head == _HDF5 else scipy.io.netcdf_file(file, mmap=False) as found:
            yield Variables(found)


def load_netcdf(path: str | PathLike[str]) -> Result | Diagram:
    """Read the cells of a mesh on a sphere from a file by the MPAS mesh specification or UGRID.

    Neighbors, areas, arcs and centroids are computed from generators and corners. A UGRID file of a `Result` gives a
    `Result`; others give a `Diagram`.
    """
    with explained(path, "a netCDF file"):
        with open_netcdf(path) as found:
            cells = _read(found)
        diagram = make_diagram(cells)
    if cells.of_run is None:
        return diagram
    return result_of_file(diagram, *cells.of_run, kind=".nc")


def _read(file: Variables) -> MeshInFile:
    for reader in READERS:
        cells = reader(file)
        if cells is not None:
            return cells
    raise FileError("it has no mesh by MPAS or UGRID")
