"""From a tree of fields to OpenCL: the text of a function `size_at`, and its numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError
from ..opencl.program import source_text

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

    from ..geometry.box import Domain
    from ..opencl.program import Engine
    from .field import Field


class Binder:
    """Collects the statements of `size_at` and the numbers that they read.

    Attributes
    ----------
    dim : int
    origin : (d,) float
    scale : float
        The device sees x' = (x - origin) / scale and h' = h / scale.
    real : numpy.dtype
        Precision in which the device reads the numbers.
    domain : Domain
    engine : Engine or None
        Where a field that has to be computed first is computed; None for the default device.
    taken : int
        Bytes that this has taken there.
    """

    def __init__(self, domain: Domain, real: np.dtype, engine: Engine | None = None):
        self.dim, self.domain, self.engine = domain.dim, domain, engine
        self.origin, self.scale = domain.frame
        self.real = np.dtype(real)
        self.taken = 0
        self.statements: list[str] = []
        self._numbers: list[np.ndarray] = []
        self._stored = 0
        self._names = 0

    def normalize(self, points: np.ndarray) -> np.ndarray:
        """Return physical `points` (..., d) in the device's coordinates, still in float64."""
        return (points - self.origin) / self.scale

    def store(self, *numbers: object) -> int:
        """Append `numbers` (scalars and arrays, flattened) to the data; return where they begin."""
        begin = self._stored
        for part in numbers:
            flat = np.ravel(np.asarray(part, dtype=float))
            self._numbers.append(flat)
            self._stored += flat.size
        return begin

    def name(self) -> str:
        """Return a fresh variable name."""
        self._names += 1
        return f"s{self._names}"

    def variable(self, value: str) -> str:
        """Add `const REAL name = value;` and return the name."""
        name = self.name()
        self.statements.append(f"const REAL {name} = {value};")
        return name

    def data(self) -> np.ndarray:
        """Return all numbers in the device's precision, cut to its largest number."""
        packed = np.concatenate([*self._numbers, np.zeros(1)])
        largest = float(np.finfo(self.real).max)
        return np.clip(packed, -largest, largest).astype(self.real)


class Bound(NamedTuple):
    """A size field as OpenCL.

    Attributes
    ----------
    prelude : str
        OpenCL text that defines ``REAL size_at(const REAL *x, __global const REAL *data)``, h' = h
        / scale at x' = (x - origin) / scale. Give it to `Engine.kernels(stage, prelude=...)`; it
        needs DIM and REAL only.
    data : (m,) real
        What to pass as `data`.
    taken : int
        Bytes that the device has had taken to compute it.
    """

    prelude: str
    data: np.ndarray
    taken: int


def bind(
    field: Field, domain: Domain, real: DTypeLike = np.float64, engine: Engine | None = None
) -> Bound:
    """Return `field` as OpenCL for the normalized coordinates of `domain`.

    Geometry is converted to those coordinates in float64, so that float32 is as accurate far from
    the origin as near it. `Expression` alone computes in physical coordinates.

    Parameters
    ----------
    field : Field
    domain : Domain
    real : dtype
        The engine's precision.
    engine : Engine, optional
        Where a field that has to be computed first (`Graded`) is computed; by default a new one on
        the default device.

    Raises
    ------
    InputError
        If the field is of another dimension than the domain, or has no device form.
    """
    field.check_dim(domain.dim)
    binder = Binder(domain, np.dtype(real), engine)
    result = field._emit(binder)
    if binder._stored >= 2**31:
        raise InputError(
            f"the size field holds {binder._stored} numbers, expected fewer than 2^31; "
            "use a coarser Raster"
        )
    body = "\n".join(f"    {line}" for line in binder.statements)
    prelude = (
        f'{source_text("sizing/size_fields.h")}\n#line 1 "size_at"\n'
        "REAL size_at(const REAL *x, __global const REAL *data)\n"
        f"{{\n{body}\n    return {result};\n}}\n"
    )
    return Bound(prelude, binder.data(), binder.taken)
