"""How both cells of every face in 3D come to share its vertices, step by step and as a whole."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.readback.diagram import _DiagramReader, make_diagram
from clvoro.tessellation.stages import TessellationStages
from clvoro.tessellation.topology3d.consistency import FaceSharing, share_faces
from tests.tessellation.test_polyhedra import BOX, tessellation


@pytest.fixture(scope="module")
def engine(ctx):
    adapter = clvoro.Adapter(ctx)
    return Engine(adapter.ctx, adapter.queue, 3, np.dtype(float))


@pytest.fixture(scope="module")
def kernels(engine):
    return engine.kernels("tessellation/topology3d/consistency")


def rows(engine, loops, behind=None):
    """Return starts and rows of these loops on the device, with what lies behind each of them."""
    behind = behind or [[-7]] * len(loops)
    whole = [[*loop, *more] for loop, more in zip(loops, behind, strict=True)]
    starts = np.cumsum([0] + [len(row) for row in whole])
    return engine.upload(starts, np.int32), engine.upload(np.concatenate(whole), np.int32)


def test_twins_of_half_faces(engine, kernels):
    """Two cells with a common face; a face with a neighbor that does not have it has no twin. Cell 3 is a ghost."""
    starts, half_face_starts = [0, 2, 4, 6], [0, 2, 5, 7]
    labels = [1, -1, -3, 0, 2, -1, 3]
    given = (engine.upload(a, np.int32) for a in (starts, half_face_starts, labels))
    twins = engine.empty(7, np.int32)
    engine.run_each(kernels.find_twins, 3, *given, twins)
    assert twins.get().tolist() == [3, 1, 2, 0, -1, 5, 6]


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
        kernels.reduce_loops,
        len(given),
        engine.upload(starts, np.int32),
        turns,
        engine.upload(of, np.int32),
        reduced,
        counts,
    )
    reduced, counts = reduced.get(), counts.get()
    for k, loop in enumerate(given):
        found = reduced[starts[k] : starts[k] + counts[k]].tolist()
        assert turned(found) == turned(without_spurs(loop)), loop
    assert 0 < np.count_nonzero(counts) < len(given)


def test_half_faces_that_differ(engine, kernels):
    """The twin of a loop passes the same vertices the other way round, each once."""
    rng = np.random.default_rng(61202)
    loops, twins, expected = [], [], []

    def add(one, other, differs):
        k = len(loops)
        turn = [np.roll(loop, rng.integers(len(loop))).tolist() if loop else [] for loop in (one, other)]
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
    # Walls, and half-faces that the graph lacks.
    for loop, twin, differs in (
        ([1, 2, 3, 4], "own", False),
        ([1, 2, 1, 4], "own", True),
        ([1, 2, 3, 4, 2], "own", True),
        ([], "own", False),
        ([], -1, False),
        ([1, 2, 3], -1, True),
    ):
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
    engine.run_each(kernels.compare_half_faces, v, engine.upload(twins, np.int32), starts, turns, counts, differs, any_)
    assert differs.get().tolist() == expected
    assert int(any_[0].get()) == 1
    same = [k for k in range(v) if not expected[k]]
    place = {k: s for s, k in enumerate(same)}
    starts, turns = rows(engine, [loops[k] for k in same])
    any_.fill(0)
    engine.run_each(
        kernels.compare_half_faces,
        len(same),
        engine.upload([place.get(twins[k], -1) for k in same], np.int32),
        starts,
        turns,
        engine.upload([len(loops[k]) for k in same], np.int32),
        differs,
        any_,
    )
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


def ring(n):
    """Generators on a circle whose axis is parallel to no wall: all cells meet along it."""
    turn = 2 * np.pi * np.arange(n) / n
    plane = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0][:2]
    return BOX.extent / 2 + 0.4 * np.column_stack([np.cos(turn), np.sin(turn)]) @ plane


def off_planes(sharing, u, y):
    """How far a position lies off the planes of corner u."""
    f, points = sharing.half_faces, sharing.t.points.get()
    own, offs = points[f.owners.get()[u]], []
    for label in f.corner_faces.get()[u].tolist():
        if label < 0:
            wall = (0, (BOX.extent / BOX.frame[1])[(-1 - label) // 2])[(-1 - label) % 2]
            offs.append(abs(y[(-1 - label) // 2] - wall))
        else:
            offs.append(abs(np.linalg.norm(y - own) - np.linalg.norm(y - points[label])))
    return max(offs)


def test_vertices_are_merged_into_better_ones_on_their_planes(engine):
    t = tessellation(engine, Bins(engine), Polyhedra(engine), ring(40))
    sharing = FaceSharing(engine, BOX, t)
    f = sharing.half_faces
    sharp = f.sharpness.get()
    assert sharing.compare()
    before, best = sharing.labels.get(), sharing.best_corners.get()
    assert sharing.merge(0)
    after, chosen = sharing.labels.get(), sharing.best_corners.get()
    merged = np.flatnonzero((after != before) & (best[before] != chosen[after]))
    assert len(merged) > 20
    at = t.points.get()[f.owners.get()] + f.corners.get()
    for u in merged.tolist():
        assert sharp[chosen[after[u]]] >= sharp[best[before[u]]]
        assert off_planes(sharing, u, at[chosen[after[u]]]) < 64 * np.finfo(float).eps
    # The ends of the axis stay apart.
    while sharing.compare():
        if not sharing.merge(0):
            break
    ends = {i for i, label in enumerate(f.corner_faces.get().tolist()) if min(label) < 0}
    on_axis = [u for u in ends if abs(np.ptp(np.linalg.norm(at[u] - t.points.get(), axis=1))) < 1e-14]
    labels = sharing.labels.get()
    assert len({labels[u] for u in on_axis}) == 2


def test_a_face_that_cannot_be_shared_is_an_error(engine, monkeypatch):
    monkeypatch.setattr(FaceSharing, "merge", lambda self, doublings: False)
    t = tessellation(engine, Bins(engine), Polyhedra(engine), ring(40))
    with pytest.raises(clvoro.errors.InputError, match="perturb generators that lie on a common sphere"):
        share_faces(engine, BOX, t)


@pytest.mark.parametrize("spoiled", [False, True])
def test_ghosts_shape_cells_and_have_none(engine, monkeypatch, spoiled):
    """Against the diagram in which they are generators, too: its first cells, with the same vertices."""
    stages, x = TessellationStages(engine), np.random.default_rng(5).random((300, 3))
    monkeypatch.setattr(_DiagramReader, "needs_check", lambda self: spoiled and self.t.rows > self.n)
    whole, some = make_diagram(stages, BOX, x), make_diagram(stages, BOX, x[:200], x[200:])
    assert len(some) == (300 if spoiled else 200)
    faces = {}
    for diagram in (whole, some):
        f = diagram.faces
        loops = [f.points[f.corners[f.starts[k] : f.starts[k + 1]]] for k in range(len(f))]
        faces[diagram] = {(i, j): loop for i, j, loop in zip(f.owner, f.neighbor, loops, strict=True) if 0 <= j < 200}
    assert faces[whole].keys() == faces[some].keys()
    for key, loop in faces[some].items():
        there = cdist(loop, faces[whole][key])
        assert len(set(there.argmin(axis=1))) == len(loop) == there.shape[1]
        assert there.min(axis=1).max() < 1e-14
    np.testing.assert_allclose(some.volumes[:200], whole.volumes[:200], rtol=1e-12)
    beyond = [
        np.bincount(f.owner[(f.neighbor >= 200) | (f.neighbor < 0)], minlength=200)[:200]
        for f in (whole.faces, some.faces)
    ]
    np.testing.assert_array_equal(*beyond)
