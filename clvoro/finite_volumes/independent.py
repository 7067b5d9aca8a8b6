"""Choice of changes to a mesh that can be made at the same time: no two of them change the same cell."""

from __future__ import annotations

import numpy as np


def independent(sets: np.ndarray, cells: np.ndarray, priority: np.ndarray, n: int) -> np.ndarray:
    """Return a maximal choice of sets without a cell in common, those of least priority first, (k,) bool."""
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
