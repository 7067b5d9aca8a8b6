"""Moves of the points of patches: minima of the sum of squares, the same alone and together."""

import numpy as np
import pytest
import scipy.optimize

import clvoro
from clvoro.finite_volumes.repair import moves
from clvoro.finite_volumes.repair.patch import part_of, take_patch
from clvoro.finite_volumes.repair.pricing import PricedPatch
from clvoro.finite_volumes.repair.tasks import Move, in_step, moved, run_task
from tests.finite_volumes.repair.test_patch import with_positions
from tests.finite_volumes.test_straight_walls import ELL


@pytest.fixture(scope="module")
def patches(ctx):
    """Three patches of random cells, and the boundary of their domain."""
    domain = clvoro.Polygon(ELL)
    points = np.random.default_rng(2).random((300, 2))
    mesh = clvoro.Adapter(ctx).diagram(domain, points[domain.contains(points)])
    mesh = mesh.solver_mesh(collapse=False)
    whole, ring = with_positions(mesh, take_patch(mesh, np.ones(mesh.n_cells, bool)))
    middles = PricedPatch.of(whole).cells.origin
    found = []
    for center in ([0.1, 0.1], [0.8, 0.2], [0.3, 0.8]):
        near = np.hypot(*(middles - center).T) < 0.22
        found.append(PricedPatch.of(part_of(whole, near)))
        assert found[-1].bad.any()
    return found, ring


def requests(given):
    return [Move(p, p.near(p.bad, 2), True, steps) for p, steps in zip(given, (3, 15, 8), strict=True)]


def test_patches_move_alike_alone_and_together(patches):
    given, ring = patches
    together = moved(requests(given), ring)
    for one, other, before in zip(together, given, requests(given), strict=True):
        (alone,) = moved([before], ring)
        assert (alone.patch.points != other.patch.points).any()
        # Sums over a patch are taken in another order, and its steps amplify their round-off.
        np.testing.assert_allclose(one.patch.points, alone.patch.points, rtol=0, atol=1e-9)


def test_sparse_matrices_give_the_moves_of_dense_ones(patches, monkeypatch):
    given, ring = patches
    dense = moved(requests(given), ring)
    monkeypatch.setattr(moves, "_MOST_DENSE", 0)
    for one, other in zip(moved(requests(given), ring), dense, strict=True):
        np.testing.assert_allclose(one.patch.points, other.patch.points, rtol=0, atol=1e-9)


def test_moves_end_near_the_minimum(patches):
    given, ring = patches
    worst = np.arange(len(given[0].prices)) == np.argmax(given[0].prices)
    problem = given[0].problem(given[0].near(worst, 1), False)

    def residuals(flat):
        at = problem.cells.figures(*problem.placed(flat.reshape(-1, 2), ring))
        return np.concatenate([problem.cells.terms(at), moves._MOVE_WEIGHT * flat])

    (found,) = moves.minimize([problem], [100], ring)
    start = np.zeros(found.size)
    known = scipy.optimize.least_squares(residuals, start)
    cost, first = (float(residuals(m) @ residuals(m)) for m in (found.ravel(), start))
    assert cost < 0.9 * first
    # The last step lowered the sum by less than a thousandth; the next ones would lower it by as much at most.
    assert cost < 1.05 * 2 * known.cost


def test_patches_without_points_that_move_stay(patches):
    given, ring = patches
    nowhere = [Move(p, np.zeros(len(p.prices), bool), True, 5) for p in given]
    assert all(a is b for a, b in zip(moved(nowhere, ring), given, strict=True))


def test_tasks_in_step_give_the_results_of_each(patches):
    given, ring = patches

    def some_moves(patch, count):
        for _ in range(count):
            (patch,) = yield [Move(patch, patch.near(patch.bad, 1), False, 2)]
        return patch

    counts = (2, 0, 1)
    alone = [run_task(some_moves(p, n), ring) for p, n in zip(given, counts, strict=True)]
    tasks = [some_moves(p, n) for p, n in zip(given, counts, strict=True)]
    together = run_task(in_step(tasks), ring)
    assert together[1] is given[1]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one.patch.points, other.patch.points, rtol=0, atol=1e-9)
