"""Estimates of the device memory that a run needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import MemoryLimitError
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..opencl import memory_limits
from ..opencl.engine import Engine
from ..opencl.memory_limits import available_memory, in_bytes
from ..solvers.poisson import max_jacobi_iterations
from ..tessellation.cut_cells import clipping_space
from ..tessellation.periodic.halo import block_count
from .forecast import IMAGE_REACH, expected_boundary_cells

MAX_CELLS = 100_000_000
"""Limit of the 32-bit indices into rows of neighbors."""
SPHERE = "sphere"
PEAK: dict[int | str, tuple[int, int]] = {2: (26, 86), 3: (140, 280), SPHERE: (33, 90)}
"""Reals and 32-bit integers per cell at the peak of a run by dimension, and on a sphere (bench/memory.py)."""
TRIMMED_PEAK = (68, 79)
"""The same in polygons, where the boundary trims cells and faces are in full precision."""
BOUNDARY_PEAK, EDGE_PEAK = (100, 187), (22, 20)
"""The same in addition per cell at the boundary, with its ghost generators, and per edge of the boundary."""
OUTPUT: dict[int | str, dict[int, int]] = {2: {8: 340, 4: 220}, 3: {8: 3600, 4: 2850}, SPHERE: {8: 450, 4: 275}}
"""Bytes per cell while the final diagram is read, with vertices, by dimension and size of a real."""
TRIMMED_OUTPUT, BOUNDARY_OUTPUT, EDGE_OUTPUT = {8: 535, 4: 330}, {8: 1200, 4: 780}, {8: 65, 4: 38}
"""The same in polygons: per cell, and in addition per cell at the boundary and per edge."""
DIAGRAM: dict[int | str, dict[int, int]] = {2: {8: 700, 4: 440}, 3: {8: 4700, 4: 3400}, SPHERE: {8: 890, 4: 610}}
"""Bytes per cell of one diagram of random generators, until it is computed and read."""
TRIMMED_DIAGRAM, BOUNDARY_DIAGRAM, EDGE_DIAGRAM = ({8: 1110, 4: 735}, {8: 750, 4: 530}, {8: 260, 4: 170})
"""The same in polygons, without ghost generators."""
FOLDED = {2: (9, 57), 3: (0, 0)}
"""Reals and integers per cell (not per image) in addition in periodic boxes."""
FOLDED_DIAGRAM = {2: {8: 360, 4: 340}, 3: {8: 2000, 4: 1900}}
"""Bytes per cell in addition for one diagram in periodic boxes."""
POWER_PEAK: dict[int | str, tuple[int, int]] = {2: (74, 119), 3: (255, 264)}
"""Reals and integers per cell while the method "transport" holds a Voronoi diagram and a power diagram."""
TRIMMED_POWER_PEAK = 171, 134
"""The same in polygons."""
FOLDED_POWER = {2: (38, 39), 3: (0, 0)}
"""The same in periodic boxes: what is added per cell (not per image)."""
POWER_DIAGRAM = {2: {8: 970, 4: 670}, 3: {8: 4700, 4: 3500}}
"""Bytes per cell for one power diagram of random generators, with given weights or with prescribed volumes."""
TRIMMED_POWER_DIAGRAM = {8: 1520, 4: 1020}
"""The same in polygons."""
FOLDED_POWER_DIAGRAM = {2: {8: 600, 4: 520}, 3: {8: 6700, 4: 5400}}
"""The same in periodic boxes: what is added per cell. Large weights need more ghost images."""
LARGEST: dict[int | str, dict[int, int]] = {2: {8: 105, 4: 90}, 3: {8: 610, 4: 310}, SPHERE: {8: 150, 4: 90}}
"""Bytes per cell or image of the largest array, of a run or of one diagram."""
TRIMMED_LARGEST = {8: 130, 4: 90}
"""The same in polygons."""
PARTIAL_SUMS, SCANS, ARRAYS = 64, 8, 64
"""Independent of the number of cells: per work-group, reals for sums and integers for scans; and small arrays, each
counted as one unit of alignment."""
FEW = 6000
"""Cells from which on linear solves use multigrid, so that the record of iterations stays short."""


@dataclass(frozen=True)
class Extras:
    """What a run of n cells needs besides its cells.

    Attributes
    ----------
    images : float, optional
        Ghost images per generator in periodic boxes (`expected_images`); by default those of equal cells.
    surplus : float
        Temporary additional cells, per cell (`expected_surplus`).
    field_bytes : float
        Memory of the size field.
    boundary : float, optional
        Cells at the boundary of a polygon (`expected_boundary_cells`); by default those of equal cells.
    """

    images: float | None = None
    surplus: float = 0.0
    field_bytes: float = 0.0
    boundary: float | None = None


def _kind_of(engine: Engine) -> int | str:
    """Return the key of the figures for `engine`."""
    return SPHERE if engine.traits.curved else engine.dim


def fixed_bytes(engine: Engine, n: float) -> float:
    """Return the bytes of a run that are almost independent of its number of cells `n`."""
    real = engine.real.itemsize
    records = 8 * real * max_jacobi_iterations(int(min(n, FEW)))
    return records + PARTIAL_SUMS * engine.groups * real + workspace_bytes(engine, n)


def workspace_bytes(engine: Engine, n: float) -> float:
    """Return the part of these bytes that one diagram needs, too."""
    unit = max(64, engine.queue.device.mem_base_addr_align // 8)
    halo = 3 * 4 * block_count(engine.dim) if engine.traits.periods else 0
    space = clipping_space(n) if engine.cell_dim == 3 else 0
    return ARRAYS * unit + SCANS * 4 * engine.groups + halo + space


def estimate_memory(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    extras: Extras | None = None,
    *,
    run: bool = True,
    power: bool = False,
) -> float:
    """Return the largest device memory of a run of `n` cells, or of reading its diagram, in bytes.

    Without `run`, return that of `Adapter.diagram`. With `power`, the run ends with a power diagram, or the diagram is
    one.
    """
    extras = Extras() if extras is None else extras
    n *= 1 + extras.surplus
    cells, folded, boundary, edges = n, 0.0, 0.0, 0
    if domain is not None and any(domain.periodic):
        images = _images_of_equal_cells(domain, n) if extras.images is None else extras.images
        cells, folded = n * (1 + images), n
    trimmed = isinstance(domain, Polygon)
    if isinstance(domain, Polygon):
        edges, boundary = len(domain.oriented.vertices), extras.boundary
        if boundary is None:
            spacing = (domain.measure / max(n, 1.0)) ** 0.5
            boundary = expected_boundary_cells(domain, lambda p: np.full(len(p), spacing))
        boundary = min(boundary, n)

    kind, real = _kind_of(engine), engine.real.itemsize

    def bytes_of(figures: tuple[int, int]) -> int:
        return figures[0] * real + figures[1] * 4

    def in_polygon(per_cell: float, per_boundary_cell: float, per_edge: float) -> float:
        return per_cell * n + per_boundary_cell * boundary + per_edge * edges

    if not run:
        per_cell = (TRIMMED_DIAGRAM, BOUNDARY_DIAGRAM, EDGE_DIAGRAM)
        made = in_polygon(*(f[real] for f in per_cell)) if trimmed else cells * DIAGRAM[kind][real]
        made += folded * FOLDED_DIAGRAM[engine.dim][real]
        if power:
            by_power = TRIMMED_POWER_DIAGRAM if trimmed else POWER_DIAGRAM[engine.dim]
            more = folded * FOLDED_POWER_DIAGRAM[engine.dim][real]
            made = max(made, cells * by_power[real] + more)
        return made + extras.field_bytes + workspace_bytes(engine, n)
    if trimmed:
        peak = in_polygon(*map(bytes_of, (TRIMMED_PEAK, BOUNDARY_PEAK, EDGE_PEAK)))
        output = in_polygon(*(f[real] for f in (TRIMMED_OUTPUT, BOUNDARY_OUTPUT, EDGE_OUTPUT)))
    else:
        peak = cells * bytes_of(PEAK[kind]) + folded * bytes_of(FOLDED[engine.dim])
        output = cells * OUTPUT[kind][real]
    if power:
        of_cells = bytes_of(TRIMMED_POWER_PEAK if trimmed else POWER_PEAK[engine.dim])
        peak = max(peak, cells * of_cells + folded * bytes_of(FOLDED_POWER[engine.dim]))
    return max(peak + fixed_bytes(engine, n), output) + extras.field_bytes


def largest_array(engine: Engine, n: float, domain: Domain | None = None, extras: Extras | None = None) -> float:
    """Return the size of the largest array of a run of `n` cells, or of one diagram, in bytes."""
    extras = Extras() if extras is None else extras
    n, real = n * (1 + extras.surplus), engine.real.itemsize
    if isinstance(domain, Polygon):
        return n * TRIMMED_LARGEST[real]
    if domain is not None and any(domain.periodic):
        images = _images_of_equal_cells(domain, n) if extras.images is None else extras.images
        n *= 1 + images
    return n * LARGEST[_kind_of(engine)][real]


def _images_of_equal_cells(domain: Domain, n: float) -> float:
    """Return the ghost images per generator of `n` equal cells in a periodic box."""
    depth = IMAGE_REACH[domain.dim] * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
    shares = [2 * min(depth / length, 1.0) for length in domain.extent[list(domain.periodic)]]
    return float(np.prod(1 + np.array(shares))) - 1


def check_memory(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    extras: Extras | None = None,
    *,
    run: bool = True,
    power: bool = False,
) -> float:
    """Check that the device has memory for `n` cells, and return the bytes needed (see `estimate_memory`).

    Raises
    ------
    MemoryLimitError
        If `n`, all arrays or the largest array are too large. The message has the number of cells, and the bytes needed
        and available.
    """
    device = engine.queue.device
    name, available = device.name.strip(), available_memory(device)
    needed = estimate_memory(engine, n, domain, extras, run=run, power=power)
    if n > MAX_CELLS:
        raise MemoryLimitError(
            f"the run has {n:.3g} cells, expected at most {MAX_CELLS:.3g}, the limit of 32-bit indices (they need "
            f"{in_bytes(needed)}, and the device has {in_bytes(available)}). Do h and the domain have the same unit "
            "of length? If so, use a larger size or a smaller n_cells"
        )
    largest, most = (largest_array(engine, n, domain, extras), memory_limits.largest_allocation(device))
    remedy = (
        "Do h and the domain have the same unit of length? If so, use a larger size, n_cells, dtype='float32' or "
        "another device"
    )
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
