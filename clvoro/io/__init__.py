"""Files: save and load meshes, and write them for other programs.

Every writer works on a temporary file beside the target and renames it when it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from ..arguments import check_path
from ..errors import InputError, InputTypeError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .atomic import check_writable, make_folder
from .cgns import write_cgns
from .contents import Contents
from .convert import check_polygons, write_foreign, write_history, write_metis, write_partition
from .disv import Disv, DisvBoundary
from .foam import write_foam
from .npz import load as load_npz
from .npz import write_npz
from .ugrid import write_ugrid
from .vtu import write_pvtu, write_vtu
from .vtu_read import load_vtu

__all__ = ["Disv", "DisvBoundary", "check_writable", "load", "make_folder", "save", "write", "write_history"]

CONVENTIONS: dict[str, Callable[[Contents, Path, str], None]] = {"ugrid": write_ugrid}
"""Writers of ``.nc`` files; `earth` adds those of its models."""
READERS: dict[str, Callable[[str | PathLike[str]], Result | Diagram]] = {".vtu": load_vtu}
"""Readers by suffix, besides that of ``.npz``; `earth` adds ``.nc``, and `shared` ``.pvtu`` and ``.foam``."""


def load(path: str | PathLike[str]) -> Result | Diagram:
    """Read a result or a diagram from a ``.npz``, ``.vtu`` or ``.pvtu`` file of its `save`, or a sphere from ``.nc``.

    A ``.npz`` file holds everything. A ``.vtu`` file holds domain, cells, neighbors, sizes, errors and quality: other
    measures are computed again, and the history is empty. The file is not trusted: nothing in it is executed, sizes are
    compared with the bytes in the file before memory is allocated, and arrays must be consistent.

    A ``.pvtu`` file and its pieces hold the mesh of all ranks. Cells are made again on the best device, and are in the
    order of ranks. ``CASE/mesh.foam`` of a decomposed case of OpenFOAM that clvoro wrote is read as a diagram, from the
    generators beside the meshes of processors.

    A ``.nc`` file of a mesh on a sphere may also be of another program. Generators, cells, neighbors and the generators
    behind a boundary are those that were saved, up to round-off; the boundary has one name, and corners may have other
    numbers. Files by the MPAS mesh specification have no sizes, errors and quality. UGRID files have longitudes and
    latitudes of generators (the coordinates of faces); those of clvoro have sizes, errors and quality, too.

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


def save(
    mesh: Result | Diagram,
    path: str | PathLike[str],
    *,
    cell_data: Mapping[str, ArrayLike] | None = None,
    **others: object,
) -> None:
    """Write a mesh in any domain to `path`; the suffix selects the format; see `Diagram.save`."""
    for name in others:
        fits = [_METHODS[kind] for kind, names in _OPTIONS.items() if name in names]
        remedy = "write " + " or ".join(f"mesh.{method}(path, {name}=...)" for method in fits)
        raise InputTypeError(
            f"save has no option {name!r}, expected path and cell_data; {remedy if fits else 'leave it out'}"
        )
    write(mesh, path, cell_data)


def write(
    mesh: Result | Diagram,
    path: str | PathLike[str],
    cell_data: Mapping[str, ArrayLike] | None = None,
    kind: str | None = None,
    **options: Any,
) -> None:
    """Write a mesh to `path` with `options` of its format; see `Diagram.save`, `to_openfoam`, `to_netcdf`, `to_vtu`.

    - `mesh`: in a box, a polygon or a solid, or on a sphere.
    - `kind` {".foam", ".nc", ".vtu"}: the format that is meant. By default that of `path`.
    - `**options`: those that are None are left out.

    Raises `InputError` or `InputTypeError` if the format is unknown, another than `kind`, or cannot hold the cells, an
    option is wrong or for another format, or the file cannot be written. An existing file is then unchanged.
    """
    contents = Contents.of(mesh, cell_data)
    path = Path(check_path("path", path))
    suffix = ".foam" if path.name == "polyMesh" else path.suffix.lower()
    suffix = ".part" if Path(path.stem).suffix == ".part" and suffix[1:].isdecimal() else suffix
    if kind not in (None, suffix):
        ends = _ENDS[kind]
        raise InputError(f"cannot write {path} as {_KINDS[kind]}, expected a name that ends in {ends}; or use save")
    given = {name: value for name, value in options.items() if value is not None}
    for name in given:
        if name not in _OPTIONS.get(suffix, ()):
            fits = [of for of, names in _OPTIONS.items() if name in names]
            raise InputError(
                f"cannot write {path} with {name}, which is for {' and '.join(_KINDS[of] for of in fits)}; save as "
                f"{' or '.join(fits)} or leave it out"
            )
    parts = None if contents.result is None else contents.result.parts
    if contents.result is not None and parts is not None and suffix in _GATHERED:
        if suffix == ".foam" or path.suffix == f".{parts.count}":
            given = {"processors": parts.owners(), **given}
        whole = parts.gather(contents.result)
        parts.together(
            lambda: None if whole is None else _WRITERS[suffix](Contents.of(whole, cell_data), path, **given)
        )
        return
    if suffix != ".npz":
        contents.diagram.demand_cells(f"a {suffix} file")
    _WRITERS.get(suffix, write_foreign)(contents, path, **given)


def _write_netcdf(contents: Contents, path: Path, convention: str = "ugrid", units: str = "m") -> None:
    """Write a netCDF file; see `Diagram.to_netcdf`."""
    check_polygons(contents, path)
    if not isinstance(units, str) or not units.isascii() or not units.strip():
        raise InputTypeError(f"units is {units!r:.60}, expected a unit of length, such as 'm' or 'km'")
    if units.startswith("degree") and contents.diagram.domain.curved:
        raise InputError(
            f"units is {units!r:.60}, expected on a sphere the unit of its radius, such as 'm' or 'km'; UGRID has "
            "degrees there anyway"
        )
    if not isinstance(convention, str) or convention not in CONVENTIONS:
        raise InputError(f"convention is {convention!r:.60}, expected one of {', '.join(map(repr, CONVENTIONS))}")
    CONVENTIONS[convention](contents, path, units)


_WRITERS: dict[str, Callable[..., None]] = {
    ".npz": write_npz,
    ".vtu": write_vtu,
    ".pvtu": write_pvtu,
    ".foam": write_foam,
    ".cgns": write_cgns,
    ".nc": _write_netcdf,
    ".info": write_metis,
    ".graph": write_metis,
    ".part": write_partition,
}
_GATHERED = (".foam", ".info", ".graph", ".part")
"""What rank 0 writes for all ranks of MPI."""
_KINDS = {".foam": "OpenFOAM", ".nc": "netCDF", ".vtu": ".vtu"}
_ENDS = {".foam": ".foam, or the folder polyMesh of a case", ".nc": ".nc", ".vtu": ".vtu"}
_METHODS = {".foam": "to_openfoam", ".nc": "to_netcdf", ".vtu": "to_vtu"}
_OPTIONS = {
    ".foam": ("patches", "types", "thickness", "binary", "walls", "zones", "check", "processors"),
    ".nc": ("convention", "units"),
    ".vtu": ("walls",),
}
"""Options of the writers that have some."""
