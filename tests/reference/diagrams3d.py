"""Slow, obvious references for the diagram in 3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, Voronoi

from tests.reference.diagrams import with_images

LATTICES = {
    "cubic": [[0, 0, 0]],
    "bcc": [[0, 0, 0], [0.5, 0.5, 0.5]],
    "fcc": [[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]],
}


def lattice(kind: str, k: int) -> np.ndarray:
    """`k` cells of one of `LATTICES` along each side of the unit cube; no generator is on a wall."""
    ijk = np.stack(np.meshgrid(*[np.arange(k)] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    return (ijk + np.array(LATTICES[kind]) + 0.25).reshape(-1, 3) / k


def directions(n: int, rng: np.random.Generator) -> np.ndarray:
    """Random unit vectors."""
    v = rng.standard_normal((n, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


@dataclass(frozen=True)
class Cell:
    """Areas and centroids of faces by neighbor (walls: -1 - wall), and the cell's moments."""

    faces: dict[int, float]
    face_centroids: dict[int, np.ndarray]
    volume: float
    centroid: np.ndarray
    covariance: np.ndarray  # (3, 3), about the centroid, per unit volume


def polygon(corners: np.ndarray, center: np.ndarray) -> tuple[float, np.ndarray, list]:
    """Return area, centroid and triangles of a convex polygon whose corners (k, 3) go around."""
    middle, nexts = corners.mean(axis=0), np.roll(corners, -1, axis=0)
    triangles = [(middle, a, b) for a, b in zip(corners, nexts, strict=True)]
    areas = np.linalg.norm(np.cross(corners - middle, nexts - middle), axis=1) / 2
    centroids = (middle + corners + nexts) / 3
    area = areas.sum()
    return area, (areas[:, None] * centroids).sum(axis=0) / area if area else middle, triangles


def moments(tetrahedra: list[np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume, centroid and second moments of tetrahedra (4, 3), by a quadrature of degree 2."""
    inner = (5 + 3 * np.sqrt(5)) / 20
    outer = (1 - inner) / 3
    weights = np.full((4, 4), outer) + (inner - outer) * np.eye(4)
    t = np.array(tetrahedra)
    volumes = np.abs(np.linalg.det(t[:, 1:] - t[:, :1])) / 6
    nodes = np.einsum("ab,tbd->tad", weights, t)
    volume = volumes.sum()
    centroid = np.einsum("t,tad->d", volumes / 4, nodes) / volume
    off = nodes - centroid
    return volume, centroid, np.einsum("t,tad,tae->de", volumes / 4, off, off) / volume


def box_voronoi(lower, upper, points) -> list[Cell]:
    """Voronoi cells of `points` (n, 3) in a box, by Qhull on the points and their images in the six walls.

    A generator's image makes the wall its bisector. Points may not lie on walls.
    """
    points, n = np.asarray(points, float), len(points)
    diagram = Voronoi(with_images(lower, upper, points))
    faces: list[dict] = [{} for _ in range(n)]
    centroids: list[dict] = [{} for _ in range(n)]
    tetrahedra: list[list] = [[] for _ in range(n)]
    for (p, q), ridge in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        for i, j in ((p, q), (q, p)):
            # A cell's own images lie behind the walls; faces to images of others have no area.
            if i < n and (j < n or j % n == i):
                area, centroid, triangles = polygon(diagram.vertices[ridge], points[i])
                label = int(j if j < n else -(j // n))
                faces[i][label] = area
                centroids[i][label] = centroid
                tetrahedra[i] += [np.array([points[i], *t]) for t in triangles]
    return [Cell(f, c, *moments(t)) for f, c, t in zip(faces, centroids, tetrahedra, strict=True)]


def half_space_volume(lower, upper, points, i) -> float:
    """Volume of cell i by Qhull's intersection of half-spaces: another way, for points on walls, too."""
    from scipy.spatial import HalfspaceIntersection

    x = points[i]
    d = np.delete(points, i, axis=0) - x
    rows = [np.column_stack([d, -np.einsum("ij,ij->i", d, d) / 2])]
    rows.append(np.column_stack([np.eye(3), x - upper]))
    rows.append(np.column_stack([-np.eye(3), lower - x]))
    half_spaces = np.concatenate(rows)
    from scipy.optimize import linprog

    length = np.linalg.norm(half_spaces[:, :3], axis=1)
    best = linprog(
        [0, 0, 0, -1],
        A_ub=np.column_stack([half_spaces[:, :3], length]),
        b_ub=-half_spaces[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    corners = HalfspaceIntersection(half_spaces, best.x[:3]).intersections
    return ConvexHull(corners).volume
