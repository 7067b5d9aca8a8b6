"""What a check of a mesh finds, and how it is told."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...errors import ClvoroError

if TYPE_CHECKING:
    from ..diagram import Diagram

ROUNDINGS = 256
"""How many roundings of a position (eps times the domain's size and its distance from 0) count as none. A corner may be
off by more, where the faces that meet there say so: see `Rebuilt.doubts`."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes
    ----------
    name : str
        Of the property that does not hold, such as ``"volumes sum"``.
    message : str
        What was found, what was expected, and where it is worst.
    count : int
        In how many places.
    """

    name: str
    message: str
    count: int = 1

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


@dataclass(frozen=True)
class Report:
    """What a check has found; true if that is nothing.

    Attributes
    ----------
    findings : tuple of Finding
    checked : tuple of str
        Names of the properties that were looked at. The check stops early where arrays do not fit each other.
    cells, faces : int
    precision : str
        The precision in which the mesh was made, told by its numbers; tolerances follow it.
    """

    findings: tuple[Finding, ...]
    checked: tuple[str, ...]
    cells: int
    faces: int
    precision: str

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.findings

    def __bool__(self) -> bool:
        return self.ok

    def __str__(self) -> str:
        head = f"{self.cells} cells, {self.faces} faces, {self.precision}"
        if self.ok:
            return f"{head}: {len(self.checked)} properties hold"
        return "\n".join([f"{head}: {len(self.findings)} of {len(self.checked)} properties do not hold",
                          *(f"  {finding}" for finding in self.findings)])  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {"ok": self.ok, **asdict(self)}

    def demand(self) -> None:
        """Raise if something is wrong.

        Raises
        ------
        CheckError
        """
        if self.findings:
            raise CheckError(str(self))


class CheckError(ClvoroError):
    """A mesh is not what it claims to be."""


class MisfitError(Exception):
    """Arrays do not fit each other: what builds on them cannot be looked at."""


class Check:
    """Collects findings about one diagram."""

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self.findings: list[Finding] = []
        self.checked: list[str] = []

    def note(
        self, name: str, wrong: ArrayLike, say: Callable[[int], str], stop: bool = False
    ) -> None:
        """Record whether `name` holds: `wrong` (k,) is true (or large) where it does not."""
        self.checked.append(name)
        places = np.flatnonzero(wrong)
        if places.size:
            worst = int(places[np.argmax(np.asarray(wrong)[places])])
            more = f" ({places.size} such)" if places.size > 1 else ""
            self.findings.append(Finding(name, say(worst) + more, int(places.size)))
            if stop:
                raise MisfitError

    def shape(self, name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "f") -> None:
        """Record whether an array has its shape, and finite numbers."""
        fits = array.shape == shape and array.dtype.kind in kinds
        self.note(
            "shapes", np.array([not fits]),
            lambda _: f"{name} is {array.dtype} {array.shape}, expected {shape}", stop=True,
        )  # fmt: skip
        if array.dtype.kind == "f":
            bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
            self.note("finite", bad, lambda i: f"{name}[{i}] is {array[i]}", stop=True)
