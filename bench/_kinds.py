"""All kinds of runs by name: domain, size field and options for a number of cells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from _common import CUBE, PERIODIC, PERIODIC_CUBE, SQUARE, domain_of, test_field

import clvoro
from clvoro import earth, sizing
from clvoro.adaptation.sampling.start import count_cells

Kind = tuple[clvoro.Box | clvoro.Polygon | clvoro.Sphere, Any, dict[str, Any]]

METHODS = ("lloyd", "poisson", "coupled", "weighted", "weighted-lloyd")


def blob(edges: int = 200) -> clvoro.Polygon:
    """Return a polygon of five lobes with a hole."""
    turn = np.linspace(0, 2 * np.pi, edges, endpoint=False)
    radius = 0.4 + 0.08 * np.sin(5 * turn)
    shore = 0.5 + radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return clvoro.Polygon(shore, [[(0.5, 0.45), (0.6, 0.45), (0.55, 0.55)]])


LAKE, COAST = blob(), blob(1500)


def even(domain: Any, **options: Any) -> Callable[[int], Kind]:
    """Return runs with cells of equal size."""
    return lambda n: (domain, (domain.measure / n) ** (1 / domain.cell_dim), options)


def of(domain: Any, field: Any, **options: Any) -> Callable[[int], Kind]:
    """Return runs of a field, or a formula, scaled to the number of cells."""
    field = sizing.Expression(field) if isinstance(field, str) else field
    return lambda n: (domain, field * (count_cells(field, domain) / n) ** (1 / domain.cell_dim), options)


def layered(domain: Any) -> Callable[[int], Kind]:
    """Return runs with boundary layers on all walls, finer than the other cells."""

    def kind(n: int) -> Kind:
        size = (domain.measure / n) ** 0.5
        return domain, size, {"layers": clvoro.Layers(0.3 * size, count=3, growth=1.2)}

    return kind


def from_points(factor: float, **options: Any) -> Callable[[int], Kind]:
    """Return runs from random points, `factor` times as many as cells."""

    def kind(n: int) -> Kind:
        points = np.random.default_rng(1).random((round(factor * n), 2))
        return SQUARE, n**-0.5, {"points": points, **options}

    return kind


def of_callable(n: int) -> Kind:
    """Return a run of a function on the host, combined with a raster on the device."""
    raster = sizing.Raster(1 + RANDOM.random((200, 200)), (0, 0), (1, 1)) * n**-0.5
    return SQUARE, sizing.minimum(raster, lambda p: np.full(len(p), 2 * n**-0.5)), {}


def graded(domain: Any, formula: str) -> Callable[[int], Kind]:
    """Return runs of a jump with limited growth."""
    plain = of(domain, formula)
    return lambda n: (domain, sizing.Graded(plain(n)[1], 1.2), {})


RANDOM = np.random.default_rng(1)
CURVE = np.column_stack([np.linspace(0.1, 0.9, 500), 0.5 + 0.2 * np.sin(np.linspace(0, 9, 500))])
GLOBE = clvoro.Sphere(1.0)
CAPS = earth.Caps([((-45, 45), 0.3, 0.1)], h_max=0.8, growth=1.2, sphere=GLOBE)
SPHERE = sizing.Distance(sizing.Ball((0.5, 0.5, 0.4), 0.25), h_min=0.045, slope=0.2)
SHORE = sizing.Distance(COAST.boundary(), h_min=0.002, slope=0.5)
JUMP = "x < 0.5 ? 1.0 : 10.0"
STRIPS = {
    "strip": "x < 0.02 ? 1.0 : 32.0",
    "thin strip": "x < 0.01 ? 1.0 : 40.0",
    "strip inside": "fabs(x - 0.5) < 0.02 ? 1.0 : 20.0",
    "two strips": "x < 0.02 || y < 0.02 ? 1.0 : 23.0",
    "corner": "x < 0.1 && y < 0.1 ? 1.0 : 44.0",
    "diagonal": "fabs(x - y) < 0.015 ? 1.0 : 23.0",
    "ring": "fabs(hypot(x - 0.5, y - 0.5) - 0.3) < 0.01 ? 1.0 : 23.0",
    "many strips": "sin(60 * x) > 0.95 ? 1.0 : 16.0",
    "a row": "fabs(x - 0.5) < 0.00016 ? 1.0 : 250.0",
}
"""Narrow strips of fine cells in a unit square, along walls or seams, and across them."""
SLAB = "x < 0.1 ? 1.0 : 6.7"
STEEP = {
    "jump": (SQUARE, "x < 0.5 ? 1.0 : 19.0"),
    "stripes": (SQUARE, "sin(25 * x) < 0 ? 1.0 : 10.0"),
    "disc": (SQUARE, "hypot(x - 0.5, y - 0.5) < 0.25 ? 1.0 : 12.0"),
    "kink": (SQUARE, "0.001 + fabs(x - 0.5)"),
    "chequers": (SQUARE, "sin(20 * x) * sin(20 * y) < 0 ? 1.0 : 8.0"),
    "wall": (CUBE, "x < 0.5 ? 1.0 : 8.0"),
}
"""Fields that are hard to estimate from sizes at generators, by name: domain and formula."""

KINDS: dict[str, Callable[[int], Kind]] = {
    **{name: of(domain_of(name), test_field(name)) for name in ("F2", "S1")},
    **{f"steep, {name}": of(*given) for name, given in STEEP.items()},
    "square": even(SQUARE),
    "square, exact": even(SQUARE, method="exact"),
    "square, best": even(SQUARE, effort="best"),
    "square, fast": even(SQUARE, effort="fast"),
    "square, uniform start": even(SQUARE, points="uniform"),
    **{f"square, {m}": even(SQUARE, method=m, max_steps=12) for m in METHODS},
    "square, count held": lambda n: (SQUARE, sizing.Expression("0.01 + 0.1 * x"), {"n_cells": n}),
    "square, from as many points": from_points(1),
    "square, from few points": from_points(1 / 16),
    "square, from many points": from_points(2),
    "square, points kept": from_points(1, method="coupled", max_steps=12),
    "square, layers": layered(SQUARE),
    "square, callable": of_callable,
    "square, raster": of(SQUARE, sizing.Raster(1 + 0.5 * RANDOM.random((400, 400)), (0, 0), (1, 1))),
    "square, scattered": of(SQUARE, sizing.Scattered(RANDOM.random((20000, 2)), 1 + RANDOM.random(20000))),
    "square, graded": graded(SQUARE, JUMP),
    "square, polyline": of(SQUARE, sizing.Distance(sizing.Polyline(CURVE), h_min=0.004, slope=0.2)),
    **{f"square, {name}": of(SQUARE, formula) for name, formula in STRIPS.items()},
    "lake, strip at the shore": of(LAKE, "x < 0.12 ? 1.0 : 30.0"),
    "lake": even(LAKE),
    "lake, coupled": even(LAKE, method="coupled", max_steps=12),
    "lake, layers": layered(LAKE),
    "coast": even(COAST),
    "coast, fine at the shore": of(COAST, SHORE),
    "periodic": even(PERIODIC),
    "periodic, coupled": even(PERIODIC, method="coupled", max_steps=12),
    "periodic, jump at a seam": of(PERIODIC, JUMP),
    "periodic, jumps beside seams": of(PERIODIC, "(x - 0.1) * (x - 0.6) < 0 ? 1.0 : 10.0"),
    **{f"periodic, {name}": of(PERIODIC, formula) for name, formula in STRIPS.items()},
    "cube, slab": of(CUBE, SLAB),
    "periodic cube, slab": of(PERIODIC_CUBE, SLAB),
    "cube": even(CUBE),
    "cube, exact": even(CUBE, method="exact"),
    "cube, coupled": even(CUBE, method="coupled", max_steps=6),
    "cube, fast": even(CUBE, effort="fast"),
    "cube, graded": graded(CUBE, "x < 0.5 ? 1.0 : 5.0"),
    "sphere": even(GLOBE),
    "sphere, exact": even(GLOBE, method="exact"),
    "sphere, coupled": even(GLOBE, method="coupled", max_steps=12),
    "sphere, caps": of(GLOBE, CAPS),
    "cube, sphere": of(CUBE, SPHERE),
    "periodic cube": even(PERIODIC_CUBE),
}
