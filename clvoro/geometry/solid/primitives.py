"""Surfaces of simple solids, as the arguments of `Solid`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from ..surface import box_surface

_FINE = 16  # edges of triangles per radius


def box(lower: Sequence[float], upper: Sequence[float]) -> dict[str, Any]:
    """Return the surface of a box, with its sides as groups."""
    surface = box_surface(np.asarray(lower, float), np.asarray(upper, float))
    triangles = surface.triangles.reshape(6, 2, 3)[[4, 5, 2, 3, 0, 1]].reshape(-1, 3)
    sides = tuple(f"{axis}{end}" for axis in "xyz" for end in ("Min", "Max"))
    return {
        "vertices": surface.vertices,
        "triangles": triangles,
        "groups": np.repeat(np.arange(6), 2),
        "group_names": sides,
    }


def ball(center: Sequence[float], radius: float, edge: float | None) -> dict[str, Any]:
    """Return a sphere: an icosahedron whose sides are divided into squares of n triangles each."""
    n = max(1, math.ceil((radius / _FINE if edge is None else edge) ** -1 * radius * 1.1))
    golden = (1 + math.sqrt(5)) / 2
    corner = np.array([(s, t * golden, 0) for s in (-1, 1) for t in (-1, 1)])
    corner = np.concatenate([np.roll(corner, k, axis=1) for k in range(3)])

    sides = scipy.spatial.ConvexHull(corner).simplices
    a, b, c = np.moveaxis(corner[sides], 1, 0)
    flip = np.einsum("ij,ij->i", a, np.cross(b, c)) < 0
    sides = np.where(flip[:, None], sides[:, ::-1], sides)
    i, j = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]).T
    at = {(p, q): k for k, (p, q) in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
    cells = [(at[p, q], at[p + 1, q], at[p, q + 1]) for p in range(n) for q in range(n - p)]
    cells += [(at[p + 1, q], at[p + 1, q + 1], at[p, q + 1]) for p in range(n) for q in range(n - 1 - p)]
    weights = np.column_stack([n - i - j, i, j]) / n
    points = np.einsum("mk,skd->smd", weights, corner[sides])
    points /= np.linalg.norm(points, axis=2, keepdims=True)
    triangles = (np.array(cells) + len(weights) * np.arange(len(sides))[:, None, None]).reshape(-1, 3)
    # Points on common sides differ by round-off.
    _, first, same = np.unique(np.round(points.reshape(-1, 3), 9), axis=0, return_index=True, return_inverse=True)
    vertices = np.asarray(center, float) + radius * points.reshape(-1, 3)[first]
    return {"vertices": vertices, "triangles": same.reshape(-1)[triangles], "group_names": ("wall",)}


def turned(begin: Sequence[float], end: Sequence[float], flat: np.ndarray) -> np.ndarray:
    """Return points (n, 3), given in axes of which the third leads from `begin` to `end`, in the axes of space."""
    along = np.subtract(end, begin).astype(float)
    along = along / np.linalg.norm(along)
    least = np.eye(3)[np.abs(along).argmin()]
    u = np.cross(least, along)
    u /= np.linalg.norm(u)
    return np.asarray(begin, float) + flat @ np.stack([u, np.cross(along, u), along])


def cylinder(begin: Sequence[float], end: Sequence[float], radius: float, edge: float | None) -> dict[str, Any]:
    """Return a cylinder around the axis from `begin` to `end`, with the groups side, bottom and top."""
    height = float(np.linalg.norm(np.subtract(end, begin)))
    rise = radius if edge is None else edge
    edge = radius / _FINE if edge is None else edge
    n = max(12, math.ceil(2 * math.pi * radius / edge))
    rows = max(1, round(height / rise))
    turn = 2 * math.pi * np.arange(n) / n
    ring = np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])
    z = height * np.arange(rows + 1) / rows
    wall = np.column_stack([np.tile(ring, (rows + 1, 1)), np.repeat(z, n)])
    flat = np.concatenate([wall, [(0, 0, 0), (0, 0, height)]])
    k = np.arange(n)
    after = (k + 1) % n
    lower = (n * np.arange(rows))[:, None]
    side = np.concatenate(
        [
            np.stack([lower + k, lower + after, lower + n + after], axis=2).reshape(-1, 3),
            np.stack([lower + k, lower + n + after, lower + n + k], axis=2).reshape(-1, 3),
        ]
    )
    bottom = np.column_stack([np.full(n, len(wall)), after, k])
    top = np.column_stack([np.full(n, len(wall) + 1), n * rows + k, n * rows + after])
    return {
        "vertices": turned(begin, end, flat),
        "triangles": np.concatenate([side, bottom, top]),
        "groups": np.repeat([0, 1, 2], [len(side), n, n]),
        "group_names": ("side", "bottom", "top"),
    }
