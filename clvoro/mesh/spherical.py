"""Measures of cells on a sphere, computed from their corners."""

from __future__ import annotations

import numpy as np

from ..geometry.sphere import arc_excess
from .connectivity import face_ends, face_owners, following
from .diagram import Diagram


def rebuild_on_sphere(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return the arrays of a diagram on a sphere that follow from its corners: arcs, their middles, and centroids.

    The integral of the position over a cell of the unit sphere is half the sum over its edges, from v to w, of
    arc n, with n the unit vector along v x w (Gauss). The centroid has its direction.
    """
    sphere = diagram.domain
    radius, owner = sphere.frame[1], face_owners(diagram)
    points, vertices = (sphere.wrap(x) / radius for x in (diagram.points, diagram.vertices))
    v, w = (vertices[ends] for ends in face_ends(diagram).T)
    a, b = (_relative(x, points[owner]) for x in (v, w))
    cross = np.cross(v, w)
    # Of the vectors v x w the parts with the generator add up to zero. Without them small cells lose no digits.
    sines, cosines = np.linalg.norm(cross, axis=1), (v * w).sum(axis=1)
    terms = np.cross(a, b) + arc_excess(sines, cosines)[:, None] * cross
    integrals = np.column_stack([np.bincount(owner, t, len(diagram)) for t in terms.T])
    return {
        "face_measures": radius * np.arctan2(sines, cosines),
        "face_centroids": sphere.wrap(v + w),
        "centroids": sphere.wrap(integrals),
    }


def bisector_corners(starts: np.ndarray, normals: np.ndarray, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the bisectors of each cell cross those before them, in the tangent plane at the generator.

    Parameters
    ----------
    starts : (n + 1,) int
        Rows of the cells.
    normals, levels : (m, 2), (m,) float64
        The lines n.p = level.

    Returns
    -------
    corners : (m, 2) float64
        Not finite where lines are parallel.
    sines : (m,) float64
        Of the angles from the normals before to the normals.
    """
    before = np.argsort(following(starts))
    one, other = normals[before], normals
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    with np.errstate(all="ignore"):
        x = (levels[before] * other[:, 1] - levels * one[:, 1]) / cross
        y = (levels * one[:, 0] - levels[before] * other[:, 0]) / cross
        lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        return np.column_stack([x, y]), cross / lengths


def _relative(x: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return x - origin for unit vectors, with the radial part -|x - origin|^2 / 2, which the difference rounds."""
    d = x - origin
    return d - ((d * origin).sum(axis=1) + (d * d).sum(axis=1) / 2)[:, None] * origin
