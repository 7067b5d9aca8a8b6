"""The contents of a mesh file: a diagram, cell data of a run, and data of the caller."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arguments import check_cell_values
from ..errors import InputError, InputTypeError
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .arrays import FileError

_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
DOMAIN = " clvoro domain: "
"""What precedes the domain of the whole mesh in a comment of a file."""
OWN = frozenset(
    (
        "size",
        "error",
        "quality",
        "volume",
        "area",
        "sides",
        "faces_of_cell",
        "label",
        "boundary",
        "generator",
        "wall",
        "weight",
        "layer",
    )
)
"""Names of clvoro's own cell data in any format."""


@dataclass(frozen=True)
class Contents:
    """The contents of a mesh file."""

    diagram: Diagram
    result: Result | None
    """None for a diagram without sizes."""
    extra: dict[str, np.ndarray]
    """The caller's data by name, (n,) or (n, k) arrays of float32, float64, int32, int64 or uint8."""

    @classmethod
    def of(cls, mesh: object, cell_data: Mapping[str, ArrayLike] | None = None) -> Contents:
        """Return the contents for a result or a diagram.

        Raises
        ------
        InputError, InputTypeError
            If `mesh` is neither, or `cell_data` does not have one number, or row of numbers, per cell.
        """
        if isinstance(mesh, Result):
            return cls(mesh.diagram, mesh, _checked(cell_data, len(mesh.diagram)))
        if isinstance(mesh, Diagram):
            return cls(mesh, None, _checked(cell_data, len(mesh)))
        raise InputTypeError(
            f"mesh is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram, as clvoro.adapt and "
            "clvoro.voronoi return them"
        )

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the run; empty for a diagram."""
        return {} if self.result is None else self.result.settings

    @property
    def with_regions(self) -> dict[str, np.ndarray]:
        """The caller's data, and the region of each cell if the domain has borders inside."""
        regions = {} if self.diagram.domain.borders is None else {"region": self.diagram.cell_region}
        return regions | self.extra

    @property
    def of_run(self) -> dict[str, np.ndarray]:
        """Cell data of the run: size, error and quality; empty for a diagram."""
        r = self.result
        if r is None:
            return {}
        return {"size": r.target_size, "error": r.size_error, "quality": r.quality}


def _checked(cell_data: object, n: int) -> dict[str, np.ndarray]:
    """Return the caller's data as arrays of types that file formats have."""
    if cell_data is None:
        return {}
    if not isinstance(cell_data, Mapping):
        raise InputTypeError(
            f"cell_data is a {type(cell_data).__name__}, expected a mapping from names to arrays, such as "
            "{'pressure': values}"
        )
    found = {}
    for name, values in cell_data.items():
        if not isinstance(name, str) or not _WORD.fullmatch(name) or name in OWN:
            why = "which clvoro uses itself" if name in OWN else "expected a word of ASCII letters and digits"
            raise InputError(f"cell_data has the name {name!r:.60}, {why}; choose another name")
        found[name] = _in_known_type(check_cell_values(f"cell_data[{name!r}]", values, n, finite=False))
    return found


def _in_known_type(array: np.ndarray) -> np.ndarray:
    """Return `array` in the smallest type that holds all its values."""
    if array.dtype.kind == "b":
        return array.astype(np.uint8)
    if array.dtype.kind == "f":
        return array.astype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    for kind in (np.uint8, np.int32, np.int64):
        if np.can_cast(array.dtype, kind):
            return array.astype(kind)
    return array.astype(np.float64)  # uint64


def describe(domain: Domain) -> dict[str, Any]:
    """Return a domain of any kind as numbers, strings and lists."""
    return {"kind": type(domain).__name__, **domain.describe(), **domain.described_borders}


def described(description: Mapping[str, Any]) -> Domain:
    """Return the domain that `describe` has described.

    Raises `FileError` if no class of this name is known.
    """
    values = dict(description)
    kind = values.pop("kind")
    if kind not in Domain.kinds:
        known = ", ".join(Domain.kinds)
        raise FileError(f"its domain is a {kind!r:.40}, expected one of {known}; import the class before")
    lines, surfaces = values.pop("lines", None), values.pop("surfaces", None)
    domain = Domain.kinds[kind].described(**values)
    if surfaces is not None:
        return domain.with_surfaces(surfaces)
    return domain if lines is None else domain.with_lines(lines)
