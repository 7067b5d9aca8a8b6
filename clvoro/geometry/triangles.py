"""Triangles in space: distances to them, and which pairs intersect. All functions work row by row on arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

_TOUCH = 1e-9  # of the size of a pair: a smaller overlap counts as contact
_FLAT = 1e-9  # a patch is flat if its mean normal is shorter than 1 by less than this


class NamedTriangles(NamedTuple):
    """Triangles in groups that have names: the first arguments of `clvoro.Solid`, in their order."""

    vertices: np.ndarray
    triangles: np.ndarray
    groups: np.ndarray | None = None
    """Group of each triangle, (t,) int; without it all have the first name."""
    names: Sequence[str] = ("wall",)

    @classmethod
    def merged(cls, parts: Sequence[NamedTriangles]) -> NamedTriangles:
        """Return several as one. Groups of one name become one."""
        names = tuple(dict.fromkeys(name for part in parts for name in part.names))
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        return cls(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.triangles + start for part, start in zip(parts, starts[:-1], strict=True)]),
            np.concatenate([part.numbers(names) for part in parts]),
            names,
        )

    def numbers(self, names: Sequence[str]) -> np.ndarray:
        """Return the place in `names` of the name of each triangle, (t,) int."""
        mine = np.array([names.index(name) for name in self.names])
        return mine[np.zeros(len(self.triangles), np.int64) if self.groups is None else self.groups]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def segment_distance2(x: np.ndarray, begin: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the squared distances of points to segments ``begin + t vector``, row by row."""
    length2 = _dot(vector, vector)
    v = x - begin
    t = np.divide(_dot(v, vector), length2, out=np.zeros(len(v)), where=length2 > 0)
    v = v - np.clip(t, 0, 1)[:, None] * vector
    return _dot(v, v)


def pierced(begin: np.ndarray, end: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return where each segment from `begin` to `end` (m, 3) meets its triangle (m, 3, 3): the share (m,), or inf."""
    along = end - begin
    a, b, c = np.moveaxis(corners - begin[:, None], 1, 0)
    normal = np.cross(b - a, c - a)
    slope = _dot(normal, along)
    share = np.divide(_dot(normal, a), slope, out=np.full(len(begin), np.inf), where=slope != 0)
    sides = np.stack([_dot(along, np.cross(p, q)) for p, q in ((a, b), (b, c), (c, a))])
    meets = ((sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)) & (share >= 0) & (share <= 1)
    return np.where(meets, share, np.inf)


def packed_rows(corners: np.ndarray, real: DTypeLike = np.float64) -> np.ndarray:
    """Return what distances to triangles (t, 3, 3) need, (t, 21).

    A row has a corner a; the sides b - a and c - a; two vectors whose products with x - a are the coordinates s and t
    of x along the sides; the unit normal; and 1 / length^2 of b - a, c - a and c - b, or 0 where that overflows `real`.
    The normal of a triangle thinner than 1e-7 of its length is 0: it counts as its three sides.
    """
    a, side1, side2 = (corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.cross(side1, side2)
    double_area = np.linalg.norm(normal, axis=1)
    length2 = np.column_stack([(v**2).sum(axis=1) for v in (side1, side2, side2 - side1)])
    longest = length2.max(axis=1)
    sound = double_area > 1e-7 * longest
    normal = np.where(sound[:, None], normal / np.where(sound, double_area, 1)[:, None], 0)
    over = np.divide(1, double_area, out=np.zeros_like(double_area), where=sound)[:, None]
    s, t = np.cross(side2, normal) * over, np.cross(normal, side1) * over
    tiny = 4 * float(np.finfo(real).tiny)
    inverse = np.divide(1, length2, out=np.zeros_like(length2), where=length2 > tiny)
    return np.hstack([a, side1, side2, s, t, normal, inverse])


def packed_weights(x: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where the point of each triangle nearest to each point x (m, 3) is, and the squared distance.

    - `x`: (m, 3) float
    - `rows` (m, 21) float: the triangles, from `packed_rows`.

    Results:
    - `s`, `t` (m,) float: the point is a + s (b - a) + t (c - a). On a side s, t or 1 - s - t is 0 to round-off.
    - `distance2`: (m,) float
    """
    x0, x1, x2 = (x - rows[:, :3]).T

    def along(k: int) -> np.ndarray:
        return x0 * rows[:, k] + x1 * rows[:, k + 1] + x2 * rows[:, k + 2]

    s, t, height = along(9), along(12), along(15)
    outside = np.flatnonzero(~((s >= 0) & (t >= 0) & (s + t <= 1) & rows[:, 15:18].any(axis=1)))
    distance2 = height * height
    if outside.size:
        x0, x1, x2, rows = x0[outside], x1[outside], x2[outside], rows[outside]
        u, v = along(3), along(6)
        sides = (rows[:, 6:9] - rows[:, 3:6]).T
        y0, y1, y2 = x0 - rows[:, 3], x1 - rows[:, 4], x2 - rows[:, 5]
        w = y0 * sides[0] + y1 * sides[1] + y2 * sides[2]
        p, q, r = (np.clip(value * rows[:, 18 + k], 0, 1) for k, value in enumerate((u, v, w)))
        best = np.full(len(outside), np.inf)
        for first, second in ((p, 0 * p), (0 * q, q), (1 - r, r)):
            z = (y - first * rows[:, 3 + k] - second * rows[:, 6 + k] for k, y in enumerate((x0, x1, x2)))
            d2 = sum(part * part for part in z)
            closer = d2 < best
            best = np.where(closer, d2, best)
            s[outside] = np.where(closer, first, s[outside])
            t[outside] = np.where(closer, second, t[outside])
        distance2[outside] = best
    return s, t, distance2


def crossing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return for pairs of triangles a, b (m, 3, 3) whether their interiors intersect, (m,) bool.

    By the separating axis theorem: two triangles do not intersect if their projections onto one of these directions do
    not overlap: the two normals and the nine cross products of one side of each; for triangles in one plane, the six
    normals of their sides in it. An overlap below 1e-9 of their size counts as contact. So triangles that share a
    corner or a side do not intersect, unless one is folded onto the other.
    """
    origin = a[:, :1]
    a, b = a - origin, b - origin
    size = np.maximum(np.abs(a).max(axis=(1, 2)), np.abs(b).max(axis=(1, 2)))
    touch = _TOUCH * size
    sides_a, sides_b = (np.roll(t, -1, axis=1) - t for t in (a, b))
    normal_a, normal_b = (np.cross(s[:, 0], s[:, 1]) for s in (sides_a, sides_b))

    def unit(axis: np.ndarray, scale: np.ndarray) -> np.ndarray:
        length = np.sqrt(_dot(axis, axis))
        # The product of parallel sides is about 0 and has no direction. It separates nothing.
        sound = length > 1e-7 * scale
        return np.where(sound[:, None], axis / np.where(sound, length, 1)[:, None], 0)

    def separated(axis: np.ndarray, rows: np.ndarray) -> np.ndarray:
        projection_a, projection_b = (np.matmul(t[rows], axis[:, :, None])[:, :, 0].T for t in (a, b))
        # Distances by which one projection must move to leave the other at its upper and lower end.
        up = _largest(projection_a) + _largest(-projection_b)
        down = _largest(projection_b) + _largest(-projection_a)
        return (np.minimum(up, down) <= touch[rows]) & axis.any(axis=1)

    longest_a, longest_b = (np.sqrt(_largest(_dot(s, s).T)) for s in (sides_a, sides_b))
    n_a, n_b = unit(normal_a, longest_a**2), unit(normal_b, longest_b**2)
    meet = np.zeros(len(a), bool)
    # A triangle without area intersects nothing.
    rows = np.flatnonzero(n_a.any(axis=1) & n_b.any(axis=1))
    flat = np.abs(_dot(b[rows], n_a[rows, None])).max(axis=1) <= touch[rows]
    plane, solid = rows[flat], rows[~flat]
    # Most neighbors lie on one side of each other's plane: what is separated is examined no more.
    for normal in (n_a, n_b):
        solid = solid[~separated(normal[solid], solid)]
    for k in range(3):
        for m in range(3):
            product = np.cross(sides_a[solid, k], sides_b[solid, m])
            solid = solid[~separated(unit(product, longest_a[solid] * longest_b[solid]), solid)]
    for k in range(3):
        for sides in (sides_a, sides_b):
            across = np.cross(n_a[plane], sides[plane, k])
            plane = plane[~separated(unit(across, 0 * longest_a[plane]), plane)]
    meet[solid] = meet[plane] = True
    return meet


def _largest(rows: np.ndarray) -> np.ndarray:
    """Return the largest of three numbers in each column of (3, m); faster than along a short axis."""
    return np.maximum(np.maximum(rows[0], rows[1]), rows[2])


def areas_of(corners: np.ndarray) -> np.ndarray:
    """Return the areas (t,) of triangles with these corners (t, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def bent_patches(areas: np.ndarray, normals: np.ndarray, patch: np.ndarray, n_patches: int) -> np.ndarray:
    """Return whether the triangles of each patch are in more than one plane, (p,) bool.

    - `areas` (t,), `normals` (t, 3) float, `patch` (t,) int: of the triangles.
    """
    total = [np.bincount(patch, areas * x, n_patches) for x in normals.T]
    return np.linalg.norm(total, axis=0) < (1 - _FLAT) * np.bincount(patch, areas, n_patches)
