"""Diagrams in three dimensions from SciPy, face by face in plain Python: for tests that only read a diagram."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Voronoi, cKDTree

from clvoro.geometry.box import Box
from clvoro.mesh.diagram import Diagram
from clvoro.mesh.results import HISTORY_DTYPE, Result
from tests.reference.diagrams import with_images


def loop_area(corners):
    """Return the area vector of a plane polygon (k, 3), counter-clockwise as seen from its tip."""
    a = corners - corners[0]
    return 0.5 * np.cross(a, np.roll(a, -1, axis=0)).sum(axis=0)


def loop_centroid(corners):
    """Return the centroid of a convex plane polygon (k, 3)."""
    a, b, c = corners[0], corners[1:-1], corners[2:]
    weights = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return (weights[:, None] * (a + b + c)).sum(axis=0) / (3 * weights.sum())


def cubes(edge=1.0):
    """Return the Diagram of 3 x 4 x 2 cubes."""
    points = (np.stack(np.meshgrid(*map(np.arange, (3, 4, 2)), indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * edge
    return solid_diagram((0, 0, 0), (3 * edge, 4 * edge, 2 * edge), points)


def solid_diagram(lower, upper, points, shortest=1e-9):
    """Return the Diagram of `points` (n, 3) in a box, by Qhull on the points and their images in the six walls.

    Vertices nearer than `shortest` times the box are one; faces that are then left without area are none.
    """
    box = Box(lower, upper)
    points, n = np.asarray(points, float), len(points)
    voronoi = Voronoi(with_images(lower, upper, points))
    vertices = np.clip(voronoi.vertices, lower, upper)
    near = cKDTree(vertices).query_ball_point(vertices, shortest * box.extent.max())
    same = np.array([min(group) for group in near])
    rows = [[] for _ in range(n)]
    for (p, q), ridge in zip(voronoi.ridge_points, voronoi.ridge_vertices, strict=True):
        for i, j in ((p, q), (q, p)):
            if i >= n or (j >= n and j % n != i):
                continue  # a cell's own images lie behind the walls
            loop = [same[k] for k in ridge]
            loop = [k for place, k in enumerate(loop) if k != loop[place - 1]]
            if len(set(loop)) < 3:
                continue
            area = loop_area(vertices[loop])
            if area @ (voronoi.points[j] - points[i]) < 0:
                loop = loop[::-1]
            rows[i].append((int(j) if j < n else -int(j // n), loop))
    faces = [face for row in rows for face in row]
    owners = np.repeat(np.arange(n), [len(row) for row in rows])
    used, numbers = np.unique(np.concatenate([loop for _, loop in faces]), return_inverse=True)
    areas = np.array([loop_area(vertices[loop]) for _, loop in faces])
    measures = np.linalg.norm(areas, axis=1)
    middles = np.array([loop_centroid(vertices[loop]) for _, loop in faces])
    # A cell is made of the pyramids from its generator to its faces.
    pyramids = np.einsum("ij,ij->i", areas, middles - points[owners]) / 3
    volumes = np.bincount(owners, pyramids, minlength=n)
    centroids = [
        np.bincount(owners, pyramids * (0.75 * middles + 0.25 * points[owners])[:, a], minlength=n) for a in range(3)
    ]
    return Diagram(
        box,
        {
            "points": points,
            "volumes": volumes,
            "centroids": np.stack(centroids, axis=1) / volumes[:, None],
            "neighbor_starts": np.cumsum([0] + [len(row) for row in rows]).astype(np.int32),
            "neighbors": np.array([j for j, _ in faces], np.int32),
            "face_measures": measures,
            "face_centroids": middles,
            "vertices": lambda: vertices[used],  # read when first used, as from a device
            "face_vertex_starts": np.cumsum([0] + [len(loop) for _, loop in faces]).astype(np.int32),
            "face_vertices": numbers.ravel().astype(np.int32),
        },
    )


def solid_result(diagram, size=None, seed=7741):
    """Return a Result that holds `diagram`, with made-up sizes (by default the cells' own) and history."""
    rng = np.random.default_rng(seed)
    length = np.cbrt(diagram.volumes)
    size = length * rng.uniform(0.9, 1.1, len(diagram)) if size is None else size(diagram.points)
    surfaces = np.add.reduceat(diagram.face_measures, diagram.neighbor_starts[:-1])
    error = (length - size) / np.minimum(length, size)
    quality = 36 * np.pi * diagram.volumes**2 / surfaces**3
    history = np.zeros(9, HISTORY_DTYPE)
    history["step"], history["cells"] = np.arange(9), len(diagram)
    history["mean_error"] = np.geomspace(0.5, np.abs(error).mean(), 9)
    history["max_error"] = np.geomspace(3, np.abs(error).max(), 9)
    history["mean_quality"] = np.linspace(0.1, quality.mean(), 9)
    history["min_quality"] = np.linspace(0.05, quality.min(), 9)
    return Result(
        points=diagram.points,
        diagram=diagram,
        target_size=size,
        size_error=error,
        quality=quality,
        history=history,
        converged=True,
        stop_reason="made up",
        settings={"method": "coupled", "seed": seed},
    )


def relaxed_points(lower, upper, n, seed, steps=3, keep=None):
    """Return random generators, each kept with the probability `keep` (n, 3) -> (n,), after a few of Lloyd's steps."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(lower, upper, (n, 3))
    if keep is not None:
        points = points[rng.random(n) < keep(points)]
    for _ in range(steps):
        points = solid_diagram(lower, upper, points).centroids
    return points
