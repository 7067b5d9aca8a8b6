"""Insertion and deletion of generators with Lloyd smoothing, the paper's 2.3.1, as a peer.

Each sweep deletes generators of cells that are too small, divides cells that are too large, and takes two Lloyd
steps (Labelle and Shewchuk, SoCG 2003, insert in this way). Lloyd's steps even sizes out, so that later sweeps go on
inserting and deleting. The mesh of the sweep with the smallest mean error is returned. A cell of volume V becomes two
of V / 2, so it is divided from V = sqrt(2) h^d on.
"""

from __future__ import annotations

import math

import numpy as np

import clvoro
from clvoro import sizing

SWEEPS, SMOOTHING = 30, 2
LIMIT = math.log(2) / 2
"""|log(V / h^d)| from which a cell is divided or deleted."""


def insert_delete_smooth(
    adapter: clvoro.Adapter, domain: clvoro.Box, size: sizing.Field, seed: int
) -> tuple[np.ndarray, int, float]:
    """Return generators (n, d), the number of Lloyd steps, and the changes of neighbors per cell."""
    mesh = adapter.run(domain, size, points="density", method="lloyd", seed=seed, max_steps=SMOOTHING)
    best, steps, changes = mesh, SMOOTHING, 0.0
    for _ in range(SWEEPS):
        points = _divide_and_delete(mesh.diagram, np.asarray(mesh.target_size))
        mesh = adapter.run(domain, size, points=points, method="lloyd", max_steps=SMOOTHING)
        steps += SMOOTHING
        changes += float(mesh.history["changed"].sum()) / len(points)
        if np.abs(mesh.size_error).mean() < np.abs(best.size_error).mean():
            best = mesh
    return best.points, steps, changes


def _divide_and_delete(diagram: clvoro.Diagram, h: np.ndarray) -> np.ndarray:
    """Return the generators after one sweep. No two neighbors change at once; the largest errors come first."""
    points, d = diagram.points, diagram.points.shape[1]
    ratio = np.log(diagram.volumes / h**d)
    starts, neighbors = diagram.neighbor_starts, diagram.neighbors
    blocked, deleted, inserted = np.zeros(len(points), bool), [], []
    moved = points.copy()
    for i in np.argsort(-np.abs(ratio), kind="stable"):
        if abs(ratio[i]) < LIMIT:
            break
        if blocked[i]:
            continue
        around = neighbors[starts[i] : starts[i + 1]]
        around = around[around >= 0]
        blocked[around] = True
        if ratio[i] < 0:
            deleted.append(i)
            continue
        # Divide across the longest way to a neighbor: a quarter of it on either side.
        ways = points[around] - points[i]
        way = ways[np.argmax(np.linalg.norm(ways, axis=1))] / 4
        both = np.clip([points[i] + way, points[i] - way], diagram.domain.lower, diagram.domain.upper)
        moved[i] = both[0]
        inserted.append(both[1])
    return np.concatenate([np.delete(moved, deleted, axis=0), np.array(inserted).reshape(-1, d)])
