"""Numbers of generators in parts that a neck joins, against a reference, or that fixed generators cut off."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation import tuning
from clvoro.adaptation.plan.actions import BalanceCounts, Refine, RepairCells
from clvoro.adaptation.plan.schedule import adaptive_schedule
from clvoro.adaptation.stages import Stages
from clvoro.opencl.engine import Engine
from clvoro.opencl.peers import ALONE
from clvoro.opencl.threads import Team
from clvoro.sizing import Sizing, as_field
from tests.reference import local_counts as reference
from tests.reference import patch

H = 0.1
LEFT, RIGHT, APART = (0.0, 0.0), (1.4, 0.0), (3.0, 0.0)
NECK = [(1, 0.35), (1.4, 0.35), (1.4, 0), (2.4, 0), (2.4, 1), (1.4, 1), (1.4, 0.65), (1, 0.65)]
ROOMS = np.array([(0, 0), (1, 0), *NECK, (1, 1), (0, 1)], float)
"""Two rooms of 100 cells each, joined by a neck that is three cells wide and four long."""
DOMAINS = {
    "rooms": clvoro.Polygon(ROOMS),
    "and a piece": clvoro.Polygon.from_pieces([[ROOMS], [np.array([(3, 0), (3.6, 0), (3.6, 0.6), (3, 0.6)])]]),
}


def grid(corner, size, counts, rng):
    """Return an irregular lattice of generators in a rectangle or box."""
    d = len(counts)
    at = np.indices(counts).reshape(d, -1).T + 0.5 + rng.uniform(-0.2, 0.2, (np.prod(counts), d))
    return np.array(corner) + at / counts * size


def unbalanced(left, right, pieces=False):
    """Return generators of both rooms, with `left` and `right` (columns, rows) of them."""
    rng = np.random.default_rng(41)
    parts = [grid(LEFT, 1, left, rng), grid(RIGHT, 1, right, rng), grid((1, 0.35), (0.4, 0.3), (4, 3), rng)]
    return np.concatenate([*parts, grid(APART, 0.6, (7, 7), rng)] if pieces else parts)


def make_mesh(ctx, domain, points, fixed=0, real=np.float64, peers=ALONE, labels=None):
    engine = Engine(ctx, cl.CommandQueue(ctx), domain.dim, np.dtype(real), domain.traits(np.dtype(real)), peers=peers)
    on_device = engine.upload(domain.place(points, engine.real))
    sizing = Sizing(engine, domain, as_field(H))
    return patch.make_mesh(Stages(engine), domain, sizing, on_device, fixed=fixed, labels=labels)


def chosen(mesh):
    """Return the changes that are chosen, (n,) int32."""
    with mesh.engine.workspace.frame():
        w = mesh.stages.density.cell_weights(mesh.t, mesh.h)
        changes = mesh.engine.scratch(mesh.n, np.int32)
        some = mesh.stages.local_counts.choose(mesh, w, changes)
        found = changes.get()
    assert some == mesh.engine.peers.any(found.any())
    return found


def cells_of(mesh):
    t, n = mesh.t, mesh.n
    starts = t.starts.get()
    neighbors, measures = (a.get()[: starts[-1]] for a in (t.neighbors, t.face_measures))
    points, h = mesh.points.get(), mesh.h.get()
    owners, inner = np.repeat(np.arange(n), np.diff(starts)), neighbors >= 0
    pairs = np.column_stack([owners, neighbors])[inner]
    return reference.Cells(
        pairs,
        measures[inner] / np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T),
        np.diff(starts),
        np.bincount(owners[~inner], minlength=n) > 0,
        t.volumes.get() / h**2,
    )


def energy_of(mesh):
    """Return E of the reference: half the sum of |u|^2 / h^2."""
    cells = cells_of(mesh)
    return cells.potential(cells.weight - 1) @ (cells.weight - 1) / 2


@pytest.mark.parametrize(("name", "fixed"), [("rooms", 0), ("rooms", 40), ("and a piece", 0)])
def test_choice(ctx, monkeypatch, name, fixed):
    """With exact potentials the sites are those of the reference, also next to fixed generators."""
    monkeypatch.setattr(tuning, "BALANCE_TOLERANCE", 1e-11)
    points = unbalanced((14, 8), (8, 11), name != "rooms")
    mesh = make_mesh(ctx, DOMAINS[name], points, fixed)
    found = chosen(mesh)
    held = mesh.labels.get() < fixed
    expected = reference.changes(cells_of(mesh), held)
    assert np.array_equal(found, expected)
    assert min((expected > 0).sum(), (expected < 0).sum()) >= 3


@pytest.mark.parametrize("name", list(DOMAINS))
@pytest.mark.parametrize("most", [0, tuning.BALANCED_ALONE])
def test_choice_of_parts(ctx, monkeypatch, name, most):
    """With exact potentials two parts choose the same; the first one chooses for both, with few messages."""
    monkeypatch.setattr(tuning, "BALANCE_TOLERANCE", 1e-11)
    monkeypatch.setattr(tuning, "BALANCED_ALONE", most)
    points = unbalanced((14, 8), (8, 11), name != "rooms")
    whole = make_mesh(ctx, DOMAINS[name], points)
    expected = np.zeros(len(points), int)
    expected[whole.labels.get()] = chosen(whole)

    def work(peers):
        rows = np.array_split(np.arange(len(points)), 2)[peers.number]
        mesh = make_mesh(ctx, DOMAINS[name], points[rows], labels=rows, peers=peers)
        before = peers.exchanges
        return mesh.labels.get(), chosen(mesh), peers.exchanges - before

    (labels, found, exchanges), other = Team(2).run(work)
    assert np.array_equal(np.concatenate([found, other[1]]), expected[np.concatenate([labels, other[0]])])
    assert (exchanges < 10) == (most > 0)


def test_fixed_generators_cut_regions_off(ctx):
    """Between two layers of fixed generators faces stay: each side gets its cells, of 156 and 204."""
    box, rng = clvoro.Box((0, 0, 0), (1, 0.6, 0.6)), np.random.default_rng(44)
    layers = [(x, *yz) for x in (0.45, 0.55) for yz in 0.05 + 0.1 * np.indices((6, 6)).reshape(2, -1).T]
    size = 0.4, 0.6, 0.6
    free = grid((0, 0, 0), size, (4, 6, 5), rng), grid((0.6, 0, 0), size, (4, 7, 6), rng)
    points = np.concatenate([layers, *free])

    def work(peers):
        rows = np.array_split(np.argsort(points[:, 1]), peers.count)[peers.number]
        mesh, begun = make_mesh(ctx, box, points[rows], len(layers), peers=peers, labels=rows), False
        while mesh.balance_regions(mesh.missing_cells(), begun) != (0, 0):
            begun = True
        return mesh.to_host(mesh.points, mesh.domain.frame[1]) + mesh.domain.frame[0]

    x, in_parts = work(ALONE), np.concatenate(Team(2).run(work))
    assert [(x[:, 0] < 0.5).sum(), (x[:, 0] > 0.5).sum()] == pytest.approx([180, 180], abs=1)
    assert np.sort(in_parts, axis=0) == pytest.approx(np.sort(x, axis=0), abs=1e-9)
    # Where faces can move, generators do, and nothing else is changed.
    mesh = make_mesh(ctx, box, np.concatenate([layers[:36], *free]), fixed=36)
    assert mesh.balance_regions(mesh.missing_cells(), begun=False) == (0, 0)


def in_both(mesh):
    """Return the number of generators left and right of the gap."""
    origin, scale = mesh.domain.frame
    x = mesh.to_host(mesh.points, scale)[:, 0] + origin[0]
    return [(x < 1).sum(), (x > 1.4).sum()]


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_rooms_get_their_cells(ctx, real):
    """Cells are inserted and deleted until no further change gains enough. New cells have new labels."""
    mesh = make_mesh(ctx, DOMAINS["rooms"], unbalanced((12, 9), (13, 7)), real=real)
    energy = energy_of(mesh)
    n, first = mesh.n, mesh.next_label
    inserted, deleted = mesh.balance_counts()
    assert mesh.n == n + inserted - deleted
    labels = np.sort(mesh.labels.get())
    assert np.array_equal(labels[labels >= first], first + np.arange(inserted))
    assert in_both(mesh) == pytest.approx([100, 100], abs=5)
    assert energy_of(mesh) < energy / 4


def test_balanced_rooms_do_not_change(ctx):
    """A room with a cell too many does not gain enough to delete one."""
    mesh = make_mesh(ctx, DOMAINS["rooms"], unbalanced((10, 10), (10, 10))[1:])
    before = mesh.points.get()
    assert mesh.balance_counts() == (0, 0)
    assert np.array_equal(mesh.points.get(), before)


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_each_piece_gets_its_cells(ctx, real):
    """Two pieces have too many and too few cells, 199 of 200; no displacement could even this out."""
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    domain = clvoro.Polygon.from_pieces([[square], [square + np.array(RIGHT)]])
    rng = np.random.default_rng(43)
    points = np.concatenate([grid(LEFT, 1, (10, 9), rng), grid(RIGHT, 1, (11, 10), rng)[1:]])
    mesh = make_mesh(ctx, domain, points, real=real)
    # There is room for about five changes at once.
    mesh.balance_counts()
    mesh.balance_counts()
    assert in_both(mesh) == pytest.approx([100, 100], abs=1)


def test_cells_at_walls_are_split(ctx):
    """A passage one cell wide has no other sites: 30 cells fit, and 20 are there, all in its right half."""
    passage = clvoro.Polygon([(0, 0), (3, 0), (3, 0.1), (0, 0.1)])
    points = np.column_stack([1.5 + 0.075 * (np.arange(20) + 0.5), np.full(20, 0.05)])
    mesh = make_mesh(ctx, passage, points)
    inserted, _ = mesh.balance_counts()
    assert inserted >= 2


@pytest.mark.parametrize("levels", [0, 2])
def test_only_narrow_parts_in_the_plane_are_balanced(levels):
    """Before each refinement, which multiplies what a part lacks, before polishing, and after each repair."""
    for dim, narrow, expected in ((2, True, 4 + levels), (2, False, 0), (3, False, 0)):
        schedule = adaptive_schedule(dim, "default", levels, True, narrow_parts=narrow)
        at = [k for k, action in enumerate(schedule) if action == BalanceCounts()]
        assert len(at) == expected
        assert [schedule[k + 1] for k in at[:levels]] == [Refine()] * len(at[:levels])
        repairs = [isinstance(schedule[k - 1], RepairCells) for k in at[levels:]]
        assert repairs == [False, True, True, True][: len(repairs)]
        near = adaptive_schedule(dim, "default", 0, True, begins="near", narrow_parts=narrow)
        assert near.count(BalanceCounts()) == min(expected, 1)
