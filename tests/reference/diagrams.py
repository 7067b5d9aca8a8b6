"""Slow, obvious references for the diagram."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.spatial import Voronoi


@dataclass(frozen=True)
class Cell:
    """Polygon (k, 2) counter-clockwise; face k, from corner k to corner k + 1, belongs to ``neighbors[k]``."""

    polygon: np.ndarray
    neighbors: list[int]
    area: float
    centroid: np.ndarray


def faults(diagram) -> list[str]:
    """Return the faults of a diagram that are found without a reference."""
    return list(map(str, diagram.check().findings))


def measures(polygon: np.ndarray) -> tuple[float, np.ndarray]:
    """Return area and centroid of a polygon (k, 2)."""
    origin = polygon.mean(axis=0)
    a = polygon - origin
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = cross.sum() / 2
    return float(area), origin + (cross[:, None] * (a + b)).sum(axis=0) / (6 * area)


def second_moment(polygon, x):
    """Integral of |y - x|^2 over a polygon: exact over triangles by the middles of their sides."""
    total = 0.0
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        area = ((a - x)[0] * (b - x)[1] - (a - x)[1] * (b - x)[0]) / 2
        middles = np.array([(a + b) / 2, (a + x) / 2, (b + x) / 2])
        total += area / 3 * ((middles - x) ** 2).sum()
    return total


def with_images(lower, upper, points: np.ndarray) -> np.ndarray:
    """Return `points` (n, d) followed by their images in the walls of a box, wall by wall."""
    found = [points]
    for axis in range(points.shape[1]):
        for wall in (lower[axis], upper[axis]):
            image = points.copy()
            image[:, axis] = 2 * wall - image[:, axis]
            found.append(image)
    return np.concatenate(found)


def box_voronoi(lower, upper, points) -> list[Cell]:
    """Voronoi cells of `points` (n, 2) in a box, by Qhull on the points and their images in the four walls.

    A generator's image makes the wall its bisector. Walls are -1 (x lower), -2 (x upper), -3, -4.
    """
    points, n = np.asarray(points, float), len(points)
    diagram = Voronoi(with_images(lower, upper, points))
    pairs, ridges = diagram.ridge_points, np.array(diagram.ridge_vertices)
    owners, others = np.concatenate([pairs, pairs[:, ::-1]]).T
    # Both ends of each face around its owner.
    own = owners < n
    owners, others, ends = owners[own], others[own], np.concatenate([ridges, ridges])[own]
    a, b = (diagram.vertices[ends[:, k]] - points[owners] for k in range(2))
    first = np.where(a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0], *ends.T)
    order = np.lexsort((np.arctan2(*(a + b).T[::-1]), owners))
    cells = []
    for rows in np.split(order, np.cumsum(np.bincount(owners, minlength=n))[:-1]):
        polygon = diagram.vertices[first[rows]]
        neighbors = [int(j) if j < n else -int(j // n) for j in others[rows]]
        cells.append(Cell(polygon, neighbors, *measures(polygon)))
    return cells


def exact_cells(lower, upper, points) -> list[Cell]:
    """Voronoi cells by clipping the box with every bisector in rational arithmetic: no rounding at all, O(n^2)."""
    points = [[Fraction(float(c)) for c in p] for p in points]
    x0, y0 = (Fraction(float(c)) for c in lower)
    x1, y1 = (Fraction(float(c)) for c in upper)
    cells = []
    for i, x in enumerate(points):
        polygon = [((x0, y0), -3), ((x1, y0), -2), ((x1, y1), -4), ((x0, y1), -1)]
        order = sorted(range(len(points)), key=lambda j: (points[j][0] - x[0]) ** 2 + (points[j][1] - x[1]) ** 2)
        for j in order:
            if j != i:
                polygon = _clip(polygon, x, points[j], j)
        area = cx = cy = Fraction(0)
        for k, ((ax, ay), _) in enumerate(polygon):
            (bx, by), _ = polygon[(k + 1) % len(polygon)]
            cross = (ax - x[0]) * (by - x[1]) - (ay - x[1]) * (bx - x[0])
            area += cross / 2
            cx += cross / 6 * (ax + bx - 2 * x[0])
            cy += cross / 6 * (ay + by - 2 * x[1])
        centroid = np.array([float(x[0] + cx / area), float(x[1] + cy / area)])
        corners = np.array([[float(c) for c in p] for p, _ in polygon])
        cells.append(Cell(corners, [j for _, j in polygon], float(area), centroid))
    return cells


def _clip(polygon, x, y, label):
    dx, dy = y[0] - x[0], y[1] - x[1]
    level = (y[0] ** 2 + y[1] ** 2 - x[0] ** 2 - x[1] ** 2) / 2
    side = [px * dx + py * dy - level for (px, py), _ in polygon]
    if max(side) <= 0:
        return polygon
    kept = []
    for k, ((p, face), s) in enumerate(zip(polygon, side, strict=True)):
        (q, _), t = polygon[(k + 1) % len(polygon)], side[(k + 1) % len(polygon)]
        if s <= 0:
            # A corner on the bisector before the cut starts the new face itself.
            kept.append((p, label if s == 0 and t > 0 else face))
        if s < 0 < t or t < 0 < s:
            u = s / (s - t)
            meeting = (p[0] + u * (q[0] - p[0]), p[1] + u * (q[1] - p[1]))
            kept.append((meeting, label if s < 0 else face))
    return kept
