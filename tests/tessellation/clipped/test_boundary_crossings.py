"""Chords of the boundary: comparison with the nearest generator along every edge."""

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.tessellation.clipped.boundary_crossings import UNTOUCHED, Boundary
from clvoro.tessellation.device_diagram import CloseError
from clvoro.tessellation.part import Part
from tests.reference import patch
from tests.reference.shores import POLYGONS, UNIT, scattered

N = 90


def envelope(a, e, points):
    """Return [(nearest generator, t where it ceases to be nearest)] along a + t e, t = 0 to 1, by brute force."""
    # |a + t e - x|^2 minus the common terms is linear in t: intercept and slope.
    heights, slopes = ((a - points) ** 2).sum(axis=1), -2 * points @ e
    cell, t, found = int(heights.argmin()), 0.0, []
    while True:
        steeper = np.flatnonzero(slopes < slopes[cell])
        at = (heights[steeper] - heights[cell]) / (slopes[cell] - slopes[steeper])
        if not len(at) or at.min() >= 1:
            return [*found, (cell, 1.0)]
        found.append((cell, float(at.min())))
        cell, t = int(steeper[at.argmin()]), at.min()
        assert t > 0


def convex(stages, domain, points, n):
    """Return the convex cells in the clip box of a domain."""
    return stages.cells.tessellate(Part.alone(points, domain, n), stages.bins.build(domain, points, n), exact=False)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("name", ["star", "holes", "pieces", "comb", "slit"])
def test_chords(ctx, name, real):
    domain = POLYGONS[name]()
    engine = patch.make_engine(ctx, real, box=domain)
    points = domain.place(scattered(domain, N, 5701), engine.real)
    on_device, boundary = engine.upload(points), Boundary(engine, domain)
    t = convex(Stages(engine), domain, on_device, N)
    vertices = boundary.vertices.get().reshape(-1, 2).astype(float)
    ways = vertices[domain.oriented.next_vertex] - vertices
    expected = [envelope(a, e, points.astype(float)) for a, e in zip(vertices, ways, strict=True)]
    cells = np.array([cell for edge in expected for cell, _ in edge])
    rng = np.random.default_rng(5702)
    for _ in range(3):
        # The result does not depend on the former owners of vertices.
        boundary.owners.set(rng.integers(0, N, len(vertices)).astype(np.int32))
        boundary._known = N
        chords = boundary.cut(t, N)
        owners, firsts, of_chords, edges, ends = (a.get() for a in chords.arrays[2:7])
        count = chords.count
        assert count == len(cells)
        assert np.array_equal(owners, [edge[0][0] for edge in expected])
        assert np.array_equal(np.diff(firsts[: len(expected) + 1]), list(map(len, expected)))
        assert np.array_equal(of_chords[:count], cells)
        assert np.array_equal(edges[:count], np.repeat(np.arange(len(expected)), list(map(len, expected))))
        # Crossings round by the rounding of positions over the distance of the generators, as seen along the edge.
        across = points[cells[1:]] - points[cells[:-1]]
        slopes = np.abs((across * ways[edges[: count - 1]]).sum(axis=1))
        off = np.abs(ends[:count] - [at for edge in expected for _, at in edge])
        assert (off[:-1] * slopes).max() <= 8 * np.finfo(real).eps
        assert off[np.cumsum(np.diff(firsts[: len(expected) + 1])) - 1].max() == 0
        slots, starts, listed = (a.get() for a in (chords.slots, chords.list_starts, chords.listed))
        touched = chords.touched.get()[: chords.touched_count]
        # In the order of their first chords; each with its own, in order.
        assert np.array_equal(touched, cells[np.sort(np.unique(cells, return_index=True)[1])])
        assert np.array_equal(slots[touched], np.arange(len(touched)))
        assert (np.delete(slots[:N], touched) == UNTOUCHED).all()
        for u, cell in enumerate(touched):
            assert np.array_equal(listed[starts[u] : starts[u + 1]], np.flatnonzero(cells == cell))


def test_cells_of_outside_generators_that_the_boundary_crosses_are_reported(ctx):
    """Exactly those cells are reported."""
    domain = POLYGONS["star"]()
    engine = patch.make_engine(ctx, box=domain)
    inside = domain.place(scattered(domain, N, 5703), engine.real)
    around = np.random.default_rng(5704).random((200, 2)) * domain.place(np.array(domain.upper)[None], engine.real)
    away = around[~domain.contains(around * domain.frame[1] + domain.frame[0])]
    points = np.concatenate([inside, away])
    t = convex(Stages(engine), domain, engine.upload(points), len(points))
    boundary = Boundary(engine, domain)
    vertices = boundary.vertices.get().reshape(-1, 2)
    met = {
        cell
        for a, e in zip(vertices, vertices[domain.oriented.next_vertex] - vertices, strict=True)
        for cell, _ in envelope(a, e, points)
    }
    expected = sorted(cell - N for cell in met if cell >= N)
    assert 5 < len(expected) < len(away) - 5
    assert boundary.cut(t, N).tolist() == expected


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_vertices_belong_to_the_nearer_of_two_close_generators(ctx, real):
    """The two rounded distances are equal, but the bisector is far from the vertex."""
    domain = clvoro.Polygon(UNIT)
    engine = patch.make_engine(ctx, real, box=domain)
    vertices = domain.place(domain.oriented.vertices, engine.real).astype(float)
    boundary, stages = Boundary(engine, domain), Stages(engine)
    rng, made = np.random.default_rng(5703), 0
    for _ in range(40):
        x = rng.uniform(0.1, 0.9, 2).astype(engine.real)
        points = np.stack([x, x + rng.integers(1, 4, 2) * (1, -1) * np.spacing(x)])
        on_device, n = engine.upload(points.astype(engine.real)), len(points)
        try:
            t = convex(stages, domain, on_device, n)
        except CloseError:
            continue
        made += 1
        boundary.owners.set(rng.integers(0, n, len(vertices)).astype(np.int32))
        boundary._known = n
        owners = boundary.cut(t, n).arrays[2].get()
        points = points.astype(float)
        for v, owner in zip(vertices, owners.tolist(), strict=True):
            # Differences of generators are exact; the longest rounding is that of v - x.
            beyond = [(v - (points[owner] + p) / 2) @ (p - points[owner]) for p in points]
            assert max(beyond) <= 4 * np.finfo(real).eps * np.abs(points - points[owner]).max()
    assert made > 10
