"""Find the cells that contain points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy
import shapely

if TYPE_CHECKING:
    from .diagram import Diagram


def power_tree(diagram: Diagram, places: np.ndarray, periods: np.ndarray) -> scipy.spatial.KDTree:
    """Return a search tree of the generators at `places` (n, d); 0 in `periods` stands for walls.

    In a power diagram a further coordinate is sqrt(max w - w_i): the square of the distance from a point with 0 there
    is |y - x_i|^2 - w_i + max w (Aurenhammer 1987). `lifted` adds the coordinate to points.
    """
    if not diagram.is_power:
        return scipy.spatial.KDTree(places, boxsize=periods)
    heights = np.sqrt(diagram.weights.max() - diagram.weights)
    return scipy.spatial.KDTree(np.column_stack([places, heights]), boxsize=np.append(periods, 0.0))


def lifted(diagram: Diagram, places: np.ndarray) -> np.ndarray:
    """Return `places` (k, d) as a tree of `power_tree` takes them."""
    return np.pad(places, ((0, 0), (0, 1))) if diagram.is_power else places


class Locator:
    """Finds the cells that hold points.

    In a box the cell is that of the nearest generator, by the power distance, also across seams. In a polygonal domain
    the boundary cuts cells off, so the point may be in the cell of another generator. There the shape of the cell
    decides.
    """

    def __init__(self, diagram: Diagram) -> None:
        self.diagram, self.domain = diagram, diagram.domain
        self.origin = np.array(self.domain.lower)
        periods = np.where(self.domain.periodic, self.domain.extent, 0.0)
        self.last = np.where(periods > 0, np.nextafter(periods, 0), np.inf)
        self.tree = power_tree(diagram, self._place(diagram.points), periods)

    def _place(self, points: np.ndarray) -> np.ndarray:
        """Return positions relative to the lower corner, in periodic directions within one period."""
        return np.minimum(self.domain.wrap(points) - self.origin, self.last)

    def find(self, points: object) -> np.ndarray:
        """Return the cell that holds each of `points` (k, d), (k,) int32; -1 outside."""
        x = self.domain.check_rows("points", points)
        found = np.full(len(x), -1, np.int32)
        inside = np.flatnonzero(self.domain.contains(x))
        x = x[inside]
        if not len(x):
            return found
        found[inside] = self.tree.query(lifted(self.diagram, self._place(x)))[1]
        if self.domain.cuts_cells:
            found[inside] = self._corrected(x, found[inside])
        return found

    def _corrected(self, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the cells whose shape holds the points `x`, of which the nearest generators are those of `cells`."""
        shapes = self.diagram.to_shapely()
        rest = np.flatnonzero(~shapely.intersects_xy(shapes[cells], x[:, 0], x[:, 1]))
        if rest.size:
            places = shapely.points(x[rest])
            # Between two shapes there may be a gap as wide as round-off. There the nearest shape counts.
            row, cell = shapely.STRtree(shapes).query_nearest(places, all_matches=False)
            cells = cells.copy()
            cells[rest[row]] = cell
        return cells
