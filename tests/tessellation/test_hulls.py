"""Rows from convex hulls: comparison with clipping and with SciPy's hulls."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from clvoro.tessellation.bins import MAX_LEVELS, Bins
from clvoro.tessellation.cells import EIGHTS, FIRST_REACH, LANES, Cells
from clvoro.tessellation.part import Part
from tests.reference import patch

BOX = patch.BOX


@pytest.fixture(scope="module")
def engine(ctx):
    made = patch.make_engine(ctx)
    if Cells(made)._hulls is None:
        pytest.skip("hulls are for CPUs")
    return made


def point_sets():
    rng = np.random.default_rng(61001)
    extent = np.array([1, 0.75])
    random = rng.random((5000, 2)) * extent
    grid = np.stack(np.meshgrid(np.arange(24) / 24, np.arange(18) / 24), axis=-1).reshape(-1, 2)
    turn = np.linspace(0, 2 * np.pi, 41)[:-1]
    ring = 0.375 + 0.3 * np.column_stack([np.cos(turn), np.sin(turn)])
    spot = np.array([0.4, 0.3])
    trio = np.array([[0, 0], [1, 0], [0, 1]])
    fan, gaps = np.array([[4e-3, 0], [0, 0], [0, 1], [0, -1]]), 10.0 ** -np.linspace(4, 9, 60)
    return {
        **{f"{n} random": random[:n] for n in (1, 2, 3, 7, 8, 9, 100)},
        "random": random,
        "cubed": rng.random((3000, 2)) ** 3 * extent,
        "radial": spot + 0.3 * np.exp(-9 * rng.random((3000, 1))) * unit(rng, 3000),
        "clusters": np.concatenate(
            [spot + s * (rng.random((300, 2)) - 0.5) for s in (1e-3, 1e-6, 1e-9)] + [random[:50]]
        ),
        "a dense and an empty half": np.concatenate([random[:3000] * [0.5, 1], [[0.99, 0.7]]]),
        "lattice": grid + 1 / 48,
        "lattice to the walls": grid,
        "lattice, rounded": grid + 1 / 48 + 1e-15 * rng.standard_normal(grid.shape),
        "lattice, nearly": grid + 1 / 48 + 1e-9 * rng.standard_normal(grid.shape),
        "hexagons": patch.hexagons(0.02),
        "ring": ring,
        "ring and center": np.concatenate([ring, [[0.375, 0.375]]]),
        "line": np.column_stack([np.linspace(0.01, 0.99, 777), np.full(777, 0.3)]),
        "walls": np.column_stack([rng.random(400), 0.75 * rng.integers(0, 2, 400)]),
        "near walls": np.concatenate([random[:300] * [1, 1e-5], random[300:900]]),
        # Two of three generators may be collinear with a corner of a hull up to round-off, while the third is not.
        **{
            f"trios, {gap}": np.concatenate([(p + gap * trio) for p in random[:60]] + [random[60:900]])
            for gap in (1e-6, 1e-8, 1e-9, 1e-10)
        },
        # The nearest of three generators in a row has a face as short as their distance.
        "rows of three": np.concatenate(
            [(p + fan * [1, gap]) for p, gap in zip(random, gaps, strict=False)] + [random[60:900]]
        ),
        "around a hole": spot + 0.3 * np.exp(-7 * rng.random((4000, 1))) * unit(rng, 4000),
        "pairs": np.concatenate([random[:500], random[:500] + 1e-6 * (random[500:1000] - 0.5)]),
    }


def unit(rng, n):
    turn = 2 * np.pi * rng.random(n)
    return np.column_stack([np.cos(turn), np.sin(turn)])


POINTS = point_sets()


def wrapped_rows(engine, points, first_reach=FIRST_REACH):
    """Return the numbers of faces after wrapping alone, 0 for cells left to clipping, and the rows."""
    n, x = len(points), engine.upload(points)
    cells, binned = Cells(engine), Bins(engine).build(BOX, x, n)
    rows = cells.take_rows(n, BOX, x, exact=True)
    engine.run_each(
        cells._hulls.wrap_all_hulls,
        -(-n // (LANES * EIGHTS)),
        np.int32(n),
        np.int32(n),
        binned.points,
        binned.items,
        binned.spacing,
        binned.reach,
        binned.bins,
        binned.grid_frames,
        binned.grid_shapes,
        *BOX.device_corners(engine.real),
        engine.real.type(first_reach),
        rows.slots,
        rows.counts,
        rows.places,
        group=1,
    )
    assert (rows.places.get() == np.arange(n)).all()
    return rows.counts.get(), rows.slots.get().reshape(n, -1)


@pytest.mark.sparse(12)
@pytest.mark.parametrize("name", list(POINTS))
def test_rows_are_those_of_clipping(engine, name):
    points = np.clip(POINTS[name], 0, [1, 0.75])
    n, x = len(points), engine.upload(points)
    found = []
    for wrap in (True, False):
        cells, binned = Cells(engine), Bins(engine).build(BOX, x, n)
        taken, take = [], cells.take_rows
        cells.take_rows = lambda *given, taken=taken, take=take, **options: (
            taken.append(take(*given, **options)) or taken[-1]
        )
        if not wrap:
            cells._hulls = None
        t = patch.fetch(cells.tessellate(Part.alone(x, BOX), binned, exact=False))
        found.append((t, taken[-1].counts.get()[:n], binned.reach.get()[:n]))
    (a, counts_a, reach_a), (b, counts_b, reach_b) = found
    assert np.array_equal(counts_a, counts_b), "other faces, or other doubts"
    assert np.array_equal(a.neighbors, b.neighbors)
    assert np.array_equal(a.volumes, b.volumes)
    # The radius comes from inverted positions, whose round-off is eps times the ratio of distances.
    assert reach_a == pytest.approx(reach_b, rel=1e-6)


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    "name", ["1 random", "9 random", "random", "clusters", "ring and center", "lattice to the walls"]
)
def test_measures_in_lanes_are_those_of_single_cells(engine, name):
    points = np.clip(POINTS[name], 0, [1, 0.75])
    n, x = len(points), engine.upload(points)
    found = []
    for lanes in (LANES, 1):
        cells, binned = Cells(engine), Bins(engine).build(BOX, x, n)
        build = cells._build

        def build_so(*capacities, cells=cells, build=build, lanes=lanes):  # capacities may grow
            build(*capacities)
            defines = {**cells.defines, "MAX_DEPTH": MAX_LEVELS, "IN_LANES": int(lanes > 1)}
            cells._kernels, cells.lanes = engine.kernels("tessellation/cells", defines), lanes

        cells._build = build_so
        cells._build(cells.cell_capacity, cells.row_capacity)
        found.append(patch.fetch(cells.tessellate(Part.alone(x, BOX), binned, exact=False)))
    a, b = found
    for field in ("starts", "neighbors", "face_measures", "face_centroids", "volumes", "offsets", "covariances"):
        assert np.array_equal(getattr(a, field), getattr(b, field)), field


@pytest.mark.parametrize(("name", "share"), [("random", 0.99), ("hexagons", 0.99), ("cubed", 0.95), ("radial", 0.9)])
def test_most_cells_are_wrapped(engine, name, share):
    """Otherwise the kernel would be useless. Lattices, where every decision is near round-off, are left to clipping."""
    counts, _ = wrapped_rows(engine, np.clip(POINTS[name], 0, [1, 0.75]))
    assert np.count_nonzero(counts) >= share * len(counts)


@pytest.mark.parametrize(("count", "is_wrapped"), [(14, True), (15, True), (16, True), (17, False)])
def test_cells_have_up_to_sixteen_faces(engine, count, is_wrapped):
    turn = 2 * np.pi * np.arange(count) / count
    ring = [0.5, 0.375] + 0.2 * np.column_stack([np.cos(turn), np.sin(turn)])
    ring += 1e-3 * np.random.default_rng(61002).random(ring.shape)
    counts, rows = wrapped_rows(engine, np.concatenate([[[0.5, 0.375]], ring]))
    assert counts[0] == (count if is_wrapped else 0)
    assert not is_wrapped or rows[0, :count].tolist() == list(range(1, count + 1))


@pytest.mark.sparse(4)
@pytest.mark.parametrize("first_reach", [0.2, 0.7, 5.0])
@pytest.mark.parametrize("name", ["random", "radial", "hexagons", "cubed"])
def test_rows_do_not_depend_on_the_first_search_radius(engine, name, first_reach):
    """With a small radius no hull contains the generator and searches repeat; with a large one lists are cut."""
    points = np.clip(POINTS[name], 0, [1, 0.75])
    (counts, rows), (others, other_rows) = (wrapped_rows(engine, points, reach) for reach in (FIRST_REACH, first_reach))
    both = (counts > 0) & (others > 0)
    assert np.count_nonzero(both) > 0.8 * len(points)
    assert np.array_equal(counts[both], others[both])
    listed = both[:, None] & (np.arange(rows.shape[1]) < counts[:, None])
    assert np.array_equal(rows[listed], other_rows[listed])


def test_against_scipy(engine):
    points = POINTS["random"][:300]
    counts, rows = wrapped_rows(engine, points)
    assert np.count_nonzero(counts) > 290
    lower, upper = np.zeros(2), np.array([1, 0.75])
    for i in np.flatnonzero(counts):
        x = points[i]
        walls = [
            [2 * (lower[0] - x[0]), 0],
            [2 * (upper[0] - x[0]), 0],
            [0, 2 * (lower[1] - x[1])],
            [0, 2 * (upper[1] - x[1])],
        ]
        d = np.concatenate([np.delete(points, i, axis=0) - x, walls])
        labels = np.append(np.delete(np.arange(300), i), [-1, -2, -3, -4])
        hull = labels[ConvexHull(d / (d**2).sum(axis=1)[:, None]).vertices]
        least = int(np.argmin(hull))
        assert rows[i, : counts[i]].tolist() == np.roll(hull, -least).tolist()


def test_cells_that_span_many_bins(engine):
    """Cells around a hole meet in its middle. The search must skip most generators within their reach."""
    points = np.clip(POINTS["around a hole"], 0, [1, 0.75])
    nearest = np.argsort(np.hypot(*(points - [0.4, 0.3]).T))[:40]
    cells, x = Cells(engine), engine.upload(points)
    cells._hulls = None
    t = patch.fetch(cells.tessellate(Part.alone(x, BOX), Bins(engine).build(BOX, x, len(points))))
    for i in nearest:
        d = np.delete(points, i, axis=0) - points[i]
        hull = ConvexHull(d / (d**2).sum(axis=1)[:, None]).vertices
        row = t.neighbors[t.starts[i] : t.starts[i + 1]]
        assert set(row) == set(np.delete(np.arange(len(points)), i)[hull])


def test_coincident_generators_are_left_to_clipping(engine):
    points = POINTS["random"][:200].copy()
    points[[30, 77]] = points[123]
    counts, _ = wrapped_rows(engine, points)
    assert (counts[[30, 77, 123]] == 0).all()
    assert np.count_nonzero(counts) > 150
