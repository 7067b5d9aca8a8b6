"""Formats of other programs, through meshio."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..mesh.results import Result
from .atomic import atomic_folder
from .vtu import cell_data, in_space

# Formats in which meshio keeps polygons of any number of sides: it drops them from others with no
# more than a warning. The value tells whether cell data are kept, too.
_POLYGONS = {".vtk": True, ".ply": False, ".obj": False}

_SAFE = (
    ".npz (everything), .vtu (ParaView), .foam (OpenFOAM), .nc (UGRID, MPAS), .vtk, .ply or .obj"
)


def write_foreign(result: Result, path: Path) -> None:
    """Write the cells in the format that the suffix of `path` names."""
    suffix = path.suffix.lower()
    if suffix not in _POLYGONS:
        what = f"the format {suffix} is unknown or cannot hold" if suffix else "no suffix chooses"
        tail = " polygons" if suffix else " a format"
        raise InputError(f"cannot write {path}: {what}{tail}; use {_SAFE}")
    check_plane(result, path)
    try:
        import meshio
    except ImportError as error:
        raise InputError(
            f'cannot write {path}: {suffix} needs meshio; run `pip install "clvoro[formats]"`, or '
            "save as .vtu or .npz"
        ) from error
    blocks, order = _by_sides(result)
    data = cell_data(result) if _POLYGONS[suffix] else {}
    mesh = meshio.Mesh(
        in_space(result.diagram.vertices),
        [*blocks],
        cell_data={name: [_known(v)[i] for i in order] for name, v in data.items()},
    )
    # meshio prints to the terminal; what matters of it arrives as an exception.
    with atomic_folder(path) as temporary, contextlib.redirect_stdout(io.StringIO()):
        mesh.write(temporary)


def check_plane(result: Result, path: Path) -> None:
    """Refuse a mesh in three dimensions."""
    if result.diagram.domain.dim != 2:
        raise InputError(
            f"cannot write {path}: the mesh has {result.diagram.domain.dim} dimensions, and only 2 "
            f"are written to {path.suffix.lower()}; save it as .vtu, .foam or .npz"
        )


def _by_sides(result: Result) -> tuple[list[tuple[str, np.ndarray]], list[np.ndarray]]:
    """Return meshio's blocks, one per number of sides, and the cells in each."""
    diagram = result.diagram
    starts = diagram.cell_vertex_starts
    sides = np.diff(starts)
    names = {3: "triangle", 4: "quad"}
    blocks, order = [], []
    for k in np.unique(sides):
        cells = np.flatnonzero(sides == k)
        corners = diagram.cell_vertices[starts[cells][:, None] + np.arange(k)]
        blocks.append((names.get(int(k), "polygon"), corners))
        order.append(cells)
    return blocks, order


def _known(values: np.ndarray) -> np.ndarray:
    """Return integers in 64 bits: what meshio calls 32 of them, VTK does not know."""
    return values.astype(np.int64) if values.dtype.kind == "i" else values
