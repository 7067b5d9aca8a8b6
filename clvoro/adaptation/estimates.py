"""Estimates of the device memory that a run needs, to a quarter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import pyopencl as cl

from ..errors import DeviceError, MemoryLimitError
from ..geometry.domain import Domain
from ..opencl import memory_limits
from ..opencl.devices import create_context
from ..opencl.engine import Engine
from ..opencl.memory_limits import available_memory, host_memory, in_bytes
from ..opencl.workspace import KEPT
from ..tessellation.cut_cells import clipping_space
from ..tessellation.decomposition import UNBALANCED
from .sampling.quadrature import DensityTree

MAX_CELLS = 100_000_000
"""Limit of the 32-bit indices into rows of neighbors."""
MAX_LABELS = 2_000_000_000
"""Limit of the permanent numbers of generators, which are unique among all parts."""
GHOST_LAYERS = {2: 4.5, 3: 0.8}
"""Depth of the layer of ghosts around a part that take as much memory as cells, divided by the size of cells. In 3D
ghosts have cells only while the mesh is read, and only those beside cells of the part."""
SIZES = {
    "plane": {"run": (26, 86), "diagram": (65, 45), "power run": (74, 119), "power diagram": (75, 92)},
    "cut": {"run": (68, 79), "diagram": (94, 90), "power run": (171, 134), "power diagram": (125, 130)},
    "curved": {"run": (33, 90), "diagram": (70, 82), "power run": (88, 138), "power diagram": (70, 82)},
    "space": {"run": (108, 378), "diagram": (230, 515), "power run": (170, 355), "power diagram": (235, 515)},
}
"""Reals and 32-bit integers per cell at the peak of a run, or of one diagram of random generators, and while all arrays
are read. By the kind of cells: in boxes in 2D, cut by a boundary, on a sphere, in 3D (bench/memory.py)."""
FOLDED = {"plane": dict.fromkeys(SIZES["plane"], 0.5), "space": {"diagram": 0.5, "power diagram": 0.5}}
"""What is added per cell (not per image) in periodic boxes, as a share of `SIZES`."""
CELLS_PER_BOUNDARY_CELL, CELLS_PER_EDGE = 1.5, 0.3
"""As many cells take as much as a cell at a boundary that cuts cells takes in addition, and as an edge of it."""
CELLS_PER_WALL_CELL = 2.5
"""As many cells take as much as a cell at the surface of a solid takes in addition: above all the generator outside of
it when the mesh is read."""
BYTES_PER_PRISM = 4000
"""Memory of the host for each prism in layers of a solid, at the peak of making the mesh."""
LARGEST = 0.2
"""Share of the largest array."""
FIXED = 2**16 + KEPT
"""Bytes for any number of cells: the record of a solver's iterations, sums and scans, small arrays, and memory that is
kept for later steps."""
IMAGE_REACH = {2: 1.55, 3: 1.75}
"""Depth of the halo of equal cells over their size."""
STEEP_FROM, STEEP_TO = 1.4, 2.4
"""Ratios of sizes around a cell between which its steepness increases from 0 to 1."""
MOST_SURPLUS, SURPLUS_RATE = 0.4, 8.0
"""Largest number of cells over the integral of h^-d, as a share of it, and the rate at which it is approached with the
mean steepness."""
GOLDEN_STEPS = {
    2: (0.7548776662466927, 0.5698402909980532),
    3: (0.8191725133961645, 0.6710436067037893, 0.5497004779019703),
}
"""Steps of a sequence without clusters: powers of 1 / r, r^(d + 1) = r + 1. `scipy.stats` takes 1 s to import."""
SAMPLE = 4096
"""Sample of cells, and of the boundary."""


@dataclass(frozen=True)
class Extras:
    """What a run of n cells needs besides its cells."""

    images: float | None = None
    """float, optional. Ghost images per generator in periodic boxes (`expected_images`); by default those of equal
    cells."""
    surplus: float = 0.0
    """Temporary additional cells, per cell (`expected_surplus`)."""
    field_bytes: float = 0.0
    """Memory of the size field."""
    boundary: float | None = None
    """float, optional. Cells at a boundary that cuts cells; by default those of equal cells."""


def estimate_memory(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    extras: Extras | None = None,
    *,
    run: bool = True,
    power: bool = False,
    exact: bool = False,
) -> float:
    """Return the largest device memory of a run of `n` cells, or of reading its diagram, in bytes.

    Without `run`, return that of `Adapter.diagram`. With `power`, the run ends with a power diagram, or the diagram is
    one. With `exact` and curved walls, a run also makes diagrams between its steps.
    """
    extras = Extras() if extras is None else extras
    traits = engine.traits
    kind = "curved" if traits.curved else "cut" if traits.cut else {2: "plane", 3: "space"}[engine.cell_dim]
    space = clipping_space(n) if kind == "space" else 0.0
    work = ("power " if power else "") + ("run" if run else "diagram")
    n *= 1 + extras.surplus
    cells = n
    if domain is not None and any(domain.periodic):
        images = extras.images
        if images is None:
            depth = IMAGE_REACH[domain.dim] * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
            images = np.prod(1 + 2 * np.minimum(depth / domain.extent[list(domain.periodic)], 1.0)) - 1
        cells += n * (images + FOLDED.get(kind, {}).get(work, 0.0))
    if domain is not None and domain.cutting_edges:
        boundary = extras.boundary
        if boundary is None:
            spacing = (domain.measure / max(n, 1.0)) ** 0.5
            boundary = domain.boundary_measure / spacing
        cells += CELLS_PER_BOUNDARY_CELL * min(boundary, n) + CELLS_PER_EDGE * domain.cutting_edges
    if domain is not None and domain.wall_triangles is not None:
        walls = domain.boundary_measure / (domain.measure / max(n, 1.0)) ** (2 / 3)
        cells += CELLS_PER_WALL_CELL * min(walls, n)
        space += domain.wall_triangles.device_bytes(engine.real)
    works = [work, "diagram"] if exact and kind == "curved" else [work]
    reals, integers = (sum(SIZES[kind][w][k] for w in works) for k in (0, 1))
    return float(cells) * (reals * engine.real.itemsize + integers * 4) + space + FIXED + extras.field_bytes


def cells_of_part(n: float, dim: int, parts: int) -> float:
    """Return how many cells and ghosts the largest of several `parts` of a mesh of `n` cells has.

    The part is taken as a cube of cells, and its ghosts as a shell around it of depth `GHOST_LAYERS`.
    """
    own = UNBALANCED * n / parts
    return float(min((own ** (1 / dim) + 2 * GHOST_LAYERS[dim]) ** dim, n))


def check_memory(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    extras: Extras | None = None,
    *,
    run: bool = True,
    power: bool = False,
    exact: bool = False,
) -> float:
    """Check that the device has memory for `n` cells, and return the bytes needed (see `estimate_memory`).

    If parts share the run, these are the bytes of the largest part with its ghosts.

    Raises `MemoryLimitError` if `n`, all arrays or the largest array are too large. The message has the number of
    cells, and the bytes needed and available.
    """
    device = engine.queue.device
    name, available = device.name.strip(), available_memory(device)
    own = n if engine.peers.count == 1 else cells_of_part(n, engine.cell_dim, engine.peers.count)
    needed = estimate_memory(engine, own, domain, extras, run=run, power=power, exact=exact)
    hint = domain.unit_hint if domain else ""
    unit = f"Do h and the domain have the same unit of length?{hint} If so, use "
    if own > MAX_CELLS or n > MAX_LABELS:
        raise MemoryLimitError(
            f"the run has {n:.3g} cells, expected at most {MAX_CELLS:.3g}, the limit of 32-bit indices (they need "
            f"{in_bytes(needed)}, and the device has {in_bytes(available)}). {unit}a larger size or a smaller n_cells"
        )
    largest, most = LARGEST * (needed - FIXED), memory_limits.largest_allocation(device)
    remedy = f"{unit}a larger size, n_cells, dtype='float32' or another device"
    remedy += " for each part of the mesh, or more ranks or devices" * engine.peers.shared
    if needed > available:
        raise MemoryLimitError(
            f"the size field requires {n:.3g} cells, which need {in_bytes(needed)} on the device; {name} has "
            f"{in_bytes(available)}. {remedy}"
        )
    if largest > most:
        raise MemoryLimitError(
            f"the size field requires {n:.3g} cells, whose largest array needs {in_bytes(largest)}; {name} allocates "
            f"at most {in_bytes(most)} for one array. {remedy}"
        )
    return needed


def holder_of_all(engine: Engine, n: float, domain: Domain) -> Engine:
    """Return an engine whose device holds the mesh of all parts, of `n` cells: the device of `engine`, else a CPU.

    Raises `MemoryLimitError` if neither does.
    """
    alone = engine.alone()
    try:
        check_memory(alone, n, domain, run=False)
    except MemoryLimitError as error:
        try:
            ctx = create_context("cpu", fp64=engine.real == np.float64)
        except DeviceError:
            raise error from None
        alone = Engine(ctx, cl.CommandQueue(ctx), engine.dim, engine.real, engine.traits)
        check_memory(alone, n, domain, run=False)
    return alone


def check_prisms(count: float) -> None:
    """Check that the host has memory for `count` prisms in layers of a solid; the device has none of them.

    Raises `MemoryLimitError`.
    """
    needed, available = BYTES_PER_PRISM * count, host_memory()
    if needed > available:
        raise MemoryLimitError(
            f"layers have about {count:.3g} prisms, which need {in_bytes(needed)}; this process has "
            f"{in_bytes(available)}. Use fewer layers, on fewer patches, or larger sizes at these walls"
        )


# What follows from the size field.


def sample_cells(domain: Domain, tree: DensityTree) -> np.ndarray:
    """Return about `SAMPLE` points of `domain` with the density of the cells."""
    reached, boxes = np.cumsum(tree.cells), tree.boxes
    marks = (np.arange(SAMPLE) + 0.5) / SAMPLE * reached[-1]
    box = np.minimum(np.searchsorted(reached, marks, side="right"), len(reached) - 1)
    inside = np.arange(SAMPLE)[:, None] * GOLDEN_STEPS[domain.dim] % 1
    places = boxes.origin + boxes.root * boxes.corner[box] + inside * boxes.edges()[box]
    return places[domain.contains(places)]


def expected_images(domain: Domain, size: Callable[[np.ndarray], np.ndarray], n: float, tree: DensityTree) -> float:
    """Return the expected ghost images per generator in a periodic box of `n` cells.

    They are counted in a sample: points beyond a periodic boundary that are not farther from it than the cells there
    reach.

    - `size`: h(points (k, d)) -> (k,), up to a constant factor.
    - `tree`: of `size`.
    """
    reach = IMAGE_REACH[domain.dim] * (tree.integral / n) ** (1 / domain.dim)
    x, images = sample_cells(domain, tree), 0.0
    for code in product((-1, 0, 1), repeat=domain.dim):
        if any(code) and all(periodic or not c for c, periodic in zip(code, domain.periodic, strict=True)):
            image = x + code * domain.extent
            foot = np.clip(image, domain.lower, domain.upper)
            away = np.linalg.norm((image - foot) / domain.extent.max(), axis=1)
            images += np.mean(away <= reach * np.asarray(size(foot)) / domain.extent.max())
    return float(images)


def expected_surplus(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], tree: DensityTree, reach: float
) -> float:
    """Return the temporary cells of a run beyond the integral of h^-d, as a share of it.

    Sizes are evaluated at the generators. At jumps of h fine cells cover parts of the coarse side and count as too
    large, until new cells have been inserted.

    - `size`: h(points (k, d)) -> (k,).
    - `tree`: of `size`, or of a multiple of it.
    - `reach`: distance over h at which sizes are compared.
    """
    places = sample_cells(domain, tree)
    if not len(places):
        return 0.0
    d, h = domain.dim, np.asarray(size(places))
    ways = np.concatenate([np.eye(d), -np.eye(d)])
    beside = domain.wrap((places[:, None] + reach * h[:, None, None] * ways).reshape(-1, d))
    known, sizes = domain.contains(beside), np.repeat(h, 2 * d)
    if known.any():
        sizes[known] = size(beside[known])
    ratios = sizes.reshape(-1, 2 * d).max(axis=1) / h
    steep = (ratios.clip(STEEP_FROM, STEEP_TO) - STEEP_FROM).mean()
    return float(MOST_SURPLUS * (1 - np.exp(-SURPLUS_RATE * steep)))
