"""How cells come to see the same faces in 3D, step by step, against plain ones in Python."""

import numpy as np
import pytest

import clvoro
from clvoro.opencl.program import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.topology3d.face_matching import MOST_DOUBLINGS, Agreement
from clvoro.tessellation.topology3d.meetings import Meetings
from tests.tessellation.test_polyhedra import BOX, tessellation


@pytest.fixture(scope="module")
def engine(ctx):
    adapter = clvoro.Adapter(ctx)
    return Engine(adapter.ctx, adapter.queue, 3, np.dtype(float))


@pytest.fixture(scope="module")
def kernels(engine):
    return engine.kernels(
        "tessellation/topology3d/face_matching", {"MOST_DOUBLINGS": MOST_DOUBLINGS}
    )


def rows(engine, loops, behind=None):
    """Return starts and rows of these loops on the device, with what lies behind each of them."""
    behind = behind or [[-7]] * len(loops)
    whole = [[*loop, *more] for loop, more in zip(loops, behind, strict=True)]
    starts = np.cumsum([0] + [len(row) for row in whole])
    return engine.upload(starts, np.int32), engine.upload(np.concatenate(whole), np.int32)


def without_spurs(loop):
    """Leave out, one by one, what is passed twice in a row, and steps there and back."""
    loop, k = list(loop), 0
    while k < len(loop) and len(loop) > 2:
        loop = loop[k:] + loop[:k]
        if loop[0] == loop[1]:
            loop, k = loop[1:], 0
        elif loop[0] == loop[2]:
            loop, k = loop[2:], 0
        else:
            loop = loop[len(loop) - k :] + loop[: len(loop) - k]
            k += 1
    return loop if len(loop) > 2 else []


def turned(loop):
    """Return the loop as it is, whatever it begins with."""
    return min(loop[k:] + loop[:k] for k in range(len(loop))) if loop else []


@pytest.mark.parametrize("labels", [2, 3, 5, 40])
def test_loops_without_repetitions_and_spurs(engine, kernels, labels):
    rng = np.random.default_rng(61201)
    given = [rng.integers(0, labels, rng.integers(0, 12)).tolist() for _ in range(400)]
    # A loop passed once, with spurs at any place, where it begins as well.
    for _ in range(200):
        way = rng.permutation(20)[:5].tolist()
        for _ in range(rng.integers(1, 4)):
            at, out = rng.integers(len(way)), rng.integers(20, 30, rng.integers(1, 3)).tolist()
            way[at:at] = [way[at], *out, *out[-2::-1]]
        given.append(np.roll(way, rng.integers(len(way))).tolist())
    names = 3 * rng.permutation(60)  # of corners
    flat = np.concatenate(given).astype(int)
    starts = np.cumsum([0] + [len(loop) for loop in given])
    of = np.zeros(180, int)
    of[names] = np.arange(60)
    turns = engine.upload(names[flat], np.int32)
    reduced, counts = engine.empty(len(flat), np.int32), engine.empty(len(given), np.int32)
    engine.run_each(
        kernels.reduce_views, len(given), engine.upload(starts, np.int32), turns,
        engine.upload(of, np.int32), reduced, counts,
    )  # fmt: skip
    reduced, counts = reduced.get(), counts.get()
    for k, loop in enumerate(given):
        found = reduced[starts[k] : starts[k] + counts[k]].tolist()
        assert turned(found) == turned(without_spurs(loop)), loop
    assert 0 < np.count_nonzero(counts) < len(given)


def test_views_that_differ(engine, kernels):
    """The twin of a loop passes the same vertices the other way round, each once."""
    rng = np.random.default_rng(61202)
    loops, twins, expected = [], [], []

    def add(one, other, differs):
        k = len(loops)
        turn = [np.roll(loop, rng.integers(len(loop))).tolist() if loop else [] for loop in (one, other)]  # fmt: skip
        loops.extend(turn)
        twins.extend([k + 1, k])
        expected.extend([differs, differs])

    for n in (3, 4, 7):
        for _ in range(12):
            loop = rng.permutation(20)[:n].tolist()
            add(loop, loop, True)
            add(loop, loop[::-1], False)
            add(loop, [], True)
            add(loop, loop[:0:-1], True)
            other = loop[::-1]
            other[rng.integers(n)] = 30
            add(loop, other, True)
            i, j = rng.permutation(n)[:2]
            other = loop[::-1]
            other[i], other[j] = other[j], other[i]
            # Three vertices have two ways round, that and the other.
            add(loop, other, n == 3 or turned(other) != turned(loop[::-1]))
            add(loop + loop[:1] + [25], (loop + loop[:1] + [25])[::-1], True)
    add([], [], False)
    # Walls, and views that the graph knows nothing of.
    for loop, twin, differs in (
        ([1, 2, 3, 4], "own", False), ([1, 2, 1, 4], "own", True), ([1, 2, 3, 4, 2], "own", True),
        ([], "own", False), ([], -1, False), ([1, 2, 3], -1, True),
    ):  # fmt: skip
        twins.append(len(loops) if twin == "own" else twin)
        loops.append(loop)
        expected.append(differs)
    # What lies behind a loop is none of it, though it would be the same with that.
    twins.extend([len(loops) + 1, len(loops)])
    behind = [[-7]] * (len(loops) + 1) + [[2, 1]]
    loops.extend([[1, 2, 3, 4, 5], [8, 9, 5, 4, 3]])
    expected.extend([True, True])
    starts, turns = rows(engine, loops, behind)
    counts = engine.upload([len(loop) for loop in loops], np.int32)
    v, any_ = len(loops), engine.zeros(1, np.int32)
    differs = engine.zeros(v, np.uint8)
    engine.run_each(
        kernels.compare_views, v, engine.upload(twins, np.int32), starts, turns, counts, differs, any_
    )  # fmt: skip
    # It stays known that they have.
    assert differs.get().tolist() == [3 if d else 0 for d in expected]
    assert int(any_[0].get()) == 1
    same = [k for k in range(v) if not expected[k]]
    place = {k: s for s, k in enumerate(same)}
    starts, turns = rows(engine, [loops[k] for k in same])
    any_.fill(0)
    engine.run_each(
        kernels.compare_views, len(same), engine.upload([place.get(twins[k], -1) for k in same], np.int32),
        starts, turns, engine.upload([len(loops[k]) for k in same], np.int32), differs, any_,
    )  # fmt: skip
    assert int(any_[0].get()) == 0


def test_the_first_of_the_sharpest_corners(engine, kernels):
    rng, c = np.random.default_rng(61204), 500
    labels = rng.integers(0, 60, c)
    sharpness = rng.choice(np.float32([0, 1e-30, 0.1, 0.5, 0.75]), c)
    of, sharp = engine.upload(labels, np.int32), engine.upload(sharpness, np.float32)
    best, chosen = engine.zeros(c, np.uint32), engine.empty(c, np.int32).fill(2**31 - 1)
    engine.run_each(kernels.rate_corners, c, of, sharp, best)
    engine.run_each(kernels.choose_corners, c, of, sharp, best, chosen)
    chosen = chosen.get()
    for label in range(c):
        own = np.flatnonzero(labels == label)
        expected = own[sharpness[own].argmax()] if len(own) else 2**31 - 1
        assert chosen[label] == expected


def test_vertices_put_into_edges(engine):
    """In both faces of an edge, once, whoever proposes it; halves know their other sides."""
    rng, cells = np.random.default_rng(61203), Polyhedra(engine)
    t = tessellation(engine, Bins(engine), cells, rng.random((12, 3)) * BOX.extent)
    stage = Agreement(engine, BOX, t)
    views, v = stage.views, len(stage.views.view_labels)
    owners, faces = views.owners.get(), views.corner_faces.get()
    labels = np.repeat(views.view_labels.get(), np.diff(views.turn_starts.get()))
    assert not stage._begin_snapping().get().any()
    for _ in range(3):
        starts, turns = views.turn_starts.get(), views.turns.get()
        before, of_chain = (a.get()[: len(turns)] for a in (stage._opposites, stage._chains))
        following = np.arange(len(turns)) + 1
        following[starts[1:] - 1] = starts[:-1]
        # The other side begins where an edge ends, in the same cell's face across, and goes back.
        assert np.array_equal(before[before], np.arange(len(turns)))
        assert np.array_equal(turns[before], turns[following])
        assert np.array_equal(turns[following[before]], turns)
        if len(labels) == len(turns):
            assert np.array_equal(owners[turns[before]], owners[turns])
            assert (labels[before] != labels).all()
            assert (faces[turns] == labels[before][:, None]).any(axis=1).all()
            assert np.array_equal(of_chain, np.minimum(np.arange(len(turns)), before))
        proposals = np.where(
            rng.random(len(turns)) < 0.3, rng.integers(0, len(owners), len(turns)), -1
        )
        proposals[0] = 0  # a number, too
        put = [max(proposals[min(s, o)], -1) for s, o in enumerate(before)]
        put = [p if p >= 0 else proposals[max(s, before[s])] for s, p in enumerate(put)]
        expected, expected_chains, new_starts = [], [], [0]
        for k in range(v):
            for s in range(starts[k], starts[k + 1]):
                more = [put[s]] if put[s] >= 0 else []
                expected += [turns[s], *more]
                expected_chains += [of_chain[s]] * (1 + len(more))
            new_starts.append(len(expected))
        stage._put(engine.upload(proposals, np.int32))
        assert views.turn_starts.get().tolist() == new_starts
        assert views.turns.get().tolist() == expected
        assert stage._chains.get().tolist() == expected_chains


def test_what_is_no_wider_than_vertices_round(engine, kernels):
    """Of walls: all vertices of a loop lie within the tolerance of a line, and a neighbor of it differed."""
    rng, level = np.random.default_rng(61205), 3
    points = engine.upload(rng.random((1, 3)))
    eps = float(np.finfo(float).eps)
    loops, narrow = [], []
    for wide in rng.choice([0.3, 3], 200):
        n, way, any_way = int(rng.integers(4, 7)), *rng.standard_normal((2, 3))
        way *= 0.3 / np.linalg.norm(way)
        side = np.cross(way, any_way)
        off = rng.uniform(-1, 1, n)
        off[:2], off[2] = 0, 1  # its ends, and what is farthest from the line
        # 16 roundings of a vertex's distance and of positions, as far as these are from the generator.
        off *= wide * 2**level * 16 * eps * (0.3 + 1) / np.linalg.norm(side)
        along = np.array([0, 1, *rng.random(n - 2)])
        loops.append(np.outer(along, way) + np.outer(off, side))
        narrow.append(wide < 1)
    v, c = len(loops), sum(map(len, loops))
    starts = np.cumsum([0] + [len(loop) for loop in loops])
    own, each = engine.upload(np.arange(c), np.int32), engine.upload(np.arange(v), np.int32)
    state = rng.choice([2, 4, 6], v)
    differs, any_ = engine.upload(state, np.uint8), engine.zeros(1, np.int32)
    engine.run_each(
        kernels.find_slits, v, points, engine.upload(np.concatenate(loops)), engine.zeros(c, np.int32), own, own,
        each, engine.upload(starts, np.int32), own, own, engine.upload(np.diff(starts), np.int32),
        engine.upload(np.full(v, level), np.uint8), differs, any_,
    )  # fmt: skip
    expected = [s | (slit and s & 4 > 0) for slit, s in zip(narrow, state.tolist(), strict=True)]
    assert differs.get().tolist() == expected
    assert int(any_[0].get()) == 1
    assert 20 < np.count_nonzero(differs.get() & 1) < v - 20


def test_vertices_as_far_from_all_their_generators():
    """On circles and on spheres, on a wall, and where hardly anything tells: it stays there."""
    rng = np.random.default_rng(61206)
    t, u = rng.uniform(0, 2 * np.pi, 40), rng.standard_normal((30, 3))
    circle = 0.5 + 0.3 * np.column_stack([np.cos(t), np.sin(t), 0 * t])
    sphere = np.array([0.2, 0.4, 0.6]) + 0.1 * u / np.linalg.norm(u, axis=1)[:, None]
    points = np.vstack([circle, sphere])
    vertices = np.repeat([0, 1, 2], [40, 40, 30])
    cells = np.concatenate([np.arange(40), np.arange(40), np.arange(40, 70)])
    fixed = np.zeros((3, 3), bool)
    fixed[0, 2] = True
    order = rng.permutation(110)
    meetings = Meetings(points, fixed, vertices[order], cells[order])
    begun = np.array([[0.51, 0.48, 0.0], [0.5 + 1e-9, 0.5, 0.7], [0.2 + 1e-3, 0.4, 0.6]])
    placed, eps = meetings.place(begun), float(np.finfo(float).eps)
    assert np.abs(placed - [[0.5, 0.5, 0], [0.5, 0.5, 0.7], [0.2, 0.4, 0.6]]).max() < 8 * eps
    far = [np.linalg.norm(begun[k] - points[cells[vertices == k]], axis=1) for k in (0, 2)]
    found = meetings.excess(np.array([0, 2]), begun[[0, 2]])
    assert found == pytest.approx([np.ptp(f) for f in far], rel=1e-12)
    assert meetings.excess(np.arange(3), placed).max() < 8 * eps
    assert meetings.excess(np.zeros(0, int), np.zeros((0, 3))).shape == (0,)
