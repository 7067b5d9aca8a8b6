"""Files: save and load meshes, and write them for other programs.

Every writer works on a temporary file beside the target and renames it when it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..arguments import check_choice, check_path
from ..errors import InputError, InputTypeError
from ..finite_volumes.solver_mesh import WallShape
from ..geometry.boundary_names import Walls
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .atomic import check_writable, make_folder
from .contents import Contents
from .disv import Disv, DisvBoundary, make_disv
from .foam import write_foam
from .formats import check_plane, write_foreign
from .history import write_history
from .mpas import write_mpas
from .npz import load as load_npz
from .npz import write_npz
from .polymesh import PatchType
from .ugrid import write_ugrid
from .vtu import write_vtu
from .vtu_read import load_vtu

if TYPE_CHECKING:
    import meshio
    import pyvista
    from numpy.typing import ArrayLike

    from .fipy_mesh import VoronoiMesh2D, VoronoiMesh3D

__all__ = [
    "Disv",
    "DisvBoundary",
    "check_writable",
    "load",
    "make_folder",
    "save",
    "to_disv",
    "to_fipy",
    "to_meshio",
    "to_pyvista",
    "write_history",
]

_WRITERS = {".npz": write_npz}
_CONVENTIONS = {"ugrid": write_ugrid, "mpas": write_mpas}


def load(path: str | PathLike[str]) -> Result | Diagram:
    """Read a result or a diagram from a ``.npz`` or ``.vtu`` file of its `save`.

    A ``.npz`` file holds everything. A ``.vtu`` file holds cells, sizes, errors and quality: the graph is computed
    again, the history is empty, and a box without periodic directions is the bounding box of the cells. The file is not
    trusted: nothing in it is executed, sizes are compared with the bytes in the file before memory is allocated, and
    arrays must be consistent.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    Result or Diagram
        The object that was saved.

    Raises
    ------
    InputError
        If the file is missing, damaged, truncated, of another format or of a newer version; names the file and the
        fault.
    """
    path = check_path("path", path)
    if Path(path).suffix.lower() == ".nc":
        raise InputError(
            f"cannot load {path}: clvoro writes netCDF for other programs only, expected a .npz or .vtu file"
        )
    return (load_vtu if Path(path).suffix.lower() == ".vtu" else load_npz)(path)


def save(
    mesh: Result | Diagram,
    path: str | PathLike[str],
    *,
    cell_data: Mapping[str, ArrayLike] | None = None,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
    walls: WallShape | None = None,
    convention: Literal["ugrid", "mpas"] | None = None,
    units: str | None = None,
) -> None:
    """Write a mesh to `path`; the suffix chooses the format.

    ``.npz``
        Everything; `load` reads it.
    ``.vtu``
        For ParaView and other VTK programs, and for `load`: polygons or polyhedra with size, error, quality, boundary
        and more as cell data; row i is cell i of the mesh. VTK's `vtkCellSizeFilter` (PyVista's `compute_cell_sizes`)
        is wrong for cells that are not convex, as there are along the boundary of a polygon: use the cell data
        `volume`. meshio 5.3 reads a mesh in 2D as one block of cells for each run of cells with equally many corners;
        a ``.vtk`` file has one block for each number of corners. In 3D it refuses most files, as its reader assigns
        cell data to the wrong blocks of polyhedra.
    ``.../constant/polyMesh`` or ``CASE/name.foam``
        A folder for OpenFOAM, alone or within a case that ParaView opens, too. In 2D one layer of prisms between
        patches of type `empty`. Each periodic direction is one pair of cyclic patches;
        with several of them, these are for OpenFOAM of openfoam.com.
    ``.nc``
        Meshes in 2D as netCDF, for models of oceans and atmospheres, QGIS, ParaView and xarray.
    ``.vtk``, ``.ply``, ``.obj``
        Meshes in 2D, written by meshio (``pip install "clvoro[formats]"``); the latter two without cell data. Cells are
        sorted by their number of corners; in ``.vtk`` the cell data `label` is the row in the mesh.

    Parameters
    ----------
    mesh : Result or Diagram
        The file of a diagram has no sizes, errors and history.
    path : str or path
    cell_data : mapping, optional
        Data of your own by name, (n,) or (n, k) arrays of real numbers: cell data in ``.vtu`` and ``.vtk``, variables
        in ``.nc``, members ``cell_data.<name>`` in ``.npz``, which `load` leaves out. Other formats hold none.
    patches : mapping, optional
        For OpenFOAM: names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls
        that are not mentioned keep the name that the domain gives them.
    types : mapping, optional
        For OpenFOAM: type of each patch by name, "wall" (the default), "patch", "symmetry" or "symmetryPlane". Inlets,
        outlets and far fields need "patch": ``types={"inlet": "patch"}``.
    thickness : float, optional
        For OpenFOAM and a mesh in 2D: height of the layer of prisms. By default the mean width of a cell.
    walls : {"straight", "exact"}, optional
        For OpenFOAM and ``.vtu``. With "straight", the default for OpenFOAM, the file has the cells of
        `Diagram.solver_mesh`: the faces of a cell on the boundary become one straight face where they turn by at most
        30 degrees in sum, face ends near a corner of the domain move into it, and short edges are collapsed. Solvers
        reject cells that are not convex. `load` does not read such a ``.vtu`` file. With "exact", the default for
        ``.vtu``, all faces are those of the diagram, as in all other formats.
    convention : {"ugrid", "mpas"}, optional
        For netCDF. With "ugrid", the default: cells as polygons with size, error, quality and area, and for each edge
        the number of its wall and its boundary; at seams as in ``.vtu``. With "mpas": cells, edges and vertices with
        all variables of the MPAS mesh specification for C grids; cells at seams are connected.
    units : str, optional
        For netCDF: unit of the coordinates, as UDUNITS writes it. By default "m". In UGRID, "degrees" stands for
        longitudes and latitudes.

    Raises
    ------
    InputError, InputTypeError
        If the format is unknown or cannot hold the cells, an argument is wrong or for another format, or the file
        cannot be written. An existing file is then unchanged.
    """
    contents = Contents.of(mesh, cell_data)
    path = Path(check_path("path", path))
    suffix = path.suffix.lower()
    is_foam = path.name == "polyMesh" or suffix == ".foam"
    for_foam = {"patches": patches, "types": types, "thickness": thickness}
    for_netcdf = {"convention": convention, "units": units}
    for options, fits, format_, name in (
        (for_foam, is_foam, "OpenFOAM", ".foam"),
        (for_netcdf, suffix == ".nc", "netCDF", ".nc"),
    ):
        given = [key for key, value in options.items() if value is not None]
        if given and not fits:
            raise InputError(
                f"cannot write {path} with {given[0]}, which is for {format_}; save as {name} or leave it out"
            )
    if walls is not None:
        check_choice("walls", walls, ("straight", "exact"))
        if not is_foam and suffix != ".vtu":
            raise InputError(
                f"cannot write {path} with walls, which is for OpenFOAM and .vtu; save as .foam or leave it out"
            )
    if is_foam:
        if contents.extra:
            raise InputError(
                f"cannot write cell_data to {path}: OpenFOAM's polyMesh holds none; save as .vtu or leave it out"
            )
        write_foam(contents, path, **for_foam, walls=walls)
    elif suffix == ".nc":
        check_plane(contents, path)
        unit = "m" if units is None else units
        if not isinstance(unit, str) or not unit.isascii() or not unit.strip():
            raise InputTypeError(
                f"units is {unit!r:.60}, expected a unit of length, such as 'm' or 'km'"
            )
        _chosen(convention)(contents, path, unit)
    elif suffix == ".vtu":
        write_vtu(contents, path, walls=walls)
    else:
        _WRITERS.get(suffix, write_foreign)(contents, path)


def to_disv(mesh: Result | Diagram, walls: WallShape = "straight") -> Disv:
    """Return the grid of MODFLOW 6's DISV package; see `Diagram.to_disv`."""
    return make_disv(Contents.of(mesh).diagram, walls)


def to_fipy(mesh: Result | Diagram, walls: WallShape = "straight") -> VoronoiMesh2D | VoronoiMesh3D:
    """Return a mesh of FiPy; see `Diagram.to_fipy`."""
    diagram = Contents.of(mesh).diagram
    try:
        from .fipy_mesh import make_fipy_mesh
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != "fipy":
            raise
        from .convert import missing

        raise missing("FiPy", "solvers", "to_fipy()") from error
    return make_fipy_mesh(diagram, walls)


def to_meshio(
    mesh: Result | Diagram, cell_data: Mapping[str, ArrayLike] | None = None
) -> meshio.Mesh:
    """Return a mesh of meshio; see `Diagram.to_meshio`."""
    from .convert import to_meshio

    return to_meshio(Contents.of(mesh, cell_data))


def to_pyvista(
    mesh: Result | Diagram, cell_data: Mapping[str, ArrayLike] | None = None
) -> pyvista.UnstructuredGrid:
    """Return an unstructured grid of PyVista; see `Diagram.to_pyvista`."""
    from .convert import to_pyvista

    return to_pyvista(Contents.of(mesh, cell_data))


def _chosen(convention: object) -> Callable[[Contents, Path, str], None]:
    name = "ugrid" if convention is None else convention
    if not isinstance(name, str) or name not in _CONVENTIONS:
        raise InputError(f"convention is {name!r:.60}, expected 'ugrid' or 'mpas'")
    return _CONVENTIONS[name]
