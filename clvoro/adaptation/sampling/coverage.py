"""The part of each box of a tree that is inside the domain, and points there."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product

import numpy as np
import shapely

from ...geometry.domain import Domain
from ...geometry.polygon import Polygon
from .box_tree import BoxTree

_LEAST = 1e-12  # share of a box below which it counts as outside
_SLIVER = 1e-9  # share of a box that may be outside if it counts as inside
_MOST_ROOTS = 1 << 16  # boxes among which a first one inside of a solid is sought
_COLLECTION = 7  # shapely's number of a GeometryCollection
_PLAIN_TRIES = 20  # draws in a cut box before they are moved towards its inner point


@lru_cache
def gauss_rule(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (3^d, d) in [0, 1] and weights of the product Gauss rule of degree 5."""
    far = math.sqrt(0.6)
    nodes = np.array(list(product((-far, 0.0, far), repeat=dim)))
    weight = np.prod(np.where(nodes == 0, 4 / 9, 5 / 18), axis=1)
    return 0.5 + 0.5 * nodes, weight


class FullCoverage:
    """Boxes that are inside the domain, such as those of a tree over a box.

    - `boxes`: changed by `split`.
    """

    correction: np.ndarray | float = 1.0
    """By what the last split has changed the shares of the boxes that it split, (c,): 1 if they are exact."""
    filling: float = 1.0
    """Share of the first boxes that must be inside: half of them in a solid, where boxes at walls take long."""

    def __init__(self, boxes: BoxTree):
        self.boxes = boxes

    @property
    def occupied(self) -> np.ndarray:
        """Return for each box whether a part of it is inside the domain, (m,) bool."""
        return np.ones(len(self.boxes), bool)

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; see `BoxTree.split`."""
        return self.boxes.split(chosen)

    def balance(self) -> float:
        """Return the measure of the domain in units of that of all shares."""
        return 1.0

    def scale_by_share(self, values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `values` (c, ...) of the boxes where `chosen` is true times their share inside the domain."""
        return values

    def move_inside(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `points` (c, p, d), centers or those of `gauss_rule`, with those outside the domain moved inside."""
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

    - `share` (m,) float: share of each box's measure inside the domain; exactly 0 or 1 up to slivers.
    - `inner` (m, d) float: a point in the part of the box inside the domain, for cut boxes.
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
        return self.domain.covers(points)

    def _nearer(self, x: np.ndarray, box: np.ndarray, cut: np.ndarray, attempt: int) -> None:
        """Move those points of `x` (n, d) in `cut` boxes towards the inner points, after many attempts."""
        share = 0.5 ** max(0, attempt - _PLAIN_TRIES)
        if share < 1:
            inner = self.inner[box[cut]]
            x[cut] = inner + share * (x[cut] - inner)


class SolidCoverage(CutCoverage):
    """Boxes over a domain in space, whose shares inside are measured at the points of `gauss_rule`.

    The shares of the parts of a box are scaled so that their sum is that of the box, and those of all boxes to the
    measure of the domain. Boxes that the surface does not meet are examined no more.

    - `share` (m,) float: share of each box's volume inside the domain.
    - `inner` (m, d) float: a point inside the domain and the box, for cut boxes with a share.
    """

    filling = 0.5

    def __init__(self, boxes: BoxTree, domain: Domain):
        super().__init__(boxes, domain)
        m, dim = len(boxes), boxes.dim
        self._at, self._weight = gauss_rule(dim)
        while True:
            self.share, self.inner, self._cut = np.zeros(m), np.zeros((m, dim)), np.ones(m, bool)
            self._inside = np.zeros(m, np.uint32)  # a bit for each sample
            self._examine(np.arange(m))
            if self.share.sum() > 0 or m >= _MOST_ROOTS:
                break
            self.boxes.split(np.ones(m, bool))  # a thin solid in a large box
            m = len(boxes)
        volumes = boxes.volumes()
        self._conserve(np.flatnonzero(self._cut), np.zeros(m, np.int64), np.array([domain.measure]), volumes)

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split the boxes where `chosen` (m,) is true; see `BoxTree.split`."""
        parent, child = self.boxes.split(chosen)
        before, one = self.share, np.ones(len(parent))
        self.share, self.inner, self._cut = self.share[parent], self.inner[parent], self._cut[parent]
        self._inside = self._inside[parent]
        rows = np.flatnonzero((child >= 0) & self._cut & (self.share > 0))
        if rows.size:
            self._examine(rows)
            family = parent[rows]
            count = np.bincount(family, minlength=len(before))
            self._conserve(rows[self._cut[rows]], parent, before * count, one)
        after = np.bincount(parent, self.share, len(before)) / np.bincount(parent, one, len(before))
        self.correction = np.divide(after, before, out=np.ones(len(before)), where=before > 0)[chosen]
        return parent, child

    def _conserve(self, cut: np.ndarray, family: np.ndarray, wanted: np.ndarray, volume: np.ndarray) -> None:
        """Change the shares of the cut boxes so that the volumes of each family sum up to `wanted`, if they can.

        - `cut`: (c,) int
        - `family` (m,) int: of each box.
        - `wanted`: (f,) float
        - `volume` (m,) float: of each box.
        """
        part = volume[cut] * self.share[cut]
        kin = family[cut]
        has = np.bincount(kin, part, len(wanted))
        room = np.bincount(kin, np.where(part > 0, volume[cut] - part, 0), len(wanted))
        whole = np.bincount(family, volume * self.share, len(wanted)) - has
        lacks = wanted - whole - has
        with np.errstate(divide="ignore", invalid="ignore"):
            more = np.where(room > 0, np.clip(lacks / room, 0, 1), 0)[kin]
            less = np.where(has > 0, np.clip(-lacks / has, 0, 0.99), 0)[kin]
        share = self.share[cut]
        self.share[cut] = np.where(share > 0, share + more * (1 - share) - less * share, 0)

    def _examine(self, rows: np.ndarray) -> None:
        """Find the shares and inner points of the boxes `rows`."""
        corners = self.boxes.points(np.array([[0.0] * self.boxes.dim, [1.0] * self.boxes.dim]), rows)
        cut = self.domain.meets_wall(corners[:, 0], corners[:, 1])
        self._cut[rows] = cut
        center = corners.mean(axis=1)
        self.share[rows[~cut]] = self.domain.covers(center[~cut])
        self.inner[rows] = center
        rows, corners, center = rows[cut], corners[cut], center[cut]
        if not rows.size:
            return
        at, shape = self._at, (len(rows), len(self._at))
        x = self.boxes.points(at, rows)
        inside = self.domain.covers(x.reshape(-1, self.boxes.dim)).reshape(shape)
        self._inside[rows] = inside @ (1 << np.arange(len(at)))
        self.share[rows] = inside @ self._weight
        first = np.argsort(np.abs(at - 0.5).max(axis=1), kind="stable")  # samples near the center are preferred
        best = first[inside[:, first].argmax(axis=1)]
        good = np.asarray(inside.any(axis=1))
        self.inner[rows[good]] = x[np.arange(len(rows)), best][good]
        # A part thinner than the distance of samples, or one on the surface: a point just inside of it.
        depth = 1e-3 * (corners[:, 1] - corners[:, 0]).min(axis=1)
        good[good] = self.domain.contains_well(self.inner[rows[good]], 1e-6 * depth.min())
        thin = np.flatnonzero(~good)
        found = self.domain.just_inside(self.inner[rows[thin]], depth[thin])
        there = ((found > corners[thin, 0]) & (found < corners[thin, 1])).all(axis=1)
        there &= self.domain.contains_well(found, 1e-6 * depth.min())
        self.inner[rows[thin[there]]] = found[there]
        self.share[rows[thin]] = np.where(there, np.maximum(self.share[rows[thin]], 0.25 / len(at)), 0)

    def balance(self) -> float:
        """Return the measure of the domain in units of that of all shares."""
        return self.domain.measure / float((self.share * self.boxes.volumes()).sum())

    def move_inside(self, points: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Return `points` (c, p, d), with those outside the domain replaced by the inner point of their box."""
        cut, p = np.flatnonzero(self._cut[chosen]), points.shape[1]
        sample = np.arange(p) if p > 1 else len(self._at) // 2
        out = (self._inside[chosen][cut, None] >> sample & 1) == 0
        points = points.copy()
        points[cut] = np.where(out[:, :, None], self.inner[chosen][cut][:, None, :], points[cut])
        return points

    def draw(self, at: np.ndarray, box: np.ndarray, attempt: int) -> np.ndarray:
        """Return the points at relative positions `at` (n, d) in [0, 1] in the boxes `box` (n,).

        After many attempts those in cut boxes approach its inner point.
        """
        x = super().draw(at, box, attempt)
        self._nearer(x, box, np.flatnonzero(self._cut[box]), attempt)
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
    if domain.curved_walls:
        return SolidCoverage(boxes, domain)
    return FullCoverage(boxes) if domain.outline is None else PolygonCoverage(boxes, domain.outline)
