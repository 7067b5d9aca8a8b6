"""The incremental update in 3D: comparison with diagrams made anew, and its vertices with all generators."""

from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.descent.surface_descent import SurfaceDescent
from clvoro.opencl.engine import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.polyhedra_update import PolyhedraUpdate
from tests.reference import patch

BOX = clvoro.Box((0, 0, 0), (1, 1, 0.75))
UPPER = np.array([1, 1, 0.75])
N = 900


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    adapter = clvoro.Adapter(ctx, dtype=request.param)
    return Engine(adapter.ctx, adapter.queue, 3, np.dtype(request.param))


def lattice(offsets, k):
    ijk = np.stack(np.meshgrid(*[np.arange(k)] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    return UPPER * (ijk + np.array(offsets) + 0.25).reshape(-1, 3) / k


def point_sets():
    rng = np.random.default_rng(52817)
    random = UPPER * rng.random((N, 3))
    on_walls = random[:200].copy()
    on_walls[:, 2] = np.where(on_walls[:, 2] < 0.4, 0, 0.75)
    bcc = lattice([[0, 0, 0], [0.5, 0.5, 0.5]], 7)
    return {
        "random": random,
        "graded": UPPER * rng.random((N, 3)) ** 2,
        "clusters": np.concatenate([random[:400], 0.3 + 0.02 * random[400:]]),
        "cubic": lattice([[0, 0, 0]], 9),
        "bcc": bcc,
        "nearly bcc": bcc + 1e-3 * rng.standard_normal(bcc.shape),
        "on walls": np.concatenate([on_walls, random[200:600]]),
        "five": random[:5],
        "one": random[:1],
    }


POINTS = point_sets()


class Rows:
    """Faces on the host, in the order of labels."""

    def __init__(self, t):
        starts = t.starts.get()[: t.n + 1]
        m = starts[-1]
        cell = np.repeat(np.arange(t.n), np.diff(starts))
        order = np.lexsort((t.neighbors.get()[:m], cell))
        self.starts, self.neighbors = starts, t.neighbors.get()[:m][order]
        self.areas = t.face_measures.get()[:m][order]
        self.centroids = t.face_centroids.get()[:m][order]
        self.cells = t.volumes.get()[: t.n], t.offsets.get()[: t.n], t.covariances.get()[: t.n]


class Carried:
    """A diagram that is updated, and the diagram of the same generators made anew."""

    def __init__(self, engine, points):
        self.engine, self.n = engine, len(points)
        self.cells, self.bins = Polyhedra(engine), Bins(engine)
        self.anew, self.update = Polyhedra(engine), PolyhedraUpdate(engine)
        x = self.upload(points)
        self.t = self.cells.tessellate(BOX, x, self.n, self.binned(x), exact=False)

    def upload(self, points):
        return self.engine.upload(np.clip(points, 0, UPPER))

    def binned(self, x):
        return self.bins.build(BOX, x, self.n)

    def clip_of(self, x):
        return lambda cells, cut, report, _: cells.clip_rest(cut, report, BOX, x, self.binned(x), self.t)

    def move(self, points):
        """Update the diagram to `points`; return whether that succeeded."""
        x = self.upload(points)
        t = self.update.update(self.cells, BOX, x, self.t, self.clip_of(x))
        if t is None:
            self.t = self.cells.tessellate(BOX, x, self.n, self.binned(x), exact=False)
        else:
            self.t = t
            self.compare(x)
        return t is not None

    def compare(self, x):
        """Compare the diagram with one made anew."""
        ours = Rows(self.t)
        theirs = Rows(self.anew.tessellate(BOX, x, self.n, self.binned(x), exact=False))
        double = self.engine.real == np.float64
        share = 1e-9 if double else 2e-3
        mean = 0.75 / self.n
        if double:
            assert (ours.starts == theirs.starts).all()
            assert (ours.neighbors == theirs.neighbors).all()
            assert np.abs(ours.areas - theirs.areas).max() <= share * mean ** (2 / 3)
        else:
            # Round-off may decide about small faces.
            assert abs(len(ours.neighbors) - len(theirs.neighbors)) <= 0.002 * len(ours.neighbors) + 4
        assert abs(ours.cells[0].sum(dtype=float) - 0.75) <= 0.75 * share / 100
        for power, a, b in zip((1, 1 / 3, 2 / 3), ours.cells, theirs.cells, strict=True):
            largest = np.abs(b).max()
            assert np.abs(a - b).max() <= share * max(mean**power, largest)

    def check_symmetry(self):
        r = Rows(self.t)
        cell = np.repeat(np.arange(self.n), np.diff(r.starts))
        inner = r.neighbors >= 0
        there = set(zip(cell[inner].tolist(), r.neighbors[inner].tolist(), strict=True))
        assert there == {(j, i) for i, j in there}

    def kept_vertices(self):
        """Return a cell and three neighbors for each vertex that the update keeps."""
        starts, neighbors = self.t.starts.get(), self.t.neighbors.get()
        triples = self.t.vertices[0].get().view(np.uint8).reshape(-1, 4)
        for i, (a, b) in enumerate(pairwise(starts)):
            if triples[2 * a, 3]:
                for at in triples[2 * a : 2 * a + 2 * (b - a) - 4, :3]:
                    yield i, neighbors[a:b][at]


def spacing(points):
    return (0.75 / len(points)) ** (1 / 3)


def relaxed(carried, points, steps=6):
    """Move all generators to their centroids, several times."""
    for _ in range(steps):
        points = np.clip(points + carried.t.offsets.get()[: len(points)], 1e-6, UPPER - 1e-6)
        carried.move(points)
    return points


@pytest.mark.sparse(6)
@pytest.mark.parametrize("name", POINTS)
def test_updated_diagrams_equal_new_ones(engine, name):
    points = POINTS[name]
    carried, rng, h = Carried(engine, points), np.random.default_rng(7), spacing(points)
    for share in (0, 1e-3, 0.03, 0.03, 0.3, 1e-6):
        points = np.clip(points + share * h * rng.uniform(-1, 1, points.shape), 0, UPPER)
        carried.move(points)
        carried.check_symmetry()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("share", [0, 1e-3, 0.02, 0.05])
def test_small_moves_of_a_relaxed_set_are_updated(engine, share):
    carried, rng = Carried(engine, POINTS["random"]), np.random.default_rng(9)
    points = relaxed(carried, POINTS["random"])
    for _ in range(4):
        moved = points + share * spacing(points) * rng.uniform(-1, 1, points.shape)
        assert carried.move(moved)
        carried.check_symmetry()


@pytest.mark.slow
def test_kept_vertices_have_no_nearer_generator(engine):
    """The certificate, by brute force: the ball around each vertex through its generators is empty."""
    carried, rng = Carried(engine, POINTS["random"]), np.random.default_rng(11)
    points = relaxed(carried, POINTS["random"], 3)
    assert carried.move(points + 0.02 * spacing(points) * rng.uniform(-1, 1, points.shape))
    x = carried.t.points.get()[:N].astype(float)
    walls = np.repeat(np.eye(3), 2, axis=0), np.column_stack([np.zeros(3), UPPER]).ravel()
    vertices = 0
    for i, labels in carried.kept_vertices():
        rows = [
            (x[j] - x[i], (x[j] @ x[j] - x[i] @ x[i]) / 2) if j >= 0 else (walls[0][-1 - j], walls[1][-1 - j])
            for j in labels
        ]
        y = np.linalg.solve(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))
        distances = np.linalg.norm(x - y, axis=1)
        noise = 1e-9 if engine.real == np.float64 else 1e-4
        assert distances.min() >= distances[i] - noise
        assert ((y >= -noise) & (y <= UPPER + noise)).all()
        vertices += 1
    assert vertices > 20 * N


@pytest.mark.sparse(1)
def test_one_generator_that_jumps(engine):
    carried = Carried(engine, POINTS["random"])
    points = relaxed(carried, POINTS["random"], 3)
    points[17] = [0.81, 0.13, 0.4]
    carried.move(points)
    carried.check_symmetry()


@pytest.mark.sparse(1)
def test_generators_toward_a_wall_gain_it(engine):
    carried = Carried(engine, POINTS["random"])
    points = relaxed(carried, POINTS["random"], 3)
    for _ in range(5):
        points = points * [1, 1, 0.97]
        carried.move(points)
    points[:, 2] = np.minimum(points[:, 2] * 1.1, 0.75)
    carried.move(points)
    carried.check_symmetry()


def test_coinciding_generators_are_left_to_a_new_diagram(engine):
    carried = Carried(engine, POINTS["random"])
    points = relaxed(carried, POINTS["random"], 2)
    points[3] = points[4]
    x = carried.upload(points)
    assert carried.update.update(carried.cells, BOX, x, carried.t, carried.clip_of(x)) is None


@pytest.mark.sparse(1)
def test_same_bits_again(engine):
    rng = np.random.default_rng(13)
    moves = 0.02 * spacing(POINTS["random"]) * rng.uniform(-1, 1, (3, N, 3))
    found = []
    for _ in range(2):
        carried = Carried(engine, POINTS["random"])
        points = relaxed(carried, POINTS["random"], 4)
        for move in moves:
            points = points + move
            assert carried.move(points)
        t, m = carried.t, carried.t.starts.get()[-1]
        found.append([getattr(t, name).get()[: t.n].tobytes() for name in ("volumes", "offsets")])
        found[-1].append(t.neighbors.get()[:m].tobytes())
    assert found[0] == found[1]


@pytest.mark.slow
def test_same_bits_with_four_and_eight_lanes(ctx, monkeypatch):
    """Vector units of CPUs hold four or eight numbers of double precision."""
    kernels, found = Engine.kernels, []
    for eight in (0, 1):
        monkeypatch.setattr(
            Engine,
            "kernels",
            lambda self, stage, defines=None, prelude="", eight=eight: kernels(
                self, stage, {**(defines or {}), "EIGHT_DOUBLES": eight}, prelude
            ),
        )
        engine = patch.make_engine(ctx, "float64", dim=3)
        carried = Carried(engine, POINTS["random"])
        relaxed(carried, POINTS["random"], 4)
        t = carried.t
        quality, h = engine.upload(np.full(N, 0.7)), engine.upload(np.full(N, 0.1))
        way = engine.zeros((N, 3))
        SurfaceDescent(engine).descend(t, h, quality, way, bad_cell_weight=5.0, rate=0.05)
        assert np.abs(way.get()).max() > 1e-4
        arrays = t.volumes, t.offsets, t.covariances, t.face_measures, t.face_centroids, way
        m = t.starts.get()[-1]
        found.append(
            [
                a.get()[: m if "face" in name else N].tobytes()
                for name, a in zip(("", "", "", "face", "face", ""), arrays, strict=True)
            ]
        )
    assert found[0] == found[1]
