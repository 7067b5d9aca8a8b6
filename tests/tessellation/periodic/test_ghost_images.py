"""Ghost images, unfolded rows and folded rows: comparison with loops in NumPy."""

from dataclasses import replace

import numpy as np
import pytest

import clvoro
from clvoro.tessellation.periodic.ghost_images import COLLAPSED, FAR
from clvoro.tessellation.periodic.halo import BLOCKS, Halo, block_count, block_counts
from clvoro.tessellation.tessellator import Tessellator

BOXES = {
    "torus": clvoro.Box((0, 0), (1, 0.7), periodic=True),
    "channel": clvoro.Box((0, 0), (1, 0.7), periodic=(True, False)),
    "cube": clvoro.Box((0, 0, 0), (1, 0.7, 0.8), periodic=True),
    "slab": clvoro.Box((0, 0, 0), (1, 0.7, 0.8), periodic=(False, True, True)),
}
WHOLE = 4.0  # a margin as wide as a period holds all images
STEP = 257 / 2**14
"""Unit of positions and depths, so that some are equal. No block begins at a multiple of it."""


def bits(x):
    """Return the bits of a float as an integer."""
    return int(np.float32(x).view(np.int32))


class Given:
    """Generators of a box, some on its boundary, with their images in a halo of random depths; some exactly as deep."""

    def __init__(self, adapter, name, n, stepped=False):
        box, rng = BOXES[name], np.random.default_rng(2301)
        self.box, self.n, self.dim = box, n, box.dim
        self.stages = adapter._stages_for(box)
        self.engine, self.ghost_images = self.stages.engine, self.stages.ghost_images
        self.real = self.engine.real
        points = np.array(box.lower) + box.extent * rng.random((n, box.dim))
        if n > 20:
            for a in range(box.dim):
                points[2 * a, a], points[2 * a + 1, a] = box.lower[a], box.upper[a]
        wide = (0.3 * rng.random(block_count(box.dim))).astype(np.float32)
        if stepped:
            points, wide = (x // STEP * STEP for x in (points, wide))
        self.x = self.engine.upload(box.place(points, self.real))
        self.points = self.x.get()
        self.periods = box.periods(self.real).astype(self.real)
        self.edges = box.device_corners(self.real)[1][: self.dim]
        self.counts = block_counts(self.edges, n)[: self.dim]
        self.halo = Halo(self.engine)
        wide[rng.random(len(wide)) < 0.1] = WHOLE
        self.halo.required.set(wide)
        self.halo.cells = n
        self.wide = wide.reshape(self.dim, 2, -1)
        self.extend()

    def extend(self):
        """Make the images, in buffers that the next call reuses."""
        self.images = self.ghost_images.extend(self.box, self.x, self.n, self.halo, 1.0, False)

    def steps(self, code):
        return [code // 3**a % 3 - 1 for a in range(self.dim)]

    def is_within(self, place, steps):
        """Return whether an image lies in the halo of all boundaries that it lies beyond."""
        for a, step in enumerate(steps):
            if step == 0:
                continue
            others = [b for b in range(self.dim) if b != a]
            blocks = []
            for b in others:
                length = self.real.type(self.edges[b] / self.counts[b])
                blocks.append(int(np.clip(np.floor(place[b] / length), 0, self.counts[b] - 1)))
            at = blocks[0] if self.dim == 2 else blocks[0] * BLOCKS[3] + blocks[1]
            depth = -place[a] if step < 0 else place[a] - self.periods[a]
            if depth > self.wide[a, int(step > 0), at]:
                return False
        return True

    def wide_of(self, axis, end):
        """Return the depths of the blocks of a boundary."""
        along = [self.counts[a] for a in range(self.dim) if a != axis]
        whole = self.wide[axis, end].reshape((BLOCKS[self.dim],) * len(along))
        return whole[tuple(slice(k) for k in along)]

    def expected(self):
        """Return owners, codes and positions of all images, ordered by owner and code."""
        found = []
        for i, x in enumerate(self.points):
            for code in range(3**self.dim):
                steps = np.array(self.steps(code))
                if not steps.any() or (steps[self.periods == 0] != 0).any():
                    continue
                place = x + steps.astype(self.real) * self.periods
                if self.is_within(place, steps):
                    found.append((i, code, place))
        return found


@pytest.mark.sparse(3)
@pytest.mark.parametrize("name", BOXES)
def test_images_are_those_in_the_halo(adapter, name):
    given = Given(adapter, name, 60, stepped=True)
    images, expected = given.images, given.expected()
    owners, codes = images.ghosts.rows.get(), images.ghosts.codes.get()
    assert images.count == 60 + len(expected)
    assert [(i, c) for i, c, _ in expected] == list(zip(owners, codes, strict=True))[: len(expected)]
    points = images.points.get()[: images.count]
    assert np.array_equal(points, np.concatenate([given.points, [p for *_, p in expected]]))
    # Extremes cover the blocks that exist.
    extremes = given.halo.extremes.get()
    used = [given.wide_of(a, end) for a in range(given.dim) for end in (0, 1)]
    walls = np.repeat(given.periods == 0, 2)
    widest = [0 if wall else wide.max() for wall, wide in zip(walls, used, strict=True)]
    assert np.array_equal(extremes[: given.dim].view(np.float32), np.maximum(widest[::2], widest[1::2]))
    least = [0 if wall else bits(WHOLE) - bits(wide.min()) for wall, wide in zip(walls, used, strict=True)]
    assert np.array_equal(extremes[4 : 4 + 2 * given.dim], least)
    firsts = np.searchsorted([i for i, *_ in expected], np.arange(61))
    assert np.array_equal(images.ghosts.firsts.get(), firsts)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", BOXES)
def test_unfolded_rows_name_the_nearest_images(adapter, name):
    """A neighbor without an image becomes -1; the former code of an image does not matter."""
    given = Given(adapter, name, 60)
    t = Tessellator(given.stages, given.box).tessellate(given.x, 60, exact=True)
    given.extend()
    rows = given.ghost_images.unfold(given.images, t)
    places = {key[:2]: 60 + g for g, key in enumerate(given.expected())}
    starts, neighbors, x = t.starts.get(), t.neighbors.get(), given.points
    found, absent, across = rows.neighbors.get(), 0, 0
    for i in range(60):
        for k in range(starts[i], starts[i + 1]):
            j, label = neighbors[k], -1
            if j >= 0:
                steps = np.where(abs(x[j] - x[i]) > given.periods / 2, -np.sign(x[j] - x[i]), 0)
                steps[given.periods == 0] = 0
                code = sum(int(s + 1) * 3**a for a, s in enumerate(steps))
                label = places.get((j, code), -1) if steps.any() else j
                absent += label < 0
                across += label >= 60
            assert found[k] == label
    assert absent > 3
    assert across > 3


class Folding:
    """A diagram of generators and images with faces missing on one side, and its folding in NumPy."""

    def __init__(self, adapter, name, n):
        self.given = given = Given(adapter, name, n)
        given.halo.required.fill(WHOLE)
        given.extend()
        self.images = images = given.images
        binned = given.stages.bins.build(images.box, images.points, images.count)
        self.t = given.stages.cells.tessellate(images, binned, exact=False, rows=n)
        self.n, self.starts = n, self.t.starts.get()
        self.m = int(self.starts[n])
        self.neighbors, self.measures = self.t.neighbors.get(), self.t.face_measures.get()
        self.volumes = self.t.volumes.get()
        self.centroids = self.t.face_centroids.get()
        self.x = images.points.get()
        self.owners, self.codes = images.ghosts.rows.get(), images.ghosts.codes.get()
        self.rows = {
            (j, c): n + g for g, (j, c) in enumerate(zip(self.owners, self.codes, strict=True)) if g < images.count - n
        }

    def face(self, k):
        """Return the generator of face k, its neighbor, and the code of the neighbor's image."""
        i, label = int(np.searchsorted(self.starts, k, side="right")) - 1, self.neighbors[k]
        if label < self.n:
            return i, label, 3**self.given.dim // 2
        return i, self.owners[label - self.n], self.codes[label - self.n]

    def other_side(self, k):
        """Return the index of face k in the neighbor's row."""
        i, j, code = self.face(k)
        seen = self.rows[i, 3**self.given.dim - 1 - code]
        row = self.neighbors[self.starts[j] : self.starts[j + 1]]
        return self.starts[j] + np.flatnonzero(row == seen)[0]

    def length(self, k):
        i, _, _ = self.face(k)
        return np.sqrt(((self.x[self.neighbors[k]] - self.x[i]) ** 2).sum())

    def fold(self, neighbors, measures, volumes, share, nearest):
        upload, t, face = self.given.engine.upload, self.t, self.given.engine.face
        changed = replace(
            t, neighbors=upload(neighbors, np.int32), face_measures=upload(measures, face), volumes=upload(volumes)
        )
        ghost_images = self.given.ghost_images
        ghost_images._report.set(np.array([0, 0, 2**31 - 1], np.int32))  # of the images, of which there is one diagram
        return ghost_images.fold(self.images, self.given.halo, changed, self.given.x, share, nearest)

    def far(self, neighbors):
        """Return the generators with a neighbor that is not the nearest image."""
        found = set()
        for k in np.flatnonzero(neighbors[: self.m] >= 0):
            i, *_ = self.face(k)
            periods = self.given.periods
            apart = abs(self.x[neighbors[k]] - self.x[i])
            if ((periods > 0) & (apart > periods / 2)).any():
                found.add(i)
        return found


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", BOXES)
def test_faces_that_are_missing_on_one_side(adapter, name):
    """Such faces are dropped if they are below round-off and cut at most a share off either cell."""
    folding, rng = Folding(adapter, name, 60), np.random.default_rng(2302)
    n, m, dim, eps = 60, folding.m, folding.given.dim, np.finfo(adapter.dtype).eps
    across = np.flatnonzero(folding.neighbors[:m] >= n)
    dropped = 0
    for trial in range(24):
        k = int(rng.choice(across))
        i, j, _ = folding.face(k)
        neighbors, measures = folding.neighbors.copy(), folding.measures.copy()
        neighbors[folding.other_side(k)] = -1
        length = folding.length(k)
        most = 2048 * eps * (1 if dim == 2 else length)
        measures[k] = most * (0.7 if trial % 4 else 1.4)
        cone = measures[k] * length / (2 * dim)
        volumes = folding.volumes.copy()
        volumes[i], volumes[j] = rng.permutation([1.0, 2.0])
        share = cone * (1.2, 0.7, 0.4)[trial % 3]  # of the lesser or of both, no more; or more than of either
        lesser = min(volumes[i], volumes[j])
        tiny = measures[k] < most and cone <= share * lesser
        nearest = trial % 2 == 0
        far = folding.far(neighbors) if nearest else set()
        folded, _, flags, generator = folding.fold(neighbors, measures, volumes, share, nearest)
        dropped += tiny
        assert flags == (0 if tiny else COLLAPSED) + (FAR if far else 0)
        assert generator == min(far | {i})
        if not tiny:
            assert folded.folded.places is None
            continue
        kept = np.delete(np.arange(m), k)
        t, made = folded, folded.folded
        assert np.array_equal(made.places.get(), kept)
        expected = [folding.face(q)[1:] for q in kept]
        lost = neighbors[kept] == -1
        labels = np.where(lost, -1, [j for j, _ in expected])
        codes = np.where(lost, 3**dim // 2, [c for _, c in expected])
        assert np.array_equal(t.neighbors.get(), labels)
        assert np.array_equal(made.codes.get(), codes)
        assert np.array_equal(t.face_measures.get(), measures[kept])
        assert np.array_equal(t.face_centroids.get(), folding.centroids[kept])
        assert np.array_equal(t.starts.get(), np.searchsorted(kept, folding.starts[: n + 1]))
    assert 6 <= dropped <= 18


@pytest.mark.sparse(3)
@pytest.mark.parametrize(("name", "n"), [("torus", 6), ("channel", 5), ("cube", 12), ("torus", 90)])
def test_neighbors_that_are_not_the_nearest_images(adapter, name, n):
    """The rows are complete, and the first generator with such a neighbor is reported."""
    folding = Folding(adapter, name, n)
    given = folding.neighbors, folding.measures, folding.volumes, 0.5
    far = folding.far(folding.neighbors)
    assert bool(far) == (n < 90)
    for nearest in (False, True):
        t, enough, flags, generator = folding.fold(*given, nearest)
        assert enough
        assert flags == (FAR if nearest and far else 0)
        assert generator == (min(far) if nearest and far else 2**31 - 1)
        assert t.folded.places is None
        m = folding.m
        expected = [folding.face(k)[1:] for k in range(m)]
        assert list(zip(t.neighbors.get()[:m], t.folded.codes.get()[:m], strict=True)) == expected
        assert np.array_equal(t.starts.get(), folding.starts[: n + 1])
