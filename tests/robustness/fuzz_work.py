"""The work of `fuzz.py`: meshes of every kind are made, repeated, resumed, written and read."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import shapely

import clvoro
from clvoro.errors import InputError
from clvoro.geometry.boundary_layers import LayerRows
from clvoro.io.vtu_read import load_vtu
from tests.robustness.fuzz_inputs import around, placed, some_box, some_layers, some_periodic_box, some_polygon
from tests.robustness.fuzz_judge import Wrong, adapter, demand, diagram_by, run_by, some_real
from tests.robustness.fuzz_options import some_options
from tests.robustness.fuzz_sizes import fine_size, some_size

WILD = 0.25
"""Share of inputs that need not end in a mesh, of kinds where most should."""
MOST_ROWS = 5000
"""Largest number of generators in layers."""

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
    diagram = diagram_by(adapter(real), box, placed(rng, box, real, wild))
    if rng.random() < 0.1 and len(adapter(real).diagram(box, diagram.points)) != len(diagram):
        raise Wrong("another number of cells")
    return "mesh"


def try_around(rng: np.random.Generator) -> str:
    """Very many cells at a point, or along a line."""
    dim, real = int(rng.choice([2, 2, 3])), some_real(rng)
    box = clvoro.Box((0,) * dim, (1,) * dim, periodic=tuple((rng.random(dim) < 0.1).tolist()))
    diagram_by(adapter(real), box, around(rng, dim))
    return "mesh"


# Runs.


def try_run(boxes: Boxes, rng: np.random.Generator) -> str:
    wild = rng.random() < WILD
    return run(rng, boxes(rng, wild), wild)


def run(rng: np.random.Generator, domain: clvoro.Box | clvoro.Polygon, wild: bool) -> str:
    real = some_real(rng)
    options = some_options(rng, domain, real, wild)
    result = run_by(adapter(real), domain, some_size(rng, domain, wild), **options)
    demand(result, real)
    if rng.random() < 0.1:
        written_and_read(result, real)
    return "mesh"


def written_and_read(result: clvoro.Result, real: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for suffix, reader in ((".npz", clvoro.load), (".vtu", load_vtu)):
            result.save(Path(folder) / f"m{suffix}")
            demand(reader(Path(folder) / f"m{suffix}"), real)
        with contextlib.suppress(InputError):  # which cannot hold cells around holes
            result.save(Path(folder) / "polyMesh")


def few_layers(rng: np.random.Generator, domain: Any, wild: bool) -> list[clvoro.Layers]:
    """Layers; unless `wild`, with few rows and room between them, after some attempts."""
    for _ in range(30):
        layers = some_layers(rng, domain, wild)
        if wild:
            break
        with contextlib.suppress(InputError):
            made = LayerRows(domain, layers)
            if made.count() <= MOST_ROWS and made.free:
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
    made = LayerRows(domain, layers)
    if MOST_ROWS < made.count() < 1e9:  # too long for a test
        return "left out"
    options = some_options(rng, domain, real, wild)
    options["effort"] = "fast"
    if not wild:
        options.pop("n_cells", None)  # may be fewer than the rows
        if options.get("method") in ("mmpde", "monge-ampere"):
            del options["method"]  # starts from a lattice, without layers
    result = adapter(real).run(domain, some_size(rng, domain, wild), layers=layers, **options)
    rows, free = made.points, made.free
    # Coordinates of the device are relative to the frame, those of the host to 0.
    slack = 8 * np.finfo(real).eps * domain.extent.max()
    slack += 4 * sum(np.spacing(np.abs(corner).max()) for corner in (domain.upper, domain.lower))
    distance, at = scipy.spatial.KDTree(result.points).query(rows)
    if not distance.max() <= slack:
        raise Wrong("a layer's generator has moved")
    rest = np.delete(np.arange(len(result.points)), at)
    others = result.points[rest]
    if isinstance(domain, clvoro.Box):
        away = np.abs(others - np.clip(others, free.lower, free.upper)).max(initial=0)
    else:
        away = shapely.distance(free.geometry, shapely.points(others))
        # What stands on the edge of a part that is too small for another is split beyond it (see apart.h).
        parts = shapely.get_parts(free.geometry)
        for k in np.flatnonzero(away > slack):
            nearest = parts[np.argmin(shapely.distance(parts, shapely.Point(others[k])))]
            small = nearest.area < 4 * result.target_size[rest[k]] ** 2
            away[k] = 0 if small else away[k]
        away = away.max(initial=0)
    demand(result, real)
    if not away <= slack:
        raise Wrong(f"generators are {away:.3g} beyond what layers leave to them")
    return "mesh"


# What follows on runs.


def some_domain(rng: np.random.Generator) -> clvoro.Box | clvoro.Polygon:
    kind = rng.integers(0, 5)
    if kind < 2:
        return some_box(rng, int(rng.choice([2, 2, 3])), wild=False)
    return some_polygon(rng) if kind == 2 else some_periodic_box(rng, int(rng.choice([2, 2, 3])), wild=False)


def try_resumed(rng: np.random.Generator) -> str:
    """A run that is interrupted and resumed ends with the same bits."""
    domain, real = some_domain(rng), some_real(rng)
    arguments = (domain, some_size(rng, domain, wild=False))
    options = some_options(rng, domain, real, wild=False)
    if not isinstance(domain, clvoro.Polygon) and domain.dim == 2 and rng.random() < 0.2 and not any(domain.periodic):
        options["layers"] = few_layers(rng, domain, wild=False)
        options.pop("n_cells", None)
    with tempfile.TemporaryDirectory() as folder:
        every = clvoro.Checkpoint(Path(folder) / "whole", every=0)
        whole = run_by(clvoro.Adapter(adapter(real).ctx, real), *arguments, checkpoint=every, **options)
        demand(whole, real)
        left = int(rng.integers(1, len(whole.history) + 1))
        state, rows = Path(folder) / "state", 0

        def stop(_: np.void) -> bool:
            nonlocal rows
            rows += 1
            return rows >= left

        adapter(real).run(*arguments, callback=stop, checkpoint=clvoro.Checkpoint(state, every=0), **options)
        if not state.exists():
            return "mesh"  # it had ended
        try:
            resumed = adapter(real).run(*arguments, checkpoint=clvoro.Checkpoint(resume=state), **options)
        except InputError as error:
            raise Wrong(f"not resumed after row {left}: {error}") from error
    for name in ("points", "size_error", "quality", "target_size"):
        if not np.array_equal(getattr(resumed, name), getattr(whole, name)):
            raise Wrong(f"a resumed run has other {name}, stopped after row {left}")
    return "mesh"


def try_moved(rng: np.random.Generator) -> str:
    """A mesh adapted to another field, and values carried over to it."""
    domain, real = some_domain(rng), some_real(rng)
    options = {"effort": "fast", "method": str(rng.choice(["adaptive", "exact"])), "seed": int(rng.integers(99))}
    first = run_by(adapter(real), domain, some_size(rng, domain, wild=False), **options)
    second = adapter(real).run(domain, some_size(rng, domain, wild=False), points=first.points, **options)
    demand(second, real)
    if domain.dim == 3 and any(domain.periodic):  # where transfer is not implemented
        return "mesh"
    values = rng.choice([1.0, 1e-200, 1e200]) * rng.standard_normal((len(first.points), 2)) + rng.choice([0, 1])
    got = first.transfer(values, onto=second, order=int(rng.choice([1, 2])))
    before, after = first.diagram.volumes @ values, second.diagram.volumes @ got
    # In single precision the sums of volumes differ, and bounds have priority over conservation.
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
    """Other work of an adapter, of any size, does not change a run that is resumed in it."""
    domain, real = some_domain(rng), some_real(rng)
    arguments = (domain, some_size(rng, domain, wild=False))
    options = some_options(rng, domain, real, wild=False) | {"effort": "fast"}
    kept = clvoro.Adapter(adapter(real).ctx, real)
    with tempfile.TemporaryDirectory() as folder:
        state, every = Path(folder) / "state", clvoro.Checkpoint(Path(folder) / "whole", every=0)
        whole = run_by(clvoro.Adapter(adapter(real).ctx, real), *arguments, checkpoint=every, **options)
        between(rng, kept, real)
        kept.run(*arguments, checkpoint=clvoro.Checkpoint(state, every=0), **options)
        if not state.exists():
            return "mesh"
        between(rng, kept, real)
        try:
            resumed = kept.run(*arguments, checkpoint=clvoro.Checkpoint(resume=state), **options)
        except InputError as error:
            raise Wrong(f"not resumed in the adapter that has done more: {error}") from error
        for name in ("points", "size_error", "target_size"):
            if not np.array_equal(getattr(resumed, name), getattr(whole, name)):
                raise Wrong(f"in an adapter that has done more a resumed run has other {name}")
        changed: dict[str, Any] = {
            "seed": options["seed"] + 1,
            "options": clvoro.PaperOptions(k=0.7, tol=0.3),
            "points": whole.points[:3],
            "n_cells": 7,
            "method": "lloyd",
            "max_steps": 1,
            "effort": "default",
        }
        name = str(rng.choice(list(changed)))
        with contextlib.suppress(InputError):  # the state is of another run
            other = kept.run(*arguments, **{**options, name: changed[name]}, checkpoint=clvoro.Checkpoint(resume=state))
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
