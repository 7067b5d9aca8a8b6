"""Checks of values and tables of a case file; errors name the key, and the nearest known one."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import PureWindowsPath
from typing import Any

from ...errors import InputError

Check = Callable[[object, str], Any]
"""Takes a value and its place in the file; returns it in its final type or raises InputError."""

_LONGEST_NAME = 200  # bytes: file systems allow 255, and some files get a further suffix
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")


class UnknownKeyError(InputError):
    """A table has a key that it does not take; `place` names the table, `known` are the keys that it takes."""

    def __init__(self, place: str, key: object, known: Iterable[str], hint: str = "") -> None:
        self.place, self.key, self.known = place, key, list(known)
        hint = hint or _nearest(key, self.known)
        super().__init__(f"{place} has the unknown key {key!r}{hint}; it takes {_join(self.known)}")


def refuse(place: str, got: object, expected: str) -> InputError:
    """Return the error for one value."""
    return InputError(f"{place} is {got!r}, expected {expected}")


def text(value: object, place: str) -> str:
    """Check for a string that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise refuse(place, value, "a text in quotes")
    return value


def file_name(value: object, place: str) -> str:
    """Check for a name that is valid for a file or folder, without a path, on any system."""
    name = text(value, place)
    alone = PureWindowsPath(name).name == name != ".."  # Windows paths know all separators and drives
    spelt = name.encode("utf-8", "replace")  # with a ? for invalid characters
    if not alone or len(spelt) > _LONGEST_NAME or _CONTROL.search(name) or spelt.decode() != name:
        raise refuse(
            place,
            name[: _LONGEST_NAME + 1],
            "a name in UTF-8 without slashes, no '.' or '..' (results go to out/NAME; "
            "--out chooses another folder); the case may give one: name = ...",
        )
    return name


def number(value: object, place: str) -> float:
    """Check for a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise refuse(place, value, "a finite number")
    return float(value)


def positive(value: object, place: str) -> float:
    """Check for a number above zero."""
    checked = number(value, place)
    if checked <= 0:
        raise refuse(place, value, "a number above 0")
    return checked


def not_negative(value: object, place: str) -> float:
    """Check for a number that is zero or more."""
    checked = number(value, place)
    if checked < 0:
        raise refuse(place, value, "a number >= 0")
    return checked


def true_or_false(value: object, place: str) -> bool:
    """Check for a truth value."""
    if not isinstance(value, bool):
        raise refuse(place, value, "true or false")
    return value


def whole(least: int) -> Check:
    """Return the check for a whole number of at least `least`."""

    def check(value: object, place: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise refuse(place, value, f"a whole number, {least} or more")
        return value

    return check


def auto_or_whole(value: object, place: str) -> str | int:
    """Check that a value is "auto" or a whole number."""
    if value == "auto":
        return "auto"
    try:
        return whole(0)(value, place)
    except InputError:
        raise refuse(place, value, "a whole number, 0 or more, or 'auto'") from None


def one_of(*names: str) -> Check:
    """Return the check for one of a few words."""

    def check(value: object, place: str) -> str:
        if value not in names:
            raise InputError(f"{place} is {value!r}{_nearest(value, names)}; expected one of {_join(names)}")
        return str(value)

    return check


def vector(*lengths: int) -> Check:
    """Return the check for a list of numbers of one of these lengths."""

    def check(value: object, place: str) -> list[float]:
        if not isinstance(value, (list, tuple)) or len(value) not in lengths:
            raise refuse(place, value, f"a list of {' or '.join(map(str, lengths))} numbers")
        return [number(v, f"{place}[{i}]") for i, v in enumerate(value)]

    return check


def vectors(least: int) -> Check:
    """Return the check for a list of at least `least` points."""

    def check(value: object, place: str) -> list[list[float]]:
        if not isinstance(value, (list, tuple)) or len(value) < least:
            raise refuse(place, value, f"a list of {least} or more points, [x, y] each")
        return [vector(2, 3)(v, f"{place}[{i}]") for i, v in enumerate(value)]

    return check


def list_of(check_item: Check, least: int = 1) -> Check:
    """Return the check for a list, every item of which passes `check_item`."""

    def check(value: object, place: str) -> list[object]:
        if not isinstance(value, (list, tuple)) or len(value) < least:
            single = isinstance(value, Mapping) and least == 1
            hint = "; put it in [ ], or under a heading in double brackets" if single else ""
            raise refuse(place, value, f"a list with {least} or more entries{hint}")
        return [check_item(v, f"{place}[{i}]") for i, v in enumerate(value)]

    return check


def names_of(*allowed: str) -> Check:
    """Return the check for a list of some of the names `allowed`, each of them once."""
    listed = list_of(one_of(*allowed))

    def check(value: object, place: str) -> list[object]:
        names = listed(value, place)
        for i, name in enumerate(names):
            if name in names[:i]:
                raise refuse(f"{place}[{i}]", name, "each name once")
        return names

    return check


@dataclass(frozen=True)
class Table:
    """The keys of a table: required ones, optional ones, and a group of which exactly one is required."""

    required: Mapping[str, Check]
    optional: Mapping[str, Check]
    choice: tuple[str, ...] = ()

    def __call__(self, value: object, place: str) -> dict[str, Any]:
        """Return the checked table, its keys in the file's order."""
        if not isinstance(value, Mapping):
            raise refuse(place, value, "a table")
        checks = {**self.required, **self.optional}
        for key in value:
            if key not in checks:
                raise UnknownKeyError(place, key, checks)
        missing = [key for key in self.required if key not in value]
        if missing:
            raise InputError(f"{place} lacks {_join(missing)}; it takes {_join(checks)}")
        if self.choice and sum(key in value for key in self.choice) != 1:
            raise InputError(
                f"{place} has {_join([k for k in self.choice if k in value]) or 'none'} of "
                f"{_join(self.choice)}, expected exactly one of them"
            )
        return {key: checks[key](item, _below(place, key)) for key, item in value.items()}


@dataclass(frozen=True)
class Kinds:
    """A table whose key `kind` says which other keys it has."""

    tables: Mapping[str, Table]
    default: str | None = None

    def __call__(self, value: object, place: str) -> dict[str, Any]:
        """Return the checked table with its kind first."""
        if not isinstance(value, Mapping):
            raise refuse(place, value, "a table")
        kind = one_of(*self.tables)(value.get("kind", self.default), _below(place, "kind"))
        rest = {key: item for key, item in value.items() if key != "kind"}
        return {"kind": kind, **self.tables[str(kind)](rest, place)}


def _below(place: str, key: str) -> str:
    """Name a key of the table at `place`; the file itself is the place "case.toml:"."""
    return f"{place} {key}" if place.endswith(":") else f"{place}.{key}"


def _join(names: Iterable[object]) -> str:
    return ", ".join(map(str, names))


def _nearest(name: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name), list(known), 1, 0.5)
    return f" (did you mean {near[0]!r}?)" if near else ""
