"""Sheets: triangles of which any number may meet at an edge, as smooth patches and the creases between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from ...arguments import format_point
from ...connectivity import starts_of
from ...errors import InputError
from ..bvh import Tree
from ..nearest_triangles import Feet, NearestTriangles, heights_over
from ..solid.creases import connect, corner_normals, find_chains, triangle_normals
from ..surface import Surface
from ..triangles import bent_patches, segment_distance2


@dataclass(frozen=True)
class Sheets:
    """Smooth patches of a surface that may be open and branch, and the chains of edges at which they end.

    - `surface`: triangles of one patch have the same orientation.
    - `patch`: (t,) int
    - `normals`: (t, 3) float
    - `edges` (e, 2) int: edges that are creases, end the surface, or join three patches or more; vertices of the
      surface.
    - `chain` (e,) int: the chain of each edge, ascending; each edge begins where the one before ends.
    - `corners` (c,) int: vertices at which chains meet, end or turn sharply.
    - `triangle_starts`, `triangles_at` (e + 1,) and (k,) int: the triangles at each edge.
    """

    surface: Surface
    patch: np.ndarray
    normals: np.ndarray
    edges: np.ndarray
    chain: np.ndarray
    corners: np.ndarray
    triangle_starts: np.ndarray
    triangles_at: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray, angle: float, name: str) -> Sheets:
        """Divide triangles (t, 3) where they turn by more than `angle` (radians).

        Raises
        ------
        InputError
            If a smooth patch has one side only.
        """
        t = len(triangles)
        ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
        edges, edge = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True)
        edge = edge.reshape(-1)
        count = np.bincount(edge)
        order = np.argsort(edge, kind="stable")
        starts = starts_of(count)
        pair = np.flatnonzero(count == 2)
        one, other = order[starts[pair]], order[starts[pair] + 1]
        twin = np.full(3 * t, -1)
        twin[one], twin[other] = other, one
        normals, _ = triangle_normals(vertices, triangles, twin)
        same = ends[one, 0] == ends[other, 1]
        cosine = np.einsum("ij,ij->i", normals[one // 3], normals[other // 3]) * np.where(same, 1, -1)
        smooth = cosine >= math.cos(angle)
        a, b, same = one[smooth] // 3, other[smooth] // 3, same[smooth]
        patch = connect(t, np.column_stack([a, b]))[1]
        # Each triangle twice, once for each orientation: the two of a surface with two sides are not connected.
        both = np.concatenate([np.column_stack([a, b + t * ~same]), np.column_stack([a + t, b + t * same])])
        side = connect(2 * t, both)[1]
        first = np.unique(patch, return_index=True)[1]
        twisted = np.flatnonzero(side[first] == side[first + t])
        if twisted.size:
            place = vertices[triangles[first[twisted[0]]]].mean(axis=0)
            raise InputError(
                f"{name} has one side only (a Moebius strip), at {format_point(place)}; expected sheets with two sides"
            )
        turned = side[:t] != side[first[patch]]
        triangles = np.where(turned[:, None], triangles[:, ::-1], triangles)
        normals = np.where(turned[:, None], -normals, normals)
        at_end = np.ones(len(edges), bool)
        at_end[pair[smooth]] = False
        rows = np.flatnonzero(at_end)
        lists = [np.sort(order[starts[k] : starts[k + 1]] // 3) for k in rows.tolist()]
        kinds: dict[tuple[int, ...], int] = {}
        kind = np.array([kinds.setdefault(tuple(sorted(patch[items])), len(kinds)) for items in lists], int)
        surface, none = Surface(vertices, triangles, name), np.zeros(0, np.int64)
        if not len(rows):
            return cls(surface, patch, normals, none.reshape(0, 2), none, none, np.zeros(1, int), none)
        corners, along, flipped, chain = find_chains(
            vertices, edges[rows], np.column_stack([kind, kind]), np.zeros(len(rows))
        )
        found, lists = edges[rows][along], [lists[k] for k in along.tolist()]
        found[flipped] = found[flipped, ::-1]
        counts = starts_of([len(items) for items in lists])
        return cls(surface, patch, normals, found, chain, corners, counts, np.concatenate(lists))

    @property
    def n_patches(self) -> int:
        """Number of patches."""
        return int(self.patch.max()) + 1

    @cached_property
    def corner_normals(self) -> np.ndarray:
        """Unit normals of the patches at the triangles' corners, (t, 3, 3)."""
        return corner_normals(self.surface.vertices, self.surface.triangles, self.normals, self.patch)

    @cached_property
    def whole(self) -> NearestTriangles:
        """All triangles, for nearest points."""
        return NearestTriangles(self.surface, np.arange(len(self.patch)))

    @cached_property
    def patches(self) -> list[NearestTriangles]:
        """The triangles of each patch, for nearest points."""
        order = np.argsort(self.patch, kind="stable")
        parts = np.split(order, np.searchsorted(self.patch[order], np.arange(1, self.n_patches)))
        return [NearestTriangles(self.surface, part) for part in parts]

    @cached_property
    def bent(self) -> np.ndarray:
        """Whether the triangles of each patch are in more than one plane, (p,) bool."""
        return bent_patches(self.surface.areas, self.normals, self.patch, self.n_patches)

    def feet(self, points: np.ndarray) -> Feet:
        """Return the nearest points of the surface to `points` (n, 3)."""
        return self.whole.feet(points, math.inf)

    def heights_over(self, corners: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return how high curved patches are over polygons; see `clvoro.geometry.nearest_triangles.heights_over`."""
        normals = np.where(self.bent[self.patch][:, None], self.normals, 0)
        return heights_over(self.feet, normals, corners, starts)

    def normals_at(self, feet: Feet) -> np.ndarray:
        """Return unit normals (n, 3) of the patches at points of them."""
        mean = np.einsum("nk,nkd->nd", feet.weights, self.corner_normals[feet.triangle])
        return mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (n,) of `points` (n, 3)."""
        return self.feet(points).distance

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the surface to each of `points` (n, 3)."""
        return self.feet(points).point

    @cached_property
    def _edge_tree(self) -> Tree:
        ends = self.surface.vertices[self.edges]
        return Tree(ends.min(axis=1), ends.max(axis=1))

    def nearest_on_edges(self, points: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return the nearest point of edges within `reach` (n,) of each of `points` (n, 3); nan where there is none."""
        found, bound2 = np.full(points.shape, np.nan), reach**2
        if not len(self.edges) or not len(points):
            return found
        begin = self.surface.vertices[self.edges[:, 0]]
        along = self.surface.vertices[self.edges[:, 1]] - begin
        _, item = self._edge_tree.nearest(points, bound2, lambda x, k: segment_distance2(x, begin[k], along[k]))
        near = np.flatnonzero(item >= 0)
        x, a, v = points[near], begin[item[near]], along[item[near]]
        share = np.clip(((x - a) * v).sum(axis=1) / (v * v).sum(axis=1), 0, 1)
        found[near] = a + share[:, None] * v
        return found

    def nearest_corner(self, points: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return the corner of the surface within `reach` (n,) of each of `points` (n, 3), or nan."""
        found = np.full(points.shape, np.nan)
        if len(self.corners) and len(points):
            away, row = scipy.spatial.KDTree(self.surface.vertices[self.corners]).query(points)
            found[away < reach] = self.surface.vertices[self.corners[row[away < reach]]]
        return found

    def crossed(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return how often each segment from `begin` to `end` (k, 3) goes through the surface, (k,) int.

        Where it meets an edge or a vertex of triangles, it goes through the surface once.
        """
        number = np.zeros(len(begin), np.int64)
        who, item = self.surface.tree.meeting(np.minimum(begin, end), np.maximum(begin, end))
        share = _pierced(begin[who], end[who], self.surface.corners[item])
        met = np.isfinite(share)
        who, share = who[met], share[met]
        order = np.lexsort((share, who))
        who, share = who[order], share[order]
        new = np.ones(len(who), bool)
        new[1:] = (who[1:] != who[:-1]) | (np.diff(share) > _SAME)
        np.add.at(number, who[new], 1)
        return number


_SAME = 1e-6
"""Places along a segment that differ by less, over its length, are one."""
_EDGE = 1e-9
"""How far beyond the sides of a triangle, over their length, points belong to it."""


def _pierced(begin: np.ndarray, end: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return where each segment meets its triangle (m, 3, 3), sides included: the share (m,), or inf."""
    along = end - begin
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(u, v)
    area2 = np.einsum("ij,ij->i", normal, normal)
    slope = np.einsum("ij,ij->i", normal, along)
    sound = (np.abs(slope) > 1e-12 * np.sqrt(area2) * np.linalg.norm(along, axis=1)) & (area2 > 0)
    share = np.divide(np.einsum("ij,ij->i", normal, a - begin), slope, out=np.full(len(a), np.inf), where=sound)
    x = begin + np.where(sound, share, 0)[:, None] * along - a
    over = np.where(area2 > 0, area2, 1)
    s = np.einsum("ij,ij->i", np.cross(x, v), normal) / over
    t = np.einsum("ij,ij->i", np.cross(u, x), normal) / over
    inside = sound & (s >= -_EDGE) & (t >= -_EDGE) & (s + t <= 1 + _EDGE) & (share >= 0) & (share <= 1)
    return np.where(inside, share, np.inf)
