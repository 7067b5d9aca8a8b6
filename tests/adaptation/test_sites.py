"""Sites of insertion and deletion, and the marks there: each kernel against NumPy."""

import numpy as np
import pytest

from clvoro.adaptation.insertion_deletion import InsertionDeletion, _Marks
from clvoro.adaptation.tuning import CLIMB_STRAIN, SHIFT_STEP, SHIFTS, SPLIT_DISTANCE, WALL_STRAIN
from tests.reference import patch

N = 400


def keys_of(magnitudes, indices):
    """Return the words that order sites; see adaptation/site_selection.h."""
    bits = np.asarray(magnitudes, np.float32).view(np.uint32).astype(np.uint64)
    return (bits << np.uint64(32)) | (0x7FFFFFFF - np.asarray(indices)).astype(np.uint64)


def assert_keys(keys, magnitudes, names):
    """Magnitudes may differ by the round-off of their terms. They are rounded to single precision."""
    sites = np.flatnonzero(keys)
    assert np.array_equal(sites, np.flatnonzero(magnitudes))
    found = (keys[sites] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    assert found == pytest.approx(magnitudes[sites], rel=1e-6)
    assert np.array_equal(keys[sites] & np.uint64(0xFFFFFFFF), 0x7FFFFFFF - names[sites])


class Mesh:
    """Random cells with random charges, walls and strains, so that all combinations occur."""

    def __init__(self, engine):
        self.engine, rng = engine, np.random.default_rng(2401)
        self.t = patch.tessellate(engine, patch.random_points(N, 2402))
        self.host = host = patch.fetch(self.t)
        self.rows = np.split(host.neighbors, host.starts[1:-1])
        self.walled = np.array([(row < 0).any() for row in self.rows])
        self.kinds = np.stack(
            [rng.choice([-2, -1, 0, 1, 2], N, p=[0.1, 0.35, 0.1, 0.35, 0.1]), rng.choice([0, 0, 1, 2], N)], axis=1
        )
        self.strain = rng.normal(size=(N, 4)).astype(np.float32)
        self.rng, self.stage = rng, InsertionDeletion(engine)
        self.kernels = self.stage._kernels
        self.graph = self.t.starts, self.t.neighbors
        self.names = rng.permutation(3 * N)[:N]
        self.name_args = np.int32(1), engine.upload(self.names, np.int32)

    def run(self, name, *args):
        real = self.engine.real.type
        args = [real(a) if isinstance(a, float) else a for a in args]
        self.engine.run_each(getattr(self.kernels, name), N, *args)

    def upload(self, array, dtype):
        return self.engine.upload(array, dtype)

    def marks(self):
        return _Marks.clean(self.stage._room, self.t, 2)

    def way(self, i, j):
        return self.host.points[j] - self.host.points[i]


@pytest.fixture(scope="module")
def mesh(ctx):
    return Mesh(patch.make_engine(ctx))


def partner_of(mesh, i, at_walls):
    """Return the partner of cell i, the pull on the pair and its rank."""
    (charge, walls), best = mesh.kinds[i], (-1, 0.0, 0.0)
    if charge >= 0 or (walls > 0 and not at_walls):
        return best
    for j in mesh.rows[i]:
        if j < 0 or mesh.kinds[j, 0] < 1:
            continue
        ends = int(walls > 0) + int(mesh.kinds[j, 1] > 0)
        if ends == 2 or (ends == 1 and not at_walls):
            continue
        xx, xy, yy = ((mesh.strain[i] + mesh.strain[j]) / 2)[:3].astype(float)
        along = mesh.way(i, j) / np.linalg.norm(mesh.way(i, j))
        across = np.array([-along[1], along[0]])
        S = np.array([[xx, xy], [xy, yy]])
        pull = across @ S @ across - along @ S @ along
        first = ends == 1 or charge == -2 or mesh.kinds[j, 0] == 2
        rank = abs(pull) + WALL_STRAIN * first
        if rank > best[2]:
            best = j, pull, rank
    return best


def scored(mesh, at_walls):
    engine = mesh.engine
    partners, pull = engine.empty((N, 4), np.int32), engine.empty(N)
    keys = engine.empty(N, np.uint64)
    mesh.run(
        "score_pairs",
        *mesh.graph,
        mesh.t.points,
        mesh.upload(mesh.kinds, np.int32),
        mesh.upload(mesh.strain, np.float32),
        np.int32(at_walls),
        *mesh.name_args,
        partners,
        pull,
        keys,
    )
    return partners, pull, keys


@pytest.mark.parametrize("at_walls", [False, True])
def test_pairs_are_the_strongest_of_their_cells(mesh, at_walls):
    partners, pull, keys = scored(mesh, at_walls)
    expected = [partner_of(mesh, i, at_walls) for i in range(N)]
    chosen = np.array([j for j, _, _ in expected])
    assert np.array_equal(partners.get()[:, 0], np.where(chosen < 0, -1, mesh.names[chosen]))
    assert np.array_equal(partners.get()[chosen >= 0, 1:3], mesh.kinds[chosen[chosen >= 0]])
    assert pull.get() == pytest.approx(np.array([s for _, s, _ in expected]), rel=1e-6, abs=1e-6)
    assert_keys(keys.get(), np.array([rank for _, _, rank in expected]), mesh.names)
    assert (chosen >= 0).sum() > N / 8


def change_of(pull, minus, plus, shift):
    """What a pair does: 1 if it is split, -1 if it is deleted."""
    if minus[1] == 0 and minus[0] == -2:
        return -1
    if plus[1] == 0 and plus[0] == 2:
        return 1
    if minus[1] > 0:
        return -1 if pull < WALL_STRAIN else 0
    if plus[1] > 0:
        return 1 if pull > -WALL_STRAIN else 0
    if pull > CLIMB_STRAIN - shift:
        return 1
    return -1 if -pull > CLIMB_STRAIN + shift else 0


def test_pairs_are_split_or_deleted(mesh):
    """At every shift of the threshold, with pulls on either side of all bounds."""
    engine = mesh.engine
    found = scored(mesh, True)[0].get()
    rows = np.full(mesh.names.max() + 2, -1)
    rows[mesh.names] = np.arange(N)
    partners = rows[found[:, 0]]
    chosen, taken = np.zeros(N, bool), set()
    for i in np.flatnonzero(partners >= 0):
        if not {i, partners[i]} & taken:  # no two at one cell
            chosen[i] = True
            taken |= {i, partners[i]}
    pull = mesh.rng.uniform(-0.6, 0.6, N)
    shifts = (np.arange(SHIFTS) - SHIFTS // 2) * SHIFT_STEP
    pairs = [(i, partners[i]) for i in np.flatnonzero(chosen)]
    changes = np.array([[change_of(pull[i], mesh.kinds[i], mesh.kinds[j], s) for i, j in pairs] for s in shifts])
    given = (
        mesh.upload(chosen.astype(np.uint64) * 7, np.uint64),
        mesh.upload(pull, engine.real),
        mesh.upload(mesh.kinds, np.int32),
        mesh.upload(found, np.int32),
    )
    tally = engine.zeros(SHIFTS, np.int32)
    mesh.run("count_pair_changes", *given, CLIMB_STRAIN, tally)
    assert np.array_equal(tally.get(), changes.sum(axis=1))
    assert len(np.unique(tally.get())) > 10

    local_length = mesh.rng.uniform(0.01, 0.02, N)
    for m in (0, SHIFTS // 2, SHIFTS - 1):
        marks = mesh.marks()
        mesh.run(
            "mark_pairs",
            *mesh.graph,
            *given,
            CLIMB_STRAIN,
            float(shifts[m]),
            *mesh.name_args,
            mesh.t.points,
            mesh.upload(local_length, engine.real),
            *marks.arrays,
            marks.busy,
        )
        kept, born, busy = np.ones(N), np.zeros(N), np.zeros(N)
        moved = np.zeros((N, 2))
        for (i, j), change in zip(pairs, changes[m], strict=True):
            busy[i] = change != 0
            if change < 0:
                kept[i] = 0
            elif change > 0:
                d = mesh.way(i, j)
                born[j] = 1
                moved[j] = SPLIT_DISTANCE * local_length[j] * np.array([-d[1], d[0]]) / np.linalg.norm(d)
        assert np.array_equal(marks.kept.get()[:N], kept)
        assert np.array_equal(marks.born.get()[:N], born)
        assert np.array_equal(marks.busy.get() != 0, busy != 0)
        assert marks.shifts.get().reshape(N, 2) == pytest.approx(moved, abs=1e-15)
        assert np.array_equal(marks.births.get(), -marks.shifts.get())


def test_nuclei_are_sites_in_a_strained_lattice(mesh):
    """Sites are regular cells among regular cells, not at walls; edges are halved and cells merged in turn."""
    engine = mesh.engine
    kinds = np.where(mesh.rng.random((N, 2)) < 0.95, 0, mesh.rng.integers(-1, 3, (N, 2)))
    kinds[mesh.walled, 1] = 1
    keys = engine.empty(N, np.uint64)
    cells = mesh.upload(kinds, np.int32), mesh.upload(mesh.strain, np.float32)
    mesh.run("score_strain", *mesh.graph, *cells, 0.8, *mesh.name_args, keys)
    magnitudes = np.zeros(N)
    for i, row in enumerate(mesh.rows):
        if not kinds[i].any() and not kinds[row].any():
            xx, xy, yy = mesh.strain[i, :3].astype(float)
            spread = np.ptp(np.linalg.eigvalsh([[xx, xy], [xy, yy]]))
            magnitudes[i] = spread if spread > 0.8 else 0
    assert_keys(keys.get(), magnitudes, mesh.names)
    assert 10 < (magnitudes > 0).sum() < (~kinds.any(axis=1)).sum() / 2

    chosen = (~mesh.walled) & (mesh.rng.random(N) < 0.2)
    ranks = np.concatenate([[0], np.cumsum(chosen)])
    marks, merged = mesh.marks(), engine.empty(N, np.int32)
    mesh.run(
        "mark_nuclei",
        mesh.upload(chosen.astype(np.uint64), np.uint64),
        mesh.upload(ranks, np.int32),
        np.int32(6),
        *mesh.graph,
        mesh.t.points,
        *mesh.name_args,
        marks.shifts,
        marks.born,
        marks.births,
        marks.busy,
        merged,
    )
    mesh.run("delete_merged", *mesh.graph, merged, *mesh.name_args, marks.kept)
    kept, born, moved, births = np.ones(N), np.zeros(N), np.zeros((N, 2)), np.zeros((N, 2))
    for i in np.flatnonzero(chosen):
        ways = np.array([mesh.way(i, j) for j in mesh.rows[i]])
        lengths = np.linalg.norm(ways, axis=1)
        if ranks[i] % 2 == 0:
            born[i], births[i] = 1, ways[lengths.argmax()] / 2
        else:
            kept[mesh.rows[i][lengths.argmin()]] = 0
            moved[i] = ways[lengths.argmin()] / 2
    assert np.array_equal(marks.kept.get()[:N], kept)
    assert np.array_equal(marks.born.get()[:N], born)
    assert np.array_equal(marks.busy.get() != 0, chosen)
    assert np.array_equal(marks.shifts.get().reshape(N, 2), moved)
    assert np.array_equal(marks.births.get().reshape(N, 2), births)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_cells_too_large_or_too_small_are_sites(mesh, sign):
    """By log ratio and number of faces, with bounds. The only generator of a piece of the domain is not deleted."""
    engine = mesh.engine
    log_ratio, keys = mesh.rng.uniform(-5, 5, N), engine.empty(N, np.uint64)
    alone = mesh.rng.random(N) < 0.1
    neighbors = np.where(alone[mesh.host.owners], -1, mesh.host.neighbors)
    mesh.run(
        "score_log_ratio",
        mesh.t.starts,
        mesh.upload(neighbors, np.int32),
        mesh.upload(log_ratio, engine.real),
        sign,
        *mesh.name_args,
        keys,
    )
    faces = np.diff(mesh.host.starts)
    magnitudes = np.clip(2 + sign * (log_ratio + 0.2 * (faces - 6)), 0, 4)
    magnitudes[alone & (sign < 0)] = 0
    assert_keys(keys.get(), magnitudes, mesh.names)
    assert min((magnitudes == 0).sum(), (magnitudes == 4).sum()) > N / 8


def test_bad_cells_are_inner_cells_above_the_bound(mesh):
    """The bound itself is excluded; cells of four or eight sides are sites for any quality, and come first."""
    flaw, keys = 0.25, mesh.engine.empty(N, np.uint64)
    quality = mesh.rng.choice([0.5, 0.74, 0.75, 0.76, 1.0], N)
    mesh.run("score_bad_cells", *mesh.graph, mesh.upload(quality, mesh.engine.real), flaw, *mesh.name_args, keys)
    sides = np.diff(mesh.host.starts)
    odd = (sides < 5) | (sides > 7)
    sites = np.where(~mesh.walled & (odd | (1 - quality > flaw)), 1 - quality + odd, 0)
    assert_keys(keys.get(), sites, mesh.names)
    assert min((sites >= 1).sum(), ((sites > 0) & (sites < 1)).sum()) > 20


def test_sites_at_fixed_generators_are_removed(mesh):
    labels = mesh.rng.permutation(N)
    fixed, first = 40, keys_of(np.ones(N), np.arange(N))
    held = labels < fixed
    beside = np.array([held[row[row >= 0]].any() for row in mesh.rows])
    for around, out in ((0, held), (1, held | beside)):
        keys = mesh.upload(first, np.uint64)
        mesh.run(
            "drop_fixed_sites", *mesh.graph, mesh.upload(labels, np.int32), np.int32(fixed), np.int32(around), keys
        )
        assert np.array_equal(keys.get(), np.where(out, 0, first))
