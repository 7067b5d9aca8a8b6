"""Files: save and load results, write meshes for other programs.

Every writer works on a temporary file beside the target and puts it in place when it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path

from ..arguments import check_path
from ..errors import InputError, InputTypeError
from ..geometry.boundary_names import Walls
from ..mesh.results import Result
from .atomic import check_writable, make_folder
from .foam import write_foam
from .formats import check_plane, write_foreign
from .history import write_history
from .mpas import write_mpas
from .npz import load as load_npz
from .npz import write_npz
from .ugrid import write_ugrid
from .vtu import write_vtu
from .vtu_read import load_vtu

__all__ = ["check_writable", "load", "make_folder", "save", "write_history"]

_WRITERS = {".npz": write_npz, ".vtu": write_vtu}
_CONVENTIONS = {"ugrid": write_ugrid, "mpas": write_mpas}


def load(path: str | PathLike[str]) -> Result:
    """Read a result that `Result.save` wrote to a ``.npz`` or ``.vtu`` file.

    A ``.npz`` file holds everything. A ``.vtu`` file holds cells, sizes, errors and quality: the graph is made anew,
    the history is empty, and a plain box is taken as the bounding box of the cells. The file is not trusted: nothing in
    it is executed, sizes are compared with the bytes that are there before memory is asked for, and the arrays must fit
    each other.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the file is missing, damaged, cut off, of another format or of a newer version; names the file and what is
        wrong.

    """
    path = check_path("path", path)
    if Path(path).suffix.lower() == ".nc":
        raise InputError(
            f"cannot load {path}: netCDF files are written for other programs and not read; load a .npz or .vtu"
        )
    return (load_vtu if Path(path).suffix.lower() == ".vtu" else load_npz)(path)


def save(
    result: Result,
    path: str | PathLike[str],
    *,
    patches: Mapping[str, Walls] | None = None,
    convention: str | None = None,
) -> None:
    """Write `result` to `path`; the suffix chooses the format.

    Parameters
    ----------
    result : Result
    path : str or path
        ``.npz`` holds everything and is read back by `load`; ``.vtu`` is for ParaView and other VTK
        programs (polygons or polyhedra with h, error, quality and more as cell data);
        ``.../constant/polyMesh`` is a folder for OpenFOAM, and ``CASE/name.foam`` the same within a
        case, for ParaView, too, both made if need be (2D: one layer of prisms between patches of type `empty`; seams of
        periodic boxes: pairs of cyclic patches); ``.nc`` holds 2D meshes as netCDF, for models of oceans and
        atmospheres, QGIS, ParaView and xarray; ``.vtk``, ``.ply`` and ``.obj`` hold 2D meshes and are written
        through meshio (``pip install "clvoro[formats]"``), the latter two without cell data.
    patches : mapping, optional
        For OpenFOAM: names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls
        that are not mentioned keep the name that the domain gives them.
    convention : {"ugrid", "mpas"}, optional
        For netCDF: what is in the file. With "ugrid", the default, cells as polygons with size, error, quality and
        area, and for each edge the number of its wall; at seams as in ``.vtu``. With "mpas" what the MPAS mesh
        specification asks for: cells, edges and vertices with all that models on C grids take, seams joined.

    Raises
    ------
    InputError
        If the format is unknown or cannot hold the cells, or the file cannot be written. An existing
        file is then as before.
    """
    if not isinstance(result, Result):
        raise InputTypeError(
            f"result is a {type(result).__name__}, expected a clvoro.Result; pass what "
            "Adapter.run returned"
        )
    path = Path(check_path("path", path))
    suffix = path.suffix.lower()
    is_foam = path.name == "polyMesh" or suffix == ".foam"
    if patches is not None and not is_foam:
        raise InputError(
            f"cannot write patches to {path}: they are for OpenFOAM; save as .foam or leave them out"
        )
    if convention is not None and suffix != ".nc":
        raise InputError(
            f"cannot write {path} by a convention: they are for netCDF; save as .nc or leave it out"
        )
    if is_foam:
        write_foam(result, path, patches)
    elif suffix == ".nc":
        check_plane(result, path)
        _chosen(convention)(result, path)
    else:
        _WRITERS.get(suffix, write_foreign)(result, path)


def _chosen(convention: object) -> Callable[[Result, Path], None]:
    name = "ugrid" if convention is None else convention
    if not isinstance(name, str) or name not in _CONVENTIONS:
        raise InputError(f"convention is {name!r:.60}, expected 'ugrid' or 'mpas'")
    return _CONVENTIONS[name]
