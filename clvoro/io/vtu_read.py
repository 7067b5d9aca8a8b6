"""Read the `.vtu` files that `vtu` writes, without trusting them.

The XML parser refuses document types and entities, so that nothing is expanded or fetched. The size of each array is
known from the numbers of points and cells, or bounded by the size of the file, before memory is allocated.
"""

from __future__ import annotations

import json
import os
import re
import struct
import sys
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping
from io import BufferedReader
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat
from xml.sax.saxutils import unescape

import numpy as np

from ..connectivity import following, rows_of, starts_of
from ..files import open_plain
from ..geometry.domain import Domain
from ..mesh.check.rebuilt import rebuild, rebuild_on_sphere
from ..mesh.diagram import Diagram
from ..mesh.results import Result, result_of_file
from ..mesh.straightening import cell_quality
from .arrays import EXPANSION, LEAST, FileError, explained
from .contents import DOMAIN, described
from .vtu import KINDS, SOLVER_MESH

LONGEST_HEAD = 1 << 22
MARK = b'<AppendedData encoding="raw">\n_'
END = b"\n</AppendedData>\n</VTKFile>\n"
_TYPES = {"Float64": "f8", "Float32": "f4", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}
_BLOCK = 1 << 20
_SAME_VOLUME = 1e-3
"""Largest relative difference between the volume of a cell in a float32 file and that of the cell made anew."""
_USED = {
    "Points.",
    "Cells.types",
    "Cells.connectivity",
    "Cells.offsets",
    "Cells.faces",
    "Cells.faceoffsets",
    "CellData.size",
    "CellData.error",
    "CellData.quality",
    "CellData.volume",
    "CellData.generator",
    "CellData.weight",
    "CellData.layer",
    "CellData.label",
    "CellData.sides",
    "CellData.faces_of_cell",
    "FieldData.domain",
    "FieldData.neighbors",
    "FieldData.shifts",
    "FieldData.bridges",
}

_TOPOLOGY = {"generator", "weight", "label", "sides", "faces_of_cell"}
"""Cell data that are no fields, and so are those that begin with ``boundary:``."""


class FileReader:
    """The head of a file: its arrays and their places."""

    def __init__(self, head: bytes, start: int, size: int) -> None:
        self.start, self.size = start, size
        self.left = max(LEAST, EXPANSION * size)  # bytes that arrays may still expand to
        self.there = size  # bytes of the file that no array has used
        self.points = self.cells = -1
        self.entries: dict[str, tuple[str, int, int]] = {}
        self._within: list[str] = []
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._refuse
        parser.EntityDeclHandler = self._refuse
        parser.StartElementHandler = self._element
        parser.EndElementHandler = lambda _: self._within.pop()
        parser.CommentHandler = self._comment
        try:
            parser.Parse(head, False)
        except expat.ExpatError as error:
            raise FileError(f"it is damaged or not from clvoro ({error})") from error
        if min(self.points, self.cells) < 0:
            raise FileError("it has no piece with points and cells")

    def _refuse(self, *_: object) -> NoReturn:
        raise FileError("it declares a document type or entities, which files of clvoro do not")

    def _comment(self, text: str) -> None:
        if text.strip() == SOLVER_MESH:
            raise FileError(
                "it holds the mesh for solvers, which is no diagram; load a .npz file, or a .vtu file with exact walls"
            )

    def _element(self, tag: str, given: dict[str, str]) -> None:
        if tag == "VTKFile":
            native = f"{sys.byteorder.title()}Endian"
            if given.get("type") != "UnstructuredGrid" or given.get("byte_order") != native:
                raise FileError(f"it is not an UnstructuredGrid in {native}")
            if given.get("header_type") != "UInt64":
                raise FileError("its header_type is not UInt64")
            if given.get("compressor") != "vtkZLibDataCompressor":
                raise FileError(f"its compressor is {given.get('compressor')!r:.60}")
        elif tag == "Piece":
            self.points, self.cells = int(given["NumberOfPoints"]), int(given["NumberOfCells"])
        elif tag == "DataArray":
            group = self._within[-1] if self._within else ""
            name = given.get("Name", "") if group != "Points" else ""
            if given.get("format") != "appended" or given["type"] not in _TYPES:
                raise FileError(f"its array {name!r:.60} is not appended, or of an unknown type")
            width = int(given.get("NumberOfComponents", "1"))
            key = f"{group}.{name}"
            if width not in (1, 3) and key in _USED:
                raise FileError(f"its array {name!r:.60} has {width} components")
            if key in self.entries:
                raise FileError(f"it has two arrays {key!r:.60}")
            self.entries[key] = (_TYPES[given["type"]], width, int(given["offset"]))
        self._within.append(tag)

    def read_all(self, file) -> dict[str, np.ndarray]:
        """Return the arrays that a mesh needs, by group and name."""
        return {name: self.read(file, name) for name in self.entries if name in _USED}

    def read(self, file, name: str) -> np.ndarray:
        """Return an array by group and name."""
        kind, width, offset = self.entries[name]
        if not 0 <= offset <= self.size - self.start - 8:
            raise FileError(f"{name} is beyond the end of the file")
        file.seek(self.start + offset)
        array = np.frombuffer(
            b"".join(self._blocks(file, name)), kind
        )  # raises unless the length is a multiple of the item size
        if width > 1:
            array = array.reshape(-1, width)
        rows = {"Points": self.points, "CellData": self.cells}.get(name.split(".")[0])
        if name in ("Cells.offsets", "Cells.types", "Cells.faceoffsets"):
            rows = self.cells
        if rows is not None and len(array) != rows:
            raise FileError(f"{name} has {len(array)} entries, expected {rows}")
        return array

    def _take(self, file, name: str, length: int) -> bytes:
        """Read `length` bytes; refuse more than the file has, and bytes of other arrays."""
        if length > self.size - file.tell():
            raise FileError(f"{name} is truncated")
        self.there -= length
        if self.there < 0:
            raise FileError("its arrays overlap")
        return file.read(length)

    def _blocks(self, file, name: str) -> Iterator[bytes]:
        count, block, partial = struct.unpack("=3Q", self._take(file, name, 24))
        if not 0 < block <= _BLOCK or partial >= block:
            raise FileError(f"{name} has blocks of {block} bytes")
        sizes = struct.unpack(f"={count}Q", self._take(file, name, 8 * min(count, self.size)))
        # Checked before any block is expanded.
        self.left -= (count - 1) * block + (partial or block) if count else 0
        if self.left < 0:
            raise FileError(f"it expands to more than {EXPANSION} times its size")
        for k, size in enumerate(sizes):
            expected = partial if k == count - 1 and partial else block
            part = zlib.decompressobj()
            data = part.decompress(self._take(file, name, size), expected)
            if len(data) != expected or part.decompress(part.unconsumed_tail, 1):
                raise FileError(f"block {k} of {name} does not have the length in its table")
            yield data


_OFF_SURFACE = 1e-5
"""Largest distance of a position from a curved domain in units of its size: round-off of float32, and more."""


def load_vtu(path: str | PathLike[str]) -> Result | Diagram:
    """Read the cells and cell data of a `.vtu` file of `Result.save` or `Diagram.save`, with any domain.

    Domain, graph, volumes, sizes, errors and quality are those of the file. Other measures are computed again from the
    corners of the cells. The history is empty.
    """
    with explained(path, "a .vtu file that save wrote"):
        with open_plain(path) as file:
            arrays = _open(file).read_all(file)
        return _assemble(arrays)


def load_pvtu(path: str | PathLike[str], tessellate: Callable[[Domain, np.ndarray], Diagram]) -> Result | Diagram:
    """Read the mesh of all ranks from a `.pvtu` file of `Result.save` and its pieces, rank by rank.

    Generators, sizes and errors are those of the pieces, and so is the quality, but for polygons: where cells meet in a
    concave corner, round-off decides which ones share a face. `tessellate` makes the cells again, since walls bound
    those of a piece. The mesh of a single process is its piece.
    """
    with explained(path, "a .pvtu file that save wrote"):
        with open_plain(path) as file:
            text = file.read(LONGEST_HEAD).decode()
        sources = [unescape(name[1:-1], {"&quot;": '"'}) for name in re.findall("<Piece Source=(.*)/>", text)]
        said = re.search(f"<!--{DOMAIN}(.*)-->", text)
        if said is None or not sources or any(Path(name).name != name for name in sources):
            raise FileError("it has no domain, or no pieces beside it; it is not from clvoro, or an earlier version")
        pieces = [load_vtu(Path(path).with_name(name)) for name in sources]
        if len(pieces) == 1:
            return pieces[0]
        results = [piece for piece in pieces if isinstance(piece, Result)]
        points, volumes, sizes, errors, quality = (
            np.concatenate([getattr(piece, name) for piece in results])
            for name in ("points", "volumes", "target_size", "size_error", "quality")
        )
        diagram = tessellate(described(json.loads(said[1])), points)
        if not np.allclose(diagram.volumes, volumes, rtol=_SAME_VOLUME):
            raise FileError("its pieces are not those of one mesh; save it again")
        if diagram.domain.cuts_cells:
            quality = cell_quality(diagram, np.empty(0))
        return result_of_file(diagram, sizes, errors, quality, ".pvtu")


def cell_data_of_vtu(path: str | PathLike[str]) -> dict[str, np.ndarray] | None:
    """Return the fields among the cell data of a file of clvoro, by name; None for files of other programs."""
    with open_plain(path) as file:
        try:
            reader = _open(file)
        except FileError:
            return None
        if "FieldData.domain" not in reader.entries:
            return None
        names = [key.removeprefix("CellData.") for key in reader.entries if key.startswith("CellData.")]
        fields = [name for name in names if name not in _TOPOLOGY and not name.startswith("boundary:")]
        return {name: reader.read(file, f"CellData.{name}").astype(float) for name in fields}


def _open(file: BufferedReader) -> FileReader:
    """Return the head of a file of clvoro."""
    head = file.read(LONGEST_HEAD)
    end = head.find(MARK)
    if end < 0:
        raise FileError("it has no appended raw data, which files of clvoro have")
    start = end + len(MARK)
    size = os.fstat(file.fileno()).st_size
    file.seek(max(0, size - len(END)))
    if file.read() != END:
        raise FileError("it is truncated, or has bytes behind its end")
    return FileReader(head[:end], start, size)


def _assemble(arrays: dict[str, np.ndarray]) -> Result | Diagram:
    vertices, n = arrays["Points."].astype(float), len(arrays["Cells.types"])
    if not n or not len(vertices) or not np.isfinite(vertices).all():
        raise FileError("it has no cells, or vertices that are not finite")
    if "FieldData.domain" not in arrays:
        raise FileError("it has no domain; it is not from clvoro, or from an earlier version: load its .npz file")
    domain = described(json.loads(arrays["FieldData.domain"].tobytes()))
    if not (arrays["Cells.types"] == KINDS[domain.cell_dim].number).all():
        raise FileError(f"its cells are not those of a mesh in {domain}")
    x = np.ascontiguousarray(vertices[:, : domain.dim])
    points = np.ascontiguousarray(arrays["CellData.generator"][:, : domain.dim].astype(float))
    for name, places in (("vertices", x), ("generators", points)) if domain.curved else ():
        off = np.linalg.norm(domain.nearest(places) - places, axis=1)
        if not (off < _OFF_SURFACE * domain.frame[1]).all():
            raise FileError(f"its {name} are not on the {domain}")
    known = _READERS[domain.cell_dim](arrays, len(x), domain)
    known |= {"points": points, "volumes": arrays["CellData.volume"].astype(float), "vertices": x}
    known |= _graph(arrays, Diagram(domain, known))
    if "CellData.weight" in arrays:
        known["weights"] = arrays["CellData.weight"].astype(float)
    if "CellData.layer" in arrays:
        known["layer"] = arrays["CellData.layer"].astype(np.int16)
    # The other arrays follow from the corners.
    rest = rebuild_on_sphere if domain.curved else rebuild
    diagram = Diagram(domain, {**known, **rest(Diagram(domain, known))})
    _check_repeated(arrays, diagram)
    of_run = [f"CellData.{name}" for name in ("size", "error", "quality")]
    if not set(of_run) & set(arrays):
        return diagram
    return result_of_file(diagram, *(arrays[name].astype(float) for name in of_run), kind=".vtu")


def _cell_polygons(arrays: Mapping[str, np.ndarray], v: int, domain: Domain) -> dict[str, np.ndarray]:
    """Return the diagram's arrays of cells and faces in 2D."""
    corners = _indices(arrays["Cells.connectivity"], v, "corners")
    starts = _starts(arrays["Cells.offsets"], len(corners), "offsets")
    found = {"cell_vertex_starts": starts, "cell_vertices": corners, "neighbor_starts": starts}
    if domain.cuts_cells:
        kept = np.ones(len(corners), bool)
        kept[_indices(arrays["FieldData.bridges"], len(corners), "bridges")] = False
        ends = np.stack([corners, corners[following(starts)]], axis=1)[kept]
        counts = np.bincount(rows_of(starts)[kept], minlength=len(starts) - 1)
        found["neighbor_starts"] = starts_of(counts)
        found |= {"face_vertex_starts": 2 * np.arange(len(ends) + 1), "face_vertices": ends.ravel()}
    return found


def _graph(arrays: Mapping[str, np.ndarray], d: Diagram) -> dict[str, np.ndarray]:
    """Return the neighbors, and in a periodic box the shifts."""
    walls, m = len(d.domain.boundary_index), len(d.half_faces.owner)
    found = {"neighbors": _indices(arrays["FieldData.neighbors"] + walls, len(d) + walls, "neighbors") - walls}
    if any(d.domain.periodic):
        shifts = arrays["FieldData.shifts"]
        if shifts.shape[1:] != (3,) or (np.abs(shifts.astype(float)) > 1).any():
            raise FileError("its shifts are other numbers than -1, 0 and 1 for each axis")
        found["shifts"] = shifts[:, : d.domain.dim].astype(np.int8)
    for name, rows in found.items():
        if len(rows) != m:
            raise FileError(f"its {name} are {len(rows)}, expected one for each of {m} faces")
    return found


def _indices(array: np.ndarray, bound: int, name: str) -> np.ndarray:
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise FileError(f"{name} are not indices")
    if len(array) and not (array.min() >= 0 and array.max() < bound):
        raise FileError(f"{name} have an index out of range")
    return array.astype(np.int64)


def _starts(ends: np.ndarray, total: int, name: str) -> np.ndarray:
    starts = np.concatenate([[0], _indices(ends, total + 1, name)])
    if starts[-1] != total or (np.diff(starts) < 3).any():
        raise FileError(f"{name} do not divide the list into cells")
    return starts


def _cell_polyhedra(arrays: Mapping[str, np.ndarray], v: int, domain: Domain) -> dict[str, np.ndarray]:
    """Return the diagram's arrays of faces in 3D."""
    del domain
    stream = _indices(arrays["Cells.faces"], max(v, len(arrays["Cells.faces"])), "faces")
    ends = _starts(arrays["Cells.faceoffsets"], len(stream), "faceoffsets")
    counts, cells = array("q"), array("q", [0])  # places of the corner counts of faces
    for begin, end in pairwise(ends.tolist()):
        part = stream[begin:end].tolist()  # faster to index than an array
        at = 1
        for _ in range(part[0]):
            if at >= len(part):
                break
            counts.append(begin + at)
            at += 1 + part[at]
        if at != len(part) or len(counts) - cells[-1] != part[0]:
            raise FileError("faces differ from the counts of their cells")
        cells.append(len(counts))
    headers = np.array(counts, np.int64)
    faces = starts_of(stream[headers])
    corners = np.delete(stream, np.concatenate([ends[:-1], headers]))
    return {
        "neighbor_starts": np.array(cells, np.int64),
        "face_vertex_starts": faces,
        "face_vertices": _indices(corners, v, "corners of faces"),
    }


_READERS = {2: _cell_polygons, 3: _cell_polyhedra}


def _check_repeated(arrays: Mapping[str, np.ndarray], diagram: Diagram) -> None:
    """Check the `arrays` of a file that are not needed to make its `diagram` against that diagram.

    Raises `FileError` that names the first array that differs.
    """
    kind = KINDS[diagram.domain.cell_dim]
    expected = {f"Cells.{name}": values for name, values in kind.topology(diagram).items()}
    expected |= {"CellData.label": np.arange(len(diagram)), f"CellData.{kind.counts}": kind.count(diagram)}
    given = {name: arrays[name] for name in expected}
    for name in ("Points.", "CellData.generator"):
        given[f"z of {name}"] = rest = arrays[name][:, diagram.domain.dim :].ravel()
        expected[f"z of {name}"] = np.zeros(len(rest))
    for name, values in expected.items():
        if given[name].shape != values.shape:
            raise FileError(f"{name} has shape {given[name].shape}, expected {values.shape}")
        wrong = np.flatnonzero(given[name] != values)
        if len(wrong):
            k = wrong[0]
            raise FileError(f"{name} is {given[name][k]} at {k}, expected {values[k]}")
