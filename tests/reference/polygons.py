"""Polygons that tests share, and slow, obvious answers about them."""

import numpy as np

SQUARE = np.array([(0.0, 0), (4, 0), (4, 3), (0, 3)])
HOLE = np.array([(1.0, 1), (2, 1), (2, 2), (1, 2)])
OTHER = HOLE * 0.5 + (2.5, 0.5)


def crossings(points: np.ndarray, rings: list) -> np.ndarray:
    """Even-odd rule, edge by edge."""
    inside = np.zeros(len(points), bool)
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            spans = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                x = a[0] + (points[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
            inside ^= spans & (points[:, 0] < x)
    return inside


def distances(points: np.ndarray, rings: list) -> np.ndarray:
    """Distance to the nearest of all edges, edge by edge."""
    best = np.full(len(points), np.inf)
    for ring in rings:
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            t = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            best = np.minimum(best, np.linalg.norm(a + t[:, None] * (b - a) - points, axis=1))
    return best
