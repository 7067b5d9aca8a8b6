"""Meshes on spheres for tests of files, and arcs and areas by other formulas than those of the package."""

import numpy as np

import clvoro
from clvoro.mesh.results import Result
from tests.reference.netcdf_files import result_of

NEAR_POLE = np.array([(0.3, 0, 1), (-0.3, 0, 1), (0, 0, -1)])
"""The edge between the first two is at the north pole; the third is the south pole."""


def scattered(n, seed=4081):
    """n generators in random directions, and three at the poles."""
    points = np.random.default_rng(seed).standard_normal((n, 3))
    lengths = np.linalg.norm(points, axis=1)
    # None in the neighborhood of the poles, so that the edge there remains.
    return np.concatenate([NEAR_POLE, points[np.abs(points[:, 2]) < 0.97 * lengths]])


def small_cells():
    """A tenth of a degree wide around one place, and large on the other side."""
    close = 1 + 0.02 * np.random.default_rng(6).standard_normal((300, 3))
    return np.concatenate([close, scattered(150)])


MESHES = {"scattered": lambda: scattered(250), "small cells": small_cells}
EARTH = clvoro.Sphere()


CASES = [
    (dtype, radius, name)
    for dtype, radius in (("float64", 1.0), ("float64", EARTH.radius), ("float32", 1.0))
    for name in MESHES
]
"""Precision, radius, and name in `MESHES`."""


def made(ctx, dtype: str, radius: float, name: str) -> Result:
    """Return the mesh of one of `CASES`, with made-up sizes."""
    return result_of(clvoro.Adapter(ctx, dtype).diagram(clvoro.Sphere(radius), MESHES[name]()))


def is_double(result):
    return not np.array_equal(result.diagram.volumes, result.diagram.volumes.astype(np.float32))


def arcs(a, b):
    """Angles between unit vectors."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))


def triangles(a, b, c):
    """Signed areas of triangles of unit vectors by l'Huilier's theorem."""
    sides = [arcs(b, c), arcs(c, a), arcs(a, b)]
    s = sum(sides) / 2
    product = np.tan(s / 2) * np.prod([np.tan((s - side) / 2) for side in sides], axis=0)
    sign = np.sign((a * np.cross(b - a, c - a)).sum(axis=-1))
    return sign * 4 * np.arctan(np.sqrt(np.maximum(product, 0)))
