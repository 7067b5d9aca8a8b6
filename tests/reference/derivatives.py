"""Weighted least squares on the neighbor graph, cell by cell."""

import numpy as np


def fit_quadratics(mesh, values):
    """Return gradient and Hessian of a quadratic fit to each cell's neighbors and theirs; flat domains only.

    A cell counts once for each path of one or two faces that leads to it.
    """
    d, c, extent = mesh.domain.dim, mesh.centroids, mesh.domain.extent
    gradients, hessians = np.zeros((len(mesh), d)), np.zeros((len(mesh), d, d))

    def steps(i):
        for k in range(mesh.neighbor_starts[i], mesh.neighbor_starts[i + 1]):
            j = mesh.neighbors[k]
            if j >= 0:
                yield j, c[j] + mesh.shifts[k] * extent - c[i]

    pairs = [(a, b) for a in range(d) for b in range(a + 1)]
    for i in range(len(mesh)):
        paths = list(steps(i))
        paths += [(k, v + w) for j, v in paths for k, w in steps(j)]
        paths = [(j, v) for j, v in paths if np.linalg.norm(v) > 1e-9]
        v = np.array([v for _, v in paths])
        rise = np.array([values[j] - values[i] for j, _ in paths])
        terms = np.column_stack([v, *(v[:, a] * v[:, b] * (0.5 if a == b else 1) for a, b in pairs)])
        weight = 1 / np.linalg.norm(v, axis=1)
        found = np.linalg.lstsq(terms * weight[:, None], rise * weight, rcond=None)[0]
        gradients[i] = found[:d]
        for (a, b), h in zip(pairs, found[d:], strict=True):
            hessians[i, a, b] = hessians[i, b, a] = h
    return gradients, hessians
