"""Read meshes on a sphere from netCDF files by MPAS, UGRID or SCRIP, of clvoro and of other programs.

A file is not trusted: indices are checked before they are used, and nothing in it is executed.
"""

from __future__ import annotations

import os
from os import PathLike

import numpy as np
import scipy

from ...errors import InputError
from ...files import open_plain
from ...io.arrays import FileError
from ...mesh.diagram import Diagram
from ...mesh.results import HISTORY_DTYPE, Result
from .cells import MeshInFile, make_diagram
from .conventions import READERS, Variables

_HDF5 = b"\x89HDF"


def load_netcdf(path: str | PathLike[str]) -> Result | Diagram:
    """Read the cells of a mesh on a sphere from a file by the MPAS mesh specification, UGRID or SCRIP.

    Neighbors, areas, arcs and centroids are computed from generators and corners. A UGRID file of a `Result` gives a
    `Result`; others give a `Diagram`.

    Raises
    ------
    InputError
        If the file is missing, damaged, of another format, of a mesh in the plane, or without generators; names the
        file and the fault.
    """
    name = os.fspath(path)
    try:
        with open_plain(path) as file:
            head = file.read(4)
            if head == _HDF5:
                raise FileError("it is netCDF-4, expected netCDF-3; convert it by `nccopy -k nc6 FILE NEW`")
            file.seek(0)
            with scipy.io.netcdf_file(file, mmap=False) as found:
                cells = _read(Variables(found))
        diagram = make_diagram(cells)
    except FileError as problem:
        raise InputError(f"cannot read {name}: {problem}") from problem
    except OSError as error:
        raise InputError(f"cannot read {name}: {error.strerror or error}") from error
    except Exception as error:  # of SciPy's reader, on damaged files
        raise InputError(f"cannot read {name}: it is damaged or no netCDF-3 ({error})") from error
    if cells.of_run is None:
        return diagram
    size, error, quality = cells.of_run
    return Result(
        points=diagram.points,
        diagram=diagram,
        target_size=size,
        size_error=error,
        quality=quality,
        history=np.zeros(0, HISTORY_DTYPE),
        converged=False,
        stop_reason="read from a .nc file",
    )


def _read(file: Variables) -> MeshInFile:
    for reader in READERS:
        cells = reader(file)
        if cells is not None:
            return cells
    raise FileError("it has no mesh by MPAS, UGRID or SCRIP")
