"""Parts with ghosts: two halves of a box with each other's generators as halos; a periodic box that is not folded."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy

from clvoro.adaptation.insertion_deletion import CellSizes, Change, Generators, Present
from clvoro.adaptation.stages import Stages
from clvoro.geometry.box import Box
from clvoro.opencl.peers import ALONE
from clvoro.opencl.threads import Team
from clvoro.solvers import multigrid
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.volume_projection import Penalty, Targets
from clvoro.tessellation import decomposition, part_steps
from clvoro.tessellation.part import Ghosts, Part
from clvoro.tessellation.part_steps import NEAR, BallGroups, Chunks
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch

N = {2: 500, 3: 900}
SPACINGS = 5
"""Depth of a halo, in mean spacings: deeper than any cell of these sets."""
REALS = [pytest.param(np.dtype(name), id=name) for name in ("float64", "float32")]


class Halves:
    """A box, its generators, and the two parts of those left and right of its middle, with halos of some depth.

    Labels are a random permutation. Threads, each with an engine, are the peers.
    """

    def __init__(self, ctx, dim, real, spacings=SPACINGS):
        self.ctx, self.real = ctx, real
        self.box = Box((0,) * dim, (2, 0.75, 0.9)[:dim])
        n, rng = N[dim], np.random.default_rng(60101)
        x = rng.random((n, dim)) * self.box.extent
        right = x[:, 0] > 1
        x = np.concatenate([x[~right], x[right]])
        self.n, self.places, self.labels = n, self.box.place(x, real), rng.permutation(2 * n)[:n].astype(np.int32)
        numbers, near = np.arange(n), np.abs(x[:, 0] - 1) < spacings * (self.box.measure / n) ** (1 / dim)
        self.bounds = 0, int(np.count_nonzero(~right)), n
        left = numbers < self.bounds[1]
        # Numbers in the whole of the rows of each part.
        self.rows = [np.concatenate([numbers[own], numbers[~own & near]]) for own in (left, ~left)]
        self.n_own = np.diff(self.bounds).tolist()

    def stages(self, peers=ALONE):
        stages = Stages(patch.make_engine(self.ctx, self.real, self.box.dim, box=self.box))
        stages.engine.peers = peers
        return stages

    def part(self, stages, peers=None):
        """Return the part of a thread, or the whole."""
        engine, rows = stages.engine, np.arange(self.n) if peers is None else self.rows[peers.number]
        n_own = self.n if peers is None else self.n_own[peers.number]
        ghosts = None
        if peers is not None:
            owners = rows[n_own:] - self.bounds[1 - peers.number]
            sent = peers.exchange([owners if part != peers.number else owners[:0] for part in range(2)])
            ghosts = Ghosts.of_lists(engine, peers, np.full(len(owners), 1 - peers.number), owners, sent)
        labels = engine.upload(self.labels[rows], np.int32)
        return Part(n_own, len(rows), engine.upload(self.places[rows]), self.box, ghosts, labels=labels)

    def run(self, work):
        """Return what ``work(stages, part, rows)`` returns for the whole, and for each of both halves in a thread.

        `rows` are the numbers in the whole of the rows of the part.
        """
        stages = self.stages()
        whole = work(stages, self.part(stages), np.arange(self.n))

        def of_part(peers):
            own = self.stages(peers)
            return work(own, self.part(own, peers), self.rows[peers.number])

        return whole, Team(2).run(of_part)

    def joined(self, found):
        """Return arrays of both halves as one of the whole."""
        return np.concatenate([values[:n] for values, n in zip(found, self.n_own, strict=True)])


def tessellate(stages, part, whole=False):
    return Tessellator(stages, part.box).tessellate_part(part, whole=whole)


@pytest.fixture(params=[2, 3])
def dim(request):
    return request.param


@pytest.mark.parametrize("real", REALS)
def test_cells_that_both_measurements_see_differently_keep_their_rows(ctx, real):
    halves = Halves(ctx, 3, real)
    stages = halves.stages()
    part = halves.part(stages)
    t = tessellate(stages, replace(part, labels=None))
    starts, wrong = t.starts.get()[: N[3] + 1], np.arange(N[3]) % 3 == 0
    rows = t.neighbors.get()[: starts[-1]]
    volumes = t.volumes.get()[: N[3]] * np.where(wrong, 1.001, 1).astype(real)
    t.volumes.set(volumes)
    part.order_rows(stages.engine, t, stages.cells.defines)
    assert t.volumes.get() == pytest.approx(volumes, rel=1e-4)
    assert (t.volumes.get() == volumes)[wrong].all()
    after = t.neighbors.get()[: starts[-1]]
    names = np.where(after < 0, after, halves.labels[after])
    ascend = [(np.diff(names[a:b]) > 0).all() for a, b in pairwise(starts)]
    kept = [(rows[a:b] == after[a:b]).all() for a, b in pairwise(starts)]
    assert np.mean(ascend, where=~wrong) > 0.7  # cells of many faces are ordered in another launch
    assert np.all(kept, where=wrong)


@pytest.mark.sparse(4)
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("real", REALS)
def test_diagrams_of_two_halves_have_the_bits_of_the_whole(ctx, dim, real, whole):
    """Rows in the order of labels, measures, centroids and moments: each cell has the same bits wherever it is made."""
    halves = Halves(ctx, dim, real)

    def work(stages, part, rows):
        t = tessellate(stages, part, whole)
        assert (t.n, t.rows) == (part.n_own, part.count)
        assert (t.whole is not None) == (whole or part.ghosts is None)
        found = patch.fetch(t)
        found.neighbors = np.where(found.neighbors >= 0, rows[np.maximum(found.neighbors, 0)], found.neighbors)
        return found

    one, two = halves.run(work)
    starts = np.concatenate([np.diff(found.starts) for found in two]).cumsum()
    assert np.array_equal(np.append(0, starts), one.starts)
    same = np.ones(halves.n, bool)
    for name in ("neighbors", "face_measures", "face_centroids"):
        differ = np.concatenate([getattr(found, name) for found in two]) != getattr(one, name)
        same[one.owners[differ.reshape(len(differ), -1).any(axis=1)]] = False
    for name in ("volumes", "offsets", "covariances"):
        differ = halves.joined([getattr(found, name) for found in two]) != getattr(one, name)
        same &= ~differ.reshape(len(differ), -1).any(axis=1)
    across = (one.owners < halves.bounds[1]) != (one.neighbors < halves.bounds[1])
    assert np.count_nonzero(across & (one.neighbors >= 0)) > 40
    # Against the order in which cells are clipped: neighbors are the same, measures differ by round-off.
    stages = halves.stages()
    plain = patch.fetch(tessellate(stages, replace(halves.part(stages), labels=None)))
    for i in np.flatnonzero(same):
        row, other = (d.neighbors[d.starts[i] : d.starts[i + 1]] for d in (one, plain))
        names = np.where(row < 0, row, halves.labels[row])
        assert np.array_equal(np.sort(row), np.sort(other))
        same[i] = names.argmin() == 0 and (dim == 2 or np.array_equal(names, np.sort(names)))
    # In single precision round-off may decide whether a cell has a face of no area: such a cell is not measured again.
    assert np.count_nonzero(~same) <= (3 if (dim, real) == (3, np.float32) else 0)
    noise = 1e3 * np.finfo(real).eps
    assert np.abs(one.volumes - plain.volumes).max() < noise * one.volumes.max()
    assert np.abs(one.covariances - plain.covariances).max() < noise


@pytest.mark.sparse(2)
@pytest.mark.parametrize("values", [np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.int32)])
@pytest.mark.parametrize("columns", [(), (3,)])
def test_ghosts_get_the_values_of_their_owners(ctx, dim, values, columns):
    halves = Halves(ctx, dim, np.dtype(np.float64))
    given = np.random.default_rng(60102).integers(1, 1 << 20, (halves.n, *columns)).astype(values)

    def work(stages, part, rows):
        filled = given[rows].copy()
        filled[part.n_own :] = 0
        device = stages.engine.upload(filled, values)
        part.forward(stages.engine, device)
        assert np.array_equal(device.get(), given[rows])
        again = stages.engine.upload(filled, values)
        names = stages.engine.upload(np.where(np.arange(len(rows)) < part.n_own, rows, 0), np.int32)
        part.forward(stages.engine, again, names)
        assert np.array_equal(again.get(), given[rows])
        assert np.array_equal(names.get(), rows)
        peers = stages.engine.peers
        assert np.array_equal(peers.total(np.array([part.n_own])), [halves.n])
        assert peers.before(np.array([part.n_own])) == rows[0]

    halves.run(work)
    # Ghosts without owner keep their values, and so do all if they have no owners.
    stages = halves.stages()
    points, owners = stages.engine.zeros((9, dim)), stages.engine.upload([3, -1, 0, -1], np.int32)
    part = Part(5, 9, points, halves.box, Ghosts(owners))
    for ghosts, expected in ((None, [0] * 4), (part.ghosts, [4, 0, 1, 0])):
        device = stages.engine.upload([1, 2, 3, 4, 5, 0, 0, 0, 0], values)
        replace(part, ghosts=ghosts).forward(stages.engine, device)
        assert device.get()[5:].tolist() == expected


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_the_laplacian_of_two_halves(ctx, dim, real):
    """Products of the matrix with values of ghosts from the other half."""
    halves = Halves(ctx, dim, real)
    values = np.random.default_rng(60103).random(halves.n).astype(real)

    def work(stages, part, rows):
        engine, poisson, t = stages.engine, stages.poisson, tessellate(stages, part)
        with engine.workspace.frame():
            x, y = engine.upload(np.where(np.arange(part.count) < part.n_own, values[rows], 0)), engine.empty(t.n)
            part.forward(engine, x)
            poisson.apply(poisson.assemble(t.starts, t.neighbors, t.face_measures, part.points), x, y)
            return y.get()

    whole, found = halves.run(work)
    assert np.abs(halves.joined(found) - whole).max() < 1e4 * np.finfo(real).eps * np.abs(whole).max()


@pytest.mark.sparse(4)
@pytest.mark.parametrize("gathered", [None, 5000, 50])
@pytest.mark.parametrize("from_zero", [True, False])
@pytest.mark.parametrize("real", REALS)
def test_the_poisson_equation_in_two_halves(ctx, dim, real, from_zero, gathered, monkeypatch):
    """Both halves iterate together: products take values from the other half, sums are over both.

    By Jacobi's preconditioner, by multigrid on all cells in each half, and with aggregates within halves.
    """
    preconditioner = "jacobi" if gathered is None else "multigrid"
    monkeypatch.setattr(multigrid, "GATHERED", gathered or 0)
    halves, rng = Halves(ctx, dim, real), np.random.default_rng(60105)
    tolerance = 1e-9 if real == np.float64 else 1e-4
    source, start = (rng.standard_normal(halves.n).astype(real) for _ in range(2))

    def work(stages, part, rows):
        engine, poisson, t = stages.engine, stages.poisson, tessellate(stages, part)
        with engine.workspace.frame():
            matrix = poisson.assemble(t.starts, t.neighbors, t.face_measures, part.points, part=part)
            phi, rhs = (engine.upload(values[rows[: t.n]]) for values in (start, source))
            given = {"tolerance": tolerance, "preconditioner": preconditioner, "from_zero": from_zero}
            if gathered and part.peers:
                levels, peers = poisson.set_up_multigrid(matrix).sizes, engine.peers
                before, sums = peers.exchanges, peers.reductions
            solution = poisson.solve(matrix, rhs, phi, **given)
            assert solution.converged
            if gathered and part.peers:
                most = 5 + 2 * (len(levels) - 1) if levels else 2
                assert peers.exchanges - before <= most * (solution.iterations + 1)
                assert peers.reductions - sums <= 2 * solution.iterations + 10
                cycles = poisson.set_up_multigrid(matrix)
                kept = [level.aggregates for level in cycles._levels]
                cycles.update_finest(*matrix.rows, replace(part.ghosts))
                assert all(level.aggregates is not old for level, old in zip(cycles._levels, kept, strict=True))
            return phi.get(), solution.iterations

    (whole, count), two = halves.run(work)
    found = halves.joined([phi for phi, _ in two])
    assert np.abs(found - whole).max() < 1e3 * tolerance * np.abs(whole).max()
    assert abs(found.mean()) < 1e3 * np.finfo(real).eps * np.abs(whole).max()
    assert two[0][1] == two[1][1] <= 1.2 * count + 3


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_a_projected_step_in_two_halves(ctx, dim, real):
    """Weighted Lloyd and descent of shapes, projected: the displacement is that of the whole up to the tolerance."""
    halves, rng = Halves(ctx, dim, real), np.random.default_rng(60106)
    h = (halves.box.measure / halves.n) ** (1 / dim) * (1 + 0.3 * rng.random(halves.n))
    h, quality, labels = (h / 2).astype(real), rng.uniform(0.5, 1, halves.n).astype(real), halves.labels

    def work(stages, part, rows):
        engine, t, own = stages.engine, tessellate(stages, part, whole=True), rows[: part.n_own]
        ways, moves = engine.empty((t.n, dim)), engine.empty((t.n, dim))
        with engine.workspace.frame():
            sizes, shapes = engine.upload(h[own]), engine.upload(quality[own])
            w = stages.density.lloyd_weights(t, sizes, ways)
            if dim == 2:
                stages.quality_descent.descend(t, sizes, shapes, ways)
            elif t.vertices:
                stages.surface_descent.descend(t, sizes, shapes, ways)
            sums = stages.density.sum_log_ratio(w)
            outcome = stages.volume_projection.project(
                t,
                Targets(sizes, w.gradient, w.log_ratio, shapes, sums),
                ways,
                moves,
                Penalty(0.2, 0.3, 0.4),
                Limits(1e-8 if real == np.float64 else 1e-5, 400),
                labels=engine.upload(labels[own], np.int32),
                fixed=halves.n // 5,
            )
            assert outcome.converged
            return ways.get(), moves.get(), outcome.iterations

    one, two = halves.run(work)
    assert abs(two[0][2] - one[2]) <= 2
    assert two[0][2] == two[1][2]
    limits = (1e3 * np.finfo(real).eps, 1e-4)  # derivatives are in single precision
    for name, limit, expected, *found in zip(("ways", "moves"), limits, one, *two, strict=False):
        assert np.abs(halves.joined(found) - expected).max() < limit * np.abs(expected).max(), name


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_refinement_of_two_halves(ctx, dim, real):
    """Each edge between the halves gets one new generator, from the cell of the lower label."""
    halves = Halves(ctx, dim, real)
    h = (halves.box.measure / halves.n) ** (1 / dim) / 2

    def work(stages, part, rows):
        t, own = tessellate(stages, part), rows[: part.n_own]
        labels = stages.engine.upload(halves.labels[own], np.int32)
        with stages.engine.workspace.frame():
            finer = stages.refinement.refine(halves.box, t, stages.engine.zeros(t.n).fill(h), labels, fixed=30)
        return finer.get()[t.n :]

    one, two = halves.run(work)
    both = np.concatenate(two)
    assert len(both) == len(one) > 2 * halves.n
    gaps, _ = scipy.spatial.KDTree(both).query(one)
    assert gaps.max() < 1e3 * np.finfo(real).eps


@pytest.mark.sparse(4)
@pytest.mark.parametrize("missing", [7.0, -9.0])
@pytest.mark.parametrize("climb", [True, False])
@pytest.mark.parametrize("real", REALS)
def test_insertion_and_deletion_in_two_halves(ctx, dim, real, climb, missing):
    """The same sites are chosen, next to the common boundary, too, and labels are unique."""
    halves, rng = Halves(ctx, dim, real), np.random.default_rng(60107)
    values = {name: rng.normal(0, 0.3, halves.n) for name in ("h", "length", "ratio")}
    values["h"] = 0.05 * np.exp(values["h"])
    values["length"] = np.minimum(values["h"], 0.05)

    def work(stages, part, rows):
        engine, t, own = stages.engine, tessellate(stages, part), rows[: part.n_own]
        zeros = np.zeros(t.n)
        given = halves.places[own], halves.labels[own], np.zeros((t.n, dim)), zeros, zeros
        types = None, np.int32, None, np.uint64, None
        with engine.workspace.frame():
            present = Present(halves.box, t, Generators(*map(engine.upload, given, types)), 2 * halves.n, fixed=40)
            sizes = CellSizes(*(engine.upload(v[own]) for v in values.values()))
            change = Change(missing, nuclei=5, climb=climb and dim == 2)
            return stages.insertion_deletion.insert_delete(present, sizes, change)

    one, two = halves.run(work)
    assert one.inserted + one.deleted >= 4
    assert {(found.inserted, found.deleted) for found in two} == {(one.inserted, one.deleted)}
    labels = np.concatenate([found.generators.labels.get() for found in two])
    assert len(np.unique(labels)) == len(labels) == halves.n + one.inserted - one.deleted
    places = np.concatenate([found.generators.points.get() for found in two])
    expected, names = one.generators.points.get(), one.generators.labels.get()
    old = labels < 2 * halves.n
    order, other = np.argsort(labels[old]), np.argsort(names[names < 2 * halves.n])
    assert np.array_equal(labels[old][order], names[names < 2 * halves.n][other])
    noise = 1e3 * np.finfo(real).eps
    assert np.abs(places[old][order] - expected[names < 2 * halves.n][other]).max() < noise
    born, wanted = places[~old], expected[names >= 2 * halves.n]
    assert all(np.abs(born - x).max(axis=1).min() < noise for x in wanted)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS[::-1])
def test_a_periodic_box_that_is_not_folded(ctx, dim, real):
    """Images are ghosts of a part in a larger box without periods; stages read values of neighbors."""
    box = Box((0,) * dim, (1,) * dim, periodic=True)
    stages = Stages(patch.make_engine(ctx, real, dim, box=box))
    n, engine, rng = N[dim], stages.engine, np.random.default_rng(60104)
    x, h = engine.upload(box.place(rng.random((n, dim)), real)), engine.upload(0.02 + 0.03 * rng.random(n))
    t = Tessellator(stages, box).tessellate(x, n)
    part = t.folded.part
    engine.queue.finish()  # the other engine has a queue of its own
    unfolded = Stages(patch.make_engine(ctx, real, dim))
    alone = Tessellator(unfolded, Box((0,) * dim, (1,) * dim)).tessellate_part(replace(part, halo_args=()))
    with engine.workspace.frame(), unfolded.engine.workspace.frame():
        ours, theirs = unfolded.density.lloyd_weights(alone, h), stages.density.lloyd_weights(t, h)
        noise = 1e4 * np.finfo(real).eps
        for name in ("gradient", "lloyd", "weight"):
            one, other = getattr(ours, name).get(), getattr(theirs, name).get()
            assert np.abs(one - other).max() < noise * np.abs(other).max(), name
        if t.vertices:
            quality, ways = engine.upload(rng.uniform(0.5, 1, n)), []
            for made, own in ((alone, unfolded), (t, stages)):
                ways.append(own.engine.zeros((n, dim)))
                own.surface_descent.descend(made, h, quality, ways[-1], bad_cell_weight=5.0, rate=0.05)
            one, other = (way.get() for way in ways)
            assert np.abs(one - other).max() < noise * np.abs(other).max() < 1
        quality, ratio, move = rng.uniform(0.5, 1, n), rng.normal(0, 0.3, n), 0.01 * rng.normal(size=(n, dim))
        gradient, labels, corrections = rng.normal(size=(n, dim)), rng.permutation(n), []
        for made, own in ((alone, unfolded), (t, stages)):
            *given, moves = map(own.engine.upload, (h.get(), gradient, ratio, quality, move))
            corrections.append(own.engine.empty((n, dim)))
            outcome = own.volume_projection.project(
                made,
                Targets(*given),
                moves,
                corrections[-1],
                Penalty(0.2, 0.3, 0.4),
                Limits(1e-10 if real == np.float64 else 1e-5, 400),
                labels=own.engine.upload(labels, np.int32),
                fixed=n // 5,
            )
            assert outcome.converged
        one, other = (correction.get() for correction in corrections)
        assert np.abs(one - other).max() < 1e-4 * np.abs(other).max(), "derivatives are in single precision"


def test_balls_and_boxes_of_two_parts(monkeypatch):
    """Pairs are all that are near each other, and bounds hold for the others; few distances are computed."""
    rng, found, gaps = np.random.default_rng(5109), [], part_steps.gaps
    monkeypatch.setattr(part_steps, "gaps", lambda *boxes: found.append(gaps(*boxes)) or found[-1])
    x = (np.indices((200, 200)).reshape(2, -1).T + rng.random((40_000, 2))) / 200
    halves, radii = (x[x.sum(axis=1) < 1], x[x.sum(axis=1) >= 1]), rng.uniform(0.01, 0.02, len(x))
    balls, others = (BallGroups(half, radii[: len(half)], Chunks(half, 1e-4)) for half in halves)
    facing = balls.facing(others.facts)
    assert sum(map(np.size, found)) < len(balls.boxes) * len(others.boxes) / 3
    corners, groups = np.tile(halves[0], 2), balls.chunks.groups
    ways = gaps(corners[facing.balls, None], others.boxes)
    paired = np.zeros(ways.shape, bool)
    paired[facing.places, facing.others] = True
    assert np.array_equal(ways[paired], facing.ways[np.lexsort((facing.others, facing.places))])
    limits = np.maximum.outer(balls.largest[groups[facing.balls]], others.largest)
    assert np.array_equal(paired, ways <= NEAR * limits)
    assert (facing.apart <= ways.min(axis=1, where=~paired, initial=np.inf)).all()
    alone = np.setdiff1d(np.arange(len(balls.boxes)), groups[facing.balls])
    assert (facing.away[alone] <= gaps(balls.boxes[alone, None], others.boxes).min(axis=1)).all()
    assert (facing.away[alone] > NEAR * np.maximum(balls.largest[alone], others.largest.max()) / 2).all()
    near = np.flatnonzero((ways <= 1.25 * radii[facing.balls, None]).any(axis=1))
    assert np.array_equal(np.sort(balls.meeting(facing)), np.sort(facing.balls[near]))


@pytest.mark.parametrize("dim", [2, 3])
def test_blocks_of_short_and_long_keys(dim):
    """Short keys are the first bits of long ones, and give the same blocks, unless most are in one place."""
    x = np.random.default_rng(5110).random((20_000, dim))
    corners, bits = (np.zeros(dim), np.ones(dim)), 16 // dim
    for points, enough in ((x, True), (x**12, False)):
        keys = decomposition.hilbert_keys(points, *corners), decomposition.coarse_keys(points.T, *corners)
        assert np.array_equal(keys[0] >> np.uint64(dim * (decomposition.BITS - bits)), keys[1])
        (_, long, _), (_, short, reached) = (
            decomposition.divide(keys[k], dim, ALONE, b) for k, b in ((0, 20), (1, bits))
        )
        assert reached == enough == np.array_equal(long, short)


@pytest.mark.parametrize("power", [1, 12])
def test_generators_are_distributed(ctx, power):
    """Each part gets a share, with its labels; also where nearly all are in one place."""
    x = np.random.default_rng(5111).random((3000, 2)) ** power
    box = Box((0, 0), (1, 1))

    def work(peers):
        engine = patch.make_engine(ctx, np.dtype(float), 2, box=box)
        engine.peers, own = peers, slice(0, len(x) * (peers.number == 0))
        rows = {"points": engine.upload(x[own]), "labels": engine.upload(np.arange(len(x))[own], np.int32)}
        found = decomposition.distribute(engine, box, rows)
        return found["points"].get(), found["labels"].get()

    parts = Team(3).run(work)
    labels = np.concatenate([found for _, found in parts])
    assert np.array_equal(np.sort(labels), np.arange(len(x)))
    assert np.array_equal(np.concatenate([points for points, _ in parts]), x[labels])
    assert max(len(points) for points, _ in parts) < decomposition.UNBALANCED * len(x) / 3
