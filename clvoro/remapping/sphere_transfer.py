"""Conservative transfer of cell data between meshes on a sphere, on the host."""

from __future__ import annotations

import numpy as np
import scipy

from ..errors import InputError
from ..mesh.diagram import Diagram
from ..mesh.lookup import Locator
from .host_transfer import CellSums, find_defect, fit_linear_functions
from .spherical_pieces import TangentCells

PAIRS = 1 << 15
"""Pairs of cells that are intersected at a time."""


def transfer_on_sphere(
    source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, ...]:
    """Return the means of `columns` (n, width), data of the cells of `source`, over the cells of `target`.

    A value of order 2 is a linear function of the position in space, g.(y - m), with the mean m of the position over
    the cell and g tangential at its generator. Its integrals are exact. Between two corners it may exceed its values
    there by a part of second order.

    Returns
    -------
    Those of `transfer_on_host`.

    Raises
    ------
    InputError
        If a graph is not that of a Voronoi diagram.
    """
    old, new = TangentCells(source), TangentCells(target)
    areas, moments = old.pieces.measure()
    _require_areas("self", source, areas)
    _require_areas("onto", target, new.pieces.measure()[0])
    every = np.arange(len(old))
    means = old.in_space(moments / areas[:, None], every)  # m_j - x_j
    slopes, least, most = None, columns, columns
    if order == 2:
        slopes, least, most = _fit_slopes(old, means, columns, limited)
    sums = CellSums(len(new), columns, slopes, least, most)
    if source.domain != target.domain:
        keys = _near(new, old)
        for first in range(0, len(keys), PAIRS):
            _add_pairs(sums, new, old, means, keys[first : first + PAIRS])
        front = keys[:0]
    else:
        front = np.arange(len(new)) * len(old) + Locator(source).find(target.points)
    seen = front
    while front.size:
        found = [
            _add_pairs(sums, new, old, means, front[first : first + PAIRS]) for first in range(0, len(front), PAIRS)
        ]
        front = np.unique(np.concatenate(found))
        places = np.minimum(np.searchsorted(seen, front), len(seen) - 1)
        front = front[seen[places] != front]
        seen = np.sort(np.concatenate([seen, front]), kind="stable")
    unit = source.domain.frame[1] ** 2
    result, low, high, covered = sums.results()
    return result, low, high, covered * unit


def _near(new: TangentCells, old: TangentCells) -> np.ndarray:
    """Return the keys of all pairs of cells that may overlap, as the old cells need not cover the new ones."""
    tree = scipy.spatial.KDTree(old.x)
    found = tree.query_ball_point(new.x, new.reach + old.reach.max())
    i = np.repeat(np.arange(len(new)), [len(row) for row in found])
    j = np.concatenate([np.empty(0, int), *(np.array(row, int) for row in found)]).astype(int)
    near = np.sqrt(((new.x[i] - old.x[j]) ** 2).sum(axis=1)) <= new.reach[i] + old.reach[j]
    return np.sort(i[near] * len(old) + j[near])


def _require_areas(name: str, diagram: Diagram, areas: np.ndarray) -> None:
    """Raise InputError unless the cells between bisectors have the areas of the diagram."""
    volumes = diagram.volumes / diagram.domain.frame[1] ** 2
    worst = find_defect(areas, volumes, 2)
    if worst is not None:
        raise InputError(
            f"cell {worst} of {name}, rebuilt from its neighbors, has {areas[worst] / volumes[worst]:.6g} of its area, "
            "expected Voronoi diagrams of distinct generators: call diagram.check() on it"
        )


def _add_pairs(sums: CellSums, new: TangentCells, old: TangentCells, means: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Add the intersections of pairs of cells, and return the keys of the pairs behind their edges.

    The key of a new cell i and an old cell j is i n + j.
    """
    n = len(old)
    i, j = keys // n, keys % n
    pairs, pieces = new.intersections(i, old, j)
    i, j = i[pairs], j[pairs]
    area, integral = pieces.measure()
    some = np.flatnonzero(area > 0)
    here, there, part = i[some], j[some], area[some]
    middle = new.in_space(integral[some] / part[:, None], here)
    sums.add(here, there, part, middle + (new.x[here] - old.x[there]) - means[there])
    inner = np.flatnonzero(pieces.labels >= 0)
    return i[pieces.owners[inner]] * n + pieces.labels[inner]


def _fit_slopes(
    old: TangentCells, means: np.ndarray, columns: np.ndarray, limited: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return slopes (n, width, 3) in space, tangential at the generators, and the bounds of neighbors' values."""
    every = np.repeat(np.arange(len(old)), np.diff(old.starts))
    inner = old.neighbors >= 0
    i, j = every[inner], old.neighbors[inner]
    between = old.along_tangents(old.x[j] - old.x[i] + means[j] - means[i], i)
    u = old.pieces.corners
    corners = u / np.sqrt(1 + (u * u).sum(axis=1))[:, None] - old.along_tangents(means[every], every)
    flat, least, most = fit_linear_functions(columns, i, j, between, every, corners, limited)
    one, other = (flat[:, :, a, None] * old.tangents[a][:, None, :] for a in range(2))
    return one + other, least, most
