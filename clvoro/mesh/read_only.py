"""Arrays that cannot be written to, and objects that hold them."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a view of `array` that cannot be written to."""
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


def seal(array: object) -> None:
    """Make an array read-only to which there is no other reference, as after unpickling."""
    if isinstance(array, np.ndarray):
        array.flags.writeable = False


class Sealed:
    """Base of dataclasses whose arrays cannot be written to."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, read_only(value))

    def __reduce__(self) -> tuple[Any, ...]:
        values = [getattr(self, f.name) for f in fields(self)]  # type: ignore[arg-type]
        return _rebuilt, (type(self), *values)


def _rebuilt(kind: type, *values: object) -> Any:
    """Return an unpickled object."""
    for value in values:
        seal(value)
    return kind(*values)
