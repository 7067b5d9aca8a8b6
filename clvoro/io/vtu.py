"""VTK's XML format for unstructured grids, for ParaView and its kin.

The arrays follow the XML as raw bytes ("appended" data): exact, compact, and read in one go. Each
is preceded by its length, or, compressed, by a table of its blocks.
"""

from __future__ import annotations

import json
import struct
import sys
import zlib
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ..geometry.box import Domain
from ..geometry.polygon import Polygon
from ..mesh.connectivity import face_corners, face_owners, next_faces
from ..mesh.diagram import Diagram
from ..mesh.straightening import count_sides
from .atomic import atomic_file
from .contents import Contents

NAMES = "clvoro names: "
"""Beginning of the comment with names of boundaries."""
_POLYGON, _POLYHEDRON = 7, 42  # VTK_POLYGON, VTK_POLYHEDRON
_BLOCK = 1 << 20
_TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32", "i8": "Int64", "u1": "UInt8"}


def write_vtu(contents: Contents, path: Path, compress: bool = True) -> None:
    """Write the cells as polygons or polyhedra with their data; the settings go along in a comment.

    Cell data: `size` (h), `error` (signed) and `quality` of a result, `volume` (area in 2D), `sides` (in 3D
    `faces_of_cell`), `label` (row of the cell), `boundary` (see `largest_boundary`), the vector `generator`, from the
    origin to the cell's generator, and data of the caller. Names of boundaries that the caller gave go along in a
    comment, a polygonal or periodic domain as field data. In a periodic box cells are not cut at the seams.
    """
    diagram = contents.diagram
    n = len(diagram)
    appended = _Appended(compress)
    points = appended.add(None, in_space(diagram.vertices))
    if diagram.domain.dim == 2:
        kind, topology = _POLYGON, _polygons(diagram)
    else:
        kind, topology = _POLYHEDRON, polyhedra(diagram)
    topology["types"] = np.full(n, kind, np.uint8)
    cells = [appended.add(name, array) for name, array in topology.items()]
    data = [appended.add(name, values) for name, values in cell_data(contents).items()]
    field = [
        appended.add(name, array, tuples=True) for name, array in _domain_data(diagram).items()
    ]
    compressor = ' compressor="vtkZLibDataCompressor"' if compress else ""
    head = f"""<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{sys.byteorder.title()}Endian" \
header_type="UInt64"{compressor}>
{_comment("clvoro settings: " + json.dumps(contents.settings, default=repr))}
{_names_comment(diagram.domain)}\
<UnstructuredGrid>
{_field_data(field)}<Piece NumberOfPoints="{len(diagram.vertices)}" NumberOfCells="{n}">
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


def _domain_data(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return what describes a domain, and its graph, that the cells' corners do not."""
    domain = diagram.domain
    if any(domain.periodic):
        starts = face_corners(diagram)[0]
        written = np.cumsum(np.diff(starts) > 0) - 1  # in 3D a face without a loop is left out
        seam = np.flatnonzero(diagram.shifts.any(axis=1) & (np.diff(starts) > 0))
        if domain.dim == 2:
            written = np.arange(len(diagram.neighbors))
        return {
            "box_corners": in_space(np.array([domain.lower, domain.upper])),
            "box_periodic": np.array(domain.periodic, np.uint8),
            "seam_faces": written[seam].astype(np.int32),
            "seam_neighbors": diagram.neighbors[seam],
            "seam_shifts": in_space(diagram.shifts[seam]).astype(np.int32),
        }
    if not isinstance(domain, Polygon):
        return {}
    return {
        "domain_vertices": in_space(domain.vertices),
        "domain_ring_starts": domain.ring_starts,
        "domain_piece_of_ring": domain.piece_of_ring,
        **_polygon_graph(diagram),
    }


def _polygon_graph(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return which ways from corner to corner are bridges between loops, and the edges behind faces on the boundary.

    Corners alone do not tell a bridge from the two sides of a slit that has no width in single precision.
    """
    starts, following = diagram.neighbor_starts, next_faces(diagram)
    cell = np.repeat(np.arange(len(diagram)), np.diff(starts))
    ends = following != np.arange(1, len(following) + 1)
    loop = np.concatenate([[0], np.cumsum(ends)[:-1]])
    earlier = loop - loop[starts[:-1]][cell]
    # A way to the second loop stands before it, ways back and on before each later one.
    place = np.arange(len(following)) - starts[cell] + np.maximum(2 * earlier - 1, 0)
    bridge = np.ones(len(diagram.cell_vertices), bool)
    bridge[diagram.cell_vertex_starts[cell] + place] = False
    walls = np.flatnonzero(diagram.neighbors < 0)
    return {
        "bridges": np.flatnonzero(bridge).astype(np.int32),
        "wall_faces": walls.astype(np.int32),
        "wall_edges": (-1 - diagram.neighbors[walls]).astype(np.int32),
    }


def _polygons(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return the cells' corners, counter-clockwise, and where each cell's end."""
    return {
        "connectivity": diagram.cell_vertices,
        "offsets": diagram.cell_vertex_starts[1:],
    }


def polyhedra(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return the cells' corners and the streams that describe their faces.

    `faces` has for each cell the number of its faces, then for each face the number of its corners and the
    corners, counter-clockwise as seen from outside; `faceoffsets` tells where each cell's part ends.
    """
    n, v = len(diagram), len(diagram.vertices)
    starts, corners = face_corners(diagram)
    sides = np.diff(starts)
    owner, sides = face_owners(diagram)[sides > 0], sides[sides > 0]
    faces = np.bincount(owner, minlength=n)
    ends = np.cumsum(1 + faces + np.bincount(owner, sides, minlength=n).astype(np.int64))
    index = np.int32 if len(ends) == 0 or ends[-1] < 2**31 else np.int64
    stream = np.empty(ends[-1] if n else 0, index)
    counts = np.concatenate([[0], ends[:-1]])
    # Before a face stand those of the same and of earlier cells, and the counts of these cells.
    headers = np.cumsum(sides + 1) - (sides + 1) + owner + 1
    rest = np.ones(len(stream), bool)
    rest[counts] = rest[headers] = False
    stream[counts], stream[headers], stream[rest] = faces, sides, corners

    # Every corner of a cell is one of at least three of its faces, and listed once.
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


def cell_data(contents: Contents) -> dict[str, np.ndarray]:
    """Return what is known of each cell, by name; vectors have three coordinates, as VTK's do."""
    diagram = contents.diagram
    flat, n = diagram.domain.dim == 2, len(diagram)
    # In 3D of the faces that are written: those with a loop.
    seen = np.diff(face_corners(diagram)[0]) > 0
    counts = count_sides(diagram) if flat else np.bincount(face_owners(diagram)[seen], minlength=n)
    return {
        **contents.of_run,
        "volume": diagram.volumes,
        "sides" if flat else "faces_of_cell": counts.astype(np.int32),
        "label": np.arange(n, dtype=np.int32),
        "boundary": largest_boundary(diagram),
        "generator": in_space(diagram.points),
        **{k: in_space(v) if v.shape[1:] == (2,) else v for k, v in contents.extra.items()},
    }


def largest_boundary(diagram: Diagram) -> np.ndarray:
    """Return the index in `boundary_names` of the boundary with the largest face of each cell, (n,) int32; -1: none."""
    found = np.full(len(diagram), -1, np.int32)
    walls = np.flatnonzero(diagram.neighbors < 0)
    walls = walls[np.argsort(diagram.face_measures[walls], kind="stable")]  # the last one stays
    found[face_owners(diagram)[walls]] = diagram.domain.boundary_index[
        -1 - diagram.neighbors[walls]
    ]
    return found


def in_space(points: np.ndarray) -> np.ndarray:
    """Return points (n, d) as (n, 3), in 2D with z = 0."""
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


class _Appended:
    """The bytes after the XML, and where each array begins in them."""

    def __init__(self, compress: bool) -> None:
        self.chunks: list[bytes] = []
        self.compress = compress
        self._offset = 0

    def add(self, name: str | None, array: np.ndarray, tuples: bool = False) -> str:
        """Append `array` and return the XML element that refers to it; it says how long it is if `tuples`."""
        data = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("="), copy=False)
        components = f' NumberOfComponents="{data.shape[1]}"' if data.ndim == 2 else ""
        label = "" if name is None else f" Name={quoteattr(name)}"
        components += f' NumberOfTuples="{len(data)}"' if tuples else ""
        kind = _TYPES[data.dtype.str[1:]]
        element = (
            f'<DataArray type="{kind}"{label}{components} format="appended" '
            f'offset="{self._offset}"/>'
        )
        chunk = _packed(data.tobytes()) if self.compress else _measured(data.tobytes())
        self.chunks.append(chunk)
        self._offset += len(chunk)
        return element


def _measured(raw: bytes) -> bytes:
    return struct.pack("=Q", len(raw)) + raw


def _packed(raw: bytes) -> bytes:
    """Compress `raw` in blocks: their number, their size, the last one's, each one's compressed."""
    blocks = [raw[i : i + _BLOCK] for i in range(0, len(raw), _BLOCK)]
    packed = [zlib.compress(block, 1) for block in blocks]
    partial = len(raw) % _BLOCK  # 0 if the last block is a full one
    table = struct.pack(f"={3 + len(packed)}Q", len(packed), _BLOCK, partial, *map(len, packed))
    return table + b"".join(packed)


def _comment(text: str) -> str:
    # A field of type String would show up in ParaView, but meshio cannot read such a file.
    return f"<!-- {text.replace('--', '- -')} -->"


def _names_comment(domain: Domain) -> str:
    """Return a line with the caller's names of boundaries, which the loader reads."""
    named = domain.describe().get("names")
    # A comment has no "--".
    text = json.dumps(named).replace("--", r"-\u002d")
    return _comment(NAMES + text) + "\n" if named else ""


def _field_data(elements: list[str]) -> str:
    return f"<FieldData>\n{_lines(elements)}\n</FieldData>\n" if elements else ""


def _lines(elements: list[str]) -> str:
    return "\n".join(elements)
