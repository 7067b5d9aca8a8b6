"""Which part of each box of a tree lies in the domain, and places there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely

from ...geometry.polygon import Polygon

if TYPE_CHECKING:
    from ...geometry.box import Domain
    from .boxes import Boxes

_LEAST = 1e-12  # share of a box that counts as none
_SLIVER = 1e-9  # share of a box that may be missing from it whole
_COLLECTION = 7  # shapely's number of a GeometryCollection
_PLAIN_TRIES = 20  # draws in a box that is cut, before they are drawn towards its inner point


class Cover:
    """Boxes that lie in the domain wholly, as those of a tree over a box do.

    Parameters
    ----------
    boxes : Boxes
        Followed by `split`.
    """

    def __init__(self, boxes: Boxes):
        self.boxes = boxes

    @property
    def reached(self) -> np.ndarray:
        """Tell for each box whether some of it lies in the domain, (m,) bool."""
        return np.ones(len(self.boxes), bool)

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; returns what `Boxes.split` does."""
        return self.boxes.split(chosen)

    def weigh(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share in the domain."""
        return values

    def keep(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return places (c, p, d) in the chosen boxes with those outside the domain brought inside."""
        return points

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Tell for each of `points` (n, d) in the boxes whether it lies in the domain; (n,) bool."""
        return np.ones(len(points), bool)

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return for relative positions `at` (n, d) in [0, 1] places in the boxes `box` (n,).

        If the place is not in the domain, another attempt with another position may be.
        """
        return self.boxes.points(at[:, None, :], box)[:, 0]

    def sides(self, box: np.ndarray) -> np.ndarray | float:
        """Return the edges of what `draw` draws from, as shares of those of the boxes `box` (n,)."""
        return 1.0


class PolygonCover(Cover):
    """Boxes over a polygonal domain, cut by its boundary.

    What is left of a box is cut out of what was left of its parent, so that each costs the time of the
    edges that are near it.

    Attributes
    ----------
    share : (m,) float
        Of each box's area that lies in the domain; exactly 0 or 1 if all but a sliver is out or in.
    inner : (m, 2) float
        A place in the part of the box that lies in the domain; unused where that is all or nothing.
    """

    def __init__(self, boxes: Boxes, domain: Polygon):
        super().__init__(boxes)
        self.domain = domain
        m = len(boxes)
        self.share, self.inner = np.ones(m), np.zeros((m, 2))
        self._parts = np.full(m, None, object)
        self._cut(np.full(m, domain.geometry), np.arange(m))

    @property
    def reached(self) -> np.ndarray:
        """Tell for each box whether some of it lies in the domain, (m,) bool."""
        return self.share > 0

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; returns what `Boxes.split` does."""
        parent, child = self.boxes.split(chosen)
        self.share, self.inner, self._parts = (
            a[parent] for a in (self.share, self.inner, self._parts)
        )
        rows = np.flatnonzero((child >= 0) & (self.share > 0) & (self.share < 1))
        self._cut(self._parts[rows], rows)
        return parent, child

    def _cut(self, wholes: np.ndarray, rows: np.ndarray) -> None:
        """Cut the boxes `rows` out of `wholes`."""
        corners = self.boxes.points(np.array([[0.0, 0.0], [1.0, 1.0]]), rows)
        edges = corners[:, 1] - corners[:, 0]
        frames = shapely.box(*corners[:, 0].T, *corners[:, 1].T)
        parts = np.asarray(shapely.intersection(wholes, frames), object)
        for i in np.flatnonzero(shapely.get_type_id(parts) == _COLLECTION):
            # Edges and corners that only touch the box.
            parts[i] = shapely.union_all([p for p in parts[i].geoms if p.area > 0])
        share = np.minimum(shapely.area(parts) / edges.prod(axis=1), 1.0)
        # Four corners and nearly all of the area: nothing of it is missing that matters.
        whole = (shapely.get_num_coordinates(parts) == 5) & (share > 1 - _SLIVER)
        share[whole] = 1.0
        share[share < _LEAST] = 0.0
        cut = np.flatnonzero((share > 0) & (share < 1))
        inner = np.zeros((len(rows), 2))
        inner[cut] = shapely.get_coordinates(shapely.point_on_surface(parts[cut]))
        # Slivers so thin that no number lies in them.
        lost = cut[~self.domain.covers(inner[cut])]
        share[lost] = 0.0
        parts[(share == 0) | (share == 1)] = None
        self.share[rows], self.inner[rows], self._parts[rows] = share, inner, parts

    def weigh(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share in the domain."""
        return values * self.share[chosen]

    def keep(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return places (c, p, 2) with those outside the domain replaced by the inner place of their box."""
        share = self.share[chosen]
        cut = np.flatnonzero((share > 0) & (share < 1))
        mine = points[cut]
        out = ~self.domain.covers(mine.reshape(-1, 2)).reshape(mine.shape[:2])
        points = points.copy()
        points[cut] = np.where(out[:, :, None], self.inner[chosen][cut][:, None, :], mine)
        return points

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Tell for each of `points` (n, 2) in the boxes whether it lies in the domain; (n,) bool."""
        return self.domain.covers(points)

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return for relative positions `at` (n, 2) in [0, 1] places in the boxes `box` (n,).

        In a box that is cut they lie in the bounding box of what is left of it; after many attempts nearer and
        nearer to its inner place.
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

    def sides(self, box: np.ndarray) -> np.ndarray:
        """Return the edges (n, 2) of what `draw` draws from, as shares of those of the boxes `box` (n,)."""
        sides = np.ones((len(box), 2))
        cut = np.flatnonzero(self.share[box] < 1)
        if cut.size:
            bounds = shapely.bounds(self._parts[box[cut]])
            sides[cut] = (bounds[:, 2:] - bounds[:, :2]) / self.boxes.edges(box[cut])
        return sides


def cover_of(boxes: Boxes, domain: Domain) -> Cover:
    """Return the cover of `domain` by `boxes`, its roots or what they were split into."""
    return PolygonCover(boxes, domain) if isinstance(domain, Polygon) else Cover(boxes)
