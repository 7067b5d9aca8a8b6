"""Checks of faces: both cells have the same corners, and measures fit each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from ..connectivity import face_ends, face_keys, plane_shares, take_rows
from .findings import ROUNDINGS

if TYPE_CHECKING:
    from ..diagram import Diagram
    from .findings import Check
    from .rebuilt import Doubts, Rebuilt


def check_corners(check: Check) -> None:
    """Check that a face has the same corners from both sides, which finds vertices that are stored twice.

    Polygons need no such check: there the symmetry of the graph depends on the corners. The two sides of a seam have
    different vertices.
    """
    d = check.diagram
    if d.domain.cuts_cells:
        return
    inner = np.flatnonzero((d.neighbors >= 0) & ~d.shifts.any(axis=1))
    here, there = (inner[np.argsort(keys)] for keys in face_keys(d, inner))
    if d.domain.cell_dim == 2:
        ends = face_ends(d)
        wrong = (ends[here] != ends[there][:, ::-1]).any(axis=1)
    else:
        starts, corners = d.face_vertex_starts, d.face_vertices
        a, b = (take_rows(starts, corners, rows) for rows in (here, there))
        wrong = np.diff(a[0]) != np.diff(b[0])
        same = ~wrong
        row_a, row_b = (np.repeat(np.arange(len(here)), np.diff(x[0])) for x in (a, b))
        one, two = a[1][same[row_a]], b[1][same[row_b]]
        row = row_a[same[row_a]]
        off = one[np.lexsort((one, row))] != two[np.lexsort((two, row))]
        wrong[row[off]] = True
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    check.note(
        "vertices once",
        wrong,
        lambda k: f"the face of cells {owner[here[k]]} and {owner[there[k]]} has other vertices from either side",
    )
    if d.domain.cell_dim == 2 and not any(d.domain.periodic):
        # Across seams a vertex has several numbers.
        expected = _euler_characteristic(d)
        v, e = len(d.vertices), len(d.neighbors) - len(inner) // 2
        c = int(np.count_nonzero(np.diff(d.neighbor_starts)))
        check.note(
            "Euler's formula",
            np.array([expected is not None and v - e + c != expected]),
            lambda _: (
                f"{v} vertices - {e} faces + {c} cells is {v - e + c}, expected {expected}: faces "
                "cross, or two vertices have one number"
            ),
        )


def _euler_characteristic(d: Diagram) -> int | None:
    """Return vertices - faces + cells of a mesh without gaps; None where parts of a boundary touch in a vertex.

    It is 2 for each connected part of a sphere, less one for each of its boundaries, as that of a rectangle: the plane
    is a part of a sphere.
    """
    if d.domain.plain:
        return 1
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    walls = d.neighbors < 0
    ends = face_ends(d)[walls]
    if len(np.unique(ends[:, 0])) < len(ends):
        return None
    parts = _count_components(len(d), owner[~walls], d.neighbors[~walls])
    # All other vertices are parts of their own.
    others = len(d.vertices) - len(np.unique(ends))
    return 2 * parts - (_count_components(len(d.vertices), *ends.T) - others)


def _count_components(n: int, i: np.ndarray, j: np.ndarray) -> int:
    """Return the number of connected components of a graph with n nodes and the edges i to j."""
    graph = scipy.sparse.coo_array((np.ones(len(i), np.int8), (i, j)), shape=(n, n))
    return int(scipy.sparse.csgraph.connected_components(graph, directed=False)[0])


def check_measures(check: Check, g: Rebuilt, positions: Doubts) -> None:
    """Check that the measures of the faces close each cell and give its volume, on the bisectors of the generators.

    The device computes a cell relative to its generator. The round-off of its measures is therefore relative to the
    size of the cell, not of the domain as that of `positions`, unless they come from the corners in a file.
    """
    d = check.diagram
    if g.remade:
        return
    dim, n = d.domain.dim, len(d)
    own = ROUNDINGS * g.unit_of_cell
    doubts = g.doubts(own)
    normals, height = g.directions, g.spacings / 2
    inner = np.flatnonzero(d.neighbors >= 0)
    height[inner] = plane_shares(d, inner) * g.spacings[inner]
    walls = np.flatnonzero(d.neighbors < 0)
    planes, anchors = d.domain.wall_planes(-1 - d.neighbors[walls])
    height[walls] = ((anchors - d.points[g.owner[walls]]) * planes).sum(axis=1)
    loose = np.zeros(len(g.owner), bool)
    if d.domain.cuts_cells:
        # Faces of parts that the boundary has cut off from their generators are not on bisectors: their corners give
        # their places. Such a part lies at the boundary, and so does the cell that it belongs to.
        there = g.areas / np.maximum(g.measures, 1e-300)[:, None]
        at_boundary = np.bincount(g.owner[walls], minlength=n) > 0
        at_wall = at_boundary[g.owner] | at_boundary[np.where(d.neighbors < 0, g.owner, d.neighbors)]
        off = np.linalg.norm(there - normals, axis=1) * g.measures
        adopted = off > np.where(at_wall, doubts.measures, positions.measures)
        adopted &= (d.neighbors >= 0) & (g.measures > 0)
        normals = np.where(adopted[:, None], there, normals)
        # Edges of the domain pass through their corners within round-off.
        loose = adopted | (d.neighbors < 0)
    rounding = np.where(loose, 2 * positions.measures, 0.0)
    # The round-off of the device's periods moves neighbors across seams.
    across = np.where(d.shifts.any(axis=1), g.period_off, 0.0) * d.face_measures
    turned = across / g.spacings
    width = np.bincount(g.owner, doubts.measures + rounding + turned, n)
    gap = np.stack([np.bincount(g.owner, d.face_measures * normals[:, k], n) for k in range(dim)], axis=1)
    gap = np.linalg.norm(gap, axis=1)
    check.note(
        "measures close",
        np.maximum(gap - width, 0),
        lambda i: f"the measures of the faces of cell {i} do not close it, by {gap[i]:.3g}",
    )
    if d.domain.cuts_cells:  # corners alone give the places of cut faces
        return
    if d.is_power and dim == 2:
        # A small cell may be far from its generator: one of its corners is the better origin. In 3D the device, too,
        # sums the cones from the generator.
        corner = np.zeros((n, dim))
        corner[g.cells] = d.vertices[g.corners] - d.points[g.cells]
        height = height - (corner[g.owner] * normals).sum(axis=1)
    volumes = np.bincount(g.owner, d.face_measures * height, n) / dim
    gap = np.abs(d.volumes - volumes)
    # Corners of a cell at the limit of the precision may all be rounded to one point, and give no measures.
    width = doubts.volumes + np.bincount(g.owner, d.face_measures, n) * own
    width += np.bincount(g.owner, across, n) / (2 * dim)
    check.note(
        "volumes",
        np.maximum(gap - width, 0),
        lambda i: f"volumes[{i}] is {d.volumes[i]:.17g}, the measures of its faces give {volumes[i]:.17g}",
    )
