"""What `fuzz.py` does with its inputs: meshes of every kind, made, made again, carried on, written and read."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely

import clvoro
from clvoro.errors import InputError
from clvoro.io.vtu_read import load_vtu
from clvoro.layers import count_rows, free_domain, place_layers
from tests.fuzz_inputs import (
    placed,
    placed_in_polygon,
    some_box,
    some_layers,
    some_periodic_box,
    some_polygon,
)
from tests.fuzz_sizes import fail, fine_size, some_size
from tests.reference_polygon import faults

WILD = 0.25
"""Share of inputs that need not end in a mesh, of kinds where most should."""
MOST_ROWS = 5000
"""Generators of layers, of inputs that are tried."""
CALLBACKS: list[Any] = [
    lambda row: fail(), lambda row: "yes", lambda row: np.ones(2), lambda row: np.bool_(row["step"] > 2),
    lambda: None, 3, lambda row: 0.0,
]  # fmt: skip
_adapters: dict[str, clvoro.Adapter] = {}


class Wrong(Exception):  # noqa: N818
    """An input led to something other than a right mesh or a clear error."""


def adapter(dtype: str) -> clvoro.Adapter:
    if dtype not in _adapters:
        _adapters[dtype] = clvoro.Adapter(dtype=dtype)
    return _adapters[dtype]


def some_real(rng: np.random.Generator) -> str:
    return str(rng.choice(["float64", "float64", "float32"]))


def demand(mesh: clvoro.Result | clvoro.Diagram, real: str) -> None:
    """Raise unless `mesh` is right."""
    report = mesh.check()
    if not report:
        raise Wrong(str(report))
    diagram = mesh.diagram if isinstance(mesh, clvoro.Result) else mesh
    if isinstance(diagram.domain, clvoro.Polygon):
        found, outside = faults(diagram, real), ~diagram.domain.contains(mesh.points)
        if found or outside.any():
            raise Wrong("; ".join([*found, f"{outside.sum()} outside"]))


# Boxes that are tried: for diagrams and for runs.

Boxes = Callable[[np.random.Generator, bool], clvoro.Box]


def in_plane(rng: np.random.Generator, wild: bool) -> clvoro.Box:
    return some_box(rng, 2, wild)


def in_space(rng: np.random.Generator, wild: bool) -> clvoro.Box:
    return some_box(rng, 3, wild)


def with_seams(rng: np.random.Generator, wild: bool) -> clvoro.Box:
    return some_periodic_box(rng, int(rng.choice([2, 2, 3])), wild)


# Diagrams.


def try_diagram(boxes: Boxes, rng: np.random.Generator) -> str:
    wild, real = rng.random() < 2 * WILD, some_real(rng)
    box = boxes(rng, wild)
    diagram = adapter(real).diagram(box, placed(rng, box, real, wild))
    demand(diagram, real)
    if rng.random() < 0.1 and len(adapter(real).diagram(box, diagram.points)) != len(diagram):
        raise Wrong("another number of cells")
    return "mesh"


def try_polygon(rng: np.random.Generator) -> str:
    domain, real = some_polygon(rng), some_real(rng)
    points = placed_in_polygon(rng, domain)
    # Boxes show what becomes of generators that coincide.
    first = np.unique(domain.place(points, np.dtype(real)), axis=0, return_index=True)[1]
    demand(adapter(real).diagram(domain, points[np.sort(first)]), real)
    return "mesh"


# Runs.


def try_run(boxes: Boxes, rng: np.random.Generator) -> str:
    wild = rng.random() < WILD
    return run(rng, boxes(rng, wild), wild)


def try_polygon_run(rng: np.random.Generator) -> str:
    return run(rng, some_polygon(rng), rng.random() < WILD)


def run(rng: np.random.Generator, domain: clvoro.Box | clvoro.Polygon, wild: bool) -> str:
    real = some_real(rng)
    options = some_options(rng, domain, real, wild)
    result = run_by(adapter(real), domain, some_size(rng, domain, wild), **options)
    demand(result, real)
    if rng.random() < 0.1:
        written_and_read(result, real)
    return "mesh"


def run_by(made_by: clvoro.Adapter, *arguments: Any, **options: Any) -> clvoro.Result:
    """Run; that generators come too close to each other is the caller's fault only where they are his."""
    try:
        return made_by.run(*arguments, **options)
    except InputError as error:
        if "too close to each other" in str(error) and "points" not in options:
            raise Wrong(f"by itself the run has come to this: {error}") from error
        raise


def written_and_read(result: clvoro.Result, real: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for suffix, reader in ((".npz", clvoro.load), (".vtu", load_vtu)):
            result.save(Path(folder) / f"m{suffix}")
            demand(reader(Path(folder) / f"m{suffix}"), real)
        with contextlib.suppress(InputError):  # which has no room for cells around holes
            result.save(Path(folder) / "polyMesh")


def some_options(rng: np.random.Generator, domain: Any, real: str, wild: bool) -> dict[str, Any]:
    """Options of a run; `wild`: such as are refused, or mean little."""
    d = domain.dim
    methods = ["adaptive", "exact", "coupled", "lloyd", "poisson", "weighted", "weighted-lloyd"]
    options: dict[str, Any] = {
        "method": str(rng.choice(methods, p=[0.35, 0.2, 0.13, 0.08, 0.08, 0.1, 0.06])),
        "effort": str(rng.choice(["fast", "default", "best"], p=[0.6, 0.3, 0.1])),
        "seed": int(rng.integers(0, 2**31)), "start": str(rng.choice(["density", "uniform"])),
    }  # fmt: skip
    # Most runs in boxes go on to their end.
    if rng.random() < (0.7 if isinstance(domain, clvoro.Polygon) else 0.4):
        options["max_steps"] = int(rng.integers(0, 15 if d == 2 else 6))
    periods = domain.extent[list(domain.periodic)]
    most = domain.measure / fine_size(rng, domain) ** d  # cells that fit into periods, too
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
    if "points" in options and not wild:
        if options["method"] not in ("adaptive", "exact"):
            options.pop("n_cells", None)  # which these methods keep
        elif periods.size:  # few generators are too few across a period, and many levels below
            options.pop("points")
    return options


def some_generators(rng: np.random.Generator, domain: Any, real: str, wild: bool) -> np.ndarray:
    if isinstance(domain, clvoro.Polygon):
        return placed_in_polygon(rng, domain)
    if not any(domain.periodic) or wild:
        return placed(rng, domain, real, wild)
    # As dense as the periods want it.
    counts = np.maximum(np.ceil(domain.extent / fine_size(rng, domain)).astype(int), 1)
    x = np.stack(np.meshgrid(*[(np.arange(c) + 0.5) / c for c in counts], indexing="ij"), axis=-1)
    x = x.reshape(-1, domain.dim) + rng.uniform(-0.3, 0.3, (counts.prod(), domain.dim)) / counts
    return domain.lower + x * domain.extent


def few_layers(rng: np.random.Generator, domain: Any, wild: bool) -> list[clvoro.Layers]:
    """Layers; unless `wild`, of not too many rows, and such as leave room, which is tried some times."""
    for _ in range(30):
        layers = some_layers(rng, domain, wild)
        if wild:
            break
        with contextlib.suppress(InputError):
            if count_rows(domain, layers) <= MOST_ROWS:
                free_domain(domain, layers)
                break
    return layers


def try_layers(rng: np.random.Generator) -> str:
    wild = rng.random() < WILD
    kind = rng.random()
    domain = some_polygon(rng) if kind < 0.6 else some_box(rng, 2, wild)
    if kind > 0.9:
        domain = some_periodic_box(rng, 2, wild)
        if not wild and all(domain.periodic):  # layers go along walls
            domain = clvoro.Box(domain.lower, domain.upper, periodic=(True, False))
    layers, real = few_layers(rng, domain, wild), some_real(rng)
    if MOST_ROWS < count_rows(domain, layers) < 1e9:  # a benchmark, not a test
        return "left out"
    options = some_options(rng, domain, real, wild)
    options["effort"] = "fast"
    if not wild:
        options.pop("n_cells", None)  # may be fewer than the rows
    result = adapter(real).run(domain, some_size(rng, domain, wild), layers=layers, **options)
    rows, free = place_layers(domain, layers), free_domain(domain, layers)
    # Coordinates of the device are relative to the frame, those of the host to 0.
    slack = 8 * np.finfo(real).eps * domain.extent.max()
    slack += 4 * sum(np.spacing(np.abs(corner).max()) for corner in (domain.upper, domain.lower))
    if not np.abs(result.points[: len(rows)] - rows).max() <= slack:
        raise Wrong("a layer's generator has moved")
    others = result.points[len(rows) :]
    if isinstance(domain, clvoro.Box):
        away = np.abs(others - np.clip(others, free.lower, free.upper)).max(initial=0)
    else:
        away = shapely.distance(free.geometry, shapely.points(others)).max(initial=0)
    demand(result, real)
    if not away <= slack:
        raise Wrong(f"generators are {away:.3g} beyond what layers leave to them")
    return "mesh"


# What follows on runs.


def some_domain(rng: np.random.Generator) -> clvoro.Box | clvoro.Polygon:
    kind = rng.integers(0, 5)
    if kind < 2:
        return some_box(rng, int(rng.choice([2, 2, 3])), wild=False)
    return (
        some_polygon(rng)
        if kind == 2
        else some_periodic_box(rng, int(rng.choice([2, 2, 3])), wild=False)
    )


def try_resumed(rng: np.random.Generator) -> str:
    """A run that is interrupted and goes on ends with the same bits."""
    domain, real = some_domain(rng), some_real(rng)
    arguments = (domain, some_size(rng, domain, wild=False))
    options = some_options(rng, domain, real, wild=False)
    if (
        not isinstance(domain, clvoro.Polygon)
        and domain.dim == 2
        and rng.random() < 0.2
        and not any(domain.periodic)
    ):
        options["layers"] = few_layers(rng, domain, wild=False)
        options.pop("n_cells", None)
    whole = run_by(clvoro.Adapter(adapter(real).ctx, real), *arguments, **options)
    demand(whole, real)
    left = int(rng.integers(1, len(whole.history) + 1))
    with tempfile.TemporaryDirectory() as folder:
        state, rows = Path(folder) / "state", 0

        def stop(_: np.void) -> bool:
            nonlocal rows
            rows += 1
            return rows >= left

        adapter(real).run(*arguments, callback=stop, checkpoint=state, **options)
        if not state.exists():
            return "mesh"  # it had ended
        try:
            resumed = adapter(real).run(*arguments, resume=state, **options)
        except InputError as error:
            raise Wrong(f"not resumed after row {left}: {error}") from error
    for name in ("points", "error", "quality", "size"):
        if not np.array_equal(getattr(resumed, name), getattr(whole, name)):
            raise Wrong(f"a resumed run has other {name}, stopped after row {left}")
    return "mesh"


def try_moved(rng: np.random.Generator) -> str:
    """A mesh adapted to another field, and values carried over to it."""
    domain, real = some_domain(rng), some_real(rng)
    options = {
        "effort": "fast",
        "method": str(rng.choice(["adaptive", "exact"])),
        "seed": int(rng.integers(99)),
    }
    first = run_by(adapter(real), domain, some_size(rng, domain, wild=False), **options)
    second = adapter(real).run(
        domain, some_size(rng, domain, wild=False), points=first.points, **options
    )
    demand(second, real)
    if domain.dim == 3 and any(domain.periodic):  # where nothing is carried over yet
        return "mesh"
    values = rng.choice([1.0, 1e-200, 1e200]) * rng.standard_normal(
        (len(first.points), 2)
    ) + rng.choice([0, 1])
    got = first.transfer(values, onto=second, order=int(rng.choice([1, 2])))
    before, after = first.diagram.volumes @ values, second.diagram.volumes @ got
    # In single precision volumes sum to others, and bounds come first.
    off = abs(first.diagram.volumes.sum() - second.diagram.volumes.sum())
    slack = 1e-11 * (first.diagram.volumes @ np.abs(values)) + off * np.abs(values).max(axis=0)
    if not (np.abs(after - before) <= slack).all():
        raise Wrong(f"of {before} there are {after} after the transfer")
    low, high = values.min(axis=0), values.max(axis=0)
    if not ((got >= low) & (got <= high)).all():
        raise Wrong("values beyond the bounds after the transfer")
    return "mesh"


# One adapter for all.


def try_turns(rng: np.random.Generator) -> str:
    """What else an adapter does, of whatever size, changes nothing of a run that is carried on in it."""
    domain, real = some_domain(rng), some_real(rng)
    arguments = (domain, some_size(rng, domain, wild=False))
    options = some_options(rng, domain, real, wild=False) | {"effort": "fast"}
    whole = run_by(clvoro.Adapter(adapter(real).ctx, real), *arguments, **options)
    kept = clvoro.Adapter(adapter(real).ctx, real)
    with tempfile.TemporaryDirectory() as folder:
        state = Path(folder) / "state"
        between(rng, kept, real)
        kept.run(*arguments, checkpoint=state, checkpoint_every=0, **options)
        if not state.exists():
            return "mesh"
        between(rng, kept, real)
        try:
            resumed = kept.run(*arguments, resume=state, **options)
        except InputError as error:
            raise Wrong(f"not resumed in the adapter that has done more: {error}") from error
        for name in ("points", "error", "size"):
            if not np.array_equal(getattr(resumed, name), getattr(whole, name)):
                raise Wrong(f"in an adapter that has done more a resumed run has other {name}")
        changed: dict[str, Any] = {
            "seed": options["seed"] + 1, "k": 0.7, "points": whole.points[:3], "n_cells": 7, "method": "lloyd",
            "tol": 0.3, "max_steps": 1, "effort": "default",
        }  # fmt: skip
        name = str(rng.choice(list(changed)))
        with contextlib.suppress(InputError):  # the state is of another run
            other = kept.run(*arguments, **{**options, name: changed[name]}, resume=state)
            demand(other, real)
    return "mesh"


def between(rng: np.random.Generator, kept: clvoro.Adapter, real: str) -> None:
    """Other work of very different sizes in the adapter `kept`."""
    for _ in range(rng.integers(1, 4)):
        domain, kind = some_domain(rng), rng.integers(3)
        if kind == 0:
            size = fine_size(rng, domain) * 10 ** rng.uniform(-1, 0)
            if not kept.memory_needed(domain, float(size)) > 0:
                raise Wrong("a run that needs no memory")
        elif kind == 1:
            n = int(10 ** rng.uniform(0, 4 if domain.dim == 2 else 3))
            x = domain.lower + rng.random((n, domain.dim)) * domain.extent
            inside = x[domain.contains(x)]
            if len(inside):
                demand(kept.diagram(domain, inside), real)
        else:
            size = fine_size(rng, domain)
            demand(run_by(kept, domain, size, effort="fast", max_steps=2), real)
