"""What a run takes on the device, known before it begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ._program import Engine
from .domain import Domain
from .errors import MemoryLimitError
from .margins import block_counts

MOST_CELLS = 100_000_000
"""Cells that 32-bit indices into the rows of neighbours allow for."""
PEAK = {2: (21, 73), 3: (151, 102)}
"""Reals and 32-bit integers per cell at the peak of a run by dimension, over all stages' buffers (bench/memory.py)."""
OUTPUT = {2: (30, 25), 3: (13, 950)}
"""The same while the finished diagram is read, corners, loops and all."""
FOLDED = {2: (40, 21), 3: (69, 30)}
"""What comes to the peak of a run in a periodic box, where graphs are folded: per cell, but not per image."""
IMAGE_REACH = {2: 1.55, 3: 1.75}
"""How deep margins of equal cells are, in their sizes."""
DEPTHS = 6
"""Places in the depth of a margin where the density of cells is looked at."""


def images_expected(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], n: float, integral: float
) -> float:
    """Return how many images of generators a periodic box of `n` cells takes, per generator.

    These are the cells beyond each block of the seams, as deep as balls around places of the seam go there (`seam.py`).
    A ball is as large as cells are at its middle, but goes no farther into smaller ones than cells of their size do.

    Parameters
    ----------
    size : callable
        h(points (k, d)) -> (k,), which sizes of cells are in proportion to.
    integral : float
        Of h^-d over the domain.
    """
    d, count = domain.dim, int(block_counts(domain.extent, n)[: domain.dim].max())
    factor, share = (integral / n) ** (1 / d), 1.0
    places = (np.arange(count) + 0.5) / count
    for axis in np.flatnonzero(domain.periodic):
        along = [a for a in range(d) if a != axis]
        unit = np.stack(np.meshgrid(*[places] * (d - 1), indexing="ij"), axis=-1).reshape(-1, d - 1)
        apart = np.zeros((len(unit), len(unit)))  # block from block
        for column, a in zip(unit.T, along, strict=True):
            away = np.abs(column[:, None] - column)
            if domain.periodic[a]:
                away = np.minimum(away, 1 - away)
            apart += (away * domain.extent[a]) ** 2
        apart = np.sqrt(apart)
        images = 0.0
        for end in (0.0, 1.0):
            places_at = np.insert(unit, axis, end, axis=1) * domain.extent + domain.lower
            h = factor * size(places_at)
            radius = (IMAGE_REACH[d] * h + apart).min(axis=1)
            deep = np.sqrt((radius**2 - apart**2).max(axis=1).clip(0))
            deep = np.minimum(deep, domain.extent[axis])
            # What lies beyond one end lies within the other one.
            places_at[:, axis] = (domain.upper if end == 0 else domain.lower)[axis]
            for part in (np.arange(DEPTHS) + 0.5) / DEPTHS:
                inside = places_at.copy()
                inside[:, axis] += part * deep * (-1 if end == 0 else 1)
                density = (factor * size(inside)) ** -d
                images += (
                    float((deep * density).mean()) * domain.measure / domain.extent[axis] / DEPTHS
                )
        share *= 1 + images / n
    return share - 1


def memory_needed(
    engine: Engine, n: float, domain: Domain | None = None, images: float | None = None
) -> float:
    """Return the bytes that a run of `n` cells, or reading its diagram, takes on the device at most.

    `images` per generator are what periodic boxes take (`images_expected`); None: as of cells that are all alike.
    """
    cells, folded = n, 0.0
    if domain is not None and any(domain.periodic):
        if images is None:
            deep = IMAGE_REACH[domain.dim] * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
            seams = [2 * min(deep / length, 1.0) for length in domain.extent[list(domain.periodic)]]
            images = float(np.prod(1 + np.array(seams))) - 1
        cells, folded = n * (1 + images), n

    def bytes_of(figures: tuple[int, int]) -> int:
        return figures[0] * engine.real.itemsize + figures[1] * 4

    d = engine.dim
    run = cells * bytes_of(PEAK[d]) + folded * bytes_of(FOLDED[d])
    return max(run, cells * bytes_of(OUTPUT[d]))


def check_memory(
    engine: Engine, n: float, domain: Domain | None = None, images: float | None = None
) -> None:
    """Refuse a mesh of `n` cells of `domain` that would not fit, before anything is allocated; see `memory_needed`.

    Raises
    ------
    MemoryLimitError
        Saying how many cells were asked for, how much memory they need and how much there is.
    """
    needed = memory_needed(engine, n, domain, images)
    available = engine.queue.device.global_mem_size
    if n > MOST_CELLS:
        raise MemoryLimitError(
            f"the run asks for {n:.3g} cells, expected at most {MOST_CELLS:.3g}, which the device's 32-bit "
            f"indices can tell apart (and they would need {needed / 2**30:.3g} GiB of "
            f"{available / 2**30:.3g} GiB). Are h and the domain in the same unit of length? Otherwise use a larger "
            "size or n_cells"
        )
    if needed > available:
        raise MemoryLimitError(
            f"the size field asks for {n:.3g} cells, which need {needed / 2**30:.3g} GiB on the device; "
            f"{engine.queue.device.name.strip()} has {available / 2**30:.3g} GiB. Are h and the domain in the same "
            "unit of length? Otherwise use a larger size, n_cells, dtype='float32' or another device"
        )
