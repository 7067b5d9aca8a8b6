"""The incremental update: comparison with diagrams made anew, and cases in which it must give up."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clvoro.opencl.engine import Engine
from clvoro.tessellation import incremental as repair
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.cells import SLOT, Cells
from clvoro.tessellation.incremental import IncrementalUpdate
from clvoro.tessellation.part import Part
from clvoro.tessellation.report import LISTED
from tests.reference import patch

N = 700


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param)


def square(n):
    x, y = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n * 0.75)
    return np.column_stack([x.ravel(), y.ravel()])


def point_sets():
    rng = np.random.default_rng(40961)
    random = patch.random_points(N, 40962)
    corners = [[0, 0], [1, 0], [1, 0.75], [0, 0.75]]
    walls = np.column_stack([rng.random(30), np.full(30, 0.75)])
    turn = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    spokes = 2 * np.pi * (np.arange(20) + 0.3 * rng.random(20)) / 20
    rings = np.concatenate([rng.uniform(0.2, 0.202, 20), rng.uniform(0.29, 0.3, 20)])
    ring = np.tile(np.column_stack([np.cos(spokes), np.sin(spokes)]), (2, 1)) * rings[:, None]
    return {
        "random": random,
        "graded": random**3,
        "clusters": np.concatenate([random[:300], 0.4 + 1e-3 * random[300:]]),
        "hexagons": patch.hexagons(0.04),
        "lattice": square(20),
        "cocircular": 0.4 + 0.2 * np.column_stack([np.cos(turn), np.sin(turn)]),
        # More faces than the checks and the lanes handle.
        "wheel": np.concatenate([np.zeros((1, 2)), ring]) + np.array([0.5, 0.4]),
        "walls": np.concatenate([corners, walls, random[:200]]),
        "three": random[:3],
        "two": random[:2],
        "one": random[:1],
    }


POINTS = point_sets()


class Carried:
    """A diagram that is updated, and the diagram of the same generators made anew."""

    def __init__(self, engine, points):
        self.engine, self.n = engine, len(points)
        self.cells, self.bins, self.incremental = (Cells(engine), Bins(engine), IncrementalUpdate(engine))
        self.t = self.anew(self.cells, points)

    def anew(self, cells, points):
        x = self.engine.upload(points)
        return cells.tessellate(Part.alone(x, patch.BOX), self.bins.build(patch.BOX, x, self.n), exact=False)

    def move(self, points):
        """Update the diagram to `points`; return it as NumPy arrays, and whether the update succeeded."""
        x = self.engine.upload(points)
        t = self.incremental.update(self.cells, patch.BOX, x, self.t)
        self.t = self.anew(self.cells, points) if t is None else t
        return patch.fetch(self.t), t is not None

    def reference(self, points):
        return patch.fetch(self.anew(Cells(self.engine), points))


def spacing(points):
    """Return the distance to the nearest neighbor, (n, 1)."""
    if len(points) == 1:
        return np.full((1, 1), 0.3)
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(d, np.inf)
    return d.min(axis=1)[:, None]


def check(t, eps):
    """Check that the cells tile the box and the graph is symmetric."""
    # In single precision the cluster's spacing is some hundred roundings of its position: corners
    # of the cells around it are known that badly.
    rel = 8 * eps if eps < 1e-10 else 1e-5
    assert t.volumes.sum(dtype=float) == pytest.approx(patch.BOX.measure, rel=rel)
    pairs = {(i, j) for i, j in zip(t.owners.tolist(), t.neighbors.tolist(), strict=True) if j >= 0}
    assert pairs == {(j, i) for i, j in pairs}
    inner = t.neighbors >= 0
    x = t.points
    # The centroid of a face has equal distances from both generators, up to the round-off of positions.
    near = np.linalg.norm(t.face_centroids[inner], axis=1)
    across = x[t.owners[inner]] - x[t.neighbors[inner]] + t.face_centroids[inner]
    assert np.allclose(near, np.linalg.norm(across, axis=1), rtol=1e-6, atol=32 * eps)


def assert_only_short_faces_differ(t, expected, noise):
    for a, b in ((t, expected), (expected, t)):
        known = set(zip(b.owners.tolist(), b.neighbors.tolist(), strict=True))
        faces = zip(a.owners.tolist(), a.neighbors.tolist(), a.face_measures, strict=True)
        assert all(length < noise for i, j, length in faces if (i, j) not in known)


@pytest.mark.sparse(6)
@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3])
def test_update_gives_the_diagram_made_anew(engine, name, share, monkeypatch):
    """Ten small motions give the same bits as a diagram made anew, apart from degenerate vertices."""
    monkeypatch.setattr(repair, "FEW", 1)  # however small the set, cells are found in lanes where there are any
    rng = np.random.default_rng(40963)
    eps = float(np.finfo(engine.real).eps)
    points = POINTS[name].astype(engine.real)
    carried = Carried(engine, points)
    times = 0
    for _ in range(10):
        step = share * spacing(points) * (rng.random(points.shape) - 0.5)
        points = np.clip(points + step, 0, [1, 0.75]).astype(engine.real)
        t, was = carried.move(points)
        times += was
        check(t, eps)
        expected = carried.reference(points)
        if np.array_equal(t.neighbors, expected.neighbors):
            assert np.array_equal(t.volumes, expected.volumes)
            assert np.array_equal(t.face_measures, expected.face_measures)
        else:
            # Only faces of zero length may exist in one diagram alone.
            assert eps > 1e-10 or name in ("lattice", "hexagons", "cocircular")
            noise = 256 * eps
            assert np.allclose(t.volumes, expected.volumes, rtol=1e-3 if share else 0, atol=noise)
            assert_only_short_faces_differ(t, expected, noise)
    if share <= 0.02 and name not in ("clusters", "lattice", "cocircular"):
        # With few cells a change concerns too many of them.
        assert times == 10 if name != "wheel" else times >= 10 - 250 * share


def fitting(t):
    """Return for each row whether all its neighbors list the generator between the correct two, (n,) bool."""
    rows = np.split(t.neighbors, t.starts[1:-1])

    def turned(row, j):
        at = np.flatnonzero(row == j)
        return None if len(at) != 1 else (row[at[0] - 1], row[(at[0] + 1) % len(row)])

    return np.array(
        [all(turned(row, j) == (turned(rows[j], i) or ())[::-1] for j in row if j >= 0) for i, row in enumerate(rows)]
    )


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.2])
def test_rows_marked_as_fitting_fit(engine, name, share):
    """The next update relies on these marks, so the test compares them with the graph."""
    rng = np.random.default_rng(40967)
    points = POINTS[name].astype(engine.real)
    carried, changed = Carried(engine, points), 0
    for _ in range(6):
        before = carried.t.neighbors.get()
        step = share * spacing(points) * (rng.random(points.shape) - 0.5)
        points = np.clip(points + step, 0, [1, 0.75]).astype(engine.real)
        t, was = carried.move(points)
        if not was:
            continue
        changed += not np.array_equal(before, carried.t.neighbors.get())
        fits = carried.incremental._fits.get() == 1
        assert not (fits & ~fitting(t)).any()
        if name in ("random", "graded", "hexagons") and engine.real == np.float64:
            # Not all: cells that are clipped again were doubtful.
            assert fits.mean() > 0.7
    if name == "random" and share > 0:
        assert changed > 3


@pytest.mark.slow
def test_most_cells_are_made_in_lanes(ctx, monkeypatch):
    """Cells at walls, doubtful cells and those with several changes are clipped, at ten times the cost."""
    engine, rng = patch.make_engine(ctx), np.random.default_rng(40968)
    if engine.group_size > 1:
        pytest.skip("lanes are for CPUs")
    points = patch.random_points(2050, 40969)
    carried, rounds, found = Carried(engine, points), [], []
    run = Engine.run_each

    def watched(self, kernel, size, *args, **kwargs):
        name = kernel.function_name
        if name == "wrap_marked":
            args[4].fill(-7)
            args[5].fill(-7)
        event = run(self, kernel, size, *args, **kwargs)
        if name == "wrap_marked":
            count = clipped_in(args[1], 0)
            if not count:
                return event
            listed, slots, counts = args[2].get(), args[4].get(), args[5].get()
            found.append((listed[:count], counts[:count], slots))
            # Lanes beyond the last cell change nothing.
            assert count % 8
            assert (counts[count:] == -7).all()
            assert (slots[SLOT * count :] == -7).all()
        elif name == "clip_marked":
            count = clipped_in(args[-1], args[1])
            rounds.extend([count] * (count > 0))
        return event

    monkeypatch.setattr(Engine, "run_each", watched)
    move = 0.2 * spacing(points) * (rng.random(points.shape) - 0.5)
    points = np.clip(points + move, 0, [1, 0.75])
    t, was = carried.move(points)
    assert was
    assert rounds[0] > 500
    (listed, counts, slots), *others = found
    assert not others
    # Within some spacings of .014 a cell may reach a wall.
    inner = (abs(points[listed] - [0.5, 0.375]) < [0.44, 0.315]).all(axis=1)
    assert (counts[inner] > 0).mean() > 0.95
    assert sum(rounds[1:]) < 0.1 * rounds[0]
    # Cells with a single change are correct at once.
    rows = np.split(t.neighbors, t.starts[1:-1])
    right = [
        np.array_equal(rows[i], slots[w * SLOT :][:n]) for w, (i, n) in enumerate(zip(listed, counts, strict=True))
    ]
    assert np.mean(np.array(right)[counts > 0]) > 0.97


def clipped_in(report, number):
    """Return how many cells are clipped in a round."""
    before, after = report.get()[LISTED + number : LISTED + number + 2]
    return int(after - before)


def no_longer_convex(t, points):
    """Return the cells to mark: those for which the rows of `t` give no convex cell of `points`, and at which face."""
    after = np.arange(len(t.neighbors)) + 1
    after[t.starts[1:] - 1] = t.starts[:-1]
    before = np.argsort(after)
    walls = np.flatnonzero(t.neighbors < 0)
    axis, side = divmod(-1 - t.neighbors[walls], 2)
    ways = points[np.maximum(t.neighbors, 0)] - points[t.owners]
    ways[walls] = 0  # to the image behind the wall
    levels = np.array([patch.BOX.lower, patch.BOX.upper])[side, axis]
    ways[walls, axis] = 2 * (levels - points[t.owners[walls], axis])
    # Corners are as far from either neighbor as from the generator.
    pairs = np.stack([ways, ways[after]], axis=1)
    corners = np.linalg.solve(pairs, (pairs**2).sum(axis=2)[..., None] / 2)[..., 0]
    edges = corners - corners[before]
    bad = np.flatnonzero(np.minimum(cross(ways, ways[after]), cross(ways, edges)) <= 0)
    around = np.stack([t.neighbors[k] for k in (bad, before[bad], after[bad])])
    return np.union1d(t.owners[bad], around[around >= 0]).tolist()


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


@pytest.mark.slow
@pytest.mark.parametrize("group_size", [None, 128])
def test_mostly_changed_cells_are_clipped(ctx, group_size, monkeypatch):
    """The first round clips cells with changed neighbors and few others; later rounds clip few."""
    engine, rng = patch.make_engine(ctx, group_size=group_size), np.random.default_rng(40971)
    points = patch.random_points(3000, 40972)
    carried, rounds, run = Carried(engine, points), [], Engine.run_each

    def watched(self, kernel, size, *args, **kwargs):
        if kernel.function_name == "clip_marked":
            clipped = args[0].get()[: clipped_in(args[-1], args[1])]
            rounds.extend([clipped] * (len(clipped) > 0))
        return run(self, kernel, size, *args, **kwargs)

    monkeypatch.setattr(Engine, "run_each", watched)
    for share in (0.0, 0.01, 0.1):
        before = patch.fetch(carried.t)
        points = points + share * spacing(points) * (rng.random(points.shape) - 0.5)
        points = np.clip(points, 0, [1, 0.75])
        rounds.clear()
        after, was = carried.move(points)
        assert was
        pairs = [set(zip(t.owners.tolist(), t.neighbors.tolist(), strict=True)) for t in (before, after)]
        changed = {i for i, _ in pairs[0] ^ pairs[1]}
        first, *others = [*rounds, np.zeros(0, int)]
        assert first.tolist() == no_longer_convex(before, points)
        assert set(first.tolist()) <= changed
        # Adjacent changes are found one after the other.
        assert len(changed) - len(first) <= 0.02 * len(changed)
        assert sum(map(len, others)) <= 0.05 * len(changed)
        assert (share > 0) == (len(changed) > 20)


class Rows:
    """Rows during an update, as NumPy arrays, with the expected `marks` and `fits` after a round of clipping."""

    def __init__(self, places, slots, counts, starts, neighbors):
        self.places, self.slots, self.counts = places.get(), slots.get(), counts.get()
        self.starts, self.neighbors = starts.get(), neighbors.get()

    def old(self, i):
        return self.neighbors[self.starts[i] : self.starts[i + 1]].tolist()

    def row(self, i):
        place = self.places[i]
        if place < 0:
            return self.old(i)
        return self.slots[place * SLOT :][: abs(self.counts[place])].tolist()

    def is_doubtful(self, i):
        return self.places[i] >= 0 and self.counts[self.places[i]] < 0


def around(row, j):
    """Return the neighbors before and behind `j` in a row; None if it is not there."""
    if j not in row:
        return None
    k = row.index(j)
    return row[k - 1], row[(k + 1) % len(row)]


def checked(before, after, listed, fits):
    """Return which cells must be marked after `listed` have been clipped, and which are known to be correct."""
    marks, fits = np.zeros(len(fits), int), fits.copy()
    for i in listed:
        if before.places[i] >= 0:  # clipped again: a neighbor that it loses may count as correct
            fits[[j for j in before.row(i) if j >= 0 and j not in after.row(i)]] = 0
    fits[listed] = 1
    for i in listed:
        row = after.row(i)
        for j in row:
            if j >= 0 and around(after.row(j), i) != around(row, j)[::-1]:
                fits[[i, j]], marks[[i, j]] = 0, 1
        for j in after.old(i):
            if j >= 0 and j not in row and i in after.row(j):
                fits[j] = 0
                if not after.is_doubtful(j):
                    marks[[i, j]] = 1
    return marks, fits


def test_marks_after_each_round_of_clipping(ctx, monkeypatch):
    """After each round, the marks and the cells known to be correct, row by row, for small sets with large changes."""
    engine, rng = patch.make_engine(ctx), np.random.default_rng(40973)
    run, rounds, state = Engine.run_each, [], {}

    def watched(self, kernel, size, *args, **kwargs):
        name = kernel.function_name
        if name == "clip_marked":
            state.update(rows=Rows(*args[3:8]), fits=args[-2].get())
        event = run(self, kernel, size, *args, **kwargs)
        if name == "check_clipped":
            listed = args[0].get()[: clipped_in(args[2], args[1])]
            marks, fits = checked(state["rows"], Rows(*args[3:8]), listed, state["fits"])
            assert np.array_equal(args[-2].get(), marks)
            assert np.array_equal(args[-1].get(), fits)
            rounds.extend([len(listed)] * (len(listed) > 0))
        return event

    monkeypatch.setattr(Engine, "run_each", watched)
    monkeypatch.setattr(repair, "MAX_SHARE", 1.0)
    monkeypatch.setattr(repair, "AGAIN_SHARE", 1.0)
    points, most, times = patch.random_points(30, 40974), 0, 0
    carried = Carried(engine, points)
    for _ in range(60):
        rounds.clear()
        points = points + 1.5 * spacing(points) * (rng.random(points.shape) - 0.5)
        points = np.clip(points, 0.01, [0.99, 0.74])
        t, was = carried.move(points)
        assert np.array_equal(t.neighbors, carried.reference(points).neighbors)
        most, times = max(most, len(rounds)), times + was
        if was and len(rounds) <= 1:
            assert carried.incremental._fits.get().all()
    assert most >= 3
    assert times > 40


@pytest.mark.sparse(4)
@pytest.mark.parametrize("expected", [[], [1], [64], [280, 1], [280] * 4, None])
def test_rounds_that_are_enqueued_ahead_change_nothing(engine, expected):
    """Too few rounds, too many, and rounds that are too small."""
    points = POINTS["random"].astype(engine.real)
    rng = np.random.default_rng(40977)
    moved = points + 0.1 * spacing(points) * (rng.random(points.shape) - 0.5)
    moved = np.clip(moved, 0, [1, 0.75]).astype(engine.real)
    carried = Carried(engine, points)
    carried.move(points)
    carried.incremental._expected = expected
    t, was = carried.move(moved)
    assert was
    reference = carried.reference(moved)
    assert np.array_equal(t.neighbors, reference.neighbors)
    assert np.array_equal(t.volumes, reference.volumes)
    assert carried.incremental._expected[0] > 256


@pytest.mark.sparse(2)
@pytest.mark.parametrize("share", [0.1, 0.2, 2.0])
def test_sample_first(engine, share, monkeypatch):
    """A check in two parts gives the same bits; if most of the sample is wrong, the rest is not checked."""
    points = POINTS["random"].astype(engine.real)
    rng = np.random.default_rng(40970)
    step = share * spacing(points) * (rng.random(points.shape) - 0.5)
    moved = np.clip(points + step, 0, [1, 0.75]).astype(engine.real)
    launched, run = [], Engine.run

    def watched(self, kernel, size, *args, **kwargs):
        if kernel.function_name == "check_rows":
            launched.append(args[1:3])
        return run(self, kernel, size, *args, **kwargs)

    monkeypatch.setattr(Engine, "run", watched)
    found = []
    for least in (N + 1, N):
        monkeypatch.setattr(repair, "SAMPLED_FROM", least)
        carried = Carried(engine, points)
        found.append((*carried.move(moved), carried.incremental._fits.get()))
    (a, was_a, fits_a), (b, was_b, fits_b) = found
    assert launched == [(1, 0), (repair.SAMPLE, 0), (repair.SAMPLE, 1)]
    assert was_a == was_b == (share < 1)
    assert np.array_equal(a.neighbors, b.neighbors)
    assert np.array_equal(a.volumes, b.volumes)
    if was_a:
        assert np.array_equal(fits_a, fits_b)


def test_many_changes_are_made_anew(engine):
    carried = Carried(engine, POINTS["random"])
    _, was = carried.move(patch.random_points(N, 40964))
    assert not was


@pytest.mark.sparse(1)
def test_exchanged_generators(engine):
    """All cells stay, but two generators exchange theirs."""
    points = patch.relaxed_points(200, 40965).astype(engine.real)
    carried = Carried(engine, points)
    for i, j in [(0, 1), (17, 91)]:
        points = points.copy()
        points[[i, j]] = points[[j, i]]
        t, _ = carried.move(points)
        expected = carried.reference(points)
        assert np.array_equal(t.neighbors, expected.neighbors)
        assert np.array_equal(t.volumes, expected.volumes)


def test_turned_inside_out(engine):
    """After a reflection all cells are convex and consistent, but clockwise."""
    points = POINTS["random"].astype(engine.real)
    carried = Carried(engine, points)
    mirrored = points.copy()
    mirrored[:, 0] = 1 - mirrored[:, 0]
    t, was = carried.move(mirrored)
    assert not was
    assert np.array_equal(t.volumes, carried.reference(mirrored).volumes)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", ["lattice", "hexagons", "cocircular"])
def test_onto_a_lattice(engine, name, monkeypatch):
    """As faces vanish nearly every row is doubtful: the result has only faces above round-off, or none exists."""
    monkeypatch.setattr(repair, "FEW", 1)
    monkeypatch.setattr(repair, "MAX_SHARE", 1.0)
    rng = np.random.default_rng(40975)
    eps, there = float(np.finfo(engine.real).eps), POINTS[name].astype(engine.real)
    points = there + (0.02 * spacing(there) * (rng.random(there.shape) - 0.5)).astype(engine.real)
    carried, times, run, certain = Carried(engine, points), 0, Engine.run_each, []

    def watched(self, kernel, size, *args, **kwargs):
        event = run(self, kernel, size, *args, **kwargs)
        if kernel.function_name == "wrap_marked" and (count := clipped_in(args[1], 0)):
            certain.append((args[5].get()[:count] > 0).mean())
        return event

    monkeypatch.setattr(Engine, "run_each", watched)
    for noise in (0, 1, 4, 0):
        points = (there + noise * eps * (rng.random(there.shape) - 0.5)).astype(engine.real)
        t, was = carried.move(points)
        times += was
        check(t, eps)
        expected = carried.reference(points)
        assert t.volumes == pytest.approx(expected.volumes, abs=256 * eps)
        assert_only_short_faces_differ(t, expected, 256 * eps)
        if was:
            assert not ((carried.incremental._fits.get() == 1) & ~fitting(t)).any()
    assert times == 4
    if name == "lattice" and certain:
        assert max(certain) == 0


@pytest.mark.sparse(1)
def test_far_jump(engine):
    """One generator crosses the domain; only its old and new surroundings change."""
    points = patch.relaxed_points(300, 40966).astype(engine.real)
    carried = Carried(engine, points)
    points = points.copy()
    points[7] = points[250] + spacing(points)[250] * 0.4
    t, _ = carried.move(points)
    assert np.array_equal(t.neighbors, carried.reference(points).neighbors)


def test_update_gives_up_on_coincident_generators(engine):
    points = POINTS["random"].astype(engine.real)
    carried = Carried(engine, points)
    points = points.copy()
    points[3] = points[4]
    x = engine.upload(points)
    assert carried.incremental.update(carried.cells, patch.BOX, x, carried.t) is None


@given(st.integers(0, 2**31), st.floats(1e-7, 1.0), st.integers(3, 60))
@settings(max_examples=25)
def test_any_motion(ctx, seed, share, n):
    engine = patch.make_engine(ctx)
    rng = np.random.default_rng(seed)
    points = np.round(rng.random((n, 2)) * [1, 0.75], rng.integers(1, 5))
    points = np.unique(points, axis=0)
    carried = Carried(engine, points)
    for _ in range(3):
        step = share * spacing(points) * (rng.random(points.shape) - 0.5)
        points = np.clip(points + step, 0, [1, 0.75])
        t, _ = carried.move(points)
        check(t, np.finfo(float).eps)
        expected = carried.reference(points)
        # Coordinates rounded to a grid make points cocircular.
        assert np.allclose(t.volumes, expected.volumes, rtol=1e-9, atol=1e-15)
