"""The report of a check: which properties of a mesh hold, and which do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...errors import ClvoroError
from ..diagram import Diagram

ROUNDINGS = 256
"""Tolerance of positions, in units of round-off: eps times the size of the domain and its distance from 0.

The tolerance of a corner is larger where its faces are nearly parallel; see `Rebuilt.doubts`."""


@dataclass(frozen=True)
class Finding:
    """One property that does not hold."""

    name: str
    """Name of the property, such as ``"volumes sum"``."""
    message: str
    """The value, the expected value, and the place with the largest deviation."""
    count: int = 1
    """Number of places."""

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


class Verdict:
    """Base of the dataclasses that report on a mesh. A report is true if the mesh is good."""

    @property
    def ok(self) -> bool:
        """Whether the mesh is good."""
        raise NotImplementedError

    def __bool__(self) -> bool:
        return self.ok

    def as_dict(self) -> dict[str, Any]:
        """Return the report as a dictionary, for example for JSON: its fields and ``"ok"``."""
        return {"ok": self.ok, **asdict(self)}  # type: ignore[call-overload]

    def demand(self) -> None:
        """Raise an error with the report as its message if the mesh is not good.

        Raises
        ------
        CheckError
        """
        if not self.ok:
            raise CheckError(str(self))


@dataclass(frozen=True)
class Report(Verdict):
    """The result of a check; it is true if every property holds.

    Attributes
    ----------
    findings : tuple of Finding
    checked : tuple of str
        Names of the properties that were checked. The check stops early if arrays do not fit each other.
    cells, faces : int
    precision : str
        The precision in which the mesh was computed, as its numbers show it; it determines the tolerances.
    """

    findings: tuple[Finding, ...]
    checked: tuple[str, ...]
    cells: int
    faces: int
    precision: str

    @property
    def ok(self) -> bool:
        """Whether every property holds."""
        return not self.findings

    def __str__(self) -> str:
        head = f"{self.cells} cells, {self.faces} faces, {self.precision}"
        if self.ok:
            return f"{head}: {len(self.checked)} properties hold"
        return "\n".join(
            [
                f"{head}: {len(self.findings)} of {len(self.checked)} properties do not hold",
                *(f"  {finding}" for finding in self.findings),
            ]
        )


class CheckError(ClvoroError):
    """A mesh is not a valid Voronoi mesh of its domain."""


class StopError(Exception):
    """Arrays do not fit each other, so that the check cannot continue."""


class Check:
    """Collects findings about one diagram."""

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self.findings: list[Finding] = []
        self.checked: list[str] = []

    def note(self, name: str, wrong: ArrayLike, say: Callable[[int], str], stop: bool = False) -> None:
        """Record whether the property `name` holds: `wrong` (k,) is true, or a positive deviation, where it does not.

        `say` returns the message for a place. With `stop` a property that does not hold ends the check.
        """
        self.checked.append(name)
        places = np.flatnonzero(wrong)
        if places.size:
            worst = int(places[np.argmax(np.asarray(wrong)[places])])
            more = f" ({places.size} such)" if places.size > 1 else ""
            self.findings.append(Finding(name, say(worst) + more, int(places.size)))
            if stop:
                raise StopError

    def compare(
        self, name: str, given: np.ndarray, expected: np.ndarray, width: ArrayLike, source: str = "corners"
    ) -> None:
        """Record whether the numbers `given`, (k,) or (k, d), are those `expected` by a `source`, up to `width`."""
        array = name.partition(" of ")[0].replace(" ", "_")
        off = np.abs(given - expected) if given.ndim == 1 else np.linalg.norm(given - expected, axis=1)
        self.note(
            name,
            np.maximum(off - width, 0),
            lambda i: f"{array}[{i}] is {_written(given[i])}, expected {_written(expected[i])}, by its {source}",
        )

    def shape(self, name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "f") -> None:
        """Record whether an array has the expected shape and finite numbers."""
        fits = array.shape == shape and array.dtype.kind in kinds
        self.note(
            "shapes",
            np.array([not fits]),
            lambda _: f"{name} is {array.dtype} {array.shape}, expected {shape}",
            stop=True,
        )
        if array.dtype.kind == "f":
            bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
            self.note("finite", bad, lambda i: f"{name}[{i}] is {array[i]}", stop=True)


def _written(value: np.ndarray) -> str:
    return f"{value:.17g}" if value.ndim == 0 else str(value)
