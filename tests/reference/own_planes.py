"""The planes that cut the cells of generators near walls of solids, patch by patch in NumPy."""

from types import SimpleNamespace

import numpy as np

from clvoro.geometry.solid.creases import CONCAVE
from clvoro.geometry.triangles import pierced


def own_planes(solid, x, reach):
    """Return the planes at the feet of generators x (n, 3) on all patches within `reach` (n,), and who is behind one.

    A patch whose foot lies on a concave crease gives none; nor does one that other walls hide, or that is seen from
    behind.
    """
    found = []
    for k, part in enumerate(solid._patches):
        feet = part.feet(x, float(reach.max()))
        for i in np.flatnonzero(feet.distance <= reach):
            weights, triangle = feet.weights[i], feet.triangle[i]
            normal = weights @ solid.corner_normals[triangle]
            found.append((i, k, feet.point[i], normal / np.linalg.norm(normal), feet.distance[i]))
            found[-1] += (kind_of_foot(solid, triangle, weights),)
    row, patch, foot, normal, distance, kind = map(np.array, zip(*sorted(found, key=lambda f: f[:2]), strict=True))
    depth = ((foot - x[row]) * normal).sum(axis=1)
    first = np.full(len(x), np.inf)
    np.minimum.at(first, row, distance)
    nearest = distance == first[row]
    behind = np.unique(row[nearest & (depth <= 0) & (kind < CONCAVE)])
    sound = (depth > 0) & (kind < CONCAVE)
    for p in np.flatnonzero(sound & ~nearest):
        sound[p] = is_visible(solid, x[row[p]], foot[p])
    return SimpleNamespace(row=row[sound], patch=patch[sound], normal=normal[sound], depth=depth[sound], behind=behind)


def kind_of_foot(solid, triangle, weights):
    """Return the kind of the crease that a foot lies on; 0 inside of a triangle."""
    zero = np.flatnonzero(weights <= 1e-9)
    if len(zero) == 1:
        return solid.side_kinds[triangle, (zero[0] + 1) % 3]
    return solid.corner_kinds[triangle, np.argmax(weights)] if len(zero) == 2 else 0


def is_visible(solid, point, foot):
    """Return whether no triangle is between a point and its foot."""
    end = point + (1 - 1e-6) * (foot - point)
    corners = solid.surface.corners
    begins, ends = (np.broadcast_to(y, (len(corners), 3)) for y in (point, end))
    return not np.isfinite(pierced(begins, ends, corners)).any()
