"""What a size field will bring with it: images beyond seams, generators beside jumps, cells along a boundary.

Known before a run begins, for what it will take on the device (`memory.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from ..geometry.box import Domain
from ..geometry.polygon import Polygon
from ..tessellation.periodic.halo import block_counts
from .sampling.quadrature import DensityTree
from .schedule import MOST_SURPLUS

IMAGE_REACH = {2: 1.55, 3: 1.75}
"""How deep margins of equal cells are, in their sizes."""
RIGHT_BESIDE, FULL_JUMPS, LARGER, SIDEWAYS_REACH = 0.5, 0.08, 0.8, 0.6
"""How many sizes away sizes are compared for jumps; the share of cells at one from which on balls are larger by that
share, at most, and go so far into smaller ones, in sizes. Measured on strips, rings and corners 1 : 5 to 1 : 40, of
2500 cells and more: margins are 2 to 3 sizes of the coarse cells deep."""
BACK = tuple(0.5**k for k in range(3, 8))
"""How far from the seam the middles of such balls are looked for, in edges of the box."""
IMAGE_SAMPLE = 16384
"""Cells that are looked at for images."""
STEEP_FROM, STEEP_TO = 1.4, 2.4
"""Ratios of sizes, within reach of a cell, from which on it is near something steep, and up to which more so."""
SURPLUS_RATE = 8.0
"""How quickly what a run takes comes to the most that it may (`plans.MOST_SURPLUS`), by the mean of that over cells.
Measured on jumps of 1 : 5 to 1 : 40, strips, rings, chequers and kinks, 1500 to 20,000 cells: 0.83 to 1.05 of what is
told here, cells that are asked for included."""
SAMPLE = 1024
"""Places where that is looked at."""
SHORE_SAMPLE = 4096
"""Places of a polygon's boundary where the size of cells is looked at, at least."""
ACROSS = 0.95
"""Cells at a boundary to its length over their size, which is looked at half a size inside."""
_STEPS = {2: (0.7548776662, 0.5698402910), 3: (0.8191725134, 0.6710436067, 0.5497004779)}
"""Whose multiples, less whole numbers, fill the unit square, or cube, evenly: powers of the inverse of the root of
x^(d + 1) = x + 1."""


def sample_cells(domain: Domain, tree: DensityTree, count: int) -> np.ndarray:
    """Return `count` places of `domain`, or a few less, spread as cells are."""
    d, reached, boxes = domain.dim, np.cumsum(tree.cells), tree.boxes
    marks = (np.arange(count) + 0.5) / count * reached[-1]
    box = np.minimum(np.searchsorted(reached, marks, side="right"), len(reached) - 1)
    inside = (0.5 + np.arange(1, count + 1)[:, None] * np.array(_STEPS[d])) % 1
    places = boxes.origin + boxes.root * boxes.corner[box] + inside * boxes.edges()[box]
    return places[domain.contains(places)]


def images_expected(
    domain: Domain,
    size: Callable[[np.ndarray], np.ndarray],
    n: float,
    tree: DensityTree,
) -> float:
    """Return how many images of generators a periodic box of `n` cells takes, per generator.

    These are the cells of a sample that lie beyond a seam, no farther than balls around places of the seam go in their
    block (`seam.py`).

    Parameters
    ----------
    size : callable
        h(points (k, d)) -> (k,), which sizes of cells are in proportion to.
    tree : DensityTree
        Of it.
    """
    d, counts = domain.dim, block_counts(domain.extent, n)[: domain.dim]
    count = int(counts.max())
    factor = (tree.integral / n) ** (1 / d)

    def scaled(points: np.ndarray) -> np.ndarray:
        return factor * np.asarray(size(points))

    jumps = _steepness(domain, scaled, sample_cells(domain, tree, SAMPLE), RIGHT_BESIDE)
    depths = _margins_expected(domain, scaled, count, jumps)
    x = (sample_cells(domain, tree, IMAGE_SAMPLE) - domain.lower) / domain.extent
    images = 0
    for code in product((-1, 0, 1), repeat=d):
        moved = np.flatnonzero(code)
        if not len(moved) or not all(domain.periodic[a] for a in moved):
            continue
        y = x + code
        within = np.ones(len(x), bool)
        blocks = np.clip((y * count).astype(int), 0, count - 1)
        for a in map(int, moved):
            along = tuple(blocks[:, b] for b in range(d) if b != a)
            deep = -y[:, a] if code[a] < 0 else y[:, a] - 1
            within &= deep * domain.extent[a] <= depths[a, code[a]][along]
        images += int(np.count_nonzero(within))
    return images / max(len(x), 1)


def _margins_expected(
    domain: Domain,
    size: Callable[[np.ndarray], np.ndarray],
    count: int,
    jumps: float,
) -> dict[tuple[int, int], np.ndarray]:
    """Return how deep margins are beyond either end (-1, 1) of each axis with seams, of `count` blocks each way.

    A ball is as large as cells are at its middle, but goes no farther into smaller ones than cells of their size do.
    Where many cells are at `jumps`, the coarse ones are larger, as they make room for a surplus of fine ones, and
    unlike each other: what such a ball may move along the seam takes it over fine ones.
    """
    d, depths = domain.dim, {}
    # In units of the longest edge, as squares in single precision are to be numbers.
    unit_length = float(domain.extent.max())
    extent = domain.extent / unit_length
    share = min(jumps / FULL_JUMPS, 1.0)
    reach, aside = IMAGE_REACH[d] * (1 + LARGER * share), SIDEWAYS_REACH * share
    places = (np.arange(count) + 0.5) / count
    for axis in np.flatnonzero(domain.periodic):
        along = [a for a in range(d) if a != axis]
        unit = np.stack(np.meshgrid(*[places] * (d - 1), indexing="ij"), axis=-1).reshape(-1, d - 1)
        away2 = []  # squares of how far blocks are apart: along one axis, then along both
        for a in along:
            away = np.abs(places[:, None] - places)
            if domain.periodic[a]:
                away = np.minimum(away, 1 - away)
            away2.append(((away * extent[a]) ** 2).astype(np.float32))
        apart2 = away2[0] if d == 2 else away2[0][:, None, :, None] + away2[1][:, None, :]
        apart2 = apart2.reshape(len(unit), len(unit))
        apart = np.sqrt(apart2)
        for end in (-1, 1):
            at, deep, limit = np.insert(unit, axis, (end + 1) / 2, axis=1), 0.0, 0.0
            for back in (0.0, *BACK) if share else (0.0,):
                at[:, axis] = back if end < 0 else 1 - back
                h = np.asarray(size(at * domain.extent + domain.lower)) / unit_length
                h = np.minimum(h, 1e9).astype(np.float32)
                if back == 0:
                    limit = (reach * h + apart).min(axis=1)
                t = back * extent[axis]
                radius = np.minimum(limit + t + aside * h, reach * h)
                deep = np.maximum(deep, np.sqrt((radius**2 - apart2).max(axis=1).clip(0)) - t)
            deep = unit_length * np.minimum(deep, extent[axis])
            depths[int(axis), end] = deep.reshape((count,) * (d - 1))
    return depths


def surplus_expected(
    domain: Domain,
    size: Callable[[np.ndarray], np.ndarray],
    tree: DensityTree,
    reach: float,
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
    steep = _steepness(domain, size, sample_cells(domain, tree, SAMPLE), reach)
    return float(MOST_SURPLUS * (1 - np.exp(-SURPLUS_RATE * steep)))


def _steepness(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], places: np.ndarray, reach: float
) -> float:
    """Return how steep sizes are around `places` (k, d): the mean of 0 (not) to 1 (`STEEP_TO`), `reach` sizes away."""
    if not len(places):
        return 0.0
    d, h = domain.dim, np.asarray(size(places))
    ways = np.concatenate([np.eye(d), -np.eye(d)])
    beside = (places[:, None] + reach * h[:, None, None] * ways).reshape(-1, d)
    for a in np.flatnonzero(domain.periodic):
        beside[:, a] = domain.lower[a] + (beside[:, a] - domain.lower[a]) % domain.extent[a]
    known, sizes = domain.contains(beside), np.repeat(h, 2 * d)
    if known.any():
        sizes[known] = size(beside[known])
    ratios = sizes.reshape(-1, 2 * d).max(axis=1) / h
    return float((ratios.clip(STEEP_FROM, STEEP_TO) - STEEP_FROM).mean())


def shore_expected(domain: Polygon, size: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return how many cells are at the boundary of a polygon.

    Parameters
    ----------
    size : callable
        h(points (k, 2)) -> (k,), that of the cells.
    """
    begins = domain.oriented.vertices
    along = begins[domain.oriented.next_vertex] - begins
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
