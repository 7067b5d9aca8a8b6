"""Incremental updates in 3D, of boxes with walls and of folded diagrams: comparison with diagrams made anew."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.descent.surface_descent import SurfaceDescent
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.tessellation.device_diagram import read_report
from clvoro.tessellation.part import Part
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch
from tests.reference.diagrams3d import lattice

BOX = clvoro.Box((0, 0, 0), (1, 1, 0.75))
UNIT = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)
CHANNEL = clvoro.Box((3, -2, 0), (5, -1, 1), periodic=(True, False, True))
N = 900
real = pytest.mark.parametrize("real", ["float64", "float32"])


def point_sets():
    rng = np.random.default_rng(52817)
    random = BOX.extent * rng.random((N, 3))
    on_walls = random[:200].copy()
    on_walls[:, 2] = np.where(on_walls[:, 2] < 0.4, 0, 0.75)
    bcc = BOX.extent * lattice("bcc", 7)
    return {
        "random": random,
        "graded": BOX.extent * rng.random((N, 3)) ** 2,
        "clusters": np.concatenate([random[:400], 0.3 + 0.02 * random[400:]]),
        "cubic": BOX.extent * lattice("cubic", 9),
        "bcc": bcc,
        "nearly bcc": bcc + 1e-3 * rng.standard_normal(bcc.shape),
        "on walls": np.concatenate([on_walls, random[200:600]]),
        "five": random[:5],
        "one": random[:1],
    }


POINTS = point_sets()


class Carried:
    """A diagram that is updated, and the same diagram made anew."""

    def __init__(self, ctx, points, box=BOX, real="float64"):
        made = patch.make_engine(ctx, real)
        self.stages, anew = (Stages(Engine(ctx, made.queue, 3, made.real, box.traits(made.real))) for _ in range(2))
        self.box, self.n, self.engine = box, len(points), self.stages.engine
        self.carrier, self.fresh = (Tessellator(stages, box) for stages in (self.stages, anew))
        self.t = self.carrier.tessellate(self.place(points), self.n)

    def place(self, points):
        held = np.where(self.box.periodic, points, np.clip(points, self.box.lower, self.box.upper))
        return self.engine.upload(self.box.place(held, self.engine.real))

    def update(self, x, previous):
        """Return `previous` updated to `x`, on the device; None if that fails."""
        whole = Part.alone(x, self.box)
        return self.carrier.steps.update(x, self.n, previous, lambda: self.carrier._sorted(whole), read_report)

    def move(self, points):
        """Update the diagram to `points`, and compare it with one made anew; return whether it has been updated."""
        x = self.place(points)
        t = self.update(x, self.t)
        self.t = self.carrier.tessellate(x, self.n, self.t) if t is None else t
        self.compare(x)
        return t is not None

    def compare(self, x):
        ours, theirs = rows_of(self.t), rows_of(self.fresh.tessellate(x, self.n))
        whole = self.box.measure / self.box.frame[1] ** 3
        double = self.engine.real == np.float64
        share, mean = 1e-9 if double else 2e-3, whole / self.n
        if double:
            assert np.array_equal(ours["faces"], theirs["faces"])
            for name, most in (("areas", mean ** (2 / 3)), ("centroids", 1)):
                assert np.abs(ours[name] - theirs[name]).max() <= share * most
        else:  # round-off may decide about small faces
            assert len(np.setxor1d(ours["faces"], theirs["faces"])) <= 0.002 * len(ours["faces"]) + 4
        assert abs(ours["volumes"].sum(dtype=float) - whole) <= whole * share / 100
        for name, power in (("volumes", 1), ("offsets", 1 / 3), ("covariances", 2 / 3)):
            largest = np.abs(theirs[name]).max()
            assert np.abs(ours[name] - theirs[name]).max() <= share * max(mean**power, largest)
        i, j = np.divmod(ours["faces"], self.n + 8)
        there = set(zip(i[j >= 6].tolist(), (j[j >= 6] - 6).tolist(), strict=True))
        assert there == {(b, a) for a, b in there}

    def relaxed(self, points, steps=5):
        """Move all generators to their centroids, several times; return where they are."""
        for _ in range(steps):
            points = points + self.box.frame[1] * self.t.offsets.get()[: self.n]
            self.move(points)
        return points

    def kept_vertices(self):
        """Return a cell and three neighbors for each vertex that the update keeps."""
        starts, neighbors = self.t.starts.get(), self.t.neighbors.get()
        triples = self.t.vertices[0].get().view(np.uint8).reshape(-1, 4)
        for i, (a, b) in enumerate(pairwise(starts)):
            if triples[2 * a, 3]:
                for at in triples[2 * a : 2 * a + 2 * (b - a) - 4, :3]:
                    yield i, neighbors[a:b][at]


def rows_of(t):
    """Return the arrays of a diagram, faces in the order of cells and neighbors."""
    starts = t.starts.get()[: t.n + 1].astype(np.int64)
    m = starts[-1]
    faces = np.repeat(np.arange(t.n), np.diff(starts)) * (t.n + 8) + t.neighbors.get()[:m] + 6
    order = np.argsort(faces)
    cells = {name: getattr(t, name).get()[: t.n] for name in ("volumes", "offsets", "covariances")}
    return {
        "faces": faces[order],
        "areas": t.face_measures.get()[:m][order],
        "centroids": t.face_centroids.get()[:m][order],
        **cells,
    }


def some_points(box, n, seed=50103):
    return np.random.default_rng(seed).random((n, 3)) * box.extent + box.lower


def moved(points, box, by, rng):
    """Move every generator by up to `by` spacings, within walls."""
    step = by * (box.measure / len(points)) ** (1 / 3) * rng.uniform(-1, 1, points.shape)
    return np.where(box.periodic, points + step, np.clip(points + step, box.lower, box.upper))


@pytest.mark.sparse(6)
@real
@pytest.mark.parametrize("name", POINTS)
def test_updated_diagrams_equal_new_ones(ctx, name, real):
    points = POINTS[name]
    carried, rng = Carried(ctx, points, real=real), np.random.default_rng(7)
    for share in (0, 1e-3, 0.03, 0.03, 0.3, 1e-6):
        points = moved(points, BOX, share, rng)
        carried.move(points)


@pytest.mark.sparse(3)
@real
@pytest.mark.parametrize("box", [BOX, UNIT, CHANNEL], ids=["walls", "unit", "channel"])
def test_small_moves_of_a_relaxed_set_are_updated(ctx, box, real):
    points, rng = some_points(box, N), np.random.default_rng(50104)
    carried = Carried(ctx, points, box, real)
    points = carried.relaxed(points)
    for share in (0, 1e-3, 0.02, 0.02, 0.05):
        points = moved(points, box, share, rng)
        assert carried.move(points) or share > 0.02


@pytest.mark.slow
@real
def test_kept_vertices_have_no_nearer_generator(ctx, real):
    """The certificate, by brute force: the ball around each vertex through its generators is empty."""
    carried, rng = Carried(ctx, POINTS["random"], real=real), np.random.default_rng(11)
    points = carried.relaxed(POINTS["random"], 3)
    assert carried.move(moved(points, BOX, 0.02, rng))
    x = carried.t.points.get()[:N].astype(float)
    walls = np.repeat(np.eye(3), 2, axis=0), np.column_stack([np.zeros(3), BOX.upper]).ravel()
    vertices = 0
    for i, labels in carried.kept_vertices():
        rows = [
            (x[j] - x[i], (x[j] @ x[j] - x[i] @ x[i]) / 2) if j >= 0 else (walls[0][-1 - j], walls[1][-1 - j])
            for j in labels
        ]
        y = np.linalg.solve(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))
        distances = np.linalg.norm(x - y, axis=1)
        noise = 1e-9 if real == "float64" else 1e-4
        assert distances.min() >= distances[i] - noise
        assert ((y >= -noise) & (y <= np.array(BOX.upper) + noise)).all()
        vertices += 1
    assert vertices > 20 * N


@pytest.mark.sparse(1)
@real
def test_large_moves_of_few_generators(ctx, real):
    """One generator jumps; others gain a wall; two coincide, which is left to a new diagram."""
    carried = Carried(ctx, POINTS["random"], real=real)
    points = carried.relaxed(POINTS["random"], 3)
    points[17] = [0.81, 0.13, 0.4]
    carried.move(points)
    for _ in range(5):
        points = points * [1, 1, 0.97]
        carried.move(points)
    points[:, 2] = np.minimum(points[:, 2] * 1.1, 0.75)
    carried.move(points)
    points[3] = points[4]
    assert carried.update(carried.place(points), carried.t) is None


def test_generators_that_cross_the_seam_keep_their_cells(ctx):
    points = some_points(UNIT, N)
    carried = Carried(ctx, points, UNIT)
    points = carried.relaxed(points)
    before = rows_of(carried.t)
    for _ in range(3):
        points = points + np.array([0.3, -0.4, 0.45])
        assert carried.move(points)
    after = rows_of(carried.t)
    assert np.array_equal(before["faces"], after["faces"])
    assert np.abs(before["volumes"] - after["volumes"]).max() < 1e-9 / N


def test_few_cells_in_a_periodic_box_are_made_anew(ctx):
    """Vertices farther than a quarter of a period from their generators."""
    points = (np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / 4
    points += 0.02 * np.random.default_rng(5).standard_normal(points.shape)
    carried = Carried(ctx, points, UNIT)
    assert carried.move(points + 1e-3)
    jumped = points.copy()
    jumped[::2, 0] += 0.2
    carried.move(jumped)


def test_cells_that_cover_the_box_twice(ctx, monkeypatch):
    """Rows of two sheets that do not know each other are consistent."""
    half = N // 2
    sheets = [some_points(UNIT, half, seed) for seed in (1, 2)]
    rows = [Carried(ctx, points, UNIT).t for points in sheets]
    carried = Carried(ctx, np.concatenate(sheets), UNIT)
    counts = np.concatenate([np.diff(t.starts.get()[: half + 1]) for t in rows])
    names = [t.neighbors.get()[: t.starts.get()[half]] for t in rows]
    upload = carried.engine.upload
    twice = replace(
        carried.t,
        starts=upload(np.append(0, np.cumsum(counts)), np.int32),
        neighbors=upload(np.concatenate([names[0], names[1] + half]), np.int32),
        vertices=(),
    )
    updates, volumes = carried.stages.update, []
    update = updates.update

    def updated(*args, **options):
        t = update(*args, **options)
        volumes.append(t.volumes.get()[:N].sum())
        return t

    monkeypatch.setattr(updates, "update", updated)
    assert carried.update(carried.t.points, twice) is None
    assert volumes == [pytest.approx(2, rel=1e-9)]


def bits_of(t):
    """Return the bytes of all arrays of a diagram."""
    m = t.starts.get()[-1]
    cells = [getattr(t, name).get()[: t.n].tobytes() for name in ("volumes", "offsets", "covariances")]
    return cells + [getattr(t, name).get()[:m].tobytes() for name in ("neighbors", "face_measures", "face_centroids")]


@pytest.mark.sparse(1)
@real
def test_same_bits_again(ctx, real):
    found = []
    for _ in range(2):
        carried, rng = Carried(ctx, POINTS["random"], real=real), np.random.default_rng(13)
        points = carried.relaxed(POINTS["random"], 4)
        for _ in range(3):
            points = moved(points, BOX, 0.02, rng)
            assert carried.move(points)
        found.append(bits_of(carried.t))
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
        carried = Carried(ctx, POINTS["random"])
        carried.relaxed(POINTS["random"], 4)
        engine = carried.engine
        quality, h = engine.upload(np.full(N, 0.7)), engine.upload(np.full(N, 0.1))
        way = engine.zeros((N, 3))
        SurfaceDescent(engine).descend(carried.t, h, quality, way, bad_cell_weight=5.0, rate=0.05)
        assert np.abs(way.get()).max() > 1e-4
        found.append([*bits_of(carried.t), way.get().tobytes()])
    assert found[0] == found[1]
