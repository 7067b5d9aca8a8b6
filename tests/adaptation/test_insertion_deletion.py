"""Insertion and deletion on small lattices: choice of sites, changes, and conservation of the generators."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from clvoro.adaptation.insertion_deletion import CellSizes, Change, Generators, InsertionDeletion, Present
from clvoro.adaptation.tuning import (
    CLIMB_STRAIN,
    LOG_RATIO_RINGS,
    MAX_CHANGE,
    NUCLEUS_RINGS,
    PAIR_RINGS,
    REPAIRED_SHARE,
    SPLIT_DISTANCE,
)
from clvoro.geometry.box import Box
from tests.reference import patch

QUIET = CLIMB_STRAIN + 0.001  # above CLIMB_STRAIN pairs at walls are left alone


BOX_OF = {2: patch.BOX, 3: patch.BOXES["space"]}
ANY = {"plane": (2, "float64"), "space": (3, "float64"), "space, float32": (3, "float32")}


@pytest.fixture(scope="module")
def engine(ctx):
    return patch.make_engine(ctx)


@pytest.fixture(scope="module", params=ANY)
def any_engine(ctx, request):
    dim, real = ANY[request.param]
    return patch.make_engine(ctx, real, dim)


def random_points(n, seed, engine):
    return patch.random_points(n, seed, BOX_OF[engine.dim]).astype(engine.real).astype(float)


class Sweep:
    """One call of `insert_delete`, or of `repair_cells` if the quality is given, and its changes by labels."""

    def __init__(self, engine, points, h, total, control=None, **options):
        (n, dim), rng = points.shape, np.random.default_rng(808)
        self.box = BOX_OF[dim]
        self.n, self.points, self.h = n, points, np.broadcast_to(h, n)
        self.labels = rng.permutation(3 * n)[:n].astype(np.int32)
        self.velocity = rng.normal(size=(n, dim)).astype(engine.real)
        self.ever_changed = (rng.random(n) < 0.5).astype(engine.real)
        self.signatures = rng.integers(1, 2**63, n).astype(np.uint64)
        self.t = patch.tessellate(engine, points, self.box)
        self.host = patch.fetch(self.t)
        local_length = np.minimum(self.h, self.host.volumes ** (1 / dim))
        self.log_ratio = np.log(self.host.volumes / self.h**dim)
        rows = Generators(
            self.t.points,
            engine.upload(self.labels, np.int32),
            engine.upload(self.velocity),
            engine.upload(self.signatures, np.uint64),
            engine.upload(self.ever_changed),
        )
        self.first_new = 5 * n
        control, fixed = control or InsertionDeletion(engine), options.pop("fixed", 0)
        present = Present(self.box, self.t, rows, self.first_new, fixed)
        if "quality" in options:
            quality = engine.upload(options.pop("quality"))
            self.new = control.repair_cells(present, quality, **options)
        else:
            sizes = CellSizes(*map(engine.upload, (self.h, local_length, self.log_ratio)))
            self.new = control.insert_delete(present, sizes, Change(total, **options))
        if self.new is not None:
            self.account()

    def account(self):
        """Check by labels that as many generators are new, and as many are gone, as are counted."""
        new = self.new.generators
        self.new_points, labels = new.points.get(), new.labels.get()
        assert len(labels) == self.n + self.new.inserted - self.new.deleted
        assert len(np.unique(labels)) == len(labels), "a label is given twice"
        old = np.isin(labels, self.labels)
        assert (~old).sum() == self.new.inserted
        born = np.sort(labels[~old])
        assert np.array_equal(born, self.first_new + np.arange(self.new.inserted))
        assert self.box.contains(self.new_points).all()
        row = {label: i for i, label in enumerate(self.labels)}
        self.rows = np.array([row[label] for label in labels[old]], int)  # the row of each old generator before
        self.deleted = np.setdiff1d(np.arange(self.n), self.rows)
        assert len(self.deleted) == self.new.deleted
        moved = (self.new_points[old] != self.points.astype(self.new_points.dtype)[self.rows]).any(axis=1)
        self.moved, self.moved_to = self.rows[moved], self.new_points[old][moved]
        assert np.array_equal(new.velocity.get()[old][~moved], self.velocity[self.rows[~moved]])
        assert not new.velocity.get()[old][moved].any()
        assert np.array_equal(new.signatures.get()[old], self.signatures[self.rows])
        assert np.array_equal(new.ever_changed.get()[old], self.ever_changed[self.rows])
        assert not new.velocity.get()[~old].any()
        assert (new.ever_changed.get()[~old] == 1).all()
        self.born = self.new_points[~old]

    def neighbors(self, i):
        return self.host.neighbors[self.host.starts[i] : self.host.starts[i + 1]]

    def rings_between(self, sites):
        """Least number of rings from one of `sites` to the next."""
        least = self.n
        for site in sites:
            ring, seen, distance = {site}, {site}, 0
            while ring and not (distance and ring & set(sites)):
                ring = {j for i in ring for j in self.neighbors(i) if j >= 0} - seen
                seen |= ring
                distance += 1
            if ring:
                least = min(least, distance)
        return least


def dislocated(a, stretch):
    """A hexagonal lattice, one dislocation (a 7-sided cell under a 5-sided) in it, stretched along x."""
    points = patch.hexagons(a, Box((0, 0), (1.4, 1.15))) - 0.2
    center = np.array([0.5, 0.375]) + a * np.array([0.25, 0.2])
    d = points - center
    angle = np.arctan2(d[:, 1], d[:, 0])
    # The displacement around an edge dislocation in an isotropic plate, Poisson's ratio 1/3.
    u = a / (2 * np.pi) * (angle + np.sin(2 * angle) * 3 / 8)
    v = -a / (2 * np.pi) * (np.log((d**2).sum(axis=1) / a**2) / 8 + np.cos(2 * angle) * 3 / 8)
    points = center + (d + np.stack([u, v], axis=1)) * [1 + stretch, 1 - stretch]
    return points[patch.BOX.contains(points)]


def the_pair(sweep):
    """Return the 5-sided and the 7-sided cell in the middle."""
    sides = np.diff(sweep.host.starts)
    middle = (np.abs(sweep.points - [0.5, 0.375]) < 0.2).all(axis=1)
    (five,), (seven,) = (np.flatnonzero(middle & (sides == n)) for n in (5, 7))
    assert seven in sweep.neighbors(five)
    return five, seven


def test_kinds_and_strain(engine):
    """Charges, walls, and strain over one and two rings are sums over neighbors, for cells of all kinds."""
    n = 80
    points, h = patch.random_points(n, 41), np.random.default_rng(42).uniform(0.05, 0.2, n)
    t = patch.tessellate(engine, points)
    host, control = patch.fetch(t), InsertionDeletion(engine)
    found = [array.get().reshape(n, -1) for array in control._measure(t, engine.upload(h))]
    rows = [host.neighbors[a:b] for a, b in itertools.pairwise(host.starts)]
    walls = np.array([(row < 0).sum() for row in rows])
    sides = np.array([len(row) for row in rows])
    assert np.array_equal(found[0], np.stack([sides - 6 + np.minimum(walls, 2), walls], axis=1))
    strain = np.zeros((n, 4))
    for i, row in enumerate(rows):
        j = row[row >= 0]
        d = points[j] - points[i]
        # 1 in a hexagonal lattice: neighbors are at sqrt(2 / sqrt 3) h.
        terms = 2 * np.array([d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2]) / (h[i] * h[j])
        strain[i, :3] = terms.mean(axis=1) / (2 / np.sqrt(3))
        strain[i, 3] = walls[i] == 0 and sides[i] == 6
    assert 3 < strain[:, 3].sum() < n / 2
    for expected in found[1:]:
        mean = np.zeros((n, 4))
        for i, row in enumerate(rows):
            own = strain[[i, *row[row >= 0]]]
            weight = own[:, 3].sum()
            mean[i, :3] = own[:, :3].T @ own[:, 3] / weight if weight > 0 else [1, 0, 1]
            mean[i, 3] = weight
        strain = mean
        # In single precision, sums of a few terms.
        assert expected == pytest.approx(strain, rel=1e-5, abs=1e-5)


A = 0.05
H = A * np.sqrt(np.sqrt(3) / 2)


def test_seven_sided_cell_is_split_under_tension(engine):
    """Into two across the pair: the extra half row grows."""
    sweep = Sweep(engine, dislocated(A, 0.06), H, 1.0, climb_strain=QUIET)
    five, seven = the_pair(sweep)
    assert (sweep.new.inserted, sweep.new.deleted) == (1, 0)
    assert sweep.moved.tolist() == [seven]
    across = sweep.born[0] - sweep.moved_to[0]
    d = sweep.points[seven] - sweep.points[five]
    assert abs(across @ d) < 1e-9 * A**2
    reach = min(H, np.sqrt(sweep.host.volumes[seven]))
    assert np.linalg.norm(across) == pytest.approx(2 * SPLIT_DISTANCE * reach)
    assert (sweep.born[0] + sweep.moved_to[0]) / 2 == pytest.approx(sweep.points[seven])


def test_five_sided_cell_is_deleted_under_compression(engine):
    sweep = Sweep(engine, dislocated(A, -0.06), H, -1.0, climb_strain=QUIET)
    five, _ = the_pair(sweep)
    assert (sweep.new.inserted, sweep.new.deleted) == (0, 1)
    assert sweep.deleted.tolist() == [five]
    assert len(sweep.moved) == 0


def test_unstrained_pair_stays(engine):
    """Without strain and with the correct count nothing is done."""
    assert Sweep(engine, dislocated(A, 0.0), H, 0.0, climb_strain=QUIET).new is None


def test_count_overrules_strain(engine):
    """A single pair cannot climb if the count is correct. If it is not, the pair is used first."""
    assert Sweep(engine, dislocated(A, 0.06), H, 0.0, climb_strain=QUIET).new is None
    against = Sweep(engine, dislocated(A, 0.0), H, 1.0, climb_strain=QUIET)
    assert against.moved.tolist() == [the_pair(against)[1]]


def test_two_pairs_of_opposite_strain_both_climb(engine):
    """The left half is stretched along x, the right half compressed; the number of generators does not change."""
    a = 0.03
    points = patch.hexagons(a, Box((0, 0), (1.6, 1.35))) - 0.3
    shift = np.zeros_like(points)
    for x, sign in ((0.25, 1), (0.75, -1)):
        d = points - [x + 0.25 * a, 0.375 + 0.2 * a]
        angle = np.arctan2(d[:, 1], d[:, 0])
        shift[:, 0] += sign * a / (2 * np.pi) * (angle + np.sin(2 * angle) * 3 / 8)
        shift[:, 1] -= sign * a / (2 * np.pi) * (np.log((d**2).sum(axis=1) / a**2) / 8 + np.cos(2 * angle) * 3 / 8)
    points = points + shift
    wide = 1 + 0.06 * np.sin(2 * np.pi * points[:, 0])
    points[:, 0] -= 0.06 / (2 * np.pi) * np.cos(2 * np.pi * points[:, 0])
    points[:, 1] = 0.375 + (points[:, 1] - 0.375) / wide
    points = points[patch.BOX.contains(points)]
    sweep = Sweep(engine, points, a * H / A, 0.0, climb_strain=QUIET)
    assert (sweep.new.inserted, sweep.new.deleted) == (1, 1)
    sides = np.diff(sweep.host.starts)
    assert sides[sweep.moved].tolist() == [7]
    assert sides[sweep.deleted].tolist() == [5]
    assert sweep.points[sweep.moved[0], 0] < 0.5 < sweep.points[sweep.deleted[0], 0]


@pytest.mark.sparse(3)
@pytest.mark.parametrize("total", [-30.0, -9.4, -1.0, 1.0, 6.0, 30.0])
def test_number_is_corrected_exactly(engine, total):
    """Without climbing: the exact number, the strongest first, with a least distance, at most a share in one call."""
    n = 500
    points = patch.relaxed_points(n, 61, steps=2)
    sweep = Sweep(engine, points, np.sqrt(0.75 / n), total, climb=False)
    expected = int(np.trunc(total + np.copysign(0.3, total)))
    expected = int(np.clip(expected, -MAX_CHANGE * n, MAX_CHANGE * n))
    change = sweep.new.inserted - sweep.new.deleted
    # Sites three rings apart take up to 37 cells each: some of 500 may find no place.
    assert change == expected if abs(expected) < 10 else 10 <= abs(change) <= abs(expected)
    assert change * expected > 0
    assert min(sweep.new.inserted, sweep.new.deleted) == 0
    sites = (sweep.moved if total > 0 else sweep.deleted).tolist()
    assert len(sites) == abs(change)
    assert len(sites) == 1 or sweep.rings_between(sites) > LOG_RATIO_RINGS
    score = np.sign(total) * (sweep.log_ratio + 0.2 * (np.diff(sweep.host.starts) - 6))
    assert score.argmax() in sites


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("total", [-7.0, -1.0, 1.0, 7.0, 500.0, -500.0])
def test_number_is_corrected_in_space(ctx, real, total):
    n, engine = 600, patch.make_engine(ctx, real, 3)
    sweep = Sweep(engine, random_points(n, 61, engine), np.cbrt(0.675 / n), total, climb=False)
    change = sweep.new.inserted - sweep.new.deleted
    assert min(sweep.new.inserted, sweep.new.deleted) == 0
    assert change * total > 0
    assert change == total if abs(total) < 3 else abs(change) <= min(abs(total), int(MAX_CHANGE * n))
    sites = sweep.moved if total > 0 else sweep.deleted
    assert len(sites) == abs(change)
    # Among the largest, or smallest, over h; a cell near a more extreme one is left for later.
    rank = np.argsort(np.argsort(-np.sign(total) * sweep.log_ratio))
    assert np.median(rank[sites]) < n / 10


@pytest.mark.parametrize(("dim", "h", "steps"), [(2, 0.04, 1), (3, 0.13, 0)])
def test_cells_are_split_along_their_longest_axis(ctx, dim, h, steps):
    points = patch.relaxed_points(300, 67, steps, BOX_OF[dim])
    sweep = Sweep(patch.make_engine(ctx, dim=dim), points, h, 5.0, climb=False)
    assert len(sweep.moved) == sweep.new.inserted >= 2
    for i, there in zip(sweep.moved, sweep.moved_to, strict=True):
        moments = np.zeros((dim, dim))
        moments[np.triu_indices(dim)] = sweep.host.covariances[i]
        values, axes = np.linalg.eigh(moments, "U")
        centroid = points[i] + sweep.host.offsets[i]
        way, part = there - centroid, sweep.host.volumes[i] ** (1 / dim) / 4
        assert np.linalg.norm(way) == pytest.approx(part, rel=1e-6)
        # In space twelve powers of the moments: the rest of the others has shrunk by their ratio each time.
        left = 1e-6 if dim == 2 else 4 * (values[1] / values[2]) ** 12
        assert abs(way @ axes[:, -1]) / part > 1 - left
        assert np.abs(sweep.born - (2 * centroid - there)).max(axis=1).min() < 1e-12


@pytest.mark.sparse(6)
@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("total", [-50.0, 50.0])
@pytest.mark.parametrize("climb", [True, False])
def test_few_cells(any_engine, n, total, climb):
    """The last generator stays."""
    climb &= any_engine.dim == 2
    sweep = Sweep(any_engine, random_points(n, n, any_engine), 0.3, total, climb=climb)
    if n == 1 and total < 0:
        assert sweep.new is None
    else:
        assert (sweep.new.inserted - sweep.new.deleted) * total > 0
        assert len(sweep.new_points) >= 1


def test_alike_cells_are_told_apart(engine):
    """All cells of a lattice have the same large log ratio: the required number is still split."""
    xy = np.stack(np.meshgrid(np.arange(16), np.arange(12), indexing="ij"), -1).reshape(-1, 2)
    sweep = Sweep(engine, (xy + 0.5) / 16, 1e-3, 3.0, climb=False)
    assert sweep.new.inserted == 3


def test_limit_keeps_the_strongest(engine):
    """Keys that are far apart, an ulp apart, and equal except for the index."""
    control, rng = InsertionDeletion(engine), np.random.default_rng(3)
    spans = [10**6, 300, 40, 1]
    for trial in range(24):
        n = int(rng.integers(1, 400))
        bits = np.float32(rng.uniform(0.1, 4)).view(np.uint32) + rng.integers(0, spans[trial % 4], n)
        keys = (bits.astype(np.uint64) << np.uint64(32)) | (0x7FFFFFFF - np.arange(n)).astype(np.uint64)
        keys[rng.random(n) < 0.3] = 0
        most = int(rng.integers(0, n + 3))
        chosen = engine.upload(keys, np.uint64)
        control._limit(SimpleNamespace(n=n, total=np.asarray), chosen, most)
        kept = np.sort(chosen.get())[::-1]
        kept = kept[kept > 0]
        expected = np.sort(keys[keys > 0])[::-1][:most]
        assert np.array_equal(kept, expected)


def strained(a=0.04, stretch=0.15):
    points = patch.hexagons(a, Box((-1, -1), (2, 2))) + 0.1
    points = points * [1 + stretch, 1 / (1 + stretch)]
    return points[patch.BOX.contains(points)]


def test_dislocations_nucleate_under_strain(engine):
    """In turn: a generator in the longest edge, and two merged in their middle."""
    h = 0.04 * H / A
    sweep = Sweep(engine, strained(), h, 0.0, nuclei=2, climb_strain=QUIET)
    assert 2 <= sweep.new.inserted + sweep.new.deleted <= 4
    assert abs(sweep.new.inserted - sweep.new.deleted) <= 1
    edges = [(sweep.points[i], sweep.points[j]) for i in range(sweep.n) for j in sweep.neighbors(i) if j > i]
    middles = np.array([(p + q) / 2 for p, q in edges])
    lengths = np.array([np.linalg.norm(p - q) for p, q in edges])
    sites = []
    for place, longest in [*((p, True) for p in sweep.born), *((p, False) for p in sweep.moved_to)]:
        k = np.linalg.norm(middles - place, axis=1).argmin()
        assert middles[k] == pytest.approx(place, abs=1e-12)
        # Its site is one of its ends, all of whose edges are shorter (longer).
        ends = [np.flatnonzero((sweep.points == p).all(axis=1))[0] for p in edges[k]]
        around = [
            lengths[[np.array_equal(p, sweep.points[e]) or np.array_equal(q, sweep.points[e]) for p, q in edges]]
            for e in ends
        ]
        best = [(own.max() if longest else own.min()) for own in around]
        assert any(lengths[k] == pytest.approx(b) for b in best)
        sites.append(ends[0])
    assert all((np.diff(sweep.host.starts)[s] == 6) for s in sites)
    # The ends found here may be one ring off the sites.
    assert sweep.rings_between(sites) > NUCLEUS_RINGS - 2
    for i in sweep.deleted:
        assert np.linalg.norm(sweep.moved_to - sweep.points[i], axis=1).min() < 0.04


def test_no_nucleation_without_strain(engine):
    assert Sweep(engine, strained(stretch=0.0), 0.04 * H / A, 0.0, nuclei=5, climb_strain=QUIET).new is None


SPOTS = {(0.2, 0.2): 0.9, (0.8, 0.2): 0.8, (0.2, 0.6): 0.93, (0.8, 0.6): 0.95}


class TestMend:
    """Cells of poor quality are deleted or split, the worst first."""

    def lattice(self, spots):
        """A lattice with a dislocation, of quality 1 but at the inner cells nearest to `spots` {place: quality}."""
        points = dislocated(0.025, 0.0)
        quality, sites = np.ones(len(points)), []
        for place, q in spots.items():
            i = np.linalg.norm(points - place, axis=1).argmin()
            quality[i] = q
            sites.append(i)
        return points, quality, sites

    @pytest.mark.parametrize("split", [False, True])
    def test_bad_cells_are_repaired(self, engine, split):
        points, quality, sites = self.lattice(SPOTS)
        sweep = Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.06, split=split, share=0.1)
        changed, others = (sweep.moved, sweep.deleted) if split else (sweep.deleted, sweep.moved)
        assert sorted(changed) == sorted(sites[:3])
        assert len(others) == 0
        for i, there in zip(sweep.moved, sweep.moved_to, strict=True):
            part = np.sqrt(sweep.host.volumes[i]) / 4
            centroid = points[i] + sweep.host.offsets[i]
            assert np.linalg.norm(there - centroid) == pytest.approx(part, rel=1e-6)

    @pytest.mark.parametrize("split", [False, True])
    def test_repair_depends_on_the_number_of_sides(self, engine, split):
        points, quality, _ = self.lattice({})
        five, seven = the_pair(Sweep(engine, points, 0.02, 0.0, climb_strain=QUIET))
        for i in (five, seven):
            poor = quality.copy()
            poor[i] = 0.9
            sweep = Sweep(engine, points, 0.02, 0.0, quality=poor, deficit=0.06, split=split, share=0.1)
            assert (sweep.deleted.tolist(), sweep.moved.tolist()) == (([five], []) if i == five else ([], [seven]))

    def test_repair_takes_a_share_of_the_worst_cells(self, engine):
        points, quality, sites = self.lattice(SPOTS)
        n = len(points)
        for most in (1, 2):
            sweep = Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.01, share=(most + 0.5) / n)
            assert sorted(sweep.deleted) == sorted([sites[1], sites[0]][:most])
        assert n * REPAIRED_SHARE > 1
        assert Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.01, share=0.9 / n).new is None

    def test_good_cells_and_cells_at_walls_are_not_repaired(self, engine):
        points, quality, _ = self.lattice({})
        assert Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.06, share=1.0).new is None
        host = patch.fetch(patch.tessellate(engine, points))
        quality[host.owners[host.neighbors < 0]] = 0.5
        assert Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.06, share=1.0).new is None

    def test_four_and_eight_sided_cells_are_always_repaired(self, engine):
        """Chosen sites are far from each other. All others have a chosen one within a few rings."""
        points = patch.relaxed_points(600, 71, steps=1)
        sweep = Sweep(engine, points, 0.04, 0.0, quality=np.ones(600), deficit=0.5, share=1.0)
        sides = np.diff(sweep.host.starts)
        inner = np.ones(600, bool)
        inner[sweep.host.owners[sweep.host.neighbors < 0]] = False
        few, many = (set(np.flatnonzero(inner & odd)) for odd in (sides < 5, sides > 7))
        assert set(sweep.deleted) <= few
        assert set(sweep.moved) <= many
        assert len(sweep.deleted) > 2 < len(sweep.moved)
        sites = {*sweep.deleted, *sweep.moved}
        assert {4, 8} <= set(sides[list(sites)].tolist())
        assert sweep.rings_between(list(sites)) > PAIR_RINGS

    def test_generators_that_stay(self, engine):
        """Neither they nor their neighbors are touched."""
        points, quality, sites = self.lattice(SPOTS)
        sweep = Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.06, share=1.0)
        beside = min(j for j in sweep.neighbors(sites[1]) if j >= 0)
        for held in (sites[1], beside):
            fixed = int(sweep.labels[held]) + 1
            again = Sweep(engine, points, 0.02, 0.0, quality=quality, deficit=0.06, share=1.0, fixed=fixed)
            still = again.labels < fixed
            free = [i for i in sites[:3] if not still[[i, *(j for j in again.neighbors(i) if j >= 0)]].any()]
            assert sites[1] not in free
            assert sorted([] if again.new is None else again.deleted) == sorted(free)
