"""What a run takes on the device, known before it begins."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl as cl

from ._host_memory import host_memory
from ._primitives import scan_width
from ._program import Engine
from .domain import Domain
from .errors import MemoryLimitError
from .margins import block_count, block_counts
from .poisson import most_iterations
from .polygon import Polygon
from .quadrature import DensityTree

MOST_CELLS = 100_000_000
"""Cells that 32-bit indices into the rows of neighbours allow for."""
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
STEEP_SHARE, STEEPEST, BEYOND_RATE = 0.25, 2.9, 3.2
"""Where all but this share of the cells are near what is steeper still, as in a kink of few cells, up to which ratio
that counts, and by how much: a coarse level there takes up to 2.5 times the generators that it is asked for."""
SAMPLE = 1024
"""Places where that is looked at."""
SHORE_SAMPLE = 4096
"""Places of a polygon's boundary where the size of cells is looked at, at least."""
ACROSS = 0.95
"""Cells at a boundary to its length over their size, which is looked at half a size inside."""
PARTIAL_SUMS, SCANS, ARRAYS = 80, 8, 64
"""What there is whatever the number of cells: reals to each work-group of sums, scans, and arrays in the workspace, of
each of which up to a unit is left."""
FEW = 6000
"""Cells from which on linear solves are by multigrid, whose iterations are few: there is room to record each one."""
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
    ratios = sizes.reshape(-1, 2 * d).max(axis=1) / h
    steep = (ratios.clip(STEEP_FROM, STEEP_TO) - STEEP_FROM).mean()
    beyond = np.quantile(ratios, STEEP_SHARE).clip(STEEP_TO, STEEPEST) - STEEP_TO
    return float(MOST_SURPLUS * (1 - np.exp(-SURPLUS_RATE * steep)) + BEYOND_RATE * beyond)


def shore_expected(domain: Polygon, size: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return how many cells are at the boundary of a polygon.

    Parameters
    ----------
    size : callable
        h(points (k, 2)) -> (k,), that of the cells.
    """
    begins = domain.vertices
    along = begins[domain.next_vertex] - begins
    lengths = np.hypot(*along.T)
    parts = np.maximum(1, np.ceil(lengths / (lengths.sum() / SHORE_SAMPLE))).astype(int)
    edge = np.repeat(np.arange(len(parts)), parts)
    part = np.arange(len(edge)) - np.repeat(np.cumsum(parts) - parts, parts)
    places = begins[edge] + ((part + 0.5) / parts[edge])[:, None] * along[edge]
    h = np.array(size(places))
    # Interior lies on the left of an edge.
    inwards = np.column_stack([-along[:, 1], along[:, 0]])[edge] / lengths[edge, None]
    inner = places + 0.5 * h[:, None] * inwards
    known = domain.contains(inner)
    if known.any():
        h[known] = size(inner[known])
    return ACROSS * float((lengths[edge] / parts[edge] / h).sum())


def fixed_bytes(engine: Engine, n: float) -> float:
    """Return the bytes of a run that do not grow with its number of cells, `n`, or hardly."""
    real = engine.real.itemsize
    records = 8 * real * most_iterations(int(min(n, FEW)))
    return records + PARTIAL_SUMS * engine.groups * real + spare_bytes(engine)


def spare_bytes(engine: Engine) -> float:
    """Return the part of these bytes that one diagram takes, too."""
    unit = max(64, engine.queue.device.mem_base_addr_align // 8)
    periodic = any(name == "PERIODIC" for name, _ in engine.domain_defines)
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
        edges = len(domain.vertices)
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
