"""Fields of other programs: values in cells or at points of a file, on a mesh of the domain to be adapted."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .arguments import check_number, check_path, warn
from .earth.netcdf_read import NETCDF_SUFFIXES, Variables, lonlat_names, open_netcdf
from .errors import InputError, InputTypeError, MismatchWarning
from .files import open_plain
from .foam.case import FoamCase
from .foam.mesh import FoamMesh
from .geometry.domain import Domain
from .geometry.sphere import Sphere
from .io import load
from .io.arrays import FileError, array_names, explained, is_kind, read_array
from .io.npz import FORMAT
from .io.vtu_read import cell_data_of_vtu
from .mesh.diagram import Diagram
from .mesh.geometry import sum_rows
from .mesh.results import Result
from .shared import voronoi
from .sizing.arguments import coverage_warnings

_SAME = 1e-9
"""Places are the same if they are nearer than this share of the domain's longest side."""
_NEAR_WALL = 1e-3
"""Places outside by less than this share of that side count as on the wall: other meshes have facets for curves."""
_TABLES = (".csv", ".txt", ".dat", ".tsv")
_AXES = (("x", "y", "z"), ("lon", "lat"), ("longitude", "latitude"))
_MPAS_PLACES = ("xCell", "yCell", "zCell", "lonCell", "latCell")


class _Found(NamedTuple):
    """Values by name, (n,) or (n, k), at places (n, d), which may be longitudes and latitudes; or on a mesh."""

    values: dict[str, np.ndarray]
    places: np.ndarray | None = None
    on_globe: bool = False
    mesh: Diagram | None = None
    domain: Domain | None = None


def read_fields(
    path: str | PathLike[str],
    fields: str | Sequence[str] | None = None,
    *,
    domain: Domain | None = None,
    time: float | None = None,
) -> tuple[Diagram, dict[str, np.ndarray]]:
    """Read fields in cells or at points from the file of any program, with a mesh on which estimators take them.

    The mesh has a generator at each place with values: the centers of cells, or points. So it does not matter of which
    cells the file's own mesh consists, nor whether it has any::

        mesh, found = clvoro.read_fields("flow.vtu", ["U", "p"], domain=channel)
        size = clvoro.sizing.hessian_size([found["U"], found["p"]], on=mesh, n_cells=6000)

    Its centroids are these places. A mesh that clvoro saved comes back as it was.

    Parameters
    ----------
    path : str or path
        - ``.vtu``, ``.npz`` of clvoro, with its ``cell_data``.
        - ``.nc``: variables by UGRID, by the MPAS mesh specification, or with the attribute ``coordinates``. Places
          without a value (``_FillValue``) are left out. netCDF-4 needs the package netCDF4.
        - ``.csv``, ``.txt``, ``.dat``, ``.tsv``: a table with a line of names. Columns x, y (, z) or lon, lat are
          places.
        - ``.npz`` with an array ``points`` (n, d) and others (n,) or (n, k).
        - The folder of a case of OpenFOAM, or a ``.foam`` file in it.
        - Any other file that meshio reads, such as ``.vtu``, ``.vtk``, ``.xdmf``, ``.msh``, ``.e``. Of its cells those
          of the highest dimension count.
    fields : str or sequence of str, optional
        Names; by default all fields with numbers: in cells, or else at points.
    domain : Box, Polygon, Solid or Sphere, optional
        The domain to be adapted. Meshes of clvoro and OpenFOAM have their own. Places outside are left out. Values at
        the same place, as of both sides of a layer of cells, are averaged.
    time : float, optional
        A time of OpenFOAM, or the number of a time in a netCDF file, from 0. By default the last one.

    Returns
    -------
    mesh : Diagram
    values : dict of (n,) or (n, k) float64
        By name, a row for each cell of `mesh`. Vectors in the plane have two components.

    Raises
    ------
    InputError, InputTypeError
        If the file cannot be read, has no such field or time, or has values that are not finite; if no domain is known,
        or no place is inside it.

    Warns
    -----
    MismatchWarning
        If the places cover little of the domain.
    """
    name = check_path("path", path)
    wanted = _names(fields)
    time = None if time is None else check_number("time", time)
    with explained(name, "a file with fields"):
        found = _reader(Path(name))(Path(name), wanted, time)
    mesh, values = _on_mesh(name, found, domain)
    for key, rows in values.items():
        bad = np.flatnonzero(~np.isfinite(rows.reshape(len(rows), -1)).all(axis=1))
        if len(bad):
            raise InputError(
                f"{name}: {key} is {rows[bad[0]]} at {mesh.centroids[bad[0]].tolist()}, expected finite values "
                f"({len(bad)} of {len(rows)} are not); leave these rows out, or go back to an earlier time"
            )
    return mesh, values


def _names(fields: object) -> tuple[str, ...] | None:
    if fields is None:
        return None
    names = (fields,) if isinstance(fields, str) else tuple(fields) if isinstance(fields, Iterable) else ()
    if not (names and all(isinstance(one, str) for one in names)):
        raise InputTypeError(f"fields is {fields!r:.60}, expected names of fields, or None for all")
    return names


def _reader(path: Path) -> Callable[[Path, tuple[str, ...] | None, float | None], _Found]:
    kind = path.suffix.lower()
    if path.is_dir() or kind == ".foam":
        return _of_openfoam
    if kind in NETCDF_SUFFIXES:
        return _of_netcdf
    if kind in _TABLES:
        return _of_table
    return {".npz": _of_npz, ".vtu": _of_vtu}.get(kind, _of_meshio)


def _chosen(wanted: Iterable[str] | None, present: Iterable[str]) -> list[str]:
    """Return the names that are wanted, each once; all by default.

    Raises `FileError` if one is absent, or there are none.
    """
    there = list(present)
    absent = [name for name in wanted or () if name not in there]
    if not there:
        raise FileError("it has no fields")
    if absent:
        raise FileError(f"it has no field {', '.join(absent)}; it has {', '.join(there)}")
    return list(dict.fromkeys(wanted or there))


def _refuse_time(time: float | None) -> None:
    """Raise FileError if a time is given for a file without times."""
    if time is not None:
        raise FileError(f"it has no times, and time is {time:g}; leave it out")


def _of_npz(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    if not is_kind(path, FORMAT):
        return _of_arrays(path, wanted, time)
    there = {n.removeprefix("cell_data."): n for n in array_names(path) if n.startswith("cell_data.")}
    return _of_clvoro(path, {n: read_array(path, there[n]).astype(float) for n in _chosen(wanted, there)}, time)


def _of_vtu(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    there = cell_data_of_vtu(path)
    if there is None:
        return _of_meshio(path, wanted, time)
    return _of_clvoro(path, {n: there[n] for n in _chosen(wanted, there)}, time)


def _of_clvoro(path: Path, values: dict[str, np.ndarray], time: float | None) -> _Found:
    _refuse_time(time)
    made = load(path)
    mesh = made.diagram if isinstance(made, Result) else made
    return _Found({n: _of_dimension(rows, mesh.domain.dim) for n, rows in values.items()}, mesh=mesh)


def _of_dimension(rows: np.ndarray, dim: int) -> np.ndarray:
    """Return vectors without the third component 0 that VTK has in the plane."""
    return rows[:, :dim] if rows.ndim > 1 and rows.shape[1] == 3 and not rows[:, dim:].any() else rows


def _of_openfoam(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    case = FoamCase(path if path.is_dir() else path.parent)
    at = case.latest()
    if time is not None:
        there = case.times()
        same = [one for one in there if one.value == time]
        if not same:
            raise FileError(f"it has no time {time:g}; it has {', '.join(one.name for one in there)}")
        at = same[0]
    foam = FoamMesh.read(case.mesh_folder(at))
    dim = 2 if foam.is_plane else 3
    known = {one.name: one for one in case.fields(at) if one.in_cells}
    values = {}
    for name in _chosen(wanted, known):
        rows = known[name].internal.rows(foam.n_cells)
        if known[name].type == "vector":
            rows = rows[:, :dim]  # in the plane the third component is round-off
        values[name] = rows[:, 0] if rows.shape[1] == 1 else rows
    return _Found(values, foam.centroids[:, :dim], domain=_domain_of(foam))


def _domain_of(foam: FoamMesh) -> Domain | None:
    """Return the inside of the boundary; None if it cannot be one of clvoro."""
    try:
        return foam.domain()
    except InputError:
        return None


def _of_table(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    _refuse_time(time)
    with open_plain(path) as file:
        try:
            lines = file.read().decode("utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            raise FileError("it is no text in UTF-8; save it as text in UTF-8, with numbers in columns") from error
    lines = [line.lstrip("#% ") if k == 0 else line for k, line in enumerate(lines) if line.strip()]
    if len(lines) < 2:
        raise FileError(f"it has {len(lines)} lines, expected names in the first one, and rows of numbers")
    mark = next((m for m in (",", ";", "\t") if m in lines[0]), None)
    rows = list(csv.reader(lines, delimiter=mark)) if mark else [line.split() for line in lines]
    names = [name.strip() for name in rows[0]]
    other = next((row for row in rows[1:] if len(row) != len(names)), None)
    if other is not None:
        raise FileError(
            f"its row {', '.join(other)!r:.60} has {len(other)} items, expected {len(names)} numbers for the names in "
            "the first line"
        )
    columns = dict(zip(names, zip(*rows[1:], strict=True), strict=True))
    if not any(columns.get("", ())):  # a separator at the end of each line
        columns.pop("", None)
    twice = [name for name in columns if names.count(name) > 1]
    if twice:
        raise FileError(f"it has two columns {twice[0]!r}, expected one for each name")
    return _of_columns(columns, wanted)


def _numbers(name: str, column: Sequence[str] | np.ndarray) -> np.ndarray:
    """Return a column of a table as float64."""
    try:
        return np.array(column, float)
    except ValueError as error:
        raise FileError(f"its column {name} has other items than numbers ({error}), expected numbers only") from error


def _of_columns(columns: dict[str, tuple[str, ...]], wanted: tuple[str, ...] | None) -> _Found:
    """Return the fields of a table, at the places in its columns x, y (, z), or lon, lat, or Points.

    ParaView writes a column for each component: Points:0 and U:0, U:1, U:2, or Points_0 and U_0, U_1, U_2.
    """
    mark, split = "_" if "Points_0" in columns else ":", dict[str, list[str]]()
    for name in columns:
        base, sign, number = name.rpartition(mark)
        split.setdefault(base if sign and number.isdigit() else name, []).append(name)

    def take(name: str) -> np.ndarray:
        parts = [_numbers(one, columns[one]) for one in split.pop(name)]
        return parts[0] if len(parts) == 1 else np.stack(parts, axis=1)

    if len(split.get("Points", ())) > 1:
        places = take("Points")
        return _Found({n: take(n) for n in _chosen(wanted, split)}, places)
    lower = {name.lower(): name for name in split}
    for axes in _AXES:
        along = [lower[axis] for axis in axes if axis in lower]
        if len(along) >= 2 and all(len(split[n]) == 1 for n in along):
            places = np.stack([take(n) for n in along], axis=1)
            return _Found({n: take(n) for n in _chosen(wanted, split)}, places, axes[0] != "x")
    raise FileError(f"it has the columns {', '.join(columns):.300}, expected x, y (, z) or lon, lat among them")


def _of_arrays(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    _refuse_time(time)
    names = array_names(path)
    if "points" not in names:
        raise FileError(f"it has the arrays {', '.join(names):.300}, expected points (n, d) among them")
    places = read_array(path, "points").astype(float)
    names.remove("points")
    values = {name: read_array(path, name) for name in _chosen(wanted, names)}
    if wanted is None:
        fields = [name for name, rows in values.items() if rows.ndim and rows.dtype.kind not in "SU"]
        values = {name: values[name] for name in _chosen(None, fields)}  # without single numbers and texts
    for name, rows in values.items():
        if rows.dtype.kind not in "biuf" or not rows.ndim or not rows[:1].size:
            raise FileError(f"{name} has shape {rows.shape} and dtype {rows.dtype}, expected (n,) or (n, k) numbers")
    return _Found({name: rows.astype(float) for name, rows in values.items()}, places)


def _of_netcdf(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    with open_netcdf(path) as file:
        there = {name: found for name in file.names() if (found := _coordinates(file, name))}
        axes = {name for found in there.values() for name in found.names}.union(_MPAS_PLACES)
        kinds = "f" if wanted is None else "iuf"
        present = [name for name in there if name not in axes and file.kind(name) in kinds]
        if not present:
            raise FileError(
                "it has no fields by UGRID or MPAS, nor with the attribute coordinates; for sizes on a grid of "
                'longitudes and latitudes take Raster, or kind = "raster" in a case file'
            )
        values = {name: _at_time(file, name, there[name].along, time) for name in _chosen(wanted, present)}
        used = {there[name] for name in values}
        if len(used) > 1:
            raise FileError(f"its fields {', '.join(values)} are at different places; read them one after the other")
        coordinates = used.pop()
        places = _places(file, coordinates)
    kept = ~np.any([np.isnan(v.reshape(len(v), -1)).any(axis=1) for v in (places, *values.values())], axis=0)
    if not kept.any():
        raise FileError(f"its fields {', '.join(values)} have no values")
    return _Found({name: v[kept] for name, v in values.items()}, places[kept], coordinates.on_globe)


class _Coordinates(NamedTuple):
    """Where the values of a variable are.

    - `names`: the variables with the coordinates.
    - `along`: the dimension of the values that counts places.
    - `on_globe`: whether the coordinates are longitudes and latitudes.
    - `corners`: by UGRID the variable with the nodes of each face or edge, if only nodes have coordinates.
    """

    names: tuple[str, ...]
    along: str
    on_globe: bool
    corners: str = ""


def _coordinates(file: Variables, name: str) -> _Coordinates | None:
    """Return where the values of a variable are; None if the file does not say it."""
    dims = file.dimensions(name)
    sphere = str(file.attribute("on_a_sphere")).strip().upper() == "YES"
    cells = ("lonCell", "latCell") if sphere else ("xCell", "yCell")
    if "nCells" in dims and all(one in file for one in cells):
        return _Coordinates(cells, "nCells", sphere)
    texts = [file.about(name, "coordinates")]
    mesh, location = file.about(name, "mesh"), file.about(name, "location")
    if mesh is not None and mesh in file:
        texts.append(file.about(mesh, f"{location}_coordinates"))
    for text in texts:
        found = _named(file, text)
        if found is not None and found.along in dims:
            return found
    if mesh is None or mesh not in file:
        return None
    corners = str(file.about(mesh, f"{location}_node_connectivity"))
    nodes = _named(file, file.about(mesh, "node_coordinates"))
    if nodes is None or corners not in file:
        return None
    along = str(file.about(mesh, f"{location}_dimension") or file.dimensions(corners)[0])
    return nodes._replace(along=along, corners=corners) if along in dims else None


def _named(file: Variables, text: object) -> _Coordinates | None:
    """Return the coordinates that an attribute names; None if they are not two or three of one dimension."""
    known = tuple(one for one in str(text or "").split() if one in file and len(file.dimensions(one)) == 1)
    along = {file.dimensions(one)[0] for one in known}
    if len(along) != 1:
        return None
    lonlat = lonlat_names(file, " ".join(known))
    if lonlat is not None:
        return _Coordinates(lonlat, along.pop(), True)
    return _Coordinates(known, along.pop(), False) if 2 <= len(known) <= 3 else None


def _places(file: Variables, coordinates: _Coordinates) -> np.ndarray:
    """Return the places of values, (n, k), in degrees on a globe; those of faces and edges are means of corners."""
    places = np.stack([file.data(name) for name in coordinates.names], axis=1)
    if coordinates.names[0] == "lonCell":
        places = np.degrees(places)
    if not coordinates.corners:
        return places
    table = file.data(coordinates.corners)
    if file.dimensions(coordinates.corners)[0] != coordinates.along:
        table = table.T
    first = int(np.ravel(file.about(coordinates.corners, "start_index") or 0)[0])
    there = (table >= first) & (table < first + len(places))
    if not there.any(axis=1).all():
        raise FileError(f"{coordinates.corners} has a row without nodes, expected numbers from {first}")
    globe = Sphere(1.0)
    x = globe.positions(places) if coordinates.on_globe else places
    corners = x[np.where(there, table, first).astype(int) - first]
    middles = (corners * there[..., None]).sum(axis=1) / there.sum(axis=1)[:, None]
    return globe.lonlat(middles) if coordinates.on_globe else middles


def _at_time(file: Variables, name: str, along: str, time: float | None) -> np.ndarray:
    """Return a variable (n,) or (n, k) at a time, with levels as its components."""
    dims, values = list(file.dimensions(name)), file.data(name)
    for k, dim in enumerate(dims):
        if dim.lower() == "time":
            count, at = values.shape[k], -1 if time is None else time
            if not count:
                raise FileError(f"{name} has no times; wait until its program has written one")
            if not (at == int(at) and -1 <= at < count):
                raise FileError(f"{name} has {count} times, and time is {time:g}; expected 0 to {count - 1}")
            values, dims = values.take(int(at), axis=k), dims[:k] + dims[k + 1 :]
            break
    else:
        _refuse_time(time)
    at = dims.index(along)
    values = np.moveaxis(values, at, 0).reshape(values.shape[at], -1)
    return values[:, 0] if values.shape[1] == 1 else values


def _of_meshio(path: Path, wanted: tuple[str, ...] | None, time: float | None) -> _Found:
    _refuse_time(time)
    with open_plain(path):
        pass
    try:
        import meshio
    except ModuleNotFoundError as error:
        raise FileError(
            "it needs the package meshio: run `pip install 'clvoro[formats]'`, or write a table of points, .csv with "
            "the columns x, y (, z)"
        ) from error
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:
        why = str(error) if isinstance(error, Exception) else " ".join(said.getvalue().split())
        raise FileError(
            f"meshio cannot read it ({why:.200}); write a table of points, .csv with the columns x, y (, z), as "
            "ParaView does with its filter Cell Centers"
        ) from error
    if not mesh.cells and not mesh.point_data:
        why = " ".join(said.getvalue().split())
        raise FileError(
            f"meshio finds no cells and no values at points in it ({why or 'it is empty'}); write a table of points, "
            ".csv with the columns x, y (, z), as ParaView does with its filter Cell Centers"
        )
    top = max((block.dim for block in mesh.cells), default=0)
    blocks = [k for k, block in enumerate(mesh.cells) if block.dim == top]
    in_cells = {name: [parts[k] for k in blocks] for name, parts in mesh.cell_data.items()}
    there = [*in_cells, *(n for n in mesh.point_data if n not in in_cells)]
    chosen = _chosen(wanted, there if wanted else in_cells or there)
    if all(name in in_cells for name in chosen):
        centers = np.concatenate([_centers(mesh.points, mesh.cells[k].data) for k in blocks])
        return _Found({n: np.concatenate(in_cells[n]).astype(float) for n in chosen}, centers)
    mixed = [name for name in chosen if name not in mesh.point_data]
    if mixed:
        raise FileError(f"{', '.join(mixed)} are in cells, the others at points; read them one after the other")
    return _Found({name: np.asarray(mesh.point_data[name], float) for name in chosen}, mesh.points)


def _centers(points: np.ndarray, cells: Sequence[Sequence[int]] | np.ndarray) -> np.ndarray:
    """Return the mean of the corners of each cell."""
    if isinstance(cells, np.ndarray):
        return points[cells].mean(axis=1)
    return np.array([points[np.asarray(cell)].mean(axis=0) for cell in cells])


def _on_mesh(name: str, found: _Found, domain: Domain | None) -> tuple[Diagram, dict[str, np.ndarray]]:
    """Return the mesh around the places of values inside the domain, and the values of its cells."""
    if found.mesh is not None:
        return found.mesh, found.values
    domain = found.domain if domain is None else domain
    if not isinstance(domain, Domain):
        given = "none" if domain is None else f"a {type(domain).__name__}"
        raise InputTypeError(f"domain is {given}, expected that to be adapted; give it, because {name} has none")
    assert found.places is not None
    if found.places.ndim != 2 or not len(found.places):
        raise InputError(f"{name} has points of shape {found.places.shape}, expected (n, {domain.dim}) numbers")
    bad = np.flatnonzero(~np.isfinite(found.places).all(axis=1))
    if len(bad):
        raise InputError(
            f"{name} has a point {found.places[bad[0]].tolist()}, expected finite numbers ({len(bad)} of "
            f"{len(found.places)} are not); leave these rows out"
        )
    x = domain.placed(name, found.places, found.on_globe)
    for key, rows in found.values.items():
        if len(rows) != len(x):
            raise InputError(f"{name}: {key} has {len(rows)} rows, expected {len(x)}: one for each point")
    size = float(domain.extent.max())
    on = domain.nearest(x)
    near = np.linalg.norm(on - x, axis=1) < _NEAR_WALL * size
    if near.sum() <= domain.dim:
        low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
        raise InputError(
            f"{name} has {len(x)} points from {low} to {high}, of which {near.sum()} are in {domain}, expected more "
            f"than {domain.dim}; do units and the order of the coordinates agree?"
        )
    for text in coverage_warnings(name, domain, x[near].min(axis=0), x[near].max(axis=0), "give values everywhere"):
        warn(text, MismatchWarning)
    x = domain.wrap(on[near])
    key = np.round((x - domain.lower) / (_SAME * size)).astype(np.int64)
    _, first, cell = np.unique(key, axis=0, return_index=True, return_inverse=True)
    cell, count = cell.ravel(), len(first)
    share = 1 / np.bincount(cell, minlength=count)
    values = {}
    for one, rows in found.values.items():
        columns = _of_dimension(rows[near].reshape(len(x), -1), domain.dim)
        mean = sum_rows(cell, columns, count) * share[:, None]
        values[one] = mean[:, 0] if rows.ndim == 1 else mean
    mesh = voronoi(domain, x[first])
    if mesh.home is not None:  # some cells of solids have several parts
        rows_of = np.where(mesh.home < 0, -1 - mesh.home, mesh.home)
        values = {one: rows[rows_of] for one, rows in values.items()}
    return mesh.with_arrays(centroids=mesh.points), values
