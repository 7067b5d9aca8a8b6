"""Weighted least squares on the neighbor graph, cell by cell."""

import numpy as np


def fit_quadratics(mesh, values):
    """Return gradient and Hessian of a quadratic fit to each cell's neighbors and theirs; flat domains only.

    A cell counts once for each path that leads to it: with the weight 1 over one face, 0.03 over two.
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
        paths = [(j, v, 1) for j, v in steps(i)]
        paths += [(k, v + w, 0.03) for j, v, _ in paths for k, w in steps(j)]
        paths = [path for path in paths if np.linalg.norm(path[1]) > 1e-9]
        v = np.array([v for _, v, _ in paths])
        rise = np.array([values[j] - values[i] for j, _, _ in paths])
        terms = np.column_stack([v, *(v[:, a] * v[:, b] * (0.5 if a == b else 1) for a, b in pairs)])
        weight = np.sqrt([share for _, _, share in paths]) / np.linalg.norm(v, axis=1) ** 2
        found = np.linalg.lstsq(terms * weight[:, None], rise * weight, rcond=None)[0]
        gradients[i] = found[:d]
        for (a, b), h in zip(pairs, found[d:], strict=True):
            hessians[i, a, b] = hessians[i, b, a] = h
    return gradients, hessians
