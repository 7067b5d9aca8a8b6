"""Values of cells carried from one diagram to another, on the host.

Of polygons, where cells need not be convex, and of periodic boxes in 2D, where cells meet images of others.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import shapely

from ..mesh.connectivity import face_ends
from ..mesh.diagram import Diagram
from ..mesh.shapes import cell_shapes

_PAIRS = 1 << 20  # of cells that are intersected at a time
_LEAST = 1e-300  # stands for 0 where it divides


def transfer_on_host(
    source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, ...]:
    """Return what comes into the cells of `target` of `columns` (n, width), means over those of `source`.

    Returns
    -------
    means, low, high : (n_new, width) float64
        Means, and the bounds of what they are means of.
    found : (n_new,) float64
        The area of a cell's parts together.
    """
    width, n = columns.shape[1], len(target)
    slopes = np.zeros((len(source), width, 2))
    least = most = columns
    if order == 2:
        slopes, least, most = fit_slopes(source, columns, limited)
    new = cell_shapes(target)
    old, image, away = _images(source, cell_shapes(source), shapely.total_bounds(new))
    here, there = shapely.STRtree(old).query(new, predicate="intersects")
    by = np.lexsort((there, here))
    here, there = here[by], there[by]
    mass, found = np.zeros((n, width)), np.zeros(n)
    low, high = np.full((n, width), np.inf), np.full((n, width), -np.inf)
    for first in range(0, len(here), _PAIRS):
        i, j = here[first : first + _PAIRS], there[first : first + _PAIRS]
        parts = shapely.intersection(new[i], old[j])
        area = shapely.area(parts)
        some = area > 0
        i, k, area, parts = i[some], j[some], area[some], parts[some]
        j = image[k]
        off = shapely.get_coordinates(shapely.centroid(parts)) - source.centroids[j] - away[k]
        found += np.bincount(i, area, n)
        for c in range(width):
            value = columns[j, c] + (slopes[j, c] * off).sum(axis=1)
            mass[:, c] += np.bincount(i, area * value, n)
        np.minimum.at(low, i, least[j])
        np.maximum.at(high, i, most[j])
    return mass / np.maximum(found, _LEAST)[:, None], low, high, found


def _images(
    diagram: Diagram, cells: np.ndarray, bounds: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `cells` (n,) and images of them within `bounds`: shapes (k,), of which cell, how far away (k, 2)."""
    n, periodic = len(cells), diagram.domain.periodic
    shapes, rows, away = [cells], [np.arange(n)], [np.zeros((n, 2))]
    boxes = shapely.bounds(cells)
    for step in product(*((-1, 0, 1) if p else (0,) for p in periodic)):
        if not any(step):
            continue
        shift = np.array(step) * diagram.domain.extent
        low, high = boxes[:, :2] + shift, boxes[:, 2:] + shift
        near = np.flatnonzero(((high > bounds[:2]) & (low < bounds[2:])).all(axis=1))
        shapes.append(shapely.transform(cells[near], lambda xy, shift=shift: xy + shift))
        rows.append(near)
        away.append(np.tile(shift, (len(near), 1)))
    return np.concatenate(shapes), np.concatenate(rows), np.concatenate(away)


def fit_slopes(
    diagram: Diagram, columns: np.ndarray, limited: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return slopes (n, width, 2) that fit the neighbors' values, and bounds of the values nearby, (n, width) each.

    As `fit_slopes` in transfer.cl does, and limited as there.
    """
    n, width = columns.shape
    owner = np.repeat(np.arange(n), np.diff(diagram.neighbor_starts))
    inner = diagram.neighbors >= 0
    i, j = owner[inner], diagram.neighbors[inner]
    d = diagram.centroids[j] + diagram.shifts[inner] * diagram.domain.extent - diagram.centroids[i]
    weight = 1 / np.maximum((d**2).sum(axis=1), _LEAST)
    normal = np.zeros((n, 2, 2))
    for a in range(2):
        for b in range(2):
            normal[:, a, b] = np.bincount(i, weight * d[:, a] * d[:, b], n)
    # A direction that the neighbors say nothing about gets no slope.
    inverse = np.linalg.pinv(normal, rcond=256 * np.finfo(float).eps, hermitian=True)
    corners = diagram.vertices[face_ends(diagram)[:, 0]] - diagram.centroids[owner]
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
