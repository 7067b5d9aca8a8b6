"""Files: save and load meshes, and write them for other programs.

Every writer works on a temporary file beside the target and renames it when it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..arguments import check_choice, check_path
from ..errors import InputError, InputTypeError
from ..finite_volumes.solver_mesh import WallShape, check_not_sphere
from ..geometry.sphere import Sphere
from ..mesh.diagram import Diagram
from ..mesh.output import MeshOutput
from ..mesh.results import Result
from .atomic import check_writable, make_folder
from .contents import Contents
from .disv import Disv, DisvBoundary, make_disv
from .foam import write_foam
from .formats import check_polygons, write_foreign
from .history import write_history
from .metis import write_metis
from .npz import load as load_npz
from .npz import write_npz
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

_WRITERS = {".npz": write_npz, ".info": write_metis, ".graph": write_metis}
CONVENTIONS: dict[str, Callable[[Contents, Path, str], None]] = {"ugrid": write_ugrid}
"""Writers of ``.nc`` files; `earth` adds those of its models."""
READERS: dict[str, Callable[[str | PathLike[str]], Result | Diagram]] = {".vtu": load_vtu}
"""Readers by suffix, besides that of ``.npz``; `earth` adds ``.nc``."""


def load(path: str | PathLike[str]) -> Result | Diagram:
    """Read a result or a diagram from a ``.npz`` or ``.vtu`` file of its `save`, or a mesh on a sphere from ``.nc``.

    A ``.npz`` file holds everything. A ``.vtu`` file holds cells, sizes, errors and quality: the graph is computed
    again, the history is empty, and a box without periodic directions is the bounding box of the cells. The file is not
    trusted: nothing in it is executed, sizes are compared with the bytes in the file before memory is allocated, and
    arrays must be consistent.

    A ``.nc`` file of a mesh on a sphere may also be of another program. Generators, cells, neighbors and the generators
    behind a boundary are those that were saved, up to round-off; the boundary has one name, and corners may have other
    numbers. Files by the MPAS mesh specification have no sizes, errors and quality. UGRID files have longitudes and
    latitudes of generators (the coordinates of faces); those of clvoro have sizes, errors and quality, too. SCRIP files
    have corners, and only those of clvoro have generators.

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
    return READERS.get(Path(path).suffix.lower(), load_npz)(path)


def save(mesh: Result | Diagram, path: str | PathLike[str], **options: Any) -> None:
    """Write a mesh to `path`; the suffix selects the format. The options are those of `Diagram.save`."""
    MeshOutput.save(mesh, path, **options)


def write_mesh(
    mesh: Result | Diagram,
    path: str | PathLike[str],
    cell_data: Mapping[str, ArrayLike] | None,
    walls: WallShape | None,
    for_foam: dict[str, Any],
    for_netcdf: dict[str, Any],
) -> None:
    """Write a mesh to `path`; the arguments are those of `Diagram.save`, in groups for each format."""
    contents = Contents.of(mesh, cell_data)
    path = Path(check_path("path", path))
    suffix = path.suffix.lower()
    if suffix != ".npz":
        contents.diagram.demand_cells(f"a {suffix or 'polyMesh'} file")
    is_foam = path.name == "polyMesh" or suffix == ".foam"
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
        check_not_sphere(
            contents.diagram,
            f"cannot write {path}: OpenFOAM's cells are polyhedra",
            "save as .nc with convention='mpas', or as .vtu",
        )
        if contents.extra:
            raise InputError(
                f"cannot write cell_data to {path}: OpenFOAM's polyMesh holds none; save as .vtu or leave it out"
            )
        write_foam(contents, path, **for_foam, walls=walls)
    elif suffix == ".nc":
        check_polygons(contents, path)
        convention, units = for_netcdf["convention"], for_netcdf["units"]
        unit = "m" if units is None else units
        if not isinstance(unit, str) or not unit.isascii() or not unit.strip():
            raise InputTypeError(f"units is {unit!r:.60}, expected a unit of length, such as 'm' or 'km'")
        if unit.startswith("degree") and isinstance(contents.diagram.domain, Sphere):
            raise InputError(
                f"units is {unit!r:.60}, expected on a sphere the unit of its radius, such as 'm' or 'km'; UGRID has "
                "degrees there anyway"
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
    diagram.demand_voronoi("to_fipy")
    check_not_sphere(
        diagram,
        "FiPy has cells in the plane and polyhedra",
        "save as .nc, or use diagram.faces, which has arcs of great circles",
    )
    try:
        from .fipy_mesh import make_fipy_mesh
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != "fipy":
            raise
        from .convert import missing

        raise missing("FiPy", "solvers", "to_fipy()") from error
    return make_fipy_mesh(diagram, walls)


def to_meshio(mesh: Result | Diagram, cell_data: Mapping[str, ArrayLike] | None = None) -> meshio.Mesh:
    """Return a mesh of meshio; see `Diagram.to_meshio`."""
    from .convert import to_meshio

    contents = Contents.of(mesh, cell_data)
    contents.diagram.demand_cells("to_meshio")
    return to_meshio(contents)


def to_pyvista(mesh: Result | Diagram, cell_data: Mapping[str, ArrayLike] | None = None) -> pyvista.UnstructuredGrid:
    """Return an unstructured grid of PyVista; see `Diagram.to_pyvista`."""
    from .convert import to_pyvista

    contents = Contents.of(mesh, cell_data)
    contents.diagram.demand_cells("to_pyvista")
    return to_pyvista(contents)


def _chosen(convention: object) -> Callable[[Contents, Path, str], None]:
    name = "ugrid" if convention is None else convention
    if not isinstance(name, str) or name not in CONVENTIONS:
        raise InputError(f"convention is {name!r:.60}, expected one of {', '.join(map(repr, CONVENTIONS))}")
    return CONVENTIONS[name]
