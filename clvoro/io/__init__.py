"""Files: save and load results, write meshes for other programs.

Every writer works on a temporary file beside the target and puts it in place when it is complete.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path

from .._arrays import check_path
from ..errors import InputError, InputTypeError
from ..results import Result
from .atomic import check_writable
from .foam import write_foam
from .formats import write_foreign
from .history import write_history
from .npz import load as load_npz
from .npz import write_npz
from .vtu import write_vtu
from .vtu_read import load_vtu

__all__ = ["check_writable", "load", "save", "write_history"]

_WRITERS = {".npz": write_npz, ".vtu": write_vtu}


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
    return (load_vtu if Path(path).suffix.lower() == ".vtu" else load_npz)(path)


def save(
    result: Result,
    path: str | PathLike[str],
    *,
    patches: Mapping[str, Iterable[int]] | None = None,
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
        periodic boxes: pairs of cyclic patches); ``.vtk``, ``.ply`` and ``.obj`` hold 2D meshes and are written
        through meshio (``pip install "clvoro[formats]"``), the latter two without cell data.
    patches : mapping, optional
        For OpenFOAM and a polygonal domain: names of patches, and the numbers of the edges in each, as in
        `Polygon.edge_numbers`. Edges in none are in the patch of their ring, ``outer``, ``hole-1``, ...

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
    if path.name == "polyMesh" or path.suffix.lower() == ".foam":
        write_foam(result, path, patches)
        return
    if patches is not None:
        raise InputError(
            f"cannot write patches to {path}: they are for OpenFOAM; save as .foam or leave them out"
        )
    _WRITERS.get(path.suffix.lower(), write_foreign)(result, path)
