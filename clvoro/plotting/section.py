"""The exact cross-section of a 3D mesh by a plane, for all cells at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ..mesh.connectivity import face_corners, face_owners, following
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class Section:
    """Polygons in which a plane cuts cells.

    Attributes
    ----------
    cells : (k,) int
        The cut cells.
    starts : (k + 1,) int, corners : (c, 3) float
        Corners of each polygon, counter-clockwise around the plane's normal.
    edges : (c, 2, 3) float
        Sides of the polygons: where the plane cuts faces of the cells.
    rows, owners : (c,) int
        The half-face behind each side, and its cell.
    """

    cells: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    edges: np.ndarray
    rows: np.ndarray
    owners: np.ndarray


def cut_cells(diagram: Diagram, normal: np.ndarray, point: np.ndarray) -> Section:
    """Cut all cells of a 3D diagram by the plane through `point` at right angles to `normal`.

    A face of the mesh that lies in the plane belongs to the cell behind it, so that the polygons cover the section
    once. In a periodic box the images of cells that reach into the box are cut, too.
    """
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    domain = diagram.domain
    parts = []
    for step in product(*((0, -1, 1) if p else (0,) for p in domain.periodic)):
        by = step * domain.extent
        part = _cut(diagram, normal, point - by)
        if any(domain.periodic):
            part = _inside(part, np.subtract(domain.lower, by), np.subtract(domain.upper, by))
        parts.append((part, by))
    if len(parts) == 1:
        return parts[0][0]
    counts = np.concatenate([np.diff(part.starts) for part, _ in parts])
    return Section(
        np.concatenate([part.cells for part, _ in parts]),
        np.concatenate([[0], np.cumsum(counts)]),
        np.concatenate([part.corners + by for part, by in parts]),
        np.concatenate([part.edges + by for part, by in parts]),
        np.concatenate([part.rows for part, _ in parts]),
        np.concatenate([part.owners for part, _ in parts]),
    )


def _inside(section: Section, lower: np.ndarray, upper: np.ndarray) -> Section:
    """Return the polygons of `section` that reach into the box by more than round-off."""
    if not len(section.cells):
        return section
    starts = section.starts[:-1]
    low = np.minimum.reduceat(section.corners, starts, axis=0)
    high = np.maximum.reduceat(section.corners, starts, axis=0)
    slack = 1e-9 * (upper - lower)
    # A polygon in the plane of a wall has no extent across it.
    kept = ((high >= lower + slack) & (low <= upper - slack)).all(axis=1)
    counts = np.diff(section.starts)
    sides = np.repeat(kept, counts)
    # `edges` and `rows` are in the order of faces, not of polygons: their cell says whether they stay.
    seen = np.zeros(section.cells.max() + 1, bool)
    seen[section.cells[kept]] = True
    return Section(
        section.cells[kept],
        np.concatenate([[0], np.cumsum(counts[kept])]),
        section.corners[sides],
        section.edges[seen[section.owners]],
        section.rows[seen[section.owners]],
        section.owners[seen[section.owners]],
    )


def _cut(diagram: Diagram, normal: np.ndarray, point: np.ndarray) -> Section:
    vertices = diagram.vertices
    height = (vertices - point) @ normal
    # Vertices in the plane, up to round-off, count as above, for all cells.
    height[np.abs(height) < 1e-12 * diagram.domain.extent.max()] = 0.0
    starts, corners = face_corners(diagram)
    above = height[corners] >= 0
    nexts = following(starts)
    face = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    ups = np.flatnonzero(~above & above[nexts])
    downs = np.flatnonzero(above & ~above[nexts])
    # A face is convex: the plane enters and leaves it once. Faces bent by round-off are skipped.
    entered, left = (np.bincount(face[places], minlength=len(starts) - 1) for places in (ups, downs))
    sound = (entered == 1) & (left == 1)
    ups, downs = ups[sound[face[ups]]], downs[sound[face[downs]]]
    rows = face[ups]
    # The cell lies behind the face: counter-clockwise, its polygon runs from the exit to the entry.
    edges = np.stack(
        [
            _crossings(vertices, height, corners[nexts[downs]], corners[downs]),
            _crossings(vertices, height, corners[ups], corners[nexts[ups]]),
        ],
        axis=1,
    )
    owner = face_owners(diagram)[rows]
    cells, first, counts = np.unique(owner, return_index=True, return_counts=True)
    order = _around(edges.mean(axis=1), owner, first, counts, normal)
    starts = np.concatenate([[0], np.cumsum(counts)])
    return Section(cells, starts, edges[order, 0], edges, rows, owner)


def plane_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors in the plane, to the right and up; along axes: x or y to the right, z or y up."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    if abs(normal[2]) < 1 - 1e-9:
        up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
        up /= np.linalg.norm(up)
        right = np.cross(up, normal)
        # Seen from the side with increasing coordinates to the right.
        return (right if right[np.argmax(np.abs(right))] > 0 else -right), up
    return np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def _crossings(vertices: np.ndarray, height: np.ndarray, below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """Return the intersections of the plane with edges between vertices below and above it."""
    t = height[below] / (height[below] - height[above])
    return vertices[below] + t[:, None] * (vertices[above] - vertices[below])


def _around(
    middles: np.ndarray, owner: np.ndarray, first: np.ndarray, counts: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Return the order of the sides of convex polygons, polygon by polygon, by the angles of their midpoints."""
    if not len(owner):
        return np.zeros(0, np.intp)
    right, _ = plane_axes(normal)
    up = np.cross(normal, right)
    flat = np.stack([middles @ right, middles @ up], axis=1)
    centers = np.add.reduceat(flat, first, axis=0) / counts[:, None]
    arms = flat - np.repeat(centers, counts, axis=0)
    return np.lexsort((np.arctan2(arms[:, 1], arms[:, 0]), owner))
