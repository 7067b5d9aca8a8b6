"""Write meshes as CGNS files (HDF5), for commercial and open solvers and post-processors.

One base with one unstructured zone: faces as NGON_n and cells as NFACE_n, boundaries as BC_t with lists of faces, and
cell data as a FlowSolution_t at cell centers. Layout by the SIDS and the HDF5 mapping of CGNS 4: each node is a group
with the attributes name, label and type; its data are the dataset " data", with the axes in reverse order. In 2D cells
are one layer of prisms, as for OpenFOAM.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..arguments import warn
from ..errors import MismatchWarning
from ..finite_volumes.gate import rejection
from ..mesh.faces import Faces
from .atomic import atomic_folder
from .contents import Contents
from .convert import missing
from .foam import poly_mesh
from .vtu import cell_data

_NGON, _NFACE = 22, 23
_VERSION = 4.2
_TYPES = {"f4": "R4", "f8": "R8", "i4": "I4", "i8": "I8", "u1": "U1", "S1": "C1"}
_CONDITIONS = {
    "wall": "BCWall",
    "patch": "BCGeneral",
    "symmetry": "BCSymmetryPlane",
    "symmetryPlane": "BCSymmetryPlane",
}
"""CGNS's types of boundary conditions for OpenFOAM's types of patches."""
_LONGEST = 32


def write_cgns(contents: Contents, path: Path) -> None:
    """Write the cells, the boundaries by their names, and cell data, with h5py.

    Raises `MissingLibraryError` if h5py is not installed. Raises `InputError` if the file cannot be written, or
    OpenFOAM could not hold the cells either; see `poly_mesh`.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise missing("h5py", "formats", "a .cgns file") from error
    mesh, patches, _ = poly_mesh(contents.diagram, check=False)
    if why := rejection(contents.diagram.solver_mesh()):
        warn(why, MismatchWarning)
    with atomic_folder(path) as temporary, h5py.File(temporary, "w", libver=("earliest", "v110")) as file:
        root = _CgnsNode(file["/"], h5py)
        root.mark("HDF5 MotherNode", "Root Node of HDF5 File", "MT")
        file.create_dataset(" format", data=_text(f"IEEE_{sys.byteorder.upper()}_32", 15))
        file.create_dataset(" hdf5version", data=_text(f"HDF5 Version {h5py.version.hdf5_version}", 33))
        root.add("CGNSLibraryVersion", "CGNSLibraryVersion_t", np.array([_VERSION], np.float32))
        base = root.add("Base", "CGNSBase_t", np.array([3, 3], np.int32))
        _write_zone(base, mesh, patches, contents)


def _write_zone(base: _CgnsNode, mesh: Faces, patches: list[Any], contents: Contents) -> None:
    f, n = len(mesh), mesh.n_cells
    index = np.int64 if len(mesh.corners) > 1 << 30 else np.int32
    zone = base.add("Zone", "Zone_t", np.array([[len(mesh.points)], [n], [0]], index))
    zone.add("ZoneType", "ZoneType_t", "Unstructured")
    grid = zone.add("GridCoordinates", "GridCoordinates_t")
    for axis, name in enumerate("XYZ"):
        grid.add(f"Coordinate{name}", "DataArray_t", np.ascontiguousarray(mesh.points[:, axis], float))
    faces = zone.add("Faces", "Elements_t", np.array([_NGON, 0], np.int32))
    faces.add("ElementRange", "IndexRange_t", np.array([1, f], index))
    faces.add("ElementStartOffset", "DataArray_t", mesh.starts.astype(index))
    faces.add("ElementConnectivity", "DataArray_t", (mesh.corners + 1).astype(index))
    parents = np.zeros((2, f), index)
    parents[0] = f + 1 + mesh.owner
    inner = mesh.neighbor >= 0
    inner[mesh.n_inner :] = False
    parents[1, inner] = f + 1 + mesh.neighbor[inner]
    faces.add("ParentElements", "DataArray_t", parents)
    starts, places = mesh.cell_faces()
    side = mesh.sides()[1][places] + 1
    cells = zone.add("Cells", "Elements_t", np.array([_NFACE, 0], np.int32))
    cells.add("ElementRange", "IndexRange_t", np.array([f + 1, f + n], index))
    cells.add("ElementStartOffset", "DataArray_t", starts.astype(index))
    cells.add("ElementConnectivity", "DataArray_t", np.where(places < f, side, -side).astype(index))
    conditions, first = zone.add("ZoneBC", "ZoneBC_t"), mesh.n_inner
    for patch in patches:
        if patch.size:
            condition = conditions.add(_name(patch.name), "BC_t", _CONDITIONS.get(patch.kind, "BCTypeUserDefined"))
            condition.add("PointRange", "IndexRange_t", np.array([[first + 1], [first + patch.size]], index))
            condition.add("GridLocation", "GridLocation_t", "FaceCenter")
        first += patch.size
    solution = zone.add("CellData", "FlowSolution_t")
    solution.add("GridLocation", "GridLocation_t", "CellCenter")
    for name, values in cell_data(contents).items():
        columns = [(name, values)] if values.ndim == 1 else [(name + "XYZ"[k], values[:, k]) for k in range(3)]
        for title, column in columns:
            if column.dtype.kind == "u":
                column = column.astype(np.int32)
            solution.add(_name(title), "DataArray_t", np.ascontiguousarray(column))


def _name(text: str) -> str:
    """Return the name of a node: at most 32 characters without a slash."""
    return text.replace("/", "-")[:_LONGEST]


def _text(text: str, size: int) -> np.ndarray:
    return np.frombuffer(text.encode("ascii").ljust(size, b"\0")[:size], np.int8)


class _CgnsNode:
    """A node of a CGNS tree: a group of HDF5."""

    def __init__(self, group: Any, h5py: Any) -> None:
        self.group, self.h5py = group, h5py

    def mark(self, name: str, label: str, kind: str) -> None:
        """Write the attributes of a node."""
        for key, text, size in (("name", name, 33), ("label", label, 33), ("type", kind, 3)):
            text_type = self.h5py.h5t.C_S1.copy()
            text_type.set_size(size)
            space = self.h5py.h5s.create(self.h5py.h5s.SCALAR)
            attribute = self.h5py.h5a.create(self.group.id, key.encode(), text_type, space)
            attribute.write(np.array(text.encode(), f"S{size}"), text_type)
        self.group.attrs.create("flags", np.array([1], np.int32))

    def add(self, name: str, label: str, data: np.ndarray | str | None = None) -> _CgnsNode:
        """Add a node below this one."""
        node = _CgnsNode(self.group.create_group(name, track_order=True), self.h5py)
        if data is None:
            node.mark(name, label, "MT")
            return node
        if isinstance(data, str):
            node.mark(name, label, "C1")
            data = np.frombuffer(data.encode(), np.int8)
        else:
            node.mark(name, label, _TYPES[data.dtype.str[1:]])
        node.group.create_dataset(" data", data=data)
        return node
