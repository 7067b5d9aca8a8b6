"""Generators of rejected cells: how they are moved, alone and as pairs beside surfaces, and which mesh is kept."""

import numpy as np
import pytest

import clvoro
from clvoro.finite_volumes.moves import least_bad, moved

H = 0.25
CUBE = clvoro.Solid.box((0, 0, 0), (1, 1, 1))


def in_solid(solid, x, rows, move, held=0):
    return moved(solid, lambda at: -solid.signed_distance(at), np.full(len(x), H), x, np.array(rows), move, held)


def test_generators_of_rejected_cells_are_moved_inside_of_the_solid():
    """So are those beside them. One in a corner is moved away from it; where there is no room, it stays."""
    row = 0.5 + np.array([[0, 0, 0], [1.2 * H, 0, 0], [1.4 * H, 0, 0]])
    assert (in_solid(CUBE, row, [0], 0) != row).any(axis=1).tolist() == [True, True, False]
    assert (in_solid(CUBE, row, [0], 0, held=1) != row).any(axis=1).tolist() == [False, True, False]
    solid = clvoro.Solid.box((0, 0, 0), (1, 1, 0.25 * H))
    x = np.array([[0.5, 0.5, 0.12 * H], [0.5, 0.2, 0.13 * H], [0.12 * H, 0.12 * H, 0.12 * H], [0.3, 0.3, 0.05 * H]])
    for move in range(3):
        there = in_solid(solid, x, [0, 2, 3], move)
        away = np.linalg.norm(there - x, axis=1) / H
        assert away[1] == 0
        assert all(a == 0 or a == pytest.approx(0.1 + 0.05 * move) for a in away)
        assert (solid.signed_distance(there[away > 0]) < 0).all()


def test_pairs_stay_mirror_images_in_all_patches_between_them():
    """Of a generator near a cross of two planes all four move, along the line in which the planes meet."""
    line = np.array([(0.5, 0.5, -1), (0.5, 0.5, 2)])
    halves = [np.concatenate([line, line[::-1] + way]) for way in np.eye(3)[[0, 0, 1, 1]] * [[1], [-1], [1], [-1]]]
    surfaces = [(half, np.array([(0, 1, 2), (0, 2, 3)])) for half in halves]
    domain = clvoro.Box((0, 0, 0), (1, 1, 1)).with_surfaces(surfaces)
    cross = [(0.5 + s * H / 2, 0.5 + t * H / 2, 0.5) for s in (1, -1) for t in (1, -1)]
    pair = [(0.2, 0.5 + s * H / 2, 0.5) for s in (1, -1)]
    x = np.array([*cross, *pair, (0.2, 0.5 + 1.1 * H, 0.5)])
    depth = domain.boundary_distance
    for move in range(4):
        away = moved(domain, depth, np.full(len(x), H), x, np.array([0, 4]), move) - x
        assert away[:4] == pytest.approx(np.tile(away[0] * (0, 0, 1), (4, 1)), abs=1e-12)
        assert away[4:6] == pytest.approx(np.tile(away[4] * (1, 0, 1), (2, 1)), abs=1e-12)
        assert abs(away[0, 2]) > 0
        assert np.linalg.norm(away[4]) > 0
        assert domain.borders.sheets.distance(x[6:] + away[6:])[0] >= 0.9 * H - 1e-12


def test_the_mesh_of_the_least_bad_cells_is_kept():
    """What changed in a group stays if it is less bad then. Trials go on from there, or from the one before."""
    state = np.column_stack([np.arange(300) * 3.0, np.zeros((300, 3))])
    begun, made = [], []

    def change(now, rows, number):
        begun.append((np.flatnonzero(now[:, 3]).tolist(), rows.tolist(), number))
        return now + (number != 1) * np.isin(np.arange(300), rows)[:, None] * (0, 0, 0, 1)

    def kept(first, meshes, goes_on):
        meshes = iter(meshes)

        def badness(mesh):
            return np.bincount(np.array(mesh, int) % 301, minlength=301).astype(float)

        def remake(now, last):
            made.append((np.flatnonzero(now[:, 3]).tolist(), last))
            return next(meshes)

        return least_bad(first, state, np.ones(300), badness, change, remake, goes_on)

    first, better = [0, 1, 1, 100, 200], [0, 1, 200, -1]
    assert kept(first, [better, [0, 0, 1, 200], None, [0, 1]], [False] * 4) == [0, 1]
    assert begun == [
        ([], [0, 1, 100, 200], 0),
        ([1, 100], [0, 1, 200], 1),
        ([1, 100], [0, 1, 200], 2),
        ([1, 100], [0, 1, 200], 3),
    ]
    begun.clear()
    assert kept([0, 100], [[0, 0, 100], [100], []], [False, False, True, False]) == []
    assert begun == [([], [0, 100], 0), ([], [0, 100], 1), ([0, 100], [0, 100], 2), ([0], [100], 3)]
    assert kept([], [], [False]) == []
    # What was kept is worse in one mesh at 0, and is changed back there.
    made.clear()
    worse, best = [0, 0, 200], [0, 200]
    assert kept([0, 100, 200], [[200] * 3, worse, best], [False]) == best
    assert made == [([0, 100, 200], [0, 100, 200]), ([0, 100], [0, 100, 200]), ([100], [0, 100, 200])]
