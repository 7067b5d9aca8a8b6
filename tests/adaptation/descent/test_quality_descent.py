"""The gradients of quality and of short edges against finite differences of the energy, by diagrams from Qhull."""

import itertools
from unittest import mock

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation.descent import quality_descent
from clvoro.adaptation.descent.quality_descent import QualityDescent, Repulsion
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import diagrams as reference
from tests.reference import patch
from tests.reference.polygon_diagrams import polygon_voronoi

N = 40
NONE = Repulsion(0.2, 0.0)


def qualities(points):
    """Q, perimeter and area of each cell, (n, 3)."""
    rows = []
    for cell in reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points):
        n = len(cell.neighbors)
        perimeter = np.hypot(*(np.roll(cell.polygon, -1, axis=0) - cell.polygon).T).sum()
        rows.append((4 * cell.area * n * np.tan(np.pi / n) / perimeter**2, perimeter, cell.area))
    return np.array(rows)


def energy(points, omega):
    """E = sum omega (2 log P - log A); omega stays that of the start."""
    _, perimeter, area = qualities(points).T
    return float((omega * (2 * np.log(perimeter) - np.log(area))).sum())


def descend_from(engine, t, h, quality, rate=0.3, edges=NONE, pairs=NONE, most=1e9, full_rate=1e30, **weights):
    """Displacements from the diagram `t`, by the given terms of the energy and limits."""
    out = engine.empty((t.n, 2))
    terms = {"SHORT_EDGES": edges, "CLOSE_PAIRS": pairs, "LONGEST_DESCENT": most, "FULL_RATE": full_rate}
    with mock.patch.multiple(quality_descent, **terms):
        QualityDescent(engine).descend(t, engine.upload(h), engine.upload(quality), out, rate=rate, **weights)
    return out.get()


def descend(engine, points, h, bad_cell_weight, quality=None, rate=0.1, most=0.2, **terms):
    """Displacements from points, with the quality of their cells by default."""
    quality = qualities(points)[:, 0] if quality is None else quality
    t, terms = patch.tessellate(engine, points), {"rate": rate, "most": most, **terms}
    return descend_from(engine, t, h, quality, bad_cell_weight=bad_cell_weight, **terms)


def gradient_of(energy, points, some=None, step=1e-5):
    """Return dE/dx (n, 2) of generators, of `some` or all, by central differences."""
    gradient = np.zeros(points.shape)
    for i in range(len(points)) if some is None else some:
        for a in range(2):
            by = np.zeros(points.shape)
            by[i, a] = step
            gradient[i, a] = (energy(points + by) - energy(points - by)) / (2 * step)
    return gradient


@pytest.mark.sparse(1)
@pytest.mark.parametrize("bad_cell_weight", [0.0, 20.0])
def test_gradient(ctx, bad_cell_weight):
    """Generators, those at walls and in corners included, move by -rate h^2 dE/dx."""
    points = patch.relaxed_points(N, 2112, steps=3)
    h = np.random.default_rng(6).uniform(0.05, 0.2, N)
    u = descend(patch.make_engine(ctx), points, h, bad_cell_weight, rate=0.3, most=1e9)
    omega = 1 - bad_cell_weight * np.log(qualities(points)[:, 0])
    # Every third one, from the walls to the middle.
    some = np.argsort(np.minimum(points, patch.BOX.upper - points).min(axis=1))[::3]
    gradient = gradient_of(lambda x: energy(x, omega), points, some)
    expected = (-0.3 * h[:, None] ** 2 * gradient)[some]
    # Central differences: rounding of E (about 100 (1 + bad_cell_weight)) over the step, curvature times its square.
    assert u[some] == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())


def test_gradient_in_a_polygon(ctx):
    """Cells at slanted edges, in concave corners, around a hole that lies in one of them, and beside a larger one."""
    domain = clvoro.Polygon(
        [(0, 0), (2, 0.1), (1.9, 1.2), (1.2, 1), (0.9, 1.5), (0.1, 1.1)],
        [[(0.25, 0.4), (0.3, 0.47), (0.33, 0.38)], [(1.2, 0.4), (1.7, 0.4), (1.4, 0.65)]],
    )
    rng = np.random.default_rng(2115)
    grid = np.stack(np.meshgrid(np.arange(0.2, 2, 0.42), np.arange(0.15, 1.5, 0.35)), -1)
    points = grid.reshape(-1, 2) + rng.uniform(-0.05, 0.05, (grid.size // 2, 2))
    points = points[domain.contains_well(points, 0.02)]
    n, cells = len(points), polygon_voronoi(domain, points)
    around = [i for i in range(n) if {(i, -7), (i, -8), (i, -9)} <= set(cells.lengths)]
    assert around
    some = sorted({*around, *range(0, n, 3)})
    # A piece that goes to another cell would make the energy not differentiable.
    assert all(piece.root == piece.home for piece in cells.pieces)
    real = np.dtype("float64")
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, real, domain.traits(real))
    placed = domain.place(points, real)
    t = Tessellator(Stages(engine), domain).tessellate(engine.upload(placed), n)
    q, h = rng.uniform(0.5, 1, n), rng.uniform(0.05, 0.2, n)
    u = descend_from(engine, t, h, q)
    # E is the same in any unit.
    unit = np.linalg.norm(points[1] - points[0]) / np.linalg.norm(placed[1] - placed[0])
    omega = 1 - 5 * np.log(q)

    def energy(points):
        cells = polygon_voronoi(domain, points)
        perimeter = np.zeros(n)
        for (i, _), length in cells.lengths.items():
            perimeter[i] += length
        return float((omega * (2 * np.log(perimeter) - np.log(cells.areas))).sum())

    expected = (-0.3 * h[:, None] ** 2 * gradient_of(energy, points, some) * unit)[some]
    # As above.
    assert u[some] == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())


@pytest.mark.sparse(1)
@pytest.mark.parametrize("periodic", [True, (False, True)])
def test_gradient_across_seams(ctx, periodic):
    """Generators at a seam look at the nearest images of their neighbors; diagrams are the device's own."""
    box, adapter = clvoro.Box((0, 0), (1, 0.75), periodic=periodic), clvoro.Adapter(ctx)
    rng = np.random.default_rng(2116)
    grid = np.stack(np.meshgrid(np.arange(7) / 7, np.arange(6) / 8, indexing="ij"), -1)
    points = box.wrap(grid.reshape(-1, 2) + rng.uniform(0, 0.06, (42, 2)))
    n, q, h = len(points), rng.uniform(0.5, 1, 42), rng.uniform(0.05, 0.2, 42)
    some = np.flatnonzero((points < 0.1).any(axis=1))[:10]
    assert (points[some] < 0.1).any(axis=0).all()
    engine = patch.make_engine(ctx, box=box)
    placed = engine.upload(box.place(points, engine.real))
    t = Tessellator(Stages(engine), box).tessellate(placed, n)
    u = descend_from(engine, t, h, q)
    omega = 1 - 5 * np.log(q)

    def energy(points):
        d = adapter.diagram(box, points)
        perimeter = np.add.reduceat(d.face_measures, d.neighbor_starts[:-1])
        return float((omega * (2 * np.log(perimeter) - np.log(d.volumes))).sum())

    expected = -0.3 * h[:, None] ** 2 * gradient_of(energy, points, some)
    # As above; faces are in single precision while generators move.
    scale = np.abs(expected).max()
    assert u[some] == pytest.approx(expected[some], rel=1e-5, abs=2e-6 * scale)


DOMAINS = {
    "box": clvoro.Box((0, 0), (1, 0.75)),
    "periodic": clvoro.Box((0, 0), (1, 0.75), periodic=True),
    "channel": clvoro.Box((0, 0), (1, 0.75), periodic=(False, True)),
    # Small turns, a convex corner of 48 degrees, and a re-entrant one.
    "polygon": clvoro.Polygon(
        [(0, 0.05), (0.45, 0), (1, 0.02), (1.05, 0.4), (1, 0.7), (0.6, 0.8), (0.45, 0.7), (0.25, 0.85), (0, 0.8)]
    ),
}


def edges_of(d):
    """Yield the cells of each edge, (i, i) at the boundary, and its length; none beside re-entrant corners."""
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    ends, polygon = d.half_faces.ends, isinstance(d.domain, clvoro.Polygon)
    turns = {}
    if polygon:
        turns = dict(zip(map(tuple, d.domain.oriented.vertices), d.domain.oriented.turns, strict=True))
    walls = {}
    for k, (i, j) in enumerate(zip(owner.tolist(), d.neighbors.tolist(), strict=True)):
        if j >= 0:
            yield i, j, d.face_measures[k] / 2  # twice
        else:
            begin, end = map(tuple, d.vertices[ends[k]])
            walls.setdefault(i, []).append([begin, end, d.face_measures[k]])
    for i, parts in walls.items():
        joined = True
        while joined:
            joined = False
            for a, b in itertools.permutations(parts, 2):
                if a[1] == b[0] and polygon and abs(turns.get(a[1], 0)) < np.pi / 6:
                    parts.remove(b)
                    a[1:] = [b[1], a[2] + b[2]]
                    joined = True
                    break
        for begin, end, length in parts:
            if min(turns.get(begin, 0), turns.get(end, 0)) > -np.pi / 6:
                yield i, i, length


def edge_energy(d, h, short):
    """E = 1/2 sum max(0, short - l / h)^2 over all edges."""
    total = 0.0
    for i, j, length in edges_of(d):
        share = 1 if i == j else 2  # half-faces
        unit = (h[i] + h[j]) / 2
        total += max(0, short - share * length / unit) ** 2 / 2 / share
    return total


@pytest.mark.sparse(1)
@pytest.mark.parametrize("name", DOMAINS)
def test_gradient_of_short_edges(ctx, name):
    """Faces, parts of the boundary, and those that end in a corner; diagrams are the device's own."""
    domain, adapter = DOMAINS[name], clvoro.Adapter(ctx)
    rng = np.random.default_rng(2117)
    grid = np.stack(np.meshgrid(np.arange(7) / 7, np.arange(6) / 8.5, indexing="ij"), -1)
    points = grid.reshape(-1, 2) + rng.uniform(0.01, 0.12, (42, 2))
    if name == "polygon":
        points = points[domain.contains_well(points, 0.01)]
    n, short = len(points), 1.1
    h = rng.uniform(0.1, 0.14, n)
    real = np.dtype("float64")
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, real, domain.traits(real))
    placed = domain.place(points, real)
    unit = domain.frame[1]
    t = Tessellator(Stages(engine), domain).tessellate(engine.upload(placed), n)
    u = descend_from(engine, t, h / unit, np.full(n, 0.5), edges=Repulsion(short, 2), quality_weight=0)
    some = rng.permutation(n)[:16]
    gradient = gradient_of(lambda x: 2 * edge_energy(adapter.diagram(domain, x), h, short), points, some)
    expected = -0.3 * h[:, None] ** 2 * gradient / unit
    scale = np.abs(expected).max()
    assert (np.abs(expected[some]) > 1e-3 * scale).all(axis=1).sum() > 8
    assert u[some] == pytest.approx(expected[some], rel=1e-4, abs=1e-5 * scale)


def test_gradient_of_close_generators(ctx):
    """Neighbors push each other apart; others at the same distance do not."""
    points, rng = patch.relaxed_points(N, 2118, steps=1), np.random.default_rng(8)
    h, limit = rng.uniform(0.1, 0.15, N), 0.9
    engine = patch.make_engine(ctx)
    t, q = patch.tessellate(engine, points), np.full(N, 0.5)
    u = descend_from(engine, t, h, q, pairs=Repulsion(limit, 2), quality_weight=0)
    expected, pairs = np.zeros((N, 2)), 0
    for i, cell in enumerate(reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)):
        for j in cell.neighbors:
            way = points[i] - points[max(j, 0)]
            unit, away = (h[i] + h[j]) / 2, np.hypot(*way)
            if j >= 0 and away < limit * unit:
                expected[i] += 0.3 * h[i] ** 2 * 2 * (limit - away / unit) / unit * way / away
                pairs += 1
    assert 10 < pairs < 4 * N
    assert u == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_short_edges_grow(ctx, real):
    """Four generators nearly on a square: the edge between them grows in both directions."""
    points = np.array([[0.4, 0.375], [0.6, 0.375], [0.5, 0.273], [0.5, 0.477]])
    engine = patch.make_engine(ctx, real)
    adapter = clvoro.Adapter(ctx, dtype=real)

    def length(points):
        d = adapter.diagram(patch.BOX, points)
        return d.face_measures[d.neighbors >= 0].min()

    u = descend(engine, points, np.full(4, 0.2), 0.0, np.full(4, 0.9), edges=Repulsion(0.2, 50))
    assert 1e-3 < length(points) < 0.05 * 0.2
    assert length(points + u) > 2 * length(points)


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("settings", "seed"), [({"effort": "fast"}, 5), ({}, 16), ({"method": "exact"}, 14)])
def test_runs_have_no_short_edges(ctx, settings, seed):
    """A steep field, and starts from which runs without the energy end with an edge of 0.02 h or less."""
    field = clvoro.sizing.Distance(clvoro.sizing.Circle((0.5, 0.4), 0.2), h_min=0.012, slope=0.3)
    result = clvoro.Adapter(ctx).run(patch.BOX, field, seed=seed, **settings)
    h = result.target_size
    for i, j, length in edges_of(result.diagram):
        assert (1 if i == j else 2) * length > 0.05 * (h[i] + h[j]) / 2


def test_descends(ctx):
    """A step of the real size lowers E."""
    points = patch.relaxed_points(N, 2113, steps=3)
    h = np.full(N, np.sqrt(0.75 / N))
    u = descend(patch.make_engine(ctx), points, h, 5.0)
    omega = 1 - 5 * np.log(qualities(points)[:, 0])
    before, after = energy(points, omega), energy(points + u, omega)
    slope = -((u / (0.1 * h[:, None])) ** 2).sum() * 0.1
    assert after - before == pytest.approx(slope, rel=0.5)


def test_longest(ctx):
    points = patch.relaxed_points(N, 2114, steps=0)
    h = np.full(N, 0.1)
    engine = patch.make_engine(ctx)
    free = descend(engine, points, h, 5.0, most=1e9)
    u = descend(engine, points, h, 5.0, most=0.03)
    length = np.linalg.norm(free, axis=1)
    assert 3 < (length > 0.003).sum() < N
    assert u == pytest.approx(free * np.minimum(1, 0.003 / length)[:, None], rel=1e-9, abs=1e-15)


def test_rate_falls_with_the_weight_of_bad_cells(ctx):
    """In proportion to the largest omega h^2 / A of a cell and its neighbors, beyond a limit."""
    points = patch.relaxed_points(N, 2114, steps=0)
    h, limit = np.random.default_rng(9).uniform(0.05, 0.15, N), 3.0
    q, _, area = qualities(points).T
    engine = patch.make_engine(ctx)
    t = patch.tessellate(engine, points)
    free, u = (descend_from(engine, t, h, q, full_rate=f, bad_cell_weight=20.0) for f in (1e30, limit))
    per_area = (1 - 20 * np.log(q)) / area
    cells = reference.box_voronoi(patch.BOX.lower, patch.BOX.upper, points)
    rows = [[i, *(j for j in cell.neighbors if j >= 0)] for i, cell in enumerate(cells)]
    pressure = h**2 * np.array([per_area[row].max() for row in rows])
    assert N // 4 < (pressure > limit).sum() < N
    assert u == pytest.approx(free * np.minimum(1, limit / pressure)[:, None], rel=1e-9, abs=1e-15)


def test_a_regular_mesh_stays(ctx):
    """Squares do not move, although four cells share each vertex; at walls the energy has a kink there."""
    xy = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    u = descend(patch.make_engine(ctx), (xy + 0.5) / 8, np.full(48, 0.125), 5.0)
    inside = ((xy > 0) & (xy < [7, 5])).all(axis=1)
    assert np.abs(u[inside]).max() < 1e-12
    assert np.linalg.norm(u, axis=1).max() < 0.1 * 0.125


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize(
    "points",
    [
        [[0.3, 0.4]],
        [[0.3, 0.4], [0.6, 0.2]],
        [[0, 0], [1, 0.75], [0, 0.75], [1, 0]],
        np.stack([np.linspace(0.05, 0.95, 10), np.full(10, 0.375)], axis=1),
        [[0.5, 0.375], [0.5, 0.375 + 1e-6], [0.1, 0.1], [0.9, 0.7]],
    ],
)
def test_degenerate(ctx, real, points):
    n = len(points)
    some = np.full(n, 0.5)
    u = descend(patch.make_engine(ctx, real), np.array(points, float), np.full(n, 0.3), 5.0, quality=some)
    assert np.isfinite(u).all()
    assert np.linalg.norm(u, axis=1).max() <= 0.2 * 0.3 * 1.001
