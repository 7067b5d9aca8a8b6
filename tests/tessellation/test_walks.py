"""Cells in 3D from walks along their edges: comparison with clipping and with Qhull."""

import numpy as np
import pytest

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.part import Part
from clvoro.tessellation.polyhedra import CUBE as CUBE_SIDE
from clvoro.tessellation.polyhedra import FIRST_REACH, STRETCH, Polyhedra
from clvoro.tessellation.polyhedra_update import PolyhedraUpdate
from tests.reference import diagrams3d as reference3d
from tests.reference.diagrams3d import directions, lattice

CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
UNFINISHED, CERTAIN = np.iinfo(np.int32).min, 1 << 30


@pytest.fixture(scope="module")
def engine(ctx):
    adapter = clvoro.Adapter(ctx, dtype="float64")
    made = Engine(adapter.ctx, adapter.queue, 3, np.dtype(float))
    if Polyhedra(made)._walks is None:
        pytest.skip("cells are walked on CPUs")
    return made


def point_sets():
    rng = np.random.default_rng(34603)
    random = rng.random((4000, 3))
    bcc = lattice("bcc", 6)
    spot = np.array([0.4, 0.3, 0.6])
    shell = np.exp(-6 * rng.random((2000, 1)))
    hollow = 0.02 * np.exp(3.2 * rng.random((3000, 1)))
    return {
        **{f"{n} random": random[:n] for n in (1, 2, 3, 7, 8, 9, 100, STRETCH + 1)},
        "random": random,
        "cubed": rng.random((2000, 3)) ** 3,
        # Cells around the empty ball reach its center.
        "hollow": np.clip(0.5 + hollow * directions(3000, rng), 0, 1),
        "radial": np.clip(spot + 0.6 * shell * directions(2000, rng), 0, 1),
        "clusters": np.concatenate(
            [spot + s * (rng.random((300, 3)) - 0.5) for s in (1e-2, 1e-4, 1e-6)] + [random[:50]]
        ),
        # Cells as long as the box with neighbors at a thousandth of that: edges lie on bisectors up to a few eps.
        "spots": np.clip(random[:150].repeat(20, axis=0) + 1e-3 * rng.standard_normal((3000, 3)), 1e-6, 1),
        "a dense and an empty half": np.concatenate([random[:2000] * [0.3, 1, 1], [[0.99, 0.7, 0.2]]]),
        "cubic": lattice("cubic", 8),
        "bcc": bcc,
        "bcc, rounded": bcc + 1e-15 * rng.standard_normal(bcc.shape),
        "bcc, nearly": bcc + 1e-9 * rng.standard_normal(bcc.shape),
        "bcc, jittered": bcc + 0.02 * (rng.random(bcc.shape) - 0.5),
        "fcc": lattice("fcc", 5),
        "to the walls": np.array(list(np.ndindex(6, 6, 6))) / 5,
        "sphere and center": np.concatenate([0.5 + 0.4 * directions(60, rng), [[0.5, 0.5, 0.5]]]),
        "line": np.linspace([0.01, 0.02, 0.03], [0.99, 0.9, 0.8], 300),
        "plane": np.column_stack([random[:500, :2], np.full(500, 0.3)]),
        "near walls": np.concatenate([random[:300] * [1, 1, 1e-5], random[300:900]]),
        "pairs": np.concatenate([random[:500], random[:500] + 1e-6 * (random[500:1000] - 0.5)]),
        "few and a cluster": np.concatenate([random[:20], 0.5 + 0.05 * directions(3000, rng) * rng.random((3000, 1))]),
        # Of some there walls were the nearest at first, and what a cell was walked from once more lay outside of it.
        **{f"clump {seed}": clump(seed) for seed in (165, 2459, 7147)},
    }


def clump(seed):
    rng = np.random.default_rng(seed)
    return np.concatenate([0.5 + 0.016 * rng.random((100, 3)), rng.random((30, 3))])


POINTS = point_sets()


def walked(engine, points, rows=None):
    """Return the numbers of faces after walking alone, `UNFINISHED` for cells left to clipping."""
    n, x = len(points), engine.upload(points)
    rows = n if rows is None else rows
    cells, b = Polyhedra(engine), Bins(engine).build(CUBE, x, n)
    counts = engine.zeros(rows, np.int32)
    places, labels = engine.empty(rows, np.int32), engine.empty(40 * n, np.int32)
    sizes = [(40 * n,), (40 * n, 3), (rows,), (rows, 3), (rows, 6)]
    report = engine.zeros(2, np.int32)
    engine.run_each(
        cells._walks.walk_all_cells,
        -(-rows // STRETCH),
        np.int32(rows),
        cells._ordered(b, rows),
        b.points,
        b.items,
        b.spacing,
        b.reach,
        b.bins,
        b.grid_frames,
        b.grid_shapes,
        *CUBE.device_corners(engine.real),
        engine.real.type(FIRST_REACH),
        np.int32(40 * n),
        places,
        counts,
        labels,
        *(engine.empty(size) for size in sizes),
        report,
        np.int32(0),
        report,
        group=1,
    )
    counts = counts.get()
    counts[counts > 0] -= CERTAIN
    assert ((counts >= 4) | (counts == UNFINISHED)).all()
    assert report.get().tolist() == [0, counts[counts > 0].sum()]
    return counts


class Rows:
    """Return the rows of a diagram on the host, with faces in the order of labels."""

    def __init__(self, t):
        starts = t.starts.get()
        m = starts[-1]
        cell = np.repeat(np.arange(t.n), np.diff(starts))
        order = np.lexsort((t.neighbors.get()[:m], cell))
        self.starts, self.cell = starts, cell
        self.neighbors = t.neighbors.get()[:m][order]
        self.areas = t.face_measures.get()[:m][order]
        self.centroids = t.face_centroids.get()[:m][order]
        self.volumes, self.offsets = t.volumes.get(), t.offsets.get()
        self.covariances = t.covariances.get()


def tessellations(engine, points, rows=None):
    """Return the diagram with walking and without it, and the radii after both."""
    n, x = len(points), engine.upload(points)
    found = []
    for walk in (True, False):
        cells, binned = Polyhedra(engine), Bins(engine).build(CUBE, x, n)
        if not walk:
            cells._walks = None
        t = cells.tessellate(Part.alone(x, CUBE), binned, exact=False, rows=rows)
        radii = np.zeros(n)
        radii[binned.items.get()[:n]] = binned.reach.get()[:n]
        found.append((Rows(t), radii[: t.n]))
    return found


@pytest.mark.sparse(12)
@pytest.mark.parametrize("name", list(POINTS))
def test_cells_are_those_of_clipping(engine, name):
    (a, reach_a), (b, reach_b) = tessellations(engine, POINTS[name])
    assert np.array_equal(a.starts, b.starts)
    assert np.array_equal(a.neighbors, b.neighbors)
    # The round-off of a vertex is eps times its distance over the volume that the normals of its faces span. Where
    # cells are walked, that volume is at least 1e-5, mostly much more. Areas and moments have the same relative error.
    reach = reach_b / 2
    eps = 1e-10
    assert (np.abs(a.areas - b.areas) <= eps * reach[a.cell] ** 2).all()
    moments_a, moments_b = (r.areas[:, None] * r.centroids for r in (a, b))
    assert (np.abs(moments_a - moments_b) <= eps * reach[a.cell, None] ** 3).all()
    assert (np.abs(a.centroids - b.centroids) <= 1e-6 * reach[a.cell, None]).all()
    assert np.abs(a.volumes - b.volumes) == pytest.approx(0, abs=eps * (reach**3).max())
    assert (np.abs(a.volumes / b.volumes - 1) <= eps * reach**3 / b.volumes).all()
    ratio = reach**3 / b.volumes
    assert (np.abs(a.offsets - b.offsets).max(axis=1) <= eps * reach * ratio).all()
    assert (np.abs(a.covariances - b.covariances).max(axis=1) <= eps * reach**2 * ratio).all()
    # Stored in single precision.
    assert reach_a == pytest.approx(reach_b, rel=1e-6)


@pytest.mark.sparse(3)
@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("random", 0.99),
        ("bcc, jittered", 0.99),
        ("cubed", 0.9),
        ("radial", 0.95),
        ("hollow", 0.98),
        # Cells that near generators do not close, and cells that many generators may cut.
        ("a dense and an empty half", 0.99),
        ("few and a cluster", 0.99),
        ("clusters", 0.8),
    ],
)
def test_most_cells_are_walked(engine, name, share):
    """Otherwise the kernel would be useless. Lattices, where every decision is near round-off, are left to clipping."""
    counts = walked(engine, POINTS[name])
    assert np.count_nonzero(counts > 0) >= share * len(counts)


def morton(side):
    """Return the bins (x, y, z) of a cube of `side` bins per axis, a power of two, in Morton order."""
    if side == 1:
        return np.zeros((1, 3), int)
    half = morton(side // 2)
    return np.concatenate([half + side // 2 * np.array([x, y, z]) for z, y, x in np.ndindex(2, 2, 2)])


@pytest.mark.sparse(5)
@pytest.mark.parametrize("name", ["1 random", "random", "cubed", "clusters", "to the walls"])
@pytest.mark.parametrize("extent", [(1, 1, 1), (1, 0.2, 0.05), (1, 0.6, 1)])
def test_cells_are_walked_in_morton_order(engine, name, extent):
    """Cubes of bins follow each other along x first; inside them and in divided bins the order is Morton's."""
    box = clvoro.Box((0, 0, 0), extent)
    points = POINTS[name] * box.extent
    n = len(points)
    b = Bins(engine).build(box, engine.upload(points), n)
    bins, shapes = b.bins.get().reshape(-1, 2), b.grid_shapes.get().reshape(-1, 4)
    expected = []

    def follow(grid, places):
        first, *sides = shapes[grid]
        for x, y, z in places[(places < sides).all(axis=1)]:
            (start, own), (end, following) = bins[first + (z * sides[1] + y) * sides[0] + x :][:2]
            if own == following:
                expected.extend(range(start, end))
            else:
                follow(own, morton(shapes[own, 1]))

    for cube in np.ndindex(*(-(-side // CUBE_SIDE) for side in b.sides[::-1])):
        follow(0, CUBE_SIDE * np.array(cube[::-1]) + morton(CUBE_SIDE))
    assert np.array_equal(Polyhedra(engine)._ordered(b, n).get()[:n], expected)


def test_against_qhull(engine):
    points = POINTS["100 random"]
    counts = walked(engine, points)
    assert np.count_nonzero(counts > 0) > 95
    (t, _), _ = tessellations(engine, points)
    for i, cell in enumerate(reference3d.box_voronoi(CUBE.lower, CUBE.upper, points)):
        if counts[i] < 0:
            continue
        own = slice(*t.starts[i : i + 2])
        # Qhull also lists mirror images of other generators, with faces of zero area.
        faces = {label: area for label, area in cell.faces.items() if area > 1e-12}
        assert t.neighbors[own].tolist() == sorted(faces)
        for k in range(own.start, own.stop):
            label = int(t.neighbors[k])
            assert t.areas[k] == pytest.approx(faces[label], abs=1e-12)
            if faces[label] > 1e-6:
                expected = cell.face_centroids[label] - points[i]
                assert t.centroids[k] == pytest.approx(expected, abs=1e-9)
        assert t.volumes[i] == pytest.approx(cell.volume, rel=1e-11)
        assert t.offsets[i] == pytest.approx(cell.centroid - points[i], abs=1e-11)
        assert t.covariances[i] == pytest.approx(cell.covariance[np.triu_indices(3)], abs=1e-12)


def test_coincident_generators_are_left_to_clipping(engine):
    points = POINTS["random"][:300].copy()
    points[[30, 77]] = points[123]
    counts = walked(engine, points)
    assert (counts[[30, 77, 123]] == UNFINISHED).all()
    assert np.count_nonzero(counts > 0) > 250


def test_cells_of_the_first_generators_only(engine):
    """As in periodic boxes, where images get no cells."""
    points = POINTS["random"][:900]
    (a, _), (b, _) = tessellations(engine, points, rows=400)
    whole = tessellations(engine, points)[0][0]
    assert len(a.volumes) == 400
    assert np.array_equal(a.neighbors, b.neighbors)
    assert np.array_equal(a.neighbors, whole.neighbors[: whole.starts[400]])
    assert a.volumes == pytest.approx(whole.volumes[:400], rel=1e-12)


def test_face_arrays_grow(engine, monkeypatch):
    """Faces beyond the capacity are counted, and all cells are made again, with the same bits."""
    points = POINTS["random"][:500]
    expected = tessellations(engine, points)[0][0]
    monkeypatch.setattr("clvoro.tessellation.polyhedra.FACES_PER_CELL", 0.1)
    found = tessellations(engine, points)[0][0]
    for array in vars(found):
        assert np.array_equal(getattr(found, array), getattr(expected, array)), array


def test_an_update_without_motion_keeps_the_bits(engine):
    """Cells are measured from their vertices by the same function, whoever has found these."""
    n, x = 800, engine.upload(POINTS["random"][:800])
    cells, binned = Polyhedra(engine), Bins(engine).build(CUBE, x, n)
    t = cells.tessellate(Part.alone(x, CUBE), binned, exact=False)
    new = Rows(t)
    updated = Rows(PolyhedraUpdate(engine).update(cells, CUBE, x, t, None))
    for name, array in vars(new).items():
        assert np.array_equal(array, getattr(updated, name)), name
