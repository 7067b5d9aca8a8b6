"""Conservative transfer of cell data on the host, with Shapely.

For polygons, where cells need not be convex.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import shapely

from ..mesh.connectivity import face_ends
from ..mesh.diagram import Diagram
from ..mesh.lookup import cell_shapes

PAIRS = 1 << 20
"""Pairs of cells that are intersected at a time."""
TINY = 1e-300
"""Replaces a divisor of 0."""
COVER_TOLERANCE = 1e-3
"""Largest accepted difference between a cell's volume and that of its intersections, as a share of the cell."""


def find_defect(found: np.ndarray, volumes: np.ndarray, dim: int) -> int | None:
    """Return the cell where `found` differs most from the volume if it is beyond the tolerance. Both are normalized."""
    slack = 64 * np.finfo(np.float32).eps * volumes ** (1 - 1 / dim)
    defect = np.abs(found - volumes) - COVER_TOLERANCE * volumes - slack
    worst = int(defect.argmax())
    return None if defect[worst] <= 0 else worst


def transfer_on_host(
    source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, ...]:
    """Return the means of `columns` (n, width), data of the cells of `source`, over the cells of `target`.

    Returns
    -------
    means, low, high : (n_new, width) float64
        Means over the cells, and bounds of the old data in them.
    covered : (n_new,) float64
        Sum of the areas of a cell's intersections.
    """
    slopes, least, most = None, columns, columns
    if order == 2:
        slopes, least, most = fit_slopes(source, columns, limited)
    sums = CellSums(len(target), columns, slopes, least, most)
    new = cell_shapes(target)
    old, image, offsets = _images(source, cell_shapes(source), target, shapely.total_bounds(new))
    here, there = shapely.STRtree(old).query(new, predicate="intersects")
    by = np.lexsort((there, here))
    here, there = here[by], there[by]
    for first in range(0, len(here), PAIRS):
        i, j = here[first : first + PAIRS], there[first : first + PAIRS]
        parts = shapely.intersection(new[i], old[j])
        area = shapely.area(parts)
        some = area > 0
        i, k, area, parts = i[some], j[some], area[some], parts[some]
        j = image[k]
        off = shapely.get_coordinates(shapely.centroid(parts)) - source.centroids[j] - offsets[k]
        sums.add(i, j, area, off)
    return sums.results()


class CellSums:
    """Sums over the intersections of old and new cells.

    Parameters
    ----------
    n : int
        Number of new cells.
    columns, least, most : (n_old, width) float64
        Means over the old cells, and bounds of the data in them.
    slopes : (n_old, width, d) float64, optional

    Attributes
    ----------
    covered : (n,) float64
        Sum of the areas of a cell's intersections.
    """

    def __init__(
        self, n: int, columns: np.ndarray, slopes: np.ndarray | None, least: np.ndarray, most: np.ndarray
    ) -> None:
        self.columns, self.slopes, self.least, self.most = columns, slopes, least, most
        shape = n, columns.shape[1]
        self.covered, self.mass = np.zeros(n), np.zeros(shape)
        self.low, self.high = np.full(shape, np.inf), np.full(shape, -np.inf)

    def add(self, i: np.ndarray, j: np.ndarray, area: np.ndarray, off: np.ndarray) -> None:
        """Add intersections of cells i and j (k,); `off` (k, d) leads from the centroid of j to that of each."""
        n, width = self.mass.shape
        self.covered += np.bincount(i, area, n)
        for c in range(width):
            value = self.columns[j, c]
            if self.slopes is not None:
                value = value + (self.slopes[j, c] * off).sum(axis=1)
            self.mass[:, c] += np.bincount(i, area * value, n)
            np.minimum.at(self.low[:, c], i, self.least[j, c])
            np.maximum.at(self.high[:, c], i, self.most[j, c])

    def results(self) -> tuple[np.ndarray, ...]:
        """Return means, low, high and covered; see `transfer_on_host`."""
        return (self.mass / np.maximum(self.covered, TINY)[:, None], self.low, self.high, self.covered)


def _images(
    diagram: Diagram, cells: np.ndarray, target: Diagram, bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `cells` and their periodic images that overlap `bounds`; periods are those of either mesh.

    Returns
    -------
    shapes : (k,) shapely geometries
    rows : (k,) int
        The cell that each is an image of.
    offsets : (k, 2) float64
        From the cell to the image.
    """
    boxes = shapely.bounds(cells)
    own, other = diagram.domain, target.domain
    steps, extents = [], []
    for axis in range(2):
        extents.append(float((own if own.periodic[axis] else other).extent[axis]))
        first, last = 0, 0
        if own.periodic[axis] or other.periodic[axis]:
            first = math.floor((bounds[axis] - boxes[:, axis + 2].max()) / extents[axis])
            last = math.ceil((bounds[axis + 2] - boxes[:, axis].min()) / extents[axis])
        steps.append(range(min(first, 0), max(last, 0) + 1))
    n = len(cells)
    shapes, rows, offsets = [cells], [np.arange(n)], [np.zeros((n, 2))]
    for step in product(*steps):
        if not any(step):
            continue
        shift = np.array(step) * extents
        low, high = boxes[:, :2] + shift, boxes[:, 2:] + shift
        near = np.flatnonzero(((high > bounds[:2]) & (low < bounds[2:])).all(axis=1))
        shapes.append(shapely.transform(cells[near], lambda xy, shift=shift: xy + shift))
        rows.append(near)
        offsets.append(np.tile(shift, (len(near), 1)))
    return np.concatenate(shapes), np.concatenate(rows), np.concatenate(offsets)


def fit_slopes(diagram: Diagram, columns: np.ndarray, limited: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit slopes (n, width, 2) to the neighbors' values, and return the bounds of these values, (n, width) each.

    The kernel `fit_slopes` in transfer.cl gives the formulas.
    """
    owner = np.repeat(np.arange(len(diagram)), np.diff(diagram.neighbor_starts))
    inner = diagram.neighbors >= 0
    i, j = owner[inner], diagram.neighbors[inner]
    d = diagram.centroids[j] + diagram.shifts[inner] * diagram.domain.extent - diagram.centroids[i]
    corners = diagram.vertices[face_ends(diagram)[:, 0]] - diagram.centroids[owner]
    return fit_linear_functions(columns, i, j, d, owner, corners, limited)


def fit_linear_functions(
    columns: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    d: np.ndarray,
    owner: np.ndarray,
    corners: np.ndarray,
    limited: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do what `fit_slopes` does, with neighbors and corners given.

    Parameters
    ----------
    i, j : (m,) int
        Pairs of neighbors.
    d : (m, 2) float64
        From the centroid of i to that of j.
    owner, corners : (c,) int, (c, 2) float64
        Corners of cells, relative to the centroids.
    """
    n, width = columns.shape
    weight = 1 / np.maximum((d**2).sum(axis=1), TINY)
    normal = np.zeros((n, 2, 2))
    for a in range(2):
        for b in range(2):
            normal[:, a, b] = np.bincount(i, weight * d[:, a] * d[:, b], n)
    # The pseudo-inverse gives the slope of least norm where the neighbors do not determine one.
    inverse = np.linalg.pinv(normal, rcond=256 * np.finfo(float).eps, hermitian=True)
    slopes = np.empty((n, width, 2))
    least, most = columns.copy(), columns.copy()
    np.minimum.at(least, i, columns[j])
    np.maximum.at(most, i, columns[j])
    for c in range(width):
        rise = weight * (columns[j, c] - columns[i, c])
        right = np.stack([np.bincount(i, rise * d[:, a], n) for a in range(2)], axis=1)
        slope = np.einsum("nab,nb->na", inverse, right)
        if limited:
            change = (slope[owner] * corners).sum(axis=1)
            room = np.where(change > 0, most[owner, c], least[owner, c]) - columns[owner, c]
            factor = np.ones(n)
            over = np.abs(change) > np.abs(room)
            np.minimum.at(factor, owner[over], room[over] / change[over])
            slope *= factor[:, None]
        slopes[:, c] = slope
    return slopes, least, most
