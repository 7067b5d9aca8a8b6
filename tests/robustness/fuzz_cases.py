"""Case files for `fuzz.py`: every kind of domain, size, layer and setting that they may hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.robustness import fuzz_files as files

STRANGE = [None, -1, 0, "", "nonsense", [], {}, True, [1], 1e300, [[1, 2]], float("nan"), "../a.npy"]
DOMAINS: list[dict[str, Any]] = [
    {"lower": [0, 0], "upper": [2, 1]},
    {"lower": [0, 0], "upper": [2, 2], "periodic": True},
    {"lower": [0, 0], "upper": [2, 2], "periodic": [True, False]},
    {"outer": [[0, 0], [2, 0], [2, 1], [0, 1.5]], "holes": [{"kind": "circle", "center": [1, 0.6], "radius": 0.2}]},
    {"outer": [[-1, -1], [2, -1], [2, 1], [-1, 1]], "holes": [{"kind": "naca", "code": "2412", "tolerance": 1e-4}]},
    {"polygon": "g.geojson"},
    {"polygon": "w.wkt"},
    {"lower": [0, 0, 0], "upper": [1, 1, 0.7]},
]


def some_shape(rng: np.random.Generator, d: int) -> dict[str, Any]:
    """A shape that sizes are measured from."""
    at = rng.random((4, d)).round(3).tolist()
    shapes = [
        {"kind": "circle", "center": at[0], "radius": 0.2},
        {"kind": "boundary"},
        {"kind": "segment", "a": at[0], "b": at[1]},
        {"kind": "polyline", "points": at},
        {"kind": "closed_polyline", "points": at},
        {"kind": "box"},
        {"kind": "naca", "code": "0012", "angle_of_attack": -5},
        {"kind": "sphere", "center": [0.5, 0.5, 0.5], "radius": 0.2},
        {"kind": "surface", "file": "s.stl", "closed": bool(rng.integers(2))},
    ]
    fits = shapes[:7] if d == 2 else [*shapes[:6], *shapes[7:]]
    return dict(fits[rng.integers(len(fits))])


def some_field(rng: np.random.Generator, domain: dict[str, Any], depth: int = 0) -> Any:
    """Sizes of about 0.1 to 0.4."""
    d = len(domain.get("lower", (0, 0)))
    growth = {"growth": 1.3} if rng.random() < 0.5 else {"slope": 0.4}
    shapes = [some_shape(rng, d) for _ in range(rng.integers(1, 3))]
    covers = {} if "lower" in domain and rng.random() < 0.5 else {"lower": [-1] * d, "upper": [7] * d}
    bounds = {"h_min": 0.1, "h_max": 0.4}
    fields: list[Any] = [
        0.2,
        {"kind": "constant", "value": 0.3},
        {"kind": "expression", "expression": "0.2 + 0.05*sin(x*y)"},
        {"kind": "distance", "shapes": shapes, "h_min": 0.1, "h_max": 0.3, **growth},
        {"kind": "raster", "file": "a.npy", "outside": "nearest", **covers},
        {"kind": str(rng.choice(["hessian", "gradient"])), "file": "u.npy", "eps": 0.1, **bounds, **covers},
    ]
    if "lower" not in domain:
        fields.append({"kind": "feature", "cells_across": 2, "growth": 1.4, **bounds})
    if depth > 1 or rng.random() < 0.5:
        return fields[rng.integers(len(fields))]
    one, other = (some_field(rng, domain, depth + 1) for _ in range(2))
    weight = {"kind": "expression", "expression": "1 + 0.2*sin(3*x)"}
    nested: list[Any] = [
        {"kind": "graded", "field": one, **growth},
        {"kind": "graded", "field": one, "resolution": int(rng.integers(2, 40)), **growth},
        {"kind": "min", "fields": [one, other, 0.35]},
        {"kind": "max", "fields": [one, other]},
        {"kind": "scale", "factor": 0.9, "field": one},
        {"kind": "sum", "fields": [one, other]},
        {"kind": "product", "fields": [one, weight]},
        {"kind": "quotient", "fields": [one, weight]},
    ]
    return nested[rng.integers(len(nested))]


def some_run(rng: np.random.Generator, d: int, real: str) -> dict[str, Any]:
    """Settings of a run, short or to its end."""
    methods = ["adaptive", "exact", "coupled", "lloyd"]
    run: dict[str, Any] = {"effort": "fast", "seed": int(rng.integers(99)), "dtype": real}
    if rng.random() < 0.4:
        run["max_steps"] = int(rng.integers(0, 6))
    if rng.random() < 0.2:
        run["methods"] = ["lloyd", "coupled"]
    else:
        run["method"] = str(rng.choice(methods))
    optional = {
        "levels": ["auto", 0, 1][rng.integers(3)],
        "error_target": 0.05,
        "start": "uniform",
        "tol": 0.7,
        "k": 0.3,
        "alpha": 2.0,
        "points": "points.npy",
        "n_cells": 150,
    }
    return run | {key: value for key, value in optional.items() if rng.random() < 0.12}


def some_case(rng: np.random.Generator, folder: Path, real: str, wild: bool) -> dict[str, Any]:
    """A case whose files lie in `folder`; `wild`: with something strange in it."""
    domain: dict[str, Any] = dict(DOMAINS[rng.integers(len(DOMAINS))])
    d = len(domain.get("lower", (0, 0)))
    np.save(folder / "a.npy", 0.1 + 0.1 * rng.random((4, 5, 3)[:d]))
    np.save(folder / "u.npy", np.tanh(rng.standard_normal((9, 8, 7)[:d]).cumsum(axis=0)))
    np.save(folder / "points.npy", 0.05 + 0.6 * rng.random((60, d)))
    (folder / "g.geojson").write_bytes(files.GEOJSON)
    (folder / "w.wkt").write_bytes(files.WKT)
    (folder / "s.stl").write_bytes(files.surfaces()["s.stl"])
    size, run = some_field(rng, domain), some_run(rng, d, real)
    case: dict[str, Any] = {"name": "fuzz", "domain": domain, "size": size, "run": run}
    if "periodic" in domain:  # a period needs a least number of cells
        run.pop("points", None)
    walls = not np.all(domain.get("periodic", False))
    if d == 2 and walls and rng.random() < 0.2:
        run.pop("n_cells", None)  # may be fewer than the rows
        layer: dict[str, Any] = {"height": 0.02, "count": int(rng.integers(1, 4))}
        extra = {"growth": 1.3, "spacing": 0.1, "edges": [0, 1]}
        case["layers"] = [layer | {k: v for k, v in extra.items() if rng.random() < 0.4}]
        if "lower" not in domain and "edges" not in case["layers"][0]:
            case["layers"][0]["edges"] = 0
    rng.random()  # numbers that failed once stay the same input
    if wild:
        table: Any = [case, domain, size if isinstance(size, dict) else case, run][rng.integers(4)]
        key = str(rng.choice(list(table)))
        value = STRANGE[rng.integers(len(STRANGE))]
        if value is None:
            del table[key]
        elif rng.random() < 0.3:
            table[key + "s"] = table.pop(key)
        else:
            table[key] = value
    return case
