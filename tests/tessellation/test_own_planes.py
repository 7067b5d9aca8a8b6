"""Walls of solids on the device: each cell is cut by planes of its own."""

from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.geometry.solid.solid import Solid
from clvoro.geometry.triangles import packed_rows, packed_weights
from clvoro.opencl.engine import Engine
from clvoro.tessellation.device_diagram import read_report
from clvoro.tessellation.own_planes import SolidBox, SurfaceSearch
from clvoro.tessellation.stages import TessellationStages
from clvoro.tessellation.tessellator import Tessellator
from tests.reference.own_planes import own_planes

REALS = [np.dtype(np.float64), np.dtype(np.float32)]


def corner(lengths=(2.0, 2.0, 1.0), notch=(1.0, 1.0, 1.0)):
    """Return a box without a box at its upper corner: one concave crease if the notch is as high as the box."""
    lattice = [np.unique([0.0, a - b, a]) for a, b in zip(lengths, notch, strict=True)]
    full = np.ones([len(axis) - 1 for axis in lattice], bool)
    full[-1, -1, -1] = False
    return lattice_solid(lattice, full)


def lattice_solid(lattice, full):
    """Return the union of the boxes of a lattice where `full` is true."""
    corners, triangles = [], []
    padded = np.pad(full, 1)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for step in (-1, 1):
            inner = np.argwhere(full & ~np.roll(padded, -step, axis)[1:-1, 1:-1, 1:-1])
            for cell in inner:
                quad = []
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    at = cell.copy()
                    at[axis] += step > 0
                    at[u] += a
                    at[v] += b
                    quad.append([lattice[k][at[k]] for k in range(3)])
                first = len(corners)
                corners += quad[::step]
                triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return Solid(np.array(corners), np.array(triangles))


SOLIDS = {
    "box": lambda: Solid.box((0, 0, 0), (1, 1, 1)),
    "L": corner,
    "Fichera": lambda: corner((2.0, 2.0, 2.0)),
    "cylinder": lambda: Solid.cylinder((0, 0, 0), (0, 0, 2), 1.0, edge=0.2),
    "ball": lambda: Solid.ball((0, 0, 0), 1.0, edge=0.2),
}


def inner_points(solid, n, seed=0):
    rng = np.random.default_rng(seed)
    x = solid.lower + solid.extent * rng.random((4 * n, 3))
    return x[solid.contains(x)][:n]


class Device:
    """Diagrams of a solid from random generators."""

    def __init__(self, ctx, solid, real, points):
        adapter = clvoro.Adapter(ctx, dtype=real.name)
        self.engine = Engine(adapter.ctx, adapter.queue, 3, real, solid.traits(real))
        self.stages = TessellationStages(self.engine)
        self.tessellator = Tessellator(self.stages, solid)
        placed = self.engine.upload(solid.place(points, real))
        binned = self.stages.bins.build(solid, placed, len(points))
        self.points = binned.points[: len(points)].copy()

    def diagram(self, previous=None):
        return self.tessellator.tessellate(self.points, len(self.points), previous)

    def sort(self):
        return self.stages.bins.build(self.tessellator.domain, self.points, len(self.points))

    def move(self, t, share):
        self.points = self.engine.upload(self.points.get() + share * t.offsets.get())


def rows_of(t):
    neighbors = t.neighbors.get()
    return [frozenset(neighbors[a:b].tolist()) for a, b in pairwise(t.starts.get())]


@pytest.mark.parametrize("real", REALS, ids=str)
@pytest.mark.parametrize("name", SOLIDS)
def test_planes_are_those_of_the_reference(ctx, name, real):
    solid = SOLIDS[name]()
    device = Device(ctx, solid, real, inner_points(solid, 300))
    box = SolidBox(device.engine, solid, solid.wall_triangles)
    n, scale = len(device.points), solid.frame[1]
    binned = device.stages.bins.build(solid, device.points, n)
    box.guess(binned, n)
    box.find(device.points)
    x = device.points.get().astype(float) * scale + solid.frame[0]
    reach = box._reach.get()[:n].astype(float) * scale
    expected = own_planes(solid, x, reach)
    rows, labels, planes = box._rows.get()[:n], box._labels.get(), box._planes.get()
    found = np.concatenate([np.arange(first, first + count) for first, count in rows])
    owner = np.repeat(np.arange(n), rows[:, 1])
    order = np.lexsort((-labels[found], owner))
    owner, found = owner[order], found[order]
    assert box.outside == len(expected.behind) == 0
    assert (owner == expected.row).all()
    assert (-1 - labels[found] == expected.patch).all()
    assert np.abs(planes[found, :3] - expected.normal).max() < 1e3 * np.finfo(real).eps
    assert np.abs(planes[found, 3] * scale - expected.depth).max() < 1e2 * np.finfo(real).eps


@pytest.mark.parametrize("real", REALS, ids=str)
@pytest.mark.parametrize("name", ["L", "ball"])
def test_nearest_triangles_are_those_of_all(ctx, name, real):
    solid, reach = SOLIDS[name](), 0.1
    adapter = clvoro.Adapter(ctx)
    engine = Engine(adapter.ctx, adapter.queue, 3, real, solid.traits(real))
    search = SurfaceSearch(engine, solid, solid.wall_triangles)
    x = np.random.default_rng(3).uniform(solid.lower, solid.upper, (200, 3))
    corners = solid.surface.corners
    each = np.stack([np.sqrt(packed_weights(x, packed_rows(np.repeat(t[None], len(x), 0)))[2]) for t in corners])
    best, noise = each.min(axis=0), float(1e2 * np.finfo(real).eps)
    found = search.nearest(x, np.inf)
    assert each[found, np.arange(len(x))] == pytest.approx(best, abs=noise)
    near = search.nearest(x, reach)
    assert ((near >= 0) == (best <= reach)).all()
    assert (near[near >= 0] == found[near >= 0]).all()


@pytest.mark.parametrize("real", REALS, ids=str)
@pytest.mark.parametrize("name", ["box", "Fichera", "ball"])
def test_updates_are_new_diagrams(ctx, name, real):
    solid = SOLIDS[name]()
    device = Device(ctx, solid, real, inner_points(solid, 1500))
    t = device.diagram()
    for _ in range(6):
        device.move(t, 1.0)
        t = device.diagram()
    t, steps, updated = device.diagram(), device.tessellator.steps, 0
    for _ in range(3):
        device.move(t, 0.1)
        found = steps.update(device.points, len(device.points), t, device.sort, read_report)
        updated += found is not None
        t = found or device.diagram()
    assert updated > 0
    volumes, rows = t.volumes.get(), rows_of(t)
    fresh = device.diagram()
    assert np.allclose(volumes, fresh.volumes.get(), rtol=0, atol=1e3 * np.finfo(real).eps * volumes.mean())
    assert rows == rows_of(fresh)
    assert all(i in rows[j] for i, row in enumerate(rows) for j in row if j >= 0)
    total = volumes.sum(dtype=float) * solid.frame[1] ** 3 / solid.measure
    assert total == pytest.approx(1, abs=1e3 * float(np.finfo(real).eps) if name == "box" else 0.03)


@pytest.mark.parametrize("real", REALS, ids=str)
def test_nothing_leaks_through_a_thin_plate(ctx, real):
    h = 0.15
    lattice = [np.array([0, 0.9, 0.9 + 2 * h, 2.1]), np.array([0, 0.6, 1.4, 2]), np.array([0, 0.6, 1.4, 2])]
    full = np.ones((3, 3, 3), bool)
    full[1, 1, 1] = False  # a plate in the fluid
    solid = lattice_solid(lattice, full)
    device = Device(ctx, solid, real, inner_points(solid, round(solid.measure / h**3)))
    t = device.diagram()
    for _ in range(5):
        device.move(t, 0.9)
        t = device.diagram(t)
    x = t.points.get().astype(float) * solid.frame[1] + solid.frame[0]
    side = np.where(np.abs(x[:, 1:] - 1).max(axis=1) < 0.4 - h, np.sign(x[:, 0] - 0.9 - h), 0)
    rows = rows_of(t)
    assert (np.abs(side) > 0).sum() > 100
    assert not any(side[i] * side[j] < 0 for i, row in enumerate(rows) for j in row if j >= 0)
    assert t.volumes.get().sum(dtype=float) * solid.frame[1] ** 3 == pytest.approx(solid.measure, rel=0.02)


def test_walls_bent_around_a_generator_cut_its_cell_on_all_sides(ctx):
    """In a rod as thin as a cell, and in the tip of a cone, planes are a tenth of the depth, about, inside of walls."""
    rod, cone = clvoro.Solid.cylinder((0, 0, 0), (0, 0, 2), 0.2), clvoro.Solid.cone((0, 0, 0), (0, 0, 2), 1)
    cases = (rod, (0.01, 0.02, 1.0), 0.0), (cone, (0.01, 0.02, 1.7), 0.5), (cone, (0.01, 0.02, 1.6), 0.5)
    for solid, x, slope in cases:
        device = Device(ctx, solid, np.dtype(np.float64), np.array([x]))
        box = SolidBox(device.engine, solid, solid.wall_triangles, lambda y: np.full(len(y), 0.25))
        box.guess(device.sort(), 1)
        box._reach.fill(0.6 / solid.frame[1])
        box.find(device.points)
        first, count = box._rows.get()[0]
        planes = box._planes.get()[first : first + count]
        planes = planes[np.abs(planes[:, 2] - slope / np.hypot(1, slope)) < 0.02]  # not one at the tip itself
        assert len(planes) >= 4
        assert -1 < planes[:, :2].min(axis=0).max() < 0 < planes[:, :2].max(axis=0).min() < 1
        axis = np.array([0, 0, 2]) if slope else np.array([0, 0, x[2]])
        radius = 0.0 if slope else 0.2
        depth = planes[:, :3] @ (axis - x) + radius * np.linalg.norm(planes[:, :2], axis=1)
        assert planes[:, 3] * solid.frame[1] == pytest.approx(0.9 * depth, abs=0.01)
