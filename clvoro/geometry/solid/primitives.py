"""Surfaces of simple solids, with their names."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy
import shapely

from ...arguments import check_number, check_rows
from ...errors import InputError
from ..polygon import Polygon
from ..surface import Surface, box_surface
from ..triangles import NamedTriangles

_FINE = 16  # edges of triangles per radius


def box(lower: Sequence[float], upper: Sequence[float]) -> NamedTriangles:
    """Return the surface of a box, with its sides as groups."""
    _require("box", None, lower, upper)
    if not (np.asarray(lower) < np.asarray(upper)).all():
        raise InputError(f"Solid.box got lower {lower} and upper {upper}, expected lower < upper in each direction")
    surface = box_surface(np.asarray(lower, float), np.asarray(upper, float))
    triangles = surface.triangles.reshape(6, 2, 3)[[4, 5, 2, 3, 0, 1]].reshape(-1, 3)
    sides = tuple(f"{axis}{end}" for axis in "xyz" for end in ("Min", "Max"))
    return NamedTriangles(surface.vertices, triangles, np.repeat(np.arange(6), 2), sides)


def _require(shape: str, edge: float | None, *points: Sequence[float], **sizes: float) -> None:
    """Raise InputError or InputTypeError unless sizes are positive, and points of three finite numbers that differ."""
    for name, value in {**sizes, **({} if edge is None else {"edge": edge})}.items():
        check_number(f"Solid.{shape} {name}", value, above=0)
    rows = [check_rows(f"points of Solid.{shape}", [point], 3)[0] for point in points]
    if not np.isfinite(rows).all() or (len(rows) == 2 and (rows[0] == rows[1]).all()):
        raise InputError(f"Solid.{shape} got the points {points}, expected finite numbers, and ends that differ")


def ball(center: Sequence[float], radius: float, edge: float | None) -> NamedTriangles:
    """Return a sphere: an icosahedron whose sides are divided into squares of n triangles each."""
    _require("ball", edge, center, radius=radius)
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
    return NamedTriangles(vertices, same.reshape(-1)[triangles])


def placed(begin: Sequence[float], end: Sequence[float], flat: np.ndarray) -> np.ndarray:
    """Return points (n, 3), given in axes of which the third leads from `begin` to `end`, in the axes of space."""
    along = np.subtract(end, begin).astype(float)
    along = along / np.linalg.norm(along)
    least = np.eye(3)[np.abs(along).argmin()]
    u = np.cross(least, along)
    u /= np.linalg.norm(u)
    return np.asarray(begin, float) + flat @ np.stack([u, np.cross(along, u), along])


def cylinder(begin: Sequence[float], end: Sequence[float], radius: float, edge: float | None) -> NamedTriangles:
    """Return a cylinder around the axis from `begin` to `end`, with the groups side, bottom and top."""
    _require("cylinder", edge, begin, end, radius=radius)
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
    groups = np.repeat([0, 1, 2], [len(side), n, n])
    triangles = np.concatenate([side, bottom, top])
    return NamedTriangles(placed(begin, end, flat), triangles, groups, ("side", "bottom", "top"))


def turned(profile: Sequence[Sequence[float]], edge: float | None) -> NamedTriangles:
    """Return what a closed profile of points (radius, height) sweeps around the z axis.

    Each edge of the profile is a group, numbered from 0; edges on the axis have no surface.
    """
    points = np.asarray(profile, float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3 or not np.isfinite(points).all():
        raise InputError(f"Solid.turned got a profile of shape {points.shape}, expected (m, 2) finite numbers, m >= 3")
    if (points[:, 0] < 0).any():
        raise InputError(f"Solid.turned got the radius {points[:, 0].min():g}, expected none below 0: (radius, height)")
    following = np.roll(points, -1, axis=0)
    turn = (points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]).sum()
    order = range(len(points)) if turn > 0 else range(len(points) - 1, -1, -1)
    largest = points[:, 0].max()
    n = max(12, math.ceil(2 * math.pi * largest / (largest / _FINE if edge is None else edge)))
    angle = 2 * math.pi * np.arange(n) / n
    radius, height = points[:, 0, None], np.broadcast_to(points[:, 1, None], (len(points), n))
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    k = np.arange(n)
    after = (k + 1) % n
    triangles, groups = [], []
    for i in order:
        j = (i + (1 if turn > 0 else -1)) % len(points)
        a, b = n * i, n * j
        if points[i, 0] > 0:
            triangles.append(np.column_stack([a + k, a + after, b + after]))
        if points[j, 0] > 0:
            triangles.append(np.column_stack([a + k, b + after, b + k]))
        new = int(points[i, 0] > 0) + int(points[j, 0] > 0)
        groups.append(np.full(new * n, i if turn > 0 else j))
    names = tuple(f"edge-{i}" for i in range(len(points)))
    vertices[np.repeat(points[:, 0] == 0, n), :2] = 0
    return NamedTriangles(vertices, np.concatenate(triangles), np.concatenate(groups), names)


def cone(begin: Sequence[float], end: Sequence[float], radius: float, edge: float | None) -> NamedTriangles:
    """Return a cone with the base around `begin` and the tip `end`, with the groups bottom and side."""
    _require("cone", edge, begin, end, radius=radius)
    height = float(np.linalg.norm(np.subtract(end, begin)))
    made = turned([(0, 0), (radius, 0), (0, height)], edge)
    return made._replace(vertices=placed(begin, end, made.vertices), names=("bottom", "side"))


def torus(center: Sequence[float], radius: float, tube: float, edge: float | None) -> NamedTriangles:
    """Return a torus around an axis in z."""
    _require("torus", edge, center, radius=radius, tube=tube)
    n = max(12, math.ceil(2 * math.pi * tube / (tube / _FINE if edge is None else edge)))
    angle = 2 * math.pi * np.arange(n) / n
    profile = np.column_stack([radius + tube * np.cos(angle), tube * np.sin(angle)])
    made = turned(profile.tolist(), tube / _FINE if edge is None else edge)
    return NamedTriangles(made.vertices + np.asarray(center, float), made.triangles)


def extruded(polygon: Polygon, bottom: float, top: float) -> NamedTriangles:
    """Return a polygon with its holes between two heights. The groups are those of the polygon, bottom and top."""
    if not bottom < top:
        raise InputError(f"Solid.extruded got bottom {bottom!r} and top {top!r}, expected bottom < top")
    flat = shapely.get_coordinates(shapely.get_parts(shapely.constrained_delaunay_triangles(polygon.geometry)))
    flat = flat.reshape(-1, 4, 2)[:, :3]
    a, b, c = np.moveaxis(flat, 1, 0)
    clockwise = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    flat[clockwise] = flat[clockwise, ::-1]

    def lifted(points: np.ndarray, z: float) -> np.ndarray:
        return np.concatenate([points, np.full((*points.shape[:-1], 1), z)], axis=-1)

    outline = polygon.oriented
    begin, end, wall = outline.vertices, outline.vertices[outline.next_vertex], outline.edge_numbers
    p, q, r, s = lifted(begin, bottom), lifted(end, bottom), lifted(end, top), lifted(begin, top)
    corners = np.concatenate(
        [lifted(flat[:, ::-1], bottom), lifted(flat, top), np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)]
    )
    names = (*polygon.boundary_names, "bottom", "top")
    part = polygon.boundary_index[wall]
    lids = np.repeat([len(names) - 2, len(names) - 1], len(flat))
    triangles = np.arange(3 * len(corners)).reshape(-1, 3)
    return NamedTriangles(corners.reshape(-1, 3), triangles, np.concatenate([lids, part, part]), names)


def polyhedron(normals: object, offsets: object) -> NamedTriangles:
    """Return the convex polyhedron of the points x with normals . x <= offsets; each half-space is a group."""
    n, d = np.atleast_2d(np.asarray(normals, float)), np.atleast_1d(np.asarray(offsets, float))
    if n.ndim != 2 or n.shape[1] != 3 or d.shape != (len(n),) or not (np.isfinite(n).all() and np.isfinite(d).all()):
        raise InputError(
            f"Solid.polyhedron got normals {n.shape} and offsets {d.shape}, expected (m, 3) and (m,) numbers"
        )
    length = np.linalg.norm(n, axis=1)
    if not length.all():
        raise InputError(f"Solid.polyhedron got normals[{int(length.argmin())}] of length 0, expected a direction")
    n, d = n / length[:, None], d / length
    # The center of the largest ball inside: max r with n . x + r <= d.
    found = scipy.optimize.linprog([0, 0, 0, -1], np.column_stack([n, np.ones(len(n))]), d, bounds=[(None, None)] * 4)
    if found.status != 0 or found.x[3] <= 0:
        raise InputError(
            "Solid.polyhedron got half-spaces whose common part is empty or not bounded; add or move planes"
        )
    points = scipy.spatial.HalfspaceIntersection(np.column_stack([n, -d]), found.x[:3]).intersections
    hull = scipy.spatial.ConvexHull(points)
    group = np.abs(hull.equations[:, :3] @ n.T - 1).argmin(axis=1)
    a, b, c = np.moveaxis(points[hull.simplices], 1, 0)
    flip = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles = np.where(flip[:, None], hull.simplices[:, ::-1], hull.simplices)
    size = float(np.ptp(points, axis=0).max())
    vertices, triangles = Surface(points, triangles, "Solid.polyhedron", 1e-9 * size).welded
    return NamedTriangles(vertices, triangles, group, [f"plane-{k}" for k in range(len(n))])
