"""Triangles in space, many at once: distances, and whether two of them cross."""

from __future__ import annotations

import numpy as np

# Pairs overlap if nothing separates them to this part of their size.
_TOUCH = 1e-9


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

    The nearest of the three sides, or the plane where the foot of the perpendicular is inside: on
    the inner side of all three sides, n . (side x (x - corner)) >= 0.
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


def crossing(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Tell for pairs of triangles a, b (m, 3, 3) whether their interiors meet, (m,) bool.

    Two convex figures are apart, or only touch, if along one of a few directions their shadows
    are: the two normals and the nine products of a side of each; for two triangles in one plane the
    six normals of sides in it. "Only touch" means an overlap below 1e-9 of their size, so triangles
    that share a corner or a side do not cross, unless one is folded onto the other.
    """
    origin = a[:, :1]
    a, b = a - origin, b - origin
    size = np.maximum(np.abs(a).max(axis=(1, 2)), np.abs(b).max(axis=(1, 2)))
    touch = _TOUCH * size
    sides_a, sides_b = (np.roll(t, -1, axis=1) - t for t in (a, b))
    normal_a, normal_b = (np.cross(s[:, 0], s[:, 1]) for s in (sides_a, sides_b))

    def unit(axis: np.ndarray, scale: np.ndarray) -> np.ndarray:
        length = np.sqrt(_dot(axis, axis))
        # A product of parallel sides is no direction: 0 separates nothing, and is left out.
        sound = length > 1e-7 * scale
        return np.where(sound[:, None], axis / np.where(sound, length, 1)[:, None], 0)

    def separated(axis: np.ndarray) -> np.ndarray:
        shadow_a, shadow_b = _dot(a, axis[:, None]), _dot(b, axis[:, None])
        # How far one shadow would have to move to leave the other on either side.
        up = shadow_a.max(axis=1) - shadow_b.min(axis=1)
        down = shadow_b.max(axis=1) - shadow_a.min(axis=1)
        return (np.minimum(up, down) <= touch) & axis.any(axis=1)

    longest_a, longest_b = (np.sqrt(_dot(s, s).max(axis=1)) for s in (sides_a, sides_b))
    n_a, n_b = unit(normal_a, longest_a**2), unit(normal_b, longest_b**2)
    # A triangle without area crosses nothing.
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
