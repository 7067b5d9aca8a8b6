"""What a run takes on the device, known before it begins."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from ..errors import MemoryLimitError
from ..geometry.box import Domain
from ..geometry.polygon import Polygon
from ..opencl.engine import Engine
from ..opencl.host_memory import host_memory
from ..opencl.primitives import scan_width
from ..solvers.poisson import max_jacobi_iterations
from ..tessellation.periodic.halo import block_count
from .forecast import IMAGE_REACH, shore_expected

MOST_CELLS = 100_000_000
"""Cells that 32-bit indices into the rows of neighbors allow for."""
PEAK = {2: (21, 73), 3: (151, 102)}
"""Reals and 32-bit integers per cell at the peak of a run by dimension, over all stages' buffers (bench/memory.py)."""
TRIMMED_PEAK = (62, 75)
"""The same where a polygon's boundary trims the cells, and faces are in full precision."""
SHORE_PEAK, EDGE_PEAK = (100, 187), (22, 20)
"""What comes to that for each cell at the boundary, with the sentinels beyond it, and for each of its edges."""
OUTPUT = {2: {8: 340, 4: 220}, 3: {8: 3600, 4: 4000}}
"""Bytes per cell while the finished diagram is read, corners, loops and all, by dimension and size of a real.

In 3D single precision takes more: views of faces have to be brought together where double precision agrees at once."""
TRIMMED_OUTPUT, SHORE_OUTPUT, EDGE_OUTPUT = {8: 535, 4: 330}, {8: 1200, 4: 780}, {8: 65, 4: 38}
"""The same of polygons: per cell, and what comes to it as above."""
DIAGRAM = {2: {8: 700, 4: 440}, 3: {8: 4700, 4: 4600}}
"""The same of one diagram, until it is made and read: of random generators, of which stages keep what they have."""
TRIMMED_DIAGRAM, SHORE_DIAGRAM, EDGE_DIAGRAM = {8: 1110, 4: 735}, {8: 750, 4: 530}, {8: 260, 4: 170}
"""The same of polygons, likewise; there are no sentinels."""
FOLDED = {2: (9, 57), 3: (40, 25)}
"""What comes to the peak of a run in a periodic box, where graphs are folded: per cell, but not per image."""
FOLDED_DIAGRAM = {2: {8: 360, 4: 340}, 3: {8: 2000, 4: 1900}}
"""What comes to one diagram, likewise, in bytes by dimension and size of a real."""
PARTIAL_SUMS, SCANS, ARRAYS = 80, 8, 64
"""What there is whatever the number of cells: reals to each work-group of sums, scans, and arrays in the workspace, of
each of which up to a unit is left."""
FEW = 6000
"""Cells from which on linear solves are by multigrid, whose iterations are few: there is room to record each one."""


def fixed_bytes(engine: Engine, n: float) -> float:
    """Return the bytes of a run that do not grow with its number of cells, `n`, or hardly."""
    real = engine.real.itemsize
    records = 8 * real * max_jacobi_iterations(int(min(n, FEW)))
    return records + PARTIAL_SUMS * engine.groups * real + spare_bytes(engine)


def spare_bytes(engine: Engine) -> float:
    """Return the part of these bytes that one diagram takes, too."""
    unit = max(64, engine.queue.device.mem_base_addr_align // 8)
    periodic = engine.domain_kind.periodic
    margins = 3 * 4 * block_count(engine.dim) if periodic else 0
    return ARRAYS * unit + SCANS * 4 * scan_width(engine) + margins


def memory_needed(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    images: float | None = None,
    surplus: float = 0.0,
    held: float = 0.0,
    shore: float | None = None,
    *,
    run: bool = True,
) -> float:
    """Return the bytes that a run of `n` cells, or reading its diagram, takes on the device at most.

    Without `run`, those that `Adapter.diagram` takes.

    `images` per generator are what periodic boxes take (`images_expected`), `shore` are the cells at the boundary of a
    polygon (`shore_expected`); None: as of cells that are all alike. `surplus` are generators per one that is asked for
    (`surplus_expected`), `held` bytes that are there in any case.
    """
    n *= 1 + surplus
    cells, folded, edges = n, 0.0, 0
    if domain is not None and any(domain.periodic):
        if images is None:
            deep = IMAGE_REACH[domain.dim] * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
            seams = [2 * min(deep / length, 1.0) for length in domain.extent[list(domain.periodic)]]
            images = float(np.prod(1 + np.array(seams))) - 1
        cells, folded = n * (1 + images), n
    trimmed = isinstance(domain, Polygon)
    if isinstance(domain, Polygon):
        edges = len(domain.oriented.vertices)
        if shore is None:
            spacing = (domain.measure / max(n, 1.0)) ** 0.5
            shore = shore_expected(domain, lambda p: np.full(len(p), spacing))
        shore = min(shore, n)

    d, real = engine.dim, engine.real.itemsize
    at = n, shore or 0.0, edges

    def bytes_of(figures: tuple[int, int]) -> int:
        return figures[0] * real + figures[1] * 4

    def together(*figures: float) -> float:
        return sum(f * count for f, count in zip(figures, at, strict=True))

    if not run:
        per_cell = (TRIMMED_DIAGRAM, SHORE_DIAGRAM, EDGE_DIAGRAM)
        made = together(*(f[real] for f in per_cell)) if trimmed else cells * DIAGRAM[d][real]
        return made + folded * FOLDED_DIAGRAM[d][real] + held + spare_bytes(engine)
    if trimmed:
        peak = together(*(bytes_of(f) for f in (TRIMMED_PEAK, SHORE_PEAK, EDGE_PEAK)))
        output = together(*(f[real] for f in (TRIMMED_OUTPUT, SHORE_OUTPUT, EDGE_OUTPUT)))
    else:
        peak = cells * bytes_of(PEAK[d]) + folded * bytes_of(FOLDED[d])
        output = cells * OUTPUT[d][real]
    return max(peak + fixed_bytes(engine, n), output) + held


def in_bytes(amount: float) -> str:
    """Return a number of bytes as people read it: 258 KiB, 1.47 GiB."""
    power = 0 if amount < 2**10 else 1 if amount < 2**20 else 2 if amount < 2**30 else 3
    return f"{amount / 2 ** (10 * power):.3g} {('bytes', 'KiB', 'MiB', 'GiB')[power]}"


def available_memory(device: cl.Device) -> float:
    """Return the bytes that `device` has; of a CPU, no more than this process may take."""
    own = device.global_mem_size
    return min(own, host_memory()) if device.type & cl.device_type.CPU else own


def check_memory(engine: Engine, n: float, needed: float) -> float:
    """Return `needed`, the bytes that a mesh of `n` cells takes (`memory_needed`), if there are as many.

    Nothing has been allocated yet.

    Raises
    ------
    MemoryLimitError
        Saying how many cells were asked for, how much memory they need and how much there is.
    """
    available = available_memory(engine.queue.device)
    if n > MOST_CELLS:
        raise MemoryLimitError(
            f"the run asks for {n:.3g} cells, expected at most {MOST_CELLS:.3g}, which the device's 32-bit "
            f"indices can tell apart (and they would need {in_bytes(needed)} of "
            f"{in_bytes(available)}). Are h and the domain in the same unit of length? Otherwise use a larger "
            "size or n_cells"
        )
    if needed > available:
        raise MemoryLimitError(
            f"the size field asks for {n:.3g} cells, which need {in_bytes(needed)} on the device; "
            f"{engine.queue.device.name.strip()} has {in_bytes(available)}. Are h and the domain in the same "
            "unit of length? Otherwise use a larger size, n_cells, dtype='float32' or another device"
        )
    return needed
