"""The part of each box of a tree that is inside the domain, and points there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

if TYPE_CHECKING:
    from ...geometry.domain import Domain
    from ...geometry.polygon import Polygon
    from .box_tree import BoxTree

_LEAST = 1e-12  # share of a box below which it counts as outside
_SLIVER = 1e-9  # share of a box that may be outside if it counts as inside
_COLLECTION = 7  # shapely's number of a GeometryCollection
_PLAIN_TRIES = 20  # draws in a cut box before they are moved towards its inner point


class FullCoverage:
    """Boxes that are inside the domain, such as those of a tree over a box.

    Parameters
    ----------
    boxes : BoxTree
        Changed by `split`.
    """

    def __init__(self, boxes: BoxTree):
        self.boxes = boxes

    @property
    def occupied(self) -> np.ndarray:
        """Return for each box whether a part of it is inside the domain, (m,) bool."""
        return np.ones(len(self.boxes), bool)

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; see `BoxTree.split`."""
        return self.boxes.split(chosen)

    def scale_by_share(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share inside the domain."""
        return values

    def move_inside(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `points` (c, p, d) in the chosen boxes, with those outside the domain moved inside."""
        return points

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) in the boxes whether it is inside the domain, (n,) bool."""
        return np.ones(len(points), bool)

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return the points at relative positions `at` (n, d) in [0, 1] in the boxes `box` (n,).

        If a point is not inside the domain, the caller may make another attempt.
        """
        return self.boxes.points(at[:, None, :], box)[:, 0]

    def relative_edges(self, box: np.ndarray) -> np.ndarray | float:
        """Return the edges of the regions that `draw` uses, relative to those of the boxes `box` (n,)."""
        return 1.0


class PolygonCoverage(FullCoverage):
    """Boxes over a polygonal domain, cut by its boundary.

    The part of a box is cut from the part of its parent, so that the time depends on the edges near the box only.

    Attributes
    ----------
    share : (m,) float
        Share of each box's area inside the domain; exactly 0 or 1 up to slivers.
    inner : (m, 2) float
        A point in the part of the box inside the domain, for cut boxes.
    """

    def __init__(self, boxes: BoxTree, domain: Polygon):
        super().__init__(boxes)
        self.domain = domain
        m = len(boxes)
        self.share, self.inner = np.ones(m), np.zeros((m, 2))
        self._parts = np.full(m, None, object)
        self._cut(np.full(m, domain.geometry), np.arange(m))

    @property
    def occupied(self) -> np.ndarray:
        """Return for each box whether a part of it is inside the domain, (m,) bool."""
        return self.share > 0

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; see `BoxTree.split`."""
        parent, child = self.boxes.split(chosen)
        self.share, self.inner, self._parts = (a[parent] for a in (self.share, self.inner, self._parts))
        rows = np.flatnonzero((child >= 0) & (self.share > 0) & (self.share < 1))
        self._cut(self._parts[rows], rows)
        return parent, child

    def _cut(self, wholes: np.ndarray, rows: np.ndarray) -> None:
        """Cut the parts of the boxes `rows` from the regions `wholes`."""
        corners = self.boxes.points(np.array([[0.0, 0.0], [1.0, 1.0]]), rows)
        edges = corners[:, 1] - corners[:, 0]
        frames = shapely.box(*corners[:, 0].T, *corners[:, 1].T)
        parts = np.asarray(shapely.intersection(wholes, frames), object)
        for i in np.flatnonzero(shapely.get_type_id(parts) == _COLLECTION):
            # Without edges and points that only touch the box.
            parts[i] = shapely.union_all([p for p in parts[i].geoms if p.area > 0])
        share = np.minimum(shapely.area(parts) / edges.prod(axis=1), 1.0)
        # Four corners and nearly all of the area: the box counts as inside.
        whole = (shapely.get_num_coordinates(parts) == 5) & (share > 1 - _SLIVER)
        share[whole] = 1.0
        share[share < _LEAST] = 0.0
        cut = np.flatnonzero((share > 0) & (share < 1))
        inner = np.zeros((len(rows), 2))
        inner[cut] = shapely.get_coordinates(shapely.point_on_surface(parts[cut]))
        # Slivers that contain no floating-point number.
        lost = cut[~self.domain.covers(inner[cut])]
        share[lost] = 0.0
        parts[(share == 0) | (share == 1)] = None
        self.share[rows], self.inner[rows], self._parts[rows] = share, inner, parts

    def scale_by_share(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share inside the domain."""
        return values * self.share[chosen]

    def move_inside(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `points` (c, p, 2), with those outside the domain replaced by the inner point of their box."""
        share = self.share[chosen]
        cut = np.flatnonzero((share > 0) & (share < 1))
        mine = points[cut]
        out = ~self.domain.covers(mine.reshape(-1, 2)).reshape(mine.shape[:2])
        points = points.copy()
        points[cut] = np.where(out[:, :, None], self.inner[chosen][cut][:, None, :], mine)
        return points

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) in the boxes whether it is inside the domain, (n,) bool."""
        return self.domain.covers(points)

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return the points at relative positions `at` (n, 2) in [0, 1] in the boxes `box` (n,).

        In a cut box positions are relative to the bounding box of its part. After many attempts they approach its inner
        point.
        """
        x = super().draw(at, box, attempt)
        cut = np.flatnonzero(self.share[box] < 1)
        if cut.size:
            bounds = shapely.bounds(self._parts[box[cut]])
            x[cut] = bounds[:, :2] + at[cut] * (bounds[:, 2:] - bounds[:, :2])
            nearer = 0.5 ** max(0, attempt - _PLAIN_TRIES)
            if nearer < 1:
                inner = self.inner[box[cut]]
                x[cut] = inner + nearer * (x[cut] - inner)
        return x

    def relative_edges(self, box: np.ndarray) -> np.ndarray:
        """Return the edges (n, 2) of the regions that `draw` uses, relative to those of the boxes `box` (n,)."""
        sides = np.ones((len(box), 2))
        cut = np.flatnonzero(self.share[box] < 1)
        if cut.size:
            bounds = shapely.bounds(self._parts[box[cut]])
            sides[cut] = (bounds[:, 2:] - bounds[:, :2]) / self.boxes.edges(box[cut])
        return sides


def coverage_of(boxes: BoxTree, domain: Domain) -> FullCoverage:
    """Return the coverage of `domain` by `boxes`."""
    return FullCoverage(boxes) if domain.outline is None else PolygonCoverage(boxes, domain.outline)
