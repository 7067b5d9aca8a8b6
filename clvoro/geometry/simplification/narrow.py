"""Narrow water and small land, as sets of triangles."""

from __future__ import annotations

import numpy as np
import scipy
import shapely

from .triangles import Triangles, components, keys_of

LEAST_PART = 0.12
"""Least area over h^2 of a narrow part that is filled or dropped. Corners of more than 70 degrees have less."""
SCALES = 1, 0.5, 0.25, 0.125
"""Narrow parts are found for these multiples of the size. A thin slit has a small area compared with h^2, but a large
one compared with the square of its width."""
LONGEST_PART = 1.25
"""Extent over the least scale of h beyond which a narrow part is filled, whatever its area."""


class Parts:
    """Sets of triangles that are joined: their areas and mean sizes.

    Attributes
    ----------
    row : (m,) int
        Triangles.
    part : (m,) int
        The set of each.
    rim : (m, 3) bool
        Which sides lead to other water, of a part of the water, or to other land.
    count : int
        Number of sets.
    area, h : (count,) float
    """

    def __init__(self, triangles: Triangles, chosen: np.ndarray) -> None:
        self.triangles, self.row = triangles, np.flatnonzero(chosen)
        near = triangles.neighbors
        inner = chosen[:, None] & (near >= 0) & chosen[near]
        water = triangles.water[:, None]
        same = np.where(near < 0, ~water, triangles.water[near] == water)
        component = components(inner, near)[1][self.row]
        names, self.part = np.unique(component, return_inverse=True)
        self.count, self.rim = len(names), (~inner & same)[self.row]
        self.area = self.sums(triangles.area[self.row])
        self.h = self.sums(triangles.h[triangles.corners[self.row]].mean(axis=1)) / self.sums()

    def sums(self, values: np.ndarray | None = None) -> np.ndarray:
        """Return the sum over each part of values, (m,), or the number of its triangles."""
        return np.bincount(self.part, values, self.count)

    def chosen(self, parts: np.ndarray) -> np.ndarray:
        """Return which triangles, (t,) bool, belong to the chosen `parts`, (count,) bool."""
        found = np.zeros(len(self.triangles.corners), bool)
        found[self.row[parts[self.part]]] = True
        return found

    def extents(self, wanted: np.ndarray) -> np.ndarray:
        """Return the longest side of the smallest rectangle around each wanted part, and 0 for others."""
        found = np.zeros(self.count)
        rows = np.flatnonzero(wanted[self.part])
        rows = rows[np.argsort(self.part[rows], kind="stable")]
        if rows.size:
            x = self.triangles.x[self.triangles.corners[self.row[rows]]].reshape(-1, 2)
            _, index = np.unique(self.part[rows], return_inverse=True)
            points = shapely.multipoints(x, indices=np.repeat(index, 3))
            around = np.asarray(shapely.oriented_envelope(points))
            corners, part = shapely.get_coordinates(around, return_index=True)
            sides, same = np.hypot(*np.diff(corners, axis=0).T), part[1:] == part[:-1]
            longest = np.zeros(len(around))
            np.maximum.at(longest, part[1:][same], sides[same])
            found[wanted] = longest
        return found


def narrow_parts(triangles: Triangles, water: bool, scale: float) -> Parts:
    """Return the parts of the water, or of the land, in which no disc of the diameter ``scale * h`` fits.

    Their areas are those beside the discs that touch their rims.
    """
    corners = triangles.x[triangles.corners]
    side = np.hypot(*np.moveaxis(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), -1, 0))
    disc = 0.5 * scale * triangles.h[triangles.corners].mean(axis=1)
    is_narrow = side.prod(axis=1) < 4 * triangles.area * disc
    parts = Parts(triangles, is_narrow & (triangles.water == water))
    t, k = np.nonzero(parts.rim)
    r = disc[parts.row][t]
    half = np.minimum(0.5 * side[parts.row][t, k], r)
    beyond = r**2 * np.arcsin(half / r) - half * np.sqrt(r**2 - half**2)
    parts.area -= np.bincount(parts.part[t], beyond, parts.count)
    return parts


def narrow_water(triangles: Triangles, scale: float) -> np.ndarray:
    """Return the triangles of narrow water to fill."""
    parts = narrow_parts(triangles, True, scale)
    h = scale * parts.h
    large = parts.area > LEAST_PART * h**2
    return parts.chosen(large | (parts.extents(~large) > LONGEST_PART * h))


def small_islands(triangles: Triangles) -> np.ndarray:
    """Return the triangles of islands that are smaller than h."""
    islands = Parts(triangles, ~triangles.water)
    inner = np.ones(islands.count, bool)
    inner[islands.part[(triangles.neighbors[islands.row] < 0).any(axis=1)]] = False
    return islands.chosen(inner & (islands.extents(inner) < islands.h))


def small_land(triangles: Triangles, scale: float) -> np.ndarray:
    """Return the triangles of islands and capes that are smaller than h. Land that joins two larger parts is kept."""
    parts = narrow_parts(triangles, False, scale)
    small = parts.area < LEAST_PART * (scale * parts.h) ** 2
    # A cape has one root: the sides to other land are one polyline.
    t, k = np.nonzero(parts.rim)
    part, corners = parts.part[t], triangles.corners[parts.row[t]]
    ends = [keys_of(np.column_stack([part, corners[np.arange(len(t)), (k + i) % 3]])) for i in (1, 2)]
    nodes, index = np.unique(ends, return_inverse=True)
    begin, end = index.reshape(2, -1)
    graph = scipy.sparse.coo_array((np.ones(len(t)), (begin, end)), (len(nodes), len(nodes)))
    count, root = scipy.sparse.csgraph.connected_components(graph, directed=False)
    part_of_root = np.zeros(count, np.int64)
    part_of_root[root] = nodes >> 32
    capes = ~small & (np.bincount(part_of_root, minlength=parts.count) == 1)
    capes &= parts.extents(capes) <= parts.h
    return small_islands(triangles) | parts.chosen(capes)
