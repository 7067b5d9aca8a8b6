"""The arrays of a diagram under their names, read from the device when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..opencl.probe import check_process
from .read_only import read_only

if TYPE_CHECKING:
    from ..geometry.domain import Domain


class LazyArrays:
    """Base of `Diagram`, which describes the arrays.

    Parameters
    ----------
    domain : Domain
    arrays : dict
        By name: arrays, or functions that return them, called when they are first used. Arrays that diagrams of such a
        domain do not have are missing.
    """

    _NAMES = (
        "points",
        "volumes",
        "centroids",
        "neighbor_starts",
        "neighbors",
        "shifts",
        "face_measures",
        "face_centroids",
        "vertices",
        "cell_vertex_starts",
        "cell_vertices",
        "face_vertex_starts",
        "face_vertices",
        "weights",
    )

    def __init__(self, domain: Domain, arrays: Mapping[str, np.ndarray | Callable[[], np.ndarray]]) -> None:
        self.domain = domain
        self._arrays = {n: a if callable(a) else read_only(a) for n, a in arrays.items()}

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in self._NAMES:
            # A copy under construction has no arrays yet; `copy` looks for private names.
            there = "" if name.startswith("_") else f"; it has {', '.join(self._there())}"
            raise AttributeError(f"a Diagram has no {name!r}{there}", name=name, obj=self)
        if name == "shifts" and name not in self._arrays:
            self._arrays[name] = read_only(np.zeros((len(self.neighbors), self.domain.dim), np.int8))
        if name == "weights" and not self.is_power:
            return read_only(np.zeros(len(self.points)))
        if name not in self._arrays:
            raise AttributeError(f"a diagram in {self.domain.dim}D has no {name}; it has {', '.join(self._there())}")
        value = self._arrays[name]
        if callable(value):
            check_process()  # it may still be on a device
            value = self._arrays[name] = read_only(value())
        return value

    def _there(self) -> list[str]:
        return [n for n in self._NAMES if n == "shifts" or n in self._arrays]

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._there()]

    @property
    def is_power(self) -> bool:
        """Whether it is a power diagram. Its cells need not contain their generators, and may be empty."""
        return "weights" in self._arrays
