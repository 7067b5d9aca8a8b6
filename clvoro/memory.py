"""What a run takes on the device, known before it begins."""

from __future__ import annotations

import numpy as np

from ._program import Engine
from .domain import Domain
from .errors import MemoryLimitError

MOST_CELLS = 100_000_000
"""Cells that 32-bit indices into the rows of neighbours allow for."""
PEAK = {2: (21, 73), 3: (151, 102)}
"""Reals and 32-bit integers per cell at the peak of a run by dimension, over all stages' buffers (bench/memory.py)."""
OUTPUT = {2: (30, 25), 3: (13, 950)}
"""The same while the finished diagram is read, corners, loops and all."""
FOLDED = {2: (40, 21), 3: (69, 30)}
"""What comes to the peak of a run in a periodic box, where graphs are folded: per cell, but not per image."""
IMAGE_MARGIN = 1.9
"""Mean spacings from the seams within which such boxes take images of generators, which count as cells (seam.py)."""


def memory_needed(engine: Engine, n: float, domain: Domain | None = None) -> float:
    """Return the bytes that a run of `n` cells, or reading its diagram, takes on the device at most."""
    cells, folded = n, 0.0
    if domain is not None and any(domain.periodic):
        margin = IMAGE_MARGIN * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
        edges = domain.extent[list(domain.periodic)]
        # Images are taken from one period away at most.
        cells, folded = n * float(np.prod(1 + 2 * np.minimum(margin / edges, 1))), n

    def bytes_of(figures: tuple[int, int]) -> int:
        return figures[0] * engine.real.itemsize + figures[1] * 4

    d = engine.dim
    run = cells * bytes_of(PEAK[d]) + folded * bytes_of(FOLDED[d])
    return max(run, cells * bytes_of(OUTPUT[d]))


def check_memory(engine: Engine, n: float, domain: Domain | None = None) -> None:
    """Refuse a mesh of `n` cells of `domain` that would not fit, before anything is allocated.

    Raises
    ------
    MemoryLimitError
        Saying how many cells were asked for, how much memory they need and how much there is.
    """
    needed = memory_needed(engine, n, domain)
    available = engine.queue.device.global_mem_size
    if n > MOST_CELLS:
        raise MemoryLimitError(
            f"the run asks for {n:.3g} cells, expected at most {MOST_CELLS:.3g}, which the device's 32-bit "
            f"indices can tell apart (and they would need {needed / 2**30:.3g} GiB of "
            f"{available / 2**30:.3g} GiB). Use a larger size or n_cells"
        )
    if needed > available:
        raise MemoryLimitError(
            f"the size field asks for {n:.3g} cells, which need {needed / 2**30:.3g} GiB on the device; "
            f"{engine.queue.device.name.strip()} has {available / 2**30:.3g} GiB. Use a larger size, "
            "n_cells, dtype='float32' or another device"
        )
