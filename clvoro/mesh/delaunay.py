"""The dual of a diagram in the plane or on a sphere: the Delaunay triangles of its generators, or regular ones."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .diagram import Diagram


def dual_triangles(diagram: Diagram) -> np.ndarray:
    """Return the triples of generators whose cells meet in a vertex (t, 3) int32; see `Diagram.triangles`."""
    if diagram.domain.cell_dim != 2 or any(diagram.domain.periodic):
        raise InputError(
            f"triangles are for meshes in the plane without seams and on spheres, not for {diagram.domain}; use "
            "neighbors and shifts, which every diagram has"
        )
    n, starts = len(diagram), diagram.cell_vertex_starts
    cells = np.repeat(np.arange(n, dtype=np.int64), np.diff(starts))
    # A cell with several loops lists the ends of its bridges twice.
    pairs = np.unique(diagram.cell_vertices * np.int64(n) + cells)
    vertices, cells = pairs // n, pairs % n
    centers = diagram.vertices
    if diagram.is_power:
        # The generators need not lie around the vertex, but around their own middle.
        number = np.bincount(vertices, minlength=len(centers))
        sums = [np.bincount(vertices, diagram.points[cells, a], len(centers)) for a in range(2)]
        centers = np.column_stack(sums) / number[:, None]
    arms = diagram.points[cells] - centers[vertices]
    axes = diagram.domain.tangents(diagram.vertices)
    arms = np.column_stack([(arms * axis[vertices]).sum(axis=1) for axis in axes])
    # Around each vertex counter-clockwise.
    order = np.lexsort((np.arctan2(arms[:, 1], arms[:, 0]), vertices))
    cells = cells[order]
    first = np.flatnonzero(np.diff(vertices, prepend=-1))
    counts = np.diff(first, append=len(vertices))
    # A fan of counts - 2 triangles; one triangle at most vertices.
    fans = np.maximum(counts - 2, 0)
    apex = np.repeat(first, fans)
    step = 1 + np.arange(len(apex)) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.column_stack([cells[apex], cells[apex + step], cells[apex + step + 1]]).astype(np.int32)
