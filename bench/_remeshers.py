"""Classical remeshing of boxes: Gmsh and MMG with the edge lengths of a size field, as peers.

Both make triangles or tetrahedra. Their vertices are generators of Voronoi cells; those on walls have cells that are
cut. A mesher does not promise a number of vertices, so `remesh` scales its sizes until it is right to 2 %. Times are
processor times of the last call, in one thread. Gmsh reads its sizes from a file, which is not part of its time.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import clvoro
from clvoro import sizing

EDGE = {2: 1.0746, 3: 1.12}
"""Edge length over h: in 2D that of a hexagonal lattice with cells of area h^2; in 3D for equal numbers on S1."""
FINENESS, MOST_POINTS = 1.5, {2: 4000, 3: 160}
"""Grid from which Gmsh interpolates sizes: points per smallest size, and most points along a side."""
PASSES = 4
"""Passes of MMG, each with the sizes at the vertices of the one before."""
ROUNDS = 3


class MissingPeerError(Exception):
    """A peer is not installed. The message says what to install."""


@contextmanager
def gmsh_with(**options: float) -> Iterator[Any]:
    """Yield Gmsh in one thread, with `options` for its meshes: sizes are those of fields, or those given."""
    try:
        import gmsh
    except (ModuleNotFoundError, OSError) as error:
        raise MissingPeerError(f"gmsh (pip install gmsh): {error}") from error
    gmsh.initialize(interruptible=False)
    try:
        from_others = ("MeshSizeFromPoints", "MeshSizeFromCurvature", "MeshSizeExtendFromBoundary")
        for name, value in {**dict.fromkeys(from_others, 0), **options}.items():
            gmsh.option.setNumber(f"Mesh.{name}", value)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        yield gmsh
    finally:
        gmsh.finalize()


def grid(domain: clvoro.Box, counts: np.ndarray) -> np.ndarray:
    """Return the points (n, d) of a grid over the box, walls included."""
    axes = [np.linspace(a, b, k) for a, b, k in zip(domain.lower, domain.upper, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, domain.dim)


def vertices_gmsh(domain: clvoro.Box, size: sizing.Field, edge: float) -> tuple[np.ndarray, float]:
    """Return the vertices (n, d) of Gmsh's mesh with edges of `edge` h, and seconds.

    "Frontal-Delaunay" in 2D, "HXT" in 3D.
    """
    d, extent = domain.dim, np.array(domain.extent)
    least = np.asarray(size(grid(domain, np.full(d, 64)))).min()
    counts = np.clip(np.ceil(FINENESS * extent / least).astype(int), 2, MOST_POINTS[d])
    values = edge * np.asarray(size(grid(domain, counts)))
    with tempfile.TemporaryDirectory() as folder:
        file, flat = Path(folder, "sizes"), 3 - d
        steps = np.append(extent / (counts - 1), [1.0] * flat)
        header = np.append(domain.lower, [0.0] * flat), steps
        numbers = np.append(counts, [1] * flat).astype(np.int32)
        file.write_bytes(b"".join(a.astype(float).tobytes() for a in header) + numbers.tobytes() + values.tobytes())
        start = time.process_time()
        with gmsh_with(Algorithm=6, Algorithm3D=10) as gmsh:
            if d == 2:
                gmsh.model.occ.addRectangle(*domain.lower, 0, *extent)
            else:
                gmsh.model.occ.addBox(*domain.lower, *extent)
            gmsh.model.occ.synchronize()
            field = gmsh.model.mesh.field.add("Structured")
            gmsh.model.mesh.field.setString(field, "FileName", str(file))
            gmsh.model.mesh.field.setNumber(field, "TextFormat", 0)
            gmsh.model.mesh.field.setAsBackgroundMesh(field)
            gmsh.model.mesh.generate(d)
            seconds = time.process_time() - start
            _, nodes, _ = gmsh.model.mesh.getNodes()
    return np.clip(nodes.reshape(-1, 3)[:, :d], domain.lower, domain.upper), seconds


def vertices_mmg(domain: clvoro.Box, size: sizing.Field, edge: float) -> tuple[np.ndarray, float]:
    """Return the vertices (n, d) of MMG's mesh with edges of `edge` h, and seconds.

    It begins with the Delaunay triangulation of a coarse grid. The last pass changes little.
    """
    try:
        import mmgpy
    except (ModuleNotFoundError, OSError) as error:
        raise MissingPeerError(f"mmgpy (pip install mmgpy): {error}") from error
    from scipy.spatial import Delaunay

    d, extent = domain.dim, np.array(domain.extent)
    counts = np.maximum(4, np.round(extent / extent.min() * (24 if d == 2 else 10)).astype(int))
    vertices = grid(domain, counts)
    simplices = _boxes(counts) if d == 3 else Delaunay(vertices, qhull_options="QJ").simplices
    simplices = _oriented(vertices, simplices)
    kind = mmgpy.MmgMesh2D if d == 2 else mmgpy.MmgMesh3D
    start = time.process_time()
    for _ in range(PASSES):
        mesh = kind(vertices, simplices.astype(np.int32))
        mesh.set_field("metric", edge * np.asarray(size(vertices))[:, None])
        mesh.remesh(hgrad=-1.0, verbose=-1)
        vertices = np.clip(mesh.get_vertices(), domain.lower, domain.upper)
        simplices = mesh.get_triangles() if d == 2 else mesh.get_tetrahedra()
    return vertices, time.process_time() - start


def _boxes(counts: np.ndarray) -> np.ndarray:
    """Return the tetrahedra (m, 4) of a grid of points: six around a diagonal of each of its boxes."""
    index = np.arange(counts.prod()).reshape(counts)
    corner = {
        code: index[tuple(slice(c, n - 1 + c) for c, n in zip(code, counts, strict=True))].ravel()
        for code in product((0, 1), repeat=3)
    }
    tetrahedra = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        code, path = [0, 0, 0], [(0, 0, 0)]
        for axis in order:
            code[axis] = 1
            path.append(tuple(code))
        tetrahedra.append(np.column_stack([corner[p] for p in path]))
    return np.concatenate(tetrahedra)


def _oriented(vertices: np.ndarray, simplices: np.ndarray) -> np.ndarray:
    """Return the simplices with positive volume, those without volume left out."""
    corners = vertices[simplices]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1])
    least = 1e-9 * np.abs(volume).max()
    turned = np.where((volume < 0)[:, None], simplices[:, [1, 0, *range(2, simplices.shape[1])]], simplices)
    return turned[np.abs(volume) > least]


Mesher = Callable[[clvoro.Box, sizing.Field, float], tuple[np.ndarray, float]]


def remesh(mesher: Mesher, domain: clvoro.Box, size: sizing.Field, count: int) -> tuple[np.ndarray, float]:
    """Return about `count` vertices (n, d) of a mesher, and the seconds of its last call."""
    edge = EDGE[domain.dim]
    for _ in range(ROUNDS):
        vertices, seconds = mesher(domain, size, edge)
        ratio = len(vertices) / count
        if abs(math.log(ratio)) < 0.02:
            break
        edge *= ratio ** (1 / domain.dim)
    return vertices, seconds


MESHERS: dict[str, Mesher] = {"Gmsh": vertices_gmsh, "MMG": vertices_mmg}
