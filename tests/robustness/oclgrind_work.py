"""Small work for every kernel on the simulator Oclgrind: `python -m tests.robustness.oclgrind_work NAME [OPTION ...]`.

Prints one JSON object: which kernels have run ("file.kernel"), and how often.
`tests/robustness/test_oclgrind.py` starts it and reads the simulator's log. Options: `float32`; `groups`, work-groups
as on a GPU (16 work-items, with local memory and barriers) instead of a CPU's groups of one; `teams`, cells in 3D by
teams of work-items.
"""

from __future__ import annotations

import collections
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from unittest import mock

import numpy as np
import pyopencl as cl
from scipy.spatial import ConvexHull

import clvoro
from clvoro.adaptation.insertion_deletion import CellSizes, Change, Generators, InsertionDeletion, Present
from clvoro.adaptation.stages import Stages
from clvoro.opencl import program as _program
from clvoro.opencl.engine import Engine
from clvoro.opencl.primitives import Scan
from clvoro.sizing import Ball, Circle, ClosedPolyline, Distance, Expression, Graded, Raster, Sizing, Surface, minimum
from clvoro.sizing.derivatives import CellStencils, Derivatives
from clvoro.tessellation import back_ends
from clvoro.tessellation.cells import SLOT
from clvoro.tessellation.part import Part
from clvoro.tessellation.tessellator import Tessellator
from tests.reference.patch import BOX as PATCH
from tests.reference.patch import hexagons, tessellate
from tests.robustness.gpu_like import use_groups
from tests.robustness.oclgrind_runs import COMB, ROD, RUNS, SQUARE, every_step, large

back_ends.LANES_FROM.update({2: 0, 3: 0})  # lanes for small meshes, too
BOX = clvoro.Box((0, 0), (2.5, 1.5))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
GRADED = "0.12 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)"
SOLID = "0.3 + 0.2*x"


def points(n: int, dim: int = 2, seed: int = 733) -> np.ndarray:
    return np.random.default_rng(seed).random((n, dim))


def diagrams(adapter: clvoro.Adapter) -> None:
    """Sets that need every branch: few, lattice, cluster (bins in bins), cocircular (rows enlarged)."""
    square = clvoro.Box((0, 0), (1, 1))
    to_the_walls = np.stack(np.meshgrid(*[np.arange(5) / 4] * 2), axis=-1).reshape(-1, 2)
    cluster = np.concatenate([points(15), 0.3 + 1e-4 * points(60)])
    angle = np.linspace(0, 2 * np.pi, 29)[:-1]
    ring = 0.5 + 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for each in (points(1), points(2), to_the_walls, lattice(4, 2), cluster, np.vstack([ring, [[0.5, 0.5]]])):
        diagram = adapter.diagram(square, each)
        assert abs(diagram.volumes.sum() - 1) < 1e-4
        assert len(diagram.vertices) > 3
    drop_loops(adapter)


def hulls(adapter: clvoro.Adapter) -> None:
    """Sets for which gift wrapping fails: too many or too few near ones, many scales, walls, lines."""
    square = clvoro.Box((0, 0), (1, 1))
    spots = [0.4 + scale * (points(30) - 0.5) for scale in (1e-2, 1e-4, 1e-6)]
    if adapter.dtype == np.float32:
        spots.pop()
    for each in (
        np.vstack([points(450) * (0.05, 1), [[0.99, 0.7]]]),
        np.vstack([*spots, points(9)]),
        points(90) ** 3,
        np.vstack([points(40) * (1, 1e-4), points(40)]),
        np.stack([np.linspace(0.01, 0.99, 77), np.full(77, 0.3)], axis=1),
        np.vstack([points(30), points(30) + 1e-4 * (points(30, seed=1) - 0.5)]),
    ):
        diagram = adapter.diagram(square, np.clip(each, 0, 1))
        assert abs(diagram.volumes.sum() - 1) < 1e-4


def lattice(side: int, dim: int) -> np.ndarray:
    line = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(*[line] * dim), axis=-1).reshape(-1, dim)


def almost_cubes(adapter: clvoro.Adapter) -> np.ndarray:
    """Return a 3D lattice with deviations so small that cells disagree about their common faces."""
    noise = np.random.default_rng(0).standard_normal((8, 3))
    return lattice(2, 3) + (1e-14 if adapter.dtype == np.float64 else 3e-6) * noise


def ring() -> np.ndarray:
    """Return places on a circle in space: all cells meet along a line."""
    rng = np.random.default_rng(7)
    turn = rng.uniform(0, 2 * np.pi, 30)
    plane = np.linalg.qr(rng.standard_normal((3, 3)))[0][:2]
    return 0.5 + 0.2 * np.column_stack([np.cos(turn), np.sin(turn)]) @ plane


def solid(adapter: clvoro.Adapter) -> None:
    """Three dimensions: the same kinds of sets, and almost a lattice."""
    near = almost_cubes(adapter)
    cluster = np.concatenate([points(6, 3), 0.3 + 1e-2 * points(12, 3)])
    ball = points(40, 3) - 0.5
    ball *= 0.4 / np.linalg.norm(ball, axis=1)[:, None]
    few = points(1, 3), points(2, 3), points(20, 3)
    for each in (*few, lattice(3, 3), near, ring(), cluster, np.vstack([0.5 + ball, [[0.5] * 3]])):
        diagram = adapter.diagram(CUBE, each)
        assert abs(diagram.volumes.sum() - 1) < 1e-4
        assert len(diagram.vertices) > 3


def method(name: str, box: clvoro.Box = BOX, size: str = GRADED, **options: object) -> Callable[[clvoro.Adapter], None]:
    def work(adapter: clvoro.Adapter) -> None:
        result = adapter.run(box, Expression(size), method=name, seed=911, **options)
        assert np.isfinite(result.size_error).all()
        result.diagram.vertices  # noqa: B018

    return work


def repaired(adapter: clvoro.Adapter) -> None:
    """Generators that move a little: a fifth of the cells change."""
    square, n = clvoro.Box((0, 0), (1, 1)), 120
    stages = adapter._stages_for(square)
    tessellator, where = Tessellator(stages, square), points(n)
    t = tessellator.tessellate(stages.engine.upload(where), n)
    for seed in range(2):
        where = np.clip(where + 0.008 * (points(n, seed=seed) - 0.5), 0, 1)
        x = stages.engine.upload(where)
        again = stages.update.update(stages.cells, square, x, t)
        assert again is not None
        t = again
        assert abs(t.volumes.get().sum() - 1) < 1e-4


def drop_faces(adapter: clvoro.Adapter) -> None:
    """Close rows that have lost faces, which round-off hardly ever causes."""
    for dim in (2, 3):
        which, n = (True, *(dim == 2,) * (dim - 1)), 30 if dim == 2 else 12
        box = clvoro.Box((0,) * dim, (1,) * dim, periodic=which)
        stages = adapter._stages_for(box)
        engine = stages.engine
        x = engine.upload(box.place(points(n, dim), adapter.dtype))
        t = Tessellator(stages, box).tessellate(x, n, exact=True, complete=True)
        ghosts = t.folded.part.ghosts
        values = engine.upload(np.append(np.arange(n), np.zeros(t.folded.part.count - n)), np.int32)
        t.folded.part.forward(engine, values)
        assert (values.get()[n:] == ghosts.rows.get()[: len(values) - n]).all()
        m = int(t.starts.get()[-1])
        kept = np.ones(m, np.uint8)
        kept[::7] = 0
        starts = np.concatenate([[0], np.cumsum(np.add.reduceat(kept.astype(int), t.starts.get()[:-1]))])
        left = int(starts[-1])
        ints = [engine.empty(left, np.int32) for _ in range(3)]
        engine.run_each(
            stages.ghost_images._kernels.close_rows,
            n,
            t.starts,
            engine.upload(kept, np.uint8),
            engine.upload(starts, np.int32),
            t.neighbors,
            t.folded.codes,
            t.face_measures,
            t.face_centroids,
            ints[0],
            ints[1],
            engine.empty(left, engine.face),
            engine.empty((left, dim), engine.face),
            ints[2],
        )
        assert (ints[2].get() == np.flatnonzero(kept)).all()


def drop_loops(adapter: clvoro.Adapter) -> None:
    """Leave out faces that cross, which takes a circle of a thousand generators; one from corner to corner stays.

    In a lattice of squares, four of which meet in each point.
    """
    square, across = clvoro.Box((0, 0), (1, 1)), 8
    stages = adapter._stages_for(square)
    engine, where = stages.engine, lattice(across, 2)
    n, x = len(where), engine.upload(where)
    t = Tessellator(stages, square).tessellate(x, n)
    starts, neighbors = t.starts.get(), t.neighbors.get()
    expected = [list(neighbors[a:b]) for a, b in pairwise(starts)]
    rows = [list(row) for row in expected]

    def join(i: int, j: int, before_i: int, before_j: int) -> None:
        """Make i and j neighbors, each after the given neighbor, counter-clockwise."""
        for cell, other, before in ((i, j, before_i), (j, i, before_j)):
            rows[cell].insert(rows[cell].index(before) + 1, other)

    for column, row, crossed in ((1, 1, True), (5, 2, True), (3, 5, False), (6, 6, True), (1, 6, False)):
        i = column + across * row  # lower left of the four
        right, above, opposite = i + 1, i + across, i + across + 1
        join(i, opposite, right, above)
        if crossed:
            join(right, above, opposite, i)
        else:
            expected[i], expected[opposite] = list(rows[i]), list(rows[opposite])
    made = stages.cells.take_rows(n, square, x, exact=True)
    slots = np.zeros((n, SLOT), np.int32)
    for i, labels in enumerate(rows):
        slots[i, : len(labels)] = labels
    counts = np.array([len(labels) for labels in rows], np.int32)
    made.slots.set(slots.ravel())
    made.places.set(np.arange(n, dtype=np.int32))
    made.counts.set(-counts)
    made.keep.set((1 << counts.astype(np.uint32)) - 1)
    made.starts.set(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32))
    graph = engine.upload(np.concatenate(rows), np.int32)
    t = stages.cells._measure_without_loops(made, graph)
    assert t is not None
    starts, neighbors = t.starts.get(), t.neighbors.get()
    assert [list(neighbors[a:b]) for a, b in pairwise(starts)] == expected


def sphere(adapter: clvoro.Adapter) -> None:
    """Few generators on a sphere, a cluster, and vertices of many cells: those of a cube, and of a small circle."""
    few = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    corners, turn = lattice(2, 3) - 0.5, np.arange(13)
    cluster = (0, 0, 1) + 1e-3 * (points(20, 3) - 0.5)
    circle = np.column_stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.ones(13)])
    for each in (few, corners, np.vstack([corners, cluster]), np.vstack([corners, circle])):
        x = each / np.linalg.norm(each, axis=1)[:, None]
        diagram = adapter.diagram(clvoro.Sphere(1.0), x)
        assert abs(diagram.volumes.sum() - 4 * np.pi) < 1e-4
        assert len(diagram.vertices) > 3


def gradation(adapter: clvoro.Adapter) -> None:
    """Size fields that are limited in growth, over several tiles."""
    for dim, counts in ((2, (40, 37)), (3, (12, 11, 13))):
        values = 0.1 + points(int(np.prod(counts)), 1).reshape(counts[::-1])
        box = clvoro.Box((0,) * dim, (1,) * dim)
        raster = Raster(values, box.lower, box.upper)
        size = Graded(raster, growth=1.2, resolution=counts)
        adapter.run(box, size, points=points(9, dim), method="weighted", max_steps=1)


def polygon(adapter: clvoro.Adapter) -> None:
    """Trimmed cells: a concave domain with a hole that many cells meet, and one that lies in a single cell."""
    angle = np.arange(24) * (2 * np.pi / 24)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    outer = [(0, 0), (2, 0), (2, 1.5), (1.2, 0.9), (1, 1.5), (0, 1.5)]
    for radius in (0.25, 0.003):
        domain = clvoro.Polygon(outer, [0.5 + radius * ring])
        for n in (2, 50):
            x = points(40 * n) * (2, 1.5)
            diagram = adapter.diagram(domain, x[domain.contains(x)][:n])
            assert abs(diagram.volumes.sum() - domain.measure) < 1e-3 * domain.measure
            assert len(diagram.vertices) > 3
    adapter.run(domain, 0.3, method="exact", effort="fast", max_steps=8, seed=911)
    layers = clvoro.Layers(0.05, count=2, spacing=0.2, edges=[0])
    # Steps until cells are inserted and deleted, other than those of layers.
    adapter.run(
        domain,
        0.4,
        layers=layers,
        method="exact",
        options=clvoro.MultilevelOptions(levels=0),
        effort="fast",
        max_steps=22,
        seed=911,
    )


def comb(adapter: clvoro.Adapter) -> None:
    """Pieces that belong to other cells, islands in lakes within a cell, edges on faces."""
    diagram = adapter.diagram(COMB, COMB.nearest(points(12) * (4, 0.3)))
    assert abs(diagram.volumes.sum() - COMB.measure) < 1e-4
    square = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    lake = clvoro.Polygon.from_pieces([[square, square * 0.5 + 0.25], [square * 0.25 + 0.375]])
    for each in (np.array([(0.5, 0.5), (0.1, 0.1)]), lattice(8, 2)):
        diagram = adapter.diagram(lake, each[lake.contains(each)])
        assert abs(diagram.volumes.sum() - lake.measure) < 1e-4
        assert len(diagram.vertices) > 3


def periodic(adapter: clvoro.Adapter) -> None:
    """Boxes that are periodic in some directions."""
    near = lattice(4, 3) + 0.05 * (points(64, 3) - 0.5)
    for x, which in (
        (points(60), (True, True)),
        (points(60), (True, False)),
        (lattice(4, 2), (True, True)),
        (near, (True, False, False)),
        (almost_cubes(adapter), (True, False, False)),
        (ring(), (True, False, False)),
    ):
        dim = len(which)
        diagram = adapter.diagram(clvoro.Box((0,) * dim, (1,) * dim, periodic=which), x)
        assert abs(diagram.volumes.sum() - 1) < 1e-4
        assert len(diagram.vertices) > 3
    square = clvoro.Box((0, 0), (1, 1), periodic=True)
    adapter.run(square, 0.13, effort="fast", options=clvoro.MultilevelOptions(levels=0), max_steps=4, seed=911)
    # The second diagram of a run in 3D begins with the rows of the first, unfolded.
    rod = clvoro.Box((0, 0, 0), (1, 0.4, 0.4), periodic=(True, False, False))
    adapter.run(rod, 0.17, method="coupled", max_steps=2)
    move_some_far(adapter)
    drop_faces(adapter)


def move_some_far(adapter: clvoro.Adapter) -> None:
    """Move generators a little and some far, in a periodic box in 3D: some cells are clipped anew."""
    box, n = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=(True, True, False)), 216
    x = lattice(6, 3) + 0.03 * (points(n, 3) - 0.5)
    stages = adapter._stages_for(box)
    periodic = Tessellator(stages, box)
    t = periodic.tessellate(stages.engine.upload(box.place(x, adapter.dtype)), n)
    x = x + 0.002 * (points(n, 3, seed=1) - 0.5)
    x[::31] = (x[::31] + 0.25) % 1
    t = periodic.tessellate(stages.engine.upload(box.place(x, adapter.dtype)), n, t)
    assert abs(t.volumes.get()[:n].sum() - 1) < 1e-4


def ordered(adapter: clvoro.Adapter) -> None:
    """Rows in the order of labels, which only parts have."""
    for dim in (2, 3):
        stages, box = stages_of(adapter, dim), clvoro.Box((0,) * dim, (1,) * dim)
        part = Part.alone(stages.engine.upload(points(30, dim)), box)
        labels = stages.engine.upload(np.arange(30)[::-1], np.int32)
        Tessellator(stages, box).tessellate_part(replace(part, labels=labels))


def parts(adapter: clvoro.Adapter) -> None:
    """Runs by two parts, in every kind of domain that they share."""
    two = clvoro.Adapter(devices=[adapter.ctx] * 2, dtype=adapter.dtype, share_gpus=True)
    every_step(BOX, "0.2 + 0.05*x", 60, fixed=[(1, 0.5)])(two)
    for domain, size in ((SQUARE, 0.12), (ROD, 0.13), (COMB, 0.3), (clvoro.Sphere(1.0), 0.35)):
        two.run(domain, size, method="coupled", max_steps=2)


def walls(adapter: clvoro.Adapter) -> None:
    """Cells in a solid, with planes of their own, and generators around a concave crease."""
    body = clvoro.Solid.box((0, 0, 0), (1, 1, 1)) - clvoro.Solid.box((0.5, 0.5, -1), (2, 2, 2))
    adapter.run(body, 0.3, effort="fast", options=clvoro.MultilevelOptions(levels=0), max_steps=3, seed=911)


def quadratics(adapter: clvoro.Adapter) -> None:
    """Derivatives of cell data, with and without walls, on a sphere and of few cells."""
    for domain, n in ((BOX, 40), (SQUARE, 60), (CUBE, 40), (clvoro.Sphere(1.0), 30), (BOX, 2)):
        mesh = adapter.diagram(domain, domain.lower + points(n, domain.dim) * domain.extent)
        engine = Engine(adapter.ctx, adapter.queue, domain.dim, np.dtype(adapter.dtype))
        stencils = CellStencils.of(mesh)
        found = Derivatives(engine, domain.cell_dim < domain.dim).fit_quadratics(stencils, mesh.centroids[:, :1], 1.0)
        assert all(np.isfinite(each).all() for each in found)


def copy(adapter: clvoro.Adapter) -> None:
    """The kernel with which a profile measures the bandwidth, on little memory."""
    source, target = (stages_of(adapter).engine.zeros(256, np.uint8) for _ in range(2))
    kernel = _program.build_program(adapter.ctx, "opencl/copy.cl", {}, "").all_kernels()[0]
    kernel.stage = "copy"
    kernel.set_args(source.data, target.data)
    cl.enqueue_nd_range_kernel(adapter.queue, kernel, (16,), (16,))


def fields(adapter: clvoro.Adapter) -> None:
    """Every kind of size field at some places, with its gradient; runs with some of them, and with a callable."""
    turn = np.linspace(0, 6.2, 150)
    many = ClosedPolyline(0.75 + 0.4 * np.stack([np.cos(turn), np.sin(turn)], 1))
    raster = Raster(0.2 + 0.1 * points(12).reshape(4, 6), BOX.lower, BOX.upper)
    few = Distance([Circle((0.5, 0.5), 0.2)], 0.1, growth=1.3, h_max=0.4)
    corners = 0.5 + 0.3 * (x := points(14, 3) - 0.5) / np.linalg.norm(x, axis=1)[:, None]
    body = Surface(corners, ConvexHull(corners).simplices)
    cube = Raster(0.2 + 0.1 * points(12).reshape(2, 4, 3), CUBE.lower, CUBE.upper)
    flat = minimum(few, raster), Distance([many], 0.2, slope=0.3), Expression(GRADED)
    solid = (Distance(body, 0.1, slope=0.3), Distance(Ball((0.5, 0.5, 0.4), 0.2), 0.1, slope=0.3) + cube)
    for box, size in (*((BOX, size) for size in flat), *((CUBE, size) for size in solid)):
        n, d = 40, box.dim
        engine = Engine(adapter.ctx, adapter.queue, d, np.dtype(adapter.dtype))
        origin, scale = box.frame
        at = engine.upload((points(n, d) * box.extent - origin) / scale)
        stage, h = Sizing(engine, box, size), engine.empty(n)
        stage.evaluate(at, n, h)
        stage.evaluate_with_gradient(at, n, h, slope := engine.empty((n, d)))
        assert (h.get() > 0).all()
        assert np.isfinite(slope.get()).all()
    for size in (minimum(few, raster), lambda x: 0.3 + 0 * x[:, 0]):
        adapter.run(BOX, size, method="weighted", max_steps=1, seed=911)
    adapter.run(BOX, few, method="exact", n_cells=60, effort="fast", seed=911, max_steps=3)


def multigrid(adapter: clvoro.Adapter) -> None:
    """The preconditioner, which runs use for larger meshes only, and a solve in two precisions."""
    from clvoro.solvers import multigrid as multigrids
    from clvoro.solvers.poisson import SINGLE_PRECISION_TOLERANCE, Poisson

    n = 300  # the smallest number that needs all its kernels
    stages = stages_of(adapter)
    engine, (origin, scale) = stages.engine, BOX.frame
    on_device = engine.upload((points(n) - origin) / scale)
    t = stages.cells.tessellate(Part.alone(on_device, BOX), stages.bins.build(BOX, on_device, n))
    stage = Poisson(engine)
    laplacian = stage.assemble(t.starts, t.neighbors, t.face_measures, t.points)
    rhs = engine.upload(points(n)[:, 0])
    for preconditioner in ("multigrid", "jacobi"):
        potential = engine.zeros(n)
        solution = stage.solve(laplacian, rhs, potential, tolerance=1e-3, preconditioner=preconditioner)
        assert solution.converged
        stage.apply(laplacian, potential, rhs)
    # The levels below the finest by one work-group each.
    with mock.patch.object(multigrids, "one_group_limit", return_value=n):
        potential, kind = engine.zeros(n), "multigrid"
        alone = Poisson(engine).solve(laplacian, rhs, potential, tolerance=1e-3, preconditioner=kind)
        assert alone.converged
    # Steps of smoothing merged, or apart: what this device does not do by itself.
    other = Poisson(engine)
    cycles = other.set_up_multigrid(laplacian)._cycle
    cycles.merged = not cycles.merged
    potential.fill(0)
    assert other.solve(laplacian, rhs, potential, tolerance=1e-3, preconditioner=kind).converged
    # A solve whose initial guess is not zero.
    rough = stage.assemble(t.starts, t.neighbors, t.face_measures, t.points, tolerance=SINGLE_PRECISION_TOLERANCE)
    assert stage.solve(rough, rhs, engine.upload(points(n)[:, 1]), tolerance=SINGLE_PRECISION_TOLERANCE).converged


def nuclei(adapter: clvoro.Adapter) -> None:
    """Nucleation of dislocations, and repair of the worst cells. Runs do both late."""
    engine, stretch = stages_of(adapter).engine, 1.15
    x = hexagons(0.08, clvoro.Box((-1, -1), (2, 2))) * (stretch, 1 / stretch) + 0.1
    t = tessellate(engine, x := x[PATCH.contains(x)])
    n, h = len(x), 0.08 * (3**0.5 / 2) ** 0.5
    rows = Generators(
        t.points,
        engine.upload(np.arange(n), np.int32),
        engine.zeros((n, 2)),
        engine.zeros(n, np.uint64),
        engine.zeros(n),
    )
    sizes, log_ratio = engine.upload(np.full(n, h)), engine.zeros(n)
    control = InsertionDeletion(engine)
    present = Present(PATCH, t, rows, n)
    found = control.insert_delete(present, CellSizes(sizes, sizes, log_ratio), Change(0.0, nuclei=2))
    assert found is not None
    assert found.inserted + found.deleted >= 2
    quality = engine.upload(np.linspace(0.8, 1, n))
    found = control.repair_cells(present, quality, deficit=0.1, split=True, share=0.5)
    assert found is not None
    assert found.inserted >= 1


def scan(adapter: clvoro.Adapter) -> None:
    """Prefix sums of an array of no round length that is too long for one work-item."""
    for dim in (2, 3):
        engine, n = stages_of(adapter, dim).engine, 8219
        values, sums = engine.upload(np.arange(n) % 7, np.int32), engine.empty(n - 2, np.int32)
        Scan(engine).exclusive(values, sums, n - 3, first=3)
        assert (np.diff(sums.get()) == np.arange(3, n) % 7).all()


def stages_of(adapter: clvoro.Adapter, dim: int = 2) -> Stages:
    return Stages(Engine(adapter.ctx, adapter.queue, dim, np.dtype(adapter.dtype)))


def broken(kernel: str) -> Callable[[clvoro.Adapter], None]:
    """A kernel with deliberate errors: a simulator that misses them is of no use."""

    def work(adapter: clvoro.Adapter) -> None:
        text = {
            "bounds": "kernel void bounds(global int *a) { a[get_global_id(0) + 1] = 1; }",
            "race": "kernel void race(global int *a) { a[0] = get_global_id(0); }",
            "same": "kernel void same(global int *a) { a[0] = 1; }",
            "local_race": "kernel void local_race(global int *a) { local int s[16]; int i = get_local_id(0);"
            " s[i] = i; a[i] = s[15 - i]; }",
            "barrier_": "kernel void barrier_(global int *a)"
            " { if (get_local_id(0) < 3) barrier(CLK_LOCAL_MEM_FENCE); a[get_global_id(0)] = 1; }",
            "private": "kernel void private_(global int *a) { int s[4]; int i = get_global_id(0);"
            " s[i % 3] = i; a[i] = s[a[i] + 3]; }",
        }[kernel]
        ones = np.zeros(16, np.int32)
        buffer = cl.Buffer(adapter.ctx, cl.mem_flags.COPY_HOST_PTR, hostbuf=ones)
        program = cl.Program(adapter.ctx, text).build()
        cl.enqueue_nd_range_kernel(adapter.queue, _bound(program.all_kernels()[0], buffer), (16,), (16,))
        adapter.queue.finish()

    return work


def transfer(adapter: clvoro.Adapter) -> None:
    """Transfer of cell data: from few cells to many, from many to few, and cells of many faces."""
    for dim in (2, 3):
        box = clvoro.Box((0,) * dim, (1,) * dim)
        one, other = (adapter.diagram(box, points(n, dim, n)) for n in (3, 50))
        for old, new in ((one, other), (other, one)):
            for order in (1, 2):
                assert np.ptp(old.transfer(np.ones(len(old)), new, order, adapter=adapter)) == 0


def _bound(kernel: cl.Kernel, buffer: cl.Buffer) -> cl.Kernel:
    kernel.set_args(buffer)
    return kernel


WORK: dict[str, Callable[[clvoro.Adapter], None]] = {
    "diagrams": diagrams,
    "hulls": hulls,
    "solid": solid,
    "fields": fields,
    "multigrid": large(multigrid),
    "scan": scan,
    "nuclei": nuclei,
    "transfer": transfer,
    "gradation": gradation,
    "copy": copy,
    "ordered": ordered,
    "parts": parts,
    "walls": walls,
    "quadratics": quadratics,
    "polygon": polygon,
    "comb": comb,
    "periodic": periodic,
    "sphere": sphere,
    "repaired": large(repaired),
    "coupled": large(method("coupled", max_steps=2)),
    "lloyd": method("lloyd", max_steps=1),
    "weighted": method("weighted", max_steps=2),
    "adaptive": method("adaptive", options=clvoro.MultilevelOptions(levels=1), n_cells=90, effort="fast", max_steps=60),
    "best": method("adaptive", options=clvoro.MultilevelOptions(levels=0), n_cells=150, effort="best", max_steps=20),
    "exact": large(method("exact", options=clvoro.MultilevelOptions(levels=0), effort="fast", max_steps=75)),
    "mmpde": method("mmpde", n_cells=80, max_steps=2),
    "solid-mmpde": method("mmpde", CUBE, SOLID, n_cells=130, max_steps=2),
    "solid-adaptive": method("adaptive", CUBE, SOLID, effort="fast"),
    "solid-coupled": method("coupled", CUBE, SOLID, max_steps=2),
    **RUNS,
    **{f"broken-{k}": broken(k) for k in ("bounds", "race", "same", "local_race", "barrier_", "private")},
}


def buffers_of_their_own() -> Callable[[], None]:
    """Have no array share its buffer with others, as those of the workspace do, so that it shows who leaves one.

    Returns what ends that.
    """
    shared = Engine.scratch
    Engine.scratch = Engine.empty
    return lambda: setattr(Engine, "scratch", shared)


def build_for_simulator() -> None:
    """Build programs without optimization that Oclgrind does not run right with it.

    It lacks a function with which LLVM notes scopes of aliases, and finds other determinants of simplices. Where the
    sums of teams take the place of several arrays, it sees, optimized, only the first.
    """
    build = _program.compile_text

    def built(ctx: cl.Context, text: str, options: tuple[str, ...], short: bool = True) -> cl.Program:
        if "shape_gradients" not in text and "clip_polyhedra_by_teams" not in text:
            program = build(ctx, text, options, short)
            if b"noalias.scope.decl" not in program.binaries[0]:
                return program
        return build(ctx, text, (*options, "-cl-opt-disable"), short)

    _program.compile_text = built


def main(name: str, *options: str) -> None:
    context = clvoro.create_context("oclgrind")
    counts = collections.Counter()
    original = cl.enqueue_nd_range_kernel

    def counted(queue, kernel, *rest, **more):
        # Kernels of several files share names; PyOpenCL's own know no stage.
        full = f"{getattr(kernel, 'stage', 'pyopencl')}.{kernel.function_name}"
        counts[full] += 1
        return original(queue, kernel, *rest, **more)

    cl.enqueue_nd_range_kernel = counted
    if "groups" in options:
        use_groups(16, 3)
    if "teams" in options:
        back_ends.teams_are_faster = lambda _: True
    build_for_simulator()
    buffers_of_their_own()
    adapter = clvoro.Adapter(context, "float32" if "float32" in options else "float64")
    WORK[name](adapter)
    adapter.queue.finish()
    print(json.dumps(counts))


if __name__ == "__main__":
    main(*sys.argv[1:])
