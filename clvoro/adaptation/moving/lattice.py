"""The computational mesh of moving meshes: a lattice that fills a box, and its mirror images at the walls."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...errors import InputError
from ...geometry.domain import Domain

FEWEST_ROWS = 4
"""Fewest cells across the box in each direction."""


def lattice_points(domain: Domain, n: int) -> np.ndarray:
    """Return `n` generators (n, d) of a lattice in a box, all for the same volume.

    In 2D they are rows of a hexagonal lattice, in 3D layers of a body-centered cubic one. If `n` does not fill all
    rows, some rows have one generator more and are wider in the same ratio, so that the lattice has a dislocation.

    Raises `InputError` if the box is narrower than `FEWEST_ROWS` cells.
    """
    spacing = (domain.measure / n) ** (1 / domain.dim)
    if domain.extent.min() < FEWEST_ROWS * spacing:
        raise InputError(
            f"{n} cells of {domain} are {domain.extent.min() / spacing:.2g} cells wide in one direction, expected at "
            f"least {FEWEST_ROWS} for a moving mesh; use smaller sizes, or another method"
        )
    if domain.dim == 2:
        points = _rows(domain.extent, n, round(domain.extent[1] / spacing * math.sqrt(2 / math.sqrt(3))))
        return np.array(domain.lower) + points
    edge = 2 ** (1 / 3) * spacing
    layers, z = [], 0.0
    for k, count in enumerate(_parts(n, round(2 * domain.extent[2] / edge))):
        height = domain.extent[2] * count / n
        layer = _rows(domain.extent[:2], count, round(domain.extent[1] / edge), shift=k % 2)
        layers.append(np.column_stack([layer, np.full(count, z + height / 2)]))
        z += height
    return np.array(domain.lower) + np.concatenate(layers)


def _parts(n: int, count: int) -> list[int]:
    """Return `n` as a sum of `count` numbers that differ by one at most, larger ones first."""
    return [n // count + (k < n % count) for k in range(count)]


def _rows(extent: np.ndarray, n: int, count: int, shift: int | None = None) -> np.ndarray:
    """Return `n` points (n, 2) in `count` rows: in turn 1/4 and 3/4 of a spacing off the wall.

    With `shift`, all rows are 1/4 (0) or 3/4 (1) off, in both directions: a layer of a cubic lattice.
    """
    rows, y = [], 0.0
    for k, m in enumerate(_parts(n, count)):
        height = extent[1] * m / n
        offset = 0.25 + 0.5 * (k % 2 if shift is None else shift)
        x = (np.arange(m) + offset) / m * extent[0]
        rows.append(np.column_stack([x, np.full(m, y + height * (0.5 if shift is None else offset))]))
        y += height
    return np.concatenate(rows)


@dataclass(frozen=True)
class Mirrored:
    """Points of a box, followed by their mirror images near its walls."""

    points: np.ndarray
    """(n + g, d) float64."""
    owners: np.ndarray
    """(n + g,) int32. The point that each one is, or is an image of."""
    codes: np.ndarray
    """(n + g,) int32. Two bits per axis: 1 and 2 for the image at the lower and at the upper wall."""


def mirrored(points: np.ndarray, lower: np.ndarray, upper: np.ndarray, depth: float) -> Mirrored:
    """Return `points` (n, d) and their images up to `depth` from the walls, also those in edges and corners."""
    x, owners = points, np.arange(len(points), dtype=np.int32)
    codes = np.zeros(len(points), np.int32)
    for axis in range(points.shape[1]):
        parts = [(x, owners, codes)]
        for code, wall in ((1, lower[axis]), (2, upper[axis])):
            near = np.abs(x[:, axis] - wall) < depth
            image = x[near]
            image[:, axis] = 2 * wall - image[:, axis]
            parts.append((image, owners[near], codes[near] | (code << 2 * axis)))
        x, owners, codes = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Mirrored(x, owners, codes)
