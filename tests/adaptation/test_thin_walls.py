"""Pairs of generators on both sides of thin walls, against NumPy, and a run."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.thin_walls import has_thin_walls
from clvoro.opencl.engine import Engine
from clvoro.sizing import Sizing, as_field
from tests.reference import patch

H = 0.1
TOP = 0.7


def slit(half):
    """Return a square with a wall of the thickness 2 `half`."""
    wall = [(0.5 - half, 0), (0.5 - half, TOP), (0.5 + half, TOP), (0.5 + half, 0)]
    return clvoro.Polygon([(0, 0), *wall, (1, 0), (1, 1), (0, 1)])


SLIT = slit(0.001)


def rows_of(t, order):
    """Return the neighbors of each generator, by label."""
    host = patch.fetch(t)
    rows = [set() for _ in order]
    for i, j in zip(host.owners, host.neighbors, strict=True):
        if max(i, j) < len(order) and j >= 0:
            rows[order[i]].add(int(order[j]))
    return rows


def across(points, i, rows):
    """Return those of the generators `rows` that the slit separates from generator i."""
    x, found = points[i], []
    for j in sorted(rows):
        y = points[j]
        if (x[0] < 0.5) != (y[0] < 0.5):
            share = (0.5 - x[0]) / (y[0] - x[0])
            found += [j] if x[1] + share * (y[1] - x[1]) <= TOP else []
    return found


def share(x, y, half):
    """Return by how much a pair moves towards its images, from the length of the line between them in the slit."""
    inside = 2 * half * np.hypot(*(y - x)) / abs(y[0] - x[0])
    return min(1, 2 - 2 * inside / (0.3 * H))


def nearest_images(points, convex, neighbors, half):
    """Return the generator beyond the slit whose mirror image is nearest to each point; -1 for none."""
    partners = np.full(len(points), -1)
    for i, x in enumerate(points):
        least = 0.45 * H
        for j in across(points, i, convex[i] - neighbors[i]):
            away = np.hypot(1 - points[j, 0] - x[0], points[j, 1] - x[1])
            if away < least and share(x, points[j], half) >= 0:
                least, partners[i] = away, j
    return partners


@pytest.mark.parametrize(("real", "half"), [("float64", 0.001), ("float64", 0.01), ("float32", 0.001)])
def test_pairs(ctx, real, half):
    domain = slit(half)
    rng = np.random.default_rng(7)
    x = (np.indices((10, 10)).reshape(2, -1).T + 0.5) / 10 + rng.uniform(-0.03, 0.03, (100, 2))
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(real), domain.traits(np.dtype(real)))
    mesh = patch.make_mesh(
        Stages(engine), domain, Sizing(engine, domain, as_field(H)), engine.upload(domain.place(x, engine.real))
    )
    origin, scale = domain.frame
    order = mesh.labels.get()
    rows = [rows_of(t, order) for t in (mesh.t.trimmed.convex, mesh.t)]
    chords = mesh.t.trimmed.chords
    at_wall = order[chords.touched.get()[: chords.touched_count]]
    mesh.stages.thin_walls.pair(mesh.free, mesh.t, mesh.h, mesh.moving)
    partners, expected = nearest_images(x, *rows, half), x.copy()
    paired = {i for i, j in enumerate(partners) if j >= 0 and partners[j] == i and (i in at_wall or j in at_wall)}
    pushed = 0
    for i in set(at_wall.tolist()) | paired:
        if i in paired:
            y = x[partners[i]]
            expected[i] += share(x[i], y, half) / 2 * ((1 - y[0], y[1]) - x[i])
            continue
        pairs = [j for j in across(x, i, rows[0][i]) if j in paired and j in at_wall and share(x[i], x[j], half) >= 0]
        if len(pairs) > 1:
            mean = np.mean([share(x[i], x[j], half) for j in pairs])
            expected[i, 0] += 0.1 * H * mean * np.sign(x[i, 0] - 0.5)
            pushed += 1
    assert pushed > 0 or half > 0.001
    moved = (expected != x).any(axis=1)
    assert moved.sum() >= 8
    tolerance = 200 * float(np.finfo(real).eps)
    assert origin + mesh.to_host(mesh.points, scale) == pytest.approx(expected, abs=tolerance)
    assert mesh.to_host(mesh.velocity, scale) == pytest.approx(expected - x, abs=tolerance)


def test_sides_of_unlike_size_have_no_pairs(ctx):
    """A row of cells has no image in a row with fewer cells."""
    x = (np.indices((10, 10)).reshape(2, -1).T + 0.5) / 10
    x[:, 1] += np.where(x[:, 0] < 0.5, 0.01, -0.01)
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(float), SLIT.traits(np.dtype(float)))
    moved = []
    for ratio in (1.1, 1.2):
        size = as_field(clvoro.sizing.Expression(f"x < 0.5 ? {H} : {H * ratio}"))
        mesh = patch.make_mesh(
            Stages(engine), SLIT, Sizing(engine, SLIT, size), engine.upload(SLIT.place(x, engine.real))
        )
        before = mesh.points.get()
        mesh.stages.thin_walls.pair(mesh.free, mesh.t, mesh.h, mesh.moving)
        moved.append((mesh.points.get() != before).any())
    assert moved == [True, False]


@pytest.mark.parametrize(("thickness", "expected"), [(0.02, True), (0.28, True), (0.32, False)])
def test_walls_that_are_thin(thickness, expected):
    half = thickness * H / 2
    post = [(0.5 - half, 0.2), (0.5 + half, 0.2), (0.5 + half, 0.8), (0.5 - half, 0.8)]
    for hole in (post, post[::-1]):
        domain = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)], [hole])
        assert has_thin_walls(domain, np.full(8, H)) == expected
    # A thin channel is no thin wall.
    assert not has_thin_walls(clvoro.Polygon(post), np.full(4, H))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 8])
def test_cells_beside_a_slit(seed):
    """They are as good as elsewhere. Without pairs some reach through the wall, and Q is below 0.5 from any start.

    If pairs do not move by the whole way to their images, it is about 0.5 from these two.
    """
    result = clvoro.adapt(SLIT, 0.04, seed=seed)
    assert result.quality.min() > 0.7
    assert np.abs(result.size_error).max() < 0.06
    assert result.diagram.solver_mesh().measures.concavity.max() < 1
