"""Moving meshes in plain NumPy: Huang's functional as a sum over simplices, and a map in one dimension."""

import numpy as np


def with_images(x, owners, codes, box):
    """Return `x` (n, d), followed by its images: a code has two bits per axis, 1 at the lower wall, 2 at the upper."""
    images = x[owners]
    for image, code in zip(images, codes, strict=True):
        for axis in range(box.dim):
            wall = {1: box.lower, 2: box.upper}.get((code >> 2 * axis) & 3)
            if wall is not None:
                image[axis] = 2 * wall[axis] - image[axis]
    return np.concatenate([x, images])


def functional(x, xi, h, simplices):
    """Return the two terms of Huang's functional for each simplex, (2, k): p = 3/2, theta = 1/3, metric h^-2.

    `x`, `xi` (m, d) and `h` (m,) are positions, positions in the lattice and sizes of all vertices.
    """
    d, p, theta = x.shape[1], 1.5, 1 / 3
    e, e0 = (np.swapaxes(v[simplices][:, 1:] - v[simplices][:, :1], 1, 2) for v in (x, xi))
    jacobian = e0 @ np.linalg.inv(e)
    volume = np.abs(np.linalg.det(e)) / (2 if d == 2 else 6)
    size = np.exp(np.log(h)[simplices].mean(axis=1))
    rho = size**-d
    alignment = theta * rho * (size**2 * (jacobian**2).sum(axis=(1, 2))) ** (d * p / 2)
    distribution = rho * (np.abs(np.linalg.det(jacobian)) / rho) ** p
    return volume * np.array([alignment, (1 - 2 * theta) * d ** (d * p / 2) * distribution])


def transported(xi, density, length, samples=20001):
    """Where the transport of the uniform density on (0, length) to `density` takes `xi` (n,)."""
    x = np.linspace(0, length, samples)
    mass = np.concatenate([[0], np.cumsum((density(x)[1:] + density(x)[:-1]) / 2)])
    return np.interp(xi / length, mass / mass[-1], x)
