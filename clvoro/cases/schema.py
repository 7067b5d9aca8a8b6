"""What a case file may contain; errors name the key and the nearest known one."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..preparation import METHODS

Check = Callable[[object, str], Any]
"""Takes a value and its place in the file; returns it in its final type or raises InputError."""


def refuse(place: str, got: object, expected: str) -> InputError:
    """Return the error for one value."""
    return InputError(f"{place} is {got!r}, expected {expected}")


def text(value: object, place: str) -> str:
    """Check for a string that is not empty."""
    if not isinstance(value, str) or not value.strip():
        raise refuse(place, value, "a text in quotes")
    return value


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
        raise refuse(place, value, "a number not below 0")
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
    """Check for "auto" or a whole number."""
    return "auto" if value == "auto" else whole(0)(value, place)


def one_of(*names: str) -> Check:
    """Return the check for one of a few words."""

    def check(value: object, place: str) -> str:
        if value not in names:
            raise InputError(
                f"{place} is {value!r}{_nearest(value, names)}; expected one of {_join(names)}"
            )
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


@dataclass(frozen=True)
class Table:
    """A table's keys: those it must have, may have, and those of which exactly one is wanted."""

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
                hint = _home(key, place) or _nearest(key, checks)
                raise InputError(
                    f"{place} has the unknown key {key!r}{hint}; it takes {_join(checks)}"
                )
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


def _home(name: object, place: str) -> str:
    """Say where in a case a key belongs that is not known at `place`, if that is one table, or which kinds have it."""
    kinds = [kind for kind, t in _SIZE.tables.items() if name in (*t.required, *t.optional)]
    if kinds and re.search(r" size\b", place):
        return f" (it is for kind = {' or '.join(map(repr, kinds))})"
    homes = [home for home, keys in _HOMES.items() if name in keys]
    return f" (it belongs to {homes[0]})" if len(homes) == 1 else ""


SHAPE = Kinds(
    {
        "circle": Table({"centre": vector(2, 3), "radius": not_negative}, {}),
        "sphere": Table({"centre": vector(3), "radius": not_negative}, {}),
        "box": Table({}, {"lower": vector(2, 3), "upper": vector(2, 3)}),
        "boundary": Table({}, {"edges": list_of(whole(0))}),
        "surface": Table({"file": text}, {"closed": true_or_false, "join": positive}),
        "segment": Table({"a": vector(2, 3), "b": vector(2, 3)}, {}),
        "polyline": Table({"points": vectors(2)}, {}),
        "polygon": Table({"points": vectors(3)}, {}),
        "naca4": Table(
            {"digits": text},
            {"chord": positive, "leading_edge": vector(2), "angle": number, "n_points": whole(3)},
        ),
    }
)
"""A shape that sizes are measured from."""


def size(value: object, place: str) -> dict[str, Any]:
    """Check a size field: a number, or a tree of tables."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return {"kind": "constant", "value": positive(value, place)}
    return _SIZE(value, place)


# What an array in a file covers, and how.
_COVERED: dict[str, Check] = {
    "lower": vector(2, 3),
    "upper": vector(2, 3),
    "at": one_of("nodes", "centres"),
    "missing": one_of("error", "nearest"),
}

_SIZE = Kinds(
    {
        "constant": Table({"value": positive}, {}),
        "distance": Table(
            {"shapes": list_of(SHAPE), "h_min": positive},
            {"growth": positive, "slope": positive, "h_max": positive},
            choice=("growth", "slope"),
        ),
        "expression": Table({"expression": text}, {}),
        "raster": Table(
            {"file": text},
            {**_COVERED, "outside": one_of("nearest", "error")},
        ),
        "hessian": Table(
            {"file": text},
            {
                **_COVERED,
                "n_cells": positive,
                "eps": positive,
                "p": positive,
                "h_min": not_negative,
                "h_max": positive,
            },
            choice=("n_cells", "eps"),
        ),
        "gradient": Table(
            {"file": text},
            {
                **_COVERED,
                "n_cells": positive,
                "eps": positive,
                "h_min": not_negative,
                "h_max": positive,
            },
            choice=("n_cells", "eps"),
        ),
        "feature": Table(
            {},
            {
                "cells_across": positive,
                "growth": positive,
                "h_min": positive,
                "h_max": positive,
                "curvature": not_negative,
            },
        ),
        "graded": Table(
            {"field": size},
            {"growth": positive, "slope": positive, "resolution": whole(2)},
            choice=("growth", "slope"),
        ),
        "min": Table({"fields": list_of(size)}, {}),
        "max": Table({"fields": list_of(size)}, {}),
        "sum": Table({"fields": list_of(size)}, {}),
        "product": Table({"fields": list_of(size)}, {}),
        "quotient": Table({"fields": list_of(size, 2)}, {}),
        "scale": Table({"factor": positive, "field": size}, {}),
    }
)

_RING = Kinds(
    {
        "circle": Table({"centre": vector(2), "radius": positive}, {"n_points": whole(3)}),
        "naca4": Table(
            {"digits": text},
            {"chord": positive, "leading_edge": vector(2), "angle": number, "n_points": whole(3)},
        ),
    }
)


def ring(value: object, place: str) -> Any:
    """Check for the vertices of a ring, or a shape that has some."""
    if isinstance(value, Mapping):
        return _RING(value, place)
    if not isinstance(value, (list, tuple)) or len(value) < 3:
        raise refuse(place, value, "a list of 3 or more points, [x, y] each, or a shape")
    return [vector(2)(v, f"{place}[{i}]") for i, v in enumerate(value)]


def directions(value: object, place: str) -> bool | list[bool]:
    """Check a truth value, or one for each direction."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, list) or not all(isinstance(v, bool) for v in value):
        raise refuse(place, value, "true, false or one of them for each direction")
    return value


_DOMAINS = Kinds(
    {
        "box": Table({"lower": vector(2, 3), "upper": vector(2, 3)}, {"periodic": directions}),
        "polygon": Table(
            {}, {"file": text, "outer": ring, "holes": list_of(ring)}, choice=("file", "outer")
        ),
    },
    default="box",
)


def domain(value: object, place: str) -> dict[str, Any]:
    """Check a domain: a box by its corners, a polygon by a file or its rings."""
    if isinstance(value, Mapping) and "kind" not in value:
        corners = [key for key in ("lower", "upper", "periodic") if key in value]
        rings = [key for key in ("polygon", "outer", "holes") if key in value]
        if corners and rings:
            raise InputError(
                f"{place} has both {corners[0]}, of a box, and {rings[0]}, of a polygon; leave one of them out"
            )
        if "polygon" in value:
            rest = {key: item for key, item in value.items() if key != "polygon"}
            value = {"kind": "polygon", "file": text(value["polygon"], f"{place}.polygon"), **rest}
        elif "outer" in value:
            value = {"kind": "polygon", **value}
    checked = _DOMAINS(value, place)
    if "file" in checked and "holes" in checked:
        raise InputError(f"{place} has both a file and holes, expected holes beside outer only")
    return checked


RUN = Table(
    {},
    {
        "method": one_of(*METHODS),
        "methods": list_of(one_of(*METHODS)),
        "start": one_of("density", "uniform"),
        "points": text,
        "n_cells": whole(1),
        "max_steps": whole(0),
        "tol": not_negative,
        "alpha": positive,
        "k": positive,
        "seed": whole(0),
        "dtype": one_of("float64", "float32"),
        "effort": one_of("fast", "default", "best"),
        "levels": auto_or_whole,
        "error_target": positive,
    },
)

SEQUENCE = Table({"frames": whole(1)}, {})

LAYERS = Table(
    {"height": positive},
    {
        "count": whole(1),
        "growth": positive,
        "spacing": positive,
        "edges": list_of(whole(0)),
        "rings": list_of(whole(0)),
    },
)
"""Rows of generators along walls; rings stand for all their edges, 0 the first outer ring."""

CASE = Table(
    {"domain": domain, "size": size},
    {"name": text, "title": text, "run": RUN, "layers": list_of(LAYERS), "sequence": SEQUENCE},
)

_HOMES = {
    "the case itself, above all tables": {*CASE.required, *CASE.optional},
    "[domain]": {key for t in _DOMAINS.tables.values() for key in (*t.required, *t.optional)},
    "[size]": {key for t in _SIZE.tables.values() for key in (*t.required, *t.optional)},
    "[run]": {*RUN.optional},
    "[[layers]]": {*LAYERS.required, *LAYERS.optional},
    "[sequence]": {*SEQUENCE.optional},
}
"""The keys of each table."""
