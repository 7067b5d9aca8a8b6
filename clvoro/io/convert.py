"""Diagrams for other programs: meshio and the formats that it writes, PyVista, METIS, tables of the history."""

from __future__ import annotations

import contextlib
import csv
import io
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..connectivity import starts_of
from ..errors import ClvoroError, InputError, MissingLibraryError
from ..geometry.domain import Domain, images_in
from ..mesh.results import Result
from .atomic import atomic_file, atomic_folder
from .contents import Contents
from .foam_parts import processors_of
from .vtu import KINDS, cell_data, in_space, polyhedra

if TYPE_CHECKING:
    import meshio
    import pyvista
    from numpy.typing import ArrayLike

    from ..finite_volumes.solver_mesh import WallShape
    from ..mesh.diagram import Diagram
    from .fipy_mesh import VoronoiMesh2D, VoronoiMesh3D


def missing(library: str, extra: str, what: str) -> MissingLibraryError:
    """Return the error for an optional library that is not installed."""
    return MissingLibraryError(f"{what} needs {library}, which is not installed; run `pip install 'clvoro[{extra}]'`")


def to_meshio(contents: Contents, with_data: bool = True) -> meshio.Mesh:
    """Return a mesh of meshio; see `Diagram.to_meshio`."""
    try:
        import meshio
    except ModuleNotFoundError as error:
        raise missing("meshio", "formats", "to_meshio()") from error
    diagram = contents.diagram
    diagram.demand_cells("to_meshio")
    blocks, rows = _BLOCKS[diagram.domain.cell_dim](diagram)
    data = cell_data(contents) if with_data else {}
    return meshio.Mesh(
        in_space(diagram.vertices), blocks, cell_data={name: [_known(v)[k] for k in rows] for name, v in data.items()}
    )


def to_fipy(diagram: Diagram, walls: WallShape) -> VoronoiMesh2D | VoronoiMesh3D:
    """Return a mesh of FiPy; see `Diagram.to_fipy`."""
    diagram.demand_voronoi("to_fipy")
    diagram.domain.require_flat(
        "FiPy has cells in the plane and polyhedra",
        "save as .nc, or use diagram.faces, which has arcs of great circles",
    )
    try:
        from .fipy_mesh import make_fipy_mesh
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != "fipy":
            raise
        raise missing("FiPy", "solvers", "to_fipy()") from error
    return make_fipy_mesh(diagram, walls)


def to_pyvista(contents: Contents, cut: bool = False) -> pyvista.UnstructuredGrid:
    """Return an unstructured grid of PyVista, perhaps `cut` at the box; see `Diagram.to_pyvista`."""
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise missing("PyVista", "pyvista", "to_pyvista()") from error
    diagram = contents.diagram
    diagram.demand_cells("to_pyvista")
    kind = KINDS[diagram.domain.cell_dim]
    ends, items = (kind.topology(diagram)[name] for name in kind.stream)
    starts = np.concatenate([[0], ends])
    # The number of items precedes the items of each cell.
    cells = np.insert(items.astype(np.int64), starts[:-1], np.diff(starts))
    grid = pyvista.UnstructuredGrid(cells, np.full(len(diagram), kind.number, np.uint8), in_space(diagram.vertices))
    for name, values in cell_data(contents).items():
        grid.cell_data[name] = np.array(values)
    return _cut(grid, diagram.domain) if cut and any(diagram.domain.periodic) else grid


def _cut(grid: pyvista.UnstructuredGrid, domain: Domain) -> pyvista.UnstructuredGrid:
    """Return the cells cut at the periodic sides of the box, with their images, which fill it."""
    box = np.array([domain.lower, domain.upper])
    corners = np.asarray(grid.points)[grid.cell_connectivity, : domain.dim]
    low, high = (bound.reduceat(corners, grid.cell_offsets[:-1], axis=0) for bound in (np.minimum, np.maximum))
    parts = []
    for rows, by in images_in(domain, low, high, box):
        if len(rows):
            parts.append(grid.extract_cells(rows).translate(in_space(by[None])[0], inplace=False))
    return cut_at_sides(parts, domain)


def cut_at_sides(parts: list[Any], domain: Domain) -> pyvista.UnstructuredGrid:
    """Return the cells of all `parts`, cut at the periodic sides of the box."""
    import pyvista

    alone = (*parts, pyvista.UnstructuredGrid())[0]
    whole: Any = pyvista.merge(parts, merge_points=False) if len(parts) > 1 else alone
    sides = in_space(np.array([domain.lower, domain.upper]))
    return _CLIPS[domain.cell_dim](whole, np.flatnonzero(domain.periodic), sides)


def _clip_polygons(grid: Any, axes: np.ndarray, sides: np.ndarray) -> pyvista.UnstructuredGrid:
    """Return convex polygons between the `sides` (2, 3) across each axis; `clip` would divide them into triangles."""
    import pyvista
    from vtkmodules.vtkCommonDataModel import vtkPlane
    from vtkmodules.vtkFiltersCore import vtkPolyDataPlaneClipper

    whole: Any = pyvista.PolyData(grid.points, faces=grid.cells)
    whole.cell_data["row"] = np.arange(grid.n_cells, dtype=float)  # VTK makes floats of integers
    for axis in axes:
        for side, sign in zip(sides, (1.0, -1.0), strict=True):
            plane, clipper = vtkPlane(), vtkPolyDataPlaneClipper()
            plane.SetOrigin(*side)
            plane.SetNormal(*sign * np.eye(3)[axis])
            clipper.SetInputData(whole)
            clipper.SetPlane(plane)
            clipper.CappingOff()
            clipper.Update()
            whole = pyvista.wrap(clipper.GetOutput())
    rows = np.asarray(whole.cell_data.pop("row")).astype(int)
    for name, values in grid.cell_data.items():
        whole.cell_data[name] = values[rows]
    return whole.cast_to_unstructured_grid()


def _clip_polyhedra(grid: Any, axes: np.ndarray, sides: np.ndarray) -> pyvista.UnstructuredGrid:
    """Return polyhedra between the `sides` (2, 3) across each axis."""
    for axis in axes:
        grid = grid.clip("xyz"[axis], origin=sides[0], invert=False).clip("xyz"[axis], origin=sides[1])
    return grid


_CLIPS = {2: _clip_polygons, 3: _clip_polyhedra}


def _polygons(diagram: Diagram) -> tuple[list[Any], list[np.ndarray]]:
    """Return meshio's blocks in 2D, one per number of corners, and the cells in each."""
    starts = diagram.cell_vertex_starts
    corners = np.diff(starts)
    names = {3: "triangle", 4: "quad"}
    blocks, rows = [], []
    for k in np.unique(corners):
        cells = np.flatnonzero(corners == k)
        of_cells = diagram.cell_vertices[starts[cells][:, None] + np.arange(k)]
        blocks.append((names.get(int(k), "polygon"), of_cells))
        rows.append(cells)
    return blocks, rows


def _polyhedra(diagram: Diagram) -> tuple[list[Any], list[np.ndarray]]:
    """Return meshio's blocks in 3D, one per number of corners, and the cells in each."""
    starts = diagram.face_vertex_starts
    faces = np.split(diagram.face_vertices, starts[1:-1])
    first = diagram.neighbor_starts
    corners = np.diff(np.concatenate([[0], polyhedra(diagram)["offsets"]]))
    blocks, rows = [], []
    for k in np.unique(corners):
        cells = np.flatnonzero(corners == k)
        of_cells = [[f for f in faces[first[i] : first[i + 1]] if len(f) > 2] for i in cells]
        blocks.append((f"polyhedron{k}", of_cells))
        rows.append(cells)
    return blocks, rows


_BLOCKS = {2: _polygons, 3: _polyhedra}


def _known(values: np.ndarray) -> np.ndarray:
    """Return integers in 64 bits: VTK does not read the name that meshio writes for 32 bits."""
    return values.astype(np.int64) if values.dtype.kind == "i" else values


# Formats in which meshio writes polygons with any number of sides. In others it drops them with a warning only. The
# value says whether it writes cell data, too.
_POLYGONS = {".vtk": True, ".ply": False, ".obj": False}

_SAFE = (
    ".npz (everything), .vtu (ParaView), .foam (OpenFOAM), .cgns, .nc (QGIS, UGRID, MPAS), .info (METIS), .vtk, .ply "
    "or .obj"
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


_CHUNK = 1 << 16


def write_metis(contents: Contents, path: Path) -> None:
    """Write the neighbors of each cell: METIS' graph format, MPAS' `graph.info`.

    The first line has the numbers of cells and of pairs of neighbors. Line i + 1 has the neighbors of the i-th cell,
    counted from 1, ascending. Neighbors share a face that has a measure; each is listed once, and no cell is its own
    neighbor, as METIS requires.

    Raises `InputError` if there are data of the caller, which the format does not hold.
    """
    if contents.extra:
        raise InputError(f"cannot write cell_data to {path}: a graph for METIS holds none; save as .nc or leave it out")
    faces, n = contents.diagram.faces, len(contents.diagram)
    i, j = (ends[: faces.n_inner].astype(np.int64) for ends in (faces.owner, faces.neighbor))
    pairs = np.unique(np.concatenate([i * n + j, j * n + i]))
    pairs = pairs[pairs // n != pairs % n]
    starts = starts_of(np.bincount(pairs // n, minlength=n))
    neighbors = pairs % n + 1
    with atomic_file(path) as file:
        file.write(f"{n} {len(pairs) // 2}\n".encode())
        for first in range(0, n, _CHUNK):
            rows = starts[first : first + _CHUNK + 1]
            form = "".join(" ".join(["%d"] * k) + "\n" for k in np.diff(rows).tolist())
            file.write((form % tuple(neighbors[rows[0] : rows[-1]].tolist())).encode())


def write_partition(contents: Contents, path: Path, processors: ArrayLike | None = None) -> None:
    """Write the processor of each cell, a number per line: the file of METIS, as ``graph.info.part.8`` for 8 of them.

    `processors` (n,) int are these; by default parts of equal numbers of cells, divided by planes.

    Raises `InputError` if there are data of the caller, or fewer cells than processors.
    """
    if contents.extra:
        raise InputError(f"cannot write cell_data to {path}, which has the processor of each cell; leave it out")
    part = processors_of(int(path.suffix[1:]) if processors is None else processors, contents.diagram.points)
    with atomic_file(path) as file:
        file.write(("%d\n" * len(part) % tuple(part.tolist())).encode())


def write_history(result: Result, path: str | PathLike[str]) -> None:
    """Write `result.history` as CSV: a line of names, then one line per step.

    Floats have as many digits as are needed to read them back exactly.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with atomic_file(path) as file:
        text = io.TextIOWrapper(file, encoding="ascii", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(result.history.dtype.names or ())
        writer.writerows(result.history.tolist())
        text.flush()
        text.detach()
