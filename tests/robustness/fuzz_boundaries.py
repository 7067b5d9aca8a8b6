"""The work of `fuzz.py` on polygons, and on rings that may be invalid."""

from __future__ import annotations

import numpy as np
import shapely

import clvoro
from clvoro.errors import InputError
from tests.robustness.fuzz_inputs import placed_in_polygon, some_polygon
from tests.robustness.fuzz_judge import Wrong, adapter, demand, demand_truth, run_by, some_real
from tests.robustness.fuzz_polygons import hard_polygon, polygon_of, some_rings
from tests.robustness.fuzz_work import WILD, run


def try_polygon(rng: np.random.Generator) -> str:
    domain, real = some_polygon(rng), some_real(rng)
    return diagram(domain, placed_in_polygon(rng, domain), real)


def diagram(domain: clvoro.Polygon, points: np.ndarray, real: str) -> str:
    """Make a diagram of those of `points` that do not coincide. Coincident ones are tested in boxes."""
    first = np.unique(domain.place(points, np.dtype(real)), axis=0, return_index=True)[1]
    points = points[np.sort(first)]
    try:
        demand(adapter(real).diagram(domain, points), real)
    except InputError as error:
        demand_truth(error, domain, real, points)
        raise
    return "mesh"


def try_polygon_run(rng: np.random.Generator) -> str:
    return run(rng, some_polygon(rng), rng.random() < WILD)


def try_hard(rng: np.random.Generator) -> str:
    """Diagrams and short runs from few, many or no given generators, in hard polygons."""
    domain, real, kind = hard_polygon(rng), some_real(rng), rng.random()
    if kind < 0.3:  # cells larger than most edges
        points = domain.lower + rng.random((int(rng.integers(1, 6)), 2)) * domain.extent
        points = points[domain.contains(points)]
        points = points if len(points) else domain.inner_points()[:1]
    elif kind < 0.45:
        points = domain.inner_points()
    else:
        points = placed_in_polygon(rng, domain)
    if kind < 0.8 and rng.random() < 0.6:
        return diagram(domain, points, real)
    first = np.unique(domain.place(points, np.dtype(real)), axis=0, return_index=True)[1]
    options = {"points": points[np.sort(first)]} if kind < 0.8 else {}
    method = str(rng.choice(["lloyd", "adaptive", "exact", "coupled"]))
    if method in ("adaptive", "exact"):
        options["effort"] = "fast"
    cells = 10 ** rng.uniform(0.5, 2.7)
    if len(points) > 20 * cells:  # of very many on lines few are deleted at a time, which takes minutes
        return diagram(domain, points, real)
    size = float(np.sqrt(domain.measure / cells))
    steps = int(rng.integers(0, 6))
    demand(run_by(adapter(real), domain, size, method=method, max_steps=steps, **options), real)
    return "mesh"


def try_rings(rng: np.random.Generator) -> str:
    """Rings are refused, or make a polygon that can be described and meshed."""
    domain, real = polygon_of(rng, some_rings(rng)), some_real(rng)
    if abs(shapely.area(domain.geometry) - domain.measure) > 1e-12 * domain.extent.prod():
        raise Wrong(f"area {domain.measure}, expected {shapely.area(domain.geometry)}")
    if clvoro.Polygon.described(**domain.describe()) != domain:
        raise Wrong("described it is another polygon")
    n = int(rng.choice([1, 3, 20]))
    points = domain.lower + rng.random((8 * n, 2)) * domain.extent
    points = points[domain.contains(points)][:n]
    return diagram(domain, points if len(points) else domain.inner_points()[:1], real)
