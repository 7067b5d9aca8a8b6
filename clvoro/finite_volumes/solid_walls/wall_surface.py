"""The surface of a solid as its mesh asks for it: closest points, sides, patches, creases and corners."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ...connectivity import distinct, rows_of, starts_of, take_rows
from ...geometry.bvh import Tree
from ...geometry.triangles import bent_patches
from ...geometry.wall_triangles import TIP_COSINE

if TYPE_CHECKING:
    from ...geometry.solid.solid import Solid

SNAP_CREASE = 0.06
"""Wall vertices this close to a crease, as a share of h, are moved onto it."""
SNAP_CORNER = 0.12
"""The same for corners."""
_AROUND = 0.85
"""Generators nearer to a concave crease than this share of h stay: the faces between their cells meet in it."""
_THIN, _DEEP = 0.7, 0.05
"""A part of a solid is thin if both walls are nearer to a generator than the first share of h. Generators that are less
deep than the second do not count."""
_FEW, _MOST_KEPT = 64, 1 << 19
"""Answers for fewer points at a time are not kept; how many are, at most."""


class WallSurface:
    """Answers of a solid's surface to the mesh.

    A wall vertex lies on a patch, on a crease or on a corner. Its `site` says where: site k is patch k; the edges of
    creases follow, and then the corners.

    - `nearest`: returns the triangle nearest to each of the points (k, 3) within a reach, (k,) or a number; -1 where
      there is none; (k,) int. By default the solid's own search does.
    """

    def __init__(
        self, solid: Solid, nearest: Callable[[np.ndarray, np.ndarray | float], np.ndarray] | None = None
    ) -> None:
        self.solid, self._nearest = solid, nearest
        self.vertices, self.triangles = solid.surface.vertices, solid.surface.triangles
        self.patch = solid.patch
        self.n_patches = solid.n_patches
        self.ends = self.vertices[solid.creases.edges]  # (e, 2, 3)
        self.corners = self.vertices[solid.corners]
        self._kept = list[tuple[np.ndarray, ...]]()
        nothing = np.full((1, 3), np.nan)
        self._known = np.zeros(1, np.int64), nothing, np.zeros(1, np.int64), nothing, np.zeros(1)

    @property
    def first_corner(self) -> int:
        """Site of the first corner."""
        return self.n_patches + len(self.ends)

    @cached_property
    def widths(self) -> np.ndarray:
        """Width of each patch if it is long and narrow, (p,) float: twice its area over the length around it."""
        length = np.repeat(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1), 2)
        around = np.bincount(self.solid.creases.patches.ravel(), length, self.n_patches)
        area = np.bincount(self.patch, self.solid.surface.areas, self.n_patches) * self.solid.extent.max() ** 2
        return 2 * area / np.maximum(around, 1e-300)

    @cached_property
    def bent(self) -> np.ndarray:
        """Whether the triangles of each patch are in more than one plane, (p,) bool."""
        return bent_patches(self.solid.surface.areas, self.solid.normals, self.patch, self.n_patches)

    @cached_property
    def tips(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tips of patches, as those of cones: vertices (k,), their patches, and how far the patch is straight there.

        All triangles at a tip are steep against the patch's normal there.
        """
        x, n = self.triangles, len(self.vertices)
        steep = np.einsum("tkd,td->tk", self.solid.corner_normals, self.solid.normals) < TIP_COSINE
        tips = np.flatnonzero(np.bincount(x[steep], minlength=n) == np.maximum(np.bincount(x.ravel(), minlength=n), 3))
        tips = np.setdiff1d(tips, self.solid.creases.edges)
        lengths = np.linalg.norm(self.vertices[np.roll(x, -1, axis=1)] - self.vertices[x], axis=2)
        straight, patch = np.full(n, np.inf), np.zeros(n, np.int64)
        np.minimum.at(straight, x, np.minimum(lengths, np.roll(lengths, 1, axis=1)))
        patch[x] = self.patch[:, None]
        return tips, patch[tips], straight[tips]

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the closest triangle (k,), the point on it (k, 3), and the distance (k,), negative inside."""
        if len(points) < _FEW:
            return self.solid.closest(points, self._triangles(points))
        key = _keys(points)
        keys, known, *answers = self._known
        row = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        new = np.flatnonzero((keys[row] != key) | (known[row] != points).any(axis=1))
        triangle, foot, distance = (answer[row] for answer in answers)
        if len(new):
            asked = points[new]
            triangle[new], foot[new], distance[new] = self.solid.closest(asked, self._triangles(asked))
        found = triangle, foot, distance
        self._kept += [(points, *found)] if sum(len(x) for x, *_ in self._kept) < _MOST_KEPT else []
        return found

    def recall(self) -> None:
        """Let `closest` take what it has found since the last call from there, and forget what it had found before."""
        if self._kept:
            points, *answers = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
            key = _keys(points)
            order = np.argsort(key)
            self._known = key[order], points[order], *(answer[order] for answer in answers)
            self._kept = []

    def feet(self, points: np.ndarray) -> np.ndarray:
        """Return the closest point of the surface to each of `points` (k, 3), (k, 3)."""
        return self.closest(points)[1]

    def _triangles(self, points: np.ndarray) -> np.ndarray | None:
        return None if self._nearest is None else self._nearest(points, np.inf)

    def touches(self, points: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return for each of `points` (k, 3) whether the surface may lie within `reach` (k,)."""
        if self._nearest is not None:
            return self._nearest(points, reach) >= 0
        found = np.zeros(len(points), bool)
        found[self.solid.surface.tree.within(points, reach)[0]] = True
        return found

    def close_to(self, points: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows of points nearer to the surface than `reach` (n,), their feet on it and signed distances."""
        near = np.flatnonzero(self.touches(points, reach))
        _, foot, distance = self.closest(points[near])
        close = np.abs(distance) < reach[near]
        return near[close], foot[close], distance[close]

    def at_concave_creases(self, points: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return whether each point (n, 3) is close to a concave crease, for cells of the `sizes` (n,); (n,) bool."""
        edge = self.nearest_crease(points, _AROUND * sizes)[0]
        found = edge >= 0
        found[found] = self.solid.creases.concave[edge[found]]
        return found

    def thin_parts(self, points: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the points (n, 3) between two walls that are close, for cells of the `sizes` (n,), not at creases.

        These are their rows (k,), directions away from the nearer wall (k, 3), and distances from it (k,).
        """
        near, foot, distance = self.close_to(points, _THIN * sizes)
        kept = distance < -_DEEP * sizes[near]
        kept &= ~self.at_concave_creases(points[near], sizes[near])
        near, foot, depth = near[kept], foot[kept], -distance[kept]
        across = (points[near] - foot) / depth[:, None]
        thin = self.closest(points[near] + _THIN * sizes[near, None] * across)[2] > 0
        return near[thin], across[thin], depth[thin]

    @cached_property
    def _crease_tree(self) -> Tree:
        return Tree(self.ends.min(axis=1), self.ends.max(axis=1))

    @cached_property
    def _corner_tree(self) -> scipy.spatial.KDTree:
        return scipy.spatial.KDTree(self.corners)

    def nearest_crease(
        self, points: np.ndarray, reach: np.ndarray, between: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest edge of a crease within `reach` (k,), or -1, and the point on it (k, 3).

        `between` are pairs of sites, (k,) each: only creases count that have a patch of each.
        """
        edge, foot = np.full(len(points), -1), points.copy()
        if not len(self.ends) or not len(points):
            return edge, foot
        who, item = self._crease_tree.within(points, reach)
        for site in between or ():
            fits = self.common(self.n_patches + item, site[who])[0] > 0
            who, item = who[fits], item[fits]
        begin, along = self.ends[item, 0], self.ends[item, 1] - self.ends[item, 0]
        share = ((points[who] - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        there = begin + np.clip(share, 0, 1)[:, None] * along
        far = ((points[who] - there) ** 2).sum(axis=1)
        rows = np.flatnonzero(far <= reach[who] ** 2)
        order = rows[np.lexsort((item[rows], far[rows], who[rows]))]
        first = np.unique(who[order], return_index=True)[1]
        edge[who[order[first]]], foot[who[order[first]]] = item[order[first]], there[order[first]]
        return edge, foot

    def sites(
        self, points: np.ndarray, triangles: np.ndarray, h: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sites (k,) of wall vertices at `points` (k, 3) on `triangles`, and where they lie there (k, 3).

        A corner is the site of one vertex only: the nearest. The vertices `free` (k,) are not moved to concave creases
        and to corners.
        """
        site = self.patch[triangles].astype(np.int64)
        edge, foot = self.nearest_crease(points, SNAP_CREASE * h)
        loose = free & (edge >= 0) & self.solid.creases.concave[edge] if len(self.ends) else free
        foot[loose], edge[loose] = points[loose], -1
        site[edge >= 0] = self.n_patches + edge[edge >= 0]
        if len(self.corners) and len(points):
            far, corner = nearest(self._corner_tree, points)
            rows = np.flatnonzero((far <= SNAP_CORNER * h) & ~free)
            rows = rows[np.argsort(far[rows], kind="stable")]
            rows = rows[np.unique(corner[rows], return_index=True)[1]]
            site[rows], foot[rows] = self.first_corner + corner[rows], self.corners[corner[rows]]
        return site, foot

    @cached_property
    def _site_patches(self) -> tuple[np.ndarray, np.ndarray]:
        """Patches of each site, ascending, as ragged rows."""
        place = np.full(len(self.vertices), -1)
        place[self.solid.corners] = np.arange(len(self.corners))
        at, patch = place[self.triangles].ravel(), np.repeat(self.patch, 3)
        pairs = np.unique(np.stack([at[at >= 0], patch[at >= 0]]), axis=1)
        at_corners = np.bincount(pairs[0], minlength=len(self.corners))
        counts = np.concatenate([np.ones(self.n_patches, int), np.full(len(self.ends), 2), at_corners])
        items = [np.arange(self.n_patches), np.sort(self.solid.creases.patches, axis=1).ravel(), pairs[1]]
        return starts_of(counts), np.concatenate(items).astype(np.int64)

    def patches_of(self, site: int) -> list[int]:
        """Return the patches that meet at a site."""
        starts, items = self._site_patches
        return items[starts[site] : starts[site + 1]].tolist()

    def common(self, one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how many patches the sites `one` and `other` (k,) share, and the least of them or -1, (k,) each."""
        size = self.first_corner + len(self.corners)
        keys, place = np.unique(one * size + other, return_inverse=True)
        starts, items = self._site_patches
        starts_a, a = take_rows(starts, items, keys // size)
        starts_b, b = take_rows(starts, items, keys % size)
        rows = np.concatenate([rows_of(s) for s in (starts_a, starts_b)])
        pairs = np.sort(rows * self.n_patches + np.concatenate([a, b]))
        shared = distinct(pairs[:-1][pairs[1:] == pairs[:-1]])
        number, least = np.bincount(shared // self.n_patches, minlength=len(keys)), np.full(len(keys), -1)
        least[(shared // self.n_patches)[::-1]] = (shared % self.n_patches)[::-1]
        return number[place], least[place]


def _keys(points: np.ndarray) -> np.ndarray:
    """Return a number for each of `points` (k, 3) that few others have, (k,) int."""
    bits = np.ascontiguousarray(points, float).view(np.int64)
    return (bits * np.array([-7046029254386353131, -4417276706812531889, 1609587929392839161])).sum(axis=1)


def nearest(tree: scipy.spatial.KDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance to the nearest point of `tree` and its row, (k,) each; none if there are no `points`."""
    if not len(points):
        return np.zeros(0), np.zeros(0, np.int64)
    far, row = tree.query(points)
    return np.asarray(far), np.asarray(row)
