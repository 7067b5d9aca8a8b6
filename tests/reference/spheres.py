"""Voronoi diagrams on the unit sphere in NumPy and SciPy, and point sets on it."""

import numpy as np
from scipy.spatial import ConvexHull

import clvoro

UNIT = clvoro.Sphere(1.0)


def random_points(n, seed):
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return UNIT.wrap(x)


def clustered_points(n, seed):
    """Return points of which three in four lie in a cap of a degree."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    fine = 3 * n // 4
    x[:fine] = (0.3, -0.5, 0.8) + 0.01 * rng.normal(size=(fine, 3))
    return UNIT.wrap(x)


def grid_of_rings():
    """Return points on meridians and parallels, with both poles: four cells meet at each vertex."""
    lon, lat = np.meshgrid(np.arange(0, 360, 10.0), np.arange(-80, 81, 10.0))
    return UNIT.positions(np.concatenate([np.column_stack([lon.ravel(), lat.ravel()]), [(0, 90), (0, -90)]]))


class SphericalDiagram:
    """The diagram of points (n, 3) in general position, from their convex hull.

    With weights (n,) it is the power diagram: the hull is that of exp(w / 2) x, and points inside of it have no cells
    (Sugihara 2002, J. Geom. Graph. 6, 69).

    Attributes
    ----------
    neighbors : list of lists
        Counter-clockwise as seen from outside.
    areas, offsets, moments : (n,), (n, 3), (n, 3, 3)
        Area of each cell; its centroid on the sphere less the generator; second moments about the centroid in the
        tangent plane, per area.
    arcs, middles : lists of arrays
        Lengths of the faces, and their middles on the sphere.
    """

    def __init__(self, x, weights=None):
        factors = np.ones(len(x)) if weights is None else np.exp(weights / 2)
        y = factors[:, None] * x
        hull = ConvexHull(y)
        triangles = hull.simplices.copy()
        a, b, c = y[triangles].swapaxes(0, 1)
        inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
        triangles[inwards] = triangles[inwards][:, ::-1]
        a, b, c = y[triangles].swapaxes(0, 1)
        normals = np.cross(b - a, c - a)
        self.vertices = normals / np.linalg.norm(normals, axis=1)[:, None]
        follows = [{} for _ in x]  # neighbor -> (next neighbor, vertex between them)
        for v, (a, b, c) in enumerate(triangles.tolist()):
            for i, j, k in ((a, b, c), (b, c, a), (c, a, b)):
                follows[i][j] = k, v
        self.neighbors, self.arcs, self.middles = [], [], []
        self.areas, self.offsets, self.moments = (np.zeros(len(x)), np.zeros((len(x), 3)), np.zeros((len(x), 3, 3)))
        for i, around in enumerate(follows):
            j, row, corners = next(iter(around), None), [], []
            for _ in around:
                row.append(j)
                j, v = around[j]
                corners.append(v)
            # The face with neighbor k lies between the vertices before and after it.
            after = self.vertices[corners]
            before = np.roll(after, 1, axis=0)
            self.neighbors.append(row)
            if row:
                self._measure(x[i], i, before, after)

    def _measure(self, x, i, before, after):
        cross = np.cross(before, after)
        sine = np.linalg.norm(cross, axis=1)
        arcs = np.arctan2(sine, (before * after).sum(axis=1))
        middles = before + after
        self.arcs.append(arcs)
        self.middles.append(middles / np.linalg.norm(middles, axis=1)[:, None])
        # Girard: the sum of the angles at the generator's triangles.
        triple = cross @ x
        excess = 2 * np.arctan2(triple, 1 + before @ x + after @ x + (before * after).sum(axis=1))
        self.areas[i] = excess.sum()
        integral = (arcs / sine)[:, None] * cross / 2
        centroid = integral.sum(axis=0)
        self.offsets[i] = centroid / np.linalg.norm(centroid) - x
        # The polygon in the tangent plane.
        p, q = before / (before @ x)[:, None] - x, after / (after @ x)[:, None] - x
        weight = np.cross(p, q) @ x / 2
        middle = ((p + q) / 3 * weight[:, None]).sum(axis=0) / weight.sum()
        outer = np.einsum("ki,kj->kij", p, p) + np.einsum("ki,kj->kij", q, q)
        outer += np.einsum("ki,kj->kij", p + q, p + q)
        self.moments[i] = np.einsum("k,kij->ij", weight / 12, outer) / weight.sum() - np.outer(middle, middle)
