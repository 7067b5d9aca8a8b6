"""Balls that touch the boundary of a polygon at a given point, by bisection."""

import numpy as np
import shapely

import clvoro


def largest_radius(domain: clvoro.Polygon, point: np.ndarray, normal: np.ndarray, most: float) -> float:
    """Return the radius of the largest ball at a point of the boundary, its center along the normal; at most `most`.

    Each ball holds the smaller ones.
    """
    boundary, least = domain.geometry.boundary, 0.0
    for _ in range(60):
        radius = 0.5 * (least + most)
        center = shapely.Point(point + radius * normal)
        if boundary.distance(center) < radius * (1 - 1e-10):
            most = radius
        else:
            least = radius
    return most
