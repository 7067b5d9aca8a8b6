"""The mesh of a solid, from the generators of a tessellation."""

from __future__ import annotations

import gc
from dataclasses import replace
from typing import cast

import numpy as np
import pyopencl.array as cla

from ...errors import InputError
from ...finite_volumes.solid_walls.mesh import off_middle, outer_generators, solid_diagram
from ...finite_volumes.solid_walls.settling import CellTargets
from ...finite_volumes.solid_walls.wall_surface import WallSurface
from ...geometry.box import Box
from ...geometry.domain import Domain
from ...geometry.solid.solid import Solid
from ...mesh.diagram import Diagram
from ...mesh.faces import Faces
from ...opencl.engine import Engine
from ..device_diagram import Tessellation
from ..own_planes import SurfaceSearch
from ..stages import TessellationStages
from .diagram import make_diagram, order_of

_MARGIN = 4.0
"""Distance of the box that holds all generators from the solid, over the largest h."""
_COLLECTS = 50_000
"""From so many cells on the memory of trials is worth the .1 s that it takes to find it."""


def read_generators(domain: Domain, t: Tessellation, labels: cla.Array) -> tuple[np.ndarray, np.ndarray]:
    """Return the generators of `t` in the order of `labels` (n,), (n, 3) float, and the sizes of their cells, (n,)."""
    origin, scale = domain.frame
    order = order_of(labels.get()[: t.n])
    points = origin + scale * t.points.get()[: t.n, :3][order].astype(float)
    return points, scale * np.cbrt(t.volumes.get()[: t.n][order].astype(float))


def mesh_volumes(engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array) -> np.ndarray:
    """Return the volumes of cells in the mesh of a solid, (n,) by labels; 0 for generators of `t` without a cell."""
    points, sizes = read_generators(domain, t, labels)
    try:
        mesh = make_mesh(engine, cast("Solid", domain), points, sizes, warns=False)
    except InputError:  # raised at the end of the run, too
        return np.zeros(t.n)
    assert mesh.home is not None
    return np.bincount(np.where(mesh.home < 0, -1 - mesh.home, mesh.home), mesh.volumes, t.n)


def make_mesh(
    engine: Engine,
    domain: Solid,
    points: np.ndarray,
    sizes: np.ndarray,
    warns: bool = True,
    spread: bool = True,
    held: int | None = 0,
    targets: CellTargets | None = None,
) -> Diagram:
    """Return the mesh of a solid by its generators `points` (n, 3), for cells of the `sizes` (n,).

    In a run each cell is cut by planes of its own, and cells do not fit together. The mesh has the Voronoi cells of the
    same generators, cut at the surface. With `warns` the function warns of defects of the mesh. With `spread` those in
    thin parts do not stay halfway between the walls. The first `held` generators are not moved; if it is None, all are
    given, and move only where OpenFOAM would reject cells. With `targets` those near walls move; see `settled`.
    """
    tell = engine.pool.on_work or (lambda _: None)
    tell("diagram of all cells")
    surface = WallSurface(domain, SurfaceSearch(engine, domain, domain.wall_triangles).nearest)
    if spread:
        points = off_middle(surface, points, sizes)
    reach = _MARGIN * sizes.max()
    box = Box(tuple(np.subtract(domain.lower, reach).tolist()), tuple(np.add(domain.upper, reach).tolist()))

    def whole(points: np.ndarray) -> Faces:
        stages = TessellationStages(engine.replaced(traits=box.traits(engine.real)))
        diagram = make_diagram(stages, box, points, outer_generators(surface, points, sizes))
        stages.release()  # what is read holds its own arrays
        faces = replace(diagram.faces, diagram=None)
        del diagram.faces  # they name each other: their arrays would wait for the garbage collector
        return faces

    straight = held is not None and domain.sheets is None
    made = solid_diagram(surface, points, sizes, whole, tell, warns, held or 0, straight, targets if straight else None)
    if len(points) > _COLLECTS:
        gc.collect()  # meshes and their measures name each other: those of trials would stay in memory
    return made
