"""Move generators of rejected cells, and those beside them, a little, so that the mesh can be made again."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
import scipy

from ..geometry.domain import Domain
from ..geometry.solid.creases import connect
from ..geometry.surfaces.sheets import Sheets

T = TypeVar("T")
FEW = 0.03
"""Largest share of generators with rejected cells for which meshes are made again, and of generators without cells."""
MOVES = 8
"""Largest number of trials to move the generators of rejected cells."""
_STEPS, _BESIDE = (0.1, 0.15, 0.2, 0.25, 0.3), 1.3
"""Displacements of generators of rejected cells, in turn, and distance up to which others move as well, over h."""
_GROUP = 2.5
"""Distance over h up to which rejected cells are in one group."""
_RETURNS = 4
"""How often groups are changed back and a mesh is made again, at most."""
_DEEP = 0.1
"""Least distance of moved generators from the boundary of the domain, over h."""
_NEAR, _MIRRORED = 0.75, 0.2
"""Largest distances of paired generators from a surface, and of one from the mirror image of the other, over h."""
_SLANTED = 0.2
"""Singular value, over the largest, of the normals at a pair, above which it does not move in that direction."""
_FREE = 0.9
"""Distance from surfaces inside, over h, below which generators without a partner do not come nearer."""


def least_bad(
    first: T,
    state: np.ndarray,
    sizes: np.ndarray,
    badness: Callable[[T], np.ndarray],
    change: Callable[[np.ndarray, np.ndarray, int], np.ndarray],
    remake: Callable[[np.ndarray, T], T | None],
    goes_on: list[bool],
) -> T:
    """Change what a mesh is made of at bad cells; return the mesh with the least sum of badness.

    Bad cells near each other are a group. If it is less bad after a change, what changed in it stays; all else is
    changed back.

    - `first`: the mesh of `state` (n, k): the generators, (n, 3), and more columns of numbers if it depends on these.
    - `sizes` (n,) float: h at the generators.
    - `badness`: returns how bad the cells of each generator are in a mesh, (n + 1,) float, 0 for good ones. The last
      number is that of cells without a generator.
    - `change`: called with the state, some rows (k,) int, and the number of the trial. Returns a state with those rows
      changed, and those beside them; or the same one, for which no mesh is made.
    - `remake`: called with another state and the last mesh. Returns the mesh of that state, or None if there is none.
    - `goes_on`: for each trial whether it changes the state of the one before at the cells that were bad then. Others
      change the best state so far.
    """
    best, last, bad, points = first, first, badness(first), state[:, :3]
    least, begun, given = bad.sum(), state, bad
    tried, new = state, bad
    for number, further in enumerate(goes_on):
        base, of = (tried, new) if further else (state, bad)
        if not bad.any():
            break
        rows = np.flatnonzero(of[:-1])
        trial = change(base, rows, number) if len(rows) else base
        if (trial == base).all() or (made := remake(trial, last)) is None:
            continue
        last, tried, new = made, trial, badness(made)
        if new.sum() < least:
            best, least = made, new.sum()
        found, group, before, after = _compared(points, sizes, bad, new)
        had = np.flatnonzero(bad[:-1])
        changed = np.flatnonzero((trial != state).any(axis=1))
        at = had[scipy.spatial.KDTree(points[had]).query(points[changed])[1]]
        changed = changed[(after < before)[group[np.searchsorted(found, at)]]]
        state = state.copy()
        state[changed] = trial[changed]
        replaced = ((after < before) | (before == 0))[group]
        bad = np.bincount(found, np.where(replaced, new[found], bad[found]), len(bad))
    # Groups were judged in several meshes. Those that are worse in one mesh than at first are changed back.
    for _ in range(_RETURNS if bad.sum() < least else 0):
        if (made := remake(state, best)) is None:
            break
        new = badness(made)
        if new.sum() < least:
            best, least = made, new.sum()
        found, group, before, after = _compared(points, sizes, given, new)
        changed = np.flatnonzero((state != begun).any(axis=1))
        changed = changed[(after > before)[group[scipy.spatial.KDTree(points[found]).query(points[changed])[1]]]]
        if not len(changed):
            break
        state = state.copy()
        state[changed] = begun[changed]
    return best


def at_generators(rows: np.ndarray, n: int, weights: np.ndarray | None = None) -> np.ndarray:
    """Return how often each of n generators is in `rows` (k,), -1 for none, or the sums of `weights`: (n + 1,) float.

    The last number is that of -1.
    """
    return np.bincount(rows % (n + 1), weights, n + 1).astype(float)


def _compared(
    points: np.ndarray, sizes: np.ndarray, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the generators (k,) that are bad before or after, their groups (k,), and how bad each group is (g,)."""
    found = np.flatnonzero(before[:-1] + after[:-1])
    count, group = _groups(points, sizes, found)
    return found, group, *(np.bincount(group, values[found], count) for values in (before, after))


def _groups(points: np.ndarray, sizes: np.ndarray, rows: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of groups of near generators, and the group of each of `rows` (k,) int."""
    x, h = points[rows], _GROUP * sizes[rows]
    pairs = scipy.spatial.KDTree(x).query_pairs(float(h.max()), output_type="ndarray")
    apart = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    return connect(len(rows), pairs[apart < h[pairs].min(axis=1)])


def moved(
    domain: Domain,
    depth: Callable[[np.ndarray], np.ndarray],
    sizes: np.ndarray,
    points: np.ndarray,
    rows: np.ndarray,
    move: int,
    held: int = 0,
) -> np.ndarray:
    """Return all generators (n, 3), with those of `rows` (k,) int and beside them moved. They stay in the domain.

    The two generators of a pair, on both sides of a surface inside, are moved together along the surface.

    - `depth`: returns how deep points (k, 3) are in the domain, (k,).
    - `sizes` (n,) float: h at the generators.
    - `move`: the number of the trial, which the random directions depend on.
    - `held`: how many of the first generators stay.
    """
    beside = scipy.spatial.KDTree(points).query_ball_point(points[rows], _BESIDE * sizes[rows])
    rows, points = np.unique(np.concatenate(beside).astype(np.int64)), points.copy()
    rows = rows[rows >= held]
    away = np.random.default_rng(move).normal(size=(len(rows), 3))
    away *= (_STEPS[move % len(_STEPS)] * sizes[rows] / np.linalg.norm(away, axis=1))[:, None]
    sheets = domain.sheets
    group, room = np.arange(len(rows)), np.zeros(len(rows))
    if sheets is not None:
        rows, away, group = _along(sheets, points, sizes, rows, away)
        room = np.minimum(sheets.distance(points[rows]), _FREE * sizes[rows])
        room[np.bincount(group)[group] > 1] = 0
    for sign in (1, -1):
        x = points[rows] + sign * away
        good = depth(x) > _DEEP * sizes[rows]
        if sheets is not None:
            good &= sheets.distance(x) >= room
        whole = np.ones(int(group.max(initial=-1)) + 1, bool)
        whole[group[~good]] = False
        inside = whole[group]
        points[rows[inside]] = x[inside]
        left = ~inside
        rows, away, group, room = rows[left], away[left], group[left], room[left]
    return points


def _along(
    sheets: Sheets, points: np.ndarray, sizes: np.ndarray, rows: np.ndarray, away: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which generators move (k,), how far (k, 3), and their groups (k,).

    First come those of `rows`, then the other ones of their pairs. Generators that move together are a group. They move
    as the first of them, but along all patches between them.
    """
    tree, given, new = scipy.spatial.KDTree(points), len(rows), rows
    pairs, normals = [np.zeros((0, 2), np.int64)], [np.zeros((0, 3))]
    while len(new):
        h = sizes[new]
        for patch in sheets.patches:
            feet = patch.feet(points[new], _NEAR * float(h.max()))
            near = np.flatnonzero((feet.triangle >= 0) & (feet.distance < _NEAR * h))
            gap, other = tree.query(2 * feet.point[near] - points[new[near]])
            paired = gap < _MIRRORED * h[near]
            pairs.append(np.column_stack([new[near[paired]], other[paired]]))
            normals.append((points[new[near]] - feet.point[near])[paired])
        new = np.setdiff1d(np.concatenate(pairs)[:, 1], rows)
        rows = np.concatenate([rows, new])
    mates, across = np.concatenate(pairs), np.concatenate(normals)
    across /= np.linalg.norm(across, axis=1)[:, None]
    place = np.full(len(points), -1)
    place[rows] = np.arange(len(rows))
    group = connect(len(rows), place[mates])[1]
    first = np.unique(group, return_index=True)[1]
    away = np.concatenate([away, np.zeros((len(rows) - given, 3))])[first]
    of_pair = group[place[mates[:, 0]]]
    for g in np.unique(of_pair).tolist():
        directions, share = np.linalg.svd(across[of_pair == g])[1:][::-1]
        fixed = directions[: int((share > _SLANTED * share[0]).sum())]
        away[g] -= fixed.T @ (fixed @ away[g])
    return rows, away[group], group
