"""Names of the parts of a boundary, and the selection of walls by name or number.

A wall is one side of a `Box` or one edge of a `Polygon`. Walls are numbered from 0: sides in the order xMin, xMax,
yMin, ..., edges in the order of the caller's vertices. A face on wall k has the neighbor -1 - k.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, InputTypeError

Walls = int | str | Iterable[int | str]
"""A selection of walls: a number, a name, or several of them."""
WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
_LISTED = 12  # names or numbers in an error message


def check_word(what: str, name: object) -> str:
    """Return the name of a boundary, or raise `InputError` if it is not a word."""
    if not isinstance(name, str) or not WORD.fullmatch(name):
        raise InputError(
            f"{what} {name!r:.60}, expected a word of ASCII letters, digits, _, . and - that begins with a letter or _"
        )
    return name


@dataclass(frozen=True)
class BoundaryNames:
    """The parts of one boundary.

    Attributes
    ----------
    names : tuple of str
    index : (k,) int32
        Index in `names` of the part that each wall belongs to; -1 for a side of a box that is periodic.
    kind : str
        Name of one wall in error messages: "edge" or "side".
    """

    names: tuple[str, ...]
    index: np.ndarray
    kind: str

    def __post_init__(self) -> None:
        self.index.setflags(write=False)

    def select(self, what: str, walls: Walls | None) -> np.ndarray:
        """Return the numbers of the selected walls, (m,) int64, ascending.

        Parameters
        ----------
        what : str
            Name of the selection in error messages.
        walls : int, str, sequence of both, (k,) bool or None
            Numbers, names of parts, or a mask over all walls. None selects every wall.

        Raises
        ------
        InputError, InputTypeError
            If a wall or name does not exist, or nothing is selected.
        """
        if walls is None:
            return np.flatnonzero(self.index >= 0)
        items = [walls] if isinstance(walls, str | int | np.integer) else walls
        if not isinstance(items, Iterable) or isinstance(items, Mapping):
            raise self._wrong_type(what, walls)
        if isinstance(items, np.ndarray):
            if items.dtype == bool and items.shape != self.index.shape:
                raise InputError(
                    f"{what} is a mask of shape {items.shape}, expected {self.index.shape}: one value per {self.kind}"
                )
            items = np.flatnonzero(items) if items.dtype == bool else items.ravel()
        found: list[int] = []
        for item in items:
            if isinstance(item, str):
                found += self._part(what, item)
            elif isinstance(item, int | np.integer) and not isinstance(item, bool):
                found.append(self._wall(what, int(item)))
            else:
                raise self._wrong_type(what, walls)
        if not found:
            raise InputError(f"{what} is empty, expected at least one {self.kind}")
        return np.unique(np.array(found, np.int64))

    def renamed(self, what: str, names: Mapping[str, Walls]) -> BoundaryNames:
        """Return these parts with new `names` for some walls; the other walls keep the name that they have.

        Raises
        ------
        InputError, InputTypeError
            If a name is not a word, a wall or name does not exist, a wall is named twice, or a new name is also that
            of a part with other walls.
        """
        if not isinstance(names, Mapping):
            raise InputTypeError(
                f"{what} is {names!r:.60} of type {type(names).__name__}, expected a mapping from names to numbers or "
                "names of walls, such as {'inlet': [0, 1]}"
            )
        index = np.full(len(self.index), -1, np.int32)
        for k, (name, walls) in enumerate(names.items()):
            check_word(f"{what} has the name", name)
            chosen = self.select(f"{what}[{name!r}]", walls)
            twice = chosen[index[chosen] >= 0]
            if twice.size:
                other = list(names)[index[twice[0]]]
                raise InputError(
                    f"{what} has {self.kind} {twice[0]} both in {other!r} and in {name!r}, expected in one of them"
                )
            if name in self.names and not np.array_equal(chosen, np.flatnonzero(self.index == self.names.index(name))):
                raise InputError(
                    f"{what} has the name {name!r}, which other {self.kind}s already have; choose another name"
                )
            index[chosen] = k
        left = np.unique(self.index[(index < 0) & (self.index >= 0)])
        place = np.full(len(self.names) + 1, -1, np.int32)
        place[left] = len(names) + np.arange(len(left))
        index = np.where(index >= 0, index, place[self.index]).astype(np.int32)
        return BoundaryNames((*names, *(self.names[k] for k in left)), index, self.kind)

    def _part(self, what: str, name: str) -> list[int]:
        if name not in self.names:
            raise InputError(f"{what} is {name!r:.60}, expected the name of a boundary: {_listed(self.names)}")
        return np.flatnonzero(self.index == self.names.index(name)).tolist()

    def _wall(self, what: str, number: int) -> int:
        if not 0 <= number < len(self.index):
            raise InputError(f"{what} has {self.kind} {number:.12g}, expected numbers from 0 to {len(self.index) - 1}")
        if self.index[number] < 0:
            raise InputError(
                f"{what} has {self.kind} {number}, which is periodic, expected one of "
                f"{_listed(np.flatnonzero(self.index >= 0).tolist())}"
            )
        return number

    def _wrong_type(self, what: str, walls: object) -> InputTypeError:
        return InputTypeError(
            f"{what} is {walls!r:.60}, expected a number or name of {self.kind}s, or a sequence of them"
        )


def _listed(items: Iterable[object]) -> str:
    known = [str(item) for item in items]
    more = len(known) - _LISTED
    return ", ".join(known[:_LISTED]) + (f" and {more} more" if more > 0 else "") or "none"
