"""What a run takes on the device, known before it begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ._program import Engine
from .domain import Domain
from .errors import MemoryLimitError
from .margins import block_counts
from .polygon import Polygon
from .quadrature import DensityTree

MOST_CELLS = 100_000_000
"""Cells that 32-bit indices into the rows of neighbours allow for."""
PEAK = {2: (21, 73), 3: (151, 102)}
"""Reals and 32-bit integers per cell at the peak of a run by dimension, over all stages' buffers (bench/memory.py)."""
TRIMMED_PEAK = (69, 84)
"""The same where a polygon's boundary trims the cells, and faces are in full precision."""
OUTPUT = {2: {8: 340, 4: 220}, 3: {8: 3600, 4: 4000}}
"""Bytes per cell while the finished diagram is read, corners, loops and all, by dimension and size of a real.

In 3D single precision takes more: views of faces have to be brought together where double precision agrees at once."""
TRIMMED_OUTPUT = {8: 600, 4: 370}
"""The same of polygons."""
DIAGRAM = {2: {8: 700, 4: 440}, 3: {8: 4400, 4: 4600}}
"""The same of one diagram, until it is made and read: of random generators, of which stages keep what they have."""
TRIMMED_DIAGRAM = {8: 1160, 4: 770}
"""The same of polygons."""
FOLDED = {2: (40, 21), 3: (69, 30)}
"""What comes to the peak of a run in a periodic box, where graphs are folded: per cell, but not per image."""
FOLDED_DIAGRAM = {2: {8: 360, 4: 340}, 3: {8: 2000, 4: 1900}}
"""What comes to one diagram, likewise, in bytes by dimension and size of a real."""
IMAGE_REACH = {2: 1.55, 3: 1.75}
"""How deep margins of equal cells are, in their sizes."""
DEPTHS = 6
"""Places in the depth of a margin where the density of cells is looked at."""
STEEP_FROM, STEEP_TO = 1.4, 2.4
"""Ratios of sizes, within reach of a cell, from which on it is near something steep, and up to which more so."""
MOST_SURPLUS, SURPLUS_RATE = 0.7, 2.0
"""Generators, over those that a size field asks for, that a run takes at most where cells are near something steep, and
by how much more quickly than the mean of that it comes to as many. Measured on jumps of 1 : 5 to 1 : 20, kinks, stripes
and chequers, 4000 to 30,000 cells: 0.02 to 0.6, nowhere more than 0.05 over what is told here."""
SAMPLE = 1024
"""Places where that is looked at."""
_STEPS = {2: (0.7548776662, 0.5698402910), 3: (0.8191725134, 0.6710436067, 0.5497004779)}
"""Whose multiples, less whole numbers, fill the unit square, or cube, evenly: powers of the inverse of the root of
x^(d + 1) = x + 1."""


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
        away2 = []  # squares of how far blocks are apart: along one axis, then along both
        for a in along:
            away = np.abs(places[:, None] - places)
            if domain.periodic[a]:
                away = np.minimum(away, 1 - away)
            away2.append(((away * domain.extent[a]) ** 2).astype(np.float32))
        apart2 = away2[0] if d == 2 else away2[0][:, None, :, None] + away2[1][:, None, :]
        apart2 = apart2.reshape(len(unit), len(unit))
        apart = np.sqrt(apart2)
        images = 0.0
        for end in (0.0, 1.0):
            places_at = np.insert(unit, axis, end, axis=1) * domain.extent + domain.lower
            h = factor * size(places_at)
            radius = ((IMAGE_REACH[d] * h).astype(np.float32) + apart).min(axis=1)
            deep = np.sqrt((radius**2 - apart2).max(axis=1).clip(0))
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


def surplus_expected(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], tree: DensityTree, reach: float
) -> float:
    """Return how many generators more than the integral of h^-d a run takes at times, per generator.

    Sizes count where generators are. Where they change several-fold from one cell to the next, cells on the finer side
    own parts of the coarser one, and are taken for too large until others have come beside them.

    Parameters
    ----------
    size : callable
        h(points (k, d)) -> (k,).
    tree : DensityTree
        Of it, or of what is in proportion.
    reach : float
        How far cells are looked around, in their sizes.
    """
    d, reached, boxes = domain.dim, np.cumsum(tree.cells), tree.boxes
    marks = (np.arange(SAMPLE) + 0.5) / SAMPLE * reached[-1]
    box = np.minimum(np.searchsorted(reached, marks, side="right"), len(reached) - 1)
    inside = (0.5 + np.arange(1, SAMPLE + 1)[:, None] * np.array(_STEPS[d])) % 1
    places = boxes.origin + boxes.root * boxes.corner[box] + inside * boxes.edges()[box]
    places = places[domain.contains(places)]
    if not len(places):
        return 0.0
    h = np.asarray(size(places))
    ways = np.concatenate([np.eye(d), -np.eye(d)])
    beside = (places[:, None] + reach * h[:, None, None] * ways).reshape(-1, d)
    known, sizes = domain.contains(beside), np.repeat(h, 2 * d)
    if known.any():
        sizes[known] = size(beside[known])
    largest = sizes.reshape(-1, 2 * d).max(axis=1)
    steep = ((largest / h).clip(STEEP_FROM, STEEP_TO) - STEEP_FROM).mean()
    return MOST_SURPLUS * float(1 - np.exp(-SURPLUS_RATE * steep))


def memory_needed(
    engine: Engine,
    n: float,
    domain: Domain | None = None,
    images: float | None = None,
    surplus: float = 0.0,
    held: float = 0.0,
    *,
    run: bool = True,
) -> float:
    """Return the bytes that a run of `n` cells, or reading its diagram, takes on the device at most.

    Without `run`, those that `Adapter.diagram` takes.

    `images` per generator are what periodic boxes take (`images_expected`); None: as of cells that are all alike.
    `surplus` are generators per one that is asked for (`surplus_expected`), `held` bytes that are there in any case.
    """
    n *= 1 + surplus
    cells, folded = n, 0.0
    if domain is not None and any(domain.periodic):
        if images is None:
            deep = IMAGE_REACH[domain.dim] * (domain.measure / max(n, 1.0)) ** (1 / domain.dim)
            seams = [2 * min(deep / length, 1.0) for length in domain.extent[list(domain.periodic)]]
            images = float(np.prod(1 + np.array(seams))) - 1
        cells, folded = n * (1 + images), n

    d, real, trimmed = engine.dim, engine.real.itemsize, isinstance(domain, Polygon)
    if not run:
        per_cell = TRIMMED_DIAGRAM[real] if trimmed else DIAGRAM[d][real]
        return cells * per_cell + folded * FOLDED_DIAGRAM[d][real] + held

    def bytes_of(figures: tuple[int, int]) -> int:
        return figures[0] * real + figures[1] * 4

    peak = cells * bytes_of(TRIMMED_PEAK if trimmed else PEAK[d]) + folded * bytes_of(FOLDED[d])
    output = cells * (TRIMMED_OUTPUT[real] if trimmed else OUTPUT[d][real])
    return max(peak, output) + held


def in_bytes(amount: float) -> str:
    """Return a number of bytes as people read it: 258 KiB, 1.47 GiB."""
    power = 0 if amount < 2**10 else 1 if amount < 2**20 else 2 if amount < 2**30 else 3
    return f"{amount / 2 ** (10 * power):.3g} {('bytes', 'KiB', 'MiB', 'GiB')[power]}"


def check_memory(engine: Engine, n: float, needed: float) -> float:
    """Return `needed`, the bytes that a mesh of `n` cells takes (`memory_needed`), if there are as many.

    Nothing has been allocated yet.

    Raises
    ------
    MemoryLimitError
        Saying how many cells were asked for, how much memory they need and how much there is.
    """
    available = engine.queue.device.global_mem_size
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
