"""Read back the `.vtu` files that `vtu.py` writes, without trusting them: for checks.

The XML is read by a parser that refuses document types and entities, so that nothing expands and nothing is fetched;
every array's size is known from the numbers of points and cells, or bounded by the file's, before memory is asked for.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import zlib
from array import array
from collections.abc import Iterator
from itertools import pairwise
from os import PathLike, fspath
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from ..errors import InputError
from ..files import open_plain
from ..geometry.box import Box, Domain
from ..geometry.polygon import Polygon
from ..mesh.check.rebuilt import rebuild
from ..mesh.diagram import Diagram
from ..mesh.results import HISTORY_DTYPE, Result
from .arrays import EXPANSION, LEAST
from .vtu import NAMES
from .vtu_more import check_repeated

_LONGEST_HEAD = 1 << 22
_MARK = b'<AppendedData encoding="raw">\n_'
_END = b"\n</AppendedData>\n</VTKFile>\n"
_TYPES = {"Float64": "f8", "Float32": "f4", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}
_BLOCK = 1 << 20
_USED = {
    "Points.", "Cells.types", "Cells.connectivity", "Cells.offsets", "Cells.faces", "Cells.faceoffsets",
    "CellData.size", "CellData.error", "CellData.quality", "CellData.volume", "CellData.generator",
    "CellData.label", "CellData.sides", "CellData.faces_of_cell",
    "FieldData.box_corners", "FieldData.box_periodic",
    "FieldData.seam_faces", "FieldData.seam_neighbors", "FieldData.seam_shifts",
    "FieldData.domain_vertices", "FieldData.domain_ring_starts", "FieldData.domain_piece_of_ring",
    "FieldData.domain_edge_numbers", "FieldData.bridges", "FieldData.wall_faces", "FieldData.wall_edges",
}  # fmt: skip


class _FileError(Exception):
    """What is wrong with a file; `load_vtu` adds which one."""


def load_vtu(path: str | PathLike[str]) -> Result | Diagram:
    """Read the cells and what is known of them from a `.vtu` file that `Result.save` or `Diagram.save` wrote.

    The domain is the polygon or periodic box that the file describes, or else the vertices' bounding box. The graph is
    made anew from the corners that cells share; volumes, sizes, errors and quality are those of the file, the history
    is empty.

    Raises
    ------
    InputError
        If the file is missing, damaged, cut off or not of clvoro's kind; names the file and what is wrong.
    """
    name = fspath(path)
    try:
        with open_plain(path) as file:
            head = file.read(_LONGEST_HEAD)
            end = head.find(_MARK)
            if end < 0:
                raise _FileError("it has no appended raw data, as clvoro's have")
            start = end + len(_MARK)
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - len(_END)))
            if file.read() != _END:
                raise _FileError("its end is missing: it is cut off, or something follows")
            reader = _Reader(head[:end], start, size)
            arrays = reader.read_all(file)
        return _assemble(arrays, reader.names)
    except _FileError as problem:
        raise InputError(f"cannot read {name}: {problem}") from problem
    except (
        zlib.error,
        struct.error,
        ValueError,
        OverflowError,
        KeyError,
        TypeError,
        RecursionError,
        expat.ExpatError,
    ) as error:
        raise InputError(f"cannot read {name}: it is damaged or foreign ({error})") from error
    except OSError as error:
        raise InputError(f"cannot read {name}: {error.strerror or error}") from error


class _Reader:
    """The head of a file: which arrays there are, and where."""

    def __init__(self, head: bytes, start: int, size: int) -> None:
        self.start, self.size = start, size
        self.left = max(LEAST, EXPANSION * size)  # bytes of arrays
        self.there = size  # bytes of the file, none of which two arrays share
        self.points = self.cells = -1
        self.compressed = False
        self.entries: dict[str, tuple[str, int, int]] = {}
        self.names: dict[str, list[int]] | None = None
        self._within: list[str] = []
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._refuse
        parser.EntityDeclHandler = self._refuse
        parser.StartElementHandler = self._element
        parser.EndElementHandler = lambda _: self._within.pop()
        parser.CommentHandler = self._comment
        parser.Parse(head, False)
        if min(self.points, self.cells) < 0:
            raise _FileError("it has no piece with points and cells")

    def _refuse(self, *_: object) -> NoReturn:
        raise _FileError("it declares a document type or entities, which clvoro's never do")

    def _comment(self, text: str) -> None:
        text = text.strip()
        if text.startswith(NAMES):
            self.names = json.loads(text.removeprefix(NAMES))

    def _element(self, tag: str, given: dict[str, str]) -> None:
        if tag == "VTKFile":
            native = f"{sys.byteorder.title()}Endian"
            if given.get("type") != "UnstructuredGrid" or given.get("byte_order") != native:
                raise _FileError(f"it is no UnstructuredGrid in {native}")
            if given.get("header_type") != "UInt64":
                raise _FileError("its header_type is not UInt64")
            compressor = given.get("compressor")
            if compressor not in (None, "vtkZLibDataCompressor"):
                raise _FileError(f"its compressor is {compressor!r:.60}")
            self.compressed = compressor is not None
        elif tag == "Piece":
            self.points, self.cells = int(given["NumberOfPoints"]), int(given["NumberOfCells"])
        elif tag == "DataArray":
            group = self._within[-1] if self._within else ""
            name = given.get("Name", "") if group != "Points" else ""
            if given.get("format") != "appended" or given["type"] not in _TYPES:
                raise _FileError(f"its array {name!r:.60} is not appended, or of an unknown type")
            width = int(given.get("NumberOfComponents", "1"))
            key = f"{group}.{name}"
            if width not in (1, 3) and key in _USED:
                raise _FileError(f"its array {name!r:.60} has {width} components")
            if key in self.entries:
                raise _FileError(f"it has two arrays called {key!r:.60}")
            self.entries[key] = (_TYPES[given["type"]], width, int(given["offset"]))
        self._within.append(tag)

    def read_all(self, file) -> dict[str, np.ndarray]:
        """Return all arrays that a result is made of, by group and name."""
        used = {name: entry for name, entry in self.entries.items() if name in _USED}
        return {name: self._read(file, name, *entry) for name, entry in used.items()}

    def _read(self, file, name: str, kind: str, width: int, offset: int) -> np.ndarray:
        if not 0 <= offset <= self.size - self.start - 8:
            raise _FileError(f"{name} lies beyond the file's end")
        file.seek(self.start + offset)
        if self.compressed:
            raw = bytearray()
            for block in self._blocks(file, name):
                raw += block
        else:
            (length,) = struct.unpack("=Q", file.read(8))
            raw = self._take(file, name, length)
        array = np.frombuffer(raw, kind)  # raises if it is no whole number of items
        if width > 1:
            array = array.reshape(-1, width)
        rows = {"Points": self.points, "CellData": self.cells}.get(name.split(".")[0])
        if name in ("Cells.offsets", "Cells.types", "Cells.faceoffsets"):
            rows = self.cells
        if rows is not None and len(array) != rows:
            raise _FileError(f"{name} has {len(array)} entries, expected {rows}")
        return array

    def _take(self, file, name: str, length: int) -> bytes:
        """Read `length` bytes, of which there are that many."""
        if length > self.size - file.tell():
            raise _FileError(f"{name} is cut off")
        self.there -= length
        if self.there < 0:
            raise _FileError("its arrays lie in each other")
        return file.read(length)

    def _blocks(self, file, name: str) -> Iterator[bytes]:
        count, block, partial = struct.unpack("=3Q", self._take(file, name, 24))
        if not 0 < block <= _BLOCK or partial >= block:
            raise _FileError(f"{name} is in blocks of {block} bytes")
        sizes = struct.unpack(f"={count}Q", self._take(file, name, 8 * min(count, self.size)))
        # Before any is expanded.
        self.left -= (count - 1) * block + (partial or block) if count else 0
        if self.left < 0:
            raise _FileError(f"it expands to more than {EXPANSION} times its size")
        for k, size in enumerate(sizes):
            expected = partial if k == count - 1 and partial else block
            part = zlib.decompressobj()
            data = part.decompress(self._take(file, name, size), expected)
            if len(data) != expected or part.decompress(part.unconsumed_tail, 1):
                raise _FileError(f"block {k} of {name} has not the length that its table says")
            yield data


def _assemble(
    arrays: dict[str, np.ndarray], names: dict[str, list[int]] | None
) -> Result | Diagram:
    vertices = arrays["Points."].astype(float)
    kinds = arrays["Cells.types"]
    if not len(kinds) or not len(vertices) or not np.isfinite(vertices).all():
        raise _FileError("it has no cells, or vertices that are not finite")
    if (kinds == 7).all():
        dim, (cell_starts, corners) = 2, _polygons(arrays, len(vertices))
        face_starts = None
    elif (kinds == 42).all():
        dim, (cell_starts, face_starts, corners) = 3, _polyhedra(arrays, len(vertices))
    else:
        raise _FileError("its cells are neither all polygons nor all polyhedra")
    lower, upper = vertices.min(axis=0)[:dim], vertices.max(axis=0)[:dim]
    if not (lower < upper).all():
        raise _FileError("its vertices lie on a line")
    polygon = _polygon(arrays, names) if dim == 2 else None
    periodic = "FieldData.box_periodic" in arrays
    if periodic:
        domain = _periodic_box(arrays, dim, names)
    else:
        domain = polygon or Box(tuple(lower), tuple(upper), names=names)
    x = np.ascontiguousarray(vertices[:, :dim])
    points = arrays["CellData.generator"][:, :dim].astype(float)
    owner = np.repeat(np.arange(len(kinds)), np.diff(cell_starts))
    if face_starts is None:
        following = np.arange(1, len(corners) + 1)
        following[cell_starts[1:] - 1] = cell_starts[:-1]
        loops = np.stack([corners, corners[following]], axis=1)
        if polygon is not None:
            faces = ~_bridges(arrays, owner, loops)
            owner, loops = owner[faces], loops[faces]
        face = np.repeat(np.arange(len(loops)), 2)
        flat, starts = loops.ravel(), 2 * np.arange(len(loops) + 1)
    else:
        flat, starts = corners, face_starts
        face = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    neighbors = _neighbors(owner, face, flat, starts, x, domain)
    if "FieldData.wall_faces" in arrays:
        _set_walls(arrays, neighbors, domain)
    across = _seam(arrays, neighbors, dim, len(kinds)) if periodic else {}
    known = {
        "points": points, "volumes": arrays["CellData.volume"].astype(float),
        "neighbor_starts": cell_starts, "neighbors": neighbors, "vertices": x,
        **across,
    }  # fmt: skip
    if polygon is not None:
        rows = np.bincount(owner, minlength=len(kinds))
        known["neighbor_starts"] = np.concatenate([[0], np.cumsum(rows)])
        known |= {"face_vertex_starts": starts, "face_vertices": flat}
    if face_starts is None:
        known |= {"cell_vertex_starts": cell_starts, "cell_vertices": corners}
    else:
        known |= {"face_vertex_starts": face_starts, "face_vertices": corners}
    # What the file does not hold is what its corners give.
    diagram = Diagram(domain, {**known, **rebuild(Diagram(domain, known))})
    check_repeated(arrays, diagram)
    if not {f"CellData.{name}" for name in ("size", "error", "quality")} & set(arrays):
        return diagram
    size, error, quality = (
        arrays[f"CellData.{name}"].astype(float) for name in ("size", "error", "quality")
    )
    return Result(
        points=points, diagram=diagram, target_size=size, size_error=error, quality=quality,
        history=np.zeros(0, HISTORY_DTYPE),
        converged=False, stop_reason="read from a .vtu file",
    )  # fmt: skip


def _periodic_box(
    arrays: dict[str, np.ndarray], dim: int, names: dict[str, list[int]] | None
) -> Box:
    """Return the periodic box that the file has."""
    corners = arrays["FieldData.box_corners"].reshape(2, 3)[:, :dim].astype(float)
    axes = arrays["FieldData.box_periodic"]
    if axes.shape != (dim,):
        raise _FileError("box_periodic has another number of directions")
    return Box(*corners.tolist(), periodic=tuple(bool(a) for a in axes), names=names)


def _seam(
    arrays: dict[str, np.ndarray], neighbors: np.ndarray, dim: int, n: int
) -> dict[str, np.ndarray]:
    """Put in the neighbors across the seams, whose faces share no corners, and return the shifts."""
    faces = _indices(arrays["FieldData.seam_faces"], len(neighbors), "seam_faces")
    others = _indices(arrays["FieldData.seam_neighbors"], n, "seam_neighbors")
    steps = arrays["FieldData.seam_shifts"].reshape(-1, 3)[:, :dim]
    if not len(faces) == len(others) == len(steps) or (np.abs(steps.astype(float)) > 1).any():
        raise _FileError("its seams do not fit its cells")
    neighbors[faces] = others
    shifts = np.zeros((len(neighbors), dim), np.int8)
    shifts[faces] = steps
    return {"shifts": shifts}


def _polygon(arrays: dict[str, np.ndarray], names: dict[str, list[int]] | None) -> Polygon | None:
    """Return the polygonal domain, if the file has one."""
    prefix = "FieldData.domain_"
    values = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    if not values:
        return None
    if "vertices" in values:
        values["vertices"] = values["vertices"].reshape(-1, 3)[:, :2]
    return Polygon.described(**values, names=names)


def _set_walls(arrays: dict[str, np.ndarray], neighbors: np.ndarray, domain: Domain) -> None:
    """Put in the edges behind faces on the boundary, as the file has them."""
    faces = _indices(arrays["FieldData.wall_faces"], len(neighbors), "wall_faces")
    edges = _indices(arrays["FieldData.wall_edges"], len(domain.boundary_index), "wall_edges")
    if len(faces) != len(edges):
        raise _FileError("its faces on walls do not fit each other")
    neighbors[faces] = -1 - edges


def _bridges(arrays: dict[str, np.ndarray], owner: np.ndarray, loops: np.ndarray) -> np.ndarray:
    """Tell which ways from corner to corner (m, 2) join loops of a cell, and are no faces.

    Where the file does not say it, those that their cell also goes back.
    """
    if "FieldData.bridges" in arrays:
        found = np.zeros(len(loops), bool)
        found[_indices(arrays["FieldData.bridges"], len(loops), "bridges")] = True
        return found
    low, high = loops.min(axis=1), loops.max(axis=1)
    order = np.lexsort((high, low, owner))
    same = np.all([np.diff(key[order]) == 0 for key in (owner, low, high)], axis=0)
    found = np.zeros(len(loops), bool)
    found[order[1:][same]] = found[order[:-1][same]] = True
    return found & (low < high)


def _indices(array: np.ndarray, bound: int, name: str) -> np.ndarray:
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise _FileError(f"{name} are no indices")
    if len(array) and not (array.min() >= 0 and array.max() < bound):
        raise _FileError(f"{name} point to what does not exist")
    return array.astype(np.int64)


def _starts(ends: np.ndarray, total: int, name: str) -> np.ndarray:
    starts = np.concatenate([[0], _indices(ends, total + 1, name)])
    if starts[-1] != total or (np.diff(starts) < 3).any():
        raise _FileError(f"{name} do not cut the list into cells")
    return starts


def _polygons(arrays: dict[str, np.ndarray], v: int) -> tuple[np.ndarray, np.ndarray]:
    corners = _indices(arrays["Cells.connectivity"], v, "corners")
    return _starts(arrays["Cells.offsets"], len(corners), "offsets"), corners


def _polyhedra(arrays: dict[str, np.ndarray], v: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Take the streams of faces apart: starts of cells in faces, of faces in corners, corners."""
    stream = _indices(arrays["Cells.faces"], max(v, len(arrays["Cells.faces"])), "faces")
    ends = _starts(arrays["Cells.faceoffsets"], len(stream), "faceoffsets")
    counts, cells = array("q"), array("q", [0])  # places of faces' numbers of corners
    for begin, end in pairwise(ends.tolist()):
        part = stream[begin:end].tolist()  # whose items are got at sooner
        at = 1
        for _ in range(part[0]):
            if at >= len(part):
                break
            counts.append(begin + at)
            at += 1 + part[at]
        if at != len(part) or len(counts) - cells[-1] != part[0]:
            raise _FileError("faces do not fit their cells")
        cells.append(len(counts))
    headers = np.array(counts, np.int64)
    faces = np.concatenate([[0], np.cumsum(stream[headers])])
    corners = np.delete(stream, np.concatenate([ends[:-1], headers]))
    return np.array(cells, np.int64), faces, _indices(corners, v, "corners of faces")


def _neighbors(
    owner: np.ndarray,
    face: np.ndarray,
    corners: np.ndarray,
    starts: np.ndarray,
    x: np.ndarray,
    domain: Domain,
) -> np.ndarray:
    """Return the cell behind each face: the one whose face has the same corners; or else the wall it lies on."""
    order = np.lexsort((corners, face))
    ragged = corners[order]
    sides = np.diff(starts)
    result = np.full(len(sides), np.iinfo(np.int64).min)
    for k in np.unique(sides):
        rows = np.flatnonzero(sides == k)
        if k < 2:
            raise _FileError("a face has fewer corners than it takes")
        keys = ragged[starts[rows][:, None] + np.arange(k)]
        by = np.lexsort(keys.T[::-1])
        same = (keys[by][1:] == keys[by][:-1]).all(axis=1)
        a, b = rows[by[:-1][same]], rows[by[1:][same]]
        result[a], result[b] = owner[b], owner[a]
    alone = np.flatnonzero(result < 0)
    middle = (
        np.stack([np.bincount(face, x[corners, k], len(sides)) for k in range(x.shape[1])], axis=1)[
            alone
        ]
        / sides[alone][:, None]
    )
    if isinstance(domain, Polygon):
        result[alone] = -1 - domain.nearest_edge(middle)[0]
        return result
    gaps = np.stack([middle - domain.lower, domain.upper - middle], axis=2)
    gaps[:, np.array(domain.periodic)] = np.inf  # these are seams
    gaps = gaps.reshape(len(alone), -1)
    result[alone] = -1 - gaps.argmin(axis=1)
    return result
