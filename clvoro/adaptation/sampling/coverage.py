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
_SIDE = 3  # points along each edge of a box that a surface cuts
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


class CutCoverage(FullCoverage):
    """Boxes that the boundary of a domain cuts.

    Attributes
    ----------
    share : (m,) float
        Share of each box's measure inside the domain; exactly 0 or 1 up to slivers.
    inner : (m, d) float
        A point in the part of the box inside the domain, for cut boxes.
    """

    def __init__(self, boxes: BoxTree, domain: Domain):
        super().__init__(boxes)
        self.domain = domain
        m = len(boxes)
        self.share, self.inner = np.ones(m), np.zeros((m, boxes.dim))

    @property
    def occupied(self) -> np.ndarray:
        """Return for each box whether a part of it is inside the domain, (m,) bool."""
        return self.share > 0

    def scale_by_share(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share inside the domain."""
        return values * self.share[chosen]

    def move_inside(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `points` (c, p, d), with those outside the domain replaced by the inner point of their box."""
        share = self.share[chosen]
        cut = np.flatnonzero((share > 0) & (share < 1))
        mine = points[cut]
        out = ~self.contains(mine.reshape(-1, mine.shape[2])).reshape(mine.shape[:2])
        points = points.copy()
        points[cut] = np.where(out[:, :, None], self.inner[chosen][cut][:, None, :], mine)
        return points

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) in the boxes whether it is inside the domain, (n,) bool."""
        return self.domain.contains(points)

    def _nearer(self, x: np.ndarray, box: np.ndarray, cut: np.ndarray, attempt: int) -> None:
        """Move those points of `x` (n, d) in `cut` boxes towards the inner points, after many attempts."""
        share = 0.5 ** max(0, attempt - _PLAIN_TRIES)
        if share < 1:
            inner = self.inner[box[cut]]
            x[cut] = inner + share * (x[cut] - inner)


class SolidCoverage(CutCoverage):
    """Boxes over a solid, cut by its surface. Shares are those of a grid of points, scaled to the volume of the solid.

    Parameters
    ----------
    boxes : BoxTree
    domain : Domain
        One with `wall_triangles`.
    """

    def __init__(self, boxes: BoxTree, domain: Domain):
        super().__init__(boxes, domain)
        self._sample(np.arange(len(boxes)))

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; see `BoxTree.split`."""
        parent, child = self.boxes.split(chosen)
        self.share, self.inner = self.share[parent], self.inner[parent]
        self._sample(np.flatnonzero((child >= 0) & (self.share > 0) & (self.share < 1)))
        return parent, child

    def _sample(self, rows: np.ndarray) -> None:
        """Find the shares of the boxes `rows`."""
        middle = self.boxes.points(np.full((1, 3), 0.5), rows)[:, 0]
        reach = np.linalg.norm(self.boxes.edges(rows), axis=1) / 2
        cut = self.domain.boundary_distance(middle) <= reach
        self.share[rows[~cut]] = self.contains(middle[~cut])
        at = (np.stack(np.meshgrid(*[np.arange(_SIDE)] * 3), axis=-1).reshape(-1, 3) + 0.5) / _SIDE
        points = self.boxes.points(at, rows[cut])
        inside = self.contains(points.reshape(-1, 3)).reshape(points.shape[:2])
        # A box with all points inside is cut nevertheless.
        self.share[rows[cut]] = np.minimum(inside.mean(axis=1), 1 - _SLIVER)
        self.inner[rows[cut]] = points[np.arange(len(points)), inside.argmax(axis=1)]
        volumes = self.boxes.volumes()
        part = (self.share > 0) & (self.share < 1)
        whole, parts = volumes[self.share == 1].sum(), (volumes * self.share)[part].sum()
        if parts > 0:
            self.share[part] *= max(self.domain.measure - whole, 0.1 * parts) / parts

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return the points at relative positions `at` (n, 3) in the boxes `box` (n,); see `FullCoverage.draw`."""
        x = super().draw(at, box, attempt)
        self._nearer(x, box, np.flatnonzero(self.share[box] != 1), attempt)
        return x


class PolygonCoverage(CutCoverage):
    """Boxes over a polygonal domain, cut by its boundary.

    The part of a box is cut from the part of its parent, so that the time depends on the edges near the box only.
    """

    def __init__(self, boxes: BoxTree, domain: Polygon):
        super().__init__(boxes, domain)
        self.domain: Polygon = domain
        m = len(boxes)
        self._parts = np.full(m, None, object)
        self._cut(np.full(m, domain.geometry), np.arange(m))

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
            self._nearer(x, box, cut, attempt)
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
    if domain.wall_triangles is not None:
        return SolidCoverage(boxes, domain)
    return FullCoverage(boxes) if domain.outline is None else PolygonCoverage(boxes, domain.outline)
