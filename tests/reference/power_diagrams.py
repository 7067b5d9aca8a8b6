"""Power diagrams by brute force: the paper's (2.5) in NumPy, SciPy and Shapely, without any search."""

import numpy as np
import shapely
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError


def power_cell(lower, upper, points, weights, i):
    """Return volume and centroid of cell i in a box; (0, None) if it is empty.

    All half-spaces 2 (x_j - x_i) . y <= |x_j|^2 - |x_i|^2 - (w_j - w_i) are intersected, after a linear program for the
    center of the largest ball in the cell.
    """
    from scipy.optimize import linprog

    d = points.shape[1]
    others = np.delete(np.arange(len(points)), i)
    normals = 2 * (points[others] - points[i])
    square = (points**2).sum(axis=1) - weights
    levels = square[others] - square[i]
    normals = np.vstack([normals, np.eye(d), -np.eye(d)])
    levels = np.concatenate([levels, upper, -np.asarray(lower)])
    lengths = np.linalg.norm(normals, axis=1)
    ball = linprog(
        np.append(np.zeros(d), -1),
        A_ub=np.column_stack([normals, lengths]),
        b_ub=levels,
        bounds=[(None, None)] * d + [(0, None)],
    )
    if ball.status != 0 or ball.x[-1] < 1e-12:
        return 0.0, None
    try:
        corners = HalfspaceIntersection(
            np.column_stack([normals, -levels]), ball.x[:d]
        ).intersections
        hull = ConvexHull(corners)
    except QhullError:
        return 0.0, None
    apex = corners.mean(axis=0)
    simplices = corners[hull.simplices] - apex
    volumes = np.abs(np.linalg.det(simplices))
    share = volumes / volumes.sum()
    centroid = apex + (share[:, None] * simplices.sum(axis=1)).sum(axis=0) / (d + 1)
    return hull.volume, centroid


def power_cells(lower, upper, points, weights):
    """Return volumes (n,) and centroids (n, d), NaN for empty cells."""
    cells = [power_cell(lower, upper, points, weights, i) for i in range(len(points))]
    nothing = np.full(points.shape[1], np.nan)
    return np.array([v for v, _ in cells]), np.array(
        [nothing if c is None else c for _, c in cells]
    )


def polygon_power_cells(domain, points, weights):
    """Return the cells in a `clvoro.Polygon` as n Shapely shapes: its shape, cut by each half-plane in turn."""
    far = 4 * float(np.linalg.norm(domain.extent))
    cells = []
    for i, x in enumerate(points):
        cell = domain.geometry
        for j in range(len(points)):
            d = points[j] - x
            if i == j or cell.is_empty:
                continue
            way = d / np.linalg.norm(d)
            across = far * np.array([-way[1], way[0]])
            foot = x + (d @ d - (weights[j] - weights[i])) / (2 * d @ d) * d
            behind = (
                foot + across,
                foot - across,
                foot - across - far * way,
                foot + across - far * way,
            )
            cell = shapely.intersection(cell, shapely.Polygon(behind))
        cells.append(cell)
    return cells
