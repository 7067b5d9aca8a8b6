"""Triangles in space: distances to them, and which pairs intersect. All functions work row by row on arrays."""

from __future__ import annotations

import numpy as np

_TOUCH = 1e-9  # of the size of a pair: a smaller overlap counts as contact


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...k,...k->...", a, b)


def segment_distance2(x: np.ndarray, begin: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the squared distances of points to segments ``begin + t vector``, row by row."""
    length2 = _dot(vector, vector)
    v = x - begin
    t = np.divide(_dot(v, vector), length2, out=np.zeros(len(v)), where=length2 > 0)
    v = v - np.clip(t, 0, 1)[:, None] * vector
    return _dot(v, v)


def triangle_distance2(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the squared distances of points (m, 3) to triangles (m, 3, 3), row by row.

    The distance is that to the plane if the foot of the perpendicular is in the triangle, that is, if
    n . (side x (x - corner)) >= 0 for all three sides. Otherwise it is that to the nearest side.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    area2 = _dot(normal, normal)
    inside = area2 > 0
    best2 = np.full(len(x), np.inf)
    for k in range(3):
        best2 = np.minimum(best2, segment_distance2(x, corners[:, k], sides[:, k]))
        inside &= _dot(np.cross(sides[:, k], x - corners[:, k]), normal) >= 0
    height = _dot(x - corners[:, 0], normal) ** 2
    return np.where(inside, height / np.where(inside, area2, 1), best2)


def closest_on_triangle(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the weights (m, 3) of the corners in the point of each triangle (m, 3, 3) nearest to each point x (m, 3).

    A weight is exactly 0 where that point lies on the opposite side.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    area2 = _dot(normal, normal)
    weights = np.zeros((len(x), 3))
    inside = area2 > 0
    for k in range(3):
        part = _dot(np.cross(sides[:, k], x - corners[:, k]), normal)
        weights[:, (k + 2) % 3] = part / np.where(area2 > 0, area2, 1)
        inside &= part >= 0
    best2 = np.where(inside, -1.0, np.inf)
    for k in range(3):
        v, side = x - corners[:, k], sides[:, k]
        length2 = _dot(side, side)
        t = np.clip(np.divide(_dot(v, side), length2, out=np.zeros(len(x)), where=length2 > 0), 0, 1)
        v = v - t[:, None] * side
        d2 = _dot(v, v)
        closer = d2 < best2
        best2 = np.where(closer, d2, best2)
        weights[closer, k], weights[closer, (k + 1) % 3], weights[closer, (k + 2) % 3] = 1 - t[closer], t[closer], 0
    return weights


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

    def separated(axis: np.ndarray) -> np.ndarray:
        projection_a, projection_b = _dot(a, axis[:, None]), _dot(b, axis[:, None])
        # Distances by which one projection must move to leave the other at its upper and lower end.
        up = projection_a.max(axis=1) - projection_b.min(axis=1)
        down = projection_b.max(axis=1) - projection_a.min(axis=1)
        return (np.minimum(up, down) <= touch) & axis.any(axis=1)

    longest_a, longest_b = (np.sqrt(_dot(s, s).max(axis=1)) for s in (sides_a, sides_b))
    n_a, n_b = unit(normal_a, longest_a**2), unit(normal_b, longest_b**2)
    # A triangle without area intersects nothing.
    apart = ~(n_a.any(axis=1) & n_b.any(axis=1))
    flat = np.abs(_dot(b, n_a[:, None])).max(axis=1) <= touch
    solid = separated(n_a) | separated(n_b)
    for k in range(3):
        for m in range(3):
            product = np.cross(sides_a[:, k], sides_b[:, m])
            solid |= separated(unit(product, longest_a * longest_b))
    plane = np.zeros(len(a), bool)
    for k in range(3):
        plane |= separated(unit(np.cross(n_a, sides_a[:, k]), 0 * longest_a))
        plane |= separated(unit(np.cross(n_a, sides_b[:, k]), 0 * longest_b))
    return ~apart & ~np.where(flat, plane, solid)
