"""Options of the runs that `fuzz.py` tries."""

from __future__ import annotations

from typing import Any

import numpy as np

import clvoro
from clvoro.adaptation.options import arguments_of_run
from tests.robustness.fuzz_inputs import placed, placed_in_polygon
from tests.robustness.fuzz_sizes import fail, fine_size

CALLBACKS: list[Any] = [
    lambda row: fail(),
    lambda row: "yes",
    lambda row: np.ones(2),
    lambda row: np.bool_(row["step"] > 2),
    lambda: None,
    3,
    lambda row: 0.0,
]


def some_options(rng: np.random.Generator, domain: Any, real: str, wild: bool) -> dict[str, Any]:
    """Options of a run; `wild`: also invalid or pointless ones."""
    d = domain.dim
    methods = ["adaptive", "exact", "coupled", "lloyd", "poisson", "weighted", "weighted-lloyd"]
    options: dict[str, Any] = {
        "method": str(rng.choice(methods, p=[0.35, 0.2, 0.13, 0.08, 0.08, 0.1, 0.06])),
        "effort": str(rng.choice(["fast", "default", "best"], p=[0.6, 0.3, 0.1])),
        "seed": int(rng.integers(0, 2**31)),
        "start": str(rng.choice(["density", "uniform"])),
    }
    # Without a draw: the inputs of earlier seeds stay.
    others, chance = ("mmpde", "monge-ampere", "transport"), options["seed"] % 24
    # Most runs in boxes are complete.
    if rng.random() < (0.7 if isinstance(domain, clvoro.Polygon) else 0.4):
        options["max_steps"] = int(rng.integers(0, 15 if d == 2 else 6))
    periods = domain.extent[list(domain.periodic)]
    most = domain.measure / fine_size(rng, domain) ** d  # cells must fit into periods, too
    optional = {
        "n_cells": lambda: int(most * rng.uniform(1, 1.5)) + (1 if periods.size else 12),
        "k": lambda: float(rng.choice([0.1, 1.0, 2.0])),
        "alpha": lambda: float(rng.choice([0.3, 1.0, 3.0])),
        "tol": lambda: float(rng.choice([0.0, 0.5, 0.9])),
        "levels": lambda: 0 if periods.size else int(rng.integers(0, 2)),
        "error_target": lambda: float(rng.choice([1e-4, 0.01, 0.1])),
        "points": lambda: some_generators(rng, domain, real, wild),
    }
    if wild:
        optional |= {
            "method": lambda: "nonsense",
            "n_cells": lambda: int(rng.choice([1, 2, 3, 17, 40, 10**9, -1])),
            "k": lambda: rng.choice([1e-9, 100.0, -1.0, np.nan]),
            "alpha": lambda: rng.choice([1e-9, 100.0, np.inf]),
            "tol": lambda: rng.choice([1e9, -1.0]),
            "levels": lambda: rng.choice([np.int64(2), 50, -1]),
            "error_target": lambda: rng.choice([1e-9, 10.0, 0.0]),
            "effort": lambda: ["slow", None, 3][rng.integers(3)],
            "start": lambda: ["random", None, 0][rng.integers(3)],
            "seed": lambda: [-1, 1.5, 2**70, "1", None][rng.integers(5)],
            "max_steps": lambda: [-1, 2.5, "3"][rng.integers(3)],
            "callback": lambda: CALLBACKS[rng.integers(len(CALLBACKS))],
        }
    options |= {name: make() for name, make in optional.items() if rng.random() < 0.12}
    walled = isinstance(domain, clvoro.Box) and not any(domain.periodic)
    if walled and chance < len(others) and "points" not in options:
        options["method"] = others[chance]
    if "points" in options and not wild:
        if options["method"] not in ("adaptive", "exact"):
            options.pop("n_cells", None)  # these methods keep the number
        elif periods.size:  # a period needs a least number of cells, on coarser levels, too
            options.pop("points")
    return arguments_of_run(options)


def some_generators(rng: np.random.Generator, domain: Any, real: str, wild: bool) -> np.ndarray:
    if isinstance(domain, clvoro.Polygon):
        return placed_in_polygon(rng, domain)
    if not any(domain.periodic) or wild:
        return placed(rng, domain, real, wild)
    # As dense as the periods require.
    counts = np.maximum(np.ceil(domain.extent / fine_size(rng, domain)).astype(int), 1)
    x = np.stack(np.meshgrid(*[(np.arange(c) + 0.5) / c for c in counts], indexing="ij"), axis=-1)
    # Or a lattice, up to some round-off.
    noise = rng.choice([0.3, 1e-6, 1e-15]) * rng.uniform(-1, 1, (counts.prod(), domain.dim))
    x = x.reshape(-1, domain.dim) + noise / counts
    return domain.lower + x * domain.extent
