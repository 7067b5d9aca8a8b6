"""Make a diagram on a sphere from generators and corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ...geometry.sphere import Sphere
from ...geometry.sphere_region import SphereRegion
from ...geometry.spherical_triangles import triangle_areas
from ...io.arrays import FileError
from ...mesh.connectivity import following
from ...mesh.diagram import Diagram
from ...mesh.spherical import rebuild_on_sphere

OFF_SPHERE = 1e-5
"""Largest distance of a position from its sphere in units of the radius: round-off of float32, and more."""
_SAME = 0.05
"""Positions of removed generators are the same if they are nearer to each other than this share of the least distance
from their cells."""


@dataclass
class MeshInFile:
    """The cells of a mesh on a sphere, as a file has them.

    Attributes
    ----------
    radius : float
    points, vertices : (n, 3), (v, 3) float64
        Generators and corners on the sphere.
    counts : (n,) int
        Numbers of corners of the cells.
    corners : (m,) int
        Corners of the cells, one cell after the other, counter-clockwise.
    middles : (m, 3) float64, optional
        For the face from each corner to the next the middle of the arc between its generators.
    of_run : three (n,) float64, optional
        Size, error and quality.
    """

    radius: float
    points: np.ndarray
    vertices: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    middles: np.ndarray | None = None
    of_run: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def make_diagram(cells: MeshInFile) -> Diagram:
    """Return the diagram of `cells`; without the whole sphere it is that of a `SphereRegion`.

    Raises
    ------
    FileError
        If positions are not on the sphere, a cell has fewer than two corners or is not counter-clockwise, or a face
        is in more than two cells.
    """
    n, radius = len(cells.points), cells.radius
    if not n or not np.isfinite(radius) or radius <= 0:
        raise FileError(f"it has {n} cells on a sphere of radius {radius:g}")
    for name, places in (("generators", cells.points), ("corners", cells.vertices)):
        off = np.abs(np.linalg.norm(places, axis=1) / radius - 1)
        if not (off < OFF_SPHERE).all():
            k = int(np.argmax(~(off < OFF_SPHERE)))
            raise FileError(f"{name}[{k}] is {places[k]}, not on the sphere of radius {radius:g}")
    if cells.counts.min() < 2:
        raise FileError(f"cell {cells.counts.argmin()} has {cells.counts.min()} corners")
    starts = np.concatenate([[0], np.cumsum(cells.counts)])
    owner = np.repeat(np.arange(n), cells.counts)
    ends = np.stack([cells.corners, cells.corners[following(starts)]], axis=1)
    x, v = cells.points / radius, cells.vertices / radius
    areas = np.bincount(owner, triangle_areas(x[owner], v[ends[:, 0]], v[ends[:, 1]]), n)
    if not (areas > 0).all():
        k = int(np.argmax(~(areas > 0)))
        raise FileError(f"cell {k} does not surround its generator counter-clockwise")
    volumes = areas * radius**2
    neighbors = _neighbors(owner, ends, len(v))
    alone = np.flatnonzero(neighbors < 0)
    sphere = Sphere(radius)
    if len(alone):
        beyond, walls = _removed(cells, owner[alone], ends[alone], alone)
        neighbors[alone] = -1 - walls
        area = min(float(volumes.sum()), sphere.measure)
        within = cells.points[np.unique(owner[alone])]
        sphere = SphereRegion(radius, within=within, beyond=beyond, area=area)
    known = {
        "points": cells.points,
        "volumes": volumes,
        "neighbor_starts": starts.astype(np.int32),
        "neighbors": neighbors.astype(np.int32),
        "vertices": cells.vertices,
        "cell_vertex_starts": starts.astype(np.int32),
        "cell_vertices": cells.corners.astype(np.int32),
    }
    return Diagram(sphere, {**known, **rebuild_on_sphere(Diagram(sphere, known))})


def _neighbors(owner: np.ndarray, ends: np.ndarray, v: int) -> np.ndarray:
    """Return the cell with the opposite of each face (m, 2); -1 without one."""
    here, there = ends[:, 0] * v + ends[:, 1], ends[:, 1] * v + ends[:, 0]
    order = np.argsort(here)
    ranked = here[order]
    same = np.flatnonzero(ranked[1:] == ranked[:-1])
    if len(same):
        a, b = owner[order[same[0]]], owner[order[same[0] + 1]]
        raise FileError(f"cells {a} and {b} are on the same side of a face")
    place = np.minimum(np.searchsorted(ranked, there), len(ranked) - 1)
    return np.where(ranked[place] == there, owner[order[place]], -1)


def _removed(
    cells: MeshInFile, owner: np.ndarray, ends: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the generators of removed cells (b, 3), and which of them is behind each boundary face (k,).

    A face is on the bisector of both generators. So the other one is the reflection of that of the cell, through the
    middle of the arc between them, or else at the plane of the face.
    """
    radius = cells.radius
    own = cells.points[owner] / radius
    v, w = (cells.vertices[ends[:, k]] / radius for k in (0, 1))
    lengths = np.linalg.norm(w - v, axis=1)
    if cells.middles is not None:
        middle = cells.middles[faces] / np.linalg.norm(cells.middles[faces], axis=1)[:, None]
        other = 2 * (own * middle).sum(axis=1)[:, None] * middle - own
    else:
        normal = np.cross(v, w - v)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal /= np.linalg.norm(normal, axis=1)[:, None]
        other = own - 2 * (own * normal).sum(axis=1)[:, None] * normal
    usable = np.isfinite(other).all(axis=1)
    if not usable.any():
        raise FileError("its boundary has no face with a length")
    other = np.where(usable[:, None], other, own)
    away = np.linalg.norm(other - own, axis=1)
    near = scipy.spatial.KDTree(other).query_pairs(_SAME * float(away[usable].min()), output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(near), np.int8), (near[:, 0], near[:, 1])), (len(own),) * 2)
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    # The longest face of each removed cell places its generator best. Walls are in the order of their first faces.
    rank = np.lexsort((-lengths, ~usable, label))
    best = rank[np.flatnonzero(np.diff(label[rank], prepend=-1))]
    return radius * other[best], label
