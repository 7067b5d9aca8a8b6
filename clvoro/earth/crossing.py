"""The cells on a sphere that lines cross, and rings of neighbors around cells."""

from __future__ import annotations

import numpy as np
import scipy

from ..geometry.sphere import Sphere
from ..geometry.sphere_region import SphereRegion
from ..mesh.connectivity import face_owners
from ..mesh.diagram import Diagram

_STEP = 0.1
"""Length in degrees of the arcs by which lines in longitude and latitude are approximated."""
_TIE = 1e-12
"""Difference of distances, in units of the radius, below which two generators are equally near."""


def cells_across(diagram: Diagram, sphere: Sphere, line: np.ndarray) -> np.ndarray:
    """Return the cells that a line (k, 2) of continuous longitudes and latitudes crosses, ascending.

    Cells that follow each other along the line have a common face. Where the line goes through a vertex of more than
    three cells, those beside it are added. Parts of the line outside of the mesh are skipped.
    """
    n, unit = len(diagram), diagram.points
    if isinstance(sphere, SphereRegion):
        unit = np.concatenate([unit, sphere.beyond])
    unit = unit / np.linalg.norm(unit, axis=1)[:, None]
    tree = scipy.spatial.KDTree(unit)
    path = sphere.positions(_divided(line)) / sphere.radius
    cells = np.asarray(tree.query(path)[1])
    begin, end, first, last = path[:-1], path[1:], cells[:-1], cells[1:]
    found, pairs = [cells], [np.empty((0, 2), np.int64)]
    while True:
        some = first != last
        begin, end, first, last = begin[some], end[some], first[some], last[some]
        if not len(first):
            break
        # Where the arc crosses the bisector of the cells of its ends: between them, unless a third one is nearer.
        normal = unit[last] - unit[first]
        a, b = _heights(normal, begin, end)
        middle = begin + np.clip(a / np.maximum(a + b, 1e-300), 0, 1)[:, None] * (end - begin)
        middle /= np.linalg.norm(middle, axis=1)[:, None]
        distance, nearest = (np.asarray(x) for x in tree.query(middle))
        own = np.linalg.norm(middle - unit[first], axis=1)
        third = (distance < own - _TIE) & (nearest != first) & (nearest != last)
        pairs.append(np.column_stack([first, last])[~third])
        found.append(nearest[third])
        begin, middle, end = begin[third], middle[third], end[third]
        first, nearest, last = first[third], nearest[third], last[third]
        begin, end = np.concatenate([begin, middle]), np.concatenate([middle, end])
        first, last = np.concatenate([first, nearest]), np.concatenate([nearest, last])
    crossed = np.unique(np.concatenate(found))
    beside = _common_neighbors(diagram, np.concatenate(pairs))
    return np.union1d(crossed[crossed < n], beside)


def rings_around(diagram: Diagram, inside: np.ndarray, count: int) -> np.ndarray:
    """Return 0 for cells inside, k for those in the k-th ring of neighbors around them, else -1; (n,) int32."""
    inner = diagram.neighbors >= 0
    i, j = face_owners(diagram)[inner], diagram.neighbors[inner]
    ring = np.where(inside, 0, -1).astype(np.int32)
    for k in range(1, count + 1):
        front = j[ring[i] == k - 1]
        ring[front[ring[front] < 0]] = k
    return ring


def _heights(normal: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of both ends from the planes with these normals, not negative."""
    a, b = -(normal * begin).sum(axis=1), (normal * end).sum(axis=1)
    return np.maximum(a, 0), np.maximum(b, 0)


def _divided(line: np.ndarray) -> np.ndarray:
    """Return the line with more positions, at most `_STEP` apart."""
    steps = np.abs(np.diff(line, axis=0)).max(axis=1)
    counts = np.maximum(np.ceil(steps / _STEP), 1).astype(int)
    segment = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(segment)) - (np.cumsum(counts) - counts)[segment]) / counts[segment]
    made = line[segment] + share[:, None] * (line[segment + 1] - line[segment])
    made = np.concatenate([made, line[-1:]])
    made[:, 0] = np.mod(made[:, 0], 360)
    return made


def _common_neighbors(diagram: Diagram, pairs: np.ndarray) -> np.ndarray:
    """Return the cells that are neighbors of both cells of a pair that are not neighbors of each other."""
    n = len(diagram)
    pairs = np.unique(pairs[(pairs < n).all(axis=1)], axis=0)
    starts, neighbors = diagram.neighbor_starts, diagram.neighbors
    found = [np.empty(0, np.int64)]
    for i, j in pairs.tolist():
        around, others = (neighbors[starts[k] : starts[k + 1]] for k in (i, j))
        if j not in around:
            both = np.intersect1d(around, others)
            found.append(both[both >= 0])
    return np.unique(np.concatenate(found))
