"""Parts with ghosts: two halves of a box with each other's generators as halos; a periodic box that is not folded."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from clvoro.adaptation.stages import Stages
from clvoro.geometry.box import Box
from clvoro.solvers.conjugate_gradient import ConjugateGradient
from clvoro.solvers.linear_system import Limits, Operator
from clvoro.solvers.volume_projection import Penalty, Targets
from clvoro.tessellation.part import Home, Part
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch

N = {2: 500, 3: 900}
SPACINGS = 5
"""Depth of a halo, in mean spacings: deeper than any cell of these sets."""
REALS = [pytest.param(np.dtype(name), id=name) for name in ("float64", "float32")]


class Halves:
    """A box, its generators, and the two parts of those left and right of its middle, with halos of some depth."""

    def __init__(self, ctx, dim, real, spacings=SPACINGS):
        self.box = Box((0,) * dim, (2, 0.75, 0.9)[:dim])
        self.engine = patch.make_engine(ctx, real, dim, box=self.box)
        n = N[dim]
        x = np.random.default_rng(60101).random((n, dim)) * self.box.extent
        right = x[:, 0] > 1
        self.n_left = int(np.count_nonzero(~right))
        x = np.concatenate([x[~right], x[right]])
        spacing = (self.box.measure / n) ** (1 / dim)
        rows, near = np.arange(n), np.abs(x[:, 0] - 1) < spacings * spacing
        left = rows < self.n_left
        # Global numbers of the rows of each part.
        self.rows = [np.concatenate([rows[own], rows[~own & near]]) for own in (left, ~left)]
        self.n_own = [self.n_left, n - self.n_left]
        self.places = self.box.place(x, real)
        self.whole = self.tessellate(Part(n, n, self.upload(self.places), self.box))
        self.parts = [self.part(number) for number in (0, 1)]

    def upload(self, values, dtype=None):
        return self.engine.upload(values, dtype)

    def part(self, number):
        rows, n_own, first = self.rows[number], self.n_own[number], (0, self.n_left)[1 - number]
        home = Home(
            self.upload(rows[n_own:] - first, np.int32), self.upload(np.full(len(rows) - n_own, 1 - number), np.int32)
        )
        return Part(n_own, len(rows), self.upload(self.places[rows]), self.box, home)

    def tessellate(self, part):
        return Tessellator(Stages(self.engine), self.box).tessellate_part(part)

    def names(self, t, number=None):
        """Return the faces as pairs of global numbers, ordered by the device's rows."""
        found = patch.fetch(t)
        if number is None:
            return found, found.owners, found.neighbors
        rows = self.rows[number]
        across = np.where(found.neighbors >= 0, rows[np.maximum(found.neighbors, 0)], found.neighbors)
        return found, rows[found.owners], across


@pytest.fixture(params=[2, 3])
def dim(request):
    return request.param


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", REALS)
def test_diagrams_of_two_halves_are_that_of_the_whole(ctx, dim, real):
    halves = Halves(ctx, dim, real)
    whole, owners, neighbors = halves.names(halves.whole)
    noise = 1e3 * np.finfo(real).eps
    expected = set(zip(owners.tolist(), neighbors.tolist(), strict=True))
    assert len(halves.rows[0]) < len(halves.places) > len(halves.rows[1])
    found, across = set(), 0
    for number, part in enumerate(halves.parts):
        t = halves.tessellate(part)
        assert t.n == part.n_own
        assert t.rows == part.count
        mine, i, j = halves.names(t, number)
        found |= set(zip(i.tolist(), j.tolist(), strict=True))
        across += np.count_nonzero((i < halves.n_left) != (j < halves.n_left) & (j >= 0))
        rows = halves.rows[number][: t.n]
        assert np.abs(mine.volumes - whole.volumes[rows]).max() < noise * whole.volumes.max()
        assert np.abs(mine.offsets - whole.offsets[rows]).max() < noise
    if real == np.float64:
        assert found == expected
    else:
        assert len(found ^ expected) < 1e-3 * len(expected)
    assert across > 20


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_candidates_in_the_same_order_give_the_same_bits(ctx, dim, real):
    """The left half with all others as ghosts: rows have the numbers of the whole."""
    halves = Halves(ctx, dim, real, np.inf)
    t = halves.tessellate(halves.parts[0])
    mine, whole = patch.fetch(t), patch.fetch(halves.whole)
    m = whole.starts[t.n]
    for name in ("neighbors", "face_measures", "face_centroids"):
        assert np.array_equal(getattr(mine, name), getattr(whole, name)[:m]), name
    for name in ("volumes", "offsets", "covariances"):
        assert np.array_equal(getattr(mine, name)[: t.n], getattr(whole, name)[: t.n]), name


@pytest.mark.sparse(2)
@pytest.mark.parametrize("values", [np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.int32)])
@pytest.mark.parametrize("columns", [(), (3,)])
def test_ghosts_get_the_values_of_their_owners(ctx, dim, values, columns):
    halves = Halves(ctx, dim, np.dtype(np.float64))
    given = np.random.default_rng(60102).integers(1, 1 << 20, (len(halves.places), *columns)).astype(values)
    owned = [halves.upload(given[rows[:n]], values) for rows, n in zip(halves.rows, halves.n_own, strict=True)]
    for part, rows in zip(halves.parts, halves.rows, strict=True):
        filled = given[rows].copy()
        filled[part.n_own :] = 0
        device = halves.upload(filled, values)
        part.forward(halves.engine, device, owned)
        assert np.array_equal(device.get(), given[rows])
    # Ghosts without owner keep their values, and so do all if they have no home.
    part, n = halves.parts[0], halves.n_own[0]
    lonely = part.home.rows.get()
    lonely[::2] = -1
    device = halves.upload(np.zeros_like(filled[:1]).repeat(part.count, axis=0), values)
    replace(part, home=None).forward(halves.engine, device, owned)
    replace(part, home=replace(part.home, rows=halves.upload(lonely, np.int32))).forward(halves.engine, device, owned)
    assert not device.get()[: n + 1 : n].any()
    assert device.get()[n + 1 :: 2].all()
    assert not device.get()[n::2].any()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_the_laplacian_of_two_halves(ctx, dim, real):
    """Products of the matrix with values of ghosts from the other half."""
    halves = Halves(ctx, dim, real)
    poisson = Stages(halves.engine).poisson
    values = np.random.default_rng(60103).random(len(halves.places)).astype(real)

    def product(t, points, x):
        with poisson.engine.workspace.frame():
            y = poisson.engine.empty(t.n)
            poisson.apply(poisson.assemble(t.starts, t.neighbors, t.face_measures, points), x, y)
            return y.get()

    whole = product(halves.whole, halves.whole.points, halves.upload(values))
    owned = [halves.upload(values[rows[:n]]) for rows, n in zip(halves.rows, halves.n_own, strict=True)]
    for part, rows, own in zip(halves.parts, halves.rows, owned, strict=True):
        x = halves.engine.zeros(part.count)
        x[: part.n_own].set(own.get())
        part.forward(halves.engine, x, owned)
        mine = product(halves.tessellate(part), part.points, x)
        assert np.abs(mine - whole[rows[: part.n_own]]).max() < 1e4 * np.finfo(real).eps * np.abs(whole).max()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_the_poisson_equation_in_two_halves(ctx, dim, real):
    """Each half applies its rows to its own values and those that `Part.forward` brings from the other."""
    halves = Halves(ctx, dim, real)
    engine, poisson, n = halves.engine, Stages(halves.engine).poisson, len(halves.places)
    source = np.random.default_rng(60105).standard_normal(n)
    source, limits = halves.upload(source - source.mean()), Limits(1e-9 if real == np.float64 else 1e-4, 1000)
    diagrams = [halves.tessellate(part) for part in halves.parts]
    diagrams = [replace(t, **{name: getattr(t, name).copy() for name in ("starts", "neighbors")}) for t in diagrams]
    bounds = np.cumsum([0, *halves.n_own])
    with engine.workspace.frame():
        t = halves.whole
        expected = engine.zeros(n)
        matrix = poisson.assemble(t.starts, t.neighbors, t.face_measures, t.points)
        assert poisson.solve(matrix, source, expected, tolerance=limits.tolerance).converged
        matrices, inverses = [], []
        for part, t in zip(halves.parts, diagrams, strict=True):
            matrices.append(poisson.assemble(t.starts, t.neighbors, t.face_measures, part.points, part=part))
            inverses.append(poisson.inverse_diagonal(matrices[-1]).get())

        def apply(x, y):
            owned = [x[a:b].copy() for a, b in pairwise(bounds)]
            for part, rows, values, (a, b) in zip(halves.parts, matrices, owned, pairwise(bounds), strict=True):
                both, product = engine.zeros(part.count), engine.empty(b - a)
                both[: b - a] = values
                part.forward(engine, both, owned)
                poisson.apply(rows, both, product)
                y[a:b] = product

        found, inverse = engine.zeros(n), engine.upload(np.concatenate(inverses))
        given = Operator(apply, singular=True), source, found, inverse, limits
        assert ConjugateGradient(engine).solve(*given, from_zero=True).converged
        one, other = found.get(), expected.get()
        assert np.abs(one - other).max() < 1e3 * limits.tolerance * np.abs(other).max()


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
        source, potentials = rng.standard_normal(n) / n, []
        for part, made, poisson in ((alone.part, alone, unfolded.poisson), (None, t, stages.poisson)):
            phi = poisson.engine.zeros(n)
            matrix = poisson.assemble(made.starts, made.neighbors, made.face_measures, made.points, part=part)
            tolerance = 1e-9 if real == np.float64 else 1e-4
            for kind in ("jacobi", "multigrid"):
                given = {"tolerance": tolerance, "preconditioner": kind, "from_zero": True}
                assert poisson.solve(matrix, poisson.engine.upload(source), phi, **given).converged
                potentials.append(phi.get())
        for potential in potentials[1:]:
            assert np.abs(potentials[0] - potential).max() < 1e3 * tolerance * np.abs(potential).max()
