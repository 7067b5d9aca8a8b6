"""The exact cross-section of a 3D mesh by a plane, for all cells at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.connectivity import face_corners, face_owners, following
from ..mesh.results import Diagram


@dataclass(frozen=True)
class Section:
    """Polygons in which a plane cuts cells.

    Attributes
    ----------
    cells : (k,) int
        Which cells are cut.
    starts : (k + 1,) int, corners : (c, 3) float
        Corners of each polygon, counter-clockwise around the plane's normal.
    edges : (c, 2, 3) float
        Sides of the polygons: where the plane cuts faces of the cells.
    rows : (c,) int
        Where in the diagram's graph the face behind each side stands.
    """

    cells: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    edges: np.ndarray
    rows: np.ndarray


def cut_cells(diagram: Diagram, normal: np.ndarray, point: np.ndarray) -> Section:
    """Cut all cells of a 3D diagram by the plane through `point` at right angles to `normal`.

    A face of the mesh that lies in the plane belongs to the cell behind it, so that the polygons cover the section
    once.
    """
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    vertices = diagram.vertices
    height = (vertices - point) @ normal
    # What lies in the plane but for rounding is on its upper side, whichever cell asks.
    height[np.abs(height) < 1e-12 * diagram.domain.extent.max()] = 0.0
    starts, corners = face_corners(diagram)
    above = height[corners] >= 0
    nexts = following(starts)
    face = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    ups = np.flatnonzero(~above & above[nexts])
    downs = np.flatnonzero(above & ~above[nexts])
    # A face is convex: the plane enters and leaves it once. One that rounding has bent is left out.
    entered, left = (
        np.bincount(face[places], minlength=len(starts) - 1) for places in (ups, downs)
    )
    sound = (entered == 1) & (left == 1)
    ups, downs = ups[sound[face[ups]]], downs[sound[face[downs]]]
    rows = face[ups]
    # The cell lies behind the face: around the normal its polygon runs from where it leaves to where it enters.
    edges = np.stack(
        [
            _meetings(vertices, height, corners[nexts[downs]], corners[downs]),
            _meetings(vertices, height, corners[ups], corners[nexts[ups]]),
        ],
        axis=1,
    )
    owner = face_owners(diagram)[rows]
    cells, first, counts = np.unique(owner, return_index=True, return_counts=True)
    order = _around(edges.mean(axis=1), owner, first, counts, normal)
    return Section(cells, np.concatenate([[0], np.cumsum(counts)]), edges[order, 0], edges, rows)


def plane_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors in the plane, to the right and up; along axes: x or y to the right, z or y up."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    if abs(normal[2]) < 1 - 1e-9:
        up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
        up /= np.linalg.norm(up)
        right = np.cross(up, normal)
        # Seen from whichever side has the larger coordinates to the right.
        return (right if right[np.argmax(np.abs(right))] > 0 else -right), up
    return np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def _meetings(
    vertices: np.ndarray, height: np.ndarray, below: np.ndarray, above: np.ndarray
) -> np.ndarray:
    """Return where the edges between vertices below and above the plane meet it, the same from either side."""
    t = height[below] / (height[below] - height[above])
    return vertices[below] + t[:, None] * (vertices[above] - vertices[below])


def _around(
    middles: np.ndarray,
    owner: np.ndarray,
    first: np.ndarray,
    counts: np.ndarray,
    normal: np.ndarray,
) -> np.ndarray:
    """Return the order of the sides of convex polygons, one polygon after the other, by the angles of their middles."""
    if not len(owner):
        return np.zeros(0, np.intp)
    right, _ = plane_axes(normal)
    up = np.cross(normal, right)
    flat = np.stack([middles @ right, middles @ up], axis=1)
    centers = np.add.reduceat(flat, first, axis=0) / counts[:, None]
    arms = flat - np.repeat(centers, counts, axis=0)
    return np.lexsort((np.arctan2(arms[:, 1], arms[:, 0]), owner))
