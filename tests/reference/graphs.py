"""Random Voronoi graphs from SciPy in the unit box, in Morton order."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.spatial import Voronoi


def morton_order(points):
    """Order of `points` in [0, 1]^d along a Morton curve of 2^10 boxes per direction."""
    boxes = np.minimum((points * 1024).astype(np.int64), 1023)
    dim = points.shape[1]
    key = np.zeros(len(points), np.int64)
    for bit in range(10):
        for a in range(dim):
            key |= ((boxes[:, a] >> bit) & 1) << (bit * dim + a)
    return np.argsort(key, kind="stable")


def polygon_area(corners):
    """Area of a plane polygon in space, corners (k, 3) in order."""
    fan = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0])
    return 0.5 * np.linalg.norm(fan.sum(axis=0))


def voronoi_graph(points):
    """CSR graph of the diagram of `points` (n, d): starts, neighbors, face measures, volumes.

    Neighbors -1 - b are walls, which Qhull makes as every generator is mirrored at every wall.
    """
    n, dim = points.shape
    mirrored = [points]
    for a in range(dim):
        for wall in (0.0, 1.0):
            image = points.copy()
            image[:, a] = 2 * wall - image[:, a]
            mirrored.append(image)
    diagram = Voronoi(np.concatenate(mirrored))
    pairs = diagram.ridge_points
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    # A cell's own images lie behind the walls; faces to images of others have no measure.
    kept = (low < n) & ((high < n) | (high % n == low))
    pairs = pairs[kept]
    if dim == 2:
        ends = diagram.vertices[np.array(diagram.ridge_vertices)[kept]]
        measures = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    else:
        measures = np.array([polygon_area(diagram.vertices[diagram.ridge_vertices[f]]) for f in np.flatnonzero(kept)])
    heights = 0.5 * np.linalg.norm(np.diff(diagram.points[pairs], axis=1)[:, 0], axis=1)
    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0]])
    both, high = np.tile(measures, 2), np.tile(heights, 2)
    keep = rows < n
    rows, columns, both, high = rows[keep], columns[keep], both[keep], high[keep]
    columns = np.where(columns >= n, -(columns // n), columns)
    order = np.lexsort((columns, rows))
    rows, columns, both, high = rows[order], columns[order], both[order], high[order]
    starts = np.searchsorted(rows, np.arange(n + 1)).astype(np.int32)
    volumes = np.bincount(rows, both * high / dim, minlength=n)
    return starts, columns.astype(np.int32), both, volumes


def random_graph(n, dim=2, seed=7):
    """`n` uniform random generators in Morton order: points and what `voronoi_graph` returns."""
    points = np.random.default_rng(seed).random((n, dim))
    points = points[morton_order(points)]
    return points, *voronoi_graph(points)


def laplacian_matrix(points, starts, neighbors, measures, density=None):
    """SciPy CSR matrix of A = -Laplacian: the slow and obvious form."""
    n = len(points)
    rows = np.repeat(np.arange(n), np.diff(starts))
    inner = neighbors >= 0
    i, j = rows[inner], neighbors[inner]
    weights = measures[inner] / np.linalg.norm(points[i] - points[j], axis=1)
    if density is not None:
        weights = weights * np.sqrt(density[i] * density[j])
    off = sp.csr_matrix((weights, (i, j)), (n, n))
    off = 0.5 * (off + off.T)
    return sp.csr_matrix(sp.diags(np.asarray(off.sum(axis=1)).ravel()) - off)
