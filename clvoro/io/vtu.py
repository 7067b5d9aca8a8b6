"""Write VTK's XML format for unstructured grids (`.vtu`), for ParaView and similar programs.

The arrays follow the XML as compressed bytes ("appended" data), which are exact. Before each array stands a table of
its blocks.
"""

from __future__ import annotations

import json
import re
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ..arguments import check_choice
from ..connectivity import rows_of, take_rows
from ..finite_volumes.prisms import cell_loops
from ..finite_volumes.solver_mesh import WallShape, make_solver_mesh
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.straightening import count_sides
from .atomic import atomic_file
from .contents import DOMAIN, Contents, describe

SOLVER_MESH = "clvoro solver mesh: the cells are not those of a diagram"
_BLOCK = 1 << 20
_TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}


def write_vtu(contents: Contents, path: Path, walls: WallShape = "exact") -> None:
    """Write the cells as polygons or polyhedra with cell data.

    Cell data: `size` (h), `error` (signed) and `quality` of a result; `volume` (area in 2D); `sides` (in 3D
    `faces_of_cell`); `label` (row of the cell); `boundary` (see `largest_boundary`); for each name that the caller
    gave to a boundary `boundary:NAME` (1 where the cell has a face on it, else 0); the vector `generator`, from the
    origin to the cell's generator; in a power diagram `weight`; and data of the caller. A comment holds the settings,
    field data the domain (JSON as bytes), and what is behind each face. In a periodic box cells
    are not cut at the seams. On a sphere the corners of cells are on it, and VTK draws straight lines between them.

    With `walls` "straight" the cells are those of the solver mesh, with their volumes, and without the domain, as the
    file is no diagram to `load`.
    """
    check_choice("walls", walls, ("straight", "exact"))
    diagram = contents.diagram
    n = len(diagram)
    appended = _Appended()
    mesh = make_solver_mesh(diagram) if walls == "straight" else None
    vertices = diagram.vertices if mesh is None else mesh.points
    points = appended.add(None, in_space(vertices))
    kind = KINDS[diagram.domain.cell_dim]
    topology = kind.topology(diagram if mesh is None else mesh)
    topology["types"] = np.full(n, kind.number, np.uint8)
    values = cell_data(contents)
    if mesh is not None:
        values |= _solver_data(mesh)
    cells = [appended.add(name, array) for name, array in topology.items()]
    data = [appended.add(name, array) for name, array in values.items()]
    about = _diagram_data(diagram) if mesh is None else {}
    field = [appended.add(name, array, tuples=True) for name, array in about.items()]
    note = "" if mesh is None else _comment(SOLVER_MESH) + "\n"
    head = f"""<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{sys.byteorder.title()}Endian" \
header_type="UInt64" compressor="vtkZLibDataCompressor">
{_comment("clvoro settings: " + json.dumps(contents.settings, default=repr))}
{note}\
<UnstructuredGrid>
{_field_data(field)}<Piece NumberOfPoints="{len(vertices)}" NumberOfCells="{n}">
<Points>
{points}
</Points>
<Cells>
{_lines(cells)}
</Cells>
<CellData Scalars="{"volume" if contents.result is None else "error"}" Vectors="generator">
{_lines(data)}
</CellData>
</Piece>
</UnstructuredGrid>
<AppendedData encoding="raw">
_"""
    with atomic_file(path) as file:
        file.write(head.encode())
        for chunk in appended.chunks:
            file.write(chunk)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


def write_pvtu(contents: Contents, path: Path) -> None:
    """Write the mesh of all ranks for ParaView: each rank its cells to a file ``NAME_0.vtu``, ..., rank 0 their index.

    `load` reads the whole mesh. The mesh of a single process has one piece. Marks of named boundaries, which ranks do
    not share, are in pieces only.
    """
    parts = None if contents.result is None else contents.result.parts
    number, count = (0, 1) if parts is None else (parts.number, parts.count)
    pieces = [f"{path.stem}_{k}.vtu" for k in range(count)]

    def write_piece() -> None:
        write_vtu(contents, path.with_name(pieces[number]))

    write_piece() if parts is None else parts.together(write_piece)
    if number:
        return
    declared = _Appended()
    # Elements without the places of bytes in a file.
    shapes = {name: a[:0] for name, a in cell_data(contents).items() if not name.startswith("boundary:")}
    data = [_PLACE.sub("", declared.add(name, a)).replace("DataArray", "PDataArray") for name, a in shapes.items()]
    sources = [f"<Piece Source={quoteattr(piece)}/>" for piece in pieces]
    domain = json.dumps(describe(contents.diagram.domain if parts is None else parts.domain))
    text = f"""<?xml version="1.0"?>
<VTKFile type="PUnstructuredGrid" version="1.0" byte_order="{sys.byteorder.title()}Endian" header_type="UInt64">
<!--{DOMAIN}{domain.replace("--", "-" + chr(92) + "u002d")}-->
<PUnstructuredGrid GhostLevel="0">
<PPoints>
<PDataArray type="Float64" NumberOfComponents="3"/>
</PPoints>
<PCellData Scalars="{"volume" if contents.result is None else "error"}" Vectors="generator">
{_lines(data)}
</PCellData>
{_lines(sources)}
</PUnstructuredGrid>
</VTKFile>
"""
    with atomic_file(path) as file:
        file.write(text.encode())


_PLACE = re.compile(' format="appended" offset="[0-9]*"')


def _diagram_data(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return field data with the domain, and with what corners of cells do not define: the graph."""
    written = np.diff(diagram.half_faces.corners[0]) > 0
    found = {"domain": np.frombuffer(json.dumps(describe(diagram.domain)).encode(), np.uint8)}
    found["neighbors"] = diagram.neighbors[written].astype(np.int32)
    if any(diagram.domain.periodic):
        found["shifts"] = in_space(diagram.shifts[written]).astype(np.int32)
    if diagram.domain.cuts_cells:
        found["bridges"] = _bridges(diagram)
    return found


def _bridges(diagram: Diagram) -> np.ndarray:
    """Return the places among the corners of cells where bridges between loops begin, and no faces.

    Corners alone do not distinguish a bridge from a slit without width in single precision.
    """
    starts, following = diagram.neighbor_starts, diagram.half_faces.next
    cell = rows_of(starts)
    ends = following != np.arange(1, len(following) + 1)
    loop = np.concatenate([[0], np.cumsum(ends)[:-1]])
    earlier = loop - loop[starts[:-1]][cell]
    # One bridge precedes the second loop; two, back and forth, precede each later one.
    place = np.arange(len(following)) - starts[cell] + np.maximum(2 * earlier - 1, 0)
    bridge = np.ones(len(diagram.cell_vertices), bool)
    bridge[diagram.cell_vertex_starts[cell] + place] = False
    return np.flatnonzero(bridge).astype(np.int32)


def _polygons(mesh: Diagram | Faces) -> dict[str, np.ndarray]:
    """Return the corners of cells, counter-clockwise, and the end of each cell's part."""
    if isinstance(mesh, Faces):
        starts, corners = cell_loops(mesh)
        return {"connectivity": corners.astype(np.int32), "offsets": starts[1:].astype(np.int32)}
    return {"connectivity": mesh.cell_vertices, "offsets": mesh.cell_vertex_starts[1:]}


def _half_faces(mesh: Diagram | Faces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cell, starts and corners of each half-face in 3D, cell by cell."""
    if not isinstance(mesh, Faces):
        return mesh.half_faces.owner, *mesh.half_faces.corners
    starts, sides = mesh.cell_faces()
    face = mesh.sides()[1][sides]
    cell = rows_of(starts)
    return cell, *take_rows(mesh.starts, mesh.corners, face, sides >= len(mesh))


def _solver_data(mesh: Faces) -> dict[str, np.ndarray]:
    """Return the cell data that differ from those of the diagram."""
    counts = np.bincount(mesh.sides()[0], minlength=mesh.n_cells)
    return {
        "volume": mesh.volumes,
        KINDS[mesh.dim].counts: counts.astype(np.int32),
        **_on_boundaries(mesh.domain, mesh.owner, mesh.neighbor, mesh.n_cells),
    }


def polyhedra(mesh: Diagram | Faces) -> dict[str, np.ndarray]:
    """Return the corners and faces of cells in VTK's arrays.

    `faces` has for each cell the number of its faces, and then for each face the number of its corners and the corners,
    counter-clockwise as seen from outside. `faceoffsets` has the end of each cell's part.
    """
    n, v = (mesh.n_cells, len(mesh.points)) if isinstance(mesh, Faces) else (len(mesh), len(mesh.vertices))
    owner, starts, corners = _half_faces(mesh)
    sides = np.diff(starts)
    owner, sides = owner[sides > 0], sides[sides > 0]
    faces = np.bincount(owner, minlength=n)
    ends = np.cumsum(1 + faces + np.bincount(owner, sides, minlength=n).astype(np.int64))
    index = np.int32 if len(ends) == 0 or ends[-1] < 2**31 else np.int64
    stream = np.empty(ends[-1] if n else 0, index)
    counts = np.concatenate([[0], ends[:-1]])
    # Before a face come its cell's count, the counts of all earlier cells, and all earlier faces.
    headers = np.cumsum(sides + 1) - (sides + 1) + owner + 1
    rest = np.ones(len(stream), bool)
    rest[counts] = rest[headers] = False
    stream[counts], stream[headers], stream[rest] = faces, sides, corners

    # A corner belongs to at least three faces of its cell. List it once.
    keys = np.repeat(owner.astype(np.int64) * v, sides) + corners
    keys.sort()
    keys = keys[np.concatenate([[True], keys[1:] != keys[:-1]])]
    per_cell = np.bincount(keys // v, minlength=n)
    return {
        "connectivity": (keys % v).astype(np.int32),
        "offsets": np.cumsum(per_cell).astype(index),
        "faces": stream,
        "faceoffsets": ends.astype(index),
    }


def _count_faces(diagram: Diagram) -> np.ndarray:
    written = np.diff(diagram.half_faces.corners[0]) > 0
    return np.bincount(diagram.half_faces.owner[written], minlength=len(diagram))


@dataclass(frozen=True)
class CellKind:
    """What a file has of cells of one dimension."""

    number: int
    """VTK's number of the kind."""
    counts: str
    """Name of the cell data with the numbers of sides or faces."""
    stream: tuple[str, str]
    """(str, str). Names of the arrays with the ends of the cells' parts and their items."""
    topology: Callable[[Diagram | Faces], dict[str, np.ndarray]]
    count: Callable[[Diagram], np.ndarray]
    """`topology`, `count`: of a diagram: VTK's arrays (also of a mesh for solvers), and numbers of sides or faces."""


KINDS = {
    2: CellKind(7, "sides", ("offsets", "connectivity"), _polygons, count_sides),
    3: CellKind(42, "faces_of_cell", ("faceoffsets", "faces"), polyhedra, _count_faces),
}
"""VTK's polygons and polyhedra, by the dimension of the cells."""


def cell_data(contents: Contents) -> dict[str, np.ndarray]:
    """Return the cell data by name. Vectors have three coordinates, as VTK requires."""
    diagram, n = contents.diagram, len(contents.diagram)
    kind = KINDS[diagram.domain.cell_dim]
    return {
        **contents.of_run,
        "volume": diagram.volumes,
        kind.counts: kind.count(diagram).astype(np.int32),
        "label": np.arange(n, dtype=np.int32),
        "boundary": largest_boundary(diagram),
        **_on_boundaries(diagram.domain, diagram.half_faces.owner, diagram.neighbors, n),
        "generator": in_space(diagram.points),
        **({"weight": diagram.weights} if diagram.is_power else {}),
        **({"layer": diagram.layer.astype(np.int32)} if diagram.layer.any() else {}),
        **{k: in_space(v) if v.shape[1:] == (2,) else v for k, v in contents.with_regions.items()},
    }


def largest_boundary(diagram: Diagram) -> np.ndarray:
    """Return the index in `boundary_names` of the boundary with the largest face of each cell, (n,) int32; -1: none."""
    found = np.full(len(diagram), -1, np.int32)
    walls = np.flatnonzero(diagram.neighbors < 0)
    # Of several entries for a cell the last one remains: that of its largest wall face.
    walls = walls[np.argsort(diagram.face_measures[walls], kind="stable")]
    found[diagram.half_faces.owner[walls]] = diagram.domain.boundary_index[-1 - diagram.neighbors[walls]]
    return found


def _on_boundaries(domain: Domain, owner: np.ndarray, neighbor: np.ndarray, n: int) -> dict[str, np.ndarray]:
    """Return for each boundary that the caller has named which of `n` cells have a face on it, (n,) uint8."""
    on_wall = neighbor < 0
    part, cell = domain.boundary_index[-1 - neighbor[on_wall]], owner[on_wall]
    found = {}
    for name in domain.describe().get("names") or ():
        found[f"boundary:{name}"] = mask = np.zeros(n, np.uint8)
        mask[cell[part == domain.boundary_names.index(name)]] = 1
    return found


def in_space(points: np.ndarray) -> np.ndarray:
    """Return points (n, d) as (n, 3), in 2D with z = 0."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


class _Appended:
    """The appended bytes, and the XML elements that refer to them."""

    def __init__(self) -> None:
        self.chunks: list[bytes] = []
        self._offset = 0

    def add(self, name: str | None, array: np.ndarray, tuples: bool = False) -> str:
        """Append `array` and return its XML element; with `tuples`, the element has its length."""
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("="), copy=False)
        components = f' NumberOfComponents="{data.shape[1]}"' if data.ndim == 2 else ""
        label = "" if name is None else f" Name={quoteattr(name)}"
        components += f' NumberOfTuples="{len(data)}"' if tuples else ""
        kind = _TYPES[data.dtype.str[1:]]
        element = f'<DataArray type="{kind}"{label}{components} format="appended" offset="{self._offset}"/>'
        chunk = _packed(data.tobytes())
        self.chunks.append(chunk)
        self._offset += len(chunk)
        return element


def _packed(raw: bytes) -> bytes:
    """Compress `raw` in blocks, after a table of their number, their size, that of the last, and compressed sizes."""
    blocks = [raw[i : i + _BLOCK] for i in range(0, len(raw), _BLOCK)]
    packed = [zlib.compress(block, 1) for block in blocks]
    partial = len(raw) % _BLOCK  # 0 if the last block is full
    table = struct.pack(f"={3 + len(packed)}Q", len(packed), _BLOCK, partial, *map(len, packed))
    return table + b"".join(packed)


def _comment(text: str) -> str:
    # Not a field of type String, because meshio cannot read such a file.
    return f"<!-- {text.replace('--', '- -')} -->"


def _field_data(elements: list[str]) -> str:
    return f"<FieldData>\n{_lines(elements)}\n</FieldData>\n" if elements else ""


def _lines(elements: list[str]) -> str:
    return "\n".join(elements)
