"""A diagram on the device and its copy on the host: what the tests of the stages start from."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pyopencl as cl

from clvoro.adaptation.stages import Stages
from clvoro.adaptation.state import MeshState, Setup
from clvoro.adaptation.tuning import SHORT_FACE
from clvoro.geometry.box import Box
from clvoro.opencl.engine import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.cells import Cells
from clvoro.tessellation.part import Part
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import diagrams, diagrams3d

BOX = Box((0, 0), (1, 0.75))
"""Its frame is the unit square's: normalized coordinates are physical ones."""
BOXES = {
    "plane": BOX,
    "space": Box((0, 0, 0), (1, 0.75, 0.9)),
    "torus": Box((0, 0), (1, 0.75), periodic=True),
    "slab": Box((0, 0, 0), (1, 0.75, 0.9), periodic=(True, False, True)),
}
"""Boxes of all kinds. The frame of each is the unit square or cube."""


def make_engine(ctx, real="float64", dim=2, group_size=None, box=BOX):
    """Return an engine for `box`; with `group_size` as on a GPU also where the device is a CPU."""
    real = np.dtype(real)
    engine = Engine(ctx, cl.CommandQueue(ctx), dim, real, box.traits(real))
    if group_size is not None:
        object.__setattr__(engine, "group_size", group_size)
    return engine


def make_mesh(stages, domain, sizing, points, size_factor=1.0, fixed=0, labels=None):
    """Return the mesh of `points` (n, d) on the device, in normalized coordinates; `labels` are by default 0 to n."""
    setup = Setup(stages, domain, sizing, domain, fixed, np.empty((0, domain.dim)))
    labels = stages.engine.upload(np.arange(len(points)) if labels is None else labels, np.int32)
    return MeshState(setup, size_factor, {"points": points, "labels": labels})


def tessellate(engine, points, box=BOX):
    """Return the tessellation by `points` (n, d) in their order, in buffers of its own."""
    n, on_device = len(points), engine.upload(points)
    binned = Bins(engine).build(box, on_device, n)
    cells = Cells(engine) if box.cell_dim == 2 else Polyhedra(engine)
    return cells.tessellate(Part.alone(on_device, box), binned)


def tessellate_box(engine, box, n, seed):
    """Return the tessellation of any box by `n` random generators, some 250 for five across a period in space."""
    on_device = engine.upload(box.place(random_points(n, seed, box), engine.real))
    return Tessellator(Stages(engine), box).tessellate(on_device, n)


def fetch(t):
    """Return the arrays of `t` as NumPy's, faces cut to their number, and `owners` (m,) of the faces."""
    starts = t.starts.get()
    m = int(starts[t.n])
    names = ("neighbors", "face_measures", "face_centroids")
    faces = {name: getattr(t, name).get()[:m] for name in names}
    cells = {name: getattr(t, name).get() for name in ("points", "volumes", "offsets", "covariances")}
    owners = np.repeat(np.arange(t.n), np.diff(starts))
    return SimpleNamespace(n=t.n, starts=starts, owners=owners, **faces, **cells)


def ways(host, box):
    """Return the vector from each face's generator to the nearest image of its neighbor, (m, d); walls are left out."""
    across = host.points[np.maximum(host.neighbors, 0)].astype(float) - host.points[host.owners]
    across[host.neighbors < 0] = 0
    periods = np.where(box.periodic, box.extent, 1)
    return across - np.rint(across / periods) * np.where(box.periodic, periods, 0)


def free_depth(ways, inwards, gap, most):
    """How far a cell reaches from a wall, by the `ways` to its neighbors (k, d), up to `most`; see refinement.cl."""
    ahead = ways @ inwards > 0
    reach = (ways**2).sum(axis=1)[ahead] / (2 * (ways @ inwards)[ahead])
    return (max(gap, 0) + reach).min(initial=most)


def children(host, box, h, held=None):
    """Middles of all edges across faces of some size, and one point between each wall and its cells; see refinement.cl.

    Cells that are `held` (n,), and their faces, are left out.
    """
    made, across = [], ways(host, box)
    held = np.zeros(len(host.points), bool) if held is None else held
    for k, (i, j) in enumerate(zip(host.owners, host.neighbors, strict=True)):
        if held[i] or (j >= 0 and held[j]):
            continue
        child = host.points[i].astype(float)
        if j < 0:
            axis, upper = divmod(-1 - j, 2)
            wall = (box.lower, box.upper)[upper][axis]
            gap, most = abs(child[axis] - wall), min(h[i], box.extent[axis] / 2)
            inwards = (1 - 2 * upper) * np.eye(box.dim)[axis]
            room = free_depth(across[host.owners == i], inwards, gap, most)
            between = gap > most / 8 or room < 3 * gap
            way = min(gap / 2, h[i] / 4) if between else room / 2
            child[axis] = wall - way if upper else wall + way
        elif j > i and host.face_measures[k] > SHORT_FACE * host.volumes[i] ** (1 - 1 / box.dim):
            child = child + across[k] / 2
            child = np.where(box.periodic, child % box.extent, child)
        else:
            continue
        made.append(child)
    return np.array(made)


def hexagons(a, box=BOX):
    """Return the points of a hexagonal lattice of spacing `a` that lie in the box, none near a wall."""
    rows = np.arange(a / 4, box.upper[1] - a / 4, a * np.sqrt(3) / 2)
    lines = [
        np.stack([x := np.arange(a / 4 + a / 2 * (k % 2), box.upper[0] - a / 8, a), np.full_like(x, y)], 1)
        for k, y in enumerate(rows)
    ]
    return np.concatenate(lines)


def random_points(n, seed, box=BOX):
    x = np.random.default_rng(seed).random((n, box.dim)) * box.extent + box.lower
    return x if box.cell_dim == box.dim else box.wrap(x)


def relaxed_points(n, seed, steps=8, box=BOX):
    """Random points after some steps of Lloyd's: cells of all shapes, but none degenerate."""
    points = random_points(n, seed, box)
    for _ in range(steps):
        cells = (diagrams if box.dim == 2 else diagrams3d).box_voronoi(box.lower, box.upper, points)
        points = np.array([c.centroid for c in cells])
    return points
