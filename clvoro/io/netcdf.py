"""Write netCDF-3 files with 64-bit offsets, which every version of the netCDF library reads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from ..errors import InputError
from .atomic import atomic_file
from .contents import Contents

_MOST = 2**31 - 4  # bytes of a variable: readers store its size in a signed integer of 32 bits


@dataclass(frozen=True)
class _Variable:
    """One variable: its values, or the items of ragged rows. Integers are written as int32, others as float64."""

    dimensions: tuple[str, ...]
    values: np.ndarray
    attributes: Mapping[str, str | np.generic | np.ndarray]
    counts: np.ndarray | None = None
    missing: int = 0

    @property
    def kind(self) -> np.dtype:
        return np.dtype(np.float64 if self.values.dtype.kind == "f" else np.int32)


class NetCDF:
    """The contents of a file, which `write` writes.

    - `contents`: its settings become an attribute, its extra data variables by `add_extra`.
    - `dimensions`: lengths by name.
    - `attributes`: attributes of the file: texts and numbers of NumPy.
    """

    def __init__(
        self, path: Path, contents: Contents, dimensions: Mapping[str, int], attributes: Mapping[str, str | np.generic]
    ) -> None:
        self.path, self.dimensions, self.extra = path, dict(dimensions), contents.with_regions
        settings = json.dumps(contents.settings, default=repr)
        self.attributes = {**attributes, "source": "clvoro", "clvoro_settings": settings}
        self._variables: dict[str, _Variable] = {}

    def add(
        self, name: str, dimensions: tuple[str, ...], values: np.ndarray, **attributes: str | np.generic | np.ndarray
    ) -> None:
        """Add a variable of integers or real numbers."""
        assert values.shape == tuple(self.dimensions[d] for d in dimensions), name
        self._add(name, _Variable(dimensions, values, attributes))

    def add_rows(
        self,
        name: str,
        dimensions: tuple[str, str],
        counts: np.ndarray,
        items: np.ndarray,
        missing: int,
        **attributes: str | np.generic,
    ) -> None:
        """Add a table of ragged rows: row i has `counts[i]` of the `items`, then `missing`."""
        self._add(name, _Variable(dimensions, items, attributes, counts, missing))

    def add_extra(self, cells: str, **attributes: str) -> None:
        """Add the caller's data along the dimension `cells`.

        Raises `InputError` if the file has another variable of that name, or the data are too large for the format.
        """
        for name, values in self.extra.items():
            if name in self._variables:
                raise InputError(
                    f"cell_data has the name {name!r}, which is that of another variable in {self.path}; choose another"
                )
            if values.dtype.kind != "f" and abs(values).max() >= 2**31:  # netCDF-3 has no 64 bits
                values = values.astype(float)
            columns = ()
            if values.ndim == 2:
                columns = (f"{name}_columns",)
                self.dimensions[columns[0]] = values.shape[1]
            self.add(name, (cells, *columns), values, **attributes)

    def _add(self, name: str, variable: _Variable) -> None:
        lengths = [self.dimensions[d] for d in variable.dimensions]
        size = math.prod(lengths) * variable.kind.itemsize
        if size > _MOST:
            raise InputError(
                f"cannot write {self.path}: {name} ({' x '.join(map(str, lengths))}) has {size} bytes, and a variable "
                f"in netCDF-3 has at most {_MOST}; use fewer cells, or save as .npz or .vtu"
            )
        self._variables[name] = variable

    def write(self) -> None:
        """Write the file; call it once. Equal contents give equal bytes."""
        with atomic_file(self.path) as file:
            made = scipy.io.netcdf_file(file, "w", version=2)
            for name, value in self.attributes.items():
                setattr(made, name, value)
            for name, length in self.dimensions.items():
                made.createDimension(name, length)
            for name in list(self._variables):
                # Each variable is freed when it is written.
                given = self._variables.pop(name)
                variable = made.createVariable(name, given.kind, given.dimensions)
                for key, value in given.attributes.items():
                    setattr(variable, key, value)
                if given.counts is None:
                    variable[...] = given.values
                else:
                    filled = np.arange(variable.shape[1]) < given.counts[:, None]
                    variable[...] = given.missing
                    variable[filled] = given.values
            made.flush()  # close() would write everything again and close the file


def squared(unit: str) -> str:
    """Return the square of a unit of length as UDUNITS writes it."""
    return f"{unit}2" if unit.isalpha() else f"({unit})^2"
