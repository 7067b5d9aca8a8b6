"""The arrays of a `.vtu` file.

The XML parser refuses document types and entities, so that nothing is expanded or fetched. The size of each array is
known from the numbers of points and cells, or bounded by the size of the file, before memory is allocated.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Iterator
from typing import NoReturn
from xml.parsers import expat

import numpy as np

from ..arrays import EXPANSION, LEAST, FileError
from ..vtu import SOLVER_MESH

LONGEST_HEAD = 1 << 22
MARK = b'<AppendedData encoding="raw">\n_'
END = b"\n</AppendedData>\n</VTKFile>\n"
_TYPES = {"Float64": "f8", "Float32": "f4", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}
_BLOCK = 1 << 20
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
    "CellData.label",
    "CellData.sides",
    "CellData.faces_of_cell",
    "FieldData.domain",
    "FieldData.border_faces",
    "FieldData.border_neighbors",
    "FieldData.border_shifts",
    "FieldData.bridges",
}


class FileReader:
    """The head of a file: its arrays and their places."""

    def __init__(self, head: bytes, start: int, size: int) -> None:
        self.start, self.size = start, size
        self.left = max(LEAST, EXPANSION * size)  # bytes that arrays may still expand to
        self.there = size  # bytes of the file that no array has used
        self.points = self.cells = -1
        self.compressed = False
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
            compressor = given.get("compressor")
            if compressor not in (None, "vtkZLibDataCompressor"):
                raise FileError(f"its compressor is {compressor!r:.60}")
            self.compressed = compressor is not None
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
        used = {name: entry for name, entry in self.entries.items() if name in _USED}
        return {name: self._read(file, name, *entry) for name, entry in used.items()}

    def _read(self, file, name: str, kind: str, width: int, offset: int) -> np.ndarray:
        if not 0 <= offset <= self.size - self.start - 8:
            raise FileError(f"{name} is beyond the end of the file")
        file.seek(self.start + offset)
        if self.compressed:
            raw = bytearray()
            for block in self._blocks(file, name):
                raw += block
        else:
            (length,) = struct.unpack("=Q", file.read(8))
            raw = self._take(file, name, length)
        array = np.frombuffer(raw, kind)  # raises unless the length is a multiple of the item size
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
