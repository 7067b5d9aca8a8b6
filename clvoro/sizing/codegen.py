"""Generate OpenCL from a size field: the text of a function `size_at`, and the numbers that it reads."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..opencl.program import source_text

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

    from ..geometry.domain import Domain
    from ..opencl.engine import Engine
    from .field import Field


class CodeWriter:
    """Collects the statements of `size_at` and the numbers that they read.

    - `dim`: int
    - `origin`: (d,) float
    - `scale`: the device sees x' = (x - origin) / scale and h' = h / scale.
    - `real`: precision in which the device reads the numbers.
    - `domain`: Box, Polygon, Sphere or Solid
    - `engine`: engine for fields that are computed in advance; None for the default device.
    - `peak_bytes`: device memory that this computation took at most.
    """

    def __init__(self, domain: Domain, real: np.dtype, engine: Engine | None = None):
        self.dim, self.domain, self.engine = domain.dim, domain, engine
        self.origin, self.scale = domain.frame
        self.real = np.dtype(real)
        self.peak_bytes = 0
        self.statements: list[str] = []
        self.functions: list[str] = []
        self._numbers: list[np.ndarray] = []
        self._stored = 0
        self._names = 0
        self._whole: CodeWriter | None = None

    def normalize(self, points: np.ndarray) -> np.ndarray:
        """Return physical `points` (..., d) in the device's coordinates, still in float64."""
        return (points - self.origin) / self.scale

    def in_plane(self, domain: Domain) -> CodeWriter:
        """Return a writer for a part of the field in another, plane domain, whose coordinates are not normalized.

        Its numbers are stored here; its statements become a function by `function`.
        """
        inner = CodeWriter(domain, self.real, self.engine)
        inner.origin, inner.scale, inner._whole = np.zeros(domain.dim), 1.0, self
        return inner

    def function(self, statements: list[str], result: str) -> str:
        """Add a function of `statements` of a plane part, and return its name."""
        name = f"plane_part_{self.name()}"
        body = "\n".join(f"    {line}" for line in statements)
        self.functions.append(
            f"REAL {name}(const REAL *x, __global const REAL *data)\n{{\n{body}\n    return {result};\n}}\n"
        )
        return name

    def store(self, *numbers: object) -> int:
        """Append `numbers` (scalars and arrays, flattened) to the data; return the index of the first one."""
        if self._whole is not None:
            return self._whole.store(*numbers)
        begin = self._stored
        for part in numbers:
            flat = np.ravel(np.asarray(part, dtype=float))
            self._numbers.append(flat)
            self._stored += flat.size
        return begin

    def name(self) -> str:
        """Return an unused variable name."""
        self._names += 1
        return f"s{self._names}"

    def variable(self, value: str) -> str:
        """Add `const REAL name = value;` and return the name."""
        name = self.name()
        self.statements.append(f"const REAL {name} = {value};")
        return name

    def data(self) -> np.ndarray:
        """Return all numbers in the device's precision, clipped to its range."""
        packed = np.concatenate([*self._numbers, np.zeros(1)])
        largest = float(np.finfo(self.real).max)
        return np.clip(packed, -largest, largest).astype(self.real)


class DeviceCode(NamedTuple):
    """A size field as OpenCL."""

    prelude: str
    """OpenCL text that defines ``REAL size_at(const REAL *x, __global const REAL *data)``: h' = h / scale at x' = (x -
    origin) / scale. It is an argument of `Engine.kernels` and needs only DIM and REAL."""
    data: np.ndarray
    """(m,) real. The argument `data` of `size_at`."""
    peak_bytes: int
    """Peak device memory of the computation."""


def generate_code(
    field: Field, domain: Domain, real: DTypeLike = np.float64, engine: Engine | None = None
) -> DeviceCode:
    """Return `field` as OpenCL for the normalized coordinates of `domain`.

    Geometry is converted to these coordinates in float64, so that float32 is as accurate far from the origin as near
    it. Only `Expression` computes in physical coordinates.

    Parameters
    ----------
    field : Field
    domain : Box, Polygon, Sphere or Solid
    real : dtype
        The engine's precision.
    engine : Engine, optional
        Engine for fields that are computed in advance (`Graded`); by default a new one on the default device.

    Raises
    ------
    InputError
        If the dimensions of field and domain differ, or the field has no device form.
    """
    field.check_dim(domain.dim)
    writer = CodeWriter(domain, np.dtype(real), engine)
    result = field._emit(writer)
    if writer._stored >= 2**31:
        raise InputError(
            f"the size field holds {writer._stored} numbers, expected fewer than 2^31; use a coarser Raster"
        )
    body = "\n".join(f"    {line}" for line in writer.statements)
    plane = _plane_text(writer.functions, writer.dim) if writer.functions else ""
    prelude = (
        f'{source_text("sizing/size_fields.h")}\n{plane}#line 1 "size_at"\n'
        "REAL size_at(const REAL *x, __global const REAL *data)\n"
        f"{{\n{body}\n    return {result};\n}}\n"
    )
    return DeviceCode(prelude, writer.data(), writer.peak_bytes)


def _plane_text(functions: list[str], dim: int) -> str:
    """Return `functions` of plane parts, with the building blocks of size fields for two dimensions before them."""
    text = source_text("sizing/size_fields.h")
    plane = re.sub(r"\bsize_", "plane_size_", "\n".join([text, *functions]))
    return f"#undef DIM\n#define DIM 2\n{plane}#undef DIM\n#define DIM {dim}\n"
