"""Power diagrams by SciPy's convex hulls, and by brute force with Shapely: the paper's (2.5) without any search."""

import numpy as np
import shapely
from scipy.spatial import ConvexHull, QhullError


def power_cells(box, points, weights):
    """Return volumes (n,) and centroids (n, d) of the cells in a `clvoro.Box`; NaN for the centroids of empty cells.

    Generators are lifted to (x, |x|^2 - w), together with their images across periodic boundaries, and their mirror
    images beyond walls. Each face below the convex hull has the slope 2 c with a vertex c of the diagram (Edelsbrunner
    and Seidel 1986, Discrete Comput. Geom. 1, 25). A mirror image is farther from every point of the box than its
    generator.
    """
    n, d = points.shape
    origin = np.array(box.lower)
    x, w = points - origin, np.tile(weights, 3**d)
    for axis, length in enumerate(box.extent):
        copies = [x.copy(), x.copy()]
        for copy, end in zip(copies, (0, 1), strict=True):
            if box.periodic[axis]:
                copy[:, axis] += (2 * end - 1) * length
            else:
                copy[:, axis] = 2 * end * length - copy[:, axis]
        x = np.concatenate([x, *copies])
    hull = ConvexHull(np.column_stack([x, (x**2).sum(axis=1) - w]))
    below = hull.equations[:, d] < -1e-12
    centers = -hull.equations[below, :d] / (2 * hull.equations[below, d, None])
    volumes, centroids = np.zeros(n), np.full((n, d), np.nan)
    faces = hull.simplices[below]
    order = np.argsort(faces.ravel(), kind="stable")
    starts = np.searchsorted(faces.ravel()[order], np.arange(n + 1))
    for i in range(n):
        corners = centers[order[starts[i] : starts[i + 1]] // (d + 1)]
        try:
            cell = ConvexHull(corners)
        except (QhullError, ValueError):  # no corners, or all in a plane
            continue
        apex = corners.mean(axis=0)
        simplices = corners[cell.simplices] - apex
        share = np.abs(np.linalg.det(simplices))
        share /= share.sum()
        volumes[i] = cell.volume
        centroids[i] = origin + apex + (share[:, None] * simplices.sum(axis=1)).sum(axis=0) / (d + 1)
    return volumes, centroids


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
            behind = (foot + across, foot - across, foot - across - far * way, foot + across - far * way)
            cell = shapely.intersection(cell, shapely.Polygon(behind))
        cells.append(cell)
    return cells
