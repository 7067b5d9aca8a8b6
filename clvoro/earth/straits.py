"""Straits of a single cell's width, and cells that widen them."""

from __future__ import annotations

import numpy as np

from ..mesh.connectivity import face_owners, following
from ..mesh.diagram import Diagram


def narrow_cells(diagram: Diagram, water: np.ndarray) -> np.ndarray:
    """Return which water cells have land on two sides, so that water is one cell wide there: (n,) bool.

    The neighbors around such a cell form two or more runs of water with land between them.
    """
    wet = (diagram.neighbors >= 0) & water[diagram.neighbors]
    ends = wet & ~wet[following(diagram.neighbor_starts)]
    return water & (np.bincount(face_owners(diagram), ends, len(diagram)) >= 2)


def widen_straits(diagram: Diagram, water: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `water` with more cells, so that no strait is a single cell wide, and the cells where that is impossible.

    Beside a narrow cell one run of land between two runs of water becomes water, the shortest one that can. A land cell
    can become water if its neighbors in the water form a single run. Then land and water keep their connected parts: no
    land bridge opens, and no island disappears.

    Parameters
    ----------
    diagram : Diagram
    water, fixed : (n,) bool
        Water cells, and land cells that stay land.

    Returns
    -------
    water : (n,) bool
    left : (k,) int
        Cells that are still narrow.
    """
    wet = water.copy()
    starts, neighbors = diagram.neighbor_starts.tolist(), diagram.neighbors
    while True:
        changed = False
        for cell in np.flatnonzero(narrow_cells(diagram, wet)).tolist():
            ring = neighbors[starts[cell] : starts[cell + 1]].tolist()
            runs = _land_runs(ring, wet)
            if len(runs) < 2:
                continue  # widened from another cell
            for run in sorted(runs, key=len):
                if _flood(run, wet, fixed, starts, neighbors):
                    changed = True
                    break
        if not changed:
            return wet, np.flatnonzero(narrow_cells(diagram, wet))


def _land_runs(ring: list[int], wet: np.ndarray) -> list[list[int]]:
    """Return the runs of land among the neighbors around a cell; -1 and below are land, too."""
    is_wet = [j >= 0 and bool(wet[j]) for j in ring]
    first = next((k for k, here in enumerate(is_wet) if here), 0)
    runs: list[list[int]] = []
    before = True
    for k in range(first, first + len(ring)):
        here = is_wet[k % len(ring)]
        if not here:
            runs = [*runs, []] if before else runs
            runs[-1].append(ring[k % len(ring)])
        before = here
    return runs


def _flood(run: list[int], wet: np.ndarray, fixed: np.ndarray, starts: list[int], neighbors: np.ndarray) -> bool:
    """Make a run of land cells water, from its begin on; if one of them must stay land, change nothing."""
    done: list[int] = []
    for cell in run:
        if cell >= 0 and not fixed[cell]:
            ring = neighbors[starts[cell] : starts[cell + 1]].tolist()
            if len(_land_runs(ring, wet)) == 1:
                wet[cell] = True
                done.append(cell)
                continue
        wet[done] = False
        return False
    return True
