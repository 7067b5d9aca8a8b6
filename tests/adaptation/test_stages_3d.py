"""The stages of a step in three dimensions, on diagrams of the device, against NumPy and Qhull."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from clvoro.adaptation.density import Density
from clvoro.adaptation.insertion_deletion import CellSizes, Change, Generators, InsertionDeletion
from clvoro.adaptation.metric import Metric
from clvoro.adaptation.motion import Motion
from clvoro.adaptation.refinement import Refinement
from clvoro.adaptation.tuning import MAX_CHANGE
from clvoro.geometry.box import Box
from clvoro.solvers.linear_system import Limits
from clvoro.solvers.poisson import Poisson
from clvoro.solvers.volume_projection import Penalty, Targets, VolumeProjection
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.polyhedra import Polyhedra
from tests.reference import diagrams3d as reference3d
from tests.reference import patch

BOX = Box((0, 0, 0), (1, 0.75, 0.9))
"""Its frame is the unit cube's: normalized coordinates are physical ones."""
N = 150
SLOPE = np.array([0.9, -1.4, 0.6])


@pytest.fixture(scope="module", params=["float64", "float32"])
def engine(ctx, request):
    return patch.make_engine(ctx, request.param, dim=3)


@pytest.fixture(scope="module")
def double(ctx):
    return patch.make_engine(ctx, dim=3)


def tessellate(engine, points, box=BOX):
    on_device = engine.upload(points)
    binned = Bins(engine).build(box, on_device, len(points))
    return Polyhedra(engine).tessellate(box, on_device, len(points), binned)


def random_points(n, seed, real="float64"):
    return patch.random_points(n, seed, BOX).astype(real).astype(float)


def relaxed_points(n, seed, steps=3):
    points = random_points(n, seed)
    for _ in range(steps):
        points = np.array([c.centroid for c in cells_of(points)])
    return points


def cells_of(points):
    return reference3d.box_voronoi(BOX.lower, BOX.upper, points)


def at_walls(host):
    wall = np.zeros(host.n, bool)
    wall[host.owners[host.neighbors < 0]] = True
    return wall


# Metric.


@pytest.mark.sparse(1)
def test_metric(engine):
    points = random_points(N, 618, engine.real)
    rng = np.random.default_rng(55)
    h = np.exp(rng.uniform(np.log(0.03), np.log(0.6), N)).astype(engine.real).astype(float)
    out = [engine.empty(N) for _ in range(4)]
    Metric(engine).evaluate(tessellate(engine, points), engine.upload(h), *out)
    error, quality, energy, reach = (a.get() for a in out)
    # Faces and volumes of cells of 0.15 carry eps of the unit box over those lengths.
    rel = 4000 * float(np.finfo(engine.real).eps)
    for i, cell in enumerate(cells_of(points)):
        length = np.cbrt(cell.volume)
        smaller = min(length, h[i])
        assert error[i] == pytest.approx((length - h[i]) / smaller, abs=rel * length / smaller)
        assert reach[i] == pytest.approx(smaller, rel=rel)
        surface = sum(cell.faces.values())
        assert quality[i] == pytest.approx(36 * np.pi * cell.volume**2 / surface**3, rel=rel)
        moment = np.trace(cell.covariance) + ((cell.centroid - points[i]) ** 2).sum()
        assert energy[i] == pytest.approx(cell.volume * moment, rel=rel)


# Density.


def test_density(engine):
    points = random_points(N, 111, engine.real)
    t, density = tessellate(engine, points), Density(engine)
    h = 0.1 * np.exp(points @ SLOPE)
    w = density.lloyd_weights(t, engine.upload(h))
    volumes, eps = t.volumes.get().astype(float), float(np.finfo(engine.real).eps)
    assert w.density.get() == pytest.approx(h**-3, rel=64 * eps)
    assert w.weight.get() == pytest.approx(volumes / h**3, rel=64 * eps)
    excess = np.log(volumes / h**3)
    assert w.log_ratio.get() == pytest.approx(excess, abs=64 * eps)
    # log h linear is fitted exactly; it rounds by a few eps over distances of 0.03 and more.
    assert np.abs(w.gradient.get() - SLOPE).max() < 8000 * eps
    weighed, weights = density.sum_log_ratio(w).get().reshape(2, -1).sum(axis=1)
    mean = np.average(excess, weights=volumes / h**3)
    assert weighed / weights == pytest.approx(mean, abs=256 * eps)


def weighted_centroid(samples, slope):
    """Centroid of a cell weighted by exp(-5 slope . y), by points spread over it."""
    weight = np.exp(-5 * (samples - samples.mean(axis=0)) @ slope)
    return (weight[:, None] * samples).sum(axis=0) / weight.sum()


def test_weighted_centroids(double):
    """Of h^-(d + 2), h exponential, right to first order in its change across the cell."""
    points = relaxed_points(40, 113)
    t = tessellate(double, points)
    samples = patch.random_points(200_000, 5, BOX)
    owner = KDTree(points).query(samples)[1]
    slope = 0.2 * SLOPE
    w = Density(double).lloyd_weights(t, double.upload(0.1 * np.exp(points @ slope)))
    lloyd, offsets = w.lloyd.get(), t.offsets.get()
    for i in range(40):
        own = samples[owner == i]
        # The difference of both centroids: the noise of the sampling cancels.
        shift = weighted_centroid(own, slope) - own.mean(axis=0)
        assert np.linalg.norm(lloyd[i] - offsets[i] - shift) < 0.1 * np.linalg.norm(shift)


# Motion and the Poisson equation.


def test_gradient_of_a_linear_potential(engine):
    points = random_points(600, 904, engine.real)
    t = tessellate(engine, points)
    host, u = patch.fetch(t), engine.empty((600, 3))
    psi = engine.upload(5 + points @ SLOPE)
    Motion(engine).compute_potential_gradient(t, psi, u)
    closed = ~at_walls(host)
    assert 100 < closed.sum() < 600
    # Differences of psi (about 5) over distances that go down to 0.01.
    assert np.abs(u.get()[closed] - SLOPE).max() < 8000 * np.finfo(engine.real).eps
    assert np.abs(u.get()[~closed] - SLOPE).max() > 0.1, "a wall lets no flux through"


def test_potential_solves_the_equation(double):
    """Fluxes through faces add up to the source's integral, cell by cell."""
    points = random_points(N, 91)
    t = tessellate(double, points)
    host, poisson = patch.fetch(t), Poisson(double)
    r = np.random.default_rng(6).normal(size=N)
    source, potential = double.empty(N), double.zeros(N)
    laplacian = poisson.assemble(t.starts, t.neighbors, t.face_measures, t.points)
    poisson.subtract_mean_source(double.upload(r), t.volumes, source)
    poisson.solve(laplacian, source, potential, tolerance=1e-10)
    phi, inner = potential.get(), host.neighbors >= 0
    i, j = host.owners[inner], host.neighbors[inner]
    flux = host.face_measures[inner] * (phi[i] - phi[j])
    flux /= np.linalg.norm(points[i] - points[j], axis=1)
    net = np.bincount(i, flux, minlength=N)
    wanted = host.volumes * (r - np.average(r, weights=host.volumes))
    off = min(np.abs(net - wanted).max(), np.abs(net + wanted).max())  # whatever the convention for the sign
    assert off < 1e-8 * np.abs(wanted).max()


# VolumeProjection.


def excess_of(points):
    """r = log(V / h^3), V by Qhull, h = 0.1 exp(SLOPE . x)."""
    volumes = np.array([c.volume for c in cells_of(points)])
    return np.log(volumes) - 3 * (np.log(0.1) + points @ SLOPE)


def test_projection_uses_the_derivative_of_the_volumes(double):
    """With a tiny penalty one step removes small log ratios up to second order."""
    points = relaxed_points(60, 606)
    h, left = 0.1 * np.exp(points @ SLOPE), []
    base = excess_of(points)
    t = tessellate(double, points)
    for size in (0.02, 0.01):
        # Required changes of the volumes. Their mean needs motion along grad h.
        ask = size * np.random.default_rng(3).normal(size=60)
        u = double.empty((60, 3))
        solution = VolumeProjection(double).project(
            t,
            Targets(*map(double.upload, (h, np.tile(SLOPE, (60, 1)), ask, np.ones(60)))),
            double.zeros((60, 3)),
            u,
            Penalty(1e-9),
            Limits(1e-11, 2000),
        )
        assert solution.residual < 1e-9
        change = excess_of(points + u.get()) - base
        left.append(np.abs(change + ask).max())
        assert left[-1] < 0.2 * np.abs(ask).max()
    assert left[1] < 0.3 * left[0], "a quarter at half the size"


# Refinement.


@pytest.mark.sparse(3)
@pytest.mark.parametrize("n", [1, 2, 3, 200])
def test_children(engine, n):
    points = random_points(n, n + 41, engine.real)
    h = np.full(n, np.cbrt(0.675 / n) / 2)
    t, refinement = tessellate(engine, points), Refinement(engine)
    finer = refinement.refine(BOX, t, engine.upload(h)).get()
    assert refinement.count(t) == len(finer)
    assert np.array_equal(finer[:n], points.astype(engine.real)), "the parents come first"
    expected = patch.children(patch.fetch(t), BOX, h)
    assert len(finer) == n + len(expected)
    new = finer[n:]
    off = np.abs(new[np.lexsort(new.T)] - expected[np.lexsort(expected.T)])
    assert off.max() <= 4 * np.finfo(engine.real).eps
    assert BOX.contains(finer).all()


def test_refined_body_centered_lattice(double):
    """Middles of its edges make the lattice of half the spacing, all cells truncated octahedra."""
    a, box = 1 / 6, Box((0, 0, 0), (1, 1, 1))
    line = np.arange(6)
    corner = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    points = np.concatenate([corner + 0.25, corner + 0.75]) * a
    t = tessellate(double, points, box)
    size = double.upload(np.full(len(points), a * 2 ** (-4 / 3)))
    finer = Refinement(double).refine(box, t, size).get()
    host = patch.fetch(tessellate(double, finer, box))
    inside = ((finer > 1.3 * a) & (finer < 1 - 1.3 * a)).all(axis=1)
    assert inside.sum() > 500
    assert (np.diff(host.starts)[inside] == 14).all()
    assert host.volumes[inside] == pytest.approx(np.full(inside.sum(), (a / 2) ** 3 / 2))
    surface = np.bincount(host.owners, host.face_measures)[inside]
    quotient = 36 * np.pi * host.volumes[inside] ** 2 / surface**3
    assert quotient == pytest.approx(np.full(inside.sum(), 0.753367), abs=1e-6)


# Generators.


class Sweep:
    """One call of `insert_delete` that corrects the number only."""

    def __init__(self, engine, points, h, total):
        n = len(points)
        self.t = t = tessellate(engine, points)
        self.host = patch.fetch(t)
        self.log_ratio = np.log(self.host.volumes / h**3)
        labels = np.random.default_rng(8).permutation(3 * n)[:n]
        zeros = engine.zeros(n)
        self.new = InsertionDeletion(engine).insert_delete(
            BOX,
            t,
            CellSizes(*map(engine.upload, (np.full(n, h), np.full(n, h), self.log_ratio))),
            Generators(
                t.points, engine.upload(labels, np.int32), engine.zeros((n, 3)), engine.zeros(n, np.uint64), zeros
            ),
            5 * n,
            Change(total, climb=False),
        )
        if self.new is None:
            return
        self.points, found = self.new.generators.points.get(), self.new.generators.labels.get()
        assert len(found) == n + self.new.inserted - self.new.deleted
        assert len(np.unique(found)) == len(found)
        assert BOX.contains(self.points).all()
        old = np.isin(found, labels)
        assert np.array_equal(np.sort(found[~old]), 5 * n + np.arange(self.new.inserted))
        row = {label: i for i, label in enumerate(labels)}
        rows = np.array([row[label] for label in found[old]])
        self.deleted = np.setdiff1d(np.arange(n), rows)
        moved = (self.points[old] != points.astype(engine.real)[rows]).any(axis=1)
        self.moved, self.moved_to = rows[moved], self.points[old][moved]
        self.born = self.points[~old]


@pytest.mark.sparse(4)
@pytest.mark.parametrize("total", [-7.0, -1.0, 1.0, 7.0, 500.0, -500.0])
def test_number_is_corrected_exactly(engine, total):
    n = 600
    points = random_points(n, 61, engine.real)
    sweep = Sweep(engine, points, np.cbrt(0.675 / n), total)
    change = sweep.new.inserted - sweep.new.deleted
    assert min(sweep.new.inserted, sweep.new.deleted) == 0
    assert change * total > 0
    most = int(MAX_CHANGE * n)
    assert change == total if abs(total) < 3 else abs(change) <= min(abs(total), most)
    sites = sweep.moved if total > 0 else sweep.deleted
    assert len(sites) == abs(change)
    # Among the largest, or smallest, over h; a cell near a more extreme one is left for later.
    rank = np.argsort(np.argsort(-np.sign(total) * sweep.log_ratio))
    assert np.median(rank[sites]) < n / 10


def test_cells_are_split_along_their_longest_axis(double):
    points = random_points(300, 67)
    sweep = Sweep(double, points, 0.13, 4.0)
    assert len(sweep.moved) == sweep.new.inserted >= 2
    for i, there in zip(sweep.moved, sweep.moved_to, strict=True):
        xx, xy, xz, yy, yz, zz = sweep.host.covariances[i]
        moments = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        centroid = points[i] + sweep.host.offsets[i]
        way = there - centroid
        quarter = np.cbrt(sweep.host.volumes[i]) / 4
        assert np.linalg.norm(way) == pytest.approx(quarter, rel=1e-6)
        values, axes = np.linalg.eigh(moments)
        # Twelve powers of the moments: the rest of the others has shrunk by their ratio each time.
        along = abs(way @ axes[:, 2]) / quarter
        assert along > 1 - 4 * (values[1] / values[2]) ** 12
        assert np.abs(sweep.born - (2 * centroid - there)).max(axis=1).min() < 1e-12


@pytest.mark.sparse(4)
@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("total", [-50.0, 50.0])
def test_few_cells(engine, n, total):
    """The last generator is not deleted."""
    sweep = Sweep(engine, random_points(n, n, engine.real), 0.6, total)
    if n == 1 and total < 0:
        assert sweep.new is None
    else:
        assert (sweep.new.inserted - sweep.new.deleted) * total > 0
        assert len(sweep.points) >= 1
