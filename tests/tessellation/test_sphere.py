"""Diagrams on the sphere against the convex hull of the generators, and where four cells meet."""

from itertools import pairwise

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.errors import InputError
from clvoro.opencl.engine import Engine
from clvoro.tessellation.back_ends import LANES_FROM
from clvoro.tessellation.tessellator import Tessellator
from tests.reference.diagrams import faults
from tests.reference.spheres import UNIT, SphericalDiagram, clustered_points, grid_of_rings, random_points

SETS = {
    "random": random_points(2000, 1),
    "few": random_points(60, 2),
    "clustered": clustered_points(1500, 3),
    "icosahedral": UNIT.icosahedral_points(3),
}
PRECISIONS = ["float64", "float32"]


def tessellate(ctx, points, real="float64"):
    """Return the tessellation on the device, and the order of its rows."""
    engine = Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(real), UNIT.traits(np.dtype(real)))
    stages, n = Stages(engine), len(points)
    on_device = engine.upload(UNIT.place(points, engine.real))
    binned = stages.bins.build(UNIT, on_device, n)
    order = binned.items.get()[:n].copy()
    ordered = engine.upload(on_device.get()[order])
    stages.bins.renumber(binned, n)
    tessellator = Tessellator(stages, UNIT)
    t = tessellator.tessellate(ordered, n, exact=True)
    return tessellator, tessellator.final(t), order


def as_cycle(row):
    """Return a cyclic list from its least item on."""
    first = row.index(min(row))
    return row[first:] + row[:first]


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", list(SETS))
def test_neighbors(ctx, name, real):
    points = SETS[name].astype(real).astype(float)
    d = clvoro.Adapter(ctx, real).diagram(UNIT, points)
    expected = SphericalDiagram(UNIT.wrap(points)).neighbors
    starts = d.neighbor_starts
    rows = [as_cycle(d.neighbors[a:b].tolist()) for a, b in pairwise(starts.tolist())]
    wrong = [i for i, row in enumerate(expected) if as_cycle(row) != rows[i]]
    # In single precision generators are a rounding off, and so are decisions between four that nearly lie on a circle.
    assert len(wrong) <= (0 if real == "float64" else 0.01 * len(points))


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("name", list(SETS))
def test_measures(ctx, name, real):
    points = SETS[name]
    _, t, order = tessellate(ctx, points, real)
    reference = SphericalDiagram(points[order])
    eps, spacing = float(np.finfo(real).eps), np.sqrt(reference.areas)
    starts, rows = t.starts.get(), t.neighbors.get()
    same = np.array(
        [
            as_cycle(rows[a:b].tolist()) == as_cycle(row)
            for (a, b), row in zip(pairwise(starts.tolist()), reference.neighbors, strict=True)
        ]
    )
    assert same.mean() > 0.99
    # Positions have an error of eps, and so have corners over the sine of the angle between their faces, which is small
    # in a few cells of random sets.
    close, largest = 400 * eps * spacing.max(), 1e-5 if real == "float64" else 0.03

    def agree(found, expected, tolerance):
        away = np.abs(found - expected).reshape(len(same), -1).max(axis=1)[same]
        return np.quantile(away, 0.98) < tolerance and (away < largest * np.abs(expected).max()).all()

    assert agree(t.volumes.get(), reference.areas, close)
    assert agree(t.offsets.get().reshape(-1, 3), reference.offsets, close / spacing.min())
    tangents = UNIT.tangents(points[order])
    packed = np.column_stack(
        [np.einsum("ki,kij,kj->k", tangents[a], reference.moments, tangents[b]) for a, b in ((0, 0), (0, 1), (1, 1))]
    )
    assert agree(t.covariances.get().reshape(-1, 3), packed, 4 * close * spacing.max() / spacing.min())
    lengths, middles = t.face_measures.get(), t.face_centroids.get().reshape(-1, 3)
    for i in np.flatnonzero(same)[::7]:
        row, first = rows[starts[i] : starts[i + 1]].tolist(), starts[i]
        for j, arc, middle in zip(reference.neighbors[i], reference.arcs[i], reference.middles[i], strict=True):
            k = first + row.index(j)
            assert abs(lengths[k] - arc) < close / spacing.min()
            assert np.abs(middles[k] + points[order[i]] - middle).max() < close / spacing.min()


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("points", [*SETS.values(), grid_of_rings()], ids=[*SETS, "rings"])
def test_cells_fill_the_sphere(ctx, points, real):
    assert not faults(clvoro.Adapter(ctx, real).diagram(clvoro.Sphere(3.0), points))


def test_four_cells_at_a_vertex(ctx):
    """Faces no longer than round-off are left out: meridians and parallels give rectangles."""
    d = clvoro.Adapter(ctx).diagram(UNIT, grid_of_rings())
    sides = np.diff(d.neighbor_starts)
    assert sides[:-2].tolist() == [4] * (len(d) - 2)
    assert sides[-2:].tolist() == [36, 36]
    assert len(d.vertices) == 36 * 18


def test_few_generators(ctx):
    """A tetrahedron, a cube and an octahedron: the largest cells there are."""
    cube = np.array([(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)])
    solids = {4: cube[[0, 3, 5, 6]], 6: np.concatenate([np.eye(3), -np.eye(3)]), 8: cube}
    for n, points in solids.items():
        d = clvoro.Adapter(ctx).diagram(UNIT, points)
        assert d.volumes == pytest.approx(np.full(n, 4 * np.pi / n), rel=1e-14)
        assert d.centroids == pytest.approx(UNIT.wrap(points), abs=1e-14)


@pytest.mark.parametrize("points", [SETS["random"][:1], SETS["random"][:3], np.abs(SETS["random"])])
def test_generators_on_one_side(ctx, points):
    with pytest.raises(InputError, match="generators on the sphere leave a half of it free"):
        clvoro.Adapter(ctx).diagram(UNIT, points)


@pytest.mark.parametrize(
    ("lonlat", "message"),
    [
        ([(0, 0), (180, 0)], "none within 90 degrees of longitude"),
        ([(0, 0), (180, 0), (90, 0), (-90, 0)], "none within 89 degrees of .*latitude -?8"),
        ([(30, 40), (10, 10), (20, -30), (40, 5)], r"degrees of longitude -15\d, latitude -?\d;"),
        (np.random.default_rng(7).uniform((-3, -1.5), (3, 1.5), (50, 2)), "look like radians"),
    ],
    ids=["antipodal", "equator", "one side", "radians"],
)
def test_the_free_half_is_named(ctx, lonlat, message):
    with pytest.raises(InputError, match=message):
        clvoro.Adapter(ctx).diagram(UNIT, lonlat)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", PRECISIONS)
@pytest.mark.parametrize("step", [1e-3, 0.02, 0.2])
def test_update(ctx, step, real):
    """An update of a diagram gives the graph of a new one, after steps of any length."""
    points = SETS["random"]
    tessellator, t, order = tessellate(ctx, points, real)
    engine, n = tessellator.stages.engine, len(points)
    moved = UNIT.wrap(points[order] + step / np.sqrt(n) * np.random.default_rng(5).normal(size=(n, 3)))
    new = tessellator.tessellate(engine.upload(UNIT.place(moved, engine.real)), n, t)
    starts, rows = new.starts.get(), new.neighbors.get()
    found = [as_cycle(rows[a:b].tolist()) for a, b in pairwise(starts.tolist())]
    expected = [as_cycle(row) for row in SphericalDiagram(moved).neighbors]
    wrong = sum(a != b for a, b in zip(found, expected, strict=True))
    assert wrong <= (0 if real == "float64" else 0.01 * n)
    assert new.volumes.get().astype(float).sum() == pytest.approx(4 * np.pi, rel=64 * float(np.finfo(real).eps))


def test_lanes_and_single_cells(ctx, monkeypatch):
    """Cells that are wrapped eight at a time are those that are clipped one by one."""
    points = np.concatenate([SETS["random"], SETS["clustered"]])
    wrapped = clvoro.Adapter(ctx).diagram(UNIT, points)
    monkeypatch.setitem(LANES_FROM, 2, 10**9)
    clipped = clvoro.Adapter(ctx).diagram(UNIT, points)
    assert np.array_equal(wrapped.neighbors, clipped.neighbors)
    assert np.array_equal(wrapped.volumes, clipped.volumes)
    monkeypatch.setattr("clvoro.tessellation.cells.LANES", 1)
    single = clvoro.Adapter(ctx).diagram(UNIT, points)
    assert np.array_equal(single.neighbors, clipped.neighbors)
    assert np.array_equal(single.volumes, clipped.volumes)
