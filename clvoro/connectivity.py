"""Connectivity in arrays: ragged rows, sets of indices, and components of graphs.

Row i of a ragged array of n rows is ``items[starts[i] : starts[i + 1]]``; `starts` has n + 1 numbers.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy


def starts_of(counts: np.ndarray | list[int], dtype: type = np.int64) -> np.ndarray:
    """Return the `starts` (n + 1,) of rows with `counts` (n,) items."""
    found = np.zeros(len(counts) + 1, dtype)
    np.cumsum(counts, out=found[1:])
    return found


def rows_of(starts: np.ndarray) -> np.ndarray:
    """Return the number of the row that each item is in, (k,) int."""
    return np.repeat(np.arange(len(starts) - 1), np.diff(starts))


def rows_and_places(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the row that each item is in, and its place there, (k,) int each; rows have `counts` (n,) items."""
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)


def ranges(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return i and k, (m,) int each, of all pairs with ``first[i] <= k <= last[i]``, by i, then k."""
    i, place = rows_and_places(last - first + 1)
    return i, place + first[i]


def following(starts: np.ndarray) -> np.ndarray:
    """Return for each item of ragged rows, taken as loops, the place of the next item of its loop."""
    places = np.arange(1, starts[-1] + 1)
    filled = starts[1:] > starts[:-1]
    places[starts[1:][filled] - 1] = starts[:-1][filled]
    return places


def distinct(values: np.ndarray) -> np.ndarray:
    """Return the different `values`, ascending: `np.unique` by sorting, in a tenth of the time for integers."""
    values = np.sort(values)
    new = np.ones(len(values), bool)
    new[1:] = values[1:] != values[:-1]
    return values[new]


def used_indices(indices: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers below `count` that occur in `indices`, ascending, and the row of each index among these."""
    used = np.zeros(count, bool)
    used[indices] = True
    return np.flatnonzero(used), np.take(np.cumsum(used, dtype=np.int32) - 1, indices)


def inverse(starts: np.ndarray, items: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each of `size` items the rows of the ragged array `starts` and `items` that have it, also ragged."""
    rows = scipy.sparse.csc_array((np.ones(len(items), np.int8), items, starts), (size, len(starts) - 1)).tocsr()
    return rows.indptr, rows.indices


def take_rows(
    starts: np.ndarray, items: np.ndarray, rows: np.ndarray, backwards: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the selected `rows` (indices) of the ragged array `starts` and `items`, as starts and items.

    Where `backwards` (bool, one per row) is set, the items of a row are reversed, but the first stays first.
    """
    begin = starts[:-1][rows]
    return take_ranges(begin, starts[1:][rows] - begin, items, backwards)


def take_ranges(
    begin: np.ndarray, counts: np.ndarray, items: np.ndarray, backwards: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of `items`: row i has ``counts[i]`` of them, from ``begin[i]`` on; see `take_rows`."""
    taken = starts_of(counts)
    found = np.empty((taken[-1], *items.shape[1:]), items.dtype)
    for part in slices(len(counts)):
        first, end = int(taken[part.start]), int(taken[part.stop])
        base, many = begin[part], counts[part]
        places = np.repeat(base - taken[part], many)
        places += np.arange(first, end)
        if backwards is not None and backwards[part].any():
            turned = np.repeat(backwards[part], many) & (places > np.repeat(base, many))
            places = np.where(turned, np.repeat(2 * base + many, many) - places, places)
        found[first:end] = items.take(places, axis=0)
    return taken, found


def rows_with(starts: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return which rows of a ragged array of k items have one that is `chosen` (k,) bool; an empty row has none."""
    found = np.empty(len(starts) - 1, bool)
    for part in slices(len(found)):
        here = starts[part.start : part.stop + 1]
        count = np.zeros(here[-1] - here[0] + 1, np.int32)
        np.cumsum(chosen[here[0] : here[-1]], out=count[1:])
        count = count[here - here[0]]
        found[part] = count[1:] > count[:-1]
    return found


def slices(count: int, size: int = 1 << 14) -> Iterator[slice]:
    """Cut `count` rows into parts whose arrays fit the caches: large arrays cost a system call and cleared memory."""
    return (slice(k, min(k + size, count)) for k in range(0, count, size))


def independent(sets: np.ndarray, cells: np.ndarray, priority: np.ndarray, n: int) -> np.ndarray:
    """Return a maximal choice of sets without a cell in common, those of least priority first, (k,) bool.

    Sets are changes to a mesh, with the `cells` (s,) that they change; the choice can be made at the same time.
    """
    k = len(priority)
    rank = np.empty(k, np.int64)
    rank[np.argsort(priority, kind="stable")] = np.arange(k)
    chosen, left = np.zeros(k, bool), np.ones(k, bool)
    taken = np.zeros(n, bool)
    while len(sets):
        best = np.full(n, k)
        np.minimum.at(best, cells, rank[sets])
        loses = np.zeros(k, bool)
        loses[sets[best[cells] != rank[sets]]] = True
        wins = left & ~loses
        wins &= np.bincount(sets, minlength=k) > 0
        chosen |= wins
        taken[cells[wins[sets]]] = True
        left &= ~wins
        left[sets[taken[cells]]] = False
        going = left[sets]
        sets, cells = sets[going], cells[going]
    return chosen


def components(n: int, i: np.ndarray, j: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of connected components of a graph, and the component of each of its `n` nodes, (n,) int.

    Edge k leads from node ``i[k]`` to node ``j[k]``.
    """
    graph = scipy.sparse.coo_array((np.ones(len(i), bool), (i, j)), shape=(n, n))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)


def first_nodes(n: int, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return the first node of the component that each node is in, (n,) int; see `components`."""
    label = components(n, i, j)[1]
    return np.unique(label, return_index=True)[1][label]
