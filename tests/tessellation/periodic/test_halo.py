"""The halo of periodic boxes: comparison with the balls around the vertices of all images."""

import itertools

import numpy as np
import pytest
from scipy.spatial import Delaunay

import clvoro
from clvoro.tessellation.periodic import images
from clvoro.tessellation.periodic.ghost_images import KEPT, OUTWARDS, SIDEWAYS, GhostImages
from clvoro.tessellation.periodic.halo import BLOCKS, FEWEST_BLOCKS, FINENESS, Halo, block_counts
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.tessellator import Tessellator

BOXES = {2: clvoro.Box((0, 0), (1, 0.7), periodic=True), 3: clvoro.Box((0, 0, 0), (1, 0.7, 0.8), periodic=True)}
WALLED = {
    2: clvoro.Box((0, 0), (1, 0.7), periodic=(False, True)),
    3: clvoro.Box((0, 0, 0), (1, 0.7, 0.8), periodic=(False, True, True)),
}
NOISE = {"float64": 1e-5, "float32": 1e-4}


def lattice(box, count, rng):
    """Return a perturbed body-centered lattice: no four points nearly in a plane or on a circle."""
    cubes = np.indices((count,) * box.dim).reshape(box.dim, -1).T
    points = np.concatenate([cubes, cubes + 0.5]) / count
    points += 0.12 / count * rng.uniform(-1, 1, points.shape)
    return np.array(box.lower) + box.extent * (points % 1)


def balls(points, edges, periods):
    """Return centers and radii of empty balls through generators, one in the box, and the generators' least distance.

    Generators are mirrored at walls, so that vertices on a wall are centers as well.
    """
    steps = [(-1, 0, 1) if period > 0 else (0,) for period in periods]
    shifts = sorted(itertools.product(*steps), key=any)  # the generators themselves first
    images = np.concatenate([points + np.array(s) * periods for s in shifts])
    mirrored = [images]
    for a, end in itertools.product(np.flatnonzero(periods == 0), (0, 1)):
        beyond = images.copy()
        beyond[:, a] = 2 * end * edges[a] - images[:, a]
        mirrored.append(beyond)
    places = np.concatenate(mirrored)
    simplices = Delaunay(places).simplices
    simplices = simplices[(simplices < len(points)).any(axis=1)]
    corners = places[simplices]
    spans = corners[:, 1:] - corners[:, :1]
    # Around a vertex on a wall some simplices of mirror images are degenerate.
    whole = np.abs(np.linalg.det(spans)) > 1e-12
    corners, spans = corners[whole], spans[whole]
    centers = np.linalg.solve(spans, (spans**2).sum(axis=2)[..., None] / 2)[..., 0]
    middles, radii = corners[:, 0] + centers, np.linalg.norm(centers, axis=1)
    # A generator and its mirror image have the same distance from a vertex on the wall.
    seen = simplices[whole] % len(images)
    ways = [
        np.where(a == b, np.inf, np.linalg.norm(images[a] - images[b], axis=1))
        for a, b in itertools.combinations(seen.T, 2)
    ]
    # Centers lie on a wall up to round-off. Those behind it are mirror images of others.
    inside = ((periods > 0) | (abs(middles - edges / 2) < edges / 2 + 1e-9)).all(axis=1)
    return middles[inside], radii[inside], np.min(ways, axis=0)[inside]


def outside(x, lower, upper):
    """Return the distances (k, blocks) of x (k,) from blocks. The outermost blocks are unbounded."""
    below, above = lower - x[:, None], x[:, None] - upper
    below[:, 0] = above[:, -1] = 0
    return np.maximum(np.maximum(below, above), 0)


def needs(points, edges, periods, counts, sideways, outwards, noise):
    """Return the required depth of each block, {(axis, end): (blocks, ...)}, with room for motion of the balls."""
    centers, radii, ways = balls(points, edges, periods)
    radii = radii * (1 + noise)
    found = {}
    for axis, end in itertools.product(np.flatnonzero(periods), (0, 1)):
        to_boundary = periods[axis] - centers[:, axis] if end else centers[:, axis]
        aside2 = 0.0
        for a in (a for a in range(len(periods)) if a != axis):
            ends = np.arange(counts[a] + 1) * edges[a] / counts[a]
            away = outside(centers[:, a], ends[:-1], ends[1:])
            aside2 = aside2 + away**2 if np.ndim(aside2) == 0 else aside2[..., None] + away[:, None, :] ** 2
        shape = (-1,) + (1,) * (aside2.ndim - 1)
        radius, side = radii.reshape(shape), (sideways * ways).reshape(shape)
        out = outwards * ways + np.clip(radii + to_boundary, 0, sideways * ways)
        deep2 = radius**2 - np.maximum(np.sqrt(aside2) - side, 0) ** 2
        depth = np.sqrt(np.maximum(deep2, 0)) + (out - to_boundary).reshape(shape)
        found[axis, end] = np.where(deep2 > 0, depth, 0).max(axis=0).clip(0)
    return found


def blocks_of(array, dim, counts):
    """Return an array over blocks on the device in the form of `needs`."""
    whole = array.get().reshape(dim, 2, *(BLOCKS[dim],) * (dim - 1))
    found = {}
    for axis, end in itertools.product(range(dim), (0, 1)):
        along = [counts[a] for a in range(dim) if a != axis]
        found[axis, end] = whole[(axis, end, *(slice(k) for k in along))]
    return found


@pytest.mark.sparse
@pytest.mark.parametrize("walks", [True, False])
@pytest.mark.parametrize(("dim", "count"), [(2, 7), (3, 4)])
@pytest.mark.parametrize("walled", [False, True], ids=["", "walls"])
def test_required_depths_are_those_of_the_balls_around_vertices(adapter, dim, count, walled, walks):
    box, rng = (WALLED if walled else BOXES)[dim], np.random.default_rng(2206)
    check_depths(adapter, box, lattice(box, count, rng), walks)


def test_balls_on_walls(adapter):
    """Among random generators some balls on walls require more than all others."""
    box, rng = WALLED[2], np.random.default_rng(10)
    check_depths(adapter, box, np.array(box.lower) + box.extent * rng.random((40, 2)), True)


def check_depths(adapter, box, points, walks):
    """Check that every block is as deep as the balls require, and little deeper."""
    n, dim, real, stages = len(points), box.dim, adapter.dtype, adapter._stages_for(box)
    if not walks:
        if dim == 2 or stages.cells._walks is None:
            pytest.skip("cells are made in one way only")
        stages.cells._walks = None
    x = stages.engine.upload(box.place(points, real))
    periodic = Tessellator(stages, box)
    for _ in range(5):  # depths converge to those required
        periodic.tessellate(x, n)
    stages.release()
    periods, place = box.periods(real), x.get().astype(float)
    edges = box.device_corners(real)[1][:dim].astype(float)
    counts = block_counts(edges, n)[:dim]
    noise = NOISE[real.name]
    needed = blocks_of(periodic.steps.halo.required, dim, counts)
    widths = blocks_of(periodic.steps.halo.depths, dim, counts)
    expected = needs(place, edges, periods, counts, SIDEWAYS, OUTWARDS, noise)
    least = needs(place, edges, periods, counts, 0, 0, 0)
    spacing, requests = (np.prod(edges) / n) ** (1 / dim), 0
    for side_of_axis, request in expected.items():
        kept = KEPT[dim] * np.minimum(widths[side_of_axis], periods[side_of_axis[0]])
        excess = needed[side_of_axis] - np.maximum(request, kept)
        requests += (request > kept).sum()
        # Vertices have round-off, and a request exceeds the required depth by 1e-5 of it.
        assert np.abs(excess).max() < 3 * noise * max(spacing, request.max())
        assert (widths[side_of_axis] >= least[side_of_axis] * (1 - noise)).all()
    assert requests > 30


def test_single_diagrams_of_graded_points_take_few_images(ctx):
    """Large cells in the corners need no images of the small ones in the middle, which have no room to move there."""
    adapter, box = clvoro.Adapter(ctx, "float64"), clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)
    rng = np.random.default_rng(2208)
    ways = rng.normal(size=(600, 3))
    points = 0.5 + ways * (0.5 * rng.random(600) ** 3 / np.linalg.norm(ways, axis=1))[:, None]
    stages = adapter._stages_for(box)
    x = stages.engine.upload(box.place(points, adapter.dtype))
    t = Tessellator(stages, box).tessellate(x, 600, exact=True, complete=True)
    assert t.folded.part.count < 4 * 600
    stages.release()


@pytest.mark.sparse(2)
@pytest.mark.parametrize(("spread", "most"), [(0.01, 7), (None, 3)])
def test_few_cells_are_built_for_clusters(ctx, monkeypatch, spread, most):
    """Gaps between clusters need images from far away: the cells built until they are there are counted."""
    rng, n, built = np.random.default_rng(6), 2000, []
    points = rng.random((n, 3))
    if spread:
        points = (rng.random((20, 3))[rng.integers(0, 20, n)] + spread * rng.normal(size=(n, 3))) % 1
    monkeypatch.setitem(images.SAMPLED_FROM, 3, 1000)
    plain = Polyhedra.tessellate

    def counted(cells, part, binned, start, exact, rows):
        built.append(rows)
        return plain(cells, part, binned, start, exact, rows)

    monkeypatch.setattr(Polyhedra, "tessellate", counted)
    made = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), points)
    assert made.volumes.sum() == pytest.approx(1, rel=1e-9)
    assert sum(built) < most * n


@pytest.mark.parametrize("short", [0.6, 0.9])
def test_too_shallow_blocks_are_detected(adapter, short):
    """The halo is reported too shallow if one block of many is, and only then."""
    box, rng = BOXES[3], np.random.default_rng(2207)
    points, real = lattice(box, 4, rng), adapter.dtype
    n, stages = len(points), adapter._stages_for(box)
    x, ghost_images = stages.engine.upload(box.place(points, real)), stages.ghost_images
    periods = box.periods(real)
    counts = block_counts(periods, n)[:3]
    least = needs(x.get().astype(float), periods, periods, counts, 0, 0, 0)
    found = []
    for factor in (1.001, short):
        for axis, end in itertools.product(range(3), (0, 1)):
            halo, widths = Halo(stages.engine), {}
            whole = np.zeros((3, 2, BLOCKS[3], BLOCKS[3]), np.float32)
            for (a, e), need in least.items():
                widths[a, e] = 1.001 * need
                if (a, e) == (axis, end):
                    worst = np.unravel_index(need.argmax(), need.shape)
                    widths[a, e][worst] = factor * need.max()
                whole[a, e, : need.shape[0], : need.shape[1]] = widths[a, e]
            halo.required.set(whole.ravel())
            halo.cells = n
            found.append(is_enough(stages, ghost_images, box, x, n, halo))
    assert found == [True] * 6 + [False] * 6


def is_enough(stages, ghost_images: GhostImages, box, x, n, halo):
    """Return whether the halo is reported deep enough."""
    images = ghost_images.extend(box, x, n, halo, 1.0, False)
    binned = stages.bins.build(images.box, images.points, images.count)
    t = stages.cells.tessellate(images, binned, exact=False, rows=n)
    return ghost_images.fold(images, halo, t, x, 0.5, True)[1]


@pytest.mark.sparse(2)
@pytest.mark.parametrize(("dim", "count"), [(2, 60), (3, 100)])
def test_depths_do_not_depend_on_the_order_of_generators(adapter, dim, count):
    """Number 0, which bounds are most easily wrong for, is each generator near the boundary in turn."""
    box, rng = BOXES[dim], np.random.default_rng(2209)
    points, real = np.array(box.lower) + box.extent * rng.random((count, dim)), adapter.dtype
    n, stages = count, adapter._stages_for(box)
    periods = box.periods(real)
    counts, noise = block_counts(periods, n)[:dim], NOISE[real.name]
    place = box.place(points, real).astype(float)
    whole = np.zeros((dim, 2, *(BLOCKS[dim],) * (dim - 1)), np.float32)
    for side_of_axis, need in needs(place, periods, periods, counts, 0, 0, 2 * noise).items():
        whole[(*side_of_axis, *map(slice, need.shape))] = 1.0001 * need + noise / 10
    found, beside = [], np.minimum(place, periods - place).min(axis=1).argsort()
    for first in (n - 1, *beside[:24]):
        halo, order = Halo(stages.engine), np.arange(n)
        order[[0, first]] = first, 0
        halo.required.set(whole.ravel())
        halo.cells = n
        x = stages.engine.upload(box.place(points[order], real))
        assert is_enough(stages, stages.ghost_images, box, x, n, halo)
        found.append(halo.required.get())
    assert (found[0] > whole.ravel()).mean() > 0.3 * (found[0] > 0).mean()
    # Vertices have round-off.
    assert np.abs(found - found[0]).max() < noise


def test_nearly_a_period_counts_as_the_whole_period(adapter):
    """A depth of the whole period includes every image whatever the round-off."""
    box, rng = BOXES[2], np.random.default_rng(2210)
    stages, n = adapter._stages_for(box), 50
    x = stages.engine.upload(box.place(box.extent * rng.random((n, 2)), adapter.dtype))
    counts = block_counts(box.periods(adapter.dtype), n)[:2]
    for share in (0.98, 0.995):
        halo, periods = Halo(stages.engine), box.periods(adapter.dtype)
        whole = np.zeros((2, 2, BLOCKS[2]), np.float32)
        whole[:] = share * periods[:2, None, None]
        halo.required.set(whole.ravel())
        halo.cells = n
        stages.ghost_images.extend(box, x, n, halo, 1.0, False)
        for (axis, _), found in blocks_of(halo.depths, 2, counts).items():
            wide = share * periods[axis] if share < 0.99 else 4.0  # WHOLE_PERIOD of tessellation/periodic/halo.h
            assert found == pytest.approx(np.full(found.shape, wide), rel=1e-6)


def test_there_are_up_to_two_blocks_per_cell():
    assert (block_counts(np.array([1.0, 0.5]), 10) == BLOCKS[2]).all()
    for n in (1, 700, 5000, 40_000, 10**7):
        counts = block_counts(np.array([1.0, 0.3, 2.0]), n)[:3]
        across = FINENESS * np.array([1.0, 0.3, 2.0]) * (n / 0.6) ** (1 / 3)
        assert (counts <= np.maximum(across, FEWEST_BLOCKS)).all()
        assert ((2 * counts > across) | (counts == BLOCKS[3])).all()
    assert (block_counts(np.array([1.0, 1.0, 0.0]), 100)[:2] == BLOCKS[3]).all()


@pytest.mark.sparse(4)
@pytest.mark.parametrize(
    ("dim", "before", "after"), [(2, 600, 900), (3, 600, 5000), (3, 5000, 600), (3, 5000, 40_000), (3, 40_000, 5000)]
)
def test_depths_after_a_change_of_blocks(adapter, dim, before, after):
    """Each new block takes the largest depth among old blocks no farther away than their depth."""
    box, rng = BOXES[dim], np.random.default_rng(2208)
    stages = adapter._stages_for(box)
    halo, periods = Halo(stages.engine), box.periods(adapter.dtype)
    was, counts = (block_counts(periods, n)[:dim] for n in (before, after))
    assert dim == 2 or (was != counts).any()
    old = np.zeros((dim, 2, *(BLOCKS[dim],) * (dim - 1)), np.float32)
    for axis in range(dim):
        along = tuple(slice(was[a]) for a in range(dim) if a != axis)
        shape = [2, *(k.stop for k in along)]
        old[(axis, slice(None), *along)] = 0.02 * (1 + rng.random(shape))
    halo.required.set(old.ravel())
    halo.cells = before
    factor = (before / after) ** (1 / dim)
    points = np.array(box.lower) + box.extent * rng.random((after, dim))
    x = stages.engine.upload(box.place(points, adapter.dtype))
    stages.ghost_images.extend(box, x, after, halo, factor, False)
    found = blocks_of(halo.depths, dim, counts)
    for axis, end in itertools.product(range(dim), (0, 1)):
        across = [a for a in range(dim) if a != axis]
        depths = factor * old[(axis, end, *(slice(was[a]) for a in across))]
        # Squared distance of each new block from each old one.
        apart2 = np.zeros(())
        for a in across:
            one, other = (periods[a] / k[a] for k in (counts, was))
            middles = one * (np.arange(counts[a]) + 0.5), other * (np.arange(was[a]) + 0.5)
            gaps = np.abs(middles[0][:, None] - middles[1]) - abs(one - other) / 2
            apart2 = np.add.outer(apart2, np.maximum(gaps, 0) ** 2)
        if dim == 3:
            apart2 = apart2.transpose(0, 2, 1, 3)
        nearby = np.where(apart2 < depths**2, depths, 0)
        expected = nearby.reshape(*found[axis, end].shape, -1).max(axis=-1)
        # Random depths avoid ties between distance and depth, which round-off would decide.
        assert np.abs(found[axis, end] - expected).max() < 1e-6
