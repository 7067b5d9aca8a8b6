"""The structure of the bins, read on the host: every generator is in one leaf, at its position."""

import numpy as np
import pytest

from clvoro.geometry.box import Box
from clvoro.tessellation.bins import MAX_CHILD_SIDE, MAX_LEVELS, OCCUPANCY, SPACING_COUNT, SPLIT_COUNT, Bins
from clvoro.tessellation.periodic.ghost_images import ExtendedBox
from tests.reference import patch


def child_side(count, dim):
    """Return the number of bins per axis into which a bin of `count` generators is divided."""
    if dim == 2:
        sides = [s for s in range(2, MAX_CHILD_SIDE + 1) if count >= OCCUPANCY * s**2]
        return max(sides, default=2)
    sides = [s for s in (2, 4, 8, 16, 32) if count <= OCCUPANCY * (2 * s) ** 3]
    return min(sides, default=MAX_CHILD_SIDE)


def walk(binned, n, dim, eps):
    """Return the leaves as (first, count, origin, edge, level, spacing)."""
    bins = binned.bins.get().reshape(-1, 2)
    frames = binned.grid_frames.get().reshape(-1, 4).astype(float)
    shapes = binned.grid_shapes.get().reshape(-1, 4)
    leaves, opened = [], set()

    def open_grid(g, level):
        assert g not in opened, "a grid is reached twice"
        opened.add(g)
        first, *sides = shapes[g]
        sides = sides[:dim]
        edge = 1 / frames[g, 3]
        held = 0
        counts = np.diff(bins[first : first + np.prod(sides) + 1, 0]).reshape(sides[::-1])
        for place in range(int(np.prod(sides))):
            index = np.unravel_index(place, sides[::-1])[::-1]
            origin = frames[g, :dim] + np.array(index) * edge
            (start, grid), (end, next_grid) = bins[first + place : first + place + 2]
            count = end - start
            if grid == next_grid:
                # The spacing at an empty leaf is not used.
                for width in range(1, max(sides) + 1 if count else 1):
                    block = counts[tuple(slice(max(i - width, 0), i + width + 1) for i in index[::-1])]
                    if block.sum() >= SPACING_COUNT:
                        break
                spacing = edge * (OCCUPANCY * block.size / block.sum()) ** (1 / dim) if count else 0
                leaves.append((start, count, origin, edge, level, spacing))
            else:
                assert frames[grid, :dim] == pytest.approx(origin, abs=8 * eps)
                assert shapes[grid][1] / frames[grid, 3] == pytest.approx(edge, rel=8 * eps)
                assert count > SPLIT_COUNT[dim]
                assert set(shapes[grid][1 : dim + 1]) == {child_side(count, dim)}
                inside = open_grid(grid, level + 1)
                assert inside == count, "a divided bin does not hold what its grid holds"
            held += count
        return held

    assert open_grid(0, 0) == n
    return leaves


def check(binned, points, dim, eps):
    n = len(points)
    leaves = walk(binned, n, dim, eps)
    items = binned.items.get()[:n]
    assert np.array_equal(np.sort(items), np.arange(n)), "not every generator is in one place"
    assert np.array_equal(binned.points.get().reshape(-1, dim)[:n], points[items])
    starts, counts, origins, edges, levels, spacings = map(np.array, zip(*leaves, strict=True))
    assert ((counts <= SPLIT_COUNT[dim]) | (levels == MAX_LEVELS - 1)).all()
    leaf = np.repeat(np.arange(len(leaves)), counts)
    place = starts[leaf] + np.arange(len(leaf)) - np.repeat(np.cumsum(counts) - counts, counts)
    assert np.array_equal(np.sort(place), np.arange(n)), "leaves overlap or leave a gap"
    ascends = np.diff(items[place]) > 0
    assert ascends[np.diff(leaf) == 0].all(), "a leaf is not sorted"
    assert np.allclose(binned.reach.get()[place], edges[leaf], rtol=1e-6)
    # float32, and 1 / edge of the grid is rounded
    assert np.allclose(binned.spacing.get()[place], spacings[leaf], rtol=1e-6)
    # A generator lies in its bin up to bin_noise (bins.h), which the search allows for.
    inside = points[items[place]].astype(float)
    first = binned.grid_frames.get()[:dim].astype(float)
    noise = 16 * eps * (np.abs(inside) + np.abs(first))
    below, above = origins[leaf] - inside, inside - (origins[leaf] + edges[leaf, None])
    assert (np.maximum(below, above) <= noise).all()
    sides = binned.grid_shapes.get()[1 : 1 + dim]
    assert np.prod(sides) <= 2**dim * max(n / OCCUPANCY, 1), "far more bins than generators"
    return leaves


def sets(dim, box):
    rng = np.random.default_rng(8111)
    lower, extent = np.array(box.lower), np.array(box.upper) - box.lower
    square = lower + rng.random((700, dim)) * extent
    corners = np.array(list(np.ndindex(*(2,) * dim))) * extent + lower
    tight = lower + 0.95 * extent
    return {
        "one": square[:1],
        "two": square[:2],
        "random": square,
        "graded": lower + rng.random((900, dim)) ** 5 * extent,
        "corners": np.concatenate([corners, square[:50]]),
        "clusters": np.concatenate([tight * (1 + s * rng.random((120, dim))) for s in (1e-2, 1e-5, 1e-6, 1e-8, 1e-12)]),
        "one place": np.repeat(square[:1], 400, axis=0),
        "few places": np.repeat(square[:5], [1, 90, 11, 3000, 10], axis=0)[rng.permutation(3112)],
        "line": lower + np.linspace(0, 1, 501)[:, None] * extent,
        "lattice": np.array(list(np.ndindex(*(9,) * dim))) / 8 * extent + lower,
    }


BOXES = {
    "box": Box((0, 0), (1, 0.75)),
    "needle": Box((0, 0), (1, 1e-4)),
    "thread": Box((0, 0), (1, 1e-9)),
    "cube": Box((0, 0, 0), (1, 0.5, 0.75)),
    "sheet": Box((0, 0, 0), (1, 1, 1e-9)),
    # The extended box of a periodic box: the grid begins below 0, and positions beyond 1 have twice the round-off.
    "beyond": ExtendedBox(np.array([-0.507, -0.512]), np.array([1.507, 1.512])),
}


@pytest.fixture(scope="module", params=["float64", "float32"])
def real(request):
    return request.param


@pytest.mark.sparse
@pytest.mark.parametrize("box", BOXES)
def test_every_generator_in_one_leaf(ctx, real, box):
    box = BOXES[box]
    dim = len(box.lower)
    engine = patch.make_engine(ctx, real, dim)
    bins = Bins(engine)  # one object for all sets: its buffers are used again, and grow
    corner = np.array(box.upper).astype(real)
    for name, points in sets(dim, box).items():
        points = np.minimum(points.astype(real), corner)
        binned = bins.build(box, engine.upload(points), len(points))
        try:
            leaves = check(binned, points, dim, float(np.finfo(real).eps))
        except AssertionError as error:
            raise AssertionError(f"{name}: {error}") from error
        levels = max(leaf[4] for leaf in leaves)
        if name in ("one place", "few places"):
            assert levels == MAX_LEVELS - 1, name
        elif name in ("one", "two", "lattice"):
            assert levels == 0, name
        elif name == "clusters":
            assert levels >= 2, name


def test_uniform_sets_stay_on_one_level(ctx):
    """In random sets about one of 1e5 bins holds more than SPLIT_COUNT (Poisson, mean 2)."""
    engine = patch.make_engine(ctx)
    points = patch.random_points(20000, 202)
    leaves = walk(Bins(engine).build(patch.BOX, engine.upload(points), 20000), 20000, 2, 2e-16)
    assert np.mean([leaf[4] > 0 for leaf in leaves]) < 1e-3
    assert 0.4 * 20000 < len(leaves) < 0.6 * 20000 + 300


def test_bits_do_not_depend_on_earlier_sets(ctx, real):
    """Neither the order of atomics nor old content of the buffers changes the result."""
    engine = patch.make_engine(ctx, real)
    used, points = Bins(engine), sets(2, patch.BOX)
    first = {}
    for name in ("graded", "few places", "clusters"):
        binned = Bins(engine).build(patch.BOX, engine.upload(points[name]), len(points[name]))
        first[name] = binned.items.get()[: len(points[name])]
    for name in ("few places", "graded", "one", "clusters", "graded", "few places"):
        n = len(points[name])
        items = used.build(patch.BOX, engine.upload(points[name]), n).items.get()[:n]
        if name in first:
            assert np.array_equal(items, first[name]), name


@pytest.mark.sparse(3)
@pytest.mark.parametrize("box", BOXES)
def test_renumbered_bins_are_those_of_the_sorted_generators(ctx, real, box):
    """Renumbering gives the bits of a second sort, so that generators are binned once."""
    box = BOXES[box]
    dim = len(box.lower)
    engine = patch.make_engine(ctx, real, dim)
    for name, points in sets(dim, box).items():
        points, n = np.minimum(points, box.upper).astype(real), len(points)
        once, anew = Bins(engine), Bins(engine)
        binned = once.build(box, engine.upload(points), n)
        items = binned.items.get()[:n]
        again = anew.build(box, engine.upload(points[items]), n)
        once.renumber(binned, n)
        assert binned.sides == again.sides
        for field in set(vars(binned)) - {"sides"}:
            own, other = (getattr(b, field).get() for b in (binned, again))
            assert np.array_equal(own, other), (name, field)
        if name == "random":
            assert not np.array_equal(items, np.arange(n)), "the set was in order before"


def test_only_the_first_n_are_binned(ctx):
    engine = patch.make_engine(ctx)
    points = patch.random_points(300, 4)
    binned = Bins(engine).build(patch.BOX, engine.upload(points), 120)
    check(binned, points[:120], 2, 2e-16)


def test_capacity_grows(ctx):
    """A small set, a large one, one with more bins than estimated, and a small one again."""
    engine = patch.make_engine(ctx)
    bins = Bins(engine)
    rng = np.random.default_rng(64)
    for points in (
        patch.random_points(3, 1),
        patch.random_points(9000, 2),
        0.5 + 1e-6 * rng.random((9000, 2)) * (rng.random((9000, 1)) < 0.9),
        patch.random_points(3, 1),
    ):
        check(bins.build(patch.BOX, engine.upload(points), len(points)), points, 2, 2e-16)


def test_leaves_are_sorted_for_any_order_of_atomics(ctx):
    """Atomics on a CPU mostly arrive in order, so the test shuffles the leaves and sorts them again."""
    engine = patch.make_engine(ctx)
    points = sets(2, patch.BOX)["few places"]
    n, bins = len(points), Bins(engine)
    binned = bins.build(patch.BOX, engine.upload(points), n)
    leaves = walk(binned, n, 2, 2e-16)
    expected = binned.items.get()
    mixed, rng = expected.copy(), np.random.default_rng(56)
    for start, count, *_ in leaves:
        mixed[start : start + count] = rng.permutation(mixed[start : start + count])
    assert (mixed != expected).sum() > 2000
    items = engine.upload(mixed, np.int32)
    engine.run_each(
        bins._kernels.sort_bins,
        len(bins._bins) // 2 - 1,
        bins._bins,
        bins._grid_of,
        bins._frames,
        bins._shapes,
        items,
        binned.reach,
        binned.spacing,
    )
    assert np.array_equal(items.get(), expected)
