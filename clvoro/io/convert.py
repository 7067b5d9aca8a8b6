"""Diagrams as meshes of other libraries: meshio and PyVista."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import MissingLibraryError
from .vtu import KINDS, cell_data, in_space, polyhedra

if TYPE_CHECKING:
    import meshio
    import pyvista

    from ..mesh.diagram import Diagram
    from .contents import Contents


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
    blocks, rows = _BLOCKS[diagram.domain.cell_dim](diagram)
    data = cell_data(contents) if with_data else {}
    return meshio.Mesh(
        in_space(diagram.vertices), blocks, cell_data={name: [_known(v)[k] for k in rows] for name, v in data.items()}
    )


def to_pyvista(contents: Contents) -> pyvista.UnstructuredGrid:
    """Return an unstructured grid of PyVista; see `Diagram.to_pyvista`."""
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise missing("PyVista", "pyvista", "to_pyvista()") from error
    diagram = contents.diagram
    kind = KINDS[diagram.domain.cell_dim]
    ends, items = (kind.topology(diagram)[name] for name in kind.stream)
    starts = np.concatenate([[0], ends])
    # The number of items precedes the items of each cell.
    cells = np.insert(items.astype(np.int64), starts[:-1], np.diff(starts))
    grid = pyvista.UnstructuredGrid(cells, np.full(len(diagram), kind.number, np.uint8), in_space(diagram.vertices))
    for name, values in cell_data(contents).items():
        grid.cell_data[name] = np.array(values)
    return grid


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
