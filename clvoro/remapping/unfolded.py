"""Cells bounded by bisectors alone: points behind faces take the place of walls, seams and removed cells."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from ..mesh.connectivity import face_owners, following, neighbor_points
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class Unfolded:
    """Cells of a diagram and of its periodic images.

    Attributes
    ----------
    points : (k, d) float64
        Generators of the cells, then points behind faces that have no cell here.
    starts, neighbors : (c + 1,) and (m,) int32
        Rows of the neighbor graph.
    cells : (c,) int
        The cell of the diagram that each cell is, or is an image of.
    offsets : (c, d) float64
        From the cell of the diagram to its image.
    """

    points: np.ndarray
    starts: np.ndarray
    neighbors: np.ndarray
    cells: np.ndarray
    offsets: np.ndarray

    def __len__(self) -> int:
        return len(self.cells)


def unfold(diagram: Diagram, lower: np.ndarray | None = None, upper: np.ndarray | None = None) -> Unfolded:
    """Return the cells of `diagram`, and the images whose generators are between two corners, if these are given."""
    n, d = diagram.points.shape
    extent = diagram.domain.extent
    shifts, images = [np.zeros(d, int)], [np.arange(n)]
    if lower is not None and upper is not None:
        reach = [
            range(int(np.floor((a - top) / e)), int(np.ceil((b - bottom) / e)) + 1) if periodic else (0,)
            for a, b, bottom, top, e, periodic in zip(
                lower, upper, diagram.domain.lower, diagram.domain.upper, extent, diagram.domain.periodic, strict=True
            )
        ]
        for step in product(*reach):
            if any(step):
                x = diagram.points + np.array(step) * extent
                shifts.append(np.array(step))
                images.append(np.flatnonzero(((x >= lower) & (x <= upper)).all(axis=1)))
    cells = np.concatenate(images)
    shift = np.repeat(np.array(shifts), [len(rows) for rows in images], axis=0)
    # The number of each image: by shift and cell.
    low = shift.min(axis=0) - 1
    shape = tuple(shift.max(axis=0) - low + 2)
    number = np.full((int(np.prod(shape)), n), -1, np.int32)
    number[np.ravel_multi_index(tuple((shift - low).T), shape), cells] = np.arange(len(cells))
    counts = np.diff(diagram.neighbor_starts)[cells]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    faces = np.arange(starts[-1]) - np.repeat(starts[:-1], counts) + np.repeat(diagram.neighbor_starts[cells], counts)
    moved = np.repeat(shift, counts, axis=0)
    there = np.clip(moved + diagram.shifts[faces] - low, 0, np.array(shape) - 1)
    behind = diagram.neighbors[faces]
    neighbors = number[np.ravel_multi_index(tuple(there.T), shape), np.maximum(behind, 0)]
    neighbors[behind < 0] = -1
    alone = np.flatnonzero(neighbors < 0)
    neighbors[alone] = len(cells) + np.arange(len(alone))
    beyond = _behind(diagram, faces[alone]) + moved[alone] * extent
    offsets = shift * extent
    return Unfolded(np.concatenate([diagram.points[cells] + offsets, beyond]), starts, neighbors, cells, offsets)


def _behind(diagram: Diagram, faces: np.ndarray) -> np.ndarray:
    """Return the points behind half-faces (k,), so that bisectors are where the faces of the diagram are.

    Faces at curved walls have corners there and are not plane. The bisector passes through the centroid, normal to the
    vector area; where that leads away from the wall, it touches the wall.
    """
    found = neighbor_points(diagram, faces)
    curved = diagram.domain.curved_walls & (diagram.neighbors[faces] < 0)
    if not curved.any():
        return found
    own, wall = diagram.points[face_owners(diagram)[faces[curved]]], faces[curved]
    outward = found[curved] - own
    corners, starts = diagram.face_vertices, diagram.face_vertex_starts
    areas = np.cross(diagram.vertices[corners], diagram.vertices[corners[following(starts)]])
    areas = np.add.reduceat(areas, starts[:-1])[wall]
    normals = areas / np.maximum(np.linalg.norm(areas, axis=1), 1e-300)[:, None]
    normals *= np.sign((normals * outward).sum(axis=1))[:, None]
    gaps = ((diagram.face_centroids[wall] - own) * normals).sum(axis=1)
    usable = ((normals * outward).sum(axis=1) > 0.5 * np.linalg.norm(outward, axis=1)) & (gaps > 0)
    found[np.flatnonzero(curved)[usable]] = (own + 2 * gaps[:, None] * normals)[usable]
    return found


def farthest_neighbor(diagram: Diagram) -> float:
    """Return the largest distance of a generator from one behind a face."""
    faces = np.arange(len(diagram.neighbors))
    way = neighbor_points(diagram, faces) - diagram.points[face_owners(diagram)]
    return float(np.sqrt((way**2).sum(axis=1).max()))
