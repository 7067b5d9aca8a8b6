"""Expected ghost images, additional cells beside jumps of h, and cells at the boundary, for estimates of the memory."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..tessellation.periodic.halo import block_counts
from .sampling.quadrature import DensityTree

IMAGE_REACH = {2: 1.55, 3: 1.75}
"""Depth of the halo of equal cells over their size."""
JUMP_DISTANCE, FULL_JUMPS, LARGER, SIDEWAYS_REACH = 0.5, 0.08, 0.8, 0.6
"""Distance over h at which sizes are compared for jumps; share of cells at jumps for which balls are larger by the full
factor LARGER; how far such balls extend into smaller cells, over h. Measured on strips, rings and corners 1 : 5 to 1 :
40 with at least 2500 cells: the halo is 2 to 3 sizes of the coarse cells deep."""
CENTER_DEPTHS = tuple(0.5**k for k in range(3, 8))
"""Distances from the periodic boundary of the centers of such balls, over the edges of the box."""
IMAGE_SAMPLE = 16384
"""Sample of cells for the number of images."""
STEEP_FROM, STEEP_TO = 1.4, 2.4
"""Ratios of sizes around a cell between which its steepness increases from 0 to 1."""
MOST_SURPLUS = 0.4
"""Largest number of cells over the integral of h^-d, as a share of it. Steep slopes require up to 0.35 more for a
while, and 0.15 at the end. Jumps would require any number, without a better mesh."""
SURPLUS_RATE = 8.0
"""Rate at which the surplus approaches its limit (`MOST_SURPLUS`) with the mean steepness.
Measured on jumps of 1 : 5 to 1 : 40, strips, rings, checkers and kinks, 1500 to 20,000 cells: 0.83 to 1.05 of this
estimate of all cells."""
SAMPLE = 1024
"""Sample of cells for the steepness."""
BOUNDARY_SAMPLE = 4096
"""Points on the boundary of a polygon where h is evaluated, at least."""
CELLS_PER_SIZE = 0.95
"""Ratio of the cells at a boundary to its length over h, with h evaluated half a cell inside."""
_RECURRENCE = {2: (0.7548776662, 0.5698402910), 3: (0.8191725134, 0.6710436067, 0.5497004779)}
"""Steps of the additive recurrence R_d, a low-discrepancy sequence in the unit square or cube: powers of the inverse of
the root of x^(d + 1) = x + 1."""


def sample_cells(domain: Domain, tree: DensityTree, count: int) -> np.ndarray:
    """Return about `count` points of `domain` with the density of the cells."""
    d, reached, boxes = domain.dim, np.cumsum(tree.cells), tree.boxes
    marks = (np.arange(count) + 0.5) / count * reached[-1]
    box = np.minimum(np.searchsorted(reached, marks, side="right"), len(reached) - 1)
    inside = (0.5 + np.arange(1, count + 1)[:, None] * np.array(_RECURRENCE[d])) % 1
    places = boxes.origin + boxes.root * boxes.corner[box] + inside * boxes.edges()[box]
    return places[domain.contains(places)]


def expected_images(domain: Domain, size: Callable[[np.ndarray], np.ndarray], n: float, tree: DensityTree) -> float:
    """Return the expected ghost images per generator in a periodic box of `n` cells.

    They are counted in a sample: points across a periodic boundary that are not deeper than the halo of their block.

    Parameters
    ----------
    size : callable
        h(points (k, d)) -> (k,), up to a constant factor.
    tree : DensityTree
        Of `size`.
    """
    d, counts = domain.dim, block_counts(domain.extent, n)[: domain.dim]
    count = int(counts.max())
    factor = (tree.integral / n) ** (1 / d)

    def scaled(points: np.ndarray) -> np.ndarray:
        return factor * np.asarray(size(points))

    jumps = _steepness(domain, scaled, sample_cells(domain, tree, SAMPLE), JUMP_DISTANCE)
    depths = _expected_halo_depths(domain, scaled, count, jumps)
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


def _expected_halo_depths(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], count: int, jumps: float
) -> dict[tuple[int, int], np.ndarray]:
    """Return the expected depth of the halo at both ends (-1, 1) of each periodic axis, for `count` blocks per axis.

    A ball is as large as the cells at its center, but extends no farther into smaller cells than those require. If many
    cells are at `jumps` of h, coarse cells are larger and vary in size, and their balls extend over fine cells.
    """
    d, depths = domain.dim, {}
    # In units of the longest edge, so that squares are in range of single precision.
    unit_length = float(domain.extent.max())
    extent = domain.extent / unit_length
    share = min(jumps / FULL_JUMPS, 1.0)
    reach, aside = IMAGE_REACH[d] * (1 + LARGER * share), SIDEWAYS_REACH * share
    places = (np.arange(count) + 0.5) / count
    for axis in np.flatnonzero(domain.periodic):
        along = [a for a in range(d) if a != axis]
        unit = np.stack(np.meshgrid(*[places] * (d - 1), indexing="ij"), axis=-1).reshape(-1, d - 1)
        away2 = []  # squared distances of blocks along each axis
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
            for back in (0.0, *CENTER_DEPTHS) if share else (0.0,):
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


def expected_surplus(
    domain: Domain, size: Callable[[np.ndarray], np.ndarray], tree: DensityTree, reach: float
) -> float:
    """Return the temporary cells of a run beyond the integral of h^-d, as a share of it.

    Sizes are evaluated at the generators. At jumps of h fine cells cover parts of the coarse side and count as too
    large, until new cells have been inserted.

    Parameters
    ----------
    size : callable
        h(points (k, d)) -> (k,).
    tree : DensityTree
        Of `size`, or of a multiple of it.
    reach : float
        Distance over h at which sizes are compared.
    """
    steep = _steepness(domain, size, sample_cells(domain, tree, SAMPLE), reach)
    return float(MOST_SURPLUS * (1 - np.exp(-SURPLUS_RATE * steep)))


def _steepness(domain: Domain, size: Callable[[np.ndarray], np.ndarray], places: np.ndarray, reach: float) -> float:
    """Return the mean steepness, from 0 to 1, of the sizes around `places` (k, d) at a distance of `reach` h."""
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


def expected_boundary_cells(domain: Polygon, size: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the expected number of cells at the boundary of a polygon.

    Parameters
    ----------
    size : callable
        h(points (k, 2)) -> (k,).
    """
    begins = domain.oriented.vertices
    along, lengths = domain.oriented.along, domain.oriented.lengths
    parts = np.maximum(1, np.ceil(lengths / (lengths.sum() / BOUNDARY_SAMPLE))).astype(int)
    edge = np.repeat(np.arange(len(parts)), parts)
    part = np.arange(len(edge)) - np.repeat(np.cumsum(parts) - parts, parts)
    places = begins[edge] + ((part + 0.5) / parts[edge])[:, None] * along[edge]
    h = np.array(size(places))
    # The interior is on the left of an edge.
    inwards = np.column_stack([-along[:, 1], along[:, 0]])[edge] / lengths[edge, None]
    inner = places + 0.5 * h[:, None] * inwards
    known = domain.contains(inner)
    if known.any():
        h[known] = size(inner[known])
    return CELLS_PER_SIZE * float((lengths[edge] / parts[edge] / h).sum())
