"""Judge the result of an input: a valid mesh, or a true error."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import shapely
from scipy.spatial import KDTree

import clvoro
from clvoro.errors import InputError
from clvoro.tessellation.device_diagram import LEAST_SEPARATION

CLOSE = 64
"""Roundings: generators that are given nearer to each other than that, in domains of size 1, may come too near for the
boundary of a polygon to find its way between them."""
NARROW = 8
"""Roundings of positions: where parts of a polygon are no further from each other than that, it may be refused."""
LARGEST = 150e6
"""Bytes on the device, of a run that is tried: 300,000 cells in the plane, 40,000 in space."""
_adapters: dict[str, clvoro.Adapter] = {}


class TooLarge(Exception):  # noqa: N818
    """The input requires too much work for a test."""


class Wrong(Exception):  # noqa: N818
    """The result is neither a valid mesh nor a clear error."""


def adapter(dtype: str) -> clvoro.Adapter:
    if dtype not in _adapters:
        _adapters[dtype] = clvoro.Adapter(dtype=dtype)
    return _adapters[dtype]


def some_real(rng: np.random.Generator) -> str:
    return str(rng.choice(["float64", "float64", "float32"]))


def demand(mesh: clvoro.Result | clvoro.Diagram, real: str) -> None:
    """Raise unless `mesh` is valid."""
    report = mesh.check()
    if not report:
        raise Wrong(str(report))


def run_by(made_by: clvoro.Adapter, domain: Any, *arguments: Any, **options: Any) -> clvoro.Result:
    """Run. Generators of the caller that are far apart must not come too close to each other in the run."""
    made_by.on_memory = refuse_large
    try:
        return made_by.run(domain, *arguments, **options)
    except InputError as error:
        levels = options.get("levels") or 0
        demand_truth(error, domain, made_by.dtype.name, options.get("points"), levels)
        raise


def refuse_large(needed: float) -> None:
    """Raise if a run takes more than `LARGEST`."""
    if needed > LARGEST:
        raise TooLarge


def demand_truth(error: InputError, domain: Any, real: str, points: Any, levels: int = 0) -> None:
    """Raise if `error` says of generators or edges that they are too close to each other, and they are not.

    New generators of finer levels, between those that are there, are half as far apart, and somewhat less.
    """
    demand_telling_apart(error, domain, real)
    if not any(said in str(error) for said in ("too close to each other", "coincide in")):
        return
    if isinstance(domain, clvoro.Polygon) and clearance(domain, real) <= NARROW:
        return
    if points is not None:
        placed = domain.place(np.asarray(points, float), np.dtype(float))
        apart = KDTree(placed).query(placed, k=2)[0][:, 1] if len(placed) > 1 else np.array([1.0])
        least = CLOSE * np.finfo(real).eps if domain.dim == 2 else 3**levels * LEAST_SEPARATION[real]
        if apart.min() <= least:
            return
    raise Wrong(f"this is not so: {error}") from error


def demand_telling_apart(error: InputError, domain: Any, real: str) -> None:
    """Raise if `error` says of generators in the plane that they are too close to each other, and they are not.

    Their places differ. Near 0 floating-point numbers may be closer than the domain's size rounds.
    """
    said = re.search(r"(\S+) apart, are too close", str(error))
    if domain.dim == 2 and said and float(said[1]) > domain.frame[1] * np.finfo(real).eps / 2:
        raise Wrong(f"this is not so in the plane: {error}") from error


def diagram_by(made_by: clvoro.Adapter, box: clvoro.Box, points: Any) -> clvoro.Diagram:
    """Return the diagram of a box; raise unless it is valid."""
    try:
        diagram = made_by.diagram(box, points)
    except InputError as error:
        demand_telling_apart(error, box, made_by.dtype.name)
        raise
    demand(diagram, made_by.dtype.name)
    return diagram


def clearance(domain: clvoro.Polygon, real: str) -> float:
    """Return the least distance of edges without a common corner, in units of the round-off of positions."""
    unit = domain.frame[1] * np.finfo(real).eps
    return float(shapely.minimum_clearance(domain.geometry)) / unit
