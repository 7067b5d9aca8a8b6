"""Fields of OpenFOAM, as files: text and binary, compressed or not."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import orjson

from ..io.arrays import FileError, explained
from ..io.atomic import atomic_file
from ..io.foam_read import read_with_head

WIDTHS = {"scalar": 1, "vector": 3, "sphericalTensor": 1, "symmTensor": 6, "tensor": 9}
"""Numbers of the components of a value, by its type."""
_BLANK = re.compile(rb"(?:\s+|//[^\n]*|/\*.*?\*/)*", re.DOTALL)
_NAME = re.compile(rb'"[^"]*"|[^\s{};"]+')
_LIST = re.compile(rb"nonuniform\s+(?:List<(\w+)>\s*)?(\d+)\s*")
_UNIFORM = re.compile(rb"uniform\s+([^;]*)")
_FOR_OPENFOAM = "which only OpenFOAM reads; run the solver first, which writes numbers"
_BYTE_ORDER = {"little": "LSB", "big": "MSB"}[sys.byteorder]


@dataclass(frozen=True)
class Values:
    """A value of each cell or face, or one for all of them.

    Attributes
    ----------
    kind : str
        Type of a value, such as "vector".
    numbers : (n, k) float64
        One row if `uniform`.
    uniform : bool
    """

    kind: str
    numbers: np.ndarray
    uniform: bool

    def rows(self, n: int) -> np.ndarray:
        """Return the values of n cells, (n, k).

        Raises
        ------
        FileError
            If there are others than n.
        """
        if self.uniform:
            return np.repeat(self.numbers, n, axis=0)
        if len(self.numbers) != n:
            raise FileError(f"it has {len(self.numbers)} values, expected {n}: one for each cell or face of the mesh")
        return self.numbers

    def pieces(self, binary: bool) -> Iterator[bytes]:
        """Yield the entry as a file has it."""
        if self.uniform:
            yield b"uniform " + _item(self.numbers[0])
            return
        yield b"nonuniform List<%b> %d\n" % (self.kind.encode(), len(self.numbers))
        if binary and len(self.numbers):
            yield b"(" + np.ascontiguousarray(self.numbers, np.float64).tobytes() + b")\n"
            return
        text = orjson.dumps(np.ascontiguousarray(self.numbers), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        if self.numbers.shape[1] == 1:
            text = text.replace(b"[", b"").replace(b"]", b"").replace(b",", b"\n")
        else:
            text = text.replace(b"],[", b")\n(").replace(b"[", b"(").replace(b"]", b")").replace(b",", b" ")
        yield b"(\n" + text + b"\n)\n"


Entries = dict[str, "bytes | Values | Entries"]


@dataclass(frozen=True)
class FoamField:
    """A field in cells (``volScalarField``, ...) or on faces (``surfaceScalarField``, ...).

    Attributes
    ----------
    name, kind : str
        Name of the file, and ``class`` in its head.
    binary : bool
    entries : dict
        Everything else in its order: text as it is, `Values` and dictionaries. ``entries["internalField"]`` are the
        values, ``entries["boundaryField"]`` those of the patches.
    """

    name: str
    kind: str
    binary: bool
    entries: Entries

    @property
    def in_cells(self) -> bool:
        """Whether it has a value for each cell."""
        return self.kind.startswith("vol") and self.type in WIDTHS

    @property
    def type(self) -> str:
        """Type of a value, such as "vector"; empty for files that are no field."""
        found = re.fullmatch(r"(?:vol|surface)(\w+)Field", self.kind)
        return found[1][0].lower() + found[1][1:] if found else ""

    @property
    def internal(self) -> Values:
        """The values of cells, or of inner faces."""
        values = self.entries.get("internalField")
        if not isinstance(values, Values):
            raise FileError(f"the field {self.name} has no internalField with numbers")
        return replace(values, kind=self.type)

    @property
    def patches(self) -> dict[str, Entries]:
        """The entries of each patch, by name or pattern."""
        found = self.entries.get("boundaryField")
        return {k: v for k, v in found.items() if isinstance(v, dict)} if isinstance(found, dict) else {}

    @property
    def dimensions(self) -> tuple[float, ...]:
        """Exponents of kg, m, s, K, mol, A, cd."""
        text = self.entries.get("dimensions")
        return tuple(map(float, text.strip(b"[] ").split())) if isinstance(text, bytes) else ()

    def write(self, path: Path, location: str) -> None:
        """Write the field to the file `path`, as text or in bytes as it was read."""
        form = f'binary;\n    arch        "{_BYTE_ORDER};label=32;scalar=64"' if self.binary else "ascii"
        head = (
            f"FoamFile\n{{\n    version     2.0;\n    format      {form};\n    class       {self.kind};\n"
            f'    location    "{location}";\n    object      {self.name};\n}}\n\n'
        )
        with atomic_file(path) as file:
            file.write(head.encode())
            file.writelines(_written(self.entries, self.binary, 0))


def read_field(path: Path) -> FoamField:
    """Read a field, or ``path.gz``.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with explained(path, "a field of OpenFOAM"):
        head, text, begin = read_with_head(path)
        if not begin:
            raise FileError("it has no head FoamFile, expected a field of OpenFOAM; move other files to another folder")
        scalar = "<f4" if "scalar=32" in head.get("arch", "") else "<f8"
        binary = head.get("format") == "binary"
        kind = head.get("class", "")
        made = FoamField(path.name.removesuffix(".gz"), kind, binary, {})
        if made.type:
            made = replace(made, entries=_Reader(text, scalar if binary else "", made.type).entries(begin)[0])
        if made.in_cells:
            _ = made.internal  # before anything is made of it
        return made


class _Reader:
    """Reads the entries of a file. `scalar`: type of numbers in bytes, empty for text; `type`: of uniform values."""

    def __init__(self, text: bytes, scalar: str, type: str) -> None:
        self.text, self.scalar, self.type = text, scalar, type

    def skip(self, at: int) -> int:
        found = _BLANK.match(self.text, at)
        return found.end() if found else at

    def entries(self, at: int) -> tuple[Entries, int]:
        """Return the entries from `at` to the end of their dictionary, and where that is."""
        made: Entries = {}
        at = self.skip(at)
        while at < len(self.text) and self.text[at : at + 1] != b"}":
            if self.text[at : at + 1] == b";":
                at = self.skip(at + 1)
                continue
            if self.text[at : at + 1] == b"#":
                raise FileError(f"it has an entry that begins with #, {_FOR_OPENFOAM}")
            found = _NAME.match(self.text, at)
            if found is None:
                raise FileError(f"it cannot be read at byte {at}")
            name, at = found[0].decode("utf-8", "replace"), self.skip(found.end())
            if self.text[at : at + 1] == b"{":
                made[name], at = self.entries(at + 1)
                if self.text[at : at + 1] != b"}":
                    raise FileError(f"the entry {name} has no end")
                at = self.skip(at + 1)
            else:
                made[name], at = self.value(at)
                at = self.skip(at)
        return made, at

    def value(self, at: int) -> tuple[bytes | Values, int]:
        """Return the value of an entry, and where it ends."""
        found = _LIST.match(self.text, at)
        if found is not None:
            return self.list(found[1], int(found[2]), found.end())
        end = self.text.find(b";", at)
        if end < 0:
            raise FileError("an entry has no ; at its end")
        whole = self.text[at:end].strip()
        uniform = _UNIFORM.fullmatch(whole)
        if uniform is not None and b"$" in whole:
            raise FileError(f"it has a value that begins with $, {_FOR_OPENFOAM}")
        if uniform is not None and self.type in WIDTHS:
            numbers = uniform[1].replace(b"(", b" ").replace(b")", b" ").split()
            if len(numbers) == WIDTHS[self.type]:
                return Values(self.type, np.array([numbers], float), True), end + 1
        return whole, end + 1

    def list(self, kind: bytes | None, count: int, at: int) -> tuple[Values, int]:
        name = kind.decode() if kind else self.type or "scalar"
        if name not in WIDTHS:
            raise FileError(f"it has values of type {name}, expected {', '.join(WIDTHS)}")
        width = WIDTHS[name]
        start = self.text[at : at + 1]
        if start == b"{" or (count == 0 and start != b"("):
            end = self.text.find(b";", at)
            numbers = self.text[at:end].translate(None, b"{}()").split()
            rows = np.repeat(np.array([numbers], float), count, axis=0) if count else np.zeros((0, width))
        elif self.scalar:
            size = count * width * np.dtype(self.scalar).itemsize
            rows = np.frombuffer(self.text, self.scalar, count * width, at + 1).astype(float)
            end = self.text.find(b";", at + 1 + size)
        else:
            close = re.compile(rb"\)\s*;").search(self.text, at)
            if close is None:
                raise FileError("a list of numbers has no end")
            end = self.text.find(b";", close.start())
            rows = np.array(self.text[at : close.start()].translate(bytes.maketrans(b"()", b"  ")).split(), float)
        if rows.size != count * width:
            raise FileError(f"a list has {rows.size} numbers, expected {count * width}")
        return Values(name, rows.reshape(count, width), False), end + 1


def _item(row: np.ndarray) -> bytes:
    text = " ".join(map(repr, row.tolist())).encode()
    return text if len(row) == 1 else b"(" + text + b")"


def _written(entries: Entries, binary: bool, indent: int) -> Iterator[bytes]:
    """Yield the entries as a file has them."""
    tab = b" " * indent
    for name, value in entries.items():
        yield tab + name.encode()
        if isinstance(value, dict):
            yield b"\n" + tab + b"{\n"
            yield from _written(value, binary, indent + 4)
            yield tab + b"}\n"
            continue
        yield b" "
        if isinstance(value, Values):
            yield from value.pieces(binary)
        else:
            yield value
        yield b";\n"
