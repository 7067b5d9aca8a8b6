"""The tables and keys of a case file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from ...adaptation.options import METHODS
from ...errors import InputError
from .checks import (
    Check,
    Kinds,
    Table,
    UnknownKeyError,
    auto_or_whole,
    file_name,
    list_of,
    names_of,
    not_negative,
    number,
    one_of,
    positive,
    refuse,
    text,
    true_or_false,
    vector,
    vectors,
    whole,
)


def walls(value: object, place: str) -> Any:
    """Check a selection of edges or sides: a number, a name, or a list of them."""
    items = value if isinstance(value, list) else [value]
    if not items or not all(isinstance(v, str | int) and not isinstance(v, bool) for v in items):
        raise refuse(place, value, "the number or name of an edge or side, or a list of them")
    return value


def names(value: object, place: str) -> dict[str, Any]:
    """Check names of boundaries with their edges or sides."""
    if not isinstance(value, Mapping):
        raise refuse(place, value, "a table of names, such as {inlet = 0, island = [4, 5, 6]}")
    return {name: walls(chosen, f"{place}.{name}") for name, chosen in value.items()}


_OF_CURVE: dict[str, Check] = {"name": text, "tolerance": positive}
_CURVES = {
    "arc": Table({"center": vector(2), "radius": positive, "start": number, "end": number}, {**_OF_CURVE}),
    "ellipse": Table(
        {"center": vector(2), "semi_axes": vector(2)}, {"angle": number, "start": number, "end": number, **_OF_CURVE}
    ),
    "naca": Table(
        {"code": text},
        {
            "chord": positive,
            "leading_edge": vector(2),
            "angle_of_attack": number,
            "trailing_edge": one_of("closed", "blunt"),
            **_OF_CURVE,
        },
    ),
    "spline": Table(
        {"points": list_of(vector(2), 2)}, {"closed": true_or_false, "corners": list_of(whole(0), 0), **_OF_CURVE}
    ),
}
"""The curves of `clvoro.curves`, except circles."""

SHAPE = Kinds(
    {
        "circle": Table({"center": vector(2, 3), "radius": not_negative}, {}),
        "sphere": Table({"center": vector(3), "radius": not_negative}, {}),
        "box": Table({}, {"lower": vector(2, 3), "upper": vector(2, 3)}),
        "boundary": Table({}, {"edges": walls}),
        "surface": Table({"file": text}, {"closed": true_or_false, "join": positive}),
        "segment": Table({"a": vector(2, 3), "b": vector(2, 3)}, {}),
        "polyline": Table({"points": vectors(2)}, {}),
        "closed_polyline": Table({"points": vectors(3)}, {}),
        **_CURVES,
    }
)
"""A shape that sizes are measured from."""


def size(value: object, place: str) -> dict[str, Any]:
    """Check a size field: a number, or a tree of tables."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return {"kind": "constant", "value": positive(value, place)}
    return _SIZE(value, place)


# Extent and layout of an array in a file.
_COVERED: dict[str, Check] = {
    "lower": vector(2, 3),
    "upper": vector(2, 3),
    "at": one_of("nodes", "centers"),
    "missing": one_of("error", "nearest"),
}

_SIZE = Kinds(
    {
        "constant": Table({"value": positive}, {}),
        "caps": Table(
            {
                "regions": list_of(Table({"center": vector(2), "radius": not_negative, "size": positive}, {})),
                "h_max": positive,
            },
            {"growth": positive, "slope": positive},
            choice=("growth", "slope"),
        ),
        "distance": Table(
            {"shapes": list_of(SHAPE), "h_min": positive},
            {"growth": positive, "slope": positive, "h_max": positive},
            choice=("growth", "slope"),
        ),
        "expression": Table({"expression": text}, {}),
        "raster": Table({"file": text}, {**_COVERED, "variable": text, "outside": one_of("nearest", "error")}),
        "hessian": Table(
            {"file": text},
            {**_COVERED, "n_cells": positive, "eps": positive, "p": positive, "h_min": not_negative, "h_max": positive},
            choice=("n_cells", "eps"),
        ),
        "gradient": Table(
            {"file": text},
            {**_COVERED, "n_cells": positive, "eps": positive, "h_min": not_negative, "h_max": positive},
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
            {"field": size}, {"growth": positive, "slope": positive, "resolution": whole(2)}, choice=("growth", "slope")
        ),
        "min": Table({"fields": list_of(size)}, {}),
        "max": Table({"fields": list_of(size)}, {}),
        "sum": Table({"fields": list_of(size)}, {}),
        "product": Table({"fields": list_of(size)}, {}),
        "quotient": Table({"fields": list_of(size, 2)}, {}),
        "scale": Table({"factor": positive, "field": size}, {}),
    }
)

_CURVE = Kinds({"circle": Table({"center": vector(2), "radius": positive}, {**_OF_CURVE}), **_CURVES})


def ring(value: object, place: str) -> Any:
    """Check and return a ring: a closed curve, or a list of points and curves."""
    if isinstance(value, Mapping):
        return _CURVE(value, place)
    items = value if isinstance(value, (list, tuple)) else []
    if len(items) < 3 and not any(isinstance(item, Mapping) for item in items):
        raise refuse(place, value, "a list of 3 or more points, [x, y] each, or a curve")
    return [(_CURVE if isinstance(item, Mapping) else vector(2))(item, f"{place}[{i}]") for i, item in enumerate(items)]


def directions(value: object, place: str) -> bool | list[bool]:
    """Check a truth value, or one for each direction."""
    if isinstance(value, bool):
        return value
    if not isinstance(value, list) or not all(isinstance(v, bool) for v in value):
        raise refuse(place, value, "true, false or one of them for each direction")
    return value


_DOMAINS = Kinds(
    {
        "box": Table({"lower": vector(2, 3), "upper": vector(2, 3)}, {"periodic": directions, "names": names}),
        "polygon": Table(
            {},
            {"file": text, "outer": ring, "holes": list_of(ring), "names": names, "simplified": positive},
            choice=("file", "outer"),
        ),
        "sphere": Table({}, {"radius": positive}),
    },
    default="box",
)


def domain(value: object, place: str) -> dict[str, Any]:
    """Check a domain: a box by its corners, a polygon by a file or its rings, a sphere by its kind."""
    if isinstance(value, Mapping) and "kind" not in value:
        corners = [key for key in ("lower", "upper", "periodic") if key in value]
        rings = [key for key in ("polygon", "outer", "holes") if key in value]
        if corners and rings:
            raise InputError(
                f"{place} has both {corners[0]}, of a box, and {rings[0]}, of a polygon; leave one of them out"
            )
        if not corners and not rings:
            raise InputError(
                f"{place} is neither a box nor a polygon nor a sphere, expected lower and upper, or outer, or "
                'polygon = FILE, or kind = "sphere"'
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


def fixed(value: object, place: str) -> object:
    """Check fixed generators: the name of a file, or a list of positions."""
    return text(value, place) if isinstance(value, str) else vectors(1)(value, place)


_RUN = Table(
    {},
    {
        "method": one_of(*METHODS),
        "methods": names_of(*METHODS),
        "start": one_of("density", "uniform"),
        "points": text,
        "fixed": fixed,
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

LAYERS = Table({"height": positive}, {"count": whole(1), "growth": positive, "spacing": positive, "edges": walls})
"""Layers of cells along edges or sides."""

_CASE = Table(
    {"domain": domain, "size": size},
    {"name": file_name, "title": text, "run": _RUN, "layers": list_of(LAYERS), "sequence": SEQUENCE},
)

_HOMES = {
    "the case itself, above all tables": {*_CASE.required, *_CASE.optional},
    "[domain]": {key for t in _DOMAINS.tables.values() for key in (*t.required, *t.optional)},
    "[size]": {key for t in _SIZE.tables.values() for key in (*t.required, *t.optional)},
    "[run]": {*_RUN.optional},
    "[[layers]]": {*LAYERS.required, *LAYERS.optional},
    "[sequence]": {*SEQUENCE.optional},
}
"""The keys of each table."""


def _home(name: object, place: str) -> str:
    """Return a hint for an unknown key at `place`: the table or the kinds that have this key."""
    kinds = [kind for kind, t in _SIZE.tables.items() if name in (*t.required, *t.optional)]
    if kinds and re.search(r" size\b", place):
        return f" (it is for kind = {' or '.join(map(repr, kinds))})"
    homes = [home for home, keys in _HOMES.items() if name in keys]
    return f" (it belongs to {homes[0]})" if len(homes) == 1 else ""


def case(value: object, place: str) -> dict[str, Any]:
    """Check a whole case."""
    return _check_table(_CASE, value, place)


def run(value: object, place: str) -> dict[str, Any]:
    """Check the settings of a run."""
    return _check_table(_RUN, value, place)


def _check_table(table: Table, value: object, place: str) -> dict[str, Any]:
    """Check `value`; errors about a key in the wrong table name the right one."""
    try:
        return table(value, place)
    except UnknownKeyError as error:
        hint = _home(error.key, error.place)
        raise UnknownKeyError(error.place, error.key, error.known, hint) from None
